"""Annotation schema: COCO keypoints and further fields of roadside cameras.

The records are frozen and checked when they are made. A UserError names the field, the expected and the actual value.
Fields that plain COCO files lack are optional, so that the same records hold annotations from other sources.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Final, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from skope import keypoints
from skope.camera.model import Camera
from skope.errors import UserError
from skope.files import safe_names
from skope.keypoints import SKOPE33, Scheme
from skope.records import check_array, check_choice, check_number, check_share, check_whole, is_number
from skope.types import Array

SCHEMA_VERSION: Final = 1
VEHICLE_CATEGORY: Final = "vehicle"
"""Category of all vehicles with more than two wheels."""
PEDESTRIAN_CATEGORY: Final = "pedestrian"
"""Category of pedestrians."""
CATEGORY_NAMES: Final = (VEHICLE_CATEGORY, "bicycle", "motorcycle", PEDESTRIAN_CATEGORY)
"""Names of the categories; ids count from 1. Only vehicles have keypoints. A rider is part of the two-wheeler."""
VEHICLE_ALONE: Final = CATEGORY_NAMES[:1]
"""Categories of a file in which only vehicles are labelled."""
CATEGORY_ID: Final = 1
"""Id of the category `VEHICLE_CATEGORY`."""
ROAD_USER_IDS: Final = (2, 3, 4)
"""Ids of the categories without keypoints."""
COCO_IDS: Final = {1: 4, 2: 2, 3: 1, 4: 3, 6: 1, 8: 1}
"""Id of a category in COCO (person, bicycle, car, motorcycle, bus, truck) -> id in `CATEGORY_NAMES`."""
SUPERCATEGORY_NAMES: Final = ("vehicle", "vehicle", "vehicle", "person")

VEHICLE_TYPES: Final = (
    "city_car", "hatchback", "sedan", "coupe", "wagon", "suv", "minivan", "pickup", "van", "box_truck", "bus", "truck",
    "articulated_truck", "articulated_bus", "other",
)  # fmt: skip
VEHICLE_COLORS: Final = (
    "white", "black", "grey", "silver", "blue", "red", "brown", "green", "orange", "yellow", "gold", "purple", "other",
)  # fmt: skip
WEATHER_NAMES: Final = ("clear", "cloudy", "overcast", "rain", "after_rain", "fog", "snow")


@dataclass(frozen=True)
class KeypointTolerance:
    """Maximum distance of a labelled keypoint outside its box."""

    share: float = 0.1
    """Share of the box's longer edge."""
    pixels: float = 2.0
    """Minimum tolerance, pixels."""


KEYPOINT_TOLERANCE: Final = KeypointTolerance()

IGNORE_REASONS: Final = ("occluded", "sliver", "small", "unseen")


def category(scheme: Scheme = SKOPE33) -> dict[str, Any]:
    """Return the COCO category `vehicle`, with names, 1-based skeleton and sigmas."""
    return {
        "id": CATEGORY_ID,
        "name": "vehicle",
        "supercategory": "vehicle",
        "keypoints": list(scheme.names),
        "skeleton": [[a + 1, b + 1] for a, b in scheme.skeleton],
        "keypoint_sigmas": list(scheme.sigmas),
    }


def category_rows(categories: Iterable[str], scheme: Scheme = SKOPE33) -> list[dict[str, Any]]:
    """Return the COCO categories of these names; those without keypoints have empty lists, as pycocotools requires."""
    rows = [category(scheme)]
    for name in categories:
        if name != "vehicle":
            which = CATEGORY_NAMES.index(name)
            kind = SUPERCATEGORY_NAMES[which]
            rows.append({"id": which + 1, "name": name, "supercategory": kind, "keypoints": [], "skeleton": []})
    return rows


def checked_categories(categories: Iterable[str]) -> tuple[str, ...]:
    """Return category names in the order of their ids.

    Raises UserError if a name is unknown or `vehicle` is missing.
    """
    names = tuple(categories)
    for name in names:
        check_choice("categories", name, CATEGORY_NAMES)
    if "vehicle" not in names:
        raise UserError(f"categories: expected vehicle among {', '.join(names) or 'no names'}")
    return tuple(name for name in CATEGORY_NAMES if name in names)


@dataclass(frozen=True, kw_only=True, eq=False)
class Image:
    """Frame of a camera. Paths are relative to the dataset folder, with forward slashes."""

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
        check_whole("id", self.id, 0)
        check_whole("width", self.width, 1)
        check_whole("height", self.height, 1)
        safe_names.relative("file_name", self.file_name)
        if self.depth_file_name is not None:
            safe_names.relative("depth_file_name", self.depth_file_name)
        for field_name in ("town", "site", "recording", "split"):
            value = getattr(self, field_name)
            if value is not None:
                safe_names.name(field_name, value)
        if self.frame_index is not None:
            check_whole("frame_index", self.frame_index, 0)
        check_choice("weather", self.weather, WEATHER_NAMES)


