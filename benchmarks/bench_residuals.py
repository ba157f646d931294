"""Do fits follow what is seen? Residuals of keypoints over the error that they claim.

    python benchmarks/bench_residuals.py VIDEO [VIDEO ...] [--stages FOLDER]
        [--rendered M2-room D1-follow --motion other --frames 120]

Each video, and each rendered sequence of `experiment video`, is estimated from its
images alone. A residual is a keypoint, after what the detector calls a joint is taken
out (`people.as_body_keypoints`), minus the estimated body's; the error that it claims
is that of `people.keypoint_sigma` at the person's depth, without the inflation that
stands for errors that last. Only sure keypoints count, of a relative confidence of
`SURE` or more. A ratio is the standard deviation of one coordinate that a normal
distribution with the same median distance would have, over the claim: 1 if fits lie
where the noise puts them; `tail`, the 95th percentile over that of a normal
distribution, is of limbs that are not followed. Slow, medium and fast are thirds of
all speeds at the fixed limits `SPEEDS`. `near` is the share of residuals within 3 % of
the stature.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from bodyslam_jax import body as body_
from bodyslam_jax import io, people, pipeline, simulation
from bodyslam_jax.body.skeleton import KEYPOINT_NAMES
from bodyslam_jax.body.skinning import stature
from bodyslam_jax.config import Config, Simulation
from bodyslam_jax.experiments.video import filmed
from bodyslam_jax.people.costs import KEYPOINT_SIGMA
from bodyslam_jax.pipeline.run import run_stages
from bodyslam_jax.types import Result, Sequence

SURE = 0.5
SPEEDS = (0.3, 1.0)
"""Speed of a keypoint in the image relative to the hips', m/s at the person's depth."""
NEAR = 0.03
"""Of the stature."""
MEDIAN, TAIL = 1.1774, 2.4477
"""Median and 95th percentile of the distance of two standard normal coordinates."""
PARTS = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle", "big_toe", "heel")
CONFIG = Config(overlay=False)


def residuals(
    sequence: Sequence, result: Result
) -> Iterator[dict[str, np.ndarray | float]]:
    """For each person: `off` (distance over the claimed error), `sure`, `speed` (m/s)
    and `away` (in statures), each of all frames and keypoints."""
    body = body_.load_body_model()
    keypoints = sequence.keypoints
    assert keypoints is not None
    R_WC, eye = result.T_WC[:, :3, :3], result.T_WC[:, :3, 3]
    T_CH = np.tile(np.eye(4), (*result.present.shape, 1, 1))
    R_WH = people.roots_from_bodies(_bodies(result), body).T_CH[..., :3, :3]
    T_CH[..., :3, :3] = np.swapaxes(R_WC, 1, 2) @ R_WH
    T_CH[..., :3, 3] = np.einsum("tab,hta->htb", R_WC, result.joints[:, :, 0] - eye)
    posture = result.poses[..., 3:].reshape(*result.present.shape, 23, 3)
    roots = people.PersonState(result.present, T_CH, posture, result.betas)
    everyone = np.ones(len(result.present), bool)
    plain = people.as_body_keypoints(
        keypoints, roots, everyone, sequence.intrinsics, body, sequence.fps
    )
    camera = result.intrinsics[:4]
    for h in range(len(result.present)):
        local = body_.local_keypoints(
            body, jnp.asarray(posture[h]), jnp.asarray(result.betas[h])
        )
        p_C = np.einsum("tab,tkb->tka", T_CH[h, :, :3, :3], np.asarray(local))
        p_C = p_C + T_CH[h, :, None, :3, 3]
        uv = p_C[..., :2] / p_C[..., 2:] * camera[:2] + camera[2:]
        depth = T_CH[h, :, 2, 3][:, None]
        metres = depth / camera[:2].mean()
        sigma = people.keypoint_sigma(keypoints, sequence.intrinsics, h)
        away = np.linalg.norm(plain.uv[h] - uv, axis=-1) * metres
        hips = KEYPOINT_NAMES["body25"].index("mid_hip")
        moved = np.gradient(keypoints.uv[h] - keypoints.uv[h][:, [hips]], axis=0)
        sure = sigma <= KEYPOINT_SIGMA / SURE
        sure &= result.present[h][:, None]
        yield {
            "off": away / sigma,
            "sure": sure,
            "speed": np.linalg.norm(moved, axis=-1) * metres * sequence.fps,
            "away": away / stature(body, result.betas[h]),
        }


def _bodies(result: Result):
    from bodyslam_jax.types import Bodies

    shapes = np.repeat(result.betas[:, None], result.present.shape[1], axis=1)
    return Bodies(result.present, result.poses, shapes, result.trans)


def tell(name: str, found: list[dict]) -> None:
    """Prints a table: a line for each limb, columns by speed."""
    print(f"\n{name}")
    print("| limb | slow | medium | fast | tail | near, % | of fast, % | number |")
    print("|---|---|---|---|---|---|---|---|")
    names = KEYPOINT_NAMES["body25"]
    for part in PARTS:
        rows = [i for i, one in enumerate(names) if one.endswith(part)]
        pick = lambda key, rows=rows: np.concatenate(
            [one[key][:, rows][one["sure"][:, rows]] for one in found]
        )
        off, speed, away = pick("off"), pick("speed"), pick("away")
        if len(off) < 20:
            continue
        group = np.digitize(speed, SPEEDS)
        cell = lambda mask, off=off: (
            f"{np.median(off[mask]) / MEDIAN:.2f}" if mask.sum() > 19 else "–"
        )
        near = lambda mask, away=away: (
            f"{100 * np.mean(away[mask] < NEAR):.0f}" if mask.sum() > 19 else "–"
        )
        print(
            f"| {part} | {' | '.join(cell(group == g) for g in range(3))} | "
            f"{np.quantile(off, 0.95) / TAIL:.2f} | {near(group >= 0)} | "
            f"{near(group == 2)} | {len(off)} |",
            flush=True,
        )


def estimated(
    sequence: Sequence, cache: pipeline.Cache, config: Config = CONFIG
) -> list[dict]:
    sequence = pipeline.find_people(sequence, config, cache)
    result, _, used = run_stages(sequence, config, cache)
    return list(residuals(used, result))


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("videos", type=Path, nargs="*")
    parser.add_argument("--stages", type=Path)
    parser.add_argument("--rendered", nargs="*", default=[])
    parser.add_argument("--motion")
    parser.add_argument("--frames", type=int, default=120)
    options = parser.parse_args()
    stages: Path | None = options.stages
    rows = []
    for video in options.videos:
        cache = pipeline.Cache(stages and stages / f"{video.stem}-alone")
        rows += estimated(io.read_sequence(video), cache)
    if rows:
        tell(f"{len(options.videos)} videos", rows)
    rows = []
    for name in options.rendered:
        sequence, family = name.split("-")
        settings = Simulation(
            sequence=sequence,  # pyright: ignore
            family=family,  # pyright: ignore
            length=options.frames,
            motion=options.motion,
        )
        scene = simulation.simulate(filmed(settings))
        folder = (stages or Path("residuals_kept")) / f"{name}-{options.motion}"
        film = simulation.film_scene(folder / "film", scene)
        unseen = CONFIG.for_simulated_people()
        rows += estimated(io.read_sequence(film), pipeline.Cache(folder), unseen)
    if rows:
        tell(" ".join(options.rendered), rows)


if __name__ == "__main__":
    main()
