"""Simulates the ten named sequences: walk, camera, room, and measurements of them.

`play` has people do something else than walk, as they were recorded. The ten recordings
of `assets/other.npz`, one for each named sequence, are of people of whom neither the
posture prior nor the lifting network that ship learnt. World: y up, floor at y = 0,
metres.
"""

import dataclasses
import zlib
from collections.abc import Sequence as Many
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d

from bodyslam_jax.body import BodyModel, load_body_model
from bodyslam_jax.config import Simulation
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.motion import FPS, Clip, read_motion
from bodyslam_jax.motion.capture.clips import hip_centre, leg_length
from bodyslam_jax.simulation.camera_paths import (
    HANDLING,
    film_around,
    film_following,
    film_room,
    floor_path,
)
from bodyslam_jax.simulation.gait_synthesis import (
    Soles,
    Walk,
    walk_along,
    walking_clips,
)
from bodyslam_jax.simulation.posing import Person
from bodyslam_jax.simulation.room import Room, furnish, put_in_the_way
from bodyslam_jax.simulation.sensor_noise import (
    NOISE,
    Regressed,
    detect_keypoints,
    is_behind,
    noise_of_bodies,
    noise_of_keypoints,
    regress_bodies,
    track_points,
)
from bodyslam_jax.types import (
    Bodies,
    Intrinsics,
    Keypoints,
    Result,
    Sequence,
    Tracks,
)

ASSETS = Path(__file__).parent / "assets"
INTRINSICS = np.array([525.0, 525.0, 319.5, 239.5])
"""`fx fy cx cy`, px."""
SIZE = (640, 480)
"""Width and height of the image, px."""
LENGTH = {
    **{"E1": 600, "E2": 700, "E3": 800, "M1": 700, "M2": 800, "M3": 900, "M4": 1000},
    **{"D1": 600, "D2": 800, "D3": 1000},
}
"""Number of frames of each sequence, at 30 fps."""
_MAX_PEOPLE = 3
_SEQUENCES_AROUND_CAMERA = ("E3", "M2", "M4", "D2")
"""Sequences in which the person walks around the camera instead of in front of it."""
OTHER = "other"
"""Value of `Simulation.motion` that selects these recordings."""
RECORDINGS = {
    "E1": ("14_32", "sits down on a stepstool"),
    "E2": ("14_traffic", "directs traffic, waves, points"),
    "E3": ("02_06", "bends over, lifts"),
    "M1": ("49_18", "balances on one leg"),
    "M2": ("06_12", "dribbles a basketball"),
    "M3": ("14_33", "climbs a ladder"),
    "M4": ("02_07", "fights with a sword"),
    "D1": ("14_08", "jumps up to grab"),
    "D2": ("02_04", "jumps, balances"),
    "D3": ("14_21", "climbs three steps"),
}
"""CMU trial of each sequence, whose subject is before the underscore, and what it
shows."""
_STANDING_SHARE = 0.05
"""Quantile of the height of the lowest sole that is the floor: everybody stands on it
for longer, and noise is below it."""
_DRIFT_M = 0.1
"""Range of the height of the lowest sole up to which it is an error of the recording,
such as feet that sink where somebody crouches whose leg has other proportions."""


@dataclasses.dataclass(frozen=True)
class Actor:
    """One person of a sequence: truth and measurements."""

    person: Person
    """The true body at rest."""
    walk: Walk
    """The true motion."""
    joints: Float[np.ndarray, "t 24 3"]
    """True joints, m, world frame."""
    keypoints: tuple[Float[np.ndarray, "t 25 2"], Float[np.ndarray, "t 25"]]
    """Measured pixels and confidences, BODY_25; missing points are 0 0 0."""
    bodies: Regressed
    """Measured bodies in the camera frame."""

    @property
    def poses(self) -> Float[np.ndarray, "t 72"]:
        """True SMPL poses (axis-angle, rad); the first three numbers are the root's
        rotation from the body to the world frame."""
        return self.walk.poses.reshape(-1, 72)

    @property
    def trans(self) -> Float[np.ndarray, "t 3"]:
        """True pelvis joint minus `J_0(β)`, m, world."""
        return self.walk.pelvis - self.person.rest[0]


