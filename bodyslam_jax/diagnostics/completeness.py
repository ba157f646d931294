"""Checks that a result is finite and has cameras, people, enough frames and a scale."""

import numpy as np

from bodyslam_jax.diagnostics.checks import Reason
from bodyslam_jax.types import Result, ScaleStart, SfmResult

_MIN_FRAMES_SHARE = 0.5
"""Share of the video's frames that must be used for a result to represent that
video."""


def incomplete(result: Result, cameras: SfmResult) -> list[Reason]:
    """Returns the reasons to doubt or reject a result that is missing or partial.

    These are values that are not finite, a camera motion that was not found, no people
    (and no metric camera path), and fewer than half of the video's frames used.
    """
    found = []
    if not np.isfinite(result.T_WC).all() or not np.isfinite(result.joints).all():
        found.append(
            Reason(
                "not_finite",
                "the estimate is not a number.",
                "finite numbers",
                "leave out inputs one by one: bodies, masks, the camera file",
                fatal=True,
            )
        )
    if cameras.kind == "failed":
        found.append(
            Reason(
                "camera_motion",
                "the camera's motion was not found: people are placed as if it stood "
                "still.",
                "a camera path",
                "give a video with more texture and less blur, or person masks",
                fatal=True,
            )
        )
    metric = np.isfinite(cameras.path_scale)
    if not result.present.any() and not metric:
        found.append(
            Reason(
                "people",
                "there are no people: cameras and map have no unit.",
                "at least one person",
                "give keypoints of a detector that finds them (--keypoints), or a "
                "metric camera path",
            )
        )
    within = cameras.within
    if within.mean() < _MIN_FRAMES_SHARE:
        used = np.flatnonzero(within)
        found.append(
            Reason(
                "frames_used",
                f"only frames {used[0]} to {used[-1]} of {len(within)} are used.",
                f"at least {100 * _MIN_FRAMES_SHARE:.0f} % of the frames",
                "cut the video where the shot changes and run the parts",
                figure=float(within.mean()),
            )
        )
    return found


def scale_undetermined(
    result: Result, cameras: SfmResult, start: ScaleStart, *, legs_hidden: bool = False
) -> list[Reason]:
    """Returns the reasons to doubt or reject the scale of a moving camera that sees
    people.

    Either no cue determines the scale, or the estimated scale is not positive. With
    `legs_hidden` nobody's legs are seen in any frame.
    """
    if cameras.kind != "moving" or not result.present.any():
        return []
    advice = (
        "give a camera path in metres, or have the ground in view; people who are "
        "carried, on wheels or in the air do not determine the size of the scene"
    )
    if result.scale <= 0:
        return [
            Reason(
                "scale_sign",
                f"the scale of the map is {result.scale:.3g}: people move against the "
                "direction that their postures predict.",
                "a scale above 0",
                advice,
                figure=float(result.scale),
                fatal=True,
            )
        ]
    if np.isfinite(start.standard_error):
        return []
    if legs_hidden:
        advice = (
            "give a camera path in metres (--camera-path-metric), or a part of the "
            "video in which legs are in view (--start, --end); a stature (--height) or "
            "a regressor's bodies (--bodies) tell how far people are from the camera, "
            "but not how far it moves"
        )
    return [
        Reason(
            "scale_unknown",
            "nobody's legs are seen: no step and no foot determines how large the "
            "scene is."
            if legs_hidden
            else "neither people's motion nor the ground under their feet determines "
            "how large the scene is.",
            "people who walk, or stand on ground that is in view",
            advice,
        )
    ]
