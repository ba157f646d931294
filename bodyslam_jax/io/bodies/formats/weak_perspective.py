"""SPIN and VIBE: bodies in weak perspective, in square boxes around people."""

import numpy as np

from bodyslam_jax.io.bodies.body_format import BodyFormat
from bodyslam_jax.io.bodies.parts import (
    Rows,
    Video,
    betas_of,
    frames_of,
    from_crops,
    join,
    numbers_of,
    people_of,
)
from bodyslam_jax.io.formats import Source
from bodyslam_jax.io.frame_index import InvalidContent


class Spin(BodyFormat):
    """SPIN: a row per frame; the boxes, which SPIN does not write, are needed too."""

    name = "SPIN"
    layout = ("pose", "betas", "camera")

    def read(self, source: Source, video: Video) -> Rows:
        return from_spin(source.content, video)


class Vibe(BodyFormat):
    """VIBE: `{person: {...}}`, crops as boxes (cx, cy, w, h) with w = h."""

    name = "VIBE"
    layout = ("pose", "pred_cam", "betas", "bboxes")
    by_entry = True

    def read(self, source: Source, video: Video) -> Rows:
        data, rows = source.content, []
        for number, (_, one) in enumerate(
            sorted(data.items(), key=lambda kv: str(kv[0]))
        ):
            poses = numbers_of(one, "pose", (-1, 72))
            n = len(poses)
            boxes = numbers_of(one, "bboxes", (n, 4))
            rows.append(
                from_crops(
                    frames_of(one, "frame_ids", n, video.num_frames),
                    np.full(n, number),
                    poses,
                    betas_of(one, "betas", n),
                    numbers_of(one, "pred_cam", (n, 3)),
                    boxes[:, :3],
                    video.camera,
                )
            )
        return join(rows)


def from_spin(data: dict, video: Video) -> Rows:
    """Returns bodies with `camera` (m, 3: s, tx, ty) in boxes `bbox` (m, 3: cx, cy,
    side px).

    **Raises:** `InvalidContent` if an array is missing or of another shape.
    """
    poses = numbers_of(data, "pose", (-1, 72))
    frame = frames_of(data, "frame", len(poses), video.num_frames)
    if "bbox" not in data:
        raise InvalidContent("`camera` needs `bbox` (m, 3: cx, cy, side px)")
    box, crop = (
        numbers_of(data, "bbox", (len(poses), 3)),
        numbers_of(data, "camera", (len(poses), 3)),
    )
    return from_crops(
        frame,
        people_of(data, len(poses)),
        poses,
        betas_of(data, "betas", len(poses)),
        crop,
        box,
        video.camera,
    )
