"""Summary and verdict of a result."""

import dataclasses

import estimates
import numpy as np
import pytest

from bodyslam_jax import simulation
from bodyslam_jax.body import load_body_model
from bodyslam_jax.config import Config, Simulation
from bodyslam_jax.diagnostics import Gait, verdict
from bodyslam_jax.pipeline.run import assemble
from bodyslam_jax.types import ScaleStart


@pytest.mark.slow
def test_cues_that_contradict_bound_the_scale_sigma_from_below():
    made = simulation.simulate(Simulation(sequence="M1", length=15))
    sequence, body, config = simulation.as_sequence(made), load_body_model(), Config()
    cameras = estimates.still_camera(sequence)

    def found(motion: float, sigma: float) -> tuple[dict, str]:
        start = ScaleStart(motion, 0.1, ground=3.0, ground_error=0.1)
        joint = dataclasses.replace(
            estimates.standing_people(sequence), start=start, scale_sigma=sigma
        )
        moving = dataclasses.replace(cameras, kind="moving")
        summary = assemble(sequence, config, body, moving, joint, {}).summary
        lines.append(summary["headline"][1])
        return summary["scale"], " ".join(summary["warnings"])

    lines = []
    scale, warnings = found(2.0, 0.03)
    assert scale["sigma"] == pytest.approx(np.log(1.5) / 2)
    assert scale["sigma_of_covariance"] == 0.03 and "no better than" in warnings
    scale, warnings = found(2.9, 0.03)
    assert scale["sigma"] == 0.03 and "no better than" not in warnings
    assert found(2.0, 0.4)[0]["sigma"] == 0.4
    assert np.isnan(found(2.0, np.nan)[0]["sigma"])
    found(2.9, 4.0)
    found(2.9, 1e-5)
    value = scale["value"]
    shares = [f" m ± {100 * s / value:.0f} % in" for s in (np.log(1.5) / 2, 0.03, 0.4)]
    for line, part in zip(
        lines, [*shares, " m in", " m, of no known size, in", " m ± 1 % in"]
    ):
        assert part in line


@pytest.mark.slow
def test_pixel_noise_is_reported_only_where_it_was_measured():
    made = simulation.simulate(Simulation(sequence="M1", length=15))
    sequence, body, config = simulation.as_sequence(made), load_body_model(), Config()
    joint = estimates.standing_people(sequence)
    for kind, expected in (("static", None), ("rotation", None), ("moving", 0.7)):
        cameras = estimates.still_camera(sequence)
        cameras = dataclasses.replace(cameras, kind=kind, pixel_sigma=0.7)
        found = assemble(sequence, config, body, cameras, joint, {}).summary
        assert found["pixel_sigma"] == expected


@pytest.mark.slow
def test_the_summary_names_people_and_frames_that_are_left_out():
    made = simulation.simulate(Simulation(sequence="M1", length=15))
    sequence, body, config = simulation.as_sequence(made), load_body_model(), Config()
    joint = estimates.standing_people(sequence)
    moved = joint.cameras.copy()
    moved[:, 0, 3] = np.linspace(0, 3, 15)
    nobody = np.zeros_like(joint.present)
    joint = dataclasses.replace(joint, cameras=moved, status="ran out of steps")

    def found(joint, first, last, kind="moving"):
        cameras = estimates.still_camera(sequence)
        located = (np.arange(15) >= first) & (np.arange(15) <= last)
        cameras = dataclasses.replace(cameras, kind=kind, registered=located)
        return assemble(sequence, config, body, cameras, joint, {}).summary

    # These people fit no keypoints, which is a reason as well.
    about = {"people", "frames_used"}
    names = lambda summary: [
        r["name"] for r in summary["reasons"] if r["name"] in about
    ]
    whole = found(joint, 0, 14)
    assert names(whole) == []
    assert whole["frames_used"] == [0, 14]
    assert any("may not be the best: ran out of steps" in w for w in whole["warnings"])
    # Seven of fourteen steps are half of the way.
    part = found(joint, 0, 7)
    assert names(part) == [] and "camera: 1.5" in part["headline"][1]
    assert "camera: 3.0" in whole["headline"][1]
    assert part["frames_used"] == [0, 7]
    short = found(joint, 9, 14)
    assert short["status"] == "doubtful" and names(short) == ["frames_used"]
    assert "9 to 14 of 15 are used" in short["reasons"][0]["message"]
    lost = found(joint, 0, 14, "failed")
    assert lost["status"] == "failed" and lost["reasons"][0]["name"] == "camera_motion"
    empty = found(dataclasses.replace(joint, present=nobody), 0, 14)
    assert any("person 0 is left out" in w for w in empty["warnings"])
    assert not any("person 0" in line for line in empty["headline"])
    assert empty["people"][0]["stature_m"] is None
    assert whole["people"][0]["stature_m"] > 1
    unknown = dataclasses.replace(joint, present=nobody, scale_sigma=np.inf)
    empty = found(unknown, 0, 14)
    assert empty["status"] == "doubtful" and names(empty) == ["people"]
    assert "no people" in empty["reasons"][0]["message"]
    assert " m, of no known size, in" in empty["headline"][1]
    assert any("frames 0 to 7 of 15 are used" in w for w in part["warnings"])
    assert not any("are used" in w for w in whole["warnings"])


def test_an_undetermined_scale_is_doubtful_and_a_negative_one_failed():
    made = simulation.simulate(Simulation(sequence="M1", length=15))
    sequence, body, config = simulation.as_sequence(made), load_body_model(), Config()
    joint = estimates.standing_people(sequence)
    cameras = dataclasses.replace(estimates.still_camera(sequence), kind="moving")

    def verdict_on(**changes):
        one = dataclasses.replace(joint, **changes)
        found = assemble(sequence, config, body, cameras, one, {}).summary
        about = [r["name"] for r in found["reasons"]]
        about = [n for n in about if n.startswith(("scale_", "height_over_"))]
        return found["status"], about

    known = ScaleStart(motion=2.0, motion_error=0.1)
    assert verdict_on(start=known, scale_sigma=0.05)[1] == []
    assert verdict_on(start=ScaleStart(), scale_sigma=0.05)[1] == ["scale_unknown"]
    climbed = ScaleStart(ground=2.0, ground_error=0.3, climbing=True)
    sure = lambda start: verdict_on(start=start, scale_sigma=0.05)[1]
    assert sure(climbed) == ["height_over_ground"]
    level = dataclasses.replace(climbed, climbing=False)
    walked = dataclasses.replace(climbed, motion=2.0, motion_error=0.1)
    long = dataclasses.replace(climbed, ground_error=0.1)
    assert not any(sure(start) for start in (level, walked, long))
    turned = verdict_on(start=known, scale=-3.0, scale_sigma=-0.1)
    assert turned == ("failed", ["scale_sign"])


def test_implausibly_slow_steps_cause_a_warning(monkeypatch):
    made = simulation.simulate(Simulation(sequence="M1", length=15))
    sequence, body, config = simulation.as_sequence(made), load_body_model(), Config()
    joint = dataclasses.replace(estimates.standing_people(sequence), scale_sigma=np.nan)
    cameras = estimates.still_camera(sequence)
    found = lambda: assemble(sequence, config, body, cameras, joint, {}).summary
    assert found()["people"][0]["steps_per_s"] is None  # half a second
    monkeypatch.setattr(verdict, "gait", lambda *_: Gait(0.7, 0.9, 0.8))
    summary = found()
    assert summary["people"][0]["steps_per_s"] == 0.7
    assert any("person 0 takes 0.7 steps a second" in w for w in summary["warnings"])
