"""The server of the page: its own page alone may ask it, and what it saves is refused where it would lose something."""

import base64
import json
import tomllib
from collections.abc import Callable
from datetime import timedelta
from http.client import HTTPConnection
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from skope.errors import UserError
from skope.site.page.inputs import SiteFrames
from skope.site.page.plan import map_places
from skope.site.page.solved_page import SolvedPage
from skope.site.site_file import SiteFile, read_site
from tests.site.page.conftest import CAMERA, PLACES, SIZE, Served, empty_document, marked_points, pixels_of
from tests.waiting import HANG_S

Serve = Callable[..., Served]


def ask(served: Served, path: str, value: Any = None, **headers: str | None) -> tuple[int, dict[str, str], bytes]:
    """Status, headers and content of an answer; `value` is sent as the page sends it, headers of None are left out."""
    port = served.server.server_port
    connection = HTTPConnection("127.0.0.1", port, timeout=HANG_S)
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


def look_at(points: Any, **document: Any) -> dict[str, Any]:
    return dict(SolvedPage(SIZE).look(empty_document(points=points, **document)))


def moved_places(way: Callable[[float, float], tuple[float, float]]) -> list[dict[str, Any]]:
    return [point | {"place": [*way(*point["place"][:2]), 0.0]} for point in marked_points()]


def test_what_is_missing_is_said_point_by_point() -> None:
    points = marked_points(4)
    assert look_at([])["message"].startswith("Mark at least four points")
    assert look_at(points[:1])["message"].startswith("1 of 4 points have positions. Mark three more")
    assert "Mark one more" in look_at(points[:3])["message"]
    points[1]["place"] = [None, None, 0]
    message = look_at(points[:3])["message"]
    assert message.startswith("2 of 4 points have positions. Type x and y of point 2 in metres, then mark one more")
    assert look_at(marked_points(4))["message"] == ""
    known = {"fov_deg": [65.9, 1.0]}  # with the lens known, three points tell a pose
    assert look_at(marked_points(2), known=known)["message"].startswith("2 of 3 points")
    assert look_at(marked_points(3), known=known)["camera"] is not None
    assert look_at(marked_points(3), known={"height_m": [6.5, 0.1]})["message"].startswith("3 of 4 points")


@pytest.mark.parametrize("way", [lambda x, y: (x, -y), lambda x, y: (y, x)])
def test_a_mirrored_plan_is_said_and_has_no_camera(way: Any) -> None:
    answer = look_at(moved_places(way))
    assert answer["camera"] is None
    assert answer["mend"] == "mirrored"
    assert "mirrored" in answer["message"]


def test_a_camera_that_no_road_camera_is_is_rejected() -> None:
    """Lines that are not parallel on the road, on real footage: the solver gave a focal length of 4 763 140 px."""
    lines = [[[105, 336], [109, 242]], [[233, 307], [198, 233]], [[408, 354], [322, 200]], [[547, 356], [405, 232]]]
    look = look_at(
        [],
        parallels=[{"name": "lines", "lines": lines}],
        lengths=[{"name": "length", "pixels": [[233, 307], [211, 262]], "metres": 6.0}],
    )
    assert look["camera"] is None
    assert "which is not plausible" in look["message"]


def test_degrees_in_place_of_metres_are_said_and_taken_as_metres(serve: Serve) -> None:
    # A minute of latitude is a nautical mile of 1852 m at about 45 degrees, within a third of a percent at 50.
    points = moved_places(lambda x, y: (50 + y / 1852 / 60, 8 + x / (1852 * 60 * 0.6428)))
    answer = look_at(points)
    assert (answer["camera"], answer["mend"]) == (None, "degrees")
    pairs = [point["place"][:2] for point in points]
    status, _, data = ask(serve(), "/map-places", {"pairs": pairs, "order": "latitude", "world": None})
    found = json.loads(data)
    assert status == 200
    places = np.array(found["places"])
    apart = np.linalg.norm(places[:, None] - places, axis=-1)
    true = np.linalg.norm(PLACES[:, None] - PLACES, axis=-1)
    assert apart == pytest.approx(true, rel=0.005, abs=0.01)
    assert found["world"]["origin"]["latitude"] == pytest.approx(50.0002, abs=1e-4)


