"""`build`: makes the joint problem and its first state, without solving anything."""

import dataclasses
from collections.abc import Iterable

from bodyslam_jax import diagnostics, graph
from bodyslam_jax.body import load_body_model
from bodyslam_jax.config import Config
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.pipeline import before_joint, find_people
from bodyslam_jax.pipeline.case import Case
from bodyslam_jax.pipeline.joint_problem import prepare
from bodyslam_jax.solver.padding import stack
from bodyslam_jax.types import Sequence


def build(
    source: Case | Sequence,
    config: Config | None = None,
    hold: tuple[str, ...] = (),
) -> tuple[graph.Problem, graph.State]:
    """Makes the joint problem of section 3.6 and a first state for it.

    Cameras and landmarks start at the result of structure from motion, people at their
    given bodies, and the scale at its closed form from people's motion and the ground.
    `run` first solves for the bodies alone with cameras held; `build` does not, so that
    its start is slightly farther from the solution. For a `Sequence` the front end runs
    here, as in `run`; for a `Case` it has run already.

    Args:
        config: settings; by default those of the case, or the defaults of `Config`.
        hold: groups of variables that keep the values of the first state, among the
            fields of `State`: `scale`, `cameras`, `roots`, `poses`, `shapes`,
            `landmarks`, `intrinsics`.

    **Raises:** `InputError` as `run`, and for any other name in `hold`.
    """
    unknown = sorted(set(hold) - set(graph.VARIABLES))
    if isinstance(hold, str) or unknown:
        raise InputError(
            f"hold: found {hold!r}, expected a tuple of names among "
            f"{list(graph.VARIABLES)}."
        )
    if isinstance(source, Case):
        config = config or source.config
        sequence, body = source.sequence, source.body
        cameras, bodies = source.cameras, source.bodies
    else:
        config = config or Config()
        body = load_body_model(config.body_model)
        source = diagnostics.reconcile(find_people(source, config), body)
        sequence, cameras, bodies = before_joint(source, body, config)
    prepared = prepare(sequence, cameras, bodies, body, config, feet=False)
    return hold_groups(prepared.problem, hold), prepared.state


def stack_cases(
    cases: Iterable[Case | Sequence | tuple[graph.Problem, graph.State]],
    config: Config | None = None,
    hold: tuple[str, ...] = (),
) -> tuple[graph.Problem, graph.State]:
    """Returns several problems and first states stacked into one of each, for
    `jax.vmap` and `jax.jit`.

    Arrays get a leading axis of cases. Shorter cases get frames, landmarks and
    observations that measure nothing and variables that may not move, up to the least
    of the solver's common sizes that holds all; costs and solutions are those of each
    alone, to rounding. States have the frames of that size: `Case.trajectories` leaves
    out those that its case does not have.

    Args:
        cases: problems with their states, such as `build` gives; a `Case` or `Sequence`
            is built here.
        config, hold: of `build`, for those that are built here.

    **Raises:** `ValueError` if the cases differ in their terms, number of people, free
    groups of variables or settings, or fit no common size; and as `build`.
    """
    pairs = [
        case if isinstance(case, tuple) else build(case, config, hold) for case in cases
    ]
    return stack(pairs)


def hold_groups(problem: graph.Problem, hold: tuple[str, ...]) -> graph.Problem:
    """Returns the problem with these groups held constant; the solver does not form
    their blocks of the Hessian."""
    variables = tuple(name for name in problem.variables if name not in hold)
    free = graph.set_constant(problem.free, *hold)
    return dataclasses.replace(problem, free=free, variables=variables)
