"""Frames at the rate of the window, and those of them that wait for it.

The window has a frame every `step` seconds, a *slot*. The frame of the video that is
nearest to its time is in it; others lie between slots. A slot that no frame came for is
empty, and its camera is between others if the gap is short.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from bodyslam_jax.graph import CHUNK
from bodyslam_jax.online.window_content import FRAMES, Measured, between

_BRIDGED = 2
"""Most slots in a row that are taken for located without an image."""


class Slots:
    """The slots of one map."""

    def __init__(self, step: float) -> None:
        """**Arguments:** `step` between slots, s."""
        self.step = step
        self.waiting: list[tuple[int, Measured]] = []
        self.front: dict[int, Float[np.ndarray, "4 4"]] = {}
        """First poses of slots that the window has not left, in the map as it is now.
        """
        self.next, self.first_time = 0, 0.0

    def take(self, frame: Measured) -> tuple[int, Float[np.ndarray, "4 4"], float]:
        """Takes the next frame of the video in.

        **Returns:** the last slot, the camera of the frame from that of the slot (map
        units), and for how long no frame came where that was long, else 0 (s).
        """
        if self.next == 0:
            self.first_time = frame.time
        slot = round((frame.time - self.first_time) / self.step)
        gap, stood = slot - self.next, 0.0
        if gap > 2 * FRAMES:  # The source stood still: time goes on from here.
            stood = gap * self.step
            self.first_time += (gap - FRAMES) * self.step
            slot -= gap - FRAMES
        if 0 < slot - self.next <= _BRIDGED and frame.located:
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

    def fill(self, T_WC: Float[np.ndarray, "4 4"]) -> None:
        """Adds empty slots, up to whole chunks."""
        while len(self.waiting) % CHUNK:
            self._put(self._empty(T_WC))

    def pop(self, count: int) -> list[tuple[int, Measured]]:
        """The oldest that wait, with poses in the map as it is now: it may have been
        corrected since they came."""
        found = [
            (slot, dataclasses.replace(frame, T_WC=self.front[slot]))
            for slot, frame in self.waiting[:count]
        ]
        del self.waiting[:count]
        return found

    def move(self, move: Float[np.ndarray, "4 4"]) -> None:
        """The map was moved as a whole."""
        self.front = {slot: move @ T for slot, T in self.front.items()}

    def forget(self, first: int) -> None:
        """Drops first poses of slots before this one."""
        self.front = {slot: T for slot, T in self.front.items() if slot >= first}

    def _empty(self, T_WC: Float[np.ndarray, "4 4"]) -> Measured:
        """The next slot without a frame."""
        none = np.zeros(0, int), np.zeros((0, 2))
        at = self.first_time + self.next * self.step
        return Measured(at, T_WC, False, *none, {})

    def _put(self, measured: Measured) -> None:
        self.front[self.next] = measured.T_WC
        self.waiting.append((self.next, measured))
        self.next += 1
