"""From pixels alone: what the experiment measures, and how it tells it."""

import dataclasses

import numpy as np
import pytest

from bodyslam_jax import evaluation, simulation
from bodyslam_jax.body import KEYPOINT_NAMES, load_body_model
from bodyslam_jax.config import Config, Experiment
from bodyslam_jax.experiments import video
from bodyslam_jax.experiments.plans import PLANS
from bodyslam_jax.experiments.video import detection_figures
from bodyslam_jax.experiments.video_table import write_video
from bodyslam_jax.pipeline.stage_cache import fingerprint
from bodyslam_jax.types import Keypoints

NAMES = KEYPOINT_NAMES["body25"]


@pytest.fixture(scope="module")
def simulated():
    return simulation.simulate(
        simulation.Simulation(sequence="E3", length=90, seed=5, noise="none")
    )


def moved(simulated, name, offset):
    """Exact keypoints, but one is off by `offset` m in its joint's frame."""
    sequence = simulation.as_sequence(simulated)
    person, walk = simulated.person, simulated.walk
    G, joints = person.joints(walk.poses, walk.pelvis)
    k = NAMES.index(name)
    points = person.keypoints(G, joints)[:, k]
    j = {"left_knee": 4, "right_knee": 5}[name]
    points = points + G[:, j] @ np.array(offset)
    p = np.einsum(
        "tba,tb->ta", simulated.T_WC[:, :3, :3], points - simulated.T_WC[:, :3, 3]
    )
    uv = sequence.keypoints.uv.copy()
    uv[0, :, k] = (
        p[:, :2] / p[:, 2:] * simulated.intrinsics[:2] + simulated.intrinsics[2:]
    )
    return dataclasses.replace(
        sequence, keypoints=Keypoints(uv, sequence.keypoints.confidence)
    )


@pytest.mark.parametrize("side", ["left", "right"])
def test_offset_of_a_keypoint_is_found_in_the_body_frame(simulated, side):
    sign = 1 if side == "left" else -1
    offset = np.array([0.02 * sign, 0.05, -0.03])
    found = detection_figures(simulated, moved(simulated, f"{side}_knee", offset))
    assert found["found"] == 1.0
    stature = np.ptp(simulated.person.skin[:, 1])
    knee = found["keypoints"][f"{side}_knee"]
    # Outwards on both sides; along the line of sight it is known less well
    np.testing.assert_allclose(
        np.array(knee["offset"]) * stature, [0.02, 0.05, -0.03], atol=0.004
    )
    assert knee["spread"] < 0.002 and knee["gross"] == 0
    ankle = found["keypoints"][f"{side}_ankle"]
    np.testing.assert_allclose(ankle["offset"], 0, atol=1e-6)
    assert ankle["seen"] > 0.9


def test_who_is_not_found_and_what_is_something_else_is_counted(simulated):
    sequence = simulation.as_sequence(simulated)
    uv, confidence = (
        x.copy() for x in (sequence.keypoints.uv, sequence.keypoints.confidence)
    )
    confidence[0, :30] = 0.0  # nobody
    uv[0, 30:60, NAMES.index("nose")] += 300.0
    other = dataclasses.replace(sequence, keypoints=Keypoints(uv, confidence))
    found = detection_figures(simulated, other)
    assert found["found"] == pytest.approx(2 / 3, abs=0.02)
    assert found["keypoints"]["nose"]["gross"] == pytest.approx(0.5, abs=0.05)
    assert found["keypoints"]["left_hip"]["gross"] == 0.0
    nobody = dataclasses.replace(sequence, keypoints=None)
    assert detection_figures(simulated, nobody)["found"] == 0.0


