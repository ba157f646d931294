"""Errors of detected keypoints by confidence, from rendered people.

    python benchmarks/keypoint_noise.py FOLDER [FOLDER ...]

Each `FOLDER` has `*/film` and `*/pixels/detection-*.npz`, as `figures_by_sequence.py
measure --inputs pixels --keep` leaves them. An error is a keypoint, after what the
detector calls a joint is taken out, minus the true projection, m at the true depth. By
maximum likelihood it has Student's distribution in two dimensions, whose scale falls
with the confidence (its logarithm is piecewise linear); four frames and two coordinates
count once. The ratio of the median error to the claim's is of people who were left out
(four folds), beside today's (`people.keypoint_sigma`, normal).
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize
from scipy.special import gammaln

from bodyslam_jax import body as body_
from bodyslam_jax import evaluation, io, people
from bodyslam_jax.body import BODY25
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.people.found import _WRIST_POWER
from bodyslam_jax.types import Keypoints

KNOTS = np.array([0.0, 0.1, 0.2, 0.5, 0.8, 1.0])
"""Confidences of `found.confidence`; of feet relative to the greatest, 0.6."""
PARTS = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle", "big_toe", "heel")
FOOT = 0.6
ALIKE = 9.0
"""Measurements of which one counts."""
FOLDS = 4


def errors(run: Path, body: body_.BodyModel) -> list[dict[str, np.ndarray]]:
    """For each person of a film: `error` (m), `confidence` and `claim` (m), each of all
    frames and keypoints."""
    sequence = io.read_sequence(run / "film")
    truth = evaluation.read_groundtruth(run / "film", body)
    (file,) = (run / "pixels").glob("detection-*.npz")
    with np.load(file) as found:
        frame, points, who = (found[f".{n}"] for n in ("frame", "points", "person"))
    shape = who.max() + 1, sequence.num_frames, 25
    seen = np.zeros((*shape, 3))
    seen[who[who >= 0], frame[who >= 0]] = points[who >= 0]
    focal, centre = np.split(np.asarray(sequence.intrinsics.params[:4]), 2)
    R_CW = np.swapaxes(truth.T_WC[:, :3, :3], 1, 2)
    rows = []
    for pose, shape, joints in zip(truth.poses, truth.betas, truth.joints):
        posture = pose[:, 3:].reshape(-1, 23, 3)
        local = body_.local_keypoints(body, jnp.asarray(posture), jnp.asarray(shape))
        T_CH = np.tile(np.eye(4), (1, len(pose), 1, 1))
        T_CH[0, :, :3, :3] = R_CW @ so3.exp(pose[:, :3])
        off = joints[:, 0] - truth.T_WC[:, :3, 3]
        T_CH[0, :, :3, 3] = np.einsum("tab,tb->ta", R_CW, off)
        p_C = np.einsum("tab,tkb->tka", T_CH[0, :, :3, :3], np.asarray(local))
        p_C = p_C + T_CH[0, :, None, :3, 3]
        exact = p_C[..., :2] / p_C[..., 2:] * focal + centre
        away = np.linalg.norm(seen[..., :2] - exact, axis=-1)
        away = np.ma.median(np.ma.masked_array(away, seen[..., 2] <= 0), axis=-1)
        away = away.filled(np.inf)
        near = away.min(axis=0) < 0.25 * np.ptp(exact[..., 1], axis=1)
        own = seen[away.argmin(axis=0), np.arange(len(pose))]
        size = np.array([sequence.intrinsics.width, sequence.intrinsics.height])
        inside = ((exact > 0) & (exact < size)).all(-1)
        sure = np.where(near[:, None] & inside, own[..., 2], 0.0)
        keypoints = Keypoints(own[None, ..., :2], sure[None], "movenet-blazepose")
        roots = people.PersonState(
            np.ones((1, len(pose)), bool), T_CH, posture[None], shape[None]
        )
        nobody = np.zeros(1, bool)
        plain = people.as_body_keypoints(
            keypoints, roots, nobody, sequence.intrinsics, body, sequence.fps
        )
        error = (plain.uv[0] - exact) * p_C[..., 2:] / focal.mean()
        claim = people.keypoint_sigma(keypoints, sequence.intrinsics, 0)
        rows.append({"error": error, "confidence": sure, "claim": claim})
    return rows


def fitted(error: np.ndarray, sure: np.ndarray) -> np.ndarray:
    """The logarithms of the scales at `KNOTS`, and of the degrees of freedom."""
    squared = np.sum(error**2, axis=1)

    def minus(x):
        scale, nu = np.interp(sure, KNOTS, x[:-1]), np.exp(x[-1])
        value = gammaln(nu / 2 + 1) - gammaln(nu / 2) - np.log(nu * np.pi) - 2 * scale
        value -= (nu / 2 + 1) * np.log1p(squared / nu * np.exp(-2 * scale))
        rises = np.maximum(np.diff(x[:-1]), 0)
        bends = np.diff(x[:-1], 2)
        prior = 2 * bends @ bends + 1e3 * rises @ rises + 0.5 * (x[-1] - 1) ** 2
        return prior - value.sum() / ALIKE

    start = np.append(np.linspace(-2, -4, len(KNOTS)), 0.7)
    bounds = [(-6.0, 0.0)] * len(KNOTS) + [(-1.0, 3.0)]
    return minimize(minus, start, method="L-BFGS-B", bounds=bounds).x


def ratio(x: np.ndarray, error: np.ndarray, sure: np.ndarray) -> np.ndarray:
    """Errors over the median that the claim has."""
    nu = np.exp(x[-1])
    middle = np.exp(np.interp(sure, KNOTS, x[:-1])) * np.sqrt(nu * (2 ** (2 / nu) - 1))
    return np.linalg.norm(error, axis=1) / middle


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folders", type=Path, nargs="+")
    body = body_.load_body_model()
    films = [
        (run.name[:2], errors(run, body))
        for folder in parser.parse_args().folders
        for run in sorted(folder.iterdir())
    ]
    print(f"| | scale, mm, at {KNOTS} | nu | left out | today | number |")
    for part in PARTS:
        columns = [BODY25[f"{side}_{part}"] for side in ("left", "right")]
        everyone = [(name, one) for name, some in films for one in some]
        pick = lambda key, one, c=columns: one[key][:, c][one["confidence"][:, c] > 0]
        error, sure, claim = (
            np.concatenate([pick(key, one) for _, one in everyone])
            for key in ("error", "confidence", "claim")
        )
        who = [[name] * len(pick("claim", one)) for name, one in everyone]
        who = np.concatenate(who)
        if part == "wrist":
            sure = sure ** (1 / _WRIST_POWER)
        if part in ("big_toe", "heel"):
            sure = np.minimum(sure / FOOT, 1.0)
        x, out = fitted(error, sure), []
        for fold in range(FOLDS):
            test = np.isin(who, np.unique(who)[fold::FOLDS])
            out.append(
                ratio(fitted(error[~test], sure[~test]), error[test], sure[test])
            )
        now = np.linalg.norm(error, axis=1)[np.isfinite(claim)] / 1.1774
        now = np.median(now / claim[np.isfinite(claim)])
        scales = " ".join(f"{1e3 * np.exp(v):.0f}" for v in x[:-1])
        print(
            f"| {part} | {scales} | {np.exp(x[-1]):.1f} | "
            f"{np.median(np.concatenate(out)):.2f} | {now:.2f} | {len(error)} |"
        )


if __name__ == "__main__":
    main()