UTM_WORLD = {"origin": {"easting": 389917.833, "northing": 5819690.797}, "utm_zone": "33N"}
"""Its origin is at 52.5162 degrees north, by PROJ."""


@pytest.mark.parametrize(
    ("text", "world", "said"),
    [
        ("52.5163° N, 13.3777° E", None, None),
        ("52,5163; 13,3777", None, None),
        ("52.5163 13.3777", {"origin": {"longitude": 13.3777, "latitude": 52.5162}}, None),
        ("-33.85, 151.21", None, None),
        ("52.5163", None, "like 49.00012"),
        ("95, 13", None, "from -90 to 90"),
        ("13.3777, 52.5163", {"origin": {"longitude": 13.3777, "latitude": 52.5162}}, "is the latitude first?"),
        ("52.5163, 13.3777", UTM_WORLD, None),
        ("53.5163, 13.3777", UTM_WORLD, "is the latitude first?"),
        ("52.5163, 13.3777", {"origin": {"easting": 1.0, "northing": 2.0}}, "type metres"),
    ],
)
def test_a_place_as_maps_give_it(text: str, world: Any, said: str | None) -> None:
    if said is not None:
        with pytest.raises(UserError, match=said):
            map_places({"text": text, "world": world})
        return
    found = map_places({"text": text, "world": world})
    north = 0.0001 * 111_280 if world else 0.0  # metres of a ten-thousandth of a degree at 52.5 degrees
    assert found["places"][0] == pytest.approx([0.0, north], abs=0.02)


def test_a_place_on_a_map_beside_metres_from_elsewhere_is_refused() -> None:
    with pytest.raises(UserError, match="type this one in metres too"):
        map_places({"text": "52.5163, 13.3777", "world": None, "others": True})


def test_a_lens_file_is_kept_as_evidence(serve: Serve) -> None:
    served = serve()
    text = (
        "%YAML:1.0\n---\nimage_width: 1280\nimage_height: 720\ncamera_matrix: !!opencv-matrix\n"
        "   rows: 3\n   cols: 3\n   dt: d\n   data: [ 1000., 0., 639.5, 0., 1000., 359.5, 0., 0., 1. ]\n"
        "distortion_coefficients: !!opencv-matrix\n   rows: 1\n   cols: 4\n   dt: d\n   data: [ -0.1, 0., 0., 0. ]\n"
    )
    found = json.loads(ask(served, "/read", {"name": "lens.yml", "text": text})[2])
    assert "only the lens" in found["said"]
    assert "camera" not in found
    assert found["lens"] == {"focal_px": [500.0, 5.0], "k1": [-0.1, 0.02]}  # of 640 pixels in place of 1280
    begun = json.loads(ask(served, "/begin.json")[2])["document"]
    document = begun | {"points": marked_points(4), "known": {"lens": found["lens"]}}
    assert ask(served, "/save", {"document": document, "revision": None})[0] == 200
    assert json.loads(ask(served, "/begin.json")[2])["document"]["known"] == {"lens": found["lens"]}
    calibration = read_site(served.path).calibration
    assert calibration is not None
    (prior,) = calibration.evidence().priors
    assert np.exp(prior.mean[0]) == pytest.approx(500)
    assert prior.mean[1] == -0.1
    with_lens, without = (
        SolvedPage(SIZE).look(one)["camera"]["figures"][0] for one in (document, document | {"known": {}})
    )
    assert with_lens["sigma"] < 6 < without["sigma"]


