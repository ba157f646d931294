"""How many steps a run takes, by its settings; nothing is solved."""

import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
import scenes

from bodyslam_jax import graph, joint, solver
from bodyslam_jax.config import Config
from bodyslam_jax.solver import PAPER_SCHEDULE, Solution


def test_the_papers_schedule_has_its_numbers_of_first_order_steps():
    first, second = solver.paper_schedule("adam")
    assert (first.max_steps, second.max_steps) == (200, 100)
    assert [first.free, second.free] == [stage.free for stage in PAPER_SCHEDULE]
    assert solver.paper_schedule("structured") == PAPER_SCHEDULE


@pytest.mark.parametrize(
    ("config", "steps"), [(Config(), [20, 50]), (Config.paper(), [200, 100])]
)
def test_a_run_takes_the_steps_of_its_preset(monkeypatch, config, steps):
    """All of them for the joint problem, the last of them for people alone."""
    state = scenes.truth(np.random.default_rng(0), frames=2, people=0, landmarks=0)
    problem = graph.make_problem((), state)
    told = []

    def solve(problem, state, *, solver, schedule):
        told.append((solver, [stage.max_steps for stage in schedule]))
        cost, counts = jnp.asarray(1.0), (jnp.array(3), jnp.array(4))
        return Solution(state, optx.RESULTS.successful, cost, (), counts, 2 * cost)

    monkeypatch.setattr(solver, "solve", solve)
    _, said = joint.solve_stage(problem, state, config, "joint")
    assert said["iterations"] == 7 and said["status"] == "converged"
    joint.solve_stage(problem, state, config, "people alone")
    assert told == [(config.solver, steps), (config.solver, steps[-1:])]
