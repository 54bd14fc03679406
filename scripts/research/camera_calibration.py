"""Accuracy of cameras that are calibrated from marked points, lengths, parallel lines and vehicles.

    python scripts/research/camera_calibration.py marks --draws 100
    python scripts/research/camera_calibration.py vehicles --draws 20
    python scripts/research/camera_calibration.py bound --draws 40

Eight simulated cameras by a road, with known truth and including lens distortion. Marked points have noise of 1.5 px
and 0.1 m, on a road that is uneven by 3 cm. Positions on a grid of the road up to 60 m away are compared with where the
calibrated camera puts their true pixels: share within the stated 90% error, and median error. Lengths, parallel lines
and vehicles do not determine position and direction; for them the origin of the world is below the camera.

`marks`: points, lengths and parallel lines, and sets with one wrong point.

`vehicles`: vehicles alone, marks, and all together. Vehicles are shapes of the fleet's shape space; their true
keypoints have noise of 2% of their box, at least a pixel. If a part rejects a draw, "together" does without it.
`--size-sigma`: all vehicles of a draw are larger or smaller than the fleet's by one factor, which may vary between
countries.

`bound`: how often the wrong one of six points can be found at all if the distribution of wrong points is known. For
each point, the likelihood of all points is computed on the assumption that this point is wrong by 2 m along x and y
(Laplace's approximation, at the camera that the search finds from the true one). "Forced": the wrong point is the most
likely of the six. "Found": it is also more likely than no wrong point, with one wrong point in fifty.
"""

import argparse
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from skope import keypoints
from skope.camera.calibrate import calibrate
from skope.camera.evidence import MARKING_ERRORS, Evidence, MarkedLength, MarkedPoint, ParallelLines
from skope.camera.evidence_terms import point_term, terms_of
from skope.camera.fit.bundle_adjustment import VehicleViews
from skope.camera.fit.camera_doubts import rejection_reason
from skope.camera.fit.camera_unknowns import UNKNOWN_NAMES
from skope.camera.fit.fit_camera import fit_camera_to_vehicles
from skope.camera.ground_plane import intersect_ground
from skope.camera.model import Camera, Distortion
from skope.camera.uncertain_camera import CAMERA_PARAMETERS, UncertainCamera, values_of
from skope.camera.weighted_fit import SEARCH_SCALES, fit_terms
from skope.errors import UserError
from skope.pose.shape_model import Shapes, facing, fleet_shapes
from skope.types import Array

SIZE = (1280, 720)
FARTHEST_M = 60.0
ASIDE_M = 2.0
"""Standard deviation of a wrong point along x and y."""
ONE_IN = 50
BOUND_POINTS = 6
ROWS = ("4-points", "6-points", "8-points", "10-points", "6-points-one-wrong", "8-points-one-wrong", "lengths")
Cameras = Sequence[tuple[float, float, float, float, float]]
CAMERAS: Cameras = (
    # fov, height, pitch, roll (degrees), k1
    (40.0, 6.0, 14.0, 0.5, -0.05),
    (60.0, 8.0, 20.0, -1.0, -0.12),
    (80.0, 5.0, 16.0, 1.5, -0.20),
    (95.0, 10.0, 30.0, 0.0, -0.25),
    (50.0, 12.0, 25.0, 2.0, 0.0),
    (70.0, 4.0, 12.0, -2.0, -0.15),
    (30.0, 15.0, 20.0, 0.5, 0.02),
    (88.0, 7.0, 22.0, 1.0, -0.22),
)


def drawn_cameras(rng: np.random.Generator) -> Iterator[tuple[float, float, float, float, float]]:
    """Draw eight cameras with the variety of real roads, whose images show road up to `FARTHEST_M`."""
    for _ in CAMERAS:
        fov, height = rng.uniform(30, 95), 4 * 4 ** rng.uniform()
        pitch = rng.uniform(0.2, 0.4) * fov + math.degrees(math.atan(height / FARTHEST_M))
        yield fov, height, min(pitch, 40.0), rng.normal(0, 1.5), rng.uniform(-0.3, 0.03)


