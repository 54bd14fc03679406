"""The whole walk in a browser: by mouse, by keyboard, by touch at a phone's width; two windows; hostile names."""

import json
import re
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from skope.camera.calibrate import SiteCalibration, calibrate
from skope.camera.evidence import Evidence
from skope.site.page.inputs import SiteFrames
from skope.site.page.overlays import overlays
from skope.site.site_file import SiteFile, read_site
from tests.site.page.conftest import CAMERA, PLACES, SIZE, Served, SitePage, marked_points, pixels_of, road_picture
from tests.waiting import HANG_S

HOSTILE = "<img src=x onerror=alert(1)>\"'&"

LOUPE = (
    "(() => { const b = document.getElementById('loupe').getBoundingClientRect();"
    " return [b.left, b.top, b.right, b.bottom]; })()"
)

Open = Callable[..., SitePage]


def mark_all(page: SitePage, count: int = 6) -> None:
    """Mark the crosses of the road by mouse, and type their places."""
    page.tool("points")
    for i, (pixel, place) in enumerate(zip(pixels_of(PLACES[:count]), PLACES[:count], strict=True)):
        page.click(pixel)
        page.type(str(place[0]))  # the field has the focus
        page.type(str(place[1]).replace(".", ","))
        assert page.count(".points circle.handle") == i + 1
    page.settle()


def test_by_mouse_from_the_first_point_to_a_saved_site(open_page: Open) -> None:
    page = open_page()
    assert "mark points with known positions" in page.text("#steps")
    mark_all(page)
    assert page.text("#message") == ""
    assert page.text("#hint").startswith("Where grid and boxes lie on the road")
    assert page.text("#figures-summary").startswith("6.")
    assert not page.browser.run("document.getElementById('legend').hidden")
    # A point that was marked wrongly is seen, and mended by dragging it.
    begin, wrong = pixels_of(PLACES[2:3])[0], pixels_of(PLACES[2:3])[0] + [40, 25]
    page.tool("select")
    page.drag(page.screen(begin), page.screen(wrong))
    page.settle()
    assert "left out" in page.text("#marks .bad")
    page.drag(page.screen(wrong), page.screen(begin))
    page.settle()
    assert page.count("#marks .bad") == 0
    page.tool("gates")
    for pixel in pixels_of([[2, 15], [9, 18]]):
        page.click(pixel)
    page.settle()
    page.fill("gates:0:name", f"north {HOSTILE}")
    page.fill("gates:0:directions.0", "to the station")
    page.fill("gates:0:directions.1", "to the bridge")
    page.tool("lanes")
    for pixel in pixels_of([[5, 8], [6, 14], [8, 30]]):
        page.click(pixel)
    page.press("Enter")
    page.settle()
    page.tool("zones")
    for pixel in pixels_of([[3, 10], [9, 12], [8, 20]]):
        page.click(pixel)
    page.browser.run("document.getElementById('finish').click()")
    page.settle()
    page.browser.run("document.getElementById('undo').click()")
    page.settle()
    assert page.count(".zones path.shape") == 0
    assert "to the station" in page.text("#drawing .gates")
    page.browser.run("document.getElementById('save').click()")
    page.browser.until("document.getElementById('state').textContent === 'saved'")
    site = read_site(page.served.path)
    assert site.gates[0].name == f"north {HOSTILE}"
    assert site.gates[0].directions == ("to the station", "to the bridge")
    assert np.abs(np.array(site.gates[0].line) - [[2, 15], [9, 18]]).max() < 1.0
    assert len(site.lanes[0].line) == 3
    assert site.zones == ()
    assert site.camera is not None
    assert np.abs(site.camera.camera.position - CAMERA.position).max() < 0.7
    again = open_page(page.served)
    again.settle()
    assert again.count(".points circle.handle") == 6
    assert f"north {HOSTILE}" in again.text("#road")
    assert again.text("#state") == "saved"


