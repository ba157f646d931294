"""Measurements by the user: facts about a video, each with a standard deviation.

Every field is an option of the command line (`--height 1.78`, `--focal 1250±20`) and a
line of `config.yaml`. A value may carry its own standard deviation after `±` (or `+-`);
without one the default given in the field's docstring is used.
"""

import dataclasses
import math
import re
from typing import Literal, NamedTuple

from bodyslam_jax.config.errors import NOT_NEGATIVE, InputError, check

HEIGHT_SIGMA = 0.02
"""Standard deviation of a stature, m. Self-reported statures are 1 cm too tall on
average and scatter by 2 cm (Gorber et al., Obesity Reviews 2007)."""
FOCAL_SIGMA = 0.02
"""Relative standard deviation of a focal length: that of a data sheet, before
stabilisation crops the image."""
GRAVITY_SIGMA = math.radians(1.0)
"""Standard deviation of gravity, rad: that of a phone's accelerometer held still."""
PATH_SIGMA = 0.01
"""Standard deviation of a camera path: relative for its scale if it is metric, over the
median distance of the scene for positions, in rad for rotations."""

RANGES = {
    "gravity": (-math.inf, math.inf),
    "start": NOT_NEGATIVE,
    "end": NOT_NEGATIVE,
    "person": NOT_NEGATIVE,
}
"""Ranges of numbers other than positive ones."""
_SIGMA = re.compile(r"±|\+-|\+/-")
_MIN_FOV_DEG, _MAX_FOV_DEG = 1.0, 179.0
"""Range of fields of view, degrees."""


KeypointDefinition = Literal[
    "unknown", "movenet-blazepose", "coco", "mediapipe", "openpose", "halpe"
]


class Measured(NamedTuple):
    """A number and its standard deviation, in the same unit."""

    value: float
    """Measured value."""
    sigma: float
    """Standard deviation."""


