"""Contact sheets of vehicle models: the project's own renderer, numbered keypoints, the skeleton."""

import math
from collections.abc import Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skope.camera.model import Camera
from skope.gen.labels.annotate import annotate
from skope.gen.labels.ignore_rules import Rules
from skope.gen.render.choose_renderer import make_renderer
from skope.gen.scene.conditions import Conditions
from skope.gen.scene.recording import RecordedVehicle, Recording
from skope.gen.scenery.build import STUDIO
from skope.gen.vehicles import trailer_motion
from skope.gen.vehicles.model import Vehicle, straight_lwh
from skope.gen.vehicles.paints import palette
from skope.gen.vehicles.trailer_motion import DrivenTrailer
from skope.pictures import draw

VIEWS: Final = {
    "three quarters front": (35.0, 18.0),
    "three quarters rear": (145.0, 18.0),
    "front": (0.0, 6.0),
    "side": (90.0, 6.0),
    "rear": (180.0, 6.0),
    "top": (90.0, 80.0),
}
"""Directions of the camera: degrees from straight ahead towards the vehicle's left, and above the horizon."""
_FOV: Final = math.radians(20)
_SHEET_MARGIN: Final = 1.12
_BEND: Final = math.radians(25)
"""Bend of articulated vehicles in the views of three quarters."""
_CAR_COLOR: Final = "red"
_CONDITIONS: Final = Conditions(
    sun_elevation_deg=50.0,
    sun_azimuth_deg=60.0,
    clouds=0.2,
    visibility_m=20000.0,
    exposure_ev=0.2,
    noise=0.5,
    vignetting=0.0,
    k1=0.0,
)


def sheet(vehicle: Vehicle, renderer: str, *, size: tuple[int, int] = (640, 400)) -> NDArray[np.uint8]:
    """All views of a vehicle, plain above and labelled below, with its name and dimensions as caption."""
    pictures = list(_pictures(vehicle, renderer, size))
    columns = len(VIEWS) // 2
    rows = [pictures[i : i + columns] for i in range(0, len(pictures), columns)]
    cells = [picture for row in rows for which in (0, 1) for picture in (pair[which] for pair in row)]
    length, width, height = straight_lwh(vehicle)
    text = f"{vehicle.model}: {vehicle.vehicle_type}, {length:.2f} x {width:.2f} x {height:.2f} m"
    return draw.caption(draw.contact_sheet(cells, columns), text)


def _pictures(
    vehicle: Vehicle, renderer: str, size: tuple[int, int]
) -> Iterator[tuple[NDArray[np.uint8], NDArray[np.uint8]]]:
    for name, (azimuth, elevation) in VIEWS.items():
        bend = _BEND if name.startswith("three quarters") else 0.0
        recording = parked_recording(
            vehicle, _camera(vehicle, math.radians(azimuth), math.radians(elevation), size, bend), bend
        )
        view = make_renderer(renderer, recording).render(0)
        annotations, _ = annotate(recording.moment(0), view, recording.camera, Rules(), image_id=1)
        yield view.rgb, draw.numbered(view.rgb, annotations)


def _camera(vehicle: Vehicle, azimuth: float, elevation: float, size: tuple[int, int], bend: float) -> Camera:
    """A camera that looks at the middle of a vehicle, bent by an angle, and just holds it."""
    toward = np.array(
        [math.cos(azimuth) * math.cos(elevation), math.sin(azimuth) * math.cos(elevation), math.sin(elevation)]
    )
    length, _, height = straight_lwh(vehicle)
    middle = np.array([(vehicle.shape.length - length) / 2, 0.0, height / 2])

    def at(distance: float) -> Camera:
        place = middle + distance * toward
        return Camera.looking(place, yaw=azimuth + math.pi, pitch_down=elevation, size=size, fov=_FOV)

    distance = 60.0
    placed = zip(vehicle.parts, parked_recording(vehicle, at(distance), bend).moment(0).part_poses(0), strict=False)
    corners = np.concatenate([part.vertices @ T[:3, :3].T + T[:3, 3] for part, T in placed])
    for _ in range(4):
        camera = at(distance)
        pixels, _, _ = camera.project(corners)
        reach = np.abs(pixels - [size[0] / 2, size[1] / 2]).max(axis=0) / [size[0] / 2, size[1] / 2]
        distance *= float(reach.max()) * _SHEET_MARGIN
    return at(distance)


def sheet_color(vehicle: Vehicle) -> str:
    """A paint that shows a model's shape, or its livery."""
    own = palette(vehicle)
    return _CAR_COLOR if _CAR_COLOR in own else own[min(1, len(own) - 1)]


def parked_recording(vehicle: Vehicle, camera: Camera, bend: float = 0.0) -> Recording:
    """One frame of a vehicle that stands at the origin of an empty place, heading east, bent by an angle."""
    wheels = np.tile(np.eye(4), (1, 4, 1, 1))
    wheels[0, :, :3, 3] = vehicle.shape.wheel_centers()
    return Recording(
        town=STUDIO,
        site=STUDIO.name,
        name="00",
        split="extra",
        camera=camera,
        weather="clear",
        time_of_day="noon",
        conditions=_CONDITIONS,
        seed=0,
        versions={},
        vehicles=(RecordedVehicle(1, vehicle.model, vehicle.shape.to_dict(), sheet_color(vehicle)),),
        times_s=np.zeros(1),
        signals=({},),
        frame=np.zeros(1, dtype=np.int32),
        vehicle=np.zeros(1, dtype=np.int32),
        T_world_chassis=np.eye(4)[None],
        T_world_wheels=wheels,
        T_world_trailer=trailer_motion.trailer_poses(vehicle, DrivenTrailer(bend, 0.0, 0.0), np.eye(4))[None],
        velocity=np.zeros((1, 3)),
        lamps=np.zeros(1, dtype=np.uint8),
    )
