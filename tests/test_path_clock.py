"""A camera path whose clock is not the video's is put on the frames that fit it."""

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bodyslam_jax import sfm
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io.camera.path import read_camera_path, write_tum
from bodyslam_jax.sfm.given_path import PathTest
from bodyslam_jax.types import CameraPath, Intrinsics, Tracks

NUM, RATE = 90, 30.0
TIMES = np.arange(NUM) / RATE
CAMERA = Intrinsics(np.array([525.0, 525.0, 319.5, 239.5]), 640, 480)
UNIX = 1_700_000_000.0


def hand(times):
    """Rotations and centres of a camera that is carried through a room, at any times
    (s): slow sways of several periods in each axis."""
    rng = np.random.default_rng(3)
    sway = lambda size: sum(
        size / (k + 1) * np.sin(np.outer(times, rng.uniform(1, 2, 3) * (k + 1)) + p)
        for k, p in enumerate(rng.uniform(0, 6, (4, 3)))
    )
    centre = sway(0.35) + np.outer(times, [0.25, 0.0, 0.15])
    return Rotation.from_rotvec(sway(0.12)), centre


def straight(times):
    """A camera on a rail: steady speed, no rotation."""
    return Rotation.identity(len(times)), np.outer(times, [0.5, 0.0, 0.0])


def poses(motion, times):
    R, centre = motion(np.asarray(times, float))
    T_WC = np.tile(np.eye(4), (len(times), 1, 1))
    T_WC[:, :3, :3], T_WC[:, :3, 3] = R.as_matrix(), centre
    return T_WC


def tracks_of(motion, noise=0.4, seed=0):
    """Tracks of points of a room, of half a second and a second and a half."""
    rng = np.random.default_rng(seed)
    T_WC = poses(motion, TIMES)
    points = rng.uniform([-5, -2.5, 2], [6, 2, 9], (900, 3))
    p_C = np.einsum("tij,tpi->tpj", T_WC[:, :3, :3], points - T_WC[:, None, :3, 3])
    uv = p_C[..., :2] / np.maximum(p_C[..., 2:], 0.1) * 525 + [319.5, 239.5]
    seen = (p_C[..., 2] > 0.5) & (uv > 0).all(-1) & (uv < [639, 479]).all(-1)
    born = rng.integers(-30, NUM, len(points))
    age = np.arange(NUM)[:, None] - born
    seen &= (age >= 0) & (age < rng.integers(15, 45, len(points)))
    frame, landmark = np.nonzero(seen)
    uv = uv[frame, landmark] + rng.normal(0, noise, (len(frame), 2))
    wrong = rng.random(len(frame)) < 0.03
    uv[wrong] += rng.normal(0, 20, (int(wrong.sum()), 2))
    return Tracks(frame, landmark, uv)


HAND = tracks_of(hand)


def placed(tmp_path, times, T_WC, tracks=HAND, metric=True, camera=CAMERA):
    """The path of a TUM file on the frames, and all that was said."""
    file = tmp_path / "slam.txt"
    write_tum(file, np.asarray(times, float), T_WC)
    lines: list[str] = []
    path = read_camera_path(file, timestamps=TIMES, metric=metric, warn=lines.append)
    found = sfm.place_in_time(path, tracks, camera, TIMES)
    return found.path, " ".join([*lines, *found.warnings])


def told(text):
    """First pose (s), its sigma, and the percentage of points that fit."""
    found = re.search(r"first pose at (\S+) ± (\S+) s .*?where (\d+) %", text)
    assert found, text
    return tuple(map(float, found.groups()))


LATE = 10
IN_FRAMES = np.arange(NUM)[LATE:]
CLOCKS = {
    "Unix time": TIMES[LATE:] + UNIX,
    "seconds from the first pose": TIMES[LATE:] - TIMES[LATE],
    "milliseconds": np.round((TIMES[LATE:] - TIMES[LATE]) * 1e3),
    "Unix milliseconds": np.round((TIMES[LATE:] + UNIX) * 1e3),
    "nanoseconds": np.round((TIMES[LATE:] + UNIX) * 1e3) * 1e6,
    "frame numbers": IN_FRAMES - LATE,
    "frame numbers of a longer video": IN_FRAMES + 400,
    "25 frames/s assumed": (IN_FRAMES - LATE) / 25,
}
QUICK = ("Unix time", "milliseconds", "frame numbers")
"""The others are read alike, and take as long."""


