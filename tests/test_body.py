import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
from body_cases import make_raw, smpl, write
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.test_util import check_grads

from bodyslam_jax import body
from bodyslam_jax.body.skeleton import pose_joints
from bodyslam_jax.geometry import so3_numpy

N = 5  # frames; one size for all tests, so that little is compiled


@pytest.fixture(scope="module")
def raw():
    return make_raw()


@pytest.fixture(scope="module")
def model(raw, tmp_path_factory):
    path = write(raw, tmp_path_factory.mktemp("body") / "made_up.npz")
    return body.load_body_model(path)


@pytest.fixture(scope="module")
def default():
    return body.load_body_model()


def some_bodies(seed=0, spread=0.8):
    rng = np.random.default_rng(seed)
    pose, beta = spread * rng.normal(size=(N, 72)), rng.normal(size=(N, 10))
    return jnp.asarray(pose), jnp.asarray(beta), jnp.asarray(rng.normal(size=(N, 3)))


def as_dtype(tree, dtype):
    cast = lambda x: x.astype(dtype) if x.dtype.kind == "f" else x
    return jax.tree.map(cast, tree)


@pytest.mark.parametrize(
    ("dtype", "tolerance"), [("float64", 1e-10), ("float32", 1e-5)]
)
def test_equals_smpl_written_in_numpy(model, raw, dtype, tolerance):
    pose, beta, trans = some_bodies()
    args = as_dtype((model, pose, beta, trans), dtype)
    joints, vertices = body.joints(*args), body.vertices(*args)
    assert joints.dtype == vertices.dtype == dtype
    for n in range(N):
        J, V = smpl(raw, *(np.asarray(x[n], np.float64) for x in (pose, beta, trans)))
        np.testing.assert_allclose(joints[n], J, atol=tolerance)
        np.testing.assert_allclose(vertices[n], V, atol=2 * tolerance)


def test_default_body_equals_smpl_written_in_numpy(default):
    raw = {
        "v_template": np.asarray(default.template),
        "shapedirs": np.asarray(default.shape_dirs),
        "posedirs": np.zeros((default.num_vertices, 3, 0)),
        "J_regressor": np.asarray(default.joint_regressor),
        "weights": np.zeros((default.num_vertices, 24)),
    }
    rows = np.arange(default.num_vertices)[:, None]
    np.add.at(
        raw["weights"], (rows, np.asarray(default.skin_joint)), default.skin_weight
    )
    pose, beta, trans = some_bodies(1)
    shared = body.vertices(default, pose, beta[0], trans)
    each = body.vertices(default, pose, jnp.broadcast_to(beta[:1], (N, 10)), trans)
    for n in range(N):
        _, V = smpl(raw, np.asarray(pose[n]), np.asarray(beta[0]), np.asarray(trans[n]))
        np.testing.assert_allclose(shared[n], V, atol=1e-10)
        np.testing.assert_allclose(each[n], V, atol=1e-10)


def test_long_videos_go_through_in_chunks(model):
    pose = 0.5 * jax.random.normal(jax.random.key(1), (37, 72))
    beta, trans = jnp.ones((37, 10)), jnp.zeros((37, 3))
    whole = body.vertices(model, pose, beta, trans)
    for n in (0, 15, 16, 31, 32, 36):
        one = body.vertices(model, pose[n], beta[n], trans[n])
        np.testing.assert_allclose(whole[n], one, atol=1e-12)


@pytest.mark.parametrize("shape", [(10,), (1, 10), (0, 10)])
def test_no_frames_have_no_bodies(model, default, shape):
    pose, beta, trans = jnp.zeros((0, 72)), jnp.zeros(shape), jnp.zeros((0, 3))
    for body_model in (model, default):  # with pose blend shapes, and without
        size = body_model.num_vertices
        found = body.vertices(body_model, pose, beta, trans)
        assert found.shape == (0, size, 3)
        assert body.joints(body_model, pose, beta, trans).shape == (0, 24, 3)
        assert body.keypoints(body_model, pose, beta, trans).shape == (0, 25, 3)


