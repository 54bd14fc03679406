"""The scenery as one camera sees it: what frames need of everything that does not move."""

import hashlib
import json
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

import skope
from skope.gen.recording import Recording
from skope.gen.render import SKY, STATIC
from skope.gen.render.daylight import Daylight
from skope.gen.render.gl import light as lighting
from skope.gen.render.gl import photograph
from skope.gen.render.gl.cache import cached
from skope.gen.render.gl.context import Device, albedo_table, light_projection, projection, put, shader_sources
from skope.gen.render.gl.light import SHADOW_RADIUS, Stage, sun_map_size
from skope.gen.towns.scenery import scenery

Array = NDArray[np.float64]

SCALE: Final = 2
"""Samples per pixel and axis of the vehicles' picture, and of the depth that hides it."""
_MIRROR: Final = 128


@dataclass(frozen=True, eq=False)
class Background:
    """Scenery: light and depth on the device, geometry in memory."""

    daylight: Daylight
    focus: Array
    """(3,) a point on the road in the middle of the view, world axes, relative to the camera."""
    depth: NDArray[np.float32]
    slope: NDArray[np.float32]
    ids: NDArray[np.int32]
    textures: dict[str, Any]
    """By the name of the uniform that programs sample them with."""
    uniforms: dict[str, Any]
    """What programs need besides."""

    def bind(self) -> dict[str, Any]:
        """Put the textures into their places, the device's first; returns the uniforms that belong to them."""
        for unit, texture in enumerate(self.textures.values()):
            texture.use(unit)
        return {**self.uniforms, **{name: unit for unit, name in enumerate(self.textures)}}


def light_the_scenery(device: Device, recording: Recording) -> Background:
    """Work out the light of a recording's scenery."""
    camera, daylight = recording.camera, Daylight.of(recording.conditions)
    if recording.place and recording.place.photograph:
        daylight = photograph.fitted(device, daylight, recording.place)
    size = (camera.width, camera.height)
    stage = Stage(device, scenery(recording.town).mesh, camera, daylight)

    geometry = device.target(size, ["4f4"])
    stage.draw_geometry(geometry)
    data = np.frombuffer(geometry.read(components=4, dtype="f4"), dtype=np.float32).reshape(size[1], size[0], 4)
    hit = data[..., 3] > 0
    fine = device.depth_target((SCALE * size[0], SCALE * size[1]))
    stage.draw_depth(fine, projection(camera.K, (0, 0, *size)) @ stage.view, seen=True)
    sun_map = device.shadow_map(sun_map_size(camera))
    clip, sun_map_from = light_projection(daylight.sun_direction, stage.focus, SHADOW_RADIUS)
    if recording.photograph is None:
        stage.draw_depth(sun_map, clip)
        light = cached(_digest(device, recording), stage.light)
        ambient, sunlit = _develop(stage, light, geometry.color_attachments[0])
    else:
        photograph.draw_shadows(stage, sun_map, clip, recording, daylight)
        ambient, sunlit = photograph.shown(device, recording, daylight)
    textures = {
        "u_ambient": ambient,
        "u_sunlit": sunlit,
        "u_background": device.texture(np.where(hit, data[..., 0], 0)[..., None], "f4"),
        "u_scenery": fine.depth_attachment,
        "u_mirror": _mirror(stage),
        "u_scenery_sun_map": sun_map.depth_attachment,
    }
    return Background(
        daylight=daylight,
        focus=stage.focus,
        depth=np.where(hit, data[..., 0], np.inf).astype(np.float32),
        slope=np.where(hit[..., None], data[..., 1:3], 0).astype(np.float32),
        ids=np.where(hit, STATIC, SKY).astype(np.int32),
        textures=textures,
        uniforms={**stage.uniforms, "u_scenery_sun_map_from": sun_map_from},
    )


def _develop(stage: Stage, light: dict[str, NDArray[np.float16]], geometry: Any) -> tuple[Any, Any]:
    """Textures of the scenery's light from sky and sun as the camera exposes it."""
    device = stage.device
    program = device.program("screen.vert.glsl", "develop.frag.glsl")
    target = device.target(geometry.size, ["4f2", "4f2"], depth=False)
    textures = [*(device.texture(light[name], "f2") for name in ("ambient", "sunlit")), geometry]
    for unit, texture in enumerate(textures):
        texture.use(unit)
    put(program, {**stage.uniforms, **stage.pixels, "u_a": 0, "u_b": 1, "u_geometry": 2, "u_jitter": [0.0, 0.0]})
    target.use()
    device.context.enable_only(device.gl.NOTHING)
    device.screen(program)
    ambient, sunlit = target.color_attachments
    return ambient, sunlit


def _mirror(stage: Stage) -> Any:
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


def _digest(device: Device, recording: Recording) -> str:
    """Names everything that the scenery's light depends on."""
    mesh = scenery(recording.town).mesh
    camera = recording.camera
    parts = (
        *(skope.__version__, device.name, shader_sources(), str(lighting.SAMPLES)),
        *(json.dumps(camera.to_dict()), f"{camera.width}x{camera.height}", str(mesh.materials)),
        *(str(getattr(recording.conditions, name)) for name in ("sun_elevation_deg", "sun_azimuth_deg", "clouds")),
    )
    digest = hashlib.sha256("\n".join(parts).encode())
    for array in (mesh.vertices, mesh.normals, mesh.triangles, mesh.material, albedo_table()):
        digest.update(array.tobytes())
    return digest.hexdigest()[:24]
