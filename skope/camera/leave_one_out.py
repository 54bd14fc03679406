"""Errors of a calibration at places that it has not seen: each point left out once, and placed by the others."""

from dataclasses import dataclass, replace

import numpy as np

from skope.camera.calibrate import SiteCalibration, calibrate
from skope.camera.evidence import Evidence, MarkedPoint
from skope.camera.pose_from_points import FEWEST
from skope.camera.uncertain_camera import PLACE_SHARE, UncertainCamera, radius_of
from skope.errors import UserError


@dataclass(frozen=True)
class LeftOutError:
    """Error of a point that is left out and placed by the others."""

    error_m: float
    """Distance from its place, metres; NaN where the others have it above the horizon."""
    stated_m: float
    """Within so many metres it should lie in 90% of the cases: errors of the others, of its mark and of its place."""


def left_out_errors(evidence: Evidence, calibration: SiteCalibration) -> dict[str, LeftOutError]:
    """The error of each point by its name, without those that the calibration leaves out.

    A point that is left out of the calibration anyhow is placed by all that are not. Empty where too few would remain.
    """
    good = tuple(point for point in evidence.points if point.name not in calibration.outliers)
    out = {}
    for point in evidence.points:
        others = tuple(one for one in good if one is not point)
        if len(others) < FEWEST:
            continue
        if len(others) == len(good):
            out[point.name] = left_out_error(point, calibration)
            continue
        try:
            without = calibrate(replace(evidence, points=others), start=calibration.camera, check=False)
        except UserError:
            continue
        out[point.name] = left_out_error(point, without)
    return out


def left_out_error(point: MarkedPoint, camera: UncertainCamera) -> LeftOutError:
    """Error of the place that a camera which does not know the point gives its mark, on the plane of its height."""
    height = float(point.place[2])
    place = camera.places(point.pixel, height)
    away = place - camera.camera.position
    rise = point.sigma_z_m * away[:2] / away[2] if away[2] else np.zeros(2)
    covariance = camera.place_covariance(point.pixel, height, point.sigma_px)
    covariance = covariance + point.sigma_m**2 * np.eye(2) + np.outer(rise, rise)
    return LeftOutError(float(np.linalg.norm((place - point.place)[:2])), float(radius_of(covariance, PLACE_SHARE)))
