"""Generates paths of people on the floor, and of a hand-held camera that films them.

World: y up, floor at y = 0, metres; paths on the floor are (x, z).
"""

import dataclasses

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d

from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.motion import FPS
from bodyslam_jax.simulation.exact_scene import look_at


@dataclasses.dataclass(frozen=True)
class Handling:
    """Parameters of the motion of a hand-held camera: easy, medium or difficult."""

    radius: tuple[float, float]
    """RMS distance of the camera from its mean position in a room, m."""
    speed: float
    """RMS speed of that motion, m/s."""
    aim: float
    """RMS distance by which the camera misses the person's middle, m."""
    shake: float
    """RMS of fast motion, m."""
    tremble: float
    """RMS of fast rotation, rad per axis."""
    swing: float
    """RMS change of the direction from which a person is followed, rad."""
    track_life: float
    """Mean duration of a track, frames: fast motion ends tracks sooner."""


HANDLING = {
    "E": Handling((0.40, 0.55), 0.20, 0.12, 0.003, 0.004, 0.25, 30.0),
    "M": Handling((0.50, 0.70), 0.45, 0.18, 0.006, 0.008, 0.5, 22.0),
    "D": Handling((0.65, 0.80), 0.75, 0.25, 0.012, 0.016, 0.8, 16.0),
}


_FOLLOWING_DISTANCE_M = 3.7
_AROUND_SPEED = 1.1
"""Speed of a camera that walks around somebody, m/s: a slow walk."""


def smooth_noise(
    rng: np.random.Generator, num_frames: int, seconds: float, width: int = 1
) -> Float[np.ndarray, "t {width}"]:
    """Returns Gaussian noise of standard deviation 1 that varies within about
    `seconds`."""
    sigma = seconds * FPS
    pad = int(4 * sigma) + 1
    x = gaussian_filter1d(rng.standard_normal((num_frames + 2 * pad, width)), sigma, 0)
    return x[pad:-pad] * np.sqrt(2 * np.sqrt(np.pi) * sigma)


def floor_path(
    family: str, around: bool, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "p 2"], Float[np.ndarray, "2"]]:
    """Returns a closed path to walk on, and the place of a camera that stays in a room
    (m).

    In a room the path is a loop in front of the camera at 2.5 to 6 m, or with `around`
    a larger one around it; a path to be followed is 70 m long. Orientation and
    direction are random.
    """
    angle = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    angle = angle * rng.choice([-1, 1]) + rng.uniform(0, 2 * np.pi)
    if family == "follow":
        phase = rng.uniform(0, 2 * np.pi, 3)
        bumps = np.array([0.10, 0.08, 0.05]) * np.cos(
            np.outer(angle, [2, 3, 4]) + phase
        )
        radius = 11.0 * (1 + bumps.sum(axis=1))
        path = np.stack([radius * np.cos(angle), 0.8 * radius * np.sin(angle)], 1)
        return path, np.zeros(2)
    a, b = (3.5, 3.0) if around else (2.3, 1.9)
    a, b = (a, b) * rng.uniform(0.92, 1.08, 2)
    path = np.stack([a * np.cos(angle), b * np.sin(angle)], axis=1)
    away = rng.uniform(0.2, 0.7) if around else b + rng.uniform(2.3, 2.7)
    camera = np.array([rng.uniform(-0.4, 0.4), -away])
    turn = rng.uniform(0, 2 * np.pi)
    c, s = np.cos(turn), np.sin(turn)
    R = np.array([[c, -s], [s, c]])
    return path @ R.T, R @ camera


def film_room(
    person: Float[np.ndarray, "t 3"],
    place: Float[np.ndarray, "2"],
    handling: Handling,
    rng: np.random.Generator,
) -> Float[np.ndarray, "t 4 4"]:
    """Returns the poses (camera to world) of a camera that stays near `place` and turns
    towards the `person`."""
    t = len(person)
    radius = rng.uniform(*handling.radius)
    drift = smooth_noise(rng, t, radius / (np.sqrt(2) * handling.speed), 3)
    drift = (drift - drift.mean(axis=0)) * [1.0, 0.25, 1.0]
    drift *= radius / np.sqrt((drift**2).sum(axis=1).mean())
    eye = drift + [place[0], rng.uniform(1.35, 1.6), place[1]]
    return _in_hand(eye, person, handling, rng)


