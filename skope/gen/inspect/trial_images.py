"""Test images of an installation: a simulated frame, drawn by each renderer."""

from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np

from skope.camera.model import Camera
from skope.gen.scene.conditions import Conditions, ranges
from skope.gen.scene.recording import Recording, RecordingPlan
from skope.gen.simulation.simulate import simulate
from skope.gen.towns.road_graph import RoadGraph
from skope.gen.towns.sites import sites
from skope.pictures import draw

TESTED_RENDERERS: Final = ("gl", "pybullet")


def simulated_frame() -> Recording:
    """Simulate traffic and return a recording of one frame."""
    site = next(iter(sites().values()))
    plan = RecordingPlan(site=site, index=0, frames=1, interval=0.5, size=(320, 180), fov_deg=90, seed=0)
    return simulate(plan)


def draw_test_image(renderer: str, recording: Recording | None, folder: Path) -> str:
    """Draw a recording, or an empty street, to a PNG file in a folder; return the name of the driver.

    Raises RuntimeError if the image has one colour. Other exceptions are those of a broken library.
    """
    from skope.gen.render.choose_renderer import choose_renderer, make_renderer

    _, driver, _ = choose_renderer(renderer)
    recording = recording or _empty_street()
    view = make_renderer(renderer, recording).render(0)
    _refuse_blank(view.rgb, recording.camera)
    draw.write(folder / f"doctor_{renderer}.png", view.rgb)
    return driver


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
