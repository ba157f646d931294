"""Defines the experiments of `bodyslam experiment NAME`, each as a plan of rows and a
report, and runs one: computes the missing rows and writes the report.

Inputs are the settings of `config.Experiment`; outputs are those of the reports in
`experiments.reports`, `table1` and `video_table`.
"""

import dataclasses
import functools
import logging
from collections.abc import Callable
from pathlib import Path

from bodyslam_jax import body as body_
from bodyslam_jax import motion
from bodyslam_jax.batch.engine import Engine, Failure, Setup
from bodyslam_jax.config import Config, Experiment, Simulation
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.experiments import ablation as ablation_
from bodyslam_jax.experiments import reports
from bodyslam_jax.experiments import video as video_
from bodyslam_jax.experiments.ablation import FULL, VARIANTS, landmark_ablation
from bodyslam_jax.experiments.calibration import jobs as calibration_jobs
from bodyslam_jax.experiments.calibration import write_calibration
from bodyslam_jax.experiments.comparison import compare_methods
from bodyslam_jax.experiments.jobs import (
    Job,
    Journal,
    Plan,
    Row,
    by_sequence,
    cases,
    check_files,
    cost,
    named,
)
from bodyslam_jax.experiments.paper import STRUCTURE
from bodyslam_jax.experiments.reports import about
from bodyslam_jax.experiments.scale import PERTURBATIONS, scale_recovery
from bodyslam_jax.experiments.scenario import simulations
from bodyslam_jax.experiments.table1 import write_table1
from bodyslam_jax.experiments.video_table import write_video
from bodyslam_jax.pipeline.case import Case
from bodyslam_jax.pipeline.stage_cache import body_model_file
from bodyslam_jax.simulation import motion_file

ALL_SEQUENCES = ("E1", "E2", "E3", "M1", "M2", "M3", "M4", "D1", "D2", "D3")
NOISE_LEVELS = ("none", "low", "real")
log = logging.getLogger(__name__)


def table1(experiment: Experiment, config: Config, stages: Path) -> Plan:
    """Plans table 1: all methods on all ten sequences, both families."""
    jobs = by_sequence(
        experiment,
        config,
        stages,
        ALL_SEQUENCES,
        ("room", "follow"),
        compare_methods,
        (3.0, 6.0),
    )
    return Plan(jobs, functools.partial(write_table1, about=about(experiment, config)))


def scale(experiment: Experiment, config: Config, stages: Path) -> Plan:
    """Plans the recovery of the scale from six perturbations, in one vectorised
    solve."""

    def compute(case: Case) -> Row:
        found = scale_recovery(case)
        return {
            **{k: v.tolist() for k, v in vars(found).items()},
            "deviation": found.deviation.tolist(),
            "spread": found.spread,
        }

    jobs = by_sequence(
        experiment,
        config,
        stages,
        ("E2", "M2", "D2"),
        ("room",),
        compute,
        (len(PERTURBATIONS) * 1.5, 3.0),
    )
    data = about(experiment, config)
    return Plan(jobs, functools.partial(reports.write_scale, about=data))


def landmarks(experiment: Experiment, config: Config, stages: Path) -> Plan:
    """Plans the optimisation of perturbed cameras with and without landmarks, on the
    paper's five sequences."""
    jobs = by_sequence(
        experiment,
        config,
        stages,
        tuple(STRUCTURE),
        ("room",),
        functools.partial(landmark_ablation, seed=experiment.seed or 0),
        (2.5, 4.0),
    )
    data = about(experiment, config)
    return Plan(jobs, functools.partial(reports.write_structure, about=data))


def motion_model(experiment: Experiment, config: Config, stages: Path) -> Plan:
    """Plans the prediction errors of the motion model on clips it was not trained
    on."""
    source = str(motion_file(experiment.motion))

    def compute() -> Row:
        model = motion.load_motion_model(config.motion_model)
        body = body_.load_body_model(config.body_model)
        training, held = motion.split(motion.read_motion(source))
        clips = held or training
        rows = motion.compare({"default": model}, body, clips, training=training)
        return {"rows": rows, "clips": len(clips), "held_out": bool(held)}

    def write(out: Path, rows: list[Row]) -> list[Path]:
        return reports.write_motion(out, rows, source, config)

    model = config.motion_model and Path(config.motion_model)
    key = (Path(source), model, body_model_file(config.body_model))
    return Plan([Job("motion", key, 60.0, compute)], write)


