"""Loops of the live map: the graph of poses, places, and what a correction changes."""

import dataclasses

import numpy as np
import pytest

from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.online.loops import NO_CORRECTION, Correction, Loops
from bodyslam_jax.online.window import Solved
from bodyslam_jax.sfm.places import Place, sighting
from bodyslam_jax.sfm.pose_graph import Edge, Nodes, PoseGraph, residuals
from bodyslam_jax.types import Intrinsics

CAMERA = Intrinsics(np.array([500.0, 500.0, 319.5, 239.5]), 640, 480)
THRESHOLD, EXTENT = 3 / 500, np.array([0.64, 0.48])


def pose(vector: list[float], centre: list[float]) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = so3.exp(np.array(vector)), centre
    return T


def ring(count: int) -> np.ndarray:
    """Cameras on a circle, looking along it."""
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return np.array([pose([0, -a, 0], [np.cos(a), 0.1 * a, np.sin(a)]) for a in angle])


def measured(nodes: Nodes, a: int, b: int, loop: bool = False) -> Edge:
    """The edge that fits two cameras exactly."""
    blank = Edge(a, b, np.eye(4), 0.0, np.diag([1e-4] * 7), loop)
    r = residuals(nodes, [blank])[0][0]
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = nodes.R[a].T @ nodes.R[b], r[3:6]
    return dataclasses.replace(blank, T=T, log_ratio=float(r[6]))


def truth(count: int = 8) -> Nodes:
    T = ring(count)
    return Nodes(T[:, :3, :3], T[:, :3, 3], np.linspace(0, 0.2, count))


def test_a_graph_finds_the_cameras_that_its_edges_measure():
    exact = truth()
    edges = [measured(exact, i, i + 1) for i in range(7)]
    edges.append(measured(exact, 0, 7, loop=True))
    rng = np.random.default_rng(0)
    away = 0.05 * rng.standard_normal((8, 7))
    away[0] = 0.0
    found = PoseGraph(exact.move(away), edges).solve()
    np.testing.assert_allclose(found.R, exact.R, atol=1e-6)
    np.testing.assert_allclose(found.t, exact.t, atol=1e-6)
    np.testing.assert_allclose(found.log_unit, exact.log_unit, atol=1e-6)


