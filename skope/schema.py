"""The annotation schema: COCO keypoints with what a roadside camera knows besides.

Frozen records, checked where they are made; a UserError names the field, what was expected and what came. Fields that
plain COCO files do not have are optional, so that the same records hold anybody's annotations.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skope import keypoints
from skope.camera.model import Camera
from skope.errors import UserError, one_of
from skope.files import safe_names
from skope.keypoints import SKOPE33, Scheme
from skope.types import Array

VERSION: Final = 1
CATEGORY_ID: Final = 1

VEHICLE_TYPES: Final = (
    "city_car", "hatchback", "sedan", "coupe", "wagon", "suv", "minivan", "pickup", "van", "box_truck", "bus", "truck",
    "articulated_truck", "articulated_bus", "other",
)  # fmt: skip
COLORS: Final = (
    "white", "black", "grey", "silver", "blue", "red", "brown", "green", "orange", "yellow", "gold", "purple", "other",
)  # fmt: skip
WEATHERS: Final = ("clear", "cloudy", "overcast", "rain", "after_rain", "fog", "snow")
_OUTSIDE_SHARE: Final = 0.1
_OUTSIDE_PX: Final = 2.0
IGNORE_REASONS: Final = ("occluded", "sliver", "small", "unseen")


def category(scheme: Scheme = SKOPE33) -> dict[str, Any]:
    """The one COCO category, `vehicle`, with names, 1-based skeleton and sigmas."""
    return {
        "id": CATEGORY_ID,
        "name": "vehicle",
        "supercategory": "vehicle",
        "keypoints": list(scheme.names),
        "skeleton": [[a + 1, b + 1] for a, b in scheme.skeleton],
        "keypoint_sigmas": list(scheme.sigmas),
    }


def array(name: str, value: Any, *shape: int) -> Array:
    """`value` as a float array of `shape`, or a UserError that names the field."""
    try:
        result = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise UserError(f"{name}: expected numbers, got {str(value)[:60]!r}") from None
    if result.size != math.prod(shape):
        expected = " x ".join(map(str, shape))
        raise UserError(f"{name}: expected {expected} numbers, got {result.size}")
    if not np.isfinite(result).all():
        raise UserError(f"{name}: not all numbers are finite")
    return result.reshape(shape)


def _integer(name: str, value: Any, least: int) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise UserError(f"{name}: expected a whole number from {least}, got {value!r}")
    return value


def _share(name: str, value: float | None) -> None:
    if value is not None and not (isinstance(value, int | float) and 0 <= value <= 1):
        raise UserError(f"{name}: expected a share from 0 to 1, got {value!r}")


def _choice(name: str, value: str | None, choices: tuple[str, ...]) -> None:
    if value is not None:
        one_of(name, value, choices)


@dataclass(frozen=True, kw_only=True, eq=False)
class Image:
    """One frame of one camera. Paths are relative to the dataset folder, with forward slashes."""

    id: int
    file_name: str
    width: int
    height: int
    depth_file_name: str | None = None
    town: str | None = None
    site: str | None = None
    recording: str | None = None
    frame_index: int | None = None
    time_s: float | None = None
    split: str | None = None
    weather: str | None = None
    sun_elevation_deg: float | None = None
    camera: Camera | None = None

    def __post_init__(self) -> None:
        _integer("id", self.id, 0)
        _integer("width", self.width, 1)
        _integer("height", self.height, 1)
        safe_names.relative("file_name", self.file_name)
        if self.depth_file_name is not None:
            safe_names.relative("depth_file_name", self.depth_file_name)
        for field_name in ("town", "site", "recording", "split"):
            value = getattr(self, field_name)
            if value is not None:
                safe_names.name(field_name, value)
        if self.frame_index is not None:
            _integer("frame_index", self.frame_index, 0)
        _choice("weather", self.weather, WEATHERS)


@dataclass(frozen=True, kw_only=True, eq=False)
class Box3D:
    """An oriented box in the world frame, metres and radians, without mirrors and antennas."""

    center: Array
    """(3,) middle of the box."""
    size_lwh: Array
    """(3,) length, width, height."""
    yaw: float
    """Heading, radians, counter-clockwise from world x."""
    R: Array
    """(3, 3) turns vehicle axes (x forward, y left, z up) into world axes."""

    def __post_init__(self) -> None:
        for name, shape in (("center", (3,)), ("size_lwh", (3,)), ("R", (3, 3))):
            object.__setattr__(self, name, array(f"box_3d.{name}", getattr(self, name), *shape))
        if (self.size_lwh <= 0).any():
            raise UserError("box_3d.size_lwh: expected three positive lengths")


@dataclass(frozen=True, kw_only=True, eq=False)
class Annotation:
    """One vehicle in one image."""

    id: int
    image_id: int
    bbox: Array
    """(4,) x, y, width, height: the whole silhouette as if nothing stood before it, clipped to the image."""
    keypoints: Array
    """(33, 3) x, y, v: v = 2 visible, 1 inside the image but hidden, 0 (x = y = 0) outside or unlabelled."""
    area: float
    """Number of visible pixels."""
    iscrowd: int = 0
    """1: an ignored vehicle, neither ground truth nor background."""
    segmentation: Mapping[str, Any] | list[Any] | None = None
    """COCO RLE of the visible pixels."""
    category_id: int = CATEGORY_ID
    track_id: int | None = None
    model: str | None = None
    vehicle_type: str | None = None
    color: str | None = None
    parked: bool | None = None
    bbox_visible: Array | None = None
    """(4,) box of the visible pixels."""
    area_full: float | None = None
    """Number of the whole silhouette's pixels inside the image."""
    keypoints_3d: Array | None = None
    """(33, 3) world positions of all keypoints, whatever v says, metres."""
    box_3d: Box3D | None = None
    box_3d_pixels: Array | None = None
    """(8, 2) corners of the 3D box in the image, where a dataset has those and no camera."""
    articulation: float | None = None
    """Of an articulated vehicle: heading of the trailer minus that of the vehicle before it, radians."""
    velocity: Array | None = None
    """(3,) velocity in the world, m/s."""
    distance: float | None = None
    """Camera to the middle of the 3D box, metres."""
    occlusion: float | None = None
    """Share of the silhouette's pixels inside the image that something else hides."""
    truncation: float | None = None
    """Share of the silhouette outside the image."""
    contrast: float | None = None
    """Mean absolute difference that the vehicle makes on its visible pixels, in units of the noise's sigma."""
    ignore_reason: str | None = None

    def __post_init__(self) -> None:
        _integer("id", self.id, 0)
        _integer("image_id", self.image_id, 0)
        _integer("category_id", self.category_id, 0)
        if self.track_id is not None:
            _integer("track_id", self.track_id, 0)
        if self.iscrowd not in (0, 1):
            raise UserError(f"iscrowd: expected 0 or 1, got {self.iscrowd!r}")
        shapes: tuple[tuple[str, tuple[int, ...]], ...] = (
            ("bbox", (4,)),
            ("keypoints", (keypoints.K, 3)),
            ("bbox_visible", (4,)),
            ("keypoints_3d", (keypoints.K, 3)),
            ("box_3d_pixels", (8, 2)),
            ("velocity", (3,)),
        )
        for name, shape in shapes:
            value = getattr(self, name)
            if value is not None or name in ("bbox", "keypoints"):
                object.__setattr__(self, name, array(name, value, *shape))
        if (self.bbox[2:] < 0).any():
            raise UserError(f"bbox: width and height must not be negative, got {self.bbox.tolist()}")
        v = self.keypoints[:, 2]
        if not ((v == 0) | (v == 1) | (v == 2)).all():  # np.isin takes five times as long
            raise UserError("keypoints: v is 0, 1 or 2")
        for name in ("area", "area_full", "distance", "contrast"):
            value = getattr(self, name)
            if value is None and name != "area":
                continue
            if not isinstance(value, int | float) or not math.isfinite(value) or value < 0:
                raise UserError(f"{name}: expected a number from 0, got {value!r}")
        if self.articulation is not None:
            angle = self.articulation
            if isinstance(angle, bool) or not isinstance(angle, int | float) or not abs(angle) <= math.pi:
                raise UserError(f"articulation: expected radians from -pi to pi, got {angle!r}")
        _share("occlusion", self.occlusion)
        _share("truncation", self.truncation)
        _choice("vehicle_type", self.vehicle_type, VEHICLE_TYPES)
        _choice("color", self.color, COLORS)
        _choice("ignore_reason", self.ignore_reason, IGNORE_REASONS)

    @property
    def ignored(self) -> bool:
        return self.iscrowd == 1

    @property
    def num_keypoints(self) -> int:
        return int((self.keypoints[:, 2] > 0).sum())


