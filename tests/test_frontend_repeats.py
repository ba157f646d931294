"""Frames that repeat the one before, and pixels whose shape the file tells."""

import struct

import cv2
import numpy as np
import pytest
from test_frontend_motion import SIZE, plane_images

from bodyslam_jax.io import read_sequence


def write(path, images, fps=30.0):
    size = images[0].shape[1::-1]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), fps, size)
    for image in images:
        writer.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    writer.release()
    return path


@pytest.mark.parametrize("of, per", [(1, 2), (4, 5), (2, 5)])
def test_a_conversion_of_the_rate_is_undone(tmp_path, of, per):
    shown = [k * of // per for k in range(60)]
    images = plane_images(shown[-1] + 1)
    path = write(tmp_path / "a.mp4", [images[k] for k in shown], 60.0)
    found = read_sequence(path)
    assert found.picks is not None
    # The encoder may take another try at the first frame.
    assert abs(found.num_frames - len(images)) <= 1
    assert found.fps == pytest.approx(60 * of / per, rel=0.05)
    assert any("only repeat the one before" in text for text in found.warnings)


def test_a_freeze_keeps_the_times_of_what_is_new(tmp_path):
    images = plane_images(40)
    shown = [k if not 15 <= k < 25 else 15 for k in range(40)]
    found = read_sequence(write(tmp_path / "a.mp4", [images[k] for k in shown]))
    assert found.num_frames == 31 and found.picks is not None
    np.testing.assert_allclose(found.timestamps, found.picks / 30, atol=2e-3)


@pytest.mark.parametrize("still", [True, False])
def test_neither_a_still_scene_nor_a_moving_one_has_repeats(tmp_path, still):
    images = plane_images(1) * 30 if still else plane_images(30)
    rng = np.random.default_rng(0)
    noisy = [np.clip(i + rng.normal(0, 2, i.shape), 0, 255) for i in images]
    found = read_sequence(write(tmp_path / "a.mp4", [i.astype("u1") for i in noisy]))
    assert found.num_frames == 30 and found.picks is None


def test_who_stands_for_a_moment_before_a_still_camera_repeats_nothing(tmp_path):
    background = plane_images(1)[0]
    images = []
    for k in range(50):
        image = background.copy()
        x = 40 + 5 * min(k, 15) + 5 * max(0, k - 32)  # walks, stands, walks on
        cv2.rectangle(image, (x, 60), (x + 40, 200), 30 + 3 * (k % 2), -1)
        images.append(image)
    assert read_sequence(write(tmp_path / "a.mp4", images)).num_frames == 50


def test_repeated_images_of_a_folder_are_left_out(tmp_path):
    folder = tmp_path / "images"
    folder.mkdir()
    images = plane_images(15)
    for k in range(30):
        cv2.imwrite(str(folder / f"{k:03}.png"), images[k // 2])
    found = read_sequence(folder)
    assert found.num_frames == 15 and found.picks is not None
    np.testing.assert_array_equal(found.picks, np.arange(0, 30, 2))


def with_aspect(path, across, along):
    """Writes the shape of pixels into an .mp4 file, as cameras do: a `pasp` box."""
    data = bytearray(path.read_bytes())
    at = data.index(b"mp4v", data.index(b"stsd")) - 4
    size = struct.unpack(">I", data[at : at + 4])[0]
    data[at + size : at + size] = struct.pack(">I4sII", 16, b"pasp", across, along)
    for name in (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stsd", b"mp4v"):
        start = at if name == b"mp4v" else data.rindex(name, 0, at + 4) - 4
        old = struct.unpack(">I", data[start : start + 4])[0]
        data[start : start + 4] = struct.pack(">I", old + 16)
    path.write_bytes(bytes(data))


def camera(path, width, params):
    text = f'{{"model": "PINHOLE", "width": {width}, "height": {SIZE[1]}, '
    path.write_text(text + f'"params": {list(params)}}}')
    return path


def test_the_shape_of_pixels_is_read_from_the_file(tmp_path):
    path = write(tmp_path / "a.mp4", plane_images(5))
    with_aspect(path, 4, 3)
    found = read_sequence(path)
    fx, fy = found.intrinsics.params[:2]
    assert fx / fy == pytest.approx(0.75)
    assert fy == pytest.approx(1.2 * SIZE[0] * 4 / 3)
    assert any("1.333 times as wide as high" in text for text in found.warnings)


def test_a_camera_that_says_otherwise_is_used_and_doubted(tmp_path):
    path = write(tmp_path / "a.mp4", plane_images(5))
    with_aspect(path, 4, 3)
    square = camera(tmp_path / "square.json", SIZE[0], (300, 300, 159.5, 119.5))
    found = read_sequence(path, camera=square)
    np.testing.assert_allclose(found.intrinsics.params[:2], 300)
    assert any("camera.json used" in text for text in found.warnings)


def test_a_camera_of_the_images_as_shown_is_that_of_those_stored(tmp_path):
    path = write(tmp_path / "a.mp4", plane_images(5))
    with_aspect(path, 3, 2)
    shown = camera(tmp_path / "shown.json", SIZE[0] * 3 // 2, (450, 450, 239.5, 119.5))
    found = read_sequence(path, camera=shown)
    np.testing.assert_allclose(found.intrinsics.params, [300, 450, 159.5, 119.5])
    assert found.intrinsics.width == SIZE[0]
