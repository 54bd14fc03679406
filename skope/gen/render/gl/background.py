"""Background of one camera: everything that frames need from the stationary scenery.

A photograph of the empty road can replace the lit scenery. Vehicles then get light that matches the photograph.
"""

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any, Final

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray

from skope.camera.ground_plane import intersect_ground
from skope.camera.model import Camera
from skope.gen.cache import Arrays, cached, cached_from_parts, digest_of
from skope.gen.render.daylight import Daylight
from skope.gen.render.frame import SKY_ID, STATIC_ID
from skope.gen.render.gl import light as lighting
from skope.gen.render.gl.context import (
    Device,
    albedo_table,
    light_projection,
    linear,
    pattern_tables,
    projection,
    put,
    shader_sources,
)
from skope.gen.render.gl.ground_lights import StreetLights
from skope.gen.render.gl.light import LIGHT_SAMPLING, Stage, sun_map_size
from skope.gen.render.gl.wet_ground import Plane, plane_of, uniforms_of
from skope.gen.render.lit_lamps import burning_street_lights
from skope.gen.render.materials import MATERIAL_COLORS, Palette
from skope.gen.scene.recording import Recording
from skope.gen.scenery.backdrop import plates
from skope.gen.scenery.build import scenery
from skope.gen.towns.road_graph import RoadGraph
from skope.gen.towns.town import OwnRoad, Town
from skope.types import Array

_ROAD_ALBEDO: Final = linear(np.array(MATERIAL_COLORS["asphalt_worn"]))
"""(3,) share of the light that a road reflects."""


@dataclass(frozen=True)
class BackgroundSampling:
    """Resolution of the background and of measurements on it."""

    measured_within_m: float = 80.0
    """Distance from the camera within which the road in the photograph is measured, metres."""
    curve_stops: tuple[float, float] = (-16.0, 4.0)
    """Range of light for which the camera's curve is tabulated, powers of two."""
    table_steps: int = 4096
    """Number of entries of the camera's curve."""
    tint_limits: tuple[float, float] = (0.6, 1.6)
    """Minimum and maximum factor per channel between the colour of the light and that of the hour."""
    vehicle_scale: int = 2
    """Samples per pixel and axis of the vehicles' image, and of the depth that hides it."""
    mirror_px: int = 128
    """Border of the mirrored image, pixels."""
    light_parts: int = 4
    """Number of parts into which the light samples are divided among workers without a GPU."""


BACKGROUND_SAMPLING: Final = BackgroundSampling()


def fitted_to_photograph(device: Device, daylight: Daylight, road: OwnRoad) -> Daylight:
    """Return daylight that gives the road the brightness that it has in the photograph.

    If the photograph shows no road nearby, its whole lower half is used.
    """
    picture = road.picture((road.camera.width, road.camera.height))
    seen = light_of(device, picture[_road_pixels(road)])
    gain = np.maximum(np.median(seen, axis=0), 1e-4) * np.pi / (_ROAD_ALBEDO * daylight.ground_irradiance)
    tint = np.clip(gain / gain.mean(), *BACKGROUND_SAMPLING.tint_limits)
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


def light_in_photograph(device: Device, recording: Recording, daylight: Daylight) -> tuple[Any, Any]:
    """Return two textures: the photograph's light from the sky and from the sun.

    The shares are those of level ground under the same daylight, and their sum is the photograph. If a vehicle blocks
    the sun, the sky's part remains. In the photograph's own shadows all light is the sky's.
    """
    assert recording.photograph is not None
    assert recording.town.road is not None
    light = light_of(device, recording.photograph)
    share = daylight.sun * daylight.sun_direction[2] / daylight.ground_irradiance
    sun = share * (1 - _shadow_mask(recording.town.road, recording.camera))[..., None]
    alpha = np.ones((*light.shape[:2], 1))
    parts = (np.concatenate([light * share, alpha], axis=-1) for share in (1 - sun, sun))
    ambient, sunlit = (device.texture(part, "f2") for part in parts)
    return ambient, sunlit


def draw_photographed_shadows(stage: Stage, target: Any, clip: Array, recording: Recording, daylight: Daylight) -> None:
    """Draw the depth buffer of the objects that cast the photograph's own shadows onto vehicles."""
    assert recording.town.road is not None
    high = plates(recording.town.road, daylight.sun_direction)
    if high is None:
        target.clear()
    else:
        Stage(stage.device, high, recording.camera, recording.conditions, daylight=daylight).draw_depth(target, clip)


