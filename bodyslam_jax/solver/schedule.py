"""The solvers and stages that `solve` accepts."""

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Any, Literal, get_args

from bodyslam_jax.graph import VARIABLES

Solver = Literal["structured", "adam", "optimistix_lm", "jaxopt_lm"]


@dataclasses.dataclass(frozen=True)
class Stage:
    """One run of the solver with some groups of variables free."""

    free: tuple[str, ...] = VARIABLES
    """Groups among the fields of `State`; what the problem holds stays held."""
    max_steps: int = 50
    rtol: float = 1e-8
    """Relative decrease of the cost below which the stage ends."""
    atol: float = 0.0
    """Absolute decrease likewise; a residual of one standard deviation costs a half."""

    def __post_init__(self):
        check_names(self.free)
        if self.max_steps < 0:
            raise ValueError(f"max_steps: {self.max_steps}, expected 0 or more.")
        for name in ("rtol", "atol"):
            # This refuses NaN as well.
            if not getattr(self, name) >= 0:
                found = getattr(self, name)
                raise ValueError(f"{name}: {found}, expected 0 or more.")


def check_schedule(solver: Any, schedule: Any) -> None:
    """Refuses an unknown solver, and a schedule that takes no step.

    **Raises:** `ValueError` that says what was found and what was expected.
    """
    if solver not in get_args(Solver):
        raise ValueError(
            f"solver: {solver!r}, expected one of {list(get_args(Solver))}."
        )
    stages = isinstance(schedule, Sequence)
    if not stages or not all(isinstance(stage, Stage) for stage in schedule):
        raise ValueError(
            f"schedule: found {schedule!r:.60}, expected a tuple of `Stage`."
        )
    if not schedule:
        raise ValueError("schedule: no stage, expected one or more.")
    if not any(stage.max_steps for stage in schedule):
        raise ValueError(
            "schedule: every stage has max_steps=0, nothing to solve; "
            "`problem.cost(state)` is the cost."
        )


def check_names(free: Iterable[str]) -> None:
    if isinstance(free, str):
        raise ValueError(f"free: found {free!r}, expected a tuple of names.")
    unknown = sorted(set(free) - set(VARIABLES))
    if unknown:
        raise ValueError(f"free: {unknown}, expected names among {list(VARIABLES)}.")


PAPER_SCHEDULE = (
    Stage(("scale", "cameras", "roots", "landmarks"), max_steps=20, rtol=1e-4),
    Stage(),
)
"""Section 3.6: first scale, cameras, roots and landmarks, then all variables."""
PAPER_STEPS = (200, 100)
"""The paper's number of first-order steps in each stage."""


def paper_schedule(solver: Solver) -> tuple[Stage, ...]:
    """Returns `PAPER_SCHEDULE`, with the paper's numbers of steps for `adam`."""
    if solver != "adam":
        return PAPER_SCHEDULE
    return tuple(
        dataclasses.replace(stage, max_steps=count)
        for stage, count in zip(PAPER_SCHEDULE, PAPER_STEPS, strict=True)
    )
