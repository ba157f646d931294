"""Videos of about the same length share what is compiled."""

import jax
import jax.numpy as jnp
import numpy as np

import bodyslam_jax.graph as g
from bodyslam_jax.solver.padding import pad


def video(frames, seed):
    """About ten new points a frame, each seen in a run of frames."""
    rng = np.random.default_rng(seed)
    count = int(9.6 * frames)
    start = rng.integers(0, frames - 4, count)
    stop = np.minimum(start + np.clip(rng.gamma(4.0, 4.0, count), 4, 48), frames)
    seen = [np.arange(a, int(b)) for a, b in zip(start, stop, strict=True)]
    landmark = np.repeat(np.arange(count), [len(x) for x in seen])
    frame = np.concatenate(seen)
    zeros = lambda *shape: jnp.asarray(np.zeros(shape))
    factor = g.Reprojection(
        frame=jnp.asarray(frame),
        landmark=jnp.asarray(landmark),
        pixel=zeros(len(frame), 2),
        sigma=jnp.asarray(np.ones(len(frame))),
        loss=g.Squared(),
    )
    state = g.State(
        scale=jnp.asarray(1.0),
        cameras=jnp.asarray(np.tile(np.eye(4), (frames, 1, 1))),
        roots=zeros(0, frames, 4, 4),
        poses=zeros(0, frames, 23, 3),
        shapes=zeros(0, 10),
        landmarks=zeros(count, 3),
        intrinsics=jnp.asarray(np.array([600.0, 600, 320, 240])),
    )
    return pad(g.make_problem([factor], state), state)


def test_videos_of_about_the_same_length_compile_few_times():
    """Ten of them, of other lengths and with other tracks, four times at most."""
    kinds = set()
    for k in range(10):
        given = video(300 - k, seed=k)
        shapes = tuple((x.shape, x.dtype.name) for x in jax.tree.leaves(given))
        kinds.add((jax.tree.structure(given), shapes))
    assert len(kinds) <= 4, len(kinds)
