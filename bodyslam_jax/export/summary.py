"""`summary.json`: what a person wants to know of a result, and what to doubt."""

import dataclasses
import importlib.metadata
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from bodyslam_jax import body as body_
from bodyslam_jax import export
from bodyslam_jax.config import Config
from bodyslam_jax.diagnostics import figures, plausibility
from bodyslam_jax.diagnostics.plausibility import PERSON_CHECKS, WORLD_CHECKS, Reason
from bodyslam_jax.geometry import camera
from bodyslam_jax.geometry.gravity import Upright
from bodyslam_jax.types import JointEstimate, Result, ScaleStart, Sequence, SfmResult

_CUES_APART = 1.25
"""Factor between the sizes that motion and ground tell, from which a line says so."""
_MOST = 0.5
"""Share of the frames that are used, from which a result is one of the video."""
_GROUND_DOUBT = 1.15
"""Factor between the map's size and that of the people on its ground, from which a
line says so."""


def summarise(
    sequence: Sequence,
    config: Config,
    body: body_.BodyModel,
    cameras: SfmResult,
    joint: JointEstimate,
    result: Result,
    up: Upright,
    seconds: dict[str, float],
) -> dict[str, Any]:
    """`summary.json`: what a person wants to know first, then everything else."""
    warnings = [*sequence.warnings, *cameras.warnings, *joint.unobserved]
    if cameras.kind != "moving" and joint.present.any():
        warnings.append(
            "metric size comes from the body alone: the camera's path gives none."
        )
    apart = cues_apart(joint.start)
    warnings += _disagreement(joint.start, apart)
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
            f"frames {used[0]} to {used[-1]} of {len(within)} are used: nothing tells "
            "where the camera was in the others."
        )
    ground = export.ground_scale(result) if cameras.kind == "moving" else None
    off = max(ground, 1 / ground) if ground else 1.0
    if off > _GROUND_DOUBT:
        text = (
            f"the ground of the map would be under the people's feet if the map were "
            f"{ground:.2f} times as large: scale, postures or focal length are off, or "
            "they stand on something else."
        )
        warnings.append(text)
    way = export.camera_facts(result, within)
    # NaN, where covariances were not computed, stays NaN.
    scale_sigma = np.maximum(abs(joint.scale_sigma), apart / 2 * abs(result.scale))
    scale_sigma = float(scale_sigma)
    persons = []
    for h in range(len(result.poses)):
        facts = export.person_facts(result, h)
        tall, sigma = None, None
        if result.present[h].any():
            tall, sigma = stature(body, result.betas[h], joint.shape_covariance[h])
        steps = export.gait(result, h)
        warnings += _slow_motion(h, steps, scale_sigma / result.scale, sequence.fps)
        persons.append(
            {
                "frames": int(result.present[h].sum()),
                "path_m": facts.distance,
                "speed_m_s": facts.distance / max(facts.seconds, 1e-9),
                "steps_per_s": None if steps is None else steps.frequency,
                "stature_m": tall,
                "stature_sigma_m": sigma,
            }
        )
    reasons = _missing(result, cameras) + _scale_unknown(result, cameras, joint.start)
    if not any(reason.fatal for reason in reasons):
        reasons += _implausible(
            sequence, body, cameras, joint, result, up, scale_sigma, off, persons
        )
    status = plausibility.status_of(reasons)
    headline = [
        f"{sequence.name}: {status}",
        f"camera: {way.distance:.2f} m{_known_to(scale_sigma / result.scale, cameras)} "
        f"in {way.seconds:.1f} s ({cameras.kind})",
    ]
    for h, p in enumerate(persons):
        if not p["frames"]:
            continue
        sure = (
            ""
            if np.isnan(p["stature_sigma_m"])
            else (f" ± {100 * p['stature_sigma_m']:.0f}")
        )
        headline.append(
            f"person {h}: {p['path_m']:.2f} m at {p['speed_m_s']:.2f} m/s, "
            f"{100 * p['stature_m']:.0f}{sure} cm tall"
        )
    lens = focal_length(sequence, cameras)
    if lens["guessed"]:
        text = f"focal length: guess {lens['guess_px']:.0f} px"
        if (sigma := lens["focal_sigma_px"]) is not None:
            text += f", from the camera's path {lens['focal_px']:.0f} ± {sigma:.0f} px"
        headline.append(text)
    return {
        "status": status,
        "reasons": [reason.to_dict() for reason in reasons],
        "headline": headline,
        "warnings": warnings,
        "input": {
            **describe(sequence),
            "fps": sequence.fps,
            "intrinsics_guessed": sequence.intrinsics.is_guess,
        },
        "intrinsics": lens,
        "camera_motion": cameras.kind,
        "scale": {
            "value": result.scale,
            "sigma": scale_sigma,
            "sigma_of_covariance": joint.scale_sigma,
            "start": joint.start.value,
            "start_standard_error": joint.start.standard_error,
            **_cues(joint.start),
            "ground_factor": ground,
        },
        "people": persons,
        # The first and the last.
        "frames_used": np.flatnonzero(within)[[0, -1]].tolist(),
        "counts": {
            "landmarks": len(result.landmarks),
            "observations": int(cameras.keep.sum()),
            "people": len(persons),
        },
        # Of what was not adjusted it is a setting, not a measurement.
        "pixel_sigma": cameras.pixel_sigma if cameras.kind == "moving" else None,
        "per_frame": per_frame(sequence, body, cameras, joint),
        "stages": list(joint.stages),
        "solver": joint.status,
        "durations_s": seconds,
        "settings": dataclasses.asdict(config),
        "versions": versions(),
    }


