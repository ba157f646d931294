"""Precision and recall of the contact network and of a rule by height and speed."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from bodyslam_jax.body import BodyModel, keypoints, rest_joints
from bodyslam_jax.body.skeleton import BODY25_TOES_AND_HEELS
from bodyslam_jax.geometry import so3
from bodyslam_jax.motion.capture.clips import FPS, Clip, resample
from bodyslam_jax.motion.capture.retarget import place
from bodyslam_jax.motion.contact_network import ContactModel, predict_contact
from bodyslam_jax.motion.prediction import in_dtype, leg_length
from bodyslam_jax.motion.training.contact import standing_points
from bodyslam_jax.motion.training.evaluation import disturbed

_FOOT_POINTS = np.array(BODY25_TOES_AND_HEELS)


def judge_contact(
    model: ContactModel,
    body: BodyModel,
    dataset: Sequence[Clip],
    drift_deg: float = 0.0,
    *,
    root_drift: float = 0.5,
    seed: int = 0,
) -> dict[str, float]:
    """Evaluates a contact network on clips whose postures have errors as in training.

    The standard deviation of slow errors is `drift_deg` per joint axis (1.5 times that
    at hands and feet), that of white noise 0.4 degrees; errors of the root's
    orientation are multiplied by `root_drift`.

    Returns `precision` and `recall` of points with a probability above one half,
    `share` (of points in contact), `probability` (mean) and `slip`: root mean square
    speed, in the exact motion, of the points classified as in contact, leg lengths per
    second. `rule_precision`, `rule_recall` and `rule_slip` are those of the rule of
    `contact_labels`, applied to the same postures and the exact path of the pelvis.
    """
    clips = resample([clip for clip in dataset if clip.phase == 0], FPS)
    trials = place(body, clips)
    counts = [len(trial.trans) for trial in trials]
    length = -(-max(counts) // 64) * 64
    pad = lambda x: np.concatenate([x, np.repeat(x[-1:], length - len(x), axis=0)])
    stack = lambda arrays: jnp.asarray(np.stack(arrays), jnp.float32)
    poses = stack([pad(trial.clip.poses) for trial in trials])
    trans = stack([pad(trial.trans) for trial in trials])
    shape = stack([trial.shape for trial in trials])
    present = np.arange(length) < np.array(counts)[:, None]
    body, model = in_dtype(body, jnp.float32), in_dtype(model, jnp.float32)
    seen = poses
    if drift_deg > 0:
        sigma, white = np.deg2rad(drift_deg), np.deg2rad(0.4)
        keys = jax.random.split(jax.random.key(seed), len(trials))
        seen = disturbed(
            poses, keys, *(jnp.float32(x) for x in (sigma, white, root_drift))
        )
    exact = np.asarray(_points(body, poses, trans, shape))
    noisy = np.asarray(_points(body, seen, trans, shape))
    guess = np.asarray(_contacts(model, body, seen, shape, jnp.asarray(present)))
    rows = lambda x: np.concatenate([a[:n] for a, n in zip(x, counts, strict=True)])
    label = lambda points: np.concatenate(
        [standing_points(p[:n], FPS) for p, n in zip(points, counts, strict=True)]
    )
    true, rule, guess = label(exact), label(noisy), rows(guess)
    speed = rows(np.linalg.norm(np.gradient(exact, axis=1), axis=-1) * FPS)
    found = {"share": float(true.mean()), "probability": float(guess.mean())}
    for name, stands in (("", guess > 0.5), ("rule_", rule)):
        hits = np.count_nonzero(stands & true)
        found[f"{name}precision"] = hits / max(np.count_nonzero(stands), 1)
        found[f"{name}recall"] = hits / max(np.count_nonzero(true), 1)
        slip = speed[stands]
        found[f"{name}slip"] = float(np.sqrt((slip**2).mean())) if slip.size else np.nan
    return found


@eqx.filter_jit
def _points(
    body: BodyModel,
    poses: Float[Array, "c t 24 3"],
    trans: Float[Array, "c t 3"],
    shape: Float[Array, "c 10"],
) -> Float[Array, "c t 4 3"]:
    """Returns positions of toes and heels, leg lengths."""
    shift = trans - rest_joints(body, shape)[:, None, 0]
    flat = poses.reshape(*poses.shape[:2], 72)
    points = keypoints(body, flat, shape[:, None], shift)[..., _FOOT_POINTS, :]
    return points / leg_length(body, shape)[:, None, None, None]


@eqx.filter_jit
def _contacts(
    model: ContactModel,
    body: BodyModel,
    poses: Float[Array, "c t 24 3"],
    shape: Float[Array, "c 10"],
    present: Bool[Array, "c t"],
) -> Float[Array, "c t 4"]:
    """Returns the predicted contact probabilities of all clips."""
    one = lambda p, s, there: predict_contact(
        model, body, so3.exp(p[:, 0]), p[:, 1:], s, there
    )
    return jax.vmap(one)(poses, shape, present)
