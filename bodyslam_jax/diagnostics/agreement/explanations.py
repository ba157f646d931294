"""Hypotheses that explain why given keypoints and given bodies disagree.

Each hypothesis is a transformation that may have been applied to one of them before
they were given: a rotated, mirrored or resized image, another focal length, other units
or other axes. An `Explanation` predicts the keypoints from the bodies under one
hypothesis. All are tested; their effects on size and position in the image differ:

- a resized copy scales size and position about the image's corner;
- another focal length scales both about the principal point;
- another unit of `trans` changes the size, not the position;
- a crop, or another principal point, changes the position, not the size.
"""

import dataclasses
import itertools
from collections.abc import Callable, Iterator

import numpy as np
from jaxtyping import Float

from bodyslam_jax.diagnostics.agreement.image_points import (
    MIRRORED_POINTS,
    People,
    centred,
    distances,
    in_common,
    project,
)

Forecast = Callable[[Float[np.ndarray, "t b 14 3"]], Float[np.ndarray, "t b 14 2"]]

_POSITION_RATIO_TOLERANCE, _SIZE_RATIO_TOLERANCE = 0.04, 0.12
"""Relative tolerances to a common ratio, for ratios measured by positions in the image
and by sizes; regressors have larger errors in sizes."""
_COMMON_RESIZE_RATIOS = (1 / 4, 1 / 3, 3 / 8, 4 / 9, 1 / 2, 2 / 3, 3 / 4, 4 / 5)
"""Ratios between common video formats: 2160, 1440, 1080, 960, 720, 540, 480 lines."""


