"""Files of marked points, places on the Earth as metres, and errors of points that are left out."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skope.camera.calibrate import calibrate, left_out_errors
from skope.camera.evidence import Evidence, MarkedPoint
from skope.camera.geographic import local_metres, utm_metres, utm_scale
from skope.camera.ground_plane import intersect_ground
from skope.camera.model import Camera
from skope.camera.point_files import read_points
from skope.errors import UserError

POINTS = {
    "1": {"x_px": 20, "y_px": 250, "hemisphere": "N", "zone_utm": 31, "lon_utm": 850010.5, "lat_utm": 5500020.25},
    "2": {"x_px": 600, "y_px": 130, "hemisphere": "N", "zone_utm": 31, "lon_utm": 850000.5, "lat_utm": 5500000.25},
    "gate": {"x_px": 300, "y_px": 200, "hemisphere": "N", "zone_utm": 31, "lon_utm": 849990.5, "lat_utm": 5499990.25},
}


def otrfpts(path: Path, **changes: Any) -> Path:
    document = {name: dict(row) for name, row in POINTS.items()}
    document["2"].update(changes)
    path.write_text(json.dumps(document))
    return path


def test_reference_points_keep_their_own_zone(tmp_path: Path) -> None:
    """Zone 31 ends at an easting of about 720 km here."""
    read = read_points(otrfpts(tmp_path / "a.otrfpts"))
    assert [point.name for point in read.points] == ["1", "2", "gate"]
    assert read.points[0].pixel.tolist() == [20.0, 250.0]
    assert read.world is not None
    origin = np.array([read.world["origin"]["easting"], read.world["origin"]["northing"]])
    assert (read.world["utm_zone"], read.world["epsg"]) == ("31N", 32631)
    for point, row in zip(read.points, POINTS.values(), strict=True):
        assert point.place[:2] + origin == pytest.approx([row["lon_utm"], row["lat_utm"]], abs=1e-6)
        assert np.abs(point.place).max() < 100
    assert any("are too large by 0.11%" in words for words in read.notes)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"zone_utm": 32}, "zone_utm: points of 31N, 32N"),
        ({"hemisphere": "S"}, "zone_utm: points of 31N, 31S"),
        ({"zone_utm": 61}, "2.zone_utm"),
        ({"zone_utm": True}, "2.zone_utm"),
        ({"hemisphere": "north"}, "2.hemisphere"),
        ({"x_px": "far"}, "2.x_px"),
        ({"x_px": 1e9}, "pixels within"),
        ({"lat_utm": None}, "2.lat_utm"),
        ({"lat_utm": 9e6}, "20 km"),
    ],
)
def test_wrong_reference_points_are_told(changes: dict[str, Any], said: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=said) as error:
        read_points(otrfpts(tmp_path / "a.otrfpts", **changes))
    assert str(error.value).startswith(str(tmp_path))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("text", ["[]", "{}", '{"1": 3}', '{"1": {"x_px": 1}}', "{", '{"1": NaN}'])
def test_files_that_are_no_reference_points(text: str, tmp_path: Path) -> None:
    (tmp_path / "a.otrfpts").write_text(text)
    with pytest.raises(UserError, match=r"a.otrfpts"):
        read_points(tmp_path / "a.otrfpts")


def test_a_table_says_how_exact_its_points_are(tmp_path: Path) -> None:
    (tmp_path / "p.csv").write_text("name,column,row,x,y,z,sigma_m\nkerb,1,2,3,4,0.5,0.3\n,5,6,7,8,0,0.2\n")
    read = read_points(tmp_path / "p.csv")
    assert [(point.name, point.sigma_m) for point in read.points] == [("kerb", 0.3), ("2", 0.2)]
    assert read.points[0].place.tolist() == [3.0, 4.0, 0.5]
    assert read.world is None
    for line in ("kerb,1,2,3,4,nan,0.3", "kerb,1,2,3,4,0,-1", "kerb,1,2,3,4", "2,1,2,3,4,0,1\n,1,2,3,4,0,1"):
        (tmp_path / "p.csv").write_text(f"name,column,row,x,y,z,sigma_m\n{line}\n")
        with pytest.raises(UserError, match=r"p.csv: "):
            read_points(tmp_path / "p.csv")


def test_longitude_and_latitude_become_metres_by_the_ellipsoids_radii() -> None:
    """Short ways along a meridian and a parallel: arcs of the radii of curvature, by Meusnier."""
    a, f = 6378137.0, 1 / 298.257223563
    e2, at = f * (2 - f), math.radians(51.0)
    meridian = a * (1 - e2) / (1 - e2 * math.sin(at) ** 2) ** 1.5
    parallel = a / math.sqrt(1 - e2 * math.sin(at) ** 2) * math.cos(at)
    step = 1e-3
    east, north = local_metres([7.0 + step, 7.0], [51.0, 51.0 + step], (7.0, 51.0))
    assert east == pytest.approx([math.radians(step) * parallel, 0.0], abs=1e-3)
    assert north == pytest.approx([0.0, math.radians(step) * meridian], abs=1e-3)


def test_a_table_in_wgs84(tmp_path: Path) -> None:
    (tmp_path / "p.csv").write_text("column,row,longitude,latitude\n1,2,7.0,51.0\n3,4,7.0001,51.0\n5,6,7.0,51.0001\n")
    read = read_points(tmp_path / "p.csv")
    places = np.array([point.place for point in read.points])
    assert np.linalg.norm(places[1] - places[0]) == pytest.approx(7.02, abs=0.01)
    assert np.linalg.norm(places[2] - places[0]) == pytest.approx(11.13, abs=0.01)
    assert read.world is not None
    assert read.world["origin"] == {"longitude": 7.0, "latitude": 51.0}
    (tmp_path / "p.csv").write_text("column,row,longitude,latitude\n1,2,7.0,91.0\n")
    with pytest.raises(UserError, match="latitude: expected"):
        read_points(tmp_path / "p.csv")


def test_utms_scale_is_that_of_its_own_formula() -> None:
    """On the central meridian by definition; 180 km beside it the grid is true, as every map's margin says."""
    assert utm_scale(500_000, 5_500_000) == pytest.approx(0.9996)
    assert utm_scale(680_000, 5_500_000) == pytest.approx(1.0, abs=2e-5)
    assert utm_scale(320_000, 4_500_000, south=True) == pytest.approx(1.0, abs=2e-5)
    # A meridian's arc and a parallel's in the projection, by its series: 0.9996 (1 + x^2 / 2 R^2) at 344 km.
    assert utm_scale(844_000, 5_673_000) == pytest.approx(0.9996 * (1 + (344 / 6384 / 0.9996) ** 2 / 2), abs=5e-6)


