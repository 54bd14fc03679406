"""Annotate a rendered frame: labels of all vehicles that it shows, and of people on foot and on two wheels; which of
them are ground truth and which are ignored.

It knows arrays alone, and none of the engines that made them.
"""

import math
from dataclasses import dataclass, field
from typing import Any, Final

import cv2
import numpy as np
from pycocotools import mask as coco_mask

from skope import keypoints
from skope.camera.model import Camera
from skope.errors import UserError, one_of
from skope.gen.bystanders import bystander
from skope.gen.bystanders.bystander import CATEGORY_OF
from skope.gen.labels.visibility import VISIBILITY_TOLERANCES, behind, find_hidden
from skope.gen.labels.world_keypoints import LOCALIZER_CHOICES, world_keypoints
from skope.gen.render.frame import RenderedFrame
from skope.gen.scene.recording import Moment
from skope.gen.vehicles.model import Trailer, Vehicle
from skope.gen.vehicles.paints import color_name
from skope.schema import CATEGORY_NAMES, Annotation, Box3D, RoadUser
from skope.types import Array, Mask


@dataclass(frozen=True, eq=False)
class Extent:
    """Boxes, mask and pixel counts of a road user in the image."""

    bbox: Array
    """(4,) x, y, width, height of the silhouette inside the image, pixels."""
    bbox_visible: Array
    """(4,) x, y, width, height of the visible pixels."""
    segmentation: dict[str, Any]
    """Visible pixels as COCO's RLE."""
    visible: int
    """Number of visible pixels."""
    inside: int
    """Pixels of the whole silhouette inside the image."""
    whole: int
    """Pixels of the whole silhouette, also outside the image."""

    def fields(self) -> dict[str, Any]:
        """The fields of `schema.Labelled` that follow from these."""
        return {
            "bbox": self.bbox,
            "bbox_visible": self.bbox_visible,
            "segmentation": self.segmentation,
            "area": self.visible,
            "area_full": self.inside,
            "occlusion": 1 - self.visible / self.inside,
            "truncation": 1 - self.inside / self.whole,
        }


def measure_extent(view: RenderedFrame, i: int, camera: Camera) -> Extent | None:
    """Boxes, mask and pixel counts of a road user; None where none of its pixels is visible.

    Args:
        view: The rendered frame.
        i: Number of the road user in it.
        camera: The frame's camera.
    """
    silhouette = view.silhouettes[i]
    height, width = silhouette.mask.shape
    x0, y0 = max(silhouette.x, 0), max(silhouette.y, 0)
    x1, y1 = min(silhouette.x + width, camera.width), min(silhouette.y + height, camera.height)
    visible = view.ids[y0:y1, x0:x1] == i + 1
    if not visible.any():
        return None
    whole = silhouette.mask[y0 - silhouette.y : y1 - silhouette.y, x0 - silhouette.x : x1 - silhouette.x]
    # The silhouette is drawn in another window, where an edge may round to the pixel beside it; visible pixels are part
    # of the vehicle in any case.
    inside = whole | visible
    corner = np.array([x0, y0, 0, 0])
    return Extent(
        bbox_of(inside) + corner,
        bbox_of(visible) + corner,
        _segmentation(visible, (x0, y0), (camera.width, camera.height)),
        int(np.count_nonzero(visible)),
        int(np.count_nonzero(inside)),
        int(np.count_nonzero(silhouette.mask) + np.count_nonzero(inside) - np.count_nonzero(whole)),
    )


