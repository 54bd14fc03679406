"""Convert the published scenes (see `skope.gen.formats.skope3d_scenes`) to datasets, and datasets to scenes.

A hidden point (visible = 0) with a position becomes v = 1, a point at 0, 0 becomes v = 0. The order of the keypoints
differs from skope's (scheme `skope3d`); a map by name converts the named keypoints to `skope33`.
"""

import csv
import io
import itertools
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from skope import boxes, keypoints
from skope.dataset.folder import Dataset
from skope.dataset.image_selection import recordings
from skope.errors import UserError
from skope.files.atomic import write_text
from skope.files.csv_files import read_csv, write_csv
from skope.files.json_files import read_json, write_json
from skope.files.safe_names import name as check_name
from skope.gen.formats.dataset_builder import finish_dataset, frame_rate, labelled_frame, licence_beside
from skope.gen.formats.skope3d_scenes import VIDEO_MEMBER, ArchiveScene, ArchiveVehicle, archives, scene_of
from skope.gen.formats.source_files import opened, zipped
from skope.gen.output.writers import FolderWriter
from skope.keypoints import PUBLISHED, SKOPE33, K
from skope.schema import Annotation, AnnotationFile, Image
from skope.terminal.console import Console
from skope.types import Array
from skope.video.footage import open_footage
from skope.video.write import write_video

SKOPE3D_LICENCE: Final = "CC BY-NC-SA 4.0 (as its users state it)"
SCENES_FILE: Final = "scenes.csv"
"""File beside exported archives: split, site and recording of each scene."""
POINT_MAP_FILE: Final = "map.json"
"""File beside exported archives: names of the keypoints by number."""
ARCHIVE_CORNERS: Final = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
"""(8, 3) corners of the unit box, in the order of exported archives: back before front, right before left, below before
above."""

UNKNOWN_PIXEL: Final = -1.0


# ---------------------------------------------------------------------------------------------------------- importing


@dataclass(frozen=True)
class ScenePlace:
    """Split, site and recording of a scene in the dataset."""

    split: str
    site: str
    recording: str


def read(
    sources: Sequence[Path], root: Path, *, split: str | None, map_file: Path | None, command: str, console: Console
) -> None:
    """Make a dataset from scenes of the published SKoPe3D layout.

    Args:
        sources: Archives, or folders with archives.
        root: Folder of the new dataset.
        split: Split of all scenes. Default: from the `scenes.csv` beside them, else "train".
        map_file: Keypoint names of the archives' numbers; with it the scheme is `skope33`, else `skope3d`.
        command: Command line for the card.
        console: Shows progress.

    Raises:
        UserError: An archive or the map cannot be read, a scene occurs twice, or scenes have different licences.
    """
    names = read_map(map_file) if map_file else None
    writer = FolderWriter(root, SKOPE33 if names is not None else PUBLISHED)
    seen: dict[tuple[str, str], Path] = {}
    licences = set()
    for path in console.bar(archives(sources), unit="scene", label="reading scenes"):
        with opened(path) as archive:
            scene = scene_of(archive)
            known_scenes = _places(path.parent / SCENES_FILE)
            place = known_scenes.get(scene.name, ScenePlace("train", scene.name, "00"))
            # Scenes that skope exported are not the published data and have their own licence.
            licences.add(licence_beside(path.parent) if scene.name in known_scenes else SKOPE3D_LICENCE)
            place = replace(place, split=split) if split else place
            if (place.site, place.recording) in seen:
                raise UserError(f"{path}: {scene.name} is in {seen[place.site, place.recording]} too")
            seen[place.site, place.recording] = path
            _add_scene(scene, place, names, writer, root / ".video.avi")
    rules = ["Boxes, keypoints and tracks are those of the files read; v = 2: visible, v = 1: hidden, with a place."]
    if names is not None:
        rules.append(f"{len(names)} of {K} keypoints are mapped to scheme {SKOPE33.name}; the others are unlabelled.")
    if len(licences) > 1:
        raise UserError(f"scenes under different licences ({'; '.join(sorted(licences))}): import them separately")
    finish_dataset(writer, command=command, licence=licences.pop(), label_rules=rules)


def _places(path: Path) -> dict[str, ScenePlace]:
    if not path.is_file():
        return {}
    places = {}
    try:
        for row in read_csv(path)[1]:
            places[row["scene"]] = ScenePlace(row["split"], row["site"], row["recording"])
    except KeyError:
        raise UserError(f"{path}: expected the columns scene, split, site, recording") from None
    for scene, place in places.items():
        for field, value in vars(place).items():
            check_name(f"{path}: {scene}: {field}", value)
    return places


