"""The focal length that each tool assumes for its bodies' camera.

A regressor sees a crop, and converts the body's size in it to a distance with a focal
length of its own. For the true camera the distance has to be converted by the ratio of
focal lengths. The file's value is used if it has one; otherwise the tool's default:

| tool | focal length, px | where it is set in the tool's public code |
|---|---|---|
| WHAM | diagonal of the image, also where a calibration is given: that is for SLAM | `compute_cam_intrinsics`, `lib/utils/imutils.py`; called by `lib/data/datasets/dataset_custom.py` |
| CLIFF | `focal_l` in the file, else the diagonal | `estimate_focal_length`, `common/utils.py` |
| TRAM | `img_focal` of `camera.npy`, else the diagonal | `est_focal` of its datasets |
| GVHMR | `K_fullimg` in the file, else the diagonal | `estimate_focal_length`, `hmr4d/utils/geo/hmr_cam.py` |
| 4D-Humans, PHALP | 5000 for a crop of 256 px, so 5000/256 of the longer side | `EXTRA.FOCAL_LENGTH / MODEL.IMAGE_SIZE * img_size.max()`, `demo.py` |
| GLAMR, PromptHMR, SLAHMR | in the file: `cam_K`, `img_focal`, `intrins` | |
| SPIN, VIBE | none: weak perspective in a box | |
"""  # noqa: E501

import math
from collections.abc import Callable

from bodyslam_jax.io.bodies.body_records import Video
from bodyslam_jax.types import Intrinsics

_NOTABLE = 0.02
"""Relative difference of focal lengths from which there is a warning."""


def diagonal(camera: Intrinsics) -> float:
    """Of the image, px."""
    return math.hypot(camera.width, camera.height)


DEFAULT_FOCAL: dict[str, Callable[[Intrinsics], float]] = {
    "WHAM": diagonal,
    "CLIFF": diagonal,
    "TRAM": diagonal,
    "GVHMR": diagonal,
    "4D-Humans": lambda camera: 5000 / 256 * max(camera.width, camera.height),
}
"""The focal length (px) that each tool assumes for an image of the given size. It is
used if the tool's file has no focal length."""


def default_focal(tool: str, video: Video) -> float:
    """The focal length that `tool` assumes, px, with a warning if the camera's differs.

    `parts.refocused` moves the bodies to where they have the same image in the camera.
    """
    focal, actual = DEFAULT_FOCAL[tool](video.camera), float(video.camera.params[0])
    if abs(focal / actual - 1) > _NOTABLE:
        video.warn(
            f"bodies of {tool}: no focal length in the file, its default of "
            f"{focal:.0f} px taken; the camera has {actual:.0f} px, so distances are "
            f"times {actual / focal:.3g}."
        )
    return focal
