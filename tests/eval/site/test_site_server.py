"""The server of the page: its own page alone may ask it, and what it saves is refused where it would lose something."""

import json
import tomllib
from collections.abc import Callable
from http.client import HTTPConnection
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skope.eval.site.frames import SiteFrames
from skope.site.site_file import read_site
from tests.eval.site.conftest import CAMERA, PLACES, SIZE, Served, empty_document, marked_points, pixels_of

Serve = Callable[..., Served]


def ask(served: Served, path: str, value: Any = None, **headers: str | None) -> tuple[int, dict[str, str], bytes]:
    """Status, headers and content of an answer; `value` is sent as the page sends it, headers of None are left out."""
    port = served.server.server_port
    connection = HTTPConnection("127.0.0.1", port, timeout=20)
    own = {} if value is None else {"Content-Type": "application/json", "Origin": f"http://127.0.0.1:{port}"}
    given = {name.replace("_", "-"): text for name, text in headers.items()}
    sent = {name: text for name, text in {**own, **given}.items() if text is not None}
    data = None if value is None else json.dumps(value).encode()
    try:
        connection.request("GET" if value is None else "POST", path, data, sent)
        got = connection.getresponse()
        return got.status, dict(got.headers), got.read()
    finally:
        connection.close()


def test_all_that_the_page_asks_for_comes_under_a_strict_policy(serve: Serve) -> None:
    served = serve()
    for path in ("/", "/site.css", "/page.css", "/site.js", "/panel.js", "/begin.json", "/frames/0"):
        status, headers, data = ask(served, path)
        assert status == 200
        assert data
        policy = dict(part.split(" ", 1) for part in headers["Content-Security-Policy"].split("; "))
        assert policy["default-src"] == policy["frame-ancestors"] == policy["form-action"] == "'none'"
        assert policy["script-src"] == policy["style-src"] == policy["connect-src"] == "'self'"
    for path in ("/site_server.py", "/../site.toml", "/frames/1", "/frames/-1", "/site.toml", "/server.py"):
        assert ask(served, path)[0] == 404
    scripts = [ask(served, f"/{name}.js")[2].decode() for name in ("site", "panel", "drawing", "viewport", "kinds")]
    assert not any("innerHTML" in text or "eval(" in text for text in scripts)


@pytest.mark.parametrize(
    "headers",
    [
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Origin": None},
        {"Origin": "http://127.0.0.1:1"},
        {"Host": "evil.example"},
        {"Content_Type": "text/plain"},
        {"Content_Type": "application/x-www-form-urlencoded"},
    ],
)
def test_other_pages_may_send_nothing(serve: Serve, headers: dict[str, str | None]) -> None:
    served = serve()
    document = empty_document(points=marked_points())
    status, _, data = ask(served, "/save", {"document": document, "revision": None}, **headers)
    assert status == 403
    assert len(data) < 100
    assert not served.path.exists()


def test_other_pages_may_not_read_either(serve: Serve) -> None:
    assert ask(serve(), "/begin.json", Origin="http://evil.example")[0] == 403


@pytest.mark.parametrize("value", [[], "x", {"document": 3}, {}, {"document": {"points": 3}, "revision": None}])
def test_what_is_no_document_is_a_line_of_text(serve: Serve, value: Any) -> None:
    status, _, data = ask(serve(), "/save", value)
    assert status == 400
    assert b"expected" in data


def test_more_than_a_page_can_send_is_not_read(serve: Serve) -> None:
    status, _, _ = ask(serve(), "/look", {}, Content_Length=str(1 << 30))
    assert status == 413


def test_a_look_has_camera_residuals_and_errors(serve: Serve) -> None:
    points = marked_points()
    points[3]["pixel"] = [points[3]["pixel"][0] + 30, points[3]["pixel"][1] + 20]
    points[0]["name"] = points[1]["name"]
    document = empty_document(points=points)
    answer = json.loads(ask(serve(), "/look", document)[2])
    assert [(one["kind"], one["index"], one["field"]) for one in answer["problems"]] == [("points", 1, "name")]
    points[0]["name"] = "first"
    answer = json.loads(ask(serve(), "/look", document)[2])
    assert [one["index"] for one in answer["residuals"] if one["left_out"]] == [3]
    assert answer["residuals"][3]["value"] == pytest.approx(36, abs=4)
    figures = {one["name"]: one for one in answer["camera"]["figures"]}
    assert figures["height"]["value"] == pytest.approx(6.5, abs=0.5)
    assert figures["height"]["sigma"] > 0
    errors = answer["errors"]
    assert len(errors["values"]) == errors["columns"] * errors["rows"]
    assert errors["values"][0] is None  # the sky
    assert errors["values"][-1] < 5


def test_a_look_says_where_the_others_put_each_point(serve: Serve) -> None:
    points = marked_points()
    points[2]["pixel"] = [points[2]["pixel"][0] + 3, points[2]["pixel"][1]]
    answer = json.loads(ask(serve(), "/look", empty_document(points=points))[2])
    told = {one["index"]: one["by_others"] for one in answer["residuals"]}
    others = [point for i, point in enumerate(points) if i != 2]
    document = empty_document(points=others)
    (place,) = json.loads(ask(serve(), "/places", {"document": document, "pixels": [points[2]["pixel"]]})[2])["places"]
    assert told[2][0] == pytest.approx(float(np.linalg.norm(place - PLACES[2])), abs=0.02)
    assert 0.1 < told[2][1] < 3
    # Of four points, three are left, which tell no camera.
    answer = json.loads(ask(serve(), "/look", empty_document(points=points[:4]))[2])
    assert [one["by_others"] for one in answer["residuals"]] == [None] * 4


