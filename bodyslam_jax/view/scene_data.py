"""A result as the 3D page reads it: JSON with arrays in base64.

The page skins the bodies itself, so that each person needs the rest mesh and weights
once, and per frame the rotations of 24 joints and the place of the pelvis: 208 bytes.

`scene.html` is one file with everything in it, which opens without a network;
`notebook_scene` shows the same page inside a notebook. `VideoSampler` takes
small images and colours of the map from the video.
"""

import base64
import dataclasses
import html
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import cv2
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, UInt8

from bodyslam_jax import evaluation
from bodyslam_jax.body import PARENTS, BodyModel, rest_joints
from bodyslam_jax.body.skeleton import FEET
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.diagnostics import statistics
from bodyslam_jax.diagnostics.reported_status import inferred_bones, reported_status
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.geometry.arrays import runs
from bodyslam_jax.io import atomic, files
from bodyslam_jax.io.markup import json_in_html
from bodyslam_jax.types import Result, Tracks
from bodyslam_jax.view.ground import feet_on_the_ground
from bodyslam_jax.view.style import PEOPLE, Image

_MAX_MAP_POINTS = 60_000
_MILLIMETRES_PER_METRE = 1000.0
_QUATERNION_ONE = 32767
"""A quaternion's entries are sent as 16-bit integers; this is the integer for 1."""
_MAX_IMAGES = 400
_MAX_IMAGE_BYTES = 3_600_000
"""Size of all small images, bytes, so that the page of 1,000 frames has less than 8
MB."""
_IMAGE_WIDTH_PX = 320
"""Width of a small image, px."""
_JPEG_QUALITY = 55
"""Quality of JPEG, 0 to 100."""
_SCRIPTS = tuple(
    f"{name}.js"
    for name in ("three", "scene_pieces", "scene_run", "scene_view", "scene_page")
)
_RUN = '<script type="application/json" class="run">{}</script>'
_RUNS = re.compile(_RUN.replace("{}", "(.*?)"), re.DOTALL)


@dataclasses.dataclass(frozen=True)
class VideoSamples:
    """Samples of a video whose map has `l` landmarks."""

    frame: Int[np.ndarray, " k"]
    """Frames with a small image, increasing."""
    images: tuple[bytes, ...]
    """JPEG, one for each of `frame`."""
    colors: UInt8[np.ndarray, "l 3"]
    """Colours of the landmarks, RGB: the mean over the pixels that show them; grey
    where none does."""


def scene_data(
    result: Result, body: BodyModel, samples: VideoSamples | None = None
) -> dict[str, Any]:
    """Returns what the page shows of one run.

    Args:
        samples: small images and colours of the map; without them the page shows
            neither.
    """
    summary = result.summary
    inferred = inferred_bones(result) @ (1 << np.arange(24))
    source = summary.get("input")
    source = source if isinstance(source, dict) else {}
    return {
        "name": str(source.get("name") or "run"),
        "status": summary.get("status"),
        "times": _array(result.timestamps - result.timestamps[0], np.float32),
        "metric": bool(result.present.any()),
        "scale_sigma": _relative_sigma(result),
        "camera": _camera(result, source),
        "map": _map(result, samples),
        "images": _images(samples),
        "body": _skin(body),
        "people": [
            _person(result, body, h, inferred[h]) for h in range(len(result.poses))
        ],
    }


def _array(values: np.ndarray, dtype: Any) -> dict[str, Any]:
    packed = np.ascontiguousarray(values, np.dtype(dtype).newbyteorder("<"))
    return {
        "type": np.dtype(dtype).name,
        "shape": list(packed.shape),
        "data": base64.b64encode(packed.tobytes()).decode(),
    }


def _rotations(vectors: Float[np.ndarray, "*b 3"]) -> dict[str, Any]:
    """Returns unit quaternions (x y z w) of rotation vectors."""
    return _array(np.round(so3.quaternion(vectors) * _QUATERNION_ONE), np.int16)


def _relative_sigma(result: Result) -> float | None:
    """Returns the relative standard deviation of all lengths; `None` if it is
    unknown."""
    sigma = (result.summary.get("scale") or {}).get("sigma")
    if sigma is None or not math.isfinite(sigma) or result.scale <= 0:
        return None
    return float(sigma / result.scale)


def _camera(result: Result, source: dict[str, Any]) -> dict[str, Any]:
    fx, fy, cx, cy = (float(x) for x in result.intrinsics[:4])
    return {
        "position": _array(result.T_WC[:, :3, 3], np.float32),
        "rotation": _rotations(so3.log(result.T_WC[:, :3, :3])),
        "located": _array(result.located, np.uint8),
        "distance": statistics.camera_statistics(result).distance,
        "focal": [fx, fy],
        "centre": [cx, cy],
        # The centre of an image lies half a pixel before half its size.
        "size": [
            int(source.get("width") or round(2 * cx + 1)),
            int(source.get("height") or round(2 * cy + 1)),
        ],
    }


