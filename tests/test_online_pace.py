"""What the live estimate does where the machine is slower than the video."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from passing_camera import CAMERA, passing

import bodyslam_jax as bs
from bodyslam_jax import graph, motion, simulation
from bodyslam_jax.config import Config, Simulation
from bodyslam_jax.online import maps, online
from bodyslam_jax.online.record import Record, Seen, Slot, evenly, parts_of
from bodyslam_jax.online.slots import Slots
from bodyslam_jax.online.window import Solved, Window
from bodyslam_jax.online.window_content import FRAMES, Measured
from bodyslam_jax.online.window_problem import at_times
from bodyslam_jax.people.live import LivePeople

PIXELS = np.random.default_rng(5).uniform([-40, 150], [40, 350], (25, 2))


def walker(u: float) -> np.ndarray:
    """Keypoints of somebody 200 px high at a column of the image."""
    return np.column_stack([PIXELS + [u, 0.0], np.full(25, 0.9)])


def test_a_person_is_known_after_the_same_time_whatever_frames_are_left_out():
    for rate in (30, 10):
        people = LivePeople(fps=30.0)
        times = np.arange(0, 12 * 30 // rate) / rate
        known = [
            bool(people.given(walker(200 + 60 * t)[None], float(t))) for t in times
        ]
        assert 0.15 < times[known.index(True)] < 0.21


def test_people_are_expected_where_their_velocity_takes_them():
    people = LivePeople(fps=30.0)
    for k in range(6):
        people.given(walker(200 + 300 * k / 10)[None], k / 10)
    (person,) = people.expected(0.6).values()
    away = np.median(person[2:8, 0]) - np.median(walker(350)[2:8, 0])
    assert 22 < away < 30  # px, of 30 px at 300 px/s; velocities decay


@pytest.mark.parametrize("fps", [20, 25, 30, 60])
def test_slots_have_frames_at_even_times(fps):
    """Also where frames lie halfway between two slots."""
    stride = max(1, round(fps / 10))
    slots = Slots(stride / fps, origin=100.0)
    nothing = np.eye(4), True, np.zeros(0, int), np.zeros((0, 2)), {}
    for k in range(4 * fps):
        slots.take(Measured(100.0 + k / fps, *nothing))
    times = np.array([frame.time for _, frame in slots.waiting])
    assert np.ptp(np.diff(times[1:])) < 1e-9
    assert [n for n, _ in slots.waiting] == list(range(len(times)))


def test_maps_that_begin_later_keep_the_clock_of_the_first():
    slots = Slots(0.1, origin=2.0)
    nothing = np.eye(4), True, np.zeros(0, int), np.zeros((0, 2)), {}
    for time in (5.14, 5.16, 5.3):
        slots.take(Measured(time, *nothing))
    assert [(n, frame.time) for n, frame in slots.waiting] == [
        (0, 5.14),
        (1, 5.16),
        (2, 5.3),
    ]


def recorded(times: np.ndarray) -> Record:
    """A camera and a person that go 1 m/s sideways past 10 frames of the window a
    second; frames are used at some times only."""
    record, away = Record(), np.eye(4)
    away[:3, 3] = [0.0, 0.0, 4.0]
    pose = lambda t: np.array(
        [[1, 0, 0, t], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]
    )
    for k in range(21):
        body = {0: (away, np.zeros((23, 3)), np.ones(4))}
        record.slots[0, k] = Slot(k / 10, pose(k / 10), True, body)
    for n, t in enumerate(times):
        slot = min(int(t * 10 + 1e-6), 20)
        since, looked = pose(t - slot / 10), n % 2 == 0
        people = {0: walker(200 + 60 * t)} if looked else {}
        record.frames.append(Seen(t, 0, slot, since, True, people, None, looked))
    record.scales[0] = [(20, 1.0, 0.05)]
    record.shapes[0], record.shape_covariances[0] = np.zeros(10), np.eye(10)
    return record


DROPPED = np.array([0, 1, 3, 4, 6, 12, 13, 15, 16, 18, 25, 26, 27, 30, 40, 42, 43]) / 30


def test_a_result_has_even_times_where_frames_were_dropped():
    """Speeds and accelerations are judged by frames, as if they were at even times."""
    given = CAMERA, "walk", 10.0, (), 30.0
    measured, cameras, joint = parts_of(recorded(DROPPED), *given)
    times = measured.timestamps
    assert np.ptp(np.diff(times)) < 1e-9 and np.diff(times)[0] == pytest.approx(0.1)
    assert cameras.registered.all() and joint.present.all()
    assert np.abs(cameras.T_WC[:, 0, 3] - times).max() < 1e-6
    assert np.abs(joint.roots[0, :, 2, 3] - 4.0).max() < 1e-6
    # Keypoints are interpolated, but not over more than a third of a second.
    assert measured.keypoints is not None
    u, there = measured.keypoints.uv[0, :, 3, 0], measured.keypoints.confidence[0, :, 3]
    assert np.abs(u - PIXELS[3, 0] - 200 - 60 * times)[there > 0].max() < 0.01
    assert 0.6 < (there > 0).mean() < 1.0


def test_a_result_has_the_frames_that_were_used_where_none_was_dropped():
    for times in (np.arange(60) / 30, np.arange(20) / 10):
        frames, kept = evenly(recorded(times), 30.0)
        assert len(frames) == len(times) and kept.all()


def test_a_gap_of_the_source_is_not_filled():
    times = np.concatenate([np.arange(10), np.arange(45, 55)]) / 30
    frames, kept = evenly(recorded(times), 30.0)
    inside = [f for f in frames if 10 / 30 < f.time < 44 / 30]
    assert not inside and kept.sum() == 20


def test_steps_have_the_times_of_their_frames_by_programs_of_one_size():
    window = Window(CAMERA, bs.load_body_model(), Config(), 10.0, 1)
    network = motion.load_motion_model()
    even = motion.make_clock(window.times, network.fps)
    present = jnp.ones((1, FRAMES), bool)
    given = motion.predict_between, (network, even), window.body, present
    predictor = graph.MotionPredictor(*given)
    sizes = set()
    for n, away in enumerate((0.0, 0.03, 0.045)):
        uneven = np.arange(FRAMES) / 10 + away * np.cos(np.pi * np.arange(FRAMES))
        window.times = uneven + 7.0
        _, clock = at_times(window, predictor, present).model
        sizes.add((len(clock.frame), clock.same))
        steps = np.asarray(clock.steps)[1:-1] / network.fps
        assert np.abs(steps - np.diff(uneven)[:-1]).max() < 1e-9, n
    # The source stood still for 20 s.
    window.times = np.arange(FRAMES) / 10 + np.where(np.arange(FRAMES) < 40, 0.0, 20.0)
    _, clock = at_times(window, predictor, present).model
    sizes.add((len(clock.frame), clock.same))
    assert np.asarray(clock.steps).max() < 0.16 * network.fps
    assert len(sizes) == 1


# What runs when.


class Pool:
    """A second thread whose windows take some time of the video."""

    def __init__(self, takes: float) -> None:
        self.takes, self.now = takes, 0.0
        self.begun: list[float] = []

    def submit(self, function, frames) -> "Pool":
        self.begun.append(self.now)
        self.found = function(frames)
        return self

    def done(self) -> bool:
        return self.now >= self.begun[-1] + self.takes

    def result(self) -> list[Solved]:
        return self.found

    def shutdown(self) -> None:
        pass


@pytest.fixture
def without_solves(monkeypatch):
    """A window whose scale is known at once, and nothing is compiled."""

    def advance(self: Window, frames) -> list[Solved]:
        for start in range(0, len(frames), maps.CHUNK):
            if self.count == maps.FRAMES - maps.CHUNK:
                self._shift()
            self._take(frames[start : start + maps.CHUNK])
        self.scale_sigma = 0.05
        return [self._solved(np.zeros((1, maps.FRAMES, 4)), {})]

    monkeypatch.setattr(Window, "advance", advance)
    monkeypatch.setattr(online, "compile_all", lambda *a, **b: None)


@pytest.mark.parametrize(("takes", "apart"), [(0.3, 1.0), (0.8, 1.6), (1.5, 2.5)])
def test_the_window_rests_as_long_as_it_took(without_solves, takes, apart):
    """At most a second; it has ten frames in a second, and begins with ten."""
    one = bs.Online(intrinsics=CAMERA, fps=30.0, threads=False)
    pool: Any = Pool(takes)
    one.pool = pool
    nobody = np.zeros((0, 25, 3))
    for k, (_, ids, uv) in enumerate(passing(300, np.random.default_rng(0))):
        pool.now = k / 30
        one.update(None, k / 30, nobody, points=(ids, uv))
    between = np.diff(pool.begun)
    assert len(between) > 2
    assert between.min() > apart - 0.05 and between.max() < apart + 0.15


def test_the_networks_look_once_in_a_frame_of_the_window(without_solves, monkeypatch):
    looks: list[float] = []

    def find(self, image, time):
        looks.append(time)
        return {}

    monkeypatch.setattr(LivePeople, "find", find)
    monkeypatch.setattr(LivePeople, "load_networks", lambda self: None)
    one = bs.Online(intrinsics=CAMERA, fps=30.0, threads=False)
    image = np.zeros((480, 640, 3), np.uint8)
    for k, (_, ids, uv) in enumerate(passing(60, np.random.default_rng(0))):
        one.update(image, k / 30, points=(ids, uv))
    assert len(looks) == 21 and one.counts.looks == 21
    looked = [frame.time for frame in one.record.frames if frame.looked]
    assert looked == looks
    given = [row.time for _, row in one.slots.waiting]
    assert given and set(given) <= set(looks)


@pytest.mark.slow
def test_few_steps_tell_no_scale():
    """A scale that began at any value was claimed with three times its own size."""
    settings = Simulation(sequence="M2", family="follow", length=60)
    made = simulation.simulate(settings)
    sequence, truth = simulation.as_sequence(made), simulation.as_truth(made)
    found, tracks, unit = sequence.keypoints, sequence.tracks, 5.0
    assert found is not None and tracks is not None
    window = Window(sequence.intrinsics, bs.load_body_model(), Config(), 10.0, 1)
    known = {}
    for count in (8, 20):
        frames = []
        for k in range(0, 60, 3):
            at, T_WC = tracks.frame == k, truth.T_WC[k].copy()
            T_WC[:3, 3] /= unit
            rows = found.uv[0, k], found.confidence[0, k][:, None]
            people = {0: np.concatenate(rows, axis=1)} if k < 3 * count else {}
            seen = tracks.landmark[at], tracks.uv[at]
            frames.append(Measured(k / 30, T_WC, True, *seen, people))
        window.restart()
        known[count] = window.advance(frames)[-1]
    assert np.isnan(known[8].scale_sigma)
    assert known[20].scale == pytest.approx(unit, abs=0.5)
    assert known[20].scale_sigma < 0.1 * unit