def true_camera(fov: float, height: float, pitch: float, roll: float, k1: float, rng: np.random.Generator) -> Camera:
    """Return one of `CAMERAS` with a random position and direction."""
    pitch, roll, yaw = math.radians(pitch), math.radians(roll), rng.uniform(-math.pi, math.pi)
    lens = Distortion("brown", (k1, 0.0, 0.0, 0.0)) if k1 else Distortion()
    position = [*rng.uniform(-50, 50, 2), height]
    return Camera.looking(
        position, yaw=yaw, pitch_down=pitch, roll=roll, size=SIZE, fov=math.radians(fov), distortion=lens
    )


def road(camera: Camera) -> tuple[Array, Array]:
    """Return a grid of the road as the camera sees it.

    Returns:
        Pixels (N, 2) of a grid of the image that show road up to `FARTHEST_M` away, and their positions (N, 3).
    """
    u, v = np.meshgrid(np.linspace(20, SIZE[0] - 20, 25), np.linspace(20, SIZE[1] - 20, 19))
    pixels = np.column_stack([u.ravel(), v.ravel()])
    places = intersect_ground(camera, pixels)
    near = np.linalg.norm(places[:, :2] - camera.position[:2], axis=1) < FARTHEST_M
    return pixels[near], places[near]


def points(camera: Camera, count: int, rng: np.random.Generator, wrong: bool = False) -> tuple[MarkedPoint, ...]:
    """Draw points spread over the road as people choose them, with errors; with `wrong` the first one is wrong."""
    pixels, places = road(camera)
    chosen = [int(rng.integers(len(places)))]
    while len(chosen) < count:  # prefer points that are far from the others in the image
        apart = np.linalg.norm(pixels[:, None] - pixels[chosen], axis=-1).min(axis=1)
        chosen.append(int(rng.choice(len(places), p=apart**2 / (apart**2).sum())))
    out = []
    for k, i in enumerate(chosen):
        position = places[i] + rng.normal(0, [0.1, 0.1, MARKING_ERRORS.height_m])
        pixel = pixels[i] + rng.normal(0, 1.5, 2)
        if wrong and k == 0:  # as if the next corner of the marking was clicked
            angle = rng.uniform(0, 2 * math.pi)
            position = position + rng.uniform(1.5, 4) * np.array([math.cos(angle), math.sin(angle), 0])
        out.append(MarkedPoint(pixel, position, name=str(k + 1)))
    return tuple(out)


def lengths_and_parallels(camera: Camera, rng: np.random.Generator) -> Evidence:
    """Return three known lengths along and across the road, and its two edges."""
    pixels, places = road(camera)
    yaw = camera.angles[0] + rng.normal(0, 0.3)
    along, across = np.array([math.cos(yaw), math.sin(yaw), 0]), np.array([-math.sin(yaw), math.cos(yaw), 0])
    middle = places[np.abs(pixels - [SIZE[0] / 2, 0.7 * SIZE[1]]).sum(axis=1).argmin()]

    def marked(ends: Array) -> Array | None:
        seen, _, valid = camera.project(ends)
        return seen + rng.normal(0, 1.5, seen.shape) if (valid & camera.inside(seen)).all() else None

    lengths, lines = [], []
    for metres, way, begin in (
        (6.0, along, -2 * across),
        (6.0, along, 1.5 * across),
        (3.5, across, along),
        (3.5, across, 6 * along),
    ):
        for shift in (0.0, 2.0, 4.0, -2.0):
            seen = marked(np.stack([middle + begin + shift * along, middle + begin + shift * along + metres * way]))
            if seen is not None:
                lengths.append(MarkedLength(seen, metres + rng.normal(0, 0.05)))
                break
    for side in (-3.5, 0.0, 3.5):
        for reach in (25.0, 15.0, 8.0, 4.0):
            seen = marked(np.stack([middle + side * across, middle + side * across + reach * along]))
            if seen is not None:
                lines.append(seen)
                break
    groups = (ParallelLines(np.stack(lines)),) if len(lines) > 1 else ()
    return Evidence(SIZE, lengths=tuple(lengths), parallels=groups)


