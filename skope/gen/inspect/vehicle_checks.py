"""Checks of a vehicle model: keypoints, symmetry, dimensions, wheels, surfaces, parts, sidecar."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from skope import keypoints
from skope.gen.labels.localize import trilaterate
from skope.gen.labels.raycast import Fan
from skope.gen.vehicles.fleet import class_ranges
from skope.gen.vehicles.model import Vehicle, straight_lwh, straight_mesh
from skope.gen.vehicles.user_models import AddedVehicle
from skope.types import Array

SURFACE_TOLERANCE: Final = 0.01
"""Metres that a keypoint may be off the surface."""
SYMMETRY_TOLERANCE: Final = 0.005
GROUND_TOLERANCE: Final = 0.01
RAYS: Final = 300
"""Cast at the surface from each of four sides, to different triangles."""
CORNER_TOLERANCE: Final = 0.05
"""Metres that a bumper may reach beyond the markers of its corners, along the diagonal."""
_CORNER_BAND: Final = 0.15
"""Height above and below a bumper's marker within which it is looked for, metres."""
BACK_SHARE: Final = 0.002
"""Share of rays from outside that may meet a triangle's back first."""
SIZE_M: Final = 0.03
"""Largest difference of a mesh's length and height from what the shape says, metres."""
ROD_M: Final = 0.01
"""Half of the width of what counts as a rod on the middle of a roof, metres."""
GRAZING: Final = 0.1
"""Sine of the angle under which a back does not count: the rim of what lies on a panel, seen over the panel's edge."""
LAMP_PARTS: Final = {
    "headlight": "low-beam lamps",
    "taillight": "tail lamps",
    "brake_light": "brake lamps",
    "indicator_left": "left indicators",
    "indicator_right": "right indicators",
    "reverse_light": "reverse lamps",
}
"""Materials that stand for the lamps' functions."""


@dataclass(frozen=True)
class VehicleFinding:
    text: str
    harmless: bool = False
    """Whether the maker of a user's own model may have wanted this."""

    def __str__(self) -> str:
        return self.text


def findings(vehicle: Vehicle) -> Iterator[VehicleFinding]:
    """Check a vehicle model: yields what is wrong with it."""
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
        if away > SURFACE_TOLERANCE:
            yield f"keypoints: {keypoints.NAMES[k]} is {100 * away:.1f} cm off the surface"


def _symmetry(vehicle: Vehicle) -> Iterator[str]:
    apart = np.linalg.norm(vehicle.points[list(keypoints.FLIP)] * [1, -1, 1] - vehicle.points, axis=1)
    for k in np.flatnonzero(apart > SYMMETRY_TOLERANCE).tolist():
        if keypoints.FLIP[k] >= k:
            yield f"keypoints: {keypoints.NAMES[k]} is {100 * apart[k]:.1f} cm off the mirror image of its twin"
    for k, name in enumerate(keypoints.NAMES):
        if name.endswith("_right") and vehicle.points[k, 1] > 0:
            yield f"keypoints: {name} is on the left"


def _corners(vehicle: Vehicle) -> Iterator[str]:
    """Corners of bumpers that are marked inside of where people see them (docs/conventions.md)."""
    mesh = straight_mesh(vehicle)
    surface = mesh.vertices[np.unique(mesh.triangles)]
    for name in (f"bumper_{end}_{side}" for end in ("front", "rear") for side in ("right", "left")):
        marker = vehicle.points[keypoints.INDEX[name]]
        outwards = np.sign(marker[:2]) / np.sqrt(2)
        near = np.abs(surface[:, 2] - marker[2]) < _CORNER_BAND
        beyond = float(((surface[near, :2] - marker[:2]) @ outwards).max(initial=0.0))
        if beyond > CORNER_TOLERANCE:
            yield (
                f"keypoints: {name} lies {100 * beyond:.0f} cm inside of the bumper's corner: mark where the outline, "
                "seen from above, is farthest out along the diagonal, at the bumper's lower edge"
            )


