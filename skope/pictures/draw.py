"""Overlays of vehicles on images, and sheets of several images. RGB uint8 in and out; drawn by OpenCV.

Coordinates are skope's continuous pixels. OpenCV counts the centre of pixel i as i, so half a pixel is subtracted, and
sub-pixel positions are kept. Line widths and letters grow with the image. `scale` first enlarges small images, so that
keypoints do not merge. Arrays of another shape or type raise a UserError.
"""

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from pycocotools import mask as coco_mask

from skope.boxes import xywh_to_xyxy
from skope.camera.model import Camera
from skope.errors import UserError
from skope.files.atomic import write_bytes
from skope.keypoints import SKOPE33, Scheme
from skope.records import check_image
from skope.schema import Annotation, Box3D, Labelled, Result, RoadUser, RoadUserResult
from skope.types import Pixels

Color = tuple[int, int, int]


@dataclass(frozen=True)
class DrawingStyle:
    """Colours and sizes of drawn vehicles."""

    palette: tuple[Color, ...] = (
        (86, 180, 233),
        (230, 159, 0),
        (0, 200, 140),
        (240, 228, 66),
        (90, 140, 255),
        (255, 110, 40),
        (230, 140, 190),
        (190, 230, 120),
    )
    """Colours of vehicles, by track: those of Okabe and Ito, brightened if they would be invisible on asphalt."""
    ignored: Color = (200, 200, 200)
    """Colour of ignored vehicles."""
    dark: Color = (16, 16, 16)
    """Colour of outlines behind letters."""
    drawn_probability: float = 0.5
    """Minimum probability of a keypoint that is drawn in full."""
    faint_probability: float = 0.15
    """Minimum probability of a drawn keypoint. Below `drawn_probability` it is faint."""
    faintness: float = 0.4
    """Share of a faint keypoint's colour in the image."""
    small_px: int = 36
    """Maximum longer side of a small box, pixels of the enlarged image at 960x540."""
    subpixel_bits: int = 4
    """OpenCV takes sub-pixel positions as integers in units of 1 / 2**subpixel_bits pixel."""


DRAWING_STYLE: Final = DrawingStyle()

_LABEL_FONT: Final = cv2.FONT_HERSHEY_SIMPLEX


def annotations(
    image: Pixels,
    vehicles: Iterable[Annotation],
    road_users: Iterable[RoadUser] = (),
    *,
    scale: int = 1,
    scheme: Scheme = SKOPE33,
) -> Pixels:
    """Draw ground truth on a copy of an image.

    Keypoints are filled where visible (v = 2) and hollow where hidden (v = 1); ignored road users have a dashed box
    with the reason. The label is the track number or the annotation id; for other road users it begins with a letter.

    Args:
        image: (H, W, 3) RGB.
        vehicles: The image's annotations, boxes and keypoints in its pixels.
        road_users: Pedestrians and two-wheelers.
        scale: Enlargement factor.
        scheme: Scheme of the keypoints.

    Returns:
        (scale H, scale W, 3) RGB.
    """
    canvas = _Canvas(image, scale, scheme)
    labels: list[Annotation | RoadUser] = [*vehicles, *road_users]
    for label in sorted(labels, key=lambda label: not label.ignored):
        color = color_of(label)
        if label.ignored:
            canvas.dashed_box(label.bbox, color)
            canvas.note(label.bbox, label.ignore_reason or "ignored", color)
        elif isinstance(label, Annotation):
            v = label.keypoints[:, 2]
            canvas.vehicle(label.bbox, label.keypoints, v > 0, v > 1, color)
            canvas.label(label.bbox, str(number_of(label)), color)
        else:
            canvas.box(label.bbox, color)
            canvas.label(label.bbox, f"{label.category[0]}{number_of(label)}", color)
    return canvas.pixels


def number_of(label: Labelled) -> int:
    """Return the drawn number: that of the track, or the annotation's id."""
    return label.id if label.track_id is None else label.track_id


def color_of(label: Labelled) -> Color:
    """Return the colour of a road user in all drawings."""
    return (
        DRAWING_STYLE.ignored if label.ignored else DRAWING_STYLE.palette[number_of(label) % len(DRAWING_STYLE.palette)]
    )


