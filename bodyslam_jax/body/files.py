"""Finds, reads, checks and writes body model files.

SMPL's files are found by their standard names, and read in both common formats: the
original pickle, and `.npz` with the same names of arrays. SMPL-H and SMPL-X have more
joints (hands, jaw, eyes), which are kept at rest: their skinning weights are added to
those of the wrist or head, and the body has SMPL's 72 pose parameters.

The original pickles are read without chumpy or SciPy. They contain chumpy expressions
and scipy.sparse matrices beside NumPy arrays. `io.safe_pickle` loads them as inert
stand-ins, from whose state the numbers are taken.
"""

import json
import os
import re
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from bodyslam_jax.body.model import BodyModel, runs_of_vertices, sparse_rows
from bodyslam_jax.body.skeleton import (
    ANKLES,
    HEAD,
    JOINT_NAMES,
    PARENTS,
    SURFACE_POINTS,
)
from bodyslam_jax.body.validate import checked
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io import atomic
from bodyslam_jax.io.archive import read_npz
from bodyslam_jax.io.files import is_zip
from bodyslam_jax.io.safe_pickle import StandIn, restricted_load

DEFAULT = Path(__file__).parent / "assets" / "default_body.npz"
"""The body model of the package."""
PATH_VARIABLE = "BODYSLAM_BODY_MODEL"
"""Environment variable that names a body model, or a folder of them."""
_GENDERS = ("neutral", "female", "male")
_FILE_NAMES = (
    "SMPL_{G}.npz",
    "SMPL_{G}.pkl",
    "smpl/SMPL_{G}.npz",
    "smpl/SMPL_{G}.pkl",
    "basicModel_{g}_lbs_10_207_0_v1.0.0.pkl",
    "basicmodel_{g}_lbs_10_207_0_v1.1.0.pkl",
    "basicModel_{g}_lbs_10_207_0_v1.1.0.pkl",
    "smpl/models/basicmodel_{g}_lbs_10_207_0_v1.1.0.pkl",
    "SMPLH_{G}.npz",
    "SMPLH_{G}.pkl",
    "smplh/SMPLH_{G}.npz",
    "smplh/SMPLH_{G}.pkl",
    "{gender}/model.npz",
    "smplh/{gender}/model.npz",
    "SMPLX_{G}.npz",
    "SMPLX_{G}.pkl",
    "smplx/SMPLX_{G}.npz",
    "smplx/SMPLX_{G}.pkl",
)
_PICKS_BY_MESH_SIZE = {
    6890: (332, 6260, 2800, 4071, 583, 3216, 3226, 3387, 6617, 6624, 6787),
    10475: (9120, 9929, 9448, 616, 6, 5770, 5780, 8846, 8463, 8474, 8635),
}
"""Vertices of SURFACE_POINTS in the meshes of SMPL and SMPL-X, by their numbers of
vertices (`vertex_ids.py` of smplx; the top of the head is the highest vertex)."""
KIND_BY_JOINTS = {24: "smpl", 52: "smplh", 55: "smplx"}
"""Body models by their number of joints."""
_LIBRARIES = ("chumpy", "scipy.sparse")
_MAX_DEPTH = 8
"""Largest depth of nested chumpy expressions that are evaluated."""
_MAX_NUMBERS = 20_000_000
"""Largest total size of the arrays that sparse matrices and selections expand to;
SMPL-X's regressor has 576,000 numbers, its shapes have 12 million."""


def search_paths(gender: str = "neutral") -> list[Path]:
    """Returns the files that are tried, in this order, when no body model is named.

    They are in the file or folder of the environment variable `BODYSLAM_BODY_MODEL`,
    then in the user's data folder. If none exists, the package's body is used.

    **Raises:** `InputError` for an unknown gender.
    """
    return [path for location in _locations() for path in candidates(location, gender)]


def load_body_model(
    path: str | Path | None = None, gender: str | None = None, dtype=None
) -> BodyModel:
    """Reads a body model; without a path the first that `search_paths` finds, or the
    package's free body.

    **Arguments:**

    - `path`: a file (SMPL, SMPL-H, SMPL-X; `.pkl` or `.npz`) or a folder with standard
        file names.
    - `gender`: `neutral`, `female` or `male`, which selects the file of a folder and
        must not contradict the name of a file. Without it, the neutral file is taken.
    - `dtype`: type of the arrays; by default that of JAX.

    **Raises:** `InputError`, with the paths that were tried if there is no file, or
    with what is wrong in the file.
    """
    file = _find(path, gender)
    model = _assemble(file, checked(file, read_arrays(file)))
    dtype = jnp.result_type(float) if dtype is None else jnp.dtype(dtype)
    cast = lambda x: jnp.asarray(x, dtype if x.dtype.kind == "f" else jnp.int32)
    arrays = {name: cast(x) for name, x in model.items() if isinstance(x, np.ndarray)}
    return BodyModel(**{**model, **arrays})


