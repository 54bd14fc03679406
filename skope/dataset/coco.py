"""The only reader and writer of COCO JSON: annotation files and results files."""

import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from skope import keypoints, records, schema
from skope.camera.model import Camera
from skope.errors import UserError
from skope.files.atomic import replacing
from skope.files.json_files import json_bytes, parse_json, read_json
from skope.keypoints import SKOPE33, Scheme
from skope.schema import Annotation, AnnotationFile, Box3D, Image, Labelled, Result, RoadUser, RoadUserResult
from skope.version import __version__

T = TypeVar("T")

_IMAGE_FIELDS = tuple(Image.__dataclass_fields__)
_ANNOTATION_FIELDS = (
    "id", "image_id", "bbox", "keypoints", "area", "iscrowd", "segmentation", "category_id", "track_id", "model",
    "vehicle_type", "color", "parked", "bbox_visible", "area_full", "keypoints_3d", "box_3d", "box_3d_pixels",
    "articulation", "velocity", "distance", "occlusion", "truncation", "contrast", "ignore_reason",
)  # fmt: skip
"""Fields of `Annotation` in the order in which files have them."""
_ROAD_USER_FIELDS = tuple(name for name in _ANNOTATION_FIELDS if name in RoadUser.__dataclass_fields__)
_NO_KEYPOINTS = [0] * (3 * keypoints.K)
"""Keypoints of a road user's row, all unlabelled (v = 0), because torchvision's readers require keypoints in every
row."""


# ----------------------------------------------------------------------------------------------------------- reading


def read(path: Path) -> AnnotationFile:
    """Read an annotation file.

    Args:
        path: A file of skope, or any COCO keypoints file with the 33 keypoints of one of `keypoints.SCHEMES`. It has a
            single category, or `vehicle` and others of `schema.CATEGORY_NAMES` with their ids.

    Raises:
        UserError: A value is missing, malformed or inconsistent; the message names file, record and field.
    """
    document = read_json(path)
    if not isinstance(document, dict):
        raise UserError(f"{path}: expected a COCO object with images and annotations, got a {type(document).__name__}")
    categories = _categories(path, document)
    scheme = _scheme(path, document)
    images = _records(path, document, "images", image_from_dict)
    labels = _records(path, document, "annotations", _label_parser(categories))
    _check_ids(path, images, labels)
    return AnnotationFile(
        images=images,
        info=document.get("info") or {},
        name=path.stem,
        scheme=scheme,
        categories=categories,
        **_by_kind(labels),
    )


def assembled(
    rows: Iterable[tuple[Mapping[str, Any], list[Any]]],
    path: Path,
    split: str,
    scheme: Scheme,
    categories: tuple[str, ...] = schema.VEHICLE_ALONE,
) -> AnnotationFile:
    """Build an annotation file from JSON rows.

    Args:
        rows: Row of each image, with the rows of its annotations.
        path: Path of the file, used only in error messages.
        split: Name of the split.
        scheme: Scheme of the keypoints.
        categories: Names of the categories that were labelled.
    """
    images: list[Image] = []
    labels: list[Annotation | RoadUser] = []
    parse = _label_parser(categories)
    for image, annotation_rows in rows:
        images += images_of(path, [image])
        labels += _parse_rows(path, "annotations", annotation_rows, parse)
    _check_ids(path, images, labels)
    info = {"split": split, **scheme.fields(), "schema_version": schema.SCHEMA_VERSION}
    return AnnotationFile(
        images=tuple(images), info=info, name=split, scheme=scheme, categories=categories, **_by_kind(labels)
    )


def _by_kind(labels: Iterable[Annotation | RoadUser]) -> dict[str, Any]:
    """Return the fields of `AnnotationFile` with vehicles and other road users."""
    labels = tuple(labels)
    return {
        "annotations": tuple(label for label in labels if isinstance(label, Annotation)),
        "road_users": tuple(label for label in labels if isinstance(label, RoadUser)),
    }


