"""The only reader and writer of COCO JSON: annotation files and results files, both directions."""

import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from skope import keypoints, schema
from skope.camera.model import Camera
from skope.errors import UserError
from skope.files.atomic import replacing
from skope.files.json_files import json_bytes, parse_json, read_json
from skope.keypoints import SKOPE33, Scheme
from skope.schema import Annotation, AnnotationFile, Box3D, Image, Result
from skope.version import __version__

T = TypeVar("T")

_IMAGE_FIELDS = tuple(Image.__dataclass_fields__)
_ANNOTATION_FIELDS = tuple(Annotation.__dataclass_fields__)


# ----------------------------------------------------------------------------------------------------------- reading


def read(path: Path) -> AnnotationFile:
    """Read an annotation file.

    Args:
        path: A file that skope wrote, or any COCO keypoints file with the 33 keypoints of one of `keypoints.SCHEMES`.

    Raises:
        UserError: Something is missing, malformed or inconsistent; it names file, record and field.
    """
    document = read_json(path)
    if not isinstance(document, dict):
        raise UserError(f"{path}: expected a COCO object with images and annotations, got a {type(document).__name__}")
    scheme = _scheme(path, document)
    images = _records(path, document, "images", image_from_dict)
    annotations = _records(path, document, "annotations", annotation_from_dict)
    _check_ids(path, images, annotations)
    info = document.get("info") or {}
    return AnnotationFile(images=images, annotations=annotations, info=info, name=path.stem, scheme=scheme)


def assembled(
    rows: Iterable[tuple[Mapping[str, Any], list[Any]]], path: Path, split: str, scheme: Scheme
) -> AnnotationFile:
    """Make an annotation file of JSON rows.

    Args:
        rows: The row of each image, with the rows of its annotations.
        path: What messages name as the file.
        split: Name of the split.
        scheme: What the keypoints are.
    """
    images: list[Image] = []
    annotations: list[Annotation] = []
    for image, annotation_rows in rows:
        images += images_of(path, [image])
        annotations += _parse_rows(path, "annotations", annotation_rows, annotation_from_dict)
    _check_ids(path, tuple(images), tuple(annotations))
    info = {"split": split, **scheme.fields(), "schema_version": schema.VERSION}
    return AnnotationFile(images=tuple(images), annotations=tuple(annotations), info=info, name=split, scheme=scheme)


def images_of(path: Path, rows: Iterable[Any]) -> tuple[Image, ...]:
    """The elements of `images`; a UserError names `path`, the record and the field that is wrong."""
    return _parse_rows(path, "images", rows, image_from_dict)


def _records(path: Path, document: Mapping[str, Any], key: str, parse: Callable[[Any], T]) -> tuple[T, ...]:
    rows = document.get(key)
    if not isinstance(rows, list):
        raise UserError(f"{path}: field {key} is missing or not a list")
    return _parse_rows(path, key, rows, parse)


def _parse_rows(path: Path, key: str, rows: Iterable[Any], parse: Callable[[Any], T]) -> tuple[T, ...]:
    return tuple(_parsed(path, key, rows, parse))


def _parsed(path: Path, key: str, rows: Iterable[Any], parse: Callable[[Any], T]) -> Iterator[T]:
    for i, row in enumerate(rows):
        try:
            if not isinstance(row, dict):
                raise UserError(f"expected an object, got {str(row)[:40]!r}")
            record = parse(row)
        except UserError as error:
            raise UserError(f"{path}: {key}[{i}]: {error}") from None
        except KeyError as error:
            raise UserError(f"{path}: {key}[{i}]: field {error.args[0]} is missing") from None
        except (TypeError, ValueError, AttributeError) as error:
            raise UserError(f"{path}: {key}[{i}]: {error}") from None
        yield record


