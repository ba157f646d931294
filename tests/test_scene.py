"""The page in 3D: true to the result, complete offline, small."""

import base64
import dataclasses
import json
import re

import cv2
import export_cases
import jax.numpy as jnp
import numpy as np
import pytest
from browser import chromium, opened, scene, until

from bodyslam_jax import view
from bodyslam_jax.body import load_body_model
from bodyslam_jax.geometry.camera import project
from bodyslam_jax.types import Tracks


@pytest.fixture(scope="module")
def body():
    return load_body_model(dtype=jnp.float32)


@pytest.fixture(scope="module")
def result(body):
    made = export_cases.make_result(load_body_model())
    summary = made.summary | {
        "scale": {"sigma": 0.05},
        "people": [{"stature_sigma_m": 0.02}, {"stature_sigma_m": None}],
    }
    return dataclasses.replace(made, summary=summary)


@pytest.fixture(scope="module")
def browser():
    with chromium() as found:
        yield found


def _samples(result, size=(160, 120)):
    """Images whose grey tells the frame."""
    t = len(result.timestamps)
    sampler = view.VideoSampler(t, None, len(result.landmarks))
    images = (np.full((*size[::-1], 3), 10 * k, np.uint8) for k in range(t))
    assert len(list(sampler.watch(images))) == t
    return sampler.samples()


@pytest.fixture(scope="module")
def page_file(tmp_path_factory, result, body):
    path = tmp_path_factory.mktemp("scene") / "scene.html"
    view.write_scene(path, result, body, _samples(result))
    return path


@pytest.fixture(scope="module")
def page(browser, page_file):
    with opened(browser, page_file) as found:
        yield scene(found)


def test_bodies_and_cameras_are_where_the_result_has_them(page, result):
    for frame in (0, 6, 11):
        joints, eye = page.evaluate(
            """async (frame) => {
                await bodyslam.show(frame);
                const at = (o) => new THREE.Vector3().setFromMatrixPosition(
                    o.matrixWorld).toArray();
                const people = bodyslam.runs[0].people;
                return [people.map((p) => p.skin.visible && p.bones.map(at)),
                    bodyslam.runs[0].eye.position.toArray()];
            }""",
            frame,
        )
        np.testing.assert_allclose(eye, result.T_WC[frame, :3, 3], atol=1e-5)
        for h, present in enumerate(result.present[:, frame]):
            assert bool(joints[h]) == present
            if present:
                expected = result.joints[h, frame]
                np.testing.assert_allclose(joints[h], expected, atol=2e-3)


def test_the_camera_view_is_that_of_the_video(page, result):
    """Joints are seen where the estimated camera sees them."""
    frame, (width, height) = 3, (640, 480)
    seen = page.evaluate(
        """(frame) => {
            bodyslam.look("camera");
            bodyslam.show(frame);
            const { camera } = bodyslam.view;
            camera.updateMatrixWorld();
            return bodyslam.runs[0].people[0].bones.map((bone) =>
                new THREE.Vector3().setFromMatrixPosition(bone.matrixWorld)
                    .project(camera).toArray());
        }""",
        frame,
    )
    T = result.T_WC[frame]
    p_C = (result.joints[0, frame] - T[:3, 3]) @ T[:3, :3]
    uv = np.asarray(project(jnp.asarray(result.intrinsics), jnp.asarray(p_C)))
    ndc = np.array(seen)[:, :2]
    found = np.stack([(ndc[:, 0] + 1) * width, (1 - ndc[:, 1]) * height], -1) / 2 - 0.5
    assert np.abs(found - uv).max() < 1.5  # px; joints are rounded to 0.2 mm


