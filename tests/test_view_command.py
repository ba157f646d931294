"""`bodyslam view`: a run in a browser, alone, beside another one, before and after."""

import dataclasses
import json
import os
import re
import socket
import sys
import threading
import time
import urllib.error
import urllib.request
from http.server import ThreadingHTTPServer

import export_cases
import jax.numpy as jnp
import numpy as np
import pytest
from browser import chromium, opened, scene

from bodyslam_jax import export, view
from bodyslam_jax.body import load_body_model, rest_joints
from bodyslam_jax.cli.view import view as view_command
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.pipeline.run_folder import start_of_joint
from bodyslam_jax.pipeline.stage_cache import save
from bodyslam_jax.types import Bodies, JointEstimate, ScaleStart, SfmResult, Tracks
from bodyslam_jax.view.serve import MAX_THREADS, address_of, page_server

SCALE = 2.5
"""m per map unit."""


@pytest.fixture(scope="module")
def body():
    return load_body_model()


@pytest.fixture(scope="module")
def result(body):
    made = export_cases.make_result(body)
    used = {"frames_used": [0, export_cases.NUM_FRAMES - 1]}
    return dataclasses.replace(made, summary=made.summary | used)


@pytest.fixture
def run(tmp_path, result):
    folder = tmp_path / "run"
    export.write_run(folder, result)
    return folder


def _keep_stages(run, result, body):
    """The stages of a run whose joint estimate has changed nothing: the result in
    another world and another unit."""
    other = np.eye(4)
    other[:3, :3] = so3.exp(np.array([0.3, -0.8, 0.2]))
    other[:3, 3] = [1.0, 2.0, -3.0]
    T_WC = other @ result.T_WC
    T_WC[:, :3, 3] /= SCALE
    landmarks = (result.landmarks @ other[:3, :3].T + other[:3, 3]) / SCALE
    tracks = Tracks(*(np.zeros(0, int) for _ in range(2)), np.zeros((0, 2)))
    num, (h, t) = len(landmarks), result.present.shape
    cameras = SfmResult(
        **{"kind": "moving", "T_WC": T_WC, "registered": np.ones(t, bool)},
        **{"landmarks": landmarks, "tracks": tracks, "keep": np.zeros(0, bool)},
        prior_information=np.zeros((num, 3, 3)),
        prior_mean=landmarks,
        pixel_sigma=0.3,
        intrinsics=result.intrinsics,
        focal_sigma=float("nan"),
        costs=(2.0, 1.0),
        warnings=(),
    )
    poses = result.poses.copy()
    R_CW = np.swapaxes(result.T_WC[:, :3, :3], 1, 2)
    poses[..., :3] = so3.log(R_CW @ so3.exp(poses[..., :3]))
    rest = np.asarray(rest_joints(body, jnp.asarray(result.betas)))[:, None, 0]
    pelvis = rest + result.trans - result.T_WC[:, :3, 3]
    bodies = Bodies(
        result.present,
        poses,
        np.repeat(result.betas[:, None], t, axis=1),
        np.einsum("tij,htj->hti", R_CW, pelvis) - rest,
    )
    joint = JointEstimate(
        scale=3.0,
        start=ScaleStart(motion=SCALE, motion_error=0.1),
        scale_sigma=0.1,
        shape_covariance=np.zeros((h, 10, 10)),
        unobserved=(),
        cameras=T_WC,
        roots=np.tile(np.eye(4), (h, t, 1, 1)),
        poses=np.zeros((h, t, 23, 3)),
        shapes=result.betas,
        landmarks=landmarks,
        intrinsics=result.intrinsics,
        present=result.present,
        status="converged",
        stages=(),
    )
    folder = run / ".cache"
    folder.mkdir()
    for name, stage in (("cameras", cameras), ("people", bodies), ("joint", joint)):
        save(folder / f"{name}-0.npz", stage)


