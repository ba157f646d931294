"""A measured stature as information on a person's shape and distance."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bodyslam_jax.body import BodyModel
from bodyslam_jax.config import Measured
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.people.person_state import PersonState

_UP = 1


class LinearStature(NamedTuple):
    """Height of the mesh at rest, m, as `template + slope · β`."""

    template: float
    slope: Float[np.ndarray, " 10"]


def linear_stature(body: BodyModel) -> LinearStature:
    """From the highest vertex of the mean shape to the lowest."""
    up = np.asarray(body.template, np.float64)[:, _UP]
    by_shape = np.asarray(body.shape_dirs, np.float64)[:, _UP]
    top, bottom = int(np.argmax(up)), int(np.argmin(up))
    return LinearStature(float(up[top] - up[bottom]), by_shape[top] - by_shape[bottom])


def statures_of(
    heights: Mapping[int | None, Measured], numbers: Sequence[int]
) -> dict[int, Measured]:
    """Statures by index among the people with these `numbers`; that under the key
    `None` applies to everybody without one of their own.

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


def with_statures(
    roots: PersonState,
    statures: Mapping[int, Measured],
    body: BodyModel,
    shape_sigma: Float[np.ndarray, " h"],
) -> PersonState:
    """The most probable shapes given the statures, people as large in the image.

    β has the standard deviation `shape_sigma` about its estimate in every component, so
    that β moves along the slope g of the stature by `σ_β² (h̃ - h) / (σ_β² |g|² + σ²)`.
    Distances from the camera change in the ratio of the statures.
    """
    linear = linear_stature(body)
    shape, T_CH = roots.shape.copy(), roots.T_CH.copy()
    for h, measured in statures.items():
        variance = shape_sigma[h] ** 2
        before = linear.template + linear.slope @ shape[h]
        gain = variance / (variance * linear.slope @ linear.slope + measured.sigma**2)
        shape[h] += gain * (measured.value - before) * linear.slope
        after = linear.template + linear.slope @ shape[h]
        T_CH[h, roots.present[h], :3, 3] *= after / before
    return dataclasses.replace(roots, shape=shape, T_CH=T_CH)
