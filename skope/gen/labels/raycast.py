"""Ray casting from the camera to points, against the triangles of a frame's vehicles. Pure numpy.

What counts as hidden is decided in annotate.py.

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
    """Patches and margins of ray casting."""

    patch_triangles: int = 16
    """Number of triangles of a patch, which are tested together."""
    order_steps: int = 1023
    """Steps that a vehicle's length is cut into where triangles are put in order."""
    rounding_m: float = 1e-6
    """Enlargement of spheres and boxes, metres: more than rounding errors."""


RAYCAST_LIMITS: Final = RaycastLimits()


class RayCaster:
    """Finds where rays from the camera first meet one of the N vehicles of a moment."""

    def __init__(self, moment: Moment, vehicles: Sequence[Body], camera: Camera) -> None:
        self._moment, self._vehicles, self._camera = moment, vehicles, camera

    def first_hits(self, points: Array) -> Array:
        """Cast a ray from the camera to each of R points.

        Args:
            points: (R, 3) world, metres.

        Returns:
            (R,) metres from the camera to the first vehicle's surface that the ray meets; inf where there is none.
            Surfaces behind a point may be left out.
        """
        ahead = self._camera.to_camera(points)
        away = np.linalg.norm(ahead, axis=-1)
        rays = ahead / away[:, None]
        hits = np.full(len(points), np.inf)
        passing = _may_meet_spheres(rays, away, self._centers, self._radii)
        found = [self._candidates(i, rays, away, passing[:, i]) for i in np.flatnonzero(passing.any(axis=0)).tolist()]
        if not found:
            return hits
        # The patches of all vehicles are tested together: many small numpy calls would cost more.
        starts = np.cumsum([0, *(len(one.eyes) for one in found)])
        ray = np.concatenate([one.ray for one in found])
        patch = np.concatenate([one.patch + start for one, start in zip(found, starts, strict=False)])
        own = np.concatenate([one.own for one in found])
        eyes = np.concatenate([one.eyes for one in found])
        edges, volume = _edge_planes(np.concatenate([one.corners for one in found], axis=2) - eyes.T[:, None, :, None])
        sides = [np.einsum("pc,cpt->pt", own, edge[:, patch]) for edge in edges]
        pair, triangle, facing = _find_crossings(sides)
        reach = volume[patch[pair], triangle] / facing
        np.minimum.at(hits, ray[pair], np.where(reach > 0, reach, np.inf))
        return hits

    @cached_property
    def _radii(self) -> Array:
        """(N,) radii of spheres around the vehicles, wheels and mirrors included, metres."""
        return np.array([0.5 * np.linalg.norm(vehicle.size_lwh) + 0.4 + _reach(vehicle) for vehicle in self._vehicles])

    @cached_property
    def _centers(self) -> Array:
        """(N, 3) centres of the spheres around the vehicles, camera frame, metres."""
        up = np.array([[0, 0, vehicle.size_lwh[2] / 2] for vehicle in self._vehicles]).reshape(-1, 3)
        T = self._moment.T_world_chassis
        return self._camera.to_camera(np.einsum("nij,nj->ni", T[:, :3, :3], up) + T[:, :3, 3])

    def _candidates(self, i: int, rays: Array, away: Array, chosen: NDArray[np.bool_]) -> "_Candidates":
        """Pairs of a ray and a patch of the i-th vehicle that may meet; `chosen` (R,) are the rays to test."""
        patches = _patches(self._vehicles[i])
        poses = self._camera.T_camera_world @ self._moment.part_poses(i)
        T = poses[patches.part]
        centers = np.einsum("pij,pj->pi", T[:, :3, :3], patches.centers) + T[:, :3, 3]
        ray, patch = _may_meet_spheres(rays[chosen], away[chosen], centers, patches.radii).nonzero()
        ray = np.flatnonzero(chosen)[ray]
        # Rays are moved to the part's frame, and not triangles to the camera's: there are fewer of them.
        eyes = -np.einsum("pji,pj->pi", poses[:, :3, :3], poses[:, :3, 3])
        own = np.einsum("pji,pj->pi", T[patch, :3, :3], rays[ray])
        part = patches.part[patch]
        through = _may_meet_boxes(own, away[ray], patches.boxes[:, patch] - eyes[part])
        used, index = np.unique(patch[through], return_inverse=True)
        return _Candidates(ray[through], index, own[through], eyes[patches.part[used]], patches.corners[:, :, used])


def _reach(vehicle: Body) -> float:
    """Distance by which a vehicle's trailer may reach out of a sphere around the vehicle before it, metres."""
    trailer = vehicle.trailer
    return float(np.abs(trailer.corners).max() + np.linalg.norm(trailer.size_lwh[1:])) if trailer else 0.0


def _may_meet_spheres(rays: Array, away: Array, centers: Array, radii: Array) -> NDArray[np.bool_]:
    """(R, N) whether unit rays (R, 3) from the origin, `away` (R,) metres long, may meet what is inside spheres."""
    along = rays @ centers.T
    across = (centers**2).sum(axis=-1) - along**2
    return np.asarray((along > -radii) & (along - radii < away[:, None]) & (across < radii**2))


