"""The light of everything that does not move, worked out once per recording.

An average of many samples, each with its own shift of the pixels, its own point of the sun's disc and its own
direction of the sky: anti-aliasing, soft shadows and sky occlusion come out of the same average.
"""

import hashlib
import json
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

import skope
from skope.camera import Camera
from skope.gen.recording import Recording
from skope.gen.render import SKY, STATIC
from skope.gen.render.daylight import Daylight
from skope.gen.render.gl.cache import cached
from skope.gen.render.gl.context import (
    Device,
    albedo_table,
    light_projection,
    noise_tile,
    projection,
    put,
    shader_sources,
)
from skope.gen.towns.scenery import scenery

Array = NDArray[np.float64]

SAMPLES: Final = 32
SHADOW_MAP: Final = 4096
SHADOW_RADIUS: Final = 140.0
SUN_RADIUS: Final = 0.0047
"""Of the sun's disc, radians."""
_GOLDEN: Final = (1 + 5**0.5) / 2


@dataclass(frozen=True, eq=False)
class Background:
    """Scenery as one camera sees it: light and depth on the device, geometry in memory."""

    camera: Camera
    daylight: Daylight
    focus: Array
    """(3,) a point on the road in the middle of the view, world axes, relative to the camera."""
    depth: NDArray[np.float32]
    slope: NDArray[np.float32]
    ids: NDArray[np.int32]
    noise: Any
    ambient: Any
    sunlit: Any
    depth_texture: Any
    sun_map: Any
    sun_map_from: Array

    @property
    def sun_direction(self) -> Array:
        return self.daylight.sun_direction

    def bind(self) -> dict[str, Any]:
        """Put textures into their places; returns the uniforms that programs need of them and of the light."""
        self.noise.use(0)
        self.ambient.use(1)
        self.sunlit.use(2)
        self.depth_texture.use(3)
        self.sun_map.use(8)
        return {
            **light_uniforms(self.camera, self.daylight),
            "u_ambient": 1,
            "u_sunlit": 2,
            "u_background": 3,
            "u_scenery_sun_map": 8,
            "u_scenery_sun_map_from": self.sun_map_from,
        }

    def display_uniforms(self) -> dict[str, Any]:
        """What turns light into a picture."""
        return {
            "u_exposure": self.daylight.exposure,
            "u_fog": self.daylight.horizon,
            "u_fog_density": self.daylight.fog_density,
            "u_world_from_camera": self.camera.T_camera_world[:3, :3].T,
            "u_camera_from_pixel": np.linalg.inv(self.camera.K),
        }


def light_uniforms(camera: Camera, daylight: Daylight) -> dict[str, Any]:
    return {
        "u_noise": 0,
        "u_eye": camera.position,
        "u_sun_direction": daylight.sun_direction,
        "u_sun": daylight.sun,
        "u_zenith": daylight.zenith,
        "u_horizon": daylight.horizon,
        "u_ground": daylight.ground,
        "u_cloud": daylight.cloud,
        "u_albedo": albedo_table(),
    }


