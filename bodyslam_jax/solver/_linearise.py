"""The blocks of the normal equations: `J^T J` and `J^T r`, formed where they are not 0.

Factors over frames give blocks between variables of nearby frames, found from the
variables that each factor touches. Landmarks give dense tables, frames by landmarks of
a group (`graph/_layout.py`). Names of blocks: `("pose", "root", d)` couples the pose of
frame k with the root of frame k - d.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bodyslam_jax.camera import project
from bodyslam_jax.graph import (
    CHUNK,
    AbstractFrameFactor,
    Frame,
    Problem,
    Reprojection,
    Shared,
    State,
    inverse_right_jacobian,
)

_RANK = {"pose": 0, "root": 1, "camera": 2, "globals": 3}
_GROUP = {
    "pose": "poses",
    "root": "roots",
    "camera": "cameras",
    "shape": "shapes",
    "scale": "scale",
    "intrinsics": "intrinsics",
}


class Sizes(eqx.Module):
    """Static sizes of a linearised problem."""

    people: int = eqx.field(static=True)
    chunks: int = eqx.field(static=True)
    bandwidth: int = eqx.field(static=True)
    intrinsics: int = eqx.field(static=True)
    """0 where they are held."""
    variables: tuple[str, ...] = eqx.field(static=True)

    @property
    def own_globals(self) -> int:
        """Scale, intrinsics and the shape of one person."""
        return 1 + self.intrinsics + 10

    @property
    def globals(self) -> int:
        """Scale, intrinsics and all shapes."""
        return 1 + self.intrinsics + 10 * self.people


class LandmarkBlocks(eqx.Module):
    """One bucket: `n` groups of `g` landmarks over `f` frames."""

    cross: Float[Array, "n f 6 3 g"]
    """Camera against landmark."""
    cross_intrinsics: Float[Array, "n i 3 g"]
    own: Float[Array, "n 3 3 g"]
    gradient: Float[Array, "n 3 g"]


class Linearisation(eqx.Module):
    """Blocks of `J^T J` and of the gradient `J^T r` at a state, and its cost."""

    blocks: dict[tuple[str, str, int], Array]
    """Per person (but for cameras alone) and frame."""
    gradient: dict[str, Array]
    globals: Float[Array, "g g"]
    globals_gradient: Float[Array, " g"]
    landmarks: tuple[LandmarkBlocks, ...]
    costs: Float[Array, " k"]
    """Of each factor."""


class Observations(eqx.Module):
    """The measurements of one bucket, gathered once per solve."""

    pixel: Float[Array, "n f g 2"]
    weight: Float[Array, "n f g"]
    """1 / sigma; 0 in the holes."""


def sizes_of(problem: Problem, state: State) -> Sizes:
    held = "intrinsics" not in problem.variables
    return Sizes(
        people=state.roots.shape[0],
        chunks=problem.layout.num_chunks,
        bandwidth=problem.layout.bandwidth,
        intrinsics=0 if held else state.intrinsics.shape[0],
        variables=problem.variables,
    )


def gather(problem: Problem) -> tuple[Observations, ...]:
    """Measurements of landmarks in the order of the tables."""
    for factor in problem.factors:
        if isinstance(factor, Reprojection):
            return tuple(
                Observations(factor.pixel[b.row], 1 / factor.sigma[b.row])
                for b in problem.layout.buckets
            )
    return ()


def linearise(
    problem: Problem, observations: tuple[Observations, ...], state: State
) -> Linearisation:
    """All blocks at a state; held coordinates have zero rows and columns."""
    sizes = sizes_of(problem, state)
    sums = _Sums(sizes, state)
    landmarks = ()
    for factor in problem.factors:
        if isinstance(factor, Reprojection):
            landmarks = _landmarks(problem, factor, observations, state, sums)
        elif isinstance(factor, AbstractFrameFactor):
            _frames(problem, factor, state, sums)
    return Linearisation(
        sums.blocks,
        sums.gradient,
        sums.globals,
        sums.globals_gradient,
        landmarks,
        jnp.stack(sums.costs),
    )


class _Sums:
    """Adds blocks up by name, while tracing."""

    def __init__(self, sizes: Sizes, state: State):
        self.sizes = sizes
        self.blocks: dict[tuple[str, str, int], Array] = {}
        self.gradient: dict[str, Array] = {}
        self.costs: list[Array] = []
        dtype = state.scale.dtype
        self.globals = jnp.zeros((sizes.globals, sizes.globals), dtype)
        self.globals_gradient = jnp.zeros(sizes.globals, dtype)

    def add(self, key, value):
        known = self.blocks.get(key)
        self.blocks[key] = value if known is None else known + value

    def add_gradient(self, name, value):
        known = self.gradient.get(name)
        self.gradient[name] = value if known is None else known + value

    def add_globals(self, person, hessian, gradient):
        """Adds what one person's own globals (or the camera's) gathered."""
        index = own_to_global(self.sizes, person)
        self.globals = self.globals.at[index[:, None], index[None, :]].add(hessian)
        self.globals_gradient = self.globals_gradient.at[index].add(gradient)


def own_to_global(sizes: Sizes, person: int | None) -> Array:
    """Where scale, intrinsics and the shape of a person stand among all globals."""
    common = jnp.arange(1 + sizes.intrinsics)
    if person is None:
        return common
    return jnp.concatenate([common, len(common) + 10 * person + jnp.arange(10)])


def _frames(problem, factor, state, sums):
    """Blocks of a factor over frames, by forward differentiation of one frame."""
    sizes, variables = sums.sizes, problem.variables
    touches = [t for t in factor.touches if _GROUP[t[0]] in variables]
    if not touches:
        sums.costs.append(factor.cost(state))
        return
    local = [t for t in touches if t[0] in ("pose", "root", "camera")]
    common = [t[0] for t in touches if t[0] not in ("pose", "root", "camera")]
    ordered = [*local, *((name, 0) for name in common)]
    joint = factor.per_joint
    width = {"pose": 3 if joint else 69, "root": 6, "camera": 6}
    own = {"scale": slice(0, 1), "intrinsics": slice(1, 1 + sizes.intrinsics)}
    own["shape"] = slice(1 + sizes.intrinsics, sizes.own_globals)
    length = [width[name] for name, _ in local]
    length += [own[name].stop - own[name].start for name in common]
    ends = [sum(length[: i + 1]) for i in range(len(length))]
    parts = [slice(e - n, e) for e, n in zip(ends, length, strict=True)]

    def one(data, window, shared, turns):
        known = factor.jacobian(data, window, shared)
        if known is not None:
            residual, parts_of = known
            jac = jnp.concatenate([parts_of[touch] for touch in ordered], axis=-1)
        else:

            def moved(step):
                if joint:
                    step = jnp.broadcast_to(step, (23, ends[-1]))
                frames, rest = list(window), shared
                for (name, lag), part in zip(local, parts[: len(local)], strict=True):
                    frames[lag] = _move(frames[lag], name, step[..., part], turns[lag])
                for name, part in zip(common, parts[len(local) :], strict=True):
                    rest = _move_shared(rest, name, step[..., part])
                residual = factor.local(data, tuple(frames), rest)
                return residual, residual

            zero = jnp.zeros(ends[-1], state.scale.dtype)
            jac, residual = jax.jacfwd(moved, has_aux=True)(zero)
        s = jnp.sum(residual**2, axis=-1)
        root_weight = jnp.sqrt(factor.loss.weight(s))
        jac = jac * root_weight[..., None, None]
        return jac, residual * root_weight[..., None], factor.loss.rho(s)

    turns: tuple = (None,) * factor.num_lags
    if any(name == "pose" for name, _ in local):
        turn = inverse_right_jacobian(state.poses)
        turns = tuple(shift_back(turn, lag) for lag in range(factor.num_lags))
    jac, residual, rho = factor.map_frames(one, state, turns)
    sums.costs.append(0.5 * jnp.sum(rho))
    if not factor.of_people:
        jac, residual = jac[None], residual[None]
    h, t = jac.shape[:2]
    # The rows of one frame; one more axis for the joints that do not interact.
    lead = (h, t, 23) if joint else (h, t)
    jac = jac.reshape(*lead, -1, ends[-1])
    residual = residual.reshape(*lead, -1)
    columns = []
    for (name, lag), part in zip(local, parts[: len(local)], strict=True):
        free = _free_of(problem, name, joint)
        if lag:
            free = jnp.concatenate([free[:, :lag], free[:, :-lag]], axis=1)
        columns.append(jac[..., part] * free[..., None, :])
    spread = None
    if common:
        spread = jnp.zeros((*jac.shape[:-1], sizes.own_globals), jac.dtype)
        for name, part in zip(common, parts[len(local) :], strict=True):
            free = _free_of_shared(problem, name, factor.of_people)
            spread = spread.at[..., own[name]].set(jac[..., part] * free)
    _add_products(sums, local, columns, spread, residual, factor.of_people, joint)


def _add_products(sums, local, columns, spread, residual, of_people, joint):
    outer = lambda a, b: jnp.einsum("...ra,...rb->...ab", a, b)
    inner = lambda a, r: jnp.einsum("...ra,...r->...a", a, r)
    squeeze = (lambda x: x) if of_people else (lambda x: x[0])
    for i, (name, lag) in enumerate(local):
        own = shift(inner(columns[i], residual), lag)
        if joint:
            own = own.reshape(*own.shape[:2], 69)
        sums.add_gradient(name if of_people else "camera_alone", squeeze(own))
        for j, (other, other_lag) in enumerate(local):
            here, there = (_RANK[name], lag), (_RANK[other], other_lag)
            if here > there:
                continue
            block = shift(outer(columns[i], columns[j]), lag)
            # Blocks between joints that do not interact stay apart (23 of 3 x 3).
            key = ("joint", "joint") if joint else (name, other)
            key = key if of_people else ("alone", "alone")
            sums.add((*key, other_lag - lag), squeeze(block))
        if spread is not None:
            block = shift(outer(columns[i], spread), lag)
            sums.add((name if of_people else "alone", "globals", 0), squeeze(block))
    if spread is not None:
        flat = spread.reshape(spread.shape[0], -1, spread.shape[-1])
        rows = residual.reshape(residual.shape[0], -1)
        for person in range(spread.shape[0]):
            n = sums.sizes.own_globals if of_people else 1 + sums.sizes.intrinsics
            columns_of = flat[person][:, :n]
            sums.add_globals(
                person if of_people else None,
                columns_of.T @ columns_of,
                columns_of.T @ rows[person],
            )


def shift(x: Array, lag: int) -> Array:
    """Row k of frame axis 1 to row k - lag: a term of frame k about frame k - lag."""
    if lag == 0:
        return x
    return jnp.concatenate([x[:, lag:], jnp.zeros_like(x[:, :lag])], axis=1)


def shift_back(x: Array, lag: int) -> Array:
    """What frame k - lag holds, at frame k; the first repeats."""
    return x[:, jnp.maximum(jnp.arange(x.shape[1]) - lag, 0)]


def _move(frame, name, step, turn):
    """First order in the step, which is all that a derivative at 0 sees."""
    if name == "pose":
        step = jnp.einsum("jab,jb->ja", turn, step.reshape(23, 3))
        return Frame(frame.camera, frame.root, frame.pose + step)
    if name == "root":
        return Frame(frame.camera, _nudge(frame.root, step), frame.pose)
    return Frame(_nudge(frame.camera, step), frame.root, frame.pose)


def _nudge(pose, step):
    """`retract_pose` to first order."""
    rotation = pose[:3, :3]
    rotation = rotation + jnp.cross(rotation, jnp.broadcast_to(step[:3], (3, 3)))
    top = jnp.concatenate([rotation, (pose[:3, 3] + step[3:])[:, None]], axis=1)
    return jnp.concatenate([top, pose[3:]], axis=0)


def _move_shared(shared, name, step):
    if name == "scale":
        return Shared(shared.scale + step[0], shared.shape, shared.intrinsics)
    if name == "shape":
        return Shared(shared.scale, shared.shape + step, shared.intrinsics)
    return Shared(shared.scale, shared.shape, shared.intrinsics + step)


def _free_of(problem, name, joint):
    """Mask of a variable over people and frames; people share the cameras'."""
    if name == "camera":
        return problem.free.cameras[None]
    if name == "root":
        return problem.free.roots
    poses = problem.free.poses
    return poses if joint else poses.reshape(*poses.shape[:2], 69)


