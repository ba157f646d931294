"""How many steps a run takes, by its settings; nothing is solved."""

import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
import scenes

from bodyslam_jax import graph, solver
from bodyslam_jax.config import Config
from bodyslam_jax.pipeline.joint_problem import solve_stage
from bodyslam_jax.solver import PAPER_SCHEDULE, Solution, Stage
from bodyslam_jax.solver.solve import check_names, check_schedule


def test_the_papers_schedule_has_its_numbers_of_first_order_steps():
    first, second = solver.paper_schedule("adam")
    assert (first.max_steps, second.max_steps) == (200, 100)
    assert [first.free, second.free] == [stage.free for stage in PAPER_SCHEDULE]
    assert solver.paper_schedule("structured") == PAPER_SCHEDULE


@pytest.mark.parametrize(
    ("config", "steps"), [(Config(), [20, 50]), (Config.paper(), [200, 100])]
)
def test_a_run_takes_the_steps_of_its_preset(monkeypatch, config, steps):
    """All of them for the joint problem, the last of them for standing feet."""
    state = scenes.truth(np.random.default_rng(0), frames=2, people=0, landmarks=0)
    problem = graph.make_problem((), state)
    calls = []

    def solve(problem, state, *, solver, schedule, mixed_precision):
        assert mixed_precision is False
        calls.append((solver, [stage.max_steps for stage in schedule]))
        cost, counts = jnp.asarray(1.0), (jnp.array(3), jnp.array(4))
        return Solution(state, optx.RESULTS.successful, cost, (), counts, 2 * cost)

    monkeypatch.setattr(solver, "solve", solve)
    _, entry = solve_stage(problem, state, config, "joint")
    assert entry["iterations"] == 7 and entry["status"] == "converged"
    solve_stage(problem, state, config, "standing feet")
    assert calls == [(config.solver, steps), (config.solver, steps[-1:])]


@pytest.mark.parametrize(
    ("schedule", "message"),
    [
        ((), "schedule: no stage, expected one or more"),
        ((Stage(max_steps=0),) * 2, "every stage has max_steps=0, nothing to solve"),
        (Stage(), r"schedule: found Stage\(.*, expected a tuple of `Stage`"),
        ((50,), "schedule: found \\(50,\\), expected a tuple of `Stage`"),
    ],
)
def test_a_schedule_without_steps_is_refused(schedule, message):
    with pytest.raises(ValueError, match=message) as refused:
        check_schedule("structured", schedule)
    assert "\n" not in str(refused.value)


def test_one_stage_may_be_idle():
    check_schedule("adam", (Stage(max_steps=0), Stage(max_steps=1)))
    check_schedule("structured", [Stage()])


def test_solvers_and_stages_that_are_none_are_refused():
    with pytest.raises(ValueError, match="solver: 'foo', expected one of .*'adam'"):
        check_schedule("foo", (Stage(),))
    with pytest.raises(ValueError, match="max_steps: -1, expected 0 or more"):
        Stage(max_steps=-1)
    for name, value in (("rtol", float("nan")), ("atol", -1e-3)):
        with pytest.raises(ValueError, match=f"{name}: {value}, expected 0 or more"):
            Stage(**{name: value})
    with pytest.raises(ValueError, match="free: found 'cameras', expected a tuple"):
        check_names("cameras")
