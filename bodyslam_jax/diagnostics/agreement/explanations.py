"""Hypotheses that explain why given keypoints and given bodies disagree.

Each hypothesis is a transformation that may have been applied to one of them before
they were given. An `Explanation` predicts the keypoints from the bodies under one
hypothesis. All are tested; their effects on size and position in the image differ:

- a copy of the image of another size, turned or mirrored, maps it about its corner;
- another focal length scales size and position about the principal point;
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

_MAX_PAIRS, _MAX_RATIOS = 24, 12
"""Number of pairs of people, and of the ratios of their sizes, that are tried: bounds
on the time that a crowd takes."""
_MIN_COMPARED_FRAMES = 3
"""Least number of frames of a median."""
_MIN_LOG_RATIO = 0.1
"""Logarithm of a ratio of sizes from which it is tried: a regressor's own error is as
large (0.05 to 0.13 of a person's size)."""
_SIZE_RATIO_TOLERANCE = 0.12
"""Relative difference up to which a usual focal length explains a ratio of sizes: a
regressor's error of size."""
_CROP_FOCAL_PX = 5000.0
"""Focal length of SPIN (Kolotouros et al., ICCV 2019) and its successors, px."""
_NEAR_FACTORS = (0.85, 0.92, 1.0, 1.08, 1.17)
"""Factors on a measured ratio with which a focal length is tried, steps of 8 %: the
size of people nearby is not quite proportional to it."""


@dataclasses.dataclass(frozen=True)
class Explanation:
    """One hypothesis; fields that do not belong to its `kind` change nothing."""

    kind: str
    """`agree`, `copy` (`name`, `factor`), `focal`, `unit` (`factor`) or `crop`
    (`shift`)"""
    forecast: Forecast
    factor: float = 1.0
    """Depending on `kind`: size of the copy over that of the video; the bodies' focal
    length over the camera's; or units of `trans` per metre."""
    name: str = ""
    """How the copy is turned or mirrored; empty if it is not."""
    shift: Float[np.ndarray, " 2"] = dataclasses.field(
        default_factory=lambda: np.zeros(2)
    )
    """From the projected bodies to the keypoints, px."""
    usual: bool = True
    """Whether `factor` is the one of a tool's default rather than a measured one."""


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
        if len(nearest) < _MIN_COMPARED_FRAMES:
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
    projected = plain(people.bodies)
    ratios = _ratios(people.keypoints, projected)
    for name, image in _symmetries(camera.width, camera.height):
        if name:
            yield Explanation("copy", lambda p, m=image: m(plain(p)), name=name)
        places = _ratios(people.keypoints, image(projected), about_corner=True)
        for scale in places:
            # A copy changes sizes as it does places, but for a regressor's error.
            if any(abs(np.log(scale / r)) < 2 * _MIN_LOG_RATIO for r in ratios):
                forecast = lambda p, m=image, s=scale: s * m(plain(p))
                yield Explanation("copy", forecast, scale, name, usual=False)
    yield from _other_bodies(people, ratios)
    shift = _shift(people.keypoints, projected)
    if shift is not None:
        yield Explanation("crop", lambda p: plain(p) + shift, shift=shift)


def _other_bodies(people: People, ratios: list[float]) -> Iterator[Explanation]:
    """Yields explanations by another focal length and by another unit of `trans`."""
    camera = people.camera
    longer = max(camera.width, camera.height)
    # The image's diagonal (CLIFF, WHAM), HMR2's for a crop of 256 px, and SPIN's.
    diagonal = np.hypot(camera.width, camera.height)
    usual = np.array([diagonal, _CROP_FOCAL_PX / 256 * longer, _CROP_FOCAL_PX])
    for ratio in ratios:
        factors = [(float(f), True) for f in usual / camera.params[0]]
        factors = [
            (f, known)
            for f, known in factors
            if abs(np.log(f / ratio)) < _SIZE_RATIO_TOLERANCE
        ]
        for factor, known in [*factors, *((by * ratio, False) for by in _NEAR_FACTORS)]:
            forecast = lambda p, s=factor: project(camera, p / np.array([1, 1, s]))
            yield Explanation("focal", forecast, factor, usual=known)

        def in_unit(p, factor=ratio):
            # The pelvis moves, the body keeps the size of the body model.
            pelvis = p[..., 7:8, :]
            return project(camera, p - pelvis + pelvis / factor)

        yield Explanation("unit", in_unit, ratio, usual=False)


def _shift(detected, projected) -> Float[np.ndarray, " 2"] | None:
    """Returns the median displacement in the image, px; `None` if it is unknown."""
    middles = [
        [centred(uv)[0] for uv in in_common(detected[:, k], projected[:, b])]
        for k, b in _pairs(detected, projected)
    ]
    shift = np.concatenate([np.zeros((0, 2)), *(q - p for q, p in middles)])
    shift = shift[np.isfinite(shift).all(-1)]
    return np.median(shift, axis=0) if len(shift) else None


def _pairs(detected, projected) -> list[tuple[int, int]]:
    """Returns pairs (row of keypoints, row of bodies) that may be one person, pairs of
    low and equal row numbers first."""
    rows = itertools.product(range(detected.shape[1]), range(projected.shape[1]))
    order = sorted(rows, key=lambda pair: (sum(pair), abs(pair[0] - pair[1])))
    return order[:_MAX_PAIRS]


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
        enough = len(ratio) >= _MIN_COMPARED_FRAMES
        middle = float(np.median(ratio)) if enough else 0.0
        if (
            middle > 0
            and abs(np.log(middle)) > _MIN_LOG_RATIO
            and all(abs(np.log(middle / f)) > _MIN_LOG_RATIO / 5 for f in found)
        ):
            found.append(middle)
    return found[:_MAX_RATIOS]


def _symmetries(width: int, height: int) -> Iterator[tuple[str, Callable]]:
    """Yields the rotations and reflections of an image of that size, the identity
    first, as maps of its pixels. A mirrored copy may have left and right exchanged."""
    w, h = width - 1.0, height - 1.0
    maps = (
        ("", lambda u, v: (u, v)),
        ("turned by 90 degrees clockwise", lambda u, v: (h - v, u)),
        ("turned by 180 degrees", lambda u, v: (w - u, h - v)),
        ("turned by 90 degrees anticlockwise", lambda u, v: (v, w - u)),
        ("mirrored left to right", lambda u, v: (w - u, v)),
        ("with y counted from the lower edge", lambda u, v: (u, h - v)),
        ("with x and y exchanged", lambda u, v: (v, u)),
        ("turned by 90 degrees and mirrored", lambda u, v: (h - v, w - u)),
    )
    for k, (name, of) in enumerate(maps):
        moved = lambda uv, of=of: np.stack(of(uv[..., 0], uv[..., 1]), -1)
        yield name, moved
        if k >= len(maps) // 2:
            yield name, lambda uv, m=moved: m(uv)[..., MIRRORED_POINTS, :]
