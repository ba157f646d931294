"""A run beside its ground truth: errors before and after the joint optimisation, true
paths and statures.

Before the joint optimisation the cameras of structure from motion have an arbitrary
scale; after it, everything is in metres.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from bodyslam_jax import evaluation
from bodyslam_jax.body import BodyModel, stature
from bodyslam_jax.body.skeleton import PELVIS
from bodyslam_jax.evaluation.association import associate_with_people
from bodyslam_jax.types import Result, SfmResult

CAMERAS_ALONE = "cameras alone, arbitrary scale"
JOINT_ESTIMATE = "joint estimate, in metres"
_SCALE_FREE_ERRORS = ("c_ate_sim3", "rpe_rotation")
"""Errors (each with its RMSE) that are defined for cameras of arbitrary scale."""
_HEADLINE_ERRORS = ("c_ate_se3", "c_ate_sim3", "h_ate_se3", "scale")


@dataclasses.dataclass(frozen=True)
class TruthBeside:
    """What is true, in the world of an estimate."""

    cameras: Float[np.ndarray, "c 3"]
    """Camera centres, m, by the rigid motion that aligns all of them best (pelvises
    without a true camera)."""
    pelvises: Float[np.ndarray, "h n 3"]
    """Pelvis joints of the people of both, m; NaN in frames without the person."""
    statures: dict[int, tuple[float, float]]
    """True and estimated stature (m) by person of the estimate, where the truth has a
    shape of this body model."""


def beside(result: Result, truth: Result, body: BodyModel) -> TruthBeside:
    """Returns the truth in the world of the result, on common frames.

    **Raises:** `InputError` if no frame of one is at the time of a frame of the other.
    """
    found, true, pairs, is_of_body = associate_with_people(result, truth, body)
    both = np.asarray(found.camera_valid & true.camera_valid)
    cameras = lambda side: np.asarray(side.T_WC)[:, :3, 3]
    pelvises = lambda side: np.asarray(side.joints)[:, :, PELVIS]
    present = np.asarray(true.present)
    if both.any():
        target, source, weights = cameras(found), cameras(true), both
    else:
        target, source = (pelvises(side).reshape(-1, 3) for side in (found, true))
        weights = (present & np.asarray(found.present)).reshape(-1)
    target, source, weights = (jnp.asarray(x, float) for x in (target, source, weights))
    to_result = evaluation.umeyama(target, source, weights)
    move = lambda x: np.asarray(to_result.apply(jnp.asarray(x)))
    statures = {}
    for mine, theirs in pairs if is_of_body else ():
        each = (truth.betas[theirs], result.betas[mine])
        statures[mine] = tuple(stature(body, betas) for betas in each)
    moved = np.where(present[..., None], move(pelvises(true)), np.nan)
    return TruthBeside(move(cameras(true))[both], moved, statures)


def errors(
    result: Result, cameras: SfmResult, truth: Result, body: BodyModel
) -> dict[str, dict[str, float | str]]:
    """Returns the errors of `bodyslam evaluate` before and after the joint
    optimisation.

    Cameras alone, if they moved, have the errors that need neither scale nor people;
    the others are replaced by text on what is missing. Errors after the optimisation
    are left out if there are no people and the cameras alone have errors.
    """
    after = evaluation.evaluate(result, truth, body)
    found: dict[str, dict[str, float | str]] = {}
    # The people stay the same, so that the same compiled program is used.
    unscaled = dataclasses.replace(result, T_WC=cameras.T_WC)
    before = evaluation.evaluate(unscaled, truth, body)
    if cameras.kind == "moving" and np.isfinite(before["c_ate_sim3"]):
        found[CAMERAS_ALONE] = {
            key: "no people" if key in after.people else "no scale" for key in after
        }
        for name in _SCALE_FREE_ERRORS:
            for key in (name, f"{name}_rmse"):
                found[CAMERAS_ALONE][key] = float(before[key])
    if result.present.any() or CAMERAS_ALONE not in found:
        found[JOINT_ESTIMATE] = {k: float(v) for k, v in after.items()}
    return found


def headline(
    errors: dict[str, dict[str, float | str]], truth: TruthBeside | None = None
) -> list[str]:
    """Returns the main errors, as a line for each entry of `errors`; the statures; and
    how far off lengths would be by the height alone, which a user can give."""
    lines = []
    for name, found in errors.items():
        parts = [
            f"{label} {factor * value:.4g} {unit}".rstrip()
            for key, label, unit, factor in evaluation.ROWS
            if key in _HEADLINE_ERRORS
            and isinstance(value := found.get(key), float)
            and np.isfinite(value)
        ]
        if parts:
            lines.append(f"error of {name}: {'; '.join(parts)}")
    return lines + (sizes(errors, truth) if truth else [])


def sizes(errors: dict[str, dict[str, float | str]], truth: TruthBeside) -> list[str]:
    """Returns, for each person, a line with both statures, and a line with the error of
    lengths and what it would be if the stature had been given."""
    lines = []
    scale = errors.get(JOINT_ESTIMATE, {}).get("scale")
    for person, (true, found) in truth.statures.items():
        lines.append(
            f"person {person}: {100 * found:.0f} cm, in truth {100 * true:.0f} cm"
        )
        if isinstance(scale, float) and np.isfinite(scale):
            by_height = scale * found / true
            lines.append(
                f"lengths are off by {_off(scale)}; by the height alone "
                f"(--height {true:.2f}) they would be by {_off(by_height)}"
            )
    return lines


def _off(scale: float) -> str:
    """Returns the error of lengths whose best factor is `scale`, as text."""
    return f"{100 * (1 / scale - 1):+.1f} %"
