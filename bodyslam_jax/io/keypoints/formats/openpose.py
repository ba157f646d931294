"""OpenPose: a folder of JSON files, one per frame."""

from pathlib import Path

import numpy as np

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io.files import read_json
from bodyslam_jax.io.formats import Source
from bodyslam_jax.io.keypoints.keypoint_format import (
    KeypointFormat,
    Listed,
    detector_in,
    person_in,
    triples,
)


class OpenPose(KeypointFormat):
    """OpenPose's `--write_json`, and other tools' output in its style."""

    name = "OpenPose"
    folder = "*_keypoints.json"

    def recognises(self, source: Source) -> bool:
        return source.path.is_dir() and bool(_files(source.path))

    def read(self, source: Source, num_frames: int | None) -> Listed:
        files = _files(source.path)
        rows = []
        for file in files:
            rows += [(file.name, *found) for found in _read_frame(file)]
        first = read_json(files[0])
        return Listed(rows, [f.name for f in files], detector=detector_in(first))


def _files(folder: Path) -> list[Path]:
    """Returns the files of the frames; some tools leave out `_keypoints` in their
    names."""
    return sorted(folder.glob(OpenPose.folder)) or sorted(folder.glob("*.json"))


def _read_frame(file: Path) -> list[tuple[np.ndarray, int]]:
    data = read_json(file)
    people = data.get("people") if isinstance(data, dict) else None
    if not isinstance(people, list):
        raise InputError(f"{file}: no list `people`, so not OpenPose's output.")
    found = []
    for person in people:
        if not isinstance(person, dict):
            raise InputError(f"{file}: `people` holds {type(person).__name__}s.")
        flat = person.get("pose_keypoints_2d", person.get("pose_keypoints"))
        if flat is None:
            raise InputError(f"{file}: a person without `pose_keypoints_2d`.")
        found.append((triples(file, flat), person_in(person, "person_id")))
    return found