def _may_meet_boxes(rays: Array, away: Array, boxes: Array) -> NDArray[np.bool_]:
    """(R,) whether unit rays (R, 3) from the origin, `away` (R,) metres long, may pass their boxes (2, R, 3)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        first, second = boxes / rays
    begin, end = np.minimum(first, second).max(axis=-1), np.maximum(first, second).min(axis=-1)
    # A ray along the side of a box gives NaN, for which all comparisons are false: it counts as a hit.
    return np.asarray(~((begin > end) | (end < 0) | (begin > away)))


@dataclass(frozen=True, eq=False)
class _Candidates:
    """P pairs of a ray and a patch that may meet, and the U patches that occur, in the frames of their parts."""

    ray: NDArray[np.intp]
    """(P,) number of each pair's ray."""
    patch: NDArray[np.intp]
    """(P,) index of each pair's patch among the U patches."""
    own: Array
    """(P, 3) direction of each pair's ray in the patch's part."""
    eyes: Array
    """(U, 3) place of the camera in each patch's part, metres."""
    corners: Array
    """(3 axes, 3 corners, U, patch_triangles) corners of the patches' triangles, metres."""


@dataclass(frozen=True, eq=False)
class _Patches:
    """A vehicle's triangles in P patches of `RAYCAST_LIMITS.patch_triangles` that lie close together, and spheres and
    boxes around them."""

    corners: Array
    """(3 axes, 3 corners, P, patch_triangles) metres, in the frame of their part; smaller patches repeat their
    triangles."""
    part: NDArray[np.int64]
    """(P,) part that a patch belongs to: 0 is the body, then its moving parts."""
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
    """(P, patch_triangles, 3, 3) corners of a mesh's triangles by patch; smaller patches repeat their triangles.

    The last ones are kept: front and rear wheels are the same mesh.
    """
    triangles = mesh.vertices[mesh.triangles]
    return triangles[_split_in_patches(triangles.mean(axis=1))]


def _split_in_patches(places: Array) -> NDArray[np.int64]:
    """(P, patch_triangles) groups of the indices of `places` (N, 3) that lie close together; smaller ones repeat
    theirs.

    They follow each other along a Z-order curve (Morton 1966).
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
    """Triangles (T, 3, 3), metres, for rays that all begin at the origin."""

    def __init__(self, triangles: Array) -> None:
        self._edges, self._volume = _edge_planes(np.ascontiguousarray(triangles.transpose(2, 1, 0)))

    def first_hits(self, rays: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Cast rays from the origin.

        Args:
            rays: (R, 3) directions, of any length.

        Returns:
            (R,) distance to the first triangle in lengths of the ray, inf where it meets none; (R,) whether it meets
            the triangle's front, which is the side that shows the corners counter-clockwise.
        """
        ray, triangle, facing = _find_crossings([rays @ edge for edge in self._edges])
        reach = self._volume[triangle] / facing
        order = np.lexsort([reach, ray])[::-1]
        order = order[reach[order] > 0]
        hits, front = np.full(len(rays), np.inf), np.zeros(len(rays), dtype=bool)
        # Crossings are in falling order of distance: the nearest one of a ray is assigned last.
        hits[ray[order]], front[ray[order]] = reach[order], facing[order] < 0
        return hits, front


def _edge_planes(corners: Array) -> tuple[tuple[Array, Array, Array], Array]:
    """Planes through the origin and each edge of triangles, whose corners are (3 axes, 3, ...).

    Returns the normals of the three planes, (3 axes, ...) each, whose sum is the triangle's own normal; and (...,) six
    times the volume of the tetrahedron between origin and triangle.
    """
    a, b, c = corners.swapaxes(0, 1)
    edges = _cross(a, b), _cross(b, c), _cross(c, a)
    return edges, (a * sum(edges)).sum(axis=0)


def _find_crossings(sides: Sequence[Array]) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
    """Pairs of a ray and a triangle that cross.

    Args:
        sides: For each of a triangle's three edges (R, T) products of ray and the normal of the edge's plane.

    Returns:
        Row of the ray and column of the triangle, and the product of the ray with the triangle's normal: (P,) each.
    """
    # A ray passes inside a triangle when it is on the same side of all three planes.
    u, v, w = sides
    low, high = np.minimum(np.minimum(u, v), w), np.maximum(np.maximum(u, v), w)
    ray, triangle = ((low >= 0) | (high <= 0)).nonzero()
    facing = u[ray, triangle] + v[ray, triangle] + w[ray, triangle]
    crosses = np.abs(facing) > 1e-12
    return ray[crosses], triangle[crosses], facing[crosses]


def _cross(a: Array, b: Array) -> Array:
    """Cross product of vectors (3, ...), axes first; many times faster than `np.cross`."""
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
