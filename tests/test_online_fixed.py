"""The estimate while a video runs, before a camera that stands still or only turns: the
rule and the maps with a window that solves nothing, and all of it (slow)."""

import dataclasses

import jax
import numpy as np
import pytest

import bodyslam_jax as bs
from bodyslam_jax import evaluation, simulation
from bodyslam_jax.cli import live as command
from bodyslam_jax.config import Config, Simulation
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.io.camera.calibration import project_points
from bodyslam_jax.online import maps, online
from bodyslam_jax.online.window import Solved, Window
from bodyslam_jax.sfm.live_turning import TurningCamera
from bodyslam_jax.simulation.exact_scene import look_at
from bodyslam_jax.types import Intrinsics, Result, Sequence

CAMERA = Intrinsics(np.array([525.0, 525.0, 319.5, 239.5]), 640, 480)
FPS = 30.0


def seen_by(T_WC: np.ndarray, seed: int = 0, points: np.ndarray | None = None):
    """Pixels of points (300 at 3 to 8 m without them), with noise of 0.5 px, in each
    frame."""
    rng = np.random.default_rng(seed)
    if points is None:
        points = rng.uniform([-6, -2, 3], [6, 2, 8], (300, 3))
    for T in T_WC:
        p_C = (points - T[:3, 3]) @ T[:3, :3]
        uv = project_points(CAMERA, p_C) + 0.5 * rng.standard_normal((len(points), 2))
        inside = (p_C[:, 2] > 0.5) & (uv > 0).all(1) & (uv < [640, 480]).all(1)
        yield np.flatnonzero(inside), uv[inside]


def path(frames: int, turn: float = 0.0, start: int | None = None) -> np.ndarray:
    """T_WC of a camera that turns (rad a frame), and from frame `start` on moves
    sideways by 2 cm a frame."""
    k = np.arange(frames)
    T = np.tile(np.eye(4), (frames, 1, 1))
    T[:, :3, :3] = so3.exp(np.outer(turn * k, [0.0, 1.0, 0.0]))
    if start is not None:
        T[:, 0, 3] = 0.02 * np.maximum(k - start, 0)
    return T


# The camera.


def test_a_still_camera_keeps_its_pose_and_a_turning_one_is_followed():
    camera = TurningCamera(CAMERA)
    for ids, uv in seen_by(path(150)):
        T = camera.locate(ids, uv)
        assert T is not None and (T == np.eye(4)).all()
    assert camera.kind == "static"
    camera, truth = TurningCamera(CAMERA), path(150, turn=0.004)  # 34 degrees in all
    for T_true, (ids, uv) in zip(truth, seen_by(truth), strict=True):
        T = camera.locate(ids, uv)
        assert T is not None and (T[:3, 3] == 0).all()
        angle = np.linalg.norm(so3.log(T[:3, :3].T @ T_true[:3, :3]))
        assert angle < np.radians(0.1)
    assert camera.kind == "rotation"


def test_a_camera_of_other_points_is_lost_and_found_by_known_directions():
    camera = TurningCamera(CAMERA)
    ids, uv = next(seen_by(path(1)))
    camera.locate(ids, uv)
    points = np.array(list(camera.points.values()))
    assert camera.locate(ids + 1000, uv) is None
    assert camera.locate(ids[:5], uv[:5]) is None
    rng = np.random.default_rng(1)
    assert camera.locate(ids, uv[rng.permutation(len(uv))]) is None
    turned = so3.exp(np.array([0.0, 0.1, 0.0]))
    found = camera.relocated(points, project_points(CAMERA, points @ turned))
    assert found is not None
    assert np.linalg.norm(so3.log(found[:3, :3].T @ turned)) < 1e-6


# The maps.


@pytest.fixture
def without_solves(monkeypatch):
    """A window whose cameras are those of the front end, and nothing is compiled."""

    def advance(self: Window, frames) -> list[Solved]:
        found = []
        for start in range(0, len(frames), maps.CHUNK):
            if self.count == maps.FRAMES - maps.CHUNK:
                self._shift()
            self._take(frames[start : start + maps.CHUNK])
            found.append(self._solved(np.zeros((1, maps.FRAMES, 4)), {}))
        return found

    monkeypatch.setattr(Window, "advance", advance)
    monkeypatch.setattr(online, "compile_all", lambda *a, **b: None)


def play(
    one: bs.Online, T_WC: np.ndarray, seed: int = 0, points: np.ndarray | None = None
) -> list:
    nobody = np.zeros((0, 25, 3))
    rows = enumerate(seen_by(T_WC, seed, points))
    return [one.update(None, k / FPS, nobody, points=points) for k, points in rows]


