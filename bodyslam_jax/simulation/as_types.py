"""A simulated sequence as the types of the pipeline: measurements and truth."""

import numpy as np

from bodyslam_jax.simulation.sequences import SimulatedSequence
from bodyslam_jax.types import Bodies, Intrinsics, Keypoints, Result, Sequence


def as_sequence(simulated: SimulatedSequence) -> Sequence:
    """The measurements, as the readers return them; without a video."""
    actors, t = simulated.actors, simulated.num_frames
    present = np.zeros((len(actors), t), bool)
    poses, shapes = np.zeros((len(actors), t, 72)), np.zeros((len(actors), t, 10))
    trans = np.zeros((len(actors), t, 3))
    for h, actor in enumerate(actors):
        bodies = actor.bodies
        present[h, bodies.frame] = True
        poses[h, bodies.frame] = bodies.poses
        shapes[h, bodies.frame] = bodies.shapes
        trans[h, bodies.frame] = bodies.trans
    uv, confidence = (np.stack([a.keypoints[i] for a in actors]) for i in range(2))
    return Sequence(
        name=simulated.name,
        frames=None,
        timestamps=simulated.timestamps,
        intrinsics=Intrinsics(simulated.intrinsics, *simulated.size),
        keypoints=Keypoints(uv, confidence),
        bodies=Bodies(present, poses, shapes, trans, shapes_regressed(simulated)),
        tracks=simulated.tracks,
    )


def as_truth(simulated: SimulatedSequence) -> Result:
    """The truth, as the result that an estimate is evaluated against."""
    return Result(
        timestamps=simulated.timestamps,
        T_WC=simulated.T_WC,
        scale=1.0,
        intrinsics=simulated.intrinsics,
        landmarks=simulated.landmarks,
        poses=np.stack([a.poses for a in simulated.actors]),
        trans=np.stack([a.trans for a in simulated.actors]),
        betas=np.stack([a.person.shape for a in simulated.actors]),
        joints=np.stack([a.joints for a in simulated.actors]),
        present=np.ones((len(simulated.actors), simulated.num_frames), bool),
    )


def shapes_regressed(simulated: SimulatedSequence) -> bool:
    """Whether shapes are those of a regressor, not the true ones."""
    settings = simulated.settings
    return (settings.body_noise or settings.noise) != "none"
