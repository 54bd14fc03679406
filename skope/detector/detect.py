"""Run a detector on images: vehicles with keypoints, other road users, or keypoints in given boxes.

Threads may share a model, because each call locks it.
"""

import contextlib
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Final
from weakref import WeakKeyDictionary

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor
from torchvision.models.detection import KeypointRCNN
from torchvision.models.detection.roi_heads import RoIHeads
from torchvision.models.detection.transform import resize_boxes
from torchvision.ops import clip_boxes_to_image

from skope import keypoints, schema
from skope.detections import Detections, RoadUserDetections
from skope.detector.build import NETWORK_DEFAULTS, box_passes_of
from skope.detector.network_settings import MIN_SCORE

REGIONS_AT_ONCE: Final = 128
"""Number of given boxes that pass through the keypoint head together; it limits memory."""


def heatmap_peaks(maps: Tensor, boxes: Tensor) -> tuple[Tensor, Tensor]:
    """Return positions and values of the maxima of heat maps.

    A parabola through the largest cell and its two neighbours gives the maximum along each axis. torchvision's
    `heatmaps_to_keypoints` enlarges each map to the size of its box and takes the largest pixel. Its positions are
    rounded to pixels of the network's input, which makes them less accurate on small vehicles and takes longer.

    Args:
        maps: (N, K, H, W) logits of K keypoints of N vehicles.
        boxes: (N, 4) xyxy of the vehicles, pixels.

    Returns:
        (N, K, 2) x and y of the peaks, pixels, and (N, K) logits there.
    """
    height, width = maps.shape[2:]
    flat = maps.flatten(2)
    cell = flat.argmax(dim=2)
    row, column = cell // width, cell % width
    # At an edge the inner neighbour stands in for the outer one, so that the peak stays in the middle of its cell.
    around = [
        cell,
        cell + torch.where(column > 0, -1, 1),
        cell + torch.where(column < width - 1, 1, -1),
        cell + torch.where(row > 0, -width, width),
        cell + torch.where(row < height - 1, width, -width),
    ]
    peak, left, right, above, below = flat.gather(2, torch.stack(around, dim=-1)).unbind(dim=-1)
    across, rise_across = _parabola(left, peak, right)
    down, rise_down = _parabola(above, peak, below)
    shares = torch.stack([(column + 0.5 + across) / width, (row + 0.5 + down) / height], dim=-1)
    extents = (boxes[:, None, 2:] - boxes[:, None, :2]).clamp(min=1)
    return boxes[:, None, :2] + shares * extents, peak + rise_across + rise_down


def _parabola(before: Tensor, peak: Tensor, after: Tensor) -> tuple[Tensor, Tensor]:
    """Return position, -0.5 to 0.5, and height above `peak` of the maximum of a parabola through three values."""
    slope, bend = (after - before) / 2, 2 * peak - before - after
    position = torch.where(bend > 0, slope / bend, 0.0).clamp(-0.5, 0.5)
    return position, slope * position / 2


MODEL_LOCKS: Final[WeakKeyDictionary[KeypointRCNN, threading.RLock]] = WeakKeyDictionary()
"""Locks by model. They are not attributes of the models, because models are copied and saved."""
_ALL_LOCKS: Final = threading.Lock()


def detect(
    model: KeypointRCNN,
    images: Sequence[NDArray[np.uint8]],
    device: torch.device | str,
    *,
    min_score: float = MIN_SCORE,
    max_detections: int = NETWORK_DEFAULTS.max_detections,
    categories: Sequence[str] = schema.VEHICLE_ALONE,
) -> list[Detections]:
    """Detect vehicles and other road users in images, as one batch.

    An image that is less than a pixel wide or high inside the network has no detections.

    Args:
        model: The detector.
        images: (H, W, 3) uint8 sRGB each, of any sizes.
        device: Device of the model.
        min_score: Score threshold.
        max_detections: Maximum number of detections per image, over all categories.
        categories: Names of the network's labels, as in `DetectorConfig`.

    Returns:
        The detections of each image.
    """
    seen = [i for i, image in enumerate(images) if _short_side(model, image) >= 1]
    with _inference(model, min_score, max_detections):
        found = (
            dict(zip(seen, _found(model, [images[i] for i in seen], device, categories), strict=True)) if seen else {}
        )
    return [found[i] if i in found else _nothing(image) for i, image in enumerate(images)]