@dataclass(frozen=True, kw_only=True, eq=False)
class Box3D:
    """Oriented box in the world frame, metres and radians, without mirrors and antennas."""

    center: Array
    """(3,) middle of the box."""
    size_lwh: Array
    """(3,) length, width, height."""
    yaw: float
    """Heading, radians, counter-clockwise from world x."""
    R: Array
    """(3, 3) rotation from vehicle axes (x forward, y left, z up) to world axes."""

    def __post_init__(self) -> None:
        for name, shape in (("center", (3,)), ("size_lwh", (3,)), ("R", (3, 3))):
            object.__setattr__(self, name, check_array(f"box_3d.{name}", getattr(self, name), *shape))
        if (self.size_lwh <= 0).any():
            raise UserError("box_3d.size_lwh: expected three positive lengths")


@dataclass(frozen=True, kw_only=True, eq=False)
class Labelled:
    """Base of the labels of vehicles, riders and pedestrians in one image."""

    id: int
    image_id: int
    bbox: Array
    """(4,) x, y, width, height of the whole silhouette, as if nothing occluded it, clipped to the image."""
    area: float
    """Number of visible pixels."""
    iscrowd: int = 0
    """1 for ignored: neither ground truth nor background."""
    segmentation: Mapping[str, Any] | list[Any] | None = None
    """COCO RLE of the visible pixels."""
    track_id: int | None = None
    bbox_visible: Array | None = None
    """(4,) box of the visible pixels."""
    area_full: float | None = None
    """Number of pixels of the whole silhouette inside the image."""
    box_3d: Box3D | None = None
    velocity: Array | None = None
    """(3,) velocity in the world, m/s."""
    distance: float | None = None
    """Distance from the camera to the middle of the 3D box, metres."""
    occlusion: float | None = None
    """Hidden share of the silhouette's pixels inside the image."""
    truncation: float | None = None
    """Share of the silhouette outside the image."""
    contrast: float | None = None
    """Mean absolute difference of its visible pixels to the image without it, in units of the noise's sigma."""
    ignore_reason: str | None = None

    def __post_init__(self) -> None:
        check_whole("id", self.id, 0)
        check_whole("image_id", self.image_id, 0)
        if self.track_id is not None:
            check_whole("track_id", self.track_id, 0)
        if self.iscrowd not in (0, 1):
            raise UserError(f"iscrowd: expected 0 or 1, got {self.iscrowd!r}")
        self._set_array("bbox", 4)
        for name, length in (("bbox_visible", 4), ("velocity", 3)):
            if getattr(self, name) is not None:
                self._set_array(name, length)
        if (self.bbox[2:] < 0).any():
            raise UserError(f"bbox: width and height must not be negative, got {self.bbox.tolist()}")
        check_number("area", self.area)
        for name in ("area_full", "distance", "contrast"):
            value = getattr(self, name)
            if value is not None:
                check_number(name, value)
        check_share("occlusion", self.occlusion)
        check_share("truncation", self.truncation)
        check_choice("ignore_reason", self.ignore_reason, IGNORE_REASONS)

    def _set_array(self, name: str, *shape: int) -> None:
        """Replace a field's numbers by an array of a shape."""
        object.__setattr__(self, name, check_array(name, getattr(self, name), *shape))

    @property
    def ignored(self) -> bool:
        return self.iscrowd == 1


@dataclass(frozen=True, kw_only=True, eq=False)
class Annotation(Labelled):
    """Vehicle in one image."""

    keypoints: Array
    """(33, 3) x, y, v: v = 2 visible, 1 inside the image but hidden, 0 (x = y = 0) outside or unlabelled."""
    category_id: int = CATEGORY_ID
    model: str | None = None
    vehicle_type: str | None = None
    color: str | None = None
    parked: bool | None = None
    keypoints_3d: Array | None = None
    """(33, 3) world positions of all keypoints, for any v, metres."""
    box_3d_pixels: Array | None = None
    """(8, 2) corners of the 3D box in the image, if a dataset has them without a camera."""
    articulation: float | None = None
    """Heading of an articulated vehicle's trailer minus that of the vehicle in front of it, radians."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_whole("category_id", self.category_id, 0)
        self._set_array("keypoints", keypoints.K, 3)
        if self.keypoints_3d is not None:
            self._set_array("keypoints_3d", keypoints.K, 3)
        if self.box_3d_pixels is not None:
            self._set_array("box_3d_pixels", 8, 2)
        v = self.keypoints[:, 2]
        if not ((v == 0) | (v == 1) | (v == 2)).all():  # np.isin takes five times as long
            raise UserError("keypoints: v is 0, 1 or 2")
        if self.articulation is not None:
            angle = self.articulation
            if not is_number(angle) or not abs(angle) <= math.pi:
                raise UserError(f"articulation: expected radians from -pi to pi, got {angle!r}")
        check_choice("vehicle_type", self.vehicle_type, VEHICLE_TYPES)
        check_choice("color", self.color, VEHICLE_COLORS)

    @property
    def num_keypoints(self) -> int:
        return int((self.keypoints[:, 2] > 0).sum())


class _Categorised:
    """Base of labels and results in a category without keypoints."""

    category_id: int

    @property
    def category(self) -> str:
        """Name of the category."""
        return CATEGORY_NAMES[self.category_id - 1]


@dataclass(frozen=True, kw_only=True, eq=False)
class RoadUser(Labelled, _Categorised):
    """Bicycle or motorcycle with its riders, or a pedestrian, in one image."""

    category_id: int
    """2 to 4, see `CATEGORY_NAMES`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_road_user(self.category_id)


