"""`bodyslam view`: a run in a browser, alone, beside another one, before and after."""

import dataclasses
import json
import re
import threading
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
from bodyslam_jax.pipeline.stage_cache import save
from bodyslam_jax.pipeline.start_of_joint import start_of_joint
from bodyslam_jax.types import Bodies, JointEstimate, ScaleStart, SfmResult, Tracks
from bodyslam_jax.view.serve import address_of, page_server

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
