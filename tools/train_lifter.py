"""Trains the network that guesses postures from keypoints (`bodyslam_jax.people`).

    python tools/train_lifter.py DATA_FOLDER OUT.npz [--steps 6000]
    python tools/train_lifter.py DATA_FOLDER OUT.npz --start FILE
        [--also SUBJECT... | --everybody]
    python tools/train_lifter.py DATA_FOLDER OUT.npz --judge [--start FILE]

`DATA_FOLDER` holds the files that `make_posture_prior.py` reads. A first training
leaves out `CALIBRATION` too, to see by how much deviations are too small for people
that were not learnt from; a second one has them. A quarter of an hour on two cores.
`--start` goes on training another network in its place, whose deviations are widened as
those of that network were. Then `--also` learns from some of the people of `HELD_OUT`,
too, as a fold does, and `--everybody` from all of them, as the network that ships did.
By how much deviations are too small cannot be seen of people who were learnt from: the
factors remain those that were found while these people were held out. `--judge` trains
nothing: people of `HELD_OUT` of whom nothing was learnt, seen by made-up cameras, are
fitted with the network in OUT.npz and without one, or with that of `--start`;
`judge_postures.py` judges guesses alone. What came out is in
`bodyslam_jax/people/assets/README.md`.
"""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from lifter_scene import (
    CAMERA,
    FRAMES,
    SIZE,
    Motion,
    excerpt,
    hide,
    mirrored,
    place,
    read_motions,
    standing,
    watch,
)
from make_posture_prior import HELD_OUT, unknown_to

from bodyslam_jax import people
from bodyslam_jax.body import load_body_model
from bodyslam_jax.config import PeopleFit
from bodyslam_jax.geometry.so3 import log
from bodyslam_jax.people import fit, lift
from bodyslam_jax.people.lift import NUM_FEATURES, Lifter, features, load_lifter
from bodyslam_jax.people.posture_prior import PosturePrior, load_posture_prior
from bodyslam_jax.people.skeleton import (
    NUM_SHAPE,
    Skeleton,
    make_skeleton,
    place_points,
)
from bodyslam_jax.types import Intrinsics, Keypoints

CALIBRATION = ("05", "10", "12", "39")
VIEWS = {True: 10, False: 24}  # cameras for each sequence of walking, of anything else
FEWER_VIEWS = {True: 10, False: 12}  # where another network is trained further
PHASES = (0, 1, 2, 3)
LOCOMOTION_SHARE = 0.5
STANDING = 0.1
"""Share of views of somebody who stands still."""
DEFINITIONS = {"movenet-blazepose": 0.5, "mediapipe": 0.2, "unknown": 0.3}
"""Share of views with keypoints of each definition."""
WIDER = {"posture": 1.18, "turn": 1.21}
"""What deviations are widened by where another network is trained further, so that
errors on walking of people who were not learnt from are as large as they say."""
HIDDEN = 512
BATCH = 512
LEGS = [4, 5, 7, 8, 10, 11]


class Examples(NamedTuple):
    """Frames as the network sees them, and the truth."""

    x: np.ndarray
    angles: np.ndarray
    orientation: np.ndarray
    """Along the ray to the person."""
    walks: np.ndarray


def skeletons() -> dict[str, Skeleton]:
    """By the definition of keypoints."""
    body = load_body_model()
    return {name: make_skeleton(body, 0.0, name) for name in DEFINITIONS}


def make_examples(
    motions: list[Motion], seed: int, views: dict[bool, int] = VIEWS
) -> Examples:
    bones = skeletons()
    rng = np.random.default_rng(seed)
    see = jax.jit(features)
    intrinsics = Intrinsics(CAMERA, *SIZE)
    rows = []
    for motion in motions:
        for _ in range(views[motion.walks]):
            chosen = mirrored(motion) if rng.random() < 0.5 else motion
            still = standing(chosen, rng) if rng.random() < STANDING else None
            chosen = excerpt(chosen, FRAMES, rng) if still is None else still
            noise = "real" if rng.random() < 0.7 else "low"
            definition = rng.choice(list(DEFINITIONS), p=list(DEFINITIONS.values()))
            built_in = definition == "movenet-blazepose"
            view = watch(chosen, bones[definition], rng, noise, built_in)
            view = hide(view, rng) if rng.random() < 0.25 else view
            seen = Keypoints(view.uv[None], view.confidence[None])
            sigma = people.keypoint_sigma(seen, intrinsics, 0)
            # Slower and faster motion: frames that are seen lie closer, or wider.
            rate = rng.choice([20.0, 30.0, 30.0, 40.0])
            last = lambda a: np.concatenate([a, np.repeat(a[-1:], FRAMES - len(a), 0)])
            arrays = (CAMERA, last(view.uv), last(sigma), rate)
            found = see(*(jnp.asarray(a) for a in arrays))
            x, turn, known = (np.asarray(a[: len(sigma)]) for a in found)
            R = turn @ view.T_CH[:, :3, :3]
            parts = (
                x.astype(np.float16),
                view.angles,
                R,
                np.full(len(x), motion.walks),
            )
            rows.append([p[known] for p in parts])
    x, angles, R, walks = (np.concatenate(column) for column in zip(*rows))
    return Examples(x, angles.astype(np.float32), R.astype(np.float32), walks)


