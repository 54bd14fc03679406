"""Local web server for the pages of this package.

It listens on the loopback address only. It rejects requests under another host name or from another page, and sends a
content security policy that keeps the page from contacting other hosts.
"""

import errno
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from typing import Any, Final, TypeVar

from skope.errors import UserError
from skope.page.templates import render
from skope.terminal.console import Console

LOCAL_ADDRESS: Final = "127.0.0.1"


@dataclass(frozen=True)
class ServerLimits:
    """Port and largest request of a local server."""

    port: int = 8033
    """Port that is used if it is free."""
    request_bytes: int = 1 << 25
    """Maximum size of a request, bytes."""


SERVER_LIMITS: Final = ServerLimits()

JSON_TYPE: Final = "application/json"
TEXT_TYPE: Final = "text/plain; charset=utf-8"
HTML_TYPE: Final = "text/html; charset=utf-8"
CSS_TYPE: Final = "text/css; charset=utf-8"
SCRIPT_TYPE: Final = "text/javascript; charset=utf-8"
SHARED_FILES: Final = {
    "/page.css": ("skope.page", "page.css", CSS_TYPE),
    "/dom.js": ("skope.page", "dom.js", SCRIPT_TYPE),
    "/viewport.js": ("skope.page", "viewport.js", SCRIPT_TYPE),
}
"""Files that every page has: path -> package, name and media type."""
LOCAL_HOST: Final = re.compile(r"(localhost|127\.0\.0\.1|\[::1\])(:[0-9]{1,5})?", re.IGNORECASE)
SAFE_HEADERS: Final = {
    # The page contacts only this server, runs only its own script, and is not embedded in other pages.
    "Content-Security-Policy": "default-src 'none'; img-src data:; style-src 'self'; script-src 'self'; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    # The data may change, and another page may be shown at the same address tomorrow.
    "Cache-Control": "no-store",
}

Answer = tuple[str, bytes]
"""Media type and content."""
S = TypeVar("S", bound="LocalServer")


