"""croissant.json: description of a dataset for catalogues and loaders (MLCommons Croissant 1.0 with RAI).

Source: the format's specification, docs.mlcommons.org/croissant/docs/croissant-spec.html. The publisher has to add what
only the publisher knows (url, creator, datePublished). The file contains no date, so equal datasets have equal bytes.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from skope import schema
from skope.dataset import shards
from skope.dataset.depth_files import DEPTH_CODING
from skope.gen.output import card_text
from skope.gen.output.licences import LICENCE_ADDRESSES
from skope.gen.vehicles.fleet import fleet

Json = dict[str, Any]

JSON_LD_CONTEXT: Final[Json] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "citeAs": "cr:citeAs",
    "column": "cr:column",
    "conformsTo": "dct:conformsTo",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/",
    "equivalentProperty": "cr:equivalentProperty",
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "extract": "cr:extract",
    "field": "cr:field",
    "fileProperty": "cr:fileProperty",
    "fileObject": "cr:fileObject",
    "fileSet": "cr:fileSet",
    "format": "cr:format",
    "includes": "cr:includes",
    "isLiveDataset": "cr:isLiveDataset",
    "jsonPath": "cr:jsonPath",
    "key": "cr:key",
    "md5": "cr:md5",
    "parentField": "cr:parentField",
    "path": "cr:path",
    "recordSet": "cr:recordSet",
    "references": "cr:references",
    "regex": "cr:regex",
    "repeated": "cr:repeated",
    "replace": "cr:replace",
    "samplingRate": "cr:samplingRate",
    "sc": "https://schema.org/",
    "separator": "cr:separator",
    "source": "cr:source",
    "subField": "cr:subField",
    "transform": "cr:transform",
}
PAPER_CITATION: Final = (
    "Pahadia, Lu, Chakravarthi, Yang: SKoPe3D: A Synthetic Dataset for Vehicle Keypoint Perception in 3D from Traffic "
    "Monitoring Cameras, 2023 (the method; the images are made by skope)"
)
MIME_TYPES: Final = {
    ".jpg": "image/jpeg",
    ".png": "image/png",
    ".webp": "image/webp",
    ".npz": "application/octet-stream",
}
FOLDER_DESCRIPTIONS: Final = {
    "images/*/*": "Camera images.",
    "depth/*/*": f"Planar depth, metres = value / {DEPTH_CODING.scale:.0f}, 0 = sky.",
    "recordings/*": "Poses of every vehicle in every frame.",
}

_IMAGE_FIELDS: Final = {
    "id": ("sc:Integer", "Number of the image, unique in the dataset."),
    "file_name": ("sc:Text", "Path of the image in the dataset."),
    "width": ("sc:Integer", "Pixels."),
    "height": ("sc:Integer", "Pixels."),
    "site": ("sc:Text", "Camera site."),
    "recording": ("sc:Text", "Recording at the site, a continuous period."),
    "frame_index": ("sc:Integer", "Index of the frame in its recording."),
    "split": ("sc:Text", "train, or a test split."),
    "weather": ("sc:Text", f"One of {', '.join(schema.WEATHER_NAMES)}."),
}
_VEHICLE_FIELDS: Final = {
    "id": ("sc:Integer", "Number of the annotation, unique in the dataset."),
    "image_id": ("sc:Integer", "Id of the annotation's image."),
    "bbox": ("cr:BoundingBox", "x, y, width, height in pixels of the whole vehicle, including its hidden parts."),
    "keypoints": ("sc:Float", "33 times x, y, v; v = 2 visible, 1 hidden, 0 outside the image."),
    "iscrowd": ("sc:Integer", "1: ignored, neither ground truth nor background."),
    "track_id": ("sc:Integer", "Id of the vehicle at its site."),
    "vehicle_type": ("sc:Text", "One of {types}."),
}

RECORD_SETS: Final = {
    "images": ("images", "Images of all splits; COCO keypoints, one file per split.", _IMAGE_FIELDS),
    "vehicles": (
        "annotations",
        "Annotated vehicles of all splits; COCO keypoints, one file per split.",
        _VEHICLE_FIELDS,
    ),
}


def croissant(card: Mapping[str, Any], sums: Mapping[str, str]) -> Json:
    """Return the document for a card and the dataset's checksums (SHA-256 by path, from the manifest)."""
    licence = str(card["licence"])
    return {
        "@context": JSON_LD_CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": ["http://mlcommons.org/croissant/1.0", "http://mlcommons.org/croissant/RAI/1.0"],
        "name": "skope-vehicle-keypoints",
        "description": f"{card_text.DATASET_TITLE}. {card_text.card_summary(card)}",
        "license": LICENCE_ADDRESSES.get(licence, licence),
        "version": f"{schema.SCHEMA_VERSION}.0.0",
        "citeAs": PAPER_CITATION,
        "keywords": ["keypoints", "vehicles", "roadside camera", "synthetic data", "3D boxes", "depth"],
        "rai:dataCollection": " ".join(card_text.made(card)),
        "rai:dataCollectionType": ["Simulations"],
        "rai:dataUseCases": card_text.purposes(),
        "rai:dataLimitations": card_text.limits(card),
        "rai:dataAnnotationProtocol": list(card["label_rules"]),
        "rai:personalSensitiveInformation": [card_text.people(card)],
        **(
            _shards(sums) if card.get("format") == "shards" else _folder(sums, _types(card), card.get("categories", ()))
        ),
    }