def test_a_plan_is_written_beside_the_site_and_opened_again(serve: Serve, tmp_path: Path) -> None:
    served = serve()
    pictures = [cv2.imencode(".png", np.full((40, 60, 3), grey, dtype=np.uint8))[1].tobytes() for grey in (10, 200)]
    held = [
        json.loads(ask(served, "/plan-picture", {"data": base64.b64encode(data).decode()})[2])["picture"]
        for data in pictures
    ]
    assert ask(served, f"/plans/{held[0]}")[2] == pictures[0]
    begun = json.loads(ask(served, "/begin.json")[2])
    plan = {"metres_per_pixel": 0.1, "origin": [-5.0, 40.0], "rotation_deg": 12.5}
    assert [path.name for path in tmp_path.iterdir()] == ["road.png"]  # nothing before it is saved
    (tmp_path / "site_plan.png").write_bytes(b"somebody's own")
    document = begun["document"] | {"plan": plan | {"picture": held[0], "file": "../../evil.png"}}
    status, _, data = ask(served, "/save", {"document": document, "revision": None})
    assert status == 200, data
    assert (tmp_path / "site_plan.png").read_bytes() == b"somebody's own"
    read = read_site(served.path).plan
    assert read is not None
    assert read.file == tmp_path / "site_plan_2.png"
    assert read.file.read_bytes() == pictures[0]
    again = json.loads(ask(serve(path=served.path), "/begin.json")[2])
    assert again["document"]["plan"] == plan | {"picture": held[0]}
    # Where the picture has gone, its name and its scale stay.
    read.file.unlink()
    served = serve(path=served.path)
    gone = json.loads(ask(served, "/begin.json")[2])
    assert gone["document"]["plan"] == plan | {"picture": None}
    moved = gone["document"] | {"plan": gone["document"]["plan"] | {"origin": [0.0, 0.0]}}
    assert ask(served, "/save", {"document": moved, "revision": gone["revision"]})[0] == 200
    kept = read_site(served.path).plan
    assert kept is not None
    assert (kept.file.name, kept.origin) == ("site_plan_2.png", (0.0, 0.0))
    away = moved | {"plan": None}
    revision = json.loads(ask(served, "/begin.json")[2])["revision"]
    assert ask(served, "/save", {"document": away, "revision": revision})[0] == 200
    assert read_site(served.path).plan is None


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"<svg onload=alert(1)>", "PNG, JPEG or WebP"),
        (b"%PDF-1.7", "save its page as PNG"),
        (b"", "PNG, JPEG or WebP"),
    ],
)
def test_what_is_no_picture_is_no_plan(serve: Serve, data: bytes, said: str) -> None:
    status, _, answer = ask(serve(), "/plan-picture", {"data": base64.b64encode(data).decode()})
    assert (status, said in answer.decode()) == (400, True)
    assert ask(serve(), "/plan-picture", {"data": "no base64!"})[0] == 400


@pytest.mark.parametrize(
    ("time_zone", "start", "wrong"),
    [
        ("Europe/Berlin", "2026-11-26 10:00", {}),
        (None, "2026-11-26T10:00:00+05:30", {}),
        ("Berlin", "2026-11-26 10:00", {"time_zone": "Europe/Berlin"}),
        ("../../etc/passwd", None, {"time_zone": "Europe/Berlin"}),
        ("Europe/Berlin", "ten o'clock", {"start": "2026-11-26 10:00:00"}),
        (None, "2026-11-26 10:00", {"start": "time zone"}),
        ("Europe/Berlin", "2026-03-29 02:30", {"start": "no such time"}),
        ("Europe/Berlin", "2026-10-25 02:30", {"start": "2026-10-25 02:30:00+02:00 or 2026-10-25 02:30:00+01:00"}),
    ],
)
def test_time_zone_and_start_of_the_footage(
    serve: Serve, time_zone: str | None, start: str | None, wrong: dict[str, str]
) -> None:
    served = serve()
    begun = json.loads(ask(served, "/begin.json")[2])
    document = begun["document"] | {"time_zone": time_zone, "start": start}
    problems = json.loads(ask(served, "/look", document)[2])["problems"]
    assert {one["field"] for one in problems} == set(wrong)
    assert all(wrong[one["field"]] in one["text"] for one in problems)
    status = ask(served, "/save", {"document": document, "revision": None})[0]
    assert status == (422 if wrong else 200)
    if wrong:
        return
    site = read_site(served.path)
    assert start is not None
    assert site.start is not None
    assert site.start.replace(tzinfo=None).isoformat() == "2026-11-26T10:00:00"
    assert site.start.utcoffset() == timedelta(hours=1 if time_zone else 5.5)
    again = json.loads(ask(served, "/begin.json")[2])["document"]
    assert again["time_zone"] == time_zone
    assert again["start"].startswith("2026-11-26 10:00:00" if time_zone else "2026-11-26 10:00:00+05:30")


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


