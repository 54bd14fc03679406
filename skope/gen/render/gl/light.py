"""Light of the stationary scenery, computed once per recording.

The light is an average of many samples. Each sample has its own pixel shift, its own point of the sun's disc and its
own direction of the sky. Anti-aliasing, soft shadows and sky occlusion follow from this average.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache, partial
from itertools import pairwise
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from skope.camera.model import Camera
from skope.gen.cache import Arrays
from skope.gen.mesh import Mesh
from skope.gen.render.daylight import Daylight
from skope.gen.render.gl import ground_lights as street_lights
from skope.gen.render.gl.context import (
    Device,
    DeviceMesh,
    albedo_table,
    light_projection,
    noise_tile,
    pattern_tables,
    projection,
    put,
)
from skope.gen.render.gl.ground_lights import StreetLights
from skope.gen.render.gl.wet_ground import Plane, uniforms_of
from skope.gen.render.materials import MATERIAL_COLORS, USUAL_PALETTE, Palette
from skope.gen.render.night_camera import NIGHT_SENSOR
from skope.gen.scene.conditions import Conditions
from skope.types import Array

LitMeshes = list[tuple[DeviceMesh, tuple[str, ...]]]
"""Meshes with the options of the programs that draw them."""


@dataclass(frozen=True)
class LightSampling:
    """Samples and shadow maps of sun and sky."""

    samples: int = 24
    """Number of samples of sun and sky."""
    standing_water: int = 64
    """Value added to the mirrored share of light where water stands: greater than the sum over all samples."""
    mirrored_share: int = 4
    """Divisor of the number of samples for the mirror image on wet ground. It has half the resolution, as water
    blurs it."""
    sky_map_texels: int = 2048
    """Side of the sky's shadow maps, texels."""
    shadow_map_m: float = 140.0
    """Side of the area that a shadow map covers, metres."""
    sun_radius_rad: float = 0.0047
    """Angular radius of the sun's disc, radians."""
    golden_ratio: float = (1 + 5**0.5) / 2
    """Golden ratio, used to spread the samples."""


LIGHT_SAMPLING: Final = LightSampling()

PATTERN_GROUPS: Final = {
    "WALLS": ("brick", "sandstone"),
    "GROUND": ("asphalt", "grass"),
    "LEAVES": ("leaves", "leaves_pale"),
    "OTHERS": ("asphalt", "seam"),
}
"""Ranges of materials (first and last in the table) that share the programs compiled for their patterns."""