def test_derivatives_of_an_edge_are_those_of_its_error():
    nodes = truth()
    edge = measured(nodes, 2, 5)
    r, J = (x[0] for x in residuals(nodes, [edge]))
    np.testing.assert_allclose(r, 0, atol=1e-12)
    for k in range(14):
        step = np.zeros((8, 7))
        step[(2, 5)[k // 7], k % 7] = 1e-6
        later = residuals(nodes.move(step), [edge])[0][0]
        np.testing.assert_allclose((later - r) / 1e-6, J[:, k], atol=1e-5)


def test_the_error_of_a_loop_is_normalised_by_what_the_graph_knows():
    exact = dataclasses.replace(truth(), t=np.zeros((8, 3)))
    graph = PoseGraph(exact, [measured(exact, i, i + 1) for i in range(7)])
    loop = measured(exact, 0, 7, loop=True)
    ratio = dataclasses.replace(loop, log_ratio=loop.log_ratio + 0.1)
    found = graph.squared_error([loop, ratio])
    # The unit has seven steps' variance, and the loop's own.
    np.testing.assert_allclose(found, [0, 0.1**2 / 8e-4], atol=1e-9)


def scene(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Points before a camera, and their descriptors."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(2, 5, 200)
    xy = rng.uniform(-1, 1, (200, 2)) * EXTENT
    points = np.concatenate([xy, np.ones((200, 1))], axis=1) * depth[:, None]
    return points, rng.integers(0, 256, (200, 32), dtype=np.uint8)


def seen_from(T: np.ndarray, unit: float, seed: int = 0) -> Place:
    """The place as a camera at T in the first one's frame sees it, where the map's unit
    is `unit` as long."""
    points, descriptors = scene(seed)
    p = (points - T[:3, 3]) @ T[:3, :3] / unit
    rng = np.random.default_rng(9)
    noise = 1 + 0.02 * rng.standard_normal((len(p), 1))
    return Place(descriptors, p * noise)


def test_two_views_of_a_place_tell_pose_and_unit():
    T = pose([0.02, 0.05, -0.03], [0.2, -0.05, 0.1])
    found = sighting(seen_from(np.eye(4), 1.0), seen_from(T, 0.9), THRESHOLD, EXTENT)
    assert found is not None
    sigma = np.sqrt(np.diag(found.covariance))
    assert abs(found.log_ratio - np.log(0.9)) < 3 * sigma[6] < 0.05
    turn = so3.log(found.T[:3, :3].T @ T[:3, :3])
    assert np.abs(turn).max() < 3 * sigma[:3].max()
    shift = found.T[:3, 3] * np.sqrt(0.9) - T[:3, 3]
    assert np.abs(shift).max() < 3 * sigma[3:6].max() < 0.06


def test_another_place_and_a_small_picture_are_no_sighting():
    here = seen_from(np.eye(4), 1.0)
    other = seen_from(np.eye(4), 1.0, seed=1)
    assert sighting(here, other, THRESHOLD, EXTENT) is None
    small = (np.abs(here.points[:, :2] / here.points[:, 2:]) < 0.5 * EXTENT).all(axis=1)
    assert small.sum() > 30
    part = Place(here.descriptors[small], here.points[small])
    assert sighting(part, here, THRESHOLD, EXTENT) is None


# A camera that goes round and comes back, of whose map the unit shrinks.

DRIFT = 0.9
"""Unit at the end, in units at the beginning."""
COUNT = 12


def window(T: np.ndarray) -> Solved:
    """A window without people that has all slots of a path."""
    frames = len(T)
    return Solved(
        first=-10,
        times=np.arange(frames) / 10,
        T_WC=T,
        located=np.ones(frames, bool),
        people=(),
        present=np.zeros((0, frames), bool),
        roots=np.zeros((0, frames, 4, 4)),
        poses=np.zeros((0, frames, 23, 3)),
        shapes=np.zeros((0, 10)),
        shape_covariance=np.zeros((0, 10, 10)),
        scale=4.0,
        scale_sigma=0.2,
        landmarks={},
        contacts=np.zeros((0, frames, 4)),
        seconds={},
    )


def drifting() -> tuple[np.ndarray, np.ndarray]:
    """The true path of slots, back where it began, and that of the map."""
    slots = 20 * (COUNT - 1) + 1
    angle = np.linspace(0, 2 * np.pi, slots)
    exact = np.array(
        [pose([0, 0.3 * np.sin(a), 0], [1 - np.cos(a), 0, np.sin(a)]) for a in angle]
    )
    unit = DRIFT ** np.linspace(0, 1, slots)
    found = exact.copy()
    steps = np.diff(exact[:, :3, 3], axis=0) / unit[1:, None]
    found[1:, :3, 3] = np.cumsum(steps, axis=0)
    return exact, found


def looped(last: Place) -> tuple[Loops, Correction | None, np.ndarray, np.ndarray]:
    """Loops of that path; its last keyframe sees `last`, and others their own place."""
    exact, found = drifting()
    loops = Loops(CAMERA)
    for k in range(COUNT):
        place = seen_from(np.eye(4), 1.0, seed=k)
        if k == COUNT - 1:
            place = last
        loops.add(place, 2.0 * k, 20 * k, np.eye(4), found[20 * k])
    past = np.tile(found[0], (10, 1, 1))
    correction = loops.close([window(np.concatenate([past, found]))])
    return loops, correction, exact, found


def test_a_loop_closes():
    # The first place again, in a unit that is shorter.
    loops, correction, exact, found = looped(seen_from(np.eye(4), DRIFT))
    assert correction is not None and len(loops.edges) == 1
    assert correction.unit == pytest.approx(DRIFT, abs=0.01)
    corrected, scale = correction.at(np.arange(len(found)), found)
    assert np.linalg.norm(found[-1, :3, 3]) > 0.1
    assert np.linalg.norm(corrected[-1, :3, 3]) < 0.01
    away = np.linalg.norm(corrected[:, :3, 3] - exact[:, :3, 3], axis=1)
    before = np.linalg.norm(found[:, :3, 3] - exact[:, :3, 3], axis=1)
    assert away.max() < 0.4 * before.max()
    assert np.all(np.diff(scale) <= 1e-9)
    # What is seen now is where it was.
    now = correction.now(found[-1])
    np.testing.assert_allclose(now, corrected[-1], atol=1e-12)
    points = np.array([[0.3, 0.2, 2.0]])
    there = correction.scale[-1] * correction.back(points) @ correction.R[-1].T
    np.testing.assert_allclose(there + correction.t[-1], points, atol=1e-12)


def test_places_that_look_alike_are_refused_where_no_drift_explains_them():
    # The camera is back at the first place, and sees what it saw two metres from there.
    loops, correction, *_ = looped(seen_from(np.eye(4), 1.0, seed=COUNT // 2 - 1))
    assert correction is None and loops.refused == 1 and not loops.edges
    assert loops.correction is NO_CORRECTION


def test_nothing_changes_without_a_loop():
    loops, correction, _, found = looped(seen_from(np.eye(4), 1.0, seed=99))
    assert correction is None and not loops.refused
    slots = np.arange(len(found))
    same, unit = loops.correction.at(slots, found)
    np.testing.assert_array_equal(same, found)
    np.testing.assert_array_equal(unit, 1.0)
    np.testing.assert_array_equal(loops.correction.now(found[3]), found[3])
