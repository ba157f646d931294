"""Pictures agree with the geometry that they are made from."""

import copy
import dataclasses

import cv2
import numpy as np
import pytest

from bodyslam_jax.body import load_body_model
from bodyslam_jax.simulation.exact_scene import look_at, walk
from bodyslam_jax.simulation.figure import Figure, dress
from bodyslam_jax.simulation.garments import PARTS, Outfit
from bodyslam_jax.simulation.posing import Person
from bodyslam_jax.simulation.raster import Shutter, cameras_at, rasterise
from bodyslam_jax.simulation.renderer import Renderer, write_video
from bodyslam_jax.simulation.room import Box, Room, furnish, landmarks_on

INTRINSICS = np.array([525.0, 525.0, 319.5, 239.5])
SIZE = (640, 480)


def naked(person):
    """A figure whose outline is the body's own."""
    part = np.zeros(len(person.skin), int)
    colours = np.full((len(part), 3), 120.0)
    return Figure(person, Outfit(), part, colours, np.ones(3), np.zeros((2, 2, 2)))


def still(renderer, T_WC, *people):
    """What a camera sees of people who stand still."""
    return renderer.frame(T_WC[None], 0, [(v, 0 * v, 0 * v) for v in people])


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
    return Renderer(room, [naked(person)], INTRINSICS, SIZE, np.random.default_rng(0))


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
    inverse, _, _ = renderer.render_room(T[None])
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
        inverse, _, _ = renderer.render_room(camera([0.2, 1.5, -1.0], target)[None])
        # Walls are at most 9 m away; the background's inverse depth is 0.001
        assert inverse.min() > 0.1


def test_body_is_drawn_where_its_keypoints_are(renderer, posed):
    vertices, keypoints, _ = posed
    T = camera([0.5, 1.4, -3.0], [0.0, 0.9, 0.3])
    image, who = still(renderer, T, vertices)
    mask = who == 1
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
    whole, part = (still(r, T, posed[0])[1] == 1 for r in (free, renderer))
    assert 0.3 * whole.sum() < part.sum() < 0.9 * whole.sum()
    assert not (part & ~whole).any()


def test_nearest_triangle_wins_and_back_faces_do_not_show():
    uv = np.array([[2.0, 2], [2, 12], [12, 2], [2.0, 2], [2, 12], [12, 2]])
    depth = np.array([0.5, 0.5, 0.5, 0.8, 0.8, 0.8])
    faces = np.array([[0, 1, 2], [3, 4, 5]])
    background = np.full((20, 20), 0.1)
    hits = rasterise(uv, depth, faces, background)
    assert (hits.face == 1).all() and 40 < len(hits.pixel) < 70
    assert len(np.unique(hits.pixel)) == len(hits.pixel)
    # The corners' weights say where in the triangle a pixel is
    at = (hits.weights[:, :, None] * uv[faces[hits.face]]).sum(axis=1)
    row, column = np.divmod(hits.pixel, 20)
    np.testing.assert_allclose(at, np.stack([column, row], axis=1), atol=1e-9)
    np.testing.assert_allclose(hits.inverse, 0.8)
    hits = rasterise(uv, depth, np.array([[0, 1, 2], [3, 5, 4]]), background)
    assert (hits.face == 0).all()
    assert not len(rasterise(uv, depth, faces, np.full((20, 20), 0.9)).pixel)


def test_person_behind_the_camera_is_not_drawn(renderer, posed):
    _, who = still(renderer, camera([0, 1.4, -1.0], [0, 1.0, -3.5]), posed[0])
    assert not who.any()