def _lamps(vehicle: Vehicle) -> Iterator[str]:
    mesh = straight_mesh(vehicle)
    present = set(np.array(mesh.materials)[np.unique(mesh.material)])
    yield from (f"parts: no {what} (material {name})" for name, what in LAMP_PARTS.items() if name not in present)


def _class(vehicle: Vehicle) -> Iterator[str]:
    for name, (low, high) in class_ranges(vehicle.size_class).items():
        value = getattr(vehicle.shape, name)
        if not low - 1e-9 <= value <= high + 1e-9:
            yield f"shape.{name}: {value:.3f} m, expected {low:g} to {high:g} for a {vehicle.size_class}"


def _size(vehicle: Vehicle) -> Iterator[str]:
    vertices = straight_mesh(vehicle).vertices
    length, _, height = straight_lwh(vehicle)
    # A rod antenna is not counted, as vehicles' papers do not.
    rod = (vertices[:, 2] > height + SIZE_M) & (np.abs(vertices[:, 1]) < ROD_M)
    for name, found, said in (
        ("length", np.ptp(vertices[:, 0]), length),
        ("height", vertices[~rod, 2].max(), height),
    ):
        if abs(found - said) > SIZE_M:
            yield f"mesh: its {name} is {found:.2f} m, the shape says {said:.2f} m"


def _wheels(vehicle: Vehicle) -> Iterator[str]:
    radius = vehicle.shape.wheel_radius
    around = np.linalg.norm(vehicle.wheel.vertices[:, [0, 2]], axis=1).max()
    if abs(around - radius) > 0.01:
        yield f"wheel: its mesh has a radius of {around:.3f} m, the shape says {radius:.3f} m"
    centers = vehicle.shape.wheel_centers()
    if vehicle.trailer:
        centers[2:] = vehicle.trailer.at_rest[1:, :3, 3]
    for wheel, center in zip(keypoints.WHEELS, centers, strict=True):
        if abs(center[2] - radius) > GROUND_TOLERANCE:
            off = 100 * (center[2] - radius)
            yield f"keypoints: {keypoints.NAMES[wheel]} is {off:.1f} cm off its height above the road"
        if np.linalg.norm(vehicle.points[wheel] - center) > 0.001:
            yield f"keypoints: {keypoints.NAMES[wheel]} is not the centre of its wheel"


def _orientation(vehicle: Vehicle) -> Iterator[str]:
    """Rays from around the vehicle to its surface must meet fronts first."""
    rng = np.random.default_rng(0)
    mesh = straight_mesh(vehicle)
    corners = mesh.vertices[mesh.triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1)
    back = total = 0
    for azimuth in np.radians([20, 110, 200, 290]):
        eye = max(15, straight_lwh(vehicle)[0]) * np.array([np.cos(azimuth), np.sin(azimuth), 0.35])
        aims = corners[rng.choice(len(corners), RAYS, replace=False, p=area / area.sum())].mean(axis=1)
        sight = corners.mean(axis=1) - eye
        away = (normal * sight).sum(axis=1)
        counts = (away <= 0) | (away > GRAZING * area * np.linalg.norm(sight, axis=1))
        reach, front = Fan(corners[counts] - eye).first_hits(aims - eye)
        back += int((np.isfinite(reach) & ~front).sum())
        total += int(np.isfinite(reach).sum())
    if back > BACK_SHARE * total:
        yield f"mesh: {back} of {total} rays from outside meet the back of a triangle"


def _sidecar(vehicle: Vehicle) -> Iterator[str]:
    wheels = vehicle.shape.wheel_centers() if vehicle.trailer else vehicle.points[list(keypoints.WHEELS)]
    found = trilaterate(wheels[None], vehicle.sidecar.distances[None], vehicle.sidecar.side[None])[0]
    error = np.linalg.norm(found - vehicle.points, axis=1)
    for k in np.flatnonzero(error > 1e-3).tolist():
        yield f"sidecar: trilateration puts {keypoints.NAMES[k]} {1000 * error[k]:.1f} mm off"


def distance_to_surface(point: Array, triangles: Array) -> float:
    """Metres from a point (3,) to the nearest of T triangles (T, 3, 3), exact up to 0.1 m, else inf."""
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
