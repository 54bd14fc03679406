"""The camera's own rays to points, against the triangles of a moment's vehicles. Pure numpy."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skope.camera import Camera
from skope.gen.scene.recording import Moment
from skope.gen.vehicles.model import Body

Array = NDArray[np.float64]

_PATCH: Final = 16
"""Triangles that are looked at together."""
_SLACK: Final = 1e-6
"""More than rounding takes from a sphere or box, metres."""


class RayCaster:
    """What of a moment's N vehicles a ray from the camera meets first."""

    def __init__(self, moment: Moment, vehicles: Sequence[Body], camera: Camera) -> None:
        self._moment, self._vehicles, self._camera = moment, vehicles, camera

    def first_hits(self, points: Array) -> Array:
        """World points (R, 3) -> (R,) metres from the camera to what its rays to them meet first; inf where nothing.

        What begins behind a point need not be found.
        """
        ahead = self._camera.to_camera(points)
        away = np.linalg.norm(ahead, axis=-1)
        rays = ahead / away[:, None]
        hits = np.full(len(points), np.inf)
        passing = _near(rays, away, self._centers, self._radii)
        found = [self._met(i, rays, away, passing[:, i]) for i in np.flatnonzero(passing.any(axis=0)).tolist()]
        if not found:
            return hits
        # All vehicles' patches go through the arithmetic together: numpy's calls are what would cost.
        starts = np.cumsum([0, *(len(one.eyes) for one in found)])
        ray = np.concatenate([one.ray for one in found])
        patch = np.concatenate([one.patch + start for one, start in zip(found, starts, strict=False)])
        own = np.concatenate([one.own for one in found])
        eyes = np.concatenate([one.eyes for one in found])
        edges, volume = _planes(np.concatenate([one.corners for one in found], axis=2) - eyes.T[:, None, :, None])
        sides = [np.einsum("pc,cpt->pt", own, edge[:, patch]) for edge in edges]
        pair, triangle, facing = _crossings(sides)
        reach = volume[patch[pair], triangle] / facing
        np.minimum.at(hits, ray[pair], np.where(reach > 0, reach, np.inf))
        return hits

    @cached_property
    def _radii(self) -> Array:
        """(N,) of spheres around the vehicles, wheels and mirrors included."""
        return np.array([0.5 * np.linalg.norm(vehicle.size_lwh) + 0.4 for vehicle in self._vehicles])

    @cached_property
    def _centers(self) -> Array:
        """(N, 3) their centres in the camera frame."""
        up = np.array([[0, 0, vehicle.size_lwh[2] / 2] for vehicle in self._vehicles]).reshape(-1, 3)
        T = self._moment.T_world_chassis
        return self._camera.to_camera(np.einsum("nij,nj->ni", T[:, :3, :3], up) + T[:, :3, 3])

    def _met(self, i: int, rays: Array, away: Array, chosen: NDArray[np.bool_]) -> "_Met":
        """The i-th vehicle's patches that chosen ones of the rays may meet."""
        moment, patches = self._moment, _patches(self._vehicles[i])
        poses = self._camera.T_camera_world @ np.concatenate(
            [moment.T_world_chassis[i][None], moment.T_world_wheels[i]]
        )
        T = poses[patches.part]
        centers = np.einsum("pij,pj->pi", T[:, :3, :3], patches.centers) + T[:, :3, 3]
        ray, patch = _near(rays[chosen], away[chosen], centers, patches.radii).nonzero()
        ray = np.flatnonzero(chosen)[ray]
        # Rays are turned into the part's frame: they are fewer than its corners.
        eyes = -np.einsum("pji,pj->pi", poses[:, :3, :3], poses[:, :3, 3])
        own = np.einsum("pji,pj->pi", T[patch, :3, :3], rays[ray])
        part = patches.part[patch]
        through = _through(own, away[ray], patches.boxes[:, patch] - eyes[part])
        used, index = np.unique(patch[through], return_inverse=True)
        return _Met(ray[through], index, own[through], eyes[patches.part[used]], patches.corners[:, :, used])


def _near(rays: Array, away: Array, centers: Array, radii: Array) -> NDArray[np.bool_]:
    """(R, N) whether unit rays (R, 3) from the origin, `away` long, may meet what is in spheres."""
    along = rays @ centers.T
    across = (centers**2).sum(axis=-1) - along**2
    return np.asarray((along > -radii) & (along - radii < away[:, None]) & (across < radii**2))


def _through(rays: Array, away: Array, boxes: Array) -> NDArray[np.bool_]:
    """(R,) whether unit rays (R, 3) from the origin, `away` long, may pass boxes (2, R, 3), one for each of them."""
    with np.errstate(divide="ignore", invalid="ignore"):
        first, second = boxes / rays
    begin, end = np.minimum(first, second).max(axis=-1), np.maximum(first, second).min(axis=-1)
    # A ray along the very side of a box gives NaN, which nothing here is true for.
    return np.asarray(~((begin > end) | (end < 0) | (begin > away)))


