"""The report: complete offline, true to the numbers, calm where parts are missing."""

import dataclasses
import re
from importlib import resources

import numpy as np
import pytest
from browser import chromium, until
from scipy.signal import savgol_filter

from bodyslam_jax import export, view
from bodyslam_jax.body import load_body_model
from bodyslam_jax.diagnostics import statistics, thresholds
from bodyslam_jax.evaluation import before_after
from bodyslam_jax.export.figures import person_variable
from bodyslam_jax.export.report import in_plain_words
from bodyslam_jax.types import Result
from bodyslam_jax.view.style import PEOPLE


@pytest.fixture(scope="module")
def body():
    return load_body_model()


def _walk(num=90, fps=30.0, people=1):
    """People along x at 1.2 m/s, the camera beside them at 1 m/s."""
    t = np.arange(num) / fps
    T_WC = np.tile(np.eye(4), (num, 1, 1))
    T_WC[:, :3, 3] = np.stack([1.0 * t, 1.5 + 0 * t, -4 + 0 * t], -1)
    rng = np.random.default_rng(0)
    offsets = rng.normal(0, 0.2, (24, 3)) + [0.0, 0.9, 0.0]
    root = np.stack([1.2 * t, 0 * t, 0 * t], -1)
    joints = np.tile(root[None, :, None] + offsets, (people, 1, 1, 1))
    joints[:, :, 0] = root + [0.0, 0.9, 0.0]
    return Result(
        timestamps=t,
        T_WC=T_WC,
        scale=2.0,
        intrinsics=np.array([500.0, 510.0, 320.0, 240.0]),
        landmarks=rng.normal(0, 2, (40, 3)),
        poses=np.zeros((people, num, 72)),
        trans=joints[:, :, 0],
        betas=np.zeros((people, 10)),
        joints=joints,
        present=np.ones((people, num), bool),
    )


SUMMARY = {
    "status": "doubtful",
    "reasons": [
        {
            "status": "doubtful",
            "name": "standing_foot_speed",
            "message": "person 0: the lower foot moves at 0.62 m/s, expected < 0.4.",
            "advice": "look at the overlay",
            "figure": 0.62,
        }
    ],
    "input": {"name": "<script>alert(1)</script>", "width": 640, "height": 480},
    "warnings": ["focal length guessed & refined"],
    "scale": {"value": 2.0, "sigma": 0.05},
    "people": [{"stature_sigma_m": 0.021}],
    "stages": [
        {"name": "cameras", "cost_before": 200.0, "cost_after": 20.0, "iterations": 7},
        {"name": "fails", "cost_before": 0.0, "cost_after": None, "iterations": 0},
    ],
    "durations_s": {"tracks": 1.5, "joint": 2.0},
    "per_frame": {"reprojection_px": [None] * 9 + [0.7] * 81, "tracks": [200] * 90},
    "errors": {
        "cameras alone": {"c_ate_sim3": 0.0085, "c_ate_se3": "no <scale>"},
        "joint": {"c_ate_sim3": 0.0081, "c_ate_se3": 0.0251},
    },
    "settings": {"solver": {"iterations": 30}},
}


def _write(path, result, body):
    export.write_report(path / "report.html", result, body)
    return (path / "report.html").read_text()


def _text(page):
    return re.sub(r"\s+", " ", re.sub(r"<svg.*?</svg>|<[^>]+>", " ", page, flags=re.S))


def test_says_what_was_found(tmp_path, body):
    page = _write(tmp_path, dataclasses.replace(_walk(), summary=SUMMARY), body)
    text = _text(page)
    for words in (
        "doubtful",
        "Look twice at this result. The feet of the person slide",
        "What to do: look at the overlay.",
        "moves at 0.62 m/s, expected &lt; 0.4.",
        "person 3.6 m",  # 3 s at 1.2 m/s
        "camera 3.0 m",
        "person 1.2 m/s",
        "person: 4.3 km/h",
        "mean speed, m/s 1.20",
        f"{100 * statistics.stature(body, np.zeros(10)):.0f} ± 2 cm",
        "sizes are known to 2 % a metre in here is 0.97 to 1.02 m",
        "Lengths are known to 2.5 %",
        "estimate 2 0.05",  # the scale itself, among the details
        "focal length guessed &amp; refined",
        "cameras alone joint C-ATE, SE(3), mm – no &lt;scale&gt; 25.1",
        "C-ATE, Sim(3), mm 8.5 8.1",
        "total 3.5",
        "iterations: 30",
    ):
        assert words in text, words
    assert page.count("<svg") == 6


