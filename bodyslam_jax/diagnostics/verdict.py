"""Verdict on a result: its status with reasons, warnings, and the figures of its
people."""

import dataclasses

import numpy as np
from jaxtyping import Float

from bodyslam_jax import people as people_
from bodyslam_jax.body import BodyModel
from bodyslam_jax.config import Config
from bodyslam_jax.diagnostics import measurability
from bodyslam_jax.diagnostics.accuracy import Accuracy, accuracy, guess_warning
from bodyslam_jax.diagnostics.checks import Reason, Status, status_of
from bodyslam_jax.diagnostics.completeness import incomplete, scale_undetermined
from bodyslam_jax.diagnostics.facts import (
    Fact,
    contradictions,
    given_facts,
    misfits_of_own_factors,
)
from bodyslam_jax.diagnostics.gait import Gait, gait
from bodyslam_jax.diagnostics.measured import measured
from bodyslam_jax.diagnostics.person_verdict import (
    PersonVerdict,
    assess_person,
    reasons_of_people,
    warnings_of_people,
    with_doubts,
    with_more_doubts,
)
from bodyslam_jax.diagnostics.place_uncertainty import (
    PlaceUncertainty,
    place_uncertainty,
)
from bodyslam_jax.diagnostics.plausibility import implausible
from bodyslam_jax.diagnostics.reprojection import per_frame
from bodyslam_jax.diagnostics.scale_uncertainty import (
    discrepancy_warning,
    reported_sigma,
)
from bodyslam_jax.diagnostics.standing_height import ground_scale
from bodyslam_jax.diagnostics.statistics import (
    PathStatistics,
    camera_statistics,
)
from bodyslam_jax.ground.gravity import Upright
from bodyslam_jax.people.stature import SIZE_STEP, stature_range
from bodyslam_jax.types import JointEstimate, Result, Sequence, SfmResult

_GROUND_WARNING_FACTOR = 1.15
"""Factor between the size of the map and that of the people on its ground from which a
warning is given."""


@dataclasses.dataclass(frozen=True)
class Verdict:
    """Status, reasons, warnings and figures of a result."""

    status: Status
    reasons: tuple[Reason, ...]
    """Reasons for which the status is not `ok`."""
    warnings: tuple[str, ...]
    scale_sigma: float
    """Standard deviation of the scale as reported, m per unit of the map; infinite or
    NaN as in `scale_uncertainty.covariance_sigma`."""
    ground_factor: float | None
    """Factor by which the map would have to grow for its ground to lie under people's
    feet (`ground_scale`); `None` where no ground is found."""
    camera: PathStatistics
    people: tuple[PersonVerdict, ...]
    per_frame: dict[str, list[float | None]]
    """Figures of each frame (`reprojection.per_frame`)."""
    joint_sigma: Float[np.ndarray, "h t 24"]
    """Expected error of each joint within the body, m (`measured.Measured`)."""
    places: PlaceUncertainty | None
    """Standard deviations of people's places and of the camera's height; `None` where
    they were not computed, or nothing determines the scale."""
    up: Upright
    """The vertical, and the cues that determined it."""
    accuracy: Accuracy
    """Standard deviations of the focal length, of up, and of people's lengths."""
    given: tuple[Fact, ...] = ()
    """Quantities that the user gave, with the estimates made without them."""


def assess(
    sequence: Sequence,
    body: BodyModel,
    cameras: SfmResult,
    joint: JointEstimate,
    result: Result,
    up: Upright,
    config: Config = Config(),
) -> Verdict:
    """Judges a result.

    Args:
        config: settings, with the quantities that the user gave.
        joint: the optimum of which `result` is the metric, upright version.
        up: the vertical of the result, and the cues that determined it.
    """
    scale_sigma = reported_sigma(result.scale, joint.scale_sigma, joint.start)
    found = measured(sequence, joint, body, result)
    # Feet and steps of hidden legs are guesses, which are not judged.
    legs = people_.legs_shown(found.keypoint, result.present, sequence.fps)
    stepping = dataclasses.replace(result, present=result.present & legs)
    ground_factor = ground_scale(stepping) if cameras.kind == "moving" else None
    gaits = [gait(stepping, h) for h in range(len(result.poses))]
    people = [
        assess_person(sequence, result, body, joint, h, steps, found)
        for h, steps in enumerate(gaits)
    ]
    of_world: tuple[Reason, ...] = ()
    whole = incomplete(result, cameras)
    hidden = bool(result.present.any()) and not stepping.present.any()
    whole += scale_undetermined(result, cameras, joint.start, legs_hidden=hidden)
    if not any(reason.fatal for reason in whole):
        factor = ground_factor or 1.0
        doubts = implausible(
            sequence,
            body,
            cameras,
            joint,
            result,
            up,
            scale_sigma=scale_sigma,
            ground_factor=max(factor, 1 / factor),
            statures=[person.stature for person in people],
            of_measurement=measurability.measurement_figures(sequence, found, result),
            measurable=np.array([p.status == "ok" for p in people], bool),
            inferred=result.present & ~legs,
        )
        people = with_doubts(people, doubts)
        of_world = doubts.of_whole
    statures = [
        (person.stature_sigma or np.nan) / (person.stature or np.nan)
        for person in people
    ]
    moving = cameras.kind == "moving"
    sizes = [scale_sigma / abs(result.scale)] * len(people) if moving else statures
    lengths = accuracy(sequence, cameras, result, up, sizes, config.structure)
    places = place_uncertainty(
        joint,
        result,
        found.joint_sigma,
        np.array(statures),
        scale_sigma=scale_sigma if moving else 0.0,
        up_sigma=lengths.up,
        focal_sigma=lengths.focal,
    )
    warnings = _warnings(sequence, cameras, joint, ground_factor)
    warnings += guess_warning(sequence, cameras, lengths)
    warnings += warnings_of_people(people)
    warnings += _assumed_shown(sequence, result)
    for h, steps in enumerate(gaits):
        warnings += cadence_warning(h, steps, scale_sigma / result.scale, sequence.fps)
    of_given = tuple(
        given_facts(
            config, sequence, cameras, joint, up, gaits, scale_sigma / result.scale
        )
    )
    lines, contradicted = contradictions(of_given)
    warnings += lines
    lines, misfits = misfits_of_own_factors(joint)
    warnings += lines
    of_world += tuple(misfits)
    people, contradicted = with_more_doubts(
        people, [*contradicted, *_resized(body, joint)]
    )
    reasons = (*whole, *reasons_of_people(people), *of_world, *contradicted)
    reasons += tuple(
        Reason(
            name="input_contradicts_itself",
            message=text,
            expected="files that agree",
            advice="mend the file that is wrong, or leave it out",
        )
        for text in sequence.contradictions
    )
    return Verdict(
        status=status_of(list(reasons)),
        reasons=reasons,
        warnings=tuple(warnings),
        scale_sigma=scale_sigma,
        ground_factor=ground_factor,
        camera=camera_statistics(result, cameras.within),
        people=tuple(people),
        per_frame=per_frame(sequence, body, cameras, joint),
        joint_sigma=found.joint_sigma,
        places=places,
        up=up,
        accuracy=lengths,
        given=of_given,
    )


