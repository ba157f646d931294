"""Who is hidden, tiny, exchanged or whole: what a result says of each person."""

import dataclasses
import functools

import cv2
import estimates
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bodyslam_jax import (
    evaluation,
    export,
    initialisation,
    motion,
    people,
    simulation,
)
from bodyslam_jax.body import load_body_model
from bodyslam_jax.body.skeleton import ANKLES, BODY25, KNEES, WRISTS
from bodyslam_jax.config import Config, GraphWeights, Simulation
from bodyslam_jax.diagnostics.reprojection import projected_keypoints
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.people import PersonState, bodies_from_roots
from bodyslam_jax.pipeline.run import assemble
from bodyslam_jax.types import Bodies, Intrinsics, Keypoints

LEGS = [BODY25[f"{side}_{n}"] for side in ("left", "right") for n in ("knee", "ankle")]
FEET = [k for name, k in BODY25.items() if "toe" in name or "heel" in name]
FRAMES = 90
CENTRE = 2000


@functools.cache
def scene():
    """Somebody who really walked, in front of a camera that moves, and keypoints of all
    of them without noise; no body is given."""
    made = simulation.simulate(
        Simulation(sequence="E1", family="follow", length=FRAMES, seed=3, noise="none")
    )
    sequence, truth = simulation.as_sequence(made), simulation.as_truth(made)
    cameras = dataclasses.replace(estimates.still_camera(sequence), T_WC=truth.T_WC)
    joint = estimates.standing_people(sequence)
    camera_of_world = np.linalg.inv(truth.T_WC)
    roots = np.tile(np.eye(4), (1, FRAMES, 1, 1))
    roots[..., :3, :3] = camera_of_world[:, :3, :3] @ so3.exp(truth.poses[..., :3])
    pelvis = truth.joints[:, :, 0] - truth.T_WC[:, :3, 3]
    roots[..., :3, 3] = np.einsum("tij,htj->hti", camera_of_world[:, :3, :3], pelvis)
    # An image so large that nobody leaves it.
    lens = np.array([*sequence.intrinsics.params[:2], CENTRE, CENTRE])
    joint = dataclasses.replace(
        joint,
        intrinsics=lens,
        cameras=truth.T_WC,
        roots=roots,
        poses=truth.poses[..., 3:].reshape(1, FRAMES, 23, 3),
        shapes=truth.betas,
        present=truth.present,
    )
    uv = np.array(projected_keypoints(load_body_model(), joint))
    sequence = dataclasses.replace(
        sequence,
        keypoints=Keypoints(uv, np.ones(uv.shape[:3])),
        bodies=None,
        intrinsics=Intrinsics(lens, 2 * CENTRE, 2 * CENTRE),
    )
    return sequence, cameras, joint


def judged(sequence, cameras, joint):
    result = assemble(sequence, Config(), load_body_model(), cameras, joint, {})
    assert result.joint_sigma is not None
    return result.summary, result.joint_sigma


def names(summary, person=None):
    return {
        r["name"]
        for r in summary["reasons"]
        if person is None or r.get("person") == person
    }


def hidden(sequence, points, frames):
    """The sequence, the detector hardly certain of these keypoints there."""
    confidence = sequence.keypoints.confidence.copy()
    confidence[:, frames, np.array(points)[:, None]] = 0.1
    keypoints = dataclasses.replace(sequence.keypoints, confidence=confidence)
    return dataclasses.replace(sequence, keypoints=keypoints)


def test_somebody_in_full_view_is_ok():
    summary, sigma = judged(*scene())
    assert names(summary) == set()
    (person,) = summary["people"]
    assert person["status"] == "ok" and person["reasons"] == []
    assert person["inferred_frames"] == []
    assert person["not_measured"] == {"arms": 0.0, "legs": 0.0, "feet": 0.0}
    assert person["leg_px"] > 60 and person["speed_noise_m_s"] < 0.1
    assert any("(ok)" in line for line in summary["headline"])
    assert 0.02 < sigma.min() and sigma.max() < 0.15