def _found(
    model: KeypointRCNN, images: Sequence[NDArray[np.uint8]], device: torch.device | str, categories: Sequence[str]
) -> Iterator[Detections]:
    """Yield the detections of images, by torchvision's path through the model except for reading heat maps.

    Only vehicles pass through the keypoint head. torchvision sends all categories through it.
    """
    batch, _ = model.transform([as_tensor(image, device) for image in images])
    features = model.backbone(batch.tensors)
    proposals, _ = model.rpn(batch, features)
    heads = model.roi_heads
    regions = heads.box_head(heads.box_roi_pool(features, proposals, batch.image_sizes))
    logits, offsets = heads.box_predictor(regions)
    if logits.shape[1] != 1 + len(categories):
        raise ValueError(f"categories: the network has {logits.shape[1] - 1}, got {', '.join(categories)}")
    rectangles, scores, labels = heads.postprocess_detections(logits, offsets, proposals, batch.image_sizes)
    if box_passes_of(model) > 1 and any(len(label) for label in labels):
        rectangles = _corrected(heads, features, rectangles, labels, batch.image_sizes)
    road_users = [RoadUserDetections()] * len(images)
    if len(categories) > 1:
        road_users = list(_road_users(images, batch.image_sizes, rectangles, scores, labels, categories))
        vehicles = [each == schema.CATEGORY_ID for each in labels]
        rectangles, scores = ([x[v] for x, v in zip(each, vehicles, strict=True)] for each in (rectangles, scores))
    points = _keypoints(model, features, rectangles, batch.image_sizes)
    # A single transfer from the device for the whole batch, because on a GPU each transfer takes as long as a small
    # one.
    together = torch.cat([torch.cat(rectangles), torch.cat(scores)[:, None], points.flatten(1)], dim=1).cpu().double()
    of_image = torch.split(together, [len(image_scores) for image_scores in scores])
    for image, inner_size, found, users in zip(images, batch.image_sizes, of_image, road_users, strict=True):
        points = found[:, 5:].view(-1, keypoints.K, 3)
        yield replace(_in_image(image, inner_size, found[:, :4], found[:, 4], points), road_users=users)


def _corrected(
    heads: RoIHeads,
    features: Mapping[str, torch.Tensor],
    rectangles: Sequence[torch.Tensor],
    labels: Sequence[torch.Tensor],
    inner_sizes: Sequence[tuple[int, int]],
) -> list[torch.Tensor]:
    """Return the (N, 4) boxes of each image after a second pass of the box head, in pixels inside the network.

    The first pass uses a region around the vehicle, the second the box that the first has found. The remaining error of
    the box is small (Cascade R-CNN; Cai and Vasconcelos, 2018; here with a single head).
    """
    _, offsets = heads.box_predictor(heads.box_head(heads.box_roi_pool(features, rectangles, inner_sizes)))
    label_offsets = offsets_of_label(offsets, torch.cat(list(labels))).float()
    moved = heads.box_coder.decode_single(label_offsets, torch.cat(list(rectangles)))
    of_image = torch.split(moved, [len(each) for each in rectangles])
    return [clip_boxes_to_image(each, size) for each, size in zip(of_image, inner_sizes, strict=True)]


def offsets_of_label(offsets: torch.Tensor, labels: torch.Tensor) -> torch.Tensor:
    """Return (N, 4) box head offsets of each box's own label (N,), from (N, 4 C) for C labels."""
    return offsets.view(len(labels), -1, 4)[torch.arange(len(labels), device=labels.device), labels]


def _road_users(
    images: Sequence[NDArray[np.uint8]],
    inner_sizes: Sequence[tuple[int, int]],
    rectangles: Sequence[torch.Tensor],
    scores: Sequence[torch.Tensor],
    labels: Sequence[torch.Tensor],
    categories: Sequence[str],
) -> Iterator[RoadUserDetections]:
    """Return the detections of each image that are not vehicles, in pixels of the image.

    Boxes, scores and labels are (N, 4), (N,) and (N,) of each image, the boxes in pixels inside the network.
    """
    ids = np.array([0, *(1 + schema.CATEGORY_NAMES.index(name) for name in categories)], dtype=np.int64)
    for image, inner_size, image_boxes, sure, label in zip(
        images, inner_sizes, rectangles, scores, labels, strict=True
    ):
        chosen = label != schema.CATEGORY_ID
        in_pixels = _in_pixels(image_boxes[chosen].cpu().double(), _scale(inner_size, (image.shape[1], image.shape[0])))
        of_category = ids[label[chosen].cpu().numpy()]
        yield RoadUserDetections(in_pixels.numpy(), sure[chosen].cpu().double().numpy(), of_category)


def _keypoints(
    model: KeypointRCNN,
    features: Mapping[str, torch.Tensor],
    rectangles: Sequence[torch.Tensor],
    inner_sizes: Sequence[tuple[int, int]],
) -> torch.Tensor:
    """Return (N, 33, 3) x, y and peak logit, in pixels inside the network, for the N boxes (.., 4) of all images."""
    heads = model.roi_heads
    regions = heads.keypoint_roi_pool(features, rectangles, inner_sizes)
    heatmaps = heads.keypoint_predictor(heads.keypoint_head(regions))
    places, logits = heatmap_peaks(heatmaps, torch.cat(list(rectangles)))
    return torch.cat([places, logits[..., None]], dim=-1)