def words_of(vehicle: Annotation | RoadUser) -> str:
    """Describe a road user in a few words."""
    if isinstance(vehicle, Annotation):
        parts = [f"{vehicle.vehicle_type or 'vehicle'} {number_of(vehicle)}", vehicle.color]
    else:
        parts = [f"{vehicle.category} {number_of(vehicle)}"]
    if vehicle.distance is not None:
        parts.append(f"{vehicle.distance:.0f} m away")
    if vehicle.velocity is not None:
        parts.append(f"{3.6 * float(np.linalg.norm(vehicle.velocity)):.0f} km/h")
    if vehicle.occlusion:
        parts.append(f"{vehicle.occlusion:.0%} hidden")
    if vehicle.ignored:
        parts.append(f"ignored: {vehicle.ignore_reason or 'no reason given'}")
    return ", ".join(part for part in parts if part)


def numbered(image: Pixels, vehicles: Iterable[Annotation], *, scale: int = 1) -> Pixels:
    """Draw ground truth with the number of each keypoint beside it and without boxes' labels.

    Args:
        image: (H, W, 3) RGB.
        vehicles: The image's annotations.
        scale: Enlargement factor.

    Returns:
        (scale H, scale W, 3) RGB.
    """
    canvas = _Canvas(image, scale)
    for vehicle in vehicles:
        seen = vehicle.keypoints[:, 2]
        canvas.vehicle(vehicle.bbox, vehicle.keypoints, seen > 0, seen > 1, DRAWING_STYLE.palette[0])
        for i in np.flatnonzero(seen > 0):
            canvas.number(vehicle.keypoints[i, :2], int(i), bold=bool(seen[i] > 1))
    return canvas.pixels


def results(
    image: Pixels,
    found: Iterable[Result],
    road_users: Iterable[RoadUserResult] = (),
    *,
    scale: int = 1,
    scheme: Scheme = SKOPE33,
) -> Pixels:
    """Draw detections on a copy of an image, the best one on top.

    Keypoints are filled at a probability of 0.5 or more, hollow and faint below, and omitted below 0.15. Small vehicles
    have neither skeleton nor label, which would hide their neighbours. The label is the score. Other road users have a
    box in the colour of their category and a label that begins with its first letter.

    Args:
        image: (H, W, 3) RGB.
        found: Vehicles, in pixels of the image.
        road_users: Pedestrians and two-wheelers.
        scale: Enlargement factor.
        scheme: Scheme of the keypoints.

    Returns:
        (scale H, scale W, 3) RGB.
    """
    canvas = _Canvas(image, scale, scheme)
    for user in sorted(road_users, key=lambda r: r.score):
        color = DRAWING_STYLE.palette[user.category_id]
        canvas.box(user.bbox, color)
        if not canvas.is_small(user.bbox):
            canvas.label(user.bbox, f"{user.category[0]} {user.score:.2f}", color)
    ordered = sorted(found, key=lambda r: r.score)
    canvas.faint_points(ordered)
    for i, result in enumerate(ordered):
        color = DRAWING_STYLE.palette[i % len(DRAWING_STYLE.palette)]
        canvas.prediction(result.bbox, result.keypoints, color)
        if not canvas.is_small(result.bbox):
            canvas.label(result.bbox, f"{result.score:.2f}", color)
    return canvas.pixels


def boxes_3d(image: Pixels, vehicles: Iterable[Labelled], camera: Camera) -> Pixels:
    """Draw the edges of road users' 3D boxes on a copy of an image; edges of the front are thicker.

    Args:
        image: (H, W, 3) RGB.
        vehicles: Labels of vehicles or other road users; those without `box_3d` are skipped.
        camera: The image's camera.
    """
    canvas = _Canvas(image, 1)
    for vehicle in vehicles:
        if vehicle.box_3d is None:
            continue
        canvas.box_3d(vehicle.box_3d, camera, color_of(vehicle))
    return canvas.pixels


def edges_3d(box: Box3D, camera: Camera) -> Iterator[tuple[list[NDArray[np.float64]], bool]]:
    """Yield each of a box's 12 edges as pieces (2, 2) in pixels, which a lens may bend, and whether it is in front.

    Parts behind the camera are omitted.
    """
    corners = np.array(list(itertools.product((-0.5, 0.5), repeat=3))) * box.size_lwh @ box.R.T + box.center
    along = np.linspace(0, 1, 17)[:, None]
    for a, b in itertools.combinations(range(8), 2):
        if (a ^ b).bit_count() == 1:
            pixels, _, valid = camera.project(corners[a] * (1 - along) + corners[b] * along)
            yield [pixels[i : i + 2] for i in np.flatnonzero(valid[1:] & valid[:-1])], a >= 4 and b >= 4