def _segmentation(mask: Mask, corner: tuple[int, int], size: tuple[int, int]) -> dict[str, Any]:
    """COCO's RLE of an image of `size` (width, height) with a mask at `corner` (x, y) and nothing else."""
    (x0, y0), (width, height) = corner, size
    # RLE runs go down the columns; an empty row at the end keeps a run from continuing in the next column.
    columns = np.pad(mask, ((0, 1), (0, 0))).T.ravel()
    edges = np.flatnonzero(np.diff(columns, prepend=False))
    column, row = np.divmod(edges, len(mask) + 1)
    edges = (x0 + column) * height + y0 + row
    # In a mask as high as the image a run may end where the next begins: such runs are joined.
    meets = np.flatnonzero(edges[1:] == edges[:-1])
    edges = np.delete(edges, np.concatenate([meets, meets + 1]))
    counts = np.diff(edges[edges < width * height], prepend=0, append=width * height).tolist()
    rle = coco_mask.frPyObjects({"size": [height, width], "counts": counts}, height, width)
    return {"size": [height, width], "counts": rle["counts"].decode()}


def bbox_of(mask: Mask) -> Array:
    """(4,) x, y, width, height of the tight box around a mask's (H, W) pixels."""
    return np.array(cv2.boundingRect(mask.view(np.uint8)), dtype=np.float64)


def box_around(vehicle: Vehicle, trailer: Trailer, T_world_chassis: Array, T_world_trailer: Array) -> tuple[Array, Any]:
    """The box around both parts of an articulated vehicle, along the axes of the first.

    Args:
        vehicle: The part in front.
        trailer: The part behind.
        T_world_chassis: (4, 4) pose of the part in front, metres.
        T_world_trailer: (4, 4) pose of the trailer, metres.

    Returns:
        Middle (3,), world, and size (3,), metres.
    """
    length, width, height = vehicle.size_lwh
    own = np.array([[-length / 2, -width / 2, 0.0], [length / 2, width / 2, height]])
    corners = np.array(np.meshgrid(*trailer.corners.T)).reshape(3, -1).T
    T = np.linalg.inv(T_world_chassis) @ T_world_trailer
    points = np.concatenate([own, corners @ T[:3, :3].T + T[:3, 3]])
    low, high = points.min(axis=0), points.max(axis=0)
    return T_world_chassis[:3, :3] @ ((low + high) / 2) + T_world_chassis[:3, 3], high - low


OCCLUSION_RULES: Final = ("others", "paper")


@dataclass(frozen=True)
class LabelLimits:
    """Limits below which a vehicle is ignored."""

    pixels: int = 20
    """Vehicles with fewer visible pixels are ignored as `small`."""
    contrast: float = 1.0
    """Vehicles whose visible pixels change by less than this on average, in units of what noise and compression hide,
    are ignored as `unseen`."""


LABEL_LIMITS: Final = LabelLimits()


@dataclass(frozen=True, kw_only=True)
class Rules:
    """Rules on what is ground truth and what ignored, and on how keypoints are localised."""

    occlusion: str = "others"
    localizer: str = "rigid"
    min_visible: float = 0.15
    """Less than this share of the silhouette unhidden and inside the image: `sliver`."""
    min_box: float = 12.0
    """A box whose shorter edge is under this many pixels: `small`."""

    def __post_init__(self) -> None:
        one_of("--occlusion-rule", self.occlusion, OCCLUSION_RULES)
        one_of("--localizer", self.localizer, LOCALIZER_CHOICES)
        if not 0 <= self.min_visible <= 1:
            raise UserError(f"--min-visible: expected a share from 0 to 1, got {self.min_visible}")
        if not self.min_box >= 0:
            raise UserError(f"--min-box: expected pixels from 0, got {self.min_box}")


def occluded_by_others(hidden_by_others: Mask, inside: Mask) -> Mask:
    """(...,) whether a vehicle counts as hidden by the rule `others`.

    It does where something else hides more than half of its keypoints inside the image; both masks are (..., 33).
    """
    return np.asarray(hidden_by_others.sum(-1) * 2 > inside.sum(-1))


