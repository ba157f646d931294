"""Small made-up sequences of EMDB, 3DPW and RICH, in the layouts of their authors."""

import json
import pickle

import cv2
import jax.numpy as jnp
import jaxlie
import numpy as np
from body_cases import make_raw, write

NUM = 6
K = np.array([[50.0, 0, 31.5], [0, 52.0, 23.5], [0, 0, 1]])
RICH = "Hall_003_wipe"


def make_world():
    """World-to-camera poses, and a person's poses, places and shape."""
    rng = np.random.default_rng(0)
    T_CW = np.tile(np.eye(4), (NUM, 1, 1))
    turns = jaxlie.SO3.exp(jnp.asarray(rng.normal(0, 0.5, (NUM, 3))))
    T_CW[:, :3, :3] = turns.as_matrix()
    T_CW[:, :3, 3] = rng.normal(0, 1, (NUM, 3))
    poses, trans = rng.normal(0, 0.3, (NUM, 72)), rng.normal(0, 1, (NUM, 3))
    return T_CW, poses, trans, rng.normal(0, 1, 10)


def make_bodies(folder):
    """SMPL and, in `smplx`, SMPL-X of every gender, each another body."""
    (folder / "smplx").mkdir(parents=True)
    for seed, gender in enumerate(("NEUTRAL", "FEMALE", "MALE")):
        write(make_raw(seed=seed), folder / f"SMPL_{gender}.npz")
        raw = make_raw(num_joints=55, seed=seed + 3)
        write(raw, folder / "smplx" / f"SMPLX_{gender}.npz")
    return folder


def make_images(folder, names, size=(64, 48)):
    folder.mkdir(parents=True)
    for k, name in enumerate(names):
        image = np.full((size[1], size[0], 3), 20 * k, np.uint8)
        cv2.imwrite(str(folder / name), image)


def dump(path, data):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(pickle.dumps(data, protocol=2))
    return path


def emdb_data(world):
    T_CW, poses, trans, betas = world
    return {
        "gender": "female",
        "n_frames": NUM,
        "good_frames_mask": np.arange(NUM) != 2,
        "camera": {"intrinsics": K, "extrinsics": T_CW, "width": 64, "height": 48},
        "smpl": {
            "poses_root": poses[:, :3],
            "poses_body": poses[:, 3:],
            "trans": trans,
            "betas": betas,
        },
    }


def make_emdb(folder, world, **other):
    """The folder of one sequence; `other` entries of its file."""
    make_images(folder / "images", [f"{k:05d}.jpg" for k in range(NUM)])
    dump(folder / "P0_09_walk_data.pkl", emdb_data(world) | other)
    return folder


def threedpw_data(world, num_people=2):
    """The last person is that of `world`."""
    T_CW, poses, trans, betas = world
    rng = np.random.default_rng(1)
    other = rng.normal(0, 0.3, (NUM, 72))
    # COCO's 18 of a person who stands, as OpenPose orders them.
    x = [40, 40, 32, 30, 30, 48, 50, 50, 36, 36, 36, 44, 44, 44, 38, 42, 36, 44]
    y = [8, 14, 14, 22, 30, 14, 22, 30, 32, 44, 56, 32, 44, 56, 7, 7, 8, 8]
    standing = np.array([x, y, np.ones(18)], float)
    points = standing + rng.uniform(0, 1, (NUM, 3, 18)) * [[0.5], [0.5], [0.0]]
    points[2] = 0.0
    joints = rng.normal(0, 1, (NUM, 72))
    valid = np.array([1, 1, 1, 0, 1, 1])
    people = {
        "poses": [other, poses],
        "trans": [trans, trans],
        "betas": [np.zeros(10), np.r_[betas, np.zeros(290)]],
        "genders": ["m", "f"],
        "campose_valid": [np.ones(NUM), valid],
        "jointPositions": [joints, joints + 1],
        "poses2d": [points, points],
    }
    found = {name: both[-num_people:] for name, both in people.items()}
    return found | {"sequence": "walk_00", "cam_poses": T_CW, "cam_intrinsics": K}


def make_3dpw(folder, data):
    """The file of one sequence, with its images where they belong."""
    names = [f"image_{k:05d}.jpg" for k in range(NUM)]
    make_images(folder / "imageFiles" / "walk_00", names)
    return dump(folder / "sequenceFiles" / "test" / "walk_00.pkl", data)


def make_rich(root, world, subjects=("003",)):
    """`root` with one sequence; the toolkit's table calls subject 3 a woman."""
    T_CW, poses, trans, betas = world
    names = [f"{k:05d}_03.jpeg" for k in range(3, 3 + NUM)]
    make_images(root / "images" / "val" / RICH / "cam_03", names)
    for k in range(NUM - 1):  # The last image has no body.
        for subject in subjects:
            dump(
                root / "bodies" / "val" / RICH / f"{k + 3:05d}" / f"{subject}.pkl",
                {
                    "global_orient": poses[k : k + 1, :3],
                    "body_pose": poses[k : k + 1, 3:66],
                    "betas": betas[None],
                    "transl": trans[k : k + 1],
                },
            )
    calibration = root / "scan_calibration" / "Hall" / "calibration"
    calibration.mkdir(parents=True)
    matrix = lambda name, x: (
        f"<{name} type_id='opencv-matrix'><data>"
        f"{' '.join(map(str, np.ravel(x)))}</data></{name}>"
    )
    (calibration / "003.xml").write_text(
        "<?xml version='1.0'?><opencv_storage>"
        + matrix("CameraMatrix", T_CW[0, :3])
        + matrix("Intrinsics", K)
        + matrix("Distortion", [0.01, -0.002, 0, 0, 0])
        + "</opencv_storage>"
    )
    table = json.dumps({"3": "female", "4": "male"})
    (root / "resource").mkdir()
    (root / "resource" / "gender.json").write_text(table)
    return root


def make_pair(folder, world, **other):
    """A trajectory and an AMASS file without joints."""
    _, poses, trans, betas = world
    folder.mkdir(parents=True, exist_ok=True)
    trajectory, motion = folder / "camera.tum", folder / "walk_poses.npz"
    lines = [f"{k / 30} {k} 0 0 0 0 0 1" for k in range(NUM)]
    trajectory.write_text("\n".join(lines))
    arrays = {"poses": poses, "trans": trans, "betas": betas, "gender": "female"}
    np.savez(motion, **(arrays | {"mocap_framerate": 30.0} | other))
    return trajectory, motion