def _scheme(path: Path, document: Mapping[str, Any]) -> Scheme:
    """The scheme that a file says it has, or else the one whose names it has."""
    info = document.get("info")
    info = info if isinstance(info, dict) else {}
    stated = info.get("keypoint_scheme")
    categories = document.get("categories")
    if not isinstance(categories, list) or len(categories) != 1 or not isinstance(categories[0], dict):
        raise UserError(f"{path}: field categories: expected exactly one category")
    names = categories[0].get("keypoints")
    if not isinstance(names, list) or len(names) != keypoints.K:
        count = len(names) if isinstance(names, list) else "none"
        raise UserError(f"{path}: categories[0].keypoints: expected {keypoints.K} names, got {count}")
    if stated is None:  # somebody else's file: people mark what they see, as today's edition does
        scheme = next((s for s in keypoints.SCHEMES.values() if s.names == tuple(names)), SKOPE33)
    else:
        try:
            scheme = keypoints.scheme_in(info)
        except UserError as error:
            raise UserError(f"{path}: info.{error}") from None
    if tuple(names) != scheme.names:
        first = next(i for i, (a, b) in enumerate(zip(names, scheme.names, strict=True)) if a != b)
        raise UserError(
            f"{path}: categories[0].keypoints[{first}]: {names[first]!r} is not scheme {scheme.name}'s "
            f"{scheme.names[first]!r}"
        )
    return scheme


def _check_ids(path: Path, images: tuple[Image, ...], annotations: tuple[Annotation, ...]) -> None:
    by_id = {image.id: image for image in images}
    if len(by_id) != len(images):
        raise UserError(f"{path}: field images: two images share an id")
    seen: set[int] = set()
    for i, annotation in enumerate(annotations):
        if annotation.id in seen:
            raise UserError(f"{path}: annotations[{i}]: id {annotation.id} stands twice")
        seen.add(annotation.id)
        if annotation.image_id not in by_id:
            raise UserError(f"{path}: annotations[{i}]: image_id {annotation.image_id} is not among the images")


def image_from_dict(row: Mapping[str, Any]) -> Image:
    """One element of `images`; unknown fields are left out."""
    values = {name: row[name] for name in _IMAGE_FIELDS if name in row}
    for name in ("id", "file_name", "width", "height"):
        values[name] = row[name]
    if values.get("camera") is not None:
        values["camera"] = _camera(row["camera"], row["width"], row["height"])
    return Image(**values)


def _camera(row: Any, width: int, height: int) -> Camera:
    """The camera of an image; those of footage are all the same one, which is kept once."""
    return _known_camera(json_bytes([row, width, height]))


@lru_cache(maxsize=256)
def _known_camera(row_and_size: bytes) -> Camera:
    row, width, height = parse_json(row_and_size)
    return Camera.from_dict(row, width, height)


def annotation_from_dict(row: Mapping[str, Any]) -> Annotation:
    """One element of `annotations`; unknown fields are left out."""
    values = {name: row[name] for name in _ANNOTATION_FIELDS if name in row}
    for name in ("id", "image_id", "bbox", "keypoints"):
        values[name] = row[name]
    if "area" not in row:
        values["area"] = math.prod(schema.array("bbox", row["bbox"], 4)[2:].tolist())
    if values.get("box_3d") is not None:
        box = row["box_3d"]
        if not isinstance(box, Mapping):
            raise UserError(f"box_3d: expected an object with center, size_lwh, yaw and R, got {str(box)[:40]!r}")
        values["box_3d"] = Box3D(center=box["center"], size_lwh=box["size_lwh"], yaw=float(box["yaw"]), R=box["R"])
    return Annotation(**values)


def read_results(path: Path, foreign: str | None = None) -> tuple[Result, ...]:
    """Read a COCO keypoint results file; a result without `bbox` gets the extent of its keypoints of a score above 0.

    Args:
        path: A .json file with a list of results.
        foreign: The keypoints' scheme where it is not ours, one of `keypoints.FOREIGN_SCHEMES`. Points that mean the
            same as one of ours are taken over; our other points are 0.

    Raises:
        UserError: A result is malformed; it names file, result and field.
    """
    return tuple(iter_results(path, foreign))