@dataclasses.dataclass(frozen=True)
class SimulatedSequence:
    """A sequence with its truth and measurements; world: y up, floor at 0, m."""

    name: str
    settings: Simulation
    timestamps: Float[np.ndarray, " t"]
    """Times of the frames, s."""
    intrinsics: Float[np.ndarray, "4"]
    """`fx fy cx cy`, px."""
    size: tuple[int, int]
    """Width and height of the image, px."""
    T_WC: Float[np.ndarray, "t 4 4"]
    """True cameras, camera to world, m."""
    person: Person
    """The true body at rest."""
    walk: Walk
    """The true motion."""
    joints: Float[np.ndarray, "t 24 3"]
    """True joints, m, world frame."""
    room: Room
    keypoints: tuple[Float[np.ndarray, "t 25 2"], Float[np.ndarray, "t 25"]]
    """Measured pixels and confidences, BODY_25; missing points are 0 0 0."""
    bodies: Regressed
    """Measured bodies in the camera frame."""
    tracks: Tracks
    """Measured tracks of static points."""
    landmarks: Float[np.ndarray, "l 3"]
    """True positions of the tracked points, m, world frame."""
    others: tuple[Actor, ...] = ()
    """Further people."""

    @property
    def seed(self) -> int:
        """Seed of all random numbers."""
        return _seed_of(self.settings)

    @property
    def actors(self) -> tuple[Actor, ...]:
        """All people; the camera follows the first."""
        first = Actor(self.person, self.walk, self.joints, self.keypoints, self.bodies)
        return (first, *self.others)

    @property
    def num_frames(self) -> int:
        """Number of frames."""
        return len(self.timestamps)

    @property
    def poses(self) -> Float[np.ndarray, "t 72"]:
        """True poses of the first person."""
        return self.actors[0].poses

    @property
    def trans(self) -> Float[np.ndarray, "t 3"]:
        """True `trans` of the first person, m."""
        return self.actors[0].trans