def _label_parser(categories: tuple[str, ...]) -> Callable[[Mapping[str, Any]], Annotation | RoadUser]:
    """Return a parser of elements of `annotations` in a file of these categories.

    If vehicles are the only category, each row is a vehicle, whatever its category id.
    """

    def parse(row: Mapping[str, Any]) -> Annotation | RoadUser:
        number = row.get("category_id", schema.CATEGORY_ID)
        if len(categories) == 1 or number == schema.CATEGORY_ID:
            return annotation_from_dict(row)
        if number not in (schema.CATEGORY_NAMES.index(name) + 1 for name in categories):
            raise UserError(f"category_id: {number!r} is none of the file's categories")
        return road_user_from_dict(row)

    return parse


def images_of(path: Path, rows: Iterable[Any]) -> tuple[Image, ...]:
    """Return the elements of `images`.

    Raises UserError with the record and the invalid field. `path` is used only in error messages.
    """
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


def _categories(path: Path, document: Mapping[str, Any]) -> tuple[str, ...]:
    """Return a file's category names: `vehicle` for a single category, whatever its name, else several of skope's."""
    rows = document.get("categories")
    if not isinstance(rows, list) or not rows or not all(isinstance(row, dict) for row in rows):
        raise UserError(f"{path}: field categories: expected exactly one category")
    if len(rows) == 1:
        return schema.VEHICLE_ALONE
    ours = dict(enumerate(schema.CATEGORY_NAMES, start=1))
    found = [(row.get("id"), row.get("name")) for row in rows]
    if found[0][0] != schema.CATEGORY_ID or any(ours.get(number) != name for number, name in found[1:]):
        listed = ", ".join(f"{number} {name}" for number, name in ours.items())
        raise UserError(f"{path}: field categories: expected exactly one category, or the first of {listed} and others")
    if len(set(found)) != len(found):
        raise UserError(f"{path}: field categories: a category stands twice")
    return schema.checked_categories(["vehicle", *(name for _, name in found[1:])])


def _scheme(path: Path, document: Mapping[str, Any]) -> Scheme:
    """Return the scheme that a file names, or else the scheme with the keypoint names of its first category."""
    info = document.get("info")
    info = info if isinstance(info, dict) else {}
    stated = info.get("keypoint_scheme")
    categories = document["categories"]
    names = categories[0].get("keypoints")
    if not isinstance(names, list) or len(names) != keypoints.K:
        count = len(names) if isinstance(names, list) else "none"
        raise UserError(f"{path}: categories[0].keypoints: expected {keypoints.K} names, got {count}")
    if stated is None:  # a file of another source, in which people marked visible points
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


def _check_ids(path: Path, images: Sequence[Image], annotations: Sequence[Labelled]) -> None:
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
    """Return an element of `images`; unknown fields are omitted."""
    values = {name: row[name] for name in _IMAGE_FIELDS if name in row}
    for name in ("id", "file_name", "width", "height"):
        values[name] = row[name]
    if values.get("camera") is not None:
        values["camera"] = _camera(row["camera"], row["width"], row["height"])
    return Image(**values)


def _camera(row: Any, width: int, height: int) -> Camera:
    """Return the camera of an image; equal cameras of footage share one object."""
    return _known_camera(json_bytes([row, width, height]))


@lru_cache(maxsize=256)
def _known_camera(row_and_size: bytes) -> Camera:
    row, width, height = parse_json(row_and_size)
    return Camera.from_dict(row, width, height)


def annotation_from_dict(row: Mapping[str, Any]) -> Annotation:
    """Return a vehicle from an element of `annotations`; unknown fields are omitted."""
    return Annotation(**_values(row, _ANNOTATION_FIELDS, ("id", "image_id", "bbox", "keypoints")))


def road_user_from_dict(row: Mapping[str, Any]) -> RoadUser:
    """Return another road user from an element of `annotations`; unknown fields and keypoints are omitted."""
    return RoadUser(**_values(row, _ROAD_USER_FIELDS, ("id", "image_id", "bbox", "category_id")))


