"""Where the networks that ship put the keypoints of rendered people.

`python benchmarks/detector_on_rendered.py [--frames N] [NAME-FAMILY ...]`: the named
sequences of `experiment video`, detection alone, so that it takes a fifth of the time.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np

from bodyslam_jax import io, pipeline, simulation
from bodyslam_jax.config import Simulation
from bodyslam_jax.experiments.video import detection_figures, filmed
from bodyslam_jax.experiments.video_table import keypoint_table


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sequences", nargs="*", default=["E2-room", "M3-follow"])
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--seed", type=int)
    options = parser.parse_args()
    rows = []
    for name in options.sequences:
        sequence, family = name.split("-")
        settings = filmed(
            Simulation(
                sequence=sequence,  # pyright: ignore
                family=family,  # pyright: ignore
                length=options.frames,
                seed=options.seed,
            )
        )
        simulated = simulation.simulate(settings)
        with tempfile.TemporaryDirectory() as folder:
            film = simulation.film_scene(Path(folder) / "film", simulated)
            found = pipeline.find_people(io.read_sequence(film))
        row = detection_figures(simulated, found)
        people = 0 if found.keypoints is None else len(found.keypoints.uv)
        p = (simulated.joints - simulated.T_WC[:, None, :3, 3]) @ simulated.T_WC[
            :, :3, :3
        ]
        height = np.ptp(p[..., 1] / p[..., 2], axis=1) * simulated.intrinsics[1]
        print(
            f"{name}: found in {100 * row['found']:.0f} % of the frames, "
            f"{np.median(height):.0f} px high; {people} of {settings.people} people",
            flush=True,
        )
        rows.append({"sequence": name, **row})
    print(keypoint_table(rows))


if __name__ == "__main__":
    main()