def _missing(result: Result, cameras: SfmResult) -> list[Reason]:
    """What there is no result without, or only a part of one."""
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
                "the camera's motion is not found: people are placed as if it stood "
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
                "give keypoints of a detector that sees them (--keypoints), or a "
                "metric camera path",
            )
        )
    within = cameras.within
    if within.mean() < _MOST:
        used = np.flatnonzero(within)
        found.append(
            Reason(
                "frames_used",
                f"only frames {used[0]} to {used[-1]} of {len(within)} are used.",
                f"at least {100 * _MOST:.0f} % of the frames",
                "cut the video where the shot changes and run the parts",
                figure=float(within.mean()),
            )
        )
    return found


def _scale_unknown(
    result: Result, cameras: SfmResult, start: ScaleStart
) -> list[Reason]:
    """Where nothing tells how large the map is, although there are people in it."""
    if cameras.kind != "moving" or not result.present.any():
        return []
    advice = (
        "give a camera path in metres, or see that the ground is in view; people who "
        "are carried, on wheels or in the air tell no size of the scene"
    )
    if result.scale <= 0:
        return [
            Reason(
                "scale_sign",
                f"the scale of the map comes out as {result.scale:.3g}: people move "
                "against what their posture says.",
                "a scale above 0",
                advice,
                figure=float(result.scale),
                fatal=True,
            )
        ]
    if np.isfinite(start.standard_error):
        return []
    return [
        Reason(
            "scale_unknown",
            "neither people's motion nor the ground under their feet tells how large "
            "the scene is.",
            "people who walk, or stand on ground that is in view",
            advice,
        )
    ]


def _implausible(
    sequence: Sequence,
    body: body_.BodyModel,
    cameras: SfmResult,
    joint: JointEstimate,
    result: Result,
    up: Upright,
    scale_sigma: float,
    ground: float,
    persons: list[dict[str, Any]],
) -> list[Reason]:
    """What no person, camera or ground is like."""
    fps, found = sequence.fps, []
    walking = False
    misfits = _misfits(sequence, body, joint)
    for h, there in enumerate(result.present):
        told = figures.person_figures(result.joints[h], there, fps)
        walking |= "trunk_lean" in told
        if there.any():
            told["stature"] = told["short_stature"] = persons[h]["stature_m"]
            told["keypoint_misfit"] = misfits[h]
            told["turned_from_body"] = _turned(sequence, joint, h)
        found += plausibility.judge(PERSON_CHECKS, told, h)
    told = {"floors_apart": figures.floors_apart(result.joints, result.present, fps)}
    if walking:
        told["up_against_trunks"] = np.degrees(up.trunks)
        told["slope_of_ground"] = np.degrees(up.ground)
    elif result.present.any():
        told["up_in_image"] = figures.up_in_image(result.T_WC[cameras.within])
    if cameras.kind == "moving" and result.present.any():
        told |= figures.camera_figures(result.T_WC[cameras.within], fps)
        told["scale_sigma"] = 100 * scale_sigma / abs(result.scale)
        told["scale_cues_apart"] = float(np.exp(cues_apart(joint.start)))
        told["ground_under_feet"] = ground
    return found + plausibility.judge(WORLD_CHECKS, told)