def initial(key: jax.Array, prior: PosturePrior) -> Lifter:
    k = prior.basis.shape[1]
    keys = jax.random.split(key, 5)
    normal = lambda key, *shape: np.sqrt(2 / shape[0]) * jax.random.normal(key, shape)
    gains = (1.0, 0.5, 0.5)
    hidden = [g * normal(key, HIDDEN, HIDDEN) for key, g in zip(keys[1:4], gains)]
    # Upright, facing the camera, with unit deviations.
    bias = [jnp.zeros(k), jnp.array([1.0, 0, 0, 0, -1, 0]), jnp.zeros(k)]
    network = Lifter(
        normal(keys[0], NUM_FEATURES, HIDDEN),
        jnp.stack(hidden),
        0.1 * normal(keys[4], HIDDEN, 2 * k + 7),
        jnp.zeros((4, HIDDEN)),
        jnp.concatenate([*bias, jnp.array([-1.0])]),
    )
    return jax.tree.map(lambda a: a.astype(jnp.float32), network)


def joints_of(skeleton: Skeleton) -> Callable[[jax.Array, jax.Array], jax.Array]:
    """22 joints about the pelvis, of a person of mean shape."""
    mean = jnp.zeros(NUM_SHAPE, jnp.float32)
    return jax.vmap(lambda a, R: place_points(skeleton, a, mean)[0][:22] @ R.T)


