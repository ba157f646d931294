"""How fast and how exact is the estimate while a video runs?

    python benchmarks/bench_online.py simulated M2 --family follow --frames 150
    python benchmarks/bench_online.py film FOLDER --frames 300 [--networks] [--every 3]
    python benchmarks/bench_online.py dropped FOLDER
    python benchmarks/bench_online.py tripod E1 --camera still --frames 210
    python benchmarks/bench_online.py faults
    python benchmarks/bench_online.py memory --frames 3000

Frames are given one after another as fast as they are taken, windows are solved in the
same thread, so that accuracy does not depend on the machine. Processor time is that of
the process, compiling left out. `causal` are the estimates as `update` returned them,
from where the scale's standard deviation is below 10 %; `finish` is the result; both
and `offline`, `bodyslam_jax.run` on the same input, have one alignment for the whole
path. Tables are in `online.md`.
"""

import argparse
import dataclasses
import json
import resource
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

import bodyslam_jax as bs
from bodyslam_jax import evaluation, io, simulation
from bodyslam_jax.config import Config, Simulation
from bodyslam_jax.io.sequence import select_frames
from bodyslam_jax.online import Estimate, Online
from bodyslam_jax.simulation.exact_scene import look_at
from bodyslam_jax.types import Result, Sequence

SURE = 0.1
"""Relative standard deviation of the scale from which causal estimates count."""
FIGURES = {
    "C-ATE": "c_ate_se3",
    "C-ATE after Sim(3)": "c_ate_sim3",
    "H-ATE": "h_ate_se3",
    "J-ATE": "j_ate_se3",
    "scale": "scale",
}
DARK = slice(60, 150)
"""Frames of 3 s without a picture."""
NOBODY = slice(90, 150)
STANDS = 5.0
"""s after which the camera on a tripod moves."""
TAKEN = (
    *(0, 2, 3, 4, 5, 6, 8, 10, 12, 15, 16, 19, 21, 23, 26, 28, 32, 35, 38, 41, 46, 48),
    *(51, 53, 55, 58, 68, 83, 86, 90, 92, 94, 97, 99, 101, 104, 106, 108, 111, 113),
    *(115, 121, 125, 130, 134, 139, 143, 148, 153, 158, 160, 163, 165, 169, 174, 180),
    *(184, 189, 192, 195, 203, 206, 208, 210, 212, 214, 217, 219, 222, 224, 226, 230),
    *(233, 236, 238, 240, 243, 247, 250, 252, 255, 257, 259, 264, 266, 269, 273, 276),
    *(279, 281, 283, 285, 288, 290, 293, 295, 299),
)
"""Frames of 300 that `bodyslam live` took on two cores."""
LATE = (7.3, 1.5)
"""s that the first window took then, and about what the others do."""
CONFIG = Config().for_simulated_people()


@dataclasses.dataclass(frozen=True)
class Given:
    """What `update` is called with."""

    image: Any
    timestamp: float
    keypoints: Any
    points: Any


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=tuple(KINDS))
    parser.add_argument("which", nargs="?", default="M2")
    parser.add_argument("--family", default="follow")
    parser.add_argument("--frames", type=int, default=150)
    parser.add_argument("--people", type=int, default=1)
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--camera", choices=("still", "turn", "move"), default="still")
    parser.add_argument("--networks", action="store_true")
    parser.add_argument("--no-offline", action="store_true")
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    for row in KINDS[given.what](given):
        print(json.dumps(row), flush=True)


def simulated(given: Any) -> Iterator[dict]:
    """Simulated tracks and keypoints."""
    sequence, truth = made(given.which, given.family, given.frames, given.people)
    online = prepared(sequence)
    estimates, figures = play(online, frames_of(sequence))
    yield {"case": f"{given.which}-{given.family}", **figures}
    yield from compared(online, estimates, truth, sequence, not given.no_offline)


