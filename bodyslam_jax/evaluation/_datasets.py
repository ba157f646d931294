"""Public data sets turned into sequence folders with ground truth.

Layouts as their authors document them: EMDB (Kaufmann et al., ICCV 2023), 3DPW (von
Marcard et al., ECCV 2018), RICH (Huang et al., CVPR 2022), and pairs of a TUM
trajectory and an AMASS file. Images are linked, not copied. Pickles pass through the
restricted reader only. All three data sets have 30 frames per second.
"""

import json
import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax import frontend
from bodyslam_jax.body import BodyModel
from bodyslam_jax.evaluation._readers import posed_joints, read_tum
from bodyslam_jax.export._run import write_body, write_tum
from bodyslam_jax.frontend._pickle import restricted_load

FPS = 30.0
_HOME = {
    "EMDB": "https://emdb.ait.ethz.ch",
    "3DPW": "https://virtualhumans.mpi-inf.mpg.de/3DPW",
    "RICH": "https://rich.is.tue.mpg.de",
}


def convert_emdb(source: Path, out: Path, body: BodyModel) -> Path:
    """Turns one EMDB sequence (a folder with `*_data.pkl` and `images/`) into `out`.

    `body` is the gendered SMPL that the file names: it makes the true joints. The
    person is present in the file's good frames.

    **Raises:** `FileNotFoundError` that says where to register, or `ValueError` naming
    the file and what is wrong with it.
    """
    file = _one_of(source, "*_data.pkl", "EMDB")
    data = _dictionary(file, ("n_frames", "good_frames_mask", "camera", "smpl"))
    camera, smpl = data["camera"], data["smpl"]
    num = int(data["n_frames"])
    at = lambda values, *shape: _array(file, values, (num, *shape))
    poses = np.concatenate(
        [at(smpl["poses_root"], 3), at(smpl["poses_body"], 69)], axis=1
    )
    _write_camera(
        out, camera["intrinsics"], (int(camera["width"]), int(camera["height"]))
    )
    _write_truth(
        out,
        at(camera["extrinsics"], 4, 4),
        [
            _person(
                poses,
                at(smpl["trans"], 3),
                _array(file, smpl["betas"], (10,)),
                _array(file, data["good_frames_mask"], (num,)).astype(bool),
                str(data.get("gender", "neutral")),
                body,
            )
        ],
    )
    return _link_images(source / "images", out)


def convert_3dpw(source: Path, out: Path) -> Path:
    """Turns one 3DPW sequence into `out`, with its 2D detections as keypoints.

    `source` is `sequenceFiles/<split>/<name>.pkl`; the images are looked for in
    `imageFiles/<name>` beside `sequenceFiles`. Joints are the file's own. A person is
    present where the camera's pose was aligned to the image.

    **Raises:** as `convert_emdb`.
    """
    if not source.is_file():
        raise FileNotFoundError(_not_there(source, "3DPW"))
    needed = ("sequence", "poses", "trans", "betas", "cam_poses", "cam_intrinsics")
    needed += ("campose_valid", "jointPositions")
    data = _dictionary(source, needed)
    num = len(data["cam_poses"])
    people = []
    for h, poses in enumerate(data["poses"]):
        at = lambda name, *shape: _array(source, data[name][h], (num, *shape))
        people.append(
            {
                "poses": _array(source, poses, (num, 72)),
                "trans": at("trans", 3),
                "betas": _array(source, data["betas"][h][:10], (10,)),
                "present": at("campose_valid").astype(bool),
                "gender": {"m": "male", "f": "female"}.get(
                    str((data.get("genders") or data.get("gender") or "?")[h])[:1],
                    "neutral",
                ),
                "joints": at("jointPositions", 72).reshape(num, 24, 3),
            }
        )
    images = source.parents[2] / "imageFiles" / str(data["sequence"])
    _write_truth(out, _array(source, data["cam_poses"], (num, 4, 4)), people)
    _link_images(images, out)
    _write_camera(out, data["cam_intrinsics"], _image_size(images))
    if data.get("poses2d") is not None:
        detections = [
            _array(source, found, (num, 3, 18)).transpose(0, 2, 1)
            for found in data["poses2d"]
        ]
        _write_keypoints(out / "keypoints", str(data["sequence"]), detections)
    return out


