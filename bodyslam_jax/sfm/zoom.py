"""Detects the zoom of a camera that only rotates; removes it from tracks and images.

Rotation and zoom map directions by a rotation and a scale about the principal point.
Forward motion scales near points more than far ones: over an interval in which the
scale changes by some per cent the two models differ by pixels, unless all points are
equally far away.
"""

from collections.abc import Iterable, Iterator

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.geometry.triangulation import unit_rays
from bodyslam_jax.sfm.bundle import Views, rows_by
from bodyslam_jax.types import Tracks

MIN_LOG_ZOOM = 0.04
"""Least logarithm of the ratio of focal lengths for which a zoom is reported."""
_LINK_FRAMES = 5
"""Number of frames between two links of the chain."""
_MIN_SHARED_POINTS = 20
_MAX_PAIRS = 12
"""Largest number of pairs of frames that test the zoom."""
_MIN_RESIDUAL_RATIO = 3.0
"""Least ratio of the residuals of a rotation without and with a scale."""


def turning_zoom(
    views: Views, num_frames: int, limit: float
) -> Float[np.ndarray, " t"] | None:
    """Returns the logarithm of the focal length of a camera that turns and zooms,
    relative to the first frame; `None` if it does not zoom, or moves otherwise.

    Args:
        limit: largest median error, at depth 1, of a correct model.
    """
    of_frame = rows_by(views.frame, num_frames)

    def pair(a: int, b: int, before: float) -> tuple[float, float, float] | None:
        """Returns `_turn_and_scale` of frames a and b, both
        scaled by `exp(-before)`."""
        ids = views.landmark[of_frame[a]], views.landmark[of_frame[b]]
        _, i, j = np.intersect1d(*ids, return_indices=True)
        if len(i) < _MIN_SHARED_POINTS:
            return None
        size = np.exp(-before)
        xy = size * views.xy[of_frame[a][i]], size * views.xy[of_frame[b][j]]
        return _turn_and_scale(*xy, limit)

    at = np.unique(np.r_[np.arange(0, num_frames, _LINK_FRAMES), num_frames - 1])
    log_scale = np.zeros(len(at))
    for i, (a, b) in enumerate(zip(at[:-1], at[1:], strict=True)):
        found = pair(int(a), int(b), float(log_scale[i]))
        log_scale[i + 1] = log_scale[i] + (found[0] if found else 0.0)
    if np.ptp(log_scale) < MIN_LOG_ZOOM:
        return None
    # Pairs with the largest change of scale that still share tracks.
    change = np.abs(log_scale[:, None] - log_scale)
    i, j = np.nonzero(np.triu(change >= MIN_LOG_ZOOM))
    judged = []
    for k in np.argsort(-change[i, j], kind="stable"):
        found = pair(int(at[i[k]]), int(at[j[k]]), float(log_scale[i[k]]))
        if found is not None:
            judged.append(found[1:])
        if len(judged) == _MAX_PAIRS:
            break
    if not judged:
        return None
    with_scale, without = np.median(judged, axis=0)
    if with_scale > limit or without < _MIN_RESIDUAL_RATIO * with_scale:
        return None
    return np.interp(np.arange(num_frames), at, log_scale)


def _turn_and_scale(
    xy_a: np.ndarray, xy_b: np.ndarray, scale: float
) -> tuple[float, float, float]:
    """Returns the logarithm of the scale, and the median errors of a rotation with a
    scale and of a rotation alone."""
    away = []
    for free in (False, True):
        turn, log_s, r = np.eye(3), 0.0, xy_a - xy_b
        for _ in range(10):
            p = unit_rays(xy_a) @ turn.T
            q = p[:, :2] / p[:, 2:]
            size = np.exp(log_s)
            r = size * q - xy_b
            weight = 1 / (1 + (r**2).sum(axis=-1) / scale**2)
            J = np.zeros((len(q), 2, 4))
            x, y = q.T
            J[:, 0, :3] = np.stack([-x * y, 1 + x * x, -y], axis=-1)
            J[:, 1, :3] = np.stack([-1 - y * y, x * y, x], axis=-1)
            J[..., :3] *= size
            J[..., 3] = size * q * free
            H = np.einsum("m,mki,mkj->ij", weight, J, J) + 1e-12 * np.eye(4)
            step = -np.linalg.solve(H, np.einsum("m,mki,mk->i", weight, J, r))
            turn = so3.exp(step[:3]) @ turn
            log_s += float(np.clip(step[3], -0.2, 0.2)) if free else 0.0
        away.append(float(np.median(np.linalg.norm(r, axis=-1))))
    return log_s, away[1], away[0]


def tracks_without_zoom(
    tracks: Tracks, zoom: Float[np.ndarray, " t"], centre: Float[np.ndarray, "2"]
) -> Tracks:
    """Returns the tracks scaled about the centre (px) to one focal length."""
    size = np.exp(-zoom)[tracks.frame][:, None]
    uv = centre + (tracks.uv - centre) * size
    return Tracks(tracks.frame, tracks.landmark, uv, tracks.warnings)


def without_zoom(
    images: Iterable[UInt8[np.ndarray, "y x *c"]],
    zoom: Float[np.ndarray, " t"],
    centre: Float[np.ndarray, "2"],
) -> Iterator[UInt8[np.ndarray, "y x *c"]]:
    """Yields the images scaled about the centre (px) to one focal length; black where
    they have no pixels."""
    for image, log_size in zip(images, zoom, strict=False):
        size = float(np.exp(-log_size))
        shift = (1 - size) * np.asarray(centre, float)
        warp = np.array([[size, 0, shift[0]], [0, size, shift[1]]])
        yield cv2.warpAffine(
            image, warp, (image.shape[1], image.shape[0]), flags=cv2.INTER_LINEAR
        )