def _add_scene(
    scene: ArchiveScene, place: ScenePlace, names: Mapping[int, int] | None, writer: FolderWriter, video: Path
) -> None:
    scene.archive.extract(f"{scene.name}/{VIDEO_MEMBER}", video)
    try:
        for frame, time_s, pixels in _pictures(scene, video):
            height, width = pixels.shape[:2]
            image = Image(
                id=0,
                file_name=f"images/{place.site}/{place.recording}_{frame:06d}.jpg",
                width=width,
                height=height,
                site=place.site,
                recording=place.recording,
                frame_index=frame,
                time_s=time_s,
            )
            done, data = cv2.imencode(".jpg", cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 95])
            assert done
            annotations = [_annotation(vehicle, width, height, names) for vehicle in scene.vehicles(frame)]
            vehicles = [vehicle for vehicle in annotations if vehicle is not None]
            frame_files = labelled_frame(place.split, image, vehicles, {image.file_name: data.tobytes()})
            writer.add(place.split, [frame_files])
    finally:
        video.unlink(missing_ok=True)


def _pictures(scene: ArchiveScene, video: Path) -> Iterator[tuple[int, float | None, NDArray[np.uint8]]]:
    """Yield annotated frames with their time and (H, W, 3) RGB pixels."""
    where, last = f"{scene.archive.path}: {scene.name}/{VIDEO_MEMBER}", max(scene.frames)
    try:
        footage = open_footage(str(video))
    except UserError:
        raise UserError(f"{where}: not a video that can be decoded") from None
    assert footage.clip is not None
    # The published data does not document whether the first frame is 0 or 1. A last number just past the end shows that
    # it is 1.
    first = 1 if 0 not in scene.frames and last == footage.clip.count else 0
    left = sorted(scene.frames)
    for image, pixels in footage.frames():
        number = first + (image.frame_index or 0)
        if number > left[0]:
            break
        if number == left[0]:
            left.pop(0)
            yield number, None if image.time_s is None else round(image.time_s, 4), pixels
            if not left:
                return
    raise UserError(f"{where}: frame {left[0]} cannot be decoded; the annotations go to {last}")


def _annotation(vehicle: ArchiveVehicle, width: int, height: int, names: Mapping[int, int] | None) -> Annotation | None:
    """Return the annotation of a vehicle; None if its box lies outside the image."""
    box = boxes.clip(vehicle.box_xyxy, width, height)
    if boxes.area(box) <= 0:
        return None
    x, y, visible = vehicle.points.T
    inside = (x >= 0) & (y >= 0) & (x < width) & (y < height) & ((x != 0) | (y != 0))
    points = np.where(inside[:, None], np.column_stack([x, y, 1 + visible]), 0.0)
    if names is not None:
        mapped = np.zeros_like(points)
        mapped[list(names.values())] = points[list(names)]
        points = mapped
    known = not (vehicle.corners == UNKNOWN_PIXEL).all()
    bbox = boxes.xyxy_to_xywh(box)
    return Annotation(
        id=0,
        image_id=0,
        bbox=bbox,
        keypoints=points,
        area=float(bbox[2] * bbox[3]),
        track_id=vehicle.track_id,
        model=vehicle.model,
        box_3d_pixels=vehicle.corners if known else None,
    )


def read_map(path: Path) -> dict[int, int]:
    """Read a map from indices in the files to indices in `skope33`.

    The file contains a JSON object {"skope3d_16": "wheel_front_right", ...}.

    Known points (`keypoints.SKOPE3D`) need not be listed.

    Raises:
        UserError: An entry is wrong.
    """
    document = read_json(path)
    if not isinstance(document, dict):
        raise UserError(f'{path}: expected an object like {{"skope3d_16": "wheel_front_right"}}')
    table = dict(keypoints.SKOPE3D)
    for theirs, ours in document.items():
        if theirs not in PUBLISHED.names:
            raise UserError(f"{path}: {theirs!r} is not one of {PUBLISHED.names[0]} to {PUBLISHED.names[-1]}")
        if not isinstance(ours, str) or ours not in keypoints.INDEX:
            raise UserError(f"{path}: {theirs}: {ours!r} is not a keypoint of {SKOPE33.name}")
        index = PUBLISHED.names.index(theirs)
        if table.get(index, keypoints.INDEX[ours]) != keypoints.INDEX[ours]:
            raise UserError(f"{path}: {theirs}: is {keypoints.NAMES[table[index]]}, not {ours}")
        table[index] = keypoints.INDEX[ours]
    if len(set(table.values())) != len(table):
        twice = next(ours for ours in table.values() if list(table.values()).count(ours) > 1)
        raise UserError(f"{path}: two points are mapped to {keypoints.NAMES[twice]}")
    return table