def _shadow_mask(road: OwnRoad, camera: Camera) -> Array:
    """Return the share (H, W) of each pixel in the photograph's shadows, for a camera at the same place."""
    out = np.zeros((camera.height, camera.width), dtype=np.uint8)
    for outline in road.shades:
        fine = shapely.get_coordinates(shapely.segmentize(shapely.Polygon(outline), road.camera.width / 50))
        rays, _ = road.camera.rays(fine)
        pixels, _, _ = camera.project(camera.position + rays @ camera.T_camera_world[:3, :3])
        at = np.rint((np.clip(pixels, -1e4, 1e4) - 0.5) * 16).astype(np.int32)
        cv2.fillPoly(out, [at], 255, cv2.LINE_AA, 4)
    return np.asarray(cv2.blur(out, (3, 3)) / 255)


def light_of(device: Device, rgb: NDArray[np.uint8]) -> Array:
    """Return the exposed light (..., 3), before the camera's curve, that gives these colours."""
    return _inverse_curve(device)[rgb]


@cache
def _inverse_curve(device: Device) -> Array:
    """Return the light (256,) for each value of an image: the inverse of the shaders' curve."""
    program = device.program("screen.vert.glsl", "curve.frag.glsl")
    target = device.target((BACKGROUND_SAMPLING.table_steps, 1), ["4f4"], depth=False)
    low, high = BACKGROUND_SAMPLING.curve_stops
    put(program, {"u_size": [BACKGROUND_SAMPLING.table_steps, 1], "u_jitter": [0.0, 0.0], "u_low": low, "u_high": high})
    target.use()
    device.context.enable_only(device.gl.NOTHING)
    device.screen(program)
    values = np.frombuffer(target.read(components=4, dtype="f4"), dtype=np.float32).reshape(-1, 4)[:, 0]
    stops = np.interp(
        np.minimum(np.arange(256), 254.6) / 255, values, np.linspace(low, high, BACKGROUND_SAMPLING.table_steps)
    )
    return np.concatenate([[0.0], 2.0 ** stops[1:]])


def _road_pixels(road: OwnRoad) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return rows and columns of a grid of pixels that show the carriageway."""
    camera, graph = road.camera, RoadGraph.of(Town.of(road))
    step = max(1, camera.width // 320)
    rows, columns = (at.ravel() for at in np.mgrid[0 : camera.height : step, 0 : camera.width : step])
    eye = camera.position
    places = intersect_ground(camera, np.stack([columns, rows], axis=-1) + 0.5, graph.road_level(eye[:2]))[:, :2]
    near = np.linalg.norm(places - eye[:2], axis=1) < BACKGROUND_SAMPLING.measured_within_m
    on_road = near & shapely.contains_xy(graph.ground_road, graph.world(np.nan_to_num(places)))
    outlines = [*(occluder.polygon for occluder in road.occluders), *road.shades]
    hidden = shapely.unary_union([shapely.Polygon(outline).buffer(0) for outline in outlines])
    sunny = on_road & ~shapely.contains_xy(hidden, columns + 0.5, rows + 0.5)
    chosen = sunny if sunny.any() else on_road
    if not chosen.any():
        chosen = rows >= camera.height / 2
    return rows[chosen], columns[chosen]


_LIGHT_CONDITIONS: Final = (
    "sun_elevation_deg", "sun_azimuth_deg", "clouds", "wetness", "puddles",
    "street_lighting", "street_light_k", "street_lights_lit", "lit_windows", "infrared", "snow_cover",
)  # fmt: skip
"""Conditions that affect the scenery's light."""


