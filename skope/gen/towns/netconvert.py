"""SUMO's netconvert, which compiles the networks of towns and converts maps from other sources."""

import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from skope.errors import UserError

COMMON_OPTIONS: Final[Mapping[str, str]] = {
    "output.street-names": "false",
    "offset.disable-normalization": "true",
    "default.lanewidth": "3.3",
    "tls.yellow.time": "3",
    # Signals are actuated by the traffic: no vehicle waits for an empty road, and queues are served before red.
    "tls.default-type": "actuated",
    "tls.min-dur": "5",
    "tls.max-dur": "25",
    # Maximum lateral acceleration in a turn, m/s^2.
    "junctions.limit-turn-speed": "4",
    "no-turnarounds": "true",
    "junctions.corner-detail": "8",
    "junctions.internal-link-detail": "12",
}
MAP_OPTIONS: Final[Mapping[str, str]] = {
    "geometry.remove": "true",
    "ramps.guess": "true",
    "junctions.join": "true",
    "tls.discard-simple": "true",
    "roundabouts.guess": "true",
    "keep-edges.by-vclass": "passenger",
}
COMMENT_PATTERN: Final = re.compile(r"<!--.*?-->", re.DOTALL)


def program() -> str | None:
    """Return the netconvert program next to this Python, else the one in the path; None if there is none."""
    beside = Path(sys.executable).with_name("netconvert")
    return str(beside) if beside.is_file() else shutil.which("netconvert")


def netconvert(options: Mapping[str, str], header: str = "") -> str:
    """Run netconvert and return the network, with a fixed comment instead of its header with date and paths.

    Raises UserError with netconvert's message if it fails, and if it is not installed.
    """
    command = program()
    if command is None:
        raise UserError("netconvert is not installed: pip install 'skope[maps]'")
    with tempfile.TemporaryDirectory() as scratch:
        made = Path(scratch) / "made.net.xml"
        flags = [f"--{name}={value}" for name, value in {**options, "output-file": str(made)}.items()]
        done = subprocess.run([command, *flags], capture_output=True, text=True, check=False)
        if done.returncode or not made.is_file():
            errors = [line for line in done.stderr.splitlines() if line.startswith("Error")]
            raise UserError(f"netconvert: {(errors or ['Error: failed'])[0].removeprefix('Error: ')}")
        return COMMENT_PATTERN.sub(f"<!-- {header} -->" if header else "", made.read_text(encoding="utf-8"), count=1)


def from_map(path: Path, kind: str, origin: tuple[float, float] | None, *, lefthand: bool, height: float = 0.0) -> str:
    """Convert an OpenStreetMap ("osm") or OpenDRIVE ("opendrive") file to a network.

    Args:
        path: Path of the map file.
        kind: "osm" or "opendrive".
        origin: Latitude and longitude, in degrees, of the point (0, 0) of an OpenStreetMap file; x east and y north.
        lefthand: Whether traffic drives on the left.
        height: Height in the map that becomes z = 0, metres.
    """
    options = {**COMMON_OPTIONS, **MAP_OPTIONS, f"{kind}-files": str(path)}
    if height:
        options["offset.z"] = repr(-height)
    if lefthand:
        options["lefthand"] = "true"
    if kind == "osm":
        assert origin is not None
        latitude, longitude = origin
        options["proj"] = f"+proj=tmerc +lat_0={latitude!r} +lon_0={longitude!r} +ellps=WGS84 +units=m +no_defs"
    return netconvert(options)
