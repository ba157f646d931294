"""Learns the posture prior of `bodyslam_jax.people` from CMU motion capture.

    python tools/make_posture_prior.py DATA_FOLDER OUT.npz [PRIOR.npz]

`DATA_FOLDER` holds `cmu_locomotion.npz`, `cmu_other.npz` and `cmu_more.npz`: SMPL joint
rotations at 30 fps with the arrays `poses` (n, 24, 3), `seq_name`, `seq_start`,
`seq_length`, `seq_subject`, `seq_split` and `seq_phase`. What is learnt and why is in
`bodyslam_jax/people/posture_prior.py`; what was held out is in the model card there.
With PRIOR.npz all but the limits are taken from it: lifters speak in its components.
"""

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

FILES = ("locomotion", "other", "more")
# Both elbows bend backwards, by 100 degrees. Bent forwards by as much, the forearms
# remain twisted as in no other trial (34 mm from the prior, where others are 5).
DROPPED = ("13_18",)
NUM_JOINTS = 21  # all but the root and the two hands, which CMU does not measure
HELD_OUT = ("02", "06", "08", "14", "49", "55")  # subjects that only tests may see
RANK = 32
LOCOMOTION_SHARE = 0.5  # weight of walking and running against everything else
LIMIT_QUANTILE = 1e-3
LIMIT_MARGIN = np.radians(6.0)
# How far, in m, a radian at each joint moves the keypoints below it, roughly: the
# principal components are those of metres, not of radians.
LEVER = np.array(
    [0.85, 0.85, 0.5, 0.45, 0.45, 0.5, 0.15, 0.15, 0.5, 0.05, 0.05]
    + [0.2, 0.55, 0.55, 0.15, 0.55, 0.55, 0.27, 0.27, 0.08, 0.08]
).repeat(3)


def unknown_to(files: list[Path]) -> tuple[str, ...]:
    """The subjects of whom none of these files learnt."""
    unknown = [set(np.load(file)["held_out_subjects"].tolist()) for file in files]
    return tuple(sorted(set(HELD_OUT).intersection(*unknown)))


def archives(folder: Path) -> Iterator[tuple[str, dict[str, np.ndarray], np.ndarray]]:
    """Name and arrays of each file, and which of its sequences may be used at all."""
    for name in FILES:
        data = dict(np.load(folder / f"cmu_{name}.npz"))
        usable = (data["seq_split"] != "heldout") & ~np.isin(data["seq_name"], DROPPED)
        yield name, data, usable


def sequences(data: dict[str, np.ndarray], keep: np.ndarray) -> list[np.ndarray]:
    """The sequences of one file that are kept and their mirror images, (n, 63) each."""
    names = list(data["joint_names"])
    sides = {"L": "R", "R": "L"}
    mirrored = [
        names.index(sides[n[0]] + n[1:] if n[:2] in ("L_", "R_") else n) for n in names
    ]
    found = []
    for start, length in zip(data["seq_start"][keep], data["seq_length"][keep]):
        poses = data["poses"][start : start + length].astype(np.float64)
        for each in (poses, poses[:, mirrored] * [1.0, -1.0, -1.0]):
            found.append(each[:, 1 : 1 + NUM_JOINTS].reshape(length, -1))
    return found


def limits(frames: np.ndarray) -> dict[str, np.ndarray]:
    """Without weights: extremes are the point of them."""
    lower, upper = np.quantile(frames, (LIMIT_QUANTILE, 1 - LIMIT_QUANTILE), axis=0)
    lower, upper = lower - LIMIT_MARGIN, upper + LIMIT_MARGIN
    return {"lower": lower.astype(np.float32), "upper": upper.astype(np.float32)}


def main(folder: Path, out: Path, prior: Path | None = None) -> None:
    walking, other = [], []
    for name, data, usable in archives(folder):
        keep = usable & ~np.isin(data["seq_subject"], HELD_OUT)
        group = walking if name == "locomotion" else other
        group += sequences(data, keep & (data["seq_phase"] == 0))
    groups = [walking, other]
    shares = (LOCOMOTION_SHARE, 1 - LOCOMOTION_SHARE)
    stacked = [np.concatenate(group) for group in groups]
    frames = np.concatenate(stacked)
    if prior is not None:
        np.savez_compressed(out, **dict(np.load(prior)) | limits(frames))
        return
    weight = np.concatenate(
        [np.full(len(s), share / len(s)) for s, share in zip(stacked, shares)]
    )
    mean = weight @ frames
    scaled = (frames - mean) * LEVER
    variance, axes = np.linalg.eigh((scaled * weight[:, None]).T @ scaled)
    variance, axes = variance[::-1][:RANK], axes[:, ::-1][:, :RANK]
    basis = axes * np.sqrt(variance) / LEVER[:, None]
    encode = axes.T * LEVER / np.sqrt(variance)[:, None]

    # Second-order autoregression of each (unit-variance) component, Yule--Walker. Lag
    # correlations come from mean squared differences: exact for smooth motion, and
    # the mean of a short sequence does not bias them.
    lag = []
    for step in (1, 2):
        squares = [
            np.mean(
                np.concatenate(
                    [((s[step:] - s[:-step]) @ encode.T) ** 2 for s in group]
                ),
                0,
            )
            for group in groups
        ]
        lag.append(1 - 0.5 * np.average(squares, axis=0, weights=shares))
    first, second = lag
    a1 = first * (1 - second) / (1 - first**2)
    a2 = (second - first**2) / (1 - first**2)

    np.savez_compressed(
        out,
        mean=mean.astype(np.float32),
        basis=basis.astype(np.float32),
        autoregression=np.stack([a1, a2], 1),
        **limits(frames),
        frames=len(frames),
        held_out_subjects=np.array(HELD_OUT),
        source="CMU Graphics Lab Motion Capture Database, mocap.cs.cmu.edu",
    )
    residual = scaled - (scaled @ axes) @ axes.T
    print(f"{len(frames)} frames, {RANK} components")
    print(
        f"unexplained: {1e3 * np.sqrt(3 * weight @ (residual**2).mean(1)):.1f} mm rms"
    )
    print("innovation", np.sqrt(1 - a1 * first - a2 * second).round(3))


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
