"""What the measurements do not determine, by name."""

import numpy as np

from bodyslam_jax.graph import Problem, State, world_from_root
from bodyslam_jax.solver._covariance import Marginals


def observability(problem: Problem, state: State, spread: Marginals) -> tuple[str, ...]:
    """What the measurements do not determine, one line each; empty if all is well.

    A direction counts as not determined where its standard deviation is more than a
    third of the thing itself.
    """
    deviation = lambda x: np.sqrt(np.maximum(np.trace(x, axis1=-2, axis2=-1), 0.0))
    found = []
    cameras = np.asarray(state.cameras)
    s = float(state.scale)
    centres = s * cameras[:, :3, 3]
    reach = float(np.max(np.linalg.norm(centres - centres[0], axis=1), initial=0.0))
    if "scale" in problem.variables:
        share = float(np.sqrt(max(float(spread.scale), 0.0))) / s
        if not share < 1 / 3:
            found.append(
                f"scale: known to {share:.0%} only; the person or the camera hardly "
                "moves, or nothing links them."
            )
    if len(state.landmarks) and "landmarks" in problem.variables:
        seen = np.zeros(len(state.landmarks), bool)
        for bucket in problem.layout.buckets:
            index = np.asarray(bucket.landmark).ravel()
            seen[index[index < len(seen)]] = True
        if not seen.all():
            found.append(f"landmarks: {int((~seen).sum())} are not observed.")
        points = s * np.asarray(state.landmarks)
        depth = np.linalg.norm(points - centres.mean(axis=0), axis=1)
        lost = seen & ~(deviation(np.asarray(spread.landmarks)) < depth / 3)
        if lost.sum() > 0.5 * seen.sum():
            found.append(
                f"depth of {int(lost.sum())} of {int(seen.sum())} landmarks: the "
                "camera turns but does not move."
            )
        elif lost.any():
            found.append(f"depth of {int(lost.sum())} landmarks: seen from one place.")
    if "cameras" in problem.variables:
        lost = ~(deviation(np.asarray(spread.cameras)) < max(reach, 1e-9) / 3)
        if lost[1:].any():
            found.append(
                f"centres of {int(lost[1:].sum())} cameras: too few points, or the "
                "camera hardly moves."
            )
    if "roots" in problem.variables:
        for person in range(len(state.roots)):
            place = np.asarray(world_from_root(state))[person, :, :3, 3]
            distance = np.linalg.norm(place - centres, axis=1)
            lost = ~(deviation(np.asarray(spread.people[person])) < distance / 3)
            if problem.motion is not None:
                lost &= np.asarray(problem.motion.present[person])
            if lost.any():
                found.append(f"place of person {person} in {int(lost.sum())} frames.")
    return tuple(found)
