"""Tracks of real and rendered clips whose camera is known, for `bench_camera_model.py`.

Rendered clips are filmed with a square pinhole camera at a larger image; stretching,
distortion and zoom are applied to the images, which are then compressed and tracked
like any video. Real clips are tracked once; pieces of them are pieces of these tracks.
"""

import dataclasses
from pathlib import Path

import cv2
import numpy as np

from bodyslam_jax import io, sfm, simulation
from bodyslam_jax.config import Simulation
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.pipeline.stage_cache import load, save
from bodyslam_jax.simulation.camera_paths import smooth_noise
from bodyslam_jax.simulation.exact_scene import look_at
from bodyslam_jax.types import Keypoints, Sequence, Tracks

SIZE = (640, 360)
MARGIN = 1.2
"""Size of a rendered image over that of the clip where the lens is a barrel, which
shows more than a plain one."""


@dataclasses.dataclass(frozen=True)
class Film:
    """A rendered clip: what is filmed, and the camera that is simulated."""

    motion: str
    """`follow` or `room` with its level, or a path of `paths`."""
    seed: int
    aspect: float = 1.0
    """fx / fy"""
    k1: float = 0.0
    zoom: float = 1.0
    """Focal length of the last frame over that of the first."""
    frames: int = 75
    focal: float = 560.0
    """Of an image of `SIZE`, px."""
    readout: float = 0.0
    """s"""

    @property
    def name(self) -> str:
        lens = f"a{self.aspect:.2f}-k{self.k1:+.2f}-z{self.zoom:.2f}"
        readout = "-rolling" if self.readout else ""
        return f"{self.motion}-{self.seed}-{self.frames}-{lens}{readout}"


_PLAIN = (
    ("beside", 1, 70),
    ("beside", 2, 70),
    ("beside", 3, 90),
    ("ahead", 4, 70),
    ("ahead", 5, 80),
    ("arc", 6, 70),
    ("arc", 7, 90),
    ("rise", 8, 70),
    ("follow-E", 9, 75),
    ("follow-M", 10, 75),
    ("follow-D", 11, 75),
    ("room-E", 12, 90),
    ("room-M", 13, 90),
    ("room-D", 14, 90),
)
FILMS: tuple[Film, ...] = (
    *(Film(m, s, frames=n, focal=480 + 37 * (s % 6)) for m, s, n in _PLAIN),
    Film("beside", 15, readout=0.015),
    Film("follow-M", 16, readout=0.015),
    # Pixels that are not square
    Film("beside", 20, aspect=4 / 3),
    Film("arc", 21, aspect=0.75),
    Film("follow-E", 22, aspect=4 / 3, frames=90),
    Film("follow-D", 23, aspect=0.75, frames=90),
    Film("room-M", 24, aspect=4 / 3, frames=90),
    Film("rise", 25, aspect=0.75),
    Film("ahead", 26, aspect=4 / 3, frames=90),
    Film("beside", 27, aspect=1.09),
    # Lenses
    Film("beside", 30, k1=-0.2),
    Film("arc", 31, k1=-0.25),
    Film("follow-E", 32, k1=-0.2, frames=90),
    Film("follow-D", 33, k1=-0.3, frames=90),
    Film("room-D", 34, k1=-0.25, frames=90),
    Film("ahead", 35, k1=-0.25, frames=90),
    Film("rise", 36, k1=0.2),
    Film("arc", 37, k1=-0.07),
    # Zooms
    Film("beside", 40, zoom=1.5, focal=480),
    Film("arc", 41, zoom=1.4, focal=480),
    Film("follow-E", 42, zoom=1.6, frames=90),
    Film("follow-D", 43, zoom=1.4, frames=90),
    Film("room-M", 44, zoom=1.5, frames=90),
    Film("ahead", 45, zoom=1.5, frames=90, focal=480),
    Film("rise", 46, zoom=1.4, focal=480),
    Film("beside", 47, zoom=1.1),
)


def rendered(film: Film, folder: Path) -> Sequence:
    """The clip's tracks and keypoints with the guessed camera, made if they are not in
    `folder`."""
    file = folder / f"{film.name}.npz"
    if file.exists():
        return load(file, Sequence)
    video = folder / f"{film.name}.mp4"
    keypoints = _write(film, video)
    sequence = io.read_sequence(video)
    sequence = dataclasses.replace(sequence, keypoints=keypoints)
    sequence = dataclasses.replace(sequence, tracks=sfm.track(sequence))
    save(file, sequence)
    video.unlink()
    return sequence


