"""Estimates made by hand: a camera that stands still, and people before it."""

import numpy as np

from bodyslam_jax.types import JointEstimate, ScaleStart, Sequence, SfmResult, Tracks

DISTANCE = 4.0
"""m"""


def still_camera(sequence: Sequence) -> SfmResult:
    """A camera that stands still and sees nothing."""
    t = sequence.num_frames
    nothing = np.zeros(0, np.int64)
    return SfmResult(
        kind="static",
        T_WC=np.tile(np.eye(4), (t, 1, 1)),
        registered=np.ones(t, bool),
        landmarks=np.zeros((0, 3)),
        tracks=Tracks(nothing, nothing, np.zeros((0, 2))),
        keep=nothing.astype(bool),
        prior_information=np.zeros((0, 3, 3)),
        prior_mean=np.zeros((0, 3)),
        pixel_sigma=1.0,
        intrinsics=np.asarray(sequence.intrinsics.params, float),
        focal_sigma=float("nan"),
        costs=(0.0, 0.0),
        warnings=(),
    )


def standing_people(sequence: Sequence) -> JointEstimate:
    """People who stand before that camera."""
    assert sequence.bodies is not None
    h, t = sequence.bodies.present.shape
    roots = np.tile(np.diag([1.0, -1.0, -1.0, 1.0]), (h, t, 1, 1))
    roots[..., 2, 3] = DISTANCE
    return JointEstimate(
        scale=1.0,
        start=ScaleStart(),
        scale_sigma=1.0,
        shape_covariance=np.zeros((h, 10, 10)),
        unobserved=(),
        cameras=np.tile(np.eye(4), (t, 1, 1)),
        roots=roots,
        poses=np.zeros((h, t, 23, 3)),
        shapes=np.zeros((h, 10)),
        landmarks=np.zeros((0, 3)),
        intrinsics=np.asarray(sequence.intrinsics.params, float),
        present=np.ones((h, t), bool),
        status="converged",
        stages=(),
    )