@dataclass(frozen=True, eq=False)
class _Met:
    """Pairs of rays and patches, and U patches, in the frames of their parts."""

    ray: NDArray[np.intp]
    patch: NDArray[np.intp]
    """Of the U."""
    own: Array
    """(pairs, 3) the rays."""
    eyes: Array
    """(U, 3) the camera."""
    corners: Array
    """(3 axes, 3 corners, U, _PATCH) metres."""


@dataclass(frozen=True, eq=False)
class _Patches:
    """A vehicle's triangles in P patches of `_PATCH` that lie close together, and spheres and boxes around them."""

    corners: Array
    """(3 axes, 3 corners, P, _PATCH) metres, in the frame of their part; where there are fewer they repeat."""
    part: NDArray[np.int64]
    """(P,) 0 for the body, then its moving parts."""
    centers: Array
    """(P, 3)"""
    radii: Array
    """(P,)"""
    boxes: Array
    """(2, P, 3) their lowest and highest corners."""


@lru_cache(maxsize=256)
def _patches(vehicle: Body) -> _Patches:
    corners, part = list[Array](), list[int]()
    for number, mesh in enumerate(vehicle.parts):
        triangles = mesh.vertices[mesh.triangles]
        for chosen in _halved(triangles.mean(axis=1), np.arange(len(triangles))):
            corners.append(triangles[np.resize(chosen, _PATCH)])
            part.append(number)
    points = np.array(corners)
    low, high = points.min(axis=(1, 2)), points.max(axis=(1, 2))
    centers = (low + high) / 2
    radii = np.linalg.norm(points - centers[:, None, None], axis=-1).max(axis=(1, 2)) + _SLACK
    boxes = np.stack([low - _SLACK, high + _SLACK])
    return _Patches(np.ascontiguousarray(points.transpose(3, 2, 0, 1)), np.array(part), centers, radii, boxes)


def _halved(places: Array, chosen: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Halves of the chosen places (N, 3), halved across their longest side until none has more than `_PATCH`."""
    if len(chosen) <= _PATCH:
        return [chosen] if len(chosen) else []
    there = places[chosen]
    order = chosen[there[:, np.ptp(there, axis=0).argmax()].argsort(kind="stable")]
    middle = len(order) // 2
    return _halved(places, order[:middle]) + _halved(places, order[middle:])


class Fan:
    """Triangles (T, 3, 3) as seen from the origin."""

    def __init__(self, triangles: Array) -> None:
        self._edges, self._volume = _planes(np.ascontiguousarray(triangles.transpose(2, 1, 0)))

    def first_hits(self, rays: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Rays (R, 3) from the origin -> how far they get, in their own lengths, and whether they meet a front there.

        inf and False where they meet nothing. Fronts are counter-clockwise.
        """
        ray, triangle, facing = _crossings([rays @ edge for edge in self._edges])
        reach = self._volume[triangle] / facing
        order = np.lexsort([reach, ray])[::-1]
        order = order[reach[order] > 0]
        hits, front = np.full(len(rays), np.inf), np.zeros(len(rays), dtype=bool)
        # Of what a ray meets, the nearest comes last and stays.
        hits[ray[order]], front[ray[order]] = reach[order], facing[order] < 0
        return hits, front


def _planes(corners: Array) -> tuple[tuple[Array, Array, Array], Array]:
    """Corners (3 axes, 3, ...) of triangles -> normals (3, ...) of the planes through the origin and each edge.

    Their sum is the triangle's own normal; with it comes (...,) the volume of six tetrahedra from the origin.
    """
    a, b, c = corners.swapaxes(0, 1)
    edges = _cross(a, b), _cross(b, c), _cross(c, a)
    return edges, (a * sum(edges)).sum(axis=0)


def _crossings(sides: Sequence[Array]) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
    """On which side rays pass of the planes of triangles, (R, T) for each edge -> rays and triangles that cross.

    With them comes how much the ray goes along the triangle's normal.
    """
    # A ray passes inside a triangle when it is on the same side of all three planes.
    u, v, w = sides
    low, high = np.minimum(np.minimum(u, v), w), np.maximum(np.maximum(u, v), w)
    ray, triangle = ((low >= 0) | (high <= 0)).nonzero()
    facing = u[ray, triangle] + v[ray, triangle] + w[ray, triangle]
    crosses = np.abs(facing) > 1e-12
    return ray[crosses], triangle[crosses], facing[crosses]


def _cross(a: Array, b: Array) -> Array:
    """Of vectors (3, ...), whose axes are apart: many times faster than numpy's."""
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
