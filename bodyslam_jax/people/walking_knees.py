"""Knees of people who walk: a lasting error of their guess is taken out.

Seen by one camera, a leg that is bent by ten degrees more and one that is a few per
cent shorter look alike. So keypoints hardly determine how much the leg that stands is
bent over a whole clip, and the guess of postures (`lift`) decides: it bends those of
real people by 3 to 11 degrees too much. Walkers are known better: the knee of the leg
that stands is bent by 21 ± 4 degrees among people. Both are combined, and the guess of
standing legs is shifted so that the fit has their mean.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from bodyslam_jax import motion
from bodyslam_jax.body import BodyModel, local_joints
from bodyslam_jax.body.skeleton import ANKLES
from bodyslam_jax.geometry.runs import runs
from bodyslam_jax.people.trajectory_fit import Chain, ChainProblem

_DEGREE = np.pi / 180
_USUAL, _AMONG_PEOPLE = 21.0 * _DEGREE, 4.0 * _DEGREE
"""Mean and standard deviation, among the eleven subjects of CMU's walks that train the
motion model, of the first coordinate of the knee's rotation while that leg alone
stands: `tools/walking_knees.py` gives 20.4 ± 3.6, of which these are upper bounds. (The
leg of the body model at rest is bent by 4 degrees the other way.)"""
_GUESS = 7.0 * _DEGREE
"""Standard deviation of the lasting error of the guess: 3 degrees in rendered people,
up to 11 in real ones."""
_STANDS = 0.6
"""Probability of heel and toe from which a leg stands."""
_LEAST = 0.1
"""Share of the frames in which each leg must stand alone, for a person to walk."""
_SHORTEST = 0.2
"""By how much the pelvis must pass over the foot that stands, leg lengths: people who
dance, box or walk backwards bend their knees otherwise. A length and not a speed, so
that slow motion does not matter."""
_RESPONSE = 0.6
"""By how much the knees of the fit follow those of the guess."""
_ROUNDS = 2
"""Fits with a shifted guess."""
_CROUCH = (-0.5, 1.0, -0.5)
"""By how much hip, knee and ankle turn about the axis to the left, for a knee that
bends by one while trunk and foot keep their direction."""
_LEGS = ((1, 4, 7), (2, 5, 8))
"""Hip, knee and ankle."""

Solve = Callable[[ChainProblem, Chain], tuple[Chain, Float[Array, ""]]]


class Walk(NamedTuple):
    """A fit of somebody who walks."""

    bend: float
    """Of the knee of the leg that alone stands, mean over frames and of both legs, rad.
    """
    stands: Float[np.ndarray, "t 2"]
    """Probability of each leg to stand."""


def with_walking_knees(
    problem: ChainProblem,
    solved: tuple[Chain, Float[Array, ""]],
    solve: Solve,
    body: BodyModel,
    fps: float,
) -> tuple[Chain, Float[Array, ""]]:
    """The fit whose standing knees are as bent as fit and gait together tell.

    `solved` is the fit with the guess as it is; it is returned for people who do not
    walk, and with a body that the contact network was not trained on.
    """
    contacts = motion.load_contact_model()
    if contacts.body != body.kind:
        return solved
    clock = motion.make_clock(np.arange(len(problem.sigma)) / fps, contacts.fps)
    look = lambda chain: find_walk(problem, chain, (contacts, clock), body)
    walk = look(solved[0])
    if walk is None:
        return solved
    share = _GUESS**2 / (_GUESS**2 + _AMONG_PEOPLE**2)
    wanted = walk.bend + share * (_USUAL - walk.bend)
    legs = _crouches(np.asarray(problem.scene.prior.basis, float))
    for _ in range(_ROUNDS):
        step = (wanted - walk.bend) / _RESPONSE * walk.stands @ legs
        step = jnp.asarray(step, problem.lifted.latent.dtype)
        problem = eqx.tree_at(
            lambda p: p.lifted.latent, problem, problem.lifted.latent + step
        )
        chain = eqx.tree_at(
            lambda c: c.fit.latent, solved[0], solved[0].fit.latent + step
        )
        again = solve(problem, chain)
        after = look(again[0])
        if after is None:
            break
        solved, walk = again, after
    return solved


def find_walk(
    problem: ChainProblem,
    chain: Chain,
    contacts: tuple[motion.ContactModel, motion.Clock],
    body: BodyModel,
) -> Walk | None:
    """How a person walks; `None` where legs do not stand in turns, or the pelvis does
    not go forwards over them."""
    seen = np.flatnonzero(np.isfinite(np.asarray(problem.sigma)).any(axis=1))
    present = np.arange(problem.sigma.shape[0]) <= seen[-1]
    fit, shape = chain.fit, chain.shape[:10]
    poses = problem.scene.prior.decode(fit.latent)
    probability, ahead = _legs(
        contacts, body, fit.orientation, poses, shape, jnp.asarray(present)
    )
    stands = _stands(np.asarray(probability))
    alone = alone_of(np.asarray(probability))
    if (alone[present].mean(axis=0) < _LEAST).any():
        return None
    if _stride(np.asarray(ahead), alone) < _SHORTEST:
        return None
    return Walk(bend_of(np.asarray(poses), alone), stands)


def _stands(probability: Float[np.ndarray, "t 4"]) -> Float[np.ndarray, "t 2"]:
    """Probability of each leg to stand on toe and heel."""
    return probability.reshape(-1, 2, 2).min(axis=-1)


def alone_of(probability: Float[np.ndarray, "t 4"]) -> Bool[np.ndarray, "t 2"]:
    """Frames in which each leg stands and the other does not, by the contact network's
    probabilities."""
    stands = _stands(probability)
    return (stands > _STANDS) & (stands[:, ::-1] <= _STANDS)


def bend_of(
    body_pose: Float[np.ndarray, "t 23 3"], alone: Bool[np.ndarray, "t 2"]
) -> float:
    """Bend of the knee of the leg that alone stands: the first coordinate of its
    rotation, mean over frames and of both legs, rad."""
    bend = body_pose[:, [3, 4], 0]
    return float(np.mean([bend[alone[:, leg], leg].mean() for leg in range(2)]))


def _stride(ahead: Float[np.ndarray, "t 2"], alone: Bool[np.ndarray, "t 2"]) -> float:
    """By how much the pelvis passes over the ankle of a leg while that alone stands,
    leg lengths; the median over stances."""
    found = [
        ahead[stance.start, leg] - ahead[stance.stop - 1, leg]
        for leg in range(2)
        for stance in runs(alone[:, leg])
    ]
    return float(np.median(found))


def _crouches(basis: Float[np.ndarray, "63 k"]) -> Float[np.ndarray, "2 k"]:
    """Change of the latent posture for a knee that bends by one radian, of each leg."""
    crouch = np.zeros((2, len(basis)))
    for leg, joints in enumerate(_LEGS):
        for joint, turn in zip(joints, _CROUCH, strict=True):
            crouch[leg, 3 * (joint - 1)] = turn
    return np.linalg.lstsq(basis, crouch.T, rcond=None)[0].T


@eqx.filter_jit
def _legs(
    contacts: tuple[motion.ContactModel, motion.Clock],
    body: BodyModel,
    orientation: Float[Array, "t 3 3"],
    poses: Float[Array, "t 23 3"],
    shape: Float[Array, " 10"],
    present: Bool[Array, " t"],
) -> tuple[Float[Array, "t 4"], Float[Array, "t 2"]]:
    """Probability of toes and heels to stand, and how far ahead of the pelvis ankles
    are, in leg lengths."""
    probability = motion.contact_between(
        contacts, body, orientation, poses, shape, present
    )
    joints = jax.vmap(lambda pose: local_joints(body, pose, shape))(poses)
    ahead = joints[:, np.array(ANKLES), 2] / motion.leg_length(body, shape)
    return probability, ahead
