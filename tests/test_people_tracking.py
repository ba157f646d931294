"""Who is who: people who cross, hide, leave, return and jump, as made-up keypoints."""

import numpy as np
import pytest

from bodyslam_jax.body.skeleton import COCO17_MIRRORED
from bodyslam_jax.people.linking import link, remarks
from bodyslam_jax.people.movenet import MOVENET_POINTS
from bodyslam_jax.people.phantoms import is_phantom
from bodyslam_jax.people.regions import behind, regions
from bodyslam_jax.tracking.appearance import describe, difference, mean_look
from bodyslam_jax.tracking.tracker import PointSet, Tracker, Tracklet, between

# COCO's 17 keypoints of somebody who stands, in units of the height.
STANDING = np.array(
    [(0.0, 0.08), (0.01, 0.06), (-0.01, 0.06), (0.03, 0.07), (-0.03, 0.07)]
    + [(0.11, 0.18), (-0.11, 0.18), (0.14, 0.33), (-0.14, 0.33), (0.15, 0.46)]
    + [(-0.15, 0.46), (0.07, 0.5), (-0.07, 0.5), (0.07, 0.73), (-0.07, 0.73)]
    + [(0.07, 0.95), (-0.07, 0.95)]
)
HEIGHT = 200.0


def standing(x, height=HEIGHT, y=100.0, score=0.8):
    at = np.array([x, y]) + height * STANDING
    return np.column_stack([at, np.full(17, score)])


def clothes(share):
    """The look of somebody all of one colour, as `describe` would give it."""
    return np.tile((np.linspace(0, 1, 32) >= share).astype(float), 6)


def follow(frames, fps=30.0, max_gap=0.7):
    """People found in `frames`, lists of (truth, points, look), and remarks on them."""
    tracker, truth = Tracker(fps, max_gap, MOVENET_POINTS), {}
    for k, found in enumerate(frames):
        points = np.array([p for _, p, _ in found]).reshape(-1, 17, 3)
        looks = np.array([look for *_, look in found]).reshape(len(found), 192)
        sure = np.ones(len(found), bool)
        who = tracker.update(k, points, looks, sure, sure)
        for (name, *_), number in zip(found, who.tolist(), strict=True):
            truth[number, k] = name
    people = link(tracker.tracklets)
    named = [
        [(k, truth[t.number, k]) for t in pieces for k in t.frames] for pieces in people
    ]
    return named, remarks(people, fps, max_gap)


def crossing(fps, speed, colours, hidden):
    """Two people walk past each other, the one behind unseen while hidden."""
    frames = []
    noise = np.random.default_rng(0)
    for k in range(round(3 * fps)):
        x = 300 + speed * HEIGHT * (k / fps - 1.5) * np.array([1, -1])
        found = []
        for name, (at, height, colour) in enumerate(zip(x, (200, 180), colours)):
            if name == 1 and abs(x[0] - x[1]) < hidden * HEIGHT:
                continue
            points = standing(at, height, y=120 if name else 100)
            points[:, :2] += noise.normal(0, 2, (17, 2))
            found.append((name, points, clothes(colour)))
        frames.append(found)
    return frames


@pytest.mark.parametrize("fps", [15.0, 30.0])
@pytest.mark.parametrize("speed", [0.5, 0.9])
def test_people_who_cross_keep_their_identity(fps, speed):
    people, _ = follow(crossing(fps, speed, (0.2, 0.7), hidden=0.3))
    assert [{name for _, name in p} for p in people] in ([{0}, {1}], [{1}, {0}])


@pytest.mark.parametrize("hidden", [0.2, 0.5])
def test_people_alike_who_cross_do_not_become_each_other(hidden):
    """Split, at most: nobody goes on as the other, who comes the other way."""
    people, _ = follow(crossing(30.0, 0.7, (0.5, 0.5), hidden))
    assert all(len({name for _, name in p}) == 1 for p in people)


def coloured(share):
    """As `clothes`, of a cloth with pattern: 0.1 of `share` is a difference of 22."""
    return np.tile(np.clip((np.linspace(0, 1, 32) - share) / 0.3 + 0.5, 0, 1), 6)


def taken_over(fps, colours, seed):
    """Somebody (0), long unseen behind a pillar, comes out in front of another (1) who
    walks by: the detector finds only the one in front for half a second."""
    frames, noise = [], np.random.default_rng(seed)
    for k in range(round(3 * fps)):
        found = []
        if k < 0.6 * fps or k >= 1.43 * fps:
            found.append((0, 300.0))
        if k < 1.43 * fps or k >= 1.9 * fps:
            found.append((1, 300 + 100 * (1.5 - k / fps)))
        row = []
        for name, x in found:
            points = standing(x)
            points[:, :2] += noise.normal(0, 3, (17, 2))
            row.append((name, points, coloured(colours[name] + noise.normal(0, 0.015))))
        frames.append(row)
    return frames