def _values(row: Mapping[str, Any], fields: Iterable[str], needed: Iterable[str]) -> dict[str, Any]:
    """Return the fields of an annotation or road user in a row; a KeyError if a required field is missing."""
    values = {name: row[name] for name in fields if name in row}
    for name in needed:
        values[name] = row[name]
    if "area" not in row:
        values["area"] = math.prod(records.check_array("bbox", row["bbox"], 4)[2:].tolist())
    if values.get("box_3d") is not None:
        box = row["box_3d"]
        if not isinstance(box, Mapping):
            raise UserError(f"box_3d: expected an object with center, size_lwh, yaw and R, got {str(box)[:40]!r}")
        values["box_3d"] = Box3D(center=box["center"], size_lwh=box["size_lwh"], yaw=float(box["yaw"]), R=box["R"])
    return values


def read_results(path: Path, foreign: str | None = None) -> tuple[Result, ...]:
    """Read the vehicles of a COCO results file.

    A result without `bbox` gets the extent of its keypoints with a score above 0.

    Args:
        path: A .json file with a list of results.
        foreign: Scheme of the keypoints if it is not skope's, one of `keypoints.FOREIGN_SCHEMES` or
            `keypoints.BOX_SCHEMES`. Points with the same meaning are taken over; all other points are 0.

    Raises:
        UserError: A result is malformed; the message names file, result and field.
    """
    return tuple(iter_results(path, foreign))


def read_road_user_results(path: Path) -> tuple[RoadUserResult, ...]:
    """Read the pedestrians and two-wheelers of a COCO results file. Raises UserError if a result is malformed."""
    return tuple(result for result in iter_all_results(path) if isinstance(result, RoadUserResult))


def iter_results(path: Path, foreign: str | None = None) -> Iterator[Result]:
    """Yield the results of `read_results` one by one.

    Only one result is in memory if each is on its own line, as in files that skope writes.
    """
    return (result for result in iter_all_results(path, foreign) if isinstance(result, Result))


def iter_all_results(path: Path, foreign: str | None = None) -> Iterator[Result | RoadUserResult]:
    """Yield the results of a file in its order, of vehicles and of other road users (see `iter_results`)."""
    return (result for _, result in numbered_results(path, foreign))


def numbered_results(path: Path, foreign: str | None = None) -> Iterator[tuple[int, Result | RoadUserResult]]:
    """Yield the results of `iter_all_results`, each with its index in the file.

    Results of COCO categories that are no road users are left out (scheme `coco`).
    """

    def parse(row: Mapping[str, Any]) -> Result | RoadUserResult | None:
        if foreign in keypoints.BOX_SCHEMES:
            return _box_from_dict(row, schema.COCO_IDS if foreign == "coco" else None)
        return any_result_from_dict(row, foreign)

    parsed = _parsed(path, "results", _result_rows(path), parse)
    return ((i, result) for i, result in enumerate(parsed) if result is not None)


def _result_rows(path: Path) -> Iterator[Any]:
    """Yield the elements of a list, line by line while each line contains one, and the rest at once."""
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


def any_result_from_dict(row: Mapping[str, Any], foreign: str | None = None) -> Result | RoadUserResult:
    """Return an element of a results file: a road user if it has such a category and no keypoints.

    Other programs number their vehicles differently; theirs have keypoints. All elements with `foreign` are vehicles.
    """
    if foreign is None and "keypoints" not in row:
        if row.get("category_id") in schema.ROAD_USER_IDS:
            return RoadUserResult(
                image_id=row["image_id"],
                category_id=row["category_id"],
                bbox=row["bbox"],
                score=row["score"],
                interpolated=row.get("interpolated", False),
                track_id=row.get("track_id"),
            )
        raise UserError("field keypoints is missing (for results that are boxes alone: --scheme boxes or coco)")
    return result_from_dict(row, foreign)


