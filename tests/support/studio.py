"""Foxglove Studio in a browser: its last open release, 1.48 of 2023, of which Lichtblick is the continuation.

It knows the protocol under its former name. The page gets it with the name that foxglove-sdk has now, as Lichtblick
does since its pull request 819; the protocol is the same.
"""

from __future__ import annotations

import mimetypes
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import quote, urlsplit

VIEWERS = Path(__file__).with_name("viewers")
PACKAGES = VIEWERS / "node_modules"
FILES = {
    "/": VIEWERS / "studio.html",
    "/react.js": PACKAGES / "react/umd/react.production.min.js",
    "/react-dom.js": PACKAGES / "react-dom/umd/react-dom.production.min.js",
}
FORMER, NOW = b"foxglove.websocket.v1", b"foxglove.sdk.v1"


class Page(BaseHTTPRequestHandler):
    """The files of the page."""

    def do_GET(self) -> None:
        place = urlsplit(self.path).path
        path = FILES.get(place, PACKAGES / "@foxglove/studio-base/assets" / Path(place).name)
        if not path.is_file():
            self.send_error(HTTPStatus.NOT_FOUND)
            return
        content = path.read_bytes()
        if path.name == "index.js":
            assert FORMER in content
            content = content.replace(FORMER, NOW)
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", mimetypes.guess_type(path.name)[0] or "application/octet-stream")
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format: str, *args: object) -> None:
        """Nobody reads it."""


@contextmanager
def studio(port: int) -> Iterator[str]:
    """The address of a page that connects to the live server at `port`."""
    with ThreadingHTTPServer(("127.0.0.1", 0), Page) as server:
        threading.Thread(target=server.serve_forever).start()
        try:
            link = quote(f"ws://127.0.0.1:{port}", safe="")
            yield f"http://127.0.0.1:{server.server_port}/?ds=foxglove-websocket&ds.url={link}"
        finally:
            server.shutdown()
