"""Models the exposure of each pixel: camera and people around the time of a frame.

Between frames all motion is quadratic in time, through three frames. A frame's time is
the middle of the exposure of its middle row, so that neither a long exposure nor a
rolling shutter shifts the image in time on average.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from bodyslam_jax.geometry import so3_numpy as so3


@dataclasses.dataclass(frozen=True)
class Shutter:
    """Exposure of each row, and delay between the first and the last row.

    Zeros are an ideal camera with a global shutter.
    """

    exposure: float = 0.0
    """Exposure time of a row, s."""
    readout: float = 0.0
    """Delay between the first and the last row, s."""

    def row_times(self, rows: int) -> Float[np.ndarray, " rows"]:
        """Returns the middle of each row's exposure relative to the frame's time, s."""
        return self.readout * ((np.arange(rows) + 0.5) / rows - 0.5)

    def instants(self, count: int) -> Float[np.ndarray, " {count}"]:
        """Returns evenly spaced times within the exposure, s, whose images are
        averaged."""
        return self.exposure * ((np.arange(count) + 0.5) / count - 0.5)


def around(
    values: Float[np.ndarray, "t n d"], k: int
) -> tuple[
    Float[np.ndarray, "n d"], Float[np.ndarray, "n d"], Float[np.ndarray, "n d"]
]:
    """Returns value, first and second difference (per frame) of a series at frame `k`.

    At the ends the motion is extrapolated with constant velocity.
    """
    value = values[k]
    last, first = len(values) - 1, 0
    before = values[k - 1] if k > first else 2 * value - values[min(k + 1, last)]
    after = values[k + 1] if k < last else 2 * value - before
    return value, (after - before) / 2, after - 2 * value + before


def cameras_at(
    T_WC: Float[np.ndarray, "t 4 4"], k: int, when: Float[np.ndarray, " n"], fps: float
) -> Float[np.ndarray, "n 4 4"]:
    """Returns the camera poses at times `when` (s) relative to frame `k`.

    The rotation is that of frame `k` times the exponential of a quadratic.
    """
    window = T_WC[max(k - 1, 0) : k + 2]
    own = min(k, 1)
    R = window[:, :3, :3]
    turned = so3.log(R[own].T @ R)
    tau = (when * fps)[:, None]
    move = lambda terms: terms[0] + tau * terms[1] + tau**2 / 2 * terms[2]
    out = np.tile(np.eye(4), (len(tau), 1, 1))
    out[:, :3, :3] = R[own] @ so3.exp(move(around(turned[:, None], own)))
    out[:, :3, 3] = move(around(window[:, None, :3, 3], own))
    return out
