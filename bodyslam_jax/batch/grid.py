"""Parses the axes of a sweep, `NAME=VALUE,VALUE,...`, and generates the points of the
grid.

`scale` multiplies the map that the joint solve starts from; `weights.TERM` is λ of a
term of the cost, named as by `bs.weights`. The points of these two have the same shapes
and are solved by one compiled program. Any other name is a setting (`structure.x`,
`weights.pixel_sigma`), for each of whose values a problem is built.
"""

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence

from bodyslam_jax.config import Config, field_names, with_values
from bodyslam_jax.config.errors import InputError

SCALE = "scale"
_WEIGHTS_PREFIX = "weights."


@dataclasses.dataclass(frozen=True)
class Axis:
    """A quantity and its values."""

    name: str
    values: tuple[str, ...]
    is_setting: bool

    @property
    def term(self) -> str | None:
        """Name of the cost term whose λ the axis varies, else `None`."""
        return (
            None if self.is_setting else self.name.partition(_WEIGHTS_PREFIX)[2] or None
        )


def parse_axes(texts: Sequence[str], config: Config = Config()) -> list[Axis]:
    """Parses axes such as `weights.human_motion=10,100`.

    **Raises:** `InputError` for an unknown name, an impossible value, or a repeated
    axis.
    """
    if not texts:
        raise InputError("--grid: found none, expected NAME=VALUE,VALUE,...")
    settings = set(field_names(config))
    axes: list[Axis] = []
    for text in texts:
        name, sign, listed = text.partition("=")
        name = name.strip().replace("-", "_")
        values = tuple(value.strip() for value in listed.split(",") if value.strip())
        if not sign or not values:
            raise InputError(f"--grid {text}: expected NAME=VALUE,VALUE,...")
        if name in (axis.name for axis in axes):
            raise InputError(f"--grid {name}: given twice.")
        is_weight = name.startswith(_WEIGHTS_PREFIX) and name not in settings
        axis = Axis(name, values, is_setting=not is_weight and name != SCALE)
        for value in values:
            _check(axis, value, config)
        axes.append(axis)
    return axes


def _check(axis: Axis, value: str, config: Config) -> None:
    if axis.is_setting:
        try:
            with_values(config, {axis.name: value.split()})
        except ValueError as error:
            raise InputError(f"--grid {axis.name}={value}: {error}") from None
        return
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if not 0 < number < math.inf:
        raise InputError(
            f"--grid {axis.name}: found {value!r}, expected a number above 0."
        )


def settings_points(axes: Sequence[Axis]) -> list[dict[str, str]]:
    """Returns all combinations of values of settings."""
    return _product([axis for axis in axes if axis.is_setting])


def mapped_points(axes: Sequence[Axis]) -> list[dict[str, float]]:
    """Returns all combinations of scale and weights."""
    found = _product([axis for axis in axes if not axis.is_setting])
    return [{name: float(value) for name, value in point.items()} for point in found]


def at_point(config: Config, point: Mapping[str, str]) -> Config:
    """Returns the settings at a point of `settings_points`."""
    return with_values(config, {name: value.split() for name, value in point.items()})


def _product(axes: Sequence[Axis]) -> list[dict[str, str]]:
    names = [axis.name for axis in axes]
    return [
        dict(zip(names, values, strict=True))
        for values in itertools.product(*(axis.values for axis in axes))
    ]