def test_unknown_layouts_and_whole_numbers_are_named(model):
    pose, beta, trans = some_bodies()
    with pytest.raises(ValueError, match="'foo', expected one of body25, coco17, hal"):
        body.keypoints(model, pose, beta, trans, layout="foo")
    jaxtyping.config.update("jaxtyping_disable", True)  # as without the tests' checks
    try:
        with pytest.raises(
            TypeError, match="poses are of type int64, expected float32"
        ):
            body.joints(model, jnp.zeros(72, int), beta[0], trans[0])
    finally:
        jaxtyping.config.update("jaxtyping_disable", False)


def test_leading_axes_broadcast_and_vmap_agrees(model):
    pose, beta, trans = some_bodies(2)
    table = body.joints(model, pose[:, None], beta[None], jnp.zeros(3))
    assert table.shape == (N, N, 24, 3)
    one = body.joints(model, pose[1], beta[3], jnp.zeros(3))
    np.testing.assert_allclose(table[1, 3], one, atol=1e-12)
    for function in (body.joints, body.keypoints, body.vertices):
        mapped = jax.jit(jax.vmap(function, (None, 0, 0, 0)))(model, pose, beta, trans)
        expected = function(model, pose, beta, trans)
        np.testing.assert_allclose(mapped, expected, atol=1e-12)


def test_root_turns_about_the_pelvis(model):
    pose, beta, trans = some_bodies(3)
    expected = body.rest_joints(model, beta)[:, 0] + trans
    found = body.joints(model, pose, beta, trans)[:, 0]
    np.testing.assert_allclose(found, expected, atol=1e-12)
    local = body.local_joints(model, pose[:, 3:].reshape(N, 23, 3), beta)
    assert abs(local[:, 0]).max() == 0


@pytest.mark.parametrize("function", [body.joints, body.keypoints, body.vertices])
def test_derivatives_against_differences(model, function):
    angle = jnp.array([0.0, 1e-9, 1e-4, 1.0, jnp.pi])[:, None]  # one per frame
    axis = jnp.tile(jnp.array([0.6, 0.0, 0.8]), (N, 24))
    _, beta, trans = some_bodies(4)
    weight = jnp.asarray(np.random.default_rng(0).normal(size=(1, 1, 3)))
    f = jax.jit(lambda p, b, t: (weight * function(model, p, b, t)).sum((-1, -2)))
    check_grads(f, (angle * axis, beta, trans), order=1, atol=1e-6, rtol=1e-6)


def test_second_derivatives_against_differences(model):
    pose, beta, _ = some_bodies(5)
    pose = pose[:, 3:].reshape(N, 23, 3)
    f = jax.jit(lambda p, b: (body.local_joints(model, p, b) ** 2).sum())
    check_grads(f, (pose, beta), order=2, modes=("rev",), atol=1e-5, rtol=1e-5)


def test_derivatives_of_each_joint_are_those_of_its_ancestors_alone(default):
    jacobian = jax.jacfwd(body.local_joints, 1)(
        default, jnp.ones((23, 3)), jnp.ones(10)
    )
    moved_by = np.asarray(abs(jacobian).max((1, 3)) > 1e-12)  # joint, of 23
    for j in range(24):
        above, i = [], body.PARENTS[j]
        while i > 0:
            above.append(i)
            i = body.PARENTS[i]
        np.testing.assert_array_equal(np.flatnonzero(moved_by[j]) + 1, sorted(above))


@given(st.integers(0, 2**31), st.floats(0, 4))
@settings(max_examples=15, deadline=None)
def test_bones_keep_their_lengths(default, seed, spread):
    pose, beta, trans = some_bodies(seed, spread)
    length = lambda x: np.linalg.norm(x[:, 1:] - x[:, body.PARENTS[1:]], axis=-1)
    posed = np.asarray(body.joints(default, pose, beta, trans))
    rest = np.asarray(body.rest_joints(default, beta))
    np.testing.assert_allclose(length(posed), length(rest), atol=1e-12)