def train(
    data: Examples,
    steps: int,
    skeleton: Skeleton,
    prior: PosturePrior,
    start: Lifter | None = None,
) -> Lifter:
    network = start or initial(jax.random.key(0), prior)
    rate = 1e-3 if start is None else 4e-4
    optimiser = optax.adam(optax.cosine_decay_schedule(rate, steps))
    state = optimiser.init(network)
    joints = joints_of(skeleton)
    decode = jnp.linalg.pinv(prior.basis).T

    def loss(network, x, angles, R, key):
        # Some keypoints are not seen, either.
        keep = jax.random.bernoulli(key, 0.97, (len(x), NUM_FEATURES // 3, 1))
        x = (x.reshape(len(x), -1, 3) * keep).reshape(len(x), -1)
        found = network(x, key)
        guess = prior.angles(found.latent)
        away = joints(guess, found.orientation) - joints(angles, R)
        distance = jnp.mean(jnp.sqrt(jnp.sum(away**2, -1) + 1e-6))
        # Deviations are learnt from errors, not errors from deviations.
        fixed = jax.lax.stop_gradient(found)
        latent = (angles - prior.mean) @ decode
        error = (fixed.latent - latent) / found.latent_sigma
        turn = jax.vmap(log)(fixed.orientation @ jnp.swapaxes(R, -1, -2))
        turn = turn / found.turn_sigma[:, None]
        likely = jnp.mean(0.5 * error**2 + jnp.log(found.latent_sigma))
        likely += jnp.mean(0.5 * turn**2 + jnp.log(found.turn_sigma)[:, None])
        value = distance + 0.02 * jnp.mean((guess - angles) ** 2) + 0.01 * likely
        return value, distance

    @jax.jit
    def step(network, state, x, angles, R, key):
        (_, distance), gradient = jax.value_and_grad(loss, has_aux=True)(
            network, x, angles, R, key
        )
        update, state = optimiser.update(gradient, state)
        return optax.apply_updates(network, update), state, distance

    rng = np.random.default_rng(1)
    walking, other = np.flatnonzero(data.walks), np.flatnonzero(~data.walks)
    share = round(LOCOMOTION_SHARE * BATCH)
    told = []
    for i in range(steps):
        rows = np.concatenate(
            [rng.choice(walking, share), rng.choice(other, BATCH - share)]
        )
        batch = data.x[rows].astype(np.float32), data.angles[rows]
        batch = (*batch, data.orientation[rows], jax.random.key(i))
        network, state, distance = step(network, state, *batch)
        told.append(distance)
        if i % 500 == 499:
            error = 1e3 * np.mean(jax.device_get(told))
            print(f"{i + 1}/{steps}: {error:.1f} mm", flush=True)
            told = []
    return network


def errors(
    network: Lifter, data: Examples, skeleton: Skeleton, prior: PosturePrior
) -> dict[str, dict[str, float]]:
    """Of guesses, by kind of motion: mm; and root mean squares of whitened ones."""
    joints = jax.jit(joints_of(skeleton))
    found = jax.jit(jax.vmap(network))(data.x.astype(np.float32))
    guess = joints(prior.angles(found.latent), found.orientation)
    true = joints(jnp.asarray(data.angles), jnp.asarray(data.orientation))
    distance = 1e3 * np.linalg.norm(guess - true, axis=-1)
    latent = (data.angles - np.asarray(prior.mean)) @ np.linalg.pinv(prior.basis).T
    posture = (np.asarray(found.latent) - latent) / np.asarray(found.latent_sigma)
    turn = jax.vmap(log)(found.orientation @ jnp.swapaxes(data.orientation, -1, -2))
    turn = np.asarray(turn) / np.asarray(found.turn_sigma)[:, None]
    rms = lambda a: float(np.sqrt(np.mean(a**2)))
    return {
        name: {
            "joints": float(distance[rows].mean()),
            "legs": float(distance[rows][:, LEGS].mean()),
            "posture": rms(posture[rows]),
            "turn": rms(turn[rows]),
        }
        for name, rows in (("walking", data.walks), ("other", ~data.walks))
    }


def save(network: Lifter, path: Path, held_out: tuple[str, ...] = HELD_OUT) -> None:
    np.savez_compressed(
        path,
        **{n: np.asarray(a, np.float16) for n, a in vars(network).items()},
        held_out_subjects=np.array(held_out, dtype="U8"),
        source="CMU Graphics Lab Motion Capture Database, mocap.cs.cmu.edu",
    )


def widened(network: Lifter, posture: float, turn: float) -> Lifter:
    """The network with its standard deviations multiplied."""
    wider = np.zeros(len(network.last_bias))
    k = (len(wider) - 7) // 2
    wider[k + 6 : -1], wider[-1] = np.log(posture), np.log(turn)
    bias = network.last_bias + jnp.asarray(wider, jnp.float32)
    return eqx.tree_at(lambda n: n.last_bias, network, bias)


def learn(folder: Path, out: Path, steps: int) -> None:
    """A first training."""
    skeleton, prior = make_skeleton(load_body_model(), 0.0), load_posture_prior(30.0)
    examples = lambda subjects, inside, seed: make_examples(
        read_motions(folder, subjects, inside, PHASES), seed
    )
    single = jax.tree.map(lambda a: a.astype(jnp.float32), (skeleton, prior))
    data = examples((*HELD_OUT, *CALIBRATION), False, seed=0)
    others = examples(CALIBRATION, True, seed=1)
    print(f"{len(data.x)} frames to learn from, {len(others.x)} to calibrate with")
    found = errors(train(data, steps, *single), others, *single)
    print(found)
    both = lambda name: np.sqrt(np.mean([kind[name] ** 2 for kind in found.values()]))
    network = train(examples(HELD_OUT, False, seed=0), steps, *single)
    network = widened(network, both("posture"), both("turn"))
    save(network, out)
    print("held out:", errors(network, examples(HELD_OUT, True, seed=2), *single))


def learn_further(
    folder: Path, out: Path, steps: int, start: Path, also: tuple[str, ...]
) -> None:
    """From another network, and from the people `also` of `HELD_OUT` too."""
    skeleton, prior = make_skeleton(load_body_model(), 0.0), load_posture_prior(30.0)
    single = jax.tree.map(lambda a: a.astype(jnp.float32), (skeleton, prior))
    held_out = tuple(sorted(set(HELD_OUT) - set(also)))
    read = lambda who, inside: read_motions(folder, who, inside, PHASES[::2])
    # Each person's views are the same whoever else is learnt from.
    data = [make_examples(read(HELD_OUT, False), 0, FEWER_VIEWS)]
    data += [make_examples(read((who,), True), int(who), FEWER_VIEWS) for who in also]
    data = jax.tree.map(lambda *parts: np.concatenate(parts), *data)
    print(f"{len(data.x)} frames to learn from", flush=True)
    network = widened(load_lifter(start), *(1 / w for w in WIDER.values()))
    network = widened(train(data, steps, *single, start=network), **WIDER)
    save(network, out, held_out)
    if held_out:
        others = make_examples(read(held_out, True), 2, FEWER_VIEWS)
        print("held out:", errors(network, others, *single))


def judge(folder: Path, network: Path, start: Path | None) -> None:
    """Fits to keypoints of the held-out people, with guesses and without, or else with
    those of `start`."""
    body = load_body_model()
    skeleton = make_skeleton(body, 0.0)
    unknown = unknown_to([network] if start is None else [network, start])
    motions = [
        m for m in read_motions(folder, unknown, True, (0,)) if len(m.poses) > 59
    ]
    camera = Intrinsics(CAMERA, *SIZE)
    settings = {
        "without": (PeopleFit(lift_scale=0.0), network),
        "with": (PeopleFit(), network),
    }
    if start is not None:
        settings = {
            f"with those of {path}": (PeopleFit(), path) for path in (start, network)
        }
    rows = []
    for number, motion in enumerate(motions):
        rng = np.random.default_rng(number)
        view = watch(excerpt(motion, 192, rng), skeleton, rng, "real")
        seen = Keypoints(view.uv[None], view.confidence[None])
        true, _ = place(skeleton, view.angles, view.shape)
        true = np.einsum("tij,tkj->tki", view.T_CH[:, :3, :3], true)
        found = [motion.walks]
        for chosen, path in settings.values():
            fit.load_lifter = lambda _, path=path: lift.load_lifter(path)
            bodies = people.fit_bodies(seen, camera, body, 30.0, chosen)
            roots = people.roots_from_bodies(bodies, body)
            shape = np.concatenate([roots.shape[0], np.zeros(NUM_SHAPE - 10)])
            angles = roots.body_pose[0, :, :21].reshape(-1, 63)
            joints, _ = place(skeleton, angles, shape)
            joints = np.einsum("tij,tkj->tki", roots.T_CH[0, :, :3, :3], joints)
            there = roots.present[0]
            joints, there_true = joints[there, :22], true[there, :22]
            # No size is known from one view: the best for the whole clip.
            size = np.sum(joints * there_true) / np.sum(joints**2)
            error = 1e3 * np.linalg.norm(size * joints - there_true, axis=-1)
            found += [error.mean(), error[:, LEGS].mean()]
        rows.append(found)
        print(motion.name, *(f"{v:.0f}" for v in found[1:]), flush=True)
    rows = np.array(rows, float)
    for name, kind in (("walking", 1.0), ("other", 0.0)):
        chosen = rows[rows[:, 0] == kind, 1:]
        mean, count = chosen.mean(0), len(chosen)
        print(f"{name}, {count} sequences, joints and legs of the best size, mm:")
        for i, which in enumerate(settings):
            print(f"  {which} {mean[2 * i]:.1f} {mean[2 * i + 1]:.1f}")
        away = chosen[:, 2:] - chosen[:, :2]
        error = away.std(0, ddof=1) / np.sqrt(count)
        print("  difference", *away.mean(0).round(2), "+-", *error.round(2))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--steps", type=int, default=6000)
    parser.add_argument("--start", type=Path)
    parser.add_argument("--also", nargs="+", choices=HELD_OUT, default=())
    parser.add_argument("--everybody", action="store_true")
    parser.add_argument("--judge", action="store_true")
    options = parser.parse_args()
    if options.judge:
        judge(options.data, options.out, options.start)
    elif options.start is None:
        if options.also or options.everybody:
            parser.error("--also and --everybody need --start")
        learn(options.data, options.out, options.steps)
    else:
        also = HELD_OUT if options.everybody else tuple(options.also)
        learn_further(options.data, options.out, options.steps, options.start, also)


if __name__ == "__main__":
    main()
