"""Errors of cameras that are estimated from vehicles, and of positions and speeds when a camera shakes.

    skope gen --preset world --recordings 4 --frames 600 --interval 0.2 --seed 888 --no-depth --out data
    skope eval --data data --checkpoint road33 --split train --fast --score 0.3 --out seen
    python scripts/research/camera_errors.py vehicles data/annotations/train.json \\
        --predictions seen/predictions_train.json

    skope gen --preset demo --sites t01_main_west --frames 100 --recordings 1 --interval 0.1 --size 1280x720 \\
        --weather clear --time-of-day noon --no-depth --out street
    python scripts/research/camera_errors.py shake street/annotations/medium.json --images street

`vehicles`: a line for each generated recording, whose camera is known: the truth, the estimate, its error in its own
standard deviations, and the errors of distances (of vehicles from the camera's foot, and travelled distances of at
least five metres). The last lines summarise. Without --predictions the labels' keypoints are used, with a pixel of
noise. --broken simulates faults that a camera from vehicles cannot handle, and shows how often they are rejected:
`bend` and `bend-little` bend the image like another lens, `crop` moves it by a fifth of its width and a seventh of its
height, `stretch` squeezes it to three quarters of its width, `noise` moves keypoints by a twentieth of their boxes,
`swap` exchanges front and rear in three of ten detections.

`shake`: a camera of 640x360 and 80 degrees sees each generated image. It is turned frame by frame, which is exact:
its rays are looked up in the wider image. Images are compressed like those of a stream, and the motion is measured as
`skope eval predict` does. Keypoints are the true ones with noise of a pixel. The amplitude of the shake is the given
one across (period 1.3 s) and 0.4 of it up and down (0.8 s); the camera also rolls. In the last row the camera is moved
by 40 px halfway. Errors are those of the camera at rest. In the last column the camera was calibrated at a moment of
its shake (five of them): the share of positions within the stated 90% error.
"""

import argparse
import math
import sys
import tempfile
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from skope.camera.fit.camera_doubts import rejection_reason, sigma_of_ways
from skope.camera.fit.camera_unknowns import FOCAL, HEIGHT, PITCH, on_road
from skope.camera.fit.fit_camera import fit_camera_to_vehicles
from skope.camera.fit.vehicle_sample import sample_vehicles
from skope.camera.model import Camera
from skope.camera.motion.camera_motion import MOTION_KEY, turned_camera
from skope.camera.motion.camera_shake import CameraShakeEstimator, record_of
from skope.camera.motion.view_changes import ViewSamples
from skope.camera.uncertain_camera import UNCERTAINTY_LIMITS, radius_of
from skope.confidence_level import INTERVAL_SIGMAS
from skope.dataset import coco
from skope.dataset.folder import CHANGES_KEY, read_image
from skope.dataset.image_selection import part
from skope.errors import UserError
from skope.footage.confirmation import Confirmation
from skope.keypoints import FLIP, OTHER_END
from skope.pose.camera_error import with_camera_error
from skope.pose.keypoint_views import Scene, read_scene
from skope.pose.pose_records import locate_view
from skope.schema import Annotation, AnnotationFile, Image, Result
from skope.tracking.tracker_inputs import detections_of
from skope.tracking.vehicle_tracker import track_vehicles
from skope.types import Array

CONFIRMED_SCORE = 0.5
LONG_M = 5.0
FARTHEST_M = 100.0
BROKEN_NOISE = 0.05
SWAPPED = 0.3
TURNED = np.array([FLIP[i] for i in OTHER_END])
Warp = Callable[[Array], Array]
"""Moves (P, 2) pixels."""


@dataclass(frozen=True)
class Row:
    """Errors of an estimated camera."""

    off: Array
    """(3,) errors of log focal length, tilt (radians) and log height."""
    sigmas: Array
    """(3,) the same errors in standard deviations."""
    distances: Array
    """Errors of the logarithms of distances from the camera's foot."""
    ways: Array
    """Errors of the logarithms of travelled distances."""


