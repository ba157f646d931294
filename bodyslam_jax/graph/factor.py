"""What a factor of the graph is: measurements, and one `residual` method.

A residual is prediction minus measurement in standard deviations, so that
`0.5 * sum(rho(|residual|^2))` is a negative log-likelihood. Missing is `sigma = inf` on
a finite value. A factor over frames is written once, for one frame of one person
(`local`), with the variables it touches; the rest (all frames at once, blocks of the
Jacobian) follows from that.
"""

import abc
from collections.abc import Mapping
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from bodyslam_jax.graph.losses import Loss, squared_norm
from bodyslam_jax.graph.state import State

JOINTS = tuple(range(23))
"""All joints below the pelvis, as `State.poses` counts them."""

Limbs = tuple[tuple[int, ...], ...]
"""Groups of joints."""

Key = tuple[str, int]
"""A variable and how many frames back: `("camera", 1)` is the previous camera."""


class Frame(eqx.Module):
    """One frame of one person; people's fields are `None` for a camera's factor."""

    camera: Float[Array, "*b 4 4"]
    root: Float[Array, "*b 4 4"] | None
    pose: Float[Array, "*b 23 3"] | None


class Shared(eqx.Module):
    """What all frames of one person share."""

    scale: Float[Array, ""]
    shape: Float[Array, " 10"] | None
    intrinsics: Float[Array, " i"]


class Factor(eqx.Module):
    """Measurements of one kind, and how far a state is from explaining them."""

    loss: eqx.AbstractVar[Loss]

    @abc.abstractmethod
    def residual(self, state: State) -> Float[Array, "*m d"]:
        """Whitened, before the loss; one measurement has the last axis."""

    def cost(self, state: State) -> Float[Array, ""]:
        """Negative log-likelihood: `0.5 sum rho(|r|^2)`."""
        s = squared_norm(residual_of(self, state))
        return 0.5 * jnp.sum(self.loss.rho(s))


@eqx.filter_jit
def residual_of(factor: Factor, state: State) -> Array:
    """`factor.residual(state)`, traced once wherever it is needed."""
    return factor.residual(state)


class FrameFactor(Factor):
    """A factor for each frame of each person, or of the camera."""

    of_people: eqx.AbstractClassVar[bool]
    time_fields: eqx.AbstractClassVar[tuple[str, ...]]
    """Fields with leading axes `h t` (or `t`): what is padded to a common length."""
    padding: ClassVar[Mapping[str, float] | None] = None
    """The value of a field of `time_fields` with which a frame weighs nothing, such as
    `{"sigma": jnp.inf}`; other fields repeat their last frame. The solver adds frames,
    so that videos of about the same length share a program. Without it, residuals of
    added frames are masked, whatever fields are called (`Masked`)."""
    per_joint = False
    """Whether row j of the residual depends on joint j of the touched poses alone."""

    @property
    @abc.abstractmethod
    def keys(self) -> tuple[Key, ...]:
        """Among `camera`, `root`, `pose` with a lag, and `scale`, `shape`,
        `intrinsics` with lag 0."""

    @abc.abstractmethod
    def data(self) -> Any:
        """Measurements, leading axes `h t` (or `t`, for a factor of the camera)."""

    @abc.abstractmethod
    def frame_residual(
        self, data: Any, window: tuple[Frame, ...], shared: Shared
    ) -> Float[Array, "*m d"]:
        """The residual of one frame; `window[lag]` is the frame that far back."""

    def jacobian(
        self, data: Any, window: tuple[Frame, ...], shared: Shared
    ) -> tuple[Float[Array, "*m d"], dict[Key, Float[Array, "*m d n"]]] | None:
        """The residual and, if known in closed form, its derivative by each touch."""
        return None

    def jacobians(
        self, state: State
    ) -> tuple[Float[Array, "*b d"], dict[Key, Float[Array, "*b d n"]]] | None:
        """The same for all frames at once, leading axes `h t` (or `t`)."""
        return None

    @property
    def limbs(self) -> Limbs:
        """Joints of the touched poses on which one row of the residual may depend."""
        return (JOINTS,)

    @property
    def num_lags(self) -> int:
        return 1 + max(lag for _, lag in self.keys)

    def frame_of_row(self, num_frames: int) -> Int[Array, " t"]:
        """The frame whose variables stand in each row of `map_frames`."""
        return jnp.arange(num_frames)

    def map_frames(self, function, state: State, extra: Any = None):
        """`function(data, window, shared, extra)` over frames, and people if any.

        A window repeats the first frame where there is none before; factors carry no
        weight there.
        """

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
            shared = Shared(state.scale, shape, state.intrinsics)
            over = lambda d, w, e: function(d, w, shared, e)
            return jax.vmap(over)(data, windows, extra)

        if not self.of_people:
            return one(self.data(), extra, None, None, None)
        return jax.vmap(one)(self.data(), extra, state.roots, state.poses, state.shapes)

    def residual(self, state: State) -> Float[Array, "*m d"]:
        return self.map_frames(lambda d, w, s, _: self.frame_residual(d, w, s), state)
