"""Keypoints in other orders, other sizes and with broken values: told, or refused."""

import json
from pathlib import Path

import numpy as np
import pytest

from bodyslam_jax.io.keypoints.layouts import LAYOUTS, from_layout, layout_of, names_in
from bodyslam_jax.io.keypoints.reader import read_detections

NUM, WIDTH, HEIGHT = 24, 640, 480
NAMES = (
    "nose neck right_shoulder right_elbow right_wrist left_shoulder left_elbow "
    "left_wrist mid_hip right_hip right_knee right_ankle left_hip left_knee left_ankle "
    "right_eye left_eye right_ear left_ear left_big_toe left_small_toe left_heel "
    "right_big_toe right_small_toe right_heel"
).split()
HEAD_TOP, SPINE = 25, 26
# x to the image's right and y down, m, of who faces the camera: right is to the left.
_STANDING = {
    0: (0.0, -0.62),
    1: (0.0, -0.48),
    2: (-0.18, -0.48),
    5: (0.18, -0.48),
    8: (0.0, 0.0),
    9: (-0.1, 0.0),
    12: (0.1, 0.0),
    15: (-0.03, -0.66),
    16: (0.03, -0.66),
    17: (-0.07, -0.63),
    18: (0.07, -0.63),
    HEAD_TOP: (0.0, -0.8),
    SPINE: (0.0, -0.24),
}


def walker(k: int, *, behind: bool = False, face: bool = True) -> np.ndarray:
    """A walking person (27, 3): BODY_25's points, then top of the head and spine."""
    points = np.zeros((27, 2))
    for part, place in _STANDING.items():
        points[part] = place
    for side, (hip, shoulder) in ((1, (9, 2)), (-1, (12, 5))):
        swing = side * 0.5 * np.sin(2 * np.pi * k / 20)
        down = lambda angle: np.array([np.sin(angle), np.cos(angle)])
        points[hip + 1] = points[hip] + 0.40 * down(swing)
        points[hip + 2] = points[hip + 1] + 0.40 * down(swing - 0.2)
        points[shoulder + 1] = points[shoulder] + 0.28 * down(-swing - 0.1 * side)
        points[shoulder + 2] = points[shoulder + 1] + 0.25 * down(-swing)
        toe, small, heel = (22, 23, 24) if side == 1 else (19, 20, 21)
        points[heel] = points[hip + 2] + [0.0, 0.03]
        points[toe] = points[hip + 2] + [0.03, 0.1]
        points[small] = points[hip + 2] + [-0.04, 0.09]
    if behind:
        points[:, 0] *= -1
    noise = np.random.default_rng(k).normal(0, 0.01, points.shape)
    uv = (points + noise) * 180 + [200 + 4 * k, 260]
    confidence = np.full((27, 1), 0.8)
    if not face:
        confidence[[0, 15, 16]] = 0.0
    return np.concatenate([uv, confidence], axis=1)


def in_order(person: np.ndarray, layout: list[int]) -> np.ndarray:
    points = np.stack([person[p] if p >= 0 else np.zeros(3) for p in layout])
    return np.where(points[:, 2:] > 0, points, 0.0)


def walk(layout: list[int], **how) -> np.ndarray:
    return np.stack([in_order(walker(k, **how), layout) for k in range(NUM)])


def openpose(folder: Path, points: np.ndarray) -> Path:
    folder.mkdir()
    for k, person in enumerate(points):
        people = [{"pose_keypoints_2d": person.ravel().tolist()}]
        text = json.dumps({"people": people})
        (folder / f"a_{k:012d}_keypoints.json").write_text(text)
    return folder


def archive(path: Path, points: np.ndarray, **more) -> Path:
    np.savez(path, keypoints=points, **more)
    return path


def read(path: Path, **size) -> tuple[np.ndarray, list[str]]:
    """The only person's keypoints (t, 25, 3), and what was said."""
    said: list[str] = []
    size = {"width": WIDTH, "height": HEIGHT} | size
    found = read_detections(path, num_frames=NUM, warn=said.append, **size)
    return np.stack([p[0] if len(p) else np.zeros((25, 3)) for p in found.points]), said


ORDERS = [(n, name) for n, layouts in LAYOUTS.items() for name in layouts]


@pytest.mark.parametrize("as_folder", [False, True])
@pytest.mark.parametrize(("num", "name"), ORDERS)
def test_an_order_is_told_by_who_is_near_whom(tmp_path, num, name, as_folder):
    layout = LAYOUTS[num][name].parts
    points = walk(layout)
    make = openpose if as_folder else lambda p, a: archive(p.with_suffix(".npz"), a)
    found, said = read(make(tmp_path / "k", points))
    np.testing.assert_allclose(found, from_layout(points, layout), atol=1e-9)
    first = name == next(iter(LAYOUTS[num]))
    assert said == [] if first else f"{num} a person taken as {name}" in said[0]


