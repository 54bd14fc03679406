"""The towns' networks are what their sources say, can be driven through, and lie where the scenery has its roads."""

import itertools
import xml.etree.ElementTree as ET
from collections import Counter
from typing import Any

import numpy as np
import pytest
import shapely
from shapely import LineString

from skope.gen.inspect.town_maps import town_map
from skope.gen.labels.ignore_rules import Rules
from skope.gen.pipeline.config import from_preset, presets
from skope.gen.render.materials import GROUND_MATERIALS
from skope.gen.scenery.bridges_and_barriers import BRIDGE_SIZES
from skope.gen.scenery.build import scenery
from skope.gen.towns.land_use import Layout
from skope.gen.towns.road_graph import RoadGraph, driven
from skope.gen.towns.sites import sites
from skope.gen.towns.town import Town, source_digest, town_folder, towns
from tests.gen.rays import cast

CLEARANCE = 4.2
"""Over lanes there is nothing below that, metres."""


@pytest.fixture(scope="module", params=towns(), ids=lambda town: town.name)
def town(request: pytest.FixtureRequest) -> Town:
    found: Town = request.param
    return found


def by_size() -> list[Any]:
    """The towns, of which the largest are slow."""
    large = ("town03", "town04", "town06", "town07")
    return [pytest.param(t, id=t.name, marks=[pytest.mark.slow] * (t.name in large)) for t in towns()]


def sources(town: Town, kind: str, tag: str) -> list[dict[str, str]]:
    path = town_folder(town.name) / "source" / f"town.{kind}.xml"
    return [element.attrib for element in ET.parse(path).iter(tag)] if path.is_file() else []


