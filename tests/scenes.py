"""Small made-up scenes for the tests of graph and solver: truth, factors, a start."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from own_factors import CameraSmoothness, StillFeet

import bodyslam_jax.graph as g
from bodyslam_jax.body import load_body_model, local_keypoints
from bodyslam_jax.geometry.camera import project
from bodyslam_jax.solver.compilation import compiled

INTRINSICS = np.array([600.0, 600.0, 320.0, 240.0])


@functools.cache
def body_model():
    return load_body_model(dtype=jnp.float64)


def look(yaw, pitch):
    """Camera axes in a world with y down and z forward."""
    return np.array(
        [
            [np.cos(yaw), np.sin(yaw) * np.sin(pitch), np.sin(yaw) * np.cos(pitch)],
            [0, np.cos(pitch), -np.sin(pitch)],
            [-np.sin(yaw), np.cos(yaw) * np.sin(pitch), np.cos(yaw) * np.cos(pitch)],
        ]
    )


def truth(rng, frames=12, people=1, landmarks=40, scale=1.7):
    """A camera that sways, people who walk before it, points around."""
    k = np.arange(frames)
    cameras = np.tile(np.eye(4), (frames, 1, 1))
    for i in range(frames):
        cameras[i, :3, :3] = look(0.15 * np.sin(0.3 * i), 0.05 * np.cos(0.4 * i))
        cameras[i, :3, 3] = [0.06 * i, 0.05 * np.sin(0.5 * i), 0.04 * i]
    roots = np.tile(np.eye(4), (people, frames, 1, 1))
    poses = 0.1 * rng.standard_normal((people, 1, 23, 3)) * np.ones((1, frames, 1, 1))
    for h in range(people):
        poses[h, :, 0, 0] += 0.4 * np.sin(0.4 * k + h)
        poses[h, :, 1, 0] -= 0.4 * np.sin(0.4 * k + h)
        for i in range(frames):
            place = np.array([0.8 * h - 0.3 + 0.02 * i, 0.1, 4.0 + 0.05 * i])
            turn = look(np.pi + 0.4 + 0.02 * i, 0.0) @ np.diag([1.0, -1, -1])
            C, r = cameras[i, :3, :3], scale * cameras[i, :3, 3]
            roots[h, i, :3, :3] = C.T @ turn
            roots[h, i, :3, 3] = C.T @ (place - r)
    points = rng.uniform([-4, -2, 4], [5, 2, 9], (landmarks, 3)) / scale
    return g.State(
        scale=jnp.asarray(scale),
        cameras=jnp.asarray(cameras),
        roots=jnp.asarray(roots),
        poses=jnp.asarray(poses),
        shapes=jnp.asarray(0.5 * rng.standard_normal((people, 10))),
        landmarks=jnp.asarray(points),
        intrinsics=jnp.asarray(INTRINSICS),
    )


def observations(rng, state, length=8, again=False, far=0):
    """Frame and landmark of each observation: runs of frames, with holes; with `again`
    the camera goes back as it came, and sees every other point on its way; the last
    `far` points are seen all the time."""
    frames, count = len(state.cameras), len(state.landmarks)
    start = rng.integers(-length // 2, frames - 1, count)
    seen = (np.arange(frames)[:, None] >= start) & (
        np.arange(frames)[:, None] < start + rng.integers(3, length + 1, count)
    )
    if again:
        seen[:, ::2] |= seen[::-1, ::2]
    seen[:, count - far :] = True
    seen &= rng.random(seen.shape) < 0.9
    return np.nonzero(seen)


def reprojection(rng, state, noise=0.5, length=8, loss=1.5, again=False, far=0):
    frame, landmark = observations(rng, state, length, again, far)
    camera = np.asarray(state.cameras)[frame]
    offset = np.asarray(state.landmarks)[landmark] - camera[:, :3, 3]
    p_C = np.einsum("mji,mj->mi", camera[:, :3, :3], offset)
    pixel = np.asarray(project(state.intrinsics, jnp.asarray(p_C)))
    return g.Reprojection(
        frame=jnp.asarray(frame),
        landmark=jnp.asarray(landmark),
        pixel=jnp.asarray(pixel + noise * rng.standard_normal(pixel.shape)),
        sigma=jnp.ones(len(frame)),
        loss=g.Cauchy(loss),
    )


def person_factors(rng, state, noise=1.0, correlation=0.9):
    """Keypoints, motion, postures and shape, as measured on the true state."""
    h, t = state.roots.shape[:2]
    body = body_model()
    sigma = np.full((h, t, 25), 3.0)
    sigma[rng.random(sigma.shape) < 0.1] = np.inf
    shapes = {"rotation": (h, 1, 23, 3), "pixel": (h, t, 25, 2), "moved": (h, t, 3)}
    draws = {name: noise * rng.standard_normal(s) for name, s in shapes.items()}
    found = _measured(body, state, jax.tree.map(jnp.asarray, draws), correlation)
    shape_sigma = np.full((h, t, 10), np.inf)
    shape_sigma[:, 0] = 0.5
    return [
        g.KeypointReprojection(
            body=body,
            pixel=found["pixel"],
            sigma=jnp.asarray(sigma),
            loss=g.GemanMcClure(20.0),
        ),
        g.HumanMotion(**found["motion"]),
        g.BodyPosePrior(
            **found["posture"], sigma=jnp.asarray(np.full((h, t, 23), 0.15))
        ),
        g.ShapePrior(shape=found["shape"], sigma=jnp.asarray(shape_sigma)),
    ]


# In one program: one by one its operations take five times as long to compile.
@compiled
def _measured(body, state, draws, correlation):
    """What `person_factors` measures, by the errors that it draws."""
    h, t = state.roots.shape[:2]
    p_H = local_keypoints(body, state.poses, state.shapes[:, None], "body25")
    p_C = jnp.einsum("htij,htkj->htki", state.roots[..., :3, :3], p_H)
    pixel = project(state.intrinsics, p_C + state.roots[..., None, :3, 3])
    windows = g.HumanMotion(
        translation=jnp.zeros((h, t, 3)),
        whitening=jnp.zeros((h, t, 3, 3)),
        correlation=jnp.zeros((h, t)),
    )
    moved = windows.map_frames(
        lambda d, w, s, _: g.displacement(w[1], w[0], s.scale), state
    )
    there = jnp.ones((h, t), bool)
    valid = there.at[:, 0].set(False)
    covariance = jnp.diag(jnp.array([0.01, 0.02, 0.015]) ** 2)
    covariance = jnp.broadcast_to(covariance, (h, t, 3, 3))
    posture = g.retract_rotation(
        state.poses, 0.05 * draws["rotation"] * jnp.ones((1, t, 1, 1))
    )
    return {
        "pixel": pixel + draws["pixel"],
        "motion": {
            "translation": moved + 0.003 * draws["moved"],
            "whitening": g.whitening_of(covariance, valid),
            "correlation": g.ar1_correlation(valid, correlation),
        },
        "posture": {
            "rotation": posture,
            "correlation": g.ar1_correlation(there, correlation),
        },
        "shape": state.shapes[:, None] + jnp.zeros((h, t, 1)),
    }


def landmark_prior(rng, state, seen=None):
    """Half of the landmarks seen known besides, each its own way; not quite true."""
    l = len(state.landmarks)
    whitening = 5 * rng.standard_normal((l, 3, 3))
    whitening[::2] = 0.0
    if seen is not None:
        whitening[~np.isin(np.arange(l), np.asarray(seen.landmark))] = 0.0
    away = 0.05 * rng.standard_normal((l, 3))
    return g.LandmarkPrior(
        position=state.landmarks + away, whitening=jnp.asarray(whitening)
    )


def extra_factors(rng, state, seen=None):
    """All that `person_factors` leaves out, for its blocks: not all of it true."""
    h, t = state.roots.shape[:2]
    i = len(state.intrinsics)
    body = body_model()
    normal = lambda *shape: jnp.asarray(rng.standard_normal(shape))
    late = lambda *shape, skip: jnp.full(shape, 0.05).at[:, :skip].set(jnp.inf)
    there = jnp.ones((h, t), bool)
    moved = there.at[:, 0].set(False)
    steps = {
        "translation": 0.1 * normal(h, t, 3),
        "whitening": g.whitening_of(0.02 * jnp.eye(3) + jnp.zeros((h, t, 3, 3)), moved),
        "correlation": g.ar1_correlation(moved, 0.8),
    }
    turned = 0.3 * normal(h, t, 3)
    return [
        landmark_prior(rng, state, seen),
        g.HumanMotion(**steps, body=body),
        g.HumanMotion(**steps, correlated=False),
        g.BodyPosePrior(
            rotation=state.poses + 0.1 * normal(h, t, 23, 3),
            sigma=jnp.full((h, t, 23), 0.3),
            correlation=g.ar1_correlation(there, 0.9),
            correlated=False,
        ),
        g.CameraPrior(cameras=state.cameras, sigma=jnp.full((t, 6), 0.3)),
        g.IntrinsicsPrior(
            intrinsics=state.intrinsics[None], sigma=jnp.full((1, i), 20.0)
        ),
        g.AspectRatioPrior(sigma=jnp.array([3.0])),
        g.ScalePrior(scale=jnp.full(t, 1.6), sigma=jnp.full(t, jnp.inf).at[2].set(0.2)),
        g.Stature(
            template=jnp.asarray(1.7),
            slope=0.05 * normal(10),
            height=jnp.full((h, t), 1.8),
            sigma=jnp.full((h, t), jnp.inf).at[:, 1].set(0.02),
        ),
        CameraSmoothness(sigma=jnp.full((t, 2), 0.05).at[:2].set(jnp.inf)),
        g.RootSmoothness(sigma=late(h, t, skip=2)),
        g.RootSmoothness(sigma=late(h, t, skip=2), body=body),
        g.AngularAccelerationPrior(sigma=late(h, t, skip=2)),
        g.RootOrientation(
            orientation=state.roots[..., :3, :3] @ jaxlie.SO3.exp(turned).as_matrix(),
            sigma=jnp.full((h, t), 0.2),
            correlation=g.ar1_correlation(there, 0.9),
        ),
        g.RootPositionPrior(
            position=state.roots[..., :3, 3] + 0.1,
            sigma=jnp.full((h, t, 2), 0.05),
            correlation=g.ar1_correlation(there, 0.9),
        ),
        StillFeet(body=body, sigma=late(h, t, 4, skip=1)),
        g.FootContact(
            body=body,
            shape=0.3 * normal(h, 1, 10) + jnp.zeros((h, t, 1)),
            scale=jnp.full((h, t), 1.5),
            sigma=late(h, t, 4, skip=1),
        ),
        g.GroundContact(
            body=body,
            normal=jnp.array([0.1, -0.99, 0.1]),
            offset=1.2 + 0.1 * normal(h, t),
            sigma=late(h, t, skip=1),
            height=0.2 + 0.1 * normal(h, t),
        ),
    ]


def perturb(rng, problem, state, size=0.02, scale=1.0):
    """A start off the truth, where the problem lets it move."""
    draw = lambda x: jnp.asarray(size * rng.standard_normal(x.shape))
    moved = _moved(state, jax.tree.map(draw, state.zero_step()), problem.free)
    return dataclasses.replace(moved, scale=state.scale * scale)


@compiled
def _moved(state, step, free):
    return state.retract(jax.tree.map(jnp.multiply, step, free))
