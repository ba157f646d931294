"""Fits all frames of one person at once, by Gauss--Newton on a chain.

Neighbouring frames are tied by second-order terms: the posture's autoregression and a
constant velocity of root position and orientation. Each ties one coordinate of frames
k, k-1, k-2, so that the off-diagonal blocks of the normal matrix are diagonal. Frames
are combined in pairs, which makes the matrix block-tridiagonal, and it is factorised by
a scan. The shape β forms a border. Damping is Levenberg's; steps that do not decrease
the cost are rejected.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bodyslam_jax.geometry import so3
from bodyslam_jax.people.costs import Fit, Lifted, Normal, Scene, linearise


class Ties(eqx.Module):
    """Temporal terms `w (y_k + c1 y_{k-1} + c2 y_{k-2})²`, per frame and coordinate."""

    weight: Float[Array, "t n"]
    """Weight of the term; 0 where frame k is not tied to earlier ones."""
    c1: Float[Array, "t n"]
    c2: Float[Array, "t n"]


class ChainProblem(eqx.Module):
    """Measurements and priors of one person in `t` frames (an even number); padding has
    `sigma = inf` and no ties."""

    scene: Scene
    uv: Float[Array, "t 25 2"]
    sigma: Float[Array, "t 25"]
    lifted: Lifted
    ties: Ties
    shape_weight: Float[Array, ""]
    """Precision of the prior on β."""


class Chain(eqx.Module):
    """Pose of one person in each frame, and the shape."""

    fit: Fit
    shape: Float[Array, " s"]


@eqx.filter_jit
def solve_chain(
    problem: ChainProblem, start: Chain, max_steps: int
) -> tuple[Chain, Float[Array, ""]]:
    """Returns the bodies at a local minimum of the cost, descending from `start`, and
    the cost."""

    def step(carry: tuple) -> tuple:
        chain, normal, value, damping, count, _ = carry
        moves = jnp.where(count > 0, 1.0, 0.0).astype(value.dtype)
        newton = _newton(problem, chain, normal, damping)
        proposal = _move(chain, *(moves * part for part in newton))
        found, new_value = _evaluate(problem, proposal)
        better = new_value < value
        choose = lambda a, b: jnp.where(better, a, b)
        chain, normal = jax.tree.map(choose, (proposal, found), (chain, normal))
        small = value - new_value < 1e-4 * jnp.abs(value)
        damping = jnp.where(better, damping / 4, damping * 8)
        done = (better & small) | (damping > 1e6)
        return chain, normal, jnp.minimum(new_value, value), damping, count + 1, done

    # The first iteration makes a zero step and evaluates the start, so that the
    # derivatives occur in the loop's body alone and are compiled once.
    like = jax.eval_shape(lambda: _evaluate(problem, start)[0])
    blank = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), like)
    infinite = jnp.asarray(jnp.inf, start.shape.dtype)
    damping = jnp.asarray(1e-2, start.shape.dtype)
    chain, _, value, *_ = jax.lax.while_loop(
        lambda c: (c[4] <= max_steps) & ~c[5],
        step,
        (start, blank, infinite, damping, 0, jnp.asarray(False)),
    )
    return chain, value


def _evaluate(problem: ChainProblem, chain: Chain) -> tuple[Normal, Float[Array, ""]]:
    """Returns each frame's normal equations, and the negative log posterior of all
    frames."""
    normal: Normal = jax.vmap(linearise, in_axes=(None, 0, None, 0, 0, 0))(
        problem.scene,
        chain.fit,
        chain.shape,
        problem.uv,
        problem.sigma,
        problem.lifted,
    )
    residual = _temporal(problem.ties, chain.fit)
    value = (
        jnp.sum(normal.cost)
        + 0.5 * jnp.sum(problem.ties.weight * residual**2)
        + 0.5 * problem.shape_weight * jnp.sum(chain.shape**2)
    )
    return normal, value


def _move(chain: Chain, step: Array, shape_step: Array) -> Chain:
    return Chain(chain.fit.moved(step), chain.shape + shape_step)


def _temporal(ties: Ties, fit: Fit) -> Float[Array, "t n"]:
    """Returns the residuals `y_k + c1 y_{k-1} + c2 y_{k-2}`.

    For orientations they are the change of the rotation between successive frames with
    c1 = -2, c2 = 1, and that rotation itself with c1 = -1, c2 = 0.
    """
    linear = jnp.concatenate([fit.position, fit.latent], axis=-1)
    before, earlier = _shifted(linear, 1), _shifted(linear, 2)
    linear = linear + ties.c1[:, 3:] * before + ties.c2[:, 3:] * earlier
    relative = fit.orientation @ jnp.swapaxes(_shifted(fit.orientation, 1), -1, -2)
    turn = so3.log(relative).at[0].set(0.0)
    return jnp.concatenate([turn - ties.c2[:, :3] * _shifted(turn, 1), linear], -1)


def _shifted(values: Array, by: int) -> Array:
    """Returns rows shifted so that row k is row k - by; the first row is repeated where
    no tie reaches."""
    return jnp.concatenate([values[:1]] * by + [values[:-by]])


def _newton(
    problem: ChainProblem, chain: Chain, normal: Normal, damping: Array
) -> tuple[Float[Array, "t n"], Float[Array, " s"]]:
    """Returns the Gauss--Newton step of the frames and of the shape, with β as
    border."""
    ties = problem.ties
    w, c1, c2 = ties.weight, ties.c1, ties.c2
    pull = w * _temporal(ties, chain.fit)
    w1, w2 = _ahead(w, 1), _ahead(w, 2)
    gradient = normal.gradient + pull + _ahead(c1 * pull, 1) + _ahead(c2 * pull, 2)
    diagonal = w + w1 * _ahead(c1, 1) ** 2 + w2 * _ahead(c2, 2) ** 2
    one_back = w * c1 + w1 * _ahead(c2 * c1, 1)
    two_back = w * c2

    size = w.shape[-1]
    eye = jnp.eye(size, dtype=w.dtype)
    hessian = normal.hessian + diagonal[:, :, None] * eye
    own = jnp.diagonal(hessian, axis1=-2, axis2=-1)
    hessian = hessian + (damping * own + 1e-6 * (1 + own))[:, :, None] * eye
    solved = _solve_banded(
        hessian,
        one_back,
        two_back,
        jnp.concatenate([-gradient[..., None], normal.cross], axis=-1),
    )
    step, response = solved[..., 0], solved[..., 1:]
    border = jnp.sum(normal.shape_hessian, 0)
    border_diagonal = jnp.diagonal(border) * damping + problem.shape_weight + 1e-6
    schur = (
        border
        + jnp.diag(border_diagonal)
        - jnp.einsum("tna,tnb->ab", normal.cross, response)
    )
    right = -(jnp.sum(normal.shape_gradient, 0) + problem.shape_weight * chain.shape)
    right = right - jnp.einsum("tna,tn->a", normal.cross, step)
    shape_step = jnp.linalg.solve(schur, right)
    return step - response @ shape_step, shape_step


def _ahead(values: Array, by: int) -> Array:
    """Returns rows shifted so that row k is row k + by, zero beyond the end."""
    return jnp.concatenate([values[by:], jnp.zeros_like(values[:by])])


def _solve_banded(
    diagonal: Float[Array, "t n n"],
    one_back: Float[Array, "t n"],
    two_back: Float[Array, "t n"],
    right: Float[Array, "t n c"],
) -> Float[Array, "t n c"]:
    """Solves the symmetric system whose blocks (k, k-1) and (k, k-2) are diagonal."""
    frames, size, columns = right.shape
    pairs = frames // 2
    spread = lambda d: d[..., :, None] * jnp.eye(size, dtype=d.dtype)
    even, odd = slice(0, None, 2), slice(1, None, 2)
    inner = spread(one_back[odd])
    blocks = jnp.block([[diagonal[even], inner], [inner, diagonal[odd]]])
    right = right.reshape(pairs, 2 * size, columns)
    identity = jnp.eye(2 * size, dtype=right.dtype)
    # The block before the diagonal, frames 2i, 2i+1 by frames 2i-2, 2i-1, is made of
    # diagonals, [[p, q], [0, r]], so that products with it are elementwise.
    back = jnp.stack([two_back[even], one_back[even], two_back[odd]], axis=1)
    back = back.at[0].set(0.0)

    def times(link: Array, m: Array) -> Array:
        p, q, r = link[:, :, None]
        return jnp.concatenate([p * m[:size] + q * m[size:], r * m[size:]])

    def transposed_times(link: Array, m: Array) -> Array:
        p, q, r = link[:, :, None]
        return jnp.concatenate([p * m[:size], q * m[:size] + r * m[size:]])

    def forward(carry: tuple, row: tuple) -> tuple:
        inverse, reduced = carry
        block, link, b = row
        fill = times(link, times(link, inverse).T)
        factor = jax.scipy.linalg.cho_factor(block - fill, lower=True)
        b = b - times(link, inverse @ reduced)
        inverse = jax.scipy.linalg.cho_solve(factor, identity)
        return (inverse, b), (inverse, b)

    start = (identity, jnp.zeros_like(right[0]))
    _, (inverses, reduced) = jax.lax.scan(forward, start, (blocks, back, right))

    def backward(carry: tuple, row: tuple) -> tuple:
        link_after, x_after = carry
        inverse, link, b = row
        x = inverse @ (b - transposed_times(link_after, x_after))
        return (link, x), x

    start = (jnp.zeros_like(back[0]), jnp.zeros_like(right[0]))
    _, solved = jax.lax.scan(backward, start, (inverses, back, reduced), reverse=True)
    return solved.reshape(frames, size, columns)
