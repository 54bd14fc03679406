"""How far places and speeds are off when a camera sways or is knocked, with its sway taken out and without.

    skope gen --preset demo --sites t01_main_west --frames 100 --recordings 1 --interval 0.1 --size 1280x720 \\
        --weather clear --time-of-day noon --no-depth --out data
    python scripts/research/camera_sway.py data/annotations/medium.json --images data

Each generated picture is seen by a camera of 640x360 and 80 degrees at the same place that is turned frame by frame,
which is exact: rays of the one are looked up in the other. Pictures are compressed as a stream's are, and measured as
`skope eval predict` measures them. Keypoints are the true ones of that frame with noise of a pixel, in place of a
detector's. Sways are amplitudes of 1.3 s across and 0.8 s up and down (0.4 of it), with a roll; in the last row the
camera is knocked by 40 px halfway. Errors are of the camera at rest; in the last column the camera was calibrated at a
moment of its sway (five of them), and places are within the stated 90% error so often.
"""

import argparse
import math
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from skope.camera.model import Camera
from skope.camera.motion.camera_motion import MOTION_KEY, turned_camera
from skope.camera.motion.camera_shake import SwayWatch, record_of
from skope.camera.motion.view_changes import Looks
from skope.camera.uncertain_camera import UNCERTAINTY, radius_of
from skope.dataset import coco
from skope.dataset.folder import CHANGES_KEY, read_image
from skope.pose.camera_error import with_camera_error
from skope.pose.keypoint_views import Scene, read_scene
from skope.pose.pose_records import locate_view
from skope.schema import Annotation, AnnotationFile, Image
from skope.tracking.tracker_inputs import detections_of
from skope.tracking.vehicle_tracker import follow
from skope.types import Array

SIZE = (640, 360)
FOV_DEG = 80.0
NOISE_PX = 1.0
QUALITY = 85
SWAYS_PX = (0.0, 0.2, 1.0, 3.0, 10.0)
BUMP_PX = 40.0
SLOWEST = 2.0
"""Speeds are compared of vehicles that drive as fast as this, m/s."""
MOMENTS = 5


@dataclass(frozen=True)
class Shaken:
    """What a camera that is turned frame by frame has seen."""

    file: AnnotationFile
    turns: list[Camera]
    """The camera in each frame."""
    said: str
    """What was measured of its motion."""


def moves(count: int, times_s: Sequence[float], sway_px: float, bump_px: float) -> Iterator[tuple[float, float, float]]:
    """Shift (pixels) and turn (radians) of each frame."""
    for k, time_s in enumerate(times_s):
        across, down = math.sin(2 * math.pi * time_s / 1.3), math.sin(2 * math.pi * time_s / 0.8 + 1)
        roll = 3e-4 * sway_px * math.sin(2 * math.pi * time_s / 1.1 + 2)
        yield sway_px * across + (bump_px if 2 * k >= count else 0.0), 0.4 * sway_px * down, roll


def at_rest(wide: Camera) -> Camera:
    """A narrower camera at the place of a generated one."""
    focal = SIZE[0] / 2 / math.tan(math.radians(FOV_DEG) / 2)
    K = np.array([[focal, 0, SIZE[0] / 2], [0, focal, SIZE[1] / 2], [0, 0, 1]])
    return Camera(*SIZE, K, wide.T_camera_world)