def test_what_comes_after_saving_and_labels_that_can_be_read(
    serve: Callable[..., Served], open_page: Open, image: Path, tmp_path: Path
) -> None:
    footage = tmp_path / "two frames"
    footage.mkdir()
    for name in ("a.png", "b.png"):
        (footage / name).write_bytes(image.read_bytes())
    gates = [
        {"name": name, "line": [[2.0 + k, 15.0], [9.0, 18.0 + k]], "directions": ["in", "out"]}
        for k, name in enumerate(["north", "north as well", "east"])
    ]
    served = serve(SiteFrames.of_footage(str(footage)), points=marked_points(), gates=gates)
    page = open_page(served)
    assert page.text("#then") == ""
    page.browser.run("document.getElementById('save').click()")
    page.browser.until("document.getElementById('state').textContent === 'saved'")
    page.settle()
    command = f"skope eval traffic '{footage}' --site {served.path}"
    assert page.text("#then") == f"Saved. To count and measure: {command}"
    boxes = page.browser.run(
        "[...document.querySelectorAll('#drawing > .gates text')].map((e) => e.getBBox())"
        ".map((b) => [b.x, b.y, b.x + b.width, b.y + b.height])"
    )
    assert len(boxes) >= 3
    for i, one in enumerate(boxes):
        for other in boxes[:i]:
            across = min(one[2], other[2]) - max(one[0], other[0])
            down = min(one[3], other[3]) - max(one[1], other[1])
            assert across < 3 or down < 5, (one, other)


def test_by_keyboard_alone(open_page: Open) -> None:
    page = open_page()
    run = page.browser.run
    page.press("p")
    for i, (pixel, place) in enumerate(zip(np.rint(pixels_of(PLACES)), PLACES, strict=True)):
        run("document.getElementById('stage').focus()")
        page.press("ArrowRight")  # the cross-hair, in the middle
        off = (pixel - [SIZE[0] / 2, SIZE[1] / 2]).astype(int)
        for amount, ways in zip(off.tolist(), (("ArrowLeft", "ArrowRight"), ("ArrowUp", "ArrowDown")), strict=True):
            page.press(ways[amount > 0], shift=True, times=abs(amount) // 10)
            page.press(ways[amount > 0], times=abs(amount) % 10)
        page.press("Enter")
        page.type(str(place[0]))
        page.type(str(place[1]))
        page.press("Escape")  # back to the picture
        assert run("document.activeElement.id") == "stage"
        assert page.count(".points circle.handle") == i + 1
    page.settle()
    assert page.text("#figures-summary").startswith("6.")
    # Tab leads into the picture's marks, whose arrow keys move them; typed pixels do the same.
    page.press("Tab")
    handle = run("document.activeElement.dataset.handle")
    assert handle is not None, run("document.activeElement.outerHTML.slice(0, 300)")
    kind, index, _ = handle.split(":")
    page.settle()
    before = float(run(f"document.querySelector('[data-focus=\"{kind}:{index}:pixel.0\"]').value"))
    page.press("ArrowRight", times=3)
    page.settle()
    assert run("document.activeElement.dataset.handle") == handle
    after = float(run(f"document.querySelector('[data-focus=\"{kind}:{index}:pixel.0\"]').value"))
    assert after == pytest.approx(before + 3)
    page.press("z", ctrl=True)
    page.settle()
    assert float(run(f"document.querySelector('[data-focus=\"{kind}:{index}:pixel.0\"]').value")) == before
    page.fill(f"{kind}:{index}:pixel.0", str(before + 0.25))
    page.settle()
    page.press("Escape")
    page.press("g")
    for right, down in ((-4, 3), (9, -1)):
        page.press("ArrowRight")
        page.press("ArrowRight" if right > 0 else "ArrowLeft", shift=True, times=abs(right))
        page.press("ArrowDown" if down > 0 else "ArrowUp", shift=True, times=abs(down))
        page.press("Enter")
    page.settle()
    assert page.count("#road > .gates") == 1
    page.press("Escape")
    page.press("s", ctrl=True)
    page.browser.until("document.getElementById('state').textContent === 'saved'")
    assert len(read_site(page.served.path).gates) == 1
    page.press("Delete")
    page.settle()
    assert page.count("#road > .gates") == 0


def test_by_touch_at_the_width_of_a_phone(open_page: Open) -> None:
    page = open_page(None, 390, 844)
    assert page.browser.run("document.documentElement.scrollWidth") <= 390
    page.tool("points")
    for i, (pixel, place) in enumerate(zip(pixels_of(PLACES), PLACES, strict=True)):
        # A finger comes down beside the place, and is moved onto it under the loupe.
        x, y = page.screen(pixel + [-20, 10])
        page.browser.call("Input.dispatchTouchEvent", type="touchStart", touchPoints=[{"x": x, "y": y}])
        assert not page.browser.run("document.getElementById('loupe').hidden")
        glass = page.browser.run(LOUPE)
        assert not (glass[0] <= x <= glass[2] and glass[1] <= y <= glass[3])  # the finger does not hide it
        page.browser.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])
        assert page.browser.run("document.getElementById('loupe').hidden")
        page.press("z", ctrl=True)
        page.touch(pixel + [-20, 10], pixel)
        assert page.browser.run("document.activeElement.tagName") != "INPUT"  # no keyboard over the picture
        page.fill(f"points:{i}:place.0", str(place[0]))
        page.fill(f"points:{i}:place.1", str(place[1]))
        page.browser.run("window.scrollTo(0, 0)")
    page.settle()
    assert page.text("#figures-summary").startswith("6.")
    page.tool("gates")
    page.touch(pixels_of([[2, 15]])[0])
    page.touch(pixels_of([[9, 18]])[0])
    page.settle()
    assert page.count("#road > .gates") == 1
    page.tool("lanes")
    for pixel in pixels_of([[5, 8], [8, 30]]):
        page.touch(pixel)
    page.browser.run("document.getElementById('finish').click()")
    page.settle()
    assert page.count("#road > .lanes") == 1
    # A finger that marks takes nothing along, however near; under Choose it does.
    page.tool("points")
    page.touch(pixels_of(PLACES[:1])[0] + [10, 0])
    page.settle()
    assert page.count("#marks > .points") == 7
    page.browser.run("document.getElementById('undo').click()")
    page.settle()
    # Two fingers zoom.
    page.tool("select")
    before = page.browser.run("document.getElementById('drawing').viewBox.baseVal.width")
    a, b = page.screen([250, 180]), page.screen([350, 180])
    for kind, spread in (("touchStart", 0), ("touchMove", 30), ("touchMove", 60)):
        fingers = [{"x": a[0] - spread, "y": a[1], "id": 0}, {"x": b[0] + spread, "y": b[1], "id": 1}]
        page.browser.call("Input.dispatchTouchEvent", type=kind, touchPoints=fingers)
    page.browser.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])
    assert page.browser.run("document.getElementById('drawing').viewBox.baseVal.width") < 0.8 * before
    page.browser.run("document.getElementById('save').click()")
    page.browser.until("document.getElementById('state').textContent === 'saved'")
    assert len(read_site(page.served.path).lanes) == 1
    again = open_page(page.served, 390, 844)
    assert again.count(".points circle.handle") == 6