def light_the_scenery(device: Device, recording: Recording) -> Background:
    """Work out the light of a recording's scenery."""
    camera, daylight = recording.camera, Daylight.of(recording)
    size = (camera.width, camera.height)
    mesh = device.upload(scenery(recording.town).mesh, origin=camera.position)
    noise = device.context.texture((256, 256), 4, noise_tile())
    noise.build_mipmaps()
    noise.filter = (device.gl.LINEAR_MIPMAP_LINEAR, device.gl.LINEAR)
    noise.use(0)

    view = np.eye(4)
    view[:3, :3] = camera.T_camera_world[:3, :3]
    geometry = device.target(size, ["4f4"])
    _draw_geometry(device, mesh, geometry, view, projection(camera.K, (0, 0, *size)))
    data = np.frombuffer(geometry.read(components=4, dtype="f4"), dtype=np.float32).reshape(size[1], size[0], 4)
    hit = data[..., 3] > 0

    focus = _focus(camera)
    light = cached(_digest(device, recording), lambda: _accumulate(device, mesh, camera, daylight, view, focus))
    ambient, sunlit = (_texture(device, light[name].astype(np.float32)) for name in ("ambient", "sunlit"))
    sun_map = device.shadow_map(SHADOW_MAP)
    clip, sun_map_from = light_projection(daylight.sun_direction, focus, SHADOW_RADIUS)
    _draw_shadow(device, mesh, sun_map, clip)
    depth = np.where(hit, data[..., 0], 0).astype(np.float32)
    return Background(
        camera=camera,
        daylight=daylight,
        focus=focus,
        depth=np.where(hit, data[..., 0], np.inf).astype(np.float32),
        slope=np.where(hit[..., None], data[..., 1:3], 0).astype(np.float32),
        ids=np.where(hit, STATIC, SKY).astype(np.int32),
        noise=noise,
        ambient=ambient,
        sunlit=sunlit,
        depth_texture=_texture(device, depth[..., None]),
        sun_map=sun_map.depth_attachment,
        sun_map_from=sun_map_from,
    )


def _focus(camera: Camera) -> Array:
    forward = camera.T_camera_world[2, :3]
    level = np.array([forward[0], forward[1], 0.0]) / max(np.hypot(forward[0], forward[1]), 1e-6)
    return np.asarray(40.0 * level - [0, 0, camera.position[2]])


def _draw_geometry(device: Device, mesh: Any, target: Any, view: Array, P: Array) -> None:
    program = device.program("geometry.vert.glsl", "geometry.frag.glsl")
    target.use()
    target.clear(0, 0, 0, 0)
    device.context.enable_only(device.gl.DEPTH_TEST)
    put(program, {"u_model": view, "u_world": np.eye(4), "u_project": P, "u_id": 1.0})
    mesh.draw(program)


def _draw_shadow(device: Device, mesh: Any, target: Any, clip: Array) -> None:
    program = device.program("geometry.vert.glsl", "shadow.frag.glsl")
    target.use()
    target.clear()
    device.context.enable_only(device.gl.DEPTH_TEST)
    put(program, {"u_model": np.eye(4), "u_world": np.eye(4), "u_project": clip})
    mesh.draw(program)


def _digest(device: Device, recording: Recording) -> str:
    """Names everything that the scenery's light depends on."""
    mesh = scenery(recording.town).mesh
    camera = recording.camera
    parts = (
        *(skope.__version__, device.name, shader_sources(), str(SAMPLES), str(SHADOW_MAP)),
        *(json.dumps(camera.to_dict()), f"{camera.width}x{camera.height}", str(mesh.materials)),
        *(recording.weather, str(recording.sun_elevation_deg), str(recording.sun_azimuth_deg)),
    )
    digest = hashlib.sha256("\n".join(parts).encode())
    for array in (mesh.vertices, mesh.normals, mesh.triangles, mesh.material, albedo_table()):
        digest.update(array.tobytes())
    return digest.hexdigest()[:24]


