"""Generates small exact scenes as plain arrays, for tests and benchmarks of the graph.

No files or images are involved: a hand-held camera moves beside a walking body and
observes static landmarks. World: y up, floor at y = 0, metres.
"""

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from bodyslam_jax.geometry import so3_numpy as so3


@dataclasses.dataclass(frozen=True)
class Scene:
    """`t` cameras, `l` landmarks with `m` observations, and one walking person."""

    intrinsics: Float[np.ndarray, "4"]
    """`fx fy cx cy`, px."""
    size: tuple[int, int]
    """Image width and height, px."""
    timestamps: Float[np.ndarray, " t"]
    """Times of the frames, s."""
    T_WC: Float[np.ndarray, "t 4 4"]
    """Camera to world, m."""
    landmarks: Float[np.ndarray, "l 3"]
    """Positions of the landmarks, m, world frame."""
    frame: Int[np.ndarray, " m"]
    landmark: Int[np.ndarray, " m"]
    uv: Float[np.ndarray, "m 2"]
    """Observations, px, sorted by frame; exact unless noise was requested."""
    T_WH: Float[np.ndarray, "t 4 4"]
    """Body root to world; the translation is the pelvis joint, m."""
    body_pose: Float[np.ndarray, "t 23 3"]
    """Axis-angle of the joints without the root, rad."""
    shape: Float[np.ndarray, "10"]
    """SMPL β."""

    @property
    def T_CH(self) -> Float[np.ndarray, "t 4 4"]:
        """Body root to camera, m."""
        return np.linalg.inv(self.T_WC) @ self.T_WH


