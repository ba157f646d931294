"""All errors of an estimate at once: a pure function of two aligned-in-time bundles."""

import json
import math
from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from bodyslam_jax.evaluation import _metrics as metrics
from bodyslam_jax.evaluation._alignment import Alignment, align

PELVIS = 0
STILL = 0.01
"""m; a camera whose path has a smaller radius (root mean square) stands still."""
FEET = (7, 10, 8, 11)
"""Left ankle and foot, right ankle and foot: what slides where no mesh is known."""


class Trajectories(eqx.Module):
    """A camera and `h` people over `t` frames: what is compared, in one world frame.

    Two of them are comparable when frame `k` is the same moment and person `i` the same
    person in both; `associate` makes such a pair of two results.
    """

    T_WC: Float[Array, "*b t 4 4"]
    """Camera to world, m."""
    camera_valid: Bool[Array, "*b t"]
    """Where the camera is known."""
    joints: Float[Array, "*b h t 24 3"]
    """m"""
    present: Bool[Array, "*b h t"]
    """Where the person is known."""
    feet: Float[Array, "*b h t f 3"]
    """Points of the feet for `foot_sliding`, m."""
    fps: Float[Array, "*b"]
    """1/s"""


class Evaluation(eqx.Module):
    """Errors by name in m, rad, s: `found["c_ate_se3"]` is a mean, `..._rmse` its RMSE.

    A mapping: `keys`, `items`, `in` and `len` work. NaN where the truth (or the
    estimate) lacks what the error is about, and where a frame that counts is NaN.
    """

    values: dict[str, Float[Array, "*b"]]
    """Cameras, and the mean over people of theirs."""
    people: dict[str, Float[Array, "*b h"]]
    """The same names, person by person, in the truth's order."""
    feet: str = eqx.field(static=True, default="the points given")
    """What `foot_sliding` is of."""

    def __getitem__(self, name: str) -> Float[Array, "*b"]:
        return self.values[name]

    def __contains__(self, name: object) -> bool:
        return name in self.values

    def __iter__(self) -> Iterator[str]:
        return iter(self.values)

    def __len__(self) -> int:
        return len(self.values)

    def keys(self):
        return self.values.keys()

    def items(self):
        return self.values.items()


def evaluate_trajectories(estimate: Trajectories, truth: Trajectories) -> Evaluation:
    """Every error of module `_metrics`; jits, and vmaps over leading axes.

    `c_` is the camera, `h_` the human centre, `j_` the joints. `_se3` and `_sim3` are
    alignment A1 (camera and person each on its own), `_a2`, `_a3`, `_a4` the other
    three in SE(3). `scale` is that of the camera's Sim(3) alignment (paper: "scale
    error", best 1), `scale_error` is `|1 - scale|`. A true camera that stays within
    `STILL` has no scale, no Sim(3) and turns nothing: these and A2 are NaN then.
    """
    camera_valid = estimate.camera_valid & truth.camera_valid
    values = _camera_errors(estimate, truth, camera_valid)
    people: dict[str, Array] = {}
    if truth.present.shape[0]:
        per_person = jax.vmap(_person_errors, (0, 0, 0, 0, 0, 0, None, None, None))
        people = per_person(
            estimate.joints,
            truth.joints,
            estimate.feet,
            truth.feet,
            estimate.present,
            truth.present,
            estimate,
            truth,
            camera_valid,
        )
        counts = estimate.present & truth.present
        broken = jnp.zeros(len(counts), bool)
        for side in (estimate, truth):
            broken |= _is_broken(side.T_WC, camera_valid)
            broken |= jax.vmap(_is_broken)(side.joints, counts)
        mean = lambda value: _mean_over_people(value, broken)
        values |= {name: mean(value) for name, value in people.items()}
    return Evaluation(values, people)


def _is_broken(x: Float[Array, "t ..."], valid: Bool[Array, " t"]) -> Bool[Array, ""]:
    """Whether something that counts is not a number."""
    return jnp.any(valid & ~jnp.all(jnp.isfinite(x), tuple(range(1, x.ndim))))


def _mean_over_people(
    value: Float[Array, " h"], broken: Bool[Array, " h"]
) -> Float[Array, ""]:
    """Over those for whom the error exists; NaN if it is NaN as what counts is."""
    exists = ~jnp.isnan(value) | broken
    return metrics.Errors(value, exists).mean()


