"""Site files: what is read, what is refused in one line, and saving that keeps what it does not know."""

import math
import threading
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from skope.camera.model import Camera
from skope.errors import UserError
from skope.files.json_files import json_bytes
from skope.site.site_file import read_site
from skope.site.write_site import save_site

WHOLE = """
# A junction.
time_zone = "Europe/Berlin"
start = 2026-11-26T10:00:00
network = "not_there.net.xml"   # for generating alone

[calibration]
size = [640, 480]
when = 2026-11-25T10:00:00+01:00
fov_deg = [60.0, 2.0]
points = [
  { pixel = [12.5, 300.0], place = [3.0, 12.5, 0.0], sigma_m = 0.2, name = "kerb" },
  { pixel = [600, 310], place = [30, 2] },   # a manhole
]
lengths = [{ pixels = [[10, 20], [30, 40]], metres = 5.0 }]
parallels = [{ lines = [[[1, 2], [3, 4]], [[5, 6], [7, 9]]], name = "edges" }]
verticals = [{ pixels = [[100, 200], [100, 90]], metres = 6.0 }]

[world]
origin = { easting = 844090.0, northing = 5673189.0 }
utm_zone = "32N"
epsg = 32632
scale = 1.0010604

[plan]
file = "plan.png"
metres_per_pixel = 0.05
origin = [-20.0, 60.0]
rotation_deg = 12.5

[camera]
size = [640, 480]
fov_deg = 60.0
position = [0.0, 0.0, 6.0]
yaw_deg = 90.0
pitch_deg = 20.0
covariance = { of = ["z", "pitch"], matrix = [[0.01, 0.0], [0.0, 0.0001]] }
calibrated = { when = 2026-11-25T10:00:00+01:00, from = "6 points" }

[[gates]]    # by the station
name = "north"
line = [[0.0, 10.0], [8.0, 10.0]]
directions = ["to the station", "to the bridge"]
colour = "red"

[[zones]]
name = "box"
polygon = [[0, 0], [5, 0], [5, 5]]

[[lanes]]
name = "1"
line = [[0, 0], [0, 20], [3, 40]]
width = 3.5

[[occluders]]
polygon = [[10, 10], [20, 10], [20, 30]]
foot = [15, 400]
"""


@pytest.fixture
def site(tmp_path: Path) -> Path:
    path = tmp_path / "site.toml"
    path.write_text(WHOLE)
    return path


def test_everything_is_read(site: Path) -> None:
    read = read_site(site)
    marks = read.calibration
    assert marks is not None
    assert read.camera is not None
    evidence = marks.evidence()
    assert evidence.size == (640, 480)
    assert [point.name for point in evidence.points] == ["kerb", "2"]
    assert evidence.points[0].sigma_m == 0.2
    assert evidence.points[1].place.tolist() == [30.0, 2.0, 0.0]
    assert (evidence.lengths[0].metres, evidence.verticals[0].metres) == (5.0, 6.0)
    assert evidence.parallels[0].lines.shape == (2, 2, 2)
    # tan(30 deg) = 320 / focal
    assert math.exp(evidence.priors[0].mean[0]) == pytest.approx(320 / math.tan(math.radians(30)))
    assert read.gates[0].directions == ("to the station", "to the bridge")
    assert read.zones[0].polygon == ((0.0, 0.0), (5.0, 0.0), (5.0, 5.0))
    assert read.lanes[0].width == 3.5
    assert read.occluders[0].foot == (15.0, 400.0)
    assert read.start is not None
    assert read.start.utcoffset() == timedelta(hours=1)
    assert marks.when == datetime.fromisoformat("2026-11-25T10:00:00+01:00")
    assert read.camera.known is not None
    assert read.camera.known.parameters == ("z", "pitch")
    assert read.camera.camera.position == pytest.approx([0, 0, 6])
    assert read.world == {
        "origin": {"easting": 844090.0, "northing": 5673189.0},
        "utm_zone": "32N",
        "epsg": 32632,
        "scale": 1.0010604,
    }
    assert read.plan is not None
    assert read.plan.file == site.with_name("plan.png")
    assert (read.plan.metres_per_pixel, read.plan.origin, read.plan.rotation_deg) == (0.05, (-20.0, 60.0), 12.5)
    assert read.unknown == ("gates[1].colour",)