def test_difficulty_of_the_scenes_and_rows_of_the_plan(tmp_path):
    plan = PLANS["video"](Experiment(sequences=("E1", "D2")), Config(), tmp_path)
    assert [job.label for job in plan.jobs[:4]] == [
        *("E1-room-pixels", "E1-room-keypoints", "E1-room-bodies", "D2-room-pixels"),
    ]
    assert len(plan.jobs) == 12
    easy, hard = plan.jobs[0].key[0], plan.jobs[3].key[0]
    assert (easy.length, easy.people, easy.hiding, easy.readout) == (300, 1, False, 0)
    assert (hard.people, hard.hiding) == (2, True) and hard.readout > 0


def test_rows_of_other_motion_say_what_is_done_and_have_a_table_of_their_own(tmp_path):
    other = Experiment(sequences=("M3",), family="room", motion=simulation.OTHER)
    plan = PLANS["video"](other, Config(), tmp_path)
    walk = PLANS["video"](
        dataclasses.replace(other, motion=None), Config(), tmp_path / "stages"
    )
    assert [job.label for job in plan.jobs] == [job.label for job in walk.jobs]
    assert [job.key[0].motion for job in plan.jobs] == ["other"] * 3
    assert fingerprint(*plan.jobs[0].key) != fingerprint(*walk.jobs[0].key)
    done = "climbs a ladder (14_33)"
    assert [video.what_is_done(job.key[0]) for job in plan.jobs] == [done] * 3
    row = {"sequence": "M3-room", "status": "ok", "size": 1.0}
    row |= dict.fromkeys(video.FIGURES, 0.5)
    rows = [row | {"input": which} for which in video.INPUTS]
    written = walk.write(tmp_path, rows)
    written += plan.write(tmp_path, [one | {"motion": done} for one in rows])
    names = ["video.md", "video.csv", "video-other.md", "video-other.csv"]
    assert [path.name for path in written] == names
    assert f"| M3-room | {done} | pixels |" in written[2].read_text()
    assert "ladder" not in written[0].read_text()


@pytest.mark.slow
def test_tables_have_means_with_standard_errors(simulated, tmp_path):
    truth = simulation.as_truth(simulated)
    pair = evaluation.associate(truth, truth, load_body_model())
    same = evaluation.evaluate(*pair)
    detected = detection_figures(simulated, simulation.as_sequence(simulated))
    rows = []
    for k, name in enumerate(("E1-room", "E2-room")):
        for which in video.INPUTS:
            row = {"sequence": name, "input": which, "status": "ok"}
            row |= {key: float(same[key]) for key in video.FIGURES} | {"size": 1.0}
            row["h_ate_sim3"] = 0.04 + 0.01 * k
            if which == "pixels":
                row |= detected
            rows.append(row)
    written = write_video(tmp_path, rows, about="Seed 5.")
    text = written[0].read_text()
    knees = f"{np.degrees(float(same['knee'])):.1f} ± 0.0"
    assert f"| knees, degrees | {' | '.join(4 * [knees])} |" in text
    assert "| H-ATE Sim(3), mm | 45.0 ± 5.0 | 45.0 ± 5.0 | 45.0 ± 5.0 | – |" in text
    assert "| left_knee" not in text and "| knee | 0.0 ± 0.0" in text
    assert "Seed 5." in text and len(written[1].read_text().splitlines()) == 7


@pytest.mark.slow
def test_a_short_sequence_from_pixels_alone(tmp_path):
    """The person is found, and what a row must have is there."""
    plain = simulation.Simulation(sequence="E1", family="follow", length=30, seed=11)
    settings = video.filmed(plain)
    row = video.video_row(settings, "pixels", Config(), tmp_path)
    assert all(isinstance(row[name], float) for name in (*video.FIGURES, "size"))
    assert isinstance(row["status"], str)
    assert row["found"] > 0.9 and len(row["keypoints"]) == 25
    assert 0.5 < row["scale"] < 2 and row["pa_mpjpe"] < 0.15
    film = next(tmp_path.glob("E1-follow-*/film"))
    assert (film / "video.mp4").exists() and not (film / "keypoints").exists()
    truth = evaluation.read_groundtruth(film, load_body_model())
    assert truth.joints.shape == (1, 30, 24, 3)
