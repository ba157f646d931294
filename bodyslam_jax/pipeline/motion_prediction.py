"""Predictions of the motion model and the contact network for one sequence."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from bodyslam_jax import graph, initialisation, motion
from bodyslam_jax.body import BodyModel
from bodyslam_jax.config import Config
from bodyslam_jax.geometry.lengths import padded_length, shortened
from bodyslam_jax.ground.stances import in_free_fall
from bodyslam_jax.people import PersonState
from bodyslam_jax.solver.compilation import compiled
from bodyslam_jax.types import Sequence


def motion_predictor(
    sequence: Sequence, roots: PersonState, body: BodyModel, config: Config
) -> graph.MotionPredictor:
    """Returns the motion model, resampled to the frame times of the sequence."""
    model = motion.load_motion_model(config.motion_model)
    clock = motion.make_clock(sequence.timestamps, model.fps)
    present = jnp.asarray(roots.present)
    return graph.MotionPredictor(motion.predict_between, (model, clock), body, present)


def contact_predictor(
    sequence: Sequence, roots: PersonState, body: BodyModel, config: Config
) -> graph.MotionPredictor | None:
    """Returns the contact network, resampled to the frame times of the sequence; `None`
    without `weights.contact_sigma`, or if it was not trained on this kind of body."""
    if not config.weights.contact_sigma:
        return None
    model = motion.load_contact_model()
    if model.body != body.kind:
        return None
    clock = motion.make_clock(sequence.timestamps, model.fps)
    present = jnp.asarray(roots.present)
    return graph.MotionPredictor(motion.contact_between, (model, clock), body, present)


def predict(predictor: graph.MotionPredictor, state: graph.State) -> Any:
    """Evaluates a predictor for the people of a state: returns a `motion.Prediction` of
    the motion model, or probabilities `h t 4` of the contact network."""
    # Predictions do not depend on landmarks. Without them, shapes depend on people
    # alone, so that maps of different sizes share one compiled program.
    none = jnp.zeros((0, 3), state.landmarks.dtype)
    state = eqx.tree_at(lambda s: s.landmarks, state, none)
    frames = len(state.cameras)
    longer = padded_length(frames)
    state = graph.extend_state(state, longer - frames)
    found = _predict(predictor.lengthened(longer), state)
    return shortened(found, frames, axis=1)


def contact_probability(
    predictor: graph.MotionPredictor, state: graph.State, fps: float
) -> Float[np.ndarray, "h t 4"]:
    """Returns the contact probabilities of toes and heels; 0 in free fall, which
    postures alone do not distinguish from a stance
    (`ground.stances.in_free_fall`)."""
    found = np.array(predict(predictor, state))
    present = np.asarray(predictor.present)
    pelvis = np.asarray(graph.world_from_root(state))[..., :3, 3]
    up = initialisation.mean_up(state, present)
    for h, there in enumerate(present):
        found[h, in_free_fall(pelvis[h], there, up, fps)] = 0.0
    return found


_predict = compiled(lambda predictor, state: predictor(state))