def _resized(body: BodyModel, joint: JointEstimate) -> list[Reason]:
    """Returns a reason for each person whose given stature lies outside the range of
    the body model's shapes."""
    if not body.sized or joint.statures is None:
        return []
    low, high = stature_range(body)
    return [
        Reason(
            name="stature_beyond_body_model",
            message=f"person {h}: the body model's shapes reach statures of {low:.2f} "
            f"to {high:.2f} m (3 standard deviations), not the {height:.2f} m given: "
            f"the person is a model's body resized by {1 + SIZE_STEP * shape[-1]:.2f}, "
            "with an adult's proportions, where a child's legs are shorter.",
            expected=f"{low:.2f} to {high:.2f} m",
            advice="the stature is right if it was given right, lengths of limbs and "
            "the camera's path are off by as much as the proportions; for children "
            "give a body model of children (--body-model)",
            figure=float(height),
            unit="m",
            person=h,
        )
        for h, (shape, (height, *_)) in enumerate(
            zip(joint.shapes, joint.statures, strict=True)
        )
        if np.isfinite(height) and not low <= height <= high
    ]


def _warnings(
    sequence: Sequence,
    cameras: SfmResult,
    joint: JointEstimate,
    ground_factor: float | None,
) -> list[str]:
    """Returns the warnings of the stages, and those of limits that do not make the
    result doubtful."""
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
    if ground_factor and max(ground_factor, 1 / ground_factor) > _GROUND_WARNING_FACTOR:
        warnings.append(
            f"the ground of the map would be under the people's feet if the map were "
            f"{ground_factor:.2f} times as large: scale, postures or focal length are "
            "off, or they stand on something else."
        )
    return warnings


def _assumed_shown(sequence: Sequence, result: Result) -> list[str]:
    """Returns a warning for people with bodies but no keypoints, of whom hidden limbs
    cannot be told from visible ones."""
    lone = people_.without_keypoints(sequence) & result.present.any(axis=1)
    if not lone.any():
        return []
    who = ", ".join(str(h) for h in np.flatnonzero(lone))
    where = "in the image" if sequence.masks is None else "on the masks of people"
    return [
        f"person {who}: a body and no keypoints, so nothing tells which limbs are "
        f"hidden; all are taken to be seen that the body has {where}. If legs are "
        "hidden, as by a table, give keypoints (--keypoints): guessed steps make sizes "
        "wrong."
    ]


def cadence_warning(
    person: int, steps: Gait | None, length_error: float, fps: float
) -> list[str]:
    """Returns a warning if the steps are so slow or so quick that the frame rate is
    probably wrong, else an empty list.

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
    if steps is None:
        return []
    if not steps.is_slow_motion(length_error):
        if not steps.has_low_cadence():
            return []
        return [
            f"person {person} takes {steps.frequency:.1f} steps a second: of 76 "
            "recorded walks one has fewer than 1.2. If this is slow motion, or "
            f"{fps:g} fps is not the video's frame rate, speeds are too low, and steps "
            "are predicted worse; give --fps."
        ]
    return [
        f"person {person} takes {steps.frequency:.1f} steps a second, each "
        f"{steps.step:.1f} of a leg long: people do that about {steps.slowness:.1f} "
        f"times as fast. If this is slow motion, or {fps:g} fps is not its frame rate, "
        "speeds are too low by that factor."
    ]
