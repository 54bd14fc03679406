"""What is drawn over the picture, and what gates are warned of, against what can be worked out."""

import math
from typing import Any

import numpy as np
import pytest

from skope.camera.calibrate import calibrate
from skope.camera.evidence import Evidence, marked_points
from skope.camera.ground_plane import intersect_ground
from skope.camera.model import Camera
from skope.errors import UserError
from skope.site.page.drawings import gate_warnings, read_drawings, shapes
from skope.site.page.marks import marks_of_document, unique_names
from skope.site.page.overlays import car_edges, horizon_line, overlays
from skope.site.page.plan import plan_scale, seen_from_above
from skope.site.page.site_store import merged_document
from skope.site.page.solved_page import error_map
from tests.site.page.conftest import PLACES, SIZE, empty_document, pixels_of

LEVEL = Camera.looking([0, 0, 6], yaw=math.pi / 2, pitch_down=0.3, size=(640, 360), fov=1.2)
"""Looks north from 6 m over the origin."""


def test_the_grid_lies_on_the_road_at_whole_steps() -> None:
    drawn = overlays(LEVEL)
    step = drawn["step_m"]
    for line in drawn["grid"]:
        places = intersect_ground(LEVEL, np.array(line))[:, :2]
        off = np.abs(places / step - np.rint(places / step)).min(axis=1)
        near = np.linalg.norm(places, axis=1) < 40  # farther off, pixels are rounded to metres
        assert (off[near] * step < 0.1 * step).all()
    for label in drawn["labels"]:
        metres = float(label["text"].removesuffix(" m"))
        assert intersect_ground(LEVEL, label["at"])[1] == pytest.approx(metres, rel=0.02)


def test_a_level_horizon_is_the_tilt_above_the_middle() -> None:
    (line,) = horizon_line(LEVEL)
    rows = np.array(line)[:, 1]
    assert rows == pytest.approx(180 - LEVEL.K[1, 1] * math.tan(0.3), abs=0.1)


def test_a_box_is_as_large_as_a_car() -> None:
    edges = car_edges(LEVEL, np.array([1.0, 15.0, 0.0]), np.array([0.0, 1.0]))
    assert len(edges) == 12
    feet = [e for e in edges if np.isfinite(intersect_ground(LEVEL, np.array(e))).all()]
    lengths = sorted(float(np.linalg.norm(np.subtract(*intersect_ground(LEVEL, np.array(e))[:, :2]))) for e in feet)
    assert lengths[:2] == pytest.approx([1.8, 1.8], abs=0.05)


def test_the_map_has_the_errors_of_the_middles_of_its_cells() -> None:
    places = np.concatenate([PLACES, np.zeros((6, 1))], axis=1)
    known = calibrate(Evidence(SIZE, points=marked_points(pixels_of(PLACES), places)))
    shown = error_map(known)
    row, column = shown["rows"] - 3, shown["columns"] // 2
    middle = [(column + 0.5) * shown["cell"], (row + 0.5) * shown["cell"]]
    value = shown["values"][row * shown["columns"] + column]
    assert value == pytest.approx(float(known.place_error(middle)), rel=0.01)


def warned(line: Any, lanes: Any = (), error: float | None = 0.2) -> str:
    known = None if error is None else lambda pixels: np.full(np.shape(pixels)[:-1], error)
    return "; ".join(gate_warnings(np.array(line, dtype=float), LEVEL, lanes, known))


def test_a_gate_across_a_lane_in_the_middle_is_not_warned_of() -> None:
    lane = (np.array([[0.0, 10.0], [0.0, 40.0]]), 3.5)
    assert warned([[-4, 20], [4, 20]], [lane]) == ""


def test_gates_are_warned_of() -> None:
    lane = (np.array([[0.0, 10.0], [0.0, 40.0]]), 3.5)
    assert warned([[0, 15], [1, 25]], [lane]).startswith("runs along a lane (6 degrees to it)")
    assert warned([[5, 15], [6, 25]], [lane]) == ""  # beside the lane
    assert "errors of up to 2.5 m" in warned([[-4, 20], [4, 20]], error=2.5)
    assert "outside the image" in warned([[-4, -20], [4, -20]])
    assert "nothing can cross it" in warned([[4, 20], [4.1, 20]])
    # The image's lower edge shows the road 8.8 m ahead: south of this gate nothing is seen 3 m away.
    edge = float(intersect_ground(LEVEL, [320, 359])[1])
    south = warned([[-2, edge + 1], [2, edge + 1]])
    assert "on its right" in south
    assert "on its left" not in south
    assert "on its left" in warned([[2, edge + 1], [-2, edge + 1]])


