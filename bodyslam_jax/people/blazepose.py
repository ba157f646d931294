"""Runs BlazePose GHUM: heels, toes, a mask and rough 3-D landmarks of one person.

The network reads a square around the person, rotated so that the hips are below the
shoulders (Bazarevsky et al., 2020; Grishchenko et al., 2022). The square follows from
MoveNet's keypoints, which also verify that both networks show the same person.
"""

import dataclasses
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

INPUT_SIDE_PX = 256
"""Side of the square that the network reads."""
NUM_LANDMARKS = 33
"""Number of landmarks that the network has (MODEL_CARD.md)."""
COCO_OF_LANDMARKS = np.array(
    [0, 2, 5, 7, 8, 11, 12, 13, 14, 15, 16, 23, 24, 25, 26, 27, 28]
)
"""BlazePose's landmark for each of COCO's 17 keypoints."""
HEELS_AND_TOES = np.array([29, 31, 30, 32])
"""Left heel and big toe, right heel and big toe."""
_SQUARE_FACTOR = 1.25
"""Side of the square relative to the diameter of the circle around the person."""
_BODY_REACH_FACTOR = 1.1
"""Distance of head and soles relative to that of the farthest keypoint."""
_TRUNK_REACH_FACTOR = 1.9
"""Radius of a standing adult's circle about the hips, relative to the trunk's
length."""


@dataclasses.dataclass(frozen=True)
class Square:
    """A rotated square of the image."""

    centre: Float[np.ndarray, " 2"]
    """Centre in the image, px."""
    side: float
    """Side, px."""
    up: Float[np.ndarray, " 2"]
    """Unit vector in the image that points up in the square."""

    def from_image(self) -> Float[np.ndarray, "2 3"]:
        """Returns the affine map from pixels of the image to those of the network's
        input."""
        scale = INPUT_SIDE_PX / self.side
        x, y = self.up
        # Rows are the square's right and down, in the image.
        turn = np.array([[-y, x], [-x, -y]]) * scale
        middle = (INPUT_SIDE_PX - 1) / 2
        return np.column_stack([turn, middle - turn @ self.centre])


@dataclasses.dataclass(frozen=True)
class Pose:
    """The network's output for the person in a square."""

    landmarks: Float[np.ndarray, "33 3"]
    """Landmarks: u px, v px in the image, visibility in 0..1."""
    presence: float
    """Probability that the square contains a person, 0..1."""
    mask: UInt8[np.ndarray, "256 256"]
    """Mask in the square; 255 is person."""
    square: Square


def turned_square(points: Float[np.ndarray, "17 3"], least: float) -> Square | None:
    """Returns BlazePose's input square for a person with these COCO keypoints (u, v,
    score), or `None` if neither hips nor shoulders are visible.

    Args:
        least: score from which keypoints are used.
    """
    visible = points[:, 2] > least
    # Rows of COCO's layout.
    shoulders, hips = slice(5, 7), slice(11, 13)
    if not (visible[hips].all() and visible[shoulders].all()):
        return None
    centre = points[hips, :2].mean(0)
    trunk = points[shoulders, :2].mean(0) - centre
    length = float(np.linalg.norm(trunk))
    reach = np.linalg.norm(points[visible, :2] - centre, axis=1).max()
    radius = max(_BODY_REACH_FACTOR * float(reach), _TRUNK_REACH_FACTOR * length)
    if radius < 1.0:
        return None
    up = trunk / length if length > 0.05 * radius else np.array([0.0, -1.0])
    return Square(centre, 2 * _SQUARE_FACTOR * radius, up)


def read_pose(session: Any, image: UInt8[np.ndarray, "y x 3"], square: Square) -> Pose:
    """Runs BlazePose on one square of a BGR image."""
    crop = _cut(image, square)
    tensor = crop[None, ..., ::-1].astype(np.float32) / 255
    outputs = session.run(None, {session.get_inputs()[0].name: tensor})
    by_size = {np.size(out): np.asarray(out) for out in outputs}
    return decode(
        by_size[195].reshape(39, 5)[:NUM_LANDMARKS],
        float(by_size[1].reshape(())),
        by_size[INPUT_SIDE_PX**2].reshape(INPUT_SIDE_PX, INPUT_SIDE_PX),
        square,
    )


