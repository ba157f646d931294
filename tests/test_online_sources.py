"""What a live estimate reads from, the page that shows it, and how it ends."""

import json
import signal
import threading
import time
import urllib.request

import cv2
import numpy as np
import pytest

from bodyslam_jax.cli import interrupts
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io.capture import Capture
from bodyslam_jax.view.live_page import LivePage
from bodyslam_jax.view.serve import address_of

# Source, page, command.


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    path = tmp_path_factory.mktemp("live") / "clip.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (64, 48))
    for k in range(24):
        writer.write(np.full((48, 64, 3), 10 * k, np.uint8))
    writer.release()
    return path


def test_a_file_runs_at_its_own_pace_and_the_newest_image_wins(clip):
    capture = Capture(str(clip))
    assert capture.fps == pytest.approx(30) and capture.size == (64, 48)
    begun = time.monotonic()
    capture.start()
    found = []
    while (image := capture.newest(timeout=5.0)) is not None:
        found.append(image)
        time.sleep(0.1)  # slower than the source
    capture.close()
    assert capture.ended
    assert 0.7 < time.monotonic() - begun < 3.0
    indices = [image.index for image in found]
    assert indices == sorted(set(indices))
    assert len(found) + capture.dropped == 24 and capture.dropped > 5
    assert [i.timestamp for i in found] == pytest.approx([k / 30 for k in indices])


def test_a_file_waits_for_who_wants_every_frame_of_it(clip):
    capture = Capture(str(clip), every=True)
    assert capture.length == 24
    capture.start()
    found = []
    while (image := capture.newest(timeout=5.0)) is not None:
        found.append(image)
        time.sleep(0.05)  # slower than the source
    capture.close()
    assert capture.dropped == 0
    assert [image.index for image in found] == list(range(24))
    assert [i.timestamp for i in found] == pytest.approx([k / 30 for k in range(24)])
    with pytest.raises(InputError, match="--every-frame: 0 is no file"):
        Capture("0", every=True)


def test_a_file_that_waits_can_be_closed_before_its_end(clip):
    capture = Capture(str(clip), every=True)
    capture.start()
    assert capture.newest(timeout=5.0) is not None
    capture.close()  # the thread waits to be relieved of the second image
    assert capture.ended


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ("nowhere.mp4", "nowhere.mp4: no such file"),
        ("97", "97: this camera cannot be opened"),
    ],
)
def test_a_source_that_is_none_is_told_in_one_line(source, words):
    with pytest.raises(InputError, match=words) as error:
        Capture(source)
    assert "\n" not in str(error.value)


def test_the_page_shows_the_newest_state_to_this_machine_only():
    page = LivePage()
    try:
        joints = np.random.default_rng(0).standard_normal((24, 3))
        image = np.zeros((48, 64, 3), np.uint8)
        people = [(0, np.full((24, 2), 20.0), joints)]
        for k in range(3):
            T_WC = np.eye(4)
            T_WC[0, 3] = k
            figures = {"figures": {"status": "tracking"}, "notes": ["<b>a note"]}
            page.show(image, np.zeros((2, 2)), people, T_WC, figures)
        address = address_of(page.server)
        assert address.startswith("http://127.0.0.1:")
        with urllib.request.urlopen(address + "state.json") as answer:
            state = json.load(answer)
        assert [p[0] for p in state["paths"]["camera"]] == [0, 1, 2]
        assert state["figures"] == {"status": "tracking"}
        with urllib.request.urlopen(address + "picture.jpg") as answer:
            found = np.frombuffer(answer.read(), np.uint8)
        assert cv2.imdecode(found, cv2.IMREAD_COLOR).shape == image.shape
        with urllib.request.urlopen(address) as answer:
            assert b"textContent" in answer.read()  # notes are text, never markup
        foreign = urllib.request.Request(address, headers={"Host": "evil.example"})
        with pytest.raises(urllib.error.HTTPError) as refused:
            urllib.request.urlopen(foreign)
        assert refused.value.code == 421
        refused.value.close()
    finally:
        page.close()


def test_paths_on_the_page_stay_short():
    page = LivePage()
    try:
        for k in range(3000):
            page.paths.setdefault("camera", type_of_path()).add(np.full(3, float(k)))
        points = page.paths["camera"].points
        assert len(points) <= 600 and points[0][0] == 0 and points[-1][0] > 2900
    finally:
        page.close()


def type_of_path():
    from bodyslam_jax.view import live_page

    return live_page.Path()


def test_the_first_interrupt_ends_the_source_and_the_second_the_command():

    if threading.current_thread() is not threading.main_thread():
        pytest.skip("signals come to the main thread")
    # A worker of the tests ignores it.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        _interrupted_twice()
    finally:
        signal.signal(signal.SIGINT, before)


def _interrupted_twice():

    with pytest.raises(KeyboardInterrupt), interrupts.as_event() as stop:
        assert not stop.is_set()
        signal.raise_signal(signal.SIGINT)
        assert stop.is_set()
        signal.raise_signal(signal.SIGINT)
    with interrupts.as_event() as stop:
        pass
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)
