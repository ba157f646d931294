"""What each experiment computes, row by row, and what it writes of it."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from bodyslam_jax import body as body_
from bodyslam_jax import motion
from bodyslam_jax.config import Config, Experiment, Simulation
from bodyslam_jax.experiments import _ablation, _reports
from bodyslam_jax.experiments._case import Case, make_case, simulations
from bodyslam_jax.experiments._comparison import compare_methods
from bodyslam_jax.experiments._journal import Row
from bodyslam_jax.experiments._learning import learn_and_test
from bodyslam_jax.experiments._paper import STRUCTURE
from bodyslam_jax.experiments._scale import PERTURBATIONS, scale_recovery
from bodyslam_jax.experiments._structure import landmark_ablation
from bodyslam_jax.experiments._variants import VARIANTS
from bodyslam_jax.synthetic import LENGTH

ALL = ("E1", "E2", "E3", "M1", "M2", "M3", "M4", "D1", "D2", "D3")
FRONT, SOLVE, COMPILE = 0.15, 0.08, 25.0
"""Processor time on a 2.5 GHz core: the stages before the joint estimate, s a frame; a
solve of everything, s a frame; a problem of new shapes, s."""


@dataclasses.dataclass(frozen=True)
class Job:
    """One row: what it follows from, what it costs, how it is computed."""

    label: str
    key: tuple[Any, ...]
    seconds: float
    """Of processor time, about."""
    compute: Callable[[], Row]


@dataclasses.dataclass(frozen=True)
class Plan:
    """An experiment: its rows in their order, and the report on those that are done."""

    jobs: list[Job]
    write: Callable[[Path, list[Row]], list[Path]]


def _named(settings: Simulation) -> str:
    return f"{settings.sequence}-{settings.family}"


def _cost(settings: Simulation, solves: float, shapes: float) -> float:
    frames = settings.length or LENGTH[settings.sequence]
    return frames * (FRONT + SOLVE * solves) + COMPILE * shapes


def _cases(config: Config, stages: Path) -> Callable[[Simulation], Case]:
    """Makes cases, and keeps the last one: rows of one sequence follow one another."""

    @functools.lru_cache(maxsize=1)
    def case(settings: Simulation) -> Case:
        return make_case(settings, config, cache=stages)

    return case


def _by_sequence(
    experiment: Experiment,
    config: Config,
    stages: Path,
    sequences: Sequence[str],
    families: Sequence[str],
    compute: Callable[[Case], Row],
    cost: tuple[float, float],
) -> list[Job]:
    """One row a sequence."""
    case = _cases(config, stages)

    def job(settings: Simulation) -> Job:
        name = _named(settings)
        run = lambda: {"sequence": name, **compute(case(settings))}
        return Job(name, (settings, config), _cost(settings, *cost), run)

    return [job(s) for s in simulations(experiment, sequences, families)]


def table1(experiment: Experiment, config: Config, stages: Path) -> Plan:
    """All methods on all ten sequences, both families."""
    jobs = _by_sequence(
        experiment, config, stages, ALL, ("room", "follow"), compare_methods, (2.0, 4.0)
    )
    return Plan(jobs, functools.partial(_reports.write_table1, noise=experiment.noise))


def scale(experiment: Experiment, config: Config, stages: Path) -> Plan:
    """Recovery of the scale from six perturbations, mapped."""

    def compute(case: Case) -> Row:
        found = scale_recovery(case)
        return {
            **{k: v.tolist() for k, v in vars(found).items()},
            "deviation": found.deviation.tolist(),
            "spread": found.spread,
        }

    jobs = _by_sequence(
        experiment,
        config,
        stages,
        ("E2", "M2", "D2"),
        ("room",),
        compute,
        (len(PERTURBATIONS) * 1.5, 3.0),
    )
    return Plan(jobs, functools.partial(_reports.write_scale, noise=experiment.noise))


def landmarks(experiment: Experiment, config: Config, stages: Path) -> Plan:
    """Shaken cameras, optimised with and without landmarks: the paper's five."""
    jobs = _by_sequence(
        experiment,
        config,
        stages,
        tuple(STRUCTURE),
        ("room",),
        landmark_ablation,
        (2.5, 4.0),
    )
    return Plan(
        jobs, functools.partial(_reports.write_structure, noise=experiment.noise)
    )


