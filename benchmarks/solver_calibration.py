"""Are the solver's covariances as large as its errors? On simulated noise."""

import numpy as np
from solver_scene import make

import bodyslam_jax.graph as g
from bodyslam_jax.solver import Stage, marginals, solve


def calibration(frames, draws, noise=1.0, robust=False):
    """Errors over what the covariances say, on simulated noise that is as the weights
    have it: per group the mean normalised error squared (1 is right) and the share of
    coordinates within 1.96 standard deviations (0.95 is right). `robust`: with gross
    outliers among the pixels, and robust losses."""
    how = {} if robust else dict(outliers=0.0, loss=g.Squared())
    squares, inside = {}, {}
    for draw in range(draws):
        scene = make(frames, draw=draw, noise=noise, **how)
        problem, truth, _ = scene
        found = solve(problem, truth, schedule=(Stage(rtol=1e-9),)).state
        spread = marginals(problem, found)
        rows = {
            "scale": (scale(found) - scale(truth), spread.scale[None]),
            "cameras": (
                metric(found, "cameras") - metric(truth, "cameras"),
                spread.cameras,
            ),
            "people": (places(found) - places(truth), spread.people),
            "shape": (found.shapes - truth.shapes, spread.shapes),
            "landmarks": (
                metric(found, "landmarks") - metric(truth, "landmarks"),
                spread.landmarks,
            ),
        }
        for name, (error, covariance) in rows.items():
            error, covariance = np.atleast_1d(error), np.asarray(covariance)
            d = error.shape[-1]
            error = error.reshape(-1, d)
            covariance = covariance.reshape(-1, d, d)
            deviation = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
            # The gauge is exact, and what is not seen is not known at all.
            known = (deviation > 1e-9).all(axis=1) & (deviation < 1.0).all(axis=1)
            solved = np.linalg.solve(covariance[known], error[known][..., None])[..., 0]
            squares.setdefault(name, []).extend(np.sum(error[known] * solved, 1) / d)
            share = abs(error[known]) < 1.96 * deviation[known]
            inside.setdefault(name, []).extend(share.ravel())
    kind = "robust losses" if robust else "squared losses"
    print(f"{frames} frames, {draws} draws of {noise:g} times the noise, {kind}")
    for name, values in squares.items():
        print(f"  {name:10s} {np.mean(values):6.3f} {np.mean(inside[name]):6.3f}")
    return {name: (np.mean(v), np.mean(inside[name])) for name, v in squares.items()}


def scale(state):
    return np.asarray(state.scale)


def metric(state, name):
    """Camera centres or landmarks in metres."""
    value = np.asarray(getattr(state, name))
    return scale(state) * (value[:, :3, 3] if name == "cameras" else value)


def places(state):
    """Pelvis joints in the world, m: `s r'_WC + C_WC r_CH`."""
    cameras, roots = np.asarray(state.cameras), np.asarray(state.roots)
    turned = np.einsum("tij,htj->hti", cameras[:, :3, :3], roots[..., :3, 3])
    return metric(state, "cameras") + turned