def _box_from_dict(row: Mapping[str, Any], ids: Mapping[int, int] | None) -> Result | RoadUserResult | None:
    """Return an element of a results file whose vehicles have no keypoints; None if it is no road user.

    `ids` are the ids of skope's categories by those of the file; None: they are the same.
    """
    category = row["category_id"] if ids is None else ids.get(row["category_id"])
    if category is None:
        return None
    own = {name: row[name] for name in ("image_id", "bbox", "score")} | {"category_id": category}
    return any_result_from_dict(own if category in schema.ROAD_USER_IDS else own | {"keypoints": _NO_KEYPOINTS})


def result_from_dict(row: Mapping[str, Any], foreign: str | None = None) -> Result:
    """Return a vehicle from an element of a results file (see `read_results`)."""
    theirs = records.check_array(
        "keypoints", row["keypoints"], keypoints.FOREIGN_K[foreign] if foreign else keypoints.K, 3
    )
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
    """Return numbers rounded as by numpy, of any shape; never -0.0, so that equal labels have equal bytes."""
    scale = 10.0**digits
    if isinstance(values, float):
        return round(values * scale) / scale
    array = np.asarray(values, dtype=np.float64)
    if array.ndim == 1:  # calling numpy takes longer than rounding a few numbers
        return [round(value * scale) / scale for value in array.tolist()]
    return (np.round(array, digits) + 0.0).tolist()


_FIELD_DIGITS = {
    **dict.fromkeys(("bbox", "bbox_visible", "box_3d_pixels"), 2),
    **dict.fromkeys(("keypoints_3d", "velocity", "distance", "occlusion", "truncation"), 4),
    "contrast": 2,
}


def image_to_dict(image: Image) -> dict[str, Any]:
    """Return an element of `images`, without fields that are None."""
    row: dict[str, Any] = {}
    for name in _IMAGE_FIELDS:
        value = getattr(image, name)
        if value is not None:
            row[name] = value.to_dict() if isinstance(value, Camera) else value
    return row


def annotation_to_dict(annotation: Annotation) -> dict[str, Any]:
    """Return a vehicle's element of `annotations`, without fields that are None.

    Pixels are rounded to 0.01 and metres to 0.1 mm; matrices are not rounded.
    """
    row = _label_row(annotation, _ANNOTATION_FIELDS)
    places = _rounded(annotation.keypoints[:, :2], 2)
    visible = annotation.keypoints[:, 2].tolist()
    row["keypoints"] = [x for point, v in zip(places, visible, strict=True) for x in (*point, int(v))]
    row["num_keypoints"] = annotation.num_keypoints
    return row


def road_user_to_dict(user: RoadUser) -> dict[str, Any]:
    """Return a road user's element of `annotations`, rounded as a vehicle's, with unlabelled keypoints."""
    return _label_row(user, _ROAD_USER_FIELDS) | {"keypoints": _NO_KEYPOINTS, "num_keypoints": 0}


def _label_row(label: Labelled, fields: Iterable[str]) -> dict[str, Any]:
    row: dict[str, Any] = {}
    for name in fields:
        value = getattr(label, name)
        if value is None:
            continue
        if isinstance(value, Box3D):
            value = {
                "center": _rounded(value.center, 4),
                "size_lwh": _rounded(value.size_lwh, 4),
                "yaw": value.yaw,
                "R": value.R.tolist(),
            }
        elif name in _FIELD_DIGITS:
            value = _rounded(value, _FIELD_DIGITS[name])
        row[name] = value
    return row


def write(path: Path, file: AnnotationFile) -> None:
    """Write an annotation file, one record per line; equal records give equal bytes.

    Args:
        path: The .json file to write, which is replaced atomically.
        file: Images and annotations. Pixels are rounded to 0.01, metres to 0.0001.
    """
    write_rows(path, file.info, map(image_to_dict, file.images), label_rows(file), file.scheme, file.categories)


def label_rows(file: AnnotationFile) -> Iterator[dict[str, Any]]:
    """Yield the elements of `annotations` in file order; with road users by image, vehicles first."""
    if not file.road_users:
        yield from map(annotation_to_dict, file.annotations)
        return
    for labels in file.labels_by_image().values():
        yield from (
            annotation_to_dict(label) if isinstance(label, Annotation) else road_user_to_dict(label) for label in labels
        )