GATES = f"""
[[gates]]
name = "drawn"
pixels = [[100, 300], [500, 250]]
size = [{SIZE[0]}, {SIZE[1]}]
edges = ["a", "b"]

[[gates]]
name = "survey"
line = [[2, 15], [9, 18]]
"""


def saved_again(served: Served, **changes: Any) -> SiteFile:
    """Open the page's document, change lists of it, save it, and read the file."""
    begun = json.loads(ask(served, "/begin.json")[2])
    sent = {"document": begun["document"] | changes, "revision": begun["revision"]}
    status, _, data = ask(served, "/save", sent)
    assert status == 200, data
    return read_site(served.path)


def test_gates_in_the_image_get_a_line_from_the_camera_and_keep_their_pixels(serve: Serve, tmp_path: Path) -> None:
    path = tmp_path / "site.toml"
    path.write_text(GATES)
    served = serve(path=path)
    assert [bool(gate.line) for gate in saved_again(served).gates] == [False, True]
    drawn, survey = saved_again(served, points=marked_points()).gates
    assert np.array(drawn.pixels).tolist() == [[100, 300], [500, 250]]
    assert list(drawn.edges or ()) == ["a", "b"]
    assert np.abs(pixels_of(drawn.line) - drawn.pixels).max() < 2
    assert np.array(survey.line).tolist() == [[2, 15], [9, 18]]
    assert (len(survey.pixels), survey.size) == (0, None)
    # The camera is calibrated again: all places were counted from 3 m farther west.
    moved = [point | {"place": [point["place"][0] + 3, *point["place"][1:]]} for point in marked_points()]
    again, same = saved_again(served, points=moved).gates
    assert again.pixels == drawn.pixels
    assert np.array(again.line) == pytest.approx(np.array(drawn.line) + [3, 0], abs=0.02)
    assert same.line == survey.line
    # An end above the horizon is nowhere on the road: the gate counts in the image alone.
    document = json.loads(ask(served, "/begin.json")[2])["document"]
    document["gates"][0]["pixels"][1] = [500, 2]
    (warned,) = json.loads(ask(served, "/look", document)[2])["shapes"][0]["warnings"]
    assert "above the horizon" in warned
    assert saved_again(served, gates=document["gates"]).gates[0].line == ()


def test_a_gate_in_the_image_has_its_line_where_the_camera_is_written_by_hand(tmp_path: Path) -> None:
    path = tmp_path / "site.toml"
    pixels = (2 * pixels_of([[2, 15], [9, 18]])).round(2).tolist()
    gate = f'[[gates]]\nname = "g"\npixels = {pixels}\nsize = [{2 * SIZE[0]}, {2 * SIZE[1]}]\n'
    camera = {"width": SIZE[0], "height": SIZE[1], **CAMERA.to_dict()}
    (tmp_path / "camera.json").write_text(json.dumps(camera))
    path.write_text(gate)
    assert read_site(path).gates[0].line == ()
    path.write_text(gate + '[camera]\nfile = "camera.json"\n')
    assert np.array(read_site(path).gates[0].line) == pytest.approx(np.array([[2, 15], [9, 18]]), abs=0.01)
    path.write_text(path.read_text().replace(f"{2 * SIZE[1]}]", "960]"))  # of another aspect ratio: nowhere
    assert read_site(path).gates[0].line == ()


