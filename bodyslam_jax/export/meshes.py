"""Static meshes."""

from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float, Int

from bodyslam_jax.config.errors import InputError


def write_mesh(
    path: Path, vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> None:
    """Writes one mesh, m; the suffix is `.glb`, `.obj`, `.ply` or `.stl`."""
    suffixes = (".glb", ".obj", ".ply", ".stl")
    if path.suffix.lower() not in suffixes:
        raise InputError(f"{path}: suffix {path.suffix!r}, not one of {suffixes}.")
    trimesh.Trimesh(vertices, faces, process=False).export(path)