def check(path: str | Path, gender: str | None = None) -> str:
    """Describes a body model file in one line: kind of model, size and stature.

    The arguments are those of `load_body_model`.

    **Raises:** `InputError`, one line, if it is not usable as a body model.
    """
    file = _find(path, gender)
    raw = checked(file, read_arrays(file))
    num_vertices, num_joints = raw["weights"].shape
    stature = np.ptp(raw["v_template"][:, 1])
    kind = "the default body" if file == DEFAULT else KIND_BY_JOINTS[num_joints].upper()
    return (
        f"{file}: {kind}, {num_vertices} vertices, {len(raw['f'])} faces, "
        f"{num_joints} joints, {raw['shapedirs'].shape[2]} shape components, "
        f"{raw['posedirs'].shape[2]} pose blend shapes, {stature:.2f} m tall."
    )


def write_npz(model: BodyModel, path: str | Path) -> None:
    """Writes a body model in SMPL's layout of 24 joints, which other tools can read.

    Missing pose blend shapes are written as zeros. The file is written atomically.

    **Raises:** `InputError` if the suffix of the path is not `.npz`; `OSError`, naming
    the path, if the file cannot be written.
    """
    path = Path(path)
    if path.suffix != ".npz":
        raise InputError(f"{path}: suffix {path.suffix!r}, expected '.npz'.")
    v = model.num_vertices
    weights = np.zeros((v, 24), np.asarray(model.skin_weight).dtype)
    rows = np.arange(v)[:, None]
    np.add.at(weights, (rows, np.asarray(model.skin_joint)), model.skin_weight)
    pose_dirs = np.zeros((v, 3, 207), weights.dtype)
    pose_dirs[:, :, : model.pose_dirs.shape[2]] = model.pose_dirs
    parents = np.array([2**32 - 1, *PARENTS[1:]], np.uint32)
    picks = dict(zip(SURFACE_POINTS, np.asarray(model.picks).tolist(), strict=True))
    arrays = {
        "v_template": np.asarray(model.template),
        "shapedirs": np.asarray(model.shape_dirs),
        "posedirs": pose_dirs,
        "J_regressor": np.asarray(model.joint_regressor),
        "J": np.asarray(model.joint_template),
        "weights": weights,
        "kintree_table": np.stack([parents, np.arange(24, dtype=np.uint32)]),
        "f": np.asarray(model.faces).astype(np.uint32),
        "joint_names": np.array(JOINT_NAMES),
        "header": np.array(json.dumps({"name": model.name, "keypoints": picks})),
    }
    atomic.write_npz(path, arrays)


def read_arrays(file: Path) -> dict[str, np.ndarray]:
    """Reads the arrays of a `.npz` or a pickle, recognised by content, without checks.

    **Raises:** `InputError` if the file is neither.
    """
    if file.suffix != ".npz" and not is_zip(file):
        return read_pickle(file)
    archive = read_npz(file, "a body model (.npz)")
    # Files of SMPL-X also contain objects, which are not needed.
    plain = [n for n in archive.names if archive.header(n)[1].kind in "biufSU"]
    return {name: archive.raw(name) for name in plain}


def _locations() -> list[Path]:
    """Returns the files and folders that are searched when no body model is named."""
    locations = (
        [Path(os.environ[PATH_VARIABLE])] if os.environ.get(PATH_VARIABLE) else []
    )
    home = os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share"
    return [*locations, Path(home) / "bodyslam" / "body_models"]


def candidates(location: Path, gender: str) -> list[Path]:
    """Returns the files of one gender that `location`, a file or folder, may refer to.

    **Raises:** `InputError` for an unknown gender.
    """
    if gender not in _GENDERS:
        raise InputError(f"gender {gender!r}, expected neutral, female or male.")
    if location.suffix in (".npz", ".pkl") or location.is_file():
        return [location]
    short = gender if gender == "neutral" else gender[0]
    names = [n.format(G=gender.upper(), g=short, gender=gender) for n in _FILE_NAMES]
    return [location / name for name in names]


