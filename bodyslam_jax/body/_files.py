"""Body model files: found, read, checked, written."""

import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from bodyslam_jax.body._model import BodyModel, sparse_rows
from bodyslam_jax.body._skeleton import SURFACE_POINTS

_DEFAULT = Path(__file__).parent / "assets" / "default_body.npz"


def load_body_model(
    path: str | Path | None = None, gender: str = "neutral", dtype=None
) -> BodyModel:
    """Reads a body model; without a path, the free one that ships with the package."""
    raw = dict(np.load(path or _DEFAULT))
    header = json.loads(str(raw["header"]))
    dtype = jnp.result_type(float) if dtype is None else jnp.dtype(dtype)
    template = raw["v_template"].astype(np.float64)
    shape_dirs = raw["shapedirs"].astype(np.float64)
    regressor = raw["J_regressor"].astype(np.float64)
    picks = dict(header["keypoints"], head_top=int(template[:, 1].argmax()))
    joint, weight = sparse_rows(raw["weights"].astype(np.float64))
    real = lambda x: jnp.asarray(x, dtype)
    return BodyModel(
        template=real(template),
        shape_dirs=real(shape_dirs),
        pose_dirs=jnp.zeros((len(template), 3, 0), dtype),
        joint_template=real(regressor @ template),
        joint_shape_dirs=real(np.einsum("jv,vcs->jcs", regressor, shape_dirs)),
        joint_regressor=real(regressor),
        skin_joint=jnp.asarray(joint, jnp.int32),
        skin_weight=real(weight),
        faces=jnp.asarray(raw["f"].astype(np.int32)),
        picks=jnp.asarray([picks[n] for n in SURFACE_POINTS], jnp.int32),
        name="default body",
        kind="default",
    )
