"""Conflicts against those that SUMO's SSM device finds in traffic whose places are known exactly."""

import math
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from skope.site.traffic_settings import TrafficSettings
from skope.tracks.track import Track
from skope.traffic.conflicts import Conflict, conflicts
from tests.traffic.drives import drive

ROAD = Path(__file__).parents[2] / "examples/own_road"
SIZES = {"lorry": (8.0, 2.4)}
RECKLESS = 'length="4.5" width="1.8" jmIgnoreFoeProb="0.35" jmIgnoreFoeSpeed="30" jmIgnoreJunctionFoeProb="0.2"'
RUN = """
import libsumo
libsumo.start(["sumo", "-n", "net.xml", "-r", "flows.xml", "--step-length", "0.1", "--end", "700", "--seed", "3",
    "--no-step-log", "true", "--no-warnings", "true", "--collision.action", "none", "--device.ssm.probability", "1",
    "--device.ssm.measures", "TTC DRAC PET", "--device.ssm.thresholds", "1.5 3.4 5.0", "--device.ssm.range", "60",
    "--device.ssm.file", "ssm.xml", "--fcd-output", "fcd.xml", "--lateral-resolution", "0.4"])
for _ in range(7000):
    libsumo.simulationStep()
libsumo.close()
"""


def driven(folder: Path) -> dict[str, Track]:
    """The vehicles by their names; SUMO says where the middle of their front is."""
    rows: dict[str, list[list[float]]] = {}
    sizes = {}
    for _, step in ElementTree.iterparse(folder / "fcd.xml"):
        if step.tag == "timestep":
            for one in step:
                heading = math.radians(90 - float(one.get("angle", "")))
                row = [float(step.get("time", "")), float(one.get("x", "")), float(one.get("y", "")), heading]
                rows.setdefault(one.get("id", ""), []).append(row)
                sizes[one.get("id", "")] = SIZES.get(one.get("type", ""), (4.5, 1.8))
            step.clear()
    out = {}
    for number, (name, own) in enumerate(rows.items()):
        t, x, y, heading = np.array(own).T
        length, width = sizes[name]
        middle = np.stack([x - length / 2 * np.cos(heading), y - length / 2 * np.sin(heading)], axis=1)
        if len(t) > 5:
            out[name] = drive(number, middle, t, sigma=0.0, heading=heading, length=length, width=width)
    return out


def told(folder: Path) -> Iterator[tuple[str, str, float]]:
    """Pairs, and SUMO's post-encroachment time: by when lanes are left and entered, seconds."""
    for one in ElementTree.parse(folder / "ssm.xml").getroot():
        pet = one.find("PET")
        if pet is not None and pet.get("value") not in ("NA", "", None) and 0 < float(pet.get("value", "")) < 4.5:
            yield one.get("ego", ""), one.get("foe", ""), float(pet.get("value", ""))


@pytest.mark.slow
def test_encroachment_is_what_sumo_says_where_bodies_do_not_turn(tmp_path: Path) -> None:
    """Where the first of the two drives straight on; where it turns, SUMO lets it leave before its rear has left."""
    (tmp_path / "net.xml").write_bytes((ROAD / "junction.net.xml").read_bytes())
    flows = (ROAD / "flows.rou.xml").read_text()
    car = '<vType id="car" vClass="passenger"'
    assert car in flows
    flows = flows.replace(car, f'<vType id="DEFAULT_VEHTYPE" {RECKLESS}/>{car} tau="0.6" {RECKLESS}')
    (tmp_path / "flows.xml").write_text(flows.replace('vClass="truck"', 'vClass="truck" length="8" width="2.4"'))
    subprocess.run([sys.executable, "-c", RUN], cwd=tmp_path, check=True, capture_output=True)
    vehicles = driven(tmp_path)
    names = {one.number: name for name, one in vehicles.items()}
    search = conflicts(list(vehicles.values()), TrafficSettings(), np.random.default_rng(0))
    ours: dict[frozenset[str], Conflict] = {
        frozenset((names[one.first.number], names[one.second.number])): one for one in search.conflicts
    }
    found, off = 0, []
    pairs = [pair for pair in told(tmp_path) if pair[0] in vehicles and pair[1] in vehicles]
    for ego, foe, seconds in pairs:
        conflict = ours.get(frozenset((ego, foe)))
        found += conflict is not None
        if conflict is not None and names[conflict.first.number].startswith(("westbound", "eastbound", "lorries")):
            off.append(conflict.pet_area_s - seconds)
    assert len(pairs) > 60
    assert found / len(pairs) > 0.95
    assert len(off) > 30
    assert abs(np.nanmedian(off)) < 0.05
    assert np.mean(np.abs(off) < 0.3) > 0.9
