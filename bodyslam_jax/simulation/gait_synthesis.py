"""Synthesises long walks from short recordings that are joined and bent along a path.

Trials are joined where their body poses and velocities agree (same phase of the gait)
and blended over a third of a second; the body is turned slightly in every frame to
follow a path. To prevent foot sliding, the pelvis is not blended but computed from the
feet: the point of the soles in contact with the floor moves exactly as in the
recording. World: y up, floor at y = 0, metres.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import gaussian_filter1d

from bodyslam_jax.body.skeleton import ANKLES, FEET
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.motion import FPS, Clip, resample
from bodyslam_jax.motion.capture.clips import leg_length, mirror
from bodyslam_jax.simulation.posing import Person

_BLEND_FRAMES = 10
"""Duration of the blend of two trials."""
_MIN_PLAYED_FRAMES = 18
"""Duration of a trial between two blends at least."""
_MAX_CLIPS = 40
_MAX_TURN_RAD_S = np.radians(60.0)
"""How quickly a walk is bent at most."""
_LOOK_AHEAD_M = 1.2
"""Distance of the target point ahead on the path, m."""


@dataclasses.dataclass(frozen=True)
class Walk:
    """A person's motion over `t` frames at 30 fps."""

    poses: Float[np.ndarray, "t 24 3"]
    """Axis-angle, rad; row 0 rotates H to the world."""
    pelvis: Float[np.ndarray, "t 3"]
    """Pelvis joint in the world, m."""


def walking_clips(clips: Sequence[Clip], source: str) -> tuple[Clip, ...]:
    """Returns the walking trials among `clips` at 30 fps, those of validation subjects
    if there are any.

    **Raises:** `InputError`, naming `source`, if none is long enough to be joined.
    """
    long = [
        c
        for c in clips
        if c.motion == "walk"
        and c.phase == 0
        and len(c.poses) / c.fps * FPS > 2 * _BLEND_FRAMES + _MIN_PLAYED_FRAMES + 4
    ]
    kept = [c for c in long if c.split == "val"] or long
    if not kept:
        raise InputError(
            f"{source}: no walk of more than 1.4 s among {len(clips)} clips; expected "
            "walking to make long walks of."
        )
    kept = kept[:_MAX_CLIPS]
    is_right = all(
        c.fps == FPS for c in kept
    )  # saves a compilation for the shipped clips
    return tuple(kept) if is_right else resample(kept, FPS)


def walk_along(
    person: Person,
    clips: Sequence[Clip],
    path: Float[np.ndarray, "p 2"],
    num_frames: int,
    rng: np.random.Generator,
) -> Walk:
    """Returns `num_frames` of walking along the closed `path` (x, z in m); corners
    sharper than `_MAX_TURN_RAD_S` are cut."""
    library = _Library(person, [*clips, *map(mirror, clips)])
    plan = _join(library, num_frames, rng)
    yaw = _steer(library, plan, path)
    return _play(library, plan, yaw, path[0])


class Soles:
    """Heel and ball of both feet: the points that support a walker."""

    def __init__(self, person: Person):
        self.person = person
        floor = person.skin[:, 1].min()
        self.offset = np.empty((2, 2, 3))
        for i, (ankle, toe) in enumerate(zip(ANKLES, FEET)):
            foot = person.skin[person.weights[:, ankle] > 0.5]
            heel = foot[foot[:, 2].argmin()] + [0.0, 0.0, 0.02]
            for k, point in enumerate((heel, person.rest[toe])):
                self.offset[i, k] = [point[0], floor, point[2]] - person.rest[ankle]

    def __call__(
        self, poses: Float[np.ndarray, "t 24 3"], pelvis: Float[np.ndarray, "t 3"]
    ) -> Float[np.ndarray, "t 4 3"]:
        """Returns left heel and ball, right heel and ball in the world, m."""
        G, x = self.person.joints(poses, pelvis)
        points = x[:, 7:9, None] + np.einsum("tiab,ikb->tika", G[:, 7:9], self.offset)
        return points.reshape(-1, 4, 3)


