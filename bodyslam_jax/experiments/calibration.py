"""Measures the calibration of uncertainties, for `bodyslam experiment calibration`.

A claimed standard deviation is right if the errors divided by it have a root mean
square of 1 and lie within it as often as a normal distribution predicts. This is
measured on people, motions, cameras, floors and errors that are drawn from
distributions unknown to all priors of the estimator:

- statures of a population (`POPULATION`), a third of the other components of shape
  beyond one standard deviation of the prior, and individual limb lengths
  (`LIMB_SPREAD`), which no β of the body model can represent;
- errors of keypoints and bodies of other magnitude and other correlation in time, of
  other shares of outliers and of exchanged sides, and keypoints between SMPL's and
  COCO's definition;
- floors that are level (half), slope by up to 4 degrees, or are uneven by 3 cm;
- any of the ten kinds of camera and motion, both families, 90 to 210 frames.

Seeds start at `FIRST_SEED`, so that nothing was fitted to these people. The inputs are
a regressor's bodies, keypoints, or rendered images alone.
"""

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from bodyslam_jax import body as body_
from bodyslam_jax import evaluation, io, pipeline, simulation
from bodyslam_jax.body.skeleton import FEET, PARENTS, PELVIS
from bodyslam_jax.config import Config, Experiment, Simulation
from bodyslam_jax.evaluation.errors import UP
from bodyslam_jax.experiments.jobs import COMPILATION_S, Job, Row
from bodyslam_jax.experiments.tables import (
    Column,
    intro,
    markdown,
    to_csv,
    write_text,
)
from bodyslam_jax.ground.gravity import upright
from bodyslam_jax.ground.stances import find_stances
from bodyslam_jax.pipeline.stage_cache import Cache
from bodyslam_jax.simulation import sequences
from bodyslam_jax.simulation.posing import Person
from bodyslam_jax.simulation.room import Height, Room, Terrain, lifted
from bodyslam_jax.types import Result

COUNTS = {"bodies": 35, "keypoints": 35, "pixels": 30}
"""Number of people for each input."""
FIRST_SEED = 7_000_000
POPULATION = ((1.754, 0.075), (1.613, 0.071))
"""Mean and standard deviation of the statures of men and women, m: adults of NHANES
2015-2018 (Fryar, Carroll, Gu, Afful, Ogden, Vital and Health Statistics 3:46, 2021)."""
LIMB_SPREAD = 0.035
"""Standard deviation of a limb's length over that of a person of this stature: the
coefficient of variation of thigh, shin, upper arm and forearm within a stature in
ANSUR II is 3 to 4 % (Gordon et al., 2014)."""
MAX_SLOPE_RAD = math.radians(4.0)
UNEVENNESS_M = 0.03
"""Amplitude of uneven floors."""
LIMBS = (
    *((1, 4, 7), (2, 5, 8), (4, 7, 10), (5, 8, 11)),
    *((16, 18, 20), (17, 19, 21), (18, 20, 22), (19, 21, 23)),
)
"""Start joint, end joint and next joint of thighs, shins, upper arms and forearms; a
person's left and right limbs are equal."""
QUANTITIES = {
    "scale": "scale",
    "stature": "stature",
    "up": "up",
    "joints": "joints within the body",
    "places": "pelvis on the floor (x, z)",
    "heights": "pelvis over the floor (y)",
    "camera": "first camera over the floor",
}
"""Claimed quantities by the field of a row."""
OVER_FRAMES = {"joints": 3, "places": 2, "heights": 1}
"""Quantities with a claim in each frame, and their number of coordinates. A row has
their root mean square and their coverage over its frames, so that a clip, whose errors
are mostly common to all frames, counts once."""
CHI2_QUANTILES = {68: (0.989, 2.279, 3.506), 95: (3.841, 5.991, 7.815)}
"""Quantiles of χ² at 68 and 95 % for one, two and three coordinates."""
FORM: dict[str, Any] = {
    **{f"z_{name}": float for name in QUANTITIES},
    **{f"{n}_within_{share}": float for n in OVER_FRAMES for share in CHI2_QUANTILES},
    "input": str,
    "status": str,
}