@dataclass(frozen=True, eq=False)
class Background:
    """Scenery: light and depth on the device, geometry in memory."""

    daylight: Daylight
    street_lights: StreetLights
    focus: Array
    """(3,) a point on the road in the middle of the view, world axes, relative to the camera."""
    road: Plane
    depth: NDArray[np.float32]
    slope: NDArray[np.float32]
    ids: NDArray[np.int32]
    textures: dict[str, Any]
    """Textures by the name of the uniform with which programs sample them."""
    mirrored_depth: Any
    """Depth texture of the mirror image on wet ground, at half the image's resolution; None if the ground is dry."""
    water: NDArray[np.float16] | None
    """(H, W) share of light that water on the ground mirrors."""
    uniforms: dict[str, Any]
    """Values of further uniforms, by name."""

    def bind(self) -> dict[str, Any]:
        """Bind the textures, the device's first; return the uniforms that belong to them."""
        for unit, texture in enumerate(self.textures.values()):
            texture.use(unit)
        return {**self.uniforms, **{name: unit for unit, name in enumerate(self.textures)}}


def light_the_scenery(device: Device, recording: Recording, on_light: Callable[[], None]) -> Background:
    """Compute the light of a recording's scenery, or load it from the cache.

    `on_light` is called before a computation.
    """
    camera, town, conditions = recording.camera, scenery(recording.town), recording.conditions
    daylight = Daylight.of(conditions)
    if recording.town.road and recording.town.road.photograph:
        # The photograph already contains its own wet road.
        conditions = replace(conditions, wetness=0.0, puddles=0.0)
        daylight = fitted_to_photograph(device, daylight, recording.town.road)
    size = (camera.width, camera.height)
    lamps = burning_street_lights(town.lamps, conditions.street_lights_lit)
    stage = Stage(device, town.mesh, camera, conditions, lamps, daylight, Palette.of(recording.town), town.light_pools)
    wet = conditions.wetness > 0

    geometry = device.target(size, ["4f4"])
    stage.draw_geometry(geometry)
    data = np.frombuffer(geometry.read(components=4, dtype="f4"), dtype=np.float32).reshape(size[1], size[0], 4)
    hit = data[..., 3] > 0
    depth = np.where(hit, data[..., 0], np.inf).astype(np.float32)
    slope = np.where(hit[..., None], data[..., 1:3], 0).astype(np.float32)
    road = plane_of(camera, depth, slope)
    fine = device.depth_target(
        (BACKGROUND_SAMPLING.vehicle_scale * size[0], BACKGROUND_SAMPLING.vehicle_scale * size[1])
    )
    stage.draw_depth(fine, projection(camera.K, (0, 0, *size)) @ stage.view, seen=True)
    sun_map = device.shadow_map(sun_map_size(camera))
    clip, sun_map_from = light_projection(stage.daylight.sun_direction, stage.focus, LIGHT_SAMPLING.shadow_map_m)
    if recording.photograph is None:
        stage.draw_depth(sun_map, clip)
        light = _cached_light(stage, road if wet else None, _light_digest(device, recording), on_light)
        shown = _develop_textures(stage, light, geometry.color_attachments[0], road)
    else:
        draw_photographed_shadows(stage, sun_map, clip, recording, stage.daylight)
        ambient, sunlit = light_in_photograph(device, recording, stage.daylight)
        shown = {"u_ambient": ambient, "u_sunlit": sunlit}
    textures = {
        **shown,
        "u_background": device.texture(np.where(hit, data[..., 0], 0)[..., None], "f4"),
        "u_scenery": fine.depth_attachment,
        "u_mirror": _mirror_texture(stage),
        "u_scenery_sun_map": sun_map.depth_attachment,
    }
    if stage.daylight.dark:
        vectors = device.texture(stage.lamp_vectors, "f2")
        vectors.filter = (device.gl.LINEAR, device.gl.LINEAR)
        vectors.repeat_x = vectors.repeat_y = False
        textures["u_lamp_vectors"] = vectors
    return Background(
        daylight=stage.daylight,
        street_lights=stage.street_lights,
        focus=stage.focus,
        road=road,
        depth=depth,
        slope=slope,
        ids=np.where(hit, STATIC_ID, SKY_ID).astype(np.int32),
        textures=textures,
        mirrored_depth=_mirrored_depth(stage, road) if wet else None,
        water=np.abs(light["sunlit"][..., 3]) if wet else None,
        uniforms={**stage.uniforms, "u_scenery_sun_map_from": sun_map_from},
    )


