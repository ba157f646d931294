"""How well is a person's size known, over many people who were drawn at random?

    python benchmarks/bench_person_size.py --people 30
    python benchmarks/bench_person_size.py --people 30 --set posture_sigma=0.18 \
        --set posture_correlation=0.96 --set root_correlation=0.96 \
        --set keypoint_inflation=3 --set keypoint_loss=9

Simulated, noise `real`. Cameras are held where they truly were and there is no map, so
that a person takes seconds: what is estimated is people alone, as in the first of the
pipeline's two solves. Size is the leg's length, of which scale has its metres.
"""

import argparse
import dataclasses
import zlib

import jax
import jax.numpy as jnp
import numpy as np

from bodyslam_jax import body as body_
from bodyslam_jax import (
    diagnostics,
    graph,
    initialisation,
    motion,
    people,
    simulation,
    solver,
)
from bodyslam_jax.config import Config, GraphWeights, Simulation
from bodyslam_jax.pipeline.joint_problem import solve_stage

MUTED = graph.RootSmoothness
"""Its weight is of the person's path in the world."""


def draw(number, frames, family):
    """A simulated sequence: person, walk, camera and errors of its own."""
    names = list(simulation.LENGTH)
    settings = Simulation(
        sequence=names[number % len(names)],
        family=family,
        length=frames,
        seed=zlib.crc32(f"person size {number}".encode()),
    )
    return simulation.simulate(settings, body_.load_body_model())


def errors(simulated, weights):
    """Of the leg, as a share: the regressor's (its shrinkage undone), the estimate's,
    and the standard deviation that the covariance says."""
    body, config = body_.load_body_model(), Config().for_simulated_people()
    sequence = diagnostics.reconcile(simulation.as_sequence(simulated), body)
    bodies = people.estimate_bodies(sequence, body, config.people_fit)
    roots = people.roots_from_bodies(bodies, body)
    state = initialisation.first_state(
        np.array(simulated.T_WC), np.zeros((0, 3)), roots, sequence.intrinsics.params
    )
    factors = initialisation.people_factors(sequence, roots, weights, body)
    factors = [f for f in factors if not isinstance(f, MUTED)]
    free = initialisation.free_people(state)
    problem = graph.make_problem(factors, state, free=free)
    held = graph.set_constant(problem.free, "scale", "cameras", "intrinsics")
    problem = dataclasses.replace(problem, free=held)
    solution, _ = solve_stage(problem, state, config, "people")
    shape = solution.state.shapes[0]
    leg = lambda shape: motion.leg_length(body, jnp.asarray(shape))
    by_shape = np.asarray(jax.grad(lambda shape: jnp.log(leg(shape)))(shape))
    spread = np.asarray(solver.marginals(problem, solution.state).shapes[0])
    true = float(leg(simulated.person.shape))
    return (
        float(leg(roots.shape[0])) / true - 1,
        float(leg(shape)) / true - 1,
        float(np.sqrt(by_shape @ spread @ by_shape)),
    )


def weight(text):
    """A number of `GraphWeights` and its value, of `name=value`."""
    name, _, value = text.partition("=")
    try:
        number = float(value)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text}: expected name=number") from None
    known = [k for k, v in vars(GraphWeights()).items() if not isinstance(v, bool)]
    if name not in known:
        raise argparse.ArgumentTypeError(
            f"{name}: no such weight, expected one of {', '.join(known)}"
        )
    return name, number


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--people", type=int, default=30)
    parser.add_argument("--first", type=int, default=0, help="number of the first")
    parser.add_argument("--frames", type=int, default=600)
    parser.add_argument("--family", choices=["room", "follow"], default="room")
    parser.add_argument(
        "--set",
        type=weight,
        action="append",
        default=[],
        help="a weight, such as shape_sigma=0.3",
    )
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    weights = GraphWeights(**dict(args.set))
    found = []
    for number in range(args.first, args.first + args.people):
        found.append(errors(draw(number, args.frames, args.family), weights))
        given, estimate, sigma = found[-1]
        print(
            f"{number}: regressor {given:+.2%}, estimate {estimate:+.2%} ± {sigma:.2%}",
            flush=True,
        )
    given, estimate, sigma = np.array(found).T
    size = lambda e: f"mean |e| {abs(e).mean():.2%}, root mean square {rms(e):.2%}"
    print(f"{len(found)} people of {args.frames} frames, {args.family}")
    print(f"  regressor: {size(given)}")
    print(f"  estimate: {size(estimate)}, mean {estimate.mean():+.2%}")
    squares = rms(estimate / sigma) ** 2
    print(f"  as its covariances say: {rms(sigma):.2%}, mean square {squares:.2f} of 1")


def rms(values):
    return float(np.sqrt(np.mean(values**2)))


if __name__ == "__main__":
    main()