def test_it_plays_and_shows_what_is_asked_for(browser, page_file):
    with opened(browser, page_file, (390, 700)) as page:
        scene(page).click("#play")
        until(page, "bodyslam.state.frame > 3")
        page.click("#play")
        page.evaluate("bodyslam.show(9)")
        assert "10 of 12" in page.inner_text("#clock")
        until(page, "bodyslam.state.decoded === 9")
        shade = page.evaluate(
            "[...bodyslam.runs[0].texture.image.getContext('2d')"
            ".getImageData(5, 5, 1, 1).data]"
        )
        assert abs(shade[0] - 90) < 5
        page.click("#panel summary")
        for name in "people names camera images paths map ground".split():
            page.uncheck(f"input[name={name}]")
        visible = page.evaluate(
            "Object.entries(bodyslam.runs[0].layers).filter(([, g]) => g.visible)"
            ".map(([name]) => name)"
        )
        assert set(visible) <= {"contacts", "uncertainty"}
        page.check("input[name=uncertainty]")
        for mode in ("side", "above", "person-1", "camera", "free"):
            page.select_option("#view", mode)
        width = page.evaluate("document.documentElement.scrollWidth")
        assert width <= 390


@pytest.mark.slow
@pytest.mark.parametrize("case", ["nobody", "one frame", "no map", "a name"])
def test_missing_parts_are_left_out(browser, tmp_path, result, body, case):
    name = "</script><script>alert(1)</script>"
    changes = {
        "nobody": lambda r: export_cases.without_people(r),
        "one frame": lambda r: dataclasses.replace(
            r,
            **{n: getattr(r, n)[:1] for n in ("timestamps", "T_WC")},
            **{
                n: getattr(r, n)[:, :1] for n in ("poses", "trans", "joints", "present")
            },
        ),
        "no map": lambda r: dataclasses.replace(r, landmarks=r.landmarks[:0]),
        "a name": lambda r: dataclasses.replace(r, summary={"input": {"name": name}}),
    }
    changed = changes[case](result)
    view.write_scene(tmp_path / "scene.html", changed, body)
    with opened(browser, tmp_path / "scene.html") as page:
        text = scene(page).inner_text("header")
        assert "NaN" not in text and "undefined" not in text
        assert ("not metres" in text) == (case == "nobody")
        assert (name in text) == (case == "a name")


def test_a_thousand_frames_are_less_than_8_mb(tmp_path, result, body):
    index = np.arange(1000) % len(result.timestamps)
    long = dataclasses.replace(
        result,
        timestamps=np.arange(1000) / 30.0,
        T_WC=result.T_WC[index],
        landmarks=np.random.default_rng(0).normal(0, 3, (5000, 3)),
        **{
            n: getattr(result, n)[:, index]
            for n in ("poses", "trans", "joints", "present")
        },
    )
    sampler = view.VideoSampler(1000, None, 5000)
    noise = np.random.default_rng(0).integers(0, 255, (180, 320, 3), np.uint8)
    for _ in sampler.watch([noise] * 1000):
        pass
    samples = sampler.samples()
    assert 30 < len(samples.images) < 400 and samples.frame[-1] > 980
    view.write_scene(tmp_path / "scene.html", long, body, samples)
    assert (tmp_path / "scene.html").stat().st_size < 8e6


def test_colours_of_the_map_are_those_of_the_video():
    blue, red = np.zeros((2, 20, 30, 3), np.uint8)
    blue[5, 7] = (250, 0, 0)
    red[5, 7] = (150, 0, 100)
    tracks = Tracks(
        np.array([1, 0, 0]), np.array([0, 0, 1]), np.array([[7.2, 4.9]] * 3)
    )
    sampler = view.VideoSampler(2, tracks, 3)
    np.testing.assert_array_equal(list(sampler.watch([blue, red])), [blue, red])
    samples = sampler.samples()
    np.testing.assert_array_equal(
        samples.colors, [[50, 0, 200], [0, 0, 250], [128, 128, 128]]
    )
    small = cv2.imdecode(np.frombuffer(samples.images[0], np.uint8), cv2.IMREAD_COLOR)
    assert small.shape == blue.shape


def test_the_page_can_be_read_again(page_file, result):
    (run,) = view.read_runs(page_file)
    assert run["name"] == "made" and len(run["people"]) == 2
    times = np.frombuffer(base64.b64decode(run["times"]["data"]), "<f4")
    np.testing.assert_allclose(times, result.timestamps, atol=1e-6)
    with pytest.raises(ValueError, match="no runs in it, expected a scene.html"):
        other = page_file.with_name("other.html")
        other.write_text("<html></html>")
        view.read_runs(other)


