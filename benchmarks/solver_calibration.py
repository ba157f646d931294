"""Are the solver's covariances as large as its errors? On simulated noise."""

import equinox as eqx
import numpy as np
from solver_scene import make

import bodyslam_jax.graph as g
from bodyslam_jax.solver import Stage, marginals, solve
from bodyslam_jax.solver.retriangulation import tracks_of

INLIERS = g.BlakeZisserman(4.5)
"""Of `robust` solutions' second half: what is no outlier keeps its weight."""


def calibration(frames, draws, noise=1.0, robust=False):
    """Errors over what the covariances say, on simulated noise that is as the weights
    have it: per group the mean normalised error squared (1 is right), the share of
    coordinates within 1.96 standard deviations (0.95 is right), the mean error in
    standard deviations (0 is right), and the median error.

    `robust`: with gross outliers among the pixels, and robust losses: those that a
    solve has by default, and from where they end `INLIERS` for landmarks.
    """
    how = {} if robust else dict(outliers=0.0, loss=g.Squared())
    errors = {"default": {}, "inliers": {}} if robust else {"squared": {}}
    for draw in range(draws):
        problem, truth, _ = make(frames, draw=draw, noise=noise, **how)
        found = truth
        for losses, groups in errors.items():
            if losses == "inliers":
                problem = eqx.tree_at(lambda p: tracks_of(p).loss, problem, INLIERS)
            found = solve(problem, found, schedule=(Stage(rtol=1e-9),)).state
            note(groups, problem, found, truth)
    result = {}
    for losses, groups in errors.items():
        print(f"{frames} frames, {draws} draws of {noise:g} times the noise, {losses}")
        result[losses] = {
            name: tell(name, *columns) for name, columns in groups.items()
        }
    return result


def tell(name, *draws):
    """Prints a group's line; its mean square and share inside."""
    square, inside, deviations, size = map(np.concatenate, zip(*draws))
    print(
        f"  {name:24s} {square.mean():8.3f} {inside.mean():6.3f} "
        f"{deviations.mean():+6.3f} {np.median(size):9.4f}"
    )
    return square.mean(), inside.mean()


def note(errors, problem, found, truth):
    """One draw's columns, per group."""
    spread = marginals(problem, found)
    error = lambda value: value(found) - value(truth)
    cameras, landmarks = metric("cameras"), metric("landmarks")
    # How far away a landmark is said to be is less uncertain where it is thought near.
    ray = landmarks(found) - cameras(found)[0]
    away = np.linalg.norm(ray, axis=1, keepdims=True)
    true_away = np.linalg.norm(landmarks(truth) - cameras(truth)[0], axis=1)
    along = np.einsum("li,lij,lj->l", ray, spread.landmarks, ray) / away[:, 0] ** 4
    one = lambda wrong, variance: (wrong[..., None], variance[..., None, None])
    rows = {
        "scale": one(error(scale), np.asarray(spread.scale)),
        "cameras, m": (error(cameras), spread.cameras),
        "people, m": (error(places), spread.people),
        "shape": (error(lambda state: np.asarray(state.shapes)), spread.shapes),
        "landmarks, m": (error(landmarks), spread.landmarks),
        "landmarks, log distance": one(np.log(away[:, 0] / true_away), along),
    }
    for name, (wrong, covariance) in rows.items():
        d = wrong.shape[-1]
        wrong = wrong.reshape(-1, d)
        covariance = np.asarray(covariance).reshape(-1, d, d)
        deviation = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        # The gauge is exact, and what is not seen is not known at all.
        known = (deviation > 1e-9).all(axis=1) & (deviation < 1.0).all(axis=1)
        wrong, covariance, deviation = wrong[known], covariance[known], deviation[known]
        solved = np.linalg.solve(covariance, wrong[..., None])[..., 0]
        of_one = (wrong / deviation).ravel()
        columns = (
            np.sum(wrong * solved, 1) / d,
            abs(of_one) < 1.96,
            of_one,
            abs(wrong).ravel(),
        )
        errors.setdefault(name, []).append(columns)


def scale(state):
    return np.asarray(state.scale)


def metric(name):
    """Camera centres or landmarks of a state, in metres."""

    def value(state):
        found = np.asarray(getattr(state, name))
        return scale(state) * (found[:, :3, 3] if name == "cameras" else found)

    return value


def places(state):
    """Pelvis joints in the world, m: `s r'_WC + C_WC r_CH`."""
    cameras, roots = np.asarray(state.cameras), np.asarray(state.roots)
    turned = np.einsum("tij,htj->hti", cameras[:, :3, :3], roots[..., :3, 3])
    return metric("cameras")(state) + turned
