"""Limits of what is opened, whatever its kind."""

import dataclasses

from bodyslam_jax.config.check import check

_GIGABYTE = 1_000_000_000


@dataclasses.dataclass(frozen=True)
class Limits:
    """How much one input may ask for; what exceeds it is refused before it is read."""

    input_gigabytes: float = 1.0
    """Size of a file, and of what it expands to, GB. Videos are exempt: they are read
    frame by frame."""
    frames: int = 100_000
    """Number of frames where no video tells it, and only the numbers in a file do."""

    def __post_init__(self) -> None:
        check(self, {"input_gigabytes": (0.001, 1000.0), "frames": (1, 100_000_000)})

    @property
    def bytes(self) -> int:
        """`input_gigabytes` in bytes."""
        return round(self.input_gigabytes * _GIGABYTE)
