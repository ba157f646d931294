"""Verdict on one person: figures, status and reasons."""

import dataclasses
from typing import Literal

import numpy as np

from bodyslam_jax.body import BodyModel
from bodyslam_jax.diagnostics import measurability, moments
from bodyslam_jax.diagnostics.checks import Reason, judge
from bodyslam_jax.diagnostics.gait import Gait
from bodyslam_jax.diagnostics.measured import Measured
from bodyslam_jax.diagnostics.plausibility import Doubts
from bodyslam_jax.diagnostics.seated import Seated, stretches
from bodyslam_jax.diagnostics.statistics import (
    PathStatistics,
    person_statistics,
    stature_and_sigma,
)
from bodyslam_jax.diagnostics.thresholds import MEASURABLE_CHECKS
from bodyslam_jax.geometry.arrays import runs
from bodyslam_jax.types import JointEstimate, Result, Sequence

PersonStatus = Literal["ok", "doubtful", "not_measurable", "absent"]
"""Status of one person. `not_measurable`: too small or too far away for a speed, path
or size in metres; `absent`: in no frame."""


@dataclasses.dataclass(frozen=True)
class PersonVerdict:
    """Figures of one person, with status and reasons."""

    frames: int
    """Frames in which the person is present."""
    path: PathStatistics
    steps_per_s: float | None
    """Cadence; `None` where no regular steps are found."""
    stature: float | None
    """Stature, m; `None` for a person who is in no frame."""
    stature_sigma: float | None
    """Standard deviation, m; NaN if uncertainty was not computed."""
    status: PersonStatus
    reasons: tuple[Reason, ...]
    """Reasons for which the status is not `ok`."""
    not_measured: dict[str, float]
    """Share of the frames in which arms, legs and feet were not measured, 0 to 1, by
    limb."""
    inferred_frames: tuple[tuple[int, int], ...]
    """First and last frame of each stretch in which the legs were mostly inferred."""
    seated: tuple[Seated, ...]
    """Stretches of frames without a knee or an ankle in view, each with the probability
    that the person sits."""
    leg_px: float
    """Median length of a leg in the image, px."""
    speed_noise: float
    """Standard deviation of the mean speed along the view due to keypoint noise alone,
    m/s; NaN if unknown."""


def assess_person(
    sequence: Sequence,
    result: Result,
    body: BodyModel,
    joint: JointEstimate,
    person: int,
    steps: Gait | None,
    found: Measured,
) -> PersonVerdict:
    """Returns a person's figures, and the status that they imply: `ok`,
    `not_measurable` or `absent`."""
    stature, sigma = None, None
    present = result.present[person]
    path = person_statistics(result, person)
    reasons: list[Reason] = []
    leg_px, speed_noise = np.nan, np.nan
    if present.any():
        stature, sigma = stature_and_sigma(
            body, result.betas[person], joint.shape_covariance[person]
        )
        leg_px = measurability.leg_in_image(joint, result, person)
        speed_noise = measurability.speed_noise(sequence, found, joint, person)
        if not found.body[person].any():
            error = measurability.relative_speed_error(speed_noise, path.mean_speed)
            figures = {"leg_in_image": leg_px, "speed_error": error}
            reasons = judge(
                MEASURABLE_CHECKS,
                figures,
                person,
                moments=dict.fromkeys(figures, moments.seen(present)),
                times=result.timestamps,
            )
    inferred = runs(measurability.inferred_legs(found, person, present, sequence.fps))
    known = "ok" if present.any() else "absent"
    return PersonVerdict(
        frames=int(present.sum()),
        path=path,
        steps_per_s=None if steps is None else steps.frequency,
        stature=stature,
        stature_sigma=sigma,
        status="not_measurable" if reasons else known,
        reasons=tuple(reasons),
        not_measured=found.shares(person, present),
        inferred_frames=tuple((int(run.start), int(run.stop - 1)) for run in inferred),
        seated=stretches(
            result.joints[person],
            present & found.legs_unseen[person],
            sequence.fps,
            result.T_WC[:, :3, 3],
        ),
        leg_px=leg_px,
        speed_noise=speed_noise,
    )


def with_doubts(people: list[PersonVerdict], doubts: Doubts) -> list[PersonVerdict]:
    """Returns the people; those whom `doubts` names are `doubtful`, with the
    reasons."""
    return [
        dataclasses.replace(person, status="doubtful", reasons=reasons)
        if reasons
        else person
        for person, reasons in zip(people, doubts.of_person, strict=True)
    ]


def with_more_doubts(
    people: list[PersonVerdict], reasons: list[Reason]
) -> tuple[list[PersonVerdict], list[Reason]]:
    """Adds reasons to the measurable people they are about, who become `doubtful`.

    Returns these people, and the reasons that are about none of them.
    """
    found, rest = list(people), []
    for reason in reasons:
        h = reason.person
        if h is None or found[h].status not in ("ok", "doubtful"):
            rest.append(reason)
            continue
        more = (*found[h].reasons, reason)
        found[h] = dataclasses.replace(found[h], status="doubtful", reasons=more)
    return found, rest


def reasons_of_people(people: list[PersonVerdict]) -> list[Reason]:
    """Returns the reasons to doubt the whole result: those about measurable people, or,
    if nobody is measurable, those why not."""
    somebody = any(person.status in ("ok", "doubtful") for person in people)
    return [
        reason
        for person in people
        if person.status == "doubtful" or not somebody
        for reason in person.reasons
    ]


def warnings_of_people(people: list[PersonVerdict]) -> list[str]:
    """Returns a warning for each person who cannot be measured, for each whose legs are
    inferred in frames too few to make the person doubtful, and for each of whom no leg
    is in view, with the probability that the person sits."""
    lines = []
    for h, person in enumerate(people):
        if person.status == "not_measurable":
            why = " ".join(reason.message for reason in person.reasons)
            lines.append(f"{why} No length, speed or place of this person is measured.")
        elif person.inferred_frames and person.status == "ok":
            frames = ", ".join(f"{a} to {b}" for a, b in person.inferred_frames)
            lines.append(
                f"person {h}, frames {frames}: most of the legs are hidden or out of "
                "the image; the posture is inferred there, not measured."
            )
        lines += [
            f"person {h}, frames {one.frames[0]} to {one.frames[1]}: no knee and no "
            "ankle is in view, and legs are a guess; by how little the pelvis moves, "
            f"the probability is {100 * one.probability:.0f} % that the person sits."
            for one in person.seated
            if person.status != "not_measurable"
        ]
    return lines