def held(camera: Camera, calibration: UncertainCamera, *, gauge: bool = False) -> tuple[float, float]:
    """Return the share of positions within the stated error, and the median error, metres.

    With `gauge` the world of the calibration begins under its camera, so that distances between positions are compared.
    """
    pixels, places = road(camera)
    if gauge:
        position, yaw = camera.position, camera.angles[0]
        c, s = math.cos(-yaw), math.sin(-yaw)
        places = (places - position * [1, 1, 0]) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T
    error = np.linalg.norm((calibration.places(pixels) - places)[:, :2], axis=1)
    error[np.isnan(error)] = np.inf
    stated = calibration.place_error(pixels)
    return float((error <= stated).mean()), float(np.median(error))


def draws(
    make: Callable[[Camera, np.random.Generator], Evidence], cameras: Cameras, count: int, gauge: bool = False
) -> Iterator[str]:
    """Yield a line for each camera, and one over all."""
    means = []
    for k, row in enumerate(cameras):
        rng = np.random.default_rng(k)
        shares, errors, rejected = [], [], 0
        for _ in range(count):
            camera = true_camera(*row, rng)
            try:
                share, error = held(camera, calibrate(make(camera, rng)), gauge=gauge)
            except UserError:
                rejected += 1
                continue
            shares.append(share)
            errors.append(error)
        summary = f"{np.mean(shares):.3f} within, median error {np.median(errors):.2f} m" if shares else "none"
        means += [float(np.mean(shares))] if shares else []
        yield f"  camera {k + 1}: {summary}, {rejected} rejected"
    if means:
        yield f"  all cameras: {np.mean(means):.3f} within, from {min(means):.3f} to {max(means):.3f}"


def found_wrong(count: int, cameras: Cameras, draws: int) -> Iterator[str]:
    """Measure how often the wrong one of `count` points is left out, or named among those that may be wrong."""
    left_out = named = total = 0
    means = []
    for k, row in enumerate(cameras):
        rng, shares = np.random.default_rng(100 + k), []
        for _ in range(draws):
            camera = true_camera(*row, rng)
            found = calibrate(Evidence(SIZE, points=points(camera, count, rng, wrong=True)))
            doubted = {word.strip(":;,") for words in found.warnings if "mark" in words for word in words.split()}
            left_out, total = left_out + (found.outliers == ("1",)), total + 1
            named += found.outliers == ("1",) or "1" in doubted
            shares.append(held(camera, found)[0])
        means.append(float(np.mean(shares)))
        yield f"  camera {k + 1}: {means[-1]:.3f} within"
    yield f"  of {total} draws the wrong point is left out in {left_out}, and left out or named as possible in {named}"
    yield f"  all cameras: {np.mean(means):.3f} within, from {min(means):.3f} to {max(means):.3f}"


def _marked(count: int, camera: Camera, rng: np.random.Generator) -> Evidence:
    return Evidence(SIZE, points=points(camera, count, rng))


def lines_of(row: str, cameras: Cameras, count: int) -> Iterator[str]:
    """Yield the lines of one of `ROWS`, from `count` draws per camera."""
    if row == "lengths":
        return draws(lengths_and_parallels, cameras, count, gauge=True)
    number = int(row.split("-")[0])
    return found_wrong(number, cameras, count) if "wrong" in row else draws(partial(_marked, number), cameras, count)


def chosen_cameras(count: int, seed: int | None) -> Cameras:
    """Return the first `count` of the eight cameras, or of eight cameras drawn by a seed."""
    return tuple(CAMERAS if seed is None else drawn_cameras(np.random.default_rng(seed)))[:count]


PARTS = ("6 points", "lengths and parallel lines", "vehicles", "together")
Result = tuple[float, float]
"""Share of positions within the stated error, and the median error, metres."""


