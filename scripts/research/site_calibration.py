"""How well a camera is known from marked points, lengths and parallel lines, vehicles, and all together.

Eight cameras by a road with known truth, bent lenses included; of each so many draws of points in the image with noise
of 1.5 px and 0.1 m, on a road that is uneven by 3 cm. Places on a grid of the road up to 60 m away are compared with
where the calibrated camera puts the true pixels: share within the stated 90% error, and the median error. Vehicles are
shapes of the fleet's shape space whose true keypoints have noise of 2% of their box, a pixel at least; they say nothing
of place and direction, nor do lengths and parallel lines: there the world begins under the camera. Where a part refuses
a draw, all together do without it.
Run: python scripts/research/site_calibration.py --draws 100 --vehicle-draws 4
"""

import argparse
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from skope import keypoints
from skope.camera.calibrate import calibrate
from skope.camera.evidence import UNEVEN_M, Evidence, MarkedLength, MarkedPoint, ParallelLines
from skope.camera.ground_plane import ground_places
from skope.camera.model import Camera, Distortion
from skope.camera.uncertain_camera import UncertainCamera
from skope.errors import UserError
from skope.eval.pose.bundle_adjustment import VehicleViews
from skope.eval.pose.camera_doubts import why_not
from skope.eval.pose.camera_unknowns import CAMERA
from skope.eval.pose.fit_camera import fit_camera
from skope.eval.pose.self_occlusion import facing
from skope.eval.pose.shape_model import Shapes, fleet_shapes

SIZE = (1280, 720)
FARTHEST_M = 60.0
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


def other_cameras(rng: np.random.Generator) -> Iterator[tuple[float, float, float, float, float]]:
    """Eight cameras as unlike one another as those of roads are, whose images have road up to the far limit."""
    for _ in CAMERAS:
        fov, height = rng.uniform(30, 95), 4 * 4 ** rng.uniform()
        pitch = rng.uniform(0.2, 0.4) * fov + math.degrees(math.atan(height / FARTHEST_M))
        yield fov, height, min(pitch, 40.0), rng.normal(0, 1.5), rng.uniform(-0.3, 0.03)


Array = np.ndarray


def true_camera(fov: float, height: float, pitch: float, roll: float, k1: float, rng: np.random.Generator) -> Camera:
    """One of `CAMERAS`, at some place and turned some way."""
    pitch, roll, yaw = math.radians(pitch), math.radians(roll), rng.uniform(-math.pi, math.pi)
    lens = Distortion("brown", (k1, 0.0, 0.0, 0.0)) if k1 else Distortion()
    place = [*rng.uniform(-50, 50, 2), height]
    return Camera.looking(
        place, yaw=yaw, pitch_down=pitch, roll=roll, size=SIZE, fov=math.radians(fov), distortion=lens
    )


def road(camera: Camera) -> tuple[Array, Array]:
    """(N, 2) pixels on a grid of the image that show road up to `FARTHEST_M` away, and (N, 3) their places."""
    u, v = np.meshgrid(np.linspace(20, SIZE[0] - 20, 25), np.linspace(20, SIZE[1] - 20, 19))
    pixels = np.column_stack([u.ravel(), v.ravel()])
    places = ground_places(camera, pixels)
    near = np.linalg.norm(places[:, :2] - camera.position[:2], axis=1) < FARTHEST_M
    return pixels[near], places[near]


