"""Base classes of the graph's factors: measurements, and one `residual` method.

A residual is prediction minus measurement in standard deviations, so that
`0.5 * sum(rho(|residual|^2))` is a negative log-likelihood. Missing measurements have
`sigma = inf` and a finite value. A factor over frames is written for one frame of one
person (`frame_residual`), with the variables it depends on (`keys`); the residuals of
all frames and the blocks of the Jacobian follow from that.

Which fields of a factor are measurements, and over which axes, is read from their
jaxtyping annotations (`fields_with_axes`).
"""

import abc
import dataclasses
import functools
import typing
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import AbstractArray, Array, Float, Int

from bodyslam_jax.graph.losses import Loss, Squared, squared_norm
from bodyslam_jax.graph.state import State

Key = tuple[str, int]
"""A variable and its lag in frames: `("camera", 1)` is the previous camera."""
_PERSON_VARIABLES = ("root", "pose", "shape")
_SHARED_VARIABLES = ("scale", "shape", "intrinsics", "globals")
BUILT_IN_VARIABLES = ("camera", "root", "pose", *_SHARED_VARIABLES)
"""Names of variables that every state has; other names in `keys` are of named globals
(`graph.globals`)."""


class Frame(eqx.Module):
    """The variables of one frame: the camera's, and those of one person if the factor
    has one residual for each person (`FrameFactor.of_people`)."""

    camera: Float[Array, "*b 4 4"]
    """T'_WC"""
    person_root: Float[Array, "*b 4 4"] | None
    """`root`, or `None` in a factor of the camera alone; so is `person_pose`."""
    person_pose: Float[Array, "*b 23 3"] | None

    @property
    def root(self) -> Float[Array, "*b 4 4"]:
        """Returns T_CH.

        **Raises:** `ValueError` in a factor without a variable of a person in `keys`.
        """
        return _of_person(self.person_root, "root")

    @property
    def pose(self) -> Float[Array, "*b 23 3"]:
        """Returns the joint rotations (axis-angle, rad).

        **Raises:** `ValueError` as `root` does.
        """
        return _of_person(self.person_pose, "pose")


class Shared(eqx.Module):
    """The variables that all frames have in common, and the shape of one person."""

    scale: Float[Array, ""]
    """s, m per unit of the map."""
    person_shape: Float[Array, " 10"] | None
    intrinsics: Float[Array, " i"]
    globals: Float[Array, " g"]
    """All named globals, one after another."""
    names: tuple[tuple[str, int, int], ...] = eqx.field(static=True, default=())
    """Name, start and end of each named global that the factor has in its `keys`."""

    def __getitem__(self, name: str) -> Float[Array, " n"]:
        """Returns the named global `name`.

        **Raises:** `ValueError` if `(name, 0)` is not among the factor's `keys`.
        """
        for known, start, end in self.names:
            if known == name:
                return self.globals[start:end]
        raise ValueError(
            f"shared[{name!r}]: found {[known for known, *_ in self.names]}, expected "
            f"`({name!r}, 0)` among the factor's `keys`."
        )

    @property
    def shape(self) -> Float[Array, " 10"]:
        """Returns SMPL β.

        **Raises:** `ValueError` in a factor without a variable of a person in `keys`.
        """
        return _of_person(self.person_shape, "shape")


def _of_person(value: Array | None, name: str) -> Array:
    if value is None:
        raise ValueError(
            f"{name}: found a factor of the camera alone, expected "
            f"`({name!r}, 0)` among its `keys`."
        )
    return value


if TYPE_CHECKING:

    class _Declared:
        """Attributes that a subclass sets as a field, a class attribute or a property:
        only of `Any` do type checkers allow all three. `FrameFactor` documents them."""

        loss: Any
        keys: Any
        per_joint: Any

else:
    _Declared = object