def far_outside(annotation: Annotation) -> NDArray[np.bool_]:
    """(33,) which labelled keypoints lie outside of the vehicle's box by more than a tenth of its longer edge, or 2 px.

    The box is that of the whole vehicle as far as the image shows it: such a point cannot be seen on it.
    """
    low, size = annotation.bbox[:2], annotation.bbox[2:]
    points = annotation.keypoints[:, :2]
    away = np.maximum(low - points, points - low - size).max(axis=1)
    far: NDArray[np.bool_] = (annotation.keypoints[:, 2] > 0) & (away > max(_OUTSIDE_SHARE * size.max(), _OUTSIDE_PX))
    return far


@dataclass(frozen=True, kw_only=True, eq=False)
class AnnotationFile:
    """One split: images and the vehicles in them, in file order."""

    images: tuple[Image, ...]
    annotations: tuple[Annotation, ...]
    info: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))
    name: str = ""
    """The split's name: the file's stem."""
    scheme: Scheme = SKOPE33
    """Keypoint scheme of the file."""

    def by_image(self) -> dict[int, list[Annotation]]:
        """Annotations of each image id, in file order; images without a vehicle have an empty list."""
        groups: dict[int, list[Annotation]] = {image.id: [] for image in self.images}
        for annotation in self.annotations:
            groups[annotation.image_id].append(annotation)
        return groups


@dataclass(frozen=True, kw_only=True, eq=False)
class Result:
    """One predicted vehicle of a COCO results file."""

    image_id: int
    score: float
    """Confidence, 0 to 1."""
    bbox: Array
    """(4,) x, y, width, height."""
    keypoints: Array
    """(33, 3) x, y, probability that the point is right."""
    category_id: int = CATEGORY_ID
    interpolated: bool = False
    """Whether it was followed from other frames, and no detector has seen it in this one."""
    track_id: int | None = None
    """Number of the vehicle among those of its video, which results of other frames share; None: not known."""
    boxed: bool = True
    """Whether its file has a box for it; else that is the extent of the keypoints that were found."""

    def __post_init__(self) -> None:
        _integer("image_id", self.image_id, 0)
        _integer("category_id", self.category_id, 0)
        if self.track_id is not None:
            _integer("track_id", self.track_id, 0)
        if not isinstance(self.interpolated, bool):
            raise UserError(f"interpolated: expected true or false, got {self.interpolated!r}")
        object.__setattr__(self, "bbox", array("bbox", self.bbox, 4))
        object.__setattr__(self, "keypoints", array("keypoints", self.keypoints, keypoints.K, 3))
        if isinstance(self.score, bool) or not isinstance(self.score, int | float) or not 0 <= self.score <= 1:
            raise UserError(f"score: expected a number from 0 to 1, got {self.score!r}")