def real(folder: Path, keep: Path) -> Sequence:
    """Tracks and keypoints of a real clip, made if they are not in `keep`."""
    file = keep / f"real-{folder.name}.npz"
    if file.exists():
        return load(file, Sequence)
    sequence = io.read_sequence(folder)
    sequence = dataclasses.replace(sequence, tracks=sfm.track(sequence))
    save(file, sequence)
    return sequence


def piece(sequence: Sequence, first: int, last: int) -> Sequence:
    """Frames `first` to `last - 1` of a clip with tracks."""
    tracks = sequence.tracks
    assert tracks is not None
    use = (tracks.frame >= first) & (tracks.frame < last)
    use &= np.bincount(tracks.landmark[use], minlength=tracks.landmark.max() + 1)[
        tracks.landmark
    ] >= min(3, last - first)
    landmark = np.unique(tracks.landmark[use], return_inverse=True)[1]
    keypoints = sequence.keypoints
    if keypoints is not None:
        now = slice(first, last)
        keypoints = Keypoints(keypoints.uv[:, now], keypoints.confidence[:, now])
    return dataclasses.replace(
        sequence,
        name=f"{sequence.name} {first}-{last}",
        timestamps=sequence.timestamps[first:last],
        tracks=Tracks(tracks.frame[use] - first, landmark, tracks.uv[use]),
        keypoints=keypoints,
        bodies=None,
        detected=None,
    )


def warped(
    sequence: Sequence, *, aspect: float = 1.0, k1: float = 0.0, zoom: float = 1.0
) -> Sequence:
    """A clip's points as a stretched, distorted or zooming camera would have them.

    The errors of the tracks are those of the clip.
    """
    tracks, guess = sequence.tracks, sequence.intrinsics
    assert tracks is not None
    last = max(sequence.num_frames - 1, 1)

    def warp(uv: np.ndarray, frame: np.ndarray) -> np.ndarray:
        return _through_lens(
            uv, frame / last, guess.params[2:4], guess.params[0], aspect, k1, zoom
        )

    uv = warp(tracks.uv, tracks.frame)
    keypoints = sequence.keypoints
    if keypoints is not None:
        frame = np.broadcast_to(
            np.arange(sequence.num_frames)[:, None], keypoints.uv.shape[1:3]
        )
        seen = np.stack([warp(one, frame) for one in keypoints.uv])
        seen[keypoints.confidence == 0] = 0.0
        keypoints = dataclasses.replace(keypoints, uv=seen)
    lens = f"a{aspect:.2f}-k{k1:+.2f}-z{zoom:.2f}"
    return dataclasses.replace(
        sequence,
        name=f"{sequence.name} {lens}",
        tracks=Tracks(tracks.frame, tracks.landmark, uv),
        keypoints=keypoints,
    )


def _through_lens(uv, share, centre, focal, aspect, k1, zoom) -> np.ndarray:
    """Pixels of a plain image (focal length `focal`) as the lens shows them; `share` of
    the zoom's way, 0 to 1."""
    q = (uv - centre) / focal
    radial = 1 + k1 * (q**2).sum(axis=-1, keepdims=True)
    size = zoom ** np.asarray(share, float)[..., None]
    return centre + focal * q * radial * size * _stretch(aspect)


def _stretch(aspect: float) -> np.ndarray:
    """Factors of x and y, none below 1, so that the image stays filled."""
    return np.array([aspect, 1.0]) / min(aspect, 1.0)