def simulate(
    settings: Simulation = Simulation(), body: BodyModel | None = None
) -> SimulatedSequence:
    """Simulates one of the named sequences, or a variant of it.

    **Arguments:**

    - `settings`: which sequence, family, length, seed, motion and noise.
    - `body`: the body model, whose pose blend shapes are ignored; the default without.

    **Raises:** `InputError`, naming the file, if the motion cannot be read or holds no
    walking; `ValueError` if there are fewer than 2 frames, for a negative seed, a bias
    that is no number, a number of people that is not between 1 and 3, or an exposure or
    readout that is not between 0 and a frame.
    """
    length = settings.length
    num_frames = LENGTH[settings.sequence] if length is None else length
    if num_frames < 2:
        raise InputError(f"length {num_frames}: a sequence needs 2 frames or more.")
    if settings.seed is not None and settings.seed < 0:
        raise InputError(f"seed {settings.seed}: expected 0 or more.")
    for name in ("keypoint_errors", "body_errors", "body_jitter"):
        if not 0 <= (factor := getattr(settings, name)) < np.inf:
            raise InputError(f"{name} {factor}: expected 0 or more.")
    for name in ("outliers", "exchanged"):
        if (share := getattr(settings, name)) is not None and not 0 <= share < 1:
            raise InputError(f"{name} {share}: expected a share, 0 to 1.")
    if not np.isfinite(settings.detector_bias):
        raise InputError(
            f"detector bias {settings.detector_bias}: expected a finite number."
        )
    if not 1 <= settings.people <= _MAX_PEOPLE:
        raise InputError(
            f"people {settings.people}: expected 1 to {_MAX_PEOPLE} walkers."
        )
    for what in ("exposure", "readout"):
        value = getattr(settings, what)
        if not 0 <= value <= 1 / FPS:
            raise InputError(f"{what} {value}: expected 0 to {1 / FPS:.4f} s, a frame.")
    name = f"{settings.sequence}-{settings.family}"
    seed = _seed_of(settings)
    # Separate streams, so that the noise level does not change the truth.
    truth, key, reg, pts = np.random.default_rng(seed).spawn(4)
    does_other = settings.motion == OTHER
    walks_of = None if does_other else settings.motion
    source = str(motion_file(walks_of))
    clips = walking_clips(read_motion(source), source)

    shape = np.clip(truth.standard_normal(10), -2.0, 2.0)
    person = Person(body or load_body_model(), shape)
    handling = HANDLING[settings.sequence[0]]
    around = settings.sequence in _SEQUENCES_AROUND_CAMERA
    path, place = floor_path(settings.family, around, truth)
    if does_other:
        trials = {clip.name: clip for clip in read_motion(motion_file(OTHER))}
        along = np.arctan2(*(path[1] - path[0]))
        clip = trials[RECORDINGS[settings.sequence][0]]
        walk = play(person, clip, num_frames, path[0], along)
    else:
        walk = walk_along(person, clips, path, num_frames, truth)
    if settings.family == "room":
        T_WC = film_room(walk.pelvis, place, handling, truth)
    elif does_other:
        T_WC = film_around(walk.pelvis, handling, truth)
    else:
        T_WC = film_following(walk.pelvis, handling, truth)
    others = [
        _other(settings, h, path, around, person, clips, num_frames)
        for h in range(1, settings.people)
    ]
    walks = [walk, *(own for _, own in others)]
    room = furnish(
        np.concatenate([one.pelvis for one in walks]),
        np.tile(T_WC[:, :3, 3], (len(walks), 1)),
        truth,
        is_hall=settings.family == "follow",
    )
    if settings.hiding:
        rng = np.random.default_rng([seed, 100])
        room = put_in_the_way(room, [w.pelvis for w in walks], T_WC[:, :3, 3], rng)
    return measure(settings, name, person, walk, T_WC, room, (key, reg, pts), others)


def motion_file(motion: str | None) -> Path:
    """Returns the file or folder of motion that `Simulation.motion` means."""
    if motion is None:
        return ASSETS / "walking.npz"
    return ASSETS / "other.npz" if motion == OTHER else Path(motion)


def _seed_of(settings: Simulation) -> int:
    name = f"{settings.sequence}-{settings.family}"
    return zlib.crc32(name.encode()) if settings.seed is None else settings.seed


def _other(
    settings: Simulation,
    h: int,
    path: Float[np.ndarray, "p 2"],
    around: bool,
    person: Person,
    clips: tuple[Clip, ...],
    num_frames: int,
) -> tuple[Person, Walk]:
    """Returns shape and walk of person `h`, on a path beside the first person's.

    In a room it is a smaller or larger loop, shifted by up to an eighth of it; in a
    hall a parallel path, shifted by up to 2.5 m.
    """
    rng = np.random.default_rng([_seed_of(settings), h])
    own = person.of_shape(np.clip(rng.standard_normal(10), -2.0, 2.0))
    middle = path.mean(axis=0)
    if settings.family == "room":
        path = middle + (1 + 0.3 * h if around else 1 - 0.3 * h) * (path - middle)
        start = int(rng.uniform(-0.12, 0.12) * len(path))
    else:
        length = np.linalg.norm(np.roll(path, -1, axis=0) - path, axis=1).sum()
        away = path - middle
        away = away / np.linalg.norm(away, axis=1, keepdims=True)
        side = (1 if h % 2 else -1) * rng.uniform(0.8, 1.2)
        path = path + side * away
        start = int(rng.uniform(-2.5, 2.5) / length * len(path))
    path = np.roll(path, -start, axis=0)
    return own, walk_along(own, clips, path, num_frames, rng)