def convert_rich(
    root: Path, split: str, sequence: str, camera: int, out: Path, body: BodyModel
) -> Path:
    """Turns one still camera's view of a RICH sequence into `out`.

    `root` holds `bodies/<split>/<sequence>/<frame>/<subject>.pkl`,
    `images/<split>/<sequence>/cam_<camera>/` and
    `scan_calibration/<scene>/calibration/<camera>.xml`. `body` is SMPL-X, of the
    subject's gender: it makes the true joints.

    **Raises:** as `convert_emdb`.
    """
    bodies = root / "bodies" / split / sequence
    images = root / "images" / split / sequence / f"cam_{camera:02d}"
    calibration = root / "scan_calibration" / sequence.split("_")[0] / "calibration"
    xml = calibration / f"{camera:03d}.xml"
    for needed in (bodies, images, xml):
        if not needed.exists():
            raise FileNotFoundError(_not_there(needed, "RICH"))
    T_CW, K, distortion = _rich_camera(xml)
    numbers = [int(re.split(r"[_.]", file.name)[0]) for file in _images(images)]
    row = {number: k for k, number in enumerate(numbers)}
    num = len(numbers)
    if not num:
        raise ValueError(f"{images}: no image in it.")
    subjects = sorted({file.stem for file in bodies.glob("*/*.pkl")})
    if not subjects:
        raise ValueError(f"{bodies}: no <frame>/<subject>.pkl in it.")
    people = []
    for subject in subjects:
        poses, trans = np.zeros((num, 72)), np.zeros((num, 3))
        betas, present = np.zeros((num, 10)), np.zeros(num, bool)
        for file in sorted(bodies.glob(f"*/{subject}.pkl")):
            if (k := row.get(int(file.parent.name))) is None:
                continue
            found = _dictionary(file, ("global_orient", "body_pose", "betas", "transl"))
            value = lambda name, size: _array(
                file, np.ravel(found[name])[:size], (size,)
            )
            poses[k, :3], poses[k, 3:66] = (
                value("global_orient", 3),
                value("body_pose", 63),
            )
            trans[k], betas[k] = value("transl", 3), value("betas", 10)
            present[k] = True
        if not present.any():
            continue
        shape = betas[present].mean(0)
        people.append(_person(poses, trans, shape, present, "neutral", body))
    _write_truth(out, np.tile(T_CW, (num, 1, 1)), people)
    _write_camera(out, K, _image_size(images), distortion)
    return _link_images(images, out)


def convert_tum_amass(
    trajectory: Path, motion: Path, out: Path, images: Path | None = None
) -> Path:
    """Puts a TUM trajectory and an AMASS file, and images if any, into `out`.

    The files are copied as they are; `read_groundtruth` brings their rates together.
    """
    read_tum(trajectory)
    truth = out / "groundtruth"
    truth.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(trajectory, truth / "camera.txt")
    shutil.copyfile(motion, truth / "body.npz")
    return out if images is None else _link_images(images, out)


def _not_there(path: Path, dataset: str) -> str:
    return (
        f"{path}: not there; {dataset} is given to researchers who register at "
        f"{_HOME[dataset]}."
    )


def _one_of(folder: Path, pattern: str, dataset: str) -> Path:
    found = sorted(folder.glob(pattern)) if folder.is_dir() else []
    if not found:
        raise FileNotFoundError(_not_there(folder / pattern, dataset))
    return found[0]


def _dictionary(file: Path, needed: tuple[str, ...]) -> dict[str, Any]:
    data = restricted_load(file)
    if not isinstance(data, dict):
        raise ValueError(f"{file}: a {type(data).__name__}, not a dictionary.")
    missing = [name for name in needed if name not in data]
    if missing:
        raise ValueError(f"{file}: no {', '.join(missing)}, only {[*data]}.")
    return data