def test_hidden_legs_are_said_to_be_inferred():
    sequence, *rest = scene()
    summary, sigma = judged(hidden(sequence, LEGS + FEET, np.arange(FRAMES)), *rest)
    assert summary["status"] == "doubtful" and names(summary) == {"legs_inferred"}
    (person,) = summary["people"]
    assert person["status"] == "doubtful" and "legs" in person["reasons"][0]
    assert person["inferred_frames"] == [[0, FRAMES - 1]]
    assert person["not_measured"] == {"arms": 0.0, "legs": 1.0}
    whole = judged(sequence, *rest)[1]
    assert (sigma[..., KNEES] > 1.8 * whole[..., KNEES]).all()
    assert (sigma[..., WRISTS] == whole[..., WRISTS]).all()


def test_joints_are_less_sure_the_longer_they_are_hidden():
    sequence, *rest = scene()
    frames = np.arange(30, 50)
    summary, sigma = judged(hidden(sequence, LEGS, frames), *rest)
    knee = sigma[0, :, KNEES[0]]
    assert (np.diff(knee[29:40]) > 0).all() and (np.diff(knee[40:51]) < 0).all()
    assert knee[40] == pytest.approx(0.16, abs=0.02)
    (person,) = summary["people"]
    ((first, last),) = person["inferred_frames"]
    assert person["status"] == "doubtful" and 28 <= first <= 30 and 49 <= last <= 51
    assert person["not_measured"]["legs"] == pytest.approx(20 / FRAMES)
    # For a moment one leg hides the other in every stride.
    summary, _ = judged(hidden(sequence, LEGS, frames[:8]), *rest)
    (person,) = summary["people"]
    assert person["status"] == "ok" and person["inferred_frames"] == []


def test_a_short_stretch_of_hidden_legs_is_a_warning():
    sequence, cameras, joint = scene()
    present = joint.present.copy()
    present[:, 70:80] = False
    joint = dataclasses.replace(joint, present=present)
    summary, _ = judged(hidden(sequence, LEGS, np.arange(80, 90)), cameras, joint)
    (person,) = summary["people"]
    assert person["status"] == "ok" and person["inferred_frames"] == [[80, 89]]
    assert any("frames 80 to 89" in line for line in summary["warnings"])


def with_body(sequence, joint):
    """The sequence with the body of somebody who regresses it without an error."""
    present = joint.present
    shapes = np.broadcast_to(joint.shapes[:, None], (*present.shape, 10))
    turns = so3.log(joint.roots[..., :3, :3])[..., None, :]
    poses = np.concatenate([turns, joint.poses], axis=-2)
    state = PersonState(present, joint.roots, joint.poses, joint.shapes)
    trans = bodies_from_roots(state, load_body_model()).trans
    bodies = Bodies(present, poses.reshape(*present.shape, 72), shapes.copy(), trans)
    return dataclasses.replace(sequence, bodies=bodies)


def test_a_body_of_a_regressor_measures_no_hidden_legs():
    sequence, cameras, joint = scene()
    whole, sure = judged(with_body(sequence, joint), cameras, joint)
    assert names(whole) == set() and sure.max() < 0.06
    assert whole["people"][0]["not_measured"] == {"arms": 0.0, "legs": 0.0, "feet": 0.0}
    unseen = hidden(sequence, LEGS + FEET, np.arange(FRAMES))
    summary, sigma = judged(with_body(unseen, joint), cameras, joint)
    (person,) = summary["people"]
    assert person["status"] == "doubtful" and names(summary) == {"legs_inferred"}
    assert person["not_measured"] == {"arms": 0.0, "legs": 1.0}
    assert (0.15 < sigma[..., ANKLES]).all() and (sigma[..., ANKLES] < 0.3).all()
    np.testing.assert_array_equal(sigma[..., WRISTS], sure[..., WRISTS])
    assert "regressor's bodies guess them" in str(summary["reasons"])


