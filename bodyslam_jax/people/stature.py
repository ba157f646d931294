"""Uses a measured stature as information on a person's shape and distance."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bodyslam_jax.body import BodyModel
from bodyslam_jax.config import Measured
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.people.person_state import PersonState

_UP_AXIS = 1
MAX_SHAPE_SIGMAS = 3.0
"""Standard deviations of β within which a model represents people: 99.7 % of those it
was made from. Beyond, proportions are extrapolated: the default body's legs are 0.48 of
a stature of 1.70 m and 0.40 of one of 1.08 m."""
SIZE_STEP = 0.01
"""Relative size of a body for one unit of a size axis. The prior on β (sigma 0.4) then
holds the size of people of unknown stature to 0.4 %."""
JOINT_SIGMA_M = 0.02
"""Error of joints at rest that counts as much as one standard deviation of β."""


class LinearStature(NamedTuple):
    """Height of the mesh at rest, m, as `template + slope · β`."""

    template: float
    slope: Float[np.ndarray, " 10"]


def linear_stature(body: BodyModel) -> LinearStature:
    """Returns the height as a linear function of β, between the highest and the lowest
    vertex of the mean shape."""
    up = np.asarray(body.template, np.float64)[:, _UP_AXIS]
    by_shape = np.asarray(body.shape_dirs, np.float64)[:, _UP_AXIS]
    top, bottom = int(np.argmax(up)), int(np.argmin(up))
    return LinearStature(float(up[top] - up[bottom]), by_shape[top] - by_shape[bottom])


def statures_of(
    heights: Mapping[int | None, Measured], numbers: Sequence[int]
) -> dict[int, Measured]:
    """Returns the statures by index among the people with these `numbers`; that under
    the key `None` applies to everybody without one of their own.

    **Raises:** `InputError` if a stature is given for a number that nobody has.
    """
    beyond = [h for h in heights if h is not None and h not in numbers]
    if beyond and len(numbers):
        raise InputError(
            f"height: given for person {beyond[0]}, expected one of "
            f"{', '.join(map(str, numbers))}."
        )
    found = [heights.get(number, heights.get(None)) for number in numbers]
    return {h: height for h, height in enumerate(found) if height is not None}


def stature_range(body: BodyModel) -> tuple[float, float]:
    """Returns the least and the greatest stature, m, of shapes within
    `MAX_SHAPE_SIGMAS` standard deviations of the mean shape."""
    linear = linear_stature(body)
    slope = linear.slope[: 9 if body.sized else 10]
    way = MAX_SHAPE_SIGMAS * float(np.linalg.norm(slope))
    return linear.template - way, linear.template + way


def beyond_reach(body: BodyModel, height: float) -> bool:
    """Returns whether no shape within that range is `height` tall, m."""
    low, high = stature_range(body)
    return not low <= height <= high


def with_size_axis(body: BodyModel) -> BodyModel:
    """Returns the model with its last shape component replaced by its size.

    One unit of β₉ is `SIZE_STEP` of the mean shape's size, about the origin of the
    model, so that a body of any stature keeps the proportions of one within the
    model's reach: `s (T + S β)` has the shape `(s β₀, ..., s β₈, (s - 1) / SIZE_STEP)`.
    """
    sized = lambda dirs, mean: dirs.at[..., -1].set(SIZE_STEP * mean)
    return dataclasses.replace(
        body,
        shape_dirs=sized(body.shape_dirs, body.template),
        joint_shape_dirs=sized(body.joint_shape_dirs, body.joint_template),
        sized=True,
    )


def with_statures(
    roots: PersonState,
    statures: Mapping[int, Measured],
    body: BodyModel,
    shape_sigma: Float[np.ndarray, " h"],
) -> PersonState:
    """Returns the most probable shapes given the statures, with distances changed so
    that people keep their size in the image.

    β has the standard deviation `shape_sigma` about its estimate in every component, so
    that β moves along the slope g of the stature by `V (h̃ - h) / (V + σ²)` in m, with
    the variance V = σ_β² |g|², or the squared difference if that is larger: a fact that
    contradicts the estimate shows that the estimate is wrong, but not by how much. With
    a model that has a size axis, the body is resized instead if no shape within the
    model's range has the stature. Distances from the camera change in the ratio of the
    statures.
    """
    linear = linear_stature(body)
    shape, T_CH = roots.shape.copy(), roots.T_CH.copy()
    slope = linear.slope.copy()
    if body.sized:
        shape[:, -1] = slope[-1] = 0.0
    for h, measured in statures.items():
        before = linear.template + slope @ shape[h]
        apart = measured.value - before
        variance = max(shape_sigma[h] ** 2 * float(slope @ slope), apart**2)
        after = before + variance / (variance + measured.sigma**2) * apart
        if body.sized and beyond_reach(body, measured.value):
            shape[h] *= after / before
            shape[h, -1] = (after / before - 1) / SIZE_STEP
        else:
            shape[h] += (after - before) / (slope @ slope) * slope
        T_CH[h, roots.present[h], :3, 3] *= after / before
    return dataclasses.replace(roots, shape=shape, T_CH=T_CH)


@dataclasses.dataclass(frozen=True)
class WithoutStature:
    """Estimate of a person's stature without the given one."""

    value: float
    """Stature, m."""
    sigma: float
    """Standard deviation, m."""


