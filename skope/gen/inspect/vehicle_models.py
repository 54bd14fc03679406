"""Checks of a vehicle model, and its contact sheet.

The checks cover keypoints, symmetry, dimensions, wheels, surfaces, parts and sidecar. The sheet is drawn by the
project's own renderer, with numbered keypoints and the skeleton.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skope import keypoints
from skope.camera.model import Camera
from skope.gen.labels.annotate import annotate
from skope.gen.labels.ignore_rules import Rules
from skope.gen.labels.raycast import Fan
from skope.gen.labels.world_keypoints import trilaterate
from skope.gen.render.choose_renderer import make_renderer
from skope.gen.scene.conditions import Conditions
from skope.gen.scene.recording import RecordedVehicle, Recording
from skope.gen.scenery.build import STUDIO_TOWN
from skope.gen.vehicles import trailer_motion
from skope.gen.vehicles.fleet import class_ranges
from skope.gen.vehicles.model import Vehicle, straight_lwh, straight_mesh
from skope.gen.vehicles.paints import palette
from skope.gen.vehicles.trailer_motion import DrivenTrailer
from skope.gen.vehicles.user_models import AddedVehicle
from skope.pictures import draw
from skope.types import Array


@dataclass(frozen=True)
class ModelTolerances:
    """Tolerances of vehicle models, and settings of their sheets."""

    surface_m: float = 0.01
    """Maximum distance of a keypoint from the surface, metres."""
    symmetry_m: float = 0.005
    """Maximum asymmetry, metres."""
    ground_m: float = 0.01
    """Maximum distance of the lowest point from the ground, metres."""
    rays: int = 300
    """Number of rays to the surface from each of four sides."""
    corner_m: float = 0.05
    """Maximum reach of a bumper beyond the markers of its corners, along the diagonal, metres."""
    corner_band_m: float = 0.15
    """Height above and below a bumper's marker within which the bumper is searched, metres."""
    back_share: float = 0.002
    """Maximum share of rays from outside that meet the back of a triangle first."""
    size_m: float = 0.03
    """Maximum difference between the length and height of a mesh and of its shape, metres."""
    rod_m: float = 0.01
    """Half of the maximum width of a rod on the middle of a roof, metres."""
    grazing_sin: float = 0.1
    """Sine of the angle below which the back of a triangle is ignored: the rim of a part on a panel, seen over the
    panel's edge."""
    sheet_fov_rad: float = math.radians(20)
    """Field of view of a sheet, radians."""
    sheet_margin: float = 1.12
    """Factor on the distance that gives a margin."""
    sheet_bend_rad: float = math.radians(25)
    """Bend of articulated vehicles in the three-quarter views, radians."""


MODEL_TOLERANCES: Final = ModelTolerances()

LAMP_PARTS: Final = {
    "headlight": "low-beam lamps",
    "taillight": "tail lamps",
    "brake_light": "brake lamps",
    "indicator_left": "left indicators",
    "indicator_right": "right indicators",
    "reverse_light": "reverse lamps",
}
"""Materials of lamps, with the names of their functions."""


@dataclass(frozen=True)
class VehicleFinding:
    text: str
    harmless: bool = False
    """Whether the maker of a user's own model may intend this."""

    def __str__(self) -> str:
        return self.text


def findings(vehicle: Vehicle) -> Iterator[VehicleFinding]:
    """Check a vehicle model, and yield its errors."""
    added = isinstance(vehicle, AddedVehicle)
    for part in (_surface, _symmetry, _size, _wheels, _orientation, _sidecar):
        yield from map(VehicleFinding, part(vehicle))
    for part in (_class, _lamps, _corners):
        yield from (VehicleFinding(text, harmless=added) for text in part(vehicle))


def _surface(vehicle: Vehicle) -> Iterator[str]:
    mesh = straight_mesh(vehicle)
    triangles = mesh.vertices[mesh.triangles]
    for k, point in enumerate(vehicle.points):
        if k in keypoints.WHEELS:
            continue
        away = distance_to_surface(point, triangles)
        if away > MODEL_TOLERANCES.surface_m:
            yield f"keypoints: {keypoints.NAMES[k]} is {100 * away:.1f} cm off the surface"


def _symmetry(vehicle: Vehicle) -> Iterator[str]:
    apart = np.linalg.norm(vehicle.points[list(keypoints.FLIP)] * [1, -1, 1] - vehicle.points, axis=1)
    for k in np.flatnonzero(apart > MODEL_TOLERANCES.symmetry_m).tolist():
        if keypoints.FLIP[k] >= k:
            yield f"keypoints: {keypoints.NAMES[k]} is {100 * apart[k]:.1f} cm off the mirror image of its twin"
    for k, name in enumerate(keypoints.NAMES):
        if name.endswith("_right") and vehicle.points[k, 1] > 0:
            yield f"keypoints: {name} is on the left"