def visible_mask(vehicle: Labelled) -> NDArray[np.bool_] | None:
    """Return (H, W) a road user's visible pixels; None if they are not given as RLE."""
    if not isinstance(vehicle.segmentation, Mapping):
        return None
    counts = str(vehicle.segmentation["counts"]).encode()
    return np.asarray(coco_mask.decode({**vehicle.segmentation, "counts": counts}), dtype=np.bool_)


def masks(image: Pixels, vehicles: Iterable[Labelled], *, strength: float = 0.45) -> Pixels:
    """Tint road users' visible pixels on a copy of an image.

    Args:
        image: (H, W, 3) RGB.
        vehicles: Labels of vehicles or other road users; those without an RLE mask are skipped.
        strength: Share of the tint, 0 to 1.
    """
    out = check_image("image", image).astype(np.float32)
    for vehicle in vehicles:
        inside = visible_mask(vehicle)
        if inside is not None:
            out[inside] = (1 - strength) * out[inside] + strength * np.array(color_of(vehicle), dtype=np.float32)
    return np.rint(out).astype(np.uint8)


def depth(metres: NDArray[np.float32], *, near: float = 4.0) -> Pixels:
    """Return a picture of (H, W) distances, metres: red at `near`, blue far away, dark where not finite (sky). Raises
    UserError."""
    if metres.ndim != 2 or not metres.size or metres.dtype.kind != "f":
        raise UserError(
            f"metres: expected (H, W) numbers of a floating type, got {metres.shape} of type {metres.dtype}"
        )
    nearness = np.clip(255 * near / np.maximum(metres, near), 0, 255).astype(np.uint8)
    colors = cv2.cvtColor(cv2.applyColorMap(nearness, cv2.COLORMAP_TURBO), cv2.COLOR_BGR2RGB)
    colors[~np.isfinite(metres)] = DRAWING_STYLE.dark
    return np.asarray(colors, dtype=np.uint8)


def occlusion(image: Pixels, vehicles: Iterable[Labelled]) -> Pixels:
    """Draw each road user's box with its hidden share on a copy of (H, W, 3) `image`."""
    canvas = _Canvas(image, 1)
    for vehicle in vehicles:
        share = vehicle.occlusion or 0.0
        color = (round(80 + 175 * share), round(200 * (1 - share)), 60)
        canvas.dashed_box(vehicle.bbox, color)
        text = f"{share:.0%} hidden" + (f", {vehicle.ignore_reason}" if vehicle.ignored else "")
        canvas.label(vehicle.bbox, text, color)
    return canvas.pixels


def caption(image: Pixels, text: str) -> Pixels:
    """Return a copy of (H, W, 3) `image` with a line of text on a dark strip above it, shortened if it is too long."""
    image = check_image("image", image)
    size = max(0.4, image.shape[1] / 1600)
    strip = np.full((round(36 * size) + 4, image.shape[1], 3), DRAWING_STYLE.dark, dtype=np.uint8)
    # The Hershey fonts have ASCII only, about 18 pixels per letter.
    text = text.encode("ascii", "replace").decode()[: int(image.shape[1] / (18 * size))]
    origin = (round(8 * size), round(26 * size) + 2)
    cv2.putText(strip, text, origin, _LABEL_FONT, 0.8 * size, (255, 255, 255), max(1, round(size)), cv2.LINE_AA)
    return np.concatenate([strip, image])