@dataclass(frozen=True)
class Traffic:
    """Number and size of the vehicles of a draw."""

    vehicles: int
    size_sigma: float = 0.0
    """Standard deviation of the factor by which all vehicles are larger than the fleet's."""
    moments: int = 4
    """Largest number of views of each vehicle."""


def vehicle_views(camera: Camera, rng: np.random.Generator, traffic: Traffic) -> VehicleViews:
    """Draw views of vehicles that drive straight through the image, with the noise of a detector."""
    shapes, vehicles = fleet_shapes(), traffic.vehicles
    larger = 1 + traffic.size_sigma * rng.normal() if traffic.size_sigma else 1.0
    found, sigmas, numbers = [], [], []
    number = 0
    for _ in range(40 * vehicles):
        if number == vehicles:
            break
        kind = int(rng.choice(len(shapes.types), p=shapes.share))
        rest = np.append(shapes.rest[kind], 0.0)[:, None] * rng.normal(size=shapes.mean[kind].shape)
        variation = np.tensordot(rng.normal(size=len(shapes.directions[kind])), shapes.directions[kind], axes=1)
        shape = larger * (shapes.mean[kind] + variation + rest)[: keypoints.K]
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
        raise UserError(f"only {number} vehicles are visible")
    return VehicleViews(np.array(found), np.array(sigmas), np.array(numbers, dtype=np.intp), SIZE, shapes)


def _sighting(
    camera: Camera, shapes: Shapes, kind: int, shape: Array, R: Array, position: Array, rng: np.random.Generator
) -> tuple[Array, float] | None:
    """Return the noisy keypoints (33, 3) of a vehicle and their standard deviation; None if too few are visible."""
    points = shape @ R.T + position + [0, 0, rng.normal(0, MARKING_ERRORS.height_m)]
    pixels, _, valid = camera.project(points)
    eye = (camera.position - position) @ R
    shown = valid & camera.inside(pixels) & facing(shapes, np.array([kind]), shape[None], eye[None])[0]
    if shown.sum() < 8 or not valid.all():
        return None
    edge = float(np.ptp(pixels, axis=0).max())
    if edge < 48:
        return None
    sigma = max(1.0, 0.02 * edge)
    return np.column_stack([pixels + rng.normal(0, sigma, pixels.shape), shown.astype(float)]), sigma


def from_vehicles(camera: Camera, rng: np.random.Generator, traffic: Traffic) -> UncertainCamera:
    """Estimate the camera from vehicles, as `skope eval camera` does.

    Raises UserError if the estimate is rejected.
    """
    views = vehicle_views(camera, rng, traffic)
    fit = fit_camera_to_vehicles(views)
    boxes = [(np.ptp(view[:, 0]) / 2 + view[:, 0].min(), view[:, 1].max()) for view in views.found]
    if reason := rejection_reason(fit, np.array(boxes)):
        raise UserError(reason)
    return UncertainCamera.from_dict(fit.camera, {"of": list(UNKNOWN_NAMES), "matrix": fit.covariance.tolist()})


