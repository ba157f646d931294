"""Small made-up bodies in SMPL's layout, and SMPL once more in plain NumPy."""

import numpy as np
from scipy.spatial.transform import Rotation

PARENTS_24 = [-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18]
PARENTS_24 += [19, 20, 21]


def parents_of(num_joints):
    """SMPL's tree; for 52 and 55 joints with three joints on each of ten fingers."""
    if num_joints == 24:
        return PARENTS_24
    parents = PARENTS_24[:22] + [15] * (num_joints - 52)
    for wrist in (20, 21):
        for _ in range(5):
            k = len(parents)
            parents += [wrist, k, k + 1]
    return parents


def make_raw(num_vertices=70, num_joints=24, seed=0, pose_dirs=True):
    """The arrays of a model file; random, but of a person's size."""
    rng = np.random.default_rng(seed)
    template = rng.uniform(-1, 1, (num_vertices, 3)) * [0.8, 0.9, 0.2]
    weights = rng.uniform(0, 1, (num_vertices, num_joints)) ** 8
    keep = np.argsort(weights, 1)[:, :-4]
    np.put_along_axis(weights, keep, 0, 1)
    regressor = rng.uniform(0, 1, (num_joints, num_vertices)) ** 12
    parents = np.array(parents_of(num_joints), np.int64)
    parents[0] = 2**32 - 1
    features = 9 * (num_joints - 1) if pose_dirs else 0
    return {
        "v_template": template,
        "shapedirs": 0.02 * rng.normal(size=(num_vertices, 3, 10)),
        "posedirs": 0.01 * rng.normal(size=(num_vertices, 3, features)),
        "J_regressor": regressor / regressor.sum(1, keepdims=True),
        "weights": weights / weights.sum(1, keepdims=True),
        "kintree_table": np.stack([parents, np.arange(num_joints)]).astype(np.uint32),
        "f": rng.integers(0, num_vertices, (100, 3)).astype(np.uint32),
    }


def smpl(raw, pose, beta, trans):
    """Joints and vertices of one body, joint by joint as the paper writes it."""
    num_joints = raw["weights"].shape[1]
    parents = parents_of(num_joints)
    full = np.zeros((num_joints, 3))
    full[: pose.size // 3] = pose.reshape(-1, 3)
    R = Rotation.from_rotvec(full).as_matrix()
    rest = raw["v_template"] + raw["shapedirs"][:, :, :10] @ beta
    J = raw["J_regressor"] @ rest
    if raw["posedirs"].shape[2]:
        rest = rest + raw["posedirs"] @ (R[1:] - np.eye(3)).ravel()
    world = np.zeros((num_joints, 4, 4))
    for k in range(num_joints):
        local = np.eye(4)
        local[:3, :3] = R[k]
        local[:3, 3] = J[k] - (J[parents[k]] if k else 0)
        world[k] = world[parents[k]] @ local if k else local
    joints = world[:, :3, 3].copy()
    world[:, :3, 3] -= np.einsum("kij,kj->ki", world[:, :3, :3], J)
    blended = np.einsum("vk,kij->vij", raw["weights"], world)
    vertices = np.einsum("vij,vj->vi", blended[:, :3, :3], rest) + blended[:, :3, 3]
    return joints + trans, vertices + trans


def write(raw, path):
    np.savez(path, **raw)
    return path


def crop_camera(trans, box, intrinsics):
    """A network's `(s, tx, ty)`: the inverse of `full_translation`."""
    fx, fy, px, py = intrinsics.params[:4]
    x, y, z = trans.T
    cx, cy, side = box.T
    s = 2 * fx / (side * z)
    return np.stack([s, x - z / fx * (cx - px), y * fy / fx - z / fx * (cy - py)], -1)
