"""A road user that stands on a line while its position swings crosses it once; one that turns round crosses twice."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skope.site.gates_zones_lanes import Gate, Zone
from skope.site.site_file import parse_site
from skope.site.traffic_settings import TrafficSettings
from skope.tracks.track import Track
from skope.traffic.image_counts import count_in_image
from skope.traffic.measure import measure
from skope.traffic.zones import visits
from skope.types import Array
from tests.traffic.drives import drive, watched
from tests.traffic.test_missed_crossings import SITE

TIMES = np.arange(600) * 0.1
SWING = np.where((TIMES > 20) & (TIMES < 40), np.sin(2 * np.pi * TIMES / 5), 0.0)
"""Four slow swings, of amplitude 1, while a road user stands."""
STAND = np.interp(TIMES, [0, 20, 40, 60], [-30.0, 0.0, 0.0, 30.0])
"""Comes from the left, stands on the line for 20 s, and goes on."""
WALKER: dict[str, Any] = {"category": "pedestrian", "class_name": "pedestrian", "length": None, "width": None}
CYCLIST: dict[str, Any] = {"category": "bicycle", "class_name": "bicycle", "length": None, "width": None}
GATE = Gate(name="g", line=((0.0, 9.0), (0.0, -9.0)), directions=("back", "on"))


def counts(*tracks: Track) -> tuple[int, int]:
    """Number of crossings on, towards +x, and back."""
    report = measure(tracks, watched(60.0), replace(SITE, gates=(GATE,)))
    number = {row.direction: row.count for row in report.counts_total if row.class_name == "all"}
    return number["on"] or 0, number["back"] or 0


def along(x: Array, *, sigma: float = 0.15, rows: slice = slice(None), number: int = 1, **others: Any) -> Track:
    """A road user at these places along x at `TIMES`."""
    places = np.column_stack([x, np.zeros_like(x)])
    return drive(number, places[rows], TIMES[rows], sigma=sigma, **others)


@pytest.mark.parametrize(
    ("x", "expected"),
    [
        (np.interp(TIMES, [0, 60], [-30, 30]), (1, 0)),
        (STAND + 0.2 * np.sign(SWING) * np.cos(9 * TIMES), (1, 0)),
        (STAND + 0.8 * SWING, (1, 0)),
        (STAND - 0.8 * SWING, (1, 0)),
        (STAND + 1.5 * SWING, (1, 0)),
        (-STAND + 0.8 * SWING, (0, 1)),
        (np.where(TIMES < 40, STAND, -STAND) + 0.8 * SWING, (0, 0)),  # backs off after it stood on the line
        (np.interp(TIMES, [0, 20, 30, 50, 60], [-30, 3, 3, -30, -30]), (1, 1)),  # reverses 3 m beyond the line
        (np.interp(TIMES, [0, 20, 30, 50, 60], [-30, -1, -1, -30, -30]), (0, 0)),
        (STAND + 0.8 * SWING + np.interp(TIMES, [20, 40], [-1, 1]), (1, 0)),  # creeps over the line
    ],
)
def test_each_way_over_the_line_is_counted_once(x: Array, expected: tuple[int, int]) -> None:
    assert counts(along(x)) == expected


def test_a_stated_error_as_large_as_the_swing_changes_nothing() -> None:
    assert counts(along(STAND + 0.8 * SWING, sigma=0.3)) == (1, 0)


@pytest.mark.parametrize("end", [250, 262, 275, 287, 300, 313])
def test_a_vehicle_that_stands_there_to_the_end_has_no_more_than_one_crossing(end: int) -> None:
    """Wherever in the swing the track ends; a second track goes on from there."""
    x = STAND + 0.8 * SWING
    on, back = counts(along(x, rows=slice(0, end)))
    assert (on <= 1, back) == (True, 0)
    parts = along(x, rows=slice(0, end)), along(x, rows=slice(end + 3, None), number=2)
    assert counts(*parts) == (1, 0)


@pytest.mark.parametrize("depth", [0.7, 1.0, 2.0, 5.0])
def test_a_turning_vehicle_crosses_each_way_however_near_to_the_line_it_turns(depth: float) -> None:
    """It drives a half circle of 5.5 m radius, whose apex lies this far beyond the line."""
    speed, radius = 5.0, 5.5
    t = np.arange(0, 20, 0.1)
    angle = np.clip((t - 8) * speed / radius, 0, np.pi)
    straight_on = speed * (np.minimum(t, 8) - 8), speed * np.maximum(t - 8 - np.pi * radius / speed, 0)
    x = radius * np.sin(angle) + straight_on[0] - straight_on[1] + depth - radius
    y = radius * (1 - np.cos(angle)) - radius
    assert counts(drive(1, np.column_stack([x, y]), t)) == (1, 1)


@pytest.mark.parametrize(("others", "amplitude_m"), [({}, 1.7), (CYCLIST, 0.9), (WALKER, 0.9)])
@pytest.mark.parametrize("seed", range(20))
def test_slow_swings_leave_the_net_number(others: dict[str, Any], amplitude_m: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    swing = np.sin(2 * np.pi * (TIMES[:, None] / rng.uniform(2, 12, 3) + rng.random(3))) @ rng.dirichlet(np.ones(3))
    swing *= rng.uniform(0.3, 1) * amplitude_m * np.interp(TIMES, [15, 20, 40, 45], [0, 1, 1, 0])
    sideways = 0.3 * np.sin(2 * np.pi * TIMES / rng.uniform(2, 12))
    # Beyond this the road user would have stood beyond the line, not on it.
    stand = STAND + rng.uniform(-0.1, 0.1)
    goes_on = bool(rng.integers(2))
    x = (stand if goes_on else np.where(TIMES < 40, stand, -stand)) + swing
    places = np.column_stack([x, sideways])
    assert counts(drive(1, places, TIMES, sigma=0.1, **others)) == (int(goes_on), 0)


def test_a_walker_who_steps_over_the_line_and_back_crosses_each_way() -> None:
    x = np.interp(TIMES, [0, 20, 25, 45, 60], [-15, 1.5, 1.5, -15, -15])
    assert counts(along(x, **WALKER)) == (1, 1)


# --------------------------------------------------------------------------------------------------- gates in the image

IMAGE_SITE = parse_site(
    Path("site.toml"),
    b"[[gates]]\nname = 'g'\npixels = [[320, 350], [320, 50]]\ndirections = ['on', 'back']\n",
)


def image_counts(x_px: Array, y_px: Any = 200.0, **others: Any) -> tuple[int, int]:
    """The same of boxes of 80 by 50 pixels whose foot is at these columns and rows; the gate is at column 320."""
    foot = np.column_stack([x_px, np.broadcast_to(y_px, x_px.shape)])
    boxes = np.column_stack([foot[:, 0] - 40, foot[:, 1] - 50, np.full_like(x_px, 80), np.full_like(x_px, 50)])
    values = {"class_name": "unknown", "heading": np.full(len(x_px), np.nan), "length": None, "width": None}
    track = drive(1, foot * [1, -1], TIMES, sigma=0.03 * 80, boxes=boxes, **values | others)
    report = count_in_image([track], watched(60.0), IMAGE_SITE)
    number = {row.direction: row.count for row in report.counts_total if row.class_name == "all"}
    return number["on"] or 0, number["back"] or 0


@pytest.mark.parametrize("share", [0.05, 0.15, 0.3])
def test_a_box_that_swings_on_a_gate_in_the_image_is_counted_once(share: float) -> None:
    """By shares of its length: three standard deviations of its foot are 0.09."""
    assert image_counts(320 + 10 * STAND + 80 * share * SWING) == (1, 0)
    assert image_counts(320 - 10 * STAND + 80 * share * SWING) == (0, 1)


def test_a_box_that_goes_over_a_gate_in_the_image_and_comes_back_is_counted_each_way() -> None:
    reverses = np.interp(TIMES, [0, 20, 30, 50, 60], [20, 360, 360, 20, 20])
    assert image_counts(reverses) == (1, 1)
    turns = np.interp(TIMES, [0, 20, 24, 50, 60], [20, 335, 335, 20, 20])
    assert image_counts(turns, np.interp(TIMES, [20, 24], [200, 260])) == (1, 1)


# ---------------------------------------------------------------------------------------------------------------- zones


def test_a_vehicle_that_stands_on_the_border_of_a_zone_visits_it_once() -> None:
    zone = Zone(name="box", polygon=((0, -5), (10, -5), (10, 5), (0, 5)))
    (visit,) = visits([along(STAND + 0.8 * SWING)], [zone], TrafficSettings())
    assert 20 < visit.enter_s < 40
    assert visit.leave_s == pytest.approx(40 + 10 / 1.5, abs=0.1)
    reverses = along(np.interp(TIMES, [0, 20, 30, 50, 60], [-30, 3, 3, -30, -30]))
    assert len(visits([reverses], [zone], TrafficSettings())) == 1


def test_a_bus_crosses_a_zone_that_is_shorter_than_itself() -> None:
    crosswalk = Zone(name="crosswalk", polygon=((0, -5), (3, -5), (3, 5), (0, 5)))
    bus = along(np.interp(TIMES, [0, 60], [-30, 30]), class_name="bus", length=12.0)
    assert len(visits([bus], [crosswalk], TrafficSettings())) == 1