def test_one_hidden_leg_of_a_regressor_is_inferred():
    sequence, cameras, joint = scene()
    left = [k for name, k in BODY25.items() if name in ("left_knee", "left_ankle")]
    feet = [k for k in FEET if k in (19, 20, 21)]
    summary, sigma = judged(
        with_body(hidden(sequence, left + feet, np.arange(FRAMES)), joint),
        cameras,
        joint,
    )
    assert summary["people"][0]["not_measured"]["legs"] == pytest.approx(0.5)
    assert names(summary) == {"legs_inferred"}
    assert (sigma[..., ANKLES[0]] > 0.15).all() and (sigma[..., ANKLES[1]] < 0.1).all()


def test_hidden_arms_of_a_regressor_are_inferred():
    sequence, cameras, joint = scene()
    arms = [k for name, k in BODY25.items() if "wrist" in name or "elbow" in name]
    summary, sigma = judged(
        with_body(hidden(sequence, arms, np.arange(FRAMES)), joint), cameras, joint
    )
    assert summary["people"][0]["not_measured"]["arms"] == 1.0
    assert names(summary) == set() and (sigma[..., WRISTS] > 0.1).all()


def test_without_keypoints_limbs_outside_the_image_are_inferred(tmp_path):
    sequence, cameras, joint = scene()
    alone = with_body(dataclasses.replace(sequence, keypoints=None), joint)
    summary, sigma = judged(alone, cameras, joint)
    assert names(summary) == set() and sigma.max() < 0.06
    (assumed,) = [line for line in summary["warnings"] if "no keypoints" in line]
    assert "person 0" in assumed and "in the image" in assumed
    # The image ends above the knees.
    uv = np.asarray(projected_keypoints(load_body_model(), joint))
    bottom = int(uv[..., [BODY25["left_knee"], BODY25["right_knee"]], 1].min()) - 5
    lens = Intrinsics(sequence.intrinsics.params, 2 * CENTRE, bottom)
    cut = dataclasses.replace(alone, intrinsics=lens)
    summary, sigma = judged(cut, cameras, joint)
    assert summary["people"][0]["not_measured"]["legs"] > 0.95
    assert "legs_inferred" in names(summary)
    assert (sigma[..., ANKLES] > 0.15).mean() > 0.9
    # So it is where the masks of people end there.
    small = Intrinsics(sequence.intrinsics.params / 10, CENTRE // 5, CENTRE // 5)
    mask = np.zeros((small.height, small.width), np.uint8)
    mask[: bottom // 10] = 255
    for k in range(FRAMES):
        cv2.imwrite(str(tmp_path / f"{k:04d}.png"), mask)
    masked = dataclasses.replace(alone, masks=tmp_path, intrinsics=small)
    summary, _ = judged(masked, cameras, joint)
    assert summary["people"][0]["not_measured"]["legs"] > 0.95
    assert any("on the masks of people" in line for line in summary["warnings"])


def test_who_has_no_keypoints_beside_others_who_do():
    sequence, cameras, joint = scene()
    two, joints = both(sequence, joint, lambda name, x: x)
    assert two.keypoints is not None
    two.keypoints.confidence[1] = 0.0
    shown = people.shown_keypoints(with_body(two, joints), load_body_model())
    assert shown.all()
    # Frames in which the detector lost somebody are as the nearest others.
    two.keypoints.confidence[1, :10] = 1.0
    two.keypoints.confidence[1, :10, LEGS] = 0.0
    shown = people.shown_keypoints(with_body(two, joints), load_body_model())
    assert not shown[1][:, LEGS].any() and shown[1][:, BODY25["neck"]].all()


@pytest.mark.parametrize(
    "hidden, told",
    [(slice(0, 12), False), (slice(18, 30), False), (slice(8, 20), True)],
    ids=["before", "after", "for less than a stride"],
)
def test_steps_of_hidden_legs_tell_no_size(hidden, told):
    frames = np.ones((1, 30), bool)
    frames[0, hidden] = False
    one = motion.Prediction(
        translation=jnp.ones((30, 3)),
        covariance=jnp.broadcast_to(jnp.eye(3), (30, 3, 3)),
        body_pose=jnp.zeros((30, 23, 3)),
        rotation=jnp.zeros((30, 3)),
        valid=jnp.ones(30, bool),
    )
    prediction = jax.tree.map(lambda x: x[None], one)
    steps = initialisation.steps_shown(prediction, frames, 30.0)
    factor = initialisation.motion_factor(
        steps, jnp.zeros((1, 10)), load_body_model(), GraphWeights()
    )
    weight = np.abs(np.asarray(factor.whitening)).sum(axis=(2, 3))[0]
    assert ((weight > 0) == (frames[0] | told)).all()
    # Of a gap that lasts as long as a stride or more nothing is known.
    long = initialisation.steps_shown(prediction, frames, 10.0)
    assert (np.asarray(long.valid)[0] == frames[0]).all()


def smaller(sequence, joint, factor):
    """The same scene in an image of fewer pixels."""
    scaled = joint.intrinsics.copy()
    scaled[:4] /= factor
    uv = sequence.keypoints.uv / factor
    keypoints = dataclasses.replace(sequence.keypoints, uv=uv)
    return (
        dataclasses.replace(sequence, keypoints=keypoints),
        dataclasses.replace(joint, intrinsics=scaled),
    )


def test_somebody_tiny_is_not_measurable():
    sequence, cameras, joint = scene()
    small, joint = smaller(sequence, joint, 6.0)
    summary, _ = judged(small, cameras, joint)
    (person,) = summary["people"]
    assert person["status"] == "not_measurable" and person["leg_px"] < 30
    # Nobody else is in the video, so there is no result to trust.
    assert summary["status"] == "doubtful" and "leg_in_image" in names(summary)
    line = next(x for x in summary["headline"] if x.startswith("person 0"))
    assert "too small or too far away" in line and " m " not in line


def both(sequence, joint, change):
    """A second person beside the first, whose estimate is `change` of the first's."""
    two = {
        name: np.concatenate([x := getattr(joint, name), change(name, x.copy())])
        for name in ("roots", "poses", "shapes", "present", "shape_covariance")
    }
    twice = lambda x: np.concatenate([x, x])
    keypoints = dataclasses.replace(
        sequence.keypoints,
        uv=twice(sequence.keypoints.uv),
        confidence=twice(sequence.keypoints.confidence),
    )
    return (
        dataclasses.replace(sequence, keypoints=keypoints),
        dataclasses.replace(joint, **two),
    )


def test_programs_read_who_can_be_trusted(tmp_path):
    sequence, cameras, joint = scene()
    result = assemble(sequence, Config(), load_body_model(), cameras, joint, {})
    export.write_run(tmp_path, result)
    with np.load(tmp_path / "result.npz", allow_pickle=False) as arrays:
        assert arrays["person_status"].tolist() == ["ok"]
        assert arrays["joint_sigma"].shape == (1, FRAMES, 24)
    found = evaluation.read_result(tmp_path)
    np.testing.assert_array_equal(found.joint_sigma, result.joint_sigma)


def test_programs_read_how_far_off_a_place_may_be(tmp_path):
    sequence, cameras, joint = scene()
    spread = np.tile(0.04 * np.eye(3), (1, FRAMES, 1, 1))
    shapes = np.tile(0.1 * np.eye(10), (1, 1, 1))
    joint = dataclasses.replace(joint, root_covariance=spread, shape_covariance=shapes)
    body = load_body_model()
    result = assemble(sequence, Config(), body, cameras, joint, {})
    export.write_run(tmp_path, result)
    found = evaluation.read_result(tmp_path)
    np.testing.assert_array_equal(found.root_sigma, result.root_sigma)
    person, height = (found.summary[k] for k in ("people", "camera_height"))
    level = np.linalg.norm(found.root_sigma[0][:, [0, 2]], axis=1)
    assert (level > np.sqrt(2) * 0.2).all()
    rms = np.sqrt((level[found.present[0]] ** 2).mean())
    assert person[0]["place_sigma_m"] == pytest.approx(rms)
    assert 0 < person[0]["height_sigma_m"] < person[0]["place_sigma_m"]
    assert height["value_m"] == pytest.approx(found.T_WC[0, 1, 3])
    assert height["sigma_m"] > 0
    export.write_report(tmp_path / "report.html", result, body)
    assert f"± {rms:.2f}" in (tmp_path / "report.html").read_text()
    # An estimate whose covariance was not computed claims nothing.
    joint = dataclasses.replace(joint, root_covariance=None)
    result = assemble(sequence, Config(), body, cameras, joint, {})
    assert result.root_sigma is None
    assert result.summary["people"][0]["place_sigma_m"] is None


def test_the_report_gives_no_metres_of_who_is_not_measurable(tmp_path):
    sequence, cameras, joint = scene()
    small, joint = smaller(sequence, joint, 6.0)
    body = load_body_model()
    result = assemble(small, Config(), body, cameras, joint, {})
    export.write_report(tmp_path / "report.html", result, body)
    page = (tmp_path / "report.html").read_text()
    assert page.count("<strong>not measurable</strong>") == 3
    assert "too small in the video to be measured" in page


def test_who_is_seen_in_short_pieces_is_doubted():
    sequence, cameras, joint = scene()
    present = joint.present.copy()
    present[:, 20:40] = present[:, 60:80] = False
    joint = dataclasses.replace(joint, present=present)
    summary, _ = judged(sequence, cameras, joint)
    assert names(summary) == {"seen_in_pieces"}
    present[:, 20:40] = True
    assert "seen_in_pieces" not in names(judged(sequence, cameras, joint)[0])


def test_who_is_far_and_seen_briefly_does_not_spoil_the_others():
    sequence, cameras, joint = scene()

    def far_and_brief(name, x):
        if name == "roots":
            x[..., :3, 3] *= 12  # Keypoints of a person twelve times as far away.
        if name == "present":
            x[:, 40:] = False
        return x

    two, joint = both(sequence, joint, far_and_brief)
    assert two.keypoints is not None
    two.keypoints.uv[1] = CENTRE + (two.keypoints.uv[1] - CENTRE) / 12
    summary, _ = judged(two, cameras, joint)
    near, far = summary["people"]
    assert near["status"] == "ok" and far["status"] == "not_measurable"
    assert names(summary) == set() and summary["status"] == "ok"
    assert any("No length, speed or place" in line for line in summary["warnings"])


def test_who_is_gone_and_back_elsewhere_is_doubted():
    sequence, cameras, joint = scene()
    present, roots = joint.present.copy(), joint.roots.copy()
    present[:, 40:60] = False
    roots[:, 60:, :3, 3] *= 4
    joint = dataclasses.replace(joint, present=present, roots=roots)
    summary, _ = judged(sequence, cameras, joint)
    assert "speed_across_gap" in names(summary, 0)
    assert summary["people"][0]["status"] == "doubtful"


def test_who_first_appears_within_somebody_else_is_doubted():
    sequence, cameras, joint = scene()

    def later(name, x):
        if name == "present":
            x[:, :45] = False
        return x

    two, joint = both(sequence, joint, later)
    summary, _ = judged(two, cameras, joint)
    assert names(summary) == {"appears_within"}
    assert [p["status"] for p in summary["people"]] == ["ok", "doubtful"]
    # Beside each other it is no doubt.
    assert two.keypoints is not None
    two.keypoints.uv[1] += [500.0, 0.0]
    summary, _ = judged(two, cameras, joint)
    assert "appears_within" not in names(summary)