def test_the_camera_of_a_file_keeps_its_uncertainty(tmp_path: Path) -> None:
    camera = Camera.looking([1, 2, 5], yaw=0.3, pitch_down=0.4, size=(640, 480), fov=1.0)
    known = {"of": ["log_height"], "matrix": [[0.0025]]}
    document = {"width": 640, "height": 480, **camera.to_dict(), "covariance": known}
    (tmp_path / "camera.json").write_bytes(json_bytes(document))
    (tmp_path / "site.toml").write_text('[camera]\nfile = "camera.json"\n[calibration]\nvehicles = "camera.json"\n')
    read = read_site(tmp_path / "site.toml")
    assert read.camera is not None
    assert read.camera.known is not None
    assert read.camera.camera.T_camera_world == pytest.approx(camera.T_camera_world)
    # 5% of 5 m
    assert read.camera.known.parameters == ("z",)
    assert read.camera.known.covariance == pytest.approx(np.array([[0.0625]]))
    assert read.calibration is not None
    (prior,) = read.calibration.evidence((640, 480)).priors
    assert prior.mean == pytest.approx([5.0])


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("place = [30, 2]", "place = [30]", ["calibration.points[2].place", "2 or 3 numbers"]),
        ("place = [30, 2]", "plaze = [30, 2]", ["calibration.points[2].place", "missing"]),
        ("pixel = [600, 310]", 'pixel = ["a", 310]', ["calibration.points[2].pixel", "number"]),
        ("pixel = [600, 310]", "pixel = [nan, 310]", ["calibration.points[2].pixel", "number"]),
        ("sigma_m = 0.2", "sigma_m = 0", ["calibration.points[1].sigma_m"]),
        ('name = "kerb"', 'name = "2"', ["calibration.points[2].name", "two points"]),
        ("metres = 5.0", "metres = -5.0", ["calibration.lengths[1].metres"]),
        ("[[1, 2], [3, 4]], [[5, 6], [7, 9]]", "[[1, 2], [3, 4]]", ["calibration.parallels[1].lines"]),
        ("[[1, 2], [3, 4]],", "[[1, 2], [1, 2]],", ["calibration.parallels[1].lines"]),
        ("[[100, 200], [100, 90]]", "[[100, 200], [100, 200]]", ["calibration.verticals[1].pixels", "are the same"]),
        ("fov_deg = [60.0, 2.0]", "fov_deg = 60.0", ["calibration.fov_deg", "2 numbers"]),
        ("size = [640, 480]\nwhen", "size = [640.5, 480]\nwhen", ["calibration.size"]),
        ("when = 2026-11-25T10:00:00+01:00\nfov", 'when = "noon"\nfov', ["calibration.when", "zone"]),
        ('"Europe/Berlin"', '"../../etc/passwd"', ["time_zone", "Europe/Berlin"]),
        ('"Europe/Berlin"', '"Europe"', ["time_zone"]),
        ('time_zone = "Europe/Berlin"', "", ["start", "time_zone"]),
        ("[8.0, 10.0]]", "[8.0, 10.0], [9.0, 9.0]]", ["gates[1].line", "two ends"]),
        ("[8.0, 10.0]]", "[0.0, 10.0]]", ["gates[1].line", "its ends are the same"]),
        ("[8.0, 10.0]]", "[inf, 10.0]]", ["gates[1].line"]),
        ('"to the station", ', "", ["gates[1].directions", "two names"]),
        ('name = "north"', 'name = "a\\nb"', ["gates[1].name", "one line"]),
        ('name = "north"', "", ["gates[1].name", "missing"]),
        ("[[0, 0], [5, 0], [5, 5]]", "[[0, 0], [5, 5], [5, 0], [0, 5]]", ["zones[1].polygon", "cross"]),
        ("width = 3.5", "width = 350", ["lanes[1].width"]),
        ("foot = [15, 400]", "", ["occluders[1].foot", "missing"]),
        ('["z", "pitch"]', '["z", "pith"]', ["camera", "covariance: of"]),
        ("[0.0, 0.0001]]", "[0.0, -1.0]]", ["camera", "covariance: matrix"]),
        ("easting = 844090.0, ", "", ["world.origin.easting", "missing"]),
        ("northing = 5673189.0", "northing = 1e9", ["world.origin.northing", "number"]),
        ('utm_zone = "32N"', 'utm_zone = "61N"', ["world.utm_zone", "32N"]),
        ('utm_zone = "32N"', "", ["world.utm_zone", "missing"]),
        ("epsg = 32632", "epsg = 32632.5", ["world.epsg", "whole"]),
        ("scale = 1.0010604", "scale = 0", ["world.scale"]),
        ('file = "plan.png"', "", ["plan.file", "picture"]),
        ("metres_per_pixel = 0.05", "metres_per_pixel = 0", ["plan.metres_per_pixel"]),
        ("origin = [-20.0, 60.0]", "origin = [-20.0]", ["plan.origin", "2 numbers"]),
        ("yaw_deg = 90.0", f"yaw_deg = {'9' * 400}", ["camera.yaw_deg", "number"]),
        ("yaw_deg = 90.0", f"yaw_deg = {'9' * 5000}", ["TOML"]),
        ("width = 3.5", f"width = {'[' * 20000}{']' * 20000}", ["TOML", "deeply"]),
        ("[[zones]]", "[zones]", ["zones", "list of tables"]),
        ("[calibration]", "[calibration", ["TOML"]),
    ],
)
def test_what_is_wrong_is_told_in_one_line(site: Path, old: str, new: str, said: list[str]) -> None:
    assert WHOLE.count(old) == 1
    site.write_text(WHOLE.replace(old, new))
    with pytest.raises(UserError) as error:
        read_site(site)
    line = str(error.value)
    assert line.startswith(f"{site}: ")
    assert "\n" not in line
    assert len(line) < len(str(site)) + 400
    assert all(word in line for word in said), line