def ablation(experiment: Experiment, config: Config, stages: Path) -> Plan:
    """Plans the ablations: disabled factors, other weights and models, noise
    levels."""
    case = cases(config, stages)

    @functools.lru_cache(maxsize=1)
    def prepared(settings: Simulation):
        return case(settings).prepare()

    jobs: list[Job] = []
    begun: set[Simulation] = set()

    def add(settings: Simulation, label: str, compute, extra=()):
        name = named(settings)
        row = lambda: {"sequence": name, "label": label, **compute()}
        seconds = cost(settings, 1.0, 1.0)
        if settings in begun:
            seconds -= cost(settings, 0.0, 0.0)  # stages before the solve are cached
        begun.add(settings)
        key = (settings, config, *extra)
        jobs.append(Job(f"{name}-{label}", key, seconds, row))

    for s in simulations(experiment, ("M2", "D1"), ("room",)):
        for v in VARIANTS:
            add(s, v, lambda s=s, v=v: ablation_.ablate(case(s), prepared(s), v))
        for label, weights in ablation_.SETTINGS.items():
            one = lambda s=s, w=weights: ablation_.with_weights(case(s), w)
            add(s, label, one, extra=(weights,))
        add(s, ablation_.PUBLISHED, lambda s=s: ablation_.as_published(case(s)))
        for file in experiment.motion_models:
            one = lambda s=s, f=file: ablation_.with_motion_model(case(s), f)
            add(s, f"motion model {Path(file).stem}", one, extra=(Path(file),))
        for noise in NOISE_LEVELS:
            quiet = dataclasses.replace(s, noise=noise)
            one = lambda q=quiet: ablation_.ablate(case(q), prepared(q), FULL)
            add(quiet, f"noise: {noise}", one)
    data = about(experiment, config)
    return Plan(jobs, functools.partial(reports.write_ablation, about=data))


def video(experiment: Experiment, config: Config, stages: Path) -> Plan:
    """Plans estimates from pixels alone, and with simulated keypoints and bodies, on
    all sequences."""
    jobs = video_.jobs(experiment, config, stages, ALL_SEQUENCES)
    return Plan(jobs, functools.partial(write_video, about=about(experiment, config)))


def calibration(experiment: Experiment, config: Config, stages: Path) -> Plan:
    """Plans the calibration of claimed uncertainties, on people whom no prior knows."""
    write = functools.partial(write_calibration, about=about(experiment, config))
    return Plan(calibration_jobs(experiment, config, stages), write)


PLANS: dict[str, Callable[[Experiment, Config, Path], Plan]] = {
    "table1": table1,
    "scale": scale,
    "landmarks": landmarks,
    "motion": motion_model,
    "ablation": ablation,
    "video": video,
    "calibration": calibration,
}


def run_experiment(
    name: str,
    out: Path,
    experiment: Experiment = Experiment(),
    config: Config = Config(),
    engine: Engine | None = None,
    setup: Setup | None = None,
) -> list[Path]:
    """Computes the rows that `out` lacks, writes tables and figures, and returns their
    paths.

    Rows are cached in `out/rows` under a fingerprint of their inputs, stages before the
    joint estimate in `out/stages`. Tables are written after every row, so that an
    interrupted experiment leaves those of the finished rows. A row that cannot be
    computed is left out with a warning. Networks are those that have not been trained
    on the simulated people (`Config.for_simulated_people`), whatever `config` says.

    Args:
        engine: computes the rows elsewhere, in processes that `setup` prepares; `out`
            is then a folder that they see. Without it, this process does.

    **Raises:** `InputError` if there is no such experiment, if `out` cannot be written,
    or if no row could be computed; `ValueError` or `FileNotFoundError`, before anything
    is computed, if a file that the settings name cannot be used.
    """
    if name not in PLANS:
        raise InputError(f"no experiment {name!r}; expected one of {sorted(PLANS)}.")
    check_files(experiment, config)
    config = config.for_simulated_people()
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror}).") from None
    if engine is not None:
        out = out.resolve()
    plan = PLANS[name](experiment, config, out / "stages")
    journal = Journal(out / "rows")
    missing = [
        job for job in plan.jobs if journal.kept(name, job.label, job.key) is None
    ]
    minutes = sum(job.seconds for job in missing) / 60
    log.info(
        "%s: %d rows, %d of them done; about %.0f min of processor time to go",
        name,
        len(plan.jobs),
        len(plan.jobs) - len(missing),
        minutes,
    )
    if engine is not None and missing:
        numbers = [k for k, job in enumerate(plan.jobs) if job in missing]
        compute = functools.partial(compute_row, name, out, experiment, config)
        for number, value in engine.map(compute, numbers, setup or _nothing):
            label = plan.jobs[number].label
            if isinstance(value, Failure):
                log.warning("%s %s: left out: %s", name, label, value.message)
            else:
                log.info("%s %s: computed", name, label)
    rows: list[Row] = []
    written: list[Path] = []
    for job in plan.jobs:
        if engine is not None:
            row = journal.kept(name, job.label, job.key)
            rows += [] if row is None else [row]
            continue
        try:
            rows.append(journal.row(name, job.label, job.key, job.compute))
        except (FileNotFoundError, ValueError) as error:
            log.warning("%s %s: left out: %s", name, job.label, error)
            continue
        if job in missing or job is plan.jobs[-1]:
            written = plan.write(out, rows)
    if not rows:
        raise InputError(f"{name}: no row could be computed; see above.")
    return written or plan.write(out, rows)


def compute_row(
    name: str, out: Path, experiment: Experiment, config: Config, number: int
) -> None:
    """Computes one row of an experiment into `out/rows`, in any process."""
    job = _plan(name, out, experiment, config).jobs[number]
    Journal(out / "rows").row(name, job.label, job.key, job.compute)


@functools.lru_cache(maxsize=1)
def _plan(name: str, out: Path, experiment: Experiment, config: Config) -> Plan:
    """Returns the plan, cached so that further rows share what its jobs have
    computed."""
    return PLANS[name](experiment, config, out / "stages")


def _nothing() -> None:
    pass
