"""What each detector calls a hip or a knee: from the file to the body."""

import json

import jax.numpy as jnp
import numpy as np
import pytest

from bodyslam_jax import body as body_
from bodyslam_jax import people
from bodyslam_jax.body import BODY25, KEYPOINT_DEFINITIONS, definition_offsets
from bodyslam_jax.body.skeleton import BODY25_MIRRORED
from bodyslam_jax.io.keypoints.reader import read_detections
from bodyslam_jax.people.person_state import PersonState
from bodyslam_jax.people.skeleton import NUM_SHAPE, make_skeleton, place_points
from bodyslam_jax.types import Intrinsics, Keypoints

FRAMES, FPS, SIZE = 12, 30.0, (640, 480)
CAMERA = Intrinsics(np.array([600.0, 600.0, 319.5, 239.5]), *SIZE)


@pytest.fixture(scope="module")
def body():
    return body_.load_body_model()


def points_at_rest(body, definition: str, shape=()) -> np.ndarray:
    beta = np.zeros(NUM_SHAPE)
    beta[: len(shape)] = shape
    skeleton = make_skeleton(body, 0.0, definition)
    return np.asarray(place_points(skeleton, jnp.zeros(63), jnp.asarray(beta))[1])


def people_seen(body, definition: str) -> tuple[PersonState, np.ndarray]:
    """Somebody who turns round at 4 m, and the pixels of the keypoints (t, 25, 2)."""
    turn = np.linspace(0.0, 2 * np.pi, FRAMES, endpoint=False)
    T_CH = np.tile(np.eye(4), (1, FRAMES, 1, 1))
    c, s, one = np.cos(turn), np.sin(turn), np.ones(FRAMES)
    R = np.stack([[c, 0 * c, s], [0 * c, -one, 0 * c], [s, 0 * c, -c]])
    T_CH[0, :, :3, :3] = R.transpose(2, 0, 1)
    T_CH[0, :, :3, 3] = [0.1, 0.0, 4.0]
    p = points_at_rest(body, definition) @ T_CH[0, :, :3, :3].swapaxes(1, 2)
    p = p + T_CH[0, :, None, :3, 3]
    uv = p[..., :2] / p[..., 2:] * CAMERA.params[:2] + CAMERA.params[2:]
    roots = PersonState(
        np.ones((1, FRAMES), bool),
        T_CH,
        np.zeros((1, FRAMES, 23, 3)),
        np.zeros((1, 10)),
    )
    return roots, uv


@pytest.mark.parametrize("definition", KEYPOINT_DEFINITIONS)
def test_definitions_are_symmetric_and_small(definition):
    offset = definition_offsets(definition)
    mirrored = offset[list(BODY25_MIRRORED)] * [-1, 1, 1]
    sided = np.arange(25) != np.array(BODY25_MIRRORED)
    np.testing.assert_allclose(offset[sided], mirrored[sided], atol=1e-12)
    assert np.linalg.norm(offset, axis=1).max() < 0.06
    below = offset[BODY25["left_knee"], 1]
    assert below == 0 if definition == "unknown" else -0.02 < below < -0.005


def test_an_unknown_definition_is_refused(body):
    with pytest.raises(ValueError, match="expected one of unknown, movenet-blazepose"):
        make_skeleton(body, 0.0, "kinect")


@pytest.mark.slow
def test_offsets_grow_with_the_stature(body):
    stature = people.linear_stature(body)
    offset = definition_offsets("movenet-blazepose")
    for shape in ((), (2.0,), (-1.5, 1.0, 0.0, 2.0)):
        beta = np.zeros(10)
        beta[: len(shape)] = shape
        height = stature.template + stature.slope @ beta
        moved = points_at_rest(body, "movenet-blazepose", shape)
        moved = moved - points_at_rest(body, "unknown", shape)
        np.testing.assert_allclose(moved, height * offset, atol=1e-12)


@pytest.mark.slow
def test_a_definition_is_removed_before_keypoints_are_compared_with_joints(body):
    _, wanted = people_seen(body, "unknown")
    roots, uv = people_seen(body, "mediapipe")
    assert np.linalg.norm(uv - wanted, axis=-1).max() > 5
    confidence = np.ones((1, FRAMES, 25))
    given = Keypoints(uv[None], confidence, definition="mediapipe")
    everybody = np.array([True])
    found = people.as_body_keypoints(given, roots, everybody, CAMERA, body, FPS)
    np.testing.assert_allclose(found.uv[0], wanted, atol=0.01)
    assert found.definition == "unknown"  # keypoints are at the joints now


def written(folder, uv, *, named=None, missing=()) -> str:
    """The definition of an OpenPose folder of these keypoints, as it is read."""
    folder.mkdir()
    for k, points in enumerate(uv):
        row = np.column_stack([points, np.full(25, 0.9)])
        row[list(missing)] = 0.0
        content = {"people": [{"pose_keypoints_2d": row.ravel().tolist()}]}
        content |= {} if named is None else {"detector": named}
        (folder / f"a_{k:012d}_keypoints.json").write_text(json.dumps(content))
    width, height = SIZE
    return read_detections(
        folder, num_frames=FRAMES, width=width, height=height
    ).definition


def test_the_detector_is_found_from_the_keypoints(body, tmp_path):
    """Joints of a body; MediaPipe's midpoints without small toes; OpenPose's neck."""
    small_toes = BODY25["left_small_toe"], BODY25["right_small_toe"]
    _, uv = people_seen(body, "unknown")
    assert written(tmp_path / "joints", uv) == "unknown"
    _, uv = people_seen(body, "openpose")
    assert written(tmp_path / "openpose", uv) == "openpose"
    _, uv = people_seen(body, "mediapipe")
    for middle, (a, b) in (("neck", (2, 5)), ("mid_hip", (9, 12))):
        uv[:, BODY25[middle]] = (uv[:, a] + uv[:, b]) / 2
    assert written(tmp_path / "mediapipe", uv, missing=small_toes) == "mediapipe"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("named", "definition"),
    [
        ("MediaPipe Pose", "mediapipe"),
        ("ViTPose-H", "coco"),
        ("OpenPose 1.7", "openpose"),
        ("AlphaPose (Halpe)", "halpe"),
        ("simulated", "unknown"),
    ],
)
def test_a_file_may_name_its_detector(body, tmp_path, named, definition):
    _, uv = people_seen(body, "coco")
    assert written(tmp_path / "named", uv, named=named) == definition


@pytest.mark.parametrize(("count", "definition"), [(26, "halpe"), (133, "coco")])
def test_layouts_of_coco_and_halpe_are_theirs(tmp_path, count, definition):
    points = np.random.default_rng(0).uniform(50, 400, (FRAMES, count, 3))
    points[..., 2] = 0.9
    np.savez(tmp_path / "k.npz", keypoints=points)
    width, height = SIZE
    found = read_detections(
        tmp_path / "k.npz", num_frames=FRAMES, width=width, height=height
    )
    assert found.definition == definition
