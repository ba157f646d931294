"""Converts EMDB: one person, a moving camera."""

from pathlib import Path

import numpy as np

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.evaluation.datasets import checks, folder
from bodyslam_jax.evaluation.datasets.gender import body_for, gender_of
from bodyslam_jax.evaluation.readers import posed_joints


def convert_emdb(source: Path, out: Path, body_model: Path | None = None) -> Path:
    """Converts one EMDB sequence (a folder with `*_data.pkl` and `images/`) to `out`.

    `body_model` is SMPL of the gender that the file names, or a folder with it; the
    true joints are posed with it. The person is present in the frames that the file
    marks good.

    **Raises:** `InputError` that says where to register, or names the file and what is
    wrong with it.
    """
    found = sorted(source.glob("*_data.pkl")) if source.is_dir() else []
    if not found:
        raise checks.not_there(source / "*_data.pkl", "EMDB")
    file = found[0]
    needed = ("gender", "n_frames", "good_frames_mask", "camera", "smpl")
    data = checks.dictionary(file, needed)
    needed = ("intrinsics", "extrinsics", "width", "height")
    camera = checks.fields(file, "camera", data["camera"], needed)
    needed = ("poses_root", "poses_body", "trans", "betas")
    smpl = checks.fields(file, "smpl", data["smpl"], needed)
    num = checks.whole(file, "n_frames", data["n_frames"])
    part = lambda name, size: checks.array(file, name, smpl[name], (num, size))
    poses = np.concatenate([part("poses_root", 3), part("poses_body", 69)], axis=1)
    trans, betas = part("trans", 3), checks.array(file, "betas", smpl["betas"], (10,))
    good = checks.array(file, "good_frames_mask", data["good_frames_mask"], (num,))
    T_CW = checks.extrinsics(file, "camera.extrinsics", camera["extrinsics"], num)
    K = checks.array(file, "camera.intrinsics", camera["intrinsics"], (3, 3))
    size = checks.whole(file, "camera.width", camera["width"])
    size = (size, checks.whole(file, "camera.height", camera["height"]))
    gender = gender_of(data["gender"])
    if gender is None:
        raise InputError(f"{file}: gender is {data['gender']!r}, not female or male.")
    checks.images(source / "images", num)
    body = body_for(file, gender, "smpl", body_model)
    person = {
        "poses": poses,
        "trans": trans,
        "betas": betas,
        "present": good.astype(bool),
        "gender": gender,
        "joints": posed_joints(body, poses, betas, trans),
    }
    with folder.sequence_folder(out, "EMDB", file) as partial:
        folder.write_camera(partial, K, size)
        folder.write_truth(partial, T_CW, [person])
        folder.link_images(partial, source / "images")
    return out