def _cached_light(stage: Stage, road: Plane | None, digest: str, on_light: Callable[[], None]) -> Arrays:
    """Return the light of the scenery and the mirror image of a wet road.

    Workers without a GPU share the computation. `on_light` is called before each part that is not in the cache.
    """
    shares = stage.light_parts(BACKGROUND_SAMPLING.light_parts if stage.device.software else 1)
    works: list[Callable[[], Arrays]] = [*shares]
    if road:
        works.append(partial(stage.mirrored, road))

    def make(work: Callable[[], Arrays]) -> Arrays:
        on_light()
        return work()

    parts = [partial(make, work) for work in works]

    def join(made: Sequence[Arrays]) -> Arrays:
        return lighting.mean_light(made[: len(shares)]) | (dict(made[-1]) if road else {})

    if stage.device.software:
        return cached_from_parts("light", digest, parts, join)
    return cached("light", digest, lambda: join([part() for part in parts]))


def _develop_textures(stage: Stage, light: Arrays, geometry: Any, road: Plane) -> dict[str, Any]:
    """Return textures of the exposed light from sky and sun, and of the mirror image on wet ground."""
    device = stage.device
    wet = "mirrored" in light
    names = ["u_ambient", "u_sunlit", *(["u_reflected"] if wet else [])]
    program = device.program("screen.vert.glsl", "develop.frag.glsl", *(["WET"] if wet else []))
    target = device.target(geometry.size, ["4f2"] * len(names), depth=False)
    textures = {name: device.texture(values, "f2") for name, values in light.items()}
    if wet:
        textures["mirrored"].build_mipmaps()
        textures["mirrored"].filter = (device.gl.LINEAR_MIPMAP_LINEAR, device.gl.LINEAR)
        textures["mirrored"].repeat_x = textures["mirrored"].repeat_y = False
    for unit, texture in enumerate((*textures.values(), geometry)):
        texture.use(unit)
    units = {f"u_{name}_light": unit for unit, name in enumerate(textures)}
    put(
        program,
        {
            **stage.uniforms,
            **uniforms_of(road),
            **stage.pixels,
            **units,
            "u_geometry": len(textures),
            "u_jitter": [0.0, 0.0],
        },
    )
    target.use()
    device.context.enable_only(device.gl.NOTHING)
    device.screen(program)
    return dict(zip(names, target.color_attachments, strict=True))


def _mirrored_depth(stage: Stage, road: Plane) -> Any:
    """Return the depth of the mirror image on the road, at half the image's resolution."""
    width, height = stage.pixels["u_size"]
    target = stage.device.depth_target((-(-width // 2), -(-height // 2)))
    stage.draw_mirrored_depth(target, road)
    return target.depth_attachment


def _mirror_texture(stage: Stage) -> Any:
    device = stage.device
    program = device.program("screen.vert.glsl", "mirror.frag.glsl")
    target = device.target((BACKGROUND_SAMPLING.mirror_px, BACKGROUND_SAMPLING.mirror_px), ["4f2"], depth=False)
    stage.noise.use(0)
    put(
        program,
        {
            **stage.uniforms,
            "u_noise": 0,
            "u_size": [BACKGROUND_SAMPLING.mirror_px, BACKGROUND_SAMPLING.mirror_px],
            "u_jitter": [0.0, 0.0],
        },
    )
    target.use()
    device.context.enable_only(device.gl.NOTHING)
    device.screen(program)
    (texture,) = target.color_attachments
    texture.filter = (device.gl.LINEAR, device.gl.LINEAR)
    return texture


def _light_digest(device: Device, recording: Recording) -> str:
    """Return a digest of everything that the scenery's light depends on."""
    town = scenery(recording.town)
    mesh = town.mesh
    camera, palette = recording.camera, Palette.of(recording.town)
    parts = (
        digest_of("light"),
        device.name,
        shader_sources(),
        str(lighting.LIGHT_SAMPLING.samples),
        json.dumps(camera.to_dict()),
        f"{camera.width}x{camera.height}",
        str(mesh.materials),
        *(str(getattr(recording.conditions, name)) for name in _LIGHT_CONDITIONS),
        str(recording.conditions.visibility_m if recording.conditions.wetness > 0 else 0),
    )
    digest = hashlib.sha256("\n".join(parts).encode())
    colors = (albedo_table(palette), *pattern_tables(palette))
    for array in (mesh.vertices, mesh.normals, mesh.triangles, mesh.material, *colors, town.lamps, town.light_pools):
        digest.update(array.tobytes())
    return digest.hexdigest()[:24]
