"""Later stages on made-up numbers, beside the first ones: their programs are ready.

On a first run compiling takes longer than all else. What depends on the numbers of
frames and people alone can be compiled while the images are rendered or tracked, and
while the joint problem, whose size only its tracks tell, is compiled itself.
"""

import concurrent.futures
import logging
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from bodyslam_jax import body as body_
from bodyslam_jax import evaluation, export, initialisation, people, view
from bodyslam_jax.config import Config
from bodyslam_jax.pipeline import joint_stage
from bodyslam_jax.pipeline.to_metric import assemble
from bodyslam_jax.types import (
    JointEstimate,
    Result,
    ScaleStart,
    Sequence,
    SfmResult,
    Tracks,
)

log = logging.getLogger(__name__)

_LONGEST = 300
"""Frames. Longer videos take minutes anyway, and what is compiled early stays in memory
while the joint problem needs it."""
_DISTANCE = 4.0
"""Of the made-up people, m."""


class Rehearsal:
    """Parts that run one after the other beside the caller; none, unless it is told.

    A stage waits for its own rehearsal before it starts: what two threads compile at
    once is compiled twice. A rehearsal that fails costs time only; the stage itself
    says what is wrong.
    """

    def __init__(self, parts: dict[str, Callable[[], object]] | None = None) -> None:
        self._thread = concurrent.futures.ThreadPoolExecutor(1, "rehearsal")
        self._parts = {n: self._thread.submit(p) for n, p in (parts or {}).items()}

    def wait(self, name: str) -> None:
        """Until that part is done, if there is such a one."""
        part = self._parts.pop(name, None)
        error = None if part is None else part.exception()
        if error is not None:
            log.debug("rehearsal of %s: %s", name, error)

    def stop(self) -> None:
        """Begins no further part."""
        self._thread.shutdown(wait=False, cancel_futures=True)


def rehearse(
    sequence: Sequence, body: body_.BodyModel, config: Config, truth: Result | None
) -> Rehearsal:
    """Begins what a short sequence with bodies goes through: `people`, `prediction`,
    `outcome`, `errors` and `files`.

    Of none where people are yet to be fitted, or the video is long.
    """
    if not config.people or sequence.bodies is None or sequence.num_frames > _LONGEST:
        return Rehearsal()
    made: list[Result] = []
    parts = {
        # As it will be, but for a focal length that is yet to be refined.
        "people": lambda: people.estimate_bodies(sequence, body, config.people_fit),
        "prediction": lambda: _prediction(sequence, body, config),
        "outcome": lambda: made.append(_outcome(sequence, body, config)),
        "errors": lambda: truth and evaluation.evaluate(made[0], truth, body),
        "files": lambda: _files(made[0], sequence, body, config),
    }
    return Rehearsal(parts)


def _prediction(sequence: Sequence, body: body_.BodyModel, config: Config) -> None:
    assert sequence.bodies is not None
    roots = people.roots_from_bodies(sequence.bodies, body)
    cameras = _cameras(sequence)
    state = initialisation.first_state(
        cameras.T_WC, cameras.landmarks, roots, cameras.intrinsics
    )
    joint_stage.predict(
        joint_stage.motion_predictor(sequence, roots, body, config), state
    )


def _outcome(sequence: Sequence, body: body_.BodyModel, config: Config) -> Result:
    found = _cameras(sequence), _joint(sequence)
    return assemble(sequence, config, body, *found, seconds={})


def _files(
    result: Result, sequence: Sequence, body: body_.BodyModel, config: Config
) -> None:
    """The overlay's meshes, of one frame; the rest whole, but for the report."""
    size = sequence.intrinsics.height, sequence.intrinsics.width
    view.draw_frame(np.zeros((*size, 3), np.uint8), result, body, 0)
    with tempfile.TemporaryDirectory() as folder:
        export.write_files(Path(folder), result, config)


def _cameras(sequence: Sequence) -> SfmResult:
    """A camera that stands still and sees nothing."""
    t = sequence.num_frames
    nothing = np.zeros(0, np.int64)
    return SfmResult(
        kind="static",
        T_WC=np.tile(np.eye(4), (t, 1, 1)),
        registered=np.ones(t, bool),
        landmarks=np.zeros((0, 3)),
        tracks=Tracks(nothing, nothing, np.zeros((0, 2))),
        keep=nothing.astype(bool),
        prior_information=np.zeros((0, 3, 3)),
        prior_mean=np.zeros((0, 3)),
        pixel_sigma=1.0,
        intrinsics=np.asarray(sequence.intrinsics.params, float),
        focal_sigma=float("nan"),
        costs=(0.0, 0.0),
        warnings=(),
    )


def _joint(sequence: Sequence) -> JointEstimate:
    """People who stand before that camera."""
    assert sequence.bodies is not None
    h, t = sequence.bodies.present.shape
    roots = np.tile(np.diag([1.0, -1.0, -1.0, 1.0]), (h, t, 1, 1))
    roots[..., 2, 3] = _DISTANCE
    return JointEstimate(
        scale=1.0,
        start=ScaleStart(),
        scale_sigma=1.0,
        shape_covariance=np.zeros((h, 10, 10)),
        unobserved=(),
        cameras=np.tile(np.eye(4), (t, 1, 1)),
        roots=roots,
        poses=np.zeros((h, t, 23, 3)),
        shapes=np.zeros((h, 10)),
        landmarks=np.zeros((0, 3)),
        intrinsics=np.asarray(sequence.intrinsics.params, float),
        present=np.ones((h, t), bool),
        status="converged",
        stages=(),
    )
