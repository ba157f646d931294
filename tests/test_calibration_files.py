"""Calibrations as other tools write them."""

import json
import time

import cv2
import numpy as np
import pytest

from bodyslam_jax import io
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io.camera.calibration import read_camera

SIZE = (640, 480)
K = np.array([[500.0, 0.0, 322.0], [0.0, 510.0, 239.0], [0.0, 0.0, 1.0]])
BENT = [-0.11, 0.02, 0.001, -0.002]
FLAT = [500.0, 510.0, 322.0, 239.0]


def words(numbers):
    return " ".join(map(repr, map(float, numbers)))


def matrix_text(matrix):
    return "\n".join(words(row) for row in matrix) + "\n"


ORB2 = """%YAML:1.0

#--------------------------------------------------------------------------------------
# Camera Parameters. Adjust them!
#--------------------------------------------------------------------------------------
Camera.fx: 500.0
Camera.fy: 510.0
Camera.cx: 322.0
Camera.cy: 239.0

Camera.k1: -0.11
Camera.k2: 0.02
Camera.p1: 0.001
Camera.p2: -0.002

# Camera frames per second
Camera.fps: 25.0

# Color order of the images (0: BGR, 1: RGB. It is ignored if images are grayscale)
Camera.RGB: 1
ORBextractor.nFeatures: 1000
"""
ORB3 = """%YAML:1.0
File.version: "1.0"
Camera.type: "PinHole"
Camera1.fx: 500.0
Camera1.fy: 510.0
Camera1.cx: 322.0
Camera1.cy: 239.0
Camera1.k1: -0.11
Camera1.k2: 0.02
Camera1.p1: 0.001
Camera1.p2: -0.002
Camera.width: 640
Camera.height: 480
Camera.newWidth: 600
Camera.newHeight: 350
Camera.fps: 25
"""
ROS = """image_width: 640
image_height: 480
camera_name: narrow
camera_matrix:
  rows: 3
  cols: 3
  data: [500.0, 0.0, 322.0, 0.0, 510.0, 239.0, 0.0, 0.0, 1.0]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.11, 0.02, 0.001, -0.002, 0.0]
"""
POSE2SIM = """[cam_01]
name = "left"
size = [ 640.0, 480.0]
matrix = [ [ 500.0, 0.0, 322.0], [ 0.0, 510.0, 239.0], [ 0.0, 0.0, 1.0]]
distortions = [ -0.11, 0.02, 0.001, -0.002]
rotation = [ 1.2, -0.4, 0.3]
translation = [ 0.1, 1.3, 4.0]
fisheye = false

[cam_02]
name = "right"
size = [ 1280.0, 720.0]
matrix = [ [ 900.0, 0.0, 640.0], [ 0.0, 900.0, 360.0], [ 0.0, 0.0, 1.0]]
distortions = [ 0.0, 0.0, 0.0, 0.0]
rotation = [ 1.2, 0.4, 0.3]
translation = [ -0.1, 1.3, 4.0]
fisheye = false

[metadata]
adjusted = false
error = 0.0
"""
QUALISYS = """<?xml version='1.0' encoding='ASCII'?>
<calibration type="regular"><cameras>
<camera active="1" serial="left" viewrotation="0">
<fov_video left="64" top="32" right="703" bottom="511"/>
<fov_video_max left="0" top="0" right="767" bottom="575"/>
<transform r11="1" r12="0" r13="0" r21="0" r22="1" r23="0" r31="0" r32="0" r33="1"
 x="0" y="0" z="0"/>
<intrinsic focalLengthU="32000" focalLengthV="32640" centerPointU="24704"
 centerPointV="17344" sensorMinU="0" sensorMaxU="49088" sensorMinV="0"
 sensorMaxV="36800" skew="0" radialDistortion1="-0.11" radialDistortion2="0.02"
 radialDistortion3="0" tangentalDistortion1="0.001" tangentalDistortion2="-0.002"/>
</camera></cameras></calibration>
"""

