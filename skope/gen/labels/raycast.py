"""Ray casting from the camera to points, against the triangles of a frame's vehicles. Pure numpy.

`skope.gen.labels.visibility.find_hidden` decides which keypoints count as hidden.

Each vehicle's triangles are grouped in patches of `RAYCAST_LIMITS.patch_triangles`. A ray is tested against spheres
around the vehicles, then spheres and boxes around their patches, and only then against triangles.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skope.camera.model import Camera
from skope.gen.mesh import Mesh
from skope.gen.scene.recording import Moment
from skope.gen.vehicles.model import Body
from skope.types import Array


@dataclass(frozen=True)
class RaycastLimits:
    """Patch size and margins for ray casting."""

    patch_triangles: int = 16
    """Number of triangles per patch; the triangles of a patch are tested together."""
    order_steps: int = 1023
    """Resolution of the Z-order curve that sorts triangles: number of steps over the longest side of the mesh."""
    rounding_m: float = 1e-6
    """Enlargement of spheres and boxes, metres; larger than rounding errors."""


RAYCAST_LIMITS: Final = RaycastLimits()


class RayCaster:
    """Finder of the first hits of rays from the camera on the N vehicles of a moment."""

    def __init__(self, moment: Moment, vehicles: Sequence[Body], camera: Camera) -> None:
        self._moment, self._vehicles, self._camera = moment, vehicles, camera

    def first_hits(self, points: Array) -> Array:
        """Cast a ray from the camera to each of R points.

        Args:
            points: (R, 3) world, metres.

        Returns:
            (R,) distance from the camera to the first vehicle surface on the ray, metres; inf if there is none.
            Surfaces behind a point can be omitted.
        """
        ahead = self._camera.to_camera(points)
        away = np.linalg.norm(ahead, axis=-1)
        rays = ahead / away[:, None]
        hits = np.full(len(points), np.inf)
        passing = _may_meet_spheres(rays, away, self._centers, self._radii)
        found = [self._candidates(i, rays, away, passing[:, i]) for i in np.flatnonzero(passing.any(axis=0)).tolist()]
        if not found:
            return hits
        # The patches of all vehicles are tested together, since many small numpy calls would cost more.
        starts = np.cumsum([0, *(len(pairs.eyes) for pairs in found)])
        ray = np.concatenate([pairs.ray for pairs in found])
        patch = np.concatenate([pairs.patch + start for pairs, start in zip(found, starts, strict=False)])
        directions = np.concatenate([pairs.directions for pairs in found])
        eyes = np.concatenate([pairs.eyes for pairs in found])
        edges, volume = _edge_planes(
            np.concatenate([pairs.corners for pairs in found], axis=2) - eyes.T[:, None, :, None]
        )
        sides = [np.einsum("pc,cpt->pt", directions, edge[:, patch]) for edge in edges]
        pair, triangle, facing = _find_crossings(sides)
        reach = volume[patch[pair], triangle] / facing
        np.minimum.at(hits, ray[pair], np.where(reach > 0, reach, np.inf))
        return hits

    @cached_property
    def _radii(self) -> Array:
        """Radii (N,) of spheres around the vehicles, including wheels and mirrors, metres."""
        return np.array([0.5 * np.linalg.norm(vehicle.size_lwh) + 0.4 + _reach(vehicle) for vehicle in self._vehicles])

    @cached_property
    def _centers(self) -> Array:
        """Centres (N, 3) of the spheres around the vehicles, camera frame, metres."""
        up = np.array([[0, 0, vehicle.size_lwh[2] / 2] for vehicle in self._vehicles]).reshape(-1, 3)
        T = self._moment.T_world_chassis
        return self._camera.to_camera(np.einsum("nij,nj->ni", T[:, :3, :3], up) + T[:, :3, 3])

    def _candidates(self, i: int, rays: Array, away: Array, chosen: NDArray[np.bool_]) -> "_Candidates":
        """Return the pairs of a ray and a patch of the i-th vehicle that may meet; `chosen` (R,) selects rays."""
        patches = _patches(self._vehicles[i])
        poses = self._camera.T_camera_world @ self._moment.part_poses(i)
        T = poses[patches.part]
        centers = np.einsum("pij,pj->pi", T[:, :3, :3], patches.centers) + T[:, :3, 3]
        ray, patch = _may_meet_spheres(rays[chosen], away[chosen], centers, patches.radii).nonzero()
        ray = np.flatnonzero(chosen)[ray]
        # There are fewer rays than triangles, so the rays are moved to the part's frame.
        eyes = -np.einsum("pji,pj->pi", poses[:, :3, :3], poses[:, :3, 3])
        directions = np.einsum("pji,pj->pi", T[patch, :3, :3], rays[ray])
        part = patches.part[patch]
        through = _may_meet_boxes(directions, away[ray], patches.boxes[:, patch] - eyes[part])
        used, index = np.unique(patch[through], return_inverse=True)
        return _Candidates(
            ray[through], index, directions[through], eyes[patches.part[used]], patches.corners[:, :, used]
        )


def _reach(vehicle: Body) -> float:
    """Return how far a vehicle's trailer can extend beyond the bounding sphere of the towing vehicle, metres."""
    trailer = vehicle.trailer
    return float(np.abs(trailer.corners).max() + np.linalg.norm(trailer.size_lwh[1:])) if trailer else 0.0


