"""Images of the gallery: the photograph, its depth, and labels as layers of a drawing."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from markupsafe import Markup

from skope.dataset.folder import Dataset
from skope.errors import UserError
from skope.keypoints import Scheme
from skope.page import image_viewer
from skope.page.svg import path_svg, tag
from skope.pictures import draw
from skope.schema import Annotation, Image, RoadUser
from skope.terminal.console import counted

LAYER_TITLES: Final = {
    "boxes": "boxes",
    "points": "keypoints (rings: hidden)",
    "boxes3d": "3D boxes (thick: front)",
    "masks": "masks",
    "depth": "depth (red near, blue far)",
    "ignored": "ignored vehicles (dotted)",
}
SHOWN_LAYERS: Final = ("boxes", "points")
"""Layers that are shown initially."""
DEPTH_IMAGE_PX: Final = 480
"""Longer edge of a depth image, pixels."""


@dataclass(frozen=True, kw_only=True)
class ShownPhoto:
    """An image of the gallery with its layers."""

    name: str
    caption: str
    picture: str
    """Data address of the photograph."""
    size: tuple[int, int]
    depth: str | None
    """Data address of its depth as an image, which is hidden until its layer is switched on."""
    drawing: Markup
    """Drawing over the photograph."""
    filters: Mapping[str, str | None]
    """Value of the image for each filter."""


def shown_photo(dataset: Dataset, image: Image, labels: Sequence[Annotation | RoadUser]) -> ShownPhoto:
    """Return an image with its layers.

    Raises:
        UserError: One of its files is missing or broken.
    """
    try:
        photograph, metres = dataset.image(image), dataset.depth(image)
    except UserError as error:
        raise UserError(f"{error} (skope gen check {dataset.root} lists all errors)") from None
    known = [label for label in labels if not label.ignored]
    size = (image.width, image.height)
    words = counted(sum(isinstance(label, Annotation) for label in known), "vehicle")
    category_counts = Counter(label.category for label in known if isinstance(label, RoadUser))
    words += "".join(f", {counted(number, name)}" for name, number in sorted(category_counts.items()))
    if len(labels) > len(known):
        words += f", {len(labels) - len(known)} ignored"
    caption = ", ".join(part for part in (image.split, image.site, image.weather, _sun(image), words) if part)
    return ShownPhoto(
        name=image.file_name,
        caption=caption,
        picture=image_viewer.jpeg(photograph),
        size=size,
        depth=None if metres is None else image_viewer.jpeg(draw.depth(metres), longest=DEPTH_IMAGE_PX),
        drawing=image_viewer.drawing(_layers(image, labels, dataset.scheme), size),
        filters={
            "split": image.split,
            "site": image.site,
            "weather": image.weather,
            "type": " ".join(sorted({filter_kind(label) for label in known})),
        },
    )


def filter_kind(label: Annotation | RoadUser) -> str:
    """Return the kind of a label for filters: the type of a vehicle, the category of another road user."""
    return (label.vehicle_type or "unknown") if isinstance(label, Annotation) else label.category


def _sun(image: Image) -> str:
    degrees = image.sun_elevation_deg
    if degrees is None:
        return ""
    return f"sun {abs(degrees):.0f}° {'above' if degrees >= 0 else 'below'} the horizon"


def _layers(image: Image, labels: Sequence[Annotation | RoadUser], scheme: Scheme) -> list[str]:
    known = [label for label in labels if not label.ignored]
    kinds: dict[str, Callable[[Annotation | RoadUser], Markup]] = {
        "masks": _mask,
        "boxes3d": lambda label: _box_3d(image, label),
        "boxes": lambda label: image_viewer.box_svg(label.bbox, draw.words_of(label)),
        "points": lambda label: _points(label, _scale(label, image), scheme),
    }
    layers = [
        tag("g", *(_label_group(label, of(label), _scale(label, image)) for label in known), class_=name)
        for name, of in kinds.items()
    ]
    ignored = [image_viewer.box_svg(label.bbox, draw.words_of(label)) for label in labels if label.ignored]
    return [tag("g", *ignored, class_="ignored"), *layers]


def _scale(label: Annotation | RoadUser, image: Image) -> float:
    """Return the size of points: small on small vehicles, where they would overlap."""
    return float(np.clip(label.bbox[2:].max() / 60, 0.3, image_viewer.unit(image.width)))


def _label_group(label: Annotation | RoadUser, drawn: Markup, scale: float) -> Markup:
    """Return the SVG group of one road user, with its drawing in its colour."""
    if not drawn:
        return Markup()
    return tag(
        "g",
        drawn,
        style="--c:#{:02x}{:02x}{:02x}".format(*draw.color_of(label)) + f";--s:{scale:.2f}",
        data_of=filter_kind(label),
    )


def _points(vehicle: Annotation | RoadUser, scale: float, scheme: Scheme) -> Markup:
    if isinstance(vehicle, RoadUser):
        return Markup()
    seen = vehicle.keypoints[:, 2]
    return image_viewer.points(vehicle.keypoints, seen > 0, seen > 1, seen > 0, scale, scheme.skeleton)


def _box_3d(image: Image, label: Annotation | RoadUser) -> Markup:
    if label.box_3d is None or image.camera is None:
        return Markup()
    straight = image.camera.distortion.model == "none"
    ends: dict[bool, str] = {False: "", True: ""}
    for pieces, front in draw.edges_3d(label.box_3d, image.camera):
        if pieces and straight:
            pieces = [np.stack([pieces[0][0], pieces[-1][1]])]
        ends[front] += "".join(
            f"M{image_viewer.path_point(start)}L{image_viewer.path_point(end)}" for start, end in pieces
        )
    return path_svg(ends[False], "edges_3d") + path_svg(ends[True], "front")


def _mask(label: Annotation | RoadUser) -> Markup:
    """Return the outline of the visible pixels, simplified by less than a pixel."""
    inside = draw.visible_mask(label)
    if inside is None:
        return Markup()
    contours, _ = cv2.findContours(inside.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    rings = [cv2.approxPolyDP(contour, 0.7, True)[:, 0] + 0.5 for contour in contours]
    return path_svg("".join(f"M{'L'.join(image_viewer.path_point(p) for p in ring)}Z" for ring in rings), "area")