def iter_results(path: Path, foreign: str | None = None) -> Iterator[Result]:
    """The results of `read_results` one by one.

    No more than one is in memory where the file has a line for each, as the files that skope writes.
    """
    return _parsed(path, "results", _result_rows(path), lambda row: result_from_dict(row, foreign))


def _result_rows(path: Path) -> Iterator[Any]:
    """The elements of a list, line by line as long as a line holds one, with the rest at once."""
    count = 0
    if path.is_file():
        with path.open("rb") as file:
            more = file.readline().strip() == b"["
            for line in file if more else ():
                text = line.strip()
                if text == b"]" and not more and not file.read().strip():
                    return
                try:
                    row = parse_json(text.removesuffix(b","))
                except ValueError:
                    break
                if not more:
                    break
                more = text.endswith(b",")
                yield row
                count += 1
    document = read_json(path)
    if not isinstance(document, list):
        raise UserError(f"{path}: expected a list of results, got a {type(document).__name__}")
    yield from document[count:]


def result_from_dict(row: Mapping[str, Any], foreign: str | None = None) -> Result:
    """One element of a results file (see `read_results`)."""
    theirs = schema.array("keypoints", row["keypoints"], keypoints.FOREIGN_K[foreign] if foreign else keypoints.K, 3)
    bbox = row.get("bbox")
    if bbox is None:
        found = theirs[theirs[:, 2] > 0, :2]
        if not len(found):
            raise UserError("bbox: missing, and no keypoint has a score")
        low, high = found.min(axis=0), found.max(axis=0)
        bbox = np.concatenate([low, high - low])
    points = theirs
    if foreign:
        table = keypoints.FOREIGN_SCHEMES[foreign]
        points = np.zeros((keypoints.K, 3))
        points[list(table.values())] = theirs[list(table)]
    return Result(
        image_id=row["image_id"],
        category_id=row.get("category_id", schema.CATEGORY_ID),
        bbox=bbox,
        keypoints=points,
        score=row["score"],
        interpolated=row.get("interpolated", False),
        track_id=row.get("track_id"),
        boxed=row.get("bbox") is not None,
    )


# ----------------------------------------------------------------------------------------------------------- writing


def _rounded(values: Any, digits: int) -> Any:
    """Numbers as numpy rounds them, of any shape; never -0.0, so that equal labels have equal bytes."""
    scale = 10.0**digits
    if isinstance(values, float):
        return round(values * scale) / scale
    array = np.asarray(values, dtype=np.float64)
    if array.ndim == 1:  # numpy takes longer to be called than to round a handful
        return [round(value * scale) / scale for value in array.tolist()]
    return (np.round(array, digits) + 0.0).tolist()


_DIGITS = {
    **dict.fromkeys(("bbox", "bbox_visible", "keypoints", "box_3d_pixels"), 2),
    **dict.fromkeys(("keypoints_3d", "velocity", "distance", "occlusion", "truncation"), 4),
    "contrast": 2,
}


def image_to_dict(image: Image) -> dict[str, Any]:
    """One element of `images`; fields that are None are left out."""
    row: dict[str, Any] = {}
    for name in _IMAGE_FIELDS:
        value = getattr(image, name)
        if value is not None:
            row[name] = value.to_dict() if isinstance(value, Camera) else value
    return row


def annotation_to_dict(annotation: Annotation) -> dict[str, Any]:
    """One element of `annotations`: 0.01 px and 0.1 mm, matrices unrounded; fields that are None are left out."""
    row: dict[str, Any] = {}
    for name in _ANNOTATION_FIELDS:
        value = getattr(annotation, name)
        if value is None:
            continue
        if isinstance(value, Box3D):
            value = {
                "center": _rounded(value.center, 4),
                "size_lwh": _rounded(value.size_lwh, 4),
                "yaw": value.yaw,
                "R": value.R.tolist(),
            }
        elif name == "keypoints":
            places = _rounded(value[:, :2], 2)
            value = [x for place, v in zip(places, value[:, 2].tolist(), strict=True) for x in (*place, int(v))]
        elif name in _DIGITS:
            value = _rounded(value, _DIGITS[name])
        row[name] = value
    row["num_keypoints"] = annotation.num_keypoints
    return row