def stature_without(
    body: BodyModel,
    given: Measured,
    shape: Float[np.ndarray, " 10"],
    covariance: Float[np.ndarray, "10 10"],
    prior: tuple[Float[np.ndarray, " 10"], float],
    before: Float[np.ndarray, " 10"],
    before_sigma: float,
) -> WithoutStature:
    """Returns the stature without the given one, computed from the estimate with it.

    The factor of the stature and the resulting displacement of the shape prior are
    removed from the posterior of β in information form, which is exact for Gaussian
    factors and needs no further solve. A size axis is held at 0, because without a
    stature nobody is resized.

    Args:
        body: model of the estimate.
        given: the given stature.
        shape: β at the optimum, with its marginal `covariance`.
        prior: mean and standard deviation of the prior on β in the estimate.
        before: mean of the prior if no stature had been given.
        before_sigma: standard deviation of the stature of `before`, m; if it exceeds
            that of the prior, it is reported instead.
    """
    linear, (mean, sigma) = linear_stature(body), prior
    g = linear.slope
    weight = sigma**-2.0
    information = np.linalg.inv(covariance)
    moment = information @ shape - weight * (mean - before)
    moment -= g * (given.value - linear.template) / given.sigma**2
    information -= np.outer(g, g) / given.sigma**2
    own = slice(0, len(g) - 1) if body.sized else slice(None)
    g = g[own]
    free = np.linalg.inv(information[own, own])
    variance = float(g @ free @ g)
    # An error of `before` along g propagates with the prior's share in the estimate.
    more = max(before_sigma**2 - float(g @ g) / weight, 0.0)
    kept = variance * weight / float(g @ g)
    return WithoutStature(
        linear.template + float(g @ free @ moment[own]),
        float(np.sqrt(variance + more * kept**2)),
    )


def in_model(
    sized: BodyModel, body: BodyModel, shape: Float[np.ndarray, " 10"]
) -> Float[np.ndarray, " 10"]:
    """Returns the shape of `body` that is as tall as `shape` of the model with a size
    axis, and nearest to its joints at rest.

    Ends of bones are fitted by least squares, with the stature as a constraint and a
    standard normal prior on β at an error of `JOINT_SIGMA_M`.
    """
    wanted = np.asarray(sized.joint_template, float) + (
        np.asarray(sized.joint_shape_dirs, float) @ shape
    )
    template = np.asarray(body.joint_template, float)
    dirs = np.asarray(body.joint_shape_dirs, float)
    # Relative to the pelvis, whose position is set by `trans`.
    A = (dirs - dirs[:1]).reshape(-1, 10) / JOINT_SIGMA_M
    b = ((wanted - wanted[:1]) - (template - template[:1])).ravel() / JOINT_SIGMA_M
    of_sized, of_body = linear_stature(sized), linear_stature(body)
    tall = of_sized.template + of_sized.slope @ shape - of_body.template
    system = np.zeros((11, 11))
    system[:10, :10] = A.T @ A + np.eye(10)
    system[:10, 10] = system[10, :10] = of_body.slope
    return np.linalg.solve(system, np.append(A.T @ b, tall))[:10]