def test_opens_offline_and_runs_nothing(tmp_path, body):
    page = _write(tmp_path, dataclasses.replace(_walk(), summary=SUMMARY), body)
    assert "<script" not in page and "&lt;script&gt;" in page
    assert not re.search(r"(src|href)=[\"'](?!#|data:)", page.replace("xlink:", ""))
    assert "@import" not in page and "url(http" not in page
    assert "var(--camera)" in page and "#0a0b0c" not in page


@pytest.mark.slow
@pytest.mark.parametrize(
    "result",
    [_walk(), _walk(people=0), _walk(num=1), _walk(num=2), _walk(people=6)],
    ids=["no summary", "nobody", "one frame", "two frames", "a crowd"],
)
def test_missing_parts_are_left_out(tmp_path, body, result):
    text = _text(_write(tmp_path, result, body))
    assert "nan" not in text.lower() and "None" not in text
    assert "Warnings" not in text and "Error against" not in text


def test_a_focal_length_that_was_guessed_is_stated(tmp_path, body):
    lens = {"guessed": True, "guess_px": 600.0, "focal_px": 512.4}
    card = lambda lens: _text(
        _write(
            tmp_path, dataclasses.replace(_walk(), summary={"intrinsics": lens}), body
        )
    )
    found = card(lens | {"focal_sigma_px": 9.6})
    assert "512 ± 10 px" in found and "the guess was 600 px" in found
    kept = card(lens | {"focal_px": 600.0, "focal_sigma_px": None})
    assert "600 px" in kept and "guessed from the image" in kept
    assert "Focal length:" not in card({"guessed": False, "focal_px": 500.0})


def test_terms_of_ones_own_are_in_the_report(tmp_path, body):
    late = {"value": [0.44], "sigma": [0.1], "given": [0.0], "given_sigma": [0.5]}
    frame = {k: [0.25, v] for k, v in zip(late, (7.5, None, 0.0, None), strict=True)}
    own = {
        "variables": {"late": late, "frame": frame},
        "factors": {"Gps": {"residuals": 120, "cost": 44.5, "rms": 0.86}},
    }
    result = dataclasses.replace(_walk(), summary={"own": own})
    text = _text(_write(tmp_path, result, body))
    for words in ("Terms of your own", "late 0.44 0.1", "frame[1] 7.5", "Gps 120"):
        assert words in text, words
    assert "None" not in text


def test_the_report_gives_the_difference_of_cues_that_contradict(tmp_path, body):
    scale = {"value": 2.0, "sigma": 0.6, "from_motion": [1.0, 0.1]}
    text = lambda scale: _text(
        _write(tmp_path, dataclasses.replace(_walk(), summary={"scale": scale}), body)
    )
    share = lambda sigma: f"{100 * sigma / _walk().scale:.1f} %"
    disputed = text(scale | {"sigma_of_covariance": 0.06})
    assert f"known to {share(0.6)}" in disputed and share(0.06) in disputed
    assert "half the difference between the cues" in disputed
    assert "half the difference" not in text(scale | {"sigma_of_covariance": 0.6})
    assert share(0.6) in text(scale)


def test_without_people_lengths_are_in_units_of_the_map(tmp_path, body):
    scale = {"scale": {"value": 1.0, "sigma": float("inf")}}
    text = _write(tmp_path, dataclasses.replace(_walk(people=0), summary=scale), body)
    cards = text[text.index('class="cards"') : text.index("</section>")]
    assert "3 units" in cards and "nobody was found" in cards
    assert "not in metres" in cards and "there are no people" in cards
    assert "m/s" not in cards and "known to" not in cards


def test_absent_people_and_no_map(tmp_path, body):
    result = _walk(people=2)
    present = result.present.copy()
    present[0, 20:50] = False
    present[1] = False
    result = dataclasses.replace(
        result, present=present, landmarks=result.landmarks[:0]
    )
    page = _write(tmp_path, result, body)
    text = _text(page)
    assert "visible, s 1.9" in text and "nan" not in text
    assert "person 0" in text and "person 1" not in text
    # The gap is no distance: 19 + 39 frames at 1.2 m/s.
    way = statistics.person_statistics(result, 0)
    np.testing.assert_allclose(way.distance, 1.2 * (19 + 39) / 30, rtol=1e-6)
    assert np.isnan(way.speed[30]) and way.speed[5] == pytest.approx(1.2)


