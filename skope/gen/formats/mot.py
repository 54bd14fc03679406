"""MOTChallenge's sequences: `<split>/<site>_<recording>/` with `img1/000001.jpg`, `gt/gt.txt` and `seqinfo.ini`.

A row of `gt.txt` is frame (from 1), track, left, top, width, height, whether it counts, class, visibility. Ignored
vehicles do not count (0). The class of vehicles is 1, which the challenge's evaluation uses. The classes of people on
foot and on two wheels, if labelled, are their category ids. `gt/labels.txt` lists their names line by line, as in CVAT.
"""

from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from skope.dataset.folder import Dataset
from skope.dataset.image_selection import recordings
from skope.errors import UserError
from skope.files.atomic import write_text
from skope.gen.formats.dataset_builder import frame_rate
from skope.gen.output.writers import place_file
from skope.schema import CATEGORY_ID, CATEGORY_NAMES, Annotation, Image, RoadUser
from skope.terminal.console import Console


def write(dataset: Dataset, out: Path, console: Console) -> None:
    """Write each recording of a dataset as a MOTChallenge sequence below `out`."""
    names = set[str]()
    for split in console.bar(dataset.splits, unit="split", label="writing mot"):
        file = dataset.read(split)
        labels_by_image = file.labels_by_image()
        for images in recordings(file):
            name = "_".join(part for part in (images[0].site, images[0].recording) if part) or "site_00"
            while f"{split}/{name}" in names:  # a_b of site c, and b of site c_a
                name += "_"
            names.add(f"{split}/{name}")
            rows = []
            for frame, image in enumerate(images, start=1):
                suffix = PurePosixPath(image.file_name).suffix
                place_file(dataset.root / image.file_name, out / split / name / "img1" / f"{frame:06d}{suffix}")
                rows += [_row(f"{dataset.root}: {split}", frame, label) for label in labels_by_image[image.id]]
            write_text(out / split / name / "gt" / "gt.txt", "".join(rows))
            if len(file.categories) > 1:
                write_text(
                    out / split / name / "gt" / "labels.txt", "".join(f"{category}\n" for category in CATEGORY_NAMES)
                )
            write_text(out / split / name / "seqinfo.ini", _information(name, images))


def _row(where: str, frame: int, vehicle: Annotation | RoadUser) -> str:
    if vehicle.track_id is None:
        raise UserError(f"{where}: annotation {vehicle.id}: track_id: missing")
    x, y, w, h = vehicle.bbox
    visible = 1 - (vehicle.occlusion or 0.0)
    track = vehicle.track_id + 1  # MOTChallenge counts from 1
    kind = CATEGORY_ID if isinstance(vehicle, Annotation) else vehicle.category_id
    return f"{frame},{track},{x:.2f},{y:.2f},{w:.2f},{h:.2f},{int(not vehicle.ignored)},{kind},{visible:.4f}\n"


def _information(name: str, images: Sequence[Image]) -> str:
    first = images[0]
    values = {
        "name": name,
        "imDir": "img1",
        "frameRate": f"{frame_rate(images):g}",
        "seqLength": len(images),
        "imWidth": first.width,
        "imHeight": first.height,
        "imExt": PurePosixPath(first.file_name).suffix,
    }
    return "[Sequence]\n" + "".join(f"{key}={value}\n" for key, value in values.items())
