"""The status of people as a run's summary reports it, for pictures and files."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Bool

from bodyslam_jax.body import PARENTS
from bodyslam_jax.types import Result

_MIN_INFERRED_SIGMA_M = 0.13
"""Expected error from which a joint counts as hidden, not measured, m. Measured knees
and ankles err by 7 to 11 cm, hidden ones by 16 to 21 cm (`measured.joint_sigma`)."""


@dataclasses.dataclass(frozen=True)
class ReportedStatus:
    """Status of one person and the reasons for it, as `summary.json` reports them."""

    status: str
    """`ok`, `doubtful`, `not_measurable` or `absent`; empty where none was reported."""
    reasons: tuple[str, ...] = ()
    """Sentences that say why the status is not `ok`, without the person's number."""

    @property
    def measurable(self) -> bool:
        """Whether lengths, speeds and positions of the person are measurements."""
        return self.status != "not_measurable"

    @property
    def words(self) -> str:
        """The status as text to print beside the person's name; empty if it is `ok`."""
        return "" if self.status in ("", "ok") else self.status.replace("_", " ")

    def named(self, number: int) -> str:
        """Returns the person's name, followed by the status if that is not `ok`."""
        return f"person {number}" + (f", {self.words}" if self.words else "")


def reported_status(summary: Mapping[str, Any], person: int) -> ReportedStatus:
    """Returns the status of a person as reported in `summary.json`; an empty status if
    the summary has no entry for that person."""
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
    """Returns which bones are inferred: an end of theirs was hidden in the video or
    outside the image.

    Bones are indexed by the joint that rotates them. All are False for ground truth,
    which has no `joint_sigma`.
    """
    if result.joint_sigma is None:
        return np.zeros(result.joints.shape[:3], bool)
    joint = result.joint_sigma > _MIN_INFERRED_SIGMA_M
    bone = joint.copy()
    for child, parent in enumerate(PARENTS):
        if parent >= 0:
            bone[..., parent] |= joint[..., child]
    return bone & result.present[..., None]
