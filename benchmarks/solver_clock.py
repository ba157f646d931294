"""Seconds, on the wall and of the processor, of things that are run several times."""

import time

import jax
import numpy as np


def timed(run, repeats):
    """Result; wall and processor seconds of the first call (with compilation), and
    medians of `repeats` more."""
    rows = []
    for _ in range(1 + repeats):
        wall, cpu = time.perf_counter(), time.process_time()
        result = jax.block_until_ready(run())
        rows.append((time.perf_counter() - wall, time.process_time() - cpu))
    return result, rows[0], np.median(rows[1:], axis=0)


def reached(costs, goal):
    """How many steps until a cost is at most `goal`; `None` if none is."""
    below = np.flatnonzero(np.asarray(costs) <= goal)
    return int(below[0]) if len(below) else None
