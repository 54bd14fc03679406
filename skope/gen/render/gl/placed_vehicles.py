"""Vehicles of a moment, ready to draw, and their motion in the image while the shutter is open (motion blur)."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

import cv2
import numpy as np

from skope.camera.model import Camera
from skope.gen.mesh import merged
from skope.gen.render.gl.context import Device, DeviceMesh, linear
from skope.gen.render.pixel_windows import Window, hull_of, may_be_seen, window_of
from skope.gen.scene.recording import Moment, body_of
from skope.gen.vehicles.model import MODEL_PARTS, Body, straight_lwh
from skope.gen.vehicles.paints import ALL_PAINTS
from skope.types import Array

PARTS_DEFINITION: Final = "PARTS 8"
"""Shader definition: a vehicle has up to eight parts, which are its body and four wheels, a trailer and two more
wheels."""
PANE_MATERIALS: Final = ("glass", "glass_tinted", "glass_lit")
"""Transparent materials."""


@dataclass(frozen=True, eq=False)
class PlacedVehicle:
    """Vehicle in a frame, ready to draw."""

    index: int
    """Index of the vehicle in the frame."""
    vehicle: Body
    T_world_chassis: Array
    T_world_parts: Array
    """(8, 4, 4) poses of its parts, as `Moment.part_poses` has them."""
    mesh: DeviceMesh
    """The vehicle from outside, with opaque panes."""
    solid: DeviceMesh
    """Everything except the panes, with the interior."""
    panes: DeviceMesh | None
    coarse: DeviceMesh
    """The whole vehicle with fewer triangles, for distant views."""
    matrices: dict[str, bytes]
    """Poses of its parts: in the camera frame, and in world axes relative to the camera."""
    distance: float
    """Distance from the camera, metres; for an articulated vehicle that of its nearer part."""
    look: dict[str, Any]
    """Uniforms of paint and lamps."""
    hull: Array
    """(N, 2) convex polygon around the pixels that the vehicle may cover."""
    window: Window
    """Window of the pixels that the vehicle may cover, in the image and beyond."""

    @property
    def number(self) -> int:
        return self.index + 1


class Placer:
    """Places vehicles before a camera and keeps their meshes on the device."""

    def __init__(self, device: Device, camera: Camera) -> None:
        self._device, self._camera = device, camera

    def place(self, moment: Moment) -> list[PlacedVehicle]:
        """Return the vehicles that the image may show, from near to far.

        In this order, pixels hidden by a nearer vehicle are not shaded.
        """
        camera, out = self._camera, []
        bodies = [body_of(recorded) for recorded in moment.vehicles]
        away = np.linalg.norm(moment.T_world_chassis[:, :3, 3] - camera.position, axis=1)
        for i, body in enumerate(bodies):
            if body.trailer:
                middle = moment.T_world_trailer[i, 0] @ [*body.trailer.corners.mean(axis=0), 1.0]
                away[i] = min(away[i], np.linalg.norm(middle[:3] - camera.position))
        for i in away.argsort(kind="stable").tolist():
            recorded, vehicle, parts = moment.vehicles[i], bodies[i], moment.part_poses(i)
            # Building its surfaces takes longer than drawing them.
            if not may_be_seen(vehicle, parts, camera):
                continue
            hull = hull_of(vehicle, parts, camera)
            window = window_of(hull, camera)
            if window is None:
                continue
            from_camera = parts.copy()
            from_camera[:, :3, 3] -= camera.position
            paint = ALL_PAINTS[recorded.color]
            look = {"u_paint": _linear_color(paint.rgb), "u_livery": _linear_color(paint.livery)}
            out.append(
                PlacedVehicle(
                    index=i,
                    vehicle=vehicle,
                    T_world_chassis=parts[0],
                    T_world_parts=parts,
                    **_upload_meshes(self._device, vehicle),
                    matrices={
                        "u_model": _uniform_bytes(camera.T_camera_world @ parts),
                        "u_world": _uniform_bytes(from_camera),
                    },
                    distance=float(away[i]),
                    look=look
                    | {
                        "u_lamps": int(moment.lamps[i]),
                        "u_plate": recorded.track_id,
                        "u_dirt": float(recorded.shape.get("dirt", 0.0)),
                    },
                    hull=hull,
                    window=window,
                )
            )
        return out


@lru_cache(maxsize=256)
def _upload_meshes(device: Device, vehicle: Body) -> dict[str, Any]:
    """Return a vehicle's meshes on the device, by field of `PlacedVehicle`."""
    insides = {0: vehicle.interior} | ({MODEL_PARTS.trailer_part: vehicle.trailer.interior} if vehicle.trailer else {})
    solid, panes = list(vehicle.parts), [part.taken(np.zeros(0, dtype=np.int64)) for part in vehicle.parts]
    for k, interior in insides.items():
        body = vehicle.parts[k]
        glass = np.isin(body.material, [i for i, name in enumerate(body.materials) if name in PANE_MATERIALS])
        solid[k] = merged([body.taken(~glass), *([interior] if interior else [])])
        panes[k] = body.taken(glass)
    return {
        "mesh": device.upload(*vehicle.parts),
        "solid": device.upload(*solid),
        "coarse": device.upload(*vehicle.coarse),
        "panes": device.upload(*panes) if any(len(part.triangles) for part in panes) else None,
    }


