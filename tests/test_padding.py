"""Videos of any length share what is compiled."""

import jax
import jax.numpy as jnp
import numpy as np

import bodyslam_jax.graph as g
from bodyslam_jax.solver.padding import pad


def video(frames, seed, common_sizes=True):
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
    return pad(g.make_problem([factor], state, common_sizes=common_sizes), state)


def kind(given):
    """What decides whether JAX compiles a program anew."""
    shapes = tuple((x.shape, x.dtype.name) for x in jax.tree.leaves(given))
    return jax.tree.structure(given), shapes


def test_videos_of_thirty_to_a_thousand_frames_share_six_programs():
    kinds = {kind(video(n, seed=n)) for n in (30, 47, 61, 115, 180, 250, 333, 400, 990)}
    assert len(kinds) <= 6, len(kinds)


def test_a_dense_map_without_people_is_not_padded_by_default():
    """A long one, whose empty tables would take as much time as its own."""
    (own, _), (common, _) = video(250, 0, None), video(250, 0)
    assert own.layout.num_chunks == 26 < common.layout.num_chunks
    assert own.layout.num_landmarks < common.layout.num_landmarks
    assert kind(video(150, 0, None)) == kind(video(150, 0))


def layout_of(frames, count, length):
    """Of `count` tracks of `length` frames."""
    start = np.linspace(0, frames - length, count).astype(int)
    frame = (start[:, None] + np.arange(length)).ravel()
    return g.make_layout(frames, count, frame, np.repeat(np.arange(count), length))


def test_a_problem_that_does_not_fit_gets_the_next_size_or_one_of_its_own():
    assert layout_of(47, 90, 5).num_chunks == 6
    assert layout_of(47, 900, 5).num_chunks == 12
    long = layout_of(400, 900, 150)
    assert long.used is None
    assert long.num_chunks == 40
