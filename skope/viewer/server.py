"""A server for one browser on this machine: it gives the page, its JSON and pictures by number, and nothing else."""

import errno
import re
import sys
from functools import lru_cache
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from typing import Any, Final

from skope.errors import UserError
from skope.files.json_files import json_bytes
from skope.terminal.console import Console
from skope.viewer.collection import Collection
from skope.viewer.documents import STEPS, Documents

ADDRESS: Final = "127.0.0.1"
PORT: Final = 8033
"""The port that is taken where it is free."""
_HOST: Final = re.compile(r"(localhost|127\.0\.0\.1|\[::1\])(:[0-9]{1,5})?", re.IGNORECASE)
_IMAGE: Final = re.compile(r"/images/([0-9]{1,9})(\.json)?")
_SCORES: Final = re.compile(r"/scores/([0-9]{1,4})\.json")
_JSON: Final = "application/json"
_TEXT: Final = "text/plain; charset=utf-8"
_FILES: Final = {
    "/": ("skope.viewer", "viewer.html", "text/html; charset=utf-8"),
    "/page.css": ("skope.page", "page.css", "text/css; charset=utf-8"),
    "/viewer.css": ("skope.viewer", "viewer.css", "text/css; charset=utf-8"),
    "/viewer.js": ("skope.viewer", "viewer.js", "text/javascript; charset=utf-8"),
}
_HEADERS: Final = {
    # The page asks this server alone, runs its own script alone, and stands in no other page.
    "Content-Security-Policy": "default-src 'none'; img-src data:; style-src 'self'; script-src 'self'; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    # The data may be made anew, and another collection may be shown at the same address tomorrow.
    "Cache-Control": "no-store",
}


def serve(collection: Collection, port: int | None, console: Console) -> None:
    """Show a collection in the browser until Ctrl-C; the address is printed in one line.

    Args:
        collection: What is shown.
        port: Where the server listens; None: `PORT`, or any free one where that is taken.
        console: Where the address is printed.

    Raises:
        UserError: `port` cannot be used.
    """
    documents = Documents(collection)
    if not len(documents):
        raise UserError(f"{collection.title}: has no images")
    with bound(documents, port) as server:
        try:
            console.result(f"{collection.title}: http://{ADDRESS}:{server.server_port}/ (Ctrl-C ends it)")
            server.serve_forever()
        except KeyboardInterrupt:
            console.say("")


def bound(documents: Documents, port: int | None) -> "ViewerServer":
    """A server that listens, on this machine's own address only; see `serve`."""
    try:
        return ViewerServer(documents, PORT if port is None else port)
    except OverflowError:
        raise UserError(f"--port: expected a number from 0 to 65535, got {port}") from None
    except OSError as error:
        if error.errno == errno.EADDRINUSE and port is None:
            return ViewerServer(documents, 0)
        reason = "is taken" if error.errno == errno.EADDRINUSE else f"cannot be used: {error.strerror}"
        raise UserError(f"--port: {port} {reason}; without --port a free one is found") from None


class ViewerServer(ThreadingHTTPServer):
    """The server of a collection's documents; each request has its thread."""

    daemon_threads = True

    def __init__(self, documents: Documents, port: int) -> None:
        self.documents = documents
        self.index = json_bytes(documents.index())
        super().__init__((ADDRESS, port), _Handler)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A browser that goes on before its answer is whole is no error."""
        if not isinstance(sys.exception(), ConnectionError | TimeoutError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    server: ViewerServer
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "skope", ""
    timeout = 60

    def do_GET(self) -> None:
        # A page of another origin whose name leads here ("DNS rebinding") says its own name.
        hosts = self.headers.get_all("Host", [])
        if len(hosts) != 1 or not _HOST.fullmatch(hosts[0].strip()):
            self.send_error(HTTPStatus.FORBIDDEN, "open this server as localhost or 127.0.0.1")
            return
        try:
            answer = self._answer_to(self.path)
        except UserError as error:
            self.send_error(HTTPStatus.NOT_FOUND, str(error))
        else:
            self._send(HTTPStatus.OK, *answer) if answer else self.send_error(HTTPStatus.NOT_FOUND)

    def _answer_to(self, path: str) -> tuple[str, bytes] | None:
        """Media type and content of what a path names; None for any other path."""
        documents = self.server.documents
        if file := _FILES.get(path):
            return file[2], _read(*file[:2])
        if path == "/index.json":
            return _JSON, self.server.index
        if (scores := _SCORES.fullmatch(path)) and int(scores[1]) <= STEPS and documents.has_predictions:
            return _JSON, json_bytes(documents.scores(int(scores[1])))
        if (image := _IMAGE.fullmatch(path)) and (number := int(image[1])) < len(documents):
            if image[2]:
                return _JSON, json_bytes(documents.details(number))
            picture = documents.picture(number)
            return picture.media_type, picture.data
        return None

    def _refuse(self) -> None:
        # What the request brings along is not read, so that nothing else can follow it.
        self.close_connection = True
        self.send_error(HTTPStatus.METHOD_NOT_ALLOWED)

    do_HEAD = do_POST = do_PUT = do_DELETE = do_PATCH = do_OPTIONS = _refuse

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Answer with a line of text, which is also how the base class refuses what is no request at all."""
        self._send(code, _TEXT, (message or HTTPStatus(code).phrase).encode(errors="replace"))

    def _send(self, code: int, media_type: str, data: bytes) -> None:
        self.send_response(code)
        headers = {**_HEADERS, "Content-Type": media_type, "Content-Length": str(len(data))}
        if code == HTTPStatus.METHOD_NOT_ALLOWED:
            headers["Allow"] = "GET"
        if self.close_connection:
            headers["Connection"] = "close"
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(data)

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing: whoever looks at images sees them come."""


@lru_cache
def _read(package: str, name: str) -> bytes:
    return resources.files(package).joinpath(name).read_bytes()
