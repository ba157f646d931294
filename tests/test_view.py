"""The overlay: bodies where the camera sees them, and a video that plays."""

import dataclasses

import cv2
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from bodyslam_jax import view
from bodyslam_jax.body import joints, keypoints, load_body_model, skeleton, write_npz
from bodyslam_jax.types import Keypoints, Result, Tracks
from bodyslam_jax.view import insets, overlay, style, video_file

WIDTH, HEIGHT = 160, 120


@pytest.fixture(scope="module")
def body():
    return load_body_model(dtype=jnp.float32)


@eqx.filter_jit
def _joints(body, pose, trans):
    return joints(body, pose, jnp.zeros(10, jnp.float32), trans)


def _scene(body, depths=(4.0,), num=4):
    """People in rest pose, upright, straight ahead of a still camera."""
    people = len(depths)
    poses = np.zeros((people, num, 72))
    poses[..., 0] = np.pi  # The camera's y points down.
    trans = np.zeros((people, num, 3))
    trans[..., 2] = np.array(depths)[:, None]
    trans[..., 1] = 0.2
    still = [
        _joints(body, *(jnp.asarray(x[h, 0], jnp.float32) for x in (poses, trans)))
        for h in range(people)
    ]
    posed = np.reshape(still, (people, 1, 24, 3)).repeat(num, axis=1)
    return Result(
        timestamps=np.arange(num) / 25.0,
        T_WC=np.tile(np.eye(4), (num, 1, 1)),
        scale=1.0,
        intrinsics=np.array([150.0, 150.0, (WIDTH - 1) / 2, (HEIGHT - 1) / 2]),
        landmarks=np.zeros((0, 3)),
        poses=poses,
        trans=trans,
        betas=np.zeros((people, 10)),
        joints=posed.astype(np.float64),
        present=np.ones((people, num), bool),
    )


def _black():
    return np.zeros((HEIGHT, WIDTH, 3), np.uint8)


def _pixels(result, person=0):
    """Where the joints are seen."""
    p = result.joints[person, 0]
    return np.round(result.intrinsics[0] * p[:, :2] / p[:, 2:] + result.intrinsics[2:4])


def test_body_covers_its_joints(body):
    result = _scene(body)
    drawn = view.draw_frame(_black(), result, body, 0).any(-1)
    for u, v in _pixels(result).astype(int):
        assert drawn[v, u]
    assert 0.03 < drawn.mean() < 0.1
    rows, columns = np.nonzero(drawn)
    assert abs(columns.mean() - (WIDTH - 1) / 2) < 2
    tall = (rows.max() - rows.min()) * 4 / 150
    assert 1.5 < tall < 1.9  # m


def test_the_nearer_person_covers_the_other(body):
    both = view.draw_frame(_black(), _scene(body, (4.0, 6.0)), body, 0).astype(int)
    near = view.draw_frame(_black(), _scene(body, (4.0,)), body, 0).astype(int)
    # Not the dark edges of the outline, which are blended with what is behind them.
    covered = near.max(-1) > 60
    assert np.mean(np.abs(both - near)[covered].max(-1) > 8) < 0.01


@pytest.mark.parametrize("depth", [-3.0, 0.0, 0.1, 0.5])
def test_at_and_behind_the_camera(body, depth):
    """What reaches behind the camera is left out, and nothing is drawn of the rest."""
    drawn = view.draw_frame(_black(), _scene(body, (depth,)), body, 0)
    assert drawn.any() == (depth > 0.05)


def test_absent_people_are_not_drawn(body):
    result = _scene(body)
    gone = dataclasses.replace(result, present=np.zeros_like(result.present))
    assert not view.draw_frame(_black(), gone, body, 0).any()


