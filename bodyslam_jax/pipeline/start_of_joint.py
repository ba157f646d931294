"""The initial values of the joint estimate as a `Result`, for comparison."""

from pathlib import Path
from typing import TypeVar

import jax.numpy as jnp
import numpy as np

from bodyslam_jax.body import BodyModel, joints, rest_joints
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.pipeline.stage_cache import load
from bodyslam_jax.types import Bodies, JointEstimate, Result, SfmResult

T = TypeVar("T")


def start_of_joint(run: Path, result: Result, body: BodyModel) -> Result | None:
    """Returns cameras and map of structure from motion and bodies of the people stage,
    with the first scale, from the stages kept in a run folder.

    The first located camera coincides with that of `result`. Returns `None` if the
    folder keeps no such stages, or those of another result.
    """
    cameras = _stage(run, "cameras", SfmResult)
    bodies = _stage(run, "people", Bodies)
    joint = _stage(run, "joint", JointEstimate)
    if cameras is None or bodies is None or joint is None:
        return None
    shape = result.present.shape
    if bodies.present.shape != shape or cameras.T_WC.shape != result.T_WC.shape:
        return None
    scale = joint.start.value
    T_WC = cameras.T_WC.copy()
    T_WC[:, :3, 3] *= scale
    first = int(np.argmax(result.located))
    move = result.T_WC[first] @ np.linalg.inv(T_WC[first])
    T_WC = move @ T_WC
    landmarks = scale * cameras.landmarks @ move[:3, :3].T + move[:3, 3]
    poses = bodies.poses.copy()
    poses[..., :3] = so3.log(T_WC[:, :3, :3] @ so3.exp(poses[..., :3]))
    # A person has one shape: the median, as the people stage has one per frame.
    betas = np.stack(
        [
            np.median(beta[there], axis=0) if there.any() else np.zeros(10)
            for beta, there in zip(bodies.shapes, bodies.present, strict=True)
        ]
    ).reshape(len(bodies.present), 10)
    rest = np.asarray(rest_joints(body, jnp.asarray(betas, body.dtype)), np.float64)
    pelvis = rest[:, None, 0] + bodies.trans
    pelvis = np.einsum("tij,htj->hti", T_WC[:, :3, :3], pelvis) + T_WC[:, :3, 3]
    trans = pelvis - rest[:, None, 0]
    cast = lambda x: jnp.asarray(x, body.dtype)
    posed = joints(body, cast(poses), cast(betas[:, None]), cast(trans))
    return Result(
        timestamps=result.timestamps,
        T_WC=T_WC,
        scale=scale,
        intrinsics=cameras.intrinsics,
        landmarks=landmarks if cameras.kind == "moving" else landmarks[:0],
        poses=poses,
        trans=trans,
        betas=betas,
        joints=np.asarray(posed, np.float64),
        present=bodies.present,
        summary={k: result.summary[k] for k in ("input", "frames_used")},
    )


def _stage(run: Path, name: str, kind: type[T]) -> T | None:
    """Loads a stage from a run folder; `None` if there is none, or it is unreadable."""
    found = sorted((run / ".cache").glob(f"{name}-*.npz"))
    if len(found) != 1:
        return None
    try:
        return load(found[0], kind)
    except Exception:  # the page is shown without what cannot be read
        return None
