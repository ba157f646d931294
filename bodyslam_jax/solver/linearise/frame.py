"""The blocks of factors over frames, from the variables that each factor touches.

All derivatives of one frame, those by globals and the residual stand side by side; one
Gram matrix a frame then holds every block and every gradient of a group of factors.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bodyslam_jax.geometry import so3
from bodyslam_jax.graph import (
    TURNS,
    FrameFactor,
    Problem,
    State,
    squared_norm,
)
from bodyslam_jax.graph.factor import Key
from bodyslam_jax.solver.blocks import Sums, basis_of, shifted, to_coordinates

_VARIABLE_ORDER = {"pose": 0, "root": 1, "camera": 2, "globals": 3}
_GROUP_OF_VARIABLE = {
    "pose": "poses",
    "root": "roots",
    "camera": "cameras",
    "shape": "shapes",
    "scale": "scale",
    "intrinsics": "intrinsics",
    "globals": "globals",
}
_FRAME_VARIABLES = ("pose", "root", "camera")
_GLOBAL_VARIABLES = ("scale", "intrinsics", "globals", "shape")


class Rows(NamedTuple):
    """The weighted rows of one factor over frames; leading axes of all arrays `h t`, or
    `1 t` for a factor of the camera alone."""

    of_people: bool
    columns: dict[Key, Array]
    """Derivatives by the variables of each frame, and by those that frames share."""
    residual: Array
    precision: np.dtype
    """Precision of the state, in which gradients are formed."""

    @property
    def local(self) -> list[Key]:
        """Returns the variables of frames among the columns, in order."""
        own = (key for key in self.columns if key[0] in _FRAME_VARIABLES)
        return sorted(own, key=lambda key: _VARIABLE_ORDER[key[0]])


def rows_of(
    problem: Problem, factor: FrameFactor, state: State, sums: Sums
) -> list[Rows]:
    """Returns the rows of one factor, none if all its variables are held, and adds its
    cost to `sums`; held coordinates have columns of zeros."""
    keys = [t for t in factor.touched if _GROUP_OF_VARIABLE[t[0]] in problem.variables]
    if not keys:
        sums.costs.append(factor.cost(state))
        return []
    residual, parts = _derivatives(factor, keys, state, sums)
    s = squared_norm(residual)
    sums.costs.append(0.5 * jnp.sum(factor.loss.rho(s)))
    root_weight = jnp.sqrt(factor.loss.weight(s))[..., None]
    if not factor.of_people:
        residual, root_weight = residual[None], root_weight[None]
        parts = {touch: part[None] for touch, part in parts.items()}
    # All residuals of a frame are flattened to one axis of rows.
    lead = residual.shape[:2]
    rows = lambda x, *width: x.reshape(*lead, -1, *width)
    weight = rows(jnp.broadcast_to(root_weight, residual.shape), 1)
    columns = {}
    for name, lag in keys:
        part = parts[name, lag]
        if name in _GLOBAL_VARIABLES:
            free = _free_of_shared(problem, name, factor.of_people)
            columns[name, lag] = rows(part, free.shape[-1]) * free * weight
            continue
        free = _free_of(problem, name, lag)
        if name != "pose":
            column = rows(part, 6) * free[..., None, :]
        elif factor.per_joint:
            column = _of_joints(problem, rows, part, free)
        else:
            column = rows(part, TURNS) * free[..., None, :]
            column = to_coordinates(problem, column)
        columns[name, lag] = column * weight
    return [Rows(factor.of_people, columns, rows(residual, 1) * weight, s.dtype)]


def add_products(sums: Sums, rows: list[Rows]) -> None:
    """Adds the blocks of all factors to `sums`.

    Factors that see no posture are stacked, as few rows each: one product of all takes
    less time to compile than one of each, and no more to compute.
    """
    groups: dict[Any, list[Rows]] = {}
    for i, part in enumerate(rows):
        sees_posture = any(name == "pose" for name, _ in part.columns)
        alike = part.of_people, part.residual.shape[:2]
        groups.setdefault((i,) if sees_posture else alike, []).append(part)
    for group in groups.values():
        _add_products(sums, group)


def _of_joints(problem, rows, part, free):
    """Returns derivatives by posture coordinates, where row j sees joint j only."""
    part = part.reshape(*part.shape[:3], -1, 3) * free.reshape(*part.shape[:3], 1, 3)
    basis = basis_of(problem, part.dtype).reshape(23, 3, -1)
    wide = jnp.einsum("htjda,jak->htjdk", part, basis)
    return rows(wide, basis.shape[-1])


def _derivatives(factor, keys, state, sums):
    """Returns the residual of all frames, and its derivatives by variable and lag."""
    known = factor.jacobians(state)
    if known is not None:
        return known
    local = [t for t in keys if t[0] in _FRAME_VARIABLES]
    common = [t for t in keys if t[0] not in _FRAME_VARIABLES]
    width = {"pose": 3 if factor.per_joint else 69, "root": 6, "camera": 6}
    width |= _common_widths(sums.sizes)
    ordered = [*local, *common]
    ends = [sum(width[n] for n, _ in ordered[: i + 1]) for i in range(len(ordered))]
    parts = {
        touch: slice(end - width[touch[0]], end)
        for touch, end in zip(ordered, ends, strict=True)
    }

    def one(data, window, shared, turns):
        known = factor.jacobian(data, window, shared)
        if known is not None:
            return known

        def moved(step):
            if factor.per_joint:
                step = jnp.broadcast_to(step, (23, ends[-1]))
            frames, rest = list(window), shared
            for name, lag in local:
                change = step[..., parts[name, lag]]
                frames[lag] = _move(frames[lag], name, change, turns[lag])
            for name, _ in common:
                rest = _move_shared(rest, name, step[..., parts[name, 0]])
            residual = factor.frame_residual(data, tuple(frames), rest)
            return residual, residual

        zero = jnp.zeros(ends[-1], state.scale.dtype)
        jac, residual = jax.jacfwd(moved, has_aux=True)(zero)
        return residual, {touch: jac[..., part] for touch, part in parts.items()}

    turns: tuple = (None,) * factor.num_lags
    if any(name == "pose" for name, _ in local):
        turn = so3.inverse_right_jacobian(state.poses)
        turns = tuple(shift_back(turn, lag) for lag in range(factor.num_lags))
    return factor.map_frames(one, state, turns)


def _common_widths(sizes):
    """Returns the number of coordinates of each group of globals."""
    named = {"intrinsics": sizes.intrinsics, "globals": sizes.named}
    return {"scale": 1, **named, "shape": 10}


def _add_products(sums: Sums, group: list[Rows]) -> None:
    first = group[0]
    of_people = first.of_people
    everything = Rows(
        of_people,
        {key: x for part in group for key, x in part.columns.items()},
        first.residual,
        first.precision,
    )
    local = everything.local
    # Only what one factor couples has a block.
    coupled = {(a, b) for part in group for a in part.columns for b in part.columns}
    has_common = any(name in _GLOBAL_VARIABLES for name, _ in everything.columns)
    common = [(name, 0) for name in _GLOBAL_VARIABLES] if has_common else []
    width = {key: x.shape[-1] for key, x in everything.columns.items()}
    width = {(name, 0): w for name, w in _common_widths(sums.sizes).items()} | width
    keys = [*local, *common]
    ends = [sum(width[k] for k in keys[: i + 1]) for i in range(len(keys))]
    parts = {k: slice(e - width[k], e) for k, e in zip(keys, ends, strict=True)}

    def stacked(part):
        none = lambda key: jnp.zeros(
            (*part.residual.shape[:-1], width[key]), part.residual.dtype
        )
        columns = [part.columns[k] if k in part.columns else none(k) for k in keys]
        return jnp.concatenate([*columns, part.residual], axis=-1)

    whole = jnp.concatenate([stacked(part) for part in group], axis=-2)
    jac = whole.astype(sums.sizes.dtype)
    gram = _products(jac, jac)
    if jac.dtype == whole.dtype:
        slope = gram[..., -1, :]
    else:
        slope = jnp.einsum("...ra,...r->...a", whole, whole[..., -1])
    # Blocks of row k that belong to a variable of frame k - lag are moved there.
    shift = lambda x, lag: shifted(x, -lag, 1)
    spread = slice(sum(width[k] for k in local), ends[-1] if common else 0)
    squeeze = (lambda x: x) if of_people else (lambda x: x[0])
    for name, lag in local:
        here = parts[name, lag]
        own = shift(slope[..., here], lag)
        sums.add_gradient(name if of_people else "camera_alone", squeeze(own))
        for other, other_lag in local:
            there = other, other_lag
            before = (_VARIABLE_ORDER[name], lag) > (_VARIABLE_ORDER[other], other_lag)
            if before or ((name, lag), there) not in coupled:
                continue
            block = shift(gram[..., here, parts[there]], lag)
            row, column = (name, other) if of_people else ("alone", "alone")
            sums.add((row, column, other_lag - lag), squeeze(block))
        if has_common:
            block = shift(gram[..., here, spread], lag)
            sums.add((name if of_people else "alone", "globals", 0), squeeze(block))
    if has_common:
        n = sums.sizes.own_globals if of_people else sums.sizes.common
        total = jnp.sum(gram[..., spread, spread], axis=1).astype(whole.dtype)
        down = jnp.sum(slope[..., spread], axis=1)
        for person in range(total.shape[0]):
            sums.add_globals(
                person if of_people else None,
                total[person, :n, :n],
                down[person, :n],
            )


def _products(a: Float[Array, "*b r p"], b: Float[Array, "*b r q"]) -> Array:
    """Returns `a^T b`; a sum of fused outer products where there are few rows."""
    if a.shape[-2] > 3:
        return jnp.einsum("...ra,...rb->...ab", a, b)
    term = lambda r: a[..., r, :, None] * b[..., r, None, :]
    return sum((term(r) for r in range(1, a.shape[-2])), term(0))


def shift_back(x: Float[Array, "h t *b"], lag: int) -> Float[Array, "h t *b"]:
    """Returns the value of frame k - lag at frame k; the first repeats."""
    return x[:, jnp.maximum(jnp.arange(x.shape[1]) - lag, 0)]


def _move(frame, name, step, turn):
    """Moves a variable to first order, which suffices for derivatives at 0."""
    if name == "pose":
        step = jnp.einsum("jab,jb->ja", turn, step.reshape(23, 3))
        return dataclasses.replace(frame, person_pose=frame.pose + step)
    if name == "root":
        return dataclasses.replace(frame, person_root=_nudge(frame.root, step))
    return dataclasses.replace(frame, camera=_nudge(frame.camera, step))


def _nudge(pose, step):
    """Applies `retract_pose` to first order."""
    rotation = pose[:3, :3]
    rotation = rotation + jnp.cross(rotation, jnp.broadcast_to(step[:3], (3, 3)))
    top = jnp.concatenate([rotation, (pose[:3, 3] + step[3:])[:, None]], axis=1)
    return jnp.concatenate([top, pose[3:]], axis=0)


def _move_shared(shared, name, step):
    if name == "shape":
        return dataclasses.replace(shared, person_shape=shared.shape + step)
    changed = getattr(shared, name) + (step[0] if name == "scale" else step)
    return dataclasses.replace(shared, **{name: changed})


def _free_of(problem, name, lag):
    """Returns the mask of a variable `lag` frames back; people share the cameras'."""
    if name == "camera":
        free = problem.free.cameras[None]
    elif name == "root":
        free = problem.free.roots
    else:
        free = problem.free.poses.reshape(*problem.free.poses.shape[:2], TURNS)
    if lag:
        free = jnp.concatenate([free[:, :lag], free[:, :-lag]], axis=1)
    return free


def _free_of_shared(problem, name, of_people):
    if name == "scale":
        return problem.free.scale[None]
    if name in ("intrinsics", "globals"):
        return getattr(problem.free, name)
    free = problem.free.shapes[:, None, None, :]
    return free if of_people else free[0]
