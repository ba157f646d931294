"""Videos as cameras write them: turned, at a variable rate, cut, without motion."""

import dataclasses
import json
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from test_frontend_motion import CAMERA, SIZE, plane_images, scene

from bodyslam_jax.io import frames, read_sequence, video
from bodyslam_jax.sfm import reconstruct, track
from bodyslam_jax.sfm.person_mask import person_masks
from bodyslam_jax.types import Keypoints, Sequence, Tracks


def write(path: Path, images, fps: float = 25.0) -> Path:
    height, width = images[0].shape[:2]
    codec = cv2.VideoWriter.fourcc(*"mp4v")
    writer = cv2.VideoWriter(str(path), codec, fps, (width, height))
    for image in images:
        writer.write(np.repeat(image[..., None], 3, axis=-1))
    writer.release()
    return path


def turn(path: Path, matrix: tuple[int, int, int, int]) -> None:
    """Sets a, b, c, d of the display matrix in the track's header (ISO 14496-12)."""
    data = bytearray(path.read_bytes())
    box = data.index(b"tkhd")
    assert data[box + 4] == 0  # version 0: 32-bit times
    at = box + 4 + 40
    fixed = [n << 16 for n in matrix]
    a, b, c, d = fixed
    data[at : at + 36] = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)
    path.write_bytes(bytes(data))


@pytest.mark.parametrize(
    "matrix, size, corner",
    [
        ((1, 0, 0, 1), (80, 48), (0, 0)),
        ((0, 1, -1, 0), (48, 80), (0, -1)),  # a quarter turn clockwise
        ((-1, 0, 0, -1), (80, 48), (-1, -1)),
        ((0, -1, 1, 0), (48, 80), (-1, 0)),
    ],
)
def test_a_video_is_turned_as_it_asks(tmp_path, matrix, size, corner):
    """Phones write pictures as the sensor lies, and how to turn them."""
    image = np.full((48, 80), 40, np.uint8)
    image[:16, :16] = 250  # the sensor's first corner
    path = write(tmp_path / "a.mp4", [image] * 4)
    turn(path, matrix)
    footage = video.look_at(path)
    assert (footage.width, footage.height) == size
    for shown in frames(path, gray=True):
        assert shown.shape == size[::-1]
        bright = np.argwhere(shown > 200).mean(axis=0) / shown.shape
        np.testing.assert_allclose(bright, np.array(corner) % 2 * 0.7 + 0.15, atol=0.1)
    sequence = read_sequence(path)
    np.testing.assert_allclose(
        sequence.intrinsics.params[2:], [(size[0] - 1) / 2, (size[1] - 1) / 2]
    )


def test_a_steady_rate_is_left_as_it_is():
    times = 3.0 + np.arange(50) / 29.97
    found, picks, warnings = video.resampled(Path("a.mp4"), times, 29.97)
    np.testing.assert_allclose(found, times - 3.0)
    assert picks is None and warnings == ()


def test_a_variable_rate_is_thinned_to_its_clock():
    """A burst is thinned, a gap stays, and every time is that of its frame."""
    steady = np.arange(60) / 30
    burst = steady[20] + np.arange(1, 8) / 240
    times = np.sort(np.concatenate([np.delete(steady, [40, 41]), burst]))
    found, picks, warnings = video.resampled(Path("a.mp4"), times, 30.0)
    assert len(warnings) == 1 and "variable frame rate" in warnings[0]
    assert "58 of 65 frames used" in warnings[0]
    np.testing.assert_allclose(found, times[picks])
    np.testing.assert_allclose(found, np.delete(steady, [40, 41]), atol=1e-9)


def test_a_variable_rate_without_a_burst_is_not_said_to_be_resampled():
    times = np.delete(np.arange(60) / 30, [30])
    found, picks, warnings = video.resampled(Path("a.mp4"), times, 30.0)
    np.testing.assert_array_equal(found, times)
    assert picks is None and len(warnings) == 1
    assert "all frames used" in warnings[0] and "resampled" not in warnings[0]


@pytest.mark.parametrize("size", [(100, 4), (2, 2)])
def test_images_too_small_for_anything_are_refused(tmp_path, size):
    for k in range(4):
        image = np.full(size[::-1], 50 * k, np.uint8)
        cv2.imwrite(str(tmp_path / f"{k}.png"), image)
    with pytest.raises(ValueError, match=f"{size[0]}x{size[1]} px are too small"):
        read_sequence(tmp_path)


def test_nobody_is_masked_before_they_come(tmp_path):
    """Someone who enters a clip of less than a second, and leaves on the other side."""
    uv, confidence = np.zeros((1, 20, 25, 2)), np.zeros((1, 20, 25))
    uv[0, 8:] = np.array([20.0, 20.0]) + 3.0 * np.arange(12)[:, None, None]
    uv[0, 8:] += np.random.default_rng(0).uniform(0, 10, (25, 2))
    confidence[0, 8:17] = 1.0
    sequence = Sequence(
        "a",
        None,
        np.arange(20) / 30,
        CAMERA,
        keypoints=Keypoints(uv, confidence),
    )
    masked = [bool(m.any()) for m in person_masks(sequence, 0.05) if m is not None]
    assert masked == [False] * 8 + [True] * 12  # who was there is still there


def test_times_that_do_not_increase_are_made_up():
    times = np.array([0.0, 0.04, 0.04, 0.08])
    found, picks, warnings = video.resampled(Path("a.mp4"), times, 25.0)
    np.testing.assert_allclose(found, np.arange(4) / 25)
    assert picks is None and "25 frames/s taken" in warnings[0]


