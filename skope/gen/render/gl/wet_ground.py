"""Wet ground: the plane of the mirroring road, and the vehicles' mirror images at half the image's resolution."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from skope.camera.model import Camera
from skope.gen.render.gl.context import Device, projection, put
from skope.gen.render.gl.placed_vehicles import PARTS_DEFINITION, PlacedVehicle
from skope.gen.render.pixel_windows import WINDOW_LIMITS, mirror_hull_of, tile_runs, tiles
from skope.types import Array


@dataclass(frozen=True)
class WetGroundLimits:
    """Plane and blur of mirror images on wet ground."""

    plane_depth_m: float = 45.0
    """Maximum depth at which the plane is fitted to the ground, metres."""
    level_normal_z: float = 0.97
    """Minimum z of the ground's normal."""
    blur_px: int = 64
    """Vertical blur of a mirror image by water, pixels of an image that is 1920 pixels wide (see blur.glsl)."""
    mirrored_within_m: float = 90.0
    """Maximum distance from the camera at which vehicles are mirrored, metres."""


WET_GROUND: Final = WetGroundLimits()


@dataclass(frozen=True, eq=False)
class Plane:
    normal: Array
    """(3,) unit normal, upwards."""
    distance: float
    """Height of the camera above the plane, metres."""

    @property
    def uniform(self) -> Array:
        return np.array([*self.normal, self.distance])

    @property
    def mirror(self) -> Array:
        """Return the reflection (4, 4) in the plane, in world axes relative to the camera."""
        out = np.eye(4)
        out[:3, :3] -= 2 * np.outer(self.normal, self.normal)
        out[:3, 3] = -2 * self.distance * self.normal
        return out


def plane_of(camera: Camera, depth: NDArray[np.float32], slope: NDArray[np.float32]) -> Plane:
    """Fit a plane to the level ground in view; without level ground, return a plane below the camera.

    Args:
        camera: The image's camera.
        depth: (H, W) metres, +inf for the sky.
        slope: (H, W, 2) change of depth per pixel.
    """
    step = max(1, camera.width // 160)
    z, dz = depth[::step, ::step].astype(np.float64), slope[::step, ::step].astype(np.float64)
    rows, columns = np.mgrid[: depth.shape[0] : step, : depth.shape[1] : step]
    rays, _ = camera.rays(np.stack([columns, rows], axis=-1) + 0.5)
    near = z < WET_GROUND.plane_depth_m
    rays, z, dz = rays[near], z[near], dz[near]
    focal = camera.K[[0, 1], [0, 1]]
    right = rays * dz[:, :1] + z[:, None] * np.array([1 / focal[0], 0, 0])
    down = rays * dz[:, 1:] + z[:, None] * np.array([0, 1 / focal[1], 0])
    R = camera.T_camera_world[:3, :3]
    normals = np.cross(down, right) @ R
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    points = (rays * z[:, None] @ R)[np.abs(normals[:, 2]) > WET_GROUND.level_normal_z]
    if len(points) < 30:
        return Plane(np.array([0.0, 0.0, 1.0]), float(camera.position[2]))
    design = np.column_stack([points[:, :2], np.ones(len(points))])
    kept = np.abs(points[:, 2] - np.median(points[:, 2])) < 3.0
    for _ in range(4):
        solution = np.linalg.lstsq(design[kept], points[kept, 2], rcond=None)[0]
        off = np.abs(design @ solution - points[:, 2])
        kept = off < max(0.1, float(np.quantile(off[kept], 0.8)))
    normal = np.array([-solution[0], -solution[1], 1.0])
    length = float(np.linalg.norm(normal))
    return Plane(normal / length, float(-solution[2] / length))


def uniforms_of(plane: Plane) -> dict[str, Any]:
    return {"u_plane": plane.uniform}


class Reflections:
    def __init__(self, device: Device, camera: Camera, road: Plane, scenery_depth: Any, *options: str) -> None:
        """Create the targets; `scenery_depth` is a texture of the scenery that hides vehicles in the mirror."""
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
        """Draw mirror images; return the tiles of the image that they may touch after blurring.

        `uniforms` are those of the vehicles; `units` gives the number of textures that are bound for them.
        """
        device, camera = self._device, self._camera
        size = (camera.width, camera.height)
        near = [vehicle for vehicle in placed if vehicle.distance < WET_GROUND.mirrored_within_m]
        hulls = [mirror_hull_of(vehicle.vehicle, vehicle.T_world_parts, camera, self._road.mirror) for vehicle in near]
        reach = -(-round(WET_GROUND.blur_px * size[0] / 1920) // WINDOW_LIMITS.tile_px)
        around = cv2.dilate(tiles(hulls, size).astype(np.uint8), np.ones((2 * reach + 1, 3), np.uint8)) > 0
        # The blur samples beyond these tiles too.
        self._target.clear(0, 0, 0, 0)
        half = [(x0 // 2, y0 // 2, -(-x1 // 2), -(-y1 // 2)) for x0, y0, x1, y1 in tile_runs(around, size)]
        unit = len(units)
        self._scenery_depth.use(unit)
        all_uniforms = {**uniforms, "u_size": list(self._target.size), "u_scenery": unit}
        device.prepare(self._target, half, all_uniforms, "SCENERY", "STEP 1")
        device.context.enable_only(device.gl.DEPTH_TEST | device.gl.CULL_FACE)
        device.context.front_face = "ccw"
        program = device.program(
            "vehicle.vert.glsl", "vehicle.frag.glsl", PARTS_DEFINITION, "REFLECTION", *self._options
        )
        put(program, {**uniforms, **self._uniforms})
        for vehicle in near:
            put(program, {**vehicle.matrices, "u_model": vehicle.matrices["u_world"], **vehicle.look})
            vehicle.coarse.draw(program)
        device.context.front_face = "cw"
        return np.asarray(around)