class Factor(eqx.Module, _Declared):
    """Measurements of one kind, with their residual at a state and a robust loss."""

    map_units: ClassVar[Mapping[str, int] | None] = None
    """The power of the map's unit in each field that has one: `{"position": 1}` for
    lengths in the map, -1 for their inverse or for metres per unit of the map; `{}`
    where there is none. `None` counts as `{}`, and `rescaled` then refuses the problem
    if the residual changes with the unit."""

    if not TYPE_CHECKING:
        loss: eqx.AbstractVar[Loss]

    def rescaled(self, factor: Float[Array, ""]) -> "Factor":
        """Returns the factor in a map that is `factor` times as large: fields are
        multiplied by the powers of `factor` in `map_units`."""
        found = self
        for name, power in (self.map_units or {}).items():
            value = in_unit(getattr(self, name), factor**power)
            found = eqx.tree_at(lambda f, n=name: getattr(f, n), found, value)
        return found

    @abc.abstractmethod
    def residual(self, state: State) -> Float[Array, "*m d"]:
        """Returns the whitened residual, before the loss; the last axis is that of one
        measurement."""

    def cost(self, state: State) -> Float[Array, ""]:
        """Returns the negative log-likelihood, `0.5 sum rho(|r|^2)`."""
        s = squared_norm(residual_of(self, state))
        return 0.5 * jnp.sum(self.loss.rho(s))


def in_unit(value: Float[Array, "*b"], power: Float[Array, ""]) -> Float[Array, "*b"]:
    """Converts a quantity to another unit. Infinite values, such as the sigma of a
    missing measurement, stay, and their derivative by the unit is 0."""
    known = jnp.isfinite(value)
    return jnp.where(known, jnp.where(known, value, 0.0) * power, value)


@eqx.filter_jit
def residual_of(factor: Factor, state: State) -> Array:
    """Returns `factor.residual(state)`, traced once wherever it is needed."""
    return factor.residual(state)