def _may_meet_spheres(rays: Array, away: Array, centers: Array, radii: Array) -> NDArray[np.bool_]:
    """Return (R, N) whether unit rays (R, 3) from the origin, `away` (R,) metres long, may meet objects in spheres."""
    along = rays @ centers.T
    across = (centers**2).sum(axis=-1) - along**2
    return np.asarray((along > -radii) & (along - radii < away[:, None]) & (across < radii**2))


def _may_meet_boxes(rays: Array, away: Array, boxes: Array) -> NDArray[np.bool_]:
    """Return (R,) whether unit rays (R, 3) from the origin, `away` (R,) metres long, may hit their boxes (2, R, 3)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        first, second = boxes / rays
    begin, end = np.minimum(first, second).max(axis=-1), np.maximum(first, second).min(axis=-1)
    # A ray along the side of a box gives NaN, which makes all comparisons false: the ray counts as a hit.
    return np.asarray(~((begin > end) | (end < 0) | (begin > away)))


@dataclass(frozen=True, eq=False)
class _Candidates:
    """P pairs of a ray and a patch that may meet, and the U distinct patches, in the frames of their parts."""

    ray: NDArray[np.intp]
    """(P,) index of each pair's ray."""
    patch: NDArray[np.intp]
    """(P,) index of each pair's patch among the U patches."""
    directions: Array
    """(P, 3) direction of each pair's ray in the frame of the patch's part."""
    eyes: Array
    """(U, 3) position of the camera in the frame of each patch's part, metres."""
    corners: Array
    """(3 axes, 3 corners, U, patch_triangles) corners of the patches' triangles, metres."""


@dataclass(frozen=True, eq=False)
class _Patches:
    """P compact patches of `RAYCAST_LIMITS.patch_triangles` triangles of a vehicle, with bounding volumes."""

    corners: Array
    """(3 axes, 3 corners, P, patch_triangles) corners in their part's frame, metres; small patches repeat triangles."""
    part: NDArray[np.int64]
    """(P,) part that each patch belongs to: 0 is the body, higher numbers are its moving parts."""
    centers: Array
    """(P, 3) centres of the spheres around the patches, metres."""
    radii: Array
    """(P,) radii of these spheres, metres."""
    boxes: Array
    """(2, P, 3) lowest and highest corners of the boxes around the patches, metres."""


@lru_cache(maxsize=256)
def _patches(vehicle: Body) -> _Patches:
    each = [_part_corners(mesh) for mesh in vehicle.parts]
    points = np.concatenate(each)
    part = np.repeat(np.arange(len(each)), [len(corners) for corners in each])
    low, high = points.min(axis=(1, 2)), points.max(axis=(1, 2))
    centers = (low + high) / 2
    radii = np.linalg.norm(points - centers[:, None, None], axis=-1).max(axis=(1, 2)) + RAYCAST_LIMITS.rounding_m
    boxes = np.stack([low - RAYCAST_LIMITS.rounding_m, high + RAYCAST_LIMITS.rounding_m])
    return _Patches(np.ascontiguousarray(points.transpose(3, 2, 0, 1)), part, centers, radii, boxes)


