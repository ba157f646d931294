"""Simulates noise of detectors, regressors and trackers correlated over time, and
tracks of static points.

Magnitudes follow published errors. HMR-class networks have errors of about 60 mm after
Procrustes alignment and of 18 to 20 m/s² in acceleration, so that most of their error
varies slowly; errors of keypoints are a share of the disagreement of annotators (COCO's
σ), and also vary slowly. With white noise, smoothing would look far too effective.
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int

from bodyslam_jax.body import KEYPOINT_SPREAD
from bodyslam_jax.body.skeleton import (
    ANKLES,
    BODY25,
    FEET,
    HANDS,
    HEAD,
    HIPS,
    KNEES,
    NECK,
    PELVIS,
    WRISTS,
)
from bodyslam_jax.config import Simulation
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.simulation.posing import Person
from bodyslam_jax.simulation.room import Room, landmarks_on
from bodyslam_jax.types import Tracks

_LIMB_CAPSULES = (
    *((0, 12, 0.19), (12, 15, 0.14), (15, 15, 0.17)),
    *((1, 4, 0.13), (4, 7, 0.10), (7, 10, 0.11), (2, 5, 0.13), (5, 8, 0.10)),
    *((8, 11, 0.11), (10, 10, 0.12), (11, 11, 0.12), (16, 18, 0.09), (18, 20, 0.08)),
    *((20, 22, 0.09), (22, 22, 0.13), (17, 19, 0.09), (19, 21, 0.08), (21, 23, 0.09)),
    *((23, 23, 0.13), (16, 17, 0.12), (1, 2, 0.17)),
)
"""Capsules that cover the body: two joints and a radius, m."""
_POINTS_PER_M2 = 9.0
"""Points per m² of all surfaces."""
_ARM = ("shoulder", "elbow", "wrist")
_LEG = ("hip", "knee", "ankle", "big_toe", "small_toe", "heel")
"""Keypoints that a detector exchanges together."""
_TRUNK_RADIUS_M, _THIGH_RADIUS_M, _HEAD_RADIUS_M = 0.13, 0.07, 0.10
"""Half widths of an adult's trunk, thigh and head, m."""
_GRID_CELLS = (8, 6)
_MAX_CANDIDATES = 700
"""Number of candidate points per image that are tested for visibility at most, to bound
the run time."""
_NUM_TRACKS = 200
"""Number of tracks per frame that are aimed at."""
_BORDER_PX = 3.0
"""Distance from the image's edge at which tracks end, px."""
_HANDS_FEET = np.isin(np.arange(24), (*ANKLES, *FEET, *WRISTS, *HANDS))


@dataclasses.dataclass(frozen=True)
class Noise:
    """Magnitudes of measurement errors; rates are shares of all frames."""

    keypoint_share: float
    """Standard deviation of keypoints relative to the disagreement of annotators."""
    keypoint_correlation: float
    """AR(1) coefficient of the slow part of keypoint noise, per frame."""
    outlier_rate: float
    """Share of keypoints that are outliers."""
    swap_rate: float
    """Share of frames in which left and right are exchanged."""
    gap_rate: float
    """Share of frames in which the person is not detected."""
    posture_bias: float
    """Constant error of joint rotations, rad per axis."""
    posture_drift: float
    """Slowly varying error of joint rotations, rad per axis."""
    posture_correlation: float
    posture_white: float
    """White error of joint rotations, rad per axis; small compared with the slow
    one."""
    root_drift: float
    """Slowly varying error of the orientation, rad per axis."""
    root_white: float
    shape_shrink: tuple[float, float]
    """Range of the factor on the true β."""
    shape_white: float
    """Standard deviation added to each β, constant in time."""
    depth: tuple[float, float]
    """Range of the standard deviation of the relative depth error, 70 % of which
    (variance) is constant in time."""
    depth_white: float
    """White part of the relative depth error."""
    offset: float
    """Error of the pelvis in the image, px."""
    track: tuple[float, float]
    """Range of the standard deviation of a track's pixels, px."""
    track_outliers: float
    """Share of observations of tracks that are outliers."""