def test_on_a_phone_every_tool_is_in_sight(open_page: Open) -> None:
    page = open_page(None, 390, 844)
    rights = page.browser.run(
        "[...document.querySelectorAll('#tools button')].map(one => one.getBoundingClientRect().right)"
    )
    assert len(rights) >= 9
    assert max(rights) <= 390
    assert page.browser.run("document.getElementById('stage').getBoundingClientRect().bottom") < 700


def test_wrong_input_is_said_beside_its_field_and_not_saved(open_page: Open) -> None:
    page = open_page()
    mark_all(page, 5)
    page.browser.run("document.querySelectorAll('#marks .choose')[1].click()")
    page.fill("points:1:place.0", "seven")
    page.settle()
    assert "expected metres, got 'seven'" in page.text("#marks .wrong")
    field = "document.querySelector('[data-focus=\"points:1:place.0\"]')"
    assert page.browser.run(f"{field}.value") == "seven"
    assert page.browser.run(f"{field}.getAttribute('aria-invalid')") == "true"
    page.browser.run("document.getElementById('save').click()")
    page.browser.until("!document.getElementById('problem').hidden")
    assert page.text("#problem").startswith("not saved: points 2: place.x")
    assert not page.served.path.exists()
    page.fill("points:1:place.0", "1.5")
    page.fill("points:1:pixel.0", "left")
    page.settle()
    assert "expected column and row" in page.text("#marks .wrong")
    assert page.count(".points circle.handle") == 4
    page.press("Escape")
    page.press("z", ctrl=True)
    page.settle()
    assert page.text("#marks .wrong") == ""
    page.browser.run("document.getElementById('save').click()")
    page.browser.until("document.getElementById('state').textContent === 'saved'")
    assert page.served.path.exists()


def test_two_windows_do_not_lose_each_others_work(open_page: Open, serve: Callable[..., Served]) -> None:
    served = serve()
    page = open_page(served)
    mark_all(page)
    # Another window saves a gate meanwhile.
    document = json.loads(page.browser.run("fetch('/begin.json').then((a) => a.text())"))["document"]
    other = document | {"points": marked_points(), "gates": [{"name": "theirs", "line": [[2, 15], [9, 18]]}]}
    status, _ = served.server.save({"document": other, "revision": None})
    assert status == 200
    page.browser.run("document.getElementById('save').click()")
    page.browser.until("!document.getElementById('conflict').hidden")
    assert "saved by another window" in page.text("#conflict")
    assert [gate.name for gate in read_site(served.path).gates] == ["theirs"]
    page.browser.run("document.getElementById('merge').click()")
    page.browser.until("document.getElementById('conflict').hidden")
    page.settle()
    assert "theirs" in page.text("#road")
    assert page.count(".points circle.handle") == 6
    page.browser.run("document.getElementById('save').click()")
    page.browser.until("document.getElementById('state').textContent === 'saved'")
    assert [gate.name for gate in read_site(served.path).gates] == ["theirs"]


