"""Finds the body model, by kind and gender, that true parameters belong to.

The same β yield different shapes in different models, so ground truths are posed with
the gendered SMPL that they were made with, as in the evaluations of EMDB, WHAM and
TRAM.
"""

import dataclasses
import logging
import os
from pathlib import Path

import numpy as np

from bodyslam_jax.body import DEFAULT, BodyModel, load_body_model, search_paths
from bodyslam_jax.body.files import PATH_VARIABLE, candidates, named_gender
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.evaluation.readers import read_groundtruth
from bodyslam_jax.io.archive import Archive, read_npz
from bodyslam_jax.io.bodies.parts import gender_of
from bodyslam_jax.types import Result

log = logging.getLogger(__name__)

_BODY_NAMES = {"smpl": "SMPL", "smplh": "SMPL-H", "smplx": "SMPL-X"}
_BODY_NAMES["default"] = "the free body that ships with the package"
_KINDS_BY_POSE_SIZE = {156: ("smplh", "smpl"), 165: ("smplx",)}
"""Kinds of body by the number of pose parameters, best first."""
_FILE_STEMS: dict[str, tuple[str, ...]] = {
    "smpl": ("smpl_", "basicmodel"),
    "smplh": ("smplh_", "model"),
    "smplx": ("smplx_",),
}
"""Beginnings of the usual file names."""


def body_for(
    file: Path, gender: str, kind: str, body_model: Path | None = None
) -> BodyModel:
    """Loads the body of one kind and gender, for the parameters in `file`.

    `body_model` is a file, or a folder with a file for each gender and kind; without it
    the body is searched for where `load_body_model` does.

    **Raises:** `InputError` if there is no such body.
    """
    is_found = body_model or os.environ.get(PATH_VARIABLE) or _is_installed(gender)
    place = body_model if is_found else DEFAULT
    body, wrong = _load(place, gender, gender, (kind,))
    if wrong:
        raise InputError(
            f"{file}: its joints need {_BODY_NAMES[kind]}, {gender}, not {wrong}; "
            "name its file or folder with --body-model."
        )
    return body


def read_truth(path: Path, body_model: Path | None = None) -> Result:
    """Reads a ground truth as `read_groundtruth` does, and poses each body without
    joints with a body of its gender.

    Warns if the body that is used is not the one that the parameters belong to.

    **Raises:** as `read_groundtruth` and `load_body_model`.
    """
    if body_model and not body_model.exists():
        raise InputError(f"{body_model}: no such body model.")
    files = _bodies(path)
    needs = [None if "joints" in x else _needed(x) for x in files]
    wanted = sorted({need for need in needs if need})
    if not wanted:
        return read_groundtruth(path, load_body_model(DEFAULT))  # poses no body
    bodies = {need: _body_at_hand(body_model, *need) for need in wanted}
    for file, need in zip((x.path for x in files), needs, strict=True):
        if need and (wrong := bodies[need][1]):
            log.warning(
                "%s: no joints in it; its parameters are of %s, %s, but posed with %s, "
                "which makes another person of them; name the right body with "
                "--body-model.",
                *(file, _BODY_NAMES[need[1][0]], need[0], wrong),
            )
    read = {need: read_groundtruth(path, body) for need, (body, _) in bodies.items()}
    of = [need or wanted[0] for need in needs]
    joints = np.stack([read[need].joints[h] for h, need in enumerate(of)])
    return dataclasses.replace(read[wanted[0]], joints=joints)


def _bodies(path: Path) -> list[Archive]:
    """Opens the body files of a ground truth in the order of its people."""
    if not path.is_dir():
        files = [path] if path.is_file() and path.suffix == ".npz" else []
    elif not (path / "groundtruth").is_dir() and (path / "result.npz").exists():
        files = []
    else:
        folder = path / "groundtruth" if (path / "groundtruth").is_dir() else path
        files = sorted(folder.glob("body.npz")) or sorted(folder.glob("body_*.npz"))
    return [read_npz(file, "a true body (.npz)") for file in files]


def _needed(person: Archive) -> tuple[str, tuple[str, ...]]:
    """Returns the gender of an AMASS file, and the kinds of body that fit it, best
    first."""
    width = person.header("poses")[0][-1:] if "poses" in person else ()
    kinds = _KINDS_BY_POSE_SIZE.get(width[0] if width else 0, ("smpl", "smplh"))
    has_text = "gender" in person and person.header("gender")[1].kind in "SU"
    gender = gender_of(person.text("gender")) if has_text else None
    return gender or "neutral", kinds


def _is_installed(gender: str) -> bool:
    return any(file.is_file() for file in search_paths(gender))


def _body_at_hand(
    body_model: Path | None, gender: str, kinds: tuple[str, ...]
) -> tuple[BodyModel, str | None]:
    """Loads the body of the gender, or the neutral one if none is named or installed;
    returns it with the description of a mismatch, if any."""
    available = gender if body_model or _is_installed(gender) else "neutral"
    return _load(body_model, available, gender, kinds)


def _load(
    place: Path | None, available: str, gender: str, kinds: tuple[str, ...]
) -> tuple[BodyModel, str | None]:
    """Loads a body of one of `kinds`, best first, among the files of gender
    `available`.

    Falls back to another body, and returns its description, for a warning.
    """
    named = place or os.environ.get(PATH_VARIABLE) or Path()
    files = candidates(place, available) if place else search_paths(available)
    order = lambda file: (not file.is_relative_to(named), _rank(file, kinds))
    files = sorted(filter(Path.is_file, files), key=order)
    found = []
    for file in files:
        body = load_body_model(file)
        wrong = _mismatch(body, file, gender, kinds)
        if not wrong:
            return body, None
        found.append((body, wrong))
    if found:
        return found[0]
    body = load_body_model(place, available)  # the default body, or an error
    return body, _mismatch(body, DEFAULT, gender, kinds)


def _rank(file: Path, kinds: tuple[str, ...]) -> int:
    """Returns the index among `kinds` of a file's kind, guessed from its name."""
    fits = [file.stem.lower().startswith(_FILE_STEMS[kind]) for kind in kinds]
    return [*fits, True].index(True)


def _mismatch(
    body: BodyModel, file: Path, gender: str, kinds: tuple[str, ...]
) -> str | None:
    """Returns the description of a body that is not of the wanted kinds and gender (by
    file name), else `None`."""
    name = _BODY_NAMES[body.kind]
    if body.kind == "default":
        return name
    of = named_gender(file)
    if body.kind not in kinds or of not in (gender, None):
        return f"{body.name} ({name}{', ' + of if of else ''})"
    return None
