"""Checks of factors' weights: robust losses, dtype, the mask of free variables, and
frames without a preceding measurement."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from bodyslam_jax.geometry.lengths import is_traced
from bodyslam_jax.graph.factor import Factor
from bodyslam_jax.graph.factors.body_pose_prior import BodyPosePrior
from bodyslam_jax.graph.factors.foot_contact import FootContact
from bodyslam_jax.graph.factors.human_motion import HumanMotion
from bodyslam_jax.graph.factors.root_orientation import RootOrientation
from bodyslam_jax.graph.factors.root_position_prior import RootPositionPrior
from bodyslam_jax.graph.factors.root_smoothness import (
    AngularAccelerationPrior,
    RootSmoothness,
)
from bodyslam_jax.graph.losses import Loss
from bodyslam_jax.graph.state import State, Step

_FIRST_FRAMES = (
    (HumanMotion, "whitening", 1, 0.0),
    # In frame 1, too: frame 0 has no prediction whose error could be correlated.
    (HumanMotion, "correlation", 2, 0.0),
    (BodyPosePrior, "correlation", 1, 0.0),
    (RootOrientation, "correlation", 1, 0.0),
    (RootPositionPrior, "correlation", 1, 0.0),
    (FootContact, "sigma", 1, np.inf),
    (RootSmoothness, "sigma", 2, np.inf),
    (AngularAccelerationPrior, "sigma", 2, np.inf),
)
"""Factor, field, number of first frames that depend on frames before frame 0, and the
value the field must have there, so that they have no weight. Windows of frames repeat
frame 0 in place of the missing frames, which would otherwise count as a measurement."""


def check_precision(factor: Factor, state: State) -> None:
    """Refuses measurements of a higher floating-point precision than the state's.

    They would promote residuals, and with them the solve, to that precision.

    **Raises:** `ValueError` that says where, what was found and what was expected.
    """
    most = state.scale.dtype
    for path, leaf in jax.tree_util.tree_leaves_with_path(factor):
        if not eqx.is_inexact_array(leaf) or getattr(leaf, "weak_type", False):
            continue
        if jnp.finfo(leaf.dtype).bits > jnp.finfo(most).bits:
            where = type(factor).__name__ + jax.tree_util.keystr(path)
            raise ValueError(
                f"{where}: found {leaf.dtype}, expected {most} as in state."
            )


def check_mask(free: Step) -> None:
    """Refuses a mask with values other than 1 (free) and 0 (held).

    **Raises:** `ValueError` that says where, and what was found.
    """
    for name, value in vars(free).items():
        if is_traced(value):
            continue
        values = np.asarray(value)
        other = values[(values != 0) & (values != 1)]
        if len(other):
            raise ValueError(f"free.{name}: found {other[0]}, expected 0 or 1.")


def check_loss(loss: Any, where: str) -> None:
    """Refuses a `loss` that is not a `Loss`, or whose scale is not positive and finite.

    **Raises:** `ValueError` that says where, what was found and what was expected.
    """
    if not isinstance(loss, Loss):
        raise ValueError(
            f"{where}: found {loss!r:.60}, expected a loss such as `Squared()`."
        )
    scale = getattr(loss, "scale", 1.0)
    if is_traced(scale):
        return
    values = np.asarray(scale)
    if not np.issubdtype(values.dtype, np.number):
        raise ValueError(f"{where}.scale: found {scale!r:.40}, expected a number.")
    if not np.isfinite(values).all():
        raise ValueError(f"{where}.scale: found {scale}, which is not finite.")
    if not (values > 0).all():
        raise ValueError(f"{where}.scale: found {values.min()}, expected above 0.")


def check_first_frames(factor: Factor, name: str) -> None:
    """Refuses weights in first frames whose residual depends on frames before frame 0.

    **Raises:** `ValueError` that says where, what was found and what was expected.
    """
    for kind, field, count, empty in _FIRST_FRAMES:
        value = getattr(factor, field, None)
        # Subclasses are not checked: their residuals may depend on other frames.
        if type(factor) is not kind or is_traced(value):
            continue
        values = np.asarray(value)
        first = values[:, :count] if factor.of_people else values[:count]
        other = first[first != empty]
        if len(other):
            frames = "frame 0" if count == 1 else f"frames 0 to {count - 1}"
            raise ValueError(
                f"{name}.{field}: found {other[0]} within {frames}, expected {empty}: "
                "there is no earlier frame."
            )


def check_correlation(factor: Factor, name: str) -> None:
    """Refuses an AR(1) correlation with a preceding frame that has no measurement.

    The residual `e_k - ρ e_{k-1}` would use the placeholder stored in frame k-1 as a
    measurement; ρ must be 0 in frame k.

    **Raises:** `ValueError` that says where, what was found and what was expected.
    """
    if isinstance(factor, HumanMotion):
        weight, is_measured = factor.whitening, lambda x: (x != 0).any(axis=(-1, -2))
    elif isinstance(factor, RootOrientation | RootPositionPrior):
        weight, is_measured = factor.sigma, np.isfinite
    else:
        return
    if is_traced((weight, factor.correlation)):
        return
    measured: np.ndarray = np.asarray(is_measured(np.asarray(weight)))
    measured = np.any(measured.reshape(*measured.shape[:2], -1), axis=-1)
    correlated = np.asarray(factor.correlation)[:, 1:] != 0
    wrong = np.argwhere(correlated & measured[:, 1:] & ~measured[:, :-1])
    if len(wrong):
        person, frame = wrong[0]
        raise ValueError(
            f"{name}.correlation: found {factor.correlation[person, frame + 1]} in "
            f"frame {frame + 1} of person {person}, expected 0.0: the frame before is "
            "not measured (`graph.ar1_correlation`)."
        )
