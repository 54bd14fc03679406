"""A photograph of the empty road in place of lit scenery, and the light that vehicles need to fit into it."""

from dataclasses import replace
from functools import cache
from typing import Any, Final

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray

from skope.camera.ground_plane import ground_places
from skope.camera.model import Camera
from skope.gen.render.daylight import Daylight
from skope.gen.render.gl.context import Device, linear, put
from skope.gen.render.gl.light import Stage
from skope.gen.render.materials import MATERIALS
from skope.gen.scene.recording import Recording
from skope.gen.scenery.backdrop import plates
from skope.gen.towns.road_graph import RoadGraph
from skope.gen.towns.town import Town
from skope.gen.towns.user_road import OwnRoad
from skope.types import Array

_ROAD_ALBEDO: Final = linear(np.array(MATERIALS["asphalt_worn"]))
"""(3,) share of the light that a road returns."""
_MEASURED_WITHIN_M: Final = 80.0
"""Distance from the camera up to which the photograph's road is measured, metres."""
_STOPS: Final = (-16.0, 4.0)
"""Range of the light that the camera's curve is tabulated for, powers of two."""
_TABLE_STEPS: Final = 4096
_TINT: Final = (0.6, 1.6)
"""Largest distance of the light's colour from that of the hour."""


def fitted(device: Device, daylight: Daylight, road: OwnRoad) -> Daylight:
    """Daylight whose colour and exposure give the road the brightness that it has in the photograph.

    Where the photograph shows no road nearby, its whole lower half counts as one.
    """
    picture = road.picture((road.camera.width, road.camera.height))
    seen = light_of(device, picture[_road_pixels(road)])
    gain = np.maximum(np.median(seen, axis=0), 1e-4) * np.pi / (_ROAD_ALBEDO * daylight.ground_irradiance)
    tint = np.clip(gain / gain.mean(), *_TINT)
    light = replace(
        daylight,
        sun=daylight.sun * tint,
        zenith=daylight.zenith * tint,
        horizon=daylight.horizon * tint,
        gains=np.ones(3),
        vignetting=0.0,
    )
    wanted = np.median(seen, axis=0).mean() * np.pi / (_ROAD_ALBEDO * light.ground_irradiance).mean()
    return replace(light, gains=np.full(3, wanted / light.exposure.mean()))


def shown(device: Device, recording: Recording, daylight: Daylight) -> tuple[Any, Any]:
    """Textures of the photograph's light from sky and sun: as much from each as level ground has under that daylight.

    Together they show the photograph; where a vehicle takes the sun, what the sky gives is left. In the photograph's
    own shadows all of it is the sky's.
    """
    assert recording.photograph is not None
    assert recording.town.road is not None
    light = light_of(device, recording.photograph)
    share = daylight.sun * daylight.sun_direction[2] / daylight.ground_irradiance
    sun = share * (1 - _shadow_mask(recording.town.road, recording.camera))[..., None]
    one = np.ones((*light.shape[:2], 1))
    parts = (np.concatenate([light * share, one], axis=-1) for share in (1 - sun, sun))
    ambient, sunlit = (device.texture(part, "f2") for part in parts)
    return ambient, sunlit


def draw_shadows(stage: Stage, target: Any, clip: Array, recording: Recording, daylight: Daylight) -> None:
    """The depth buffer of what throws the photograph's own shadows onto vehicles."""
    assert recording.town.road is not None
    high = plates(recording.town.road, daylight.sun_direction)
    if high is None:
        target.clear()
    else:
        Stage(stage.device, high, recording.camera, recording.conditions, daylight=daylight).draw_depth(target, clip)


def _shadow_mask(road: OwnRoad, camera: Camera) -> Array:
    """(H, W) share of each pixel of a camera at the place's own that lies in the photograph's shadows."""
    out = np.zeros((camera.height, camera.width), dtype=np.uint8)
    for outline in road.shades:
        fine = shapely.get_coordinates(shapely.segmentize(shapely.Polygon(outline), road.camera.width / 50))
        rays, _ = road.camera.rays(fine)
        pixels, _, _ = camera.project(camera.position + rays @ camera.T_camera_world[:3, :3])
        at = np.rint((np.clip(pixels, -1e4, 1e4) - 0.5) * 16).astype(np.int32)
        cv2.fillPoly(out, [at], 255, cv2.LINE_AA, 4)
    return np.asarray(cv2.blur(out, (3, 3)) / 255)


def light_of(device: Device, rgb: NDArray[np.uint8]) -> Array:
    """(..., 3) exposed light, before the camera's curve, that is shown as these colours."""
    return _inverse_curve(device)[rgb]


@cache
def _inverse_curve(device: Device) -> Array:
    """(256,) light for each value of a picture: the shaders' own curve, turned round."""
    program = device.program("screen.vert.glsl", "curve.frag.glsl")
    target = device.target((_TABLE_STEPS, 1), ["4f4"], depth=False)
    low, high = _STOPS
    put(program, {"u_size": [_TABLE_STEPS, 1], "u_jitter": [0.0, 0.0], "u_low": low, "u_high": high})
    target.use()
    device.context.enable_only(device.gl.NOTHING)
    device.screen(program)
    values = np.frombuffer(target.read(components=4, dtype="f4"), dtype=np.float32).reshape(-1, 4)[:, 0]
    stops = np.interp(np.minimum(np.arange(256), 254.6) / 255, values, np.linspace(low, high, _TABLE_STEPS))
    return np.concatenate([[0.0], 2.0 ** stops[1:]])


def _road_pixels(road: OwnRoad) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns of pixels, some in each direction, that show the carriageway."""
    camera, graph = road.camera, RoadGraph.of(Town.of(road))
    step = max(1, camera.width // 320)
    rows, columns = (at.ravel() for at in np.mgrid[0 : camera.height : step, 0 : camera.width : step])
    eye = camera.position
    places = ground_places(camera, np.stack([columns, rows], axis=-1) + 0.5, graph.road_level(eye[:2]))[:, :2]
    near = np.linalg.norm(places - eye[:2], axis=1) < _MEASURED_WITHIN_M
    on_road = near & shapely.contains_xy(graph.ground_road, graph.world(np.nan_to_num(places)))
    outlines = [*(one.polygon for one in road.occluders), *road.shades]
    hidden = shapely.unary_union([shapely.Polygon(outline).buffer(0) for outline in outlines])
    sunny = on_road & ~shapely.contains_xy(hidden, columns + 0.5, rows + 0.5)
    chosen = sunny if sunny.any() else on_road
    if not chosen.any():
        chosen = rows >= camera.height / 2
    return rows[chosen], columns[chosen]