def _find(path: str | Path | None, gender: str | None) -> Path:
    """Returns the body model file of `load_body_model`.

    **Raises:** `InputError` if there is none, or its name contradicts `gender`.
    """
    wanted = gender or "neutral"
    locations = _locations() if path is None else [Path(path)]
    is_set = path is None and bool(os.environ.get(PATH_VARIABLE))
    note = f" ({PATH_VARIABLE} is set)" if is_set else ""
    for candidate in (
        file for location in locations for file in candidates(location, wanted)
    ):
        if candidate.is_file():
            of = named_gender(candidate)
            if gender and of not in (gender, None):
                raise InputError(
                    f"{candidate}{note}: by its name a {of} body, expected {gender}."
                )
            return candidate
    if path is None and wanted == "neutral" and not is_set:
        return DEFAULT
    tried = ", ".join(_tried(location, wanted) for location in locations)
    raise InputError(f"No {wanted} body model found{note}; tried {tried}.")


def named_gender(file: Path) -> str | None:
    """Returns the gender in the name of a file; `None` without one.

    Examples are `SMPL_FEMALE.npz`, `basicModel_f_lbs_...pkl` and `female/model.npz`.
    """
    name = (file.parent.name if file.stem == "model" else file.stem).lower()
    words = re.split(r"[^a-z]+", name)
    found = {g for g in _GENDERS if g in words or g[0] in words}
    return found.pop() if len(found) == 1 else None


def _tried(location: Path, gender: str) -> str:
    """Describes a searched location in an error message."""
    files = candidates(location, gender)
    if files == [location]:
        return str(location)
    names = ", ".join(str(file.relative_to(location)) for file in files[:2])
    return f"{location} ({names}, ...)"


def _assemble(file: Path, raw: dict[str, np.ndarray]) -> dict:
    """Returns the fields of a `BodyModel` with 24 joints, with arrays in float64."""
    template, weights, regressor = raw["v_template"], raw["weights"], raw["J_regressor"]
    shape_dirs, pose_dirs = raw["shapedirs"][:, :, :10], raw["posedirs"]
    num_joints = weights.shape[1]
    if num_joints > 24:
        parents = raw["parents"]
        merged = np.zeros((len(template), 24))
        for j in range(num_joints):
            body_joint = j
            while body_joint >= 22:
                body_joint = parents[body_joint]
            merged[:, body_joint] += weights[:, j]
        # SMPL's hand joint is the base of the middle finger, the fourth of the 15
        # joints of each hand.
        first = num_joints - 30
        rows = [*range(22), first + 3, first + 18]
        weights, regressor = merged, regressor[rows]
        pose_dirs = pose_dirs[:, :, : 9 * 21]
    joint, weight = sparse_rows(weights / weights.sum(1, keepdims=True))
    return {
        "template": template,
        "shape_dirs": shape_dirs,
        "pose_dirs": pose_dirs if pose_dirs.any() else pose_dirs[:, :, :0],
        "joint_template": regressor @ template,
        "joint_shape_dirs": np.einsum("jv,vcs->jcs", regressor, shape_dirs),
        "joint_regressor": regressor,
        "skin_joint": joint,
        "skin_weight": weight,
        "faces": raw["f"],
        "blocks": runs_of_vertices(weights),
        "picks": raw["picks"] if "picks" in raw else _picks(template, regressor),
        "name": file.stem,
        "kind": "default" if file == DEFAULT else KIND_BY_JOINTS[num_joints],
    }


def _picks(template: np.ndarray, regressor: np.ndarray) -> np.ndarray:
    """Returns the vertices of `SURFACE_POINTS` in a mesh whose file does not name
    them."""
    top = int(template[:, 1].argmax())
    if len(template) in _PICKS_BY_MESH_SIZE:
        return np.array([*_PICKS_BY_MESH_SIZE[len(template)], top])
    # For an unknown mesh, the nearest vertices to the default body's points are taken,
    # relative to head and ankles and scaled by stature.
    default = load_body_model(DEFAULT)
    joints, picks = np.asarray(default.joint_template), np.asarray(default.picks)
    points = np.asarray(default.template)[picks]
    own_joints = regressor @ template
    size = np.ptp(template[:, 1]) / np.ptp(np.asarray(default.template)[:, 1])
    anchor = [ANKLES[0] if "left" in n else ANKLES[1] for n in SURFACE_POINTS]
    is_foot = [n.endswith(("toe", "heel")) for n in SURFACE_POINTS]
    anchor = np.where(is_foot, anchor, HEAD)
    target = own_joints[anchor] + size * (points - joints[anchor])
    near = np.linalg.norm(template[None] - target[:, None], axis=-1).argmin(1)
    return np.append(near[:-1], top)