def _corners(vehicle: Vehicle) -> Iterator[str]:
    """Yield corners of bumpers that are marked inside the visible corner (docs/conventions.md)."""
    mesh = straight_mesh(vehicle)
    surface = mesh.vertices[np.unique(mesh.triangles)]
    for name in (f"bumper_{end}_{side}" for end in ("front", "rear") for side in ("right", "left")):
        marker = vehicle.points[keypoints.INDEX[name]]
        outwards = np.sign(marker[:2]) / np.sqrt(2)
        near = np.abs(surface[:, 2] - marker[2]) < MODEL_TOLERANCES.corner_band_m
        beyond = float(((surface[near, :2] - marker[:2]) @ outwards).max(initial=0.0))
        if beyond > MODEL_TOLERANCES.corner_m:
            yield (
                f"keypoints: {name} lies {100 * beyond:.0f} cm inside the bumper's corner: mark where the outline, "
                "seen from above, is farthest out along the diagonal, at the bumper's lower edge"
            )


def _lamps(vehicle: Vehicle) -> Iterator[str]:
    mesh = straight_mesh(vehicle)
    present = set(np.array(mesh.materials)[np.unique(mesh.material)])
    yield from (f"parts: no {lamp} (material {name})" for name, lamp in LAMP_PARTS.items() if name not in present)


def _class(vehicle: Vehicle) -> Iterator[str]:
    for name, (low, high) in class_ranges(vehicle.size_class).items():
        value = getattr(vehicle.shape, name)
        if not low - 1e-9 <= value <= high + 1e-9:
            yield f"shape.{name}: {value:.3f} m, expected {low:g} to {high:g} for a {vehicle.size_class}"


def _size(vehicle: Vehicle) -> Iterator[str]:
    vertices = straight_mesh(vehicle).vertices
    length, _, height = straight_lwh(vehicle)
    # A rod antenna is not included, as in vehicles' registration papers.
    rod = (vertices[:, 2] > height + MODEL_TOLERANCES.size_m) & (np.abs(vertices[:, 1]) < MODEL_TOLERANCES.rod_m)
    for name, found, expected in (
        ("length", np.ptp(vertices[:, 0]), length),
        ("height", vertices[~rod, 2].max(), height),
    ):
        if abs(found - expected) > MODEL_TOLERANCES.size_m:
            yield f"mesh: {name} {found:.2f} m, expected {expected:.2f} m from the shape"


def _wheels(vehicle: Vehicle) -> Iterator[str]:
    radius = vehicle.shape.wheel_radius
    around = np.linalg.norm(vehicle.wheel.vertices[:, [0, 2]], axis=1).max()
    if abs(around - radius) > 0.01:
        yield f"wheel: mesh radius {around:.3f} m, expected {radius:.3f} m from the shape"
    centers = vehicle.shape.wheel_centers()
    if vehicle.trailer:
        centers[2:] = vehicle.trailer.at_rest[1:, :3, 3]
    for wheel, center in zip(keypoints.WHEELS, centers, strict=True):
        if abs(center[2] - radius) > MODEL_TOLERANCES.ground_m:
            off = 100 * (center[2] - radius)
            yield f"keypoints: {keypoints.NAMES[wheel]} is {off:.1f} cm off its height above the road"
        if np.linalg.norm(vehicle.points[wheel] - center) > 0.001:
            yield f"keypoints: {keypoints.NAMES[wheel]} is not the centre of its wheel"


def _orientation(vehicle: Vehicle) -> Iterator[str]:
    """Yield an error if rays from around the vehicle meet the backs of triangles first."""
    rng = np.random.default_rng(0)
    mesh = straight_mesh(vehicle)
    corners = mesh.vertices[mesh.triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1)
    back = total = 0
    for azimuth in np.radians([20, 110, 200, 290]):
        eye = max(15, straight_lwh(vehicle)[0]) * np.array([np.cos(azimuth), np.sin(azimuth), 0.35])
        aims = corners[rng.choice(len(corners), MODEL_TOLERANCES.rays, replace=False, p=area / area.sum())].mean(axis=1)
        rays = corners.mean(axis=1) - eye
        away = (normal * rays).sum(axis=1)
        counts = (away <= 0) | (away > MODEL_TOLERANCES.grazing_sin * area * np.linalg.norm(rays, axis=1))
        reach, front = Fan(corners[counts] - eye).first_hits(aims - eye)
        back += int((np.isfinite(reach) & ~front).sum())
        total += int(np.isfinite(reach).sum())
    if back > MODEL_TOLERANCES.back_share * total:
        yield f"mesh: {back} of {total} rays from outside meet the back of a triangle"


def _sidecar(vehicle: Vehicle) -> Iterator[str]:
    wheels = vehicle.shape.wheel_centers() if vehicle.trailer else vehicle.points[list(keypoints.WHEELS)]
    found = trilaterate(wheels[None], vehicle.sidecar.distances[None], vehicle.sidecar.side[None])[0]
    error = np.linalg.norm(found - vehicle.points, axis=1)
    for k in np.flatnonzero(error > 1e-3).tolist():
        yield f"sidecar: trilateration puts {keypoints.NAMES[k]} {1000 * error[k]:.1f} mm off"