def _in_image(
    image: NDArray[np.uint8],
    inner_size: tuple[int, int],
    rectangles: torch.Tensor,
    scores: torch.Tensor,
    points: torch.Tensor,
) -> Detections:
    """Return detections in an image, in pixels of the image."""
    size = (image.shape[1], image.shape[0])
    scale = _scale(inner_size, size)
    in_pixels = _in_pixels(rectangles, scale)
    return Detections(in_pixels.numpy(), scores.numpy(), _with_probability(points, scale), size)


def _in_pixels(rectangles: torch.Tensor, scale: torch.Tensor) -> torch.Tensor:
    """Return (N, 4) boxes, given inside the network, in pixels of an image that is (2,) times as large."""
    return (rectangles.reshape(-1, 2, 2) * scale).reshape(-1, 4)


def _scale(inner_size: tuple[int, int], size: tuple[int, int]) -> torch.Tensor:
    """Return the (2,) factors from pixels inside the network (height, width) to those of a (width, height) image."""
    return torch.tensor([size[0] / inner_size[1], size[1] / inner_size[0]], dtype=torch.float64)


def _nothing(image: NDArray[np.uint8]) -> Detections:
    """Return no detections, for an image that is too narrow for the network."""
    return Detections(np.zeros((0, 4)), np.zeros(0), np.zeros((0, keypoints.K, 3)), (image.shape[1], image.shape[0]))


def _short_side(model: KeypointRCNN, image: NDArray[np.uint8]) -> float:
    """Return the length of an image's short side inside the network, pixels."""
    short, long = sorted(image.shape[:2])
    return float(short * min(model.transform.min_size[-1] / short, model.transform.max_size / long))


def detect_on_boxes(
    model: KeypointRCNN, image: NDArray[np.uint8], boxes_xyxy: ArrayLike, device: torch.device | str
) -> NDArray[np.float64]:
    """Localise the keypoints of vehicles in given boxes, without detection.

    Args:
        model: The detector.
        image: (H, W, 3) uint8 sRGB.
        boxes_xyxy: (N, 4) pixels of `image`.
        device: Device of the model.

    Returns:
        (N, 33, 3) x, y in pixels of `image` and p, as in `Detections.keypoints`.
    """
    boxes = torch.as_tensor(np.asarray(boxes_xyxy, dtype=np.float32).reshape(-1, 4), device=device)
    if not len(boxes):
        return np.zeros((0, keypoints.K, 3))
    with _inference(model, MIN_SCORE, NETWORK_DEFAULTS.max_detections):
        batch, _ = model.transform([as_tensor(image, device)])
        (inner_size,) = batch.image_sizes
        features = model.backbone(batch.tensors)
        parts = resize_boxes(boxes, list(image.shape[:2]), list(inner_size)).split(REGIONS_AT_ONCE)
        found = torch.cat([_keypoints(model, features, [part], [inner_size]) for part in parts])
        return _with_probability(found.cpu().double(), _scale(inner_size, (image.shape[1], image.shape[0])))


@contextlib.contextmanager
def _inference(model: KeypointRCNN, min_score: float, max_detections: int) -> Iterator[None]:
    """Lock a model for this thread and set these thresholds; restore its state afterwards."""
    heads = model.roi_heads
    with _lock_of(model), torch.inference_mode():
        before = model.training, heads.score_thresh, heads.detections_per_img
        model.eval()
        heads.score_thresh, heads.detections_per_img = min_score, max_detections
        try:
            yield
        finally:
            model.train(before[0])
            heads.score_thresh, heads.detections_per_img = before[1:]


def _lock_of(model: KeypointRCNN) -> threading.RLock:
    """Return the lock that a call holds while it changes the thresholds, mode or intermediate values of a model."""
    with _ALL_LOCKS:
        return MODEL_LOCKS.setdefault(model, threading.RLock())


def as_tensor(image: NDArray[np.uint8], device: torch.device | str) -> torch.Tensor:
    """Return an image as torchvision's detectors expect it: (H, W, 3) 0..255 to (3, H, W) float32 0..1."""
    # torch supports neither negative strides nor read-only arrays; only these are copied.
    plain = np.require(image, requirements=("C", "W"))
    return torch.as_tensor(plain, device=device).permute(2, 0, 1).float() / 255


def _with_probability(points: torch.Tensor, scale: torch.Tensor) -> NDArray[np.float64]:
    """Convert (N, 33, 3) x, y and peak logit inside the network to x, y, p in an image that is (2,) times as large."""
    return torch.cat([points[..., :2] * scale, points[..., 2:].sigmoid()], dim=-1).numpy()