def ignore_reason(shape: Extent, occluded: bool, contrast: float, rules: Rules) -> str | None:
    """Tell why a road user is ignored; None where it is ground truth.

    Args:
        shape: Its boxes and pixel counts.
        occluded: Whether something else hides it, by the rule of occlusion.
        contrast: Its contrast with what is behind it, in deviations of the noise.
        rules: The limits.
    """
    if occluded:
        return "occluded"
    if shape.visible < rules.min_visible * shape.whole:
        return "sliver"
    if min(shape.bbox[2:]) < rules.min_box or shape.visible < LABEL_LIMITS.pixels:
        return "small"
    return "unseen" if contrast < LABEL_LIMITS.contrast else None


@dataclass
class RuleCounts:
    """Number of a frame's vehicles that each rule applies to, for the dataset's card."""

    vehicles: int = 0
    """Vehicles with at least one visible pixel."""
    occluded_others: int = 0
    """Vehicles that count as hidden by the rule `others`."""
    occluded_paper: int = 0
    """Vehicles that count as hidden by the rule `paper`."""
    ignored: dict[str, int] = field(default_factory=dict)
    """Vehicles that are ignored, by reason."""
    apart_m: float = 0.0
    """Sum over the vehicles of the mean distance between the two localizers' keypoints, metres."""
    most_apart_m: float = 0.0
    """Largest distance between the two localizers' answers for a keypoint, metres."""


def annotate(
    moment: Moment, view: RenderedFrame, camera: Camera, rules: Rules, image_id: int
) -> tuple[list[Annotation], RuleCounts]:
    """Annotate the vehicles of a rendered frame.

    Args:
        moment: Poses of the road users, as the frame was rendered from them.
        view: The rendered frame.
        camera: Its camera.
        rules: What is ground truth, what is ignored.
        image_id: Id of the image, for the annotations.

    Returns:
        Annotations of all vehicles with a visible pixel, ignored ones included, by track id; their ids count from 1
        (the rule `paper` leaves hidden vehicles out). And how many vehicles each rule applies to.
    """
    labelled = range(len(moment.labelled().vehicles))
    # Vehicles that no pixel shows have no label, and are not built for one.
    extents = {i: extent for i in labelled if (extent := measure_extent(view, i, camera))}
    seen = sorted(extents, key=lambda i: moment.vehicles[i].track_id)
    world = world_keypoints(moment.only(seen), rules.localizer)
    pixels, _, valid = camera.project(world.points)
    inside = valid & camera.inside(pixels)
    gap, shown = behind(view, camera, world.tested)
    own = shown[0] == np.array(seen, dtype=np.int32).reshape(-1, 1) + 1
    v = np.where(inside, np.where(find_hidden(moment, world, view, camera, inside, gap, shown), 1, 2), 0)
    hidden = inside & (np.nan_to_num(gap[0], nan=0.0) > VISIBILITY_TOLERANCES.vehicle_m)
    by_others = occluded_by_others(hidden & ~own, inside)
    by_paper = hidden.sum(-1) * 2 > keypoints.K
    tally = RuleCounts()
    out: list[Annotation] = []
    for k, i in enumerate(seen):
        tally.vehicles += 1
        tally.occluded_others += int(by_others[k])
        tally.occluded_paper += int(by_paper[k])
        tally.apart_m += float(world.difference[k].mean())
        tally.most_apart_m = max(tally.most_apart_m, float(world.difference[k].max()))
        if rules.occlusion == "paper" and by_paper[k]:
            continue
        points = np.concatenate(
            [np.where(v[k, :, None] > 0, _clip_to_image(pixels[k], camera), 0.0), v[k, :, None]], axis=1
        )
        occluded = rules.occlusion == "others" and bool(by_others[k])
        reason = ignore_reason(extents[i], occluded, float(view.contrast[i]), rules)
        if reason:
            tally.ignored[reason] = tally.ignored.get(reason, 0) + 1
        out.append(
            Annotation(
                id=len(out) + 1,
                image_id=image_id,
                keypoints=points,
                keypoints_3d=world.points[k],
                iscrowd=int(reason is not None),
                ignore_reason=reason,
                contrast=float(view.contrast[i]),
                **extents[i].fields(),
                **_vehicle_fields(moment, i, world.vehicles[k], camera),
            )
        )
    return out, tally