@pytest.mark.parametrize("layout", ["body25", "coco17", "halpe26"])
def test_keypoints_are_the_joints_and_vertices_of_their_names(default, layout):
    pose, beta, trans = some_bodies(6)
    points = body.keypoints(default, pose, beta, trans, layout=layout)
    joints = body.joints(default, pose, beta, trans)
    vertices = body.vertices(default, pose, beta, trans)
    names = body.KEYPOINT_NAMES[layout]
    assert points.shape == (N, len(names), 3)
    assert len(names) == len(body.KEYPOINT_SPREAD[layout])
    for k, name in enumerate(names):
        if name in body.JOINT_NAMES:
            expected = joints[:, body.JOINT_NAMES.index(name)]
        elif name == "mid_hip":
            expected = joints[:, 0]
        else:
            pick = default.picks[body.SURFACE_POINTS.index(name)]
            expected = vertices[:, pick]
        np.testing.assert_allclose(points[:, k], expected, atol=1e-12)


def test_bias_moves_hips_neck_and_shoulders_with_their_joints(default):
    pose, beta, trans = some_bodies(7)
    plain = body.keypoints(default, pose, beta, trans)
    biased = body.keypoints(default, pose, beta, trans, bias=1.0)
    distance = np.linalg.norm(biased - plain, axis=-1)
    for k, name in enumerate(body.KEYPOINT_NAMES["body25"]):
        expected = np.linalg.norm(body.DETECTOR_BIAS.get(name, (0.0, 0.0, 0.0)))
        np.testing.assert_allclose(distance[:, k], expected, atol=1e-12)
    half = body.keypoints(default, pose, beta, trans, bias=0.5)
    np.testing.assert_allclose(half, (plain + biased) / 2, atol=1e-12)


def test_default_body_is_a_symmetric_adult(default):
    template = np.asarray(default.template)
    assert 1.67 < np.ptp(template[:, 1]) < 1.71
    taller = template + np.asarray(default.shape_dirs[:, :, 0])
    assert 0.09 < np.ptp(taller[:, 1]) - np.ptp(template[:, 1]) < 0.12  # one σ
    J = np.asarray(default.joint_template)
    mirrored = J[list(body.MIRRORED)] * [-1, 1, 1]
    assert abs(J - mirrored).max() < 1e-3
    assert J[1, 0] > 0 and J[10, 2] > J[7, 2]  # left is +x, toes are forward
    assert abs(np.asarray(default.joint_shape_dirs[0])).max() < 2e-5
    points = dict(
        zip(
            body.KEYPOINT_NAMES["body25"],
            np.asarray(
                body.local_keypoints(default, jnp.zeros((23, 3)), jnp.zeros(10))
            ),
            strict=True,
        )
    )
    assert points["nose"][2] > points["left_ear"][2] + 0.08
    assert points["left_big_toe"][2] > points["left_heel"][2] + 0.2
    assert points["left_small_toe"][0] > points["left_big_toe"][0]
    assert points["left_eye"][0] > 0.02 > -0.02 > points["right_eye"][0]


@pytest.mark.slow
def test_picture(default, tmp_path):
    path = tmp_path / "body.png"
    body.save_picture(default, path)
    assert path.read_bytes()[:4] == b"\x89PNG"


def test_the_chain_in_numpy_is_that_in_jax(default):
    pose, beta, trans = (np.asarray(x) for x in some_bodies())
    rest = np.asarray(body.rest_joints(default, beta))
    R = so3_numpy.exp(pose.reshape(N, 24, 3))
    _, x = pose_joints(R, rest, rest[:, 0] + trans)
    np.testing.assert_allclose(body.joints(default, pose, beta, trans), x, atol=1e-12)
