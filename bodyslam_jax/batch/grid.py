"""The axes of a sweep, `NAME=VALUE,VALUE,...`, and the points of their grid.

`scale` multiplies the map that the joint solve starts from; `weights.TERM` is λ of a
term of the cost, named as by `bs.weights`. The points of these two have the same shapes
and are solved by one compiled program. Any other name is a setting (`structure.x`,
`weights.pixel_sigma`), for each of whose values a problem is made anew.
"""

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence

from bodyslam_jax.config import Config, field_names, with_values
from bodyslam_jax.config.errors import InputError

SCALE = "scale"
_WEIGHTS = "weights."


@dataclasses.dataclass(frozen=True)
class Axis:
    """A quantity and the values that it takes."""

    name: str
    values: tuple[str, ...]
    is_setting: bool

    @property
    def term(self) -> str | None:
        """The term of the cost whose λ it is."""
        return None if self.is_setting else self.name.partition(_WEIGHTS)[2] or None


def parse_axes(texts: Sequence[str], config: Config = Config()) -> list[Axis]:
    """The axes that texts such as `weights.human_motion=10,100` describe.

    **Raises:** `InputError` for a name that is none, a value that cannot be, or an axis
    that repeats.
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
        is_weight = name.startswith(_WEIGHTS) and name not in settings
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
    """All combinations of values of settings."""
    return _product([axis for axis in axes if axis.is_setting])


def mapped_points(axes: Sequence[Axis]) -> list[dict[str, float]]:
    """All combinations of scale and weights."""
    found = _product([axis for axis in axes if not axis.is_setting])
    return [{name: float(value) for name, value in point.items()} for point in found]


def at_point(config: Config, point: Mapping[str, str]) -> Config:
    """The settings at a point of `settings_points`."""
    return with_values(config, {name: value.split() for name, value in point.items()})


def _product(axes: Sequence[Axis]) -> list[dict[str, str]]:
    names = [axis.name for axis in axes]
    return [
        dict(zip(names, values, strict=True))
        for values in itertools.product(*(axis.values for axis in axes))
    ]