class FrameFactor(Factor):
    """A factor with one residual for each frame, of each person or of the camera.

    A subclass declares its measurements as annotated arrays, the variables that its
    residual depends on (`keys`), and `frame_residual`; everything else has a default:

        class CameraPosition(FrameFactor):
            position: Float[Array, "t 3"]
            sigma: Float[Array, " t"]
            keys = (("camera", 0), ("scale", 0))

            def frame_residual(self, data, window, shared):
                position, sigma = data
                return (shared.scale * window[0].camera[:3, 3] - position) / sigma

    Axes are `h` people and `t` frames: arrays of a person's factor begin with `h t`,
    those of the camera's with `t`. Measurements that depend on no frame, such as a
    known stature, have no `t` axis and keys among `scale`, `shape` and `intrinsics`;
    they are counted once (`once`). Missing measurements have `sigma = inf`.
    """

    globals_at: tuple[tuple[str, int, int], ...] = eqx.field(
        static=True, default=(), kw_only=True, repr=False
    )
    """Name, start and end in `State.globals` of each named global in `keys`; the
    problem sets it."""
    loss = Squared()
    """The robust loss; a subclass makes it a field with `loss: Loss = Squared()`."""
    padding: ClassVar[Mapping[str, float] | None] = None
    """The value of each of `time_fields` with which a frame has no weight, such as
    `{"sigma": jnp.inf}`; other fields repeat their last frame. The solver appends
    frames, so that videos of about the same length share a program. Without `padding`
    the residuals of appended frames are masked (`Masked`), which is always right and
    slightly slower."""
    per_joint = False
    """Whether row j of the residual depends only on joint j of the poses in `keys`."""

    if not TYPE_CHECKING:

        @property
        @abc.abstractmethod
        def keys(self) -> tuple[Key, ...]:
            """Variables with their lags: `camera`, `root`, `pose` with a lag, and
            `scale`, `shape`, `intrinsics` with lag 0, and names of globals
            (`variables`) with lag 0. A class attribute, or a property where they depend
            on the factor's settings."""

    @property
    def touched(self) -> tuple[Key, ...]:
        """Returns `keys` with the vector of all globals in place of named ones."""
        known = (
            (n, k) if n in BUILT_IN_VARIABLES else ("globals", k) for n, k in self.keys
        )
        return tuple(dict.fromkeys(known))

    @property
    def of_people(self) -> bool:
        """Returns True if there is one residual for each person."""
        return any(name in _PERSON_VARIABLES for name, _ in self.keys)

    @property
    def time_fields(self) -> tuple[str, ...]:
        """Returns the array fields with leading axes `h t` (or `t`): those padded."""
        axes = ("h", "t") if self.of_people else ("t",)
        return fields_with_axes(type(self), axes)

    @property
    def once(self) -> bool:
        """Returns True if the measurements depend on no frame, and are counted once."""
        return not self.time_fields and all(
            n in _SHARED_VARIABLES for n, _ in self.touched
        )

    def data(self) -> Any:
        """Returns the measurements, leading axes `h t` (or `t`): by default a tuple of
        `time_fields`, or of all arrays of a factor that is counted once."""
        if not self.once:
            return tuple(getattr(self, name) for name in self.time_fields)
        axes = ("h",) if self.of_people else ()
        names = fields_with_axes(type(self), axes)
        return tuple(jnp.expand_dims(getattr(self, n), len(axes)) for n in names)

    @abc.abstractmethod
    def frame_residual(
        self, data: Any, window: tuple[Frame, ...], shared: Shared
    ) -> Float[Array, "*m d"]:
        """Returns the residual of one frame, of one axis or more.

        `data` is `self.data()` of this frame; `window[lag]` has the variables of the
        frame that far back, `shared` those that all frames have in common.
        """

    def jacobian(
        self, data: Any, window: tuple[Frame, ...], shared: Shared
    ) -> tuple[Float[Array, "*m d"], dict[Key, Float[Array, "*m d n"]]] | None:
        """Returns the residual and its derivatives by `touched`, or `None` where these
        are not known in closed form."""
        return None

    def jacobians(
        self, state: State
    ) -> tuple[Float[Array, "*b d"], dict[Key, Float[Array, "*b d n"]]] | None:
        """Returns `jacobian` of all frames at once, leading axes `h t` (or `t`)."""
        return None

    @property
    def num_lags(self) -> int:
        return 1 + max(lag for _, lag in self.keys)

    def frame_of_row(self, num_frames: int) -> Int[Array, " t"]:
        """Returns the frame whose variables each row of `map_frames` depends on."""
        return jnp.arange(num_frames)

    def map_frames(self, function, state: State, extra: Any = None):
        """Maps `function(data, window, shared, extra)` over frames, and over people if
        the factor is of people.

        `window` holds the variables (`Frame`) of this frame and of the `num_lags - 1`
        frames before it. Before frame 0, frame 0 is repeated; factors must have no
        weight there. A factor that is counted once is evaluated in frame 0 only.
        """
        if self.once:
            state = eqx.tree_at(
                lambda s: (s.cameras, s.roots, s.poses),
                state,
                (state.cameras[:1], state.roots[:, :1], state.poses[:, :1]),
            )

        def back(x, lag):
            return x[jnp.maximum(self.frame_of_row(x.shape[0]) - lag, 0)]

        def one(data, extra, roots, poses, shape):
            windows = tuple(
                Frame(
                    back(state.cameras, lag),
                    None if roots is None else back(roots, lag),
                    None if poses is None else back(poses, lag),
                )
                for lag in range(self.num_lags)
            )
            shared = Shared(
                *(state.scale, shape, state.intrinsics, state.globals), self.globals_at
            )
            over = lambda d, w, e: function(d, w, shared, e)
            return jax.vmap(over)(data, windows, extra)

        if not self.of_people:
            return one(self.data(), extra, None, None, None)
        return jax.vmap(one)(self.data(), extra, state.roots, state.poses, state.shapes)

    def residual(self, state: State) -> Float[Array, "*m d"]:
        return self.map_frames(lambda d, w, s, _: self.frame_residual(d, w, s), state)


@functools.cache
def array_annotations(kind: type[eqx.Module]) -> dict[str, type[AbstractArray]]:
    """Returns the fields annotated with a jaxtyping array, in their declared order.

    Annotations that are strings (`from __future__ import annotations`) are evaluated.
    """
    fields = dataclasses.fields(kind)
    if any(isinstance(field.type, str) for field in fields):
        types: dict[str, Any] = typing.get_type_hints(kind)
    else:
        types = {field.name: field.type for field in fields}
    return {
        field.name: types[field.name]
        for field in fields
        if isinstance(types[field.name], type)
        and issubclass(types[field.name], AbstractArray)
    }


def fields_with_axes(kind: type[eqx.Module], axes: tuple[str, ...]) -> tuple[str, ...]:
    """Returns the array fields whose leading axes are these, such as `("h", "t")`."""
    return tuple(
        name
        for name, array in array_annotations(kind).items()
        if tuple(array.dim_str.split()[: len(axes)]) == axes
    )