def _known_to(share: float, cameras: SfmResult) -> str:
    """How well the camera's metres are known, to stand behind them."""
    if cameras.kind != "moving" or np.isnan(share):
        return ""
    return f" ± {max(1, 100 * share):.0f} %" if share < 1 else ", of no known size,"


def _cues(start: ScaleStart) -> dict[str, list[float] | None]:
    """Scale and standard error as each cue alone has them; `None` where it has none."""
    cues = {
        "from_motion": [start.motion, start.motion_error],
        "from_ground": [start.ground, start.ground_error],
        "from_path": [start.path, start.path_error],
    }
    return {k: v if np.isfinite(v[1]) else None for k, v in cues.items()}


def cues_apart(start: ScaleStart) -> float:
    """The logarithm of the ratio of the sizes that motion and ground tell; 0 where both
    may be right.

    Of two that cannot both be right half of it is what is left of certainty: the
    standard error of two measurements with unknown errors of their own (DerSimonian and
    Laird, 1986), in the limit of errors much larger than those stated.
    """
    sigma = np.hypot(
        start.motion_error / start.motion, start.ground_error / start.ground
    )
    apart = abs(np.log(start.motion / start.ground))
    # Infinite errors say that a cue is not there.
    if not np.isfinite(sigma) or np.exp(apart) < max(_CUES_APART, 1 + 2 * sigma):
        return 0.0
    return float(apart)


def _disagreement(start: ScaleStart, apart: float) -> list[str]:
    """A line where motion and ground tell sizes that both cannot be right."""
    if not apart:
        return []
    ratio = start.motion / start.ground
    return [
        f"people's motion makes the map {ratio:.2f} times as large as the ground under "
        "their feet does: postures, focal length or ground are off; look at both. The "
        f"metres are known to no better than {50 * apart:.0f} % for it."
    ]


def _slow_motion(
    person: int, steps: export.Gait | None, unsure: float, fps: float
) -> list[str]:
    """A line where somebody's steps are so rare, or so many, that time must be wrong.

    `unsure` is the share by which metres may be off; NaN where nothing tells.
    """
    if steps is not None and steps.is_fast_motion(float(np.nan_to_num(unsure))):
        return [
            f"person {person} takes {steps.frequency:.1f} steps a second, each "
            f"{steps.step:.1f} of a leg long: who steps so far does so about "
            f"{1 / steps.slowness:.1f} times as slowly. If {fps:g} fps is not the "
            "video's frame rate, speeds are too high by that."
        ]
    if steps is None or not steps.is_slow_motion(float(np.nan_to_num(unsure))):
        return []
    return [
        f"person {person} takes {steps.frequency:.1f} steps a second, each "
        f"{steps.step:.1f} of a leg long: people do that about {steps.slowness:.1f} "
        f"times as fast. If this is slow motion, or {fps:g} fps is not its frame rate, "
        "speeds are too low by that."
    ]


def describe(sequence: Sequence) -> dict[str, Any]:
    """By what an input is told from another."""
    return {
        "name": sequence.name,
        "frames": sequence.num_frames,
        "width": sequence.intrinsics.width,
        "height": sequence.intrinsics.height,
    }


def focal_length(sequence: Sequence, cameras: SfmResult) -> dict[str, Any]:
    """The focal length used, and how it was come by; px.

    `focal_sigma_px` is `None` unless a guess could be refined.
    """
    guessed = sequence.intrinsics.is_refined
    refined = np.isfinite(cameras.focal_sigma)
    return {
        "guessed": guessed,
        "guess_px": float(sequence.intrinsics.params[0]) if guessed else None,
        "focal_px": cameras.focal,
        "focal_sigma_px": cameras.focal_sigma if refined else None,
    }


def stature(
    body: body_.BodyModel,
    shape: Float[np.ndarray, " 10"],
    covariance: Float[np.ndarray, "10 10"],
) -> tuple[float, float]:
    """Height of the mesh in its rest pose and its standard deviation, m."""
    tall = export.stature(body, shape)
    slope = np.array([export.stature(body, shape + e) - tall for e in np.eye(10)])
    return tall, float(np.sqrt(slope @ covariance @ slope))