def recordings(file: AnnotationFile) -> Iterator[tuple[str, AnnotationFile]]:
    groups = defaultdict(list)
    for image in file.images:
        groups[f"{image.site or file.name} {image.recording or ''}".strip()].append(image)
    for name, images in sorted(groups.items()):
        yield name, part(file, images)


def named(file: AnnotationFile, results: Sequence[Result]) -> list[Result]:
    """Return the detections that other frames confirm, with track numbers, as `skope eval predict` writes them."""
    by_image = defaultdict(list)
    for result in results:
        by_image[result.image_id].append(result)
    confirmation, found = Confirmation(CONFIRMED_SCORE), []
    for image in file.images:
        assert image.time_s is not None
        confirmation.add(image.time_s, by_image[image.id])
        found += by_image[image.id]
    numbers = np.concatenate(confirmation.confirmed()) if found else np.zeros(0)
    return [replace(detection, track_id=int(n)) for detection, n in zip(found, numbers.tolist(), strict=True) if n >= 0]


def places_on_road(file: AnnotationFile, camera: Camera) -> dict[int, Array]:
    """Return the positions of each track on the road that the camera sees, in world coordinates."""
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
    """Return the motion of an image's pixels for each fault of `--broken`."""
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
    """Return a detection with that fault."""
    points = result.keypoints.copy()
    if how == "noise":
        points[:, :2] += rng.normal(0, BROKEN_NOISE, (len(points), 2)) * result.bbox[2:]
    elif how == "swap" and rng.random() < SWAPPED:
        points = points[TURNED]
    points[:, :2] = warp(points[:, :2])
    x, y, width, height = result.bbox
    corners = warp(np.array([[x, y], [x + width, y], [x, y + height], [x + width, y + height]]))
    return replace(result, keypoints=points, bbox=np.concatenate([corners.min(0), np.ptp(corners, axis=0)]))


def judged(estimate: Camera, camera: Camera, places: dict[int, Array], warp: Warp) -> tuple[Array, Array]:
    """Return errors of the logarithms of distances from the camera's foot, and of travelled distances."""
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
    summary = f"{name:24s} focal {focal:5.0f} tilt {tilt:5.1f} height {height:5.1f}"
    bare = replace(file, annotations=() if results is not None else file.annotations)
    scene = Scene(bare, None if results is None else tuple(results), None, None)
    try:
        drawn = sample_vehicles(scene, 40, score=0.9, noise=1.0 if results is None else 0.0, sigma_px=None)
        estimate = fit_camera_to_vehicles(drawn.views)
        reason = rejection_reason(estimate, drawn.lower_edges)
    except UserError as error:
        reason = str(error)
    if reason:
        print(f"{summary}: rejected: {reason}", flush=True)
        return None
    unknowns = estimate.solved.bundle.camera[[FOCAL, PITCH, HEIGHT]]
    sigma = np.sqrt(np.diag(estimate.covariance))[[FOCAL, PITCH, HEIGHT]]
    row = Row(unknowns - truth, np.abs(unknowns - truth) / sigma, *judged(estimate.camera, camera, places, warp))
    print(
        f"{summary}: {estimate.vehicles} vehicles, focal x{math.exp(row.off[0]):.2f} "
        f"tilt {math.degrees(row.off[1]):+.1f} height x{math.exp(row.off[2]):.2f} "
        f"(in sigmas {' '.join(f'{v:.1f}' for v in row.sigmas)}), distances {np.median(row.distances):+.1%} "
        f"travelled distances {np.median(row.ways) if row.ways.size else 0.0:+.1%}, stated within "
        f"{INTERVAL_SIGMAS * sigma_of_ways(estimate):.0%}",
        flush=True,
    )
    return row