def _about_y(angle: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
    """Returns rotation vectors about the vertical, rad."""
    return angle[:, None] * [0.0, 1.0, 0.0]


class _Library:
    """All frames of all clips, with features for joining them and the points of the
    feet."""

    def __init__(self, person: Person, clips: Sequence[Clip]):
        self.soles = Soles(person)
        rest = person.rest
        self.clip = np.repeat(np.arange(len(clips)), [len(c.poses) for c in clips])
        self.poses = np.concatenate([c.poses for c in clips]).astype(float)
        root = so3.exp(self.poses[:, 0])
        # The path of the midpoint of the hips is scaled by leg length: captures and
        # models define the pelvis joint at different heights above the hips.
        below = [
            c.offsets[1:3].mean(axis=0)
            if c.offsets is not None
            else np.array([0.0, -0.086, -0.016]) * c.leg_length / 0.82
            for c in clips
        ]
        ratio = np.array([leg_length(rest) / c.leg_length for c in clips])
        hips = np.concatenate([c.trans for c in clips])
        hips = hips + np.einsum("nij,nj->ni", root, np.array(below)[self.clip])
        self.pelvis = ratio[self.clip, None] * hips
        self.pelvis -= root @ ((rest[1] + rest[2]) / 2 - rest[0])
        _, joints = person.joints(self.poses, np.zeros_like(self.pelvis))
        sole = self.soles(self.poses, self.pelvis)
        for c in range(len(clips)):
            rows = self.clip == c
            # One foot is always on the floor; captured heights drift by centimetres.
            floor = gaussian_filter1d(sole[rows, :, 1].min(axis=1), 5.0)
            sole[rows, :, 1] -= floor[:, None]
            self.pelvis[rows, 1] -= floor
        self._bend_toes(person)
        self.step = self._differences(self.pelvis)
        self.sole_step = self._differences(sole)
        speed = np.linalg.norm(self.sole_step, axis=2) * FPS
        weight = np.exp(-speed / 0.15 - np.maximum(sole[:, :, 1], 0) / 0.03) + 1e-9
        self.carries = weight / weight.sum(axis=1, keepdims=True)
        forward = root[:, :, 2]
        self.yaw = np.arctan2(forward[:, 0], forward[:, 2])
        self.heading = self._smooth_heading()
        self.features = self._features(joints)

    def _bend_toes(self, person: Person) -> None:
        """Bends toes that would penetrate the floor, because toes are rigid in the
        recordings."""
        G, x = person.joints(self.poses, self.pelvis)
        for ankle, toe in zip(ANKLES, FEET):
            tips = np.flatnonzero(person.weights[:, toe] > 0.9)
            tip = person.skin[tips[person.skin[tips, 2].argmax()]] - person.rest[toe]
            tip[1] = person.skin[:, 1].min() - person.rest[toe, 1]
            along = np.einsum("tab,b->ta", G[:, toe], tip)
            reach = np.linalg.norm(along, axis=1)
            angle = np.arcsin(along[:, 1] / reach)
            allowed = np.arcsin(np.clip(-x[:, toe, 1] / reach, -1, 1))
            up = np.clip(gaussian_filter1d(allowed - angle, 0.7), 0.0, 1.0)
            axis = np.cross(along, [0.0, 1.0, 0.0])
            axis /= np.linalg.norm(axis, axis=1, keepdims=True)
            turned = so3.exp(up[:, None] * axis) @ G[:, toe]
            local = np.swapaxes(G[:, ankle], 1, 2) @ turned
            self.poses[:, toe] = so3.log(local)

    def _differences(self, x: np.ndarray) -> np.ndarray:
        """Returns differences to the previous frame; a clip's first one repeats the
        second."""
        d = np.diff(x, axis=0, prepend=x[:1])
        first = np.flatnonzero(np.diff(self.clip, prepend=-1))
        d[first] = d[first + 1]
        return d

    def _smooth_heading(self) -> np.ndarray:
        """Returns the direction of the path without lateral sway, as yaw in rad."""
        smooth = np.concatenate(
            [
                gaussian_filter1d(self.step[self.clip == c], 8.0, axis=0)
                for c in range(self.clip[-1] + 1)
            ]
        )
        return np.arctan2(smooth[:, 0], smooth[:, 2])

    def _features(self, joints: np.ndarray) -> np.ndarray:
        """Returns joints and their velocities relative to the heading; clips are joined
        where these are similar."""
        level = so3.exp(_about_y(-self.yaw))
        joints = np.einsum("tij,tkj->tki", level, joints)
        velocity = self._differences(joints) * FPS
        step = np.einsum("tij,tj->ti", level, self.step) * FPS
        n = len(joints)
        return np.concatenate(
            [joints.reshape(n, -1), 0.1 * velocity.reshape(n, -1), 0.3 * step], axis=1
        )


@dataclasses.dataclass(frozen=True)
class _Plan:
    """Plan of a walk: for each frame the two library frames that are blended, with
    weights and yaws."""

    frame: Int[np.ndarray, "t 2"]
    share: Float[np.ndarray, "t 2"]
    """Weights, which sum to 1."""
    yaw: Float[np.ndarray, "t 2"]
    """Yaw of each that makes the parts continuous, rad; steering is added to it."""


def _join(library: _Library, num_frames: int, rng: np.random.Generator) -> _Plan:
    """Chooses trials and transitions: at random among the three with the best match of
    phase."""
    clip, half = library.clip, _BLEND_FRAMES // 2
    count = np.bincount(clip)
    first = np.cumsum(count) - count
    place = np.arange(len(clip)) - first[clip]
    left = count[clip] - place
    squares = (library.features**2).sum(axis=1)
    ramp = (np.arange(_BLEND_FRAMES) + 0.5) / _BLEND_FRAMES
    ramp = ramp * ramp * (3 - 2 * ramp)
    entries = np.flatnonzero(
        (place >= 1) & (left > 2 * _BLEND_FRAMES + _MIN_PLAYED_FRAMES + 2)
    )

    frames, shares, yaws = [], [], []

    def add(a, b, share, yaw_a, yaw_b):
        frames.append(np.stack([a, b], axis=1))
        shares.append(np.stack([1 - share, share], axis=1))
        yaws.append(np.tile([yaw_a, yaw_b], (len(a), 1)))

    now = int(rng.choice(entries[place[entries] < 10]))
    yaw, total = 0.0, 0
    while total < num_frames:
        end = int(first[clip[now]] + count[clip[now]]) - _BLEND_FRAMES
        leave = np.arange(min(now + _MIN_PLAYED_FRAMES, end - 1), end)
        enter = entries[clip[entries] != clip[now]]
        d = squares[leave + half][:, None] + squares[enter + half]
        d = d - 2 * library.features[leave + half] @ library.features[enter + half].T
        best = {}
        for column in np.argsort(d.min(axis=0)):
            best.setdefault(clip[enter[column]], column)
            if len(best) == 3:
                break
        column = int(rng.choice(list(best.values())))
        a, b = int(leave[d[:, column].argmin()]), int(enter[column])
        alone = np.arange(now, a)
        add(alone, alone, np.zeros(len(alone)), yaw, yaw)
        turn = library.yaw[a : a + _BLEND_FRAMES] - library.yaw[b : b + _BLEND_FRAMES]
        following = yaw + np.angle(np.exp(1j * turn).mean())
        k = np.arange(_BLEND_FRAMES)
        add(a + k, b + k, ramp, yaw, following)
        total += len(alone) + _BLEND_FRAMES
        now, yaw = b + _BLEND_FRAMES, following
    cut = lambda parts: np.concatenate(parts)[:num_frames]
    return _Plan(cut(frames), cut(shares), cut(yaws))


def _steer(
    library: _Library, plan: _Plan, path: Float[np.ndarray, "p 2"]
) -> Float[np.ndarray, " t"]:
    """Returns the yaw (rad) to add in each frame so that the walk follows the path
    (pure pursuit)."""
    along = np.concatenate([path, path[:1]])
    length = np.concatenate(
        [[0.0], np.cumsum(np.linalg.norm(np.diff(along, axis=0), axis=1))]
    )
    at = lambda s: np.array(
        [np.interp(s % length[-1], length, along[:, i]) for i in (0, 1)]
    )
    a, b = plan.frame.T
    angle = np.exp(1j * (library.heading[plan.frame] + plan.yaw))
    heading = np.angle((angle * plan.share).sum(axis=1))
    x, _, z = np.moveaxis(library.step[plan.frame], 2, 0)
    walked = (np.hypot(x, z) * plan.share).sum(axis=1)
    position, progress, rate = path[0], 0.0, 0.0
    start = at(_LOOK_AHEAD_M) - path[0]
    yaw = np.empty(len(a))
    previous = np.arctan2(start[0], start[1]) - heading[0]
    limit = _MAX_TURN_RAD_S / FPS
    for k in range(len(a)):
        ahead = progress + np.linspace(0.0, 0.3, 7)
        gaps = [np.linalg.norm(at(s) - position) for s in ahead]
        progress = ahead[int(np.argmin(gaps))]
        to = at(progress + _LOOK_AHEAD_M) - position
        off = np.arctan2(to[0], to[1]) - heading[k] - previous
        off = (off + np.pi) % (2 * np.pi) - np.pi
        wanted = np.clip(0.2 * off, -limit, limit)
        rate += np.clip(wanted - rate, -0.2 * limit, 0.2 * limit)
        previous = previous + rate
        yaw[k] = previous
        direction = heading[k] + previous
        position = position + walked[k] * np.array(
            [np.sin(direction), np.cos(direction)]
        )
    return yaw


def _play(
    library: _Library,
    plan: _Plan,
    steering: Float[np.ndarray, " t"],
    start: Float[np.ndarray, "2"],
) -> Walk:
    """Blends the postures, then computes the pelvis from the feet."""
    a, b = plan.frame.T
    yaw_a, yaw_b = (_about_y(y) for y in plan.yaw.T + steering)
    share = plan.share[:, 1]
    poses = np.empty((len(a), 24, 3))
    for j in range(24):
        p = library.poses[a, j]
        q = library.poses[b, j]
        if j == 0:
            p, q = so3.compose(yaw_a, p), so3.compose(yaw_b, q)
        poses[:, j] = so3.compose(p, share[:, None] * so3.between(p, q))

    sole = library.soles(poses, np.zeros((len(a), 3)))
    mix = lambda x, y: x * plan.share[:, :1, None] + y * share[:, None, None]
    turn = lambda R, x: np.einsum("tij,tkj->tki", so3.exp(R), x)
    wanted = mix(turn(yaw_a, library.sole_step[a]), turn(yaw_b, library.sole_step[b]))
    carries = mix(library.carries[a, :, None], library.carries[b, :, None])
    step = (carries * (wanted - np.diff(sole, axis=0, prepend=sole[:1]))).sum(axis=1)
    pelvis = np.cumsum(step, axis=0)
    pelvis += [start[0], 0.0, start[1]] - pelvis[:1]
    height = library.pelvis[plan.frame, 1]
    pelvis[:, 1] = (height * plan.share).sum(axis=1)
    return Walk(poses, pelvis)