@lru_cache(maxsize=8)
def _part_corners(mesh: Mesh) -> Array:
    """Return the corners (P, patch_triangles, 3, 3) of a mesh's triangles by patch; smaller patches repeat triangles.

    The cache helps since the front and rear wheels share a mesh.
    """
    triangles = mesh.vertices[mesh.triangles]
    return triangles[_split_in_patches(triangles.mean(axis=1))]


def _split_in_patches(places: Array) -> NDArray[np.int64]:
    """Return (P, patch_triangles) groups of indices of neighbouring `places` (N, 3); smaller groups repeat indices.

    The groups follow each other along a Z-order curve (Morton 1966).
    """
    low = places.min(axis=0, initial=np.inf)
    size = (places.max(axis=0, initial=-np.inf) - low).max(initial=1e-9)
    cells = ((places - low) / size * RAYCAST_LIMITS.order_steps).astype(np.int64)
    key = np.zeros(len(places), dtype=np.int64)
    for bit in range(RAYCAST_LIMITS.order_steps.bit_length()):
        for axis in range(3):
            key |= (cells[:, axis] >> bit & 1) << (3 * bit + axis)
    order = key.argsort(kind="stable")
    begins = np.arange(0, len(order), RAYCAST_LIMITS.patch_triangles)
    sizes = np.minimum(len(order) - begins, RAYCAST_LIMITS.patch_triangles)
    return np.asarray(order[begins[:, None] + np.arange(RAYCAST_LIMITS.patch_triangles) % sizes[:, None]])


class Fan:
    """Triangles (T, 3, 3), metres, for casting rays that all begin at the origin."""

    def __init__(self, triangles: Array) -> None:
        self._edges, self._volume = _edge_planes(np.ascontiguousarray(triangles.transpose(2, 1, 0)))

    def first_hits(self, rays: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Cast rays from the origin.

        Args:
            rays: (R, 3) directions, of any length.

        Returns:
            (R,) distance to the first triangle in multiples of the ray's length, inf if there is none. (R,) whether the
            ray meets the triangle's front, the side from which the corners are counter-clockwise.
        """
        ray, triangle, facing = _find_crossings([rays @ edge for edge in self._edges])
        reach = self._volume[triangle] / facing
        order = np.lexsort([reach, ray])[::-1]
        order = order[reach[order] > 0]
        hits, front = np.full(len(rays), np.inf), np.zeros(len(rays), dtype=bool)
        # Crossings are sorted by falling distance, so the nearest crossing of a ray is assigned last.
        hits[ray[order]], front[ray[order]] = reach[order], facing[order] < 0
        return hits, front


def _edge_planes(corners: Array) -> tuple[tuple[Array, Array, Array], Array]:
    """Compute planes through the origin and each edge of triangles with corners (3 axes, 3, ...).

    Returns the normals of the three planes, (3 axes, ...) each, and (...,) six times the volume of the tetrahedron
    between origin and triangle. The sum of the normals is the normal of the triangle.
    """
    a, b, c = corners.swapaxes(0, 1)
    edges = _cross(a, b), _cross(b, c), _cross(c, a)
    return edges, (a * sum(edges)).sum(axis=0)


def _find_crossings(sides: Sequence[Array]) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
    """Find the pairs of a ray and a triangle that cross.

    Args:
        sides: For each of a triangle's three edges, products (R, T) of the ray and the normal of the edge's plane.

    Returns:
        Row of the ray, column of the triangle, and product of the ray with the triangle's normal: (P,) each.
    """
    # A ray passes through a triangle if it is on the same side of all three planes.
    u, v, w = sides
    low, high = np.minimum(np.minimum(u, v), w), np.maximum(np.maximum(u, v), w)
    ray, triangle = ((low >= 0) | (high <= 0)).nonzero()
    facing = u[ray, triangle] + v[ray, triangle] + w[ray, triangle]
    crosses = np.abs(facing) > 1e-12
    return ray[crosses], triangle[crosses], facing[crosses]


def _cross(a: Array, b: Array) -> Array:
    """Return the cross product of vectors (3, ...), axes first; many times faster than `np.cross`."""
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