def test_images_have_corners_for_a_front_end(renderer, posed):
    T = camera([0.5, 1.5, -3.0], [0.0, 0.9, 0.3])
    image, who = still(renderer, T, posed[0])
    mask = who == 1
    found = cv2.BRISK_create(20, 3).detect(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))
    at = np.array([p.pt for p in found]).astype(int)
    static = ~mask[at[:, 1], at[:, 0]]
    cells = np.unique((at[static] // 80) @ [1, 8])
    assert static.sum() > 300
    assert len(cells) >= 40  # of 48


@pytest.mark.slow
def test_who_is_nearer_hides_who_is_behind(room, person, posed):
    vertices = posed[0]
    both = [naked(person), naked(person)]
    r = Renderer(room, both, INTRINSICS, SIZE, np.random.default_rng(0))
    T = camera([0.0, 1.4, -3.0], [0.0, 0.9, 0.0])
    near = vertices - [0, 0, 1.0]
    for people, first in (((vertices, near), 2), ((near, vertices), 1)):
        who = still(r, T, *people)[1]
        alone = still(r, T, people[first - 1], vertices - [0, 0, 50.0])[1] == 1
        if first == 2:
            alone = still(r, T, vertices - [0, 0, 50.0], people[1])[1] == 2
        assert (who == first).sum() == alone.sum()
        assert 0 < (who == 3 - first).sum() < 0.7 * alone.sum()


@pytest.mark.slow
def test_rows_of_a_rolling_shutter_are_seen_from_where_the_camera_is_then(
    room, person, posed
):
    shutter = Shutter(readout=0.03)
    make = lambda s: Renderer(
        room, [naked(person)], INTRINSICS, SIZE, np.random.default_rng(0), s
    )
    rolling, ideal = make(shutter), make(Shutter())
    eyes = np.array([[0.2, 1.4, -3.2], [0.3, 1.42, -3.1], [0.45, 1.4, -3.05]])
    aims = np.array([[-0.1, 0.9, 0.3], [0.1, 0.9, 0.3], [0.4, 0.95, 0.3]])
    T = look_at(eyes, aims)
    v = posed[0]
    moving = (v, np.tile([0.03, 0.0, 0.01], (len(v), 1)), 0 * v)
    times = shutter.row_times(SIZE[1])
    assert times.mean() == pytest.approx(0.0, abs=1e-12)
    assert times[-1] - times[0] == pytest.approx(0.03 * 479 / 480)
    who = rolling.frame(T, 1, [moving])[1]
    depth = rolling.render_room(cameras_at(T, 1, times, 30.0))[0]
    still_who = ideal.frame(T, 1, [moving])[1]
    differs = 0
    for row in range(110, 400, 29):
        now = cameras_at(T, 1, times[row : row + 1], 30.0)
        at = v + 30.0 * times[row] * moving[1]
        exact = still(ideal, now[0], at)[1][row]
        assert abs(who[row] - exact).sum() <= 2  # a pixel on the edge of a triangle
        np.testing.assert_allclose(
            depth[row], ideal.render_room(now)[0][row], rtol=1e-4
        )
        differs += abs(still_who[row] - exact).sum()
    assert differs > 60  # and an ideal camera sees something else


@pytest.mark.slow
def test_motion_blur_is_as_long_as_the_motion_during_the_exposure(room, person, posed):
    bright = dataclasses.replace(
        naked(person), colours=np.full((len(person.skin), 3), 600.0)
    )
    make = lambda s: Renderer(
        room, [bright], INTRINSICS, SIZE, np.random.default_rng(0), s
    )
    T = camera([0.0, 1.4, -3.0], [0.0, 1.4, 0.3])
    v = posed[0]
    step = np.tile([0.12, 0.0, 0.0], (len(v), 1))  # 3.6 m/s to the side
    away = v - [0, 0, 50.0]  # behind the camera
    head = np.s_[:, v[:, 1].argmax()]
    widths = []
    for exposure in (0.0, 0.016):
        r = make(Shutter(exposure))
        image = r.frame(T[None], 0, [(v, step, 0 * v)])[0].astype(float)
        empty = r.frame(T[None], 0, [(away, 0 * v, 0 * v)])[0]
        seen = abs(image - empty).max(axis=2) > 10
        top = int(project(T, v[head[1]][None])[0][0, 1])
        widths.append(seen[top + 12 : top + 24, 150:490].sum(axis=1).mean())
    depth = project(T, v)[1][v[:, 1].argmax()]
    length = 3.6 * 0.016 * 525 / depth
    count = min(np.ceil(length / 2), 6)  # images in which the motion is sampled
    assert widths[1] - widths[0] == pytest.approx(length * (1 - 1 / count), abs=2.0)
    assert length > 7


@pytest.fixture(scope="module")
def dressed(person):
    outfit = Outfit(sleeves=0.4, hair="short")
    return dress(person, np.random.default_rng(4), outfit)


def test_parts_of_a_dressed_person_have_their_own_colours(person, dressed):
    """Where a joint is tells what is worn there."""
    used = np.unique(dressed.person.faces)
    skin, part = dressed.person.skin[used], dressed.part[used]
    names = {
        **{3: "shirt", 6: "shirt", 1: "trousers", 4: "trousers", 10: "shoes"},
        **{20: "skin", 22: "skin"},
    }
    part = np.where(part == PARTS.index("sole"), PARTS.index("shoes"), part)
    for joint, name in names.items():
        near = np.linalg.norm(skin - person.rest[joint], axis=1).argsort()[:40]
        assert (part[near] == PARTS.index(name)).mean() > 0.6, joint
    for name, low, high in (("hair", 0.7, 1.3), ("lips", -0.9, -0.4)):
        eyes = person.skin[person.picks[[1, 2]], 1].mean()
        unit = person.skin[person.picks[11], 1] - eyes
        at = (skin[part == PARTS.index(name), 1] - eyes) / unit
        assert low < np.percentile(at, 99) < high
    assert (skin[part == PARTS.index("lips"), 2] > person.rest[15, 2]).all()
    colours = [
        np.median(dressed.colours[dressed.part == i], axis=0)
        for i in range(len(PARTS))
        if (dressed.part == i).any()
    ]
    apart = np.linalg.norm(np.array(colours)[:, None] - colours, axis=2)
    assert (apart + 1e3 * np.eye(len(colours))).min() > 8


def test_clothes_change_the_outline_and_not_where_the_feet_stand(person):
    wide = Outfit(skirt=0.6, looseness=1.5, hair="long")
    figure = dress(person, np.random.default_rng(1), wide)
    assert figure.person.skin[:, 1].min() == pytest.approx(
        person.skin[:, 1].min(), abs=0.006
    )
    np.testing.assert_array_equal(figure.person.rest, person.rest)
    knee = person.rest[4, 1]
    at_knee = lambda p: np.ptp(p[abs(p[:, 1] - knee - 0.1) < 0.03][:, 2])
    assert at_knee(figure.person.skin) > at_knee(person.skin) + 0.03
    np.testing.assert_allclose(figure.person.weights.sum(axis=1), 1, atol=1e-6)
    assert figure.person.faces.max() < len(figure.person.skin)


def test_outfits_differ_and_a_seed_gives_the_same_again(person):
    figures = [dress(person, np.random.default_rng(k)) for k in (1, 1, 2, 3)]
    np.testing.assert_array_equal(figures[0].colours, figures[1].colours)
    np.testing.assert_array_equal(figures[0].person.skin, figures[1].person.skin)
    assert len({repr(f.outfit) for f in figures}) == 3


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