def _write(film: Film, path: Path) -> Keypoints:
    """Films the clip, and the keypoints of the walker with 2 px of noise."""
    scene = _scene(film)
    width, height = (round((MARGIN if film.k1 < 0 else 1) * s) for s in SIZE)
    focal = film.focal
    params = np.array([focal, focal, (width - 1) / 2, (height - 1) / 2])
    scene = dataclasses.replace(scene, intrinsics=params, size=(width, height))
    out = np.array(SIZE)
    centre = (out - 1) / 2
    grid = np.stack(np.meshgrid(*map(np.arange, SIZE)), axis=-1).astype(float)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 30.0, SIZE)
    last = scene.num_frames - 1
    for k, image in enumerate(simulation.render(scene)):
        size = film.zoom ** (k / last)
        q = (grid - centre) / focal / size / _stretch(film.aspect)
        q = _undistorted(q, film.k1)
        at = (q * focal + params[2:4]).astype(np.float32)
        writer.write(cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_CUBIC))
    writer.release()
    walker = scene.actors[0]
    G, joints = walker.person.joints(walker.walk.poses, walker.walk.pelvis)
    points = walker.person.keypoints(G, joints, 1.0)
    R, c = scene.T_WC[:, :3, :3], scene.T_WC[:, :3, 3]
    p_C = np.einsum("tba,tjb->tja", R, points - c[:, None])
    rng = np.random.default_rng([film.seed, 9])
    share = np.broadcast_to(np.arange(last + 1)[:, None] / last, p_C.shape[:2])
    uv = centre + focal * p_C[..., :2] / np.maximum(p_C[..., 2:], 0.2)
    uv = _through_lens(uv, share, centre, focal, film.aspect, film.k1, film.zoom)
    uv += 2.0 * rng.standard_normal(uv.shape)
    inside = ((uv > 0) & (uv < out - 1)).all(axis=-1) & (p_C[..., 2] > 0.3)
    uv[~inside] = 0.0
    return Keypoints(uv[None], inside[None].astype(float))


def _undistorted(q: np.ndarray, k1: float) -> np.ndarray:
    """Inverts `q (1 + k1 |q|²)` by fixed-point iteration."""
    x = q
    for _ in range(30 if k1 else 0):
        x = q / (1 + k1 * (x**2).sum(axis=-1, keepdims=True))
    return x


def _scene(film: Film) -> simulation.SimulatedSequence:
    """The walker and the room, seen by the film's camera."""
    family, _, level = film.motion.partition("-")
    own = family in ("follow", "room")
    settings = Simulation(
        sequence=f"{level or 'E'}1",  # pyright: ignore[reportArgumentType]
        family=family if family == "room" else "follow",
        length=film.frames,
        seed=film.seed,
        readout=film.readout,
        exposure=0.004,
    )
    scene = simulation.simulate(settings)
    if own:
        return scene
    return dataclasses.replace(scene, T_WC=_path(film, scene))


def _path(film: Film, scene: simulation.SimulatedSequence) -> np.ndarray:
    """A hand-held camera that moves by 1 to 3 m: beside the walker, ahead, along an arc
    about them, or upwards."""
    rng = np.random.default_rng([film.seed, 7])
    t = film.frames
    s = np.linspace(0, 1, t)[:, None]
    walker = scene.walk.pelvis.mean(axis=0)
    eye = scene.T_WC[:, :3, 3]
    start, ahead = eye[0], walker - eye[0]
    ahead = ahead * [1, 0, 1] / np.linalg.norm(ahead[[0, 2]])
    side = np.cross([0.0, 1.0, 0.0], ahead)
    far = rng.uniform(1.0, 2.2)
    if film.motion == "beside":
        # As the follower goes, at most `far` m.
        way = eye - eye[0]
        eye = start + way * min(1.0, far / max(np.linalg.norm(way[-1]), 1e-9))
    elif film.motion == "ahead":
        eye = start + far * s * ahead
    elif film.motion == "arc":
        angle = rng.choice([-1, 1]) * far / 4.0 * s[:, 0]
        c, n = np.cos(angle), np.sin(angle)
        out = start - walker
        turned = np.stack(
            [c * out[0] + n * out[2], 0 * c + out[1], c * out[2] - n * out[0]], axis=1
        )
        eye = walker + turned
    else:
        eye = start + s * (np.array([0.0, -0.7, 0.0]) + 0.5 * far * side)
    eye = eye + 0.02 * smooth_noise(rng, t, 0.5, 3)
    target = scene.walk.pelvis + 0.1 * smooth_noise(rng, t, 0.8, 3)
    T_WC = look_at(eye, 0.7 * target + 0.3 * walker)
    tremble = 0.005 * smooth_noise(rng, t, 0.1, 3)
    T_WC[:, :3, :3] = T_WC[:, :3, :3] @ so3.exp(tremble)
    return T_WC