def film(given: Any) -> Iterator[dict]:
    """A rendered sequence folder, with its keypoints or by the networks that ship."""
    folder = Path(given.which)
    sequence = io.read_sequence(folder)
    if given.networks:
        sequence = dataclasses.replace(sequence, keypoints=None)
    count = min(given.frames, sequence.num_frames)
    bare = chosen(sequence, np.arange(0, count, given.every))
    online = prepared(bare, sequence.fps)
    estimates, figures = play(online, frames_of(bare))
    yield {"case": folder.name, "networks": given.networks, **figures}
    truth = evaluation.read_groundtruth(folder / "groundtruth", online.body)
    yield from compared(online, estimates, truth, bare, not given.no_offline)


def dropped(given: Any) -> Iterator[dict]:
    """A rendered sequence folder as a machine of two cores saw it: frames that were
    dropped, and windows that came late, by the video's own time."""
    folder = Path(given.which)
    sequence = io.read_sequence(folder)
    bare = chosen(sequence, np.array(TAKEN))
    online = prepared(bare, sequence.fps)
    pool: Any = LatePool(*LATE)
    online.pool = pool
    rows = list(frames_of(bare))
    for row in rows:
        pool.now = row.timestamp
        online.update(row.image, row.timestamp, row.keypoints)
    truth = evaluation.read_groundtruth(folder / "groundtruth", online.body)
    yield from compared(online, [], truth, bare, False)


def tripod(given: Any) -> Iterator[dict]:
    """A walker in a room before a camera that stands still, turns half as far as the
    person goes, or stands for 5 s and then moves sideways, up to 0.5 m/s."""
    settings: Any = {"sequence": given.which, "length": given.frames}
    made = simulation.simulate(Simulation(family="room", **settings))
    T_WC, pelvis = made.T_WC, made.walk.pelvis
    eye = np.tile(T_WC[:, :3, 3].mean(axis=0), (given.frames, 1))
    aim = np.tile(pelvis.mean(axis=0), (given.frames, 1))
    if given.camera == "turn":
        aim = (aim + pelvis) / 2
    if given.camera == "move":
        since = np.maximum(made.timestamps - STANDS, 0.0)
        way = np.where(since < 1, since**2 / 2, since - 0.5) / 2
        eye = eye + np.outer(way, look_at(eye, aim)[0, :3, 0])
    made = simulation.filmed_from(made, look_at(eye, aim))
    sequence = dataclasses.replace(simulation.as_sequence(made), bodies=None)
    online = prepared(sequence)
    estimates, figures = play(online, frames_of(sequence))
    case = f"{given.which} {given.camera}"
    yield {"case": case, **figures, "states": states(estimates)}
    truth = simulation.as_truth(made)
    yield from compared(online, estimates, truth, sequence, not given.no_offline)


class LatePool:
    """A second thread whose windows are there after some time of the video."""

    def __init__(self, first: float, later: float) -> None:
        self.now, self.due, self.delay, self.later = 0.0, 0.0, first, later

    def submit(self, function: Any, frames: Any) -> "LatePool":
        self.found, self.due = function(frames), self.now + self.delay
        self.delay = self.later
        return self

    def done(self) -> bool:
        return self.now >= self.due

    def result(self) -> Any:
        return self.found

    def shutdown(self) -> None:
        pass


def faults(given: Any) -> Iterator[dict]:
    """What happens where the input is not what it should be."""
    sequence, truth = made("M2", "follow", 210, 1)
    rows = list(frames_of(sequence))
    none = np.zeros((0, 25, 3))
    nothing = np.zeros(0, int), np.zeros((0, 2))
    alone = lambda k: dataclasses.replace(rows[k], keypoints=none)
    dark = lambda k: dataclasses.replace(rows[k], keypoints=none, points=nothing)
    within = lambda k, part: part.start <= k < part.stop
    cases = {
        "none": rows,
        "2 s without people": [
            alone(k) if within(k, NOBODY) else row for k, row in enumerate(rows)
        ],
        "3 s without a picture": [
            dark(k) if within(k, DARK) else row for k, row in enumerate(rows)
        ],
        "frames twice and late": [
            row for k, r in enumerate(rows) for row in (r, r, rows[max(k - 3, 0)])
        ],
    }
    for name, case in cases.items():
        online = prepared(sequence)
        estimates, figures = play(online, iter(case))
        yield {"fault": name, **figures, "states": states(estimates)}
        yield from compared(online, estimates, truth, sequence, False)
    sequence, truth = made("M2", "follow", 150, 2)
    rows = list(frames_of(sequence))
    late = [
        dataclasses.replace(row, keypoints=row.keypoints[: 1 + (k >= 60)])
        for k, row in enumerate(rows)
    ]
    online = prepared(sequence)
    estimates, figures = play(online, iter(late))
    yield {"fault": "a second person after 2 s", **figures, "states": states(estimates)}
    yield from compared(online, estimates, truth, sequence, False)


