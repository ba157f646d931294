"""Learns the probability that somebody sits from how far the pelvis moves, and how.

    python tools/sitting_probability.py CMU.npz ...

Recordings are those of people who sit (`SITTING`, while the thighs are more than 50
degrees off the vertical) and of all who stand (thighs below 40). Half of the weight is
on people who sit, a quarter on walkers and runners, a quarter on all others who stand;
in each group people count alike. Prints the constants of
`bodyslam_jax.diagnostics.seated`, and how people fare who were left out: mean log
likelihood (chance is -0.69), mean probability by group, and the share of those who sit
by the probability that is said. Then the mean posture of the left leg of people who sit
(right legs are mirrored), for `bodyslam_jax.pipeline.seated_legs`, and the errors of
legs of people who were left out. The tables stand in `benchmarks/plausibility.md`.
"""

import argparse
from pathlib import Path

import numpy as np
from plausibility_thresholds import place

from bodyslam_jax import motion
from bodyslam_jax.body.skeleton import ANKLES, HIPS, KNEES
from bodyslam_jax.diagnostics.seated import (
    SEATED_THIGH_DEGREES,
    log_movement,
    pelvis_movement,
    thigh_angle,
)
from bodyslam_jax.geometry import so3_numpy as so3

SITTING = ("01_08", "13_01", "14_27", "14_28", "14_29", "14_31", "14_32")
STANDING_THIGH_DEGREES = 40.0
EVERY = 5  # frames
SHARES = {"sits": 0.5, "walks": 0.25, "stands": 0.25}
BINS = (0.0, 0.1, 0.3, 0.5, 0.7, 1.0)
RIDGE = 1e-3


def frames(path: Path) -> list[tuple[str, str, float]]:
    """Subject, group and movement (logarithm) of every fifth frame of an archive."""
    found = []
    for clip in motion.read_motion(path):
        if clip.phase:
            continue
        joints = place(clip)
        thighs = thigh_angle(joints)
        moved = log_movement(pelvis_movement(joints[:, 0], clip.fps))
        for thigh, x in zip(thighs[::EVERY], moved[::EVERY]):
            subject = clip.name.split("_")[0]
            if thigh > SEATED_THIGH_DEGREES and clip.name in SITTING:
                found.append((subject, "sits", x))
            elif thigh < STANDING_THIGH_DEGREES:
                walks = clip.motion in ("walk", "run")
                found.append((subject, "walks" if walks else "stands", x))
    return found


