"""Pictures agree with the geometry that they are made from."""

import copy

import cv2
import numpy as np
import pytest

from bodyslam_jax.body import load_body_model
from bodyslam_jax.synthetic._posing import Person
from bodyslam_jax.synthetic._render import Renderer, rasterise, write_video
from bodyslam_jax.synthetic._room import Box, Room, furnish, landmarks_on
from bodyslam_jax.synthetic._scene import look_at, walk

INTRINSICS = np.array([525.0, 525.0, 319.5, 239.5])
SIZE = (640, 480)


@pytest.fixture(scope="module")
def person():
    return Person(load_body_model(), np.zeros(10))


@pytest.fixture(scope="module")
def room():
    walls = Box(np.array([0.0, 1.4, 0.0]), np.array([3.0, 1.4, 4.0]), 0.0)
    box = Box(np.array([0.7, 0.4, 1.5]), np.array([0.5, 0.4, 0.3]), 0.4)
    return Room(walls, (box,))


@pytest.fixture(scope="module")
def renderer(room, person):
    return Renderer(room, person, INTRINSICS, SIZE, np.random.default_rng(0))


@pytest.fixture(scope="module")
def posed(person):
    """A walker in the middle of the room, seen from its end."""
    T, pose = walk(np.array([0.3]))
    G, x = person.joints(
        np.concatenate([np.zeros((1, 1, 3)), pose], axis=1), T[:, :3, 3]
    )
    return person.vertices(G[0], x[0]), person.keypoints(G, x)[0], x[0]


def camera(eye, target):
    return look_at(np.array([eye], float), np.array([target], float))[0]


def project(T_WC, points):
    p = (points - T_WC[:3, 3]) @ T_WC[:3, :3]
    return p[:, :2] / p[:, 2:] * INTRINSICS[:2] + INTRINSICS[2:], p[:, 2]


def test_depth_is_that_of_the_nearest_surface(room, renderer):
    T = camera([-1.0, 1.5, -3.0], [0.3, 0.8, 1.0])
    inverse, _, _ = renderer._room(T)
    rng = np.random.default_rng(1)
    points, normals = landmarks_on(room.faces(), 20.0, rng)
    uv, z = project(T, points)
    inside = ((uv > 1) & (uv < np.array(SIZE) - 2)).all(axis=1) & (z > 0.1)
    inside &= ((T[:3, 3] - points) * normals).sum(axis=1) > 0.1
    points, uv, z = points[inside], uv[inside], z[inside]
    hidden = room.is_hidden(T[:3, 3], points)
    at = uv.round().astype(int)
    drawn = 1 / inverse[at[:, 1], at[:, 0]]
    # Half a pixel on a slanted surface, and points beside an edge
    close = abs(drawn - z) < 0.03 * z
    assert hidden.sum() > 20
    assert close[~hidden].mean() > 0.97
    assert (drawn[hidden] < z[hidden] - 0.01).mean() > 0.97


def test_every_pixel_of_a_room_is_filled(renderer):
    for target in ([3.0, 0.2, 0.0], [0.0, 2.8, 1.0], [-3.0, 1.0, -4.0]):
        inverse, _, _ = renderer._room(camera([0.2, 1.5, -1.0], target))
        # Walls are at most 9 m away; the background's inverse depth is 0.001
        assert inverse.min() > 0.1


def test_body_is_drawn_where_its_keypoints_are(renderer, posed):
    vertices, keypoints, _ = posed
    T = camera([0.5, 1.4, -3.0], [0.0, 0.9, 0.3])
    image, mask = renderer.frame(T, vertices)
    uv, _ = project(T, keypoints)
    at = uv.round().astype(int)
    # Points on the skin may lie just outside of the outline
    grown = cv2.dilate(mask.astype(np.uint8), np.ones((7, 7), np.uint8))
    assert grown[at[:, 1], at[:, 0]].all()
    rows, columns = np.nonzero(mask)
    outline, _ = project(T, vertices)
    assert abs(rows.min() - outline[:, 1].min()) < 2
    assert abs(columns.max() - outline[:, 0].max()) < 2
    assert image.shape == (480, 640, 3) and image.dtype == np.uint8