NOISE = {
    "none": Noise(
        *(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, (1.0, 1.0), 0.0),
        *((0.0, 0.0), 0.0, 0.0, (0.0, 0.0), 0.0),
    ),
    "low": Noise(
        *(0.12, 0.9, 0.005, 0.002, 0.0, 0.02, 0.03, 0.98, 0.001, 0.03, 0.001),
        *((0.8, 0.9), 0.15, (0.02, 0.03), 0.002, 1.5, (0.2, 0.4), 0.01),
    ),
    "real": Noise(
        *(0.35, 0.92, 0.025, 0.01, 0.01, 0.07, 0.078, 0.98, 0.002, 0.075, 0.002),
        *((0.5, 0.8), 0.3, (0.05, 0.10), 0.006, 4.0, (0.5, 1.0), 0.03),
    ),
}
"""`real` follows published systems, `low` is about a third of it."""


def noise_of_keypoints(settings: Simulation) -> Noise:
    """Returns the noise of keypoints under these settings."""
    noise = NOISE[settings.keypoint_noise or settings.noise]
    share = settings.keypoint_errors * noise.keypoint_share
    rates = {"outlier_rate": settings.outliers, "swap_rate": settings.exchanged}
    given = {name: rate for name, rate in rates.items() if rate is not None}
    return dataclasses.replace(noise, keypoint_share=share, **given)


def noise_of_bodies(settings: Simulation) -> Noise:
    """Returns the noise of regressed bodies under these settings.

    Second differences of AR(1) noise of unit variance have variance (1 - ρ)(6 - 2ρ),
    those of white noise 6: less jitter means a larger ρ, more means added white noise.
    """
    noise = NOISE[settings.body_noise or settings.noise]
    lasting, jitter = settings.body_errors, settings.body_jitter
    rho = noise.posture_correlation
    added = np.sqrt(max(jitter**2 - 1, 0.0) * (1 - rho) * (6 - 2 * rho) / 6)
    white = lambda own, drift: float(np.hypot(own, added * drift))
    return dataclasses.replace(
        noise,
        posture_bias=lasting * noise.posture_bias,
        posture_drift=lasting * noise.posture_drift,
        root_drift=lasting * noise.root_drift,
        posture_correlation=1 - min(jitter, 1.0) ** 2 * (1 - rho),
        posture_white=white(noise.posture_white, noise.posture_drift),
        root_white=white(noise.root_white, noise.root_drift),
        depth_white=max(jitter, 1.0) * noise.depth_white,
    )


def ar1(
    rng: np.random.Generator, shape: tuple[int, ...], correlation: float
) -> Float[np.ndarray, "t ..."]:
    """Returns stationary first-order autoregressive noise along the first axis, with
    standard deviation 1."""
    x = rng.standard_normal(shape)
    x[1:] *= np.sqrt(1 - correlation**2)
    # A loop, because importing `scipy.signal` would delay every command.
    for k in range(1, len(x)):
        x[k] += correlation * x[k - 1]
    return x


def project(
    p_C: Float[np.ndarray, "*b 3"], intrinsics: Float[np.ndarray, "4"]
) -> Float[np.ndarray, "*b 2"]:
    """Projects points by a pinhole camera, px; points behind the camera project far
    away."""
    z = np.maximum(p_C[..., 2:], 1e-3)
    return p_C[..., :2] / z * intrinsics[:2] + intrinsics[2:]