def _moves(T_WC: Float[Array, "t 4 4"], valid: Bool[Array, " t"]) -> Bool[Array, ""]:
    """Whether the camera's root mean square distance from its mean is above `STILL`."""
    (centre,) = metrics.only(valid, T_WC[:, :3, 3])
    count = jnp.maximum(jnp.sum(valid), 1).astype(centre.dtype)
    (apart,) = metrics.only(valid, centre - jnp.sum(centre, 0) / count)
    return jnp.sum(apart**2) / count > STILL**2


def _both(name: str, errors: metrics.Errors) -> dict[str, Array]:
    return {name: errors.mean(), f"{name}_rmse": errors.rmse()}


def _camera_errors(
    estimate: Trajectories, truth: Trajectories, valid: Bool[Array, " t"]
) -> dict[str, Array]:
    weights = valid.astype(truth.T_WC.dtype)
    centres, true_centres = estimate.T_WC[:, :3, 3], truth.T_WC[:, :3, 3]
    values: dict[str, Array] = {}
    scale = jnp.ones((), weights.dtype)
    for group, with_scale in (("se3", False), ("sim3", True)):
        found, _ = align(
            "A1",
            truth.T_WC,
            estimate.T_WC,
            weights,
            true_centres,
            centres,
            weights,
            with_scale,
        )
        error = metrics.trajectory_error(centres, true_centres, valid, found)
        values |= _both(f"c_ate_{group}", error)
        scale = found.scale
    values["ate_s"] = values["c_ate_se3"]
    known = _moves(truth.T_WC, valid)
    for name in ("c_ate_sim3", "c_ate_sim3_rmse"):
        values[name] = jnp.where(known, values[name], jnp.nan)
    values["scale"] = jnp.where(known, scale, jnp.nan)
    values["scale_error"] = jnp.where(known, jnp.abs(1 - scale), jnp.nan)
    moved, turned = metrics.relative_pose_errors(estimate.T_WC, truth.T_WC, valid)
    return values | _both("rpe_translation", moved) | _both("rpe_rotation", turned)


def _person_errors(
    joints: Float[Array, "t 24 3"],
    true_joints: Float[Array, "t 24 3"],
    feet: Float[Array, "t f 3"],
    true_feet: Float[Array, "t f 3"],
    present: Bool[Array, " t"],
    true_present: Bool[Array, " t"],
    estimate: Trajectories,
    truth: Trajectories,
    camera_valid: Bool[Array, " t"],
) -> dict[str, Array]:
    valid = present & true_present
    dtype = true_joints.dtype
    centre, true_centre = joints[:, PELVIS], true_joints[:, PELVIS]
    values: dict[str, Array] = {}
    choices: tuple[tuple[str, Alignment, bool], ...] = (
        ("se3", "A1", False),
        ("sim3", "A1", True),
        ("a2", "A2", False),
        ("a3", "A3", False),
        ("a4", "A4", False),
    )
    for name, alignment, with_scale in choices:
        camera, human = align(
            alignment,
            truth.T_WC,
            estimate.T_WC,
            camera_valid.astype(dtype),
            true_centre,
            centre,
            valid.astype(dtype),
            with_scale,
        )
        usable = valid if alignment == "A1" else valid & jnp.any(camera_valid)
        if alignment == "A2":
            usable = valid & _moves(truth.T_WC, camera_valid)
        if alignment in ("A3", "A4"):
            values |= _both(
                f"c_ate_{name}",
                metrics.trajectory_error(
                    estimate.T_WC[:, :3, 3], truth.T_WC[:, :3, 3], camera_valid, camera
                ),
            )
        values |= _both(
            f"h_ate_{name}",
            metrics.trajectory_error(centre, true_centre, usable, human),
        )
        values |= _both(
            f"j_ate_{name}",
            metrics.joint_trajectory_error(joints, true_joints, usable, human),
        )
    chunkings: dict[str, metrics.Chunking] = {"": "wham", "_tram": "tram"}
    for suffix, chunking in chunkings.items():
        first = metrics.world_mpjpe(joints, true_joints, valid, "first", chunking)
        every = metrics.world_mpjpe(joints, true_joints, valid, "all", chunking)
        values |= _both(f"w_mpjpe{suffix}", first) | _both(f"wa_mpjpe{suffix}", every)
    values |= _both("rte", metrics.root_trajectory_error(centre, true_centre, valid))
    seen = valid & camera_valid
    in_camera, true_in_camera = (
        metrics.camera_frame(*metrics.only(seen, points, T_WC))
        for points, T_WC in ((joints, estimate.T_WC), (true_joints, truth.T_WC))
    )
    values |= _both("mpjpe", metrics.mpjpe(in_camera, true_in_camera, seen))
    values |= _both("pa_mpjpe", metrics.pa_mpjpe(joints, true_joints, valid))
    values |= _both(
        "acceleration_error",
        metrics.acceleration_error(
            metrics.hip_centred(in_camera),
            metrics.hip_centred(true_in_camera),
            seen,
            estimate.fps,
        ),
    )
    values |= _both("jitter", metrics.jitter(joints, valid, estimate.fps))
    values |= _both("jitter_of_truth", metrics.jitter(true_joints, valid, truth.fps))
    return values | _both("foot_sliding", metrics.foot_sliding(feet, true_feet, valid))


