"""Refuses problems that do not fit into memory, before the solver is started."""

import os
from pathlib import Path

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.geometry.lengths import LENGTHS
from bodyslam_jax.graph.layout import Layout
from bodyslam_jax.graph.ordering import CHUNK
from bodyslam_jax.graph.state import State

_CGROUP_LIMIT_FILES = (
    "/sys/fs/cgroup/memory.max",
    "/sys/fs/cgroup/memory/memory.limit_in_bytes",
)
"""Memory limit of a container (cgroup v2, v1); `max`, or a huge number, without."""


def memory() -> int:
    """Returns the bytes of memory of this machine, or of its container's limit."""
    found = [os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")]
    for name in _CGROUP_LIMIT_FILES:
        try:
            found.append(int(Path(name).read_text()))
        except (OSError, ValueError):
            continue
    return min(found)


def memory_needed(layout: Layout, state: State, pose: int) -> int:
    """Estimates the bytes of the solver's tables for postures of `pose` coordinates."""
    item = state.scale.dtype.itemsize
    people = len(state.roots)
    person = pose + 12  # what remains of a chunk: a posture and two roots
    front = CHUNK * 6 * layout.bandwidth + people * (layout.reach * person + 10) + 16
    front += 3 * layout.lasting
    pivot = 6 * CHUNK + people * person
    window = 2 * person + 6 * CHUNK + 24
    postures = CHUNK * 4 * pose * (2 * pose + 6 * CHUNK + 12)
    chunk = 3 * pivot * front + people * (window**2 + postures)
    tables = sum(40 * bucket.row.size for bucket in layout.buckets)
    return item * (chunk * layout.num_chunks + tables)


def check_memory(layout: Layout, state: State, pose: int) -> None:
    """Refuses a problem that does not fit; memory grows linearly with frames.

    **Raises:** `InputError` with the number of frames that fit.
    """
    need, have = memory_needed(layout, state, pose), memory()
    if need > have:
        most = int(layout.num_chunks * CHUNK * have / need)
        fit = max((x for x in LENGTHS if x <= most), default=most)
        raise InputError(
            f"{len(state.cameras)} frames need about {need / 2**30:.1f} GiB, found "
            f"{have / 2**30:.1f} GiB: about {fit} frames fit. The memory of bodyslam "
            "live VIDEO --every-frame does not grow with frames."
        )
