"""A result made by hand: two people, one of them not always there, and a map."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from bodyslam_jax.body import BodyModel, joints
from bodyslam_jax.export.formats import Observations
from bodyslam_jax.geometry.camera import project
from bodyslam_jax.types import Result

NUM_FRAMES, FPS = 12, 25.0
SIZE = (640, 480)


def make_result(body: BodyModel, distorted: bool = False) -> Result:
    """Person 1 is absent in frames 5 to 7; the camera looks at the map."""
    rng = np.random.default_rng(0)
    t = np.arange(NUM_FRAMES) / FPS
    T_WC = np.tile(np.diag([-1.0, -1.0, 1.0, 1.0]), (NUM_FRAMES, 1, 1))
    shake = Rotation.from_rotvec(rng.normal(0, 0.05, (NUM_FRAMES, 3))).as_matrix()
    T_WC[:, :3, :3] = T_WC[:, :3, :3] @ shake
    T_WC[:, :3, 3] = [0, 1.6, -5] + rng.normal(0, 0.2, (NUM_FRAMES, 3))
    poses = rng.normal(0, 0.4, (2, NUM_FRAMES, 72))
    trans = [0, 1, 0] + rng.normal(0, 0.5, (2, NUM_FRAMES, 3))
    betas = rng.normal(0, 1, (2, 10))
    posed = joints(body, *map(jnp.asarray, (poses, betas[:, None], trans)))
    present = np.ones((2, NUM_FRAMES), bool)
    present[1, 5:8] = False
    intrinsics = np.array([500.0, 510.0, 318.0, 243.0])
    if distorted:
        intrinsics = np.append(intrinsics, [-0.1, 0.02, 1e-3, -2e-3])
    return Result(
        timestamps=t,
        T_WC=T_WC,
        scale=1.25,
        intrinsics=intrinsics,
        landmarks=[0, 1, 1] + rng.uniform(-2, 2, (40, 3)),
        poses=poses,
        trans=trans,
        betas=betas,
        joints=np.asarray(posed),
        present=present,
        summary={
            "status": "ok",
            "input": {"name": "made", "width": SIZE[0], "height": SIZE[1]},
        },
    )


def observe(result: Result, error: float = 0.5) -> Observations:
    """Every landmark in every frame, `error` px off; in no order of frames."""
    rng = np.random.default_rng(1)
    t, n = len(result.timestamps), len(result.landmarks)
    frame, landmark = (x.reshape(-1) for x in np.indices((t, n)))
    order = rng.permutation(len(frame))
    frame, landmark = frame[order], landmark[order]
    T = result.T_WC[frame]
    p_C = np.einsum(
        "mji,mj->mi", T[:, :3, :3], result.landmarks[landmark] - T[:, :3, 3]
    )
    assert (p_C[:, 2] > 1).all()
    uv = np.asarray(project(jnp.asarray(result.intrinsics), jnp.asarray(p_C)))
    angle = rng.uniform(0, 2 * np.pi, len(uv))
    off = error * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return Observations(frame, landmark, uv + off)


def without_people(result: Result) -> Result:
    names = ("poses", "trans", "betas", "joints", "present")
    none = {name: getattr(result, name)[:0] for name in names}
    return dataclasses.replace(result, **none)