BENT_FILES = {
    "calib.txt": words([*FLAT, *BENT]) + "\n",
    "dpvo.txt": "# fx fy cx cy k1 k2 p1 p2\n" + ", ".join(map(str, [*FLAT, *BENT])),
    "with_k3.txt": words([*FLAT, *BENT, 0.0]),
    "orb2.yaml": ORB2,
    "orb3.yaml": ORB3,
    "ros.yaml": ROS,
    "Calib.toml": POSE2SIM.split("[cam_02]")[0],
    "Calib.qca.txt": QUALISYS,
    "opencv.json": json.dumps({"camera_matrix": K.tolist(), "dist_coeffs": [BENT]}),
}
PLAIN_FILES = {
    "four.txt": words(FLAT) + "\n",
    "intrinsics": words(FLAT),
    "matrix.txt": matrix_text(K),
    "projection.txt": matrix_text(np.hstack([K, np.zeros((3, 1))])),
    "four_by_four.txt": matrix_text(np.block([[K, np.zeros((3, 1))], [0, 0, 0, 1]])),
    "one_line.txt": words(K.ravel()),
    "brackets.txt": str(K),
    "K.json": json.dumps({"K": K.tolist()}),
    "rows.json": json.dumps(K.tolist()),
    "names.json": json.dumps(dict(zip(("fx", "fy", "cx", "cy"), FLAT))),
}


@pytest.mark.parametrize("name", BENT_FILES)
def test_a_distorted_camera_of_another_tool_is_read(tmp_path, name):
    path = tmp_path / name
    path.write_text(BENT_FILES[name])
    found, fps = read_camera(path, SIZE)
    np.testing.assert_allclose(found.params, [*FLAT, *BENT], atol=1e-9)
    assert (found.width, found.height) == SIZE and not found.is_guess
    assert fps == (25.0 if name.startswith("orb") else None)


@pytest.mark.parametrize("name", PLAIN_FILES)
def test_a_camera_without_distortion_is_read(tmp_path, name):
    path = tmp_path / name
    path.write_text(PLAIN_FILES[name])
    found, _ = read_camera(path, SIZE)
    np.testing.assert_allclose(found.params, FLAT, atol=1e-9)
    assert (found.width, found.height) == SIZE


@pytest.mark.parametrize("suffix", ["yml", "xml", "npz", "npy"])
def test_what_opencv_and_numpy_write_is_read(tmp_path, suffix):
    path = tmp_path / f"camera.{suffix}"
    bent = np.array([BENT])
    if suffix == "npz":
        np.savez(path, mtx=K, dist=bent)
    elif suffix == "npy":
        np.save(path, K)
    else:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
        storage.write("image_width", SIZE[0])
        storage.write("image_height", SIZE[1])
        storage.write("camera_matrix", K)
        storage.write("distortion_coefficients", bent)
        storage.release()
    found, _ = read_camera(path, SIZE)
    expected = FLAT if suffix == "npy" else [*FLAT, *BENT]
    np.testing.assert_allclose(found.params, expected, atol=1e-9)


def test_richer_distortion_becomes_one_that_is_alike_in_the_image(tmp_path):
    path = tmp_path / "calib.txt"
    full = np.array([*BENT, 0.004])
    path.write_text(words([*FLAT, *full]))
    found, _ = read_camera(path, SIZE)
    xy = np.array([[x, y, 1.0] for x in (-0.5, 0.1, 0.5) for y in (-0.4, 0.0, 0.4)])
    zero = np.zeros(3)
    expected = cv2.projectPoints(xy, zero, zero, K, full)[0]
    got = cv2.projectPoints(xy, zero, zero, K, found.params[4:])[0]
    assert np.abs(got - expected).max() < 0.5
    path.write_text(words([*FLAT, -0.4, 0.5, 0.0, 0.0, -3.0]))
    with pytest.raises(InputError, match="undistort the images first"):
        read_camera(path, SIZE)


