"""Checks the arrays of a body model: shapes, types and values that later code
assumes."""

from pathlib import Path

import numpy as np

from bodyslam_jax.body.skeleton import PARENTS, SURFACE_POINTS
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io.declared import as_array, fields
from bodyslam_jax.io.files import parse_json

_REQUIRED_ARRAYS = (
    "v_template",
    "shapedirs",
    "J_regressor",
    "weights",
    "kintree_table",
    "f",
)


def checked(file: Path, raw: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Checks the arrays of a body model file, and returns them in float64 or int64.

    `parents` (parent of each joint, -1 for the root) is added, and `picks` (vertices of
    `SURFACE_POINTS`) if the file has a header that names them.

    **Raises:** `InputError`, one line: the file, what was found, what was expected.
    """
    missing = [name for name in _REQUIRED_ARRAYS if name not in raw]
    if missing:
        found = ", ".join(sorted(raw)[:12]) or "nothing"
        lacks = ", ".join(missing)
        raise InputError(f"{file}: not a body model: no {lacks}; found {found}.")
    number = lambda name: _numbers(file, name, raw[name])
    template, weights = number("v_template"), number("weights")
    v = len(template)
    _expect(file, "v_template", template, template.shape == (v, 3) and v > 0, "(v, 3)")
    j = weights.shape[-1]
    _expect(file, "weights", weights, weights.shape == (v, j), f"({v}, joints)")
    if j not in (24, 52, 55):
        raise InputError(
            f"{file}: {j} joints, expected 24 (SMPL), 52 (SMPL-H) or 55 (SMPL-X)."
        )
    out = {"v_template": template, "weights": weights}
    out["shapedirs"] = dirs = number("shapedirs")
    is_right = dirs.ndim == 3 and dirs.shape[:2] == (v, 3) and dirs.shape[2] >= 10
    _expect(file, "shapedirs", dirs, is_right, f"({v}, 3, at least 10)")
    out["posedirs"] = dirs = (
        number("posedirs") if "posedirs" in raw else np.zeros((v, 3, 0))
    )
    is_right = dirs.ndim == 3 and dirs.shape[:2] == (v, 3)
    is_right = is_right and dirs.shape[2] in (0, 9 * (j - 1))
    _expect(file, "posedirs", dirs, is_right, f"({v}, 3, {9 * (j - 1)})")
    out["J_regressor"] = regressor = number("J_regressor")
    _expect(file, "J_regressor", regressor, regressor.shape == (j, v), f"({j}, {v})")
    _sums_to_one(file, "weights", weights, 1e-3)
    _sums_to_one(file, "J_regressor", regressor, 2e-2)
    if (weights < -1e-6).any():
        raise InputError(f"{file}: weights has negative entries, expected 0 to 1.")
    stature = float(np.ptp(template[:, 1]))
    # No human has either stature, m: other units, then.
    if not 0.2 < stature < 4:
        raise InputError(
            f"{file}: the body is {stature:.3g} m tall (y axis), expected 0.2 to 4 m."
        )
    out["f"] = faces = _integers(file, "f", raw["f"])
    _expect(file, "f", faces, faces.ndim == 2 and faces.shape[1] == 3, "(faces, 3)")
    if faces.size and (faces.min() < 0 or faces.max() >= v):
        raise InputError(
            f"{file}: f names vertex {faces.max()}, expected 0 to {v - 1}."
        )
    out["parents"] = np.array(_parents(file, raw["kintree_table"], j))
    if "header" in raw:
        out["picks"] = _picks(file, raw["header"], v)
    return out


def _expect(file, name, array, is_right, expected) -> None:
    """**Raises:** `InputError` with the shape of the array unless `is_right`."""
    if not is_right:
        raise InputError(
            f"{file}: {name} has shape {array.shape}, expected {expected}."
        )


def _numbers(file, name, array) -> np.ndarray:
    """Returns an array of finite numbers in float64.

    **Raises:** `InputError` for any other value.
    """
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu":
        found = getattr(array, "dtype", type(array).__name__)
        raise InputError(f"{file}: {name} is of type {found}, expected real numbers.")
    if array.ndim == 0:
        raise InputError(f"{file}: {name} is a single number, expected an array.")
    return as_array(file, name, array)


def _integers(file, name, array) -> np.ndarray:
    """Returns an array of whole numbers in int64.

    **Raises:** `InputError` for any other value.
    """
    array = _numbers(file, name, array)
    if (array != np.round(array)).any():
        raise InputError(f"{file}: {name} has fractions, expected whole numbers.")
    return array.astype(np.int64)


def _sums_to_one(file, name, rows, tolerance) -> None:
    """**Raises:** `InputError` if a row does not sum to 1."""
    worst = float(np.abs(rows.sum(-1) - 1).max())
    if worst > tolerance:
        raise InputError(
            f"{file}: rows of {name} sum to 1 only within {worst:.2g}, "
            f"expected {tolerance:g}."
        )


def _parents(file, table, num_joints) -> list[int]:
    """Returns the parent of each joint from row 0 of the kinematic tree; -1 for the
    root.

    **Raises:** `InputError` if the tree has a cycle or is not that of SMPL.
    """
    table = _integers(file, "kintree_table", table)
    row = table[0] if table.ndim == 2 and len(table) else table
    _expect(
        file, "kintree_table", table, row.shape == (num_joints,), f"(2, {num_joints})"
    )
    parents = [int(p) if 0 <= p < num_joints else -1 for p in row]
    for start in range(num_joints):
        joint, steps = start, 0
        while joint > 0 and steps <= num_joints:
            joint, steps = parents[joint], steps + 1
        if steps > num_joints:
            raise InputError(
                f"{file}: kintree_table is not a tree: joint {start} never reaches "
                "the root (a cycle)."
            )
    count = 24 if num_joints == 24 else 22
    if tuple([-1, *parents[1:count]]) != PARENTS[:count] or parents[0] not in (-1, 0):
        raise InputError(
            f"{file}: kintree_table is not SMPL's tree: parents {parents[:count]}, "
            f"expected {list(PARENTS[:count])}."
        )
    return parents


def _picks(file, header, num_vertices) -> np.ndarray:
    """Returns the vertices of surface points named in the header of this project's
    files.

    **Raises:** `InputError` for a missing or invalid one.
    """
    named = fields(file, parse_json(str(header), file, "a header (JSON)"), "header")
    named = named.fields("keypoints")
    return np.array([named.whole(n, 0, num_vertices - 1) for n in SURFACE_POINTS])
