"""What holding standing feet changes: figures before and after, on simulated sequences.

    python benchmarks/bench_contact.py [E2-room D1-follow ...] [--frames 200]
        [--keypoints] [--sigma 0.012 0.03]

With `--keypoints` there is no regressor: bodies are fitted to keypoints. Figures are of
the result in metres, low-passed as `run` writes it.
"""

import argparse
import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from bodyslam_jax import diagnostics, evaluation, graph, simulation
from bodyslam_jax.body import load_body_model
from bodyslam_jax.body.skeleton import ANKLES_AND_FEET
from bodyslam_jax.config import Config, GraphWeights, Simulation
from bodyslam_jax.pipeline import before_joint
from bodyslam_jax.pipeline.case import Case, truth_of
from bodyslam_jax.pipeline.contact_stage import Standing, hold_standing_feet
from bodyslam_jax.pipeline.joint_problem import Prepared, solve_stage
from bodyslam_jax.pipeline.joint_stage import Uncertainty, of_state
from bodyslam_jax.pipeline.to_metric import to_metric

MILLIMETRES = ("c_ate_se3", "h_ate_se3", "h_ate_sim3", "j_ate_se3", "pa_mpjpe")
"""Errors of trajectories and postures."""


def make_case(name: str, frames: int, keypoints: bool) -> Case:
    """`simulate_case`, with or without regressed bodies."""
    sequence, family = name.split("-")
    body = load_body_model()
    config = Config(uncertainty=False).for_simulated_people()
    settings = Simulation(sequence=sequence, family=family, length=frames)  # pyright: ignore
    simulated = simulation.simulate(settings, body)
    measured = simulation.as_sequence(simulated)
    if keypoints:
        measured = dataclasses.replace(measured, bodies=None)
    measured = diagnostics.reconcile(measured, body)
    measured, cameras, bodies = before_joint(measured, body, config)
    truth = truth_of(simulation.as_truth(simulated))
    return Case(name, measured, truth, body, cameras, bodies, config)


def figures(case: Case, prepared: Prepared, standing: Standing) -> dict[str, float]:
    """Errors (mm, degrees), speeds (m/s) and heights (mm) of a result."""
    unknown = Uncertainty(np.nan, np.full((len(standing.state.shapes), 10, 10), np.nan))
    best, chance = standing.state, standing.probability
    estimate = of_state(best, prepared, unknown, "converged", (), chance)
    result, _ = to_metric(case.sequence, case.config, case.body, case.cameras, estimate)
    found = evaluation.evaluate_trajectories(
        evaluation.Trajectories(
            T_WC=jnp.asarray(result.T_WC),
            camera_valid=jnp.asarray(case.cameras.registered),
            joints=jnp.asarray(result.joints),
            present=jnp.asarray(result.present),
            feet=jnp.asarray(result.joints[:, :, list(ANKLES_AND_FEET)]),
            fps=case.truth.fps,
        ),
        case.truth,
    )
    spread = lambda of: 1e3 * (found[f"feet_high{of}"] - found[f"feet_low{of}"])
    leg = lambda joints: sum(
        np.linalg.norm(joints[0, 0, a] - joints[0, 0, b])
        for a, b in ((1, 4), (4, 7), (2, 5), (5, 8))
    )
    row = {name: 1e3 * found[name] for name in MILLIMETRES}
    row |= {
        "scale": 1 / found["scale"],
        "leg": leg(result.joints) / leg(np.asarray(case.truth.joints)),
        "gravity": np.degrees(found["gravity_error"]),
        "foot_speed": found["foot_speed"],
        "true": found["foot_speed_of_truth"],
        "feet_spread": spread(""),
        "true_spread": spread("_of_truth"),
        "straighter_knee": np.degrees(found["straighter_knee"]),
        "true_knee": np.degrees(found["straighter_knee_of_truth"]),
        "acceleration": found["joint_acceleration"],
        "true_acceleration": found["joint_acceleration_of_truth"],
    }
    return {name: float(value) for name, value in row.items()}


def result_row(name: str, frames: int, keypoints: bool) -> dict[str, float]:
    """`figures` with standing feet held as by default."""
    case = make_case(name, frames, keypoints)
    prepared = case.prepare()
    solution, _ = solve_stage(prepared.problem, prepared.state, case.config, "joint")
    standing = hold_standing_feet(
        *(prepared, solution.state, case.sequence, case.cameras, case.body),
        case.config,
    )
    return figures(case, prepared, standing)


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", default=["E2-room", "D1-follow"])
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--keypoints", action="store_true")
    default = GraphWeights().contact_sigma
    parser.add_argument("--sigma", type=float, nargs="*", default=[default])
    options = parser.parse_args()
    for name in options.names:
        case = make_case(name, options.frames, options.keypoints)
        prepared = case.prepare()
        solution, _ = solve_stage(
            prepared.problem, prepared.state, case.config, "joint"
        )
        best: graph.State = solution.state
        show(f"{name} free", figures(case, prepared, Standing(best)))
        for sigma in options.sigma:
            weights = dataclasses.replace(case.config.weights, contact_sigma=sigma)
            config = dataclasses.replace(case.config, weights=weights)
            standing = hold_standing_feet(
                prepared, best, case.sequence, case.cameras, case.body, config
            )
            show(f"{name} {sigma:g}", figures(case, prepared, standing))


def show(label: str, row: dict[str, float]) -> None:
    """One line."""
    values = ", ".join(f"{name} {value:.4g}" for name, value in row.items())
    print(f"{label}: {values}", flush=True)


if __name__ == "__main__":
    main()
