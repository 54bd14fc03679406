"""People on foot and on two wheels in a COCO file of somebody's: categories of our names that have no keypoints."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from skope import schema
from skope.dataset import coco
from skope.gen.formats.coco_images import ImportedImage, telling
from skope.gen.formats.coco_vehicles import PLAIN, attributes_of, box_of_row, cut_to
from skope.gen.formats.remarks import Remarks
from skope.keypoints import K
from skope.schema import RoadUser


def road_user_of(
    where: str, row: Mapping[str, Any], category: str, image: ImportedImage, remarks: Remarks, *, ours: bool
) -> RoadUser | None:
    """A road user of an image, its box cut to it.

    Args:
        where: File and record, for messages.
        row: The record.
        category: Its category.
        image: Where it is.
        remarks: Where it is noted what cannot be right.
        ours: Whether fields beyond COCO's mean what ours do.

    Returns:
        None where the box has no area inside the image.
    """
    with telling(where):
        fields = {name: row[name] for name in PLAIN if row.get(name) is not None}
        told = {name: value for name, value in attributes_of(row).items() if name in ("track_id", "ignore_reason")}
        if told.get("ignore_reason"):
            told["iscrowd"] = 1
        fields = {**(row if ours else fields), **told, "bbox": box_of_row(row.get("bbox"), np.zeros((K, 3)), image)}
        fields |= {"category_id": schema.CATEGORIES.index(category) + 1, "id": 0}  # ids are given anew
        user = cut_to(image, coco.road_user_from_dict(fields))
    if user is None:
        remarks.add(category, "left out, without area inside the image", where)
    return user