@dataclasses.dataclass(frozen=True)
class ImageMap:
    """Affine map `q = A p + b` from pixels of the video to pixels of the keypoints'
    image."""

    A: Float[np.ndarray, "2 2"]
    b: Float[np.ndarray, " 2"]
    swap: bool = False
    """Whether the map exchanges left and right."""

    def __call__(
        self, uv: Float[np.ndarray, "*n 14 2"]
    ) -> Float[np.ndarray, "*n 14 2"]:
        moved = uv @ self.A.T + self.b
        return moved[..., MIRRORED_POINTS, :] if self.swap else moved

    def inverse(self, uv: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Applies `A^-1 (q - b)`, from pixels of the keypoints' image to pixels of the
        video.

        Left and right are not exchanged back, even if `swap` is set.
        """
        return (uv - self.b) @ np.linalg.inv(self.A).T


@dataclasses.dataclass(frozen=True)
class Explanation:
    """One hypothesis; fields that do not belong to its `kind` change nothing."""

    kind: str
    """`agree`, `sides`, `keypoints` (`image`), `axes` (`R`), `focal`, `unit`
    (`factor`), `crop` (`image`) or `copy` (`image`: resized and moved)"""
    forecast: Forecast
    image: ImageMap = ImageMap(np.eye(2), np.zeros(2))
    R: Float[np.ndarray, "3 3"] = dataclasses.field(default_factory=lambda: np.eye(3))
    """Rotation of the given bodies into the camera frame."""
    factor: float = 1.0
    """Depending on `kind`: factor of resizing; the bodies' focal length over the
    camera's; or units of `trans` per metre."""
    name: str = ""
    reason: bool = True
    """Whether `factor` is a common one, such as 1/2 or 1000, rather than a measured
    one."""


def disagreement(
    detected: Float[np.ndarray, "t k 14 2"], projected: Float[np.ndarray, "t b 14 2"]
) -> float:
    """Returns the distance between detected keypoints and projected bodies, in sizes of
    a person.

    For each detected person and frame the distance to the nearest projected body is
    taken, and vice versa; the result is the smaller of the two medians over people and
    frames. NaN with fewer than three distances in either direction.
    """
    apart = distances(detected, projected)
    apart = np.where(np.isfinite(apart), apart, np.inf)
    if not apart.size:
        return np.nan
    found = []
    for axis in (1, 2):
        nearest = apart.min(axis)
        nearest = nearest[np.isfinite(nearest)]
        if len(nearest) < 3:
            return np.nan
        found.append(float(np.median(nearest)))
    return min(found)


def explanations(people: People) -> Iterator[Explanation]:
    """Yields all explanations; the first is that keypoints and bodies agree.

    `people` should hold a few frames only, as each explanation is evaluated on all.
    """
    camera = people.camera
    plain = lambda p: project(camera, p)
    yield Explanation("agree", plain)
    yield Explanation("sides", lambda p: plain(p)[..., MIRRORED_POINTS, :])
    projected = plain(people.bodies)
    ratios = _ratios(people.keypoints, projected)
    for name, image in _symmetries(camera.width, camera.height):
        if name:
            yield _of_image(plain, image, name)
        places = _ratios(people.keypoints, image(projected), about_corner=True)
        places = [p for p in places if any(abs(np.log(p / r)) < 0.2 for r in ratios)]
        for scale, reason in _likely(
            places, _COMMON_RESIZE_RATIOS, _POSITION_RATIO_TOLERANCE
        ):
            resized = ImageMap(scale * image.A, scale * image.b, image.swap)
            yield _of_image(plain, resized, name, scale, reason)
    yield from _other_bodies(people, ratios)
    yield from _moved(people.keypoints, projected, ratios, plain)


def _of_image(plain, image, name, factor=1.0, reason=True) -> Explanation:
    forecast = lambda p: image(plain(p))
    return Explanation(
        "keypoints", forecast, image, factor=factor, name=name, reason=reason
    )


def _other_bodies(people: People, ratios: list[float]) -> Iterator[Explanation]:
    camera = people.camera
    fx = camera.params[0]
    turned = lambda R: lambda p: project(camera, p @ R.T)
    scaled = lambda s: lambda p: project(camera, p / np.asarray(s))
    for R in _axes():
        yield Explanation("axes", turned(R), R=R, name=_axes_name(R))
    longer = max(camera.width, camera.height)
    # Default focal lengths of tools of `io.bodies.formats`, and SPIN's.
    usual = np.array(
        [np.hypot(camera.width, camera.height), 5000 / 256 * longer, 5000.0]
    )
    for factor, reason in _likely(
        ratios, usual / fx, _SIZE_RATIO_TOLERANCE, inverse=False
    ):
        # The size of people nearby is not quite proportional to the focal length.
        for by in (1.0,) if reason else (0.85, 0.92, 1.0, 1.08, 1.17):
            value = by * factor
            forecast = scaled([1, 1, value])
            name = "" if by == 1 else "of people nearby"
            yield Explanation("focal", forecast, factor=value, name=name, reason=reason)
    # Bodies that are `factor` times too far look as small: mm, cm, dm, feet.
    for factor, reason in _likely(
        ratios, (10.0, 100.0, 1000.0, 1 / 0.3048), _SIZE_RATIO_TOLERANCE
    ):
        yield Explanation(
            "unit", _of_unit(camera, factor), factor=factor, reason=reason
        )


def _of_unit(camera, factor):
    """Returns the forecast for `trans` in units of `1 / factor` m: the pelvis position
    is divided by `factor`, while the body keeps the size of the body model."""

    def forecast(p):
        pelvis = p[..., 7:8, :]
        return project(camera, p - pelvis + pelvis / factor)

    return forecast


def _moved(detected, projected, ratios, plain) -> Iterator[Explanation]:
    """Yields explanations by a constant shift in the image (the median residual shift),
    at the same size (a crop) or resized by one of `ratios` (a copy)."""
    middles = [
        [centred(uv)[0] for uv in in_common(detected[:, k], projected[:, b])]
        for k, b in _pairs(detected, projected)
    ]
    for scale in (1.0, *ratios):
        shift = np.concatenate([q - scale * p for q, p in middles])
        shift = shift[np.isfinite(shift).all(-1)]
        if len(shift):
            image = ImageMap(scale * np.eye(2), np.median(shift, axis=0))
            kind = "crop" if scale == 1.0 else "copy"
            forecast = lambda p, image=image: image(plain(p))
            yield Explanation(kind, forecast, image, factor=scale)


def _pairs(detected, projected) -> list[tuple[int, int]]:
    """Returns up to 24 pairs (row of keypoints, row of bodies) that may be one person,
    pairs of low and equal row numbers first."""
    rows = itertools.product(range(detected.shape[1]), range(projected.shape[1]))
    return sorted(rows, key=lambda pair: (sum(pair), abs(pair[0] - pair[1])))[:24]


def _ratios(detected, projected, about_corner: bool = False) -> list[float]:
    """Returns the distinct ratios, other than 1, of a person's size in the keypoints to
    that in the projected bodies; with `about_corner`, of the distances from the image's
    corner.

    Each ratio is the median over the frames of one pair of rows.
    """
    found: list[float] = []
    for k, b in _pairs(detected, projected):
        pair = in_common(detected[:, k], projected[:, b])
        (q, big), (p, small) = (centred(uv) for uv in pair)
        if about_corner:
            ratio = (q * p).sum(-1) / np.maximum((p**2).sum(-1), 1.0)
        else:
            ratio = big / np.maximum(small, 1e-3)
        ratio = ratio[np.isfinite(ratio)]
        middle = float(np.median(ratio)) if len(ratio) >= 3 else 0.0
        if (
            middle > 0
            and abs(np.log(middle)) > 0.1
            and all(abs(np.log(middle / f)) > 0.02 for f in found)
        ):
            found.append(middle)
    return found[:12]


def _likely(ratios, reasons, tolerance, inverse=True) -> Iterator[tuple[float, bool]]:
    """Yields the common ratios within `tolerance` (relative) of each measured ratio,
    with `True`, then the measured ratio itself, with `False`.

    With `inverse`, reciprocals of `reasons` are common ratios too.
    """
    candidates = [*reasons, *(1 / r for r in reasons)] if inverse else list(reasons)
    for ratio in ratios:
        for reason in candidates:
            if abs(np.log(reason / ratio)) < tolerance:
                yield float(reason), True
        yield ratio, False


def _symmetries(width: int, height: int) -> Iterator[tuple[str, ImageMap]]:
    """Yields the rotations and reflections of an image of that size, the identity
    first."""
    w, h = width - 1.0, height - 1.0
    matrix = lambda *rows: np.array(rows, dtype=np.float64)
    yield "", ImageMap(np.eye(2), np.zeros(2))
    yield (
        "turned by 90 degrees clockwise",
        ImageMap(matrix([0, -1], [1, 0]), np.array([h, 0.0])),
    )
    yield "turned by 180 degrees", ImageMap(-np.eye(2), np.array([w, h]))
    yield (
        "turned by 90 degrees anticlockwise",
        ImageMap(matrix([0, 1], [-1, 0]), np.array([0.0, w])),
    )
    mirrored = (
        ("mirrored left to right", matrix([-1, 0], [0, 1]), [w, 0.0]),
        (
            "upside down, y counted from the lower edge",
            matrix([1, 0], [0, -1]),
            [0.0, h],
        ),
        ("with x and y exchanged", matrix([0, 1], [1, 0]), [0.0, 0.0]),
        ("turned by 90 degrees and mirrored", matrix([0, -1], [-1, 0]), [h, w]),
    )
    for name, A, b in mirrored:
        for swap in (True, False):
            yield name, ImageMap(A, np.array(b), swap)


def _axes() -> Iterator[Float[np.ndarray, "3 3"]]:
    """Yields the rotations that permute the axes, except the identity."""
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            R = np.zeros((3, 3))
            R[np.arange(3), order] = signs
            if np.linalg.det(R) > 0 and not np.array_equal(R, np.eye(3)):
                yield R


def _axes_name(R: Float[np.ndarray, "3 3"]) -> str:
    """Returns text that names the camera's x, y and z axes among the given axes."""
    letters = [
        ("-" if row.sum() < 0 else "") + "xyz"[int(np.abs(row).argmax())] for row in R
    ]
    right, down, forward = letters
    return f"right is {right}, down is {down}, forward is {forward}"


def of_frames(people: People, frames: np.ndarray, bodies_at: np.ndarray) -> People:
    """Returns the keypoints of `frames` paired with the bodies of `bodies_at`, to test
    a shift in time between them. Bodies are NaN where `bodies_at` is outside the
    video."""
    inside = (bodies_at >= 0) & (bodies_at < len(people.bodies))
    projected = people.bodies[np.where(inside, bodies_at, 0)]
    projected = np.where(inside[:, None, None, None], projected, np.nan)
    return People(people.keypoints[frames], projected, people.camera)


def some_frames(people: People, most: int) -> np.ndarray:
    """Returns up to `most` evenly spaced frames that have both keypoints and bodies."""
    (where,) = np.nonzero(people.both)
    return evenly(where, most)


def evenly(where: np.ndarray, most: int) -> np.ndarray:
    """Returns up to `most` evenly spaced entries of `where`."""
    if len(where) <= most:
        return where
    return where[np.linspace(0, len(where) - 1, most).round().astype(int)]