def test_the_start_of_the_joint_estimate_is_put_into_the_world_of_the_result(
    run, result, body
):
    assert start_of_joint(run, result, body) is None
    _keep_stages(run, result, body)
    start = start_of_joint(run, result, body)
    assert start.scale == SCALE
    for name in ("T_WC", "landmarks", "betas"):
        np.testing.assert_allclose(getattr(start, name), getattr(result, name))
    np.testing.assert_allclose(
        start.joints[result.present], result.joints[result.present], atol=1e-9
    )
    (run / ".cache" / "joint-0.npz").write_bytes(b"broken")
    assert start_of_joint(run, result, body) is None


def _pages(run, monkeypatch, **options):
    """What the command serves, and what the page's own address was."""
    served = {}

    def serve_once(server):
        thread = threading.Thread(target=server.handle_request)
        thread.start()
        address = address_of(server)
        served["page"] = urllib.request.urlopen(address).read().decode()
        thread.join()
        raise KeyboardInterrupt

    monkeypatch.setattr(ThreadingHTTPServer, "serve_forever", serve_once)
    view_command(run, **options)
    found = re.findall(r'class="run">(.*?)</script>', served["page"], re.DOTALL)
    return [json.loads(one) for one in found]


def test_a_run_is_served_with_its_start_and_another_run(
    run, result, body, monkeypatch, capsys
):
    (alone,) = _pages(run, monkeypatch)
    assert re.match(r"http://127\.0\.0\.1:\d+/ ", capsys.readouterr().out)
    assert alone["name"] == "made" and alone["images"]["frame"] == []
    _keep_stages(run, result, body)
    samples = view.VideoSamples(
        np.array([0]), (b"jpeg",), np.zeros((len(result.landmarks), 3), np.uint8)
    )
    view.write_scene(run / "scene.html", result, body, samples)
    monkeypatch.setattr("webbrowser.open", lambda url: print("opened", url))
    first, other, start = _pages(run, monkeypatch, compare=run, open=True)
    assert "opened http://127.0.0.1:" in capsys.readouterr().out
    assert first["images"]["frame"] == [0] and "hidden" not in first
    assert other["label"] == str(run) and "hidden" not in other
    assert start["label"] == "before the joint estimate" and start["hidden"]


@pytest.fixture
def opened_files():
    """The files that are opened from here on."""
    found, state = [], {"on": True}

    def note(event, args):
        if state["on"] and event == "open":
            found.append(str(args[0]))

    sys.addaudithook(note)
    yield found
    state["on"] = False


def _foreign(run, result, name, **input):
    """The run folder of somebody else, whose summary names files."""
    summary = result.summary | {"settings": {"body_model": name, "motion_model": name}}
    summary["input"] = {**summary.get("input", {}), "path": name, "name": "../x"}
    export.write_run(run, dataclasses.replace(result, summary=summary))


def test_no_file_is_opened_because_a_run_folder_names_it(
    tmp_path, result, body, monkeypatch, opened_files, command
):
    run, named = tmp_path / "foreign", tmp_path / "named.pkl"
    named.write_bytes(b"a body, or a trap")
    _foreign(run, result, str(named))
    opened_files.clear()
    assert len(_pages(run, monkeypatch)) == 1
    code, text = command("export", run, "--to", "glb", "tum", "colmap")
    assert code == 0, text
    code, text = command("evaluate", run, run)
    assert code == 0, text
    assert str(named) not in opened_files and str(run / "result.npz") in opened_files
    assert sorted(p.name for p in tmp_path.iterdir()) == ["foreign", "named.pkl"]
    code, text = command("export", run, "--body-model", named)
    assert code == 1 and "named.pkl" in text
    assert str(named) in opened_files


def test_a_run_of_another_body_asks_for_it_in_a_line(
    tmp_path, result, body, monkeypatch, command, caplog
):
    run = tmp_path / "run"
    other = dataclasses.replace(result, joints=result.joints + [0.1, 0, 0])
    _foreign(run, other, "my/body.npz\nsecond line")
    for argv in (("export", run), ("view", run)):
        code, text = command(*argv)
        line = text.strip().splitlines()[-1]
        assert code == 1 and "my/body.npz" in line and "--body-model" in line
    view.write_scene(run / "scene.html", result, body)
    assert len(_pages(run, monkeypatch)) == 1
    assert "--body-model" in caplog.text