@dataclasses.dataclass(frozen=True)
class Known:
    """Facts about a video and the people in it that a user may know."""

    height: tuple[str, ...] = ()
    """Stature, m, of the only person or of each by number: `1.78`, `1.78±0.01`, `0=1.78
    1=1.65`. Default standard deviation: 2 cm. The body is resized where no shape of the
    body model is as tall (children)."""
    focal: str | None = None
    """Focal length, px of the video: `1250`, `1250±20`. Default standard deviation: 2
    %. Without it or `--fov`, it is estimated from an initial guess."""
    fov: str | None = None
    """Horizontal field of view, degrees, in place of the focal length: `65`, `65±2`."""
    camera_path: str | None = None
    """Given camera poses: TUM trajectory, COLMAP `images.txt` or `images.bin`,
    nerfstudio `transforms.json`, Stray Scanner or Record3D (these in metres). Structure
    from motion then only makes the map. If its clock is not the video's, the offset is
    found from the images."""
    camera_path_metric: bool = False
    """Whether that path is in metres, as a visual-inertial tracker's is."""
    static_camera: bool = False
    """Whether the camera does not move (tripod); no camera motion is estimated."""
    gravity: tuple[float, ...] = ()
    """Direction of gravity in the axes of the first frame's camera (x right, y down, z
    forward): `0 1 0` for a level camera. Standard deviation: 1 degree."""
    fps: float | None = None
    """Frames per second, in place of the value in the file."""
    start: float | None = None
    """Start of the part of the video that is used, s."""
    end: float | None = None
    """End of the part of the video that is used, s."""
    keypoint_definition: KeypointDefinition | None = None
    """Detector of the given keypoints, which determines their position on the body,
    such as that of hips and knees. Without it, inferred from the file. `unknown`: at
    the body's joints."""
    person: tuple[int, ...] = ()
    """Numbers of the people that are estimated; all without it. The others are still
    masked in the map."""

    def check_known(self) -> None:
        """Rejects impossible values and combinations.

        **Raises:** `InputError` that names the option, what was found and what was
        expected.
        """
        check(self, RANGES)
        self.heights()
        if self.focal is not None and self.fov is not None:
            raise InputError("focal and fov: both given, expected one of them.")
        self.focal_length(1000)
        if self.start is not None and self.end is not None and self.end <= self.start:
            raise InputError(
                f"end: found {self.end:g} s, expected more than start, "
                f"{self.start:g} s."
            )
        if self.gravity and (len(self.gravity) != 3 or not any(self.gravity)):
            raise InputError(
                f"gravity: found {self.gravity}, expected a direction of 3 numbers."
            )
        if self.camera_path_metric and self.camera_path is None:
            raise InputError("camera_path_metric: expected a camera_path beside it.")
        if self.static_camera and self.camera_path is not None:
            raise InputError("static_camera and camera_path: expected one of them.")

    def heights(self) -> dict[int | None, Measured]:
        """Returns statures, m, by the person's number.

        A stature given without a number applies to all other people; its key is `None`.

        **Raises:** `InputError` if an entry cannot be parsed, is not between 0.4 and
        2.8 m, or repeats a person.
        """
        found: dict[int | None, Measured] = {}
        for text in self.height:
            who, _, number = text.rpartition("=")
            person = None
            if who:
                if not who.strip().isdigit():
                    raise InputError(
                        f"height: found {text!r}, expected PERSON=METRES as in 0=1.78."
                    )
                person = int(who)
            height = _measured("height", number, HEIGHT_SIGMA, "METRES or METRES±SIGMA")
            # Newborns have 0.5 m; the tallest person on record had 2.72 m.
            if not 0.4 <= height.value <= 2.8:
                raise InputError(
                    f"height: found {height.value:g}, expected 0.4 to 2.8 m."
                )
            if person in found:
                raise InputError(f"height: {text!r}, but that person's was given.")
            found[person] = height
        return found

    def focal_length(self, width: int) -> Measured | None:
        """Returns the focal length, px, of images `width` px wide; `None` if not given.

        **Raises:** `InputError` for an invalid focal length or field of view.
        """
        if self.focal is not None:
            found = _measured("focal", self.focal, None, "PIXELS or PIXELS±SIGMA")
            if not 0 < found.value < math.inf:
                raise InputError(f"focal: found {found.value:g}, expected more than 0.")
            return _or_usual(found)
        if self.fov is None:
            return None
        angle = _measured("fov", self.fov, None, "DEGREES or DEGREES±SIGMA")
        if not _MIN_FOV_DEG <= angle.value <= _MAX_FOV_DEG:
            raise InputError(
                f"fov: found {angle.value:g}, expected {_MIN_FOV_DEG:g} to "
                f"{_MAX_FOV_DEG:g} degrees."
            )
        half = math.radians(angle.value) / 2
        focal = width / 2 / math.tan(half)
        # d log f = -dθ / sin θ of the whole angle θ.
        sigma = focal * math.radians(angle.sigma) / math.sin(2 * half)
        return _or_usual(Measured(focal, sigma))


def _or_usual(found: Measured) -> Measured:
    """Replaces a NaN sigma by the usual share of the value."""
    sigma = FOCAL_SIGMA * found.value if math.isnan(found.sigma) else found.sigma
    return Measured(found.value, sigma)


def _measured(name: str, text: str, sigma: float | None, expected: str) -> Measured:
    """Parses `VALUE` or `VALUE±SIGMA`; sigma is NaN if it is neither given nor has a
    default.

    **Raises:** `InputError` if a number is invalid.
    """
    parts = _SIGMA.split(str(text))
    try:
        numbers = [float(part) for part in parts]
    except ValueError:
        numbers = []
    if len(numbers) not in (1, 2) or not all(map(math.isfinite, numbers)):
        raise InputError(f"{name}: found {text!r}, expected {expected}.")
    if len(numbers) == 1:
        return Measured(numbers[0], math.nan if sigma is None else sigma)
    if numbers[1] <= 0:
        raise InputError(f"{name}: {text!r} has no positive standard deviation.")
    return Measured(*numbers)
