"""Bays along kerbs: beside the carriageway, clear of what crosses the sidewalk, only where a town is grown anew."""

import numpy as np
import pytest
import shapely
from shapely import Point, Polygon

from skope.gen.scenery.build import bays_of, scenery
from skope.gen.scenery.markings import zebra_stripes
from skope.gen.towns.land_use import Bay
from skope.gen.towns.regions import rectangle_polygon
from skope.gen.towns.road_graph import RoadGraph
from skope.gen.towns.town import Town, Variant

CAR = (4.6, 1.85)


def car(graph: RoadGraph, bay: Bay) -> Polygon:
    """The ground under a car in a bay, in the graph's places."""
    corners = shapely.get_coordinates(rectangle_polygon(np.array(bay.position), bay.heading, *CAR))
    return Polygon(graph.world(corners))


@pytest.mark.parametrize("name", ["town01", *(pytest.param(n, marks=pytest.mark.slow) for n in ("town02", "town03"))])
def test_cars_along_kerbs_stand_beside_the_carriageway(name: str) -> None:
    town = Town(name, variant=Variant(7))
    graph = RoadGraph.of(town)
    grown = scenery(town)
    assert bays_of(town) == grown.bays
    cars = [car(graph, bay) for bay in grown.bays]
    assert not [one for one in cars if one.intersects(graph.road)]
    along = [one for one in cars if one.distance(graph.road) < 0.4]
    assert len(along) > 60
    stripes = shapely.union_all(list(zebra_stripes(graph)))
    houses = shapely.union_all([Polygon(graph.world(shapely.get_coordinates(house))) for house in grown.buildings])
    for one in along:
        assert one.distance(stripes) > 4
        assert not one.intersects(houses)
    assert max(len(shapely.STRtree(cars).query(one, predicate="intersects")) for one in along) == 1
    pits = [Point(graph.world((x, y))).distance(one) for x, y, _ in grown.trees for one in along]
    assert min(pits) > 0.3  # no tree stands in a bay


def test_the_towns_of_the_package_have_none() -> None:
    for name in ("town01", "town02"):
        graph = RoadGraph.of(Town(name))
        assert min(car(graph, bay).distance(graph.road) for bay in bays_of(Town(name))) > 0.4


def test_another_seed_parks_elsewhere() -> None:
    one, other = (bays_of(Town("town03", variant=Variant(seed))) for seed in (1, 2))
    assert one != other
