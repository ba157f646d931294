"""Computes the rows of `bodyslam experiment table1`: the full estimate against simpler
methods.

The input is a `Case`; the output are the errors of all `METHODS` from the same tracks,
keypoints and regressed bodies.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np

from bodyslam_jax import evaluation, graph, people
from bodyslam_jax.body.skeleton import BODY25_ANKLES
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.experiments.ablation import as_published
from bodyslam_jax.experiments.scenario import NAMES, score_of, with_scale, without_map
from bodyslam_jax.initialisation import first_state
from bodyslam_jax.pipeline.case import Case, trajectories
from bodyslam_jax.pipeline.contact_stage import hold_standing_feet
from bodyslam_jax.pipeline.joint_problem import solve_stage

METHODS = {
    "no_mm": "no motion model: cameras in the map's own unit, people from keypoints",
    "depth": "cameras scaled by the median of the regressed depths, same people",
    "start": "scale in closed form from motion and ground, same people",
    "scale_only": "cameras held, s and people optimised, no landmarks",
    "per_frame": "the regressor's bodies in the cameras of the full estimate",
    "published": "as published: the paper's weights, network and first-order steps",
    "full": "the full estimate",
}
"""Methods that are compared, with the same tracks, keypoints and regressed bodies."""
_PATH_STEP_FRAMES = 3
"""Interval between drawn points of a path."""
_NEAREST_LANDMARKS = 5
"""Number of landmarks near the ankles whose depth represents the person's."""


def compare_methods(case: Case) -> dict[str, Any]:
    """Returns the errors (m) of all `METHODS` on one sequence, by keys such as
    `full/c_ate_se3`.

    Also returned are properties of the true sequence, the estimated over the true scale
    at the start (`start_ratio`) and at the end (`scale_ratio`), steps and status.

    **Raises:** `InputError` if the camera does not move.
    """
    prepared = case.prepare()
    alone = prepared.state
    if not prepared.moving:
        raise InputError(f"{case.name}: the camera does not move; nothing to compare.")
    solution, stage = solve_stage(prepared.problem, alone, case.config, "joint")
    full = hold_standing_feet(
        prepared, solution.state, case.sequence, case.cameras, case.body, case.config
    ).state
    fixed, bare = without_map(prepared.problem, alone, hold_cameras=True)
    moved, _ = solve_stage(fixed, bare, case.config, "scale only")
    raw = people.roots_from_bodies(case.bodies, case.body)
    regressed = first_state(
        np.asarray(full.cameras),
        np.asarray(full.landmarks),
        raw,
        np.asarray(full.intrinsics),
    )
    states = {
        "no_mm": with_scale(alone, 1.0),
        "depth": with_scale(alone, depth_scale(case)),
        "start": alone,
        "scale_only": moved.state,
        "per_frame": with_scale(regressed, full.scale),
        "full": full,
    }
    row: dict[str, Any] = {
        "frames": float(case.sequence.num_frames),
        "radius": case.radius,
        "registered": float(case.cameras.registered.mean()),
        "start_ratio": prepared.scale.value / case.map_scale,
        "start_sigma": prepared.scale.standard_error / case.map_scale,
        "steps": float(stage["iterations"]),
        "seconds": float(stage["seconds"]),
        "status": stage["status"],
    }
    for name, state in states.items():
        found = score_of(case, state, prepared.roots.present)
        row |= {f"{name}/{key}": value for key, value in found.items()}
    published = as_published(case)
    row |= {f"published/{name}": published[name] for name in NAMES}
    row["scale_ratio"] = 1 / float(row["full/scale"])
    drawn = {name: states[name] for name in ("no_mm", "full")}
    return row | {"paths": _paths(case, drawn, prepared.roots.present)}


def _paths(case: Case, states: dict[str, graph.State], present: np.ndarray) -> dict:
    """Returns camera and human centre from above (x, z, m), each aligned by SE(3)
    (A1)."""
    truth = case.truth
    found = {
        "camera/truth": truth.T_WC[:, :3, 3],
        "human/truth": truth.joints[0, :, 0],
    }
    valid = jnp.asarray(case.cameras.registered, float)
    for name, state in states.items():
        estimate = trajectories(
            state, case.body, present, case.cameras.registered, truth.fps
        )
        camera, human = evaluation.align(
            "A1",
            truth.T_WC,
            estimate.T_WC,
            valid,
            truth.joints[0, :, 0],
            estimate.joints[0, :, 0],
            jnp.asarray(present[0], float),
        )
        found[f"camera/{name}"] = camera.apply(estimate.T_WC[:, :3, 3])
        found[f"human/{name}"] = human.apply(estimate.joints[0, :, 0])
    thin = lambda x: np.round(np.asarray(x)[::_PATH_STEP_FRAMES, ::2], 4).tolist()
    return {name: thin(path) for name, path in found.items()}


def depth_scale(case: Case) -> float:
    """Returns metres per unit of the map, assuming that landmarks at the feet have the
    person's depth.

    It is the median over frames of the regressed depth of the pelvis divided by the
    median depth of the landmarks that are nearest to the ankles in the image.

    **Raises:** `InputError` without keypoints.
    """
    cameras, keypoints = case.cameras, case.sequence.keypoints
    if keypoints is None:
        raise InputError(f"{case.name}: no keypoints, so no feet to look for.")
    tracks, T_WC = cameras.tracks, cameras.T_WC
    pelvis = people.roots_from_bodies(case.bodies, case.body).T_CH[0, :, 2, 3]
    found = []
    for k in np.flatnonzero(case.bodies.present[0] & cameras.registered):
        sure = keypoints.confidence[0, k, list(BODY25_ANKLES)] > 0.3
        rows = np.flatnonzero((tracks.frame == k) & cameras.keep)
        if not sure.any() or len(rows) < _NEAREST_LANDMARKS:
            continue
        feet = keypoints.uv[0, k, list(BODY25_ANKLES)][sure].mean(axis=0)
        near = rows[
            np.argsort(np.linalg.norm(tracks.uv[rows] - feet, axis=1))[
                :_NEAREST_LANDMARKS
            ]
        ]
        offset = cameras.landmarks[tracks.landmark[near]] - T_WC[k, :3, 3]
        depth = float(np.median(offset @ T_WC[k, :3, 2]))
        if depth > 0:
            found.append(pelvis[k] / depth)
    return float(np.median(found)) if found else 1.0
