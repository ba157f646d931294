"""Made-up scenes for the solver's benchmarks: a hand-held camera behind walkers.

The generator is the project's own and seeded; what it draws is simulated.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import bodyslam_jax.graph as g
from bodyslam_jax.body import load_body_model, local_keypoints
from bodyslam_jax.geometry.camera import project

INTRINSICS = np.array([900.0, 900.0, 640.0, 360.0])
TRACK = 16.0
"""Mean length of a track, frames."""
AGAIN = 0.3
"""Share of the points that are seen on the way back too."""
CORRIDOR = np.array([1.6, 1.4, 25.0])
"""Half of a corridor's width and height, and how far along it points are seen, m."""
MEDIAN, SPREAD, LONGEST = 15.0, 0.7, 60
"""Tracks in the corridor: median length, frames; standard deviation of its logarithm;
longest."""
SEEN = 150
"""Points in each frame in the corridor."""
DRIFT = 0.012
"""Standard deviation of the change of the start's logarithm of scale, from frame to
frame of the corridor."""
SECOND = ("sixteen", "deep", "outliers", "sparse")
"""Tracks of a second generator, which chose nothing in the solver: all of exactly
`TRACK` frames; the same at depths of 1 to 200 m; the same with a quarter of outliers;
or few landmarks seen long, and a start far away."""
DEEP = 1.0, 200.0
"""Depths of `deep`, m; their logarithms are uniform."""
OUTLIERS = 0.25
SPARSE = 2.3
"""Landmarks of `sparse` for each frame; their tracks have 20 to 60 frames."""
LOST = 0.1
"""Standard deviation of the cameras of the start of `sparse`, rad and units of the
map."""
FAR = 40
"""Points so far away that the camera has them before it all the way."""


def turn(axis, angle):
    """Rotation matrices about a coordinate axis."""
    c, s = np.cos(angle), np.sin(angle)
    R = np.zeros((len(angle), 3, 3))
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    R[:, axis, axis] = 1
    R[:, i, i], R[:, j, j], R[:, i, j], R[:, j, i] = c, c, -s, s
    return R


def make_scene(frames, people, rng, back, scale=1.3):
    """A hand-held camera that follows people who walk, points all along the way; with
    `back` it turns round half-way, and all go back as they came."""
    k = np.arange(frames)
    if back:
        k = np.minimum(k, k[::-1])
    wave = lambda size, period, phase: size * np.sin(2 * np.pi * k / period + phase)
    yaw, pitch = wave(0.2, 170, 0.3) + wave(0.03, 23, 1), wave(0.06, 61, 2)
    cameras = np.tile(np.eye(4), (frames, 1, 1))
    cameras[:, :3, :3] = turn(1, yaw) @ turn(0, pitch) @ turn(2, wave(0.03, 41, 0))
    step = 0.03
    cameras[:, 0, 3] = wave(0.4, 140, 0)
    cameras[:, 1, 3] = wave(0.03, 15, 0)
    cameras[:, 2, 3] = step * k + wave(0.1, 90, 1)
    roots = np.tile(np.eye(4), (people, frames, 1, 1))
    poses = np.zeros((people, frames, 23, 3))
    for h in range(people):
        swing = 2 * np.pi * k / 32 + h
        poses[h, :, 0, 0], poses[h, :, 1, 0] = 0.4 * np.sin(swing), -0.4 * np.sin(swing)
        poses[h, :, 3, 0] = 0.5 * (1 + np.sin(swing - 1.5)) * 0.7
        poses[h, :, 4, 0] = 0.5 * (1 - np.sin(swing - 1.5)) * 0.7
        poses[h, :, 15, 2], poses[h, :, 16, 2] = -1.2, 1.2
        poses[h] += 0.05 * rng.standard_normal((1, 23, 3))
        place = np.stack([0.7 * h + wave(0.3, 200, h), 0.1 + 0 * k, 4.5 + step * k], 1)
        world = turn(1, wave(0.3, 150, h)) @ np.diag([-1.0, -1.0, 1.0])
        C = cameras[:, :3, :3].transpose(0, 2, 1)
        roots[h, :, :3, :3] = C @ world
        away = place - cameras[:, :3, 3]
        roots[h, :, :3, 3] = np.einsum("tij,tj->ti", C, away)
    cameras[:, :3, 3] /= scale
    return scale, cameras, roots, poses


