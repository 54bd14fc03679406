"""The scenery as one camera sees it: what frames need of everything that does not move."""

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skope.gen.cache import Arrays, cached, cached_from_parts, digest_of
from skope.gen.render.daylight import Daylight
from skope.gen.render.frame import SKY, STATIC
from skope.gen.render.gl import light as lighting
from skope.gen.render.gl import photograph
from skope.gen.render.gl.context import (
    Device,
    albedo_table,
    light_projection,
    pattern_tables,
    projection,
    put,
    shader_sources,
)
from skope.gen.render.gl.light import SHADOW_MAP_M, Stage, sun_map_size
from skope.gen.render.gl.street_lights import StreetLights
from skope.gen.render.gl.water import Plane, plane_of, uniforms_of
from skope.gen.render.lit_street_lights import burning
from skope.gen.render.palette import Palette
from skope.gen.scene.recording import Recording
from skope.gen.scenery.build import scenery
from skope.types import Array

SCALE: Final = 2
"""Samples per pixel and axis of the vehicles' picture, and of the depth that hides it."""
_MIRROR: Final = 128
_LIGHT_CONDITIONS: Final = (
    "sun_elevation_deg", "sun_azimuth_deg", "clouds", "wetness", "puddles",
    "street_lighting", "street_light_k", "street_lights_lit", "lit_windows", "infrared", "snow_cover",
)  # fmt: skip
"""Conditions that the scenery's light depends on."""
_LIGHT_PARTS: Final = 4
"""Of the light's samples, for workers to share."""


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
    """Textures by the name of the uniform that programs sample them with."""
    mirrored_depth: Any
    """Texture of the depth of what wet ground mirrors, half as fine as the image; None where it is dry."""
    water: NDArray[np.float16] | None
    """(H, W) share of light that water on the ground mirrors."""
    uniforms: dict[str, Any]
    """Values of further uniforms, by name."""

    def bind(self) -> dict[str, Any]:
        """Put the textures into their places, the device's first; returns the uniforms that belong to them."""
        for unit, texture in enumerate(self.textures.values()):
            texture.use(unit)
        return {**self.uniforms, **{name: unit for unit, name in enumerate(self.textures)}}


def light_the_scenery(device: Device, recording: Recording, on_light: Callable[[], None]) -> Background:
    """Work out the light of a recording's scenery, or find it in the cache; `on_light` is called before the former."""
    camera, town, conditions = recording.camera, scenery(recording.town), recording.conditions
    daylight = Daylight.of(conditions)
    if recording.town.road and recording.town.road.photograph:
        # The photograph's own wet road is in it already.
        conditions = replace(conditions, wetness=0.0, puddles=0.0)
        daylight = photograph.fitted(device, daylight, recording.town.road)
    size = (camera.width, camera.height)
    lamps = burning(town.lamps, conditions.street_lights_lit)
    stage = Stage(device, town.mesh, camera, conditions, lamps, daylight, Palette.of(recording.town), town.light_pools)
    wet = conditions.wetness > 0

    geometry = device.target(size, ["4f4"])
    stage.draw_geometry(geometry)
    data = np.frombuffer(geometry.read(components=4, dtype="f4"), dtype=np.float32).reshape(size[1], size[0], 4)
    hit = data[..., 3] > 0
    depth = np.where(hit, data[..., 0], np.inf).astype(np.float32)
    slope = np.where(hit[..., None], data[..., 1:3], 0).astype(np.float32)
    road = plane_of(camera, depth, slope)
    fine = device.depth_target((SCALE * size[0], SCALE * size[1]))
    stage.draw_depth(fine, projection(camera.K, (0, 0, *size)) @ stage.view, seen=True)
    sun_map = device.shadow_map(sun_map_size(camera))
    clip, sun_map_from = light_projection(stage.daylight.sun_direction, stage.focus, SHADOW_MAP_M)
    if recording.photograph is None:
        stage.draw_depth(sun_map, clip)
        light = _cached_light(stage, road if wet else None, _light_digest(device, recording), on_light)
        shown = _develop_textures(stage, light, geometry.color_attachments[0], road)
    else:
        photograph.draw_shadows(stage, sun_map, clip, recording, stage.daylight)
        ambient, sunlit = photograph.shown(device, recording, stage.daylight)
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
        ids=np.where(hit, STATIC, SKY).astype(np.int32),
        textures=textures,
        mirrored_depth=_mirrored_depth(stage, road) if wet else None,
        water=np.abs(light["sunlit"][..., 3]) if wet else None,
        uniforms={**stage.uniforms, "u_scenery_sun_map_from": sun_map_from},
    )


def _cached_light(stage: Stage, road: Plane | None, digest: str, on_light: Callable[[], None]) -> Arrays:
    """The light of the scenery, and what a wet road mirrors, which workers without a GPU share out among them.

    `on_light` is called before each part that is not in the cache.
    """
    shares = stage.light_parts(_LIGHT_PARTS if stage.device.software else 1)
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
    """Textures of the scenery's light from sky and sun, and of what wet ground mirrors, as the camera exposes it."""
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
    """Depth of what the road mirrors, half as fine as the image."""
    width, height = stage.pixels["u_size"]
    target = stage.device.depth_target((-(-width // 2), -(-height // 2)))
    stage.draw_mirrored_depth(target, road)
    return target.depth_attachment


def _mirror_texture(stage: Stage) -> Any:
    device = stage.device
    program = device.program("screen.vert.glsl", "mirror.frag.glsl")
    target = device.target((_MIRROR, _MIRROR), ["4f2"], depth=False)
    stage.noise.use(0)
    put(program, {**stage.uniforms, "u_noise": 0, "u_size": [_MIRROR, _MIRROR], "u_jitter": [0.0, 0.0]})
    target.use()
    device.context.enable_only(device.gl.NOTHING)
    device.screen(program)
    (texture,) = target.color_attachments
    texture.filter = (device.gl.LINEAR, device.gl.LINEAR)
    return texture


def _light_digest(device: Device, recording: Recording) -> str:
    """Names everything that the scenery's light depends on."""
    town = scenery(recording.town)
    mesh = town.mesh
    camera, palette = recording.camera, Palette.of(recording.town)
    parts = (
        digest_of("light"),
        device.name,
        shader_sources(),
        str(lighting.SAMPLES),
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
