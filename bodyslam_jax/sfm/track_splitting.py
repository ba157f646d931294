"""Long tracks are split into several landmarks that share their information.

The cost of a solver step grows with the square of the frames that a landmark spans. So
a long track becomes several landmarks, each with a prior from the information of the
other pieces on the same point.
"""

import numpy as np
from jaxtyping import Float, Int

from bodyslam_jax.geometry.arrays import sum_by
from bodyslam_jax.sfm.bundle import Scene, Views, jacobian_of_points


def split_tracks(
    frame: Int[np.ndarray, " m"], track: Int[np.ndarray, " m"], longest: int
) -> tuple[Int[np.ndarray, " p"], Int[np.ndarray, " m"]]:
    """Cuts tracks that span more than `longest` frames into equal pieces.

    Returns the track of each piece, and the piece of each observation.
    """
    if not len(frame):
        return np.zeros(0, int), np.zeros(0, int)
    first = np.full(int(track.max()) + 1, frame.max() + 1)
    last = np.full(len(first), -1)
    np.minimum.at(first, track, frame)
    np.maximum.at(last, track, frame)
    span = last - first + 1
    count = -(-span // longest)
    part = (frame - first[track]) * count[track] // span[track]
    most = max(int(count.max()), 1)
    key, piece = np.unique(track * most + part, return_inverse=True)
    return key // most, piece.ravel()


def information_from_other_tracks(
    scene: Scene, views: Views, shown: Int[np.ndarray, " l"]
) -> Float[np.ndarray, "l 3 3"]:
    """Returns the information matrix that the other tracks of the same point (or the
    other pieces of a long track) provide for each track's landmark.

    The graph has one landmark per track. Each gets the mean of the others' information,
    so that the sum over the tracks of a point equals the information of all its
    observations. Cameras are held fixed; errors are in units of depth 1.

    Args:
        views: inlier observations of tracks.
        shown: the landmark that each track observes.
    """
    merged = Views(views.frame, shown[views.landmark], views.xy)
    J = jacobian_of_points(scene, merged)
    own = sum_by(views.landmark, np.einsum("mki,mkj->mij", J, J), len(shown))
    _, point = np.unique(shown, return_inverse=True)
    tracks = np.unique(views.landmark)
    count = np.bincount(point[tracks], minlength=len(shown))[point]
    total = sum_by(point, own, len(shown))[point]
    return (total - own) / np.maximum(count - 1, 1)[:, None, None]


def information_from_other_pieces(
    T_WC: Float[np.ndarray, "t 4 4"],
    landmarks: Float[np.ndarray, "l 3"],
    frame: Int[np.ndarray, " m"],
    piece: Int[np.ndarray, " m"],
    of: Int[np.ndarray, " p"],
) -> Float[np.ndarray, "p 3 3"]:
    """Returns `information_from_other_tracks` for pieces of tracks of `landmarks`.

    Args:
        of: landmark of each piece.
    """
    C_WC = T_WC[:, :3, :3]
    scene = Scene(np.swapaxes(C_WC, 1, 2), T_WC[:, :3, 3], landmarks)
    return information_from_other_tracks(
        scene, Views(frame, piece, np.zeros((len(frame), 2))), of
    )