@pytest.mark.parametrize(
    "summary",
    [
        {"settings": [1]},
        {"people": 3},
        {"people": [3]},
        {"scale": "a"},
        {"input": {"width": 1e400}},
        {"frames_used": ["a", "b"]},
        {"status": {"a": 1}},
    ],
)
def test_a_summary_of_other_types_is_named(run, summary, command):
    file = run / "summary.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | summary))
    for argv in (("export", run, "--to", "tum"), ("view", run)):
        code, text = command(*argv)
        line = text.strip().splitlines()[-1]
        assert code == 1 and str(file) in line and next(iter(summary)) in line


@pytest.mark.parametrize("page", ["", "[" * 100_000, "[1]", "{}", '{"name": NaN'])
def test_a_page_that_is_none_is_named(run, page):
    text = f'<script type="application/json" class="run">{page}</script>'
    (run / "scene.html").write_text(text)
    with pytest.raises(ValueError, match="scene.html[:,] "):
        view.read_runs(run / "scene.html")


def test_names_are_text_in_the_page(run, result, body):
    names = ("</script><script>alert(1)</script>", "{script}", "{runs}", "<!--\u2028")
    for name in names:
        summary = result.summary | {"input": {"name": name}, "status": name}
        page = view.scene_page(
            [view.scene_data(dataclasses.replace(result, summary=summary), body)]
        )
        assert page.count("<script") == 2 and "alert(1)</script>" not in page
        assert "\u2028" not in page.partition("class=")[2]
        (run / "scene.html").write_text(page)
        assert view.read_runs(run / "scene.html")[0]["name"] == name


def test_only_the_pictures_of_a_run_are_served(run):
    (run / "overlay.webm").write_bytes(bytes(range(100)))
    with page_server("<html>page</html>", run) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        get = lambda name, **headers: urllib.request.urlopen(
            urllib.request.Request(address_of(server) + name, headers=headers)
        )
        assert get("").read() == b"<html>page</html>"
        assert get("overlay.webm").read() == bytes(range(100))
        part = get("overlay.webm", Range="bytes=10-19")
        assert part.status == 206 and part.read() == bytes(range(10, 20))
        assert part.headers["Content-Range"] == "bytes 10-19/100"
        for name in ("summary.json", "../run/summary.json", "scene.html"):
            with pytest.raises(urllib.error.HTTPError, match="404"):
                get(name)
        with pytest.raises(ValueError, match=r"--port \d+: .*; expected a free port"):
            page_server("", run, server.server_address[1])
        server.shutdown()
        thread.join()


@pytest.fixture
def served(run):
    """The raw answer to a request of the server of a run."""
    (run / "overlay.webm").write_bytes(bytes(range(100)))
    with page_server("<html>page</html>", run) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        port = server.server_address[1]

        def ask(request: str, host: str | None = "127.0.0.1:{port}") -> bytes:
            lines = [request, "Connection: close"]
            lines += [] if host is None else [f"Host: {host.format(port=port)}"]
            with socket.create_connection(("127.0.0.1", port), timeout=10) as link:
                link.sendall("\r\n".join([*lines, "", ""]).encode())
                return b"".join(iter(lambda: link.recv(1 << 16), b""))

        yield ask
        server.shutdown()
        thread.join()


def test_only_requests_to_its_own_name_are_answered(served):
    """A page elsewhere whose name is made to lead here sends its own name."""
    own = ("127.0.0.1:{port}", "localhost:{port}", "LOCALHOST:{port}")
    assert all(served("GET / HTTP/1.1", host)[9:12] == b"200" for host in own)
    others = ("evil.example:{port}", "127.0.0.1", "127.0.0.1:1", "", None, "[::1]")
    for host in others:
        answer = served("GET / HTTP/1.1", host)
        assert answer[9:12] in (b"421", b"400") and b"page" not in answer, host
    assert b"page" not in served("GET / HTTP/1.1\r\nHost: evil", "127.0.0.1:{port}")


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "OPTIONS", "TRACE", "X"])
def test_nothing_but_reading_is_served(served, method):
    answer = served(f"{method} / HTTP/1.1")
    assert answer[9:12] == b"501" and b"page" not in answer
    head = served("HEAD /overlay.webm HTTP/1.1")
    assert head[9:12] == b"200" and head.endswith(b"\r\n\r\n")
    assert b"Content-Length: 100" in head and b"nosniff" in head
    assert b"Content-Security-Policy: default-src 'self'" in head


