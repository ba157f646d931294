"""A real man before four calibrated cameras: each view alone against the other three.

    python benchmarks/bench_real.py FOLDER [--stages FOLDER] [--calibrated]
        [--views cam01 cam02] [--pictures FOLDER]

`FOLDER` holds `videos/NAME.mp4`, synchronised views that do not move, and
`calibration/*.qca.txt` (Qualisys). Every view is estimated from its video alone, as by
`bodyslam run`; with `--calibrated` its camera is given, too. The truth for a view are
the keypoints of the *other* views, found by the networks that ship: people are
associated by whether their keypoints meet in space, points are triangulated without
distortion, by a robust loss, and keypoints that are off by more than `MAX_OFF` are left
out. Who is in fewer than three views or stays in place is not evaluated: a bystander,
and a woman who is rendered.

Errors are those of twelve joints (shoulders, elbows, wrists, hips, knees, ankles):

- *PA*: after the best similarity of each frame; *along* and *across* the view, root
  mean squares for one axis, are of what it leaves, as are errors by joint;
- *MPJPE*: in the camera's frame, both about the middle of the hips, neither turned nor
  scaled; *scaled* with one size for the whole clip, that of *size*;
- *size*: thighs, shins, upper arms and forearms, medians over the clip, over the true.

A body's joints are not a detector's keypoints. *Definitions out*: each joint is moved
by an offset in the axes of the limb that it moves with, the same on both sides, which
is measured in the other views' estimates and so is none of this view's error.

It is one man at one place: no constant may be chosen on it.
"""

import argparse
import dataclasses
import itertools
from pathlib import Path

import cv2
import jax
import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax import io, pipeline
from bodyslam_jax.body import KEYPOINT_NAMES
from bodyslam_jax.body.skeleton import KEYPOINT_JOINT, PARENTS
from bodyslam_jax.config import Config
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.geometry.triangulation import triangulate
from bodyslam_jax.io.camera.calibration_files import read_named_cameras
from bodyslam_jax.io.files import read_xml
from bodyslam_jax.types import Result, Sequence

PARTS = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
NAMES = tuple(f"{side}_{part}" for side in ("left", "right") for part in PARTS)
POINTS = [KEYPOINT_NAMES["body25"].index(name) for name in NAMES]
JOINTS = [KEYPOINT_JOINT[name] for name in NAMES]
HIPS = [NAMES.index("left_hip"), NAMES.index("right_hip")]
SEGMENTS = [
    (NAMES.index(f"{side}_{a}"), NAMES.index(f"{side}_{b}"))
    for side in ("left", "right")
    for a, b in (("hip", "knee"), ("knee", "ankle"))
    + (("shoulder", "elbow"), ("elbow", "wrist"))
]
MIN_CONFIDENCE = 0.2
"""Of keypoints that are triangulated: below it they are gross too often (`found`)."""
MAX_OFF = 0.04
"""m at the point's depth, from which a keypoint is another point's: three to four
standard deviations of a sure one."""
MIN_JOINTS = 9
"""Joints that a frame must have to be evaluated."""
MOVES = 0.1
"""m: root mean square of the middle of the hips about its mean, from which somebody
moves about."""
MIN_MEETING = 0.5
"""Share of the sure keypoints of all views that meet, from which they are one
person's."""
TYPICAL_DEPTH = 3.0
"""m, at which half of `MAX_OFF` is the scale of the robust loss."""
POSE_SIGMA = (0.01, 0.02)
"""Errors of the calibration's rotations, rad, and places, m, for `refined`."""
NOISE, FRAMES_ALIKE = 0.012, 9
"""Error of a keypoint, m, and the number of frames that share it, at 60 fps."""
REFINEMENTS = 30
FIGURES = ("pa", "mpjpe", "scaled", "size", "along", "across", "lasting", "frames")
CONFIG = Config(overlay=False)