def test_places_clicked_on_a_plan(open_page: Open, tmp_path: Path) -> None:
    plan = tmp_path / "plan.png"
    # Ten pixels a metre, north up, the corner at x = -5, y = 40.
    cv2.imwrite(str(plan), np.full((450, 300, 3), 230, dtype=np.uint8))
    page = open_page()
    choose_file(page, "plan", plan)
    page.browser.until("document.querySelector('[data-view=plan]').getAttribute('aria-pressed') === 'true'")
    for pixel in ([50, 400], [150, 400]):
        page.click(pixel)
    page.browser.until("document.getElementById('scale').open")
    page.browser.run("document.getElementById('scale-metres').focus()")
    page.type("ten")
    page.browser.run("document.querySelector('#scale button[type=submit]').click()")
    page.browser.until("document.getElementById('scale-wrong').textContent !== ''")
    page.browser.run("document.getElementById('scale-metres').focus()")
    page.type("10")
    page.browser.run("document.querySelector('#scale button[type=submit]').click()")
    page.browser.until("!document.getElementById('scale').open")
    page.browser.until("document.querySelector('[data-view=image]').getAttribute('aria-pressed') === 'true'")
    for pixel, place in zip(pixels_of(PLACES), PLACES, strict=True):
        page.click(pixel)
        page.browser.until("document.querySelector('[data-view=plan]').getAttribute('aria-pressed') === 'true'")
        page.click([50 + 10 * place[0], 400 - 10 * place[1]])
        page.browser.until("document.querySelector('[data-view=image]').getAttribute('aria-pressed') === 'true'")
    page.settle()
    assert page.text("#figures-summary").startswith("6.")
    page.browser.run("document.querySelectorAll('#marks .choose')[5].click()")
    shown = page.browser.run("document.querySelector('[data-focus=\"points:5:place.1\"]')?.value")
    assert float(shown or 33) == pytest.approx(33, abs=0.2)


def test_a_plan_is_scaled_and_turned_and_is_there_again(open_page: Open, tmp_path: Path) -> None:
    plan = tmp_path / "aerial.png"
    cv2.imwrite(str(plan), np.full((450, 300, 3), 230, dtype=np.uint8))
    page = open_page()
    run = page.browser.run
    choose_file(page, "plan", plan)
    page.browser.until("document.querySelector('[data-view=plan]').getAttribute('aria-pressed') === 'true'")

    def scale() -> None:
        # Up the plan by 100 pixels is 20 m to the west: its up is turned by 90 degrees to the left.
        for pixel in ([150, 300], [150, 200]):
            page.click(pixel)
        page.browser.until("document.getElementById('scale').open")
        for field, text in (("x", "10"), ("y", "20"), ("x2", "-10"), ("y2", "20")):
            run(f"document.getElementById('scale-{field}').focus()")
            page.type(text)
        run("document.querySelector('#scale button[type=submit]').click()")
        page.browser.until("!document.getElementById('scale').open")

    scale()
    # That was a mistake: undo takes the scale away, and the two points are clicked again.
    run("document.querySelector('[data-view=plan]').click()")
    run("document.getElementById('undo').click()")
    page.browser.until("document.getElementById('hint').textContent.includes('first of two points')")
    scale()
    run("document.querySelector('[data-view=image]').click()")
    for pixel, place in zip(pixels_of(PLACES), PLACES, strict=True):
        page.click(pixel)
        page.browser.until("document.querySelector('[data-view=plan]').getAttribute('aria-pressed') === 'true'")
        # Of the plan, right is north and up is west, 0.2 m a pixel.
        page.click([150 + (place[1] - 20) / 0.2, 300 + (place[0] - 10) / 0.2])
        page.browser.until("document.querySelector('[data-view=image]').getAttribute('aria-pressed') === 'true'")
    page.settle()
    assert page.text("#figures-summary").startswith("6.")
    run("document.getElementById('save').click()")
    page.browser.until("document.getElementById('state').textContent === 'saved'")
    saved = read_site(page.served.path).plan
    assert saved is not None
    assert saved.file.name == "site_plan.png"
    assert saved.rotation_deg == pytest.approx(90)
    again = open_page(page.served)
    again.browser.run("document.querySelector('[data-view=plan]').click()")
    again.browser.until("document.querySelectorAll('.points circle.handle').length === 6")
    x, y = again.browser.run(
        "['cx', 'cy'].map((k) => Number(document.querySelector('[data-handle=\"points:0:0\"]').getAttribute(k)))"
    )
    assert (x, y) == pytest.approx((150 + (PLACES[0, 1] - 20) / 0.2, 300 + (PLACES[0, 0] - 10) / 0.2), abs=1)
    assert again.text("#state") == "saved"
    again.browser.run("document.getElementById('plan-away').click()")
    assert again.text("#state") == "not saved yet"