def seen_by(camera: Camera, wide: Camera, pixels: np.ndarray) -> np.ndarray:
    """What a camera sees of the picture of a wider one at the same place, compressed."""
    u, v = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    rays = camera.rays(np.stack([u, v], axis=-1).reshape(-1, 2))[0] @ camera.T_camera_world[:3, :3]
    at = wide.project(wide.position + rays)[0].reshape(SIZE[1], SIZE[0], 2).astype(np.float32) - np.float32(0.5)
    picture = cv2.remap(pixels, at[..., 0], at[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    _, encoded = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    return np.ascontiguousarray(cv2.imdecode(encoded, cv2.IMREAD_COLOR)[..., ::-1])


def labelled(a: Annotation, wide: Camera, camera: Camera) -> Annotation | None:
    """A vehicle as a turned camera shows it; None where that shows too little of it."""
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


def shaken(file: AnnotationFile, pictures: "Pictures", sway_px: float, bump_px: float) -> Shaken:
    """The footage of a swaying camera with its labels, and what was measured of its motion."""
    wide = file.images[0].camera
    assert wide is not None
    rest = at_rest(wide)
    times = [image.time_s or 0.0 for image in file.images]
    turns = [turned_camera(rest, *move) for move in moves(len(times), times, sway_px, bump_px)]
    watch, looks = SwayWatch(), Looks()
    images = [replace(image, width=SIZE[0], height=SIZE[1], camera=rest) for image in file.images]
    frames = ((one, seen_by(turn, wide, pictures(one))) for one, turn in zip(images, turns, strict=True))
    for _ in looks.watch(watch.watch(frames)):
        pass
    record = record_of(images, (watch.taken(one.id) for one in images), SIZE[0])
    seconds = {one.id: time_s for one, time_s in zip(images, times, strict=True)}
    changes = record.view_changes([(seconds[number], look) for number, look in looks.taken.items()])
    motion = record.motion(changes)
    by_image = file.by_image()
    labels = [
        made
        for one, turn in zip(images, turns, strict=True)
        for a in by_image[one.id]
        if not a.ignored and (made := labelled(a, wide, turn)) is not None
    ]
    info = {
        **({CHANGES_KEY: [change.to_dict() for change in changes]} if changes else {}),
        **({MOTION_KEY: motion.to_dict()} if motion else {}),
    }
    said = f"{motion.median_px:.2f} px" if motion else "still"
    said += "".join(f", moved at {change.time_s:.1f} s" for change in changes)
    return Shaken(AnnotationFile(images=tuple(images), annotations=tuple(labels), info=info), turns, said)


@dataclass(frozen=True)
class Errors:
    """Errors of places (m) and speeds (m/s), whether places are within the stated 90% error, and how many have none."""

    places: Array
    speeds: Array
    within: Array
    without: int

    def __str__(self) -> str:
        def told(values: Array, unit: str) -> str:
            if not len(values):
                return "-"
            return f"{np.median(values):.2f} {unit} (90%: {np.percentile(values, 90):.2f})"

        return f"{told(self.places, 'm')} | {told(self.speeds, 'm/s')}"


def errors_of(scene: Scene) -> Errors:
    """How far places and speeds are from the truth of the labels."""
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
            within.append(off <= float(radius_of(poses.covariance[i, :2, :2], UNCERTAINTY.place_coverage)))
    labels = {(a.image_id, a.track_id): a for a in scene.file.annotations}
    ids = [image.id for image in scene.file.images]
    speeds = []
    for track in follow(found, times):
        for frame, number, speed in zip(track.frames, track.truth_ids.tolist(), track.speed, strict=True):
            label = labels.get((ids[frame], number))
            if label is not None and label.velocity is not None and np.linalg.norm(label.velocity) >= SLOWEST:
                speeds.append(abs(float(speed) - float(np.linalg.norm(label.velocity))))
    return Errors(np.array(places), np.array(speeds), np.array(within), without)


def scene_of(file: AnnotationFile, folder: Path, camera: Camera | None = None) -> Scene:
    """The scene as the commands read it; `camera`: the one that it was calibrated to be."""
    if camera is not None:
        file = replace(file, images=tuple(replace(image, camera=camera) for image in file.images))
    path = folder / "labels.json"
    coco.write(path, file)
    return read_scene(None, path, None, None, 0.0)


def row(footage: Shaken, name: str) -> str:
    """A row of the table."""
    bare = replace(footage.file, info={})
    with tempfile.TemporaryDirectory() as folder:
        kept, left = (errors_of(scene_of(file, Path(folder))) for file in (bare, footage.file))
        within = []
        # Of footage that is knocked, calibrations are of its first half.
        for k in np.linspace(0, 0.45 * len(footage.turns), MOMENTS).astype(int):
            scene = scene_of(footage.file, Path(folder), footage.turns[k])
            within += errors_of(scene).within.tolist()
    share = f"{np.mean(within):.0%}" if within else "-"
    return f"| {name} | {footage.said} | {kept} | {left} | {left.without} | {share} |"


class Pictures:
    """Pictures of the images of a file, from their folder, or one for all."""

    def __init__(self, folder: Path | None, picture: Path | None, size: tuple[int, int]) -> None:
        self._folder, self._size = folder, size
        self._one = None if picture is None else cv2.resize(read_image(picture), size, interpolation=cv2.INTER_AREA)

    def __call__(self, image: Image) -> np.ndarray:
        if self._one is not None:
            return self._one
        assert self._folder is not None
        return read_image(self._folder / image.file_name)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("annotations", type=Path, help="labels of a generated recording, with its camera")
    where = parser.add_mutually_exclusive_group(required=True)
    where.add_argument("--images", type=Path, help="folder of the labels' pictures")
    where.add_argument("--picture", type=Path, help="one picture for all images: of an empty road")
    options = parser.parse_args()
    file = coco.read(options.annotations)
    first = file.images[0]
    pictures = Pictures(options.images, options.picture, (first.width, first.height))
    print("| sway | measured | places without | speeds without | places | speeds | without metres | within 90% |")
    print("|---|---|---|---|---|---|---|---|")
    for sway_px in SWAYS_PX:
        print(row(shaken(file, pictures, sway_px, 0.0), f"{sway_px:g} px"), flush=True)
    print(row(shaken(file, pictures, 1.0, BUMP_PX), f"1 px, and {BUMP_PX:g} px halfway"), flush=True)


if __name__ == "__main__":
    main()
