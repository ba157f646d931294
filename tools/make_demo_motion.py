"""Makes the recordings of `bodyslam_jax/simulation/assets`: walks, and other motion.

    python tools/make_demo_motion.py DATA_FOLDER

`DATA_FOLDER` holds `cmu_locomotion.npz`, `cmu_other.npz` and `cmu_more.npz`, archives
of CMU trials as SMPL rotations; the output has the same arrays, so the same reader
reads both. Of walks only trials that are raw CMU recordings (source `kc-amc`) of the
archive's validation subjects are taken: motion models are trained on the others. Of
other motion only trials of subjects whom neither the posture prior nor the lifting
network learnt from.
"""

import sys
from pathlib import Path
from typing import Any

import numpy as np
from make_posture_prior import HELD_OUT

from bodyslam_jax.simulation import RECORDINGS

TRIALS = "02_01 02_02 08_01 08_02 08_03 08_04 08_06 08_09".split()
OTHER_FROM = {
    "14_32": 20, "14_traffic": 600, "02_06": 60, "49_18": 0, "06_12": 0,
    "14_33": 140, "02_07": 300, "14_08": 340, "02_04": 0, "14_21": 30,
}  # fmt: skip
"""First frame of the part that is kept: what the trial is named for happens in the four
seconds from there."""
OTHER_FRAMES = 300
OUT = Path(__file__).parents[1] / "bodyslam_jax/simulation/assets"

Arrays = dict[str, np.ndarray]


def chosen(data: Arrays, rows: list[int], first: list[int], frames: int) -> Arrays:
    """Arrays of some sequences, from frame `first` of each, at most `frames` long."""
    starts = data["seq_start"][rows] + first
    lengths = np.minimum(data["seq_length"][rows] - first, frames)
    wanted = np.concatenate([s + np.arange(n) for s, n in zip(starts, lengths)])
    people = np.isin(data["subjects"], data["seq_subject"][rows])
    new = {k: v[rows] for k, v in data.items() if k.startswith("seq_")}
    new["seq_length"] = lengths
    new["subjects"] = data["subjects"][people]
    new["subject_offsets"] = data["subject_offsets"][people]
    # 1e-4 rad and 0.1 mm are far below what the capture measures, and compress better
    new["poses"] = data["poses"][wanted].round(4).astype(np.float32)
    new["trans"] = data["trans"][wanted].round(4).astype(np.float32)
    return new | {name: data[name] for name in ("fps", "joint_names", "parents")}


def joined(parts: list[Arrays]) -> Arrays:
    """Sequences of several archives in one; of a person who is in two, the subject of
    each archive is another one, as the archives' sizes of a person differ."""
    for k, part in enumerate(parts[1:], 1):
        again = np.isin(part["subjects"], parts[0]["subjects"])
        names = dict(zip(part["subjects"], part["subjects"]))
        names |= {n: f"{n}#{k}" for n in part["subjects"][again]}
        for key in ("subjects", "seq_subject"):
            part[key] = np.array([names[n] for n in part[key]])
    shared = ("fps", "joint_names", "parents")
    names = [n for n in parts[0] if n not in shared and all(n in p for p in parts)]
    new = {n: np.concatenate([p[n] for p in parts]) for n in names}
    return new | {name: parts[0][name] for name in shared}


def write(name: str, new: dict[str, Any]) -> None:
    new["seq_start"] = np.cumsum(new["seq_length"]) - new["seq_length"]
    OUT.mkdir(exist_ok=True)
    np.savez_compressed(OUT / name, allow_pickle=False, **new)
    print(
        OUT / name, (OUT / name).stat().st_size, "bytes,", len(new["poses"]), "frames"
    )


def walks(folder: Path) -> None:
    data = dict(np.load(folder / "cmu_locomotion.npz", allow_pickle=False))
    keep = np.isin(data["seq_name"], TRIALS) & (data["seq_phase"] == 0)
    keep &= (data["seq_split"] == "val") & (data["seq_source"] == "kc-amc")
    rows = np.flatnonzero(keep).tolist()
    if len(rows) != len(TRIALS):
        raise ValueError(f"{folder}: found {len(rows)} of the {len(TRIALS)} trials.")
    write("walking.npz", chosen(data, rows, [0] * len(rows), max(data["seq_length"])))


def others(folder: Path) -> None:
    wanted, parts = [trial for trial, _ in RECORDINGS.values()], []
    for name in ("other", "more"):
        data = dict(np.load(folder / f"cmu_{name}.npz", allow_pickle=False))
        keep = np.isin(data["seq_name"], wanted) & (data["seq_phase"] == 0)
        rows = np.flatnonzero(keep & np.isin(data["seq_subject"], HELD_OUT)).tolist()
        first = [OTHER_FROM[n] for n in data["seq_name"][rows]]
        parts.append(chosen(data, rows, first, OTHER_FRAMES))
    new = joined(parts)
    if sorted(new["seq_name"]) != sorted(wanted):
        raise ValueError(f"{folder}: found {sorted(new['seq_name'])} of {wanted}.")
    write("other.npz", new)


if __name__ == "__main__":
    walks(Path(sys.argv[1]))
    others(Path(sys.argv[1]))
