"""A run's pages on this machine's own address, for a browser."""

import functools
import re
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from bodyslam_jax.config.errors import InputError

_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".webm": "video/webm",
    ".mp4": "video/mp4",
}
_FILES = ("report.html", "scene.html", "overlay.webm", "overlay.mp4")
"""What is served of a run folder."""
_RANGE = re.compile(r"bytes=(\d+)-(\d*)$")
_LOOPBACK = "127.0.0.1"


def page_server(page: str, folder: Path, port: int = 0) -> ThreadingHTTPServer:
    """A server of `page` at `/`, and of the pictures in the run folder beside it.

    It listens to this machine only. Port 0 is a free one; `address_of` has it.

    **Raises:** `InputError` if the port is taken.
    """
    handler = functools.partial(_Handler, page.encode(), folder)
    try:
        return ThreadingHTTPServer((_LOOPBACK, port), handler)
    except (OSError, OverflowError) as error:
        raise InputError(
            f"--port {port}: {error}; expected a free port, 0 for any."
        ) from None


def address_of(server: ThreadingHTTPServer) -> str:
    """Of the page, as a browser takes it."""
    return f"http://{_LOOPBACK}:{server.server_address[1]}/"


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def __init__(self, page: bytes, folder: Path, *args: Any):
        self.page, self.folder = page, folder
        super().__init__(*args)

    def do_GET(self) -> None:
        name = self.path.partition("?")[0].lstrip("/")
        if name == "":
            self._send(self.page, ".html")
        elif name in _FILES and (self.folder / name).is_file():
            self._send((self.folder / name).read_bytes(), Path(name).suffix)
        else:
            self.send_error(HTTPStatus.NOT_FOUND)

    do_HEAD = do_GET

    def _send(self, content: bytes, suffix: str) -> None:
        """All of it or, as browsers ask where they seek in a video, a part."""
        start, end, status = 0, len(content), HTTPStatus.OK
        if found := _RANGE.match(self.headers.get("Range", "")):
            start = int(found[1])
            end = min(end, int(found[2]) + 1) if found[2] else end
            status = HTTPStatus.PARTIAL_CONTENT
            if start >= end:
                self.send_error(HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE)
                return
        self.send_response(status)
        self.send_header("Content-Type", _TYPES[suffix])
        self.send_header("Content-Length", str(end - start))
        self.send_header("Accept-Ranges", "bytes")
        if status == HTTPStatus.PARTIAL_CONTENT:
            self.send_header("Content-Range", f"bytes {start}-{end - 1}/{len(content)}")
        self.end_headers()
        if self.command == "GET":
            self.wfile.write(content[start:end])

    def log_message(self, format: str, *args: object) -> None:
        """Requests are not worth a line."""
