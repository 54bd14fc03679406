"""Check the installation: installed parts, working parts, and how to fix the others."""

import platform
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from skope.camera.model import Camera
from skope.gen.scene.conditions import Conditions, ranges
from skope.gen.scene.recording import Recording, RecordingPlan
from skope.gen.simulation.simulate import simulate
from skope.gen.towns.road_graph import RoadGraph
from skope.gen.towns.sites import sites
from skope.pictures import draw


@dataclass(frozen=True)
class PartStatus:
    part: str
    works: bool
    text: str


def examine(pictures: Path | None) -> Iterator[PartStatus]:
    """Try every part that generation and training need, and yield its status.

    Test images go to the folder `pictures`, if given.
    """
    yield PartStatus("Python", sys.version_info >= (3, 11), f"{platform.python_version()} on {platform.platform()}")
    yield _try("SUMO", _sumo, "reinstall libsumo; on Debian its library needs libgl1 libx11-6 libxext6 libxrender1")
    yield _try("pybullet", _pybullet, "reinstall pybullet; Python 3.11 has wheels, later ones compile it")
    recording: list[Recording] = []
    yield _try("simulation", lambda: _simulation(recording), "see SUMO and pybullet above")
    advice = {
        "gl": "install libegl1 and libgl1-mesa-dri (Debian's names), or use --renderer pybullet",
        "pybullet": "see pybullet above",
    }
    for name, remedy in advice.items():
        yield _try(f"renderer {name}", lambda name=name: _renderer(name, recording, pictures), remedy)  # type: ignore[misc]
    yield _try("torch", _torch, "reinstall torch and torchvision together; they must match")


def _try(part: str, test: Callable[[], str], remedy: str) -> PartStatus:
    try:
        return PartStatus(part, True, test())
    except Exception as error:  # the user must see any error of a broken installation
        reason = (str(error) or type(error).__name__).splitlines()[0]
        return PartStatus(part, False, f"{reason}; {remedy}")


def _sumo() -> str:
    from skope.gen.traffic.sumo import load_libsumo

    return str(load_libsumo().getVersion()[1])


def _pybullet() -> str:
    from skope.gen.simulation.pybullet_engine import engine

    return f"API {engine().getAPIVersion()}"


def _simulation(kept: list[Recording]) -> str:
    site = next(iter(sites().values()))
    plan = RecordingPlan(site=site, index=0, frames=1, interval=0.5, size=(320, 180), fov_deg=90, seed=0)
    kept.append(simulate(plan))
    return f"{len(kept[0].vehicles)} vehicles near {site.name}"


def _renderer(name: str, recordings: list[Recording], pictures: Path | None) -> str:
    from skope.gen.render.choose_renderer import choose_renderer, make_renderer

    _, driver, _ = choose_renderer(name)
    recording = recordings[0] if recordings else _empty_street()
    view = make_renderer(name, recording).render(0)
    _refuse_blank(view.rgb, recording.camera)
    if pictures is None:
        return driver
    path = pictures / f"doctor_{name}.png"
    draw.write(path, view.rgb)
    return f"{driver}; drew {path.name}"


def _empty_street() -> Recording:
    """Return a recording of an empty street, for machines that can render but not simulate."""
    site = next(iter(sites().values()))
    spans = ranges(site.weather, site.time_of_day, site.conditions)
    lights = RoadGraph.of(site.town).net.getTrafficLights()
    poses = np.zeros((0, 4, 4))
    return Recording(
        town=site.town,
        site=site.name,
        name="00",
        split=site.split,
        camera=site.camera((320, 180), 90),
        weather=site.weather,
        time_of_day=site.time_of_day,
        conditions=Conditions.drawn(spans, np.random.default_rng(0)),
        seed=0,
        versions={},
        vehicles=(),
        times_s=np.zeros(1),
        signals=({light.getID(): "r" * (1 + max(light.getLinks())) for light in lights},),
        frame=np.zeros(0, dtype=np.int32),
        vehicle=np.zeros(0, dtype=np.int32),
        T_world_chassis=poses,
        T_world_wheels=poses.reshape(0, 4, 4, 4),
        velocity=np.zeros((0, 3)),
        lamps=np.zeros(0, dtype=np.uint8),
    )


def _refuse_blank(rgb: Any, camera: Camera) -> None:
    if np.ptp(cv2.resize(rgb, (camera.width // 8, camera.height // 8), interpolation=cv2.INTER_AREA)) < 30:
        raise RuntimeError("drew an image of one colour")


TORCH_PROGRAM = """
import torch, torchvision
torchvision.ops.nms(torch.tensor([[0.0, 0.0, 1.0, 1.0]]), torch.tensor([1.0]), 0.5)
where = torch.cuda.get_device_name() if torch.cuda.is_available() else f"CPU, {torch.get_num_threads()} threads"
print(f"{torch.__version__}, torchvision {torchvision.__version__}, {where}")
"""


def _torch() -> str:
    # In a separate process, since torch crashes if Mesa's compiler was loaded before it.
    done = subprocess.run([sys.executable, "-c", TORCH_PROGRAM], capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError((done.stderr.strip().splitlines() or [f"ended with code {done.returncode}"])[-1])
    try:
        runtime = f"OpenVINO {metadata.version('openvino')}"
    except metadata.PackageNotFoundError:
        runtime = "OpenVINO is missing; it makes prediction on a CPU four times as fast (extra openvino)"
    return f"{done.stdout.strip()}; {runtime}"
