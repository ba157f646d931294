"""Uncertainty of lengths by direction: across the view, along it, and over the ground.

The size of people gives the size of everything (`sizes`). Lengths across the view at
their distance follow from it alone; their distance from the camera, and motion along
the view, are proportional to the focal length too. A slope in depth is seen through the
focal length as well: up, where the camera looks down by the angle θ, is off by
δf / f · sin θ cos θ.
"""

import dataclasses
from collections.abc import Sequence as Many

import numpy as np
from jaxtyping import Float

from bodyslam_jax.config import Structure
from bodyslam_jax.diagnostics.statistics import smoothed
from bodyslam_jax.geometry.arrays import runs
from bodyslam_jax.ground.gravity import Upright
from bodyslam_jax.types import Result, Sequence, SfmResult

_MIN_REPORTED_FOCAL_SIGMA = 0.05
"""Relative standard deviation of the focal length from which a warning names it. Below,
it does not exceed that of the size of people."""


@dataclasses.dataclass(frozen=True)
class PersonAccuracy:
    """Relative standard deviations of a person's lengths; NaN where unknown."""

    across: float
    """Relative standard deviation of stature and of motion across the view."""
    along: float
    """Relative standard deviation of the distance from the camera and of motion along
    the view."""
    speed: float
    """Relative standard deviation of path length and speed over the ground, for the
    direction of that path."""


@dataclasses.dataclass(frozen=True)
class Accuracy:
    """Standard deviations of the focal length, of up, and of the lengths of each
    person."""

    focal: float
    """Relative standard deviation of the focal length; 0 for a calibrated camera."""
    up: float
    """Standard deviation of the vertical, rad."""
    people: tuple[PersonAccuracy, ...]

    @property
    def across(self) -> float:
        """Relative standard deviation of lengths across the view, for the person whose
        size is known best."""
        return min((p.across for p in self.people if p.across > 0), default=np.nan)

    @property
    def along(self) -> float:
        """Relative standard deviation of distances from the camera, for the person
        whose size is known best."""
        return min((p.along for p in self.people if p.along > 0), default=np.nan)


def accuracy(
    sequence: Sequence,
    cameras: SfmResult,
    result: Result,
    up: Upright,
    sizes: Many[float],
    structure: Structure,
) -> Accuracy:
    """Returns the standard deviations of the lengths of a result.

    Args:
        sizes: relative standard deviation of the size of each person.
    """
    focal = focal_uncertainty(sequence, cameras, structure)
    people, downwards = [], [0.0]
    for h, size in enumerate(sizes):
        share, down = _view(result, h)
        downwards.append(abs(np.sin(down) * np.cos(down)))
        along = float(np.hypot(size, focal))
        speed = float(np.hypot(size, share * focal))
        people.append(PersonAccuracy(float(size), along, speed))
    return Accuracy(
        focal=focal,
        up=float(np.hypot(up.sigma, focal * max(downwards))),
        people=tuple(people),
    )


def focal_uncertainty(
    sequence: Sequence, cameras: SfmResult, structure: Structure
) -> float:
    """Returns the relative standard deviation of the focal length of the result; 0 for
    a calibrated camera."""
    lens = sequence.intrinsics
    if not lens.is_refined:
        return 0.0
    if np.isfinite(cameras.focal_sigma):
        return cameras.focal_sigma / cameras.focal
    if lens.focal_sigma is not None:
        return float(lens.focal_sigma / lens.params[0])
    return structure.focal_sigma


def guess_warning(sequence: Sequence, cameras: SfmResult, found: Accuracy) -> list[str]:
    """Returns a warning that names the lengths affected by an uncertain focal length;
    an empty list if it is known well or there are no people."""
    if not found.people or not found.focal > _MIN_REPORTED_FOCAL_SIGMA:
        return []
    lens = sequence.intrinsics
    origin = "as given" if not lens.is_guess else "guessed"
    if np.isfinite(cameras.focal_sigma):
        origin = "estimated from the camera's path"
    across = _percent(found.across)
    return [
        f"the focal length is {origin}, {cameras.focal:.0f} px "
        f"± {_percent(found.focal)}: distances from the camera and motion along the "
        f"view (± {_percent(found.along)}) and up (± {np.degrees(found.up):.1f} "
        f"degrees) follow from it; lengths across the view do not (± {across}). Give "
        "--focal, --fov or --camera."
    ]


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %" if np.isfinite(share) else "unknown"


def _view(result: Result, person: int) -> tuple[float, float]:
    """Returns the share of a person's squared motion over the ground that is along the
    view, and the angle by which the camera looks down at the person, rad."""
    share = total = 0.0
    gaze: list[Float[np.ndarray, "n 3"]] = []
    for run in runs(result.present[person]):
        to = result.joints[person, run, 0] - result.T_WC[run, :3, 3]
        to = to / np.maximum(np.linalg.norm(to, axis=1, keepdims=True), 1e-9)
        gaze.append(to)
        steps = np.diff(smoothed(result.joints[person, run, 0], result.fps), axis=0)
        steps[:, 1] = 0.0
        share += float(((steps * to[1:]).sum(axis=1) ** 2).sum())
        total += float((steps**2).sum())
    if not gaze:
        return 0.0, 0.0
    down = float(-np.arcsin(np.clip(np.concatenate(gaze)[:, 1].mean(), -1, 1)))
    return share / total if total > 0 else 0.0, down