def test_what_belongs_to_frames_left_out_is_left_out(tmp_path, monkeypatch):
    """Images, keypoints, bodies, masks and tracks of a video at a variable rate."""
    images = [np.full((48, 64), 10 * k, np.uint8) for k in range(12)]
    write(tmp_path / "video.mp4", images)
    for name in ("keypoints", "masks"):
        (tmp_path / name).mkdir()
    for k in range(12):
        points = np.tile([4.0 * k + 1.0, 10.0, 1.0], (25, 1))
        points[:, 1] += np.arange(25)
        person = {"pose_keypoints_2d": points.ravel().tolist()}
        text = json.dumps({"people": [person]})
        (tmp_path / "keypoints" / f"a_{k:012d}_keypoints.json").write_text(text)
        mask = np.zeros((48, 64), np.uint8)
        mask[:, 4 * k : 4 * k + 4] = 255
        cv2.imwrite(str(tmp_path / "masks" / f"{k:02d}.png"), mask)
    frame, landmark = (a.ravel() for a in np.mgrid[:12, :3])
    uv = np.stack([frame + 5.0, landmark + 5.0], axis=-1)
    np.savez(tmp_path / "tracks.npz", frame=frame, landmark=landmark, uv=uv)
    np.savez(
        tmp_path / "bodies.npz",
        frame=np.arange(12),
        poses=np.zeros((12, 72)),
        betas=np.tile(np.arange(12.0)[:, None] / 10, 10),
        trans=np.tile([0.0, 0.0, 3.0], (12, 1)),
        shapes_regressed=np.array(False),
    )
    dense = np.concatenate([np.arange(6) / 25, 5 / 25 + np.arange(1, 4) / 200])
    times = np.concatenate([dense, 6 / 25 + np.arange(3) / 25])
    wanted = [0, 1, 2, 3, 4, 5, 9, 10, 11]
    resampled = video.resampled
    monkeypatch.setattr(
        video, "resampled", lambda path, _, rate: resampled(path, times, rate)
    )
    sequence = read_sequence(tmp_path)
    np.testing.assert_allclose(sequence.timestamps, np.arange(9) / 25, atol=1e-9)
    np.testing.assert_array_equal(sequence.picks, wanted)
    means = [image.mean() / 10 for image in frames(sequence, gray=True)]
    np.testing.assert_allclose(means, wanted, atol=0.4)
    at = sequence.keypoints.uv[0, :, 0, 0]
    np.testing.assert_allclose(at, np.multiply(wanted, 4) + 1)
    np.testing.assert_allclose(sequence.bodies.shapes[0, :, 0], np.divide(wanted, 10))
    assert not sequence.bodies.shapes_regressed
    np.testing.assert_allclose(sequence.tracks.uv[::3, 0], np.add(wanted, 5))
    assert sequence.tracks.frame.max() == 8
    middle = [np.argwhere(m)[:, 1].mean() for m in person_masks(sequence, 0.01)]
    np.testing.assert_allclose(middle[1:], np.multiply(wanted[1:], 4) + 1.5, atol=1)


def test_a_camera_on_a_tripod_and_a_cut_from_images(tmp_path):
    """As found in a video file, not in made tracks: compression moves points too."""
    still = [plane_images(1)[0]] * 10
    rng = np.random.default_rng(0)
    noisy = [
        np.clip(i + rng.normal(0, 3, i.shape), 0, 255).astype(np.uint8) for i in still
    ]
    sequence = read_sequence(write(tmp_path / "still.mp4", noisy))
    found = reconstruct(track(sequence), CAMERA, 10)
    assert found.kind == "static" and "stands still" in found.warnings[0]
    both = noisy + plane_images(10, seed=3)
    sequence = read_sequence(write(tmp_path / "cut.mp4", both))
    found = reconstruct(track(sequence), CAMERA, 20)
    assert any("cut or lost tracking at frame 10" in w for w in found.warnings)


def test_a_flat_image_has_too_few_points(tmp_path):
    gray = [np.full(SIZE[::-1], 90, np.uint8)] * 6
    sequence = dataclasses.replace(
        read_sequence(write(tmp_path / "flat.mp4", gray)), intrinsics=CAMERA
    )
    found = reconstruct(track(sequence), CAMERA, 6)
    assert found.kind == "failed" and "too few background points" in found.warnings[0]


def test_one_clean_shot_among_several_is_used():
    """Three shots, of which the longest is the middle one."""
    parts = [scene(kind, num=n, seed=i) for i, (kind, n) in enumerate(SHOTS)]
    frame, landmark, uv, start, born = [], [], [], 0, 0
    for (tracks, _), (_, num) in zip(parts, SHOTS, strict=True):
        frame.append(tracks.frame + start)
        landmark.append(tracks.landmark + born)
        uv.append(tracks.uv)
        start, born = start + num, born + int(tracks.landmark.max()) + 1
    found = reconstruct(Tracks(*map(np.concatenate, (frame, landmark, uv))), CAMERA, 45)
    assert "at frame 8, 38: only frames 8 to 37 are used" in found.warnings[0]
    assert found.kind == "moving"
    np.testing.assert_array_equal(np.flatnonzero(found.registered), np.arange(8, 38))


SHOTS = (("orbit", 8), ("sideways", 30), ("turn", 7))