@dataclasses.dataclass(frozen=True)
class View:
    """A calibrated camera, and the people in its video."""

    name: str
    K: Float[np.ndarray, "3 3"]
    distortion: Float[np.ndarray, " d"]
    R_CW: Float[np.ndarray, "3 3"]
    centre: Float[np.ndarray, "3"]
    """m, world of the calibration."""
    sequence: Sequence
    """With the people found."""

    def undistorted(self) -> Float[np.ndarray, "h t 12 2"]:
        """Keypoints at depth 1, without distortion; NaN where none is sure."""
        found = self.sequence.keypoints
        assert found is not None
        uv, sure = found.uv[:, :, POINTS], found.confidence[:, :, POINTS]
        flat = np.ascontiguousarray(uv.reshape(-1, 1, 2), np.float64)
        xy = cv2.undistortPoints(flat, self.K, self.distortion).reshape(uv.shape)
        return np.where((sure > MIN_CONFIDENCE)[..., None], xy, np.nan)

    def to_camera(self, x: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 3"]:
        return (x - self.centre) @ self.R_CW.T


def read_views(folder: Path, stages: Path | None) -> list[View]:
    """Cameras of the calibration with the people that were found in their videos."""
    (file,) = (folder / "calibration").glob("*.qca.txt")
    cameras = {camera.name: camera for camera in read_named_cameras(file) or ()}
    views = []
    for node in read_xml(file, "a calibration").findall("cameras/camera"):
        name, pose = node.get("serial", ""), node.find("transform")
        assert pose is not None
        number = lambda key, pose=pose: float(pose.get(key, "nan"))
        axes = [[number(f"r{i}{j}") for j in (1, 2, 3)] for i in (1, 2, 3)]
        # Qualisys' rows are a camera's axes to the right, up and backwards.
        R_CW = np.diag([1.0, -1.0, -1.0]) @ np.array(axes)
        centre = np.array([number(axis) for axis in "xyz"]) / 1000
        camera = cameras[name]
        video = folder / "videos" / f"{name}.mp4"
        cache = pipeline.Cache(stages and stages / f"{name}-alone")
        sequence = pipeline.find_people(io.read_sequence(video), CONFIG, cache)
        views.append(View(name, camera.K, camera.distortion, R_CW, centre, sequence))
    return views


def meet(
    views: list[View], xy: list[Float[np.ndarray, "t 12 2"]], most: float = MAX_OFF
) -> tuple[Float[np.ndarray, "t 12 3"], Float[np.ndarray, "v t 12"]]:
    """Points in the world from one person's keypoints in some views, robustly, and how
    far each keypoint is from them, m at their depth; NaN where fewer than two views
    agree."""
    seen = np.stack(xy).reshape(len(xy), -1, 2)
    count = seen.shape[1]
    R = np.stack([view.R_CW for view in views])
    centre = np.stack([view.centre for view in views])
    keep = np.isfinite(seen).all(axis=-1)
    points, off = np.empty((count, 3)), np.empty(keep.shape)
    for _ in range(2):
        keep &= keep.sum(axis=0) >= 2
        view, point = np.nonzero(keep)
        if not len(view):
            nothing = np.full((*xy[0].shape[:2], 3), np.nan)
            return nothing, np.full((len(xy), *xy[0].shape[:2]), np.nan)
        scale = most / 2 / TYPICAL_DEPTH
        points = triangulate(
            R[view], centre[view], seen[keep], point, count, scale
        )  # fmt: skip
        p_C = np.stack([view.to_camera(points) for view in views])
        away = p_C[..., :2] / p_C[..., 2:] - seen
        off = np.linalg.norm(away, axis=-1) * p_C[..., 2]
        keep &= off < most
    agree = keep.sum(axis=0) >= 2
    points[~agree] = np.nan
    off = np.where(keep & agree, off, np.nan)
    shape = xy[0].shape[:2]
    return points.reshape(*shape, 3), off.reshape(len(xy), *shape)


def refined(views: list[View], xy: list[Float[np.ndarray, "t 12 2"]]) -> list[View]:
    """The views with poses of their cameras after points and poses were estimated in
    turn, robustly, from keypoints of one person; the calibration is the prior.

    As calibrated, keypoints of all joints are off by 1 to 2 cm towards one side of an
    image, which differs from view to view.
    """
    views = list(views)
    prior = np.diag(1 / np.repeat(POSE_SIGMA, 3)) ** 2
    total = np.zeros((len(views), 6))
    for _ in range(REFINEMENTS):
        points, _ = meet(views, xy, 3 * MAX_OFF)
        for k, view in enumerate(views):
            p_C = view.to_camera(points).reshape(-1, 3)
            keep = np.isfinite(p_C).all(axis=1) & np.isfinite(xy[k]).all(-1).ravel()
            p_C, z = p_C[keep], p_C[keep, 2:]
            off = xy[k].reshape(-1, 2)[keep] - p_C[:, :2] / z
            weight = 1 / (1 + np.sum((off * z / NOISE) ** 2, axis=1))
            weight /= FRAMES_ALIKE * (NOISE / z[:, 0]) ** 2
            by_point = np.zeros((len(p_C), 2, 3))
            by_point[:, [0, 1], [0, 1]] = 1 / z
            by_point[:, :, 2] = -p_C[:, :2] / z**2
            cross = np.cross(np.eye(3)[None], p_C[:, None])  # rows: e_i x p
            J = by_point @ np.concatenate(
                [np.swapaxes(cross, 1, 2), np.tile(np.eye(3), (len(p_C), 1, 1))], 2
            )
            normal = np.einsum("nai,n,naj->ij", J, weight, J) + prior
            right = np.einsum("nai,n,na->i", J, weight, off) - prior @ total[k]
            step = np.linalg.solve(normal, right)
            total[k] += step
            R_CW = so3.exp(step[:3]) @ view.R_CW
            centre = view.centre - R_CW.T @ step[3:]
            views[k] = dataclasses.replace(view, R_CW=R_CW, centre=centre)
    return views


def same_people(views: list[View]) -> list[tuple[int, ...]]:
    """Numbers of each person in all views: those whose keypoints meet most often first;
    nobody is in two. Who stays in place is left out."""
    seen = [view.undistorted() for view in views]
    found = []
    for who in itertools.product(*(range(len(xy)) for xy in seen)):
        points, off = meet(views, [xy[h] for xy, h in zip(seen, who)])
        sure = np.isfinite([xy[h, ..., 0] for xy, h in zip(seen, who)]).sum()
        meeting = np.isfinite(off).sum()
        if meeting > MIN_MEETING * sure and walks(points):
            found.append((meeting, who))
    kept: list[tuple[int, ...]] = []
    for _, who in sorted(found, reverse=True):
        if not any(a == b for other in kept for a, b in zip(who, other)):
            kept.append(who)
    return kept


def walks(points: Float[np.ndarray, "t 12 3"]) -> bool:
    """Whether the middle of somebody's hips moves about, where it is known at all."""
    hips = points[:, HIPS].mean(axis=1)
    hips = hips[np.isfinite(hips).all(axis=1)]
    return len(hips) > 0.5 * len(points) and np.sqrt(hips.var(axis=0).sum()) > MOVES


@dataclasses.dataclass(frozen=True)
class Compared:
    """One person in one view: truth and estimate in the frame of its camera, m."""

    view: str
    true: Float[np.ndarray, "t 12 3"]
    """NaN where it is not known."""
    found: Float[np.ndarray, "t 12 3"]
    axes: Float[np.ndarray, "t 12 3 3"]
    """Of the limb that each joint moves with, in the estimate."""
    valid: Bool[np.ndarray, " t"]
    off: Float[np.ndarray, "v t 12"]
    """How far the other views' keypoints are from the truth."""
    result: Result
    person: int


def compare(
    view: View, others: list[View], calibrated: Sequence | None, cache: pipeline.Cache
) -> list[Compared]:
    """The people of a view who are found in the others, too."""
    seen = [other.undistorted() for other in others]
    sequence = view.sequence
    if calibrated is not None:
        sequence = dataclasses.replace(sequence, intrinsics=calibrated.intrinsics)
    result = pipeline.run(sequence, CONFIG, cache=cache)
    R_WC, eye = result.T_WC[:, :3, :3], result.T_WC[:, :3, 3]
    rows = []
    for who in same_people(others):
        own = [xy[h] for xy, h in zip(seen, who)]
        points, off = meet(refined(others, own), own)
        person = nearest(view, points, result)
        if person is None:
            print(f"{view.name}: {who} of the other views is not among the estimated")
            continue
        joints = result.joints[person][:, JOINTS]
        found = np.einsum("tab,tja->tjb", R_WC, joints - eye[:, None])
        turned = limb_axes(result.poses[person])[:, JOINTS]
        axes = np.swapaxes(R_WC, 1, 2)[:, None] @ turned
        true = view.to_camera(points)
        valid = result.present[person] & (
            np.isfinite(true).all(axis=-1).sum(axis=1) >= MIN_JOINTS
        )
        valid &= np.isfinite(true[:, HIPS]).all(axis=(1, 2))
        rows.append(Compared(view.name, true, found, axes, valid, off, result, person))
    return rows


def nearest(
    view: View, points: Float[np.ndarray, "t 12 3"], result: Result
) -> int | None:
    """The estimated person whose joints are where the points are in the image: within a
    fifth of the trunk and legs, in the median."""
    p_C = view.to_camera(points)
    true = p_C[..., :2] / p_C[..., 2:] * np.diag(view.K)[:2] + view.K[:2, 2]
    best, limit = (
        None,
        0.2 * np.nanmedian(np.nanmax(true[..., 1], 1) - np.nanmin(true[..., 1], 1)),
    )
    for person, joints in enumerate(result.joints):
        x = joints[:, JOINTS] - result.T_WC[:, None, :3, 3]
        x = np.einsum("tab,tja->tjb", result.T_WC[:, :3, :3], x)
        uv = x[..., :2] / x[..., 2:] * result.intrinsics[:2] + result.intrinsics[2:4]
        away = np.linalg.norm(uv - true, axis=-1)[result.present[person]]
        middle = np.nanmedian(away) if np.isfinite(away).any() else np.inf
        if middle < limit:
            best, limit = person, middle
    return best


def limb_axes(poses: Float[np.ndarray, "t 72"]) -> Float[np.ndarray, "t 24 3 3"]:
    """Rotation of each joint to the world."""
    G = so3.exp(poses.reshape(len(poses), -1, 3))
    for k in range(1, 24):
        G[:, k] = G[:, PARENTS[k]] @ G[:, k]
    return G


def aligned(
    true: Float[np.ndarray, "t 12 3"], found: Float[np.ndarray, "t 12 3"]
) -> tuple[
    Float[np.ndarray, "t 12 3"], Float[np.ndarray, "t 3 3"], Float[np.ndarray, " t"]
]:
    """The estimate after the best similarity of each frame to the known joints, its
    rotation and its scale."""
    known = np.isfinite(true).all(axis=-1, keepdims=True)
    count = known.sum(axis=1, keepdims=True)
    y_mean = np.where(known, true, 0).sum(axis=1, keepdims=True) / count
    x_mean = np.where(known, found, 0).sum(axis=1, keepdims=True) / count
    y, x = np.where(known, true - y_mean, 0), np.where(known, found - x_mean, 0)
    U, S, Vt = np.linalg.svd(np.swapaxes(y, 1, 2) @ x)
    S[:, 2] *= np.sign(np.linalg.det(U @ Vt))
    U[:, :, 2] *= np.sign(np.linalg.det(U @ Vt))[:, None]
    R, scale = U @ Vt, S.sum(axis=1) / (x**2).sum(axis=(1, 2))
    moved = scale[:, None, None] * ((found - x_mean) @ np.swapaxes(R, 1, 2)) + y_mean
    return moved, R, scale


def offsets(rows: list[Compared]) -> Float[np.ndarray, "12 3"]:
    """Offset of each joint from the estimate's, in the axes of its limb, m: of both
    sides together, medians over the frames of all rows."""
    found = np.zeros((12, 3))
    mirror = np.array([-1.0, 1.0, 1.0])
    for _ in range(3):  # alignment and offsets depend on each other
        local = []
        for row in rows:
            moved = row.found + np.einsum("tjab,jb->tja", row.axes, found)
            placed, R, scale = aligned(row.true[row.valid], moved[row.valid])
            left = row.true[row.valid] - placed
            left = np.einsum("tba,tjb->tja", R, left) / scale[:, None, None]
            local.append(np.einsum("tjba,tjb->tja", row.axes[row.valid], left))
        both = np.concatenate(local)
        both = np.concatenate([both[:, :6], both[:, 6:] * mirror])
        step = np.nanmedian(both, axis=0)
        found = found + np.concatenate([step, step * mirror])
    return found


def figures(row: Compared, shift: Float[np.ndarray, "12 3"]) -> dict[str, float]:
    """Errors of one row, mm, with the joints of the estimate moved by `shift`, m."""
    valid = row.valid
    true = row.true[valid]
    found = (row.found + np.einsum("tjab,jb->tja", row.axes, shift))[valid]
    placed, _, _ = aligned(true, found)
    left = placed - true
    error = np.linalg.norm(left, axis=-1)
    ray = true[:, HIPS].mean(axis=1)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    along = np.einsum("tjc,tc->tj", left, ray)
    across = left - along[..., None] * ray[:, None]
    rms = lambda x: 1e3 * float(np.sqrt(np.nanmean(x**2)))
    length = lambda x: np.array(
        [np.nanmedian(np.linalg.norm(x[:, a] - x[:, b], axis=-1)) for a, b in SEGMENTS]
    )
    size = float(length(found).sum() / length(true).sum())
    about = lambda x: x - x[:, HIPS].mean(axis=1, keepdims=True)
    mean = lambda x, y: (
        1e3 * float(np.nanmean(np.linalg.norm(about(x) - about(y), axis=-1)))
    )
    by_part = error.reshape(len(error), 2, len(PARTS))
    return {
        "pa": 1e3 * float(np.nanmean(error)),
        "mpjpe": mean(found, true),
        "scaled": mean(found / size, true),
        "size": size,
        "along": rms(along),
        "across": rms(across) / np.sqrt(2),
        "lasting": rms(np.nanmean(left, axis=0)),
        "frames": float(valid.sum()),
        **dict(zip(PARTS, 1e3 * np.nanmean(by_part, axis=(0, 1)))),
    }


def noise_of_truth(views: list[View]) -> None:
    """Prints how far keypoints are from where they meet, and how far the points of two
    views are from those of the other two, which share nothing."""
    for who in same_people(views):
        seen = [view.undistorted()[h] for view, h in zip(views, who)]
        _, off = meet(views, seen, 3 * MAX_OFF)
        print("as calibrated, mm median:", round(1e3 * float(np.nanmedian(off))))
        plain, views = views, refined(views, seen)
        _, off = meet(views, seen, 3 * MAX_OFF)
        print("refined, mm median:", round(1e3 * float(np.nanmedian(off))))
        for a, b in zip(plain, views):
            turn = np.degrees(np.linalg.norm(so3.log(b.R_CW @ a.R_CW.T)))
            moved = 1e3 * np.linalg.norm(b.centre - a.centre)
            print(f"{a.name}: turned by {turn:.1f} degrees, moved by {moved:.0f} mm")
        points, off = meet(views, seen)
        rms = 1e3 * np.sqrt(np.nanmean(off**2, axis=(0, 1)).reshape(2, -1).mean(axis=0))
        apart = []
        for a, b in (((0, 1), (2, 3)), ((0, 2), (1, 3)), ((0, 3), (1, 2))):
            pair = [
                meet([views[i] for i in ab], [seen[i] for i in ab])[0] for ab in (a, b)
            ]
            apart.append(np.linalg.norm(pair[0] - pair[1], axis=-1))
        apart = np.stack(apart)
        moved = []
        for k in range(len(views)):
            rest = [i for i in range(len(views)) if i != k]
            three, _ = meet([views[i] for i in rest], [seen[i] for i in rest])
            moved.append(np.linalg.norm(three - points, axis=-1))
        middle = lambda x: (
            1e3 * np.nanmedian(x.reshape(*x.shape[:-1], 2, -1), axis=(0, 1, 2))
        )
        length = [
            np.nanmedian(np.linalg.norm(points[:, a] - points[:, b], axis=-1))
            for a, b in SEGMENTS
        ]
        print(
            f"\nPerson {who} of {[view.name for view in views]}: limbs, m:",
            np.round(length, 3),
        )
        print("used of all keypoints, %:", round(100 * float(np.isfinite(off).mean())))
        table("keypoint from the point, mm rms", rms)
        table("two views from the other two, mm median", middle(apart))
        table("three views from all four, mm median", middle(np.stack(moved)))


def table(name: str, by_part: Float[np.ndarray, " 6"]) -> None:
    print(f"{name}:", ", ".join(f"{p} {x:.0f}" for p, x in zip(PARTS, by_part)))


def draw(row: Compared, view: View, folder: Path) -> None:
    """Pictures of four frames: in the image (truth red, estimate green), and from the
    side and from above after the similarity."""
    folder.mkdir(parents=True, exist_ok=True)
    lines = [*SEGMENTS, (0, 6), (3, 9), (0, 3), (6, 9)]
    there = np.flatnonzero(row.valid)
    frames = there[np.linspace(0, len(there) - 1, 4).astype(int)]
    images = {}
    video = cv2.VideoCapture(str(view.sequence.frames))
    for k in range(len(row.valid)):
        ok, image = video.read()
        if k in frames and ok:
            images[k] = image
    placed = np.full_like(row.found, np.nan)
    placed[row.valid] = aligned(row.true[row.valid], row.found[row.valid])[0]
    panels = []
    for k in frames:
        image = images[k]
        plain = np.array([*np.diag(view.K)[:2], *view.K[:2, 2]])
        for x, camera, colour in (
            (row.true[k], plain, (0, 0, 255)),
            (row.found[k], row.result.intrinsics[:4], (0, 255, 0)),
        ):
            uv = x[:, :2] / x[:, 2:] * camera[:2] + camera[2:]
            _lines(image, uv, lines, colour)
        beside = np.full((image.shape[0], image.shape[0] // 2, 3), 255, np.uint8)
        half = image.shape[0] // 2
        middle = np.nanmean(row.true[k], axis=0)
        for x, colour in ((row.true[k], (0, 0, 255)), (placed[k], (0, 160, 0))):
            p = (x - middle) * half / 2.2
            _lines(beside, np.stack([p[:, 2], p[:, 1]], 1) + half / 2, lines, colour)
            top = np.stack([p[:, 0], -p[:, 2]], 1) + [half / 2, 1.5 * half]
            _lines(beside, top, lines, colour)
        panels.append(np.concatenate([image, beside], axis=1))
    sheet = np.concatenate(panels, axis=1)
    sheet = cv2.resize(sheet, None, fx=0.33, fy=0.33, interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(folder / f"{row.view}-{row.person}.png"), sheet)


def _lines(image, uv, lines, colour) -> None:
    for a, b in lines:
        if np.isfinite(uv[[a, b]]).all():
            start, end = (tuple(int(v) for v in uv[i]) for i in (a, b))
            cv2.line(image, start, end, colour, 4, cv2.LINE_AA)


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--stages", type=Path)
    parser.add_argument("--calibrated", action="store_true")
    parser.add_argument("--views", nargs="*", default=[])
    parser.add_argument("--pictures", type=Path)
    parser.add_argument("--truth", action="store_true", help="the truth's noise alone")
    options = parser.parse_args()
    views = read_views(options.folder, options.stages)
    noise_of_truth(views)
    if options.truth:
        return
    (file,) = (options.folder / "calibration").glob("*.qca.txt")
    rows: list[Compared] = []
    for view in views:
        if options.views and view.name not in options.views:
            continue
        others = [other for other in views if other is not view]
        video = options.folder / "videos" / f"{view.name}.mp4"
        given = io.read_sequence(video, camera=file) if options.calibrated else None
        kind = "calibrated" if options.calibrated else "alone"
        cache = pipeline.Cache(
            options.stages and options.stages / f"{view.name}-{kind}"
        )
        found = compare(view, others, given, cache)
        if options.pictures:
            for row in found:
                draw(row, view, options.pictures)
        rows += found
        report(rows[len(rows) - len(found) :], [np.zeros((12, 3))] * len(found))
    if len(rows) > 1:
        print("\nDefinitions out:")
        shifts = [offsets([r for r in rows if r.view != row.view]) for row in rows]
        report(rows, shifts)
        shift = 1e3 * offsets(rows)[:6]
        for part, value in zip(PARTS, shift):
            print(f"{part}: {np.round(value)} mm outwards, up, forward")


def report(rows: list[Compared], shifts: list[Float[np.ndarray, "12 3"]]) -> None:
    """Prints a line for each row, and their means."""
    if not rows:
        return
    found = [figures(row, shift) for row, shift in zip(rows, shifts)]
    print("| view |", " | ".join([*FIGURES, *PARTS]), "| focal, px | status |")
    cells = lambda row: [
        *(f"{row[n]:.3f}" if n == "size" else f"{row[n]:.0f}" for n in FIGURES),
        *(f"{row[part]:.0f}" for part in PARTS),
    ]
    for row, one in zip(rows, found):
        last = f"| {row.result.intrinsics[0]:.0f} | {row.result.summary['status']} |"
        print(f"| {row.view} |", " | ".join(cells(one)), last, flush=True)
    if len(found) > 1:
        mean = {n: float(np.mean([one[n] for one in found])) for n in found[0]}
        print("| mean |", " | ".join(cells(mean)), "| | |")


if __name__ == "__main__":
    main()
