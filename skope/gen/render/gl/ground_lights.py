"""Light maps of lamps on the ground.

One map holds the street lights that matter for a camera. The other holds the headlights of vehicles around the middle
of the view and is drawn again in each frame.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skope.camera.model import Camera
from skope.gen.render.daylight import Daylight
from skope.gen.render.gl.context import CONTEXT_LIMITS, Device, projection
from skope.gen.render.gl.placed_vehicles import PlacedVehicle
from skope.gen.render.lit_lamps import has_headlights
from skope.gen.render.pixel_windows import beam_corners, beam_hull_of
from skope.gen.scene.conditions import Conditions
from skope.gen.scene.recording import LAMP_BITS
from skope.types import Array


@dataclass(frozen=True)
class GroundLightLimits:
    """Limits of lamps, beams and light maps on the ground."""

    most_lamps: int = 64
    """Maximum number of lamps that light the scenery."""
    most_pools: int = 4
    """Maximum number of patches of light on the road in a camera's view."""
    shadow_cells: int = 3
    """Shadow maps beside each other in a texture, on each axis. The nearest lamps cast shadows."""
    shadow_cell_texels: int = 1024
    """Side of each shadow map, texels."""
    lamp_map_px: int = 256
    """Side of the light map, pixels."""
    map_radius_m: float = 128.0
    """Radius of the light map around the middle of the view, metres."""
    lit_within_m: float = 240.0
    """Maximum distance of the lamps that light the ground, metres."""
    infrared_intensity: float = 22.0
    """Radiant intensity of a camera's infrared lamp."""
    infrared_share: float = 0.35
    """Share of a street light's light that an infrared camera sees."""
    back_light: float = 0.25
    """Share of a street light's intensity behind its pole, more than 30 degrees from straight down. Road lights with a
    shield on the house side have 0.1 to 0.4."""
    grass_share: float = 0.55
    """Share of the lamps' light that grass and crops reflect: blades shade each other in the low light of lamps."""
    lamp_height_m: float = 7.0
    """Vertical distance below the lamps for which the light map is computed, metres: one metre above the road."""
    beam_irradiance: float = 0.06
    """Irradiance of the road directly before a headlight without attenuation, in the units of `Daylight`."""
    beam_reach_m: float = 40.0
    """Reach of headlights on the road, metres."""
    wash_irradiance: float = 0.02
    """Irradiance of the road behind a vehicle from its tail lamps, in the units of `Daylight`."""
    wash_reach_m: float = 12.0
    """Reach of rear lamps on the road, metres."""
    brake_factor: float = 3.0
    """Factor on the light of the rear lamps while braking."""
    shadow_map_px: int = 1024
    """Side of the shadow map of beams, pixels."""


GROUND_LIGHTS: Final = GroundLightLimits()

LAMP_OPTIONS: Final = (
    "LAMPS",
    f"MOST_LAMPS {GROUND_LIGHTS.most_lamps}",
    f"SHADOWED_LAMPS {GROUND_LIGHTS.shadow_cells**2}",
    f"LAMP_CELLS {GROUND_LIGHTS.shadow_cells}",
    f"BACK_LIGHT {GROUND_LIGHTS.back_light}",
    f"GRASS_SHARE {GROUND_LIGHTS.grass_share}",
)
POOL_OPTIONS: Final = ("POOLS", f"MOST_POOLS {GROUND_LIGHTS.most_pools}")
_CONE_TANGENT: Final = np.tan(np.radians(75))


