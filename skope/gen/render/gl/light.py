"""The light of everything that does not move, worked out once per recording.

An average of many samples, each with its own shift of the pixels, its own point of the sun's disc and its own
direction of the sky: anti-aliasing, soft shadows and sky occlusion come out of the same average.
"""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skope.camera import Camera
from skope.gen.mesh import Mesh
from skope.gen.render.daylight import Daylight
from skope.gen.render.gl.context import (
    Device,
    DeviceMesh,
    albedo_table,
    light_projection,
    noise_tile,
    projection,
    put,
)
from skope.gen.render.materials import MATERIALS

Array = NDArray[np.float64]

SAMPLES: Final = 24
SKY_MAP: Final = 2048
SHADOW_RADIUS: Final = 140.0
GROUPS: Final = {
    "WALLS": ("brick", "sandstone"),
    "GROUND": ("asphalt", "grass"),
    "LEAVES": ("leaves", "leaves_pale"),
    "OTHERS": ("asphalt", "rim"),
}
"""Materials, from first to last of the table, that share the programs compiled for their patterns."""
SUN_RADIUS: Final = 0.0047
"""Of the sun's disc, radians."""
_GOLDEN: Final = (1 + 5**0.5) / 2


class Stage:
    """Scenery on the device with the sun and the sky over it."""

    def __init__(self, device: Device, mesh: Mesh, camera: Camera, daylight: Daylight) -> None:
        self.device, self._camera, self._daylight = device, camera, daylight
        self._size = (camera.width, camera.height)
        forward = camera.T_camera_world[2, :3]
        level = np.array([forward[0], forward[1], 0.0]) / max(np.hypot(forward[0], forward[1]), 1e-6)
        self.focus = np.asarray(40.0 * level - [0, 0, camera.position[2]])
        """(3,) a point on the road in the middle of the view, world axes, relative to the camera."""
        self.view = np.eye(4)
        self.view[:3, :3] = camera.T_camera_world[:3, :3]
        self._seen, self._casting = (_parts(device, part, camera) for part in self._needed(mesh))
        self.noise = device.context.texture((256, 256), 4, noise_tile())
        self.noise.build_mipmaps()
        self.noise.filter = (device.gl.LINEAR_MIPMAP_LINEAR, device.gl.LINEAR)
        self.uniforms: dict[str, Any] = {
            "u_eye": camera.position,
            "u_sun_direction": daylight.sun_direction,
            "u_sun": daylight.sun,
            "u_zenith": daylight.zenith,
            "u_horizon": daylight.horizon,
            "u_ground": daylight.ground,
            "u_cloud": daylight.clouds,
            "u_albedo": albedo_table(),
            "u_exposure": daylight.exposure,
            "u_haze": daylight.horizon,
            "u_haze_density": daylight.haze_density,
            "u_vignetting": daylight.vignetting,
        }
        self.pixels: dict[str, Any] = {
            "u_size": list(self._size),
            "u_camera_from_pixel": np.linalg.inv(camera.K),
            "u_world_from_camera": camera.T_camera_world[:3, :3].T,
        }

    def _needed(self, mesh: Mesh) -> tuple[Mesh, Mesh]:
        """What the image may show, from near to far so that little is shaded in vain; what may throw shadows there."""
        corners = (mesh.vertices - self._camera.position)[mesh.triangles]
        frame = corners @ self.view[:3, :3].T
        x, y, z = np.moveaxis(frame, -1, 0)
        (fx, fy), (cx, cy) = self._camera.K[[0, 1], [0, 1]], self._camera.K[:2, 2]
        width, height = self._size
        # Outside when all three corners are beyond the same side of the view, which a pixel's jitter widens.
        sides = (
            x * fx + (cx + 1) * z,
            (width + 1 - cx) * z - x * fx,
            y * fy + (cy + 1) * z,
            (height + 1 - cy) * z - y * fy,
        )
        seen = np.flatnonzero(~np.any([(side < 0).all(axis=-1) for side in (*sides, z)], axis=0))
        away = np.linalg.norm(frame[seen], axis=-1).min(axis=-1)
        casting = np.linalg.norm((corners - self.focus)[..., :2], axis=-1).min(axis=-1) < 2 * SHADOW_RADIUS
        return mesh.taken(seen[away.argsort(kind="stable")]), mesh.taken(casting)

    def draw_geometry(self, target: Any) -> None:
        """Depth, slopes and where there is something at all, at pixel centres."""
        target.use()
        target.clear(0, 0, 0, 0)
        self.device.context.enable_only(self.device.gl.DEPTH_TEST)
        P = projection(self._camera.K, (0, 0, *self._size))
        for mesh, options in self._seen:
            program = self.device.program("geometry.vert.glsl", "geometry.frag.glsl", *options)
            put(program, {"u_model": self.view, "u_world": np.eye(4), "u_project": P, "u_id": 1.0})
            mesh.draw(program)

    def draw_depth(self, target: Any, clip: Array, *, seen: bool = False) -> None:
        """The depth buffer of what throws shadows, or of what the camera sees.

        `clip` takes world axes, relative to the camera, to clip space.
        """
        target.use()
        target.clear()
        self.device.context.enable_only(self.device.gl.DEPTH_TEST)
        for mesh, options in self._seen if seen else self._casting:
            program = self.device.program("geometry.vert.glsl", "shadow.frag.glsl", *options)
            put(program, {"u_model": np.eye(4), "u_world": np.eye(4), "u_project": clip})
            mesh.draw(program)

    def light(self) -> dict[str, NDArray[np.float16]]:
        """The mean of the samples: light from the sky ("ambient") and from the sun ("sunlit"), (H, W, 4) each."""
        device, size = self.device, self._size
        sums, sample = (device.target(size, ["4f4", "4f4"]) for _ in range(2))
        sun, sky = device.shadow_map(sun_map_size(self._camera)), device.shadow_map(SKY_MAP)
        add = device.program("screen.vert.glsl", "add.frag.glsl")
        sums.use()
        sums.clear(0, 0, 0, 0)
        rng = np.random.default_rng(3)
        # Pixels are shifted in another order than the sky is gone through, or edges would take on its gradient.
        shift = rng.permutation(SAMPLES)
        for k in range(SAMPLES):
            jitter = ((shift[k] + 0.5) / SAMPLES - 0.5, (shift[k] * _GOLDEN + 0.5) % 1 - 0.5)
            # A shift of the map by less than a texel, new in each sample, hides its grid.
            shadows = self._draw_shadows(sun, sky, k, self.focus + rng.uniform(-0.2, 0.2, 3))
            self._draw_sample(sample, shadows, jitter)
            for unit, texture in enumerate(sample.color_attachments):
                texture.use(unit)
            put(add, {**self.pixels, "u_a": 0, "u_b": 1, "u_share": 1 / SAMPLES, "u_jitter": [0.0, 0.0]})
            sums.use()
            device.context.enable_only(device.gl.BLEND)
            device.context.blend_func = device.gl.ONE, device.gl.ONE
            device.screen(add)
        out = {}
        for name, texture in zip(("ambient", "sunlit"), sums.color_attachments, strict=True):
            pixels = np.frombuffer(texture.read(), dtype=np.float32).reshape(size[1], size[0], 4)
            out[name] = np.clip(pixels, 0, 6e4).astype(np.float16)
        return out

    def _draw_shadows(self, sun: Any, sky: Any, k: int, middle: Array) -> dict[str, Any]:
        """Shadow maps of the k-th point of the sun's disc and direction of the sky; returns their uniforms."""
        direction = self._daylight.sun_direction
        toward_sun = direction + SUN_RADIUS * _in_disc(k) @ _across(direction)
        toward_sky = _on_hemisphere(k)
        uniforms: dict[str, Any] = {"u_sky_direction": toward_sky, "u_sky_radiance": self._daylight.sky(toward_sky)}
        for unit, (name, target, toward) in enumerate((("sun", sun, toward_sun), ("sky", sky, toward_sky)), start=1):
            clip, texture = light_projection(toward, middle, SHADOW_RADIUS)
            self.draw_depth(target, clip)
            target.depth_attachment.use(unit)
            uniforms |= {f"u_{name}_map": unit, f"u_{name}_map_from": texture}
        return uniforms

    def _draw_sample(self, target: Any, shadows: dict[str, Any], jitter: tuple[float, float]) -> None:
        device = self.device
        target.use()
        target.clear(0, 0, 0, 0)
        device.context.enable_only(device.gl.DEPTH_TEST)
        self.noise.use(0)
        uniforms = {
            **self.uniforms,
            **shadows,
            "u_noise": 0,
            "u_model": self.view,
            "u_world": np.eye(4),
            "u_project": projection(self._camera.K, (0, 0, *self._size), jitter),
        }
        for mesh, options in self._seen:
            shade = device.program("geometry.vert.glsl", "static.frag.glsl", *options)
            put(shade, uniforms)
            mesh.draw(shade)
        sky = device.program("screen.vert.glsl", "sky.frag.glsl")
        put(sky, {**self.uniforms, **self.pixels, "u_noise": 0, "u_jitter": [-jitter[0], -jitter[1]]})
        device.screen(sky)


def sun_map_size(camera: Camera) -> int:
    """Texels of the sun's shadow map on each side: large images show finer shadows."""
    return 4096 if camera.width > 1280 else 2048


def _parts(device: Device, mesh: Mesh, camera: Camera) -> list[tuple[DeviceMesh, tuple[str, ...]]]:
    """A mesh by groups of materials, with the options of the programs that draw each.

    Only leaves have gaps between them, or nothing could be hidden from what is behind it before that is shaded.
    """
    order = list(MATERIALS)
    number = np.array([order.index(name) for name in mesh.materials])[mesh.material]
    left = np.ones(len(number), dtype=bool)
    out: list[tuple[DeviceMesh, tuple[str, ...]]] = []
    for group, (first, last) in GROUPS.items():
        chosen = left & (number >= order.index(first)) & (number <= order.index(last))
        left &= ~chosen
        if chosen.any():
            out.append((device.upload(mesh.taken(chosen), origin=camera.position), ("PARTS 1", group)))
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