@pytest.mark.parametrize(
    "clock",
    [c if c in QUICK else pytest.param(c, marks=pytest.mark.slow) for c in CLOCKS],
)
def test_a_path_that_starts_late_is_put_on_its_frames(tmp_path, clock):
    T_WC = poses(hand, TIMES)
    path, text = placed(tmp_path, CLOCKS[clock], T_WC[LATE:])
    first, sigma, share = told(text)
    assert abs(first - LATE / RATE) < 0.002 and sigma < 0.01 and share > 85
    np.testing.assert_array_equal(np.flatnonzero(path.known), IN_FRAMES)
    # Whole milliseconds move a pose by half a millisecond.
    np.testing.assert_allclose(path.T_WC[LATE:], T_WC[LATE:], atol=2e-3)
    assert path.metric and f"poses for {NUM - LATE} of {NUM} frames" in text


@pytest.mark.parametrize(
    "rate",
    [
        pytest.param(10.0, marks=pytest.mark.slow),
        30.0,
        pytest.param(120.0, marks=pytest.mark.slow),
    ],
)
def test_an_offset_of_part_of_a_frame_is_found_within_its_sigma(tmp_path, rate):
    times = np.arange(TIMES[7] + 0.0117, TIMES[-1], 1 / rate)
    path, text = placed(tmp_path, times + UNIX, poses(hand, times), metric=False)
    first, sigma, _ = told(text)
    assert abs(first - times[0]) < 4 * sigma + 5e-4 and sigma < 0.01
    known = np.flatnonzero(path.known)
    np.testing.assert_allclose(
        path.T_WC[known], poses(hand, TIMES)[known], atol=0.01 if rate > 20 else 0.03
    )


def test_noise_of_a_path_does_not_draw_its_offset_between_frames(tmp_path):
    rng = np.random.default_rng(0)
    T_WC = poses(hand, TIMES)[LATE:]
    shake = Rotation.from_rotvec(rng.normal(0, 1.5e-3, (len(T_WC), 3))).as_matrix()
    T_WC[:, :3, :3] = T_WC[:, :3, :3] @ shake
    T_WC[:, :3, 3] += rng.normal(0, 0.005, (len(T_WC), 3))
    path, text = placed(tmp_path, TIMES[LATE:] + UNIX, T_WC)
    assert told(text)[0] == pytest.approx(LATE / RATE, abs=0.001)
    np.testing.assert_allclose(path.T_WC[LATE:], T_WC, atol=1e-6)


def test_numbered_gaps_are_bridged_and_others_are_refused(tmp_path):
    kept = np.r_[5:38, 46:NUM]
    T_WC = poses(hand, TIMES)[kept]
    path, _ = placed(tmp_path, TIMES[kept] + UNIX, T_WC)
    np.testing.assert_allclose(path.T_WC[kept], T_WC, atol=1e-4)
    # Shorter than half a second, the gap is bridged.
    np.testing.assert_array_equal(np.flatnonzero(path.known), np.arange(5, NUM))
    with pytest.raises(ValueError, match="poses left out and not numbered"):
        placed(tmp_path, np.arange(len(kept)) / RATE + UNIX, T_WC)


def test_a_path_on_the_clock_of_the_video_stays_where_it_is(tmp_path):
    T_WC = poses(hand, TIMES)
    for kept in (slice(None), slice(8, 80)):
        path, text = placed(tmp_path, TIMES[kept], T_WC[kept])
        assert "clock" not in text and "first pose" not in text
        np.testing.assert_array_equal(np.flatnonzero(path.known), np.arange(NUM)[kept])
        np.testing.assert_allclose(path.T_WC[kept], T_WC[kept], atol=1e-6)


def test_a_path_that_contradicts_its_own_times_is_moved(tmp_path):
    T_WC = poses(hand, TIMES)
    path, text = placed(tmp_path, TIMES[3:70], T_WC[10:77])
    first, _, share = told(text)
    assert first == pytest.approx(10 / RATE, abs=0.001) and share > 85
    assert "and not at 0.100 s" in text
    np.testing.assert_allclose(path.T_WC[10:77], T_WC[10:77], atol=1e-6)