@dataclass(frozen=True, eq=False)
class StreetLights:
    positions: Array
    """(N, 3) positions relative to the camera, metres; those nearest to the middle of the view first."""
    arms: Array
    """(N, 2) horizontal unit vectors from the pole to the lamp; 0 without an arm."""
    intensity: Array
    """(3,) radiant intensity of each lamp, red, green and blue."""
    camera_lamp: float
    """Radiant intensity of the camera's own infrared lamp."""
    middle: Array
    """(3,) middle of the light map, relative to the camera, metres."""

    @classmethod
    def of(
        cls, lamps: Array, camera: Camera, conditions: Conditions, daylight: Daylight, middle: Array
    ) -> "StreetLights":
        """Return the lit street lights for a camera.

        Args:
            lamps: (N, 5) burning lights, as `Scenery.lamps` has them.
            camera: The camera.
            conditions: `infrared` is used.
            daylight: The light of the recording.
            middle: (3,) middle of the light map, relative to the camera, metres.
        """
        infrared = daylight.dark and conditions.infrared >= 0.5
        intensity = daylight.street_light * (GROUND_LIGHTS.infrared_share if infrared else 1.0)
        burning = lamps if intensity.any() else np.zeros((0, 5))
        offsets = burning[:, :3] - camera.position
        ahead = 0.6 * middle[:2]
        away = np.linalg.norm(offsets[:, :2] - ahead, axis=1)
        order = away.argsort(kind="stable")[: GROUND_LIGHTS.most_lamps]
        near = order[away[order] < GROUND_LIGHTS.lit_within_m]
        return cls(
            offsets[near],
            burning[near, 3:],
            intensity,
            GROUND_LIGHTS.infrared_intensity if infrared else 0.0,
            middle,
        )

    @property
    def uniforms(self) -> dict[str, Any]:
        padded = np.zeros((GROUND_LIGHTS.most_lamps, 4))
        padded[: len(self.positions), :3] = self.positions
        arms = np.zeros((GROUND_LIGHTS.most_lamps, 2))
        arms[: len(self.arms)] = self.arms
        maps = np.zeros((GROUND_LIGHTS.shadow_cells**2, 4, 4))
        for k in range(self.shadowed):
            maps[k] = _CLIP_TO_TEXTURE @ self.clip(k)
        return {
            "u_street_light": self.intensity,
            "u_luminaires": padded.astype("f4").tobytes(),
            "u_lamp_arms": arms.astype("f4").tobytes(),
            "u_lamp_count": len(self.positions),
            "u_lamp_map_from": maps,
            "u_shadowed": self.shadowed,
            "u_own_lamp": self.camera_lamp,
        }

    @property
    def shadowed(self) -> int:
        return min(len(self.positions), GROUND_LIGHTS.shadow_cells**2)

    def clip(self, k: int) -> Array:
        """Return the matrix from world axes to the clip space of a lamp that points straight down.

        World axes are relative to the camera.
        """
        T = np.diag([1.0, -1.0, -1.0, 1.0])
        T[:3, 3] = -T[:3, :3] @ self.positions[k]
        K = np.array([[1 / _CONE_TANGENT, 0, 1], [0, 1 / _CONE_TANGENT, 1], [0, 0, 1]])
        return projection(K, (0, 0, 2, 2)) @ T

    def on_ground(self) -> NDArray[np.float16]:
        """Return the vector of light around `middle`: each lamp's direction times its irradiance, north down.

        The shape is (LAMP_MAP_PX, LAMP_MAP_PX, 4). The fourth channel is empty; it gives texels a size that every
        device takes.
        """
        side = (
            np.arange(GROUND_LIGHTS.lamp_map_px) + 0.5
        ) / GROUND_LIGHTS.lamp_map_px * 2 * GROUND_LIGHTS.map_radius_m - GROUND_LIGHTS.map_radius_m
        x, y = np.meshgrid(side + self.middle[0], side + self.middle[1])
        out = np.zeros((GROUND_LIGHTS.lamp_map_px, GROUND_LIGHTS.lamp_map_px, 4))
        for lamp, arm in zip(self.positions, self.arms, strict=True):
            to = np.stack([lamp[0] - x, lamp[1] - y, np.full_like(x, GROUND_LIGHTS.lamp_height_m)], axis=-1)
            square = (to**2).sum(-1, keepdims=True)
            to /= np.sqrt(square)
            up = to[..., 2:]
            # As `luminaire` and `house_side` in lamps.glsl.
            behind = _smoothstep(0.0, 0.5, to[..., :2] @ arm)[..., None]
            side = 1 + (GROUND_LIGHTS.back_light - 1) * behind
            out[..., :3] += to * side * _smoothstep(0.2, 0.42, up) * (2.1 - 1.6 * up) / square
        return out.astype(np.float16)

    def mean(self, vectors: NDArray[np.float16]) -> Array:
        """Return the mean irradiance (3,) on the visible road."""
        half = GROUND_LIGHTS.lamp_map_px // 6
        upward = vectors[
            GROUND_LIGHTS.lamp_map_px // 2 - half : GROUND_LIGHTS.lamp_map_px // 2 + half,
            GROUND_LIGHTS.lamp_map_px // 2 - half : GROUND_LIGHTS.lamp_map_px // 2 + half,
            2,
        ].astype(np.float64)
        camera_light = self.camera_lamp * 0.35 / 14.0**2 * np.ones(3)
        return np.asarray(self.intensity * upward.mean() + camera_light)


def _smoothstep(first: float, last: float, value: Array) -> Array:
    share = np.clip((value - first) / (last - first), 0, 1)
    return np.asarray(share * share * (3 - 2 * share))


