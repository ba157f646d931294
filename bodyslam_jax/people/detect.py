"""Detects people and keypoints: YOLOX finds boxes, RTMPose points in each box.

It is an alternative to the networks of the package (`find`). The models are downloaded
once to the user's cache and checked against their SHA-256; both are Apache-2.0:

- YOLOX-S (Ge et al., 2021), Megvii's own export;
- DWPose-L (Yang et al., 2023), an RTMPose with 133 keypoints, of which those of body
  and feet are used.

Everything but the networks is plain NumPy. Images are BGR, as OpenCV reads them.
"""

import dataclasses
import hashlib
import logging
import os
import urllib.request
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from bodyslam_jax.body.skeleton import BODY25
from bodyslam_jax.config import Detect
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io import atomic
from bodyslam_jax.io.files import open_binary
from bodyslam_jax.io.keypoints.layouts import from_layout, usual_layout
from bodyslam_jax.people.networks import check_onnxruntime, make_session

log = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True)
class Model:
    """A network that can be downloaded."""

    name: str
    url: str
    sha256: str
    megabytes: int


DETECTOR = Model(
    "yolox_s.onnx",
    "https://github.com/Megvii-BaseDetection/YOLOX/releases/download/0.1.1rc0/yolox_s.onnx",
    "c5c2d13e59ae883e6af3b45daea64af4833a4951c92d116ec270d9ddbe998063",
    36,  # MB, the size of the file
)
POSE = Model(
    "dw-ll_ucoco_384.onnx",
    "https://huggingface.co/yzd-v/DWPose/resolve/main/dw-ll_ucoco_384.onnx",
    "724f4ff2439ed61afb86fb8a1951ec39c6220682803b4a8bd4f598cd913b1843",
    134,  # MB, the size of the file
)

_MIN_SCORE = 0.5
"""Score from which a box counts as a person."""
_MAX_OVERLAP = 0.45
"""Intersection over union above which two boxes are one person's."""
_MAX_PEOPLE = 8
"""Number of people per image whose keypoints are estimated, the largest first."""
_STRIDES = (8, 16, 32)
"""Cells of YOLOX's three grids, px of its input (Ge et al., 2021)."""
_PAD = 114
"""Grey level beyond the image, as in YOLOX's own preprocessing."""
_CROP_MARGIN = 1.25
"""Side of the crop over that of the box: RTMPose's own (Jiang et al., 2023)."""
# ImageNet's, as RTMPose was trained: red, green, blue.
_MEAN = np.array([123.675, 116.28, 103.53], np.float32)
_STD = np.array([58.395, 57.12, 57.375], np.float32)
"""Standard deviations, likewise."""
_SIMCC_SPLIT = 2.0
"""Bins of SimCC per pixel of the crop."""


def detect_people(
    images: Iterable[UInt8[np.ndarray, "y x 3"]],
    settings: Detect = Detect(),
    *,
    offline: bool = False,
    progress: Callable[[int], None] | None = None,
) -> list[Float[np.ndarray, "p 25 3"]]:
    """Returns the keypoints (u, v in px, confidence) of the people in each image, in
    BODY_25 order.

    People are in no particular order and are not tracked; `io.keypoints.associate` does
    that. One image is in memory at a time.

    Args:
        offline: does not use the internet; models must be in the cache, or the user's
            own.
        progress: called with the number of images done.

    **Raises:** `InputError` if onnxruntime is not installed, or if a model is not
    available or not of the expected kind.
    """
    detector = _session(settings.detector, DETECTOR, offline)
    pose = _session(settings.pose, POSE, offline)
    found = []
    for index, image in enumerate(images):
        boxes = find_boxes(detector, image)
        points = [find_keypoints(pose, image, box) for box in boxes]
        found.append(np.array(points).reshape(-1, 25, 3))
        if progress is not None:
            progress(index + 1)
    return found


