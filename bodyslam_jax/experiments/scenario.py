"""A simulated sequence, brought to where experiments begin as the pipeline does it."""

import dataclasses
import zlib
from collections.abc import Sequence as Ordered
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from bodyslam_jax import body as body_
from bodyslam_jax import evaluation, graph, pipeline, simulation
from bodyslam_jax.config import Config, Experiment, Simulation
from bodyslam_jax.experiments.scoring import score, truth_of
from bodyslam_jax.pipeline import joint_stage, sfm_stage
from bodyslam_jax.pipeline.stage_cache import Cache, fingerprint
from bodyslam_jax.types import Bodies, Sequence, SfmResult


@dataclasses.dataclass(frozen=True)
class Case:
    """One sequence with its truth, reconstructed up to scale; bodies in the camera."""

    name: str
    """Such as `M2-room`."""
    sequence: Sequence
    truth: evaluation.Trajectories
    body: body_.BodyModel
    cameras: SfmResult
    bodies: Bodies
    config: Config

    @property
    def map_scale(self) -> float:
        """Metres per unit of the map: what s should be, by Sim(3) on the cameras."""
        found = evaluation.umeyama(
            self.truth.T_WC[:, :3, 3],
            jnp.asarray(self.cameras.T_WC[:, :3, 3]),
            jnp.asarray(self.cameras.registered, float),
            with_scale=True,
        )
        return float(found.scale)

    @property
    def radius(self) -> float:
        """RMS distance of the true camera from its mean place, m."""
        centre = np.asarray(self.truth.T_WC[:, :3, 3])
        return float(np.sqrt(((centre - centre.mean(axis=0)) ** 2).sum(axis=1).mean()))

    def score(self, state: graph.State, present: np.ndarray) -> dict[str, float]:
        """Errors of a state against the truth: `_score.NAMES`."""
        return score(state, self.truth, self.body, present, self.cameras.registered)

    def prepare(self, config: Config | None = None) -> joint_stage.Prepared:
        """The joint problem and its start, with other settings if they are given."""
        return joint_stage.prepare(
            self.sequence, self.cameras, self.bodies, self.body, config or self.config
        )


def make_case(
    settings: Simulation, config: Config = Config(), *, cache: Path | None = None
) -> Case:
    """Simulates, reconstructs and adjusts: the stages before the joint estimate.

    `cache` is a folder in which stages are kept, one of its folders a sequence.

    **Raises:** as `simulation.simulate` and `pipeline.run`.
    """
    body = body_.load_body_model(config.body_model)
    simulated = simulation.simulate(settings, body)
    sequence = simulation.as_sequence(simulated)
    name = f"{simulated.name}-{fingerprint(settings)}"
    kept = Cache(None if cache is None else cache / name)
    cameras, bodies = pipeline.before_joint(sequence, body, config, kept)
    return Case(
        name=simulated.name,
        sequence=sfm_stage.with_intrinsics(sequence, cameras.intrinsics),
        truth=truth_of(simulation.as_truth(simulated)),
        body=body,
        cameras=cameras,
        bodies=bodies,
        config=config,
    )


def simulations(
    experiment: Experiment, sequences: Ordered[str], families: Ordered[str]
) -> list[Simulation]:
    """What an experiment runs on: its own sequences unless others were asked for.

    A seed that was chosen makes every sequence another one, and not all of them the
    same: their names count as well.
    """
    chosen = dict.fromkeys(experiment.sequences or sequences)  # each once
    kinds = families
    if experiment.family is not None:
        kinds = (
            ("room", "follow") if experiment.family == "both" else (experiment.family,)
        )
    chance = lambda name: (
        None
        if experiment.seed is None
        else zlib.crc32(f"{name}-{experiment.seed}".encode())
    )
    return [
        Simulation(
            sequence=sequence,  # pyright: ignore
            family=family,  # pyright: ignore
            length=experiment.frames,
            seed=chance(f"{sequence}-{family}"),
            motion=experiment.motion,
            noise=experiment.noise,
        )
        for family in kinds
        for sequence in chosen
    ]
