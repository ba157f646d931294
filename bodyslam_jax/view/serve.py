"""A run's pages on this machine's own address, for a browser.

Any page in the same browser can send requests here. So only requests for this address
by its own names are answered (`Host`, against rebinding of names), nothing but the
page and the pictures of the run is served, and threads and their patience are bounded.
"""

import contextlib
import functools
import logging
import os
import re
import stat
import threading
from collections.abc import Iterator
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, BinaryIO

from bodyslam_jax.config.errors import InputError

log = logging.getLogger(__name__)
_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".webm": "video/webm",
    ".mp4": "video/mp4",
    ".jpg": "image/jpeg",
    ".json": "application/json",
}
_SERVED_FILES = ("report.html", "scene.html", "overlay.webm", "overlay.mp4")
"""Files of a run folder that are served."""
_RANGE = re.compile(r"bytes=(\d{0,15})-(\d{0,15})")
"""One range of at most 10^15 bytes; all others are ignored, as RFC 9110 allows."""
_LOOPBACK = "127.0.0.1"
_HTTP_PORT = 80
"""Port that browsers leave out of `Host`."""
MAX_THREADS = 32
"""Requests at a time; a browser opens six connections to a server."""
_TIMEOUT_S = 30.0
"""Time for which a connection may be silent, s."""
_CHUNK_BYTES = 1 << 18
_CONTENT_SOURCES = "'self' 'unsafe-inline' data: blob:"
_HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": (
        f"default-src {_CONTENT_SOURCES}; object-src 'none'; base-uri 'none'; "
        "form-action 'none'; frame-ancestors 'self'"
    ),
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


class PageServer(ThreadingHTTPServer):
    """A server with a bounded number of threads; it refuses what exceeds it."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.free = threading.BoundedSemaphore(MAX_THREADS)

    def process_request(self, request: Any, client_address: Any) -> None:
        if self.free.acquire(blocking=False):
            super().process_request(request, client_address)
            return
        with contextlib.suppress(OSError):
            request.settimeout(0.1)
            request.sendall(b"HTTP/1.1 503 Busy\r\nConnection: close\r\n\r\n")
        self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self.free.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Prints no traceback: browsers end connections when they like."""
        log.debug("%s", client_address, exc_info=True)


def page_server(page: str, folder: Path, port: int = 0) -> PageServer:
    """Returns a server of `page` at `/`, and of the pictures in the run folder.

    It listens to this machine only. Port 0 is a free one; `address_of` has it.

    **Raises:** `InputError` if the port is taken.
    """
    return local_server(functools.partial(_Handler, page.encode(), folder), port)


def local_server(handler: Any, port: int) -> PageServer:
    """Returns a server, on this machine only, of what `handler` answers.

    **Raises:** as `page_server`.
    """
    try:
        return PageServer((_LOOPBACK, port), handler)
    except (OSError, OverflowError) as error:
        raise InputError(
            f"--port {port}: {error}; expected a free port, 0 for any."
        ) from None


def address_of(server: ThreadingHTTPServer) -> str:
    """Returns the address of the page, as a browser takes it."""
    return f"http://{_LOOPBACK}:{server.server_address[1]}/"


