"""The vertical from segments of images: recovery, uncertainty, and no false ones."""

import dataclasses

import cv2
import numpy as np
import pytest

from bodyslam_jax import sfm
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.ground.vertical_edges import Edges, find_vertical, make_edges
from bodyslam_jax.types import Intrinsics, Keypoints, Sequence

FOCAL, WIDTH, HEIGHT = 600.0, 960, 540
CAMERA = np.array([FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2])
IMAGES = 12
TILT = np.radians([3.0, -2.0])
"""Of the vertical, x and z over y."""


def scene(
    rng: np.random.Generator,
    vertical: int = 12,
    others: int = 40,
    lean: float = 0.3,
    pixel: float = 0.25,
    images: int = IMAGES,
    moves: bool = True,
) -> Edges:
    """Edges in space, seen by a camera that looks down by 8 degrees, and moves
    sideways or stands.

    Args:
        vertical, others: numbers of edges along the vertical, and in any direction.
        lean: standard deviation of the first from it, degrees.
        pixel: standard deviation of the ends of segments, px.
    """
    up = np.array([TILT[0], 1.0, TILT[1]])
    place = rng.uniform(-1, 1, (vertical + others, 3))
    middle = [0.0, 0.0, 9.0] + place * [6.0, 1.5, 2.0]
    way = rng.normal(size=(vertical + others, 3))
    way[:vertical] = up + np.radians(lean) * way[:vertical]
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    half = 0.7 * way
    ends = np.stack([middle - half, middle + half], axis=1)
    R = so3.exp(np.array([np.radians(8.0), 0, 0])) @ np.diag([-1.0, -1.0, 1.0])
    R_WC = np.tile(R, (images, 1, 1))
    eyes = np.linspace(-1.0, 1.0, images)[:, None] * [1.0, 0, 0] * moves
    frame, seen = [], []
    for k in range(images):
        p = (ends - eyes[k]) @ R
        uv = p[..., :2] / p[..., 2:] * FOCAL + CAMERA[2:]
        uv = uv + pixel * rng.normal(size=uv.shape)
        inside = ((uv >= 0) & (uv < [WIDTH, HEIGHT])).all(axis=(1, 2))
        frame.append(np.full(inside.sum(), k))
        seen.append(uv[inside])
    return make_edges(
        np.concatenate(frame), np.concatenate(seen), np.arange(images), R_WC, CAMERA
    )


def test_vertical_edges_without_noise_give_the_vertical_exactly():
    found = find_vertical(scene(np.random.default_rng(0), 15, 0, 0.0, 0.0))
    assert found is not None
    assert found.tilt == pytest.approx(TILT, abs=np.radians(0.01))
    assert found.is_vertical.min() > 0.9


def test_errors_agree_with_the_covariance_among_edges_of_any_direction():
    chi2, errors = [], []
    for seed in range(20):
        found = find_vertical(scene(np.random.default_rng(seed), 18, 30, lean=0.4))
        if found is None:
            continue
        apart = found.tilt - TILT
        errors.append(np.degrees(np.linalg.norm(apart)))
        chi2.append(apart @ np.linalg.solve(found.covariance, apart))
    assert len(errors) >= 12
    assert np.median(errors) < 0.6
    assert 0.1 < np.mean(chi2) < 3.0  # 2 by a covariance that is right


@pytest.mark.slow
def test_edges_of_any_direction_have_no_vertical():
    """Neither the same in all images, nor others in each."""
    number = 0
    for seed in range(150):
        rng = np.random.default_rng(seed)
        same = scene(rng, 0, 80, moves=bool(seed % 2), images=6)
        number += find_vertical(same) is not None
        each = [scene(rng, 0, 80, images=1) for _ in range(6)]
        together = Edges(
            np.concatenate([e.frame + k for k, e in enumerate(each)]),
            *(
                np.concatenate([getattr(e, name) for e in each])
                for name in ("normal", "ray", "length", "axis")
            ),
        )
        number += find_vertical(together) is not None
    assert number <= 3  # 1 %


def test_one_post_or_an_empty_scene_gives_no_vertical():
    """However many images show it, from wherever."""
    assert find_vertical(scene(np.random.default_rng(0), 1, 0, images=40)) is None
    assert find_vertical(scene(np.random.default_rng(0), 0, 0)) is None


def test_trees_that_lean_this_way_and_that_give_no_vertical():
    fits = [
        find_vertical(scene(np.random.default_rng(seed), 20, 20, lean=5.0))
        for seed in range(20)
    ]
    assert sum(found is not None for found in fits) <= 1


def test_edges_that_lean_far_are_not_the_vertical():
    edges = scene(np.random.default_rng(0), 15, 0)
    turned = edges.rotated(so3.exp(np.array([0.0, 0, np.radians(25.0)])))
    assert find_vertical(turned) is None


def test_more_images_of_the_same_do_not_make_it_more_certain():
    sigma = [
        np.trace(found.covariance)
        for images in (6, 24)
        if (
            found := find_vertical(
                scene(np.random.default_rng(3), 18, 10, images=images, moves=False)
            )
        )
    ]
    assert sigma[1] == pytest.approx(sigma[0], rel=0.2)


def test_segments_of_images_are_found_beside_people(tmp_path):
    image = np.full((HEIGHT, WIDTH), 90, np.uint8)
    posts = (100, 700)
    for x in (*posts, 400):
        cv2.rectangle(image, (x, 100), (x + 30, 400), 200, -1)
    for k in range(3):
        cv2.imwrite(str(tmp_path / f"{k}.png"), image)
    uv = np.zeros((1, 3, 25, 2))
    uv[..., 1, :], uv[..., 8, :] = (415, 160), (415, 300)
    confidence = np.zeros((1, 3, 25))
    confidence[..., [1, 8]] = 1.0
    sequence = Sequence(
        "posts",
        tmp_path,
        np.arange(3) / 30.0,
        Intrinsics(CAMERA, WIDTH, HEIGHT),
        keypoints=Keypoints(uv, confidence),
    )
    every = sfm.find_segments(
        dataclasses.replace(sequence, keypoints=None), np.array([True, False, True])
    )
    assert set(every.frame) == {0, 2}
    beside = sfm.find_segments(sequence, np.array([True, False, True]))
    x = beside.ends[..., 0].mean(axis=1)
    upright = np.ptp(beside.ends[..., 0], axis=1) < 2
    edges = np.sort([x[upright & (beside.frame == 0)]]).ravel()
    assert edges == pytest.approx([100, 130, 700, 730], abs=1.5)
