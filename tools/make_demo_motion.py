"""Makes `bodyslam_jax/simulation/assets/walking.npz`: a few seconds of CMU walking.

    python tools/make_demo_motion.py CMU_LOCOMOTION.npz

The input is an archive of CMU trials as SMPL rotations; the output has the same
arrays, so the same reader reads both. Only trials that are raw CMU recordings
(source `kc-amc`) of the archive's validation subjects are taken: motion models are
trained on the others.
"""

import sys
from pathlib import Path

import numpy as np

TRIALS = "02_01 02_02 08_01 08_02 08_03 08_04 08_06 08_09".split()
OUT = Path(__file__).parents[1] / "bodyslam_jax/simulation/assets/walking.npz"


def main(path: Path) -> None:
    data = dict(np.load(path, allow_pickle=False))
    rows = [
        i
        for i, (name, phase, split, source) in enumerate(
            zip(
                data["seq_name"],
                data["seq_phase"],
                data["seq_split"],
                data["seq_source"],
                strict=True,
            )
        )
        if name in TRIALS and phase == 0 and split == "val" and source == "kc-amc"
    ]
    if len(rows) != len(TRIALS):
        raise ValueError(f"{path}: found {len(rows)} of the {len(TRIALS)} trials.")
    starts, lengths = data["seq_start"], data["seq_length"]
    frames = np.concatenate([starts[i] + np.arange(lengths[i]) for i in rows])
    people = np.isin(data["subjects"], data["seq_subject"][rows])
    new = {k: v[rows] for k, v in data.items() if k.startswith("seq_")}
    new["seq_start"] = np.cumsum(new["seq_length"]) - new["seq_length"]
    new["subjects"] = data["subjects"][people]
    new["subject_offsets"] = data["subject_offsets"][people]
    # 1e-4 rad and 0.1 mm are far below what the capture measures, and compress better
    new["poses"] = data["poses"][frames].round(4).astype(np.float32)
    new["trans"] = data["trans"][frames].round(4).astype(np.float32)
    for name in ("fps", "joint_names", "parents"):
        new[name] = data[name]
    OUT.parent.mkdir(exist_ok=True)
    np.savez_compressed(OUT, allow_pickle=False, **new)
    print(OUT, OUT.stat().st_size, "bytes,", len(frames), "frames")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