def test_furniture_hides_the_body(renderer, posed):
    free = copy.copy(renderer)
    free.surfaces = renderer.surfaces[:6]  # the walls alone
    T = camera([1.5, 1.4, 3.8], [0.0, 0.8, 0.3])  # over the box
    whole, part = free.frame(T, posed[0])[1], renderer.frame(T, posed[0])[1]
    assert 0.3 * whole.sum() < part.sum() < 0.9 * whole.sum()
    assert not (part & ~whole).any()


def test_nearest_triangle_wins_and_back_faces_do_not_show():
    uv = np.array([[2.0, 2], [2, 12], [12, 2], [2.0, 2], [2, 12], [12, 2]])
    depth = np.array([0.5, 0.5, 0.5, 0.8, 0.8, 0.8])
    faces = np.array([[0, 1, 2], [3, 4, 5]])
    background = np.full((20, 20), 0.1)
    pixel, face = rasterise(uv, depth, faces, background)
    assert (face == 1).all() and 40 < len(pixel) < 70
    assert len(np.unique(pixel)) == len(pixel)
    _, face = rasterise(uv, depth, np.array([[0, 1, 2], [3, 5, 4]]), background)
    assert (face == 0).all()
    assert not len(rasterise(uv, depth, faces, np.full((20, 20), 0.9))[0])


def test_person_behind_the_camera_is_not_drawn(renderer, posed):
    _, mask = renderer.frame(camera([0, 1.4, -1.0], [0, 1.0, -3.5]), posed[0])
    assert not mask.any()


def test_images_have_corners_for_a_front_end(renderer, posed):
    T = camera([0.5, 1.5, -3.0], [0.0, 0.9, 0.3])
    image, mask = renderer.frame(T, posed[0])
    found = cv2.BRISK_create(20, 3).detect(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))
    at = np.array([p.pt for p in found]).astype(int)
    static = ~mask[at[:, 1], at[:, 0]]
    cells = np.unique((at[static] // 80) @ [1, 8])
    assert static.sum() > 300
    assert len(cells) >= 40  # of 48


@pytest.mark.parametrize("is_hall", [False, True])
def test_furniture_leaves_way_and_view_free(is_hall):
    rng = np.random.default_rng(5)
    a = np.linspace(0, 2 * np.pi, 60)
    walker = np.stack([2 * np.cos(a), 0 * a + 0.9, 2 * np.sin(a)], axis=1)
    eye = np.stack([0.3 * np.sin(a), 0 * a + 1.5, -4.5 + 0.3 * np.cos(a)], axis=1)
    room = furnish(walker, eye, rng, is_hall=is_hall)
    assert len(room.boxes) >= 3
    for p, c in zip(walker, eye, strict=True):
        assert not room.is_hidden(c, p[None]).any()
    for box in room.boxes:
        corners = box.centre + (
            np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
            * box.half
        ) @ box.axes.T  # fmt: skip
        reach = abs(corners - room.walls.centre) - room.walls.half
        assert reach.max() < 1e-9
        assert corners[:, 1].min() == pytest.approx(0.0, abs=1e-12)
        ways = np.concatenate([walker, eye])[:, [0, 2]] - box.centre[[0, 2]]
        local = ways @ box.axes[np.ix_([0, 2], [0, 2])]
        assert (abs(local) - box.half[[0, 2]]).max(axis=1).min() >= 0.3


def test_video_has_the_frames_it_was_given(tmp_path):
    rng = np.random.default_rng(0)
    frames = [np.full((48, 64, 3), int(x), np.uint8) for x in rng.integers(0, 255, 5)]
    write_video(tmp_path / "video.mp4", iter(frames), 30.0, (64, 48))
    reader = cv2.VideoCapture(str(tmp_path / "video.mp4"))
    found = []
    while (got := reader.read())[0]:
        found.append(got[1].mean())
    assert np.allclose(found, [f.mean() for f in frames], atol=4)
    assert [p.name for p in tmp_path.iterdir()] == ["video.mp4"]
    with pytest.raises(ValueError, match="cannot write"):
        write_video(tmp_path / "none" / "video.mp4", iter(frames), 30.0, (64, 48))
