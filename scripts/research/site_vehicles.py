"""How well a camera is known from vehicles, from marks, and from all together.

Cameras, marks and comparison are those of `site_calibration.py`. Vehicles are shapes of the fleet's shape space whose
true keypoints have noise of 2% of their box, a pixel at least; they say nothing of place and direction: there the world
begins under the camera. Where a part refuses a draw, all together do without it. `--size-sigma`: all vehicles of a draw
are larger or smaller than the fleet's by one factor, as those of a country may be.
Run: python scripts/research/site_vehicles.py --draws 20
"""

import argparse
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from site_calibration import (
    CAMERAS,
    SIZE,
    Cameras,
    chosen_cameras,
    held,
    lengths_and_parallels,
    points,
    road,
    true_camera,
)

from skope import keypoints
from skope.camera.calibrate import calibrate
from skope.camera.evidence import MARKING_ERRORS, Evidence
from skope.camera.fit.bundle_adjustment import VehicleViews
from skope.camera.fit.camera_doubts import why_not
from skope.camera.fit.camera_unknowns import UNKNOWN_NAMES
from skope.camera.fit.fit_camera import fit_camera_to_vehicles
from skope.camera.model import Camera
from skope.camera.uncertain_camera import UncertainCamera
from skope.errors import UserError
from skope.pose.shape_model import Shapes, facing, fleet_shapes
from skope.types import Array

PARTS = ("6 points", "lengths and parallel lines", "vehicles", "together")
Result = tuple[float, float]
"""Share of places within the stated error, and the median error, metres."""


@dataclass(frozen=True)
class Traffic:
    """What vehicles a draw has."""

    vehicles: int
    size_sigma: float = 0.0
    """Standard deviation of the factor by which all are larger than the fleet's."""
    moments: int = 4
    """Views of each, at most."""


def vehicle_views(camera: Camera, rng: np.random.Generator, traffic: Traffic) -> VehicleViews:
    """Views of vehicles that drive straight on through the image, with noise as a detector's."""
    shapes, vehicles = fleet_shapes(), traffic.vehicles
    larger = 1 + traffic.size_sigma * rng.normal() if traffic.size_sigma else 1.0
    found, sigmas, numbers = [], [], []
    number = 0
    for _ in range(40 * vehicles):
        if number == vehicles:
            break
        kind = int(rng.choice(len(shapes.types), p=shapes.share))
        rest = np.append(shapes.rest[kind], 0.0)[:, None] * rng.normal(size=shapes.mean[kind].shape)
        own = np.tensordot(rng.normal(size=len(shapes.directions[kind])), shapes.directions[kind], axes=1)
        shape = larger * (shapes.mean[kind] + own + rest)[: keypoints.K]
        yaw = float(rng.choice([0.0, math.pi]) + camera.angles[0] + rng.normal(0, 0.4))
        R = np.array([[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]])
        _, places = road(camera)
        begin = places[rng.integers(len(places))] - R[:, 0] * rng.uniform(0, 10)
        seen = [
            _sighting(camera, shapes, kind, shape, R, begin + 5.0 * k * R[:, 0], rng) for k in range(traffic.moments)
        ]
        good = [view for view in seen if view is not None]
        if len(good) < 2:
            continue
        for view, sigma in good:
            found.append(view)
            sigmas.append(sigma)
            numbers.append(number)
        number += 1
    if number < vehicles:
        raise UserError(f"only {number} vehicles are in sight")
    return VehicleViews(np.array(found), np.array(sigmas), np.array(numbers, dtype=np.intp), SIZE, shapes)


def _sighting(
    camera: Camera, shapes: Shapes, kind: int, shape: Array, R: Array, place: Array, rng: np.random.Generator
) -> tuple[Array, float] | None:
    """(33, 3) keypoints of a vehicle with their noise, and its standard deviation; None: it shows too little."""
    points = shape @ R.T + place + [0, 0, rng.normal(0, MARKING_ERRORS.height_m)]
    pixels, _, valid = camera.project(points)
    eye = (camera.position - place) @ R
    shown = valid & camera.inside(pixels) & facing(shapes, np.array([kind]), shape[None], eye[None])[0]
    if shown.sum() < 8 or not valid.all():
        return None
    edge = float(np.ptp(pixels, axis=0).max())
    if edge < 48:
        return None
    sigma = max(1.0, 0.02 * edge)
    return np.column_stack([pixels + rng.normal(0, sigma, pixels.shape), shown.astype(float)]), sigma