def lane_pieces(town: Town, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Pieces of all lanes that are not in junctions: (N,) polygons and (N, 2, 3) their ends."""
    shapes, ends = [], []
    graph = RoadGraph.of(town)
    for edge in graph.edges:
        for lane in driven(edge):
            line = np.array(lane.getShape3D())
            along = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(line[:, :2], axis=0).T))])
            at = np.linspace(0.5, along[-1] - 0.5, max(2, round(along[-1] / step) + 1))
            points = np.column_stack([np.interp(at, along, line[:, k]) for k in range(3)])
            for a, b in itertools.pairwise(points):
                half = lane.getWidth() / 2 - 0.05
                shapes.append(LineString([a[:2], b[:2]]).buffer(half, cap_style="flat"))
                ends.append([a, b])
    return np.array(shapes, dtype=object), np.array(ends)


def test_compiled_networks_are_of_their_sources(town: Town) -> None:
    """Run scripts/compile_towns.py when this fails."""
    text = town.network.read_text(encoding="utf-8")
    assert f"from sources {source_digest(town.name)} " in text
    assert "generated on" not in text
    root = ET.fromstring(text)
    edges = {edge.get("id"): edge for edge in root.iter("edge") if edge.get("function") is None}
    nodes = {node.get("id"): node for node in root.iter("junction") if node.get("type") != "internal"}
    types = {row["id"]: row for row in sources(town, "typ", "type")}
    rows = sources(town, "edg", "edge")
    assert edges.keys() == {row["id"] for row in rows}
    for row in rows:
        edge, kind = edges[row["id"]], types[row["type"]]
        assert (edge.get("from"), edge.get("to"), edge.get("type")) == (row["from"], row["to"], row["type"])
        lanes = list(edge.iter("lane"))
        assert len(lanes) == int(row.get("numLanes", kind["numLanes"]))
        assert float(lanes[0].attrib["speed"]) == float(kind["speed"])
    rows = sources(town, "nod", "node")
    assert nodes.keys() == {row["id"] for row in rows}
    for row in rows:
        for axis in ("x", "y", "z"):
            assert float(nodes[row["id"]].get(axis, 0)) == pytest.approx(float(row.get(axis, 0)), abs=0.006)


def test_every_way_in_leads_to_every_other_end(town: Town) -> None:
    net = RoadGraph.of(town).net
    edges = net.getEdges(withInternal=False)
    ways_in = [edge for edge in edges if not edge.getIncoming()]
    ways_out = [edge for edge in edges if not edge.getOutgoing()]
    assert len(ways_in) >= 4
    assert {edge.getFromNode().getID() for edge in ways_in} >= {edge.getToNode().getID() for edge in ways_out} - {
        "east_out",
        "west_out",
    }
    for start in ways_in:
        reached = [end for end in ways_out if net.getShortestPath(start, end)[0] is not None]
        others = [end for end in reached if end.getToNode() is not start.getFromNode()]
        assert others, start.getID()
    for site in Layout.of(town).sites:
        # Whoever enters does so far from what a camera looks at closely.
        far = [np.hypot(*(np.array(edge.getFromNode().getCoord()) - site.position[:2])) for edge in ways_in]
        assert min(far) > 100, site.name


@pytest.mark.parametrize("town", by_size(), indirect=True)
def test_the_road_lies_where_vehicles_drive(town: Town) -> None:
    """Straight below lanes, bridges included, the ground is at the lanes' height."""
    mesh = scenery(town).mesh
    is_ground = np.array([name in GROUND_MATERIALS for name in mesh.materials])[mesh.material]
    corners = mesh.vertices[mesh.triangles[is_ground]]
    tree = shapely.STRtree(shapely.polygons(corners[..., :2]))
    _, ends = lane_pieces(town, 3.1)
    places = ends[:, 0]
    place, triangle = tree.query(shapely.points(places[:, :2]), predicate="intersects")
    a, b, c = np.moveaxis(corners[triangle], 1, 0)
    normal = np.cross(b - a, c - a)
    height = a[:, 2] - ((places[place, :2] - a[:, :2]) * normal[:, :2]).sum(axis=1) / normal[:, 2]
    height[height > places[place, 2] + 2.0] = -np.inf  # a bridge over it
    top = np.full(len(places), -np.inf)
    np.maximum.at(top, place, height)
    assert np.abs(top - places[:, 2]).max() < 0.01


@pytest.mark.parametrize("town", by_size(), indirect=True)
def test_nothing_is_in_the_way_over_lanes(town: Town) -> None:
    mesh = scenery(town).mesh
    corners = mesh.vertices[mesh.triangles]
    # Slopes of the ground itself rise within a piece of lane.
    step = np.where(np.array([name in GROUND_MATERIALS for name in mesh.materials])[mesh.material], 0.5, 0.15)
    shapes, ends = lane_pieces(town, 4.0)
    outlines = shapely.linestrings(corners[:, [0, 1, 2, 0], :2])
    piece, triangle = shapely.STRtree(outlines).query(shapes, predicate="intersects")
    low, high = ends[piece, :, 2].max(axis=1) + step[triangle], ends[piece, :, 2].max(axis=1) + CLEARANCE
    z = corners[triangle][..., 2]
    inside = (z.max(axis=1) > low) & (z.min(axis=1) < high)
    assert not inside.any(), corners[triangle[inside]][:3]
    assert BRIDGE_SIZES.gantry_clearance_m > CLEARANCE


@pytest.mark.parametrize("town", by_size(), indirect=True)
def test_sites_see_the_carriageway_and_have_nothing_before_them(town: Town) -> None:
    mesh = scenery(town).mesh
    _, ends = lane_pieces(town, 2.0)
    places = ends.mean(axis=1)
    for site in Layout.of(town).sites:
        camera = site.camera((1280, 720), 110.0)
        near = places[np.linalg.norm(places - site.position, axis=1) < 60.0]
        pixels, _, valid = camera.project(near)
        seen = valid & (pixels >= 0).all(axis=-1) & (pixels < [1280, 720]).all(axis=-1)
        assert seen.sum() >= 25, site.name
        u, v = np.meshgrid(np.linspace(20, 1260, 14), np.linspace(20, 700, 9))
        rays, _ = camera.rays(np.stack([u, v], axis=-1).reshape(-1, 2))
        directions = rays @ camera.T_camera_world[:3, :3]
        corners = mesh.vertices[mesh.triangles]
        close = np.linalg.norm(corners - site.position, axis=-1).min(axis=1) < 8.0
        distances, _ = cast(np.array(site.position), directions, corners[close])
        assert (distances * np.linalg.norm(directions, axis=-1)).min() > 3.0, site.name


def test_cameras_hang_as_road_authorities_hang_them() -> None:
    for town in towns():
        layout = Layout.of(town)
        assert len(layout.sites) == 4
        for site in layout.sites:
            assert site.name.startswith(town.name.replace("town", "t")), site.name
            assert 5.0 <= site.position[2] - layout.road_below(site) <= 12.0, site.name
            assert 8.0 <= site.pitch_deg <= 35.0, site.name
            assert site.mounting
            assert site.sees


def test_splits_and_presets() -> None:
    counts = Counter(site.split for site in sites().values())
    assert counts == {"train": 10, "easy": 1, "medium": 1, "hard": 1, "extra": 15}
    made = {}
    for name in presets():
        made[name] = from_preset(name, seed=0, renderer="gl", driver="", rules=Rules())
    assert (len(made["demo"].parameters.sites), made["demo"].images) == (13, 156)
    assert (len(made["paper"].parameters.sites), made["paper"].images) == (13, 13_500)
    assert (len(made["full"].parameters.sites), made["full"].images) == (28, 25_004)
    assert sum(plan.frames for plan in made["paper"].plans()) == 13_500
    assert made["varied"].images == 13_500
    assert made["varied"].parameters.variation.cameras["height_m"] == (4, 20)


def test_a_plan_shows_roads_and_cameras() -> None:
    image = town_map(Town("town01"))
    assert max(image.shape[:2]) >= 1600
    layout = Layout.of(Town("town01"))
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 4
    assert layout.style.title