def points(camera: Camera, count: int, rng: np.random.Generator, wrong: bool = False) -> tuple[MarkedPoint, ...]:
    """Points spread over the road as people choose them, with errors; the first one is wrong if asked for."""
    pixels, places = road(camera)
    chosen = [int(rng.integers(len(places)))]
    while len(chosen) < count:  # each far from the others in the image
        apart = np.linalg.norm(pixels[:, None] - pixels[chosen], axis=-1).min(axis=1)
        chosen.append(int(rng.choice(len(places), p=apart**2 / (apart**2).sum())))
    out = []
    for k, i in enumerate(chosen):
        place = places[i] + rng.normal(0, [0.1, 0.1, UNEVEN_M])
        pixel = pixels[i] + rng.normal(0, 1.5, 2)
        if wrong and k == 0:  # the next corner of the marking was clicked
            angle = rng.uniform(0, 2 * math.pi)
            place = place + rng.uniform(1.5, 4) * np.array([math.cos(angle), math.sin(angle), 0])
        out.append(MarkedPoint(pixel, place, name=str(k + 1)))
    return tuple(out)


def lengths_and_parallels(camera: Camera, rng: np.random.Generator) -> Evidence:
    """Three known lengths along and across the way, and its two edges."""
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


def vehicle_views(camera: Camera, rng: np.random.Generator, vehicles: int, moments: int = 4) -> VehicleViews:
    """Views of vehicles that drive straight on through the image, with noise as a detector's."""
    shapes = fleet_shapes()
    found, sigmas, numbers = [], [], []
    number = 0
    for _ in range(40 * vehicles):
        if number == vehicles:
            break
        kind = int(rng.choice(len(shapes.types), p=shapes.share))
        rest = np.append(shapes.rest[kind], 0.0)[:, None] * rng.normal(size=shapes.mean[kind].shape)
        own = np.tensordot(rng.normal(size=len(shapes.directions[kind])), shapes.directions[kind], axes=1)
        shape = (shapes.mean[kind] + own + rest)[: keypoints.K]
        yaw = float(rng.choice([0.0, math.pi]) + camera.angles[0] + rng.normal(0, 0.4))
        R = np.array([[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]])
        _, places = road(camera)
        begin = places[rng.integers(len(places))] - R[:, 0] * rng.uniform(0, 10)
        seen = [_sighting(camera, shapes, kind, shape, R, begin + 5.0 * k * R[:, 0], rng) for k in range(moments)]
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
    points = shape @ R.T + place + [0, 0, rng.normal(0, UNEVEN_M)]
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


def from_vehicles(camera: Camera, rng: np.random.Generator, vehicles: int) -> UncertainCamera:
    """The camera that vehicles tell, as `skope eval camera` finds it. Raises UserError where it would refuse."""
    views = vehicle_views(camera, rng, vehicles)
    fit = fit_camera(views)
    boxes = [(np.ptp(view[:, 0]) / 2 + view[:, 0].min(), view[:, 1].max()) for view in views.found]
    if reason := why_not(fit, np.array(boxes)):
        raise UserError(reason)
    return UncertainCamera.from_dict(fit.camera, {"of": list(CAMERA), "matrix": fit.covariance.tolist()})


