"""`bodies.npz`, the format of this package."""

import dataclasses

import numpy as np

from bodyslam_jax.io.bodies.body_format import BodyFormat
from bodyslam_jax.io.bodies.formats.amass import body_pose, is_smplx
from bodyslam_jax.io.bodies.formats.weak_perspective import from_spin
from bodyslam_jax.io.bodies.parts import (
    PELVIS_SMPL,
    PELVIS_SMPLX,
    Rows,
    Video,
    numbers_of,
    whole_of,
)
from bodyslam_jax.io.formats import Source
from bodyslam_jax.io.frame_index import InvalidContent


class BodiesNpz(BodyFormat):
    """A row per body: `frame`, `poses`, `betas`, `trans`, perhaps `person`; or, with
    `camera` and `bbox` in place of `trans`, in weak perspective.

    Shapes count as regressed by a network, unless `shapes_regressed` () is false.
    """

    name = "bodies.npz"
    layout = ("frame", "poses", "betas")

    def read(self, source: Source, video: Video) -> Rows:
        data = source.content
        regressed = _shapes_regressed(data)
        if "trans" not in data:
            if "camera" not in data:
                raise InvalidContent("neither `trans` nor `camera` and `bbox`")
            rows = from_spin({**data, "pose": data["poses"]}, video)
            return dataclasses.replace(rows, shapes_regressed=regressed)
        arrays = {}
        n = numbers_of(data, "frame", None).size
        data = _as_smpl(data)
        person = data.get("person", np.zeros(n))
        for name, value, shape in (
            ("frame", data["frame"], (n,)),
            ("person", person, (n,)),
            ("poses", data["poses"], (n, 72)),
            ("betas", data["betas"], (n, 10)),
            ("trans", data["trans"], (n, 3)),
        ):
            array = numbers_of({name: value}, name, shape)
            whole = name in ("frame", "person")
            arrays[name] = whole_of(array, name) if whole else array
        return Rows(**arrays, shapes_regressed=regressed)


def _as_smpl(data: dict) -> dict:
    """Returns the data with SMPL's poses, if they are as wide as SMPL-H's or
    SMPL-X's."""
    poses, betas = (numbers_of(data, name, None) for name in ("poses", "betas"))
    # Three angles for 22 joints, for SMPL-H's 52, for SMPL-X's 55.
    if poses.ndim != 2 or poses.shape[1] not in (66, 156, 165):
        poses72 = poses
    else:
        poses72 = body_pose(poses)
        if is_smplx(data, poses.shape[1]):
            trans = numbers_of(data, "trans", (-1, 3)) + PELVIS_SMPLX - PELVIS_SMPL
            return {
                **data,
                "poses": poses72,
                "trans": trans,
                "betas": 0 * betas[:, :10],
            }
    if betas.ndim == 2 and betas.shape[1] > 10:
        betas = betas[:, :10]
    return {**data, "poses": poses72, "betas": betas}


def _shapes_regressed(data: dict) -> bool:
    value = np.asarray(data.get("shapes_regressed", True))
    if value.size != 1 or value.item() not in (0, 1):
        found = str(value)[:40]
        raise InvalidContent(f"`shapes_regressed` is {found}, not true or false")
    return bool(value.item())
