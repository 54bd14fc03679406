"""The light of headlights on the road: a map around the middle of the view, drawn anew in each frame."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skope.camera.model import Camera
from skope.gen.render.gl.context import Device
from skope.gen.render.gl.placed_vehicles import PlacedVehicle
from skope.gen.render.pixel_windows import beam_corners, beam_hull_of
from skope.gen.render.vehicle_lamps import has_headlights
from skope.gen.scene.lamps import LAMPS
from skope.types import Array

IRRADIANCE: Final = 0.06
"""Irradiance of the road right before a headlight, where nothing weakens it, in the units of `Daylight`."""
BEAM_REACH_M: Final = 40.0
"""Reach of headlights on the road, metres."""
WASH_IRRADIANCE: Final = 0.02
"""Irradiance of the road behind a vehicle by its tail lamps, in the same units."""
WASH_REACH_M: Final = 12.0
"""Reach of rear lamps on the road, metres."""
_BRAKING: Final = 3.0
"""How much more of it brake lamps give."""
SHADOW_MAP_PX: Final = 1024
_COLOR: Final = np.array([1.0, 0.95, 0.86])
_RED: Final = np.array([1.0, 0.05, 0.06])


class Beams:
    def __init__(self, device: Device, middle: Array, radius: float, exposure: Array) -> None:
        """The map reaches `radius` around `middle` (world), metres."""
        self._device, self._middle, self._radius = device, middle, radius
        self._target = device.target((SHADOW_MAP_PX, SHADOW_MAP_PX), ["2f2"], depth=False)
        (self.texture,) = self._target.color_attachments
        self.texture.filter = (device.gl.LINEAR, device.gl.LINEAR)
        self.texture.repeat_x = self.texture.repeat_y = False
        self.uniforms: dict[str, Any] = {
            "u_beam": IRRADIANCE,
            "u_beam_light": IRRADIANCE * exposure * _COLOR / np.pi,
            "u_wash_light": WASH_IRRADIANCE * exposure * _RED / np.pi,
        }

    def draw(self, placed: Sequence[PlacedVehicle], camera: Camera) -> list[Array]:
        """Draw the beams of those whose lamps are lit; returns polygons in the image around what they may light."""
        device = self._device
        lit = [one for one in placed if one.look["u_lamps"] & LAMPS["low_beam"] and has_headlights(one.vehicle)]
        self._target.use()
        self._target.clear(0, 0, 0, 0)
        if not lit:
            return []
        device.context.enable_only(device.gl.BLEND)
        device.context.blend_func = device.gl.ONE, device.gl.ONE
        hulls = []
        # A trailer hides its tractor's rear lamps.
        for reach, some, options in (
            (BEAM_REACH_M, lit, ()),
            (-WASH_REACH_M, [one for one in lit if one.vehicle.trailer is None], ("WASH",)),
        ):
            program = device.program("contact.vert.glsl", "beam.frag.glsl", *options)
            if some:
                corners = np.concatenate([self._beam_triangles(one, reach) for one in some])
                device.triangles(program, corners, "2f 2f 3f", "in_at", "in_local", "in_size")
            hulls += [beam_hull_of(one.vehicle, one.T_world_chassis, camera, reach) for one in some]
        return hulls

    def _beam_triangles(self, one: PlacedVehicle, reach: float) -> NDArray[np.float32]:
        """(6, 7) corners of two triangles around the road that a vehicle lights.

        Columns: place in the map (2), place ahead of the bumper (2), how far its light reaches, half its width, its
        height. With a negative `reach` it is the road behind it, and in place of the reach stands the lamps' strength.
        """
        length, width, height = one.vehicle.size_lwh
        local = beam_corners(reach)[[0, 1, 2, 0, 2, 3]]
        T = one.T_world_chassis
        world = (local + [np.copysign(length / 2, reach), 0]) @ T[:2, :2].T + T[:2, 3]
        strength = _BRAKING if one.look["u_lamps"] & LAMPS["brake"] else 1.0
        size = np.tile([reach if reach > 0 else strength, width / 2, height], (6, 1))
        return np.column_stack([(world - self._middle[:2]) / self._radius, local, size]).astype(np.float32)