def model_path(own: str | None, model: Model, offline: bool) -> Path:
    """Returns the file of a model: `own`, the user's, or that in the cache, which is
    downloaded if it is missing.

    **Raises:** `InputError` with what to do if the file is not available.
    """
    if own is not None:
        if not Path(own).is_file():
            raise InputError(f"{own}: no such file; expected an ONNX model.")
        return Path(own)
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    path = Path(home) / "bodyslam" / "models" / model.name
    advice = f"put {model.url} there, or give keypoints/ instead"
    if not path.is_file():
        if offline:
            raise InputError(f"{path}: file not found, and offline is set; {advice}.")
        log.info("fetching %s (%d MB) to %s", model.url, model.megabytes, path)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            _fetch(model, path)
        except OSError as error:
            reason = getattr(error, "reason", error)
            raise InputError(
                f"{path}: cannot be fetched ({reason}); {advice}."
            ) from error
    if (digest := _sha256(path)) != model.sha256:
        raise InputError(
            f"{path}: SHA-256 {digest[:12]}..., expected {model.sha256[:12]}...; "
            "delete the file to fetch it again."
        )
    return path


def find_boxes(
    session: Any, image: UInt8[np.ndarray, "y x 3"]
) -> Float[np.ndarray, "p 4"]:
    """Returns the boxes `x0 y0 x1 y1` (px) of the largest people in an image."""
    tensor = session.get_inputs()[0]
    height, width = (int(n) for n in tensor.shape[2:])
    scale = min(height / image.shape[0], width / image.shape[1])
    # Pixel centres: the canvas' pixel i shows the image at (i + 1/2) / scale - 1/2.
    canvas = np.full((height, width, 3), _PAD, np.float32)
    rows, columns = round(image.shape[0] * scale), round(image.shape[1] * scale)
    at = lambda count: (np.arange(count) + 0.5) / scale - 0.5
    canvas[:rows, :columns] = sample(image, at(columns), at(rows))
    (raw,) = session.run(None, {tensor.name: canvas.transpose(2, 0, 1)[None]})
    boxes, score = decode_yolox(raw[0], (height, width), _MIN_SCORE)
    boxes = boxes[suppress(boxes, score, _MAX_OVERLAP)]
    area = np.prod(boxes[:, 2:] - boxes[:, :2], axis=1)
    return boxes[np.argsort(-area)[:_MAX_PEOPLE]] / scale