def contact_sheet(images: Sequence[Pixels], columns: int, *, gap: int = 4) -> Pixels:
    """Put images in rows, each at the top left of a cell as large as the largest of them.

    Args:
        images: (H, W, 3) RGB each, of any sizes; at least one.
        columns: Number of images per row.
        gap: Distance between cells, pixels.

    Raises:
        ValueError: There is no image or no column.
    """
    if not images or columns < 1:
        raise ValueError("a contact sheet needs at least one image and one column")
    images = [check_image(f"images[{i}]", image) for i, image in enumerate(images)]
    columns = min(columns, len(images))
    rows = -(-len(images) // columns)
    height, width = (max(image.shape[axis] for image in images) + gap for axis in (0, 1))
    sheet = np.full((rows * height - gap, columns * width - gap, 3), DRAWING_STYLE.dark, dtype=np.uint8)
    for i, image in enumerate(images):
        y, x = i // columns * height, i % columns * width
        sheet[y : y + image.shape[0], x : x + image.shape[1]] = image
    return sheet


def write(path: str | Path, image: Pixels) -> None:
    """Write an image, (H, W, 3) RGB, atomically, in the format of the path's suffix. Raises UserError."""
    path = Path(path)
    # In memory, because OpenCV ends the process at a path that is not UTF-8.
    encoded, data = cv2.imencode(path.suffix, cv2.cvtColor(check_image("image", image), cv2.COLOR_RGB2BGR))
    if not encoded:
        raise UserError(f"{path}: the image could not be encoded")
    write_bytes(path, data.tobytes())


class _Canvas:
    """Image to draw on; positions are pixels of the image before enlargement."""

    def __init__(self, image: Pixels, scale: int, scheme: Scheme = SKOPE33) -> None:
        image = check_image("image", image)
        size = (image.shape[1] * scale, image.shape[0] * scale)
        self.pixels: Pixels = cv2.resize(image, size, interpolation=cv2.INTER_CUBIC) if scale > 1 else image.copy()  # type: ignore[assignment]
        self._scale, self._scheme = scale, scheme
        self._unit = max(1.0, min(size) / 540)
        """Base width of lines and letters: one pixel at 960x540 and below, two at 1920x1080."""
        self._line = round(self._unit)

    def vehicle(
        self,
        bbox: ArrayLike,
        points: NDArray[np.float64],
        shown: NDArray[np.bool_],
        sure: NDArray[np.bool_],
        color: Color,
    ) -> None:
        """Draw a box, the skeleton between shown points (dimmer if an end is not sure), and the points."""
        self.box(bbox, color)
        self._skeleton(points, shown, sure, color)
        self._points(bbox, points, shown, sure)

    def prediction(self, bbox: ArrayLike, points: NDArray[np.float64], color: Color) -> None:
        """Draw a predicted vehicle: a box, and those keypoints (33, 3: x, y, probability) and edges that are sure."""
        sure = points[:, 2] >= DRAWING_STYLE.drawn_probability
        self._box(bbox, color, max(1, self._line // 2) if self.is_small(bbox) else self._line)
        if not self.is_small(bbox):
            self._skeleton(points, sure, sure, color)
        self._points(bbox, points, sure, sure)

    def is_small(self, bbox: ArrayLike) -> bool:
        """Return whether drawings in a box would cover all of it."""
        return bool(max(np.asarray(bbox)[2:]) * self._scale < DRAWING_STYLE.small_px * self._unit)

    def faint_points(self, found: Iterable[Result]) -> None:
        """Draw the keypoints of predicted vehicles that are neither sure nor improbable."""
        before = self.pixels.copy()
        for result in found:
            probability = result.keypoints[:, 2]
            faint = (probability >= DRAWING_STYLE.faint_probability) & (probability < DRAWING_STYLE.drawn_probability)
            self._points(result.bbox, result.keypoints, faint, ~faint)
        cv2.addWeighted(self.pixels, DRAWING_STYLE.faintness, before, 1 - DRAWING_STYLE.faintness, 0, dst=self.pixels)

    def box(self, bbox: ArrayLike, color: Color) -> None:
        """Draw the outline of a box."""
        self._box(bbox, color, self._line)

    def _box(self, bbox: ArrayLike, color: Color, thickness: int) -> None:
        x0, y0, x1, y1 = xywh_to_xyxy(bbox)
        self._polyline([(x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)], color, thickness)

    def _skeleton(
        self, points: NDArray[np.float64], shown: NDArray[np.bool_], sure: NDArray[np.bool_], color: Color
    ) -> None:
        """Draw the skeleton between shown points, dimmer if an end is not sure."""
        dim = tuple(c // 2 for c in color)
        for a, b in self._scheme.skeleton:
            if shown[a] and shown[b]:
                edge = color if sure[a] and sure[b] else dim
                self._polyline([points[a, :2], points[b, :2]], edge, max(1, self._line // 2))

    def _points(
        self, bbox: ArrayLike, points: NDArray[np.float64], shown: NDArray[np.bool_], sure: NDArray[np.bool_]
    ) -> None:
        """Draw the shown points: filled if they are sure, else hollow."""
        # Small vehicles get small points, so that they do not merge into a blot.
        least = 0.8 if self.is_small(bbox) else 1.5
        radius = float(np.clip(max(np.asarray(bbox)[2:]) * self._scale / 50, least, 2.25 * self._unit))
        for i in np.flatnonzero(shown):
            self._point(points[i, :2], radius, self._scheme.colors[i], filled=bool(sure[i]))

    def box_3d(self, box: Box3D, camera: Camera, color: Color) -> None:
        """Draw a box's edges; those of its front are thicker."""
        for pieces, front in edges_3d(box, camera):
            for piece in pieces:
                self._polyline(piece, color, 2 * self._line if front else max(1, self._line))

    def dashed_box(self, bbox: ArrayLike, color: Color) -> None:
        """Draw the outline of a box in dashes."""
        x0, y0, x1, y1 = xywh_to_xyxy(bbox)
        corners = np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)])
        for start, end in itertools.pairwise(corners):
            edge = float(np.hypot(*(end - start))) * self._scale
            # An odd number of equal dashes and gaps, so that each corner is drawn.
            parts = 2 * int(np.clip(edge / (12 * self._unit), 2, 200)) + 1
            for i in range(0, parts, 2):
                ends = [start + (end - start) * at / parts for at in (i, i + 1)]
                self._polyline(ends, color, max(1, self._line // 2))

    def label(self, bbox: ArrayLike, text: str, color: Color) -> None:
        """Draw text in a filled tag on top of a box, inside the image."""
        size = 0.4 * self._unit
        (width, height), base = cv2.getTextSize(text, _LABEL_FONT, size, self._line)
        x, y = (int(v * self._scale) for v in np.asarray(bbox)[:2])
        x = max(0, min(x, self.pixels.shape[1] - width - 2))
        bottom = min(max(y, height + base), self.pixels.shape[0] - 1)
        cv2.rectangle(self.pixels, (x, bottom - height - base), (x + width + 2, bottom), color, -1)
        cv2.putText(
            self.pixels,
            text,
            (x + 1, bottom - base // 2 - 1),
            _LABEL_FONT,
            size,
            DRAWING_STYLE.dark,
            self._line,
            cv2.LINE_AA,
        )

    def number(self, at: ArrayLike, number: int, *, bold: bool) -> None:
        """Draw a keypoint's number to the upper right of it."""
        x, y = (int(v * self._scale) for v in np.asarray(at))
        size, color = 0.36 * self._unit, (255, 255, 255) if bold else DRAWING_STYLE.ignored
        origin = (x + round(3 * self._unit), y - round(3 * self._unit))
        for ink, thickness in ((DRAWING_STYLE.dark, 3 * self._line), (color, self._line)):
            cv2.putText(self.pixels, str(number), origin, _LABEL_FONT, size, ink, thickness, cv2.LINE_AA)

    def note(self, bbox: ArrayLike, text: str, color: Color) -> None:
        """Draw small text below a box, without a tag, so that ignored road users do not hide others."""
        x, y, _, height = np.asarray(bbox, dtype=np.float64) * self._scale
        size = 0.3 * self._unit
        (_, text_height), _ = cv2.getTextSize(text, _LABEL_FONT, size, 1)
        origin = (int(x), min(int(y + height) + text_height + 2, self.pixels.shape[0] - 2))
        cv2.putText(self.pixels, text, origin, _LABEL_FONT, size, color, 1, cv2.LINE_AA)

    def _fixed(self, points: ArrayLike) -> NDArray[np.int32]:
        at = (np.asarray(points, dtype=np.float64) * self._scale - 0.5) * (1 << DRAWING_STYLE.subpixel_bits)
        # A stray prediction must not overflow OpenCV's fixed-point numbers.
        return np.rint(np.clip(at, -(2**26), 2**26)).astype(np.int32)

    def _polyline(self, points: ArrayLike, color: Sequence[int], thickness: int) -> None:
        cv2.polylines(
            self.pixels, [self._fixed(points)], False, color, thickness, cv2.LINE_AA, DRAWING_STYLE.subpixel_bits
        )

    def _point(self, at: ArrayLike, radius: float, color: Color, *, filled: bool) -> None:
        x, y = self._fixed(at).tolist()
        fixed_radius = round(radius * (1 << DRAWING_STYLE.subpixel_bits))
        if filled:
            rim = round(min(1.0, radius / 3) * (1 << DRAWING_STYLE.subpixel_bits))
            cv2.circle(
                self.pixels,
                (x, y),
                fixed_radius + rim,
                DRAWING_STYLE.dark,
                -1,
                cv2.LINE_AA,
                DRAWING_STYLE.subpixel_bits,
            )
            cv2.circle(self.pixels, (x, y), fixed_radius, color, -1, cv2.LINE_AA, DRAWING_STYLE.subpixel_bits)
        else:
            cv2.circle(self.pixels, (x, y), fixed_radius, color, self._line, cv2.LINE_AA, DRAWING_STYLE.subpixel_bits)