def _accumulate(
    device: Device, mesh: Any, camera: Camera, daylight: Daylight, view: Array, focus: Array
) -> dict[str, NDArray[np.float16]]:
    """The mean of the samples: light from the sky and from the sun, (H, W, 3) each."""
    size = (camera.width, camera.height)
    sums = device.target(size, ["4f4", "4f4"])
    sums.use()
    sums.clear(0, 0, 0, 0)
    sun, sky = device.shadow_map(SHADOW_MAP), device.shadow_map(SHADOW_MAP)
    sample = device.target(size, ["4f4", "4f4"])
    shade, clear = (
        device.program("geometry.vert.glsl", "static.frag.glsl"),
        device.program("screen.vert.glsl", "sky.frag.glsl"),
    )
    add = device.program("screen.vert.glsl", "add.frag.glsl")
    matrices = {
        "u_world_from_camera": camera.T_camera_world[:3, :3].T,
        "u_camera_from_pixel": np.linalg.inv(camera.K),
        "u_size": list(size),
    }
    rng = np.random.default_rng(3)
    for k in range(SAMPLES):
        jitter = ((k + 0.5) / SAMPLES - 0.5, (k * _GOLDEN + 0.5) % 1 - 0.5)
        toward_sun = daylight.sun_direction + SUN_RADIUS * _in_disc(k) @ _across(daylight.sun_direction)
        toward_sky = _on_hemisphere(k)
        # A shift of the map by less than a texel, new in each sample, hides its grid.
        wander = focus + rng.uniform(-0.2, 0.2, 3)
        sun_clip, sun_from = light_projection(toward_sun, wander, SHADOW_RADIUS)
        sky_clip, sky_from = light_projection(toward_sky, wander, SHADOW_RADIUS)
        _draw_shadow(device, mesh, sun, sun_clip)
        _draw_shadow(device, mesh, sky, sky_clip)
        sample.use()
        sample.clear(0, 0, 0, 0)
        device.context.enable_only(device.gl.DEPTH_TEST)
        sun.depth_attachment.use(4)
        sky.depth_attachment.use(5)
        light = light_uniforms(camera, daylight)
        put(
            shade,
            {
                **light,
                "u_model": view,
                "u_world": np.eye(4),
                "u_project": projection(camera.K, (0, 0, *size), jitter),
                "u_sun_map": 4,
                "u_sky_map": 5,
                "u_sun_map_from": sun_from,
                "u_sky_map_from": sky_from,
                "u_sky_direction": toward_sky,
                "u_sky_radiance": daylight.sky(toward_sky),
            },
        )
        mesh.draw(shade)
        put(clear, {**light, **matrices, "u_jitter": [-jitter[0], -jitter[1]]})
        device.screen(clear)
        for unit, texture in enumerate(sample.color_attachments, start=6):
            texture.use(unit)
        put(add, {"u_a": 6, "u_b": 7, "u_share": 1 / SAMPLES, "u_size": list(size), "u_jitter": [0.0, 0.0]})
        sums.use()
        device.context.enable_only(device.gl.BLEND)
        device.context.blend_func = device.gl.ONE, device.gl.ONE
        device.screen(add)
    out = {}
    for name, texture in zip(("ambient", "sunlit"), sums.color_attachments, strict=True):
        pixels = np.frombuffer(texture.read(), dtype=np.float32).reshape(size[1], size[0], 4)
        out[name] = np.clip(pixels[..., :3], 0, 6e4).astype(np.float16)
    return out


def _in_disc(k: int) -> Array:
    angle, radius = 2.399963 * k, ((k + 0.5) / SAMPLES) ** 0.5
    return np.array([radius * np.cos(angle), radius * np.sin(angle)])


def _across(direction: Array) -> Array:
    """(2, 3) unit vectors across a direction."""
    side = np.cross(direction, [0.0, 0.0, 1.0])
    side /= max(float(np.linalg.norm(side)), 1e-9)
    return np.stack([side, np.cross(direction, side)])


def _on_hemisphere(k: int) -> Array:
    """Directions spread evenly over the upper hemisphere (a Fibonacci lattice)."""
    z, angle = (k + 0.5) / SAMPLES, 2.399963 * k
    r = (1 - z * z) ** 0.5
    return np.array([r * np.cos(angle), r * np.sin(angle), z])


def _texture(device: Device, values: NDArray[np.float32]) -> Any:
    texture = device.context.texture(
        (values.shape[1], values.shape[0]), values.shape[2], values.tobytes(), dtype="f4", alignment=4
    )
    texture.filter = (device.gl.NEAREST, device.gl.NEAREST)
    return texture
