"""The server gives its page, JSON and pictures to this machine's browser, and nothing to anyone else."""

import json
import signal
import socket
from collections.abc import Callable
from dataclasses import replace
from http.client import HTTPConnection, HTTPResponse
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from skope.viewer import local_server
from skope.viewer.collection import Collection, read_picture
from skope.viewer.documents import Documents
from skope.viewer.server import bound
from tests.html_page import Page
from tests.local_page import begun
from tests.viewer.conftest import HOSTILE
from tests.waiting import HANG_S

Serve = Callable[[Collection], int]


def answer(port: int, path: str, method: str = "GET", **headers: str) -> tuple[HTTPResponse, bytes]:
    connection = HTTPConnection("127.0.0.1", port, timeout=HANG_S)
    try:
        connection.request(method, path, headers=headers)
        got = connection.getresponse()
        return got, got.read()
    finally:
        connection.close()


def raw(port: int, request: bytes) -> bytes:
    """Everything that the server answers to some bytes."""
    with socket.create_connection(("127.0.0.1", port), timeout=HANG_S) as line:
        line.sendall(request)
        line.shutdown(socket.SHUT_WR)
        return b"".join(iter(lambda: line.recv(65536), b""))


@pytest.mark.parametrize(
    ("path", "kind"),
    [
        ("/", "text/html; charset=utf-8"),
        ("/page.css", "text/css; charset=utf-8"),
        ("/viewer.css", "text/css; charset=utf-8"),
        ("/viewer.js", "text/javascript; charset=utf-8"),
        ("/index.json", "application/json"),
        ("/images/0.json", "application/json"),
        ("/images/3", "image/png"),
        ("/scores/900.json", "application/json"),
    ],
)
def test_everything_comes_with_its_type_and_a_strict_policy(
    served: Serve, predicted: Collection, path: str, kind: str
) -> None:
    got, data = answer(served(predicted), path)
    assert (got.status, got.headers["Content-Type"]) == (200, kind)
    assert data
    policy = dict(part.split(" ", 1) for part in got.headers["Content-Security-Policy"].split("; "))
    assert policy["default-src"] == policy["frame-ancestors"] == policy["base-uri"] == "'none'"
    assert policy["script-src"] == policy["style-src"] == policy["connect-src"] == "'self'"
    assert policy["img-src"] == "data:"
    assert got.headers["X-Content-Type-Options"] == "nosniff"
    assert got.headers["Cross-Origin-Resource-Policy"] == "same-origin"
    assert "Access-Control-Allow-Origin" not in got.headers
    assert "Python" not in got.headers["Server"]


def test_the_page_asks_nobody_else(served: Serve, labelled: Collection) -> None:
    port = served(labelled)
    page = Page(answer(port, "/")[1].decode().replace("<!doctype html>", ""))
    addresses = [a.get(name) for _, a in page.elements for name in ("src", "href") if a.get(name)]
    assert sorted(map(str, addresses)) == ["/page.css", "/viewer.css", "/viewer.js", "data:,"]
    for path in ("/page.css", "/viewer.css", "/viewer.js"):
        text = answer(port, path)[1].decode().replace("http://www.w3.org/2000/svg", "")
        assert "://" not in text
        assert "@import" not in text
    assert "innerHTML" not in answer(port, "/viewer.js")[1].decode()


@pytest.mark.parametrize("host", ["localhost", "LOCALHOST:8033", "127.0.0.1", "127.0.0.1:9", "[::1]:8033"])
def test_this_machine_may_ask(served: Serve, labelled: Collection, host: str) -> None:
    assert answer(served(labelled), "/index.json", Host=host)[0].status == 200


