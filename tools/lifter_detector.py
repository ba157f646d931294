"""Errors of the detector that ships, on top of `simulation.NOISE`, for `train_lifter`.

Found on rendered people (`benchmarks/keypoints.md`): arms and legs behind the body are
put on the nearer ones for some tenths of a second, legs that cross in the image are
exchanged, and heels, toes, knees and elbows scatter more than annotators do.
"""

import numpy as np
from jaxtyping import Float

from bodyslam_jax.body import BODY25
from bodyslam_jax.simulation.sensor_noise import ar1

_SPREAD = {"knee": 0.012, "elbow": 0.010, "wrist": 0.010, "big_toe": 0.025}
_SPREAD |= {"small_toe": 0.025, "heel": 0.022}
"""Standard deviation of the additional error, of the person's height in the image."""
_CONFIDENCE = {"big_toe": 0.55, "small_toe": 0.55, "heel": 0.55, "wrist": 0.85}
_CORRELATION = 0.75
"""Of these errors from one frame to the next, at 30 frames a second."""
_EPISODE = 8
"""Frames for which a limb stays on the other one."""
_SIDES = ("left", "right")


def add_errors(
    uv: Float[np.ndarray, "t 25 2"],
    confidence: Float[np.ndarray, "t 25"],
    p_C: Float[np.ndarray, "t 25 3"],
    rng: np.random.Generator,
) -> tuple[Float[np.ndarray, "t 25 2"], Float[np.ndarray, "t 25"]]:
    """Keypoints of the person whose true ones are `p_C`, as this detector sees them."""
    uv, confidence = uv.copy(), confidence.copy()
    detected = confidence > 0
    height = np.median(np.ptp(np.where(detected[..., None], uv, np.nan), axis=1)[:, 1])
    if not np.isfinite(height):
        return uv, confidence
    size = height * np.exp(0.3 * rng.standard_normal())
    for name, sigma in _SPREAD.items():
        for side in _SIDES:
            k = BODY25[f"{side}_{name}"]
            uv[:, k] += sigma * size * ar1(rng, (len(uv), 2), _CORRELATION)
            confidence[:, k] *= _CONFIDENCE.get(name, 1.0)
    middle = p_C[:, BODY25["mid_hip"], 2]
    for far, near in (_SIDES, _SIDES[::-1]):
        behind = p_C[:, BODY25[f"{far}_elbow"], 2] > middle + 0.05
        moved = behind & _episodes(len(uv), 0.35, rng)
        share = rng.uniform(0.5, 1.1)
        for name in ("wrist",) if rng.random() < 0.5 else ("elbow", "wrist"):
            a, b = BODY25[f"{far}_{name}"], BODY25[f"{near}_{name}"]
            at = moved & detected[:, a] & detected[:, b]
            uv[at, a] += share * (uv[at, b] - uv[at, a])
            confidence[at, a] *= rng.uniform(0.4, 1.0)
    knees = uv[:, BODY25["left_knee"]] - uv[:, BODY25["right_knee"]]
    crossing = np.linalg.norm(knees, axis=1) < 0.06 * height
    exchanged = crossing & _episodes(len(uv), 0.3, rng)
    for name in ("knee", "ankle", "heel", "big_toe", "small_toe"):
        a, b = (BODY25[f"{side}_{name}"] for side in _SIDES)
        at = exchanged & detected[:, a] & detected[:, b]
        uv[at, a], uv[at, b] = uv[at, b].copy(), uv[at, a].copy()
    return uv, confidence


def _episodes(
    frames: int, share: float, rng: np.random.Generator
) -> Float[np.ndarray, " t"]:
    """Runs of `_EPISODE` frames that are a `share` of all."""
    chosen = rng.random(frames // _EPISODE + 2) < share
    return np.repeat(chosen, _EPISODE)[rng.integers(_EPISODE) :][:frames]