def decode_yolox(
    raw: Float[np.ndarray, "n c"], size: tuple[int, int], min_score: float
) -> tuple[Float[np.ndarray, "p 4"], Float[np.ndarray, " p"]]:
    """Returns the boxes of class 0, person, from YOLOX's raw output, in px of its
    canvas, and their scores.

    Rows are cells of grids of stride 8, 16, 32, row by row: offset of the centre from
    the cell and log of the size in strides, objectness, and a score for each class.
    """
    cells, strides = [], []
    for stride in _STRIDES:
        y, x = np.mgrid[: size[0] // stride, : size[1] // stride]
        cells.append(np.stack([x.ravel(), y.ravel()], 1))
        strides.append(np.full((x.size, 1), stride))
    cell, stride = np.concatenate(cells), np.concatenate(strides)
    if raw.ndim != 2 or len(raw) != len(cell) or raw.shape[1] < 6:
        raise InputError(
            f"detector: output of shape {raw.shape}, expected ({len(cell)}, 85) of a "
            f"YOLOX without decoding for {size[1]}x{size[0]}."
        )
    score = raw[:, 4] * raw[:, 5]
    centre, extent = (raw[:, :2] + cell) * stride, np.exp(raw[:, 2:4]) * stride
    keep = score >= min_score
    boxes = np.concatenate([centre - extent / 2, centre + extent / 2], 1)[keep]
    return boxes.astype(float), score[keep].astype(float)


def suppress(
    boxes: Float[np.ndarray, "p 4"], score: Float[np.ndarray, " p"], max_overlap: float
) -> np.ndarray:
    """Returns the indices of boxes, best first, of which none overlaps a better one by
    more than `max_overlap` (intersection over union)."""
    area = np.prod(boxes[:, 2:] - boxes[:, :2], axis=1)
    left = np.argsort(-score, kind="stable")
    kept = []
    while len(left):
        best, left = left[0], left[1:]
        kept.append(best)
        low = np.maximum(boxes[best, :2], boxes[left, :2])
        high = np.minimum(boxes[best, 2:], boxes[left, 2:])
        shared = np.prod(np.maximum(high - low, 0), axis=1)
        left = left[shared <= max_overlap * (area[best] + area[left] - shared)]
    return np.array(kept, int)


def find_keypoints(
    session: Any, image: UInt8[np.ndarray, "y x 3"], box: Float[np.ndarray, " 4"]
) -> Float[np.ndarray, "25 3"]:
    """Returns the keypoints (px, confidence) of the person in a box, in BODY_25
    order."""
    tensor = session.get_inputs()[0]
    height, width = (int(n) for n in tensor.shape[2:])
    centre, extent = (box[:2] + box[2:]) / 2, _CROP_MARGIN * (box[2:] - box[:2])
    # The crop has the network's aspect ratio and contains the box, at a single scale.
    step = max(extent[0] / width, extent[1] / height)
    corner = centre - step * np.array([width, height]) / 2
    x, y = corner[0] + step * np.arange(width), corner[1] + step * np.arange(height)
    rgb = (sample(image, x, y)[..., ::-1] - _MEAN) / _STD
    crop = np.ascontiguousarray(rgb.transpose(2, 0, 1)[None], np.float32)
    simcc_x, simcc_y = session.run(None, {tensor.name: crop})
    points, confidence = decode_simcc(simcc_x[0], simcc_y[0])
    points = corner + step * points
    return to_body25(np.concatenate([points, confidence[:, None]], axis=1))


def decode_simcc(
    x: Float[np.ndarray, "k w"], y: Float[np.ndarray, "k h"]
) -> tuple[Float[np.ndarray, "k 2"], Float[np.ndarray, " k"]]:
    """Returns positions (px of the crop) and confidences of `k` keypoints from
    RTMPose's scores of columns and rows (SimCC, two bins per pixel).

    The position is the bin with the highest score; the confidence is the lower of the
    two highest scores.
    """
    points = np.stack([x.argmax(1), y.argmax(1)], axis=1) / _SIMCC_SPLIT
    confidence = np.minimum(x.max(1), y.max(1)).astype(float)
    return points, np.clip(confidence, 0.0, 1.0)


def to_body25(points: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "25 3"]:
    """Returns BODY_25 from 17 (COCO), 26 (Halpe) or 133 (COCO-WholeBody) keypoints.

    The neck is the midpoint of the shoulders, the mid-hip that of the hips.
    """
    count = len(points)
    # COCO, Halpe, COCO-WholeBody.
    if count not in (17, 26, 133):
        raise InputError(f"pose: {count} keypoints, expected 17, 26 or 133.")
    layout = usual_layout(count)
    assert layout is not None
    middles = (BODY25["neck"], BODY25["mid_hip"])
    found = from_layout(points, [-1 if p in middles else p for p in layout.parts])
    found[found[:, 2] <= 0] = 0.0
    return found


def sample(
    image: UInt8[np.ndarray, "y x 3"],
    x: Float[np.ndarray, " w"],
    y: Float[np.ndarray, " h"],
) -> Float[np.ndarray, "h w 3"]:
    """Returns the image at a grid of columns x and rows y (px), bilinear; black
    outside."""
    weights, indices, valid = [], [], []
    for where, size in ((y, image.shape[0]), (x, image.shape[1])):
        inside = (where > -1) & (where < size)
        low = np.floor(where)
        weights.append((where - low).astype(np.float32))
        pair = np.clip(np.stack([low, low + 1]), 0, size - 1).astype(int)
        indices.append(pair)
        valid.append(inside)
    (top, bottom), (left, right) = indices
    down, along = weights[0][:, None, None], weights[1][None, :, None]
    rows = image[top] * (1 - down) + image[bottom] * down
    found = rows[:, left] * (1 - along) + rows[:, right] * along
    return found * (valid[0][:, None] & valid[1][None])[..., None]


def _session(own: str | None, model: Model, offline: bool) -> Any:
    check_onnxruntime()
    return make_session(model_path(own, model, offline))


def _fetch(model: Model, path: Path) -> None:
    with (
        atomic.replacing(path) as partial,
        urllib.request.urlopen(model.url, timeout=30) as source,
        partial.open("wb") as target,
    ):
        while block := source.read(2**20):
            target.write(block)


def _sha256(path: Path) -> str:
    with open_binary(path, "a network (ONNX)") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