def test_a_path_of_another_motion_is_refused_as_one_on_another_clock(tmp_path):
    backwards = poses(hand, TIMES[::-1])
    with pytest.raises(
        InputError, match="clock is not the video's.*no offset explains"
    ):
        placed(tmp_path, TIMES[LATE:] + UNIX, backwards[LATE:])


def test_offsets_that_cannot_be_told_apart_are_named_where_they_do_not_matter(tmp_path):
    rail = tracks_of(straight)
    path, text = placed(
        tmp_path, TIMES[LATE:] + UNIX, poses(straight, TIMES[LATE:]), rail
    )
    assert "fit the images equally well and give the same path" in text
    step = np.diff(path.T_WC[path.known][:, :3, 3], axis=0)
    np.testing.assert_allclose(
        step, np.tile([0.5 / RATE, 0, 0], (len(step), 1)), atol=1e-6
    )


def test_an_offset_that_the_images_do_not_tell_is_refused_where_it_matters(tmp_path):
    """Points at infinity and no rotation: any speed fits, and they differ."""
    still = lambda times: (Rotation.identity(len(times)), np.zeros((len(times), 3)))
    path = poses(straight, TIMES)
    path[:, 0, 3] = 0.001 * np.maximum(TIMES - 1.5, 0) ** 2  # moves by some mm at last
    with pytest.raises(InputError, match="equally well but give different paths"):
        placed(tmp_path, TIMES[LATE:] + UNIX, path[LATE:], tracks_of(still))


def test_without_points_an_unknown_clock_is_refused(tmp_path):
    nothing = Tracks(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)))
    T_WC = poses(hand, TIMES)
    with pytest.raises(InputError, match="do not tell the offset"):
        placed(tmp_path, TIMES[LATE:] + UNIX, T_WC[LATE:], nothing)
    path, _ = placed(tmp_path, TIMES, T_WC, nothing)
    assert path.known.all()


@pytest.mark.slow
def test_a_path_tells_a_guessed_focal_length_from_a_wrong_one(tmp_path):
    guess = Intrinsics(np.array([700.0, 700.0, 319.5, 239.5]), 640, 480, is_guess=True)
    T_WC = poses(hand, TIMES)
    path, text = placed(tmp_path, TIMES[LATE:] + UNIX, T_WC[LATE:], camera=guess)
    assert told(text)[0] == pytest.approx(LATE / RATE, abs=0.003)
    assert "not with the guess of 700 px" in text


def test_how_to_read_a_path_of_other_axes_is_said():
    T_WC = poses(hand, TIMES)
    known = np.ones(NUM, bool)
    for wrong, text in (
        (np.linalg.inv(T_WC), "from world to camera"),
        (T_WC * [1.0, -1.0, -1.0, 1.0], "OpenGL's axes"),
    ):
        with pytest.raises(InputError, match=text):
            sfm.reconstruct(HAND, CAMERA, NUM, path=CameraPath(wrong, known, True))


def test_the_share_that_must_fit_follows_from_the_noise():
    """Tracks of more noise leave fewer points within the threshold's sigmas."""
    T_WC, known = poses(hand, TIMES), np.ones(NUM, bool)
    fine = PathTest(HAND, CAMERA, NUM)
    coarse = PathTest(tracks_of(hand, noise=2.0), CAMERA, NUM)
    assert coarse.threshold > 1.5 * fine.threshold
    for test in (fine, coarse):
        fit = test.fit(T_WC, known)
        assert fit.share > 0.95 * fit.expected and fit.fits
        # Noise of twice the assumed is what is still accepted.
        assert fit.required == pytest.approx(fit.expected * 0.393 / 0.865, rel=0.01)


def test_two_poses_of_one_frame_are_refused(tmp_path):
    rows = [f"{i + 1} 1 0 0 0 0.{i} 0 0 1 frame_{i:04d}.jpg\n\n" for i in (0, 1, 1, 3)]
    (tmp_path / "images.txt").write_text("".join(rows))
    with pytest.raises(InputError, match="images.txt: two poses or more of frame 1"):
        read_camera_path(
            tmp_path / "images.txt", timestamps=TIMES, metric=False, warn=lambda _: None
        )