class PageHandler(BaseHTTPRequestHandler):
    """Answers requests for this address by its own names, and no others."""

    protocol_version = "HTTP/1.1"
    timeout = _TIMEOUT_S

    def do_GET(self) -> None:
        if "Content-Length" in self.headers or "Transfer-Encoding" in self.headers:
            self.close_connection = True  # what follows is no request
        if not self._is_addressed():
            self.send_error(HTTPStatus.MISDIRECTED_REQUEST)
            return
        self.answer(self.path.partition("?")[0].removeprefix("/"))

    def do_HEAD(self) -> None:
        self.do_GET()

    def answer(self, name: str) -> None:
        """Sends what has this name, or that it does not exist."""
        self.send_error(HTTPStatus.NOT_FOUND)

    def send_bytes(self, content: bytes, suffix: str) -> None:
        """Sends content that is in memory, all of it or the requested part."""
        copy = lambda start, end: self.wfile.write(content[start:end])
        self._send(len(content), suffix, copy)

    def _is_addressed(self) -> bool:
        """Returns True if the request is for this server under its own names. A request
        under another name that leads here, as by DNS rebinding, is one of a foreign
        page."""
        address: Any = self.server.server_address
        port = address[1]
        known = {f"{name}:{port}" for name in (_LOOPBACK, "localhost")}
        if port == _HTTP_PORT:
            known |= {_LOOPBACK, "localhost"}
        hosts = self.headers.get_all("Host", [])
        return len(hosts) == 1 and hosts[0].strip().lower() in known

    def _send(self, size: int, suffix: str, copy: Any) -> None:
        """Sends the whole content or, as browsers ask where they seek in a video, a
        part."""
        start, end, status = 0, size, HTTPStatus.OK
        found = _RANGE.fullmatch(self.headers.get("Range", "").strip())
        if found and found.group() != "bytes=-":
            status = HTTPStatus.PARTIAL_CONTENT
            if not found[1]:  # the last bytes
                start = max(0, size - int(found[2]))
            else:
                start = int(found[1])
                end = min(size, int(found[2]) + 1) if found[2] else size
            if start >= end:
                self.send_response(HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE)
                self.send_header("Content-Range", f"bytes */{size}")
                self.send_header("Content-Length", "0")
                self.end_headers()
                return
        self.send_response(status)
        self.send_header("Content-Type", _TYPES[suffix])
        self.send_header("Content-Length", str(end - start))
        self.send_header("Accept-Ranges", "bytes")
        if status == HTTPStatus.PARTIAL_CONTENT:
            self.send_header("Content-Range", f"bytes {start}-{end - 1}/{size}")
        self.end_headers()
        if self.command == "GET":
            copy(start, end)

    def end_headers(self) -> None:
        for name, value in _HEADERS.items():
            self.send_header(name, value)
        super().end_headers()

    def version_string(self) -> str:
        """Returns the server's name, without versions of its parts."""
        return "bodyslam"

    def log_message(self, format: str, *args: object) -> None:
        """Logs nothing of single requests."""


class _Handler(PageHandler):
    """Serves a page and the pictures of a run folder."""

    def __init__(self, page: bytes, folder: Path, *args: Any):
        self.page, self.folder = page, folder
        super().__init__(*args)

    def answer(self, name: str) -> None:
        if name == "":
            self.send_bytes(self.page, ".html")
            return
        with _opened(self.folder, name) as file:
            if file is None:
                self.send_error(HTTPStatus.NOT_FOUND)
                return
            size = os.fstat(file.fileno()).st_size
            copy = functools.partial(self._part_of_file, file)
            self._send(size, Path(name).suffix, copy)

    def _part_of_file(self, file: BinaryIO, start: int, end: int) -> None:
        file.seek(start)
        while start < end:
            part = file.read(min(_CHUNK_BYTES, end - start))
            if not part:  # the file has become shorter: its length was promised
                self.close_connection = True
                return
            self.wfile.write(part)
            start += len(part)


@contextlib.contextmanager
def _opened(folder: Path, name: str) -> Iterator[BinaryIO | None]:
    """Returns an open picture of the run; `None` if it does not exist, or a link leads
    to it out of the folder."""
    file = None
    if name in _SERVED_FILES:
        with contextlib.suppress(OSError, RuntimeError):  # none, or links in a circle
            path = (folder / name).resolve(strict=True)
            if path.is_relative_to(folder.resolve()):
                file = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))
    if file is None:
        yield None
        return
    if not stat.S_ISREG(os.fstat(file).st_mode):
        os.close(file)
        yield None
        return
    with os.fdopen(file, "rb") as opened:
        yield opened
