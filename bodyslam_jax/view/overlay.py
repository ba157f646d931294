"""The overlay video: bodies, ground and tracked points on the frames, two insets."""

from collections.abc import Iterable, Iterator
from pathlib import Path

import cv2
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from bodyslam_jax.body import BodyModel
from bodyslam_jax.body import keypoints as keypoints_of
from bodyslam_jax.geometry.camera import project
from bodyslam_jax.types import Keypoints, Result, Tracks
from bodyslam_jax.view.ground import Ground
from bodyslam_jax.view.insets import Insets, draw_trails, trails
from bodyslam_jax.view.people import Mesh, coarse_body, draw_people, meshes
from bodyslam_jax.view.style import (
    PEOPLE,
    SUBPIXELS,
    Image,
    Legend,
    person_styles,
    write_names,
    write_text,
)
from bodyslam_jax.view.video_file import Codec, write_video


def write_overlay(
    path: Path,
    frames: Iterable[Image] | None,
    result: Result,
    body: BodyModel,
    tracks: Tracks | None = None,
    size: tuple[int, int] | None = None,
    max_width: int = 1280,
    codec: Codec = "VP8",
    keypoints: Keypoints | None = None,
) -> None:
    """Writes a video with one picture per frame of the result.

    **Arguments:**

    - `frames`: the video, BGR, one image per frame of the result, of the size of the
        intrinsics; frames that are missing are drawn on black.
    - `tracks`: points to draw; `size`: width and height (px) where there are no frames,
        else twice the principal point.
    - `max_width`: larger frames are drawn smaller, px. Where people come into every
        corner, the insets are beside the image, and the video is wider than it.
    - `codec`: VP8 by default (`.webm`), which plays in the same browsers as VP9 and is
        three times as fast, as OpenCV cannot set the speed of its VP9 encoder; `H264`
        (`.mp4`) needs PyAV.
    - `keypoints`: detected ones of the result's people, to be drawn beside the bodies'.

    **Raises:** `ValueError` if there is no such encoder; `OSError` if the video could
    not be written whole.
    """
    source = iter(frames) if frames is not None else iter(())
    first = next(source, None)
    if first is not None:
        size = (first.shape[1], first.shape[0])
    elif size is None:
        cx, cy = result.intrinsics[2:4]
        size = (round(2 * cx) + 1, round(2 * cy) + 1)
    shown, zoom = _shown(size, min(size[0], max_width))
    insets = Insets(result, shown, zoom)
    while (wide := shown[0] + insets.column) > max_width and shown[0] > 2:
        shown, zoom = _shown(size, shown[0] * max_width // wide)
        insets = Insets(result, shown, zoom, beside=True)
    images = _images(first, source, len(result.timestamps), shown)
    drawn = pictures(images, result, body, tracks, zoom, insets, keypoints)
    write_video(path, drawn, (shown[0] + insets.column, shown[1]), result.fps, codec)


def _shown(
    size: tuple[int, int], width: int
) -> tuple[tuple[int, int], Float[np.ndarray, " 2"]]:
    """Returns the size (px, even) of images of `size` that are shown `width` wide, and
    their pixels per pixel of the image."""
    width = max(2, width // 2 * 2)
    height = max(2, round(size[1] * width / size[0] / 2) * 2)
    return (width, height), np.array([width / size[0], height / size[1]])


def _images(
    first: Image | None, source: Iterator[Image], number: int, size: tuple[int, int]
) -> Iterator[Image]:
    """Yields an image for each frame, of the size of the pictures; black where
    missing."""
    image = first
    for _ in range(number):
        if image is None:
            yield np.zeros((size[1], size[0], 3), np.uint8)
        elif image.shape[:2] != (size[1], size[0]):
            yield cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        else:
            yield image
        image = next(source, None)


def pictures(
    images: Iterable[Image],
    result: Result,
    body: BodyModel,
    tracks: Tracks | None,
    zoom: np.ndarray,
    insets: Insets,
    keypoints: Keypoints | None = None,
) -> Iterator[Image]:
    """Yields the pictures of the overlay; `images` have the size that `insets` were
    made for, one for each frame."""
    coarse = coarse_body(body)
    faces = np.asarray(coarse.faces)
    num_frames = len(result.timestamps)
    lines = trails(tracks, num_frames, zoom)
    ground = Ground(result, zoom)
    styles = person_styles(result)
    legend = Legend(result, styles)
    named = len(styles) > 1 or any(style.words for style in styles)
    marks = None
    if keypoints is not None:
        marks = _KeypointMarks(result, body, keypoints, zoom)
    posed = meshes(result, coarse, slice(0, num_frames))
    for frame, (image, people) in enumerate(zip(images, posed, strict=True)):
        picture = ground.draw(softened(image), frame)
        picture = draw_people(picture, people, faces, zoom, styles)
        draw_trails(picture, lines[frame])
        if named:
            heads = [(styles[mesh.person].name, _above(mesh, zoom)) for mesh in people]
            write_names(picture, [(name, at) for name, at in heads if at is not None])
        if marks is not None:
            marks.draw(picture, frame)
        picture = insets.draw(picture, frame)
        low = len(picture)
        text = f"frame {frame + 1}/{num_frames}  {result.timestamps[frame]:.2f} s"
        write_text(picture, text, (10, low - 12))
        legend.draw(picture, (10, low - 34))
        yield picture


def _above(mesh: Mesh, zoom: np.ndarray) -> tuple[float, float] | None:
    """Returns the position of a person's name in the picture, px; `None` for a person
    who reaches behind the camera."""
    if mesh.p_C[:, 2].min() < 0.1:
        return None
    u, v = mesh.uv[mesh.uv[:, 1].argmin()] * zoom
    return float(u), float(v) - 8.0


def softened(image: Image) -> Image:
    """Returns the image with less noise and contrast: what is drawn is clearly visible,
    and the video has half the bytes, as OpenCV's encoder keeps all noise and has no
    setting for it."""
    blurred = cv2.GaussianBlur(image, (0, 0), 0.9)
    return cv2.convertScaleAbs(blurred, alpha=0.88, beta=14)


class _KeypointMarks:
    """A dot for each detected keypoint, a ring where the body has it, a line between
    them."""

    def __init__(
        self, result: Result, body: BodyModel, detected: Keypoints, zoom: np.ndarray
    ):
        """`detected` are of the result's people, in its order."""
        self.result, self.detected = result, detected
        cast = lambda x: jnp.asarray(x, body.dtype)
        places = []
        for h in range(len(result.poses)):
            state = (result.poses[h], result.betas[h], result.trans[h])
            p_W = np.asarray(keypoints_of(body, *map(cast, state)), np.float64)
            R, eye = result.T_WC[:, :3, :3], result.T_WC[:, None, :3, 3]
            p_C = np.einsum("tji,tkj->tki", R, p_W - eye)
            uv = np.asarray(project(cast(result.intrinsics), cast(p_C)))
            places.append(np.where(p_C[..., 2:] > 0.05, uv, np.nan))
        to_picture = lambda uv: (uv + 0.5) * zoom - 0.5
        self.of_body = to_picture(np.array(places).reshape(len(places), -1, 25, 2))
        self.of_detector = to_picture(detected.uv)

    def draw(self, image: Image, frame: int) -> None:
        for h in np.flatnonzero(self.result.present[:, frame]):
            color = PEOPLE[h % len(PEOPLE)]
            known = self.detected.confidence[h, frame] > 0
            known &= np.isfinite(self.of_body[h, frame]).all(axis=-1)
            for k in np.flatnonzero(known):
                pair = np.stack(
                    [self.of_detector[h, frame, k], self.of_body[h, frame, k]]
                )
                dot, ring = (
                    np.round(np.clip(pair, -4000, 4000) * SUBPIXELS)
                    .astype(int)
                    .tolist()
                )
                cv2.line(image, dot, ring, (255, 255, 255), 1, cv2.LINE_AA, 4)
                cv2.circle(image, ring, 4 * SUBPIXELS, color, 1, cv2.LINE_AA, 4)
                cv2.circle(
                    image, dot, 2 * SUBPIXELS, (255, 255, 255), -1, cv2.LINE_AA, 4
                )