def test_the_two_ways_across_a_gate_are_from_left_to_right_and_back() -> None:
    drawings, problems = read_drawings(empty_document(gates=[{"name": "g", "line": [[-4, 20], [4, 20]]}]), SIZE)
    assert problems == []
    (shown,) = shapes(drawings, LEVEL, None)
    (a, b), (c, d) = np.array(shown["ways"])
    # From west to east, its left is north: traffic from left to right goes south.
    assert (b - a).tolist() == pytest.approx([0, -3])
    assert (d - c).tolist() == pytest.approx([0, 3])


def test_a_gate_in_the_image_has_its_directions_on_the_screen_and_warnings_with_metres_alone() -> None:
    edge = [{"name": "g", "pixels": [[100, 355], [500, 355]], "size": list(SIZE)}]
    drawings, problems = read_drawings(empty_document(gates=edge), SIZE)
    assert problems == []
    (shown,) = shapes(drawings, None, None)
    assert (shown["warnings"], shown["corners"]) == ([], [[100, 355], [500, 355]])
    # Drawn from left to right its left is above: from its left to its right is downwards in the image.
    ((one,),), ((two,),) = ([arrow] for arrow in shown["arrows"])
    assert [one[1][k] - one[0][k] for k in (0, 1)] == pytest.approx([0, 40])
    assert [two[1][k] - two[0][k] for k in (0, 1)] == pytest.approx([0, -40])
    (shown,) = shapes(drawings, LEVEL, None)
    assert "on its right" in "; ".join(shown["warnings"])  # the image ends there
    (a, b), _ = np.array(shown["ways"])
    assert b[1] < a[1]  # downwards in the image is towards the camera, in the south


def test_what_is_wrong_with_drawings_is_said_by_field() -> None:
    document = empty_document(
        gates=[
            {"name": "a", "line": [[0, 0], [0, 0]]},
            {"name": "a", "line": [[0, 0], [1, 0]], "directions": ["in", ""]},
            {"name": "b\n", "line": [[0, 0], ["x", 0]]},
            {"name": "c", "pixels": [[5, 5], [5, 5]], "size": list(SIZE)},
            {"name": "d", "pixels": [[5, 5], [5]], "size": list(SIZE)},
        ],
        zones=[{"name": "z", "polygon": [[0, 0], [1, 1], [1, 0], [0, 1]]}, {"name": "", "polygon": [[0, 0]]}],
        lanes=[{"name": "l", "line": [[0, 0], [9, 0]], "width": 0}],
        occluders=[{"polygon": [[0, 0], [9, 0], [9, 9]], "foot": None}],
    )
    good, problems = read_drawings(document, SIZE)
    assert [(one.kind, one.index, one.field) for one in problems] == [
        ("gates", 0, "line"),
        ("gates", 1, "name"),
        ("gates", 1, "directions.1"),
        ("gates", 2, "name"),
        ("gates", 2, "line"),
        ("gates", 3, "pixels"),
        ("gates", 4, "pixels"),
        ("zones", 0, "polygon"),
        ("zones", 1, "name"),
        ("zones", 1, "polygon"),
        ("lanes", 0, "width"),
        ("occluders", 0, "foot"),
    ]
    assert [(one.kind, one.index) for one in good] == [("gates", 1)]


def test_marks_that_are_wrong_are_said_by_field_and_left_out() -> None:
    document = empty_document(
        points=[
            {"name": "1", "pixel": [1, 2], "place": [0, "seven", None]},
            {"name": "2", "pixel": [float("inf"), 2], "place": [0, 0, 0]},
            {"name": "3", "pixel": [1, 2], "place": [0, 0, 0], "sigma_m": -1},
            {"name": "4", "pixel": [1, 2], "place": [0, 0, 0]},
        ],
        lengths=[{"pixels": [[0, 0], [9, 9]], "metres": None}, {"pixels": [[0, 0], [0, 0]], "metres": 3}],
        parallels=[{"lines": [[[0, 0], [9, 9]]]}],
        verticals=[{"pixels": [[5, 9], [5, 1]], "metres": "tall"}],
        known={"fov_deg": [300, 1], "height_m": [6, 0.2]},
    )
    marks = marks_of_document(document, SIZE)
    assert [(one.kind, one.index, one.field, one.missing) for one in marks.problems] == [
        ("points", 0, "place.y", False),
        ("points", 0, "place.z", True),
        ("points", 1, "pixel", False),
        ("points", 2, "sigma_m", False),
        ("lengths", 0, "metres", True),
        ("lengths", 1, "pixels", False),
        ("parallels", 0, "lines", True),
        ("verticals", 0, "metres", False),
        ("known", 0, "fov_deg", False),
    ]
    assert [point.name for point in marks.evidence.points] == ["4"]
    assert marks.entries["points"] == {"4": 3}
    assert [prior.of for prior in marks.evidence.priors] == [("z",)]