def memory(given: Any) -> Iterator[dict]:
    """A long run: the same simulated seconds forth and back, again and again."""
    sequence, _ = made("M2", "follow", 300, 1)
    rows = list(frames_of(sequence))
    loop = [*rows, *rows[-2:0:-1]]
    online = prepared(sequence)
    begun = time.process_time()
    last: Estimate | None = None
    for k in range(given.frames):
        row = loop[k % len(loop)]
        given = row.keypoints
        last = online.update(None, k / sequence.fps, given, points=row.points)
        if k % 300 == 299:
            now = time.process_time()
            yield {
                "frame": k + 1,
                "MiB": round(resident(), 1),
                "processor ms a frame": round((now - begun) / 0.3, 2),
                "scale": round(last.scale, 4),
                "sigma": round(last.scale_sigma, 4),
                "status": last.status,
            }
            begun = time.process_time()


def made(name: str, family: str, frames: int, people: int) -> tuple[Sequence, Result]:
    """A simulated sequence without given bodies, and its truth."""
    settings: Any = {"sequence": name, "family": family}
    simulated = simulation.simulate(
        Simulation(**settings, length=frames, people=people)
    )
    sequence = simulation.as_sequence(simulated)
    sequence = dataclasses.replace(sequence, bodies=None)
    return sequence, simulation.as_truth(simulated)


def chosen(sequence: Sequence, picks: np.ndarray) -> Sequence:
    """Some frames of a film, from images and keypoints."""
    bare = dataclasses.replace(
        sequence, timestamps=sequence.timestamps[picks], bodies=None, tracks=None
    )
    return select_frames(bare, picks)


def frames_of(sequence: Sequence) -> Iterator[Given]:
    """The frames of a sequence, one after another."""
    images = None if sequence.frames is None else io.frames(sequence)
    found, tracks = sequence.keypoints, sequence.tracks
    ends = order = np.zeros(0, int)
    if tracks is not None:
        order = np.argsort(tracks.frame, kind="stable")
        wanted = np.arange(sequence.num_frames + 1)
        ends = np.searchsorted(tracks.frame[order], wanted)
    for k, timestamp in enumerate(sequence.timestamps):
        keypoints = points = None
        if found is not None:
            rows = found.uv[:, k], found.confidence[:, k][..., None]
            keypoints = np.concatenate(rows, axis=-1)
        if tracks is not None:
            at = order[ends[k] : ends[k + 1]]
            points = tracks.landmark[at], tracks.uv[at]
        image = None if images is None else next(images)
        yield Given(image, float(timestamp), keypoints, points)


def prepared(sequence: Sequence, fps: float | None = None) -> Online:
    """An estimate of the sequence's camera, with all programs compiled."""
    online = Online(
        CONFIG,
        intrinsics=sequence.intrinsics,
        fps=fps or sequence.fps,
        threads=False,
        name=sequence.name,
    )
    online.prepare()
    return online