def test_saving_keeps_what_the_page_does_not_know(serve: Serve, tmp_path: Path) -> None:
    path = tmp_path / "site.toml"
    path.write_text(
        '# by hand\nnetwork = "junction.net.xml"  # of the town\ntime_zone = "Europe/Berlin"\n\n'
        '[[gates]]\nname = "north"\nline = [[2, 15], [9, 18]]\ncolour = "red"\n'
    )
    served = serve(path=path)
    begun = json.loads(ask(served, "/begin.json")[2])
    document = begun["document"] | {"points": marked_points()}
    document["gates"][0]["directions"] = ["in", "out"]
    status, _, data = ask(served, "/save", {"document": document, "revision": begun["revision"]})
    assert status == 200, data
    text = path.read_text()
    assert "# by hand" in text
    assert 'colour = "red"' in text
    assert tomllib.loads(text)["network"] == "junction.net.xml"
    site = read_site(path)
    assert site.gates[0].directions == ("in", "out")
    assert site.camera is not None
    assert site.camera.known is not None
    assert np.abs(site.camera.camera.position - CAMERA.position).max() < 0.1
    assert site.calibration is not None
    assert site.calibration.size == SIZE
    assert json.loads(data)["revision"] == site.revision
    again = json.loads(ask(served, "/begin.json")[2])
    assert again["document"]["points"] == document["points"]
    assert again["document"]["gates"] == document["gates"]


def test_a_second_windows_save_is_refused_and_can_be_joined(serve: Serve) -> None:
    served = serve()
    base = json.loads(ask(served, "/begin.json")[2])["document"]
    theirs = base | {"points": marked_points(), "gates": [{"name": "a", "line": [[2, 15], [9, 18]]}]}
    mine = base | {"zones": [{"name": "z", "polygon": [[2, 15], [9, 18], [5, 25]]}]}
    assert ask(served, "/save", {"document": theirs, "revision": None})[0] == 200
    before = served.path.read_bytes()
    status, _, data = ask(served, "/save", {"document": mine, "revision": None})
    assert status == 409
    assert "another window" in json.loads(data)["text"]
    assert served.path.read_bytes() == before
    joined = json.loads(ask(served, "/merge", {"base": base, "mine": mine})[2])
    assert len(joined["document"]["points"]) == 6
    assert ask(served, "/save", {"document": joined["document"], "revision": joined["revision"]})[0] == 200
    site = read_site(served.path)
    assert ([one.name for one in site.gates], [one.name for one in site.zones]) == (["a"], ["z"])


def test_what_is_not_finished_is_not_saved(serve: Serve) -> None:
    served = serve()
    points = marked_points()
    points[4]["place"][1] = None
    status, _, data = ask(served, "/save", {"document": empty_document(points=points), "revision": None})
    assert status == 422
    assert json.loads(data)["text"] == "not saved: points 5: place.y: type it in metres"
    assert not served.path.exists()


def test_files_that_are_loaded_are_named_as_the_user_does(serve: Serve) -> None:
    served = serve()
    rows = "column,row,x,y,z\n" + "".join(
        f"{u},{v},{x},{y},0\n" for (u, v), (x, y) in zip(pixels_of(PLACES).tolist(), PLACES.tolist(), strict=True)
    )
    found = json.loads(ask(served, "/read", {"name": "../../marks.csv", "text": rows})[2])
    assert [point["place"][:2] for point in found["points"]] == PLACES.tolist()
    status, _, data = ask(served, "/read", {"name": "marks.csv", "text": "a,b\n1,2\n"})
    assert status == 400
    assert data.decode().startswith("marks.csv: column column: missing")
    assert ask(served, "/read", {"name": "../x.sh", "text": ""})[0] == 400
    camera = {"width": SIZE[0], "height": SIZE[1], **CAMERA.to_dict()}
    found = json.loads(ask(served, "/read", {"name": "c.json", "text": json.dumps(camera)})[2])
    look = json.loads(ask(served, "/look", empty_document(camera=found["camera"]))[2])
    assert look["camera"]["figures"][1]["value"] == 6.5
    assert look["errors"] is None  # the file does not say how well it is known


def test_an_empty_canvas_has_no_pictures(serve: Serve) -> None:
    served = serve(SiteFrames.canvas((800, 600), "points"), points=marked_points())
    begun = json.loads(ask(served, "/begin.json")[2])
    assert (begun["size"], begun["frames"], len(begun["document"]["points"])) == ([800, 600], 0, 6)
    assert ask(served, "/frames/0")[0] == 404


def test_the_sharpest_frame_is_shown_first(tmp_path: Path) -> None:
    import cv2

    from tests.eval.site.conftest import road_picture

    sharp = road_picture()
    for number in range(5):
        picture = sharp if number == 3 else cv2.GaussianBlur(sharp, (0, 0), 3 + number)
        cv2.imwrite(str(tmp_path / f"{number}.png"), picture)
    frames = SiteFrames.of_footage(str(tmp_path))
    assert (frames.count, frames.size, frames.clearest()) == (5, SIZE, 3)