def _free_of_shared(problem, name, of_people):
    if name == "scale":
        return problem.free.scale[None]
    if name == "intrinsics":
        return problem.free.intrinsics
    return problem.free.shapes[:, None, None, :]


def _landmarks(problem, factor, observations, state, sums):
    sizes = sums.sizes
    frames = sizes.chunks * CHUNK
    dtype = state.scale.dtype
    hessian = jnp.zeros((frames, 6, 6), dtype)
    gradient = jnp.zeros((frames, 6), dtype)
    mixed = jnp.zeros((frames, 6, sizes.intrinsics), dtype)
    tables = []
    cost = jnp.zeros((), dtype)
    for bucket, seen in zip(problem.layout.buckets, observations, strict=True):
        frame = frames_of(bucket.first_chunk, bucket.width)
        parts = _bucket(problem, factor.loss, bucket, seen, frame, state, sizes)
        parts, rho = parts
        tables.append(parts[0])
        cost = cost + 0.5 * rho
        hessian = hessian.at[frame].add(parts[1])
        gradient = gradient.at[frame].add(parts[2])
        if sizes.intrinsics:
            mixed = mixed.at[frame].add(parts[3])
            sums.add_globals(None, *_with_scale(parts[4], parts[5]))
    sums.costs.append(cost)
    if "cameras" in sizes.variables:
        sums.add(("alone", "alone", 0), hessian)
        sums.add_gradient("camera_alone", gradient)
        if sizes.intrinsics:
            none = jnp.zeros((frames, 6, 1), dtype)
            more = jnp.zeros((frames, 6, 10), dtype)
            mixed = jnp.concatenate([none, mixed, more], axis=-1)
            sums.add(("alone", "globals", 0), mixed)
    return tuple(tables)


