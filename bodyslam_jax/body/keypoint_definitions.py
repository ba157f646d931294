"""Offsets of each detector's keypoints from the joints of the default body.

Every detector has its own definition of a hip or a knee, which follows from the
annotation of its training images. A definition is an offset of each keypoint of
BODY_25, in the axes of the joint that the keypoint moves with (at rest x left, y up, z
forward), as a share of the stature. It is common to all frames of all people; the
remaining offset of a person is estimated (`people.skeleton`, `people.definitions`).

`benchmarks/keypoints.md` describes the calibration and its data. The offsets hold for
the default body only; with another body model all of them are 0.
"""

import numpy as np
from jaxtyping import Float

from bodyslam_jax.body.skeleton import KEYPOINT_NAMES
from bodyslam_jax.config.errors import InputError

_Offsets = dict[str, tuple[float, float, float]]
"""Offsets by name of the keypoint without its side: outwards (from the median plane; to
the left for a point on it), up, forward, in % of the stature."""

_KNEE = (0.0, -1.3, -0.3)
"""Detectors locate knees 1.0 to 1.2 % of the stature below those of the default body,
which are 1.5 % higher than people's: 0.300 of the stature over the sole, but 0.285 by
Drillis and Contini (1966). So this is an offset of the body, not of a detector."""
_COCO: _Offsets = {
    "eye": (-0.2, 0.4, -0.9),
    "ear": (-0.8, -0.1, -0.2),
    "nose": (0.0, 0.2, -1.0),
    "neck": (0.0, -3.8, -0.4),
    "mid_hip": (0.0, 0.5, 0.3),
    "shoulder": (-1.3, -0.3, -0.5),
    "elbow": (-0.5, 0.4, 0.8),
    "wrist": (0.0, 0.4, 0.0),
    "hip": (-1.0, 1.2, 0.9),
    "knee": _KNEE,
    "ankle": (0.0, 1.3, 0.6),
}
"""Of MoveNet, which was trained on COCO: measured on rendered people
(`benchmarks/keypoints.md`), as are the next two."""
_BLAZEPOSE_FEET: _Offsets = {
    "big_toe": (2.9, 0.0, -3.7),
    "heel": (0.0, 0.3, 2.0),
}
"""Of toes and heels of BlazePose."""
_MEDIAPIPE: _Offsets = {
    "eye": (0.0, 0.3, -1.5),
    "ear": (-0.8, 0.2, 0.8),
    "nose": (0.0, 0.5, -1.2),
    "neck": (0.0, -3.9, -0.1),
    "mid_hip": (0.0, -1.5, 0.5),
    "shoulder": (-0.8, -0.3, -0.1),
    "elbow": (0.9, 1.0, 0.5),
    "wrist": (1.4, -0.2, 0.2),
    "hip": (-1.2, -0.7, 1.1),
    "knee": _KNEE,
    "ankle": (-0.4, 1.2, 1.1),
    **_BLAZEPOSE_FEET,
}
"""Of MediaPipe's BlazePose."""
_OPENPOSE: _Offsets = {
    "neck": (0.0, -3.8, 0.0),
    "mid_hip": (0.0, -0.8, 0.5),
    "shoulder": (-1.2, 0.3, -0.3),
    "hip": (-0.9, 0.0, 0.9),
    "knee": _KNEE,
}
"""Not measured, but the mean of COCO's offsets here and of those in `DETECTOR_BIAS`."""

_OFFSETS: dict[str, _Offsets] = {
    "unknown": {},
    "movenet-blazepose": {**_COCO, **_BLAZEPOSE_FEET},
    "coco": _COCO,
    "mediapipe": _MEDIAPIPE,
    "openpose": _OPENPOSE,
    "halpe": _COCO,
}
KEYPOINT_DEFINITIONS: tuple[str, ...] = tuple(_OFFSETS)
"""Names of the definitions. `unknown` has keypoints at the joints, as those projected
from bodies."""


def definition_offsets(definition: str) -> Float[np.ndarray, "25 3"]:
    """Returns the offset of each keypoint of BODY_25 from its joint or vertex, in the
    axes of the joint that it moves with, as a share of the stature.

    **Raises:** `InputError` for a name that is not in `KEYPOINT_DEFINITIONS`.
    """
    if definition not in _OFFSETS:
        names = ", ".join(KEYPOINT_DEFINITIONS)
        raise InputError(
            f"keypoint definition {definition!r}, expected one of {names}."
        )
    out = np.zeros((25, 3))
    for k, name in enumerate(KEYPOINT_NAMES["body25"]):
        side, _, part = name.partition("_")
        sided = side in ("left", "right")
        offset = _OFFSETS[definition].get(part if sided else name, (0.0, 0.0, 0.0))
        out[k] = np.multiply(offset, [-1.0 if side == "right" else 1.0, 1.0, 1.0])
    return out / 100