def test_coarse_body_is_nearly_the_same(body):
    coarse = view.coarse_body(body)
    assert len(coarse.faces) < 0.35 * len(body.faces)
    assert coarse.faces.max() < coarse.num_vertices == len(coarse.skin_weight)
    extent = np.ptp(np.asarray(body.template), axis=0)
    np.testing.assert_allclose(
        np.ptp(np.asarray(coarse.template), 0), extent, atol=0.03
    )
    pose = jnp.asarray(np.random.default_rng(0).normal(0, 0.5, 72), jnp.float32)
    args = pose, jnp.ones(10, jnp.float32), jnp.zeros(3, jnp.float32)
    np.testing.assert_allclose(joints(coarse, *args), joints(body, *args), atol=1e-5)
    moved = np.linalg.norm(keypoints(coarse, *args) - keypoints(body, *args), axis=-1)
    assert moved.max() < 0.05  # m; the diagonal of a cell is 0.043


def test_a_coarse_body_can_be_written(tmp_path, body):
    coarse = view.coarse_body(body)
    write_npz(coarse, tmp_path / "coarse.npz")
    again = load_body_model(tmp_path / "coarse.npz", dtype=jnp.float32)
    np.testing.assert_array_equal(again.picks, coarse.picks)
    near = np.asarray(again.joint_template - body.joint_template)
    assert np.linalg.norm(near, axis=-1).max() < 0.02


@pytest.mark.parametrize("frame", [-1, 4, 500])
def test_a_frame_that_is_not_there_is_named(body, frame):
    with pytest.raises(IndexError, match=f"frame {frame}, expected 0 to 3"):
        view.draw_frame(_black(), _scene(body), body, frame)


@pytest.mark.parametrize("size", [3e-3, 3.0, 3e4, 3e9])
def test_the_inset_has_a_grid_for_scenes_of_any_size(body, size):
    result = _scene(body)
    result.T_WC[:, 0, 3] = np.linspace(0, size, 4)
    plan = insets.Plan(result, (WIDTH, HEIGHT))
    assert plan.step >= 1 and plan.side / plan.zoom / plan.step <= 10.001


def _pictures(result, body, tracks=None, keypoints=None):
    """The overlay on black; what is drawn on it stands out against `BLACK`."""
    black = [_black()] * len(result.timestamps)
    return list(_drawn(black, result, body, tracks, keypoints))


def _drawn(images, result, body, tracks=None, keypoints=None):
    """The pictures, of the size of the images and so many as they."""
    size = images[0].shape[1::-1]
    found = insets.Insets(result, size, np.ones(2), beside=False)
    args = (tracks, np.ones(2), found, keypoints)
    return overlay.pictures(images, result, body, *args)


BLACK = 14
"""What black becomes by softening."""


def _read(path):
    capture = cv2.VideoCapture(str(path))
    images = []
    while True:
        ok, image = capture.read()
        if not ok:
            return np.array(images), capture.get(cv2.CAP_PROP_FPS)
        images.append(image)


@pytest.mark.parametrize("codec", ["VP8", "VP9"])
def test_video_plays_without_frames(tmp_path, body, codec):
    result = _scene(body, depths=(9.0,))
    view.write_overlay(tmp_path / "o.webm", None, result, body, codec=codec)
    images, fps = _read(tmp_path / "o.webm")
    assert images.shape == (4, HEIGHT, WIDTH, 3)
    assert fps == pytest.approx(25, abs=0.1)
    u, v = _pixels(result)[0].astype(int)
    assert images[1, v, u].max() > 80