def _types(card: Mapping[str, Any]) -> str:
    """Return the vehicle types of the standard fleet, and any other types in the dataset."""
    usual = {entry.vehicle.vehicle_type for entry in fleet().values() if not entry.further} | {"other"}
    usual |= card.get("counts", {}).get("by_vehicle_type", {}).keys()
    return ", ".join(kind for kind in schema.VEHICLE_TYPES if kind in usual)


def _folder(sums: Mapping[str, str], types: str, categories: Sequence[str]) -> Json:
    files = [_file(path, sums, "application/json") for path in sums if path.startswith("annotations/")]
    # A reader takes one list of rows from a set of files, so the same files are declared as two sets.
    files += [
        _set(f"files-of-{name}", "annotations/*.json", "application/json", description)
        for name, (_, description, _) in RECORD_SETS.items()
    ]
    for pattern, description in FOLDER_DESCRIPTIONS.items():
        folder = pattern.split("/")[0]
        for suffix in sorted({Path(path).suffix for path in sums if path.startswith(f"{folder}/")}):
            files.append(_set(f"{folder}-files", pattern + suffix, MIME_TYPES[suffix], description))
    records = []
    for name, (rows, description, fields) in RECORD_SETS.items():
        if rows == "annotations" and categories:
            description = "Annotated road users of all splits; COCO keypoints, one file per split."
            ids = ", ".join(f"{schema.CATEGORY_NAMES.index(category) + 1} {category}" for category in categories)
            # Readers put columns side by side, so no column may be missing in some rows.
            fields = {key: value for key, value in fields.items() if key != "vehicle_type"}
            fields["category_id"] = ("sc:Integer", f"One of {ids}.")
        records.append(_record_set(name, rows, description, fields, types))
    return {"distribution": files, "recordSet": records}


def _shards(sums: Mapping[str, str]) -> Json:
    """Return the description of archives; Croissant cannot describe their members (WebDataset)."""
    description = "Offset and size of each member in its shard, bytes."
    return {
        "distribution": [
            *(_file(path, sums, "application/x-tar") for path in sums if path.endswith(".tar")),
            _set("shard-indices", f"{shards.SHARD_FOLDER}/*.json", "application/json", description),
            _set("recordings-files", "recordings/*.npz", MIME_TYPES[".npz"], FOLDER_DESCRIPTIONS["recordings/*"]),
        ]
    }


def _file(path: str, sums: Mapping[str, str], kind: str) -> Json:
    name = path.replace("/", "-")
    return {
        "@type": "cr:FileObject",
        "@id": name,
        "name": name,
        "contentUrl": path,
        "encodingFormat": kind,
        "sha256": sums[path],
    }


def _set(name: str, includes: str, kind: str, description: str) -> Json:
    return {
        "@type": "cr:FileSet",
        "@id": name,
        "name": name,
        "description": description,
        "encodingFormat": kind,
        "includes": includes,
    }


def _record_set(name: str, rows: str, description: str, fields: Mapping[str, tuple[str, str]], types: str) -> Json:
    """Return the record set for the list `rows` of the annotation files.

    The image of an annotation is not declared as a reference, since readers would then join the two lists row by row.
    """
    return {
        "@type": "cr:RecordSet",
        "@id": name,
        "name": name,
        "description": description,
        "key": {"@id": f"{name}/id"},
        "field": [
            {
                "@type": "cr:Field",
                "@id": f"{name}/{field}",
                "name": field,
                "description": text.format(types=types),
                "dataType": kind,
                **({"repeated": True} if field == "keypoints" else {}),
                "source": {"fileSet": {"@id": f"files-of-{name}"}, "extract": {"jsonPath": f"$.{rows}[*].{field}"}},
            }
            for field, (kind, text) in fields.items()
        ],
    }
