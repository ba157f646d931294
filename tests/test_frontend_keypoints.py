"""Which frame a name means, who is who where a file says so, and scales undone."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from bodyslam_jax.config import Association
from bodyslam_jax.io import read_sequence
from bodyslam_jax.io.frame_index import InvalidContent, frames_of_names
from bodyslam_jax.io.keypoints.associate import associate
from bodyslam_jax.io.keypoints.reader import read_detections

NUM, WIDTH, HEIGHT = 20, 320, 240


def person(k: int = 0, x: float = 100.0) -> np.ndarray:
    """A BODY_25 person (25, 3) who moves by 2 px a frame, so that `k` can be told."""
    uv = np.random.default_rng(0).uniform(0, 1, (25, 2)) * [60, 120] + [x + 2 * k, 60]
    return np.concatenate([uv, np.full((25, 1), 0.9)], axis=-1)


def write(folder: Path, names: list[str], start: int = 0) -> Path:
    folder.mkdir(parents=True)
    for k, name in enumerate(names):
        entry = {"pose_keypoints_2d": person(start + k).ravel().tolist()}
        (folder / name).write_text(json.dumps({"people": [entry]}))
    return folder


def read(path: Path, **known):
    """The detections, and what was warned of."""
    said: list[str] = []
    known = {"num_frames": NUM, "width": WIDTH, "height": HEIGHT} | known
    return read_detections(path, **known, warn=said.append), said


def frames_with(found) -> dict[int, int]:
    """Frame -> the `k` of the person in it."""
    at = [(k, p) for k, points in enumerate(found.points) for p in points]
    return {k: round((p[0, 0] - person()[0, 0]) / 2) for k, p in at}


@pytest.mark.parametrize(
    "pattern",
    [
        "my.holiday_{:012d}_keypoints.json",
        "clip2.trim_{:012d}_keypoints.json",
        "{:06d}_cam1_keypoints.json",
        "take3-{:d}.json",
    ],
)
def test_the_number_of_a_frame_is_found_in_its_name(tmp_path, pattern):
    names = [pattern.format(k) for k in range(NUM)]
    found, said = read(write(tmp_path / "k", names))
    assert frames_with(found) == {k: k for k in range(NUM)} and said == []


def test_times_are_no_frame_numbers(tmp_path):
    names = [f"{1305031102175304 + 33333 * k}_keypoints.json" for k in range(NUM)]
    folder = write(tmp_path / "k", names)
    read = lambda n: read_detections(folder, num_frames=n, width=640, height=480)
    for num_frames in (None, NUM):
        with pytest.raises(ValueError, match="of frame"):
            read(num_frames)


def test_two_files_of_one_frame_are_refused(tmp_path):
    names = [f"{v}_{k:03d}_keypoints.json" for v in "ab" for k in range(NUM)]
    folder = write(tmp_path / "k", names)
    with pytest.raises(ValueError, match="a_000_.* and b_000_.* are both of frame 0"):
        read(folder)


@pytest.mark.parametrize(
    ("numbers", "num_frames", "complete", "first", "warned"),
    [
        (range(20), 20, True, 0, False),
        (range(1, 21), 20, True, 1, False),
        (range(50, 70), 20, True, 50, False),
        (range(5, 21), 20, False, 1, False),  # 20 is beyond, if counted from 0
        (range(15), 20, True, 0, True),  # or every n-th, numbered anew
        (range(1, 20), 20, True, 1, True),  # or number 0 has been deleted
        ([k for k in range(1, 20) if k % 7], 30, True, 0, True),  # some are deleted
        (range(1, 20), 20, False, 0, True),  # or the last image has nobody
        (range(5, 15), 20, True, 0, True),
        (range(3, 9), None, False, 0, True),
        (range(50, 70), None, True, 50, False),
    ],
)
def test_where_counting_begins(numbers, num_frames, complete, first, warned):
    said: list[str] = []
    names = [f"f_{k}.png" for k in numbers]
    found = frames_of_names(
        names,
        what="keypoints",
        num_frames=num_frames,
        complete=complete,
        warn=said.append,
    )
    assert list(found.values()) == [k - first for k in numbers]
    assert len(said) == warned
    if warned:
        assert f"taken as counted from {first}" in said[0]


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["a", "b"], "no frame number in the name a"),
        (["7", "25"], "keypoints of frames 7 to 25, but the video has 20 frames"),
        (["x/1.jpg", "y/1.jpg"], "x/1.jpg and y/1.jpg are both of frame 1"),
    ],
)
def test_refuses_names_that_cannot_be(names, message):
    with pytest.raises(InvalidContent, match=message):
        frames_of_names(
            names, what="keypoints", num_frames=20, complete=True, warn=pytest.fail
        )


def test_names_of_images_count_more_than_numbers():
    def places(names, images):
        said: list[str] = []
        found = frames_of_names(
            names,
            what="keypoints",
            num_frames=len(images),
            images=images,
            complete=False,
            warn=said.append,
        )
        return list(found.values()), said

    images = [f"{k:04d}_cam1.jpg" for k in range(50, 150)]
    assert places(["0050_cam1_keypoints.json"], images) == ([0], [])
    # Not the same names, but the same numbers.
    assert places(["149.png", "60.png"], images) == ([99, 10], [])
    frames, said = places(["60.png"], images)
    assert frames == [10] and "numbers of the images, which begin at 50" in said[0]
    # Of the video, counted from 0: the images' numbers do not have them.
    assert places(["7.png", "8.png", "0.png"], images) == ([7, 8, 0], [])


def test_images_of_a_sequence_say_where_counting_begins(tmp_path):
    (tmp_path / "images").mkdir()
    for k in range(50, 80):
        image = np.full((HEIGHT, WIDTH), k, np.uint8)
        cv2.imwrite(str(tmp_path / "images" / f"{k:06d}.jpg"), image)
    write(tmp_path / "keypoints", [f"{k:06d}_keypoints.json" for k in range(52, 70)])
    found = read_sequence(tmp_path).keypoints
    assert found is not None
    seen = np.flatnonzero(found.confidence[0].max(axis=-1))
    assert seen.tolist() == list(range(2, 20))


def _coco(points: np.ndarray) -> list[float]:
    return points[:17].ravel().tolist()


def _mmpose(k: int) -> dict:
    points = person(k)[:17]
    return {
        "keypoints": points[:, :2].tolist(),
        "keypoint_scores": points[:, 2].tolist(),
    }


def test_images_without_people_count_where_they_are_listed(tmp_path):
    """All is numbered from 1, and nobody is in the last image."""
    info = [
        {"frame_id": k + 1, "instances": [_mmpose(k)] if k < NUM - 1 else []}
        for k in range(NUM)
    ]
    images = [{"id": 7 + k, "file_name": f"i_{k + 1}.jpg"} for k in range(NUM)]
    seen = [{"image_id": 7 + k, "keypoints": _coco(person(k))} for k in range(NUM - 1)]
    for data in ({"instance_info": info}, {"images": images, "annotations": seen}):
        (tmp_path / "a.json").write_text(json.dumps(data))
        found, said = read(tmp_path / "a.json")
        assert frames_with(found) == {k: k for k in range(NUM - 1)} and said == []
    data = [{"image_id": f"{k + 1}.jpg", "keypoints": _coco(person(k))} for k in (0, 9)]
    (tmp_path / "a.json").write_text(json.dumps(data))
    found, said = read(tmp_path / "a.json")
    assert frames_with(found) == {1: 0, 10: 9} and "counted from 0" in said[0]


def test_people_of_an_archive_stay_who_they_are(tmp_path):
    """One is unseen for a second; two change places, out of sight of each other."""
    num = 90
    points = np.zeros((2, num, 25, 3))
    for k in range(num):
        points[0, k] = person(0, 20.0 if k < 45 else 220.0)
        points[1, k] = person(0, 220.0 if k < 45 else 20.0)
    points[1, 30:60, :, 2] = 0.0
    np.savez(tmp_path / "k.npz", keypoints=points)
    detected, _ = read(tmp_path / "k.npz", num_frames=num)
    people, said = associate(detected.points, Association(), 30.0, detected.person)
    assert said == ()
    np.testing.assert_array_equal(people.confidence, points[..., 2])
    seen = points[..., 2] > 0
    np.testing.assert_array_equal(people.uv[seen], points[..., :2][seen])


def _alphapose(who) -> list[dict]:
    return [
        {"image_id": f"{k}.jpg", "keypoints": _coco(person(0, x)), "idx": who(x, k)}
        for k in range(NUM)
        for x in (20.0, 220.0)
    ]


def test_numbers_of_a_tracker_are_kept(tmp_path):
    """The two who are followed change places from each frame to the next."""
    changing = _alphapose(lambda x, k: [3.0 + ((x > 100) ^ (k % 2))])
    track = {"track_id": 1, **_mmpose(0)}, {"track_id": 2, **_mmpose(0)}
    info = [
        {"frame_id": k, "instances": [*track][:: 1 - 2 * (k % 2)]} for k in range(NUM)
    ]
    for data, wanted in ((changing, [3, 4]), ({"instance_info": info}, [1, 2])):
        (tmp_path / "a.json").write_text(json.dumps(data))
        found, said = read(tmp_path / "a.json")
        assert found.person is not None and said == []
        expected = [wanted[:: 1 - 2 * (k % 2)] for k in range(NUM)]
        assert [who.tolist() for who in found.person] == expected


def test_numbers_that_say_nothing_are_not_used(tmp_path):
    for who, message in (
        (lambda x, k: 0.0, ""),  # what AlphaPose writes without a tracker
        (lambda x, k: 7, "given twice in frame 0"),
        (lambda x, k: 1 if x > 100 else -1, "given for some only"),
    ):
        (tmp_path / "a.json").write_text(json.dumps(_alphapose(who)))
        found, said = read(tmp_path / "a.json")
        assert found.person is None and len(said) == bool(message)
        assert not message or message in said[0]


@pytest.mark.parametrize("zero", [0.0, -1.0])
@pytest.mark.parametrize("far", [(0, -0.02), (1, 1.6), (0, -1.9)])
def test_a_point_outside_does_not_hide_the_scale(tmp_path, zero, far):
    """Points relative to the image, of which one is just or well outside it."""
    points = np.stack([person(k) for k in range(NUM)])
    wanted = points.copy()
    points[..., :2] = points[..., :2] / [WIDTH - 1, HEIGHT - 1] * (1 - zero) + zero
    axis, value = far
    points[:, 24, axis] = value
    wanted[:, 24, axis] = (value - zero) / (1 - zero) * (WIDTH - 1, HEIGHT - 1)[axis]
    np.savez(tmp_path / "k.npz", keypoints=points)
    found, said = read(tmp_path / "k.npz")
    np.testing.assert_allclose(np.concatenate(found.points), wanted)
    assert len(said) == 1 and f"keypoints in [{zero:g}, 1]" in said[0]


def test_pixels_are_left_as_they_are(tmp_path):
    points = np.stack([person(k) for k in range(NUM)])
    points[:, 3, :2] = 0.4
    np.savez(tmp_path / "k.npz", keypoints=points)
    found, said = read(tmp_path / "k.npz")
    np.testing.assert_array_equal(np.concatenate(found.points), points)
    assert said == []


def test_whoever_is_half_hidden_for_a_while_stays_the_same_person():
    """Three keypoints are left, beside somebody who is seen whole."""
    few = np.argsort(person()[:, 1])[:3]
    frames = []
    for k in range(30):
        one, other = person(k, 60), person(k, 200)
        if 10 <= k < 20:
            hidden = np.setdiff1d(np.arange(25), few if k % 2 else few[:1])
            one[hidden] = 0.0
        frames.append(np.stack([one, other][:: 1 if k % 3 else -1]))
    people, said = associate(frames, Association(), 30.0)
    assert people.confidence.shape[0] == 2 and said == ()
    assert (people.confidence > 0).any(axis=2).all()
    first = people.uv[:, :, few[0], 0] - [2 * k for k in range(30)]
    assert np.ptp(first, axis=1).max() < 1e-9


def test_whoever_is_half_as_large_is_somebody_else():
    frames = []
    for k in range(40):
        uvc = person(k)
        if k >= 20:
            uvc[:, :2] = 0.45 * (uvc[:, :2] - uvc[:, :2].mean(0)) + uvc[:, :2].mean(0)
        frames.append(uvc[None])
    people, said = associate(frames, Association(), 30.0)
    assert people.confidence.shape[0] == 2
    assert any("may be person" in line for line in said)


@pytest.mark.parametrize("tracked", [False, True])
def test_two_at_one_place_are_one_person(tracked):
    """A detector finds somebody twice, now and then once under either number."""
    noise = np.random.default_rng(3)
    frames, numbers = [], []
    for k in range(60):
        twice = [person(k) + noise.normal(0, [2, 2, 0], (25, 3)) for _ in range(2)]
        twice[1][:, 2] = 0.4
        chosen = [0, 1] if k % 3 else [k % 2]
        frames.append(np.stack([twice[i] for i in chosen]))
        numbers.append(np.array(chosen))
    given = numbers if tracked else None
    people, said = associate(frames, Association(), 30.0, given)
    assert people.confidence.shape[0] == 1 and (people.confidence[0] > 0).all()
    assert not any("dropped" in line for line in said)
    # Somebody beside them is somebody else.
    beside = [np.concatenate([f, person(k, 190)[None]]) for k, f in enumerate(frames)]
    given = [np.append(n, 2) for n in numbers] if tracked else None
    assert len(associate(beside, Association(), 30.0, given)[0].uv) == 2


def test_stray_points_of_somebody_are_no_people():
    """Parts of a person are found as a person of their own for some frames."""
    frames = []
    for k in range(60):
        found = [person(k)]
        if k in (20, 21, 40, 41, 42):
            part = person(k)
            part[5:] = 0.0
            part[:5, :2] += 9.0
            found.append(part)
        frames.append(np.stack(found))
    people, said = associate(frames, Association(), 30.0)
    assert len(people.uv) == 1 and said == ()
    # Elsewhere they are somebody who was there for a moment.
    for k in (20, 21):
        frames[k][1, :5, 0] += 150
    people, said = associate(frames, Association(), 30.0)
    assert len(people.uv) == 1 and "1 person detected for less than" in said[0]