@pytest.mark.parametrize("fps", [15.0, 30.0, 60.0])
@pytest.mark.parametrize("seed", range(3))
def test_a_track_that_a_detector_takes_to_another_is_cut(fps, seed):
    people, _ = follow(taken_over(fps, (0.3, 0.42), seed), fps)
    shares = sorted(np.mean([name for _, name in p]) for p in people)
    # A frame or two at the exchange may be left out, or be the other's.
    assert shares == pytest.approx([0, 1], abs=0.04)
    assert sum(map(len, people)) >= sum(map(len, taken_over(fps, (0, 0), 0))) - 2


@pytest.mark.parametrize("seed", range(3))
def test_clothes_alike_cut_nothing(seed):
    """Nobody is split for noise: the pieces are the three that the detector gives."""
    people, _ = follow(taken_over(30.0, (0.3, 0.3), seed))
    assert sum(map(len, people)) == sum(map(len, taken_over(30.0, (0, 0), 0)))
    assert len(people) <= 3


def test_who_steps_into_the_shade_stays_one_person():
    """An abrupt change of colours that nobody else explains."""
    noise = np.random.default_rng(0)
    shades = np.repeat([0.3, 0.42], 40) + noise.normal(0, 0.01, 80)
    walk = [[(0, standing(100 + 3 * k), coloured(c))] for k, c in enumerate(shades)]
    people, said = follow(walk)
    assert [len(p) for p in people] == [80] and not said


@pytest.mark.parametrize(("colour", "count"), [(0.3, 1), (0.8, 2)])
def test_who_returns_is_known_by_their_clothes(colour, count):
    walk = [[(0, standing(100 + 4 * k), clothes(0.3))] for k in range(30)]
    back = [[(1, standing(500 - 4 * k), clothes(colour))] for k in range(30)]
    people, said = follow(walk + [[]] * 60 + back)
    assert len(people) == count
    taken = "person 0: not seen from frame 30 to 89; taken for the same"
    assert any(taken in text for text in said) == (count == 1)


def test_who_is_hidden_for_a_moment_goes_on_without_remark():
    walk = [[(0, standing(100 + 3 * k), clothes(0.3))] for k in range(60)]
    walk[25:37] = [[]] * 12
    people, said = follow(walk)
    assert len(people) == 1 and not said


@pytest.mark.parametrize("change", ["place", "clothes", "size"])
def test_a_jump_is_somebody_else_and_is_said(change):
    """From one frame to the next, as where a detector goes from one man to another."""
    new = {"place": (420.0, 0.3, 200.0), "clothes": (182.0, 0.7, 200.0)}
    x, colour, height = new.get(change, (182.0, 0.3, 380.0))
    frames = [[(0, standing(100 + 2 * k), clothes(0.3))] for k in range(40)]
    frames += [[(1, standing(x + 2 * k, height), clothes(colour))] for k in range(40)]
    people, said = follow(frames)
    assert [{name for _, name in p} for p in people] == [{0}, {1}]
    assert "person 1 begins in frame 40" in said[0]
    assert "taken for somebody else" in said[0]


def test_who_stays_in_place_is_not_moved_on_so_that_everybody_has_a_detection():
    """Of two side by side one goes, and somebody comes on the other side of the other:
    all detections could continue a track, each of a neighbour."""
    tracker = Tracker(30.0, 0.7, MOVENET_POINTS)
    for k in range(20):
        tracker.update(k, np.stack([standing(100), standing(132)]))
    assert tracker.update(20, np.stack([standing(132), standing(165)])).tolist() == [
        1,
        2,
    ]


@pytest.mark.parametrize("fps", [10.0, 30.0])
def test_sides_that_a_detector_exchanges_are_of_the_same_person(fps):
    """Two walk past each other; of one, left and right are exchanged now and then."""
    tracker = Tracker(fps, 0.7, MOVENET_POINTS)
    for k in range(round(3 * fps)):
        points = np.stack([standing(100 + 90 * k / fps), standing(400 - 90 * k / fps)])
        if k % 4 == 3:
            points[0] = points[0, list(COCO17_MIRRORED)]
        assert sorted(tracker.update(k, points).tolist()) == [0, 1]
    assert np.ptp([p[:, 0].mean() for p in tracker.tracklets[0].points]) > 200


def test_a_half_hidden_person_keeps_size_and_place():
    """Only the feet are seen for a while, and then the head."""
    tracker = Tracker(30.0, 0.7, PointSet(0.15))
    for k in range(30):
        points = standing(100 + 3 * k)
        if 10 <= k < 20:
            points[slice(0, 13) if k < 15 else slice(5, 17), 2] = 0.0
        assert tracker.update(k, points[None]).tolist() == [0]
    whole = tracker.tracklets[0].expected(30)
    np.testing.assert_allclose(whole[:, :2], standing(190)[:, :2], atol=1.0)


def test_a_gap_is_filled_on_a_line():
    tracker = Tracker(30.0, 0.7, MOVENET_POINTS)
    yes = np.ones(1, bool)
    for k in (0, 1, 5):
        tracker.update(k, standing(100 + 2.0 * k)[None], clothes(0.3)[None], yes, yes)
    (tracklet,) = tracker.tracklets
    found = between(tracklet)
    assert [frame for frame, _ in found] == [2, 3, 4]
    np.testing.assert_allclose(found[1][1], standing(106.0))