def test_one_camera_of_several_is_chosen_by_name_number_or_video(tmp_path):
    path = tmp_path / "Calib.toml"
    path.write_text(POSE2SIM)
    for wanted in ("left", "0"):
        found, _ = read_camera(tmp_path / f"Calib.toml:{wanted}", SIZE)
        np.testing.assert_allclose(found.params, [*FLAT, *BENT])
    found, _ = read_camera(path, SIZE, "right")
    assert found.params[0] == 900.0 and (found.width, found.height) == (1280, 720)
    with pytest.raises(InputError, match="2 cameras .left, right.*--camera .*:left"):
        read_camera(path, SIZE, "walk")
    with pytest.raises(InputError, match="no camera 'middle', expected one of left, r"):
        read_camera(tmp_path / "Calib.toml:middle", SIZE)


WRONG = {
    "a.txt": ("1 2 3\n", "numbers of shape"),
    "b.txt": (matrix_text(K.T), "expected rows `fx 0 cx`"),
    "c.txt": (words([0.8, 1.06, 0.5, 0.5]), "units of the image"),
    "d.txt": (words([1500, 1500, 966, 718]), "1932x1436 px, but the video has 640x480"),
    "e.txt": (words([1500, 1500, 966, 200]), "another size"),
    "f.txt": (matrix_text([[500, 9, 322], [0, 510, 239], [0, 0, 1]]), "skew"),
    "g.txt": (words([np.nan, 500, 322, 239]), "not finite"),
    "a.json": ('{"K": [[1, 2], [3, 4]]}', "of shape .2, 2., expected 3 x 3"),
    "b.json": ('{"K": "wide"}', "expected numbers"),
    "a.yaml": (ORB3.replace("PinHole", "KannalaBrandt8"), "undistort"),
    "b.yaml": (ORB2.replace("Camera.cy: 239.0", ""), "no `Camera.cy`"),
    "c.yaml": ("a: 1\n", "no `fx`"),
    "a.toml": ("[cam]\nname = 3\n", "expected one for each camera"),
    "b.toml": ("[cam", "TOML"),
    "a.xml": ("<svg></svg>", "XML of <svg>"),
    "b.xml": ("<a><b></a>", "XML"),
    "c.xml": (
        '<!DOCTYPE a [<!ENTITY x "y">]><opencv_storage/>',
        "expected plain XML",
    ),
    "a.qca.txt": (QUALISYS.replace('"24704"', '"wide"'), "centerPointU"),
    "b.qca.txt": (QUALISYS.replace('viewrotation="0"', 'viewrotation="90"'), "turned"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_calibration_that_is_wrong_is_named(tmp_path, name):
    content, text = WRONG[name]
    path = tmp_path / name
    path.write_text(content)
    with pytest.raises(InputError, match=text) as raised:
        read_camera(path, SIZE)
    assert str(path) in str(raised.value) and "\n" not in str(raised.value)


def test_xml_cannot_be_made_to_expand(tmp_path):
    path = tmp_path / "bomb.xml"
    entities = "".join(f'<!ENTITY x{k + 1} "{f"&x{k};" * 10}">' for k in range(12))
    path.write_text(f'<!DOCTYPE a [<!ENTITY x0 "y">{entities}]><a>&x12;</a>')
    start = time.monotonic()
    with pytest.raises(InputError, match="DOCTYPE"):
        read_camera(path, SIZE)
    path.write_text("<a>" * 100_000)
    with pytest.raises(InputError, match="not a calibration .XML"):
        read_camera(path, SIZE)
    assert time.monotonic() - start < 5


def test_a_sequence_takes_size_and_rate_from_its_video(tmp_path):
    folder = tmp_path / "clip"
    folder.mkdir()
    for k in range(4):
        cv2.imwrite(str(folder / f"{k:04}.png"), np.full((480, 640), 40 * k, np.uint8))
    path = tmp_path / "orb.yaml"
    path.write_text(ORB2)
    sequence = io.read_sequence(folder, camera=path)
    np.testing.assert_allclose(sequence.intrinsics.params, [*FLAT, *BENT])
    np.testing.assert_allclose(np.diff(sequence.timestamps), 1 / 25)
    path.write_text(ORB3.replace("640", "1280").replace("480", "960"))
    with pytest.raises(InputError, match="for 1280x960 px, but clip has 640x480"):
        io.read_sequence(folder, camera=path)