def versions() -> dict[str, str]:
    """What ran: a result can be repeated only with the same."""
    names = ("bodyslam-jax", "jax", "optimistix", "numpy", "opencv-python-headless")
    return {name: importlib.metadata.version(name) for name in names}


def per_frame(
    sequence: Sequence, body: body_.BodyModel, cameras: SfmResult, joint: JointEstimate
) -> dict[str, list[float | None]]:
    """How well each frame is explained: mean pixel errors, tracks and inliers."""
    t = sequence.num_frames
    tracks, keep = cameras.tracks, cameras.keep
    count = np.bincount(tracks.frame, minlength=t)
    found: dict[str, list[float | None]] = {"tracks": count.astype(float).tolist()}
    intrinsics = jnp.asarray(joint.intrinsics)
    if cameras.kind == "moving":
        T = joint.cameras[tracks.frame]
        offset = joint.landmarks[tracks.landmark] - T[:, :3, 3]
        p_C = np.einsum("mji,mj->mi", T[:, :3, :3], offset)
        error = np.asarray(camera.project(intrinsics, jnp.asarray(p_C))) - tracks.uv
        length = np.linalg.norm(error, axis=-1)
        inliers = np.bincount(tracks.frame[keep], minlength=t)
        found["inliers"] = inliers.astype(float).tolist()
        found["reprojection_px"] = _means(tracks.frame[keep], length[keep], t)
    if sequence.keypoints is not None and joint.present.any():
        uv = _projected_keypoints(body, joint)
        length = np.linalg.norm(uv - sequence.keypoints.uv, axis=-1)
        seen = (sequence.keypoints.confidence > 0) & joint.present[..., None]
        frame = np.broadcast_to(np.arange(t)[:, None], length.shape)
        found["keypoint_px"] = _means(frame[seen], length[seen], t)
    return found


def _projected_keypoints(
    body: body_.BodyModel, joint: JointEstimate
) -> Float[np.ndarray, "h t 25 2"]:
    """Where the keypoints of the estimated bodies are in the images, px."""
    shapes = jnp.asarray(joint.shapes)[:, None]
    p_H = _keypoints(body, jnp.asarray(joint.poses), shapes)
    turn, move = joint.roots[..., :3, :3], joint.roots[..., None, :3, 3]
    p_C = jnp.einsum("htij,htkj->htki", jnp.asarray(turn), p_H) + move
    return np.asarray(camera.project(jnp.asarray(joint.intrinsics), p_C))


def _turned(sequence: Sequence, joint: JointEstimate, person: int) -> float:
    """How far a person is turned from the body given; NaN where none is."""
    if sequence.bodies is None:
        return np.nan
    both = sequence.bodies.present[person] & joint.present[person]
    given = sequence.bodies.poses[person, both, :3]
    turn = joint.roots[person, both, :3, :3]
    return figures.turned_from_body(np.asarray(turn), np.asarray(given, float))


def _misfits(
    sequence: Sequence, body: body_.BodyModel, joint: JointEstimate
) -> list[float]:
    """Worst distance of each person's keypoints from the body, of its size; NaN where
    there are no keypoints."""
    if sequence.keypoints is None or not joint.present.any():
        return [np.nan] * len(joint.present)
    uv = _projected_keypoints(body, joint)
    error = np.linalg.norm(uv - sequence.keypoints.uv, axis=-1)
    seen = (sequence.keypoints.confidence > 0.3) & joint.present[..., None]
    error = np.where(seen, error, np.nan)
    size = np.linalg.norm(np.ptp(uv, axis=2), axis=-1)
    return [
        figures.keypoint_misfit(*one, sequence.fps)
        for one in zip(error, size, strict=True)
    ]


def _means(frame: np.ndarray, value: np.ndarray, num_frames: int) -> list[float | None]:
    """Mean of `value` in each frame; `None` where there is none."""
    total = np.bincount(frame, value, num_frames)
    count = np.bincount(frame, minlength=num_frames)
    return [float(x / n) if n else None for x, n in zip(total, count, strict=True)]


_keypoints = eqx.filter_jit(body_.local_keypoints)