def weights(subject: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Weights of frames by `SHARES`, the same for each subject of a group."""
    found = np.zeros(len(group))
    for name, share in SHARES.items():
        people = np.unique(subject[group == name])
        for one in people:
            mine = (group == name) & (subject == one)
            found[mine] = share / len(people) / mine.sum()
    return found


def learn(x: np.ndarray, sits: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Log odds at 0, and their slope, by Newton's method."""
    X, b = np.stack([np.ones(len(x)), x], 1), np.zeros(2)
    for _ in range(50):
        p = 1 / (1 + np.exp(-X @ b))
        H = (X * (weight * p * (1 - p))[:, None]).T @ X + RIDGE * np.eye(2) / len(x)
        b = b + np.linalg.solve(H, X.T @ (weight * (sits - p)) - RIDGE * b / len(x))
    return b


Legs = tuple[str, np.ndarray, np.ndarray]


def legs(path: Path) -> list[Legs]:
    """Subject, rotations (thigh, knee, ankle) of the left leg and of the mirrored right
    one, and positions of their knees and ankles about the hips in units of thigh and
    shin, of all frames of an archive in which somebody sits."""
    found = []
    for clip in motion.read_motion(path):
        if clip.phase or clip.name not in SITTING:
            continue
        joints = place(clip)
        here = thigh_angle(joints) > SEATED_THIGH_DEGREES
        turn = so3.exp(clip.poses.reshape(-1, 24, 3)[here].astype(float))
        joints = joints[here]
        left = turn[:, 0, :, 0] * [1.0, 0.0, 1.0]
        left = left / np.linalg.norm(left, axis=1, keepdims=True)
        up = np.broadcast_to([0.0, 1.0, 0.0], left.shape)
        level = np.swapaxes(np.stack([left, up, np.cross(left, up)], axis=-1), 1, 2)
        for side, sign in enumerate(([1.0, 1.0, 1.0], [1.0, -1.0, -1.0])):
            hip, knee, ankle = (pair[side] for pair in (HIPS, KNEES, ANKLES))
            thigh = level @ turn[:, 0] @ turn[:, hip]
            rotations = np.stack([thigh, turn[:, knee], turn[:, ankle]], axis=1)
            bones = np.stack(
                [joints[:, knee] - joints[:, hip], joints[:, ankle] - joints[:, knee]],
                1,
            )
            bones = np.einsum("tij,tkj->tki", level, bones) * [sign[1], 1.0, 1.0]
            found.append((clip.name.split("_")[0], so3.log(rotations) * sign, bones))
    return found


def mean_posture(found: list[Legs]) -> np.ndarray:
    """Mean rotations, in which people count alike, by steps on the manifold."""
    people = sorted({subject for subject, *_ in found})
    each = [np.concatenate([r for s, r, _ in found if s == one]) for one in people]
    mean = so3.exp(each[0][0])
    for _ in range(20):
        away = [
            so3.log(np.swapaxes(mean, 1, 2) @ so3.exp(r)).mean(axis=0) for r in each
        ]
        mean = mean @ so3.exp(np.mean(away, axis=0))
    return so3.log(mean)


def tell_posture(found: list[Legs]) -> None:
    print("thigh, knee, ankle, rad:", mean_posture(found).round(2).tolist())
    for one in sorted({subject for subject, *_ in found}):
        thigh, knee, _ = so3.exp(mean_posture([leg for leg in found if leg[0] != one]))
        bones = np.concatenate([b for s, _, b in found if s == one])
        length = np.linalg.norm(bones, axis=2, keepdims=True)
        # A bone of the body at rest hangs.
        guess = -np.stack([thigh[:, 1], (thigh @ knee)[:, 1]]) * length
        error = np.cumsum(guess - bones, axis=1)
        rms = np.sqrt((error**2).sum(axis=2).mean(axis=0))
        print(f"  {one} left out: knee {rms[0]:.2f} m, ankle {rms[1]:.2f} m")


def main() -> None:
    parser = argparse.ArgumentParser(description="Learns who sits, and how.")
    parser.add_argument("archives", type=Path, nargs="+")
    archives = parser.parse_args().archives
    tell_posture([leg for path in archives for leg in legs(path)])
    rows = [row for path in archives for row in frames(path)]
    subject, group, x = (np.array(column) for column in zip(*rows))
    sits, weight = group == "sits", weights(subject, group)
    print(
        "log odds at 1 m, and for each unit of its logarithm:", learn(x, sits, weight)
    )
    p = np.zeros(len(x))
    for one in np.unique(subject):
        rest = subject != one
        learnt = learn(x[rest], sits[rest], weights(subject[rest], group[rest]))
        p[~rest] = 1 / (1 + np.exp(-learnt[0] - learnt[1] * x[~rest]))
    likely = weight @ np.log(np.where(sits, p, 1 - p))
    print(f"people left out: log likelihood {likely:.3f}")
    for name in SHARES:
        for one in np.unique(subject[group == name]) if name == "sits" else [None]:
            mine = (group == name) & ((subject == one) if one else True)
            low, high = np.quantile(p[mine], [0.05, 0.95])
            mean = weight[mine] @ p[mine] / weight[mine].sum()
            print(f"  {name} {one or ''}: {mean:.2f} ({low:.2f} to {high:.2f})")
    for low, high in zip(BINS[:-1], BINS[1:]):
        here = (p >= low) & (p < high)
        if here.any():
            share = weight[here] @ sits[here] / weight[here].sum()
            print(f"  said {low} to {high}: {share:.2f} sit ({weight[here].sum():.2f})")


if __name__ == "__main__":
    main()