def read_pickle(path: Path) -> dict[str, np.ndarray]:
    """Reads the arrays of a pickled dictionary, by name; other values are skipped.

    **Raises:** `InputError`, one line that names the file, if it is not a pickle of a
    dictionary, is truncated, or contains anything but plain data.
    """
    content = restricted_load(path, stand_ins=_LIBRARIES)
    if not isinstance(content, dict):
        found = type(content).__name__
        raise InputError(f"{path}: holds a {found}, expected a dictionary of arrays.")
    expressions = _Expressions()
    try:
        arrays = {str(k): expressions.array(value) for k, value in content.items()}
    except Exception as error:  # a damaged state can fail anywhere, with any error
        what = " ".join(f"{type(error).__name__}: {error}".split())[:120]
        raise InputError(
            f"{path}: a damaged pickle ({what}), expected arrays of a body model."
        ) from None
    return {key: value for key, value in arrays.items() if value is not None}


class _Expressions:
    """Evaluates chumpy objects and sparse matrices to arrays, each of them once."""

    def __init__(self) -> None:
        self.found: dict[tuple[int, int], np.ndarray | None] = {}
        """Results by identity of a stand-in and depth of the expression."""
        self.left = _MAX_NUMBERS
        """How many numbers may still be expanded."""

    def array(self, value: Any, depth: int = 0) -> np.ndarray | None:
        """Evaluates an array, a chumpy object or a sparse matrix; else returns
        `None`."""
        if isinstance(value, np.ndarray):
            return value
        if not isinstance(value, StandIn) or not isinstance(value.state, dict):
            return None
        if (id(value), depth) not in self.found:
            self.found[id(value), depth] = self._evaluated(value, value.state, depth)
        return self.found[id(value), depth]

    def _evaluated(self, value: StandIn, state: dict, depth: int) -> np.ndarray | None:
        """Evaluates one object from its state, without the results in `found`."""
        if "indptr" in state:
            return self._dense(state, value.name.rpartition(".")[2].startswith("csr"))
        if depth > _MAX_DEPTH:
            return None
        if "idxs" in state and "a" in state:  # chumpy.reordering.Select
            return self._selected(state, depth)
        for key in ("x", "a", *state):
            found = self.array(state.get(key), depth + 1)
            if found is not None:
                return found
        return None

    def _selected(self, state: dict, depth: int) -> np.ndarray | None:
        """Evaluates chumpy's selection of entries of another expression."""
        source, index = self.array(state["a"], depth + 1), np.asarray(state["idxs"])
        if source is None or index.dtype.kind not in "iu":
            return None
        self._spend(index.size)
        shape = state.get("preferred_shape", index.shape)
        return source.ravel()[index.ravel()].reshape(shape)

    def _dense(self, state: dict, by_row: bool) -> np.ndarray | None:
        """Converts a compressed sparse matrix (SciPy's csc or csr) to a dense one."""
        shape = state.get("_shape", state.get("shape"))
        parts = [state.get(name) for name in ("data", "indices", "indptr")]
        if shape is None or not all(isinstance(part, np.ndarray) for part in parts):
            return None
        data, indices, indptr = (np.asarray(part) for part in parts)
        rows, columns = (int(x) for x in shape)
        if rows < 0 or columns < 0 or any(x.ndim != 1 for x in (data, indices, indptr)):
            raise ValueError(f"a sparse matrix of shape {(rows, columns)}")
        self._spend(rows * columns)
        counts = np.diff(indptr.astype(np.int64))
        outside = indices.size and not (
            0 <= indices.min() and indices.max() < (columns if by_row else rows)
        )
        length = rows if by_row else columns
        if (
            outside
            or len(counts) != length
            or (counts < 0).any()
            or not len(indices) == len(data) == counts.sum()
        ):
            raise ValueError("a sparse matrix that contradicts its own index")
        outer = np.repeat(np.arange(len(counts)), counts)
        dense = np.zeros((rows, columns), data.dtype)
        dense[(outer, indices) if by_row else (indices, outer)] = data
        return dense

    def _spend(self, numbers: int) -> None:
        """**Raises:** `ValueError` if all expansions exceed `_MAX_NUMBERS`."""
        self.left -= numbers
        if self.left < 0:
            raise ValueError(f"expressions of more than {_MAX_NUMBERS} numbers")
