"""Chromium, steered by playwright; tests are skipped where one of them is missing."""

import contextlib
import os
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

_NAMES = ("chromium", "chromium-browser", "google-chrome")
_OPTIONS = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader")
_OPTIONS += ("--enable-unsafe-swiftshader",)


@contextlib.contextmanager
def chromium() -> Iterator:
    """A headless browser with WebGL in software."""
    playwright = pytest.importorskip("playwright.sync_api")
    found = os.environ.get("BODYSLAM_CHROMIUM") or next(
        filter(None, map(shutil.which, _NAMES)), None
    )
    if found is None:
        pytest.skip("no Chromium on the path or in BODYSLAM_CHROMIUM")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=found, args=list(_OPTIONS))
        yield browser
        browser.close()


@contextlib.contextmanager
def opened(browser, address: Path | str, size=(640, 480), view="") -> Iterator:
    """A page, offline, that must end without a message, an error or a request."""
    page = browser.new_page(viewport={"width": size[0], "height": size[1]})
    heard, asked = [], []
    page.on("console", lambda message: heard.append(message.text))
    page.on("pageerror", lambda error: heard.append(str(error)))
    page.on("request", lambda request: asked.append(request.url))
    url = address.as_uri() if isinstance(address, Path) else address
    page.goto(url + view)
    yield page
    page.close()
    assert heard == []
    assert [u for u in asked if u != url and u != url + view] == []


def scene(page):
    """Waits until the scene of a page is drawn for the first time."""
    until(page, "!!window.bodyslam && window.bodyslam.state.ready")
    return page


def until(page, condition: str, seconds: float = 60.0) -> None:
    """Waits for a condition in JavaScript. Playwright's own waiting evaluates texts in
    the page, which the page's security policy forbids."""
    end = time.monotonic() + seconds
    while not page.evaluate(condition):
        assert time.monotonic() < end, f"still not after {seconds} s: {condition}"
        time.sleep(0.05)