def pool_uniforms(pools: Array, camera: Camera, middle: Array) -> dict[str, Any]:
    """Return the uniforms of the patches of light nearest to the middle of the view.

    Args:
        pools: (N, 10) patches, as `Scenery.light_pools` has them.
        camera: The camera.
        middle: (3,) middle of its view, relative to it, metres.
    """
    from_camera = pools[:, :3] - camera.position
    order = np.linalg.norm((from_camera - middle)[:, :2], axis=1).argsort(kind="stable")[: GROUND_LIGHTS.most_pools]
    places, shapes, light = np.zeros((3, GROUND_LIGHTS.most_pools, 4))
    shapes[:, :2] = 1.0
    for k, i in enumerate(order.tolist()):
        places[k] = *from_camera[i, :2], *pools[i, 3:5]
        shapes[k, :3] = *pools[i, 5:7], from_camera[i, 2]
        light[k, :3] = pools[i, 7:]
    named = {"u_pools": places, "u_pool_shapes": shapes, "u_pool_light": light}
    return {name: values.astype("f4").tobytes() for name, values in named.items()}


_CLIP_TO_TEXTURE: Final = np.array([[0.5, 0, 0, 0.5], [0, 0.5, 0, 0.5], [0, 0, 0.5, 0.5], [0, 0, 0, 1.0]])
assert CONTEXT_LIMITS.far_m > GROUND_LIGHTS.lit_within_m


_BEAM_COLOR: Final = np.array([1.0, 0.95, 0.86])
_BRAKE_COLOR: Final = np.array([1.0, 0.05, 0.06])


class Beams:
    def __init__(self, device: Device, middle: Array, radius: float, exposure: Array) -> None:
        """Create an empty map that covers `radius` metres around `middle` (world coordinates)."""
        self._device, self._middle, self._radius = device, middle, radius
        self._target = device.target((GROUND_LIGHTS.shadow_map_px, GROUND_LIGHTS.shadow_map_px), ["2f2"], depth=False)
        (self.texture,) = self._target.color_attachments
        self.texture.filter = (device.gl.LINEAR, device.gl.LINEAR)
        self.texture.repeat_x = self.texture.repeat_y = False
        self.uniforms: dict[str, Any] = {
            "u_beam": GROUND_LIGHTS.beam_irradiance,
            "u_beam_light": GROUND_LIGHTS.beam_irradiance * exposure * _BEAM_COLOR / np.pi,
            "u_wash_light": GROUND_LIGHTS.wash_irradiance * exposure * _BRAKE_COLOR / np.pi,
        }

    def draw(self, placed: Sequence[PlacedVehicle], camera: Camera) -> list[Array]:
        """Draw the beams of vehicles with lit lamps.

        Return polygons in the image around the road that they may light.
        """
        device = self._device
        lit = [
            vehicle
            for vehicle in placed
            if vehicle.look["u_lamps"] & LAMP_BITS["low_beam"] and has_headlights(vehicle.vehicle)
        ]
        self._target.use()
        self._target.clear(0, 0, 0, 0)
        if not lit:
            return []
        device.context.enable_only(device.gl.BLEND)
        device.context.blend_func = device.gl.ONE, device.gl.ONE
        hulls = []
        # A trailer hides its tractor's rear lamps.
        for reach, some, options in (
            (GROUND_LIGHTS.beam_reach_m, lit, ()),
            (-GROUND_LIGHTS.wash_reach_m, [vehicle for vehicle in lit if vehicle.vehicle.trailer is None], ("WASH",)),
        ):
            program = device.program("contact.vert.glsl", "beam.frag.glsl", *options)
            if some:
                corners = np.concatenate([self._beam_triangles(vehicle, reach) for vehicle in some])
                device.triangles(program, corners, "2f 2f 3f", "in_at", "in_local", "in_size")
            hulls += [beam_hull_of(vehicle.vehicle, vehicle.T_world_chassis, camera, reach) for vehicle in some]
        return hulls

    def _beam_triangles(self, vehicle: PlacedVehicle, reach: float) -> NDArray[np.float32]:
        """Return the corners (6, 7) of two triangles around the road that a vehicle lights.

        Columns: position in the map (2), position ahead of the bumper (2), reach of the light, half its width, its
        height. A negative `reach` selects the road behind the vehicle; the column of the reach then holds the strength
        of the lamps.
        """
        length, width, height = vehicle.vehicle.size_lwh
        local = beam_corners(reach)[[0, 1, 2, 0, 2, 3]]
        T = vehicle.T_world_chassis
        world = (local + [np.copysign(length / 2, reach), 0]) @ T[:2, :2].T + T[:2, 3]
        strength = GROUND_LIGHTS.brake_factor if vehicle.look["u_lamps"] & LAMP_BITS["brake"] else 1.0
        size = np.tile([reach if reach > 0 else strength, width / 2, height], (6, 1))
        return np.column_stack([(world - self._middle[:2]) / self._radius, local, size]).astype(np.float32)