SIZE = (640, 360)
FOV_DEG = 80.0
NOISE_PX = 1.0
QUALITY = 85
SHAKES_PX = (0.0, 0.2, 1.0, 3.0, 10.0)
BUMP_PX = 40.0
SLOWEST = 2.0
"""Lowest speed of the vehicles whose speeds are compared, m/s."""
MOMENTS = 5


@dataclass(frozen=True)
class Shaken:
    """Footage of a camera that is turned frame by frame."""

    file: AnnotationFile
    turns: list[Camera]
    """The camera in each frame."""
    motion_text: str
    """The measured motion."""


def moves(
    count: int, times_s: Sequence[float], shake_px: float, bump_px: float
) -> Iterator[tuple[float, float, float]]:
    """Yield the shift (pixels) and turn (radians) of each frame."""
    for k, time_s in enumerate(times_s):
        across, down = math.sin(2 * math.pi * time_s / 1.3), math.sin(2 * math.pi * time_s / 0.8 + 1)
        roll = 3e-4 * shake_px * math.sin(2 * math.pi * time_s / 1.1 + 2)
        yield shake_px * across + (bump_px if 2 * k >= count else 0.0), 0.4 * shake_px * down, roll


def at_rest(wide: Camera) -> Camera:
    """Return a narrower camera at the position of a generated one."""
    focal = SIZE[0] / 2 / math.tan(math.radians(FOV_DEG) / 2)
    K = np.array([[focal, 0, SIZE[0] / 2], [0, focal, SIZE[1] / 2], [0, 0, 1]])
    return Camera(*SIZE, K, wide.T_camera_world)