def distance_to_surface(point: Array, triangles: Array) -> float:
    """Return the distance from a point (3,) to triangles (T, 3, 3), metres: exact up to 0.1 m, else inf."""
    reach = 0.1
    near = ((triangles.min(axis=1) <= point + reach) & (triangles.max(axis=1) >= point - reach)).all(axis=1)
    if not near.any():
        return np.inf
    start = triangles[near]
    side = np.roll(start, -1, axis=1) - start
    to_point = point - start
    normal = np.cross(side[:, 0], side[:, 1])
    length = np.linalg.norm(normal, axis=1)
    over = (np.einsum("tec,tc->te", np.cross(side, to_point), normal) >= 0).all(axis=1) & (length > 1e-12)
    height = np.abs(np.einsum("tc,tc->t", to_point[:, 0], normal))[over] / length[over]
    share = (to_point * side).sum(axis=-1) / np.maximum((side * side).sum(axis=-1), 1e-18)
    beside = np.linalg.norm(to_point - np.clip(share, 0.0, 1.0)[..., None] * side, axis=-1)
    best = min(float(beside.min()), float(height.min(initial=np.inf)))
    return best if best <= reach else np.inf


SHEET_VIEWS: Final = {
    "three quarters front": (35.0, 18.0),
    "three quarters rear": (145.0, 18.0),
    "front": (0.0, 6.0),
    "side": (90.0, 6.0),
    "rear": (180.0, 6.0),
    "top": (90.0, 80.0),
}
"""Directions of the camera, degrees: from straight ahead towards the vehicle's left, and above the horizon."""
_CAR_COLOR: Final = "red"
_SHEET_CONDITIONS: Final = Conditions(
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
    """Return all views of a vehicle, plain at the top and labelled below, with its name and dimensions as caption."""
    pictures = list(_pictures(vehicle, renderer, size))
    columns = len(SHEET_VIEWS) // 2
    rows = [pictures[i : i + columns] for i in range(0, len(pictures), columns)]
    cells = [picture for row in rows for which in (0, 1) for picture in (pair[which] for pair in row)]
    length, width, height = straight_lwh(vehicle)
    text = f"{vehicle.model}: {vehicle.vehicle_type}, {length:.2f} x {width:.2f} x {height:.2f} m"
    return draw.caption(draw.contact_sheet(cells, columns), text)


def _pictures(
    vehicle: Vehicle, renderer: str, size: tuple[int, int]
) -> Iterator[tuple[NDArray[np.uint8], NDArray[np.uint8]]]:
    for name, (azimuth, elevation) in SHEET_VIEWS.items():
        bend = MODEL_TOLERANCES.sheet_bend_rad if name.startswith("three quarters") else 0.0
        recording = parked_recording(
            vehicle, _sheet_camera(vehicle, math.radians(azimuth), math.radians(elevation), size, bend), bend
        )
        view = make_renderer(renderer, recording).render(0)
        annotations, _ = annotate(recording.moment(0), view, recording.camera, Rules(), image_id=1)
        yield view.rgb, draw.numbered(view.rgb, annotations)


def _sheet_camera(vehicle: Vehicle, azimuth: float, elevation: float, size: tuple[int, int], bend: float) -> Camera:
    """Return a camera that points at the middle of a vehicle, bent by an angle, and just contains it."""
    toward = np.array(
        [math.cos(azimuth) * math.cos(elevation), math.sin(azimuth) * math.cos(elevation), math.sin(elevation)]
    )
    length, _, height = straight_lwh(vehicle)
    middle = np.array([(vehicle.shape.length - length) / 2, 0.0, height / 2])

    def at(distance: float) -> Camera:
        position = middle + distance * toward
        return Camera.looking(
            position, yaw=azimuth + math.pi, pitch_down=elevation, size=size, fov=MODEL_TOLERANCES.sheet_fov_rad
        )

    distance = 60.0
    placed = zip(vehicle.parts, parked_recording(vehicle, at(distance), bend).moment(0).part_poses(0), strict=False)
    corners = np.concatenate([part.vertices @ T[:3, :3].T + T[:3, 3] for part, T in placed])
    for _ in range(4):
        camera = at(distance)
        pixels, _, _ = camera.project(corners)
        reach = np.abs(pixels - [size[0] / 2, size[1] / 2]).max(axis=0) / [size[0] / 2, size[1] / 2]
        distance *= float(reach.max()) * MODEL_TOLERANCES.sheet_margin
    return at(distance)


def sheet_color(vehicle: Vehicle) -> str:
    """Return a paint that shows a model's shape, or its livery."""
    paints = palette(vehicle)
    return _CAR_COLOR if _CAR_COLOR in paints else paints[min(1, len(paints) - 1)]


def parked_recording(vehicle: Vehicle, camera: Camera, bend: float = 0.0) -> Recording:
    """Return one frame of a vehicle at the origin of an empty place, heading east, bent by an angle."""
    wheels = np.tile(np.eye(4), (1, 4, 1, 1))
    wheels[0, :, :3, 3] = vehicle.shape.wheel_centers()
    return Recording(
        town=STUDIO_TOWN,
        site=STUDIO_TOWN.name,
        name="00",
        split="extra",
        camera=camera,
        weather="clear",
        time_of_day="noon",
        conditions=_SHEET_CONDITIONS,
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
