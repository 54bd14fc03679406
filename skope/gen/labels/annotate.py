"""Annotate a rendered frame: label all visible vehicles and bystanders, and decide which labels are ignored.

This module works on arrays only and does not depend on the engines that made them.
"""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from skope import keypoints
from skope.camera.model import Camera
from skope.gen.bystanders import bystander
from skope.gen.bystanders.bystander import CATEGORY_OF
from skope.gen.labels.ignore_rules import Rules, counts_as_hidden, ignore_reason, occluded_by_others
from skope.gen.labels.image_extent import measure_extent
from skope.gen.labels.visibility import VISIBILITY_TOLERANCES, behind, find_hidden
from skope.gen.labels.world_keypoints import world_keypoints
from skope.gen.render.frame import RenderedFrame
from skope.gen.scene.recording import Moment
from skope.gen.vehicles.model import Trailer, Vehicle
from skope.gen.vehicles.paints import color_name
from skope.schema import CATEGORY_NAMES, Annotation, Box3D, RoadUser
from skope.types import Array


def box_around(vehicle: Vehicle, trailer: Trailer, T_world_chassis: Array, T_world_trailer: Array) -> tuple[Array, Any]:
    """Compute the box around both parts of an articulated vehicle, along the axes of the front part.

    Args:
        vehicle: The part in front.
        trailer: The part behind.
        T_world_chassis: (4, 4) pose of the part in front, metres.
        T_world_trailer: (4, 4) pose of the trailer, metres.

    Returns:
        Centre (3,), world, and size (3,), metres.
    """
    length, width, height = vehicle.size_lwh
    front_corners = np.array([[-length / 2, -width / 2, 0.0], [length / 2, width / 2, height]])
    corners = np.array(np.meshgrid(*trailer.corners.T)).reshape(3, -1).T
    T = np.linalg.inv(T_world_chassis) @ T_world_trailer
    points = np.concatenate([front_corners, corners @ T[:3, :3].T + T[:3, 3]])
    low, high = points.min(axis=0), points.max(axis=0)
    return T_world_chassis[:3, :3] @ ((low + high) / 2) + T_world_chassis[:3, 3], high - low


@dataclass
class RuleCounts:
    """Number of vehicles in a frame that each rule applies to, for the dataset card."""

    vehicles: int = 0
    """Vehicles with at least one visible pixel."""
    occluded_others: int = 0
    """Vehicles that count as occluded by the rule `others`."""
    occluded_paper: int = 0
    """Vehicles that count as occluded by the rule `paper`."""
    ignored: dict[str, int] = field(default_factory=dict)
    """Number of ignored vehicles, by reason."""
    apart_m: float = 0.0
    """Sum over all vehicles of the mean distance between the keypoints of the two localizers, metres."""
    most_apart_m: float = 0.0
    """Largest distance between the positions that the two localizers give for a keypoint, metres."""


def annotate(
    moment: Moment, view: RenderedFrame, camera: Camera, rules: Rules, image_id: int
) -> tuple[list[Annotation], RuleCounts]:
    """Annotate the vehicles of a rendered frame.

    Args:
        moment: Poses of the road users from which the frame was rendered.
        view: The rendered frame.
        camera: Camera of the frame.
        rules: Rules for ground truth and ignored vehicles.
        image_id: Id of the image, stored in the annotations.

    Returns:
        Annotations of all vehicles with a visible pixel, including ignored ones, sorted by track id, with ids from 1
        (the rule `paper` omits occluded vehicles); and the number of vehicles that each rule applies to.
    """
    labelled = range(len(moment.labelled().vehicles))
    # Vehicles without visible pixels get no label; their bodies are not built.
    extents = {i: extent for i in labelled if (extent := measure_extent(view, i, camera))}
    seen = sorted(extents, key=lambda i: moment.vehicles[i].track_id)
    world = world_keypoints(moment.only(seen), rules.localizer)
    pixels, _, valid = camera.project(world.points)
    inside = valid & camera.inside(pixels)
    gap, shown = behind(view, camera, world.tested)
    own_pixels = shown[0] == np.array(seen, dtype=np.int32).reshape(-1, 1) + 1
    v = np.where(inside, np.where(find_hidden(moment, world, view, camera, inside, gap, shown), 1, 2), 0)
    hidden = inside & (np.nan_to_num(gap[0], nan=0.0) > VISIBILITY_TOLERANCES.vehicle_m)
    by_others = occluded_by_others(hidden & ~own_pixels, inside)
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
    """Clip pixels (..., 2) to the image and round them to 0.01, as in annotation files."""
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
        moment: Poses of the road users from which the frame was rendered.
        view: The rendered frame.
        camera: Camera of the frame.
        rules: Rules for ignored road users.
        image_id: Id of the image, stored in the labels.
        first_id: Id of the first label; the ids of the following labels count up from it.

    Returns:
        Labels of all bystanders with a visible pixel, including ignored ones, sorted by track id.
    """
    bystanders = [i for i, recorded in enumerate(moment.vehicles) if not recorded.labelled]
    out: list[RoadUser] = []
    for i in sorted(bystanders, key=lambda i: moment.vehicles[i].track_id):
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