class LocalServer(ThreadingHTTPServer):
    """Server that listens on this machine's own address, with a thread per request."""

    daemon_threads = True

    def __init__(self, port: int, handler: "type[LocalHandler]") -> None:
        super().__init__((LOCAL_ADDRESS, port), handler)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore connections that the browser closed before the answer was complete."""
        if not isinstance(sys.exception(), ConnectionError | TimeoutError):
            super().handle_error(request, client_address)


class LocalHandler(BaseHTTPRequestHandler):
    """Request handler for the paths that `answer_to` and, if permitted, `answer_to_post` know."""

    posts = False
    """Whether requests may contain data."""
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "skope", ""
    timeout = 60

    def answer_to(self, path: str) -> Answer | None:
        """Return media type and content for a path; None for an unknown path."""
        raise NotImplementedError

    def answer_to_post(self, path: str, data: bytes) -> tuple[int, str, bytes] | None:
        """Return status, media type and content of the answer to data sent to a path; None for an unknown path."""
        raise NotImplementedError

    def do_GET(self) -> None:
        if not self._is_same_origin():
            return
        try:
            answer = self.answer_to(self.path)
        except UserError as error:
            self.send_error(HTTPStatus.NOT_FOUND, str(error))
        else:
            self._send(HTTPStatus.OK, *answer) if answer else self.send_error(HTTPStatus.NOT_FOUND)

    def do_POST(self) -> None:
        if not self.posts:
            self._refuse()
            return
        length = self.headers.get("Content-Length", "")
        # No other request can follow until the data is read.
        self.close_connection, kept_open = True, not self.close_connection
        if not self._is_same_origin():
            return
        # Forms of other pages cannot send this type, and always state their own origin.
        if self.headers.get("Origin") is None or self.headers.get("Content-Type") != JSON_TYPE:
            self.send_error(HTTPStatus.FORBIDDEN, "is for this server's own page")
            return
        if (
            not re.fullmatch("[0-9]{1,9}", length)
            or int(length) > SERVER_LIMITS.request_bytes
            or "Transfer-Encoding" in self.headers
        ):
            self.send_error(
                HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"expected at most {SERVER_LIMITS.request_bytes >> 20} MB"
            )
            return
        data = self.rfile.read(int(length))
        self.close_connection = not kept_open
        try:
            answer = self.answer_to_post(self.path, data)
        except UserError as error:
            self.send_error(HTTPStatus.BAD_REQUEST, str(error))
        else:
            self._send(*answer) if answer else self.send_error(HTTPStatus.NOT_FOUND)

    def _is_same_origin(self) -> bool:
        """Return whether a request has this server's name and comes from no other page; otherwise send an error."""
        # A page of another origin that resolves to this address ("DNS rebinding") sends its own host name.
        hosts = self.headers.get_all("Host", [])
        if len(hosts) != 1 or not LOCAL_HOST.fullmatch(hosts[0].strip()):
            self.send_error(HTTPStatus.FORBIDDEN, "open this server as localhost or 127.0.0.1")
            return False
        origins = self.headers.get_all("Origin", [])
        if any(origin.strip().lower() != f"http://{hosts[0].strip().lower()}" for origin in origins):
            self.send_error(HTTPStatus.FORBIDDEN, "other pages may not ask this server")
            return False
        return True

    def _refuse(self) -> None:
        # The data is not read, so that no other request can follow it.
        self.close_connection = True
        self.send_error(HTTPStatus.METHOD_NOT_ALLOWED)

    do_HEAD = do_PUT = do_DELETE = do_PATCH = do_OPTIONS = _refuse

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Answer with one line of text. The base class calls this for malformed requests, too.

        Args:
            code: HTTP status.
            message: The line; None for the name of the status.
            explain: Ignored; part of the interface of the base class.
        """
        self._send(code, TEXT_TYPE, (message or HTTPStatus(code).phrase).encode(errors="replace"))

    def _send(self, code: int, media_type: str, data: bytes) -> None:
        self.send_response(code)
        headers = {**SAFE_HEADERS, "Content-Type": media_type, "Content-Length": str(len(data))}
        if code == HTTPStatus.METHOD_NOT_ALLOWED:
            headers["Allow"] = "GET, POST" if self.posts else "GET"
        if self.close_connection:
            headers["Connection"] = "close"
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(data)

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing."""


def bound_to(make: Callable[[int], S], port: int | None) -> S:
    """Return the server that `make` creates for a port.

    Args:
        make: Function that creates the server.
        port: Port; None: `SERVER_LIMITS.port`, or any free port if that is in use.

    Raises:
        UserError: `port` cannot be used.
    """
    try:
        return make(SERVER_LIMITS.port if port is None else port)
    except OverflowError:
        raise UserError(f"--port: expected a number from 0 to 65535, got {port}") from None
    except OSError as error:
        if error.errno == errno.EADDRINUSE and port is None:
            return make(0)
        reason = "is taken" if error.errno == errno.EADDRINUSE else f"cannot be used: {error.strerror}"
        raise UserError(f"--port: {port} {reason}; without --port a free one is found") from None


def serve_until_stopped(server: LocalServer, title: str, console: Console) -> None:
    """Serve until Ctrl-C; title and address are printed on one line.

    Args:
        server: The server, which is closed at the end.
        title: Description of the served page.
        console: Prints the line.
    """
    with server:
        try:
            console.result(f"{title}: http://{LOCAL_ADDRESS}:{server.server_port}/ (Ctrl-C ends it)")
            server.serve_forever()
        except KeyboardInterrupt:
            console.say("")


@lru_cache
def served_page(template: str, name: str) -> bytes:
    """Return a page from its template.

    Args:
        template: Path of the template below skope/.
        name: Name of its style and script.
    """
    return render(template, title=f"skope {name}", name=name).encode()


@lru_cache
def read_resource(package: str, name: str) -> bytes:
    """Return the content of a file of the package."""
    return resources.files(package).joinpath(name).read_bytes()