def started(**settings) -> bs.Online:
    config = Config(**settings)
    return bs.Online(config, intrinsics=CAMERA, fps=FPS, threads=False)


def test_a_camera_without_parallax_for_three_seconds_is_fixed(without_solves):
    one = started()
    found = play(one, path(120))
    states = [e.status for e in found]
    k = states.index("fixed")
    assert set(states[:k]) == {"starting"} and set(states[k:]) == {"fixed"}
    assert found[k].timestamp == pytest.approx(maps.MAX_START_S, abs=1 / FPS)
    assert any("taken to stand still" in note for note in found[-1].notes)
    assert found[-1].located and found[-1].scale != found[-1].scale
    result = one.finish()
    assert result.summary["camera_motion"] == "static"
    assert np.abs(result.T_WC - result.T_WC[0]).max() < 1e-12
    assert any("stand still" in line for line in result.summary["warnings"])


def test_a_camera_that_moves_along_its_view_is_not_taken_to_stand_still(without_solves):
    """Three quarters of its points are 15 to 60 m away, and have little parallax."""
    rng = np.random.default_rng(2)
    depth = np.concatenate([rng.uniform(15, 60, 240), rng.uniform(4, 8, 80)])
    rays = rng.uniform([-0.5, -0.4], [0.5, 0.4], (320, 2))
    points = depth[:, None] * np.column_stack([rays, np.ones(320)])
    ahead = path(130)
    ahead[:, 2, 3] = 0.02 * np.arange(130)
    one = started()
    found = play(one, ahead, points=points)
    states = [e.status for e in found]
    assert "fixed" not in states and states[-1] == "tracking"
    begun = states.index("tracking")
    assert found[begun].timestamp >= maps.MAX_START_S
    assert maps.LITTLE_PARALLAX in found[begun - 1].notes
    assert maps.LITTLE_PARALLAX not in found[-1].notes
    assert one.finish().summary["camera_motion"] == "moving"


@pytest.mark.parametrize("factor", [1.0, 0.9])
def test_a_camera_that_turns_is_said_to_turn(without_solves, factor):
    """Also with a guessed focal length that is wrong; angles are off by its error."""
    params = CAMERA.params * [factor, factor, 1, 1]
    guess = dataclasses.replace(CAMERA, params=params, is_guess=factor != 1)
    one = bs.Online(intrinsics=guess, fps=FPS, threads=False)
    assert play(one, path(120, turn=0.003))[-1].status == "fixed"
    result = one.finish()
    assert result.summary["camera_motion"] == "rotation"
    turn = result.T_WC[0, :3, :3].T @ result.T_WC[-1, :3, :3]
    angle = np.linalg.norm(so3.log(turn))
    assert angle * factor == pytest.approx(
        0.003 * 119, rel=0.01 if factor == 1 else 0.05
    )


def test_a_fixed_camera_that_moves_begins_a_map_in_the_same_world(without_solves):
    truth = path(280, start=190)
    one = started()
    found = play(one, truth)
    states = [e.status for e in found]
    k = states.index("tracking")
    assert 190 < k < 240 and set(states[k:]) == {"tracking"}
    assert "lost" not in states
    result = one.finish()
    assert result.summary["camera_motion"] == "moving"
    told = " ".join(result.summary["warnings"])
    assert "taken to stand still" in told and "the camera moved" in told
    assert maps.TWO_MAPS not in told
    assert len(result.T_WC) == 280 and result.summary["frames_used"] == [0, 279]
    # One straight path from where the camera stood, up to the unit of the map.
    centre = result.T_WC[:, :3, 3] - result.T_WC[0, :3, 3]
    way = np.linalg.norm(centre[-1])
    there = truth[:, 0, 3] / truth[-1, 0, 3]
    away = centre - np.outer(there, centre[-1])
    assert np.linalg.norm(away, axis=1).max() < 0.02 * way
    # And the estimates' world goes on, but for the parallax that was taken for a turn.
    move = np.linalg.inv(found[k - 1].T_WC) @ found[k].T_WC
    assert np.linalg.norm(move[:3, 3]) < 0.1
    assert np.linalg.norm(so3.log(move[:3, :3])) < np.radians(3.0)


def test_a_map_that_had_begun_before_leaves_no_word_of_a_fixed_camera(without_solves):
    one = started()
    found = play(one, path(160, start=85))
    assert "fixed" in [e.status for e in found] and found[-1].status == "tracking"
    result = one.finish()
    assert "stand still" not in " ".join(result.summary["warnings"])
    assert result.summary["camera_motion"] == "moving"