def test_people_without_a_face_are_told_too(tmp_path):
    layout = LAYOUTS[25]["BODY_25B"].parts
    points = walk(layout, behind=True, face=False)
    points[:, [3, 4]] = 0.0  # ears
    found, said = read(archive(tmp_path / "k.npz", points))
    np.testing.assert_allclose(found, from_layout(points, layout), atol=1e-9)
    assert "BODY_25B" in said[0]


@pytest.mark.parametrize("seed", range(4))
def test_an_order_that_is_no_bodys_is_not_taken_in_silence(tmp_path, seed):
    shuffled = np.random.default_rng(seed).permutation(25)
    path = archive(tmp_path / "k.npz", walk(list(shuffled)))
    try:
        _, said = read(path)
    except ValueError as error:
        assert "in no known order" in str(error) and "k.npz" in str(error)
    else:
        assert "fit a body badly" in said[0] or "taken as" in said[0]


def test_what_does_not_move_is_left_in_the_usual_order(tmp_path):
    """As points on a line, or made up, which say nothing of an order."""
    points = np.tile(walk(LAYOUTS[25]["BODY_25B"].parts)[:1], (NUM, 1, 1))
    found, said = read(archive(tmp_path / "k.npz", points))
    np.testing.assert_allclose(found, points)
    assert said == []


def _vit(points: np.ndarray, names: list[str]) -> dict:
    rows = points[..., [1, 0, 2]]
    frames = [{"7": person.tolist()} for person in rows]
    return {"keypoints": frames, "skeleton": dict(enumerate(names))}


def _coco(points: np.ndarray, names: list[str]) -> dict:
    return {
        "images": [{"id": k, "file_name": f"{k}.jpg"} for k in range(NUM)],
        "categories": [{"id": 1, "keypoints": names}],
        "annotations": [
            {"image_id": k, "keypoints": p.ravel().tolist()}
            for k, p in enumerate(points)
        ],
    }


def _mmpose(points: np.ndarray, names: list[str], key="meta_info") -> dict:
    return {
        key: {"keypoint_id2name": {str(k): n for k, n in enumerate(names)}},
        "instance_info": [
            {
                "frame_id": k,
                "instances": [
                    {
                        "keypoints": p[:, :2].tolist(),
                        "keypoint_scores": p[:, 2].tolist(),
                    }
                ],
            }
            for k, p in enumerate(points)
        ],
    }


NAMED = {
    "easy_ViTPose": _vit,
    "COCO": _coco,
    "MMPose": _mmpose,
    "MMPose's dataset_meta": lambda p, n: _mmpose(p, n, "dataset_meta"),
}


@pytest.mark.parametrize("kind", NAMED)
def test_names_in_the_file_count(tmp_path, kind):
    """In an order that nobody uses, and of people who do not move."""
    order = np.random.default_rng(1).permutation(25).tolist()
    points = np.tile(walk(order)[:1], (NUM, 1, 1))
    names = [NAMES[part] for part in order]
    (tmp_path / "k.json").write_text(json.dumps(NAMED[kind](points, names)))
    found, said = read(tmp_path / "k.json")
    np.testing.assert_allclose(found, from_layout(points, order), atol=1e-9)
    assert said == []


def test_names_in_an_archive_count(tmp_path):
    names = np.array([NAMES[part] for part in range(24, -1, -1)])
    points = walk(list(range(24, -1, -1)))
    found, said = read(archive(tmp_path / "k.npz", points, keypoint_names=names))
    np.testing.assert_allclose(found, points[:, ::-1])
    assert said == []


def test_names_of_another_number_of_points_are_refused(tmp_path):
    path = archive(
        tmp_path / "k.npz", walk(list(range(25))), names=np.array(NAMES[:20])
    )
    with pytest.raises(ValueError, match="names of 20 keypoints, but 25 a person"):
        read(path)


@pytest.mark.parametrize(
    ("name", "part"),
    [
        ("LShoulder", 5),
        ("left_big toe", 19),
        ("RBigToe", 22),
        ("r_ankle", 11),
        ("rank", 11),
        ("leftEye", 16),
        ("hip", 8),
        ("Hip.R", 9),
        ("thorax", 1),
        ("left_hand_root", -1),
        ("face-12", -1),
    ],
)
def test_names_as_tools_write_them(name, part):
    limbs = [NAMES[k] for k in (2, 3, 4, 5, 6, 7, 9, 10, 11, 12, 13, 14)]
    others = [n for n in limbs if NAMES.index(n) != part]
    layout = layout_of([name, *others])
    assert layout is not None and layout[0] == part


def test_names_of_human36m_in_mmpose():
    names = "root right_hip right_knee right_foot left_hip left_knee left_foot spine"
    names += " thorax neck_base head left_shoulder left_elbow left_wrist"
    names += " right_shoulder right_elbow right_wrist"
    layout = layout_of(names.split())
    usual = LAYOUTS[17]["Human3.6M"].parts
    assert layout is not None and layout[:9] == usual[:9] and layout[11:] == usual[11:]
    assert layout_of(["a", "b"]) is None
    assert names_in({"skeleton": [[0, 1], [1, 2]]}) is None


