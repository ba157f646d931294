"""Stages run beforehand on made-up numbers, so that what they need is compiled."""

import threading

import jax
import numpy as np
import pytest

from bodyslam_jax import evaluation, people, rehearsal, simulation, view
from bodyslam_jax.body import load_body_model
from bodyslam_jax.config import Config, Simulation
from bodyslam_jax.initialisation import first_state
from bodyslam_jax.pipeline import joint_stage
from bodyslam_jax.pipeline.to_metric import assemble
from bodyslam_jax.rehearsal import Rehearsal

_COMPILED = "/jax/core/compile/backend_compile_duration"
_LONG = {"_at_rest", "_place_bodies", "<lambda>", "joints", "local_keypoints"}
_LONG |= {"evaluate_trajectories", "_pose"}
_LONG = {f"jit({name})" for name in _LONG}


def test_a_stage_waits_for_its_own_part_and_for_no_other():
    go, done = threading.Event(), []
    parts = {
        "first": lambda: done.append("first"),
        "broken": lambda: done.append(1 / 0),
        "second": lambda: (go.wait(60), done.append("second")),
        "never": lambda: done.append("never"),
    }
    begun = Rehearsal(parts)
    begun.wait("first")
    begun.wait("broken")
    begun.wait("no such part")
    assert done == ["first"]
    begun.stop()
    go.set()
    begun.wait("second")
    assert done == ["first", "second"]


@pytest.mark.slow
def test_what_was_rehearsed_is_not_compiled_again(quick_compilation):
    jax.clear_caches()  # of other tests, which compile the same
    scene = simulation.simulate(Simulation(sequence="M1", family="follow", length=15))
    sequence, truth = simulation.as_sequence(scene), simulation.as_truth(scene)
    body, config = load_body_model(), Config()
    compiled = set()

    def note(event: str, seconds: float, **of: object) -> None:
        if event == _COMPILED:
            compiled.add(of.get("fun_name"))

    jax.monitoring.register_event_duration_secs_listener(note)
    try:
        begun = rehearsal.rehearse(sequence, body, config, truth)
        for part, rehearsed in begun._parts.items():
            assert rehearsed.exception() is None, part
        assert _LONG <= compiled
        compiled.clear()
        bodies = people.prepare_bodies(
            sequence.bodies, sequence.keypoints, sequence.intrinsics, body, sequence.fps
        )
        roots = people.roots_from_bodies(bodies, body)
        state = first_state(
            scene.T_WC, np.ones((77, 3)), roots, sequence.intrinsics.params
        )
        joint_stage.predict(
            joint_stage.motion_predictor(sequence, roots, body, config), state
        )
        cameras, found = rehearsal._cameras(sequence), rehearsal._joint(sequence)
        result = assemble(sequence, config, body, cameras, found, {})
        evaluation.evaluate(result, truth)
        view.draw_frame(np.zeros((480, 640, 3), np.uint8), result, body, 3)
    finally:
        jax.monitoring.unregister_event_duration_listener(note)
    assert not _LONG & compiled