def write_rows(
    path: Path,
    info: Mapping[str, Any],
    images: Iterable[Mapping[str, Any]],
    annotations: Iterable[Mapping[str, Any]],
    scheme: Scheme = SKOPE33,
    categories: tuple[str, ...] = schema.VEHICLE_ALONE,
) -> None:
    """Write records in dictionary form (see `image_to_dict`, `label_rows`) as an annotation file.

    Args:
        path: The .json file to write, which is replaced atomically.
        info: Further fields of the file's `info`.
        images: Elements of `images`.
        annotations: Elements of `annotations`.
        scheme: Definition of the keypoints.
        categories: Names of the categories that the file declares.
    """
    write_lines(path, info, map(json_bytes, images), map(json_bytes, annotations), scheme, categories)


def write_lines(
    path: Path,
    info: Mapping[str, Any],
    images: Iterable[bytes],
    annotations: Iterable[bytes],
    scheme: Scheme = SKOPE33,
    categories: tuple[str, ...] = schema.VEHICLE_ALONE,
) -> None:
    """Write records in JSON form as an annotation file, one per line.

    Args:
        path: The .json file to write, which is replaced atomically.
        info: Further fields of the file's `info`; fields of `scheme` take precedence.
        images: Elements of `images`, JSON each.
        annotations: Elements of `annotations`, JSON each.
        scheme: Definition of the keypoints.
        categories: Names of the categories that the file declares.
    """
    head = {**scheme.fields(), "schema_version": schema.SCHEMA_VERSION, "skope": __version__}
    head |= {**info, **scheme.fields()}
    listed = json.dumps(schema.category_rows(categories, scheme))
    begin = f'{{"info":{json.dumps(head)},\n"categories":{listed},\n"images":[\n'
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(begin.encode())
        file.writelines(_separated(images))
        file.write(b'\n],\n"annotations":[\n')
        file.writelines(_separated(annotations))
        file.write(b"\n]}\n")


def _separated(rows: Iterable[bytes]) -> Iterator[bytes]:
    for i, row in enumerate(rows):
        yield b",\n" + row if i else row


def result_to_dict(result: Result | RoadUserResult) -> dict[str, Any]:
    """Return an element of a results file. Results that are interpolated between key frames are rounded to pixels.

    A road user's element has no keypoints: pycocotools takes results with a box for boxes.
    """
    points = {}
    if isinstance(result, Result):
        points["keypoints"] = _followed_points(result) if result.interpolated else _points(result)
    return {
        "image_id": result.image_id,
        "category_id": result.category_id,
        "bbox": _rounded(result.bbox, 1 if result.interpolated else 2),
        **points,
        "score": round(result.score, 6),
        **({} if result.track_id is None else {"track_id": result.track_id}),
        **({"interpolated": True} if result.interpolated else {}),
    }


def _points(result: Result) -> list[float]:
    points = np.concatenate([np.round(result.keypoints[:, :2], 2), np.round(result.keypoints[:, 2:], 4)], axis=1)
    return list((points + 0.0).ravel().tolist())


def _followed_points(result: Result) -> list[float]:
    """Return whole pixels, and probabilities in tenths."""
    places = np.rint(result.keypoints[:, :2]).astype(np.int64).tolist()
    sure = np.round(result.keypoints[:, 2], 1).tolist()
    return [value for (x, y), p in zip(places, sure, strict=True) for value in (x, y, int(p) if p in (0.0, 1.0) else p)]


def write_results(path: Path, results: Iterable[Result | RoadUserResult]) -> None:
    """Write a COCO results file, one result per line."""
    write_result_rows(path, map(result_to_dict, results))


def write_result_rows(path: Path, rows: Iterable[Mapping[str, Any]]) -> None:
    """Write serialised results (see `result_to_dict`) as a COCO results file, one per line as they arrive."""
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(b"[\n")
        file.writelines(_separated(map(json_bytes, rows)))
        file.write(b"\n]\n")