def _array(file: Path, values: Any, shape: tuple[int, ...]) -> np.ndarray:
    array = np.asarray(values, np.float64)
    if array.shape != shape or not np.all(np.isfinite(array)):
        raise ValueError(f"{file}: {array.shape} values, not {shape} finite numbers.")
    return array


def _person(
    poses: Float[np.ndarray, "t 72"],
    trans: Float[np.ndarray, "t 3"],
    betas: Float[np.ndarray, " 10"],
    present: Bool[np.ndarray, " t"],
    gender: str,
    body: BodyModel,
) -> dict[str, Any]:
    """A person in the world, with joints of the body model."""
    return {
        "poses": poses,
        "trans": trans,
        "betas": betas,
        "present": present,
        "gender": gender,
        "joints": posed_joints(body, poses, betas, trans),
    }


def _write_truth(
    out: Path, T_CW: Float[np.ndarray, "t 4 4"], people: list[dict[str, Any]]
) -> None:
    truth = out / "groundtruth"
    truth.mkdir(parents=True, exist_ok=True)
    write_tum(truth / "camera.txt", np.arange(len(T_CW)) / FPS, np.linalg.inv(T_CW))
    for h, person in enumerate(people):
        name = "body.npz" if len(people) == 1 else f"body_{h}.npz"
        write_body(truth / name, fps=FPS, **person)


def _write_camera(
    out: Path,
    K: Any,
    size: tuple[int, int],
    distortion: tuple[float, ...] = (),
) -> None:
    out.mkdir(parents=True, exist_ok=True)
    K = np.asarray(K, np.float64)
    params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
    model = "PINHOLE"
    if any(distortion):
        model, params = "OPENCV", [*params, *distortion[:4]]
    camera = {"model": model, "width": size[0], "height": size[1]}
    camera |= {"params": [float(p) for p in params], "fps": FPS}
    (out / "camera.json").write_text(json.dumps(camera) + "\n")


def _rich_camera(
    xml: Path,
) -> tuple[np.ndarray, np.ndarray, tuple[float, ...]]:
    """World to camera, calibration matrix and `k1 k2 p1 p2`, from OpenCV's XML."""
    try:
        tree = ElementTree.parse(xml)
        numbers = lambda name: [
            float(word) for word in (tree.findtext(f"./{name}/data") or "").split()
        ]
        T_CW = np.vstack([np.reshape(numbers("CameraMatrix"), (3, 4)), [0, 0, 0, 1]])
        K = np.reshape(numbers("Intrinsics"), (3, 3))
        distortion = (*numbers("Distortion"), 0.0, 0.0, 0.0, 0.0)[:4]
    except (ElementTree.ParseError, ValueError) as error:
        raise ValueError(
            f"{xml}: not a calibration with CameraMatrix, Intrinsics and Distortion "
            f"({error})."
        ) from None
    return T_CW, K, distortion


def _images(folder: Path) -> list[Path]:
    found = (p for p in folder.iterdir() if p.suffix.lower() in _IMAGE_SUFFIXES)
    return sorted(found, key=lambda file: file.name)


_IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp")


def _image_size(folder: Path) -> tuple[int, int]:
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder of images.")
    first = next(frontend.frames(folder), None)
    if first is None:
        raise ValueError(f"{folder}: no image in it.")
    return first.shape[1], first.shape[0]


def _link_images(images: Path, out: Path) -> Path:
    if not images.is_dir():
        raise FileNotFoundError(f"{images}: no such folder of images.")
    link = out / "images"
    link.unlink(missing_ok=True)
    link.symlink_to(images.resolve(), target_is_directory=True)
    return out


def _write_keypoints(
    folder: Path, name: str, people: list[Float[np.ndarray, "t 18 3"]]
) -> None:
    """OpenPose's own files, COCO-18; a person who was not detected is left out."""
    folder.mkdir(parents=True, exist_ok=True)
    for k in range(len(people[0])):
        found: list[Mapping[str, Any]] = [
            {"person_id": [-1], "pose_keypoints_2d": person[k].ravel().tolist()}
            for person in people
            if person[k, :, 2].any()
        ]
        text = json.dumps({"version": 1.3, "people": found})
        (folder / f"{name}_{k:012d}_keypoints.json").write_text(text)