def gate_pixels(page: SitePage) -> Any:
    """(2, 2) where the image shows the ends of the first gate."""
    ends = "[...document.querySelectorAll('.gates circle.handle')]"
    return np.array(page.browser.run(f"{ends}.map((c) => ['cx', 'cy'].map((k) => Number(c.getAttribute(k))))"))


@pytest.mark.parametrize("kept", ["image", pytest.param("metres", marks=pytest.mark.slow)])
def test_gates_under_a_camera_that_is_calibrated_again(
    open_page: Open, serve: Callable[..., Served], kept: str
) -> None:
    gate: dict[str, Any] = {"name": "north", "line": [[2.0, 15.0], [9.0, 18.0]], "directions": ["", ""]}
    served = serve(points=marked_points(4), gates=[gate])
    page = open_page(served)
    before = gate_pixels(page)
    assert page.browser.run("document.getElementById('moved').hidden")
    # All places were counted from elsewhere: the camera is 3 m farther east.
    run = page.browser.run
    for index, place in enumerate(PLACES[:4]):
        run(f"document.querySelectorAll('#marks .choose')[{index}].click()")
        page.fill(f"points:{index}:place.0", str(place[0] + 3))
    page.settle()
    assert "calibrated again: north moved by up to" in page.text("#moved-words")
    assert np.abs(gate_pixels(page) - before).max() > 10
    run(f"document.getElementById('keep-{kept}').click()")
    page.settle()
    page.browser.until("document.getElementById('moved').hidden")
    away = np.abs(gate_pixels(page) - before).max()
    run("document.getElementById('save').click()")
    page.browser.until("document.getElementById('state').textContent === 'saved'")
    line = np.array(read_site(served.path).gates[0].line)
    if kept == "image":
        assert away < 0.3
        assert line == pytest.approx(np.array(gate["line"]) + [3, 0], abs=0.1)
    else:
        assert away > 10
        assert line == pytest.approx(np.array(gate["line"]))


def test_mirrored_places_are_mended_by_a_button_and_undone(open_page: Open, serve: Callable[..., Served]) -> None:
    points = [point | {"place": [point["place"][0], -point["place"][1], 0.0]} for point in marked_points()]
    page = open_page(serve(points=points))
    assert "mirrored" in page.text("#message")
    assert page.text("#mend button") == "Swap x and y Turn y round"
    page.browser.run("document.querySelector('[data-way=mirror]').click()")
    page.settle()
    assert page.text("#message") == ""
    assert page.text("#figures-summary").startswith("6.")
    page.browser.run("document.getElementById('undo').click()")
    page.settle()
    assert "mirrored" in page.text("#message")


def test_latitude_and_longitude_are_pasted(open_page: Open) -> None:
    page = open_page()
    page.tool("points")
    for i, (pixel, (x, y)) in enumerate(zip(pixels_of(PLACES), PLACES.tolist(), strict=True)):
        page.click(pixel)
        # A degree at 50 degrees of latitude: 111.229 km to the north, 71.696 km to the east.
        page.fill(f"points:{i}:map", f"{50 + y / 111229:.7f}, {8 + x / 71696:.7f}")
        page.browser.until(f"document.querySelector('[data-focus=\"points:{i}:place.0\"]').value !== ''")
    page.settle()
    assert page.text("#figures-summary").startswith("6.")
    page.fill("points:5:map", "50 degrees")
    page.browser.until("document.querySelector('#marks .wrong') !== null")
    assert "like 49.00012, 8.40034" in page.text("#marks .wrong")
    page.browser.run("document.getElementById('save').click()")
    page.browser.until("document.getElementById('state').textContent === 'saved'")
    world = read_site(page.served.path).world
    assert world is not None
    assert world["origin"]["latitude"] == pytest.approx(50, abs=0.001)