@pytest.mark.parametrize("behind", [False, True])
def test_x_and_y_exchanged_are_told_from_people_who_lie(tmp_path, behind):
    """By faces, which are seen from the front and not from behind."""
    points = walk(list(range(25)), behind=behind, face=not behind)
    swapped = points[..., [1, 0, 2]]
    turned = np.stack([points[..., 1], WIDTH - points[..., 0], points[..., 2]], -1)
    found, said = read(archive(tmp_path / "a.npz", swapped))
    np.testing.assert_allclose(found, points)
    assert "taken as (y, x)" in said[0]
    found, said = read(archive(tmp_path / "b.npz", turned), width=640, height=640)
    np.testing.assert_allclose(found, np.where(turned[..., 2:] > 0, turned, 0.0))
    assert "people lie on their side" in said[0] and "taken as" not in said[0]
    found, said = read(archive(tmp_path / "c.npz", points))
    assert said == []


def test_the_order_of_a_tool_that_writes_rows_first_says_it_too(tmp_path):
    """Also of people of whom nothing tells front from back."""
    layout = LAYOUTS[25]["ViTPose with feet"].parts
    points = walk(layout)
    points[:, [19, 20, 21, 22, 23, 24], 2] = 0.0
    found, said = read(archive(tmp_path / "k.npz", points[..., [1, 0, 2]]))
    np.testing.assert_allclose(found[:, 5], points[:, 6])
    assert "ViTPose" in said[0] and "taken as (y, x)" in said[1]


@pytest.mark.parametrize("value", [float("nan"), float("inf"), None])
def test_a_broken_value_is_a_missing_point(tmp_path, value):
    points = walk(list(range(25)))
    folder = openpose(tmp_path / "k", points)
    file = sorted(folder.iterdir())[3]
    data = json.loads(file.read_text())
    data["people"][0]["pose_keypoints_2d"][3 * 4] = value
    file.write_text(json.dumps(data))
    found, said = read(folder)
    points[3, 4] = 0.0
    np.testing.assert_allclose(found, points)
    assert said == [f"keypoints: 1 of {25 * NUM} have NaN, null or infinity in them: "
                    "taken as missing."]  # fmt: skip


def test_missing_points_written_as_nan_are_no_error(tmp_path):
    """Nobody's legs are seen."""
    points = walk(list(range(25)))
    points[:, 9:15] = np.nan
    points[:, 19:] = np.nan
    found, _ = read(archive(tmp_path / "k.npz", points))
    assert (found[:, 9:15, 2] == 0).all() and (found[:, 2:8, 2] > 0).all()
    points[:, 1:] = np.nan
    path = archive(tmp_path / "k.npz", points)
    with pytest.raises(ValueError, match="576 of 600 keypoints with NaN or infinity"):
        read(path)


def _sized(points: np.ndarray, kind: str, width: int, height: int) -> dict | None:
    if kind == "COCO":
        data = _coco(points, NAMES)
        for image in data["images"]:
            image |= {"width": width, "height": height}
    elif kind == "MMPose":
        data = _mmpose(points, NAMES) | {"img_shape": [height, width]}
    else:
        data = _vit(points, NAMES) | {"image_size": [width, height]}
    return data


@pytest.mark.parametrize("kind", ["COCO", "MMPose", "easy_ViTPose", "archive"])
def test_a_size_that_the_file_declares(tmp_path, kind):
    points = walk(list(range(25)))

    def file(width: int, height: int, scale: float) -> Path:
        scaled = points.copy()
        scaled[..., :2] = (points[..., :2] + 0.5) * scale - 0.5
        if kind == "archive":
            size = {"width": width, "height": height}
            return archive(tmp_path / "k.npz", scaled, **size)
        path = tmp_path / "k.json"
        path.write_text(json.dumps(_sized(scaled, kind, width, height)))
        return path

    found, said = read(file(WIDTH, HEIGHT, 1.0))
    assert said == []
    found, said = read(file(WIDTH // 2, HEIGHT // 2, 0.5))
    np.testing.assert_allclose(found, points, atol=1e-9)
    assert (
        "keypoints of images of 320x240 px" in said[0] and "multiplied by 2" in said[0]
    )
    with pytest.raises(ValueError, match="640x640 px, but the video has 640x480"):
        read(file(640, 640, 1.0))
    with pytest.raises(ValueError, match="480x640 px.*before it was turned upright"):
        read(file(480, 640, 1.0))
    # A header that is wrong: the points are beyond it.
    found, said = read(file(160, 120, 1.0))
    np.testing.assert_allclose(found, points, atol=1e-9)
    assert "beyond that size" in said[0]