def _map(result: Result, samples: VideoSamples | None) -> dict[str, Any]:
    points = result.landmarks
    colors: UInt8[np.ndarray, "l 3"] = np.full(points.shape, 140, np.uint8)
    if samples is not None and len(samples.colors) == len(points):
        colors = samples.colors
    chosen = slice(None, None, max(1, -(-len(points) // _MAX_MAP_POINTS)))
    return {
        "points": _array(points[chosen], np.float32),
        "colors": _array(colors[chosen], np.uint8),
    }


def _images(samples: VideoSamples | None) -> dict[str, Any]:
    if samples is None:
        return {"frame": [], "jpeg": []}
    jpeg = [base64.b64encode(image).decode() for image in samples.images]
    return {"frame": samples.frame.tolist(), "jpeg": jpeg}


def _skin(body: BodyModel) -> dict[str, Any]:
    """Returns triangles and the four largest skinning weights of each vertex: in the
    default body, the others are at most 3 %."""
    joint, weight = np.asarray(body.skin_joint), np.asarray(body.skin_weight)
    order = np.argsort(-weight, axis=1)[:, :4]
    joint, weight = (np.take_along_axis(x, order, axis=1) for x in (joint, weight))
    missing = ((0, 0), (0, 4 - weight.shape[1]))
    joint, weight = np.pad(joint, missing), np.pad(weight, missing)
    weight = weight / weight.sum(axis=1, keepdims=True)
    index = np.uint16 if body.num_vertices <= 1 << 16 else np.uint32
    return {
        "parents": list(PARENTS),
        "feet": list(FEET),
        "faces": _array(np.asarray(body.faces), index),
        "joints": _array(joint, np.uint8),
        "weights": _array(np.round(255 * weight), np.uint8),
    }


def _person(
    result: Result, body: BodyModel, h: int, inferred: Int[np.ndarray, " t"]
) -> dict[str, Any]:
    """Returns the data of a person; bits of `inferred` are bones that were hidden, not
    measured."""
    beta = result.betas[h]
    rest = np.asarray(rest_joints(body, jnp.asarray(beta, body.dtype)), np.float64)
    template, dirs = (
        np.asarray(x, np.float64) for x in (body.template, body.shape_dirs)
    )
    skin = template + dirs @ beta
    way = statistics.person_statistics(result, h)
    reported = (result.summary.get("people") or [])[h : h + 1]
    status = reported_status(result.summary, h)
    blue, green, red = PEOPLE[h % len(PEOPLE)]
    stands = feet_on_the_ground(result)[h]
    return {
        "number": h,
        "status": status.status,
        "words": status.words,
        "reasons": list(status.reasons),
        "inferred": _array(inferred, np.uint32) if inferred.any() else None,
        "color": f"#{red:02x}{green:02x}{blue:02x}",
        "present": _array(result.present[h], np.uint8),
        # Tenths of a millimetre: a body is less than 3 m from its origin.
        "skin": _array(np.round(skin * 10 * _MILLIMETRES_PER_METRE), np.int16),
        "rest": _array(rest, np.float32),
        "pelvis": _array(rest[0] + result.trans[h], np.float32),
        "rotations": _rotations(result.poses[h].reshape(-1, 24, 3)),
        "stands": _array(stands[:, 0] + 2 * stands[:, 1], np.uint8),
        "footprints": _footprints(result, h, stands),
        "stature": statistics.stature(body, beta),
        "stature_sigma": reported[0].get("stature_sigma_m") if reported else None,
        "distance": way.distance,
        "speed": way.mean_speed,
    }


def _footprints(result: Result, h: int, stands: np.ndarray) -> list[list[int | float]]:
    """Returns the first frame and the position (x, z, m) of each stance of a foot."""
    found = []
    for foot, joint in enumerate(FEET):
        for run in runs(stands[:, foot]):
            x, _, z = np.median(result.joints[h, run, joint], axis=0)
            found.append([int(run.start), round(float(x), 3), round(float(z), 3)])
    return sorted(found)


class VideoSampler:
    """Collects samples of the images that pass through `watch`."""

    def __init__(
        self,
        num_frames: int,
        tracks: Tracks | None,
        num_landmarks: int,
        whole_frame: int | None = None,
    ):
        """`tracks` are observations of the map's landmarks, in pixels of the images;
        `whole_frame` is the frame whose image is kept as it is."""
        self.whole: Image | None = None
        """The image of `whole_frame`, once it has passed."""
        self._whole_frame = whole_frame
        self._step = max(1, -(-num_frames // _MAX_IMAGES))
        self._images: dict[int, bytes] = {}
        self._tracks = tracks
        if tracks is not None:
            self._order = np.argsort(tracks.frame, kind="stable")
            edges = np.arange(num_frames + 1)
            self._starts = np.searchsorted(tracks.frame[self._order], edges)
        self._sum = np.zeros((num_landmarks, 3))
        self._count = np.zeros(num_landmarks)

    def watch(self, images: Iterable[Image]) -> Iterator[Image]:
        """Yields the images (BGR, one per frame) unchanged; each is sampled as it
        passes."""
        for frame, image in enumerate(images):
            if frame == self._whole_frame:
                self.whole = image.copy()
            if frame % self._step == 0:
                self._images[frame] = _small(image)
            if self._tracks is not None and frame + 1 < len(self._starts):
                self._add_colors(frame, image, self._tracks)
            yield image

    def samples(self) -> VideoSamples:
        """Returns the samples of the images that passed so far."""
        kept = list(self._images)
        total = sum(map(len, self._images.values()))
        if total > _MAX_IMAGE_BYTES:
            number = int(len(kept) * _MAX_IMAGE_BYTES / total)
            chosen = np.linspace(0, len(kept) - 1, number).round().astype(int)
            kept = [kept[k] for k in chosen]
        mean = self._sum / np.maximum(self._count, 1)[:, None]
        mean[self._count == 0] = 128
        return VideoSamples(
            np.array(kept, int),
            tuple(self._images[frame] for frame in kept),
            np.round(mean[:, ::-1]).astype(np.uint8),
        )

    def _add_colors(self, frame: int, image: Image, tracks: Tracks) -> None:
        rows = self._order[self._starts[frame] : self._starts[frame + 1]]
        corner = [image.shape[1] - 1, image.shape[0] - 1]
        u, v = np.clip(np.round(tracks.uv[rows]), 0, corner).astype(int).T
        np.add.at(self._sum, tracks.landmark[rows], image[v, u])
        np.add.at(self._count, tracks.landmark[rows], 1)


def _small(image: Image) -> bytes:
    height, width = image.shape[:2]
    scale = min(1.0, _IMAGE_WIDTH_PX / max(width, height))
    size = (max(1, round(scale * width)), max(1, round(scale * height)))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    options = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    return cv2.imencode(".jpg", small, options)[1].tobytes()


def write_scene(
    path: Path, result: Result, body: BodyModel, samples: VideoSamples | None = None
) -> None:
    """Writes the page of a result: people, camera, map and ground in 3D, over time.

    `samples` are small images and colours that a `VideoSampler` took from the video.
    """
    atomic.write_text(path, scene_page([scene_data(result, body, samples)]))


def scene_page(runs: Sequence[dict[str, Any]]) -> str:
    """Returns the page of one or more runs (`scene_data`); the first sets the
    timeline."""
    parts = {
        "{title}": html.escape(str(runs[0]["name"])),
        "{style}": _asset("scene.css"),
        "{script}": "\n".join(map(_asset, _SCRIPTS)),
        "{runs}": "\n".join(_RUN.format(json_in_html(run)) for run in runs),
    }
    # In one pass: a name may be that of another part.
    place = re.compile("|".join(map(re.escape, parts)))
    return place.sub(lambda found: parts[found[0]], _asset("scene.html"))


def read_runs(path: Path) -> list[dict[str, Any]]:
    """Returns the runs in a page that `write_scene` wrote.

    **Raises:** `InputError` if the file is no such page.
    """
    text = files.read_text(path, "a scene.html of a run")
    found = [files.parse_json(run, path) for run in _RUNS.findall(text)]
    if not found or not all(isinstance(run, dict) and "name" in run for run in found):
        raise InputError(f"{path}: no runs in it, expected a scene.html of a run.")
    return found


def _asset(name: str) -> str:
    folder = resources.files("bodyslam_jax.view").joinpath("assets")
    return folder.joinpath(name).read_text(encoding="utf-8")


class NotebookScene:
    """The page of a result, which Jupyter shows where it is a cell's last value."""

    def __init__(self, page: str, height: int):
        self.page = page
        """HTML, complete."""
        self.height = height
        """px"""

    def _repr_html_(self) -> str:
        return (
            f'<iframe srcdoc="{html.escape(self.page)}" title="scene in 3D" '
            f'style="width: 100%; height: {self.height}px; border: 0"></iframe>'
        )


def notebook_scene(
    result: Result,
    run: Path | None = None,
    *,
    height: int = 600,
    body: BodyModel | None = None,
) -> NotebookScene:
    """Returns the page of a result for a notebook, with its images and the map's
    colours if the folder of its run is given.

    Args:
        height: Of the page in the notebook, px.
        body: The body model of the result; without it the one that this machine has;
            a file that the result names is not opened.
    """
    if run is not None and (run / "scene.html").exists():
        return NotebookScene(scene_page(read_runs(run / "scene.html")[:1]), height)
    if body is None:
        body = evaluation.body_of_run(result)
    return NotebookScene(scene_page([scene_data(result, body)]), height)
