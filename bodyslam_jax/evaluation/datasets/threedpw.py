"""Converts 3DPW: one or two people, a moving camera, joints in the file."""

import re
from pathlib import Path
from typing import Any

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.evaluation.datasets import checks, folder
from bodyslam_jax.evaluation.datasets.gender import gender_of

_REQUIRED_KEYS = ("sequence", "poses", "trans", "betas", "cam_poses", "cam_intrinsics")
_REQUIRED_KEYS += ("campose_valid", "jointPositions")


def convert_3dpw(source: Path, out: Path) -> Path:
    """Converts one 3DPW sequence to `out`, with its 2D detections as keypoints.

    `source` is `sequenceFiles/<split>/<name>.pkl`; the images are looked for in
    `imageFiles/<name>` beside `sequenceFiles`. Joints are the file's own. A person is
    present where the camera's pose was aligned to the image.

    **Raises:** as `convert_emdb`.
    """
    if not source.is_file():
        raise checks.not_there(source, "3DPW")
    data = checks.dictionary(source, _REQUIRED_KEYS)
    name = data["sequence"]
    # The name becomes part of paths, and must not leave the folder.
    if not isinstance(name, str) or not re.fullmatch(r"\w[\w.+ -]{0,119}", name):
        found = f"{str(name)[:80]!r}"
        raise InputError(f"{source}: sequence: {found}, not the name of a folder.")
    T_CW = checks.extrinsics(source, "cam_poses", data["cam_poses"], None)
    K = checks.array(source, "cam_intrinsics", data["cam_intrinsics"], (3, 3))
    people = _people(source, data, len(T_CW))
    detections = None
    if data.get("poses2d") is not None:
        detections = [
            # OpenPose's COCO layout has 18 points.
            checks.array(source, "poses2d", x, (len(T_CW), 3, 18)).transpose(0, 2, 1)
            for x in checks.entries(source, "poses2d", data["poses2d"], len(people))
        ]
    # The path is resolved because it may be a bare file name.
    images = source.resolve().parent.parent.parent / "imageFiles" / name
    checks.images(images, len(T_CW))
    size = checks.image_size(images)
    with folder.sequence_folder(out, "3DPW", source) as partial:
        folder.write_camera(partial, K, size)
        folder.write_truth(partial, T_CW, people)
        folder.link_images(partial, images)
        if detections:
            folder.write_keypoints(partial, name, detections)
    return out


def _people(file: Path, data: dict[str, Any], num: int) -> list[dict[str, Any]]:
    poses = checks.entries(file, "poses", data["poses"])
    each = lambda name: checks.entries(file, name, data[name], len(poses))
    unknown = ["neutral"] * len(poses)
    genders = data.get("genders", data.get("gender", unknown))
    array = lambda name, values, *shape: checks.array(file, name, values, (num, *shape))
    rows = zip(
        poses,
        each("trans"),
        each("betas"),
        each("campose_valid"),
        each("jointPositions"),
        checks.entries(file, "genders", genders, len(poses)),
        strict=True,
    )
    return [
        {
            "poses": array("poses", pose, 72),
            "trans": array("trans", trans, 3),
            "betas": checks.first(file, "betas", betas, 10),
            "present": array("campose_valid", valid).astype(bool),
            "gender": gender_of(gender) or "neutral",
            "joints": array("jointPositions", joints, 72).reshape(num, 24, 3),
        }
        for pose, trans, betas, valid, joints, gender in rows
    ]