def jobs(experiment: Experiment, config: Config, stages: Path) -> list[Job]:
    """Returns one row for each person, of the requested families and sequences."""
    found, seed = [], FIRST_SEED + 1000 * (experiment.seed or 0)
    for which, count in COUNTS.items():
        for number in range(count):
            seed += 1
            settings, floor = drawn(seed, experiment, which)
            label = f"{which}-{number:02d}-{settings.sequence}-{settings.family}"
            compute = lambda s=settings, f=floor, w=which: person_row(
                s, f, w, config, stages
            )
            seconds = COMPILATION_S + 0.4 * (settings.length or 0)
            key = (settings, floor, which, config)
            found.append(Job(label, key, seconds, compute))
    return found


def drawn(
    seed: int, experiment: Experiment, which: str
) -> tuple[Simulation, tuple[str, float, float]]:
    """Draws the settings of one simulation, and its floor: kind, size (rad or m),
    direction (rad)."""
    rng = np.random.default_rng([seed, 1])
    strength = lambda spread: float(np.exp(spread * rng.standard_normal()))
    names = experiment.sequences or sequences.LENGTH
    families = ("room", "follow")
    if experiment.family in families:
        families = (experiment.family,)
    settings = Simulation(
        sequence=str(rng.choice(list(names))),  # pyright: ignore[reportArgumentType]
        family=str(rng.choice(families)),  # pyright: ignore[reportArgumentType]
        length=experiment.frames or int(rng.integers(90, 211)),
        seed=seed,
        motion=experiment.motion,
        noise=experiment.noise,
        keypoint_errors=strength(0.35),
        body_errors=strength(0.35),
        body_jitter=strength(0.5),
        outliers=float(rng.uniform(0.0, 0.05)),
        exchanged=float(rng.uniform(0.0, 0.02)),
        detector_bias=float(rng.uniform(0.0, 1.0)),
        render=which == "pixels",
    )
    kind = str(rng.choice(["level", "level", "slope", "uneven"]))
    size = {
        "level": 0.0,
        "slope": MAX_SLOPE_RAD * rng.uniform(),
        "uneven": UNEVENNESS_M,
    }[kind]
    return settings, (kind, float(size), float(rng.uniform(0, 2 * np.pi)))


def floor_of(floor: tuple[str, float, float]) -> Height:
    """Returns the function that maps places (x, z) to the height of a floor, m."""
    kind, size, direction = floor
    along = np.array([np.cos(direction), np.sin(direction)])
    if kind == "slope":
        return lambda at: np.tan(size) * (at @ along)
    if kind == "uneven":
        side = np.array([-along[1], along[0]])
        return lambda at: size * np.sin(2.1 * (at @ along)) * np.sin(1.7 * (at @ side))
    return lambda at: np.zeros(at.shape[:-1])


def of_population(person: Person, rng: np.random.Generator) -> Person:
    """Draws a person whose stature is of the population, with individual limb
    lengths."""
    mean, spread = POPULATION[int(rng.integers(2))]
    stature = mean + spread * rng.standard_normal()
    shape = 1.3 * rng.standard_normal(10)
    for _ in range(
        2
    ):  # the height of the mesh is linear in β except where its highest vertex changes
        there = person.of_shape(shape)
        height = np.ptp(there.skin[:, 1])
        more = [person.of_shape(shape + 0.1 * np.eye(10)[i]) for i in range(10)]
        slope = np.array([(np.ptp(p.skin[:, 1]) - height) / 0.1 for p in more])
        shape = shape + slope * (stature - height) / (slope @ slope)
    return with_limbs(person.of_shape(shape), 1 + LIMB_SPREAD * rng.standard_normal(4))