@pytest.mark.parametrize("size", [(1280, 720), (320, 181)])
def test_gates_of_another_image_size_are_scaled(serve: Serve, tmp_path: Path, size: tuple[int, int]) -> None:
    path = tmp_path / "site.toml"
    x, y = size[0] / SIZE[0], size[1] / SIZE[1]
    path.write_text(
        f'[[gates]]\nname = "g"\npixels = [[{100 * x}, {300 * y}], [{500 * x}, {250 * y}]]\nsize = {list(size)}\n'
    )
    gate = saved_again(serve(path=path)).gates[0]
    assert gate.size == SIZE
    assert np.array(gate.pixels) == pytest.approx(np.array([[100, 300], [500, 250]]))


def test_gates_of_another_aspect_ratio_are_a_problem_and_not_drawn(serve: Serve, tmp_path: Path) -> None:
    path = tmp_path / "site.toml"
    path.write_text('[[gates]]\nname = "g"\npixels = [[100, 300], [500, 250]]\nsize = [640, 480]\n')
    served, before = serve(path=path), path.read_bytes()
    begun = json.loads(ask(served, "/begin.json")[2])
    look = json.loads(ask(served, "/look", begun["document"])[2])
    (problem,) = look["problems"]
    assert (problem["kind"], problem["field"]) == ("gates", "pixels")
    assert problem["text"] == "was drawn in an image of 640x480; this footage is 640x360: delete it and draw it again"
    assert look["shapes"] == []
    assert ask(served, "/save", {"document": begun["document"], "revision": begun["revision"]})[0] == 422
    assert path.read_bytes() == before


def test_a_renamed_gate_in_the_image_keeps_its_other_keys(serve: Serve, tmp_path: Path) -> None:
    path = tmp_path / "site.toml"
    path.write_text(GATES)
    served = serve(path=path)
    gates = json.loads(ask(served, "/begin.json")[2])["document"]["gates"]
    gates[0]["name"] = "renamed"
    gate = saved_again(served, gates=gates).gates[0]
    assert (gate.name, gate.edges) == ("renamed", ("a", "b"))


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
    assert found["said"] == ""
    large = CAMERA.resized((1280, 720))
    camera = {"width": 1280, "height": 720, **large.to_dict()}
    found = json.loads(ask(served, "/read", {"name": "c.json", "text": json.dumps(camera)})[2])
    assert found["said"] == "c.json: camera of 1280x720, scaled to the 640x360 of the footage"
    status, _, data = ask(served, "/read", {"name": "c.json", "text": json.dumps(camera | {"height": 900})})
    assert (status, data.decode()) == (
        400, "c.json: image size: expected the aspect ratio of the footage, 640x360, got 1280x900"
    )  # fmt: skip


def test_an_empty_canvas_has_no_pictures(serve: Serve) -> None:
    served = serve(SiteFrames.canvas((800, 600), "points"), points=marked_points())
    begun = json.loads(ask(served, "/begin.json")[2])
    assert (begun["size"], begun["frames"], len(begun["document"]["points"])) == ([800, 600], 0, 6)
    assert ask(served, "/frames/0")[0] == 404


def test_the_sharpest_frame_is_shown_first(tmp_path: Path) -> None:
    import cv2

    from tests.site.page.conftest import road_picture

    sharp = road_picture()
    for number in range(5):
        picture = sharp if number == 3 else cv2.GaussianBlur(sharp, (0, 0), 3 + number)
        cv2.imwrite(str(tmp_path / f"{number}.png"), picture)
    frames = SiteFrames.of_footage(str(tmp_path))
    assert (frames.count, frames.size, frames.clearest()) == (5, SIZE, 3)
