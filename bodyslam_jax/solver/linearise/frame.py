"""The blocks of factors over frames, from the variables that each factor touches.

All derivatives of one frame, those by globals and the residual stand side by side; one
Gram matrix a frame then holds every block and every gradient.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bodyslam_jax.geometry import so3
from bodyslam_jax.graph import (
    TURNS,
    FrameFactor,
    Problem,
    State,
    squared_norm,
)
from bodyslam_jax.solver.blocks import Sums, shifted
from bodyslam_jax.solver.posture import basis_of, to_coordinates

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


def linearise_frames(
    problem: Problem, factor: FrameFactor, state: State, sums: Sums
) -> None:
    """Adds all blocks of one factor to `sums`; held coordinates have zeros."""
    keys = [t for t in factor.touched if _GROUP_OF_VARIABLE[t[0]] in problem.variables]
    if not keys:
        sums.costs.append(factor.cost(state))
        return
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
    local = sorted(
        (t for t in keys if t[0] in _FRAME_VARIABLES),
        key=lambda t: _VARIABLE_ORDER[t[0]],
    )
    columns = []
    for name, lag in local:
        free = _free_of(problem, name, lag)
        part = parts[name, lag]
        if name != "pose":
            columns.append(rows(part, 6) * free[..., None, :])
        elif factor.per_joint:
            columns.append(_of_joints(problem, rows, part, free))
        else:
            part = rows(part, TURNS) * free[..., None, :]
            columns.append(to_coordinates(problem, part))
    common = [name for name in _GLOBAL_VARIABLES if (name, 0) in keys]
    if common:
        widths = _common_widths(sums.sizes)
        for name in _GLOBAL_VARIABLES:
            if name in common:
                free = _free_of_shared(problem, name, factor.of_people)
                columns.append(rows(parts[name, 0], widths[name]) * free)
            else:
                columns.append(jnp.zeros((*weight.shape[:-1], widths[name]), s.dtype))
    columns.append(rows(residual, 1))
    _add_products(sums, local, bool(common), columns, weight, factor)


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


def _add_products(sums, local, has_common, columns, weight, factor):
    of_people = factor.of_people
    ends = [sum(c.shape[-1] for c in columns[: i + 1]) for i in range(len(columns))]
    parts = [slice(e - c.shape[-1], e) for e, c in zip(ends, columns, strict=True)]
    whole = jnp.concatenate(columns, axis=-1) * weight
    jac = whole.astype(sums.sizes.dtype)
    gram = _products(jac, jac)
    if jac.dtype == whole.dtype:
        slope = gram[..., -1, :]
    else:
        slope = jnp.einsum("...ra,...r->...a", whole, whole[..., -1])
    # Blocks of row k that belong to a variable of frame k - lag are moved there.
    shift = lambda x, lag: shifted(x, -lag, 1)
    spread = slice(ends[len(local) - 1] if local else 0, ends[-2] if has_common else 0)
    squeeze = (lambda x: x) if of_people else (lambda x: x[0])
    for i, (name, lag) in enumerate(local):
        own = shift(slope[..., parts[i]], lag)
        sums.add_gradient(name if of_people else "camera_alone", squeeze(own))
        for j, (other, other_lag) in enumerate(local):
            here, there = (
                (_VARIABLE_ORDER[name], lag),
                (_VARIABLE_ORDER[other], other_lag),
            )
            if here > there:
                continue
            block = shift(gram[..., parts[i], parts[j]], lag)
            key = (name, other) if of_people else ("alone", "alone")
            sums.add((*key, other_lag - lag), squeeze(block))
        if has_common:
            block = shift(gram[..., parts[i], spread], lag)
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
