"""The verdict on a result: its status with reasons, warnings, and people's figures."""

import dataclasses

import numpy as np

from bodyslam_jax.body import BodyModel
from bodyslam_jax.diagnostics.checks import Reason, Status, status_of
from bodyslam_jax.diagnostics.completeness import incomplete, scale_undetermined
from bodyslam_jax.diagnostics.gait import Gait, gait
from bodyslam_jax.diagnostics.ground_scale import ground_scale
from bodyslam_jax.diagnostics.plausibility import implausible
from bodyslam_jax.diagnostics.reprojection import per_frame
from bodyslam_jax.diagnostics.scale_uncertainty import (
    discrepancy_warning,
    reported_sigma,
)
from bodyslam_jax.diagnostics.statistics import (
    PathStatistics,
    camera_statistics,
    person_statistics,
    stature_and_sigma,
)
from bodyslam_jax.geometry.gravity import Upright
from bodyslam_jax.types import JointEstimate, Result, Sequence, SfmResult

_GROUND_WARNING = 1.15
"""Factor between the size of the map and that of the people on its ground from which
there is a warning."""


@dataclasses.dataclass(frozen=True)
class PersonVerdict:
    """One person's figures."""

    frames: int
    """Frames in which the person is present."""
    path: PathStatistics
    steps_per_s: float | None
    """`None` where no regular steps are found."""
    stature: float | None
    """m; `None` for a person who is in no frame."""
    stature_sigma: float | None
    """Standard deviation, m; NaN if uncertainty was not computed."""


@dataclasses.dataclass(frozen=True)
class Verdict:
    """What is made of a result."""

    status: Status
    reasons: tuple[Reason, ...]
    """Why it is not `ok`."""
    warnings: tuple[str, ...]
    scale_sigma: float
    """Standard deviation of the scale as reported, m per unit of the map; infinite or
    NaN as in `scale_uncertainty.covariance_sigma`."""
    ground_factor: float | None
    """Factor by which the map would have to grow for its ground to be under people's
    feet; `None` where no ground is found."""
    camera: PathStatistics
    people: tuple[PersonVerdict, ...]
    per_frame: dict[str, list[float | None]]
    """As of `reprojection.per_frame`."""


def assess(
    sequence: Sequence,
    body: BodyModel,
    cameras: SfmResult,
    joint: JointEstimate,
    result: Result,
    up: Upright,
) -> Verdict:
    """Judges a result.

    Args:
        joint: the optimum of which `result` is the metric, upright version.
        up: how the vertical of the result was found.
    """
    ground_factor = ground_scale(result) if cameras.kind == "moving" else None
    scale_sigma = reported_sigma(result.scale, joint.scale_sigma, joint.start)
    gaits = [gait(result, h) for h in range(len(result.poses))]
    people = tuple(
        _person(result, body, joint, h, steps) for h, steps in enumerate(gaits)
    )
    reasons = incomplete(result, cameras)
    reasons += scale_undetermined(result, cameras, joint.start)
    if not any(reason.fatal for reason in reasons):
        factor = ground_factor or 1.0
        reasons += implausible(
            sequence,
            body,
            cameras,
            joint,
            result,
            up,
            scale_sigma=scale_sigma,
            ground_factor=max(factor, 1 / factor),
            statures=[person.stature for person in people],
        )
    warnings = _warnings(sequence, cameras, joint, ground_factor)
    for h, steps in enumerate(gaits):
        warnings += cadence_warning(h, steps, scale_sigma / result.scale, sequence.fps)
    return Verdict(
        status=status_of(reasons),
        reasons=tuple(reasons),
        warnings=tuple(warnings),
        scale_sigma=scale_sigma,
        ground_factor=ground_factor,
        camera=camera_statistics(result, cameras.within),
        people=people,
        per_frame=per_frame(sequence, body, cameras, joint),
    )


def _person(
    result: Result,
    body: BodyModel,
    joint: JointEstimate,
    person: int,
    steps: Gait | None,
) -> PersonVerdict:
    stature, sigma = None, None
    if result.present[person].any():
        stature, sigma = stature_and_sigma(
            body, result.betas[person], joint.shape_covariance[person]
        )
    return PersonVerdict(
        frames=int(result.present[person].sum()),
        path=person_statistics(result, person),
        steps_per_s=None if steps is None else steps.frequency,
        stature=stature,
        stature_sigma=sigma,
    )


def _warnings(
    sequence: Sequence,
    cameras: SfmResult,
    joint: JointEstimate,
    ground_factor: float | None,
) -> list[str]:
    """Warnings of the stages, and what limits the result without making it doubtful."""
    warnings = [*sequence.warnings, *cameras.warnings, *joint.unobserved]
    if cameras.kind != "moving" and joint.present.any():
        warnings.append(
            "metric size comes from the body alone: the camera's path gives none."
        )
    warnings += discrepancy_warning(joint.start)
    if joint.status != "converged":
        warnings.append(f"the joint estimate may not be the best: {joint.status}.")
    warnings += [
        f"person {h} is left out: too few keypoints, and no body, in any frame used."
        for h in np.flatnonzero(~joint.present.any(axis=1))
    ]
    within = cameras.within
    if not within.all():
        used = np.flatnonzero(within)
        warnings.append(
            f"frames {used[0]} to {used[-1]} of {len(within)} are used: the camera was "
            "not located in the others."
        )
    if ground_factor and max(ground_factor, 1 / ground_factor) > _GROUND_WARNING:
        warnings.append(
            f"the ground of the map would be under the people's feet if the map were "
            f"{ground_factor:.2f} times as large: scale, postures or focal length are "
            "off, or they stand on something else."
        )
    return warnings


def cadence_warning(
    person: int, steps: Gait | None, length_error: float, fps: float
) -> list[str]:
    """A line where steps are so slow, or so quick, that the frame rate must be wrong.

    `length_error` is the relative standard error of all lengths; NaN counts as 0.
    """
    length_error = float(np.nan_to_num(length_error))
    if steps is not None and steps.is_fast_motion(length_error):
        return [
            f"person {person} takes {steps.frequency:.1f} steps a second, each "
            f"{steps.step:.1f} of a leg long: steps of that length usually are about "
            f"{1 / steps.slowness:.1f} times as slow. If {fps:g} fps is not the "
            "video's frame rate, speeds are too high by that factor."
        ]
    if steps is None or not steps.is_slow_motion(length_error):
        return []
    return [
        f"person {person} takes {steps.frequency:.1f} steps a second, each "
        f"{steps.step:.1f} of a leg long: people do that about {steps.slowness:.1f} "
        f"times as fast. If this is slow motion, or {fps:g} fps is not its frame rate, "
        "speeds are too low by that factor."
    ]