def measure(
    settings: Simulation,
    name: str,
    person: Person,
    walk: Walk,
    T_WC: Float[np.ndarray, "t 4 4"],
    room: Room,
    streams: tuple[np.random.Generator, np.random.Generator, np.random.Generator],
    others: Many[tuple[Person, Walk]] = (),
) -> SimulatedSequence:
    """Simulates the measurements of a sequence.

    `streams` are the random numbers for keypoints, bodies and tracks of the first
    person; `others` have their own.
    """
    R_CW, centre = np.swapaxes(T_WC[:, :3, :3], 1, 2), T_WC[:, :3, 3]
    to_camera = lambda x: np.einsum("tab,tjb->tja", R_CW, x - centre[:, None])
    everyone = [(person, walk), *others]
    posed = [p.joints(w.poses, w.pelvis) for p, w in everyone]
    joints_C = np.stack([to_camera(joints) for _, joints in posed])
    actors = []
    for h, ((body, own), (G, joints)) in enumerate(zip(everyone, posed, strict=True)):
        seed = [_seed_of(settings), h, 1]
        key, reg = streams[:2] if h == 0 else np.random.default_rng(seed).spawn(2)
        points = body.keypoints(G, joints, settings.detector_bias)
        points_C = to_camera(points)
        hidden = np.zeros(points.shape[:2], bool)
        if settings.hiding:
            for k in range(len(T_WC)):
                hidden[k] = room.is_hidden(centre[k], points[k])
        for i in range(len(everyone)):
            if i != h:
                hidden |= is_behind(points_C, joints_C[i], INTRINSICS)
        keypoints = detect_keypoints(
            points_C, joints_C[h], INTRINSICS, SIZE, noise_of_keypoints(settings),
            key, hidden,
        )  # fmt: skip
        if not settings.feet_and_face:
            for array in keypoints:
                array[:, [0, *range(15, 25)]] = 0.0
        poses_C = own.poses.copy()
        poses_C[:, 0] = so3.compose(so3.log(R_CW), own.poses[:, 0])
        bodies = regress_bodies(
            body, poses_C, joints_C[h, :, 0], keypoints, INTRINSICS,
            noise_of_bodies(settings), reg,
        )  # fmt: skip
        actors.append(Actor(body, own, joints, keypoints, bodies))
    tracks, landmarks = track_points(
        room, T_WC, joints_C, INTRINSICS, SIZE,
        NOISE[settings.track_noise or settings.noise], streams[2],
        life=HANDLING[settings.sequence[0]].track_life,
    )  # fmt: skip
    return SimulatedSequence(
        name=name,
        settings=settings,
        timestamps=np.arange(len(T_WC)) / FPS,
        intrinsics=INTRINSICS,
        size=SIZE,
        T_WC=T_WC,
        person=person,
        walk=walk,
        joints=actors[0].joints,
        room=room,
        keypoints=actors[0].keypoints,
        bodies=actors[0].bodies,
        tracks=tracks,
        landmarks=landmarks,
        others=tuple(actors[1:]),
    )


def filmed_from(
    simulated: SimulatedSequence, T_WC: Float[np.ndarray, "t 4 4"]
) -> SimulatedSequence:
    """Simulates new measurements of the same people and room by other cameras, such as
    one that stands still, with the noise and the seed of the sequence."""
    _, *streams = np.random.default_rng(simulated.seed).spawn(4)
    key, reg, pts = streams
    first, *others = simulated.actors
    given = simulated.settings, simulated.name, first.person, first.walk, T_WC
    walks = [(actor.person, actor.walk) for actor in others]
    return measure(*given, simulated.room, (key, reg, pts), walks)


