"""Where the gates of a generated clip lie, by a rule that knows the road network and the camera alone.

    python scripts/research/traffic_gates.py t06_plaza_opening --size 1280x720 --out clips/plaza_day

One lies across each arm of a junction, 10 to 40 m from it, or across a road that has none so near; wholly inside the
image, with some road before and behind. It writes site.toml.
"""

import argparse
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from traffic_truth import FOV_DEG

from skope.camera.model import Camera
from skope.gen.towns.road_graph import RoadGraph, beside, legs
from skope.gen.towns.sites import site
from skope.site.gates_zones_lanes import Gate
from skope.types import Array

SITE: Final = "site.toml"
FROM_JUNCTION_M: Final = (10.0, 40.0)
STEP_M: Final = 2.5
BESIDE_M: Final = 3.0
"""A gate goes on so far beyond the outermost lanes: across the pavements, on which people walk up to 2.1 m away."""
BEFORE_M: Final = 7.0
"""Of the road so much before and behind a gate is in the image."""
HIGHEST_M: Final = 1.5
"""Up to this height."""
MARGIN: Final = 0.03
"""Inside the image by this share of its size."""
FARTHEST_M: Final = 80.0
USUAL_M: Final = 35.0
"""Where no junction is near, a gate lies so far from the camera, about."""


@dataclass(frozen=True)
class _Place:
    """A place where a gate may lie."""

    line: Array
    """(2, 2) from its first to its second end, so that who drives towards the junction comes from its left."""
    from_junction: float
    """Metres along the road; infinite where there is none."""
    from_camera: float


def gates_of(graph: RoadGraph, camera: Camera, level: float) -> list[Gate]:
    """Gates across the arms that a camera sees, by the rule of this module."""
    arms: dict[frozenset[str], list[Any]] = {}
    for edge in graph.edges:
        arms.setdefault(frozenset((edge.getFromNode().getID(), edge.getToNode().getID())), []).append(edge)
    chosen = []
    for edges in arms.values():
        places = [place for place in _places(graph, edges, camera.position) if _seen(place, camera, level)]
        near = [place for place in places if FROM_JUNCTION_M[0] <= place.from_junction <= FROM_JUNCTION_M[1]]
        if near:
            chosen.append(min(near, key=lambda one: (one.from_junction, one.from_camera)))
        elif places:
            chosen.append(min(places, key=lambda one: abs(one.from_camera - USUAL_M)))
    chosen.sort(key=lambda one: one.from_camera)
    return [
        Gate(
            name=f"arm{number}",
            line=tuple((round(float(x), 2), round(float(y), 2)) for x, y in place.line),
            directions=("in", "out"),
        )
        for number, place in enumerate(chosen, start=1)
    ]


def _places(graph: RoadGraph, edges: Sequence[Any], eye: Array) -> Iterator[_Place]:
    """Places along an arm, from either of its ends; across all its lanes."""
    lanes = np.concatenate([graph.lane_points[str(edge.getID())][:, :2] for edge in edges])
    half = max(lane.getWidth() for edge in edges for lane in edge.getLanes()) / 2
    edge = edges[0]
    length = edge.getLength()
    for s in np.arange(STEP_M, length, STEP_M):
        at, heading = beside(edge, float(s), 0.0)
        at = graph.world(at)
        ahead = graph.world([math.cos(heading), math.sin(heading)])
        left = np.array([-ahead[1], ahead[0]])
        near = np.abs((lanes - at) @ ahead) < 1.0
        aside = ((lanes - at) @ left)[near]
        if not len(aside):
            continue
        low, high = aside.min() - half - BESIDE_M, aside.max() + half + BESIDE_M
        for node, away, sign in ((edge.getToNode(), length - s, 1), (edge.getFromNode(), s, -1)):
            # Who drives along `ahead` has the line's first end on the right, and so comes from its left.
            ends = (low, high) if sign > 0 else (high, low)
            line = np.array([at + left * end for end in ends])
            yield _Place(line, float(away) if _is_junction(node) else math.inf, math.dist(line.mean(axis=0), eye[:2]))


def _is_junction(node: Any) -> bool:
    """Whether three or more arms meet at a node."""
    others = {n.getID() for edge in legs(node) for n in (edge.getFromNode(), edge.getToNode())} - {node.getID()}
    return len(others) > 2


def _seen(place: _Place, camera: Camera, level: float) -> bool:
    along = place.line[1] - place.line[0]
    ahead = np.array([along[1], -along[0]]) / np.linalg.norm(along)
    points = [
        [*(end + ahead * shift), level + height]
        for end in place.line
        for shift in (-BEFORE_M, BEFORE_M)
        for height in (0.0, HIGHEST_M)
    ]
    pixels, _, valid = camera.project(np.array(points))
    size = np.array([camera.width, camera.height])
    inside = ((pixels > MARGIN * size) & (pixels < (1 - MARGIN) * size)).all()
    return bool(valid.all() and inside and place.from_camera < FARTHEST_M)


def write_site(path: Path, gates: Sequence[Gate]) -> None:
    """Write a site file with these gates and nothing else."""
    rows = []
    for gate in gates:
        line = [list(end) for end in gate.line]
        rows.append(f'[[gates]]\nname = "{gate.name}"\nline = {line}\ndirections = {list(gate.directions or ())}\n')
    path.write_text("\n".join(rows).replace("'", '"'))


def road_of(name: str, size: str) -> tuple[RoadGraph, Camera, float]:
    """Network, camera and height of the road of a site; `size` of the image as 1280x720."""
    width, height = map(int, size.split("x"))
    here = site(name)
    graph, camera = RoadGraph.of(here.town), here.camera((width, height), FOV_DEG)
    yaw = camera.angles[0]
    return graph, camera, graph.road_level(camera.position[:2] + 25 * np.array([math.cos(yaw), math.sin(yaw)]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("site", help="a site of `skope gen sites`")
    parser.add_argument("--size", default="1280x720")
    parser.add_argument("--out", type=Path, required=True, help="folder of the clip")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    gates = gates_of(*road_of(options.site, options.size))
    write_site(options.out / SITE, gates)
    for gate in gates:
        print(gate.name, *gate.line)


if __name__ == "__main__":
    main()
