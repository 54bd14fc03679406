"""Labels of people on foot and on two wheels, by the rules that hold for vehicles; they have no keypoints."""

import math
from typing import Any

import numpy as np

from skope.camera.model import Camera
from skope.gen.bystanders import bystander
from skope.gen.bystanders.bystander import CATEGORY_OF
from skope.gen.labels.boxes_and_masks import Extent, measure_extent
from skope.gen.labels.ignore_rules import Rules, ignore_reason
from skope.gen.render.frame import RenderedFrame
from skope.gen.scene.recording import Moment
from skope.schema import CATEGORIES, Box3D, RoadUser


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
        reason = ignore_reason(extent, hidden(extent), contrast, rules)
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


def hidden(extent: Extent) -> bool:
    """Whether somebody without keypoints counts as occluded: something else hides more than half of the pixels that the
    whole silhouette has inside the image."""
    return 2 * extent.visible < extent.inside


def _body_fields(moment: Moment, i: int, camera: Camera) -> dict[str, Any]:
    recorded, T = moment.vehicles[i], moment.T_world_chassis[i]
    low, high = bystander.build_bystander(recorded.model, recorded.shape).box
    center = T[:3, :3] @ ((low + high) / 2) + T[:3, 3]
    return {
        "category_id": CATEGORIES.index(CATEGORY_OF[recorded.model]) + 1,
        "track_id": recorded.track_id,
        "box_3d": Box3D(center=center, size_lwh=high - low, yaw=math.atan2(T[1, 0], T[0, 0]), R=T[:3, :3]),
        "velocity": moment.velocity[i],
        "distance": float(np.linalg.norm(center - camera.position)),
    }