def detect_keypoints(
    p_C: Float[np.ndarray, "t 25 3"],
    joints_C: Float[np.ndarray, "t 24 3"],
    intrinsics: Float[np.ndarray, "4"],
    size: tuple[int, int],
    noise: Noise,
    rng: np.random.Generator,
    hidden_by_others: Bool[np.ndarray, "t 25"] | None = None,
) -> tuple[Float[np.ndarray, "t 25 2"], Float[np.ndarray, "t 25"]]:
    """Returns measured pixels and confidences of BODY_25 keypoints at `p_C` (m, camera
    frame).

    Confidence decreases with the expected error: occluded joints and temporary
    disturbances have larger errors and lower confidence. Missing keypoints are 0 0 0,
    as are those hidden by furniture or another person.
    """
    t = len(p_C)
    exact = project(p_C, intrinsics)
    extent = np.ptp(exact[:, :15], axis=1)
    scale = np.sqrt(extent.prod(axis=1).clip(100.0))[:, None]
    sigma = noise.keypoint_share * np.array(KEYPOINT_SPREAD["body25"]) * scale
    hidden = _self_occlusion(p_C, joints_C, intrinsics)
    # A slowly varying factor on the error, which is correlated with confidence.
    trouble = np.exp(0.4 * ar1(rng, (t, 25), 0.95)) * (1 + 0.9 * hidden)
    slow = ar1(rng, (t, 25, 2), noise.keypoint_correlation)
    white = rng.standard_normal((t, 25, 2))
    error = np.sqrt(0.75) * slow + np.sqrt(0.25) * white
    uv = exact + (sigma * trouble)[:, :, None] * error
    known = trouble * np.exp(0.25 * rng.standard_normal((t, 25)))
    if noise.keypoint_share == 0:
        known = np.ones((t, 25))
    confidence = np.clip(0.95 - 0.17 * known, 0.06, 0.97)

    wrong = _episodes(rng, (t, 25), noise.outlier_rate, 5.0)
    away = np.repeat(rng.normal(0, 0.35, (t // 8 + 1, 25, 2)), 8, axis=0)[:t]
    uv = np.where(wrong[:, :, None], uv + away * scale[:, :, None], uv)
    confidence = np.where(
        wrong, confidence * rng.uniform(0.25, 0.9, (t, 25)), confidence
    )
    swapped = _episodes(rng, (t, 2), noise.swap_rate / 2, 4.0)
    for half, parts in enumerate((_ARM, _LEG)):
        at = np.flatnonzero(swapped[:, half])[:, None]
        for part in parts:
            i, j = BODY25[f"right_{part}"], BODY25[f"left_{part}"]
            uv[at, [i, j]] = uv[at, [j, i]]
            confidence[at, [i, j]] = confidence[at, [j, i]]
    lost = _episodes(rng, (t, 1), noise.gap_rate, 6.0)
    lost = lost | (rng.random((t, 25)) < 0.25 * noise.outlier_rate * trouble)
    outside = ((uv < 0) | (uv > np.array(size) - 1)).any(axis=2) | (p_C[..., 2] < 0.1)
    gone = lost | outside
    if hidden_by_others is not None:
        gone |= hidden_by_others
    return np.where(gone[:, :, None], 0.0, uv), np.where(gone, 0.0, confidence)


def _self_occlusion(p_C, joints_C, intrinsics) -> Bool[np.ndarray, "t 25"]:
    """Returns whether trunk, thigh or head is in front of a keypoint."""
    thighs = ((hip, knee, _THIGH_RADIUS_M) for hip, knee in zip(HIPS, KNEES))
    bones = (
        (PELVIS, NECK, _TRUNK_RADIUS_M),
        *thighs,
        (NECK, HEAD, _HEAD_RADIUS_M),
    )
    uv, at = project(p_C, intrinsics), project(joints_C, intrinsics)
    hidden = np.zeros(p_C.shape[:2], bool)
    for a, b, radius in bones:
        way = at[:, b] - at[:, a]
        share = ((uv - at[:, a, None]) * way[:, None]).sum(-1)
        share = np.clip(share / np.maximum((way**2).sum(-1), 1.0)[:, None], 0, 1)
        nearest = at[:, a, None] + share[..., None] * way[:, None]
        depth = joints_C[:, a, None, 2] * (1 - share) + joints_C[:, b, None, 2] * share
        reach = radius * intrinsics[0] / np.maximum(depth, 0.1)
        close = np.linalg.norm(uv - nearest, axis=-1) < reach
        hidden |= close & (p_C[..., 2] > depth + 0.10)
    return hidden


def _episodes(rng, shape, rate: float, length: float) -> Bool[np.ndarray, "t n"]:
    """Returns runs of about `length` frames that together fill a share `rate` of all
    frames."""
    state = rng.random(shape[1:]) < rate
    out = np.empty(shape, bool)
    start = rate / max((1 - rate) * length, 1e-9)
    for k, draw in enumerate(rng.random(shape)):
        state = np.where(state, draw > 1 / length, draw < start)
        out[k] = state
    return out


@dataclasses.dataclass(frozen=True)
class Regressed:
    """Bodies as a network regresses them, for some of the frames."""

    frame: Int[np.ndarray, " m"]
    poses: Float[np.ndarray, "m 72"]
    """Axis-angle, rad; the root turns the body into the camera frame."""
    shapes: Float[np.ndarray, "m 10"]
    trans: Float[np.ndarray, "m 3"]
    """Translation, m, camera frame: the pelvis is at `J_0(β) + trans`."""
    box: Float[np.ndarray, "m 3"]
    """Crop that the network used: centre and side, px."""
    camera: Float[np.ndarray, "m 3"]
    """Weak perspective camera `s tx ty` in that crop that is equivalent to `trans`."""
    poses_crop: Float[np.ndarray, "m 72"]
    """`poses` with the root relative to the crop's ray."""


def regress_bodies(
    person: Person,
    poses_C: Float[np.ndarray, "t 24 3"],
    pelvis_C: Float[np.ndarray, "t 3"],
    keypoints: tuple[Float[np.ndarray, "t 25 2"], Float[np.ndarray, "t 25"]],
    intrinsics: Float[np.ndarray, "4"],
    noise: Noise,
    rng: np.random.Generator,
) -> Regressed:
    """Returns bodies as regressed for a `person` with these true poses in the camera
    frame.

    Crops are around `keypoints`; frames without enough of them are left out.
    """
    t = len(poses_C)
    level = np.where(_HANDS_FEET, 1.5, 1.0)[:, None]
    level = level * np.where(np.arange(24) == 0, 0.0, 1.0)[:, None]
    error = noise.posture_bias * rng.standard_normal((24, 3))
    error = error + noise.posture_drift * ar1(
        rng, (t, 24, 3), noise.posture_correlation
    )
    error = level * (error + noise.posture_white * rng.standard_normal((t, 24, 3)))
    slow = ar1(rng, (t, 3), noise.posture_correlation)
    error[:, 0] = noise.root_drift * slow
    error[:, 0] += noise.root_white * rng.standard_normal((t, 3))
    poses = so3.compose(poses_C.reshape(t, 24, 3), error).reshape(t, 72)

    shape = person.shape * rng.uniform(*noise.shape_shrink)
    shape = shape + noise.shape_white * rng.standard_normal(10)
    flicker = 0.1 * noise.shape_white * ar1(rng, (t, 10), 0.9)
    shapes = shape + flicker
    visible = person.rest_joints(shape)
    # Size and depth are ambiguous: a taller estimate is proportionally farther.
    taller = np.ptp(visible[:, 1]) / np.ptp(person.rest[:, 1])
    sigma = rng.uniform(*noise.depth)
    depth = 1 + sigma * np.sqrt(0.7) * np.clip(rng.standard_normal(), -1.5, 1.5)
    depth = depth + sigma * np.sqrt(0.3) * ar1(rng, (t, 1), noise.posture_correlation)
    depth = taller * depth + noise.depth_white * rng.standard_normal((t, 1))
    uv = project(pelvis_C, intrinsics) + noise.offset * ar1(rng, (t, 2), 0.8)
    ray = np.concatenate(
        [(uv - intrinsics[2:]) / intrinsics[:2], np.ones((t, 1))], axis=1
    )
    pelvis = ray * pelvis_C[:, 2:] * depth
    trans = pelvis - person.rest_joints(shapes)[:, 0]

    box, found = crop_boxes(*keypoints)
    found &= pelvis[:, 2] > 0.3
    fx, _, px, py = intrinsics
    x, y, z = trans.T
    camera = np.stack(
        [
            2 * fx / (box[:, 2] * z),
            x - z / fx * (box[:, 0] - px),
            y - z / fx * (box[:, 1] - py),
        ],
        axis=1,
    )
    poses_crop = poses.copy()
    to_crop = so3.optical_axis_to_ray((box[:, :2] - intrinsics[2:]) / intrinsics[:2])
    poses_crop[:, :3] = so3.between(to_crop, poses[:, :3])
    frame = np.flatnonzero(found)
    return Regressed(
        frame,
        *(x[frame] for x in (poses, shapes, trans, box, camera, poses_crop)),
    )


def crop_boxes(
    uv: Float[np.ndarray, "t 25 2"], confidence: Float[np.ndarray, "t 25"]
) -> tuple[Float[np.ndarray, "t 3"], Bool[np.ndarray, " t"]]:
    """Returns square crops around people, as SPIN makes them.

    **Returns:** in each frame the crop's centre (u, v; mean of the keypoints of
    confidence above 0.2) and side (1.2 times their larger extent), px; and whether
    there are at least six such keypoints.
    """
    sure = confidence > 0.2
    found = sure.sum(axis=1) >= 6
    masked = np.where(sure[:, :, None], uv, np.nan)
    masked[~found] = 0.0
    side = 1.2 * (np.nanmax(masked, axis=1) - np.nanmin(masked, axis=1)).max(axis=1)
    centre = np.nanmean(masked, axis=1)
    return np.concatenate([centre, np.maximum(side, 10.0)[:, None]], axis=1), found


def track_points(
    room: Room,
    T_WC: Float[np.ndarray, "t 4 4"],
    joints_C: Float[np.ndarray, "h t 24 3"],
    intrinsics: Float[np.ndarray, "4"],
    size: tuple[int, int],
    noise: Noise,
    rng: np.random.Generator,
    *,
    life: float,
) -> tuple[Tracks, Float[np.ndarray, "l 3"]]:
    """Returns about `_NUM_TRACKS` tracks per frame, spread over the image, and their
    true points (m).

    A track ends when its point leaves the image or is occluded by furniture or a
    person, and at random after `life` frames on average; a point observed again starts
    a new track. Tracks of a single frame are dropped.
    """
    points, normals = landmarks_on(room.faces(), _POINTS_PER_M2, rng)
    strength = rng.random(len(points))
    frames, ids, pixels, places = [], [], [], []
    alive = np.empty((0, 2), int)  # track, point
    count = 0
    for k, T in enumerate(T_WC):
        eye = T[:3, 3]
        p_C = (points - eye) @ T[:3, :3]
        uv = project(p_C, intrinsics)
        low, high = _BORDER_PX, np.array(size) - 1 - _BORDER_PX
        visible = (p_C[:, 2] > 0.3) & ((uv > low) & (uv < high)).all(axis=1)
        visible &= ((eye - points) * normals).sum(axis=1) > 0.12 * p_C[:, 2]
        some = np.flatnonzero(visible)
        if len(some) > _MAX_CANDIDATES:
            some = np.union1d(
                rng.choice(some, _MAX_CANDIDATES, replace=False),
                alive[visible[alive[:, 1]], 1],
            )
        some = some[~room.is_hidden(eye, points[some])]
        for body in joints_C[:, k]:
            some = some[~_behind_person(uv[some], p_C[some, 2], body, intrinsics)]
        visible[:] = False
        visible[some] = True
        alive = alive[visible[alive[:, 1]] & (rng.random(len(alive)) > 1 / life)]
        if len(alive) < _NUM_TRACKS:
            fresh = _spread(
                uv, some[~np.isin(some, alive[:, 1])], strength, alive[:, 1], size,
                _NUM_TRACKS - len(alive),
            )  # fmt: skip
            new = np.stack([count + np.arange(len(fresh)), fresh], axis=1)
            alive = np.concatenate([alive, new])
            places.append(points[fresh])
            count += len(fresh)
        frames.append(np.full(len(alive), k))
        ids.append(alive[:, 0])
        pixels.append(uv[alive[:, 1]])
    frame, track, uv = map(np.concatenate, (frames, ids, pixels))
    uv = _disturb(frame, track, uv, size, noise, rng)
    lasting = np.bincount(track, minlength=count)[track] > 1
    kept, landmark = np.unique(track[lasting], return_inverse=True)
    tracks = Tracks(frame[lasting], landmark, uv[lasting])
    return tracks, np.concatenate(places)[kept]


def _spread(uv, candidates, strength, taken, size, wanted):
    """Returns the strongest points of the emptiest cells of a grid."""
    cell_of = lambda at: (at * _GRID_CELLS / size).astype(int) @ [1, _GRID_CELLS[0]]
    filled = np.bincount(cell_of(uv[taken]), minlength=_GRID_CELLS[0] * _GRID_CELLS[1])
    order = candidates[np.argsort(-strength[candidates])]
    cell = cell_of(uv[order])
    # Number of points that the cell would hold before this one is added.
    by_cell = np.argsort(cell, kind="stable")
    first = np.searchsorted(cell[by_cell], cell[by_cell])
    rank = np.empty(len(order), int)
    rank[by_cell] = np.arange(len(order)) - first
    return order[np.argsort(filled[cell] + rank, kind="stable")[:wanted]]


def is_behind(
    points_C: Float[np.ndarray, "t n 3"],
    joints_C: Float[np.ndarray, "t 24 3"],
    intrinsics: Float[np.ndarray, "4"],
) -> Bool[np.ndarray, "t n"]:
    """Returns whether a person with these joints hides points, all in the camera frame,
    m."""
    uv = project(points_C, intrinsics)
    return np.stack(
        [
            _behind_person(uv[k], points_C[k, :, 2], joints_C[k], intrinsics)
            for k in range(len(points_C))
        ]
    )


def _behind_person(uv, depth, joints_C, intrinsics) -> Bool[np.ndarray, " n"]:
    """Returns whether the body hides points that lie behind it."""
    hidden = np.zeros(len(uv), bool)
    if (joints_C[:, 2] < 0.2).any():
        return hidden
    at = project(joints_C, intrinsics)
    for a, b, radius in _LIMB_CAPSULES:
        way = at[b] - at[a]
        share = np.clip((uv - at[a]) @ way / max(way @ way, 1.0), 0, 1)
        z = joints_C[a, 2] * (1 - share) + joints_C[b, 2] * share
        away = np.linalg.norm(uv - at[a] - share[:, None] * way, axis=1)
        hidden |= (away < radius * intrinsics[0] / z) & (depth > z)
    return hidden


def _disturb(frame, track, uv, size, noise: Noise, rng):
    """Adds white noise with a standard deviation per track, and outliers.

    Half of the outliers are single wrong matches, half are tracks that drift with a
    moving object.
    """
    count = int(track.max()) + 1
    sigma = rng.uniform(*noise.track, count)
    uv = uv + sigma[track, None] * rng.standard_normal(uv.shape)
    single = rng.random(len(uv)) < noise.track_outliers / 2
    uv[single] += rng.laplace(0, 15.0, (int(single.sum()), 2))
    length = np.bincount(track, minlength=count)
    start = np.full(count, frame.max() + 1)
    np.minimum.at(start, track, frame)
    # A drifting track is wrong for half of its duration on average.
    stuck = rng.random(count) < noise.track_outliers
    onset = start + (rng.random(count) * length).astype(int)
    drift = rng.normal(0, 2.0, (count, 2))
    since = np.where(stuck[track], np.maximum(frame - onset[track] + 1, 0), 0)
    uv = uv + since[:, None] * drift[track]
    return np.clip(uv, 0, np.array(size) - 1.0)