@pytest.mark.parametrize(
    ("zone", "start", "said"),
    [
        ("Europe/Berlin", "2026-03-29T02:30:00", ["there is no such time in Europe/Berlin"]),
        ("America/New_York", "2026-03-08T02:00:00", ["there is no such time in America/New_York"]),
        ("Europe/Berlin", "2026-10-25T02:30:00", ["twice", "02:30:00+02:00 or 2026-10-25 02:30:00+01:00"]),
        ("America/New_York", "2026-11-01T01:59:59", ["twice", "01:59:59-04:00 or 2026-11-01 01:59:59-05:00"]),
        ("Europe/Berlin", "0001-01-01T00:00:00", ["year from 1900 to 2899"]),
        ("Europe/Berlin", "0001-01-01T00:00:00+01:00", ["year from 1900 to 2899"]),
    ],
)
def test_a_start_that_clocks_never_show_or_show_twice_is_rejected(
    site: Path, zone: str, start: str, said: list[str]
) -> None:
    """`--start-time` rejects the same times for the same reason."""
    site.write_text(f'time_zone = "{zone}"\nstart = {start}\n')
    with pytest.raises(UserError) as error:
        read_site(site)
    line = str(error.value)
    assert line.startswith(f"{site}: start: ")
    assert "\n" not in line
    assert all(word in line for word in said), line


