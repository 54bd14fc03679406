"""One image of the gallery: the photograph, depth over it, and labels as layers of a drawing."""

from collections.abc import Callable, Sequence
from html import escape
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from skope.dataset.folder import Dataset
from skope.errors import UserError
from skope.keypoints import Scheme
from skope.page import image_viewer
from skope.page.html_pieces import tag
from skope.pictures import draw
from skope.schema import Annotation, Image

LAYERS: Final = {
    "boxes": "boxes",
    "points": "keypoints (rings: hidden)",
    "boxes3d": "3D boxes (thick: front)",
    "masks": "masks",
    "depth": "depth (red near, blue far)",
    "ignored": "ignored vehicles (dotted)",
}
SHOWN: Final = ("boxes", "points")
"""Layers that are on at first."""
_DEPTH: Final = 480
"""Pixels of the longer edge of a depth picture."""


def figure(dataset: Dataset, image: Image, vehicles: Sequence[Annotation]) -> str:
    """An image with its layers; a UserError says what is wrong with one of its files."""
    try:
        photograph, metres = dataset.image(image), dataset.depth(image)
    except UserError as error:
        raise UserError(f"{error} (skope gen check {dataset.root} finds everything that is wrong)") from None
    known = [vehicle for vehicle in vehicles if not vehicle.ignored]
    size = (image.width, image.height)
    words = f"{len(known)} vehicles" if len(known) != 1 else "1 vehicle"
    if len(vehicles) > len(known):
        words += f", {len(vehicles) - len(known)} ignored"
    caption = ", ".join(part for part in (image.split, image.site, image.weather, _sun(image), words) if part)
    photo = tag(
        "img",
        src=image_viewer.jpeg(photograph),
        alt=f"{caption}: {image.file_name}",
        width=image.width,
        height=image.height,
        loading="lazy",
    )
    larger = tag("button", "larger", type="button", class_="larger", aria_pressed="false")
    return tag(
        "figure",
        tag("figcaption", larger, tag("b", escape(image.file_name)), tag("div", escape(caption))),
        tag(
            "div",
            photo,
            _depth(metres),
            image_viewer.drawing(_layers(image, vehicles, dataset.scheme), size),
            class_="stage",
        ),
        class_="photo",
        data_split=image.split,
        data_site=image.site,
        data_weather=image.weather,
        data_type=" ".join(sorted({vehicle.vehicle_type or "unknown" for vehicle in known})),
    )


def _depth(metres: NDArray[np.float32] | None) -> str:
    """Depth as a picture over the photograph, hidden until its layer is switched on."""
    if metres is None:
        return ""
    return tag(
        "img", src=image_viewer.jpeg(draw.depth(metres), longest=_DEPTH), alt="", loading="lazy", class_="depth off"
    )


def _sun(image: Image) -> str:
    degrees = image.sun_elevation_deg
    if degrees is None:
        return ""
    return f"sun {abs(degrees):.0f}° {'above' if degrees >= 0 else 'below'} the horizon"


def _layers(image: Image, vehicles: Sequence[Annotation], scheme: Scheme) -> list[str]:
    known = [vehicle for vehicle in vehicles if not vehicle.ignored]
    kinds: dict[str, Callable[[Annotation], str]] = {
        "masks": _mask,
        "boxes3d": lambda vehicle: _box_3d(image, vehicle),
        "boxes": lambda vehicle: image_viewer.box(vehicle.bbox, draw.words_of(vehicle)),
        "points": lambda vehicle: _points(vehicle, _scale(vehicle, image), scheme),
    }
    layers = [
        tag("g", *(_own(vehicle, of(vehicle), _scale(vehicle, image)) for vehicle in known), class_=name)
        for name, of in kinds.items()
    ]
    ignored = [image_viewer.box(vehicle.bbox, draw.words_of(vehicle)) for vehicle in vehicles if vehicle.ignored]
    return [tag("g", *ignored, class_="ignored"), *layers]


def _scale(vehicle: Annotation, image: Image) -> float:
    """How large points are drawn: small on small vehicles, where they would run together."""
    return float(np.clip(vehicle.bbox[2:].max() / 60, 0.3, image_viewer.unit(image.width)))


def _own(vehicle: Annotation, drawn: str, scale: float) -> str:
    """The SVG group of one vehicle, with what is drawn of it in its colour."""
    if not drawn:
        return ""
    return tag(
        "g",
        drawn,
        style="--c:#{:02x}{:02x}{:02x}".format(*draw.color_of(vehicle)) + f";--s:{scale:.2f}",
        data_of=vehicle.vehicle_type or "unknown",
    )


def _points(vehicle: Annotation, scale: float, scheme: Scheme) -> str:
    seen = vehicle.keypoints[:, 2]
    return image_viewer.points(vehicle.keypoints, seen > 0, seen > 1, seen > 0, scale, scheme.skeleton)


def _box_3d(image: Image, vehicle: Annotation) -> str:
    if vehicle.box_3d is None or image.camera is None:
        return ""
    straight = image.camera.distortion.model == "none"
    ends: dict[bool, str] = {False: "", True: ""}
    for pieces, front in draw.edges_3d(vehicle.box_3d, image.camera):
        if pieces and straight:
            pieces = [np.stack([pieces[0][0], pieces[-1][1]])]
        ends[front] += "".join(f"M{image_viewer.place(start)}L{image_viewer.place(end)}" for start, end in pieces)
    return image_viewer.path(ends[False], "edges_3d") + image_viewer.path(ends[True], "front")


def _mask(vehicle: Annotation) -> str:
    """The outline of the visible pixels, simplified by less than a pixel."""
    inside = draw.mask_of(vehicle)
    if inside is None:
        return ""
    contours, _ = cv2.findContours(inside.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    rings = [cv2.approxPolyDP(contour, 0.7, True)[:, 0] + 0.5 for contour in contours]
    return image_viewer.path("".join(f"M{'L'.join(image_viewer.place(p) for p in ring)}Z" for ring in rings), "area")