def _with_scale(hessian, gradient):
    return jnp.pad(hessian, ((1, 0), (1, 0))), jnp.pad(gradient, (1, 0))


def frames_of(first_chunk: Array, width: int) -> Array:
    """Frames that each group spans, `n f`."""
    within = jnp.arange(width * CHUNK, dtype=first_chunk.dtype)
    return first_chunk[:, None] * CHUNK + within


def project_table(state, bucket, frame, intrinsics_jacobian=False):
    """Pixels of a bucket and derivatives by point and intrinsics; arrays `n f g`."""
    camera = state.cameras[frame]
    points = state.landmarks[bucket.landmark]
    offset = [points[:, None, :, i] - camera[:, :, None, i, 3] for i in range(3)]
    p_C = jnp.stack(
        [sum(camera[:, :, None, j, i] * offset[j] for j in range(3)) for i in range(3)],
        axis=-1,
    )
    return p_C, camera


def _bucket(problem, loss, bucket, seen, frame, state, sizes):
    p_C, camera = project_table(state, bucket, frame)
    intrinsics = state.intrinsics
    basis = [jnp.broadcast_to(e, p_C.shape) for e in jnp.eye(3, dtype=p_C.dtype)]
    pixel, push = jax.linearize(lambda p: project(intrinsics, p), p_C)
    by_point = [push(e) for e in basis]
    error = (pixel - seen.pixel) * seen.weight[..., None]
    s = jnp.sum(error**2, axis=-1)
    root_weight = jnp.sqrt(loss.weight(s))
    total_rho = jnp.sum(loss.rho(s))
    residual = [error[..., i] * root_weight for i in range(2)]
    a = [[d[..., i] * (seen.weight * root_weight) for d in by_point] for i in range(2)]
    x, y, z = (p_C[..., i] for i in range(3))
    rotation = lambda i, j: camera[:, :, None, i, j]
    # dp_C/dl = C^T, dp_C/dr' = -C^T, dp_C/dω = [p_C]x for C Exp(ω)
    by_l = [
        [sum(a[i][k] * rotation(j, k) for k in range(3)) for j in range(3)]
        for i in range(2)
    ]
    free_c = problem.free.cameras[frame]
    by_c = [
        [
            a[i][1] * z - a[i][2] * y,
            a[i][2] * x - a[i][0] * z,
            a[i][0] * y - a[i][1] * x,
            *(-by_l[i][j] for j in range(3)),
        ]
        for i in range(2)
    ]
    by_c = [[d[j] * free_c[:, :, None, j] for j in range(6)] for d in by_c]
    free_l = problem.free.landmarks[bucket.landmark]
    if "cameras" not in sizes.variables:
        by_c = [[jnp.zeros_like(v) for v in d] for d in by_c]
    by_l = [[d[j] * free_l[:, None, :, j] for j in range(3)] for d in by_l]
    dot = lambda u, v: u[0] * v[0] + u[1] * v[1]
    pick = lambda d, j: (d[0][j], d[1][j])
    cross = jnp.stack(
        [
            jnp.stack([dot(pick(by_c, i), pick(by_l, j)) for j in range(3)], axis=2)
            for i in range(6)
        ],
        axis=2,
    )
    symmetric = lambda d, n, axis: _symmetric(
        lambda i, j: jnp.sum(dot(pick(d, i), pick(d, j)), axis=axis), n
    )
    own = symmetric(by_l, 3, 1)
    gradient = [jnp.sum(dot(pick(by_l, j), residual), axis=1) for j in range(3)]
    hessian = jnp.moveaxis(symmetric(by_c, 6, 2), (1, 2), (2, 3))
    camera_gradient = jnp.stack(
        [jnp.sum(dot(pick(by_c, j), residual), axis=2) for j in range(6)], axis=-1
    )
    count = sizes.intrinsics
    by_i = [[], []]
    if count:
        by = jax.jacfwd(lambda k: project(k, p_C))(intrinsics)
        factor = seen.weight * root_weight
        by_i = [
            [by[..., i, j] * factor * problem.free.intrinsics[j] for j in range(count)]
            for i in range(2)
        ]
    stack = lambda rows, axis: jnp.stack(rows, axis=axis)
    n, g = bucket.landmark.shape
    to_landmarks = jnp.zeros((n, 0, 3, g), p_C.dtype)
    extra = ()
    if count:
        to_landmarks = stack(
            [
                stack(
                    [
                        jnp.sum(dot(pick(by_i, i), pick(by_l, j)), axis=1)
                        for j in range(3)
                    ],
                    1,
                )
                for i in range(count)
            ],
            1,
        )
        mixed = stack(
            [
                stack(
                    [
                        jnp.sum(dot(pick(by_c, i), pick(by_i, j)), axis=2)
                        for j in range(count)
                    ],
                    -1,
                )
                for i in range(6)
            ],
            -2,
        )
        total = _symmetric(
            lambda i, j: jnp.sum(dot(pick(by_i, i), pick(by_i, j))), count, axis=0
        )
        total_gradient = stack(
            [jnp.sum(dot(pick(by_i, j), residual)) for j in range(count)], 0
        )
        extra = (mixed, total, total_gradient)
    table = LandmarkBlocks(cross, to_landmarks, own, stack(gradient, 1))
    return (table, hessian, camera_gradient, *extra), total_rho


def _symmetric(entry, n, axis=1):
    """Stacks `entry(i, j)` into a symmetric matrix at `axis`, each computed once."""
    upper = {(i, j): entry(i, j) for i in range(n) for j in range(i, n)}
    rows = [
        jnp.stack([upper[min(i, j), max(i, j)] for j in range(n)], axis=axis)
        for i in range(n)
    ]
    return jnp.stack(rows, axis=axis)
