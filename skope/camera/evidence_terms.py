"""Evidence as residuals of a camera, each with the covariance from the errors of its marks.

Residuals of lines on the road are measured on the road, because the errors of the marks are projected there.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from skope.camera.evidence import Evidence, MarkedLength, MarkedPoint, ParallelLines, Vertical
from skope.camera.ground_plane import ground_jacobian, intersect_ground
from skope.camera.model import Camera
from skope.camera.uncertain_camera import CAMERA_PARAMETERS, slopes, values_of
from skope.types import Array

LENS_PRIORS: Final = (("k1", -0.1, 0.2), ("roll", 0.0, 0.2), ("focal", None, 1.0))
"""Parameter, mean and standard deviation for roadside cameras. None: a focal length of one image width. Most
lenses lie between a rectilinear one (k1 = 0) and an equidistant fisheye: tan a - (tan a)^3 / 3 is nearly a.
"""


@dataclass(frozen=True, eq=False)
class ResidualTerm:
    """One piece of evidence: residuals (M,) of a camera, and their covariance (M, M)."""

    kind: str
    name: str
    residual: Callable[[Camera], Array]
    covariance: Callable[[Camera], Array]
    point: MarkedPoint | None = None
    """Marked point of the term, if any. All such points are projected at once."""


def residuals_of(terms: Sequence[ResidualTerm], camera: Camera) -> list[Array]:
    """Return the residuals of each term."""
    points = [term.point for term in terms if term.point is not None]
    off = iter(np.zeros((0, 2)))
    if points:
        seen = camera.project(np.array([point.place for point in points]))[0]
        off = iter(_finite(seen - np.array([point.pixel for point in points])))
    return [term.residual(camera) if term.point is None else next(off) for term in terms]


def covariances_of(terms: Sequence[ResidualTerm], camera: Camera) -> list[Array]:
    """Return the covariance of each term's residuals."""
    points = [term.point for term in terms if term.point is not None]
    spread = iter(np.zeros((0, 2, 2)))
    if points:
        places = np.array([point.place for point in points])
        J = _finite(slopes(lambda step: camera.project(places + step)[0], np.zeros(3), 0.01))
        position_sigmas = np.array([[point.sigma_m, point.sigma_m, point.sigma_z_m] for point in points])
        mark_sigmas = np.array([point.sigma_px for point in points])
        J = J * position_sigmas[:, None]
        spread = iter(J @ J.swapaxes(1, 2) + mark_sigmas[:, None, None] ** 2 * np.eye(2))
    return [term.covariance(camera) if term.point is None else next(spread) for term in terms]


def point_term(point: MarkedPoint) -> ResidualTerm:
    """Return the term of a marked point: its distance in pixels from the projection of its position."""
    term = ResidualTerm(
        "point",
        point.name,
        lambda camera: residuals_of([term], camera)[0],
        lambda camera: covariances_of([term], camera)[0],
        point,
    )
    return term


def _length_term(length: MarkedLength) -> ResidualTerm:
    def residual(camera: Camera) -> Array:
        begin, end = intersect_ground(camera, length.pixels)
        return _finite(np.array([np.linalg.norm(end - begin) - length.metres]))

    def covariance(camera: Camera) -> Array:
        begin, end = intersect_ground(camera, length.pixels)[:, :2]
        along = (end - begin) / max(float(np.linalg.norm(end - begin)), 1e-9)
        by_marks = _finite(along @ ground_jacobian(camera, length.pixels))
        return np.array([[length.sigma_m**2 + length.sigma_px**2 * float((by_marks**2).sum())]])

    return ResidualTerm("length", length.name, residual, covariance)