def write(path: Path, file: AnnotationFile) -> None:
    """Write an annotation file, one record a line; the same records give the same bytes.

    Args:
        path: The .json file to write; it is replaced as a whole or not at all.
        file: Images and annotations. Pixels are rounded to 0.01, metres to 0.0001.
    """
    images, annotations = map(image_to_dict, file.images), map(annotation_to_dict, file.annotations)
    write_rows(path, file.info, images, annotations, file.scheme)


def write_rows(
    path: Path,
    info: Mapping[str, Any],
    images: Iterable[Mapping[str, Any]],
    annotations: Iterable[Mapping[str, Any]],
    scheme: Scheme = SKOPE33,
) -> None:
    """Write already serialised records (see `image_to_dict`, `annotation_to_dict`) as an annotation file."""
    write_lines(path, info, map(json_bytes, images), map(json_bytes, annotations), scheme)


def write_lines(
    path: Path,
    info: Mapping[str, Any],
    images: Iterable[bytes],
    annotations: Iterable[bytes],
    scheme: Scheme = SKOPE33,
) -> None:
    """Write records that are JSON already as an annotation file, a line each."""
    head = {**scheme.fields(), "schema_version": schema.VERSION, "skope": __version__}
    head |= {name: value for name, value in info.items() if name != "keypoint_edition"} | scheme.fields()
    begin = f'{{"info":{json.dumps(head)},\n"categories":{json.dumps([schema.category(scheme)])},\n"images":[\n'
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(begin.encode())
        file.writelines(_separated(images))
        file.write(b'\n],\n"annotations":[\n')
        file.writelines(_separated(annotations))
        file.write(b"\n]}\n")


def _separated(rows: Iterable[bytes]) -> Iterator[bytes]:
    for i, row in enumerate(rows):
        yield b",\n" + row if i else row


def result_to_dict(result: Result) -> dict[str, Any]:
    """One element of a results file; what was followed between key frames, most of it, is rounded to pixels."""
    return {
        "image_id": result.image_id,
        "category_id": result.category_id,
        "bbox": _rounded(result.bbox, 1 if result.interpolated else 2),
        "keypoints": _followed_points(result) if result.interpolated else _points(result),
        "score": round(result.score, 6),
        **({} if result.track_id is None else {"track_id": result.track_id}),
        **({"interpolated": True} if result.interpolated else {}),
    }


def _points(result: Result) -> list[float]:
    points = np.concatenate([np.round(result.keypoints[:, :2], 2), np.round(result.keypoints[:, 2:], 4)], axis=1)
    return list((points + 0.0).ravel().tolist())


def _followed_points(result: Result) -> list[float]:
    """Whole pixels, and probabilities in tenths."""
    places = np.rint(result.keypoints[:, :2]).astype(np.int64).tolist()
    sure = np.round(result.keypoints[:, 2], 1).tolist()
    return [value for (x, y), p in zip(places, sure, strict=True) for value in (x, y, int(p) if p in (0.0, 1.0) else p)]


def write_results(path: Path, results: Iterable[Result]) -> None:
    """Write a COCO results file, one result a line."""
    write_result_rows(path, map(result_to_dict, results))


def write_result_rows(path: Path, rows: Iterable[Mapping[str, Any]]) -> None:
    """Write already serialised results (see `result_to_dict`) as a COCO results file, one a line as they come."""
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(b"[\n")
        file.writelines(_separated(map(json_bytes, rows)))
        file.write(b"\n]\n")