class Stage:
    """Scenery on the device with sun, sky and street lights."""

    def __init__(
        self,
        device: Device,
        mesh: Mesh,
        camera: Camera,
        conditions: Conditions,
        burning: Array | None = None,
        daylight: Daylight | None = None,
        palette: Palette = USUAL_PALETTE,
        pools: Array | None = None,
    ) -> None:
        """Upload the scenery and set up its light.

        Args:
            device: The OpenGL device.
            mesh: The scenery.
            camera: The image's camera.
            conditions: Conditions of the recording.
            burning: (N, 3) lit street lights, if any.
            daylight: Light of sun and sky; None: that of `conditions`.
            palette: Colours of the materials.
            pools: (N, 10) patches of light on the road, as `Scenery.light_pools` has them.
        """
        self.device, self._camera, self._mesh = device, camera, mesh
        self._size = (camera.width, camera.height)
        self.focus = _view_focus(camera)
        """(3,) point on the road in the middle of the view, world axes, relative to the camera."""
        self.view = np.eye(4)
        self.view[:3, :3] = camera.T_camera_world[:3, :3]
        daylight = daylight or Daylight.of(conditions)
        self.street_lights = StreetLights.of(
            np.zeros((0, 3)) if burning is None else burning, camera, conditions, daylight, self.focus
        )
        self.lamp_vectors = self.street_lights.on_ground()
        self.daylight = replace(daylight, lamplight=self.street_lights.mean(self.lamp_vectors))
        daylight = self.daylight
        self.options = (
            *(street_lights.LAMP_OPTIONS if daylight.dark else ()),
            *(street_lights.POOL_OPTIONS if daylight.dark and pools is not None and len(pools) else ()),
            *(("WET",) if conditions.wetness > 0 else ()),
            *(("PATTERNS",) if palette.patterns else ()),
            *(("SNOW",) if conditions.snow_cover > 0 else ()),
        )
        self._seen, self._casting = _scenery_parts(device, mesh, _Eye.of(camera))
        self.noise = device.context.texture((256, 256), 4, noise_tile())
        self.noise.build_mipmaps()
        self.noise.filter = (device.gl.LINEAR_MIPMAP_LINEAR, device.gl.LINEAR)
        self.uniforms = {**_look_of(camera, conditions, daylight, palette), **self.street_lights.uniforms}
        if pools is not None:
            self.uniforms |= street_lights.pool_uniforms(pools, camera, self.focus)
        self.pixels: dict[str, Any] = {
            "u_size": list(self._size),
            "u_camera_from_pixel": np.linalg.inv(camera.K),
            "u_world_from_camera": camera.T_camera_world[:3, :3].T,
        }

    def draw_geometry(self, target: Any) -> None:
        """Draw depth, slopes and a hit mask at pixel centres."""
        target.use()
        target.clear(0, 0, 0, 0)
        self.device.context.enable_only(self.device.gl.DEPTH_TEST)
        P = projection(self._camera.K, (0, 0, *self._size))
        for mesh, options in self._seen:
            program = self.device.program("geometry.vert.glsl", "geometry.frag.glsl", *options)
            put(program, {"u_model": self.view, "u_world": np.eye(4), "u_project": P, "u_id": 1.0})
            mesh.draw(program)

    def draw_depth(self, target: Any, clip: Array, *, seen: bool = False, parts: Any = None) -> None:
        """Draw the depth buffer of the objects that cast shadows, of those that the camera sees, or of some parts.

        `clip` is the matrix from world axes, relative to the camera, to clip space.
        """
        target.use()
        target.clear(viewport=target.viewport)
        self.device.context.enable_only(self.device.gl.DEPTH_TEST)
        for mesh, options in parts or (self._seen if seen else self._casting):
            program = self.device.program("geometry.vert.glsl", "shadow.frag.glsl", *options)
            put(program, {**self.uniforms, "u_model": np.eye(4), "u_world": np.eye(4), "u_project": clip})
            mesh.draw(program)

    def light_parts(self, count: int) -> list[Callable[[], dict[str, NDArray[np.float32]]]]:
        """Return tasks for `joined`; each computes a part of the light, summed over a share of the samples."""
        ends = np.linspace(0, LIGHT_SAMPLING.samples, count + 1).astype(int)
        return [partial(self._light_part, range(*pair)) for pair in pairwise(ends)]

    def _light_part(self, which: range) -> dict[str, NDArray[np.float32]]:
        ambient, sunlit = self._sum_of_light(self._size, which, LIGHT_SAMPLING.samples, np.eye(4), self._seen)
        return {"ambient": ambient, "sunlit": sunlit}

    def mirrored(self, plane: Plane) -> dict[str, NDArray[np.float16]]:
        """Draw the mirror image of the scenery on the road: "mirrored" (H / 2, W / 2, 4)."""
        width, height = self._size
        self.uniforms |= uniforms_of(plane)
        samples = max(2, LIGHT_SAMPLING.samples // LIGHT_SAMPLING.mirrored_share)
        size = (-(-width // 2), -(-height // 2))
        ambient, sunlit = self._sum_of_light(
            size, range(samples), samples, plane.mirror, self.reflected_parts(plane), "MIRRORED"
        )
        return {"mirrored": _half_precision(ambient + sunlit)}

    def reflected_parts(self, plane: Plane) -> LitMeshes:
        """Return the parts that the mirrored view may show."""
        return _upload_parts(
            self.device, self._mesh.taken(_in_view(self._mesh, self._camera, plane.mirror)), self._camera
        )

    def draw_mirrored_depth(self, target: Any, plane: Plane) -> None:
        """Draw the depth of the scene as the wet road mirrors it."""
        self.uniforms |= uniforms_of(plane)
        parts = [(mesh, (*options, "MIRRORED")) for mesh, options in self.reflected_parts(plane)]
        P = projection(self._camera.K, (0, 0, *self._size))
        self.draw_depth(target, P @ self.view @ plane.mirror, parts=parts)

    def _sum_of_light(
        self,
        size: tuple[int, int],
        which: range,
        samples: int,
        placed: Array,
        parts: LitMeshes,
        *options: str,
    ) -> list[NDArray[np.float32]]:
        """Return sums over the samples in `which`, weighted for the mean over all samples.

        `placed` is a transform of the scene.
        """
        device = self.device
        sums, sample = (device.target(size, ["4f4", "4f4"]) for _ in range(2))
        sun, sky = device.shadow_map(sun_map_size(self._camera)), device.shadow_map(LIGHT_SAMPLING.sky_map_texels)
        lamp_maps = self._lamp_maps
        add = device.program("screen.vert.glsl", "add.frag.glsl")
        sums.use()
        sums.clear(0, 0, 0, 0)
        rng = np.random.default_rng(3)
        # The order of pixel shifts differs from that of sky directions, otherwise edges would take on the sky's
        # gradient.
        shift = rng.permutation(samples)
        # Each sample shifts the map by less than a texel, which hides the map's grid.
        middles = self.focus + rng.uniform(-0.2, 0.2, (samples, 3))
        for k in which:
            jitter = ((shift[k] + 0.5) / samples - 0.5, (shift[k] * LIGHT_SAMPLING.golden_ratio + 0.5) % 1 - 0.5)
            shadows = self._draw_shadows(sun, sky, k, samples, middles[k])
            if lamp_maps:
                lamp_maps.depth_attachment.use(3)
                shadows["u_lamp_maps"] = 3
            self._draw_sample(sample, shadows, jitter, placed, parts, *options)
            for unit, texture in enumerate(sample.color_attachments):
                texture.use(unit)
            put(add, {"u_size": list(size), "u_a": 0, "u_b": 1, "u_share": 1 / samples, "u_jitter": [0.0, 0.0]})
            sums.use()
            device.context.enable_only(device.gl.BLEND)
            device.context.blend_func = device.gl.ONE, device.gl.ONE
            device.screen(add)
        textures = sums.color_attachments
        return [np.frombuffer(t.read(), dtype=np.float32).reshape(size[1], size[0], 4).copy() for t in textures]

    @cached_property
    def _lamp_maps(self) -> Any:
        """Return shadow maps of the nearest street lights; None if no street light burns."""
        if not self.daylight.dark:
            return None
        maps = self.device.shadow_map(
            street_lights.GROUND_LIGHTS.shadow_cells * street_lights.GROUND_LIGHTS.shadow_cell_texels
        )
        for k in range(self.street_lights.shadowed):
            row, column = divmod(k, street_lights.GROUND_LIGHTS.shadow_cells)
            maps.viewport = (
                column * street_lights.GROUND_LIGHTS.shadow_cell_texels,
                row * street_lights.GROUND_LIGHTS.shadow_cell_texels,
                street_lights.GROUND_LIGHTS.shadow_cell_texels,
                street_lights.GROUND_LIGHTS.shadow_cell_texels,
            )
            self.draw_depth(maps, self.street_lights.clip(k))
        return maps

    def _draw_shadows(self, sun: Any, sky: Any, k: int, samples: int, middle: Array) -> dict[str, Any]:
        """Draw shadow maps of the k-th point of the sun's disc and direction of the sky; return their uniforms."""
        direction = self.daylight.sun_direction
        toward_sun = direction + LIGHT_SAMPLING.sun_radius_rad * _in_disc(k, samples) @ _unit_vectors_across(direction)
        toward_sky = _on_hemisphere(k, samples)
        uniforms: dict[str, Any] = {"u_sky_direction": toward_sky, "u_sky_radiance": self.daylight.sky(toward_sky)}
        for unit, (name, target, toward) in enumerate((("sun", sun, toward_sun), ("sky", sky, toward_sky)), start=1):
            clip, texture = light_projection(toward, middle, LIGHT_SAMPLING.shadow_map_m)
            self.draw_depth(target, clip)
            target.depth_attachment.use(unit)
            uniforms |= {f"u_{name}_map": unit, f"u_{name}_map_from": texture}
        return uniforms

    def _draw_sample(
        self,
        target: Any,
        shadows: dict[str, Any],
        jitter: tuple[float, float],
        placed: Array,
        parts: LitMeshes,
        *options: str,
    ) -> None:
        device = self.device
        target.use()
        target.clear(0, 0, 0, 0)
        device.context.enable_only(device.gl.DEPTH_TEST)
        self.noise.use(0)
        # A sample may be coarser than the image; its pixel shift scales with it.
        share = (jitter[0] * self._size[0] / target.width, jitter[1] * self._size[1] / target.height)
        uniforms = {
            **self.uniforms,
            **shadows,
            "u_noise": 0,
            "u_viewer": placed[:3, 3],
            "u_model": self.view @ placed,
            "u_world": np.eye(4),
            "u_project": projection(self._camera.K, (0, 0, *self._size), share),
        }
        for mesh, group in parts:
            shade = device.program("geometry.vert.glsl", "static.frag.glsl", *group, *self.options, *options)
            put(shade, uniforms)
            mesh.draw(shade)
        sky = device.program("screen.vert.glsl", "sky.frag.glsl")
        turned = {"u_world_from_camera": placed[:3, :3] @ self.pixels["u_world_from_camera"]}
        put(sky, {**self.uniforms, **self.pixels, **turned, "u_noise": 0, "u_jitter": [-share[0], -share[1]]})
        device.screen(sky)


def _look_of(camera: Camera, conditions: Conditions, daylight: Daylight, palette: Palette) -> dict[str, Any]:
    """Return uniforms of the programs that draw scenery: sun and sky, colours, haze, water and snow."""
    first, second = pattern_tables(palette)
    return {
        "u_eye": camera.position,
        "u_sun_direction": daylight.sun_direction,
        "u_sun": daylight.sun,
        "u_zenith": daylight.zenith,
        "u_horizon": daylight.horizon,
        "u_afterglow": daylight.afterglow,
        "u_sunset": daylight.sunset,
        "u_ground": daylight.ground,
        "u_bounced": daylight.bounced,
        "u_cloud": daylight.clouds,
        "u_albedo": albedo_table(palette),
        "u_pattern_first": first,
        "u_pattern_second": second,
        "u_exposure": daylight.exposure,
        "u_haze": daylight.haze,
        "u_haze_density": daylight.haze_density,
        "u_vignetting": daylight.vignetting,
        "u_lamp_radiance": NIGHT_SENSOR.day_units if daylight.dark else 1.0,
        "u_pixels": camera.width / 1920,
        "u_wetness": conditions.wetness,
        "u_puddles": conditions.puddles,
        "u_standing": LIGHT_SAMPLING.standing_water,
        "u_lit_windows": conditions.lit_windows,
        "u_all_lit": conditions.street_lights_lit >= 1,
        "u_snow": conditions.snow_cover,
    }


def mean_light(parts: Sequence[Arrays]) -> dict[str, NDArray[np.float16]]:
    """Return the mean of the samples: light from sky and lamps ("ambient") and from the sun ("sunlit"), (H, W, 4) each.

    The fourth channel of "ambient" is the albedo. That of "sunlit" is the share of light that water on the ground
    mirrors, negative where water stands.
    """
    ambient, sunlit = (np.sum([part[name] for part in parts], axis=0) for name in ("ambient", "sunlit"))
    sunlit[..., 3] = _signed_water(sunlit[..., 3], LIGHT_SAMPLING.samples)
    return {"ambient": _half_precision(ambient), "sunlit": _half_precision(sunlit)}


def _half_precision(pixels: NDArray[np.float32]) -> NDArray[np.float16]:
    return np.clip(pixels, -6e4, 6e4).astype(np.float16)


def _signed_water(water: NDArray[np.float32], samples: int) -> NDArray[np.float32]:
    """Convert means that contain STANDING_WATER to signed means: negative if water stands in most samples."""
    standing = np.floor(water * (samples / LIGHT_SAMPLING.standing_water) + 1e-3)
    share = np.maximum(water - standing * (LIGHT_SAMPLING.standing_water / samples), 0.0)
    return np.asarray(np.where(2 * standing > samples, -share, share), dtype=np.float32)


def sun_map_size(camera: Camera) -> int:
    """Return the side of the sun's shadow map, texels. Large images show finer shadows."""
    return 4096 if camera.width > 1280 else 2048


@dataclass(frozen=True)
class _Eye:
    """Camera that serves as a cache key. Cameras with the same view are equal."""

    camera: Camera = field(compare=False)
    key: tuple[int, int, bytes, bytes]

    @classmethod
    def of(cls, camera: Camera) -> Self:
        return cls(camera, (camera.width, camera.height, camera.K.tobytes(), camera.T_camera_world.tobytes()))


@lru_cache(maxsize=2)
def _scenery_parts(device: Device, mesh: Mesh, eye: _Eye) -> tuple[LitMeshes, LitMeshes]:
    """Return the parts of a scenery that a camera sees, and those that may cast shadows into its view.

    The result is cached, since consecutive recordings often share a camera.
    """
    camera = eye.camera
    seen, casting = mesh.taken(_in_view(mesh, camera, np.eye(4))), mesh.taken(_within_reach(mesh, camera))
    return _upload_parts(device, seen, camera), _upload_parts(device, casting, camera)


def _view_focus(camera: Camera) -> Array:
    forward = camera.T_camera_world[2, :3]
    level = np.array([forward[0], forward[1], 0.0]) / max(np.hypot(forward[0], forward[1]), 1e-6)
    return np.asarray(40.0 * level - [0, 0, camera.position[2]])


def _in_view(mesh: Mesh, camera: Camera, placed: Array) -> NDArray[np.int64]:
    """Return the triangles that the image may show after the transform `placed` (world axes, relative to the camera).

    They are ordered from near to far, so that few hidden pixels are shaded.
    """
    points = (mesh.vertices - camera.position) @ placed[:3, :3].T + placed[:3, 3]
    frame = points @ camera.T_camera_world[:3, :3].T
    x, y, z = frame.T
    (fx, fy), (cx, cy) = camera.K[[0, 1], [0, 1]], camera.K[:2, 2]
    # Outside if all three corners are beyond the same side of the view, widened by the pixel jitter.
    sides = (
        x * fx + (cx + 1) * z,
        (camera.width + 1 - cx) * z - x * fx,
        y * fy + (cy + 1) * z,
        (camera.height + 1 - cy) * z - y * fy,
        z,
    )
    beyond = np.packbits([side < 0 for side in sides], axis=0)[0]
    a, b, c = mesh.triangles.T
    seen = np.flatnonzero(beyond[a] & beyond[b] & beyond[c] == 0)
    away = np.linalg.norm(frame, axis=-1)[mesh.triangles[seen]].min(axis=-1)
    return np.asarray(seen[away.argsort(kind="stable")])


def _within_reach(mesh: Mesh, camera: Camera) -> NDArray[np.bool_]:
    """Return a mask of the triangles that may cast shadows into the view."""
    away = np.linalg.norm((mesh.vertices - camera.position - _view_focus(camera))[:, :2], axis=-1)
    return np.asarray((away < 2 * LIGHT_SAMPLING.shadow_map_m)[mesh.triangles].any(axis=-1))


def _upload_parts(device: Device, mesh: Mesh, camera: Camera) -> LitMeshes:
    """Upload a mesh by groups of materials, with the options of the programs that draw each group.

    Only leaves have gaps. Otherwise nothing could be rejected by depth before it is shaded.
    """
    order = list(MATERIAL_COLORS)
    # Colours that are named directly are drawn with the last group.
    last_number = order.index(PATTERN_GROUPS["OTHERS"][1])
    numbers = [last_number if name.startswith("#") else order.index(name) for name in mesh.materials]
    number = np.array(numbers)[mesh.material]
    left = np.ones(len(number), dtype=bool)
    out: LitMeshes = []
    for group, (first, last) in PATTERN_GROUPS.items():
        chosen = left & (number >= order.index(first)) & (number <= order.index(last))
        left &= ~chosen
        if chosen.any():
            out.append((device.upload(mesh.taken(chosen), origin=camera.position), ("PARTS 1", group)))
    return out


def _in_disc(k: int, samples: int) -> Array:
    angle, radius = 2.399963 * k, ((k + 0.5) / samples) ** 0.5
    return np.array([radius * np.cos(angle), radius * np.sin(angle)])


def _unit_vectors_across(direction: Array) -> Array:
    """Return two unit vectors (2, 3) perpendicular to a direction."""
    side = np.cross(direction, [0.0, 0.0, 1.0])
    side /= max(float(np.linalg.norm(side)), 1e-9)
    return np.stack([side, np.cross(direction, side)])


def _on_hemisphere(k: int, samples: int) -> Array:
    """Return the k-th of evenly spread directions over the upper hemisphere (a Fibonacci lattice)."""
    z, angle = (k + 0.5) / samples, 2.399963 * k
    r = (1 - z * z) ** 0.5
    return np.array([r * np.cos(angle), r * np.sin(angle), z])