def film_following(
    person: Float[np.ndarray, "t 3"], handling: Handling, rng: np.random.Generator
) -> Float[np.ndarray, "t 4 4"]:
    """Returns the poses (camera to world) of a camera that follows the `person`, behind
    or beside, at 3 to 4.5 m."""
    smooth = gaussian_filter1d(person, 0.6 * FPS, axis=0, mode="nearest")
    heading = np.gradient(gaussian_filter1d(smooth, 1.2 * FPS, axis=0), axis=0)
    yaw = np.unwrap(np.arctan2(heading[:, 0], heading[:, 2]))
    return _film_from(yaw, person, handling, rng)


def film_around(
    person: Float[np.ndarray, "t 3"], handling: Handling, rng: np.random.Generator
) -> Float[np.ndarray, "t 4 4"]:
    """Returns the poses (camera to world) of a camera that walks around a `person` who
    stays about where they are, at 3 to 4.5 m."""
    rate = rng.choice([-1, 1]) * _AROUND_SPEED / _FOLLOWING_DISTANCE_M / FPS
    yaw = rng.uniform(0, 2 * np.pi) + rate * np.arange(len(person))
    return _film_from(yaw, person, handling, rng)


def _film_from(
    yaw: Float[np.ndarray, " t"],
    person: Float[np.ndarray, "t 3"],
    handling: Handling,
    rng: np.random.Generator,
) -> Float[np.ndarray, "t 4 4"]:
    """Returns the poses of a camera behind or beside a person who heads for `yaw` (rad,
    from z to x)."""
    t = len(person)
    smooth = gaussian_filter1d(person, 0.6 * FPS, axis=0, mode="nearest")
    side = rng.choice([-1, 1]) * rng.uniform(0.3, 1.2)
    yaw = yaw + np.pi + side + handling.swing * smooth_noise(rng, t, 2.5)[:, 0]
    distance = _FOLLOWING_DISTANCE_M
    distance = distance + 0.35 * np.clip(smooth_noise(rng, t, 2.5)[:, 0], -2, 2)
    eye = smooth + distance[:, None] * np.stack(
        [np.sin(yaw), np.zeros(t), np.cos(yaw)], axis=1
    )
    eye = gaussian_filter1d(eye, 0.3 * FPS, axis=0, mode="nearest")
    step = (
        2 * np.pi * (1.8 * np.arange(t) / FPS + 0.3 * smooth_noise(rng, t, 1.0)[:, 0])
    )
    height = 1.5 + 0.1 * smooth_noise(rng, t, 2.0)[:, 0] + 0.015 * np.sin(step)
    eye[:, 1] = height
    return _in_hand(eye, person, handling, rng)


def _in_hand(
    eye: Float[np.ndarray, "t 3"],
    person: Float[np.ndarray, "t 3"],
    handling: Handling,
    rng: np.random.Generator,
) -> Float[np.ndarray, "t 4 4"]:
    """Returns camera poses aimed at the person with the delay, offset and tremor of a
    hand."""
    t = len(person)
    late = np.concatenate([np.repeat(person[:1], 4, axis=0), person])[:t]
    target = gaussian_filter1d(late, 0.25 * FPS, axis=0, mode="nearest")
    target = target + handling.aim * smooth_noise(rng, t, 0.8, 3) * [1, 0.6, 1]
    T_WC = look_at(eye + handling.shake * smooth_noise(rng, t, 0.08, 3), target)
    tremble = handling.tremble * smooth_noise(rng, t, 0.08, 3)
    tremble[:, 2] += 0.03 * smooth_noise(rng, t, 1.0)[:, 0]
    T_WC[:, :3, :3] = T_WC[:, :3, :3] @ so3.exp(tremble)
    return T_WC
