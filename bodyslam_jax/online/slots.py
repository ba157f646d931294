"""Frames at the rate of the window, and the queue of those that wait for it.

The window has a frame every `step` seconds, a *slot*. It contains the frame of the
video that comes first within half a step of it; others lie between slots. A slot
without a frame is empty, and its camera is interpolated if the gap is short.
"""

import dataclasses
import math

import numpy as np
from jaxtyping import Float

from bodyslam_jax.graph import CHUNK
from bodyslam_jax.online.window_content import FRAMES, Measured, between

_ROUNDING = 1e-3
"""Share of a step within which a frame is halfway between two slots."""
_MAX_GAP_SLOTS = 2
"""Longest gap whose slots count as located, in slots."""


class Slots:
    """The slots of one map."""

    def __init__(self, step: float, origin: float = 0.0) -> None:
        """**Arguments:** `step`: time between slots, s; `origin`: time of a slot, s,
        the same for all maps."""
        self.step, self.origin = step, origin
        self.waiting: list[tuple[int, Measured]] = []
        self.front: dict[int, Float[np.ndarray, "4 4"]] = {}
        """First poses of slots that the window has not left, in the map as it is now.
        """
        self.next = self.first = 0
        """Number of the next slot; and of the map's first one by the clock."""

    def take(self, frame: Measured) -> tuple[int, Float[np.ndarray, "4 4"], float]:
        """Adds the next frame of the video.

        **Returns:** the last slot, the pose of the frame's camera relative to that of
        the slot (map units), and the duration of a long gap before it, else 0 (s).
        """
        if self.next == 0:
            self.first = self.number(frame.time)
        slot = self.number(frame.time) - self.first
        gap, stood = slot - self.next, 0.0
        if gap > 2 * FRAMES:  # The source stood still: time goes on from here.
            stood = gap * self.step
            self.first += gap - FRAMES
            slot -= gap - FRAMES
        if 0 < slot - self.next <= _MAX_GAP_SLOTS and frame.located:
            # Frames that the source, or a slow machine, left out.
            ends = np.array([self.next - 1, slot])
            poses = np.array([self.front[self.next - 1], frame.T_WC])
            for k in range(self.next, slot):
                pose = between(ends, poses, np.array([k]))[0]
                missing = self._empty(pose)
                self._put(dataclasses.replace(missing, located=True))
        while self.next < slot:
            self._put(self._empty(frame.T_WC))
        if slot == self.next:
            self._put(frame)
        last = self.next - 1
        return last, np.linalg.inv(self.front[last]) @ frame.T_WC, stood

    def number(self, time: float) -> int:
        """Returns the number of the slot that is nearest to a time (s), counted from
        the origin; a frame halfway between two is of the earlier one."""
        return math.floor((time - self.origin) / self.step + 0.5 - _ROUNDING)

    def fill(self, T_WC: Float[np.ndarray, "4 4"]) -> None:
        """Adds empty slots, up to whole chunks."""
        while len(self.waiting) % CHUNK:
            self._put(self._empty(T_WC))

    def pop(self, count: int) -> list[tuple[int, Measured]]:
        """Removes and returns the oldest waiting frames, with their poses in the
        current map, which may have been corrected since they were added."""
        found = [
            (slot, dataclasses.replace(frame, T_WC=self.front[slot]))
            for slot, frame in self.waiting[:count]
        ]
        del self.waiting[:count]
        return found

    def move(self, move: Float[np.ndarray, "4 4"]) -> None:
        """Moves all frames after a transform of the whole map."""
        self.front = {slot: move @ T for slot, T in self.front.items()}

    def forget(self, first: int) -> None:
        """Drops the first poses of slots before this one."""
        self.front = {slot: T for slot, T in self.front.items() if slot >= first}

    def _empty(self, T_WC: Float[np.ndarray, "4 4"]) -> Measured:
        """Returns the next slot without a frame."""
        none = np.zeros(0, int), np.zeros((0, 2))
        at = self.origin + (self.first + self.next) * self.step
        return Measured(at, T_WC, False, *none, {})

    def _put(self, measured: Measured) -> None:
        self.front[self.next] = measured.T_WC
        self.waiting.append((self.next, measured))
        self.next += 1