def motion_model(experiment: Experiment, config: Config, stages: Path) -> Plan:
    """How well the motion model predicts clips that it was not trained on."""
    source = experiment.motion or str(_reports.CLIPS)

    def compute() -> Row:
        model = motion.load_motion_model(config.motion_model)
        body = body_.load_body_model(config.body_model)
        training, held = motion.split(motion.read_motion(source))
        clips = held or training
        rows = motion.compare({"default": model}, body, clips, training=training)
        return {"rows": rows, "clips": len(clips), "held_out": bool(held)}

    def write(out: Path, rows: list[Row]) -> list[Path]:
        return _reports.write_motion(out, rows, source, config)

    key = (Path(source), config.motion_model, config.body_model)
    return Plan([Job("motion", key, 60.0, compute)], write)


def ablation(experiment: Experiment, config: Config, stages: Path) -> Plan:
    """Terms off and on, other weights, noise levels, first against second order."""
    case = _cases(config, stages)

    @functools.lru_cache(maxsize=1)
    def prepared(settings: Simulation):
        return case(settings).prepare()

    jobs: list[Job] = []
    begun: set[Simulation] = set()

    def add(settings: Simulation, label: str, compute, solves=1.0, extra=()):
        name = _named(settings)
        row = lambda: {"sequence": name, "label": label, **compute()}
        cost = _cost(settings, solves, solves)
        if settings in begun:
            cost -= _cost(settings, 0.0, 0.0)  # stages before the solve are kept
        begun.add(settings)
        jobs.append(Job(f"{name}-{label}", (settings, config, *extra), cost, row))

    for s in simulations(experiment, ("M2", "D1"), ("room",)):
        for v in VARIANTS:
            add(s, v, lambda s=s, v=v: _ablation.ablate(case(s), prepared(s), v))
        for label, weights in _ablation.SETTINGS.items():
            one = lambda s=s, w=weights: _ablation.with_weights(case(s), w)
            add(s, label, one, extra=(weights,))
        for file in experiment.motion_models:
            one = lambda s=s, f=file: _ablation.with_motion_model(case(s), f)
            add(s, f"motion model {Path(file).stem}", one, extra=(Path(file),))
        orders = functools.lru_cache(maxsize=1)(
            lambda s=s: _ablation.compare_orders(case(s), prepared(s))
        )
        for order in _ablation.ORDERS:
            add(s, order, lambda o=order, f=orders: f()[o], solves=2.0)
        for noise in ("none", "low", "real"):
            quiet = dataclasses.replace(s, noise=noise)
            one = lambda q=quiet: _ablation.ablate(case(q), prepared(q), "full")
            add(quiet, f"noise: {noise}", one)
    return Plan(
        jobs, functools.partial(_reports.write_ablation, noise=experiment.noise)
    )


def weights(experiment: Experiment, config: Config, stages: Path) -> Plan:
    """Weights learnt on some sequences, and the gain on the others."""
    chosen = simulations(
        experiment, ("E1", "M1", "M4", "D2", "E2", "M2", "D1"), ("room",)
    )
    half = (len(chosen) + 1) // 2
    training, test = chosen[:half], chosen[half:]

    def compute() -> Row:
        make = lambda s: make_case(s, config, cache=stages)
        return learn_and_test([make(s) for s in training], [make(s) for s in test])

    seconds = sum(_cost(s, 8.0, 1.0) for s in training) + sum(
        _cost(s, 2.0, 1.0) for s in test
    )
    key = (tuple(training), tuple(test), config)
    job = Job("weights", key, seconds, compute)
    return Plan(
        [job], functools.partial(_reports.write_weights, noise=experiment.noise)
    )


PLANS: dict[str, Callable[[Experiment, Config, Path], Plan]] = {
    "table1": table1,
    "scale": scale,
    "landmarks": landmarks,
    "motion": motion_model,
    "ablation": ablation,
    "weights": weights,
}