_MM, _PERCENT, _DEGREES = 1e3, 100.0, 180 / math.pi
ROWS: tuple[tuple[str, str, str, float], ...] = (
    ("c_ate_se3", "C-ATE, SE(3)", "mm", _MM),
    ("c_ate_sim3", "C-ATE, Sim(3)", "mm", _MM),
    ("h_ate_se3", "H-ATE, SE(3)", "mm", _MM),
    ("h_ate_sim3", "H-ATE, Sim(3)", "mm", _MM),
    ("j_ate_se3", "J-ATE, SE(3)", "mm", _MM),
    ("j_ate_sim3", "J-ATE, Sim(3)", "mm", _MM),
    ("scale", "scale (best 1)", "", 1.0),
    ("scale_error", "|1 - scale|", "%", _PERCENT),
    ("h_ate_a2", "H-ATE, A2 camera's alignment", "mm", _MM),
    ("c_ate_a3", "C-ATE, A3 joint alignment", "mm", _MM),
    ("h_ate_a3", "H-ATE, A3 joint alignment", "mm", _MM),
    ("c_ate_a4", "C-ATE, A4 first camera pose", "mm", _MM),
    ("h_ate_a4", "H-ATE, A4 first camera pose", "mm", _MM),
    ("rpe_translation", "RPE translation, 1 frame", "mm", _MM),
    ("rpe_rotation", "RPE rotation, 1 frame", "deg", _DEGREES),
    ("w_mpjpe", "W-MPJPE 100", "mm", _MM),
    ("wa_mpjpe", "WA-MPJPE 100", "mm", _MM),
    ("w_mpjpe_tram", "W-MPJPE 100, TRAM chunks", "mm", _MM),
    ("wa_mpjpe_tram", "WA-MPJPE 100, TRAM chunks", "mm", _MM),
    ("rte", "RTE", "%", _PERCENT),
    ("ate_s", "ATE-S", "mm", _MM),
    ("mpjpe", "MPJPE", "mm", _MM),
    ("pa_mpjpe", "PA-MPJPE", "mm", _MM),
    ("acceleration_error", "acceleration error", "m/s²", 1.0),
    ("jitter", "jitter", "10 m/s³", 0.1),
    ("jitter_of_truth", "jitter of the truth", "10 m/s³", 0.1),
    ("foot_sliding", "foot sliding per frame", "mm", _MM),
)
"""Name, label, unit of the report, factor from SI."""


def to_rows(evaluation: Evaluation) -> list[tuple[str, str, str, str]]:
    """What, mean, RMSE and unit of every error that exists, ready to print."""

    def cell(name: str, factor: float) -> str:
        value = float(evaluation[name]) * factor if name in evaluation else math.nan
        return "–" if math.isnan(value) else f"{value:.4g}"

    more = {"foot_sliding": f" of {evaluation.feet}"}
    rows = [
        (
            label + more.get(name, ""),
            cell(name, factor),
            cell(f"{name}_rmse", factor),
            unit,
        )
        for name, label, unit, factor in ROWS
    ]
    return [row for row in rows if row[1] != "–"]


def to_table(evaluation: Evaluation) -> str:
    """The errors as aligned text: mean and RMSE, mm and degrees where customary."""
    rows = [("", "mean", "RMSE", "unit"), *to_rows(evaluation)]
    width = max(len(row[0]) for row in rows)
    lines = [f"{a:<{width}}  {b:>9}  {c:>9}  {d}".rstrip() for a, b, c, d in rows]
    return "\n".join([lines[0], "-" * (width + 31), *lines[1:]])


def to_json(evaluation: Evaluation) -> str:
    """The errors as JSON in SI units; `null` where one does not exist."""

    def plain(value: Array) -> Any:
        array = np.asarray(value, np.float64)
        listed = [x if math.isfinite(x) else None for x in array.ravel().tolist()]
        return listed if array.ndim else listed[0]

    found: dict[str, Any] = {name: plain(x) for name, x in evaluation.items()}
    found["people"] = {name: plain(x) for name, x in evaluation.people.items()}
    return json.dumps(found, indent=2)
