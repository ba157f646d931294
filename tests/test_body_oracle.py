"""Against `smplx` (PyTorch) on the same file; runs only where that is installed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from body_cases import make_raw, write

from bodyslam_jax import body

torch = pytest.importorskip("torch")
lbs = pytest.importorskip("smplx.lbs")

N = 4


def theirs(raw, pose, beta, trans, dtype):
    """`smplx.lbs.lbs`, which is all of its SMPL class but the reading of files."""
    tensor = lambda x: torch.tensor(np.asarray(x), dtype=dtype)
    parents = torch.tensor(raw["kintree_table"][0].astype(np.int64))
    parents[0] = -1
    num_features = 9 * 23
    pose_dirs = np.reshape(raw["posedirs"], (-1, num_features)).T
    vertices, joints = lbs.lbs(
        tensor(beta),
        tensor(pose),
        tensor(raw["v_template"]),
        tensor(raw["shapedirs"]),
        tensor(pose_dirs),
        tensor(raw["J_regressor"]),
        parents,
        tensor(raw["weights"]),
    )
    trans = tensor(trans)[:, None]
    return (joints + trans).numpy(), (vertices + trans).numpy()


@pytest.mark.parametrize(
    ("dtype", "tolerance"), [("float64", 1e-10), ("float32", 1e-5)]
)
@pytest.mark.parametrize("which", ["made up", "default"])
def test_equals_smplx(tmp_path, which, dtype, tolerance):
    path = tmp_path / "model.npz"
    if which == "default":
        body.write_npz(body.load_body_model(dtype="float64"), path)
    else:
        write(make_raw(num_vertices=200), path)
    with np.load(path) as archive:
        raw = dict(archive)
    rng = np.random.default_rng(0)
    pose, beta = rng.normal(size=(N, 72)), rng.normal(size=(N, 10))
    trans = rng.normal(size=(N, 3))
    pose[0] = 0
    expected = theirs(raw, pose, beta, trans, getattr(torch, dtype))
    model = body.load_body_model(path, dtype=dtype)
    args = [jnp.asarray(x, dtype) for x in (pose, beta, trans)]
    joints, vertices = body.joints(model, *args), body.vertices(model, *args)
    print(
        f"{which}, {dtype}: joints within {abs(joints - expected[0]).max():.1e} m, "
        f"vertices within {abs(vertices - expected[1]).max():.1e} m"
    )
    if dtype == "float64":
        # smplx adds 1e-8 to the axis-angle before its norm: that is its own error.
        tolerance = 1e-7
    np.testing.assert_allclose(joints, expected[0], atol=tolerance)
    np.testing.assert_allclose(vertices, expected[1], atol=tolerance)
    assert jax.tree.leaves(model)[0].dtype == dtype