@pytest.mark.parametrize(
    "host",
    [
        "evil.example",
        "evil.example:8033",
        "127.0.0.1.evil.example",
        "localhost.evil.example",
        "127.0.0.1@evil",
        "",
        "0.0.0.0",
    ],
)
@pytest.mark.parametrize("path", ["/", "/index.json", "/images/0"])
def test_a_page_that_came_by_another_name_is_refused(served: Serve, labelled: Collection, host: str, path: str) -> None:
    got, data = answer(served(labelled), path, Host=host)
    assert got.status == 403
    assert b"localhost" in data
    assert len(data) < 100


@pytest.mark.parametrize("hosts", [b"", b"Host: localhost\r\nHost: evil.example\r\n"])
def test_a_request_says_one_host(served: Serve, labelled: Collection, hosts: bytes) -> None:
    told = raw(served(labelled), b"GET /index.json HTTP/1.1\r\n" + hosts + b"\r\n")
    assert told.split()[1] == b"403"
    assert b"names" not in told


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "PATCH", "OPTIONS", "HEAD"])
def test_nothing_but_get(served: Serve, labelled: Collection, method: str) -> None:
    got, data = answer(served(labelled), "/", method)
    assert (got.status, got.headers["Allow"]) == (405, "GET")
    assert len(data) < 100


def test_what_a_refused_request_brings_is_no_request_of_its_own(served: Serve, labelled: Collection) -> None:
    inside = b"GET /index.json HTTP/1.1\r\nHost: localhost\r\n\r\n"
    head = b"POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: %d\r\n\r\n" % len(inside)
    assert raw(served(labelled), head + inside).count(b"HTTP/1.1") == 1


@pytest.mark.parametrize(
    "path",
    [
        "/images/4", "/images/4.json", "/images/-1", "/images/", "/images/٣", "/images/0/../../data/dataset.json",
        "/../../etc/passwd", "//etc/passwd", "/images/../annotations/easy.json", "/images/%2e%2e/dataset.json",
        "/images/site/00_000001.png", "/viewer.py", "/server.py", "/viewer.html", "/images/0?x=1", "/scores/900.json",
        "/images/99999999999999999999", "http://localhost/index.json",
    ],
)  # fmt: skip
def test_pictures_have_numbers_and_no_paths(served: Serve, labelled: Collection, path: str) -> None:
    told = raw(served(labelled), b"GET " + path.encode() + b" HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
    assert told.split()[1] == b"404"
    assert b"root:" not in told


@pytest.mark.parametrize(
    "request_", [b"\0\xff\r\n\r\n", b"GET\r\n\r\n", b"GET / HTTP/9\r\n\r\n", b"GET /" + b"a" * 70_000]
)
def test_what_is_no_request_gets_a_line_and_the_server_goes_on(
    served: Serve, labelled: Collection, request_: bytes, capfd: pytest.CaptureFixture[str]
) -> None:
    port = served(labelled)
    raw(port, request_)
    assert answer(port, "/index.json")[0].status == 200
    assert capfd.readouterr().err == ""


def test_a_browser_that_goes_on_before_its_answer_is_whole_is_no_error(
    served: Serve, labelled: Collection, capfd: pytest.CaptureFixture[str]
) -> None:
    port = served(labelled)
    for _ in range(20):
        with socket.create_connection(("127.0.0.1", port)) as line:
            line.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")  # close by a reset
            line.sendall(b"GET /images/0 HTTP/1.1\r\nHost: localhost\r\n\r\n" * 20)
    assert answer(port, "/")[0].status == 200
    assert capfd.readouterr().err == ""


def test_names_are_text_wherever_they_come_from(served: Serve, labelled: Collection) -> None:
    port = served(labelled)
    got, data = answer(port, "/index.json")
    assert json.loads(data)["title"] == f"data {HOSTILE}"
    assert got.headers["Content-Type"] == "application/json"
    assert b"onerror" not in answer(port, "/")[1]


def test_a_picture_that_cannot_be_read_is_a_line_that_names_it(
    served: Serve, labelled: Collection, tmp_path: Path
) -> None:
    images = tmp_path / "data/images/site"
    (images / "00_000001.png").unlink()
    (images / "00_000002.png").unlink()
    (images / "00_000002.png").mkdir()
    port = served(labelled)
    for number, words in ((0, "00_000001.png: no such file"), (1, "00_000002.png: cannot be read: Is a directory")):
        got, data = answer(port, f"/images/{number}")
        assert (got.status, got.headers["Content-Type"]) == (404, "text/plain; charset=utf-8")
        assert data.decode().endswith(words)
    assert answer(port, "/images/0.json")[0].status == 200


def test_images_that_no_browser_shows_come_as_jpeg(tmp_path: Path) -> None:
    pixels = np.full((20, 30, 3), (200, 40, 10), dtype=np.uint8)
    for name in ("a.tiff", "a.ppm"):
        cv2.imwrite(str(tmp_path / name), cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR))
        picture = read_picture(tmp_path / name)
        assert picture.media_type == "image/jpeg"
        back = cv2.imdecode(np.frombuffer(picture.data, np.uint8), cv2.IMREAD_COLOR_RGB)
        assert np.abs(back.astype(int) - pixels).max() < 8
    (tmp_path / "a.txt").write_text("secret")
    with pytest.raises(ValueError, match=r"a\.txt: not an image"):
        read_picture(tmp_path / "a.txt")


