"""What is no part of the scene: text, logos, borders; and what only looks like it."""

import cv2
import numpy as np
import pytest
from test_frontend_motion import (
    CAMERA,
    SIZE,
    camera_error,
    plane_images,
    scene,
    write_images,
)

from bodyslam_jax.sfm import reconstruct, track, without_burnt_in
from bodyslam_jax.types import Tracks


def with_text(tracks, num, share, rng, shown=None):
    """Points that stay at their pixel, in lines at the bottom and in a corner."""
    count = round(share / (1 - share) * len(tracks.frame) / num)
    places = np.stack(
        [rng.uniform(10, SIZE[0] - 10, count), rng.choice([200, 212, 224], count)], -1
    )
    places[: count // 6] = rng.uniform([250, 8], [310, 30], (count // 6, 2))
    frames = np.arange(num) if shown is None else np.arange(*shown)
    frame, which = (x.ravel() for x in np.meshgrid(frames, np.arange(count)))
    uv = places[which] + rng.normal(0, 0.05, (len(which), 2))
    first = tracks.landmark.max() + 1
    return Tracks(
        np.concatenate([tracks.frame, frame]),
        np.concatenate([tracks.landmark, which + first]),
        np.concatenate([tracks.uv, uv]),
    ), first


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["sideways", "forward", "pan", "turn"])
@pytest.mark.parametrize("share", [0.15, 0.55])
def test_points_that_stay_at_their_pixel_are_left_out(kind, share):
    tracks, truth = scene(kind, noise=0.15)
    mixed, first = with_text(tracks, 60, share, np.random.default_rng(1))
    left, part = without_burnt_in(mixed, CAMERA, 60)
    assert abs(part - share) < 0.04
    assert len(left.frame) > 0.98 * len(tracks.frame)
    assert len(np.unique(left.landmark)) == left.landmark.max() + 1
    if kind != "turn":
        found = reconstruct(left, CAMERA, 60)
        assert found.kind == "moving" and camera_error(found.T_WC, truth) < 0.03


def test_text_that_is_shown_for_a_while_is_left_out():
    tracks, _ = scene("sideways", noise=0.15)
    mixed, first = with_text(tracks, 60, 0.3, np.random.default_rng(1), (20, 45))
    left, part = without_burnt_in(mixed, CAMERA, 60)
    assert part > 0.9 * np.mean(mixed.landmark >= first)
    assert len(left.frame) > 0.98 * len(tracks.frame)


@pytest.mark.parametrize("kind", ["static", "forward", "sideways", "orbit", "turn"])
@pytest.mark.parametrize("noise", [0.1, 0.7])
def test_nothing_of_a_scene_alone_is_left_out(kind, noise):
    tracks, _ = scene(kind, noise=noise)
    left, part = without_burnt_in(tracks, CAMERA, 60)
    assert part == 0 and left is tracks


def test_far_points_before_a_camera_that_only_goes_on_are_of_the_scene():
    # No rotation at all: what is at infinity stays at its pixel.
    rng = np.random.default_rng(2)
    near = rng.uniform([-6, 0.5, 3], [6, 2, 25], (250, 3))
    far = np.concatenate([rng.uniform(-0.5, 0.5, (60, 2)), np.ones((60, 1))], -1) * 1e5
    points = np.concatenate([near, far])
    rows = []
    for k in range(60):
        p_C = points - [0.02 * k, 0, 0.03 * k]
        uv = CAMERA.params[:2] * p_C[:, :2] / p_C[:, 2:] + CAMERA.params[2:4]
        seen = (p_C[:, 2] > 0.5) & (uv > 0).all(-1) & (uv < SIZE).all(-1)
        rows += [(k, i, *uv[i]) for i in np.flatnonzero(seen)]
    table = np.array(rows)
    uv = table[:, 2:] + rng.normal(0, 0.1, (len(table), 2))
    _, landmark = np.unique(table[:, 1], return_inverse=True)
    tracks = Tracks(table[:, 0].astype(int), landmark, uv)
    assert without_burnt_in(tracks, CAMERA, 60)[1] < 0.02


def test_things_that_cross_before_a_camera_that_stands_make_no_text_of_the_scene():
    tracks, _ = scene("static", noise=0.1)
    rng = np.random.default_rng(3)
    rows = []
    for i in range(60):  # cars, one after the other, on a road across the image
        start, lane = rng.integers(0, 45), rng.choice([150.0, 165.0, 180.0])
        for k in range(start, start + 15):
            x = 10 + 20 * (k - start)
            y = lane + rng.normal(0, 0.1)
            rows.append((k, tracks.landmark.max() + 1 + i, x, y))
    cars = np.array(rows)
    both = Tracks(
        np.concatenate([tracks.frame, cars[:, 0].astype(int)]),
        np.concatenate([tracks.landmark, cars[:, 1].astype(int)]),
        np.concatenate([tracks.uv, cars[:, 2:]]),
    )
    assert without_burnt_in(both, CAMERA, 60)[1] == 0


def titled(image):
    image = image.copy()
    for row, text in ((195, "BREAKING NEWS"), (225, "A man walks")):
        for color, width in ((0, 5), (255, 2)):
            where = (10, row)
            cv2.putText(image, text, where, 0, 0.9, color, width, cv2.LINE_AA)
    return image


def test_text_in_images_is_hidden_from_the_tracker(tmp_path):
    images = [titled(image) for image in plane_images(24)]
    found = track(write_images(tmp_path / "images", images))
    moved = [np.ptp(found.uv[found.landmark == i], axis=0).max() for i in range(50)]
    assert np.mean(np.array(moved) > 2) > 0.95
    assert len(found.warnings) == 1 and "stay at their pixel" in found.warnings[0]


def test_text_over_a_dark_scene_does_not_stop_the_camera(tmp_path):
    dark = [titled((0.15 * i.astype(float)).astype(np.uint8)) for i in plane_images(24)]
    found = track(write_images(tmp_path / "images", dark))
    span = [np.ptp(found.uv[found.landmark == i], axis=0).max() for i in range(50)]
    assert np.mean(np.array(span) > 2) > 0.95 and len(found.warnings) == 1


def test_points_on_the_edge_of_a_border_are_not_followed(tmp_path):
    images = [i.copy() for i in plane_images(24)]
    for image in images:
        image[:30], image[-30:] = 0, 0
    found = track(write_images(tmp_path / "images", images))
    assert found.uv[:, 1].min() > 35 and found.uv[:, 1].max() < SIZE[1] - 36
    assert f"{SIZE[0]}x{SIZE[1] - 60} px from (0, 30)" in found.warnings[0]


def test_a_scene_without_text_is_followed_as_it_was(tmp_path):
    assert track(write_images(tmp_path / "images", plane_images(24))).warnings == ()
    still = plane_images(1) * 12
    assert track(write_images(tmp_path / "still", still)).warnings == ()
