"""How far cameras that are worked out from vehicles are off: generated recordings, whose cameras are known.

    skope gen --preset world --recordings 4 --frames 600 --interval 0.2 --seed 888 --no-depth --out data
    skope eval --data data --checkpoint road33 --split train --fast --score 0.3 --out seen
    python scripts/research/camera_errors.py data/annotations/train.json --predictions seen/predictions_train.json

A line for each recording: what is true, what came out, in how many of its own standard deviations that is off, and how
far off distances are: of vehicles from the camera's foot, and of ways that they drive, of five metres or more. The last
line sums up. Without --predictions the labels' keypoints are taken, with a pixel of noise.

--broken takes what no camera from vehicles can know, and shows how often it is refused: `bend` and `bend-little` bend
the image as one more lens would, `crop` moves it by a fifth of its width and a seventh of its height, `stretch`
squeezes it to three quarters of its width, `noise` moves keypoints by a twentieth of their boxes, `swap` takes the
front for the rear in three of ten detections.
"""

import argparse
import math
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from skope.camera.fit.camera_doubts import sigma_of_ways, why_not
from skope.camera.fit.camera_unknowns import FOCAL, HEIGHT, PITCH, on_road
from skope.camera.fit.fit_camera import fit_camera_to_vehicles
from skope.camera.fit.vehicle_sample import sample_vehicles
from skope.camera.model import Camera
from skope.dataset import coco
from skope.dataset.image_selection import part
from skope.errors import UserError
from skope.footage.confirmation import Confirmation
from skope.keypoints import FLIP, OTHER_END
from skope.pose.keypoint_views import Scene
from skope.schema import AnnotationFile, Result
from skope.types import Array

SCORE = 0.5
LONG_M = 5.0
FARTHEST_M = 100.0
NOISE = 0.05
SWAPPED = 0.3
TURNED = np.array([FLIP[i] for i in OTHER_END])
Warp = Callable[[Array], Array]
"""Moves (P, 2) pixels."""


@dataclass(frozen=True)
class Row:
    """A camera that was answered."""

    off: Array
    """(3,) errors of log focal length, tilt (radians) and log height."""
    sigmas: Array
    """(3,) the same in standard deviations."""
    distances: Array
    """Errors of the logarithms of distances from the camera's foot."""
    ways: Array
    """The same of ways driven."""


def recordings(file: AnnotationFile) -> Iterator[tuple[str, AnnotationFile]]:
    groups = defaultdict(list)
    for image in file.images:
        groups[f"{image.site or file.name} {image.recording or ''}".strip()].append(image)
    for name, images in sorted(groups.items()):
        yield name, part(file, images)


def named(file: AnnotationFile, results: Sequence[Result]) -> list[Result]:
    """What the frames confirm of each other, with the numbers of the vehicles, as `skope eval predict` writes it."""
    by_image = defaultdict(list)
    for result in results:
        by_image[result.image_id].append(result)
    confirmation, found = Confirmation(SCORE), []
    for image in file.images:
        assert image.time_s is not None
        confirmation.add(image.time_s, by_image[image.id])
        found += by_image[image.id]
    numbers = np.concatenate(confirmation.confirmed()) if found else np.zeros(0)
    return [replace(one, track_id=int(n)) for one, n in zip(found, numbers.tolist(), strict=True) if n >= 0]


def places_on_road(file: AnnotationFile, camera: Camera) -> dict[int, Array]:
    """Of each track the places on the road that the camera sees, world."""
    places = defaultdict(list)
    for a in file.annotations:
        if a.box_3d is not None and a.track_id is not None and not a.ignored:
            places[a.track_id].append(a.box_3d.center - [0, 0, a.box_3d.size_lwh[2] / 2])
    out = {}
    for number, points in places.items():
        xyz = np.array(points)
        pixels, _, valid = camera.project(xyz)
        near = np.linalg.norm(xyz - camera.position, axis=1) < FARTHEST_M
        if (seen := valid & near & camera.inside(pixels)).any():
            out[number] = xyz[seen]
    return out


def warps(width: int, height: int) -> dict[str, Warp]:
    """What `--broken` does to an image's pixels."""
    middle = np.array([width / 2, height / 2])

    def bend(k: float) -> Warp:
        def bent(pixels: Array) -> Array:
            away = (pixels - middle) / (width / 2)
            return middle + away * (1 + k * np.minimum((away**2).sum(1, keepdims=True), 2.0)) * (width / 2)

        return bent

    return {
        "bend": bend(-0.25),
        "bend-little": bend(-0.1),
        "crop": lambda pixels: pixels + [0.2 * width, 0.15 * height],
        "stretch": lambda pixels: middle + (pixels - middle) * [0.75, 1.0],
    }


def broken(result: Result, how: str, warp: Warp, rng: np.random.Generator) -> Result:
    """A detection as it would be with that fault."""
    points = result.keypoints.copy()
    if how == "noise":
        points[:, :2] += rng.normal(0, NOISE, (len(points), 2)) * result.bbox[2:]
    elif how == "swap" and rng.random() < SWAPPED:
        points = points[TURNED]
    points[:, :2] = warp(points[:, :2])
    x, y, width, height = result.bbox
    corners = warp(np.array([[x, y], [x + width, y], [x, y + height], [x + width, y + height]]))
    return replace(result, keypoints=points, bbox=np.concatenate([corners.min(0), np.ptp(corners, axis=0)]))


