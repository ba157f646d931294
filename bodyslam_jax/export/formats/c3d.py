"""Writes C3D (C3D.org, user guide): one person's joint centres as points, mm.

Numbers are little-endian; a file consists of a header, groups of parameters, and four
floats for each frame and point: x, y, z and a residual, which is -1 where the point is
missing.
"""

import math
import struct
from pathlib import Path
from typing import Any

import numpy as np

from bodyslam_jax.body import JOINT_NAMES
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.export.formats.scene import Scene, at_constant_rate

_BLOCK_BYTES = 512
"""Size of a block (the C3D file format, section "Basic structure")."""
_PARAMETER_KEY, _INTEL_PROCESSOR = 0x50, 84
"""The format's marks of a parameter section, and of numbers of Intel's order."""
_MAX_FRAMES = 65535
"""Number of frames that the header's 16 bits can count."""
_CHAR, _INT, _FLOAT = -1, 2, 4
"""Types of parameters."""


def write(path: Path, scene: Scene) -> None:
    """Writes the only person of a scene; absent frames are missing points.

    **Raises:** `InputError` if there are more frames than the format can count.
    """
    scene = at_constant_rate(scene)
    result = scene.result
    num, rate = len(result.timestamps), result.fps
    if num > _MAX_FRAMES:
        raise InputError(f"--to c3d: {num} frames, expected at most {_MAX_FRAMES}.")
    points = np.zeros((num, 24, 4), "<f4")
    points[..., :3] = 1000 * result.joints[0]
    points[~result.present[0]] = [0, 0, 0, -1]
    # The parameters contain the start of the data, which depends on their own length.
    blocks = math.ceil(len(_parameters(num, rate, scene.up, 0)) / _BLOCK_BYTES)
    parameters = _parameters(num, rate, scene.up, 2 + blocks)
    parameters = parameters[:2] + bytes([blocks]) + parameters[3:]
    parameters += b"\0" * (blocks * _BLOCK_BYTES - len(parameters))
    header = struct.pack(
        "<BBHHHHHfHHf",
        *(2, _PARAMETER_KEY, 24, 0, 1, num, 10, -1.0, 2 + blocks, 0, rate),
    )
    data = points.tobytes()
    with path.open("wb") as file:
        file.write(header.ljust(_BLOCK_BYTES, b"\0"))
        file.write(parameters)
        file.write(data + b"\0" * (-len(data) % _BLOCK_BYTES))


def _parameters(num: int, rate: float, up: str, data_start: int) -> bytes:
    # Counts above 32767 are written as the same bits: readers take them as unsigned.
    count = num - 65536 if num > 32767 else num
    groups = {
        "POINT": [
            ("USED", _INT, 24),
            ("SCALE", _FLOAT, -1.0),
            ("RATE", _FLOAT, rate),
            ("DATA_START", _INT, data_start),
            ("FRAMES", _INT, count),
            ("LABELS", _CHAR, list(JOINT_NAMES)),
            ("DESCRIPTIONS", _CHAR, [f"joint centre {n}" for n in JOINT_NAMES]),
            ("UNITS", _CHAR, "mm"),
            ("X_SCREEN", _CHAR, "+X"),
            ("Y_SCREEN", _CHAR, f"+{up.upper()}"),
        ],
        "ANALOG": [
            ("USED", _INT, 0),
            ("GEN_SCALE", _FLOAT, 1.0),
            ("RATE", _FLOAT, 0.0),
        ],
        "FORCE_PLATFORM": [("USED", _INT, 0)],
        "TRIAL": [
            ("ACTUAL_START_FIELD", _INT, [1, 0]),
            ("ACTUAL_END_FIELD", _INT, [count, 0]),
            ("CAMERA_RATE", _FLOAT, rate),
        ],
    }
    found = bytearray([1, _PARAMETER_KEY, 0, _INTEL_PROCESSOR])
    for number, (name, rows) in enumerate(groups.items(), 1):
        found += _entry(name, -number, b"")
        for key, kind, value in rows:
            found += _entry(key, number, _value(kind, value))
    return bytes(found + b"\0\0")


def _entry(name: str, group: int, data: bytes) -> bytes:
    """Returns a group (negative number) or a parameter, without a description."""
    rest = data + b"\0"
    head = struct.pack("<bb", len(name), group) + name.encode()
    return head + struct.pack("<h", len(rest) + 2) + rest


def _value(kind: int, value: Any) -> bytes:
    """Returns type, dimensions and values of a parameter: a text, texts or numbers."""
    if kind == _CHAR:
        words = [value] if isinstance(value, str) else list(value)
        width = max(map(len, words))
        shape = [width] if isinstance(value, str) else [width, len(words)]
        data = "".join(word.ljust(width) for word in words).encode()
    else:
        array = np.asarray(value, {_INT: "<i2", _FLOAT: "<f4"}[kind])
        shape, data = list(array.shape), array.tobytes()
    return struct.pack("<bB", kind, len(shape)) + bytes(shape) + data