def seen_by(camera: Camera, wide: Camera, pixels: np.ndarray) -> np.ndarray:
    """Return the image of a camera, computed from the image of a wider one at the same position, and compressed."""
    u, v = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    rays = camera.rays(np.stack([u, v], axis=-1).reshape(-1, 2))[0] @ camera.T_camera_world[:3, :3]
    at = wide.project(wide.position + rays)[0].reshape(SIZE[1], SIZE[0], 2).astype(np.float32) - np.float32(0.5)
    picture = cv2.remap(pixels, at[..., 0], at[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    _, encoded = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    return np.ascontiguousarray(cv2.imdecode(encoded, cv2.IMREAD_COLOR)[..., ::-1])


def labelled(a: Annotation, wide: Camera, camera: Camera) -> Annotation | None:
    """Return a vehicle in the image of a turned camera; None if too little of it is visible."""
    rays = wide.rays(a.keypoints[:, :2])[0] @ wide.T_camera_world[:3, :3]
    pixels, _, valid = camera.project(camera.position + rays)
    shown = valid & camera.inside(pixels) & (a.keypoints[:, 2] == 2)
    if shown.sum() < 8:
        return None
    known = valid & (a.keypoints[:, 2] > 0)
    low, high = pixels[known].min(axis=0), pixels[known].max(axis=0)
    return replace(
        a,
        bbox=np.concatenate([low, high - low]),
        keypoints=np.where(shown[:, None], np.column_stack([pixels, np.full(len(pixels), 2.0)]), 0.0),
        segmentation=None,
        bbox_visible=None,
        box_3d_pixels=None,
    )


def shaken(file: AnnotationFile, pictures: "Pictures", shake_px: float, bump_px: float) -> Shaken:
    """Return the footage of a shaking camera with its labels, and its measured motion."""
    wide = file.images[0].camera
    assert wide is not None
    rest = at_rest(wide)
    times = [image.time_s or 0.0 for image in file.images]
    turns = [turned_camera(rest, *move) for move in moves(len(times), times, shake_px, bump_px)]
    watch, looks = CameraShakeEstimator(), ViewSamples()
    images = [replace(image, width=SIZE[0], height=SIZE[1], camera=rest) for image in file.images]
    frames = ((image, seen_by(turn, wide, pictures(image))) for image, turn in zip(images, turns, strict=True))
    for _ in looks.watch(watch.watch(frames)):
        pass
    record = record_of(images, (watch.taken(image.id) for image in images), SIZE[0])
    seconds = {image.id: time_s for image, time_s in zip(images, times, strict=True)}
    changes = record.view_changes([(seconds[number], look) for number, look in looks.taken.items()])
    motion = record.motion(changes)
    by_image = file.by_image()
    labels = [
        made
        for image, turn in zip(images, turns, strict=True)
        for a in by_image[image.id]
        if not a.ignored and (made := labelled(a, wide, turn)) is not None
    ]
    info = {
        **({CHANGES_KEY: [change.to_dict() for change in changes]} if changes else {}),
        **({MOTION_KEY: motion.to_dict()} if motion else {}),
    }
    motion_text = f"{motion.median_px:.2f} px" if motion else "still"
    motion_text += "".join(f", moved at {change.time_s:.1f} s" for change in changes)
    return Shaken(AnnotationFile(images=tuple(images), annotations=tuple(labels), info=info), turns, motion_text)


@dataclass(frozen=True)
class Errors:
    """Errors of positions (m) and speeds (m/s).

    `within`: whether positions are within the stated 90% error. `without`: number of views without a position.
    """

    places: Array
    speeds: Array
    within: Array
    without: int

    def __str__(self) -> str:
        def interval_text(values: Array, unit: str) -> str:
            if not len(values):
                return "-"
            return f"{np.median(values):.2f} {unit} (90%: {np.percentile(values, 90):.2f})"

        return f"{interval_text(self.places, 'm')} | {interval_text(self.speeds, 'm/s')}"


def errors_of(scene: Scene) -> Errors:
    """Compare positions and speeds with the labels."""
    times = [image.time_s or 0.0 for image in scene.file.images]
    places, within, without, found = list[float](), list[bool](), 0, []
    for view in scene.views(noise=NOISE_PX):
        located = locate_view(view, scene)
        found.append(detections_of(located, linked=False))
        known = scene.known_in(view.image)
        poses = with_camera_error(located.poses, known, scene.road_in(view.image)) if known else located.poses
        for i, good in enumerate(located.good):
            truth = view.truth[i]
            if not good or truth is None or truth.box_3d is None:
                without += not good
                continue
            off = float(np.linalg.norm((poses.position[i] - truth.box_3d.center)[:2]))
            places.append(off)
            within.append(off <= float(radius_of(poses.covariance[i, :2, :2], UNCERTAINTY_LIMITS.position_coverage)))
    labels = {(a.image_id, a.track_id): a for a in scene.file.annotations}
    ids = [image.id for image in scene.file.images]
    speeds = []
    for track in track_vehicles(found, times):
        for frame, number, speed in zip(track.frames, track.truth_ids.tolist(), track.speed, strict=True):
            label = labels.get((ids[frame], number))
            if label is not None and label.velocity is not None and np.linalg.norm(label.velocity) >= SLOWEST:
                speeds.append(abs(float(speed) - float(np.linalg.norm(label.velocity))))
    return Errors(np.array(places), np.array(speeds), np.array(within), without)


def scene_of(file: AnnotationFile, folder: Path, camera: Camera | None = None) -> Scene:
    """Read a scene as the commands do; `camera` replaces its calibrated camera."""
    if camera is not None:
        file = replace(file, images=tuple(replace(image, camera=camera) for image in file.images))
    path = folder / "labels.json"
    coco.write(path, file)
    return read_scene(None, path, None, None, 0.0)


def row(footage: Shaken, name: str) -> str:
    """Format a row of the table."""
    bare = replace(footage.file, info={})
    with tempfile.TemporaryDirectory() as folder:
        kept, left = (errors_of(scene_of(file, Path(folder))) for file in (bare, footage.file))
        within = []
        # For a camera that is knocked, the calibrations come from the first half.
        for k in np.linspace(0, 0.45 * len(footage.turns), MOMENTS).astype(int):
            scene = scene_of(footage.file, Path(folder), footage.turns[k])
            within += errors_of(scene).within.tolist()
    share = f"{np.mean(within):.0%}" if within else "-"
    return f"| {name} | {footage.motion_text} | {kept} | {left} | {left.without} | {share} |"


class Pictures:
    """Pictures of the images in a file, from their folder, or the same picture for all."""

    def __init__(self, folder: Path | None, picture: Path | None, size: tuple[int, int]) -> None:
        self._folder, self._size = folder, size
        self._picture = None if picture is None else cv2.resize(read_image(picture), size, interpolation=cv2.INTER_AREA)

    def __call__(self, image: Image) -> np.ndarray:
        if self._picture is not None:
            return self._picture
        assert self._folder is not None
        return read_image(self._folder / image.file_name)


def vehicles_table(options: argparse.Namespace) -> None:
    """Print a line for each recording, and the summary."""
    if options.broken and not options.predictions:
        sys.exit("--broken needs --predictions")
    file = coco.read(options.annotations)
    results = coco.read_results(options.predictions) if options.predictions else None
    by_image: dict[int, list[Result]] = defaultdict(list)
    for result in results or ():
        by_image[result.image_id].append(result)
    rows, count = [], 0
    for name, recording in recordings(file):
        count += 1
        recording_results = [detection for image in recording.images for detection in by_image[image.id]]
        rows.append(
            measure(name, recording, None if results is None else named(recording, recording_results), options.broken)
        )
    answered = [row for row in rows if row is not None]
    print(f"{len(answered)} of {count} cameras answered")
    if answered:
        focal = np.abs([row.off[0] for row in answered])
        distance = np.abs([np.median(row.distances) for row in answered if row.distances.size])
        way = np.abs([np.median(row.ways) for row in answered if row.ways.size])
        for quantity, errors in (("focal length", focal), ("distances", distance), ("travelled distances", way)):
            if len(errors):
                print(f"{quantity}: median error {np.median(errors):.1%}, 90% within {np.percentile(errors, 90):.1%}")
        inside = np.mean([row.sigmas < 2 for row in answered], axis=0)
        print(f"95% intervals cover the truth: focal {inside[0]:.0%}, tilt {inside[1]:.0%}, height {inside[2]:.0%}")


def shake_table(options: argparse.Namespace) -> None:
    """Print a row for each amplitude, and one with a moved camera."""
    file = coco.read(options.annotations)
    first = file.images[0]
    pictures = Pictures(options.images, options.picture, (first.width, first.height))
    print("| shake | measured | positions, uncorrected | speeds, uncorrected | positions | speeds ", end="")
    print("| without position | within 90% |")
    print("|---|---|---|---|---|---|---|---|")
    for shake_px in SHAKES_PX:
        print(row(shaken(file, pictures, shake_px, 0.0), f"{shake_px:g} px"), flush=True)
    print(row(shaken(file, pictures, 1.0, BUMP_PX), f"1 px, and {BUMP_PX:g} px halfway"), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    vehicles = commands.add_parser("vehicles", help="cameras that are estimated from vehicles")
    vehicles.add_argument("annotations", type=Path, help="labels of generated recordings, with their cameras")
    vehicles.add_argument("--predictions", type=Path, help="COCO results for them, instead of noisy labels")
    faults = (*warps(2, 2), "noise", "swap")
    vehicles.add_argument("--broken", choices=faults, default="", help="simulate this fault in --predictions")
    vehicles.set_defaults(run=vehicles_table)
    shake = commands.add_parser("shake", help="positions and speeds when a camera shakes")
    shake.add_argument("annotations", type=Path, help="labels of a generated recording, with its camera")
    where = shake.add_mutually_exclusive_group(required=True)
    where.add_argument("--images", type=Path, help="folder of the labels' images")
    where.add_argument("--picture", type=Path, help="one image of an empty road, used for all")
    shake.set_defaults(run=shake_table)
    options = parser.parse_args()
    options.run(options)


if __name__ == "__main__":
    main()