def _linear_color(rgb: tuple[int, int, int]) -> Array:
    return linear(np.array(rgb) / 255)


def _uniform_bytes(matrices: Array) -> bytes:
    """Return matrices (P, 4, 4) as bytes for uniforms."""
    return np.ascontiguousarray(matrices.swapaxes(-1, -2), dtype=np.float32).tobytes()


LEAST_BLUR_PX: Final = 1.5
"""Motion below which a vehicle is drawn sharp, pixels."""


@dataclass(frozen=True, eq=False)
class Moving:
    """Vehicle that moves visibly while the shutter is open."""

    vehicle: PlacedVehicle
    way: Array
    """(2,) motion in the image while the shutter is open, pixels."""
    nearest: float
    """Minimum depth of the vehicle, metres."""
    hull: Array
    """(N, 2) convex polygon around all pixels that the vehicle may blur into."""


def moving(
    placed: Iterable[PlacedVehicle],
    velocity: Array,
    shutter_s: float,
    camera: Camera,
    before: float = 0.5,
    after: float = -0.5,
) -> list[Moving]:
    """Return the vehicles that move visibly while the shutter is open.

    A vehicle nearer than its own length is left sharp, because its parts move in different directions.

    Args:
        placed: The vehicles that the image may show.
        velocity: (N, 3) of all vehicles in the frame, m/s.
        shutter_s: Exposure time, seconds.
        camera: The image's camera.
        before: The shutter opens this far before the labelled moment, as a share of `shutter_s`.
        after: The shutter closes this far before the labelled moment; negative: after it.
    """
    out = []
    for vehicle in placed:
        T, (length, _, height) = vehicle.T_world_chassis, straight_lwh(vehicle.vehicle)
        middle = T[:3, 3] + 0.5 * height * T[:3, 2]
        step = 0.5 * shutter_s * velocity[vehicle.index]
        pixels, depth, valid = camera.project(np.stack([middle - step, middle + step]))
        way = pixels[1] - pixels[0]
        if valid.all() and depth.min() > length and way @ way > LEAST_BLUR_PX**2:
            swept = cv2.convexHull(
                np.concatenate([vehicle.hull - before * way, vehicle.hull - after * way]).astype(np.float32)
            )
            # The end of a trailer is a whole length from the vehicle's position; other vehicles extend by half their
            # length.
            reach = (0.6 if vehicle.vehicle.trailer is None else 1.0) * length
            out.append(Moving(vehicle, way, float(depth.min()) - reach, swept[:, 0].astype(np.float64)))
    return out
