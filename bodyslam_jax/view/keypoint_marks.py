"""Detected keypoints on the image, and those of the estimated bodies beside them."""

import cv2
import jax.numpy as jnp
import numpy as np

from bodyslam_jax.body import BodyModel, keypoints
from bodyslam_jax.geometry.camera import project
from bodyslam_jax.types import Keypoints, Result
from bodyslam_jax.view.style import PEOPLE, Image

_WHITE = (255, 255, 255)


class KeypointMarks:
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
            p_W = np.asarray(keypoints(body, *map(cast, state)), np.float64)
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
                    np.round(np.clip(pair, -4000, 4000) * 16).astype(int).tolist()
                )
                cv2.line(image, dot, ring, _WHITE, 1, cv2.LINE_AA, 4)
                cv2.circle(image, ring, 4 * 16, color, 1, cv2.LINE_AA, 4)
                cv2.circle(image, dot, 2 * 16, _WHITE, -1, cv2.LINE_AA, 4)