# ---------------------------------------------------------------------------------------------------------- exporting


def write(dataset: Dataset, out: Path, console: Console) -> None:
    """Write each recording of a dataset as an archive to `out`, with `SCENES_FILE` and `POINT_MAP_FILE` beside them.

    Masks, depth, world coordinates, ignored vehicles and people on foot and on two wheels are left out: the layout has
    no place for them.
    """
    files = {split: dataset.read(split) for split in dataset.splits}
    groups = [(split, group) for split, file in files.items() for group in _groups(file)]
    road_user_count = sum(len(file.road_users) for file in files.values())
    places, ignored = [], 0
    for number, (split, (images, vehicles)) in enumerate(
        console.bar(groups, unit="scene", label="writing scenes"), start=1
    ):
        name, folder = f"scene_{number}", out / f".scene_{number}"
        _write_scene(dataset, images, vehicles, folder / name)
        ignored += sum(vehicle.ignored for image in images for vehicle in vehicles[image.id])
        zipped(folder, out / f"{name}.zip")
        shutil.rmtree(folder)
        places.append((name, split, images[0].site or name, images[0].recording or "00"))
    write_csv(out / SCENES_FILE, ("scene", "split", "site", "recording"), places, byte_order_mark=False)
    if ignored:
        console.say(f"{ignored} ignored vehicles are left out: this format cannot store them")
    if road_user_count:
        console.say(f"{road_user_count} people on foot and on two wheels are left out: this format has only vehicles")
    if dataset.scheme.name == SKOPE33.name:
        write_json(out / POINT_MAP_FILE, dict(zip(PUBLISHED.names, keypoints.NAMES, strict=True)))


def _groups(file: AnnotationFile) -> list[tuple[list[Image], dict[int, list[Annotation]]]]:
    return [(images, file.by_image()) for images in recordings(file)]


def _write_scene(
    dataset: Dataset, images: Sequence[Image], vehicles: Mapping[int, list[Annotation]], folder: Path
) -> None:
    if len({(image.width, image.height) for image in images}) != 1:
        raise UserError(f"{dataset.root}: recording {images[0].recording} of {images[0].site} has images of two sizes")
    folder.mkdir(parents=True)
    write_video(folder / VIDEO_MEMBER, (dataset.image(image) for image in images), frame_rate(images))
    for frame, image in enumerate(images):
        (folder / str(frame)).mkdir()
        labelled = [vehicle for vehicle in vehicles[image.id] if not vehicle.ignored]
        for number, vehicle in enumerate(labelled):
            for kind, rows in _tables(vehicle, image).items():
                text = io.StringIO()
                csv.writer(text, lineterminator="\n").writerows(rows)
                write_text(folder / str(frame) / f"{kind}_{number}.csv", text.getvalue())


def _tables(vehicle: Annotation, image: Image) -> dict[str, list[list[Any]]]:
    x0, y0, x1, y1 = boxes.xywh_to_xyxy(vehicle.bbox)
    origin = np.floor([x0, y0])
    known = vehicle.keypoints[:, 2] > 0
    points = np.where(known[:, None], vehicle.keypoints[:, :2] - origin, 0.0)
    visible = (vehicle.keypoints[:, 2] == 2).astype(int)
    rows = [[f"{x:.2f}", f"{y:.2f}", v] for (x, y), v in zip(points, visible, strict=True)]
    return {
        "keypoint": [origin.astype(int).tolist(), [f"{x0:.2f}", f"{y0:.2f}"], [f"{x1:.2f}", f"{y1:.2f}"], *rows],
        "metadata": [
            [vehicle.id if vehicle.track_id is None else vehicle.track_id, vehicle.model or "unknown"],
            *([f"{x:.2f}", f"{y:.2f}"] for x, y in _corners(vehicle, image)),
        ],
    }


def _corners(vehicle: Annotation, image: Image) -> Array:
    """Return the pixels (8, 2) of the 3D box; all -1 if it is unknown or extends behind the camera."""
    if vehicle.box_3d_pixels is not None:
        return vehicle.box_3d_pixels
    if vehicle.box_3d is not None and image.camera is not None:
        box = vehicle.box_3d
        pixels, _, valid = image.camera.project(ARCHIVE_CORNERS * box.size_lwh @ box.R.T + box.center)
        if valid.all():
            return pixels
    return np.full((8, 2), UNKNOWN_PIXEL)