@pytest.mark.parametrize(
    ("zone", "start", "utc"),
    [
        ("Europe/Berlin", "2026-03-29T01:59:59", "2026-03-29T00:59:59+00:00"),
        ("Europe/Berlin", "2026-03-29T03:00:00", "2026-03-29T01:00:00+00:00"),
        ("Europe/Berlin", "2026-10-25 02:30:00+01:00", "2026-10-25T01:30:00+00:00"),
        ("America/New_York", "2026-11-01T02:00:00", "2026-11-01T07:00:00+00:00"),
        ("America/New_York", "2026-11-01 01:30:00-04:00", "2026-11-01T05:30:00+00:00"),
        ("Asia/Tokyo", "2026-03-29T02:30:00", "2026-03-28T17:30:00+00:00"),
    ],
)
def test_a_start_near_a_change_of_clocks(site: Path, zone: str, start: str, utc: str) -> None:
    site.write_text(f'time_zone = "{zone}"\nstart = {start}\n')
    read = read_site(site)
    assert read.start is not None
    assert read.start.astimezone(UTC).isoformat() == utc


def test_a_gate_has_a_line_or_pixels_or_both(site: Path) -> None:
    row = '[[gates]]\nname = "g"\n'
    drawn, surveyed = "pixels = [[4, 5], [60, 7]]\nsize = [640, 480]\n", "line = [[0, 1], [8, 1]]\n"
    for text, line, pixels, size in (
        (drawn, (), ((4, 5), (60, 7)), (640, 480)),
        (surveyed, ((0, 1), (8, 1)), (), None),
        (drawn + surveyed, ((0, 1), (8, 1)), ((4, 5), (60, 7)), (640, 480)),
    ):
        site.write_text(row + text)
        (gate,) = read_site(site).gates
        assert (gate.line, gate.pixels, gate.size) == (line, pixels, size)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "gates[1].line: missing: draw the gate (`pixels`) or survey it (`line`)"),
        ("pixels = [[4, 5]]", "gates[1].pixels: expected two"),
        ("pixels = [[4, 5], [4, 5]]", "gates[1].pixels: its ends are the same"),
        ("pixels = [[4, 5], [6, 7]]\nsize = [640]", "gates[1].size: expected 2 numbers"),
        ("pixels = [[4, 5], [6, 7]]\nsize = [640.5, 480]", "gates[1].size: expected the width and height"),
    ],
)
def test_a_wrong_gate_is_named_with_its_field(site: Path, text: str, expected: str) -> None:
    site.write_text(f'[[gates]]\nname = "g"\n{text}\n')
    with pytest.raises(UserError) as error:
        read_site(site)
    assert expected in str(error.value)


def test_files_that_are_no_text_are_refused(site: Path) -> None:
    site.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UserError, match="not UTF-8"):
        read_site(site)
    with pytest.raises(UserError, match="no such file"):
        read_site(site.with_name("other.toml"))


def test_the_size_of_marked_images_is_needed(site: Path) -> None:
    site.write_text(WHOLE.replace("size = [640, 480]\nwhen", "when"))
    marks = read_site(site).calibration
    assert marks is not None
    assert marks.evidence((800, 600)).size == (800, 600)
    with pytest.raises(UserError, match=r"calibration.size: missing"):
        marks.evidence()


# --------------------------------------------------------------------------------------------------------------- saving


def test_saving_keeps_comments_and_what_nobody_knows(site: Path) -> None:
    before = read_site(site)
    gate = {"name": "north", "line": [[0.0, 11.0], [8.0, 11.0]]}
    points = [
        {"pixel": [13.0, 301.0], "place": [3.0, 12.5, 0.0], "name": "kerb"},
        {"pixel": [600, 310], "place": [30, 2]},
        {"pixel": [50.0, 60.0], "place": [1.0, 2.0, 0.0], "name": "new"},
    ]
    after = save_site(site, {"gates": [gate], "calibration": {"points": points}}, before.revision)
    text = site.read_text()
    expected = (
        WHOLE.replace("[[0.0, 10.0], [8.0, 10.0]]", "[[0.0, 11.0], [8.0, 11.0]]")
        .replace("pixel = [12.5, 300.0]", "pixel = [13.0, 301.0]")
        .splitlines()
    )
    added = [line for line in text.splitlines() if line not in expected]
    assert [line for line in expected if line not in text.splitlines()] == []
    assert len(added) == 1
    assert '"new"' in added[0]
    assert read_site(site).revision == after.revision != before.revision
    assert after.calibration is not None
    assert after.calibration.points[0].sigma_m == 0.2


