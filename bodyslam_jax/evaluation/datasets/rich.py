"""Converts RICH: several people, seen by one static camera."""

import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.evaluation.datasets import checks, folder
from bodyslam_jax.evaluation.datasets.gender import body_for, gender_of
from bodyslam_jax.evaluation.readers import posed_joints
from bodyslam_jax.io.files import read_json, read_text, reading

_PART_SIZES = {"global_orient": 3, "body_pose": 63, "betas": 10, "transl": 3}
_GENDERS_SOURCE = "https://github.com/paulchhuang/rich_toolkit, resource/gender.json"


def convert_rich(
    root: Path,
    split: str,
    sequence: str,
    camera: int,
    out: Path,
    body_model: Path | None = None,
    genders: Path | None = None,
) -> Path:
    """Converts the view of one static camera of a RICH sequence to `out`.

    `root` holds `bodies/<split>/<sequence>/<frame>/<subject>.pkl`,
    `images/<split>/<sequence>/cam_<camera>/` and
    `scan_calibration/<scene>/calibration/<camera>.xml`. `body_model` is a folder with
    SMPL-X of the subjects' genders, or one file if all have the same; the true joints
    are posed with it. `genders` is the toolkit's `gender.json`; by default it is
    searched for in `root`, its `resource/` and `resource/` beside it, where the toolkit
    has it.

    **Raises:** as `convert_emdb`.
    """
    bodies = root / "bodies" / split / sequence
    images = root / "images" / split / sequence / f"cam_{camera:02d}"
    calibration = root / "scan_calibration" / sequence.split("_")[0] / "calibration"
    xml = calibration / f"{camera:03d}.xml"
    for needed in (bodies, images, xml):
        if not needed.exists():
            raise checks.not_there(needed, "RICH")
    T_CW, K, distortion = _camera(xml)
    files = checks.images(images)
    row = {_number(file, file.name): k for k, file in enumerate(files)}
    num = len(files)
    subjects = sorted({file.stem for file in bodies.glob("*/*.pkl")})
    if not subjects:
        raise InputError(f"{bodies}: no <frame>/<subject>.pkl in it.")
    people = []
    for subject, gender in _genders(root, genders, subjects).items():
        person = _person(sorted(bodies.glob(f"*/{subject}.pkl")), row, num)
        if not person["present"].any():
            continue
        model = body_for(bodies / "*" / f"{subject}.pkl", gender, "smplx", body_model)
        numbers = (person["poses"], person["betas"], person["trans"])
        joints = posed_joints(model, *numbers)
        people.append(person | {"gender": gender, "joints": joints})
    size = checks.image_size(images)
    with folder.sequence_folder(out, "RICH", images) as partial:
        folder.write_truth(partial, np.tile(T_CW, (num, 1, 1)), people)
        folder.write_camera(partial, K, size, distortion)
        folder.link_images(partial, images)
    return out


def _genders(root: Path, file: Path | None, subjects: list[str]) -> dict[str, str]:
    """Returns the gender by subject, from a table `{"3": "male", ...}`."""
    root = root.resolve()
    folders = [root, root / "resource", root.parent / "resource"]
    paths = [folder / "gender.json" for folder in folders] if file is None else [file]
    file = next((path for path in paths if path.is_file()), None)
    if file is None:
        raise InputError(
            f"{paths[0]}: not there, and RICH's own files do not name genders; it is "
            f"in {_GENDERS_SOURCE}, and can be named with --genders."
        )
    table = checks.fields(file, "", read_json(file, "RICH's gender.json"), ())
    found = {}
    for subject in subjects:
        number = str(_number(file, subject))
        gender = gender_of(table.get(number))
        if gender is None:
            text = repr(table[number]) if number in table else "no entry"
            raise InputError(
                f"{file}: subject {number}: {text}, not female, male or neutral."
            )
        found[subject] = gender
    return found


def _person(files: list[Path], row: dict[int, int], num: int) -> dict[str, Any]:
    """Reads the files of one subject, one per frame, into the rows of their frames."""
    poses, trans = np.zeros((num, 72)), np.zeros((num, 3))
    betas, present = np.zeros((num, 10)), np.zeros(num, bool)
    for file in files:
        if (k := row.get(_number(file, file.parent.name))) is None:
            continue
        data = checks.dictionary(file, (*_PART_SIZES,))
        found = {
            n: checks.first(file, n, data[n], size) for n, size in _PART_SIZES.items()
        }
        poses[k, :3], poses[k, 3:66] = found["global_orient"], found["body_pose"]
        trans[k], betas[k] = found["transl"], found["betas"]
        present[k] = True
    shape = betas[present].mean(0) if present.any() else np.zeros(10)
    return {"poses": poses, "trans": trans, "betas": shape, "present": present}


def _number(file: Path, name: str) -> int:
    """Returns the number that a name begins with."""
    found = re.match(r"\d{1,12}(?!\d)", name)
    if found is None:
        raise InputError(f"{file}: {name!r} does not begin with a number.")
    return int(found[0])


def _camera(xml: Path) -> tuple[np.ndarray, np.ndarray, tuple[float, ...]]:
    """Reads world to camera, calibration matrix and `k1 k2 p1 p2` from OpenCV's XML."""
    what = "a calibration with CameraMatrix, Intrinsics and Distortion"
    text = read_text(xml, what)
    if "<!" in text.replace("<!--", ""):  # an entity may stand for gigabytes
        raise InputError(f"{xml}: it declares a type of document, expected {what}.")
    with reading(xml, what):
        tree = ElementTree.fromstring(text)
        numbers = lambda name: [
            float(word) for word in (tree.findtext(f"./{name}/data") or "").split()
        ]
        T_CW = np.vstack([np.reshape(numbers("CameraMatrix"), (3, 4)), [0, 0, 0, 1]])
        K = np.reshape(numbers("Intrinsics"), (3, 3))
        distortion = (*numbers("Distortion"), 0.0, 0.0, 0.0, 0.0)[:4]
    checks.array(xml, "Distortion", distortion, (4,))
    checks.extrinsics(xml, "CameraMatrix", T_CW[None], 1)
    return T_CW, checks.array(xml, "Intrinsics", K, (3, 3)), distortion