def make_tracks(frames, cameras, scale, rng, tracks, per_frame=9.6):
    """Points seen in a run of frames each; about 10 new ones a frame. Of `long` tracks
    each is as likely to be lost in the next frame as any other, and some last long;
    some points of `again` are seen a second time, on the way back; the last few of
    `far` are distant, and found in one frame of three all the time. Those of `corridor`
    are on its walls, floor and ceiling, their lengths log-normal. Those of `SECOND` are
    described there."""
    if tracks == "corridor":
        # Of long tracks the first and last points are out of the image.
        per_frame = 1.15 * SEEN / (MEDIAN * np.exp(SPREAD**2 / 2))
    if tracks == "sparse":
        per_frame = SPARSE
    count = int(per_frame * frames)
    start = rng.integers(-int(TRACK) // 2, frames - 2, count)
    if tracks == "long":
        length = 3 + rng.geometric(1 / (TRACK - 3), count)
    elif tracks == "corridor":
        length = rng.lognormal(np.log(MEDIAN), SPREAD, count)
        length = np.clip(length, 3, LONGEST).astype(int)
    elif tracks == "sparse":
        length = rng.integers(20, 61, count)
    elif tracks in SECOND:
        start = rng.integers(0, frames - int(TRACK), count)
        length = np.full(count, int(TRACK))
    else:
        length = np.clip(rng.gamma(4.0, TRACK / 4, count), 4, 3 * TRACK).astype(int)
    stop = np.minimum(start + length, frames)
    start = np.maximum(start, 0)
    keep = stop - start >= 3
    start, stop = start[keep], stop[keep]
    middle = (start + stop) // 2
    u = rng.uniform([40, 40], [1240, 680], (len(start), 2))
    if tracks == "deep":
        depth = np.exp(rng.uniform(*np.log(DEEP), len(start))) / scale
    else:
        depth = rng.uniform(3.0, 14.0, len(start)) / scale
    ray = np.concatenate(
        [(u - INTRINSICS[2:]) / INTRINSICS[:2], np.ones((len(u), 1))], 1
    )
    camera = cameras[middle]
    if tracks == "corridor":
        away = np.einsum("mij,mj->mi", camera[:, :3, :3], ray)
        to_wall = (CORRIDOR - np.abs(camera[:, :3, 3] * [1, 1, 0]) * scale) / np.abs(
            away
        )
        depth = to_wall.min(axis=1) / scale
    points = camera[:, :3, 3] + np.einsum(
        "mij,mj->mi", camera[:, :3, :3], ray * depth[:, None]
    )
    landmark = np.repeat(np.arange(len(start)), stop - start)
    frame = np.concatenate([np.arange(a, b) for a, b in zip(start, stop, strict=True)])
    if tracks == "again":
        twice = (rng.random(len(start)) < AGAIN)[landmark]
        frame = np.concatenate([frame, frames - 1 - frame[twice]])
        landmark = np.concatenate([landmark, landmark[twice]])
        # Tracks about the turning point have some of these frames already.
        frame, landmark = np.unique([frame, landmark], axis=1)
    if tracks == "far":
        away = rng.uniform([-0.3, -0.2, 1], [0.3, 0.2, 1], (FAR, 3))
        away *= rng.uniform(200, 600, (FAR, 1)) / scale
        known = np.nonzero(rng.random((frames, FAR)) < 1 / 3)
        frame = np.concatenate([frame, known[0]])
        landmark = np.concatenate([landmark, len(points) + known[1]])
        points = np.concatenate([points, away])
    return points, frame, landmark


def make(
    frames,
    people=1,
    seed=0,
    dtype: type = np.float64,
    outliers=0.03,
    loss=None,
    draw=0,
    noise=1.0,
    tracks="short",
):
    """A problem, its true state, and a start; `draw` numbers the noise on one scene,
    and `noise` multiplies it, with the sigmas; `tracks` are of `make_tracks`."""
    rng = np.random.default_rng(seed)
    scale, cameras, roots, poses = make_scene(frames, people, rng, tracks == "again")
    points, frame, landmark = make_tracks(frames, cameras, scale, rng, tracks)
    array = lambda x: jnp.asarray(np.asarray(x, dtype))
    truth = g.State(
        scale=array(scale),
        cameras=array(cameras),
        roots=array(roots),
        poses=array(poses),
        shapes=array(0.5 * rng.standard_normal((people, 10))),
        landmarks=array(points),
        intrinsics=array(INTRINSICS),
    )
    camera = cameras[frame]
    p_C = np.einsum(
        "mji,mj->mi", camera[:, :3, :3], points[landmark] - camera[:, :3, 3]
    )
    pixel = np.array(project(truth.intrinsics, array(p_C)), float)
    seen = p_C[:, 2] > 0.3
    if tracks == "corridor":
        seen &= np.all((pixel > 0) & (pixel < 2 * INTRINSICS[2:]), axis=1)
    missing = rng.random((people, frames, 25)) < 0.1
    # The scene is the same for every draw, so that one compilation serves all.
    rng = np.random.default_rng((seed, draw))
    pixel += noise * rng.standard_normal(pixel.shape)
    if tracks == "outliers":
        outliers = OUTLIERS
    wrong = rng.random(len(pixel)) < outliers
    pixel[wrong] += rng.uniform(-80, 80, (wrong.sum(), 2))
    frame, landmark, pixel = frame[seen], landmark[seen], pixel[seen]
    factors: list = [
        g.Reprojection(
            frame=jnp.asarray(frame),
            landmark=jnp.asarray(landmark),
            pixel=array(pixel),
            sigma=array(np.full(len(frame), noise)),
            loss=g.Cauchy(1.5) if loss is None else loss,
        )
    ]
    if people:
        factors += person(truth, missing, rng, array, loss, noise)
    problem = g.make_problem(factors, truth)
    jitter = LOST if tracks == "sparse" else 2e-3
    start = start_of(problem, truth, rng, array, jitter)
    if tracks == "corridor":
        start = with_scale_drift(start, frame, landmark, rng)
    return problem, truth, start


def with_scale_drift(state, frame, landmark, rng):
    """The state as odometry leaves it: the scale of the path wanders, and landmarks
    have that of the middle of their tracks."""
    centres, points = np.asarray(state.cameras[:, :3, 3]), np.asarray(state.landmarks)
    scale = np.exp(np.cumsum(DRIFT * rng.standard_normal(len(centres))))
    steps = np.diff(centres, axis=0, prepend=centres[:1])
    drifted = centres[0] + np.cumsum(scale[:, None] * steps, axis=0)
    number = np.maximum(np.bincount(landmark, minlength=len(points)), 1)
    middle = np.bincount(landmark, frame, minlength=len(points)) / number
    k = np.round(middle).astype(int)
    moved = drifted[k] + scale[k, None] * (points - centres[k])
    return eqx.tree_at(
        lambda s: (s.cameras, s.landmarks),
        state,
        (state.cameras.at[:, :3, 3].set(drifted), jnp.asarray(moved, points.dtype)),
    )


def person(truth, missing, rng, array, loss, noise):
    """Factors of people: keypoints, motion, postures and shape, with their noise."""
    h, t = truth.roots.shape[:2]
    body = load_body_model(dtype=truth.scale.dtype)
    pixel, moved = exact(truth, body)
    pixel = np.asarray(pixel, float) + 4.0 * noise * rng.standard_normal(pixel.shape)
    sigma = np.where(missing, np.inf, 4.0 * noise)
    slow = lambda size, rho, shape: noise * size * drift(rng, shape, rho)
    valid = jnp.ones((h, t), bool).at[:, 0].set(False)
    covariance = array(np.tile(np.diag(3 * [0.01 * noise]) ** 2, (h, t, 1, 1)))
    posture = turned(truth.poses, array(slow(0.17, 0.96, (h, t, 23, 3))))
    shape_sigma = np.full((h, t, 10), np.inf)
    shape_sigma[:, 0] = 0.5 * noise
    measured = truth.shapes[:, None] + array(
        shape_sigma[0, 0, 0] * rng.standard_normal((h, 1, 10))
    )
    return [
        g.KeypointReprojection(
            body=body,
            pixel=array(pixel),
            sigma=array(sigma),
            loss=g.GemanMcClure(16.0) if loss is None else loss,
        ),
        g.HumanMotion(
            translation=moved + array(slow(0.01, 0.8, (h, t, 3))),
            whitening=g.whitening_of(covariance, valid),
            correlation=g.ar1_correlation(valid, 0.8).astype(truth.scale.dtype),
        ),
        g.BodyPosePrior(
            rotation=posture,
            sigma=array(np.full((h, t, 23), 0.17 * noise)),
            correlation=g.ar1_correlation(jnp.ones((h, t), bool), 0.96).astype(
                truth.scale.dtype
            ),
        ),
        g.ShapePrior(
            shape=measured + array(np.zeros((h, t, 10))), sigma=array(shape_sigma)
        ),
    ]


@eqx.filter_jit
def exact(truth, body):
    """Keypoints in px, and displacements in m, without noise."""
    h, t = truth.roots.shape[:2]
    p_H = local_keypoints(body, truth.poses, truth.shapes[:, None], "body25")
    p_C = jnp.einsum("htij,htkj->htki", truth.roots[..., :3, :3], p_H)
    pixel = project(truth.intrinsics, p_C + truth.roots[..., None, :3, 3])
    blank = g.HumanMotion(
        translation=jnp.zeros((h, t, 3), p_C.dtype),
        whitening=jnp.zeros((h, t, 3, 3), p_C.dtype),
        correlation=jnp.zeros((h, t), p_C.dtype),
    )
    moved = lambda d, w, s, _: g.displacement(w[1], w[0], s.scale)
    return pixel, blank.map_frames(moved, truth)


turned = jax.jit(g.retract_rotation)
moved_by = jax.jit(lambda state, step: state.retract(step))


def drift(rng, shape, rho):
    """AR(1) along axis 1, stationary variance 1."""
    white = rng.standard_normal(shape)
    out = np.empty(shape)
    out[:, 0] = white[:, 0]
    for k in range(1, shape[1]):
        out[:, k] = rho * out[:, k - 1] + np.sqrt(1 - rho**2) * white[:, k]
    return out


def start_of(problem, truth, rng, array, jitter):
    """What initialisation leaves: cameras that drift and `jitter`, points off,
    regressed bodies."""
    t = len(truth.cameras)
    wander = np.cumsum(rng.standard_normal((t, 6)), axis=0) * 3e-4
    zero = truth.zero_step()
    step = g.Step(
        scale=zero.scale,
        cameras=array(wander + jitter * rng.standard_normal((t, 6))),
        roots=array(0.05 * rng.standard_normal(zero.roots.shape)),
        poses=zero.poses,
        shapes=array(0.5 * rng.standard_normal(zero.shapes.shape)),
        landmarks=array(0.1 * rng.standard_normal(zero.landmarks.shape)),
        intrinsics=zero.intrinsics,
    )
    moved = moved_by(truth, jax.tree.map(lambda s, m: s * m, step, problem.free))
    for factor in problem.factors:
        if isinstance(factor, g.BodyPosePrior):
            moved = eqx.tree_at(lambda s: s.poses, moved, factor.rotation)
    return moved
