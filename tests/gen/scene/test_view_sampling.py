"""Cameras at other corners: they see traffic, never the road that is tested on, and scenery makes room for them."""

import math
from dataclasses import replace

import numpy as np
import pytest
from shapely import LineString, Point

from skope.errors import UserError
from skope.gen.scene import camera_sampling
from skope.gen.scene.camera_sampling import CameraRanges, ViewSampler, road_seen
from skope.gen.towns.land_use import Layout
from skope.gen.towns.road_graph import RoadGraph
from skope.gen.towns.sites import sites
from skope.gen.towns.town import Mast, Town, Variant, towns
from skope.types import Array

SIZE = (1280, 720)
SPANS = {"fov_deg": (20.0, 110.0), "height_m": (3.0, 20.0), "pitch_deg": (4.0, 75.0), "roll_by_deg": (-3.0, 3.0)}
RANGES = CameraRanges(SIZE, 80.0, None, SPANS)


def lanes(town: Town) -> Array:
    return np.concatenate(list(RoadGraph.of(town).lane_points.values()))


def queue(town: Town, seed: int) -> Array:
    """(2, 25, 3) vehicles somewhere on the lanes, in two frames."""
    points = lanes(town)
    return points[np.random.default_rng(seed).choice(len(points), (2, 25))]


@pytest.mark.parametrize("town", towns(), ids=lambda town: town.name)
def test_no_view_shows_road_before_a_camera_of_a_test_site(town: Town) -> None:
    points, sampler = lanes(town), ViewSampler(town)
    tested = [site for site in sites().values() if site.town == town and site.split != "train"]
    assert tested
    refused = 0
    for seed in range(3):
        rng = np.random.default_rng(seed)
        camera = sampler.draw(queue(town, seed), RANGES, rng).camera
        pixels, _, valid = camera.project(points)
        shown = points[valid & camera.inside(pixels)]
        for site in tested:
            east, north, _ = (shown - site.position).T
            ahead = math.radians(site.yaw_deg)
            forward = east * math.cos(ahead) + north * math.sin(ahead)
            sideways = -east * math.sin(ahead) + north * math.cos(ahead)
            before = (np.hypot(forward, sideways) < 79) & (np.abs(np.arctan2(sideways, forward)) < math.radians(74))
            assert not before.any(), (site.name, seed)
        refused += road_seen(camera, points) < 8
    assert not refused


def test_test_sites_own_cameras_show_tested_road() -> None:
    for site in sites().values():
        shows = ViewSampler(site.town).shows_tested_road(site.camera(SIZE, 110.0))
        assert shows or site.split == "train", site.name


def test_most_views_see_vehicles_and_some_an_empty_road() -> None:
    town = Town("town05")
    points = lanes(town)
    corner = points[np.hypot(*(points[:, :2] - points[700, :2]).T) < 30][:40]  # all vehicles stand in one place
    sampler, seen = ViewSampler(town), []
    for seed in range(24):
        camera = sampler.draw(corner[None], RANGES, np.random.default_rng(seed)).camera
        pixels, depth, valid = camera.project(corner)
        seen.append((valid & camera.inside(pixels) & (depth < 150)).sum())
    empty = np.mean(np.array(seen) == 0)
    assert empty < 0.25
    assert np.mean(seen) > 8


def test_views_without_vehicles_show_an_empty_road_and_no_walls(monkeypatch: pytest.MonkeyPatch) -> None:
    """All vehicles stand in one place, so that most cameras see none; of the road before them houses hide nothing."""
    monkeypatch.setattr(camera_sampling, "CAMERA_SAMPLING", replace(camera_sampling.CAMERA_SAMPLING, empty_share=1.0))
    for name, traffic in (("town01", 300), ("town05", 700), ("town07", 100)):
        town = Town(name)
        points, graph = lanes(town), RoadGraph.of(town)
        sampler, open_ground = ViewSampler(town), graph.road.buffer(3.0)
        for seed in range(3):
            crowd = points[None, traffic : traffic + 40]
            camera = sampler.draw(crowd, RANGES, np.random.default_rng(seed)).camera
            pixels, _, valid = camera.project(points)
            eye = graph.world(camera.position[:2])
            lines = [LineString([eye, graph.world(p[:2])]) for p in points[valid & camera.inside(pixels)]]
            clear = [line.difference(Point(eye).buffer(38.0)).within(open_ground.buffer(1.0)) for line in lines]
            clear = [ok or line.length < 38 for ok, line in zip(clear, lines, strict=True)]
            assert sum(clear) >= 8, (name, seed)


def test_vehicles_are_as_large_as_is_asked_for() -> None:
    town = Town("town04")
    sampler, traffic = ViewSampler(town), queue(town, 1)
    medians = []
    for span in ((0.03, 0.06), camera_sampling.CAMERA_SAMPLING.largest_vehicle):
        views = [sampler.draw(traffic, RANGES, np.random.default_rng(seed), span) for seed in range(8)]
        shares = [sampler.vehicles_seen(view.camera, traffic)[1] for view in views]
        medians.append(np.median([share for share in shares if share]))
    assert 0.02 < medians[0] < 0.1 < medians[1]


def test_where_no_camera_sees_road_one_line_says_so() -> None:
    blind = {"fov_deg": (5.0, 5.0), "height_m": (2.0, 2.0), "pitch_deg": (84.0, 84.0)}
    town = Town("town01")
    with pytest.raises(UserError, match="cameras sees 8 m of road"):
        ViewSampler(town).draw(queue(town, 0), CameraRanges(SIZE, 80.0, None, blind), np.random.default_rng(0))


def test_scenery_leaves_room_before_the_masts() -> None:
    """Nothing of a variant's buildings stands within the clearance of its cameras, where the town's own have some."""
    from skope.gen.scenery.build import scenery

    own = scenery(Town("town01")).buildings
    house = max(own, key=lambda footprint: footprint.area)
    x, y = house.exterior.coords[0]
    mast = Mast((x, y, 7.0), 90.0, 20.0)
    moved = Town("town01", variant=Variant(3, (mast,)))
    assert [(one.position, one.yaw_deg) for one in Layout.of(moved).sites] == [(mast.position, 90.0)]
    near = [b for b in scenery(moved).buildings if np.hypot(*(np.array(b.exterior.coords) - [x, y]).T).min() < 1.0]
    assert not near