def test_nobody_new_begins_where_a_surer_person_stands():
    points = np.array([standing(100), standing(115, 190), standing(400)])
    assert behind(points, np.array([0.6, 0.3, 0.3])).tolist() == [False, True, False]


def test_whoever_is_in_the_square_of_another_needs_none():
    alone, pair, far = standing(900), standing(330, 190), standing(320, 40)
    found = regions([standing(300), pair, far, alone], least=50.0, most=8)
    assert len(found) == 2
    for left, top, right, bottom in found:
        assert right - left == bottom - top


def test_colours_tell_people_apart_and_light_hardly_does():
    rng = np.random.default_rng(0)
    points = standing(100)

    def wearing(colour):
        image = np.zeros((400, 300, 3)) + colour + rng.normal(0, 8, (400, 300, 3))
        return describe(image.clip(0, 255).astype(np.uint8), points, 0.15)

    red, darker, blue = (
        wearing([40, 40, 160]),
        wearing([34, 34, 136]),
        wearing([150, 60, 40]),
    )
    assert difference(red, wearing([40, 40, 160])) < 2
    assert difference(red, darker) < 0.4 * difference(red, blue)
    assert np.isnan(describe(np.zeros((10, 10, 3), np.uint8), points, 0.15)).all()
    assert np.isnan(difference(red, np.full_like(red, np.nan)))
    both = mean_look(np.stack([red, np.full_like(red, np.nan)]))
    np.testing.assert_array_equal(both, red)


def tracklet(number, frames, detections, colour=0.3):
    looks = [clothes(colour) for _ in frames]
    return Tracklet(
        *(number, list(frames), list(detections), looks),
        *(MOVENET_POINTS, 30.0, 21.0),
    )


def test_a_part_of_a_person_found_whole_is_nobody_elses_return():
    """Somebody hides; when they come out, their legs are found a frame before a new
    track of all of them is followed backwards."""
    before = [standing(300 + 2 * k) for k in range(25)]
    after = [standing(360 + 2 * k) for k in range(40)]
    legs = standing(362, score=0.4)
    legs[:11] = legs[11:13].mean(axis=0)
    first = tracklet(0, [*range(25), 39], [*before, legs])
    second = tracklet(1, range(38, 78), after)
    people = link([first, second])
    assert [[len(t.frames) for t in pieces] for pieces in people] == [[25, 40]]
    # A return as sure as anybody stays.
    first.points[-1] = standing(900)
    assert len(link([first, second])) == 2


def faint(x, k, legs=0.05, face=0.2, trunk=0.4):
    """A false detection: keypoints that jitter, none of a leg."""
    points = standing(x)
    points[:, :2] += np.random.default_rng(k).normal(0, 4, (17, 2))
    points[:, 2] = trunk
    points[13:, 2], points[:5, 2] = legs, face
    return points


@pytest.mark.parametrize("face", [0.2, 0.6])
def test_what_only_one_network_sees_without_legs_is_a_thing(face):
    track = tracklet(0, range(60), [faint(300, k, face=face) for k in range(60)])
    assert is_phantom([track], set(), 30.0)
    # Another network that finds it now and then makes a person of it.
    confirmed = {(0, k) for k in range(0, 60, 5)}
    assert not is_phantom([track], confirmed, 30.0)


def test_who_sits_behind_a_table_is_a_person():
    """No hips, so that the other network cannot be asked; the face speaks."""
    seated = [faint(300, k, face=0.5) for k in range(60)]
    for points in seated:
        points[11:, 2] = 0.02
    assert not is_phantom([tracklet(0, range(60), seated)], set(), 30.0)
    for points in seated:
        points[:5, 2] = 0.1
    assert is_phantom([tracklet(0, range(60), seated)], set(), 30.0)


@pytest.mark.parametrize("frames", [45, 90])
def test_what_never_moves_is_a_statue(frames):
    """The camera moves on and turns about it; for less than two seconds anybody may
    keep still."""
    noise = np.random.default_rng(1)
    detections = []
    for k in range(frames):
        points = standing(0, height=200 + k, y=0)
        points[:, :2] @= np.array([[np.cos(k / 200), 0.002 * k], [0.0, 1.0]])
        points[:, :2] += [300 + 3 * k, 100] + noise.normal(0, 2, (17, 2))
        detections.append(points)
    confirmed = {(0, k) for k in range(frames)}
    statue = tracklet(0, range(frames), detections)
    assert is_phantom([statue], confirmed, 30.0) == (frames == 90)
    # A keypoint of which the detector is not sure jumps; who waves an arm is none.
    for points in detections[20:50]:
        points[9, :2] -= [0, 12]
    assert is_phantom([statue], confirmed, 30.0) == (frames == 90)
    for points in detections[20:50]:
        points[[7, 8, 10], :2] -= [0, 25]
    assert not is_phantom([statue], confirmed, 30.0)