def play(online: Online, rows: Iterator[Given]) -> tuple[list[Estimate], dict]:
    """Estimates of all frames, and what the last two thirds took."""
    estimates, times = [], []
    for row in rows:
        begun = time.process_time()
        estimates.append(
            online.update(row.image, row.timestamp, row.keypoints, points=row.points)
        )
        times.append(time.process_time() - begun)
    later = np.array(times[len(times) // 3 :])
    window = online.seconds.copy()
    front = np.median(later)
    return estimates, {
        "frames": len(times),
        "processor ms a frame": round(1000 * float(later.mean()), 1),
        "front end ms": round(1000 * float(front), 1),
        "window s": {k: round(v, 1) for k, v in window.items()},
        "MiB": round(resident(), 0),
    }


def compared(
    online: Online,
    estimates: list[Estimate],
    truth: Result,
    sequence: Sequence,
    offline: bool,
) -> Iterator[dict]:
    """Errors of the causal estimates, of the result, and of an offline run."""
    body = online.body
    causal, since = as_result(estimates, sequence)
    if causal is not None:
        yield {"estimate": "causal", "from s": since, **errors(causal, truth, body)}
    result = online.finish()
    sigma = result.summary["scale"]["sigma"]
    told = {"status": result.summary["status"], "sigma": sigma}
    told["warnings"] = result.summary["warnings"]
    yield {"estimate": "finish", **errors(result, truth, body), **told}
    if offline:
        begun = time.process_time()
        whole = bs.run(sequence, CONFIG)
        seconds = round(time.process_time() - begun, 1)
        row = {"estimate": "offline", **errors(whole, truth, body)}
        yield {**row, "status": whole.summary["status"], "processor s": seconds}


def as_result(
    estimates: list[Estimate], sequence: Sequence
) -> tuple[Result | None, float]:
    """Causal estimates from where the scale is sure, as a result, and that time."""
    sure = [e.scale_sigma < SURE * e.scale for e in estimates]
    if not any(sure):
        return None, float("nan")
    used = [e for e in estimates[sure.index(True) :] if e.status != "late"]
    persons = sorted({p.person for e in used for p in e.people})
    shape = len(persons), len(used)
    poses, trans = np.zeros((*shape, 72)), np.zeros((*shape, 3))
    joints, present = np.zeros((*shape, 24, 3)), np.zeros(shape, bool)
    betas = np.zeros((len(persons), 10))
    for t, estimate in enumerate(used):
        for one in estimate.people:
            h = persons.index(one.person)
            poses[h, t], joints[h, t] = one.poses, one.joints
            trans[h, t], present[h, t] = one.T_WH[:3, 3], True
            betas[h] = one.betas
    result = Result(
        timestamps=np.array([e.timestamp for e in used]),
        T_WC=np.stack([e.T_WC for e in used]),
        scale=used[-1].scale,
        intrinsics=sequence.intrinsics.params,
        landmarks=np.zeros((0, 3)),
        poses=poses,
        trans=trans,
        betas=betas,
        joints=joints,
        present=present,
    )
    return result, round(used[0].timestamp, 2)


def errors(estimate: Result, truth: Result, body: Any) -> dict:
    """The figures of the table: mm, and the scale, best 1."""
    first, last = estimate.timestamps[[0, -1]]
    half = 0.5 / truth.fps
    kept = (truth.timestamps >= first - half) & (truth.timestamps <= last + half)
    truth = dataclasses.replace(
        truth,
        timestamps=truth.timestamps[kept],
        T_WC=truth.T_WC[kept],
        poses=truth.poses[:, kept],
        trans=truth.trans[:, kept],
        joints=truth.joints[:, kept],
        present=truth.present[:, kept],
    )
    found = evaluation.evaluate(estimate, truth, body)
    return {
        name: round(float(found[key]) * (1 if name == "scale" else 1000), 4)
        for name, key in FIGURES.items()
    }


def states(estimates: list[Estimate]) -> list[str]:
    """What was said, one after another, with the time it was said from."""
    found: list[str] = []
    last = ""
    for estimate in estimates:
        if estimate.status != last and estimate.status != "late":
            found.append(f"{estimate.status} from {estimate.timestamp:.1f} s")
            last = estimate.status
    return found


def resident() -> float:
    """Memory of this process now, MiB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20


KINDS = {
    "simulated": simulated,
    "film": film,
    "dropped": dropped,
    "tripod": tripod,
    "faults": faults,
    "memory": memory,
}


if __name__ == "__main__":
    main()