def as_sequence(simulated: SimulatedSequence) -> Sequence:
    """Returns the measurements as the readers would return them, without a video."""
    actors, t = simulated.actors, simulated.num_frames
    present = np.zeros((len(actors), t), bool)
    poses, shapes = np.zeros((len(actors), t, 72)), np.zeros((len(actors), t, 10))
    trans = np.zeros((len(actors), t, 3))
    for h, actor in enumerate(actors):
        bodies = actor.bodies
        present[h, bodies.frame] = True
        poses[h, bodies.frame] = bodies.poses
        shapes[h, bodies.frame] = bodies.shapes
        trans[h, bodies.frame] = bodies.trans
    uv, confidence = (np.stack([a.keypoints[i] for a in actors]) for i in range(2))
    return Sequence(
        name=simulated.name,
        frames=None,
        timestamps=simulated.timestamps,
        intrinsics=Intrinsics(simulated.intrinsics, *simulated.size),
        keypoints=Keypoints(uv, confidence),
        bodies=Bodies(present, poses, shapes, trans, shapes_regressed(simulated)),
        tracks=simulated.tracks,
    )


def as_truth(simulated: SimulatedSequence) -> Result:
    """Returns the truth as a result that an estimate can be compared with."""
    return Result(
        timestamps=simulated.timestamps,
        T_WC=simulated.T_WC,
        scale=1.0,
        intrinsics=simulated.intrinsics,
        landmarks=simulated.landmarks,
        poses=np.stack([a.poses for a in simulated.actors]),
        trans=np.stack([a.trans for a in simulated.actors]),
        betas=np.stack([a.person.shape for a in simulated.actors]),
        joints=np.stack([a.joints for a in simulated.actors]),
        present=np.ones((len(simulated.actors), simulated.num_frames), bool),
    )


def shapes_regressed(simulated: SimulatedSequence) -> bool:
    """Returns whether shapes have the errors of a regressor."""
    settings = simulated.settings
    return (settings.body_noise or settings.noise) != "none"


def play(
    person: Person, clip: Clip, num_frames: int, middle: Float[np.ndarray, "2"] | None,
    towards: float = 0.0,
) -> Walk:  # fmt: skip
    """Returns a recording in the size of another person, whose soles stand at height 0.

    It is played forwards and backwards until it is long enough.

    Args:
        middle: place (x, z), m, to which the mean of the pelvis' path is moved; `None`
            leaves it.
        towards: direction, rad from z to x, of the line along which the pelvis moves
            most; used with `middle`.
    """
    there = np.arange(len(clip.poses))
    again = np.resize(np.concatenate([there, there[-2:0:-1]]), num_frames)
    poses = clip.poses[again].astype(float)
    # By the hips: captures and models define the pelvis joint at different heights.
    hips = hip_centre(clip)[again] * float(leg_length(person.rest) / clip.leg_length)
    above = person.rest[0] - (person.rest[1] + person.rest[2]) / 2
    pelvis = hips + so3.exp(poses[:, 0]) @ above
    soles = Soles(person)(poses, pelvis)[..., 1].min(axis=1)
    floor = np.full(num_frames, np.quantile(soles, _STANDING_SHARE))
    if np.ptp(soles) < _DRIFT_M:  # nobody is in the air, or on anything
        floor = gaussian_filter1d(soles, 5.0)
    pelvis = pelvis - np.stack([0 * floor, floor, 0 * floor], axis=1)
    if middle is None:
        return Walk(poses, pelvis)
    pelvis[:, [0, 2]] -= pelvis[:, [0, 2]].mean(axis=0)
    _, _, axes = np.linalg.svd(pelvis[:, [0, 2]], full_matrices=False)
    turn = np.array([0.0, towards - np.arctan2(*axes[0]), 0.0])
    poses[:, 0] = so3.compose(np.tile(turn, (num_frames, 1)), poses[:, 0])
    pelvis = pelvis @ so3.exp(turn).T + [middle[0], 0.0, middle[1]]
    return Walk(poses, pelvis)
