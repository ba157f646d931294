"""The status of people as a run's summary reports it, for pictures and files."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Bool

from bodyslam_jax.body import PARENTS
from bodyslam_jax.types import Result

_INFERRED = 0.13
"""m: expected error from which a joint was hidden, not measured. Measured knees and
ankles err by 7 to 11 cm, hidden ones by 16 to 21 (`measured.joint_sigma`)."""


@dataclasses.dataclass(frozen=True)
class ReportedStatus:
    """Of one person."""

    status: str
    """`ok`, `doubtful`, `not_measurable` or `absent`; empty where none was reported."""
    reasons: tuple[str, ...] = ()
    """Why it is not `ok`: sentences, without the person's number."""

    @property
    def measurable(self) -> bool:
        """Whether lengths, speeds and places of the person are measurements."""
        return self.status != "not_measurable"

    @property
    def words(self) -> str:
        """The status as it is written beside a name; empty if it is `ok`."""
        return "" if self.status in ("", "ok") else self.status.replace("_", " ")

    def named(self, number: int) -> str:
        """The person's name, with the status if it is not `ok`."""
        return f"person {number}" + (f", {self.words}" if self.words else "")


def reported_status(summary: Mapping[str, Any], person: int) -> ReportedStatus:
    """A person's status in `summary.json`."""
    entries = (summary.get("people") or [])[person : person + 1]
    if not entries:
        return ReportedStatus("")
    prefix = f"person {person}: "
    reasons = (str(reason) for reason in entries[0].get("reasons") or [])
    return ReportedStatus(
        str(entries[0].get("status") or ""),
        tuple(reason.removeprefix(prefix) for reason in reasons),
    )


def inferred_bones(result: Result) -> Bool[np.ndarray, "h t 24"]:
    """Bones, by the joint that turns them, with an end that was hidden in the video or
    out of the image, so that their place is inferred. None for a truth."""
    if result.joint_sigma is None:
        return np.zeros(result.joints.shape[:3], bool)
    joint = result.joint_sigma > _INFERRED
    bone = joint.copy()
    for child, parent in enumerate(PARENTS):
        if parent >= 0:
            bone[..., parent] |= joint[..., child]
    return bone & result.present[..., None]
