"""One image of the gallery: the photograph, depth over it, and labels as layers of a drawing."""

from collections import Counter
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
SHOWN: Final = ("boxes", "points")
"""Layers that are on at first."""
_DEPTH: Final = 480
"""Pixels of the longer edge of a depth picture."""


def figure(dataset: Dataset, image: Image, labels: Sequence[Annotation | RoadUser]) -> str:
    """An image with its layers; a UserError says what is wrong with one of its files."""
    try:
        photograph, metres = dataset.image(image), dataset.depth(image)
    except UserError as error:
        raise UserError(f"{error} (skope gen check {dataset.root} finds everything that is wrong)") from None
    known = [label for label in labels if not label.ignored]
    size = (image.width, image.height)
    words = counted(sum(isinstance(label, Annotation) for label in known), "vehicle")
    others = Counter(label.category for label in known if isinstance(label, RoadUser))
    words += "".join(f", {counted(number, name)}" for name, number in sorted(others.items()))
    if len(labels) > len(known):
        words += f", {len(labels) - len(known)} ignored"
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
            image_viewer.drawing(_layers(image, labels, dataset.scheme), size),
            class_="stage",
        ),
        class_="photo",
        data_split=image.split,
        data_site=image.site,
        data_weather=image.weather,
        data_type=" ".join(sorted({filter_kind(label) for label in known})),
    )


def filter_kind(label: Annotation | RoadUser) -> str:
    """Kind of a label, by which it is filtered: type of a vehicle, category of another road user."""
    return (label.vehicle_type or "unknown") if isinstance(label, Annotation) else label.category


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


def _layers(image: Image, labels: Sequence[Annotation | RoadUser], scheme: Scheme) -> list[str]:
    known = [label for label in labels if not label.ignored]
    kinds: dict[str, Callable[[Annotation | RoadUser], str]] = {
        "masks": _mask,
        "boxes3d": lambda label: _box_3d(image, label),
        "boxes": lambda label: image_viewer.box_svg(label.bbox, draw.words_of(label)),
        "points": lambda label: _points(label, _scale(label, image), scheme),
    }
    layers = [
        tag("g", *(_own(label, of(label), _scale(label, image)) for label in known), class_=name)
        for name, of in kinds.items()
    ]
    ignored = [image_viewer.box_svg(label.bbox, draw.words_of(label)) for label in labels if label.ignored]
    return [tag("g", *ignored, class_="ignored"), *layers]


def _scale(label: Annotation | RoadUser, image: Image) -> float:
    """Size at which points are drawn: small on small vehicles, where they would run together."""
    return float(np.clip(label.bbox[2:].max() / 60, 0.3, image_viewer.unit(image.width)))


def _own(label: Annotation | RoadUser, drawn: str, scale: float) -> str:
    """The SVG group of one road user, with what is drawn of it in its colour."""
    if not drawn:
        return ""
    return tag(
        "g",
        drawn,
        style="--c:#{:02x}{:02x}{:02x}".format(*draw.color_of(label)) + f";--s:{scale:.2f}",
        data_of=filter_kind(label),
    )


def _points(vehicle: Annotation | RoadUser, scale: float, scheme: Scheme) -> str:
    if isinstance(vehicle, RoadUser):
        return ""
    seen = vehicle.keypoints[:, 2]
    return image_viewer.points(vehicle.keypoints, seen > 0, seen > 1, seen > 0, scale, scheme.skeleton)


def _box_3d(image: Image, label: Annotation | RoadUser) -> str:
    if label.box_3d is None or image.camera is None:
        return ""
    straight = image.camera.distortion.model == "none"
    ends: dict[bool, str] = {False: "", True: ""}
    for pieces, front in draw.edges_3d(label.box_3d, image.camera):
        if pieces and straight:
            pieces = [np.stack([pieces[0][0], pieces[-1][1]])]
        ends[front] += "".join(f"M{image_viewer.place(start)}L{image_viewer.place(end)}" for start, end in pieces)
    return image_viewer.path_svg(ends[False], "edges_3d") + image_viewer.path_svg(ends[True], "front")


def _mask(label: Annotation | RoadUser) -> str:
    """The outline of the visible pixels, simplified by less than a pixel."""
    inside = draw.visible_mask(label)
    if inside is None:
        return ""
    contours, _ = cv2.findContours(inside.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    rings = [cv2.approxPolyDP(contour, 0.7, True)[:, 0] + 0.5 for contour in contours]
    return image_viewer.path_svg(
        "".join(f"M{'L'.join(image_viewer.place(p) for p in ring)}Z" for ring in rings), "area"
    )