def _check_road_user(category_id: Any) -> None:
    if isinstance(category_id, bool) or category_id not in ROAD_USER_IDS:
        raise UserError(f"category_id: expected 2 (bicycle), 3 (motorcycle) or 4 (pedestrian), got {category_id!r}")


L = TypeVar("L", bound=Labelled)


def far_outside(annotation: Annotation) -> NDArray[np.bool_]:
    """Return (33,) whether labelled keypoints are outside the box by more than a tenth of its longer edge, or 2 px.

    The box is that of the whole vehicle inside the image, so such a point cannot be visible.
    """
    low, size = annotation.bbox[:2], annotation.bbox[2:]
    points = annotation.keypoints[:, :2]
    away = np.maximum(low - points, points - low - size).max(axis=1)
    far: NDArray[np.bool_] = (annotation.keypoints[:, 2] > 0) & (
        away > max(KEYPOINT_TOLERANCE.share * size.max(), KEYPOINT_TOLERANCE.pixels)
    )
    return far


@dataclass(frozen=True, kw_only=True, eq=False)
class AnnotationFile:
    """Split: images, and the vehicles and other road users in them, in file order.

    Ids are unique over annotations and road users together.
    """

    images: tuple[Image, ...]
    annotations: tuple[Annotation, ...]
    """Vehicles only."""
    info: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))
    name: str = ""
    """Name of the split: the file's stem."""
    scheme: Scheme = SKOPE33
    """Keypoint scheme of the file."""
    road_users: tuple[RoadUser, ...] = ()
    """Pedestrians and two-wheelers, if the file labels them."""
    categories: tuple[str, ...] = VEHICLE_ALONE
    """Names of the labelled categories, in the order of their ids, whether or not each occurs. Images of a file without
    pedestrians among them may show unlabelled pedestrians."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "categories", checked_categories(self.categories))
        for user in self.road_users:
            if user.category not in self.categories:
                raise UserError(f"categories: road user {user.id} is a {user.category}, which is not among them")

    def by_image(self) -> dict[int, list[Annotation]]:
        """Return the vehicles by image id, in file order; images without vehicles have an empty list."""
        return _grouped(self.images, self.annotations)

    def road_users_by_image(self) -> dict[int, list[RoadUser]]:
        """Return the other road users by image id, in file order; images without any have an empty list."""
        return _grouped(self.images, self.road_users)

    def labels_by_image(self) -> dict[int, list[Annotation | RoadUser]]:
        """Return the vehicles and, after them, the other road users by image id."""
        road_users = self.road_users_by_image()
        return {number: [*vehicles, *road_users[number]] for number, vehicles in self.by_image().items()}


def _grouped(images: Iterable[Image], labels: Iterable[L]) -> dict[int, list[L]]:
    groups: dict[int, list[L]] = {image.id: [] for image in images}
    for label in labels:
        groups[label.image_id].append(label)
    return groups


@dataclass(frozen=True, kw_only=True, eq=False)
class Found:
    """Base of the results of vehicles and of other road users."""

    image_id: int
    score: float
    """Confidence, 0 to 1."""
    bbox: Array
    """(4,) x, y, width, height."""
    interpolated: bool = False
    """Whether it was tracked from other frames and not detected in this one."""
    track_id: int | None = None
    """Number among the road users of its video, shared by results of other frames; None: not known."""

    def __post_init__(self) -> None:
        check_whole("image_id", self.image_id, 0)
        if self.track_id is not None:
            check_whole("track_id", self.track_id, 0)
        if not isinstance(self.interpolated, bool):
            raise UserError(f"interpolated: expected true or false, got {self.interpolated!r}")
        object.__setattr__(self, "bbox", check_array("bbox", self.bbox, 4))
        check_number("score", self.score, 0, 1)


@dataclass(frozen=True, kw_only=True, eq=False)
class Result(Found):
    """Predicted vehicle of a COCO results file."""

    keypoints: Array
    """(33, 3) x, y, probability that the point is right."""
    category_id: int = CATEGORY_ID
    boxed: bool = True
    """Whether its file has a box for it; otherwise the box is the extent of its keypoints."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_whole("category_id", self.category_id, 0)
        object.__setattr__(self, "keypoints", check_array("keypoints", self.keypoints, keypoints.K, 3))


@dataclass(frozen=True, kw_only=True, eq=False)
class RoadUserResult(Found, _Categorised):
    """Predicted bicycle, motorcycle or pedestrian of a COCO results file."""

    category_id: int
    """2 to 4, see `CATEGORY_NAMES`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_road_user(self.category_id)


AnyResult: TypeAlias = Result | RoadUserResult