def test_a_camera_said_to_stand_still_needs_no_points(without_solves):
    one = started(static_camera=True)
    nothing = np.zeros(0, int), np.zeros((0, 2))
    for k in range(12):
        now = one.update(None, k / FPS, np.zeros((0, 25, 3)), points=nothing)
        assert now.status == "fixed" and now.located
    other = started()
    for k in range(120):
        other.update(None, k / FPS, np.zeros((0, 25, 3)), points=nothing)
    last = other.latest
    assert last is not None
    assert last.status == "starting" and maps.NO_POINTS in last.notes


def test_all_points_are_recorded_once_for_a_last_pass(without_solves):
    truth = path(150, start=70)
    one = bs.Online(intrinsics=CAMERA, fps=FPS, threads=False, smooth=True)
    with pytest.raises(InputError, match="no result"):
        one.smooth()
    play(one, truth)
    measured = one.record.measured(CAMERA, "clip", ("a note",))
    assert measured.num_frames == 150 and measured.warnings == ("a note",)
    tracks = measured.tracks
    assert tracks is not None
    for k, (ids, uv) in enumerate(seen_by(truth)):
        assert (tracks.frame == k).sum() == len(ids)
        assert np.abs(tracks.uv[tracks.frame == k] - uv).max() < 1e-3  # px
    # A point keeps its number.
    each = [set(tracks.landmark[tracks.frame == k].tolist()) for k in (0, 1)]
    assert len(each[0] & each[1]) > 0.9 * len(each[0])
    bare = started()
    play(bare, path(5))
    with pytest.raises(InputError, match="smooth=True"):
        bare.smooth()
    assert bare.record.measured(CAMERA, "clip", ()).tracks is None


def test_a_last_pass_that_cannot_be_leaves_the_live_result_and_says_so():
    class Refuses:
        def smooth(self):
            raise InputError("clip: too few points.")

    class Found:
        timestamps = np.arange(3.0)
        summary: dict = {"warnings": []}

    found = Found()
    assert command._smoothed(Refuses(), found) is found
    (line,) = found.summary["warnings"]
    assert "no last offline pass" in line and "too few points" in line


# All of it.


@pytest.fixture(scope="module")
def still() -> tuple[Sequence, Result]:
    made = simulation.simulate(Simulation(sequence="E1", length=180))
    eye, aim = made.T_WC[:, :3, 3].mean(axis=0), made.walk.pelvis.mean(axis=0)
    T_WC = look_at(*(np.tile(x, (180, 1)) for x in (eye, aim)))
    made = simulation.filmed_from(made, T_WC)
    sequence = dataclasses.replace(simulation.as_sequence(made), bodies=None)
    return sequence, simulation.as_truth(made)


@pytest.mark.slow
def test_people_before_a_tripod_are_in_metres_as_offline(still):
    sequence, truth = still
    one = bs.Online(intrinsics=sequence.intrinsics, fps=FPS, threads=False)
    one.prepare()
    compiled: list[str] = []

    def listen(event: str, duration_secs: float, **about: str | int):
        if event.endswith("backend_compile_duration"):
            compiled.append(str(about.get("fun_name")))

    jax.monitoring.register_event_duration_secs_listener(listen)
    tracks, keypoints = sequence.tracks, sequence.keypoints
    assert tracks is not None and keypoints is not None
    for k in range(sequence.num_frames):
        at = tracks.frame == k
        found = np.concatenate(
            [keypoints.uv[:, k], keypoints.confidence[:, k, :, None]], axis=-1
        )
        points = tracks.landmark[at], tracks.uv[at]
        one.update(None, float(sequence.timestamps[k]), found, points=points)
    jax.monitoring.unregister_event_duration_listener(listen)
    assert compiled == []
    now = one.latest
    assert now is not None
    assert now.status == "fixed" and now.scale == 1.0 and 0 < now.scale_sigma < 0.1
    (person,) = now.people
    assert abs(person.joints[[7, 8, 10, 11], 1].min()) < 0.15  # m, on the floor
    result, offline = one.finish(), bs.run(sequence)
    for found in (result, offline):
        assert found.summary["camera_motion"] in ("static", "rotation")
    assert result.present[0].mean() > 0.95
    live, whole = (evaluation.evaluate(r, truth, one.body) for r in (result, offline))
    for name in ("h_ate_se3", "j_ate_se3"):
        assert float(live[name]) < 1.3 * float(whole[name]) + 0.02  # m
    stature = lambda r: r.summary["people"][0]["stature_m"]
    assert stature(result) == pytest.approx(stature(offline), abs=0.05)
