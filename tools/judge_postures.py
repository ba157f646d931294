"""Judges the posture prior and the lifter on people of whom neither learnt.

    python tools/judge_postures.py DATA_FOLDER [PRIOR.npz LIFTER.npz]...

Each pair of files is a row; without any, the prior and the held-out lifter that ship
are judged. Of the sequences of people of `HELD_OUT` of whom no file learnt, walking and
other motion apart:

- *projection*: distance, mm, from postures to what is left of them in the prior's 32
  components (22 joints about the pelvis, mean shape);
- *likelihood*: of postures under the prior, nats a frame, with 6 mm beside components;
- *innovation*: changes from frame to frame, whitened by what the prior says of them;
- *guess*: PA-MPJPE, mm, of the lifter alone, frame by frame, of 22 joints of people of
  random shape who are seen by made-up cameras with exact keypoints.

Means are those of sequences, guesses also person by person. Rows after the first are
followed by their difference from it, sequence by sequence, with its standard error.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from lifter_scene import (
    CAMERA,
    FRAMES,
    SIZE,
    Motion,
    excerpt,
    place,
    read_motions,
    watch,
)
from make_posture_prior import LEVER, unknown_to

from bodyslam_jax import people
from bodyslam_jax.body import load_body_model
from bodyslam_jax.evaluation.metrics import pa_mpjpe
from bodyslam_jax.people.lift import HELD_OUT_ASSET, Lifter, lift, load_lifter
from bodyslam_jax.people.posture_prior import ASSET as PRIOR
from bodyslam_jax.people.posture_prior import PosturePrior
from bodyslam_jax.people.skeleton import NUM_SHAPE, Skeleton, make_skeleton
from bodyslam_jax.types import Intrinsics, Keypoints

VIEWS = 4  # cameras for each sequence
RESIDUAL = 0.006  # m a joint
ALIGNED = jax.jit(lambda *given: pa_mpjpe(*given).value.mean(1))
MEASURES = ("projection", "likelihood", "innovation", "guess")


def read_prior(path: Path) -> PosturePrior:
    """Of 30 frames a second, as `make_posture_prior.py` writes it."""
    names = ("mean", "basis", "lower", "upper", "autoregression")
    return PosturePrior(*(np.load(path)[name].astype(float) for name in names))


def decoded(prior: PosturePrior, latent: ArrayLike) -> np.ndarray:
    """θ of joints 1 to 21 of each frame, (n, 63) rad."""
    return np.asarray(prior.angles(jnp.asarray(latent)))


def of_prior(
    prior: PosturePrior, motion: Motion, skeleton: Skeleton
) -> tuple[float, float, float]:
    """Projection (mm), likelihood and innovation of one sequence."""
    angles = motion.poses[:, 1:22].reshape(-1, 63)
    scaled = (angles - prior.mean) * LEVER
    basis = prior.basis * LEVER[:, None]
    latent = scaled @ np.linalg.pinv(basis).T
    mean = np.zeros(NUM_SHAPE)
    joints = [
        np.concatenate(
            [
                place(skeleton, a[k : k + FRAMES], mean)[0]
                for k in range(0, len(a), FRAMES)
            ]
        )[:, :22]
        for a in (angles, decoded(prior, latent))
    ]
    distance = 1e3 * np.linalg.norm(joints[0] - joints[1], axis=-1).mean()

    covariance = basis @ basis.T + RESIDUAL**2 / 3 * np.eye(63)
    factor = np.linalg.cholesky(covariance)
    white = np.linalg.solve(factor, scaled.T)
    constant = np.log(np.diag(factor)).sum() + 31.5 * np.log(2 * np.pi)
    likely = -0.5 * np.mean(np.sum(white**2, axis=0)) - constant

    a1, a2 = prior.autoregression.T
    first = a1 / (1 - a2)
    deviation = np.sqrt((1 - a2**2) * (1 - first**2))
    new = (latent[2:] - a1 * latent[1:-1] - a2 * latent[:-2]) / deviation
    return distance, likely, np.sqrt(np.mean(new**2))


def of_guess(
    network: Lifter,
    prior: PosturePrior,
    motion: Motion,
    skeleton: Skeleton,
    rng: np.random.Generator,
) -> float:
    """PA-MPJPE of one sequence, mm."""
    intrinsics = Intrinsics(CAMERA, *SIZE)
    filled = lambda a: np.concatenate([a, np.repeat(a[-1:], FRAMES - len(a), 0)])
    errors = []
    for _ in range(VIEWS):
        view = watch(excerpt(motion, FRAMES, rng), skeleton, rng, "none", exact=True)
        seen = Keypoints(view.uv[None], view.confidence[None])
        sigma = people.keypoint_sigma(seen, intrinsics, 0)
        given = (CAMERA, filled(view.uv), filled(sigma), 30.0)
        found, known = lift(network, *(jnp.asarray(a) for a in given))
        angles = decoded(prior, found.latent)
        guess, _ = place(skeleton, angles, np.zeros(NUM_SHAPE))
        true, _ = place(skeleton, view.angles, view.shape)
        known = np.asarray(known) & (np.arange(FRAMES) < len(sigma))
        error = ALIGNED(guess[:, :22], filled(true[:, :22]), known)
        errors.append(float(np.asarray(error)[known].mean()))
    return 1e3 * float(np.mean(errors))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("files", type=Path, nargs="*")
    options = parser.parse_args()
    files = options.files or [PRIOR, HELD_OUT_ASSET]
    skeleton = make_skeleton(load_body_model(), 0.0)
    motions = read_motions(options.data, unknown_to(files), True, (0,))
    kinds = {"walking": [m for m in motions if m.walks]}
    kinds["other"] = [m for m in motions if not m.walks]
    for kind, chosen in kinds.items():
        if not chosen:
            continue
        print(f"{kind}, {len(chosen)} sequences: {', '.join(MEASURES)}")
        first = None
        for prior_file, lifter_file in zip(files[::2], files[1::2], strict=True):
            prior, network = read_prior(prior_file), load_lifter(lifter_file)
            rows = []
            for number, motion in enumerate(chosen):
                rng = np.random.default_rng(number)
                guess = of_guess(network, prior, motion, skeleton, rng)
                rows.append((*of_prior(prior, motion, skeleton), guess))
            rows = np.array(rows)
            print(lifter_file, *rows.mean(0).round(2))
            people_of = np.array([m.name.split("_")[0] for m in chosen])
            each = {str(p): rows[people_of == p, -1].mean() for p in set(people_of)}
            print("  guess", *(f"{p}: {each[p]:.1f}" for p in sorted(each)))
            if first is None:
                first = rows
                continue
            away = rows - first
            error = away.std(0, ddof=1) / np.sqrt(len(away))
            print("  difference", *away.mean(0).round(2), "+-", *error.round(2))


if __name__ == "__main__":
    main()