def test_jitter_is_not_distance():
    still = _walk()
    noise = np.random.default_rng(0).normal(0, 0.02, (90, 3))
    still.joints[0, :, 0] = noise + [0.0, 0.9, 0.0]
    raw = np.linalg.norm(np.diff(noise[:, [0, 2]], axis=0), axis=1).sum()
    assert statistics.person_statistics(still, 0).distance < 0.15 * raw


def test_skating_is_the_speed_of_the_foot_that_stands():
    result = _walk()
    result.joints[0, :, 10] = [0.0, 0.05, 0.0]
    result.joints[0, :, 11, 1] = 0.2
    assert statistics.foot_skating(result, 0) < 1e-12
    result.joints[0, :, 10, 0] = 0.3 * result.timestamps
    np.testing.assert_allclose(statistics.foot_skating(result, 0), 0.3)


def test_paths_are_smoothed_by_a_moving_average_that_keeps_lines():
    path = np.random.default_rng(4).standard_normal((60, 2))
    inside = slice(7, -7)
    expected = savgol_filter(path, 15, 1, axis=0)[inside]
    np.testing.assert_allclose(
        statistics.smoothed(path, 30.0)[inside], expected, atol=1e-12
    )
    line = np.linspace(0, 3, 60)[:, None] * [1.0, -2.0]
    np.testing.assert_allclose(statistics.smoothed(line, 30.0), line, atol=1e-12)
    np.testing.assert_array_equal(statistics.smoothed(path[:2], 30.0), path[:2])


def test_is_read_aloud_as_it_is_read(tmp_path, body):
    page = _write(tmp_path, dataclasses.replace(_walk(), summary=SUMMARY), body)
    ids = re.findall(r'\bid="([^"]*)"', page)
    assert len(ids) > 100 and len(set(ids)) == len(ids)
    targets = set(re.findall(r'href="#([^"]*)"|url\(#([^)]*)\)', page))
    assert targets and {a or b for a, b in targets} <= set(ids)
    figures = re.findall(
        r'<figure[^>]*><svg role="img" aria-label="([^"]+)".*?'
        r"<figcaption>(.*?)</figcaption></figure>",
        page,
        re.S,
    )
    assert len(figures) == 6 and all(name == caption for name, caption in figures)
    headers = re.findall(r"<th\b(.*?)>(.*?)</th>", page, re.S)
    assert len(headers) > 20
    for attributes, text in headers:
        assert attributes in (' scope="col"', ' scope="row"') and text
    levels = [int(level) for level in re.findall(r"<h([1-6])\b", page)]
    assert levels[0] == 1 and all(b - a <= 1 for a, b in zip(levels, levels[1:]))


@pytest.mark.parametrize("size", [1e-3, 1e3, 2e4, 1e9])
def test_scenes_of_any_size_have_a_grid(tmp_path, body, size):
    result = _walk()
    result.T_WC[:, 0, 3] *= size
    assert "Paths" in _text(_write(tmp_path, result, body))


def test_skating_is_told_beside_that_of_a_real_walk(tmp_path, body):
    text = _text(_write(tmp_path, _walk(), body))
    assert "lower foot, cm/s 120" in text and "real walk moves at about 10 cm/s" in text


@pytest.mark.parametrize(
    ("kind", "words"), [("static", "stood still"), ("rotation", "turned on the spot")]
)
def test_a_camera_that_stays_in_its_place_has_no_way_and_no_speed(
    tmp_path, body, kind, words
):
    summary = {
        "camera_motion": kind,
        "scale": {"sigma": None},
        "people": [{"stature_m": 1.7, "stature_sigma_m": 0.068}],
    }
    result = dataclasses.replace(_walk(), summary=summary)
    result.T_WC[:, 0, 3] = 0.0
    page = _write(tmp_path, result, body)
    text = _text(page)
    assert f"camera {words}" in text and "camera 0.0" not in text
    assert "sizes are known to 4 % all of them come from how tall people look" in text
    speeds = page[page.index('aria-label="Speed over the ground') :]
    assert "var(--camera)" not in speeds[: speeds.index("</svg>")]