@pytest.mark.parametrize(
    ("zone", "south", "longitude", "latitude", "easting", "northing"),
    [
        (32, False, 8.40034, 49.00012, 456139.56951, 5427642.34716),
        (33, False, 8.40034, 49.00012, 17434.86183, 5448487.73481),  # its neighbour's grid
        (56, True, 151.2, -33.86, 333491.22992, 6251909.20605),
        (1, False, 179.9, 10.0, 160097.00614, 1107010.39518),  # beyond where longitudes begin again
    ],
)
def test_utms_grid_is_that_of_proj(
    zone: int, south: bool, longitude: float, latitude: float, easting: float, northing: float
) -> None:
    """Numbers of PROJ 9 (pyproj 3.7, EPSG:4326 to EPSG:326xx and 327xx)."""
    assert utm_metres(longitude, latitude, zone, south=south) == pytest.approx([easting, northing], abs=1e-4)


def test_a_point_that_is_left_out_is_placed_by_the_others() -> None:
    size, rng = (1280, 720), np.random.default_rng(2)
    camera = Camera.looking([0, 0, 7.0], yaw=0.4, pitch_down=0.35, size=size, fov=1.0)
    pixels = np.array(
        [[150, 330], [1100, 300], [640, 420], [200, 650], [1100, 600], [600, 690], [900, 380], [400, 500.0]]
    )
    within = []
    for _ in range(4):
        places = intersect_ground(camera, pixels) + rng.normal(0, [0.1, 0.1, 0.03], (8, 3))
        marks = pixels + rng.normal(0, 1.5, (8, 2))
        points = tuple(MarkedPoint(a, b, name=str(k)) for k, (a, b) in enumerate(zip(marks, places, strict=True)))
        evidence = Evidence(size, points=points)
        found = calibrate(evidence)
        errors = left_out_errors(evidence, found)
        assert list(errors) == [str(k) for k in range(8)]
        within += [error.error_m <= error.stated_m for error in errors.values()]
    assert 0.8 <= np.mean(within) <= 1
    by_hand = calibrate(Evidence(size, points=points[1:]), check=False)
    away = np.linalg.norm((by_hand.places(points[0].pixel, points[0].place[2]) - points[0].place)[:2])
    assert errors["0"].error_m == pytest.approx(away, rel=0.02)
    assert left_out_errors(Evidence(size, points=points[:4]), calibrate(Evidence(size, points=points[:4]))) == {}
