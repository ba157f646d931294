"""How many frames a second the front end does, and how much memory it takes.

    python benchmarks/bench_frontend.py [SEQUENCE] [--frames 1000] [--threads 2]

From images to tracks, and from tracks to cameras and a map up to scale, without the
final bundle adjustment. "Processor ms" is of all cores together: on a machine that does
nothing else a frame takes no longer. Without a SEQUENCE folder a simulated one of 300
frames at 640x480 is rendered (`simulate M1 --family follow --render`). For more frames
than it has, the video runs to its end, back to its start, and so on, so that motion
stays continuous. Each part runs alone in a process of its own, which JAX never enters
but for its import, so that its peak memory can be told. Prints a Markdown table.
"""

import argparse
import dataclasses
import json
import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

from bodyslam_jax import io, sfm, simulation
from bodyslam_jax.config import Simulation
from bodyslam_jax.pipeline.stage_cache import load, save
from bodyslam_jax.sfm.person_mask import person_masks
from bodyslam_jax.types import Keypoints, Sequence, Tracks


def simulated(folder: Path) -> Path:
    settings = Simulation(sequence="M1", family="follow", length=300, render=True)
    return simulation.write_sequence(
        folder, simulation.simulate(settings), tracks=False
    )


def extended(sequence: Sequence, num: int, folder: Path) -> Sequence:
    """The sequence there and back until it has `num` frames, as a video in `folder`."""
    have = sequence.num_frames
    order = np.abs((np.arange(num) + have - 1) % (2 * have - 2) - (have - 1))
    images = [cv2.imencode(".png", i)[1] for i in io.frames(sequence)]
    fps, path = sequence.fps, folder / "video.mp4"
    size = (sequence.intrinsics.width, sequence.intrinsics.height)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), fps, size)
    for k in order:
        image = cv2.imdecode(images[k], cv2.IMREAD_COLOR)
        assert image is not None
        writer.write(image)
    writer.release()
    seen = sequence.keypoints
    if seen is not None:
        seen = Keypoints(seen.uv[:, order], seen.confidence[:, order])
    return dataclasses.replace(
        sequence,
        frames=path,
        timestamps=np.arange(num) / fps,
        keypoints=seen,
        bodies=None,
        groundtruth=None,
        picks=None,
    )


def decode(sequence: Sequence, tracks: Tracks | None) -> None:
    for _ in io.frames(sequence, gray=True):
        pass


def masks(sequence: Sequence, tracks: Tracks | None) -> None:
    for _ in person_masks(sequence, 0.06):
        pass


def track(sequence: Sequence, tracks: Tracks | None) -> Tracks:
    return sfm.track(sequence)


def structure(sequence: Sequence, tracks: Tracks | None) -> sfm.Reconstruction:
    assert tracks is not None
    return sfm.reconstruct(tracks, sequence.intrinsics, sequence.num_frames)


PARTS = {
    "decoding alone": decode,
    "person masks alone": masks,
    "images to tracks, with both": track,
    "tracks to cameras and map": structure,
}


def run(part: str, folder: Path) -> None:
    sequence = load(folder / "sequence.npz", Sequence)
    file = folder / "tracks.npz"
    tracks = load(file, Tracks) if file.exists() else None
    start, begun = time.perf_counter(), time.process_time()
    found = PARTS[part](sequence, tracks)
    seconds, busy = time.perf_counter() - start, time.process_time() - begun
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    said = {"seconds": seconds, "busy": busy, "peak_mib": peak}
    if isinstance(found, Tracks):
        save(file, found)
        said["note"] = f"{len(found.frame) / sequence.num_frames:.0f} points a frame"
    if isinstance(found, sfm.Reconstruction):
        said["note"] = (
            f"{found.kind}, {found.registered.sum()} frames located, "
            f"{len(found.landmarks)} landmarks, {found.error:.2f} px"
        )
    print(json.dumps(said))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("sequence", nargs="?", type=Path)
    parser.add_argument("--frames", type=int)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--part", choices=PARTS, help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    cv2.setNumThreads(args.threads)
    if args.part:
        run(args.part, args.folder)
        return
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        source = args.sequence or simulated(folder / "simulated")
        sequence = dataclasses.replace(io.read_sequence(source), tracks=None)
        if args.frames and args.frames != sequence.num_frames:
            sequence = extended(sequence, args.frames, folder)
        save(folder / "sequence.npz", sequence)
        num = sequence.num_frames
        size = f"{sequence.intrinsics.width}x{sequence.intrinsics.height}"
        cores = len(os.sched_getaffinity(0))
        print(f"{num} frames of {size}; {cores} cores, {args.threads} threads of")
        print(f"OpenCV {cv2.__version__}, {platform.machine()}\n")
        print("| part | ms a frame | frames/s | processor ms | peak memory, MiB | |")
        print("|---|---|---|---|---|---|")
        total = all_busy = 0.0
        for part in PARTS:
            argv = [sys.executable, __file__, "--part", part, "--folder", name]
            argv += ["--threads", str(args.threads)]
            said = json.loads(
                subprocess.run(argv, check=True, stdout=subprocess.PIPE).stdout
            )
            each = said["seconds"] / num
            busy = said["busy"] / num
            if not part.endswith("alone"):
                total, all_busy = total + each, all_busy + busy
            print(
                f"| {part} | {1e3 * each:.1f} | {1 / each:.1f} | "
                f"{1e3 * busy:.1f} | {said['peak_mib']:.0f} | {said.get('note', '')} |",
                flush=True,
            )
        print(
            f"| whole front end | {1e3 * total:.1f} | {1 / total:.1f} | "
            f"{1e3 * all_busy:.1f} | | load {os.getloadavg()[0]:.1f} |"
        )


if __name__ == "__main__":
    main()