def test_every_reason_has_a_plain_sentence():
    for check in (*thresholds.PERSON_CHECKS, *thresholds.WORLD_CHECKS):
        reason = {"name": check.name, "message": "the message", "person": 3}
        assert in_plain_words(reason, 4) != "the message", check.name
    assert in_plain_words({"name": "new", "message": "the message"}) == "the message"
    feet = {"name": "standing_foot_speed", "person": 3}
    assert "of person 3 slide" in in_plain_words(feet, 4)


def test_overlay_and_scene_beside_the_report_are_shown(tmp_path, body):
    plain = _write(tmp_path, _walk(), body)
    assert "<video" not in plain and "<iframe" not in plain and "<img" not in plain
    export.write_report(tmp_path / "report.html", _walk(), body, b"jpeg")
    still = (tmp_path / "report.html").read_text()
    assert '<img src="data:image/jpeg;base64,anBlZw=="' in still
    for name in ("overlay.webm", "scene.html"):
        (tmp_path / name).write_text("")
    export.write_report(tmp_path / "report.html", _walk(), body, b"jpeg")
    shown = (tmp_path / "report.html").read_text()
    assert '<video src="overlay.webm"' in shown and 'poster="data:image' in shown
    assert '<iframe src="scene.html#embedded"' in shown
    for name in ("overlay.webm", "scene.html"):
        assert f'<a href="{name}">' in shown


@pytest.mark.slow
@pytest.mark.parametrize("width", [390, 1280])
def test_nothing_is_cut_off_in_a_browser(tmp_path, body, width):
    result = dataclasses.replace(_walk(people=2), summary=SUMMARY)
    view.write_overlay(tmp_path / "overlay.webm", None, result, body)
    view.write_scene(tmp_path / "scene.html", result, body)
    export.write_report(tmp_path / "report.html", result, body)
    with chromium() as browser:
        page = browser.new_page(viewport={"width": width, "height": 800})
        heard = []
        page.on("console", lambda message: heard.append(message.text))
        page.goto((tmp_path / "report.html").as_uri())
        page.evaluate("document.querySelectorAll('details').forEach((d) => d.open = 1)")
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        over = "[...document.querySelectorAll('.wide, figure')]"
        over += ".map((e) => e.scrollWidth - e.clientWidth)"
        assert max(page.evaluate(over)) <= 0
        until(page, "document.querySelector('video').readyState > 0")
        page.evaluate("document.querySelector('iframe').scrollIntoView()")
        frame = page.query_selector("iframe").content_frame()
        until(frame, "!!window.bodyslam && window.bodyslam.state.ready")
        assert frame.is_hidden("header")
        page.close()
    assert heard == []


def test_as_many_people_as_are_estimated_have_colours_of_their_own():
    """In the report, in its light and its dark style, and in what is drawn."""
    style = (resources.files("bodyslam_jax.export") / "report.css").read_text()
    names = {person_variable(h) for h in range(8)}
    assert len(names) == len(set(PEOPLE)) == 8
    assert all(style.count(f"--{name}:") == 2 for name in names)


def test_reasons_lead_to_their_frames_in_the_overlay(tmp_path, body):
    reason = SUMMARY["reasons"][0] | {"frames": [31, 43], "seconds": [1.03, 1.43]}
    summary = SUMMARY | {"reasons": [reason]}
    result = dataclasses.replace(_walk(), summary=summary)
    export.write_report(tmp_path / "report.html", result, body)
    text = (tmp_path / "report.html").read_text()
    assert "Look at frames 31 to 43. " in text and "#t=" not in text
    (tmp_path / "overlay.webm").touch()
    export.write_report(tmp_path / "report.html", result, body)
    text = (tmp_path / "report.html").read_text()
    assert '<a href="overlay.webm#t=1.03,1.53">Look at frames 31 to 43' in text
    assert "x grows to the left" in text


def test_errors_end_with_both_statures_and_what_the_height_alone_would_give(
    tmp_path, body
):
    errors = {before_after.JOINT_ESTIMATE: {"scale": 1.1, "h_ate_se3": 0.2}}
    result = dataclasses.replace(_walk(), summary=SUMMARY | {"errors": errors})
    truth = before_after.TruthBeside(
        result.T_WC[:, :3, 3], result.joints[:, :, 0], {0: (1.84, 1.67)}
    )
    export.write_report(tmp_path / "report.html", result, body, None, truth)
    text = (tmp_path / "report.html").read_text()
    assert "person 0: 167 cm, in truth 184 cm" in text
    assert "by the height alone (--height 1.84) they would be by +0.2 %" in text