def decode(
    raw: Float[np.ndarray, "33 5"],
    presence: float,
    mask: Float[np.ndarray, "256 256"],
    square: Square,
) -> Pose:
    """Converts the network's raw outputs to the image's axes.

    Args:
        raw: x, y (px of the square, from its upper left edge), z, logits of visibility
            and presence.
        mask: logits.
    """
    from_image = square.from_image()
    xy = raw[:, :2].astype(float) - 0.5  # from edges to pixel centres
    turn, shift = from_image[:, :2], from_image[:, 2]
    uv = (xy - shift) @ np.linalg.inv(turn).T
    visible = _sigmoid(np.minimum(raw[:, 3], raw[:, 4]).astype(float))
    return Pose(
        np.column_stack([uv, visible]),
        presence,
        np.where(mask > 0, 255, 0).astype(np.uint8),
        square,
    )


def mask_in_image(
    pose: Pose, size: tuple[int, int], step: int
) -> UInt8[np.ndarray, "y x"]:
    """Returns the person's mask in an image of `size` (rows, columns) sampled at every
    `step`-th pixel; 255 is person."""
    # Pixel i of the thinned image is the middle of pixels i * step to (i + 1) * step.
    matrix = pose.square.from_image()
    matrix[:, 2] += matrix[:, :2] @ np.full(2, (step - 1) / 2)
    matrix[:, :2] *= step
    return cv2.warpAffine(
        pose.mask,
        matrix,
        (-(-size[1] // step), -(-size[0] // step)),
        flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP,
    )


def disagreement(pose: Pose, points: Float[np.ndarray, "17 3"]) -> np.ndarray:
    """Returns the distance of BlazePose's landmarks from COCO keypoints of the person
    (17,), in radii of the circle around them."""
    away = pose.landmarks[COCO_OF_LANDMARKS, :2] - points[:, :2]
    return np.linalg.norm(away, axis=1) / (pose.square.side / (2 * _SQUARE_FACTOR))


def _cut(image: np.ndarray, square: Square) -> UInt8[np.ndarray, "256 256 3"]:
    """Returns the square's content, without aliasing: a large one is halved first."""
    halvings = max(0, int(np.floor(np.log2(square.side / INPUT_SIDE_PX))))
    matrix = square.from_image()
    if halvings:
        radius = square.side / np.sqrt(2) + 2**halvings
        low = np.floor(square.centre - radius).astype(int)
        high = np.ceil(square.centre + radius).astype(int)
        x0, y0 = np.maximum(low, 0)
        x1, y1 = np.minimum(high, [image.shape[1], image.shape[0]])
        if x1 - x0 < 2**halvings or y1 - y0 < 2**halvings:
            return np.zeros((INPUT_SIDE_PX, INPUT_SIDE_PX, 3), np.uint8)
        image = image[y0:y1, x0:x1]
        step = 2.0**halvings
        size = int(image.shape[1] / step), int(image.shape[0] / step)
        sx, sy = image.shape[1] / size[0], image.shape[0] / size[1]
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        # Pixel i of the smaller image is at (i + 1/2) s - 1/2 + x0 of the whole one.
        back = np.array([[sx, 0, sx / 2 - 0.5 + x0], [0, sy, sy / 2 - 0.5 + y0]])
        matrix = matrix[:, :2] @ back + np.array([[0, 0, 1]]) * matrix[:, 2:]
    return cv2.warpAffine(
        image, matrix, (INPUT_SIDE_PX, INPUT_SIDE_PX), flags=cv2.INTER_LINEAR
    )


def _sigmoid(x: np.ndarray) -> np.ndarray:
    # The exponential of 50 is within single precision (up to 88).
    return 1 / (1 + np.exp(-np.clip(x, -50, 50)))