def test_the_page_names_no_other_file(page_file):
    page = page_file.read_text()
    markup = re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL)
    assert not re.search(r"(src|href)=[\"'](?!data:)", markup)
    assert "The MIT License" in page and "three.js authors" in page
    assert json.loads(re.search(r'class="run">(.*?)</script>', page).group(1))


@pytest.fixture(scope="module")
def doubted(body, result):
    """The second person is not measurable, and the left arm was hidden for a while."""
    people = [
        {"status": "doubtful", "reasons": ["person 0: the feet slide."]},
        {"status": "not_measurable", "reasons": ["person 1: too small.", "far away."]},
    ]
    sigma = np.where(result.present[..., None], np.full(24, 0.03), 0.0)
    sigma[0, 4:8, 20] = 0.16
    summary = result.summary | {"people": people}
    return dataclasses.replace(result, summary=summary, joint_sigma=sigma)


def test_the_status_of_people_is_shown(browser, tmp_path, doubted, body):
    path = tmp_path / "scene.html"
    view.write_scene(path, doubted, body)
    with opened(browser, path, (1280, 720)) as page:
        text = scene(page).inner_text("header")
        assert "2 people, 1 doubtful, 1 not measurable" in text
        assert "the feet slide." in text and "too small. (and 1 more)" in text
        (line,) = (one for one in text.splitlines() if one.startswith("person 1:"))
        assert line == "person 1: not measurable"
        looks = page.evaluate(
            "bodyslam.runs[0].people.map((p) => [p.skin.material.opacity,"
            "p.person.inferred !== null])"
        )
        assert looks[0] == [1, True]
        assert looks[1][0] < 0.5 and not looks[1][1]

        def brightness(frame):
            """Of the left forearm's vertices, and of the right one's."""
            return page.evaluate(
                """async (frame) => {
                    await bodyslam.show(frame);
                    const { skin } = bodyslam.runs[0].people[0];
                    const { color, skinIndex, skinWeight } = skin.geometry.attributes;
                    return [18, 19].map((joint) => {
                        let sum = 0, count = 0;
                        for (let v = 0; v < color.count; v++) {
                            if (skinIndex.getX(v) !== joint) continue;
                            if (skinWeight.getX(v) < 0.9) continue;
                            sum += color.getX(v) + color.getY(v) + color.getZ(v);
                            count += 1;
                        }
                        return sum / count;
                    });
                }""",
                frame,
            )

        hidden, measured = brightness(5)
        assert hidden > measured + 0.1
        hidden, measured = brightness(0)
        assert hidden == pytest.approx(measured)


@pytest.mark.parametrize("size", [(1280, 720), (800, 600), (390, 800)])
def test_no_box_covers_anybody(browser, page_file, size):
    """Heads and feet of everybody, at any time, from all fixed views."""
    with opened(browser, page_file, size) as page:
        scene(page)
        for mode in ("start", "side", "above"):
            covered = page.evaluate(
                """async (mode) => {
                    bodyslam.look(mode);
                    const { camera, canvas, boxes } = bodyslam.view;
                    const found = [];
                    for (let k = 0; k < 12; k++) {
                        await bodyslam.show(k);
                        camera.updateMatrixWorld();
                        for (const p of bodyslam.runs[0].people) {
                            if (!p.present[k]) continue;
                            for (const joint of [15, 10, 11]) {
                                const q = new THREE.Vector3().setFromMatrixPosition(
                                    p.bones[joint].matrixWorld).project(camera);
                                const x = (q.x + 1) / 2 * canvas.clientWidth;
                                const y = (1 - q.y) / 2 * canvas.clientHeight;
                                for (const box of boxes) {
                                    const b = box.getBoundingClientRect();
                                    const inside = x > b.left && x < b.right
                                        && y > b.top && y < b.bottom;
                                    if (inside) found.push([k, joint, box.tagName]);
                                }
                                const most = Math.max(Math.abs(q.x), Math.abs(q.y));
                                if (most > 1) found.push([k, joint]);
                            }
                        }
                    }
                    return found;
                }""",
                mode,
            )
            assert covered == [], mode