def test_entries_without_names_are_numbered() -> None:
    assert unique_names([{}, {"name": "a"}, {"name": " a "}, {"name": ""}]) == ["1", "a", "a (2)", "4"]


def test_a_plan_is_scaled_by_two_of_its_points() -> None:
    found = plan_scale({"ends": [[50, 400], [150, 400]], "metres": "10", "at": ["2", 3]})
    size, (x0, y0) = found["metres_per_pixel"], found["origin"]
    assert (x0 + 50 * size, y0 - 400 * size) == pytest.approx((2, 3))
    assert (x0 + 150 * size, y0 - 400 * size) == pytest.approx((12, 3))
    assert y0 - 300 * size == pytest.approx(13)  # up the plan is north
    for wrong in ({"metres": 0}, {"metres": "ten"}, {"ends": [[1, 1], [1, 1]]}, {"at": ["", 0]}):
        with pytest.raises(UserError):
            plan_scale({"ends": [[50, 400], [150, 400]], "metres": 10, "at": [0, 0]} | wrong)


def test_a_plan_may_be_turned_where_two_of_its_places_are_known() -> None:
    ends = [[50.0, 400.0], [150.0, 300.0]]  # on the plan: to the upper right, 141 pixels
    # In the world from (10, 20) straight to the north, 28.28 m: the plan's up is turned by 45 degrees to the left.
    found = plan_scale({"ends": ends, "metres": "", "at": [10, 20], "second": [10, 20 + 20 * math.sqrt(2)]})
    assert found["rotation_deg"] == pytest.approx(45)
    size, turn = found["metres_per_pixel"], math.radians(found["rotation_deg"])
    assert size == pytest.approx(0.2)
    R = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    for (u, v), place in zip(ends, ([10, 20], [10, 20 + 20 * math.sqrt(2)]), strict=True):
        assert found["origin"] + size * R @ [u, -v] == pytest.approx(place)
    with pytest.raises(UserError, match=r"28\.28 m apart, not 30"):
        plan_scale({"ends": ends, "metres": "30", "at": [10, 20], "second": [10, 20 + 20 * math.sqrt(2)]})
    with pytest.raises(UserError, match="second"):
        plan_scale({"ends": ends, "metres": "30", "at": [10, 20], "second": ["", "7"]})


def test_the_road_from_above_is_where_it_is() -> None:
    import base64

    import cv2

    picture = np.zeros((360, 640, 3), dtype=np.uint8)
    column, row = (round(float(v)) for v in LEVEL.project([3.0, 18.0, 0.0])[0])
    cv2.circle(picture, (column, row), 3, (255, 255, 255), -1)
    view = seen_from_above(LEVEL, picture)
    data = base64.b64decode(view["image"].partition(",")[2])
    above = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert above is not None
    assert list(above.shape[::-1]) == view["size"]
    rows, columns = np.nonzero(above > 250)
    assert len(rows)
    x = view["low"][0] + (columns.mean() + 0.5) * view["cell_m"]
    y = view["high"][1] - (rows.mean() + 0.5) * view["cell_m"]
    assert (x, y) == pytest.approx((3, 18), abs=0.4)


def test_joining_keeps_the_changes_of_both() -> None:
    a, b, c, d = ({"name": name, "line": [[0, 0], [i, 1]]} for i, name in enumerate("abcd"))
    moved, other = a | {"line": [[5, 5], [6, 6]]}, a | {"line": [[7, 7], [8, 8]]}
    base = empty_document(gates=[a, b])
    assert merged_document(base, empty_document(gates=[moved, b]), empty_document(gates=[a, b, c]))["gates"] == [
        moved,
        b,
        c,
    ]
    assert merged_document(base, empty_document(gates=[a]), empty_document(gates=[a, b, c]))["gates"] == [a, c]
    assert merged_document(base, empty_document(gates=[a, b, d]), empty_document(gates=[other]))["gates"] == [other, d]
    assert merged_document(base, empty_document(gates=[moved, b]), empty_document(gates=[other, b]))["gates"] == [
        moved,
        b,
    ]
