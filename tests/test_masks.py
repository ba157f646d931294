"""Masks that are given: inverted, resized, incomplete, or of something else."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from bodyslam_jax.io.masks import read_mask, read_masks
from bodyslam_jax.sfm.person_mask import person_masks
from bodyslam_jax.types import Bodies, Intrinsics, Keypoints, Sequence

NUM, WIDTH, HEIGHT = 20, 160, 120
CAMERA = Intrinsics(np.array([150.0, 150.0, 79.5, 59.5]), WIDTH, HEIGHT)


def left(k: int) -> int:
    """Where the person begins, px."""
    return 20 + 3 * k


def mask(k: int, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    image = np.zeros((HEIGHT, WIDTH), np.uint8)
    image[20:100, left(k) : left(k) + 30] = 255
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_NEAREST)


def people() -> Keypoints:
    rng = np.random.default_rng(0)
    uv = rng.uniform([2, 22], [28, 98], (1, NUM, 25, 2))
    uv[..., 0] += np.array([left(k) for k in range(NUM)])[:, None]
    return Keypoints(uv, np.full((1, NUM, 25), 0.9))


def bodies() -> Bodies:
    x = (np.array([left(k) + 15 for k in range(NUM)]) - 79.5) / 150 * 4
    trans = np.stack([x, np.full(NUM, 0.2), np.full(NUM, 4.0)], axis=-1)[None]
    present = np.ones((1, NUM), bool)
    return Bodies(present, np.zeros((1, NUM, 72)), np.zeros((1, NUM, 10)), trans)


def write(folder: Path, change=lambda m, k: m, names=None) -> Path:
    folder.mkdir()
    for k in range(NUM):
        name = f"{k:03d}.png" if names is None else names(k)
        if name is not None:
            cv2.imwrite(str(folder / name), change(mask(k), k))
    return folder


def read(folder: Path, who: Keypoints | Bodies | None = people(), **known):
    said: list[str] = []
    given = {"people": who} if isinstance(who, Keypoints) else {"bodies": who}
    use = read_masks(
        folder,
        num_frames=NUM,
        intrinsics=CAMERA,
        warn=said.append,
        **given,
        **known,
    )
    sequence = Sequence(
        name="walk",
        frames=None,
        timestamps=np.arange(NUM) / 30,
        intrinsics=CAMERA,
        keypoints=given.get("people"),
        masks=folder,
        mask_use=use,
    )
    return [m > 0 for m in person_masks(sequence, 0.01)], said


def covers(masks: list[np.ndarray]) -> bool:
    """Whether the person is masked in all frames, and not all else."""
    middle = [m[30:90, left(k) + 5 : left(k) + 25].all() for k, m in enumerate(masks)]
    return all(middle) and max(m.mean() for m in masks) < 0.5


def test_masks_as_they_should_be(tmp_path):
    for who in (people(), bodies(), None):
        masks, said = read(write(tmp_path / str(type(who))), who)
        assert covers(masks) and said == []


@pytest.mark.parametrize("suffix", ["png", "jpg"])
@pytest.mark.parametrize("who", [people(), bodies(), None])
def test_inverted_masks_are_turned_back(tmp_path, who, suffix):
    names = lambda k: f"{k:03d}.{suffix}"
    masks, said = read(write(tmp_path / "m", lambda m, k: 255 - m, names), who)
    assert covers(masks)
    assert "88 % of the image" in said[0] and "taken as inverted" in said[0]


def test_masks_of_another_size(tmp_path):
    small = lambda m, k: mask(k, WIDTH // 2, HEIGHT // 2)
    masks, said = read(write(tmp_path / "small", small))
    assert covers(masks) and "masks of 80x60 px: resized" in said[0]
    turned = lambda m, k: np.ascontiguousarray(m.T)
    with pytest.raises(
        ValueError, match="000.png: 120x160 px, but the video is 160x120"
    ):
        read(write(tmp_path / "turned", turned))


@pytest.mark.parametrize("who", [people(), bodies()])
@pytest.mark.parametrize(
    "change",
    [
        lambda m, k: np.zeros_like(m),
        lambda m, k: np.roll(m, 80, axis=1),
    ],
)
def test_masks_that_cover_nobody_are_warned_of(tmp_path, change, who):
    masks, said = read(write(tmp_path / "m", change), who)
    assert "of another video?" in said[0]
    if isinstance(who, Keypoints):
        points = [who.uv[0, k].astype(int) for k in range(NUM)]
        share = np.mean(
            [masks[k][p[:, 1], p[:, 0]].mean() for k, p in enumerate(points)]
        )
        assert share > 0.8


def test_masks_of_one_of_two_people_are_no_masks_of_another_video(tmp_path):
    one = people()
    other = np.concatenate([one.uv, np.full_like(one.uv, 150.0)])
    two = Keypoints(other, np.repeat(one.confidence, 2, axis=0))
    _, said = read(write(tmp_path / "m"), two)
    assert said == []


def test_a_mask_for_every_second_frame(tmp_path):
    """By the numbers in their names; without gaps in them nobody knows."""
    names = lambda k: f"{k:03d}.png" if k % 2 == 0 else None
    masks, said = read(write(tmp_path / "m", names=names))
    assert covers(masks) and "masks of 10 of 20 frames" in said[0]
    masks, said = read(tmp_path / "m", bodies())
    assert covers(masks)
    names = lambda k: f"{k // 2:03d}.png" if k % 2 == 0 else None
    with pytest.raises(ValueError, match="10 masks, but the video has 20 frames"):
        read(write(tmp_path / "n", names=names))
    names = lambda k: f"{k + 30:03d}.png" if k % 3 else None
    with pytest.raises(ValueError, match="13 masks, but the video has 20 frames"):
        read(write(tmp_path / "o", names=names))
    images = tuple(f"{k + 30:03d}.jpg" for k in range(NUM))
    masks, _ = read(tmp_path / "o", images=images)
    assert covers(masks)


def test_masks_that_leave_nothing_are_warned_of(tmp_path):
    _, said = read(write(tmp_path / "m", lambda m, k: np.full_like(m, 255)))
    assert said == ["masks: 100 % of the image: little is left to follow."]


def test_what_of_an_image_is_the_mask(tmp_path):
    gray = mask(0)
    zero, none = np.zeros_like(gray), np.full_like(gray, 255)
    images = {
        "number.png": gray // 255,
        "colour.png": np.dstack([zero, zero, gray]),
        "opaque.png": np.dstack([gray, zero, zero, none]),
        "transparent.png": np.dstack([zero, zero, zero, gray]),
        "lossy.jpg": gray,
        "empty.jpg": zero,
    }
    for name, image in images.items():
        cv2.imwrite(str(tmp_path / name), image)
        wrong = read_mask(tmp_path / name) != ((gray > 0) & (name != "empty.jpg"))
        assert wrong.mean() < (0.005 if name == "lossy.jpg" else 1e-9), name


@pytest.mark.parametrize("people_apart", [False, True])
def test_masks_of_one_archive_are_those_of_a_folder(tmp_path, people_apart):
    stack = np.stack([mask(k) for k in range(NUM)])
    if people_apart:
        top = np.where(np.arange(HEIGHT)[:, None] < 60, stack, 0)
        stack = np.stack([top, stack - top], axis=1)
    np.savez(tmp_path / "masks.npz", masks=stack)
    found, said = read(tmp_path / "masks.npz")
    expected, _ = read(write(tmp_path / "masks"))
    assert said == []
    np.testing.assert_array_equal(found, expected)


def test_an_archive_without_masks_is_named(tmp_path):
    np.savez(tmp_path / "a.npz", u=np.zeros(3), v=np.zeros(3))
    with pytest.raises(ValueError, match="a.npz: arrays u, v, expected `masks`"):
        read(tmp_path / "a.npz")
    np.savez(tmp_path / "b.npz", masks=np.zeros((20, 5)))
    with pytest.raises(ValueError, match="b.npz: `masks` float64"):
        read(tmp_path / "b.npz")
