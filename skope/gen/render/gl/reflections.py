"""The vehicles' mirror images on wet ground, drawn half as fine as the image."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from skope.camera.model import Camera
from skope.gen.render.gl.context import Device, projection, put
from skope.gen.render.gl.placed_vehicles import PARTS_DEFINITION, PlacedVehicle
from skope.gen.render.gl.water import Plane
from skope.gen.render.pixel_windows import TILE, mirror_hull_of, tile_runs, tiles

BLUR: Final = 64
"""Blur of a mirror image up and down by water in an image 1920 pixels wide (see blur.glsl), pixels."""
MIRRORED_WITHIN_M: Final = 90.0
"""Vehicles farther from the camera than this are not mirrored, metres."""


class Reflections:
    def __init__(self, device: Device, camera: Camera, road: Plane, scenery_depth: Any, *options: str) -> None:
        """`scenery_depth` is a texture of what hides vehicles in the mirror."""
        self._device, self._camera, self._road, self._options = device, camera, road, options
        self._target = device.target(scenery_depth.size, ["4f2"])
        (self.texture,) = self._target.color_attachments
        self.texture.filter = (device.gl.LINEAR, device.gl.LINEAR)
        self.texture.repeat_x = self.texture.repeat_y = False
        self._scenery_depth = scenery_depth
        turn = np.eye(4)
        turn[:3, :3] = camera.T_camera_world[:3, :3]
        image = projection(camera.K, (0, 0, camera.width, camera.height))
        self._uniforms = {
            "u_plane": road.uniform,
            "u_viewer": road.mirror[:3, 3],
            "u_project": image @ turn @ road.mirror,
        }

    def draw(
        self, placed: Sequence[PlacedVehicle], uniforms: Mapping[str, Any], units: Mapping[str, Any]
    ) -> NDArray[np.bool_]:
        """Draw mirror images; returns the tiles of the image that they may touch once they are blurred.

        `uniforms` are the vehicles' own, `units` how many textures are bound for them.
        """
        device, camera = self._device, self._camera
        size = (camera.width, camera.height)
        near = [one for one in placed if one.distance < MIRRORED_WITHIN_M]
        hulls = [mirror_hull_of(one.vehicle, one.T_world_parts, camera, self._road.mirror) for one in near]
        reach = -(-round(BLUR * size[0] / 1920) // TILE)
        around = cv2.dilate(tiles(hulls, size).astype(np.uint8), np.ones((2 * reach + 1, 3), np.uint8)) > 0
        # The blur looks beyond these tiles too.
        self._target.clear(0, 0, 0, 0)
        half = [(x0 // 2, y0 // 2, -(-x1 // 2), -(-y1 // 2)) for x0, y0, x1, y1 in tile_runs(around, size)]
        unit = len(units)
        self._scenery_depth.use(unit)
        own = {**uniforms, "u_size": list(self._target.size), "u_scenery": unit}
        device.prepare(self._target, half, own, "SCENERY", "STEP 1")
        device.context.enable_only(device.gl.DEPTH_TEST | device.gl.CULL_FACE)
        device.context.front_face = "ccw"
        program = device.program(
            "vehicle.vert.glsl", "vehicle.frag.glsl", PARTS_DEFINITION, "REFLECTION", *self._options
        )
        put(program, {**uniforms, **self._uniforms})
        for one in near:
            put(program, {**one.matrices, "u_model": one.matrices["u_world"], **one.look})
            one.coarse.draw(program)
        device.context.front_face = "cw"
        return np.asarray(around)
