"""Left-hand traffic: its scenery is grown in a mirror, where the network is one for right-hand traffic.

The mirror takes y to -y. What stands beside the road, signals, markings and sidewalks then need to know of one side
only; `RoadGraph.mirrored` says that results have to be taken back.
"""

import re
from typing import Final
from xml.etree import ElementTree

_MIRRORED_TURNS: Final = {"l": "r", "r": "l", "L": "R", "R": "L"}
_ROOT: Final = re.compile(rb"<net\b[^>]*>")


def is_lefthand(network: bytes) -> bool:
    """Whether a SUMO network's root says so."""
    root = _ROOT.search(network)
    return root is not None and re.search(rb'\blefthand="(true|1)"', root[0]) is not None


def mirrored_town(network: bytes) -> bytes:
    """The network seen in the mirror: shapes reflected, right turns made left ones and the other way round."""
    root = ElementTree.fromstring(network)
    root.attrib.pop("lefthand", None)
    for element in root.iter():
        if "shape" in element.attrib:
            element.set("shape", " ".join(map(_reflected, element.attrib["shape"].split())))
        if element.tag == "junction" and "y" in element.attrib:
            element.set("y", _negative(element.attrib["y"]))
        if element.tag == "connection" and "dir" in element.attrib:
            element.set("dir", _MIRRORED_TURNS.get(element.attrib["dir"], element.attrib["dir"]))
        if element.tag == "location":
            x0, y0, x1, y1 = element.attrib["convBoundary"].split(",")
            element.set("convBoundary", ",".join((x0, _negative(y1), x1, _negative(y0))))
    return ElementTree.tostring(root)


def _reflected(point: str) -> str:
    x, y, *z = point.split(",")
    return ",".join((x, _negative(y), *z))


def _negative(number: str) -> str:
    return number[1:] if number.startswith("-") else f"-{number}"