def with_limbs(person: Person, factors: Float[np.ndarray, "4"]) -> Person:
    """Returns the person with thighs, shins, upper arms and forearms scaled by
    `factors`; the skin of a limb is stretched with it."""
    rest, skin = person.rest.copy(), person.skin.copy()
    for k, (start, end, _) in enumerate(LIMBS):
        grown = (factors[k // 2] - 1) * (rest[end] - rest[start])
        axis = rest[end] - rest[start]
        # Everything beyond the limb moves with it, the limb's own skin in proportion.
        beyond = sorted(_descendants(end))
        share = np.clip((skin - rest[start]) @ axis / (axis @ axis), 0.0, 1.0)
        own = person.weights[:, start] * share
        moved = own + person.weights[:, beyond].sum(axis=1)
        skin += moved[:, None] * grown
        rest[beyond] += grown
    person.rest, person.skin = rest, skin
    return person


def _descendants(joint: int) -> set[int]:
    """Returns the joint and all joints below it in the kinematic tree."""
    found = {joint}
    for child, parent in enumerate(PARENTS):
        if parent in found:
            found.add(child)
    return found


def scene_of(
    settings: Simulation, floor: tuple[str, float, float], body: Any
) -> sequences.SimulatedSequence:
    """Simulates the sequence with another person and floor."""
    flat = simulation.simulate(settings, body)
    rng = np.random.default_rng([settings.seed or 0, 2])
    leg = lambda p: np.linalg.norm(p.rest[[4, 7]] - p.rest[[1, 4]], axis=1).sum()
    person = of_population(flat.person, rng)
    ratio = leg(person) / leg(flat.person)
    height = floor_of(floor)
    # Step length and height of the pelvis are scaled with leg length.
    middle = flat.walk.pelvis.mean(axis=0) * [1, 0, 1]
    pelvis = middle + (flat.walk.pelvis - middle) * ratio
    walk = dataclasses.replace(flat.walk, pelvis=pelvis)
    walk = lifted(person, walk, height)
    room: Room = flat.room
    T_WC = flat.T_WC.copy()
    if floor[0] != "level":
        room = Terrain(room.walls, room.boxes, height)
        T_WC[:, 1, 3] += height(T_WC[:, :3, 3].mean(axis=0)[[0, 2]])
    streams = tuple(np.random.default_rng(flat.seed).spawn(4)[1:])
    return sequences.measure(
        settings, flat.name, person, walk, T_WC, room, streams, []  # pyright: ignore
    )  # fmt: skip


def person_row(
    settings: Simulation,
    floor: tuple[str, float, float],
    which: str,
    config: Config,
    stages: Path,
) -> Row:
    """Returns the errors of one person's estimate divided by their claimed standard
    deviations."""
    body = body_.load_body_model(config.body_model)
    scene = scene_of(settings, floor, body)
    config = dataclasses.replace(config, overlay=False)
    if which == "pixels":
        film = simulation.film_scene(stages / f"calibration-{settings.seed}", scene)
        sequence = pipeline.find_people(io.read_sequence(film), config, Cache(None))
    else:
        sequence = simulation.as_sequence(scene)
        if which == "keypoints":
            sequence = dataclasses.replace(sequence, bodies=None)
    result = pipeline.run(sequence, config)
    labels = {"sequence": f"{settings.seed}", "input": which, "floor": floor[0]}
    return {**labels, **claims(result, scene, body)}


def claims(result: Result, scene: sequences.SimulatedSequence, body: Any) -> Row:
    """Returns z values (error over claimed sigma) of a result; `None` where nothing is
    claimed.

    `z_up` and `z_joints` are root mean squares per coordinate: an angle has two, a
    joint position three, a place on the floor two.
    """
    pair = evaluation.associate(result, simulation.as_truth(scene), body)
    errors = evaluation.evaluate(*pair)
    summary = result.summary
    row: Row = {"status": summary["status"], "scale": float(errors["scale"])}
    known = lambda x: x is not None and math.isfinite(x) and x > 0
    ratio = lambda e, s: float(e / s) if known(s) and math.isfinite(e) else None
    claimed = summary["scale"]["sigma"]
    relative = claimed / result.scale if known(claimed) else None
    row["z_scale"] = ratio(-math.log(float(errors["scale"])), relative)
    # The first person is the one whom the camera films.
    person = summary["people"][0] if summary["people"] else {}
    stature = float(np.ptp(scene.person.skin[:, 1]))
    row["z_stature"] = ratio(
        (person.get("stature_m") or math.nan) - stature, person.get("stature_sigma_m")
    )
    up = summary["up"]["sigma_degrees"]
    tilt = math.degrees(float(errors["gravity_error"]))
    row["z_up"] = ratio(tilt / math.sqrt(2), up)
    row |= _of_joints(result, pair)
    row |= _of_places(result, scene)
    return row


def _of_joints(result: Result, pair: tuple[Any, Any]) -> Row:
    """Returns the z value and the coverage of joints, after alignment of the body in
    each frame, as `joint_sigma` (RMS distance within the body) is defined."""
    if result.joint_sigma is None or not len(result.joints):
        return _over_frames("joints", np.zeros(0))
    mine, theirs = pair
    present = np.asarray(mine.present & theirs.present)[0]
    if not present.any():
        return _over_frames("joints", np.zeros(0))
    x, y = np.asarray(mine.joints)[0][present], np.asarray(theirs.joints)[0][present]
    error = np.linalg.norm(_aligned(x, y) - y, axis=-1)
    sigma = _claimed_there(result, present)
    use = sigma > 0
    return _over_frames("joints", 3 * (error[use] / sigma[use]) ** 2)


def _over_frames(name: str, chi2: Float[np.ndarray, " n"]) -> Row:
    """Returns the root mean square per coordinate and the coverage of a quantity with
    one χ² for each claim; `None` without any."""
    coordinates = OVER_FRAMES[name]
    known = len(chi2) > 0
    row: Row = {f"z_{name}": None}
    if known:
        row[f"z_{name}"] = float(np.sqrt(chi2.mean() / coordinates))
    for share, quantiles in CHI2_QUANTILES.items():
        inside = chi2 < quantiles[coordinates - 1]
        row[f"{name}_within_{share}"] = float(inside.mean()) if known else None
    return row


def _of_places(result: Result, scene: sequences.SimulatedSequence) -> Row:
    """Returns z values and coverage of a person's place in W, and of the camera's
    height.

    The truth is taken to W as the estimate is: the first camera is its origin and gives
    its heading, y is up by its own up. No alignment is fitted, because what W claims is
    a place as seen from the first camera and the floor; an alignment of the paths
    would remove most of the error of scale and of up. The floor is the median of the
    places where feet truly stand.
    """
    row = _over_frames("places", np.zeros(0)) | _over_frames("heights", np.zeros(0))
    row["z_camera"] = None
    if result.root_sigma is None or not result.present[:1].any():
        return row
    truth = simulation.as_truth(scene)
    joints, eye = in_world(truth, scene.room)
    frames = np.flatnonzero(result.present[0, : len(truth.timestamps)])
    error = result.joints[0, frames, PELVIS] - joints[0, frames, PELVIS]
    chi2 = (error / result.root_sigma[0, frames]) ** 2
    row |= _over_frames("places", chi2[:, 0] + chi2[:, 2])
    row |= _over_frames("heights", chi2[:, 1])
    sigma = result.summary["camera_height"]["sigma_m"]
    row["z_camera"] = float((result.T_WC[0, 1, 3] - eye) / sigma) if sigma else None
    return row


def in_world(truth: Result, room: Room) -> tuple[Float[np.ndarray, "h t 24 3"], float]:
    """Returns the true joints in W, m, and the true height of the first camera over the
    floor, m."""
    height = room.height if isinstance(room, Terrain) else floor_of(("level", 0.0, 0.0))
    feet = truth.joints[:, :, list(FEET)]
    places = np.concatenate(find_stances(feet, truth.present, truth.fps))
    places = places if len(places) else feet.reshape(-1, 3)
    eye = truth.T_WC[0, 1, 3] - float(np.median(height(places[:, [0, 2]])))
    motion = upright(truth.T_WC, UP)
    joints = truth.joints @ motion[:3, :3].T + motion[:3, 3]
    return joints + eye * UP, eye


def _claimed_there(result: Result, present: np.ndarray) -> Float[np.ndarray, "f 24"]:
    """Returns `joint_sigma` at the frames of a pairing, which may be cut to common
    times."""
    sigma = np.asarray(result.joint_sigma)[0]
    frames = np.flatnonzero(present)
    return sigma[frames[frames < len(sigma)]]


def _aligned(
    x: Float[np.ndarray, "f 24 3"], y: Float[np.ndarray, "f 24 3"]
) -> Float[np.ndarray, "f 24 3"]:
    """Returns x aligned to y by a similarity in each frame (Umeyama, 1991)."""
    mx, my = x.mean(axis=1, keepdims=True), y.mean(axis=1, keepdims=True)
    a, b = x - mx, y - my
    U, D, Vt = np.linalg.svd(np.einsum("fja,fjb->fab", b, a))
    sign = np.ones_like(D)
    sign[:, 2] = np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    R = np.einsum("fab,fb,fbc->fac", U, sign, Vt)
    s = (D * sign).sum(axis=1) / (a**2).sum(axis=(1, 2))
    return my + s[:, None, None] * np.einsum("fab,fjb->fja", R, a)


def write_calibration(out: Path, rows: list[Row], *, about: str) -> list[Path]:
    """Writes `calibration.md` and `calibration.csv`: root mean square of errors over
    claims, and the share of errors within the claims."""
    text = intro(
        "Errors over claimed standard deviations",
        about,
        "People, floors, cameras and errors of distributions that no prior knows "
        "(`experiments/calibration.py` has them). Right claims have a root mean square "
        "of 1, 68 % of the errors within one claimed standard deviation and 95 % "
        "within 1.96. Of joints, coverage is that of a normal distribution in three "
        "coordinates, of places on the floor in two. Places are compared in the world "
        "of the first camera and the floor, without alignment; a clip counts once. ± "
        "is a standard error. Simulated.",
    )
    columns = [
        Column("claim", "what"),
        Column("input", "input"),
        Column("people", "count", digits=0),
        Column("rms of error over claim", "rms"),
        Column("within 68 %", "within_68"),
        Column("within 95 %", "within_95"),
    ]
    text += markdown(columns, list(_summaries(rows)))
    write_text(out / "calibration.md", text)
    kept = [Column(name, name, digits=3) for name in ("sequence", "input", *FORM)]
    write_text(out / "calibration.csv", to_csv(kept, rows, about))
    return [out / "calibration.md", out / "calibration.csv"]


def _summaries(rows: Sequence[Mapping[str, Any]]) -> Iterator[Row]:
    for name, title in QUANTITIES.items():
        for which in (*COUNTS, "all"):
            own = [r for r in rows if which in ("all", r["input"])]
            own = [r for r in own if r.get(f"z_{name}") is not None]
            z = np.array([r[f"z_{name}"] for r in own])
            if not len(z):
                continue
            row: Row = {"what": title, "input": which, "count": len(z)}
            row["rms"] = _with_error(z**2, math.sqrt)
            for share, (limit, *_) in CHI2_QUANTILES.items():
                if name in OVER_FRAMES:
                    inside = np.array([r[f"{name}_within_{share}"] for r in own])
                elif name == "up":
                    # Two coordinates: χ² with two degrees of freedom.
                    inside = 2 * z**2 < -2 * math.log(1 - share / 100)
                else:
                    inside = z**2 < limit
                row[f"within_{share}"] = _with_error(np.asarray(inside, float), float)
            yield row


def _with_error(values: np.ndarray, root: Callable[[float], float]) -> str:
    """Returns a mean, or its square root, with the standard error over people, as
    text."""
    mean = float(values.mean())
    error = float(values.std(ddof=1)) / math.sqrt(len(values)) if len(values) > 1 else 0
    if root is math.sqrt:
        mean, error = math.sqrt(mean), error / (2 * math.sqrt(max(mean, 1e-12)))
    return f"{mean:.2f} ± {error:.2f}"
