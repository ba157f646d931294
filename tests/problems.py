"""Small problems that tests of the solver share, and their dense equations."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scenes
import scipy.sparse.linalg
from jax.flatten_util import ravel_pytree
from own_factors import CameraSmoothness

import bodyslam_jax.graph as g
from bodyslam_jax.body import local_keypoints
from bodyslam_jax.geometry.camera import project
from bodyslam_jax.solver.blocks import mask_of, sizes_of
from bodyslam_jax.solver.compilation import compiled, quick_options
from bodyslam_jax.solver.levenberg_marquardt import lifted
from bodyslam_jax.solver.linear_system import damped, diagonals, eliminate, solve_step
from bodyslam_jax.solver.linearise import linearise
from bodyslam_jax.solver.linearise.landmark import gather

# One scene serves most tests, as shapes decide what is compiled.
SEED = 2


def make(
    seed=SEED,
    people=0,
    frames=7,
    landmarks=25,
    extras=False,
    known=False,
    noise=1.0,
    length=8,
    again=False,
    far=0,
    steady=False,
    some_held=False,
    **options,
):
    rng = np.random.default_rng(seed)
    state = scenes.truth(rng, frames, people, landmarks)
    # The loss as an array: a test that differentiates by it compiles nothing anew.
    loss = jnp.asarray(1.5)
    factors = [scenes.reprojection(rng, state, 0.5 * noise, length, loss, again, far)]
    if people:
        factors += scenes.person_factors(rng, state, noise=noise)
    if known:
        factors.insert(0, scenes.landmark_prior(rng, state, factors[0]))
    if steady:
        sigma = jnp.full((frames, 2), 0.05).at[:2].set(jnp.inf)
        factors.append(CameraSmoothness(sigma=sigma))
    if extras:
        more = lambda state: scenes.extra_factors(rng, state, factors[0])
        factors += eqx.filter_jit(more, compiler_options=quick_options())(state)
    problem = g.make_problem(factors, state, **options)
    if some_held:
        problem = eqx.tree_at(lambda p: p.free, problem, hold_some(problem.free))
    return problem, state, scenes.perturb(rng, problem, state)


def hold_some(free):
    """A turn of a root, a joint in some frames and a coordinate of shape, held too."""
    return dataclasses.replace(
        free,
        roots=free.roots.at[:, 3, 1].set(0.0),
        poses=free.poses.at[:, 5:8, 4].set(0.0),
        shapes=free.shapes.at[:, 1].set(0.0),
    )


def dense(problem, state):
    """Jacobian and residual of a problem in its free coordinates, without structure."""
    return tuple(np.asarray(x) for x in _dense(problem, state))


def _dense_of(problem, state):
    zero, unravel = ravel_pytree(state.zero_step())
    mask, _ = ravel_pytree(mask_of(problem))

    def residual(x):
        rows = lifted(state.retract(unravel(x * mask)), problem)
        flat = jnp.concatenate([r.reshape(-1) for r in rows])
        return flat, flat

    return jax.jacfwd(residual, has_aux=True)(zero)


_dense = compiled(_dense_of)


def normal_equations(jac, residual):
    """`JᵀJ` and `Jᵀr`, by sparse products: nearly all of thousands of rows is 0, and
    dense products take a minute."""
    jac = scipy.sparse.csr_array(jac)
    return (jac.T @ jac).toarray(), jac.T @ residual


def factorised(matrix):
    """The function that solves for right sides, by the sparse LU factors of SuperLU, of
    a matrix that is positive definite."""
    matrix = scipy.sparse.csc_array(matrix)
    factors = scipy.sparse.linalg.splu(
        matrix, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}
    )

    def solve(right):
        found = factors.solve(right)
        # Without pivots for accuracy: one step of refinement brings it back.
        return found + factors.solve(right - matrix @ found)

    return solve


def _bent_along(problem, state, way):
    """The product of what keypoints bend with a step."""
    mask = mask_of(problem)
    masked = lambda step: jax.tree.map(jnp.multiply, mask, step)

    def along(step, factor):
        """How far keypoints go along the pull that they are under at the state."""
        moved = state.retract(masked(step))
        p_H = local_keypoints(
            *(factor.body, moved.poses, moved.shapes[:, None]),
            *(factor.layout, factor.bias),
        )
        p_C = jnp.einsum("htij,htkj->htki", moved.roots[..., :3, :3], p_H)
        p_C = p_C + moved.roots[..., None, :3, 3]

        def loss(p):
            seen = project(state.intrinsics, p)
            off = (seen - factor.pixel) / factor.sigma[..., None]
            return 0.5 * jnp.sum(factor.loss.rho(jnp.sum(off**2, axis=-1)))

        return jnp.vdot(jax.lax.stop_gradient(jax.grad(loss)(p_C)), p_C)

    keypoints = [f for f in problem.factors if isinstance(f, g.KeypointReprojection)]
    slope = jax.grad(lambda step: sum(along(step, f) for f in keypoints))
    return jax.jvp(slope, (state.zero_step(),), (way,))[1]


_bent = compiled(_bent_along)


def bent(problem, state):
    """What keypoints bend of the cost, by differentiating twice; a matrix.

    No frame bends another: one product has a column of each frame and person.
    """
    zero = state.zero_step()
    flat, unravel = ravel_pytree(zero)
    place = jax.tree.map(np.asarray, unravel(jnp.arange(len(flat), dtype=float)))
    found = np.zeros((len(flat), len(flat)))
    if not any(isinstance(f, g.KeypointReprojection) for f in problem.factors):
        return found
    people, frames = state.roots.shape[:2]
    of_frames = lambda s: np.concatenate(
        [np.asarray(s.roots), np.asarray(s.poses).reshape(people, frames, 69)], axis=2
    )
    rows = of_frames(place).astype(int)
    for k in range(6 + 69):
        roots = zero.roots.at[..., k].set(1.0) if k < 6 else zero.roots
        poses = zero.poses.reshape(people, frames, 69)
        poses = poses.at[..., k - 6].set(1.0) if k >= 6 else poses
        way = dataclasses.replace(
            zero, roots=roots, poses=poses.reshape(zero.poses.shape)
        )
        found[rows, rows[..., [k]]] = of_frames(_bent(problem, state, way))
    for h, k in np.ndindex(people, 10):
        way = dataclasses.replace(zero, shapes=zero.shapes.at[h, k].set(1.0))
        line = ravel_pytree(_bent(problem, state, way))[0]
        at = int(place.shapes[h, k])
        found[at], found[:, at] = line, line
    return found


def _structured_step(problem, state, damping):
    sizes = sizes_of(problem, state)
    lin = linearise(problem, gather(problem), state)
    extra = damped(diagonals(lin, sizes), damping)
    whole = eliminate(problem, lin, sizes, extra)
    return solve_step(problem, state, lin, sizes, whole).step


structured_step = compiled(_structured_step)
