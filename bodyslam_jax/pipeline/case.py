"""The toolkit's problems: simulated cases with their truth, and `build`.

`build` makes the joint problem of a case or a sequence without solving anything.
"""

import dataclasses
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from bodyslam_jax import diagnostics, evaluation, graph, simulation
from bodyslam_jax.body import BodyModel, load_body_model, local_joints
from bodyslam_jax.body.skeleton import ANKLES_AND_FEET
from bodyslam_jax.config import Config, Simulation
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.evaluation import Trajectories
from bodyslam_jax.pipeline import before_joint, find_people
from bodyslam_jax.pipeline.joint_problem import Prepared, prepare
from bodyslam_jax.pipeline.stage_cache import Cache, fingerprint
from bodyslam_jax.solver.padding import stack
from bodyslam_jax.types import Bodies, Result, Sequence, SfmResult


@dataclasses.dataclass(frozen=True)
class Case:
    """A simulated sequence: measurements, ground truth and results of the front end."""

    name: str
    """Name of sequence and scene, such as `M2-room`."""
    sequence: Sequence
    """The measurements: tracks, keypoints, regressed bodies, intrinsics."""
    truth: Trajectories
    """True cameras and people, m, in the simulation's world."""
    body: BodyModel
    cameras: SfmResult
    """Cameras and map up to scale, from the tracks."""
    bodies: Bodies
    """Bodies in the camera frame, cleaned."""
    config: Config

    @property
    def map_scale(self) -> float:
        """True scale, m per unit of the map, by Sim(3) alignment of the cameras."""
        found = evaluation.umeyama(
            self.truth.T_WC[:, :3, 3],
            jnp.asarray(self.cameras.T_WC[:, :3, 3]),
            jnp.asarray(self.cameras.registered, float),
            with_scale=True,
        )
        return float(found.scale)

    @property
    def radius(self) -> float:
        """RMS distance of the true camera from its mean position, m."""
        centre = np.asarray(self.truth.T_WC[:, :3, 3])
        return float(np.sqrt(((centre - centre.mean(axis=0)) ** 2).sum(axis=1).mean()))

    def prepare(self, config: Config | None = None) -> Prepared:
        """Makes the joint problem and its first state as `run` does.

        Args:
            config: settings that replace those of the case.
        """
        return prepare(
            self.sequence, self.cameras, self.bodies, self.body, config or self.config
        )

    def trajectories(self, state: graph.State) -> Trajectories:
        """Returns cameras and people of a state, which `evaluate` compares with
        `truth`.

        The function can be differentiated and mapped over states. People are present
        in the same frames as in the truth; the world is that of the map, in metres.
        Frames beyond those of the truth, as `stack_cases` adds them, are left out.
        """
        num_frames = self.truth.present.shape[1]
        state = dataclasses.replace(
            state,
            cameras=state.cameras[:num_frames],
            roots=state.roots[:, :num_frames],
            poses=state.poses[:, :num_frames],
        )
        return trajectories(
            state,
            self.body,
            self.truth.present,
            self.cameras.registered,
            self.truth.fps,
        )


def simulate_case(
    sequence: str | Simulation = "M2",
    *,
    frames: int | None = None,
    config: Config = Config(),
    cache: Path | None = None,
    **settings: Any,
) -> Case:
    """Simulates a sequence and runs the stages before the joint estimate on it.

    These stages are structure from motion with bundle adjustment on the simulated
    tracks, and the cleaning of the regressed bodies, as in `run`; `build` needs them.
    Networks are those that have not been trained on the simulated people.

    Args:
        sequence: a name from `E1` to `D3`, or all settings.
        frames: number of frames at 30 fps; by default that of the sequence, 600 to
            1000.
        cache: folder in which finished stages are kept, in a subfolder per sequence.
        settings: other fields of `config.Simulation`, such as `family="follow"`,
            `seed`, `noise`.

    **Raises:** as `simulation.simulate` and `pipeline.run`.
    """
    if not isinstance(sequence, Simulation):
        sequence = Simulation(
            # `Simulation` rejects other names.
            sequence=sequence,  # pyright: ignore[reportArgumentType]
            length=frames,
            **settings,
        )
    elif frames is not None or settings:
        sequence = dataclasses.replace(
            sequence, length=frames or sequence.length, **settings
        )
    config = config.for_simulated_people()
    body = load_body_model(config.body_model)
    simulated = simulation.simulate(sequence, body)
    measured = diagnostics.reconcile(simulation.as_sequence(simulated), body)
    name = f"{simulated.name}-{fingerprint(sequence)}"
    kept = Cache(None if cache is None else cache / name)
    used, cameras, bodies = before_joint(measured, body, config, kept)
    return Case(
        name=simulated.name,
        sequence=used,
        truth=truth_of(simulation.as_truth(simulated)),
        body=body,
        cameras=cameras,
        bodies=bodies,
        config=config,
    )


def truth_of(result: Result) -> Trajectories:
    """Converts the ground truth of a simulation to `Trajectories`."""
    joints = jnp.asarray(result.joints)
    t = len(result.timestamps)
    fps = (t - 1) / (result.timestamps[-1] - result.timestamps[0])
    return Trajectories(
        T_WC=jnp.asarray(result.T_WC),
        camera_valid=jnp.ones(t, bool),
        joints=joints,
        present=jnp.asarray(result.present),
        feet=joints[..., np.array(ANKLES_AND_FEET), :],
        fps=jnp.asarray(fps),
    )


def trajectories(
    state: graph.State,
    body: BodyModel,
    present: Bool[Array | np.ndarray, "h t"],
    registered: Bool[Array | np.ndarray, " t"],
    fps: Float[Array, ""],
) -> Trajectories:
    """Returns cameras and joints of a state in metres, in the world frame of the
    map."""
    cameras = state.cameras.at[:, :3, 3].multiply(state.scale)
    T_WH = graph.world_from_root(state)
    p_H = local_joints(body, state.poses, state.shapes[:, None])
    turn, move = T_WH[..., :3, :3], T_WH[..., None, :3, 3]
    joints = jnp.einsum("htij,htkj->htki", turn, p_H) + move
    return Trajectories(
        T_WC=cameras,
        camera_valid=jnp.asarray(registered),
        joints=joints,
        present=jnp.asarray(present),
        feet=joints[..., np.array(ANKLES_AND_FEET), :],
        fps=fps,
    )


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