def test_video_over_larger_frames_that_end_early(tmp_path, body):
    """Frames are shrunk and the body with them; black where frames are missing."""
    result = _scene(body, depths=(9.0,), num=40)
    frames = [np.full((HEIGHT, WIDTH, 3), 200, np.uint8)] * 2
    path = tmp_path / "o.webm"
    view.write_overlay(path, iter(frames), result, body, max_width=WIDTH // 2 + 1)
    images, _ = _read(path)
    assert images.shape == (40, HEIGHT // 2, WIDTH // 2, 3)
    assert images[1, 5, 5].min() > 150 and images[30, 5, 5].max() < 60
    u, v = (_pixels(result)[0] / 2).astype(int)
    assert images[30, v, u].max() > 80


def test_points_and_their_trails(tmp_path, body):
    result = dataclasses.replace(_scene(body), present=np.zeros((1, 4), bool))
    tracks = Tracks(
        np.array([0, 1, 2, 2]),
        np.array([7, 7, 7, 9]),
        np.array([[20.0, 80], [30, 80], [40, 80], [20, 20]]),
    )
    pictures = _pictures(result, body, tracks)
    assert pictures[2][80, 25].max() > 50 and pictures[2][20, 20].max() > 50
    assert pictures[0][20, 20].max() == pictures[3][80, 25].max() == BLACK


def test_the_inset_follows_camera_and_person(body):
    result = _scene(body, num=30)
    result.T_WC[:, 0, 3] = np.linspace(0, 3, 30)
    moving = _pictures(result, body)
    corner = np.s_[10:50, -50:-10]
    assert np.abs(moving[29][corner].astype(int) - moving[0][corner]).max() > 60


def test_a_video_cut_short_is_an_error(tmp_path, body):
    path = tmp_path / "o.webm"
    view.write_overlay(path, None, _scene(body, num=30), body)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(OSError, match="frames written; disk full"):
        video_file.check_length(path, 30)


def test_one_frame_and_nobody(tmp_path, body):
    result = _scene(body, depths=(), num=1)
    view.write_overlay(tmp_path / "o.webm", None, result, body)
    assert len(_read(tmp_path / "o.webm")[0]) == 1


def _standing(body, num=12):
    """Somebody who stands on y = 0, seen by a camera 1.5 m above the ground."""
    result = _scene(body, num=num)
    turn = np.diag([1.0, -1.0, -1.0, 1.0])
    turn[:3, 3] = [0, 1.5, 0]
    placed = result.joints @ turn[:3, :3].T + turn[:3, 3]
    down = placed[..., 1].min() - 0.02
    poses, trans = result.poses.copy(), result.trans @ turn[:3, :3].T + turn[:3, 3]
    poses[..., 0] = 0.0
    # The pelvis joint is at J_0 + trans, whatever the rotation.
    rest = result.joints[:, :, 0] - result.trans
    trans += rest @ turn[:3, :3].T - rest - [0, down, 0]
    return dataclasses.replace(
        result,
        T_WC=np.tile(turn, (num, 1, 1)),
        poses=poses,
        trans=trans,
        joints=placed - [0, down, 0],
    )


def _seen(result, p_W, frame=0):
    T = result.T_WC[frame]
    p = (np.asarray(p_W) - T[:3, 3]) @ T[:3, :3]
    return np.round(result.intrinsics[0] * p[:2] / p[2] + result.intrinsics[2:4])


def test_the_ground_has_a_line_each_metre(body):
    result = _standing(body)
    picture = _pictures(result, body)[5]
    lines, between = [], []
    for x in (-2, -1, 1, 2):
        for shift, found in ((0.0, lines), (0.5, between)):
            u, v = _seen(result, [x + shift, 0.0, -4.4]).astype(int)
            if 1 < u < WIDTH - 2 and 1 < v < HEIGHT - 2:
                found.append(picture[v - 1 : v + 2, u - 1 : u + 2].max())
    assert len(lines) >= 2 and min(lines) > BLACK + 40
    assert between and max(between) == BLACK
    gone = dataclasses.replace(result, present=np.zeros_like(result.present))
    assert _pictures(gone, body)[5][HEIGHT - 40 : HEIGHT - 25, :90].max() == BLACK


def test_a_standing_foot_has_a_mark_in_the_persons_colour(body):
    result = _standing(body)
    lower = result.joints[0, 0, [10, 11], 1].argmin()
    place = result.joints[0, 5, [10, 11][lower]] * [1, 0, 1]
    u, v = _seen(result, place + [0.1, 0, 0.0]).astype(int)
    blue, green, red = _pictures(result, body)[5][v, u].astype(int)
    assert red > green > blue and red > 100


def test_keypoints_are_drawn_beside_those_of_the_body(body):
    result = _standing(body)
    u, v = 30, 50
    uv = np.full((1, 12, 25, 2), [u, v], float)
    confidence = np.zeros((1, 12, 25))
    confidence[0, 5, 0] = 1.0
    pictures = _pictures(result, body, keypoints=Keypoints(uv, confidence))
    assert pictures[5][v, u].min() > 200
    assert pictures[4][v, u].max() == BLACK


@pytest.mark.slow
def test_an_mp4_is_h264(tmp_path, body):
    av = pytest.importorskip("av")
    path = tmp_path / "o.mp4"
    view.write_overlay(path, None, _scene(body, (9.0,)), body, codec="H264")
    with av.open(str(path)) as container:
        (stream,) = container.streams.video
        assert stream.codec_context.name == "h264" and stream.frames == 4
        assert float(stream.average_rate) == pytest.approx(25, abs=0.1)
    assert _read(path)[0].shape == (4, HEIGHT, WIDTH, 3)


def test_mp4_without_its_extra_says_how_to_get_it(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"pip install 'bodyslam-jax\[video\]'"):
        view.check_codec("H264")


def test_noise_of_the_images_costs_no_bytes(tmp_path, body):
    """Half of what it would cost as it is."""
    result = _scene(body, depths=(), num=20)
    rng = np.random.default_rng(0)
    plain = cv2.resize(rng.normal(128, 30, (6, 8, 3)), (WIDTH, HEIGHT))
    noise = rng.normal(0, 4, (20, HEIGHT, WIDTH, 3))
    frames = list(np.clip(plain + noise, 0, 255).astype(np.uint8))
    view.write_overlay(tmp_path / "o.webm", frames, result, body)
    video_file.write_video(tmp_path / "as_it_is.webm", frames, (WIDTH, HEIGHT), 25.0)
    size = lambda name: (tmp_path / name).stat().st_size
    assert size("o.webm") < 0.5 * size("as_it_is.webm")


def test_the_side_view_fits_into_pictures_of_any_size(body):
    for size, num in (((64, 48), 3), ((48, 400), 3)):
        result = _standing(body, num)
        result.T_WC[:, 0, 3] = np.linspace(0, 30, num)
        black = [np.zeros((size[1], size[0], 3), np.uint8)] * num
        found = list(_drawn(black, result, body))
        assert len(found) == num and found[0].shape == (size[1], size[0], 3)


def _larger(result):
    """The same in images of four times the width and height."""
    larger = np.array([600.0, 600.0, (4 * WIDTH - 1) / 2, (4 * HEIGHT - 1) / 2])
    return dataclasses.replace(result, intrinsics=larger)


def test_the_status_of_people_is_drawn(body):
    """Who is not measurable is nearly transparent, who is doubtful has dashes in
    place of a line around them, and both are named; an arm that was hidden
    is paler than one that was not."""
    plain = _larger(_scene(body, depths=(3.0,)))
    image = np.full((4 * HEIGHT, 4 * WIDTH, 3), 90, np.uint8)

    def drawn(status, hidden=()):
        summary = {"people": [{"status": status, "reasons": []}]}
        sigma = np.full(plain.joints.shape[:3], 0.03)
        sigma[..., list(hidden)] = 0.2
        result = dataclasses.replace(plain, summary=summary, joint_sigma=sigma)
        return view.draw_frame(image, result, body, 0).astype(int), result

    (u, v) = _pixels(plain)[0].astype(int)
    change = {s: np.abs(drawn(s)[0][v, u] - 90).max() for s in ("ok", "not_measurable")}
    assert 0 < change["not_measurable"] < 0.7 * change["ok"]
    color = np.array(style.person_styles(plain)[0].color)
    line = lambda s: (np.abs(drawn(s)[0] - color).max(axis=-1) < 30).sum()
    assert 20 < line("doubtful") < 0.85 * line("ok")
    x, y = _pixels(plain)[[18, 20]].mean(0).astype(int)
    measured, hidden = (drawn("ok", h)[0][y, x].sum() for h in ((), (20,)))
    assert hidden > measured + 30
    _, result = drawn("doubtful")
    styles = style.person_styles(result)
    assert styles[0].name == "person 0, doubtful"
    assert style.Legend(result, styles).entries == {"doubtful": styles[0].dash}


def _at(result, u, v, depth=4.0):
    """The person moved so that the pelvis is seen at a pixel."""
    wanted = depth * np.array([(u - (WIDTH - 1) / 2) / 150, (v - 59.5) / 150, 1.0])
    move = wanted - result.joints[:, :, :1]
    return dataclasses.replace(
        result, joints=result.joints + move, trans=result.trans + move[:, :, 0]
    )


@pytest.mark.parametrize(
    "places, corner",
    [
        ([(80, 60)], (WIDTH - 50, 10)),
        ([(80, 60), (140, 5)], (10, 10)),
        ([(80, 60), (140, 5), (20, 5)], (WIDTH - 50, 35)),
        ([(20, 40), (140, 5), (140, 75)], None),
    ],
)
def test_the_insets_hide_nobody(body, places, corner):
    """They are in a corner into which nobody comes, else beside the image."""
    parts = [_at(_scene(body, num=1, depths=(9.0,)), *p, depth=9.0) for p in places]
    join = lambda name: np.concatenate([getattr(p, name) for p in parts], axis=1)
    num = len(places)
    result = dataclasses.replace(
        _scene(body, num=num),
        joints=join("joints"),
        trans=join("trans"),
        poses=join("poses"),
    )
    size = (WIDTH, HEIGHT)
    found = insets.Insets(result, size, np.ones(2))
    assert found.beside == (corner is None)
    if corner is not None:
        assert abs(found.corner[0] - corner[0]) < 3 and found.column == 0
        assert (found.corner[1] > 20) == (corner[1] > 20)
    images = [_black()] * num
    drawn = list(overlay.pictures(images, result, body, None, np.ones(2), found))
    assert all(p.shape == (HEIGHT, WIDTH + found.column, 3) for p in drawn)
    for frame, picture in enumerate(drawn):
        bare = view.draw_frame(overlay.softened(_black()), result, body, frame)
        person = np.abs(bare.astype(int) - BLACK).max(axis=-1) > 40
        assert (picture[:, :WIDTH][person].astype(int) > BLACK).any(axis=-1).all()


def test_a_column_beside_the_image_keeps_the_width(tmp_path, body, monkeypatch):
    monkeypatch.setattr(insets, "_hits", lambda *_: 1)
    view.write_overlay(tmp_path / "o.webm", None, _scene(body), body, max_width=120)
    (image, *_), _ = _read(tmp_path / "o.webm")
    assert 100 <= image.shape[1] <= 120


def test_the_person_in_the_image_shows_through_the_body(body):
    """Half of the contrast of what is beneath is left, and an outline is around it."""
    stripes = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    stripes[:, ::8] = 200
    result = _scene(body)
    drawn = view.draw_frame(stripes, result, body, 0).astype(int)
    (u, v) = _pixels(result)[0].astype(int)
    row = drawn[v, u - 8 : u + 8].sum(axis=-1)
    assert row.max() - row.min() > 0.4 * 3 * 200
    plain = np.full((4 * HEIGHT, 4 * WIDTH, 3), 128, np.uint8)
    drawn = view.draw_frame(plain, _larger(result), body, 0).astype(int)
    body_pixels = (drawn != 128).any(-1)
    inner = cv2.erode(body_pixels.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    rim = drawn[body_pixels & ~inner]
    colour = np.array(style.person_styles(result)[0].color)
    assert (np.abs(rim - colour).max(axis=-1) < 25).mean() > 0.2


def test_side_views_show_heads(body):
    """A disc where the head is, which its joint is at the lower end of."""
    result = _standing(body)
    side = insets.Insets(result, (640, 480), np.ones(2), beside=True).side
    image = np.zeros((480, 640, 3), np.uint8)
    side.draw(image, 5, (0, 0))
    middle, radius = skeleton.head_ball(result.joints[0, 5])
    top = float(body.template[:, 1].max() - body.template[:, 1].min())
    assert abs(middle[1] + radius - top) < 0.06
    x, y = side._to_inset(middle[None], side.centre)[0] // 16
    assert (image[y - 1 : y + 2, x - 1 : x + 2].max(axis=-1) > 100).all()