def _clip_to_image(pixels: Array, camera: Camera) -> Array:
    """Pixels (..., 2), rounded to 0.01 as annotation files have them, and kept inside the image."""
    return np.clip(np.round(np.nan_to_num(pixels), 2), 0, [camera.width - 0.01, camera.height - 0.01])


def _vehicle_fields(moment: Moment, i: int, vehicle: Vehicle, camera: Camera) -> dict[str, Any]:
    recorded, T = moment.vehicles[i], moment.T_world_chassis[i]
    yaw = math.atan2(T[1, 0], T[0, 0])
    center, size, articulation = T[:3, :3] @ [0, 0, vehicle.size_lwh[2] / 2] + T[:3, 3], vehicle.size_lwh, {}
    if vehicle.trailer is not None:
        T_world_trailer = moment.T_world_trailer[i, 0]
        bend = math.atan2(T_world_trailer[1, 0], T_world_trailer[0, 0]) - yaw
        articulation = {"articulation": math.remainder(bend, 2 * math.pi)}
        center, size = box_around(vehicle, vehicle.trailer, T, T_world_trailer)
    return {
        "track_id": recorded.track_id,
        "model": recorded.model,
        "vehicle_type": vehicle.vehicle_type,
        "color": color_name(vehicle, recorded.color),
        "parked": recorded.parked,
        "box_3d": Box3D(center=center, size_lwh=np.array(size), yaw=yaw, R=T[:3, :3]),
        "velocity": moment.velocity[i],
        "distance": float(np.linalg.norm(center - camera.position)),
        **articulation,
    }


def annotate_road_users(
    moment: Moment, view: RenderedFrame, camera: Camera, rules: Rules, image_id: int, first_id: int
) -> list[RoadUser]:
    """Label the bystanders of a rendered frame.

    Args:
        moment: Poses of the road users, as the frame was rendered from them.
        view: The rendered frame.
        camera: Its camera.
        rules: What is ignored.
        image_id: Id of the image, for the labels.
        first_id: Id of the first label; those of others count on from it.

    Returns:
        Labels of all bystanders with a visible pixel, ignored ones included, by track id.
    """
    others = [i for i, recorded in enumerate(moment.vehicles) if not recorded.labelled]
    out: list[RoadUser] = []
    for i in sorted(others, key=lambda i: moment.vehicles[i].track_id):
        extent = measure_extent(view, i, camera)
        if extent is None:
            continue
        contrast = float(view.contrast[i])
        reason = ignore_reason(extent, counts_as_hidden(extent), contrast, rules)
        out.append(
            RoadUser(
                id=first_id + len(out),
                image_id=image_id,
                iscrowd=int(reason is not None),
                ignore_reason=reason,
                contrast=contrast,
                **extent.fields(),
                **_body_fields(moment, i, camera),
            )
        )
    return out


def counts_as_hidden(extent: Extent) -> bool:
    """Whether somebody without keypoints counts as occluded: something else hides more than half of the pixels that the
    whole silhouette has inside the image."""
    return 2 * extent.visible < extent.inside


def _body_fields(moment: Moment, i: int, camera: Camera) -> dict[str, Any]:
    recorded, T = moment.vehicles[i], moment.T_world_chassis[i]
    low, high = bystander.build_bystander(recorded.model, recorded.shape).box
    center = T[:3, :3] @ ((low + high) / 2) + T[:3, 3]
    return {
        "category_id": CATEGORY_NAMES.index(CATEGORY_OF[recorded.model]) + 1,
        "track_id": recorded.track_id,
        "box_3d": Box3D(center=center, size_lwh=high - low, yaw=math.atan2(T[1, 0], T[0, 0]), R=T[:3, :3]),
        "velocity": moment.velocity[i],
        "distance": float(np.linalg.norm(center - camera.position)),
    }