def test_links_and_paths_do_not_lead_out_of_the_folder(served, run):
    (run.parent / "secret.html").write_text("secret")
    (run / "report.html").symlink_to(run.parent / "secret.html")
    (run / "scene.html").mkdir()
    os.mkfifo(run / "overlay.mp4")
    names = ("report.html", "scene.html", "overlay.mp4", "scene.html/", ".", "..")
    names += ("../secret.html", "%2e%2e/secret.html", "/etc/passwd", "//report.html")
    for name in names:
        answer = served(f"GET /{name} HTTP/1.1")
        assert answer[9:12] == b"404" and b"secret\n" not in answer, name
    (run / "report.html").unlink()
    (run / "inside.html").write_text("inside")
    (run / "report.html").symlink_to("inside.html")
    assert served("GET /report.html HTTP/1.1").endswith(b"inside")


@pytest.mark.parametrize(
    "wanted, expected",
    [
        ("bytes=10-19", bytes(range(10, 20))),
        ("bytes=90-", bytes(range(90, 100))),
        ("bytes=-5", bytes(range(95, 100))),
        ("bytes=-500", bytes(range(100))),
        ("bytes=90-999999999999", bytes(range(90, 100))),
        ("bytes=100-", 416),
        ("bytes=20-10", 416),
        ("bytes=-0", 416),
        ("bytes=0-1,3-4" + ",0-99" * 1000, bytes(range(100))),
        ("bytes=" + "9" * 5000 + "-", bytes(range(100))),
        ("bytes=--5", bytes(range(100))),
        ("bytes=-", bytes(range(100))),
        ("lines=1-2", bytes(range(100))),
    ],
)
def test_ranges_are_answered_within_the_file(served, wanted, expected):
    answer = served(f"GET /overlay.webm HTTP/1.1\r\nRange: {wanted}")
    head, _, body = answer.partition(b"\r\n\r\n")
    if expected == 416:
        assert head[9:12] == b"416" and b"Content-Range: bytes */100" in head
    else:
        assert head[9:12] in (b"200", b"206") and body == expected


def test_connections_are_bounded(run):
    with page_server("page", run) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        place = server.server_address[:2]
        silent = [socket.create_connection(place) for _ in range(MAX_THREADS)]
        with socket.create_connection(place, timeout=10) as one:
            assert one.recv(100).startswith(b"HTTP/1.1 503")
        assert threading.active_count() < MAX_THREADS + 20
        for link in silent:
            link.close()
        for _ in range(500):
            try:
                assert urllib.request.urlopen(address_of(server)).read() == b"page"
                break
            except (urllib.error.HTTPError, ConnectionError):
                time.sleep(0.01)
        else:
            raise AssertionError("threads are not given back")
        server.shutdown()
        thread.join()


def test_a_notebook_shows_the_scene_in_a_frame(run, result, body):
    shown = result.view()._repr_html_()
    assert shown.startswith("<iframe srcdoc=") and "&lt;canvas" in shown
    view.write_scene(run / "scene.html", result, body)
    assert result.view(run, height=300).page == (run / "scene.html").read_text()


@pytest.mark.slow
def test_a_browser_shows_the_runs_that_are_chosen(run, result, body, tmp_path):
    _keep_stages(run, result, body)
    start = view.scene_data(start_of_joint(run, result, body), body)
    runs = [view.scene_data(result, body), start | {"label": "start", "hidden": True}]
    page_file = tmp_path / "page.html"
    page_file.write_text(view.scene_page(runs))
    with chromium() as browser, opened(browser, page_file, (900, 600)) as page:
        visible = "bodyslam.runs.map((run) => run.root.visible)"
        assert scene(page).evaluate(visible) == [True, False]
        page.click("#panel summary")  # folded where the window is small
        page.check("input[name=run-1]")
        page.uncheck("input[name=run-0]")
        assert page.evaluate(visible) == [False, True]
        page.evaluate("bodyslam.show(7)")
        assert page.evaluate("bodyslam.runs[1].frame") == 7