def held(camera: Camera, calibration: UncertainCamera, *, gauge: bool = False) -> tuple[float, float]:
    """Share of places within the stated error, and the median error, metres.

    With `gauge` the world of the calibration begins under its camera: distances between places are compared.
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
    """A line for each camera."""
    for k, row in enumerate(cameras):
        rng = np.random.default_rng(k)
        shares, errors, refused = [], [], 0
        for _ in range(count):
            camera = true_camera(*row, rng)
            try:
                share, error = held(camera, calibrate(make(camera, rng)), gauge=gauge)
            except UserError:
                refused += 1
                continue
            shares.append(share)
            errors.append(error)
        told = f"{np.mean(shares):.2f} within, median error {np.median(errors):.2f} m" if shares else "none"
        yield f"  camera {k + 1}: {told}, {refused} refused"


def together(cameras: Cameras, count: int, vehicles: int) -> Iterator[str]:
    """Each part and all of them, of the same draws; a line for each camera, and the means over the cameras."""
    parts = ("6 points", "lengths and parallel lines", "vehicles", "together")
    table: dict[str, list[float]] = {name: [] for name in parts}
    for k, row in enumerate(cameras):
        rng = np.random.default_rng(200 + k)
        of_camera: dict[str, list[tuple[float, float]]] = {name: [] for name in parts}
        for _ in range(count):
            camera = true_camera(*row, rng)
            marked, measured = points(camera, 6, rng), lengths_and_parallels(camera, rng)
            told = _told_by_vehicles(camera, rng, vehicles)
            if told:
                of_camera["vehicles"].append(held(camera, told, gauge=True))
            whole = replace(measured, points=marked, beliefs=(told.belief("vehicles"),) if told else ())
            for name, evidence, gauge in (
                ("6 points", Evidence(SIZE, points=marked), False),
                ("lengths and parallel lines", measured, True),
                ("together", whole, False),
            ):
                try:
                    of_camera[name].append(held(camera, calibrate(evidence), gauge=gauge))
                except UserError:
                    continue
        said = []
        for name, rows in of_camera.items():
            if rows:
                share, error = (float(v) for v in (np.mean([r[0] for r in rows]), np.mean([r[1] for r in rows])))
                table[name].append(error)
                said.append(f"{name} {error:.3f} m, {share:.2f} within, {count - len(rows)} refused")
            else:
                said.append(f"{name} refused")
        yield f"  camera {k + 1}: {'; '.join(said)}"
    means = [f"{name} {np.mean(errors):.3f} m ({len(errors)} cameras)" for name, errors in table.items() if errors]
    yield f"  mean over the cameras of the median error: {'; '.join(means)}"


def _told_by_vehicles(camera: Camera, rng: np.random.Generator, vehicles: int) -> UncertainCamera | None:
    try:
        return from_vehicles(camera, rng, vehicles)
    except UserError:
        return None


def found_wrong(count: int, cameras: Cameras, draws: int) -> str:
    """How often the wrong one of `count` points is left out, or named among those that may be wrong."""
    left_out = named = total = 0
    shares = []
    for k, row in enumerate(cameras):
        rng = np.random.default_rng(100 + k)
        for _ in range(draws):
            camera = true_camera(*row, rng)
            found = calibrate(Evidence(SIZE, points=points(camera, count, rng, wrong=True)))
            doubted = {word.strip(":;,") for words in found.warnings if "mark" in words for word in words.split()}
            left_out, total = left_out + (found.outliers == ("1",)), total + 1
            named += found.outliers == ("1",) or "1" in doubted
            shares.append(held(camera, found)[0])
    return (
        f"one of {count} points wrong: of {total} it is left out in {left_out}, it or another it may be in {named}; "
        f"{np.mean(shares):.2f} of the places within"
    )


def _marked(count: int, camera: Camera, rng: np.random.Generator) -> Evidence:
    return Evidence(SIZE, points=points(camera, count, rng))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=100)
    parser.add_argument("--cameras", type=int, default=len(CAMERAS))
    parser.add_argument("--vehicle-draws", type=int, default=4, help="draws of vehicles and of all together")
    parser.add_argument("--vehicles", type=int, default=25, help="vehicles of a draw")
    parser.add_argument("--others", type=int, metavar="SEED", help="eight cameras drawn by this seed in their place")
    options = parser.parse_args()
    cameras = CAMERAS if options.others is None else tuple(other_cameras(np.random.default_rng(options.others)))
    cameras = cameras[: options.cameras]
    for count in (4, 6, 10):
        print(f"{count} points", flush=True)
        marked = partial(_marked, count)
        for line in draws(marked, cameras, options.draws):
            print(line, flush=True)
    for count in (6, 8):
        print(found_wrong(count, cameras, options.draws), flush=True)
    print("lengths and parallel lines alone", flush=True)
    for line in draws(lengths_and_parallels, cameras, options.draws, gauge=True):
        print(line, flush=True)
    print("the same draws: each part, and all together", flush=True)
    for line in together(cameras, options.vehicle_draws, options.vehicles):
        print(line, flush=True)


if __name__ == "__main__":
    main()