def together(cameras: Cameras, count: int, traffic: Traffic, alone: bool = False) -> Iterator[str]:
    """Measure each part and all of them together, on the same draws; yields lines of results.

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
                yield f"    {name}: {error:.3f} m, {share:.3f} within, {count - len(results)} rejected"
            elif name == "vehicles" or not alone:
                yield f"    {name}: rejected"
    yield "  mean over the cameras of the median error"
    for name, results in table.items():
        if results:
            shares, errors = np.array(results).T
            yield (
                f"    {name}: {errors.mean():.3f} m, worst {errors.max():.3f} m; {shares.mean():.3f} within, "
                f"from {shares.min():.3f} to {shares.max():.3f} ({len(results)} cameras)"
            )


def _of_draw(camera: Camera, rng: np.random.Generator, traffic: Traffic, alone: bool) -> Iterator[tuple[str, Result]]:
    """Yield the result of each of `PARTS` for one draw, without parts that reject it."""
    marked, measured = points(camera, 6, rng), lengths_and_parallels(camera, rng)
    from_traffic = _camera_of_vehicles(camera, rng, traffic)
    if from_traffic:
        yield "vehicles", held(camera, from_traffic, gauge=True)
    if alone:
        return
    whole = replace(measured, points=marked, priors=(from_traffic.prior("vehicles"),) if from_traffic else ())
    evidence = {"6 points": Evidence(SIZE, points=marked), "lengths and parallel lines": measured, "together": whole}
    for name, part in evidence.items():
        try:
            yield name, held(camera, calibrate(part), gauge=not part.points)
        except UserError:
            continue


def _camera_of_vehicles(camera: Camera, rng: np.random.Generator, traffic: Traffic) -> UncertainCamera | None:
    try:
        return from_vehicles(camera, rng, traffic)
    except UserError:
        return None


def marks_table(options: argparse.Namespace) -> Iterator[str]:
    """Yield the lines of each requested row."""
    for row in options.rows:
        yield f"{row}, {options.draws} draws per camera"
        yield from lines_of(row, chosen_cameras(options.cameras, options.others), options.draws)


def vehicles_table(options: argparse.Namespace) -> Iterator[str]:
    """Yield the lines of each part and of all together."""
    traffic = Traffic(options.vehicles, options.size_sigma)
    yield f"{traffic}, {options.draws} draws per camera"
    yield from together(chosen_cameras(options.cameras, options.others), options.draws, traffic, options.alone)


def bound(options: argparse.Namespace) -> Iterator[str]:
    """Measure how often the wrong one of `BOUND_POINTS` points is the most likely one."""
    forced = found = 0
    for k, row in enumerate(CAMERAS):
        rng = np.random.default_rng(100 + k)
        for _ in range(options.draws):
            camera = true_camera(*row, rng)
            evidence = Evidence(SIZE, points=points(camera, BOUND_POINTS, rng, wrong=True))
            terms, begin = terms_of(evidence), values_of(camera)
            none = fit_terms(terms, begin, CAMERA_PARAMETERS, SIZE).log_evidence(SEARCH_SCALES)
            each = []
            for i, point in enumerate(evidence.points):
                moved = [*terms[:i], point_term(replace(point, sigma_m=ASIDE_M)), *terms[i + 1 :]]
                each.append(fit_terms(moved, begin, CAMERA_PARAMETERS, SIZE).log_evidence(SEARCH_SCALES))
            first = each[0] == max(each)
            forced += first
            found += first and each[0] - math.log(ONE_IN - 1) > none
    total = len(CAMERAS) * options.draws
    yield f"of {total} sets: forced {forced / total:.1%}, found {found / total:.1%}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    marks = commands.add_parser("marks", help="points, lengths and parallel lines")
    marks.add_argument("--rows", nargs="+", choices=ROWS, default=ROWS, help="default: all")
    vehicles = commands.add_parser("vehicles", help="vehicles, marks and all together")
    vehicles.add_argument("--vehicles", type=int, default=25, help="vehicles per draw")
    vehicles.add_argument("--size-sigma", type=float, default=0.0, help="deviation of a common size factor")
    vehicles.add_argument("--alone", action="store_true", help="vehicles alone, without marks")
    for command in (marks, vehicles):
        command.add_argument("--cameras", type=int, default=len(CAMERAS))
        command.add_argument("--others", type=int, metavar="SEED", help="draw eight other cameras with this seed")
    wrong = commands.add_parser("bound", help="how often a wrong point can be found at all")
    for command, run, draws_per_camera in (
        (marks, marks_table, 100),
        (vehicles, vehicles_table, 20),
        (wrong, bound, 40),
    ):
        command.add_argument("--draws", type=int, default=draws_per_camera, help="draws per camera")
        command.set_defaults(run=run)
    options = parser.parse_args()
    for line in options.run(options):
        print(line, flush=True)


if __name__ == "__main__":
    main()
