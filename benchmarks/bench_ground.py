"""Floors that are not level: what slopes, stairs and drifts do to scale, up and feet.

    python benchmarks/bench_ground.py [E2-room D1-follow ...] [--frames 340]
        [--floors level slope stairs uneven drift] [--keep FOLDER] [--again]

Simulated walkers with a regressor's bodies, lifted to the floor under their standing
foot; floor, camera and tracks of the map follow it. A `drift` is what motion capture
has: the walker rises and sinks by 16 cm, while the floor of the map stays level. With
`--keep`, the stages before the joint estimate are read from files made by an earlier
run. With `--again`, the ground is estimated anew from the optimum of the joint problem,
which is solved once more, three times: the error of scale after each.
"""

import argparse
import pickle
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import gaussian_filter1d

from bodyslam_jax import diagnostics, evaluation, simulation
from bodyslam_jax.body import load_body_model
from bodyslam_jax.body.skeleton import ANKLES_AND_FEET
from bodyslam_jax.config import Config, Simulation
from bodyslam_jax.pipeline import before_joint, joint_stage
from bodyslam_jax.pipeline.case import Case, truth_of
from bodyslam_jax.pipeline.joint_problem import solve_stage
from bodyslam_jax.pipeline.joint_stage import with_ground_of
from bodyslam_jax.pipeline.to_metric import to_metric
from bodyslam_jax.simulation import sequences
from bodyslam_jax.simulation.room import TILE_LENGTH_M, Height, Terrain, lifted

UP = np.array([0.0, 1.0, 0.0])
RISER = 0.17
"""m"""
DRIFT = 0.16
"""m"""
FLOORS: dict[str, Height] = {
    "level": lambda at: np.zeros(at.shape[:-1]),
    "slope": lambda at: np.tan(np.radians(4.0)) * at[..., 0],
    "stairs": lambda at: RISER * np.clip(np.floor(at[..., 0] / TILE_LENGTH_M), 0, 5),
    "uneven": lambda at: 0.06 * np.sin(2.1 * at[..., 0]) * np.sin(1.7 * at[..., 1]),
    "drift": lambda at: np.zeros(at.shape[:-1]),
}


def make_case(name: str, floor: str, frames: int) -> Case:
    """`simulate_case` on another floor."""
    sequence, family = name.split("-")
    body, config = load_body_model(), Config().for_simulated_people()
    settings = Simulation(sequence=sequence, family=family, length=frames)  # pyright: ignore
    flat = simulation.simulate(settings, body)
    height = FLOORS[floor]
    drift = DRIFT if floor == "drift" else 0.0
    T_WC = flat.T_WC.copy()
    eye = height(T_WC[:, :3, 3][:, [0, 2]])
    T_WC[:, 1, 3] += gaussian_filter1d(eye, 15.0, mode="nearest")
    simulated = sequences.measure(
        settings,
        flat.name,
        flat.person,
        lifted(flat.person, flat.walk, height, drift),
        T_WC,
        Terrain(flat.room.walls, flat.room.boxes, height),
        tuple(np.random.default_rng(flat.seed).spawn(3)),  # pyright: ignore
    )
    measured = diagnostics.reconcile(simulation.as_sequence(simulated), body)
    measured, cameras, bodies = before_joint(measured, body, config)
    truth = truth_of(simulation.as_truth(simulated))
    return Case(f"{name}-{floor}", measured, truth, body, cameras, bodies, config)


def kept_case(name: str, floor: str, frames: int, folder: Path | None) -> Case:
    """`make_case`, read from a file if it is there."""
    if folder is None:
        return make_case(name, floor, frames)
    file = folder / f"{name}-{floor}-{frames}.pickle"
    if not file.exists():
        folder.mkdir(parents=True, exist_ok=True)
        file.write_bytes(pickle.dumps(make_case(name, floor, frames)))
    return pickle.loads(file.read_bytes())


def figures(case: Case) -> dict[str, float | str]:
    """Errors of the result: of scale in %, up in degrees, places in mm, feet in m/s."""
    sequence, cameras, config = case.sequence, case.cameras, case.config
    joint = joint_stage.estimate(sequence, cameras, case.bodies, case.body, config)
    result, up = to_metric(sequence, config, case.body, cameras, joint)
    verdict = diagnostics.assess(sequence, case.body, cameras, joint, result, up)
    found = evaluation.evaluate_trajectories(
        evaluation.Trajectories(
            T_WC=jnp.asarray(result.T_WC),
            camera_valid=jnp.asarray(cameras.registered),
            joints=jnp.asarray(result.joints),
            present=jnp.asarray(result.present),
            feet=jnp.asarray(result.joints[:, :, list(ANKLES_AND_FEET)]),
            fps=case.truth.fps,
        ),
        case.truth,
    )
    start, true = joint.start, case.map_scale
    per_cent = lambda s: round(100 * (float(s) / true - 1), 1)
    return {
        "scale": round(100 * (1 / float(found["scale"]) - 1), 2),
        "claimed": round(100 * verdict.scale_sigma / result.scale, 2),
        "motion": per_cent(start.motion),
        "ground": per_cent(start.ground),
        "ground_error": round(100 * start.ground_error / start.ground, 1),
        "up": round(float(np.degrees(found["gravity_error"])), 2),
        "up_sigma": round(float(np.degrees(up.sigma)), 2),
        "foot": round(float(found["foot_speed"]), 3),
        "foot_true": round(float(found["foot_speed_of_truth"]), 3),
        "h_ate_sim3": round(1e3 * float(found["h_ate_sim3"]), 1),
        "h_ate_se3": round(1e3 * float(found["h_ate_se3"]), 1),
        "j_ate": round(1e3 * float(found["j_ate_se3"]), 1),
        "status": verdict.status
        + " "
        + ",".join(reason.name for reason in verdict.reasons),
    }


def passes(case: Case) -> dict[str, float]:
    """Error of scale, %, after the joint problem, and after each of three further ones
    whose ground is estimated at the optimum of the one before."""
    prepared = case.prepare()
    solve = lambda problem, start, name: solve_stage(problem, start, case.config, name)
    solution, _ = solve(prepared.problem, prepared.state, "joint")
    found = {"joint": solution.state}
    for k in range(3):
        anew = with_ground_of(
            solution.state,
            prepared,
            case.cameras.registered,
            case.sequence.keypoints,
            case.body,
            case.config.weights,
            case.sequence.fps,
        )
        solution, _ = solve(anew.problem, solution.state, f"again {k + 1}")
        found[f"again {k + 1}"] = solution.state
    error = lambda state: 100 * (float(state.scale) / case.map_scale - 1)
    return {name: error(state) for name, state in found.items()}


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("names", nargs="*", default=["E2-room", "D1-follow"])
    parser.add_argument("--frames", type=int, default=340)
    parser.add_argument("--floors", nargs="*", default=list(FLOORS))
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--again", action="store_true")
    options = parser.parse_args()
    for name in options.names:
        for floor in options.floors:
            case = kept_case(name, floor, options.frames, options.keep)
            row = passes(case) if options.again else figures(case)
            show = lambda x: f"{x:.4g}" if isinstance(x, float) else x
            values = ", ".join(f"{key} {show(value)}" for key, value in row.items())
            print(f"{name} {floor}: {values}", flush=True)


if __name__ == "__main__":
    main()