def judged(estimate: Camera, camera: Camera, places: dict[int, Array], warp: Warp) -> tuple[Array, Array]:
    """Errors of the logarithms of distances from the camera's foot, and of ways driven."""
    distances, ways = [], []
    for xyz in places.values():
        found = on_road(estimate, warp(camera.project(xyz)[0]))
        true = xyz[:, :2] - camera.position[:2]
        distances += np.log(np.linalg.norm(found, axis=1) / np.linalg.norm(true, axis=1)).tolist()
        begin = 0
        for end in range(1, len(xyz)):
            if (way := np.linalg.norm(true[end] - true[begin])) >= LONG_M:
                ways.append(math.log(max(float(np.linalg.norm(found[end] - found[begin])), 1e-9) / float(way)))
                begin = end
    return np.array(distances), np.array(ways)


def measure(name: str, file: AnnotationFile, results: list[Result] | None, how: str) -> Row | None:
    camera = file.images[0].camera
    assert camera is not None
    warp = warps(camera.width, camera.height).get(how, lambda pixels: pixels)
    if results is not None and how:
        rng = np.random.default_rng(0)
        results = [broken(result, how, warp, rng) for result in results]
    places = places_on_road(file, camera)
    level = float(np.median(np.concatenate([xyz[:, 2] for xyz in places.values()]))) if places else 0.0
    truth = np.array([math.log(camera.K[0, 0]), camera.angles[1], math.log(camera.position[2] - level)])
    focal, tilt, height = math.exp(truth[0]), math.degrees(truth[1]), math.exp(truth[2])
    said = f"{name:24s} focal {focal:5.0f} tilt {tilt:5.1f} height {height:5.1f}"
    bare = replace(file, annotations=() if results is not None else file.annotations)
    scene = Scene(bare, None if results is None else tuple(results), None, None)
    try:
        drawn = sample_vehicles(scene, 40, score=0.9, noise=1.0 if results is None else 0.0, sigma_px=None)
        estimate = fit_camera_to_vehicles(drawn.views)
        reason = why_not(estimate, drawn.lower_edges)
    except UserError as error:
        reason = str(error)
    if reason:
        print(f"{said}: refused: {reason}", flush=True)
        return None
    unknowns = estimate.solved.bundle.camera[[FOCAL, PITCH, HEIGHT]]
    sigma = np.sqrt(np.diag(estimate.covariance))[[FOCAL, PITCH, HEIGHT]]
    row = Row(unknowns - truth, np.abs(unknowns - truth) / sigma, *judged(estimate.camera, camera, places, warp))
    print(
        f"{said}: {estimate.vehicles} vehicles, focal x{math.exp(row.off[0]):.2f} tilt {math.degrees(row.off[1]):+.1f} "
        f"height x{math.exp(row.off[2]):.2f} (in sigmas {' '.join(f'{v:.1f}' for v in row.sigmas)}), distances "
        f"{np.median(row.distances):+.1%} ways {np.median(row.ways) if row.ways.size else 0.0:+.1%}, said within "
        f"{2 * sigma_of_ways(estimate):.0%}",
        flush=True,
    )
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("annotations", type=Path, help="labels of generated recordings, with their cameras")
    parser.add_argument("--predictions", type=Path, help="COCO results for them, in place of noisy labels")
    parser.add_argument(
        "--broken", choices=(*warps(2, 2), "noise", "swap"), default="", help="a fault of --predictions"
    )
    options = parser.parse_args()
    if options.broken and not options.predictions:
        parser.error("--broken needs --predictions")
    file = coco.read(options.annotations)
    results = coco.read_results(options.predictions) if options.predictions else None
    by_image: dict[int, list[Result]] = defaultdict(list)
    for result in results or ():
        by_image[result.image_id].append(result)
    rows, count = [], 0
    for name, recording in recordings(file):
        count += 1
        own = [one for image in recording.images for one in by_image[image.id]]
        rows.append(measure(name, recording, None if results is None else named(recording, own), options.broken))
    answered = [row for row in rows if row is not None]
    print(f"{len(answered)} of {count} cameras answered")
    if answered:
        focal = np.abs([row.off[0] for row in answered])
        distance = np.abs([np.median(row.distances) for row in answered if row.distances.size])
        way = np.abs([np.median(row.ways) for row in answered if row.ways.size])
        for what, errors in (("focal length", focal), ("distances", distance), ("ways", way)):
            if len(errors):
                print(f"{what}: {np.median(errors):.1%} off in the median, 90% within {np.percentile(errors, 90):.1%}")
        inside = np.mean([row.sigmas < 2 for row in answered], axis=0)
        print(f"95% intervals hold the truth: focal {inside[0]:.0%}, tilt {inside[1]:.0%}, height {inside[2]:.0%}")


if __name__ == "__main__":
    main()
