"""Write COCO keypoints files, and CVAT's archives of them.

COCO: `annotations/<split>.json` beside `images/`, as in a dataset folder, with all other information in extra fields.
CVAT ("COCO Keypoints 1.0"): `annotations/person_keypoints_<subset>.json`, `images/<subset>/<file name>`. Attributes
contain what CVAT's labels can carry in addition to points. CVAT's own tracks use the attribute `track_id`.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from skope import schema
from skope.dataset import coco
from skope.dataset.folder import Dataset
from skope.files.atomic import write_text
from skope.gen.formats.dataset_builder import bare_name
from skope.gen.output.writers import place_file
from skope.keypoints import K, Scheme
from skope.terminal.console import Console

CVAT_START: Final = "person_keypoints_"
UNSET_VALUE: Final = "-"
"""Value of an unset CVAT attribute."""
CVAT_ATTRIBUTES: Final = ("track_id", "model", "vehicle_type", "color", "ignore_reason")
"""Fields that CVAT stores as attributes."""


def write(dataset: Dataset, out: Path, console: Console) -> None:
    """Write a dataset's images, depth and annotation files to `out`, with hard links if possible."""
    for split in console.bar(dataset.splits, unit="split", label="writing coco"):
        file = dataset.read(split)
        rows = []
        for image in file.images:
            row = coco.image_to_dict(image)
            for key, kind in (("file_name", "images"), ("depth_file_name", "depth")):
                if key in row:
                    name = f"{kind}/{bare_name(row[key])}"
                    place_file(dataset.root / row[key], out / name)
                    row[key] = name
            rows.append(row)
        path = out / "annotations" / f"{split}.json"
        coco.write_rows(path, {"split": split}, rows, coco.label_rows(file), file.scheme, file.categories)


def write_cvat(dataset: Dataset, out: Path, console: Console) -> None:
    """Write the files of a CVAT archive to `out`, without masks, which CVAT would show as separate shapes."""
    categories = dict[str, None]()
    for split in console.bar(dataset.splits, unit="split", label="writing cvat"):
        file = dataset.read(split)
        rows = []
        for image in file.images:
            name = bare_name(image.file_name)
            place_file(dataset.root / image.file_name, out / "images" / split / name)
            row = coco.image_to_dict(image)
            row.pop("depth_file_name", None)
            rows.append({**row, "file_name": name})
        annotations = [_cvat_row(row) for row in coco.label_rows(file)]
        path = out / "annotations" / f"{CVAT_START}{split}.json"
        coco.write_rows(path, {"split": split}, rows, annotations, file.scheme, file.categories)
        categories |= dict.fromkeys(file.categories)
    write_text(out / "labels.json", json.dumps(cvat_labels(dataset.scheme, [*categories]), indent=1) + "\n")


def _cvat_row(row: dict[str, Any]) -> dict[str, Any]:
    attributes = {name: row.pop(name) for name in CVAT_ATTRIBUTES if name in row}
    box = row["bbox"]
    kept = {name: row[name] for name in ("id", "image_id", "category_id", "bbox", "keypoints", "num_keypoints")}
    if row["category_id"] != schema.CATEGORY_ID:
        kept["keypoints"] = []  # a rectangle, as the label that it gets has no points
    # In CVAT, crowds are masks without points. An ignored vehicle is therefore an ordinary one with a reason.
    return {**kept, "area": float(box[2] * box[3]), "iscrowd": 0, "segmentation": [], "attributes": attributes}


def cvat_labels(scheme: Scheme, categories: Sequence[str] = schema.VEHICLE_ALONE) -> list[dict[str, Any]]:
    """Return the labels of a task for CVAT's "raw" editor.

    They are the vehicle's skeleton, drawn in a square of 100, with its attributes, and a rectangle per other category.
    """
    side = 6
    places = [(10 + 16 * (i % side), 10 + 16 * (i // side)) for i in range(K)]
    lines = [
        f'<line x1="{places[a][0]}" y1="{places[a][1]}" x2="{places[b][0]}" y2="{places[b][1]}" data-type="edge" '
        f'data-node-from="{a + 1}" data-node-to="{b + 1}"></line>'
        for a, b in scheme.skeleton
    ]
    nodes = [
        f'<circle r="1.5" cx="{x}" cy="{y}" data-type="element node" data-element-id="{i}" data-node-id="{i}" '
        f'data-label-name="{name}"></circle>'
        for i, (name, (x, y)) in enumerate(zip(scheme.names, places, strict=True), start=1)
    ]

    def attribute(name: str, kind: str, values: Sequence[str]) -> dict[str, Any]:
        return {"name": name, "mutable": False, "input_type": kind, "default_value": values[0], "values": list(values)}

    return [
        {
            "name": schema.category()["name"],
            "type": "skeleton",
            "attributes": [
                attribute("model", "text", [UNSET_VALUE]),
                attribute("vehicle_type", "select", [UNSET_VALUE, *schema.VEHICLE_TYPES]),
                attribute("color", "select", [UNSET_VALUE, *schema.VEHICLE_COLORS]),
                attribute("ignore_reason", "select", [UNSET_VALUE, *schema.IGNORE_REASONS]),
            ],
            "svg": "".join([*lines, *nodes]),
            "sublabels": [{"name": name, "type": "points", "attributes": []} for name in scheme.names],
        },
        *(
            {
                "name": name,
                "type": "rectangle",
                "attributes": [attribute("ignore_reason", "select", [UNSET_VALUE, *schema.IGNORE_REASONS])],
            }
            for name in categories
            if name != "vehicle"
        ),
    ]
