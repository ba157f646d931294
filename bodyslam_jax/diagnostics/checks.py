"""Rules by which a result is doubted: checks of figures, reasons, and the status.

A result is `failed` if a reason is fatal, `doubtful` if there is any reason, else `ok`.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

Status = Literal["ok", "doubtful", "failed"]


@dataclasses.dataclass(frozen=True)
class Check:
    """A figure and the threshold beyond which it makes a result doubtful."""

    name: str
    what: str
    """The figure as the subject of a sentence."""
    unit: str
    limit: float
    advice: str
    """Advice to the user if the check fails."""
    source: str
    """Source of the threshold."""
    below: bool = False
    """Whether the limit is a lower bound."""

    def fails(self, figure: float) -> bool:
        """Returns whether the figure is beyond the limit; False for NaN."""
        return figure < self.limit if self.below else figure > self.limit


@dataclasses.dataclass(frozen=True)
class Reason:
    """A reason why a result is doubtful or failed: an entry of `reasons` in
    `summary.json`."""

    name: str
    message: str
    """A sentence with the figure and what was expected."""
    expected: str
    advice: str
    figure: float | None = None
    unit: str = ""
    person: int | None = None
    frames: tuple[int, int] | None = None
    """The first and the last frame to look at."""
    seconds: tuple[float, float] | None = None
    """Times of these frames, s from the first frame of the video."""
    fatal: bool = False
    """Whether the result as a whole is unusable."""

    def to_dict(self) -> dict[str, Any]:
        """Returns the entry as written; fields that do not apply are left out."""
        plain = dataclasses.asdict(self)
        plain["status"] = "failed" if plain.pop("fatal") else "doubtful"
        return {k: v for k, v in plain.items() if v is not None and v != ""}


def judge(
    checks: tuple[Check, ...],
    figures: Mapping[str, float],
    person: int | None = None,
    *,
    moments: Mapping[str, tuple[int, int] | None] | None = None,
    times: Float[np.ndarray, " t"] | None = None,
) -> list[Reason]:
    """Returns a reason for each figure that is beyond its limit.

    Figures that are missing or NaN are not judged. The messages name the `person`, if
    any, and the first and last frame of `moments` with their `times` (s).
    """
    found = []
    for check in checks:
        figure = float(figures.get(check.name, np.nan))
        if not check.fails(figure):
            continue
        unit = check.unit and f" {check.unit}"
        bound = "at least" if check.below else "at most"
        expected = f"{bound} {check.limit:g}{unit}"
        whose = "" if person is None else f"person {person}: "
        frames = (moments or {}).get(check.name)
        seconds, where = None, ""
        if frames is not None:
            where = f" (frames {frames[0]} to {frames[1]})"
        if frames is not None and times is not None:
            first, last = (float(times[k] - times[0]) for k in frames)
            seconds = round(first, 2), round(last, 2)
            where = where[:-1] + f", {seconds[0]:.2f} to {seconds[1]:.2f} s)"
        found.append(
            Reason(
                name=check.name,
                message=f"{whose}{check.what} is {figure:.3g}{unit}{where}, expected "
                f"{expected}.",
                expected=expected,
                advice=check.advice,
                figure=figure,
                unit=check.unit,
                person=person,
                frames=frames,
                seconds=seconds,
            )
        )
    return found


def status_of(reasons: list[Reason]) -> Status:
    """Returns the status of a result with these reasons."""
    if any(reason.fatal for reason in reasons):
        return "failed"
    return "doubtful" if reasons else "ok"
