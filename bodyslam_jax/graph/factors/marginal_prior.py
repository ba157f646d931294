"""The information of marginalised measurements on the remaining variables.

    r = W (x ⊖ x̂) + b,    W^T W = Λ,  W^T b = η

`solver.marginalise` makes it of the first frames of a problem: `½ δ^T Λ δ + η^T δ` is,
up to a constant, the least cost of their measurements over the eliminated variables,
for a step δ from x̂, where they were linearised. `⊖` is `State.local`. W keeps the
derivatives at these first estimates; the chart x ⊖ x̂ is that of x̂, too, so that the
cost is one function of the state, with derivatives of its own.

Where the measurements were invariant to translation, rotation or scale of the map, so
is r, at any state: x is first aligned as a whole, so that a camera of the prior is
where it was at x̂, and the others at the same distances. Other factors may therefore be
linearised anywhere, and unobservable directions gain no information, which otherwise
takes first estimates in all Jacobians (Huang, Mourikis, Roumeliotis, A first-estimates
Jacobian EKF, 2008). How a named global of the world, such as the direction of gravity,
rotates with the map is not known here: if the measurements depended on one, the prior
is invariant along the directions that they left free at x̂, to first order. Ours.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from bodyslam_jax.graph.factor import Factor
from bodyslam_jax.graph.losses import Loss, Squared
from bodyslam_jax.graph.ordering import CHUNK
from bodyslam_jax.graph.state import State, Step

_LAST_FRAME = CHUNK - 1
"""The frame whose postures are in the prior."""


class MarginalPrior(Factor):
    """`r = W (x ⊖ x̂) + b` of the first frames of a problem: one measurement of `n`
    coordinates.

    Frames of the first chunk are the past. The prior is on their last posture, and on
    their last roots and cameras, as many as factors reach back to; on all further
    cameras up to the last of `estimate`; and on scale, intrinsics, named globals and
    shapes. Coordinates are in the order of `coordinates`.
    """

    root: Float[Array, "n n"]
    """W, in the inverse units of a step's coordinates; columns of 0 for what the
    measurements did not depend on."""
    offset: Float[Array, " n"]
    """b"""
    estimate: State
    """x̂: its `c` frames, without landmarks."""
    anchor: Float[Array, " c"]
    """1 for the cameras whose centres the measurements depended on."""
    invariant: Float[Array, " 3"]
    """1 where they were invariant to translation, rotation and scale of the map; the
    last two only with the first."""
    reach: int = eqx.field(static=True)
    """Number of roots."""
    loss: Loss = Squared()
    map_units = {}

    @property
    def frames(self) -> int:
        """Returns the number of frames that it depends on, the first ones."""
        return len(self.estimate.cameras)

    def residual(self, state: State) -> Float[Array, " n"]:
        return self.root @ self.moved(self.first_frames(state)) + self.offset

    def moved(self, first: State) -> Float[Array, " n"]:
        """Returns `x ⊖ x̂` of the first frames of a state."""
        return coordinates(self.estimate.local(self._aligned(first)), self.reach)

    def first_frames(self, x: Any) -> Any:
        """Restricts a state, or a step, to the prior's frames, without landmarks."""
        c = self.frames
        return dataclasses.replace(
            x,
            cameras=x.cameras[:c],
            roots=x.roots[:, :c],
            poses=x.poses[:, :c],
            landmarks=x.landmarks[:0],
        )

    def rescaled(self, factor):
        length = jnp.ones_like(self.estimate.cameras[:, 0, 0]) * factor
        turn = jnp.ones((self.frames, 3), length.dtype)
        like = self.estimate.zero_step()
        unit = dataclasses.replace(
            _ones(like),
            scale=1 / factor,
            cameras=jnp.concatenate([turn, turn * length[:, None]], axis=1),
        )
        cameras = self.estimate.cameras.at[:, :3, 3].multiply(factor)
        estimate = dataclasses.replace(
            self.estimate, scale=self.estimate.scale / factor, cameras=cameras
        )
        root = self.root / coordinates(unit, self.reach)
        return dataclasses.replace(self, root=root, estimate=estimate)

    def _aligned(self, first: State) -> State:
        """Returns the state translated, rotated and scaled as a whole, as far as the
        prior is invariant to that, with the first camera of `anchor` as in x̂."""
        moves, turns, scales = self.invariant
        at = jnp.argmax(self.anchor)
        here, there = first.cameras, self.estimate.cameras
        C, r = here[:, :3, :3], here[:, :3, 3]
        turn = there[at, :3, :3] @ C[at].T
        turn = turns * turn + (1 - turns) * jnp.eye(3, dtype=turn.dtype)
        size, first_size = (self._size(x[:, :3, 3], at) for x in (here, there))
        known = (scales > 0) & (size > 0) & (first_size > 0)
        safe = jnp.where(known, size, 1.0)
        ratio = jnp.where(known, jnp.sqrt(first_size / safe), 1.0)
        target = moves * there[at, :3, 3] + (1 - moves) * r[at]
        centre = target + ratio * (r - r[at]) @ turn.T
        top = jnp.concatenate([turn @ C, centre[..., None]], axis=-1)
        cameras = jnp.concatenate([top, here[:, 3:]], axis=1)
        return dataclasses.replace(first, scale=first.scale / ratio, cameras=cameras)

    def _size(self, r: Float[Array, "c 3"], at: Array) -> Float[Array, ""]:
        """Returns the sum of squared distances of the cameras to that at `at`."""
        return jnp.sum(self.anchor[:, None] * (r - r[at]) ** 2)


def coordinates(step: Step, reach: int) -> Float[Array, " n"]:
    """Returns the coordinates of a step that a prior has: scale, intrinsics, named
    globals, shapes, cameras, the last roots and the last postures of the first chunk.
    """
    parts = (
        *(step.scale[None], step.intrinsics, step.globals, step.shapes, step.cameras),
        *(step.roots[:, CHUNK - reach : CHUNK], step.poses[:, _LAST_FRAME]),
    )
    return jnp.concatenate([part.reshape(-1) for part in parts])


def _ones(step: Step) -> Step:
    return Step(**{name: jnp.ones_like(x) for name, x in vars(step).items()})