def saved(page: SitePage) -> SiteFile:
    """Save, and read what was saved."""
    page.browser.run("document.getElementById('save').click()")
    page.browser.until("document.getElementById('state').textContent === 'saved'")
    return read_site(page.served.path)


def test_gates_are_drawn_and_saved_before_anything_is_calibrated(
    serve: Callable[..., Served], open_page: Open, image: Path, tmp_path: Path
) -> None:
    footage = tmp_path / "frames"
    footage.mkdir()
    for name in ("a.png", "b.png"):
        (footage / name).write_bytes(image.read_bytes())
    page = open_page(serve(SiteFrames.of_footage(str(footage))))
    assert page.text("#steps").startswith("Draw gates")
    assert "No calibration is needed" in page.text("#hint")
    assert page.text("#solving") == ""
    begin, end = [100.0, 300.0], [500.0, 250.0]
    page.click(begin)  # the tool is chosen already
    page.click(end)
    page.settle()
    assert page.count(".gates circle.handle") == 2
    page.fill("gates:0:name", "main")
    page.fill("gates:0:directions.0", "towards us")
    page.fill("gates:0:directions.1", "away")
    page.settle()
    assert page.text("#drawing .gates").split() == ["main", "1:", "towards", "us", "2:", "away"]
    assert page.text("#road .warnings, #road .bad") == ""
    site = saved(page)
    (gate,) = site.gates
    assert np.abs(np.array(gate.pixels) - [begin, end]).max() < 0.6
    assert "calibration" not in page.served.path.read_text()
    assert (gate.size, gate.line, gate.directions, site.camera) == (SIZE, (), ("towards us", "away"), None)
    assert page.text("#then").endswith(f"skope eval traffic {footage} --site {page.served.path}")
    # An end is moved in the image, and typed.
    page.tool("select")
    page.drag(page.screen(end), page.screen([520.0, 270.0]))
    page.settle()
    page.fill("gates:0:pixels.0.0", "110.5")
    page.settle()
    assert np.abs(np.array(saved(page).gates[0].pixels) - [[110.5, 300], [520, 270]]).max() < 0.6
    page.browser.run(
        "[...document.querySelectorAll('#road button')].find((b) => b.innerText.startsWith('Swap')).click()"
    )
    page.settle()
    assert np.abs(np.array(saved(page).gates[0].pixels) - [[520, 270], [110.5, 300]]).max() < 0.6
    # Zones are in metres: they still need a camera.
    page.tool("zones")
    assert page.text("#hint") == "Zones and lanes are in metres: calibrate the camera first."
    again = open_page(page.served)
    assert again.count(".gates circle.handle") == 2
    assert again.text("#state") == "saved"


def test_a_gate_in_the_image_has_a_line_where_the_camera_is_known_until_it_is_moved_on_the_road(
    serve: Callable[..., Served], open_page: Open
) -> None:
    page = open_page(serve(points=marked_points()))
    page.settle()
    page.tool("gates")
    ends = pixels_of([[2, 15], [9, 18]])
    for pixel in ends:
        page.click(pixel)
    page.settle()
    (gate,) = saved(page).gates
    assert np.abs(np.array(gate.pixels) - ends).max() < 0.6
    assert np.abs(np.array(gate.line) - [[2, 15], [9, 18]]).max() < 0.3
    page.browser.run("document.querySelector('[data-view=above]').click()")
    page.browser.until("document.querySelector('[data-view=above]').getAttribute('aria-pressed') === 'true'")
    page.tool("select")
    at = gate_pixels(page)
    assert at.shape == (2, 2)
    page.drag(page.screen(at[1]), page.screen(at[1] + [40, 0]))
    page.settle()
    (moved,) = saved(page).gates
    assert (moved.pixels, moved.size) == ((), None)
    assert moved.line[0] == pytest.approx(gate.line[0])
    assert moved.line[1][0] > gate.line[1][0] + 0.5
    assert moved.line[1][1] == pytest.approx(gate.line[1][1], abs=0.01)


