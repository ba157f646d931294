"""People and keypoints from images: decoding, models, a network that a test makes."""

import hashlib
import struct

import numpy as np
import pytest

from bodyslam_jax.config import Detect
from bodyslam_jax.people import detect, detect_people

SIZE = (64, 96)  # rows, columns of the toy detector's canvas
NUM_CELLS = sum((SIZE[0] // s) * (SIZE[1] // s) for s in (8, 16, 32))


def raw_output(*people):
    """What a YOLOX says that sees people at (centre x, y, width, height, score)."""
    raw = np.full((NUM_CELLS, 85), 0.0, np.float32)
    for x, y, w, h, score, stride in people:
        before = {8: 0, 16: 96, 32: 96 + 24}[stride]
        column, row = int(x // stride), int(y // stride)
        raw[before + row * (SIZE[1] // stride) + column] = 0.0
        cell = raw[before + row * (SIZE[1] // stride) + column]
        cell[:2] = x / stride - column, y / stride - row
        cell[2:4] = np.log([w / stride, h / stride])
        cell[4], cell[5] = 1.0, score
    return raw


def test_boxes_of_every_stride():
    expected = [(20, 24, 16, 40, 0.9, 8), (70, 30, 30, 50, 0.8, 16)]
    expected.append((50, 40, 60, 20, 0.7, 32))
    boxes, score = detect.decode_yolox(raw_output(*expected), SIZE, 0.5)
    order = np.argsort(-score)
    np.testing.assert_allclose(score[order], [0.9, 0.8, 0.7], atol=1e-6)
    for box, (x, y, w, h, *_) in zip(boxes[order], expected):
        wanted = [x - w / 2, y - h / 2, x + w / 2, y + h / 2]
        np.testing.assert_allclose(box, wanted, atol=1e-4)  # float32


def test_boxes_below_the_threshold_and_other_classes_are_dropped():
    raw = raw_output((20, 24, 16, 40, 0.4, 8), (70, 30, 30, 50, 0.9, 16))
    dog = raw[:, 5] == np.float32(0.9)
    raw[dog, 5], raw[dog, 21] = 0.0, 0.9
    assert len(detect.decode_yolox(raw, SIZE, 0.5)[0]) == 0


def test_a_detector_of_another_kind_is_refused():
    with pytest.raises(ValueError, match=r"detector: output of shape \(10, 85\)"):
        detect.decode_yolox(np.zeros((10, 85), np.float32), SIZE, 0.5)


def test_the_better_of_two_overlapping_boxes_stays():
    boxes = np.array([[0, 0, 10, 10], [1, 0, 11, 10], [8, 0, 18, 10.0]])
    kept = detect.suppress(boxes, np.array([0.7, 0.9, 0.8]), 0.45)
    assert kept.tolist() == [1, 2]  # 0 and 1 share 9/11; 1 and 2 share 3/17


def test_simcc_takes_the_best_bin_and_the_lower_score():
    x, y = np.zeros((2, 3, 40))
    x[0, 12], y[0, 31] = 0.9, 0.6
    x[1, 0], y[1, 39] = 0.2, 1.5
    points, confidence = detect.decode_simcc(x, y)
    np.testing.assert_allclose(points[:2], [[6, 15.5], [0, 19.5]])
    np.testing.assert_allclose(confidence, [0.6, 0.2, 0.0])


@pytest.mark.parametrize("count", [17, 26, 133])
def test_body25_from_other_layouts(count):
    """By name, against the tables of the body's own layouts where there is one."""
    from bodyslam_jax.body import KEYPOINT_NAMES

    wanted = KEYPOINT_NAMES["body25"]
    names = list(KEYPOINT_NAMES["coco17"])
    if count == 26:
        names = list(KEYPOINT_NAMES["halpe26"])
    if count == 133:
        sides = ("left", "right")
        names += [f"{s}_{p}" for s in sides for p in ("big_toe", "small_toe", "heel")]
    points = np.column_stack([np.arange(count), -np.arange(count), np.ones(count)])
    found = detect.to_body25(points.astype(float))
    for k, name in enumerate(wanted):
        if name in names and name not in ("neck", "mid_hip"):
            assert found[k].tolist() == points[names.index(name)].tolist(), name
        elif name not in ("neck", "mid_hip"):
            assert found[k, 2] == 0  # no feet in COCO's 17
    np.testing.assert_allclose(found[1, :2], (found[2, :2] + found[5, :2]) / 2)
    np.testing.assert_allclose(found[8, :2], (found[9, :2] + found[12, :2]) / 2)


def test_a_pose_network_of_another_kind_is_refused():
    with pytest.raises(ValueError, match="21 keypoints, expected 17, 26 or 133"):
        detect.to_body25(np.zeros((21, 3)))


def test_sampling_is_exact_on_pixels_linear_between_and_black_outside():
    image = np.random.default_rng(0).integers(0, 255, (5, 7, 3), np.uint8)
    whole = detect.sample(image, np.arange(7.0), np.arange(5.0))
    np.testing.assert_allclose(whole, image)
    middle = detect.sample(image, np.array([2.5]), np.array([1.0]))
    np.testing.assert_allclose(middle[0, 0], image[1, 2:4].mean(0))
    assert not detect.sample(image, np.array([-3.0, 9.0]), np.array([2.0])).any()


def test_models_are_fetched_once_and_checked(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "remote.onnx").write_bytes(b"a network")
    digest = hashlib.sha256(b"a network").hexdigest()
    url = (tmp_path / "remote.onnx").as_uri()
    model = detect.Model("toy.onnx", url, digest, 0)
    with pytest.raises(ValueError, match="offline is set"):
        detect.model_path(None, model, offline=True)
    path = detect.model_path(None, model, offline=False)
    assert path.read_bytes() == b"a network"
    (tmp_path / "remote.onnx").unlink()
    assert detect.model_path(None, model, offline=True) == path
    path.write_bytes(b"damaged")
    with pytest.raises(ValueError, match="delete the file"):
        detect.model_path(None, model, offline=True)


def test_no_network_is_said_in_one_line(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    gone = detect.Model("x.onnx", (tmp_path / "gone").as_uri(), "0", 0)
    with pytest.raises(ValueError, match="cannot be fetched") as caught:
        detect.model_path(None, gone, offline=False)
    assert "\n" not in str(caught.value)
    assert not list((tmp_path / "bodyslam" / "models").iterdir())  # nothing half-done


def test_an_own_model_that_is_not_there():
    with pytest.raises(ValueError, match="nowhere.onnx: no such file"):
        detect.model_path("nowhere.onnx", detect.POSE, offline=True)


def test_networks_that_always_say_the_same(tmp_path):
    """Both networks, run by onnxruntime: the person and the points that they say."""
    raw = raw_output((40, 32, 20, 40, 0.9, 8))[None]
    detector = tmp_path / "detector.onnx"
    detector.write_bytes(constant_network((1, 3, *SIZE), {"output": raw}))
    x, y = np.zeros((1, 26, 96), np.float32), np.zeros((1, 26, 128), np.float32)
    x[0, :, 30], y[0, :, 100] = 0.7, 0.8
    pose = tmp_path / "pose.onnx"
    pose.write_bytes(constant_network((1, 3, 64, 48), {"simcc_x": x, "simcc_y": y}))
    settings = Detect(detector=str(detector), pose=str(pose))
    image = np.zeros((128, 192, 3), np.uint8)  # twice the canvas
    (found,) = detect_people([image], settings, offline=True)
    # The box is 30..50 by 12..52 on the canvas, twice that in the image: 40 x 80 px
    # about (80, 64). Times 1.25: 100 px high for 64 rows; columns follow.
    step = 100 / 64
    wanted = [80 - 24 * step + 15 * step, 64 - 32 * step + 50 * step, 0.7]
    assert found.shape == (1, 25, 3)
    np.testing.assert_allclose(found[0], np.tile(wanted, (25, 1)), rtol=1e-5)


def constant_network(input_shape, outputs) -> bytes:
    """An ONNX file, written by hand: an unused input, outputs that are constants."""

    def varint(number):
        out = b""
        while number > 0x7F:
            out, number = out + bytes([number & 0x7F | 0x80]), number >> 7
        return out + bytes([number])

    def field(number, value):
        if isinstance(value, int):
            return varint(number << 3) + varint(value)
        value = value.encode() if isinstance(value, str) else value
        return varint(number << 3 | 2) + varint(len(value)) + value

    def value_info(name, shape):
        dims = b"".join(field(1, field(1, n)) for n in shape)
        tensor = field(1, 1) + field(2, dims)  # elem_type float
        return field(1, name) + field(2, field(1, tensor))

    graph = b""
    for name, array in outputs.items():
        graph += field(1, field(1, f"{name}_0") + field(2, name) + field(4, "Identity"))
    graph += field(2, "toy")
    for name, array in outputs.items():
        data = struct.pack(f"<{array.size}f", *array.ravel())
        tensor = b"".join(field(1, n) for n in array.shape) + field(2, 1)
        graph += field(5, tensor + field(8, f"{name}_0") + field(9, data))
    graph += field(11, value_info("input", input_shape))
    for name, array in outputs.items():
        graph += field(12, value_info(name, array.shape))
    return field(1, 8) + field(7, graph) + field(8, field(1, "") + field(2, 13))
