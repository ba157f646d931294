"""Plausibility of a result: its figures, judged by the table of thresholds."""

import dataclasses

import numpy as np
from jaxtyping import Bool

from bodyslam_jax.body import BodyModel
from bodyslam_jax.diagnostics import figures, moments
from bodyslam_jax.diagnostics.checks import Reason, judge
from bodyslam_jax.diagnostics.reprojection import projected_keypoints
from bodyslam_jax.diagnostics.scale_uncertainty import cue_discrepancy
from bodyslam_jax.diagnostics.standing_height import ground_heights
from bodyslam_jax.diagnostics.thresholds import PERSON_CHECKS, WORLD_CHECKS
from bodyslam_jax.ground.gravity import Upright
from bodyslam_jax.types import JointEstimate, Result, Sequence, SfmResult

_ADULT_STATURE_M = 1.7
"""Typical stature of the people from whose cadence the limit of quick steps was
derived."""
_MIN_CONFIDENCE = 0.3
"""Confidence from which keypoints are compared with the body."""


@dataclasses.dataclass(frozen=True)
class Doubts:
    """Reasons to doubt a result."""

    of_person: tuple[tuple[Reason, ...], ...]
    """Reasons about each person."""
    of_whole: tuple[Reason, ...]
    """Reasons about the camera, the ground and the scale."""


def implausible(
    sequence: Sequence,
    body: BodyModel,
    cameras: SfmResult,
    joint: JointEstimate,
    result: Result,
    up: Upright,
    *,
    scale_sigma: float,
    ground_factor: float,
    statures: list[float | None],
    of_measurement: list[dict[str, float]],
    measurable: Bool[np.ndarray, " h"],
    inferred: Bool[np.ndarray, "h t"],
) -> Doubts:
    """Returns the reasons for which people, camera or ground are implausible.

    Args:
        up: the vertical, and the cues that determined it.
        scale_sigma: standard deviation of the scale, m per unit of the map.
        ground_factor: factor, 1 or more, between the size of the map and that of the
            people on its ground.
        statures: stature of each person, m; `None` if unknown.
        of_measurement: figures of `measurability.measurement_figures` of each person.
        measurable: people who are judged, and who are used to judge the world.
        inferred: frames in which a person's legs were mostly inferred; feet and steps
            are not judged there.
    """
    fps, of_people = sequence.fps, []
    walkers = np.zeros(result.present.shape, bool)
    misfits = _misfits(sequence, body, joint)
    present = result.present & measurable[:, None]
    judged = lambda checks, found, who, where: tuple(
        judge(checks, found, who, moments=where, times=result.timestamps)
    )
    for h, there in enumerate(present):
        own: dict[str, moments.Frames] = {}
        ground = ground_heights(result, h, there)
        of_person = figures.person_figures(result.joints[h], there, fps, ground)
        stepping = there & ~inferred[h]
        if not stepping[there].all():
            of_legs = figures.person_figures(result.joints[h], stepping, fps, ground)
            of_person = figures.with_legs_of(of_person, of_legs)
        if "trunk_lean" in of_person:
            walkers[h] = stepping
        if there.any():
            stature = statures[h]
            if stature is not None:
                of_person["stature"] = of_person["short_stature"] = stature
            of_person["keypoint_misfit"], misfit = misfits[h]
            of_person["turned_from_body"] = _turned_from_body(sequence, joint, h)
            of_person |= of_measurement[h]
            own = moments.of_person(result.joints[h], there, inferred[h], fps)
            if misfit is not None:
                own["keypoint_misfit"] = misfit
            if joint.statures is not None and np.isfinite(joint.statures[h, 0]):
                # A child's cadence is converted to that of an adult with the same
                # gait: step durations are proportional to the root of leg length.
                pace = min(float(np.sqrt(joint.statures[h, 0] / _ADULT_STATURE_M)), 1.0)
                of_person["quick_steps"] = pace * of_person.get("quick_steps", np.nan)
        whole = moments.seen(there)
        where = {name: own.get(name, whole) for name in of_person}
        of_people.append(judged(PERSON_CHECKS, of_person, h, where))
    of_camera: dict[str, moments.Frames] = {}
    of_world = {
        "floors_apart": figures.floors_apart(result.joints, present & ~inferred, fps)
    }
    if walkers.any():
        of_world["lean_of_walkers"] = figures.lean_of_walkers(result.joints, walkers)
        of_world["up_against_trunks"] = np.degrees(up.trunks)
        of_world["slope_of_ground"] = np.degrees(up.ground)
    elif result.present.any():
        of_world["up_in_image"] = figures.up_in_image(result.T_WC[cameras.within])
    if cameras.kind == "moving" and result.present.any():
        of_world |= figures.camera_figures(result.T_WC[cameras.within], fps)
        of_camera = moments.of_camera(result.T_WC, cameras.within, fps)
        if np.isfinite(scale_sigma):  # Else `scale_unknown` says why.
            of_world["scale_sigma"] = 100 * scale_sigma / abs(result.scale)
        of_world["scale_cues_apart"] = float(np.exp(cue_discrepancy(joint.start)))
        of_world["ground_under_feet"] = ground_factor
        of_world["height_over_ground"] = 100 * joint.start.by_climbers
    anybody = moments.seen(np.any(result.present, axis=0))
    where = {name: of_camera.get(name, anybody) for name in of_world}
    return Doubts(tuple(of_people), judged(WORLD_CHECKS, of_world, None, where))


def _turned_from_body(sequence: Sequence, joint: JointEstimate, person: int) -> float:
    """Returns the angle between the orientations of a person and of the given body,
    degrees; NaN without a given body."""
    if sequence.bodies is None:
        return np.nan
    both = sequence.bodies.present[person] & joint.present[person]
    given = sequence.bodies.poses[person, both, :3]
    turn = joint.roots[person, both, :3, :3]
    return figures.turned_from_body(np.asarray(turn), np.asarray(given, float))


def _misfits(
    sequence: Sequence, body: BodyModel, joint: JointEstimate
) -> list[tuple[float, moments.Frames | None]]:
    """Returns, for each person, the greatest distance of keypoints from the body, % of
    the person's size in the image, and the frames in which it occurs; NaN without
    keypoints."""
    if sequence.keypoints is None or not joint.present.any():
        return [(np.nan, None)] * len(joint.present)
    uv = projected_keypoints(body, joint)
    error = np.linalg.norm(uv - sequence.keypoints.uv, axis=-1)
    valid = sequence.keypoints.confidence > _MIN_CONFIDENCE
    error = np.where(valid & joint.present[..., None], error, np.nan)
    size = np.linalg.norm(np.ptp(uv, axis=2), axis=-1)
    return [
        figures.worst_misfit(*one, sequence.fps)
        for one in zip(error, size, strict=True)
    ]