def test_the_page_shows_that_the_camera_is_being_solved(
    serve: Callable[..., Served], open_page: Open, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = open_page(serve(points=marked_points()))
    assert page.text("#solving") == ""
    before = page.text("#figures-summary")
    held = threading.Event()

    def slowly(evidence: Evidence) -> SiteCalibration:
        assert held.wait(HANG_S)
        return calibrate(evidence)

    monkeypatch.setattr("skope.site.page.solved_page.calibrate", slowly)
    page.browser.run("document.querySelectorAll('#marks .choose')[0].click()")
    page.fill("points:0:place.2", "0.5")
    page.browser.until("document.getElementById('solving').textContent === 'Solving the camera…'")
    time.sleep(0.3)  # the server has been asked
    shade = "getComputedStyle(document.getElementById('figures-details')).opacity"
    assert page.browser.run("document.getElementById('solving').getAttribute('aria-live')") == "polite"
    assert (page.text("#figures-summary"), page.browser.run(shade)) == (before, "0.35")
    # What is drawn meanwhile changes nothing in the camera, and the answer is still awaited.
    page.tool("gates")
    for pixel in ([100, 300], [500, 250]):
        page.click(pixel)
    assert page.text("#solving") == "Solving the camera…"
    held.set()
    page.browser.until("document.getElementById('solving').textContent === ''")
    assert page.browser.run(shade) == "1"
    assert page.count(".gates circle.handle") == 2
    # A gate leaves the camera as it is.
    page.browser.run("document.getElementById('undo').click()")
    assert page.text("#solving") == ""


def test_when_the_footage_was_taken(open_page: Open) -> None:
    page = open_page()
    page.browser.run("document.getElementById('footage-details').open = true")
    page.fill("footage:0:time_zone", "Berlin")
    page.settle()
    assert "Europe/Berlin" in page.text("#footage .wrong")
    page.browser.run("document.getElementById('save').click()")
    page.browser.until("!document.getElementById('problem').hidden")
    assert not page.served.path.exists()
    page.fill("footage:0:time_zone", "Europe/Berlin")
    page.fill("footage:0:start", "2026-11-26 10:00")
    page.settle()
    assert page.text("#footage .wrong") == ""
    page.browser.run("document.getElementById('save').click()")
    page.browser.until("document.getElementById('state').textContent.startsWith('saved')")
    site = read_site(page.served.path)
    assert (site.time_zone, str(site.start)) == ("Europe/Berlin", "2026-11-26 10:00:00+01:00")


@pytest.mark.parametrize("width", [pytest.param(1280, marks=pytest.mark.slow), 390])
def test_the_picture_stays_where_it_is_between_two_clicks(
    open_page: Open, serve: Callable[..., Served], width: int
) -> None:
    page = open_page(serve(points=marked_points(4)), width)
    top = "document.getElementById('stage').getBoundingClientRect().top"
    places = []
    for tool in ("select", "points", "lengths", "parallels", "lanes", "zones"):
        page.tool(tool)
        places.append(page.browser.run(top))
        if tool != "select":
            (page.click if width > 600 else page.touch)([300, 300])
            page.settle()
            places.append(page.browser.run(top))
    assert not page.browser.run("document.getElementById('finish').hidden")
    page.browser.run("document.getElementById('finish').click()")  # too early: that is said
    page.browser.until("!document.getElementById('problem').hidden")
    places.append(page.browser.run(top))
    assert max(places) - min(places) < 1, places


def test_on_a_phone_the_fields_of_a_new_point_are_in_sight(open_page: Open) -> None:
    page = open_page(width=390, height=844)
    page.tool("points")
    page.touch(pixels_of(PLACES[:1])[0])
    page.settle()
    top, bottom = page.browser.run(
        "(() => { const b = document.querySelector('[data-focus=\"points:0:place.0\"]').getBoundingClientRect();"
        " return [b.top, b.bottom]; })()"
    )
    stage = page.browser.run("document.getElementById('stage').getBoundingClientRect().bottom")
    assert stage <= top < bottom < 600
    assert page.count("#marks .fields") == 0  # not far below as well
    page.browser.run("document.querySelector('#sheet button').click()")
    assert page.browser.run("document.getElementById('sheet').hidden")


def test_points_of_a_file_on_an_empty_canvas(open_page: Open, serve: Callable[..., Served], tmp_path: Path) -> None:
    page = open_page(serve(SiteFrames.canvas((640, 360), "points")))
    rows: dict[str, Any] = {
        str(i + 1): {"x_px": pixel[0], "y_px": pixel[1], "hemisphere": "N", "zone_utm": 33}
        | {"lon_utm": 412345.5 + place[0], "lat_utm": 5812345.5 + place[1]}
        for i, (pixel, place) in enumerate(zip(pixels_of(PLACES).tolist(), PLACES.tolist(), strict=True))
    }
    path = tmp_path / "points.otrfpts"
    path.write_text(json.dumps(rows))
    choose_file(page, "file", path)
    page.browser.until("document.querySelectorAll('.points circle.handle').length === 6")
    page.settle()
    assert "UTM zone 33N" in page.text("#problem")
    assert page.count("#marks .bad") == 0
    assert page.text("#figures-summary").startswith("6.")
    assert page.count("#marks .others") == 6
    page.browser.run("document.querySelector('#marks .choose').click()")
    shown = page.browser.run("document.querySelector('[data-focus=\"points:0:place.0\"]').value")
    assert len(shown) <= 6, shown  # digits that nobody typed
    assert re.match(r"by the others [\d.]+ m off \(stated: [\d.]+ m\)", page.text("#marks .others"))


def test_lanes_are_drawn_from_above(open_page: Open, serve: Callable[..., Served]) -> None:
    served = serve(points=marked_points())
    page = open_page(served)
    assert page.text("#state") == "not saved yet"  # the points came with the command
    page.browser.run("document.querySelector('[data-view=above]').click()")
    page.browser.until("document.querySelector('[data-view=above]').getAttribute('aria-pressed') === 'true'")
    page.tool("lanes")
    page.click([300, 700])
    page.click([400, 200])
    page.press("Enter")
    page.settle()
    page.browser.run("document.getElementById('save').click()")
    page.browser.until("document.getElementById('state').textContent === 'saved'")
    (lane,) = read_site(served.path).lanes
    (x0, y0), (x1, y1) = lane.line
    assert y1 > y0
    assert x1 > x0  # north is up, east to the right
    above = served.server.above({"document": {"points": marked_points(), "camera": None}, "frame": 0})
    assert (y1 - y0) / (500 * above["cell_m"]) == pytest.approx(1, abs=0.02)


def test_names_of_files_are_text(open_page: Open, serve: Callable[..., Served], tmp_path: Path) -> None:
    path = tmp_path / "<img src=x onerror=document.title=1>.png"
    cv2.imwrite(str(tmp_path / "plain.png"), road_picture())
    (tmp_path / "plain.png").rename(path)
    page = open_page(serve(SiteFrames.of_footage(str(path)), tmp_path / "<b>site.toml"))
    assert "<img src=x" in page.text("#title")
    assert page.count("#title *") == 0
    time.sleep(0.1)
    assert page.count("img") == 0


def choose_file(page: SitePage, field: str, path: Path) -> None:
    """Choose a file as a person does in the browser's dialog."""
    root = page.browser.call("DOM.getDocument")["root"]["nodeId"]
    node = page.browser.call("DOM.querySelector", nodeId=root, selector=f"input#{field}")["nodeId"]
    page.browser.call("DOM.setFileInputFiles", nodeId=node, files=[str(path)])


def test_a_gate_at_the_edge_is_warned_of_in_its_row(open_page: Open, serve: Callable[..., Served]) -> None:
    page = open_page(serve(points=marked_points()))
    page.settle()
    page.tool("gates")
    page.click([120, 352])
    page.click([520, 352])
    page.settle()
    assert "never on both sides" in page.text("#road .warnings")
    assert page.text("#road .bad") == "warning"


def test_no_word_of_the_grid_is_covered_by_the_name_of_a_mark(open_page: Open, serve: Callable[..., Served]) -> None:
    at, text = overlays(CAMERA)["labels"][0].values()  # "10 m", which a "7" in front of it makes "70 m"
    named = [{"name": "7", "pixels": [at, [at[0] + 60, at[1]]], "metres": None}]
    shown = "[...document.querySelectorAll('.camera text')].map((one) => one.textContent)"
    page = open_page(serve(points=marked_points(), lengths=named))
    assert text not in page.browser.run(shown)
    page.browser.run("document.evaluate(\"//label[contains(., 'names')]/input\", document).iterateNext().click()")
    assert text in page.browser.run(shown)


def test_a_length_and_parallel_lines_tell_a_camera_without_places(open_page: Open) -> None:
    page = open_page()
    page.tool("parallels")
    for line in ([[4, 8], [6, 30]], [[7.5, 8], [9.5, 30]], [[11, 12], [12.6, 30]]):
        for pixel in pixels_of(line):
            page.click(pixel)
    page.settle()
    assert page.count("#marks > .parallels") == 1
    assert "the scale is unknown" in page.text("#message")
    page.tool("lengths")
    for pixel in pixels_of([[4, 8], [6, 30]]):
        page.click(pixel)
    page.type("22.09")
    page.settle()
    assert page.text("#message") == ""
    assert "m high" in page.text("#figures-summary")
