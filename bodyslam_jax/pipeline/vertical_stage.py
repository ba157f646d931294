"""Straight segments in images of a clip, in the world of its estimated cameras."""

import numpy as np
from jaxtyping import Float, Int

from bodyslam_jax import sfm
from bodyslam_jax.geometry.vertical_edges import Edges, make_edges
from bodyslam_jax.pipeline.stage_cache import Cache, fingerprint
from bodyslam_jax.types import JointEstimate, Sequence, SfmResult

_IMAGES = 24
"""Number of images that are searched, evenly spread over the clip."""


def find_edges(
    sequence: Sequence,
    cameras: SfmResult,
    joint: JointEstimate | None = None,
    cache: Cache = Cache(None),
) -> Edges | None:
    """Segments that are on no person, in the world of the cameras, of `joint` if it is
    given; `None` without images or cameras. `sequence` is the input, with its zoom.

    **Raises:** `ValueError` if an image cannot be read.
    """
    if sequence.frames is None or cameras.kind == "failed":
        return None
    wanted = _spread(cameras)
    segments = cache.stage(
        "segments",
        fingerprint(sequence, wanted),
        sfm.Segments,
        lambda: sfm.find_segments(sequence, wanted),
    )
    ends = segments.ends
    T_WC, intrinsics = cameras.T_WC, cameras.intrinsics
    if joint is not None:
        T_WC, intrinsics = joint.cameras, joint.intrinsics
    if cameras.zoom is not None:
        centre = intrinsics[2:4]
        size = np.exp(cameras.zoom[segments.frame])[:, None, None]
        ends = centre + (ends - centre) / size
    return make_edges(segments.frame, ends, wanted, T_WC[:, :3, :3], intrinsics)


def _spread(cameras: SfmResult) -> Int[np.ndarray, " n"]:
    """Indices of the images that are searched."""
    frames = np.flatnonzero(cameras.within)
    places: Float[np.ndarray, " n"] = np.linspace(0, len(frames) - 1, _IMAGES)
    return np.unique(frames[places.round().astype(int)])