def test_rows_are_known_by_their_names(site: Path) -> None:
    rows = [
        {"name": "west", "line": [[0, 0], [1, 0]]},
        {"name": "north", "line": [[0.0, 10.0], [8.0, 10.0]]},
    ]
    save_site(site, {"gates": rows}, read_site(site).revision)
    gates = {gate.name: gate for gate in read_site(site).gates}
    assert list(gates) == ["west", "north"]
    assert gates["west"].directions is None
    assert gates["north"].directions == ("to the station", "to the bridge")
    # A gate that is renamed keeps what it has besides; one that is removed leaves nothing behind.
    save_site(site, {"gates": [{"name": "east", "line": [[0, 0], [1, 0]]}, rows[1]]}, read_site(site).revision)
    assert 'colour = "red"' in site.read_text()
    save_site(site, {"gates": [{"name": "east", "line": [[0, 0], [1, 0]]}]}, read_site(site).revision)
    assert "colour" not in site.read_text()
    save_site(site, {"gates": None, "time_zone": None, "start": None}, read_site(site).revision)
    assert read_site(site).gates == ()
    assert "time_zone" not in site.read_text()


def test_what_somebody_else_has_saved_is_not_lost(site: Path) -> None:
    revision = read_site(site).revision
    site.write_text(WHOLE + "# mine\n")
    with pytest.raises(UserError, match="has been changed since it was read"):
        save_site(site, {"time_zone": "Europe/Paris"}, revision)
    assert site.read_text() == WHOLE + "# mine\n"
    with pytest.raises(UserError, match="exists already"):
        save_site(site, {"time_zone": "Europe/Paris"}, None)


def test_of_many_that_save_at_once_one_wins(site: Path) -> None:
    revision, done = read_site(site).revision, []

    def save(k: int) -> None:
        try:
            save_site(site, {"lanes": [{"name": str(k), "line": [[0, 0], [0, k + 1]]}]}, revision)
            done.append(k)
        except UserError:
            pass

    threads = [threading.Thread(target=save, args=(k,)) for k in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(done) == 1
    assert [lane.name for lane in read_site(site).lanes] == [str(done[0])]
    assert [path.name for path in site.parent.iterdir()] == ["site.toml"]


def test_nothing_is_saved_that_could_not_be_read(site: Path) -> None:
    with pytest.raises(UserError, match=r"gates\[1\].line"):
        save_site(site, {"gates": [{"name": "north", "line": [[0, 0]]}]}, read_site(site).revision)
    with pytest.raises(UserError, match="cannot be saved"):
        save_site(site, {"gates": object()}, read_site(site).revision)
    assert site.read_text() == WHOLE


def test_a_new_file_and_a_link(tmp_path: Path) -> None:
    made = save_site(tmp_path / "new.toml", {"time_zone": "Europe/Paris"}, None)
    assert read_site(tmp_path / "new.toml").time_zone == "Europe/Paris"
    (tmp_path / "link.toml").symlink_to("new.toml")
    (tmp_path / "new.toml").chmod(0o640)
    save_site(tmp_path / "link.toml", {"time_zone": "Europe/Rome"}, made.revision)
    assert (tmp_path / "link.toml").is_symlink()
    assert read_site(tmp_path / "new.toml").time_zone == "Europe/Rome"
    assert (tmp_path / "new.toml").stat().st_mode & 0o777 == 0o640
    with pytest.raises(UserError, match="no such folder"):
        save_site(tmp_path / "nowhere" / "site.toml", {}, None)
