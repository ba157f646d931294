"""Tracks that turn out to be of one point."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bodyslam_jax import simulation
from bodyslam_jax.config import Simulation, Structure
from bodyslam_jax.sfm import information_from_other_pieces, reconstruct, split_tracks
from bodyslam_jax.sfm.bundle import Scene, Views, errors, jacobian_of_points
from bodyslam_jax.sfm.loop_closure import Revisits, near, relocate, with_moved
from bodyslam_jax.sfm.track_splitting import information_from_other_tracks

# Bundle adjustment runs for longer than it compiles.
pytestmark = pytest.mark.usefixtures("optimised")

PIXEL = 1 / 500


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.fixture
def scene(rng):
    """Six cameras side by side before 40 points."""
    centre = np.zeros((6, 3))
    centre[:, 0] = np.linspace(-1, 1, 6)
    R_CW = Rotation.from_rotvec(0.05 * rng.standard_normal((6, 3))).as_matrix()
    points = rng.uniform([-2, -1, 3], [2, 1, 6], (40, 3))
    return Scene(R_CW, centre, points)


def seen(scene, frames, points, tracks):
    """Exact views of points, under the numbers of tracks."""
    frame, which = (x.ravel() for x in np.meshgrid(frames, np.arange(len(points))))
    p_C = scene.points[points][which] - scene.centre[frame]
    p_C = np.einsum("mij,mj->mi", scene.R_CW[frame], p_C)
    return Views(frame, np.asarray(tracks)[which], p_C[:, :2] / p_C[:, 2:])


def seen_by_all(scene):
    return seen(scene, np.arange(6), np.arange(40), np.arange(40))


def together(*views):
    fields = ("frame", "landmark", "xy")
    return Views(*(np.concatenate([getattr(v, f) for v in views]) for f in fields))


def twice_seen(scene):
    """Points 0 to 39 seen in the first frames, and again as tracks 40 to 79."""
    points = np.arange(40)
    early = seen(scene, [0, 1, 2], points, points)
    return together(early, seen(scene, [3, 4, 5], points, points + 40))


def known(scene):
    """The same cameras, and room for the points of the new tracks, unknown yet."""
    whole = Scene(scene.R_CW, scene.centre, np.tile(scene.points, (2, 1)))
    return whole, np.arange(80) < 40


def test_points_seen_again_are_found_and_joined(scene):
    views = twice_seen(scene)
    whole, has_point = known(scene)
    revisits = Revisits(views, 80)
    pairs, away = revisits.find(
        whole, 4, np.arange(40, 80), has_point, np.ones(6, bool), 2 * PIXEL
    )
    assert len(pairs) > 30 and all(one == other + 40 for one, other in pairs)
    assert away < 0.1 * PIXEL
    for one, other in pairs:
        revisits.join(one, other)
    joined = np.isin(revisits.track, [one for one, _ in pairs])
    np.testing.assert_array_equal(
        views.landmark, revisits.track - np.where(joined, 40, 0)
    )
    np.testing.assert_array_equal(
        np.sort(views.frame[revisits.views_of(pairs[0][1])]), np.arange(6)
    )


def test_they_are_found_in_a_map_that_has_drifted(scene):
    views = twice_seen(scene)
    whole, has_point = known(scene)
    turn = Rotation.from_rotvec([0.0, 0.008, 0.0]).as_matrix()  # 4 px
    whole.R_CW[3:] = turn @ whole.R_CW[3:]
    pairs, away = Revisits(views, 80).find(
        whole, 4, np.arange(40, 80), has_point, np.ones(6, bool), 2 * PIXEL
    )
    assert len(pairs) > 30 and all(one == other + 40 for one, other in pairs)
    assert 3 * PIXEL < away < 5 * PIXEL


def test_other_points_are_not(scene, rng):
    """New points lie near old ones in the image here and there, and do not agree."""
    views = twice_seen(scene)
    late = views.frame >= 3
    shift = rng.uniform(-10, 10, (80, 2)) * PIXEL
    views.xy[late] += shift[views.landmark[late]]
    whole, has_point = known(scene)
    pairs, _ = Revisits(views, 80).find(
        whole, 4, np.arange(40, 80), has_point, np.ones(6, bool), 2 * PIXEL
    )
    assert len(pairs) <= 2


def test_no_landmark_is_seen_twice_in_a_frame(scene):
    """A track that overlaps the old one in time is another point, however near."""
    views = twice_seen(scene)
    points = np.arange(40)
    views = together(views, seen(scene, [3], points, points))
    whole, has_point = known(scene)
    pairs, _ = Revisits(views, 80).find(
        whole, 4, np.arange(40, 80), has_point, np.ones(6, bool), 2 * PIXEL
    )
    assert pairs == []


def test_a_track_that_does_not_fit_is_taken_out_and_not_tried_again(scene):
    views = twice_seen(scene)
    whole, has_point = known(scene)
    revisits = Revisits(views, 80)
    for i in range(40):
        revisits.join(i + 40, i)
    error = errors(scene, views) / PIXEL
    assert error.max() < 1e-6 and revisits.part(error) == []
    wrong = revisits.track == 47
    error[wrong] = 5.0
    assert revisits.part(error) == [47]
    assert (views.landmark[wrong] == 47).all() and (views.landmark[~wrong] < 40).all()
    pairs, _ = revisits.find(
        whole, 4, np.array([47]), has_point, np.ones(6, bool), 2 * PIXEL
    )
    assert pairs == []


def test_a_camera_is_located_among_wrong_pairs(scene, rng):
    pose = scene.R_CW[2], scene.centre[2]
    off = Rotation.from_rotvec([0.004, -0.006, 0.002]).as_matrix() @ pose[0]
    views = seen(scene, [2], np.arange(40), np.arange(40))
    wrong = views.xy + rng.uniform(-10, 10, (40, 2)) * PIXEL
    points = np.tile(scene.points, (2, 1))
    xy = np.concatenate([views.xy, wrong])
    which = np.tile(np.arange(40), 2)
    found, away = relocate(points, xy, which, (off, pose[1]), 2 * PIXEL, 0.04)
    assert found is not None
    turn = Rotation.from_matrix(found[0] @ pose[0].T).magnitude()
    assert turn < 2e-3 and np.linalg.norm(found[1] - pose[1]) < 0.03
    assert 2 * PIXEL < away < 6 * PIXEL
    i, j = near(scene.points, views.xy, found, 2 * PIXEL)
    assert set(zip(i, j, strict=True)) >= {(k, k) for k in range(40)}
    # All other cameras move with it.
    both = with_moved(scene, 2, found)
    rigid = both.R_CW[6:] @ np.swapaxes(both.R_CW[:6], 1, 2)
    np.testing.assert_allclose(both.R_CW[8], found[0], atol=1e-12)
    np.testing.assert_allclose(both.centre[8], found[1], atol=1e-12)
    gaps = lambda c: np.linalg.norm(c[:, None] - c, axis=-1)
    np.testing.assert_allclose(gaps(both.centre[6:]), gaps(scene.centre), atol=1e-12)
    assert rigid.shape == (6, 3, 3)


def test_derivative_by_points_is_that_of_differences(scene):
    views = twice_seen(scene)
    views = Views(views.frame, views.landmark % 40, views.xy)
    J = jacobian_of_points(scene, views)
    size = 1e-6
    for axis in range(3):
        step = size * np.eye(3)[axis]
        ahead, behind = (
            seen(Scene(scene.R_CW, scene.centre, scene.points + s), [4], [7], [7]).xy
            for s in (step, -step)
        )
        at = np.flatnonzero((views.frame == 4) & (views.landmark == 7))
        np.testing.assert_allclose(
            J[at, :, axis], (ahead - behind) / (2 * size), rtol=1e-6
        )


def test_what_other_tracks_tell_sums_to_what_all_views_say(scene):
    views = twice_seen(scene)
    shown = np.concatenate([np.arange(40), np.arange(40)])
    shown[79] = 79  # its own
    whole = Scene(scene.R_CW, scene.centre, np.tile(scene.points, (2, 1)))
    told = information_from_other_tracks(whole, views, shown)
    J = jacobian_of_points(whole, views)
    square = np.einsum("mki,mkj->mij", J, J)
    np.testing.assert_allclose(
        told[3] + told[43], square[views.landmark % 40 == 3].sum(axis=0)
    )
    np.testing.assert_allclose(told[3], square[views.landmark == 43].sum(axis=0))
    assert (told[39] == 0).all() and (told[79] == 0).all()


def test_long_tracks_are_cut_into_pieces_that_know_of_each_other(scene):
    frame = np.concatenate([np.arange(10), np.arange(3, 6), [0, 9]])
    track = np.repeat([4, 2, 7], [10, 3, 2])
    of, piece = split_tracks(frame, track, 4)
    assert of.tolist() == [2, 4, 4, 4, 7, 7]
    for p in range(len(of)):
        seen = frame[piece == p]
        assert np.ptp(seen) < 4 and (track[piece == p] == of[p]).all()
    assert split_tracks(frame, track, 10)[0].tolist() == [2, 4, 7]
    assert split_tracks(frame[:0], track[:0], 4)[0].size == 0
    # What a piece is told are the views of the other one.
    views = seen_by_all(scene)
    of, piece = split_tracks(views.frame, views.landmark, 3)
    T_WC = np.tile(np.eye(4), (6, 1, 1))
    T_WC[:, :3, :3] = np.swapaxes(scene.R_CW, 1, 2)
    T_WC[:, :3, 3] = scene.centre
    told = information_from_other_pieces(T_WC, scene.points, views.frame, piece, of)
    J = jacobian_of_points(scene, views)
    square = np.einsum("mki,mkj->mij", J, J)
    assert len(of) == 80
    np.testing.assert_allclose(told[6], square[piece == 7].sum(axis=0))
    np.testing.assert_allclose(told[7], square[piece == 6].sum(axis=0))


@pytest.mark.slow
def test_a_camera_that_turns_back_keeps_the_size_of_its_map():
    """The same tracks, joined and not: a room filmed for eight seconds."""
    made = simulation.simulate(Simulation(sequence="D1", family="room", length=240))
    sequence = simulation.as_sequence(made)
    error = {}
    for joined in (True, False):
        found = reconstruct(
            sequence.tracks,
            sequence.intrinsics,
            240,
            Structure(join_tracks=joined),
        )
        assert found.registered.all()
        x, y = found.T_WC[:, :3, 3], made.T_WC[:, :3, 3]
        x, y = x - x.mean(axis=0), y - y.mean(axis=0)
        U, D, Vt = np.linalg.svd(y.T @ x)
        S = np.diag([1, 1, np.sign(np.linalg.det(U @ Vt))])
        scale = np.trace(np.diag(D) @ S) / (x**2).sum()
        away = np.linalg.norm(y - scale * x @ (U @ S @ Vt).T, axis=1)
        error[joined] = np.sqrt((away**2).mean())
        told = found.prior_information.any(axis=(1, 2))
        assert told.mean() > 0.5 if joined else not told.any()
    assert error[True] < 0.005  # m
    assert error[True] < 0.6 * error[False]