def from_vehicles(camera: Camera, rng: np.random.Generator, traffic: Traffic) -> UncertainCamera:
    """The camera that vehicles tell, as `skope eval camera` finds it. Raises UserError where it would refuse."""
    views = vehicle_views(camera, rng, traffic)
    fit = fit_camera_to_vehicles(views)
    boxes = [(np.ptp(view[:, 0]) / 2 + view[:, 0].min(), view[:, 1].max()) for view in views.found]
    if reason := why_not(fit, np.array(boxes)):
        raise UserError(reason)
    return UncertainCamera.from_dict(fit.camera, {"of": list(UNKNOWN_NAMES), "matrix": fit.covariance.tolist()})


def together(cameras: Cameras, count: int, traffic: Traffic, alone: bool = False) -> Iterator[str]:
    """Each part and all of them, of the same draws; lines for each camera, and the means over the cameras.

    With `alone` vehicles are the only part.
    """
    table: dict[str, list[Result]] = {name: [] for name in PARTS}
    for k, row in enumerate(cameras):
        rng = np.random.default_rng(200 + k)
        of_camera: dict[str, list[Result]] = {name: [] for name in PARTS}
        for _ in range(count):
            for name, result in _of_draw(true_camera(*row, rng), rng, traffic, alone):
                of_camera[name].append(result)
        yield f"  camera {k + 1}"
        for name, results in of_camera.items():
            if results:
                share, error = np.mean(results, axis=0).tolist()
                table[name].append((share, error))
                yield f"    {name}: {error:.3f} m, {share:.3f} within, {count - len(results)} refused"
            elif name == "vehicles" or not alone:
                yield f"    {name}: refused"
    yield "  mean over the cameras of the median error"
    for name, results in table.items():
        if results:
            shares, errors = np.array(results).T
            yield (
                f"    {name}: {errors.mean():.3f} m, worst {errors.max():.3f} m; {shares.mean():.3f} within, "
                f"from {shares.min():.3f} to {shares.max():.3f} ({len(results)} cameras)"
            )


def _of_draw(camera: Camera, rng: np.random.Generator, traffic: Traffic, alone: bool) -> Iterator[tuple[str, Result]]:
    """What each of `PARTS` makes of one draw; without those that refuse it."""
    marked, measured = points(camera, 6, rng), lengths_and_parallels(camera, rng)
    told = _told_by_vehicles(camera, rng, traffic)
    if told:
        yield "vehicles", held(camera, told, gauge=True)
    if alone:
        return
    whole = replace(measured, points=marked, beliefs=(told.belief("vehicles"),) if told else ())
    evidence = {"6 points": Evidence(SIZE, points=marked), "lengths and parallel lines": measured, "together": whole}
    for name, one in evidence.items():
        try:
            yield name, held(camera, calibrate(one), gauge=not one.points)
        except UserError:
            continue


def _told_by_vehicles(camera: Camera, rng: np.random.Generator, traffic: Traffic) -> UncertainCamera | None:
    try:
        return from_vehicles(camera, rng, traffic)
    except UserError:
        return None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=20)
    parser.add_argument("--cameras", type=int, default=len(CAMERAS))
    parser.add_argument("--vehicles", type=int, default=25, help="vehicles of a draw")
    parser.add_argument("--size-sigma", type=float, default=0.0, help="of one factor on the size of all of a draw")
    parser.add_argument("--alone", action="store_true", help="vehicles alone, without marks")
    parser.add_argument("--others", type=int, metavar="SEED", help="eight cameras drawn by this seed in their place")
    options = parser.parse_args()
    traffic = Traffic(options.vehicles, options.size_sigma)
    print(f"{traffic}, {options.draws} draws a camera", flush=True)
    for line in together(chosen_cameras(options.cameras, options.others), options.draws, traffic, options.alone):
        print(line, flush=True)


if __name__ == "__main__":
    main()