# ------------------------------------------------------------------------------------------------------------- ports


def test_it_listens_to_this_machine_alone(labelled: Collection) -> None:
    with bound(Documents(labelled), 0) as listening:
        assert listening.server_address[0] == "127.0.0.1"


def test_another_port_is_found_where_the_usual_one_is_taken(
    labelled: Collection, monkeypatch: pytest.MonkeyPatch
) -> None:
    documents = Documents(labelled)
    with bound(documents, 0) as first:
        monkeypatch.setattr(local_server, "SERVER_LIMITS", replace(local_server.SERVER_LIMITS, port=first.server_port))
        with bound(documents, None) as second:
            assert second.server_port not in (0, first.server_port)


@pytest.mark.parametrize("command", [("gen", "view"), ("gen", "view", "--split", "easy")])
def test_wrong_ports_are_one_line(skope: Any, dataset: Path, command: tuple[str, ...]) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        said = f"skope: --port: {port} is taken; without --port a free one is found\n"
        assert skope(*command, dataset, "--port", port, "-q") == (2, "", said)
    said = "skope: --port: expected a number from 0 to 65535, got 70000\n"
    assert skope(*command, dataset, "--port", 70000, "-q") == (2, "", said)


# ------------------------------------------------------------------------------------------------------- the command


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["gone"], "gone: no such dataset folder"),
        (["roads", "--split", "night"], "roads: no split 'night'; there are: easy, train"),
    ],
)
def test_what_is_no_dataset_is_refused(skope: Any, dataset: Path, words: list[str], said: str) -> None:
    code, out, error = skope("gen", "view", *words, "-q")
    assert (code, out, error.count("\n")) == (2, "", 1)
    assert error.startswith(f"skope: {said}")


def test_a_dataset_without_images_is_refused(skope: Any, dataset: Path) -> None:
    path = dataset / "annotations/easy.json"
    document = json.loads(path.read_text())
    path.write_text(json.dumps({**document, "images": [], "annotations": []}))
    assert skope("gen", "view", dataset, "--split", "easy", "-q") == (2, "", "skope: roads (easy): has no images\n")


def test_ctrl_c_ends_it_quietly(dataset: Path) -> None:
    process, line = begun("gen", "view", str(dataset), "--split", "easy,train")
    assert line.startswith("roads (easy, train): http://127.0.0.1:")
    port = int(line.rsplit(":", 1)[1].split("/")[0])
    assert json.loads(answer(port, "/index.json")[1])["names"]
    process.send_signal(signal.SIGINT)
    out, error = process.communicate(timeout=HANG_S)
    assert (process.returncode, out, error) == (0, "", "")
