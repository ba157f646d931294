"""`build`: the joint problem and its start, with nothing of it solved."""

import dataclasses
from collections.abc import Iterable

from bodyslam_jax import diagnostics, graph, people
from bodyslam_jax.body import load_body_model
from bodyslam_jax.config import Config
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.pipeline import before_joint, find_people
from bodyslam_jax.pipeline.case import Case
from bodyslam_jax.pipeline.intrinsics import with_intrinsics
from bodyslam_jax.pipeline.joint_problem import prepare
from bodyslam_jax.solver.padding import stack
from bodyslam_jax.types import Sequence


def build(
    source: Case | Sequence,
    config: Config | None = None,
    hold: tuple[str, ...] = (),
) -> tuple[graph.Problem, graph.State]:
    """The joint problem of section 3.6 and a first state for it.

    Cameras and landmarks start where structure from motion put them, people where
    their bodies are given, and the scale at its closed form from people's motion and
    the ground. `run` first solves for the bodies alone with cameras held; `build` does
    not, so that its start is a little farther from the solution. Of a `Sequence` the
    front end runs here, as in `run`; of a `Case` it has run.

    Args:
        config: without it that of the case, or the defaults.
        hold: groups of variables that stay as they are in the first state, among the
            fields of `State`: `scale`, `cameras`, `roots`, `poses`, `shapes`,
            `landmarks`, `intrinsics`.

    **Raises:** `InputError` as `run`, and for a name in `hold` that is none of these.
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
        cameras, bodies = before_joint(source, body, config)
        sequence = people.select_people(source, config.person)
        sequence = with_intrinsics(sequence, cameras.intrinsics, cameras.zoom)
    prepared = prepare(sequence, cameras, bodies, body, config, feet=False)
    return hold_groups(prepared.problem, hold), prepared.state


def stack_cases(
    cases: Iterable[Case | Sequence | tuple[graph.Problem, graph.State]],
    config: Config | None = None,
    hold: tuple[str, ...] = (),
) -> tuple[graph.Problem, graph.State]:
    """Several problems and first states as one of each, for `jax.vmap` and `jax.jit`.

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
    """The problem with these groups held; their blocks are not even formed."""
    variables = tuple(name for name in problem.variables if name not in hold)
    free = graph.set_constant(problem.free, *hold)
    return dataclasses.replace(problem, free=free, variables=variables)
