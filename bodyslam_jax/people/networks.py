"""Opens the networks of the package as sessions of onnxruntime.

MoveNet MultiPose finds people and their 17 COCO keypoints in an image; BlazePose GHUM
adds heels, toes and a mask for one person at a time, and its heavy variant the wrists
of which MoveNet is not sure. `assets/networks/MODEL_CARD.md` states their origin and
licence.
"""

import dataclasses
import hashlib
import importlib
import os
from pathlib import Path
from typing import Any

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io.files import read_bytes

_FOLDER = Path(__file__).parent / "assets" / "networks"
_MAX_THREADS = 4
"""Number of threads above which networks of this size do not become faster."""


@dataclasses.dataclass(frozen=True)
class Network:
    """A network file of the package."""

    name: str
    sha256: str

    @property
    def path(self) -> Path:
        """Path of the file."""
        return _FOLDER / self.name


MOVENET = Network(
    "movenet_multipose.onnx",
    "20c7312bb9e30103d50077c6e7680e26411f07a9469db8b2bbb565f120eea817",
)
BLAZEPOSE = Network(
    "blazepose_full.onnx",
    "1f23f73d0cd62553051863e68309dd0c566fa20d43ae2821236c371d1fadf829",
)
BLAZEPOSE_HEAVY = Network(
    "blazepose_heavy.onnx",
    "f825d769b6c5b8be97f0c85c47fd7ffcff8c807088bf77fb6d361aef2772cab2",
)
NETWORKS = (MOVENET, BLAZEPOSE, BLAZEPOSE_HEAVY)


def open_network(network: Network, *, spared_cores: int = 0) -> Any:
    """Opens a session of one of the package's networks, after comparing its checksum.

    It uses the processor cores that this process may use, except `spared_cores`, at
    least one and at most four, and none while it waits.

    **Raises:** `InputError` if the file is missing or is not the one that was shipped,
    or onnxruntime is not installed.
    """
    check_onnxruntime()
    check_network(network)
    return make_session(network.path, spared_cores=spared_cores)


def check_network(network: Network) -> None:
    """Compares the checksum of a network's file.

    **Raises:** `InputError` if the file is missing or its checksum differs.
    """
    advice = "install bodyslam-jax again, or give keypoints/"
    try:
        digest = hashlib.sha256(read_bytes(network.path)).hexdigest()
    except InputError as error:
        raise InputError(
            f"{str(error).rstrip('.')}, the network that finds people: {advice}."
        ) from error
    if digest != network.sha256:
        raise InputError(
            f"{network.path}: SHA-256 {digest[:12]}..., expected "
            f"{network.sha256[:12]}...: {advice}."
        )


def network_status() -> list[tuple[str, str]]:
    """Returns lines of (name, finding), one for each network of the package."""
    rows = []
    for network in NETWORKS:
        try:
            open_network(network)
        except ValueError as error:
            rows.append((network.name, str(error)))
        else:
            rows.append((network.name, "runs; SHA-256 as shipped"))
    return rows


def make_session(path: Path, *, spared_cores: int = 0) -> Any:
    """Opens an onnxruntime session of an ONNX file on the CPU; for `spared_cores` see
    `open_network`.

    **Raises:** `InputError` if onnxruntime is missing or does not read the file.
    """
    onnxruntime = check_onnxruntime()
    options = onnxruntime.SessionOptions()
    cores = max(1, _available_cores() - spared_cores)
    options.intra_op_num_threads = min(cores, _MAX_THREADS)
    options.inter_op_num_threads = 1
    # Threads that wait in a busy loop would occupy the cores.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 3
    try:
        return onnxruntime.InferenceSession(
            str(path), options, providers=["CPUExecutionProvider"]
        )
    except Exception as error:  # onnxruntime's own errors have no common public base
        raise InputError(
            f"{path}: not a model that onnxruntime reads ({error})."
        ) from error


def check_onnxruntime() -> Any:
    """Returns the module onnxruntime.

    **Raises:** `InputError` if it is not installed.
    """
    try:
        return importlib.import_module("onnxruntime")
    except ImportError as error:
        raise InputError(
            "detect: onnxruntime is not installed; `pip install onnxruntime`, or give "
            "keypoints/ instead."
        ) from error


def _available_cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