def _parallel_term(group: ParallelLines) -> ResidualTerm:
    def directions(camera: Camera) -> Array:
        """Return (L, 2) vectors from one end of each line to the other, metres."""
        ends = intersect_ground(camera, group.lines)[..., :2]
        return np.asarray(ends[:, 1] - ends[:, 0])

    def variances(camera: Camera, way: Array) -> Array:
        """Return (L,) variances of the lines' angles, square radians."""
        across = np.stack([-way[:, 1], way[:, 0]], axis=-1) / np.maximum((way**2).sum(axis=-1), 1e-9)[:, None]
        by_marks = np.einsum("li,leij->lej", across, ground_jacobian(camera, group.lines))
        return _finite(group.sigma_px**2 * (by_marks**2).sum(axis=(1, 2)))

    def residual(camera: Camera) -> Array:
        """Return the deviations of the lines' angles from their weighted mean."""
        way = directions(camera)
        weight = 1 / np.maximum(variances(camera, way), 1e-12)
        angles = np.arctan2(way[:, 1], way[:, 0])
        # Lines have no direction, so those that were drawn in the opposite direction are reversed.
        angles = angles[0] + np.mod(angles - angles[0] + np.pi / 2, np.pi) - np.pi / 2
        return _finite(angles - (weight * angles).sum() / weight.sum())

    def covariance(camera: Camera) -> Array:
        return np.diag(variances(camera, directions(camera)))

    return ResidualTerm("parallel lines", group.name, residual, covariance)


def _vertical_term(vertical: Vertical) -> ResidualTerm:
    foot, top = vertical.pixels

    def line(camera: Camera) -> tuple[Array, Array]:
        """Return the unit vector of the vertical in the image near its top, and the pixels per metre there."""
        position = intersect_ground(camera, foot)
        ray = camera.rays(top)[0] @ camera.T_camera_world[:3, :3]
        flat = float(np.linalg.norm((position - camera.position)[:2])) / max(float(np.linalg.norm(ray[:2])), 1e-9)
        height = vertical.metres or max(float(camera.position[2] + flat * ray[2]), 0.1)
        ends, _, _ = camera.project(position + np.array([[0, 0, height - 0.05], [0, 0, height + 0.05], [0, 0, height]]))
        return (ends[1] - ends[0]) / 0.1, ends[2]

    def residual(camera: Camera) -> Array:
        a_metre, end = line(camera)
        along = a_metre / max(float(np.linalg.norm(a_metre)), 1e-9)
        off = top - end
        across = off @ np.array([-along[1], along[0]])
        return _finite(np.array([across] if vertical.metres is None else [across, off @ along]))

    def covariance(camera: Camera) -> Array:
        a_metre, _ = line(camera)
        marks_variance = 2 * vertical.sigma_px**2
        if vertical.metres is None:
            return np.array([[marks_variance]])
        return np.diag([marks_variance, marks_variance + float(a_metre @ a_metre) * vertical.sigma_m**2])

    return ResidualTerm("vertical", vertical.name, residual, covariance)


def _gaussian_term(kind: str, name: str, of: Sequence[str], mean: Array, covariance: Array) -> ResidualTerm:
    which = [CAMERA_PARAMETERS.index(parameter) for parameter in of]

    def residual(camera: Camera) -> Array:
        return np.asarray(values_of(camera)[which] - mean)

    return ResidualTerm(kind, name, residual, lambda _: covariance)


def terms_of(evidence: Evidence) -> list[ResidualTerm]:
    out = [point_term(point) for point in evidence.points]
    out += [_length_term(length) for length in evidence.lengths]
    out += [_parallel_term(group) for group in evidence.parallels]
    out += [_vertical_term(vertical) for vertical in evidence.verticals]
    out += [_gaussian_term("belief", prior.name, prior.of, prior.mean, prior.covariance) for prior in evidence.priors]
    for name, mean, sigma in LENS_PRIORS:
        center = math.log(evidence.size[0]) if mean is None else mean
        out.append(_gaussian_term("lens", name, (name,), np.array([center]), np.array([[sigma**2]])))
    return out


def _finite(values: Array) -> Array:
    """Replace residuals that are NaN, because the camera does not see a mark, by large ones."""
    return np.asarray(np.where(np.isfinite(values), values, 1e3))