def scene(
    seed: int = 0,
    num_frames: int = 10,
    num_landmarks: int = 50,
    *,
    track_length: int = 16,
    noise: float = 0.0,
    outliers: float = 0.0,
) -> Scene:
    """Returns a scene of `num_frames` at 30 fps in which every landmark is observed.

    Landmarks are created in the image of a random frame, at 2 to 8 m, and stay in view
    for `track_length` frames on average (fewer where they leave the image). `noise` is
    the standard deviation of the observations (px), `outliers` the share of them that
    is replaced by a uniform pixel. Every landmark has at least two observations if
    `num_frames` does.
    """
    rng = np.random.default_rng(seed)
    size, intrinsics = (640, 480), np.array([525.0, 525.0, 319.5, 239.5])
    timestamps = np.arange(num_frames) / 30.0
    T_WH, body_pose = walk(timestamps, phase=rng.uniform(0, 2 * np.pi))
    T_WC = _beside(timestamps, T_WH[:, :3, 3], rng)

    born = np.sort(rng.integers(0, num_frames, num_landmarks))
    life = rng.integers(
        max(track_length // 2, 2), track_length + track_length // 2 + 2, num_landmarks
    )
    first = np.clip(born - life // 2, 0, max(num_frames - 2, 0))
    last = np.minimum(first + life, num_frames)
    pixel = rng.uniform((32, 32), (size[0] - 32, size[1] - 32), (num_landmarks, 2))
    depth = rng.uniform(2.0, 8.0, (num_landmarks, 1))
    ray = (pixel - intrinsics[2:]) / intrinsics[:2]
    at_birth = depth * np.concatenate([ray, np.ones_like(depth)], axis=1)
    T = T_WC[np.clip(born, first, last - 1)]
    landmarks = np.einsum("lij,lj->li", T[:, :3, :3], at_birth) + T[:, :3, 3]

    landmark = np.repeat(np.arange(num_landmarks), last - first)
    start = np.repeat(np.cumsum(last - first) - (last - first), last - first)
    frame = np.arange(len(landmark)) - start + first[landmark]
    T = T_WC[frame]
    p_C = np.einsum("mji,mj->mi", T[:, :3, :3], landmarks[landmark] - T[:, :3, 3])
    uv = p_C[:, :2] / p_C[:, 2:] * intrinsics[:2] + intrinsics[2:]
    visible = (p_C[:, 2] > 0.1) & ((uv > 0) & (uv < np.array(size) - 1)).all(axis=1)
    order = np.flatnonzero(visible)[np.argsort(frame[visible], kind="stable")]
    frame, landmark, uv = frame[order], landmark[order], uv[order]
    uv = uv + noise * rng.standard_normal(uv.shape)
    wrong = rng.random(len(uv)) < outliers
    uv[wrong] = rng.uniform((0, 0), size, (int(wrong.sum()), 2))
    shape = np.clip(rng.standard_normal(10), -2, 2)
    return Scene(
        intrinsics, size, timestamps, T_WC, landmarks, frame, landmark, uv,
        T_WH, body_pose, shape,
    )  # fmt: skip


def walk(
    timestamps: Float[np.ndarray, " t"], phase: float = 0.0
) -> tuple[Float[np.ndarray, "t 4 4"], Float[np.ndarray, "t 23 3"]]:
    """Returns a schematic gait: `T_WH` and body pose of a person who walks 1.2 m/s
    along z.

    Hips, knees, ankles, shoulders and elbows follow sines with one period of 1.1 s,
    which is enough where only smooth motion of human magnitude is needed.
    """
    a = 2 * np.pi * timestamps / 1.1 + phase
    zero = np.zeros_like(a)
    pose = np.zeros((len(a), 24, 3))
    pose[:, 1, 0], pose[:, 2, 0] = -0.45 * np.sin(a), 0.45 * np.sin(a)
    pose[:, 4, 0] = 0.35 - 0.35 * np.cos(a - 0.6)
    pose[:, 5, 0] = 0.35 + 0.35 * np.cos(a - 0.6)
    pose[:, 7, 0], pose[:, 8, 0] = 0.15 * np.cos(a), -0.15 * np.cos(a)
    pose[:, 3, 1] = 0.06 * np.sin(a)
    pose[:, 16, 2], pose[:, 17, 2] = -1.2, 1.2  # arms down from the T-pose
    pose[:, 16, 1], pose[:, 17, 1] = -0.4 * np.sin(a), -0.4 * np.sin(a)
    pose[:, 18, 1], pose[:, 19, 1] = -0.4, 0.4
    T = np.tile(np.eye(4), (len(a), 1, 1))
    root = np.stack([zero, 0.08 * np.sin(a), 0.03 * np.cos(a)], axis=1)
    T[:, :3, :3] = so3.exp(root)
    T[:, :3, 3] = np.stack(
        [0.02 * np.sin(a), 0.92 - 0.02 * np.cos(2 * a), 1.2 * timestamps], axis=1
    )
    return T, pose[:, 1:]


def look_at(
    eye: Float[np.ndarray, "t 3"], target: Float[np.ndarray, "t 3"]
) -> Float[np.ndarray, "t 4 4"]:
    """Returns `T_WC` of upright cameras at `eye` whose optical axis passes through
    `target`."""
    z = target - eye
    z = z / np.linalg.norm(z, axis=1, keepdims=True)
    x = np.cross(z, [0.0, 1.0, 0.0])
    x = x / np.linalg.norm(x, axis=1, keepdims=True)
    T = np.tile(np.eye(4), (len(eye), 1, 1))
    T[:, :3, :3] = np.stack([x, np.cross(z, x), z], axis=2)
    T[:, :3, 3] = eye
    return T


def _beside(
    timestamps: Float[np.ndarray, " t"],
    person: Float[np.ndarray, "t 3"],
    rng: np.random.Generator,
) -> Float[np.ndarray, "t 4 4"]:
    """Returns a camera path beside the person, at 4 m, swaying by decimetres and
    degrees."""
    waves = rng.uniform((0.2, 0, 0.5), (0.9, 2 * np.pi, 1.0), (6, 3))
    sway = np.stack(
        [a * np.sin(2 * np.pi * f * timestamps + p) for f, p, a in waves], axis=1
    )
    eye = person * [1, 0, 1] + [-4.0, 1.4, -0.5] + sway[:, :3] * [0.2, 0.1, 0.3]
    T = look_at(eye, person + 0.1 * sway[:, 3:])
    shake = so3.exp(0.02 * sway[:, 3:] * [1, 1, 2])
    T[:, :3, :3] = T[:, :3, :3] @ shake
    return T
