"""Keypoint R-CNN with 33 keypoints: build, save, load, run. Stock torchvision inside.

Boxes and keypoints are continuous pixel coordinates of the image that was passed in, as everywhere in skope.
torchvision resizes the image before the network and scales the answers back by the same two factors.
"""

import contextlib
import functools
import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as serialized
from torch import nn
from torch.overrides import TorchFunctionMode
from torchvision.models.detection import KeypointRCNN
from torchvision.models.detection.anchor_utils import AnchorGenerator
from torchvision.models.detection.backbone_utils import resnet_fpn_backbone
from torchvision.models.detection.transform import resize_boxes
from torchvision.ops import FrozenBatchNorm2d

from skope import boxes, compact_weights, keypoints, weights
from skope.errors import UserError, one_of
from skope.files import write_bytes
from skope.heatmap_peaks import heatmap_peaks
from skope.schema import Result

NORMS: Final = ("frozen", "batch")
ANCHORS: Final = (32, 64, 128, 256, 512)
"""Sides of the anchors in torchvision's own model, pixels inside the network: one for each level of the pyramid."""
ASPECTS: Final = (0.5, 1.0, 2.0)
"""Heights of the anchors of a level over their widths, as in torchvision's own model."""
MAX_DETECTIONS: Final = 300
"""Vehicles that may be found in one image; torchvision's own 100 is too few for a queue at rush hour."""
PROPOSALS: Final = 300
"""Regions of an image that are looked at closely when vehicles are found; of torchvision's own 1000 the others cost a
third of the time on a CPU and found no further vehicle (docs/results.md)."""
MIN_SCORE: Final = 0.05
"""Detections that score less are not reported."""

HEADER: Final = "skope"
_PACKED: Final = "packed"
_CHECKSUM: Final = "sha256"
_FORMAT_VERSION: Final = 1
_REGIONS_AT_ONCE: Final = 128
"""Given boxes that go through the keypoint head together, so that memory stays small."""


# ---------------------------------------------------------------------------------------------------------- building


@dataclass(frozen=True, kw_only=True)
class DetectorConfig:
    """What a state dict does not tell about its model."""

    norm: str
    """`frozen` (FrozenBatchNorm2d, for weights that were trained before) or `batch` (BatchNorm2d, which learns)."""
    norm_eps: float
    """Number that normalisation adds to each variance; 0 in the weights trained on COCO."""
    min_size: int
    """Short side of the image inside the network, pixels, unless its long side would then exceed `max_size`."""
    max_size: int
    """Largest long side of the image inside the network, pixels."""
    scheme: str = keypoints.SCHEME
    """What the keypoints are: a name in `keypoints.SCHEMES`."""
    anchors: tuple[int, ...] = ANCHORS
    """Sides of the anchors of each level of the pyramid, finest first, pixels inside the network."""

    def __post_init__(self) -> None:
        one_of("scheme", self.scheme, tuple(keypoints.SCHEMES))
        check_anchors(self.anchors)
        one_of("norm", self.norm, NORMS)
        if isinstance(self.norm_eps, bool) or not isinstance(self.norm_eps, int | float) or not 0 <= self.norm_eps < 1:
            raise UserError(f"norm_eps: expected a number from 0 to 1, got {self.norm_eps!r}")
        for name in ("min_size", "max_size"):
            value = getattr(self, name)
            # Below 64 the backbone's last map may be a single cell, which has no variance to normalise by.
            if isinstance(value, bool) or not isinstance(value, int) or not 64 <= value <= 16384:
                raise UserError(f"{name}: expected 64 to 16384 pixels, got {value!r}")
        if self.max_size < self.min_size:
            raise UserError(f"max_size: {self.max_size} is less than min_size, {self.min_size}")

    def with_min_size(self, min_size: int) -> Self:
        """The config with another short side, pixels; the long side's limit changes in proportion."""
        return replace(self, min_size=min_size, max_size=round(min_size * self.max_size / self.min_size))

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """The config of `to_dict`; a UserError names a field that is missing, unknown or out of range."""
        names = {field.name for field in fields(cls)}
        # Older checkpoints do not name their scheme and anchors.
        if not isinstance(values, Mapping) or {"scheme", "anchors", *values} != names:
            raise UserError(f"config: expected the fields {', '.join(sorted(names))}, got {str(values)[:80]}")
        anchors = values.get("anchors", ANCHORS)
        if not isinstance(anchors, list | tuple):
            raise UserError(f"anchors: expected a list of pixels, got {anchors!r}")
        return cls(**{**values, "anchors": tuple(anchors)})


def check_anchors(anchors: Sequence[int]) -> None:
    """Raise a UserError unless these are sides of anchors, one for each level of the pyramid, from small to large."""
    whole = all(isinstance(side, int) and not isinstance(side, bool) and side >= 4 for side in anchors)
    if not whole or len(anchors) != len(ANCHORS) or list(anchors) != sorted({*anchors}):
        raise UserError(f"anchors: expected {len(ANCHORS)} rising sides from 4 pixels, got {list(anchors)}")


_WITHOUT_BFLOAT16: Final = ("SSE41", "AVX", "AVX2", "AVX2_VNNI", "AVX512_CORE", "AVX512_CORE_VNNI")


def has_bfloat16(device: torch.device) -> bool:
    """Whether the processor has instructions for bfloat16; without them it is slower than float32, not faster.

    Of a CPU those count that the library of its products may use: ONEDNN_MAX_CPU_ISA limits them.
    """
    if device.type == "cuda":
        return bool(torch.cuda.is_bf16_supported(including_emulation=False))
    able = torch.cpu.get_capabilities()
    allowed = os.environ.get("ONEDNN_MAX_CPU_ISA", "ALL").upper() not in _WITHOUT_BFLOAT16
    return allowed and bool(able.get("amx_bf16") or able.get("avx512_bf16"))


def choose_device(name: str) -> torch.device:
    """The device of a `--device` flag; `auto` is a GPU where there is one."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if not re.fullmatch(r"cpu|cuda(:\d+)?", name):
        raise UserError(f"device: {name!r} is not one of auto, cpu, cuda, cuda:N")
    device = torch.device(name)
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise UserError(f"device: {name} is not there (torch sees {torch.cuda.device_count()} GPUs)")
    return device


def build(config: DetectorConfig, *, trainable_layers: int = 5, num_keypoints: int = keypoints.K) -> KeypointRCNN:
    """Keypoint R-CNN (He et al., 2017; ResNet50-FPN) for one class, with weights drawn from torch's random state.

    Args:
        config: Normalisation and size of the images inside the network.
        trainable_layers: How many of the backbone's stages learn, 0 to 5 from the last one, where normalisation is
            frozen; with normalisation that learns all of them do, as in torchvision.
        num_keypoints: Another number than 33 is for weights that were trained on such a scheme and whose predictor is
            replaced next.
    """
    norm = FrozenBatchNorm2d if config.norm == "frozen" else nn.BatchNorm2d
    backbone = resnet_fpn_backbone(
        backbone_name="resnet50",
        weights=None,
        norm_layer=functools.partial(norm, eps=config.norm_eps),
        trainable_layers=trainable_layers if config.norm == "frozen" else 5,
    )
    return KeypointRCNN(
        backbone,
        num_classes=2,  # 0 is the background
        num_keypoints=num_keypoints,
        min_size=config.min_size,
        max_size=config.max_size,
        box_detections_per_img=MAX_DETECTIONS,
        rpn_post_nms_top_n_test=PROPOSALS,
        rpn_anchor_generator=AnchorGenerator(tuple((side,) for side in config.anchors), (ASPECTS,) * len(ANCHORS)),
    )


# --------------------------------------------------------------------------------------------------------- checkpoints


def save_weights(path: Path, model: KeypointRCNN, config: DetectorConfig, metadata: Mapping[str, Any]) -> None:
    """Write a checkpoint, whose tensors are those of torchvision's own model: they load there with `strict=True`.

    Args:
        path: The .safetensors file to write.
        model: The weights.
        config: What the weights do not tell about the model.
        metadata: JSON values, which `load_weights` gives back.
    """
    write_bytes(path, checkpoint_bytes(model, config, metadata))


def checkpoint_bytes(
    model: KeypointRCNN,
    config: DetectorConfig,
    metadata: Mapping[str, Any],
    *,
    packed: bool = False,
    moments: Mapping[str, torch.Tensor] | None = None,
) -> bytes:
    """A checkpoint: safetensors whose header holds scheme, config and `metadata` (JSON values) as JSON.

    The tensors are the model's, or, `packed`, what `skope.compact_weights` makes of them: a seventh of the bytes, with
    a checksum, where `moments` are those that `pack` takes. The same model gives the same bytes.
    """
    header: dict[str, Any] = {
        "version": _FORMAT_VERSION,
        "scheme": config.scheme,
        "num_keypoints": keypoints.K,
        "config": config.to_dict(),
        "metadata": dict(metadata),
    }
    state = full_state(model)
    if packed:
        state, header[_PACKED] = compact_weights.pack(state, moments=moments)
        header[_CHECKSUM] = compact_weights.digest(state, header)
    # safetensors writes several metadata fields in any order; one field keeps the bytes the same.
    return serialized(state, {HEADER: json.dumps(header, allow_nan=False)})


def full_state(model: KeypointRCNN) -> dict[str, torch.Tensor]:
    """The model's tensors, which load strictly into torchvision's own model, whichever normalisation it has."""
    state = {name: tensor.detach().cpu().contiguous() for name, tensor in model.state_dict().items()}
    # BatchNorm2d counts batches and FrozenBatchNorm2d does not; a count that is always there suits both.
    for name in [name for name in state if name.endswith(".running_var")]:
        state.setdefault(name.removesuffix("running_var") + "num_batches_tracked", torch.zeros((), dtype=torch.int64))
    return state


def load_weights(
    path: Path, device: torch.device | str, *, trainable_layers: int = 5
) -> tuple[KeypointRCNN, DetectorConfig, dict[str, Any]]:
    """Load a checkpoint that `save_weights` wrote.

    Args:
        path: The .safetensors file.
        device: Where the model shall be.
        trainable_layers: As in `build`.

    Returns:
        The model in evaluation mode, its config, and the metadata.

    Raises:
        UserError: The file, which it names, is no such checkpoint, or one of an unknown keypoint scheme.
    """
    header, state = read_checkpoint(path)
    try:
        config = DetectorConfig.from_dict(header["config"])
    except UserError as error:
        raise UserError(f"{path}: {error}") from None
    with _NotDrawn():
        model = build(config, trainable_layers=trainable_layers)
    _check_tensors(path, model.state_dict(), state)
    model.load_state_dict(state)
    return model.to(device).eval(), config, header["metadata"]


class _NotDrawn(TorchFunctionMode):
    """Leave weights that a file will give as their memory is: drawing 59 million of them takes longer than reading."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return args[0] if func in (torch.Tensor.normal_, torch.Tensor.uniform_) else func(*args, **(kwargs or {}))


def read_checkpoint(path: Path) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
    """The checked header (config, metadata ...) and the tensors of a checkpoint."""
    if not path.is_file():
        raise UserError(f"{path}: no such checkpoint file")
    try:
        with safe_open(path, framework="pt") as file:
            header = _check_header(path, file.metadata() or {})
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a mapping)
    except (SafetensorError, OSError) as error:
        raise UserError(f"{path}: not a safetensors file, or a truncated one ({error})") from None
    return header, _unpacked(path, header, tensors) if _PACKED in header else tensors


def _unpacked(path: Path, header: dict[str, Any], tensors: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    digested = {name: value for name, value in header.items() if name != _CHECKSUM}
    if compact_weights.digest(tensors, digested) != header.get(_CHECKSUM):
        raise UserError(f"{path}: {_CHECKSUM} differs: the file is damaged, or was changed after it was written")
    try:
        return compact_weights.unpack(tensors, header[_PACKED])
    except compact_weights.DamagedError as error:
        raise UserError(f"{path}: {error}") from None


def _check_header(path: Path, metadata: Mapping[str, str]) -> dict[str, Any]:
    if HEADER not in metadata:
        raise UserError(f"{path}: not a checkpoint of skope (its header has no field {HEADER})")
    try:
        header = json.loads(metadata[HEADER])
    except json.JSONDecodeError:
        header = None
    if not isinstance(header, dict) or not {"config", "metadata"} <= set(header):
        raise UserError(f"{path}: the header's field {HEADER} is damaged")
    expected = {"version": _FORMAT_VERSION, "num_keypoints": keypoints.K}
    for name, value in expected.items():
        if header.get(name) != value:
            raise UserError(f"{path}: {name}: expected {value!r}, got {header.get(name)!r}")
    one_of(f"{path}: scheme", header.get("scheme"), tuple(keypoints.SCHEMES))
    return header


def _check_tensors(path: Path, expected: Mapping[str, torch.Tensor], got: Mapping[str, torch.Tensor]) -> None:
    counts = {name for name in got if name.endswith(".num_batches_tracked")}
    missing, extra = sorted(set(expected) - set(got)), sorted(set(got) - set(expected) - counts)
    for what, names in (("lacks", missing), ("has unknown", extra)):
        if names:
            raise UserError(f"{path}: {what} {len(names)} tensor(s), first {names[0]}")
    for name, tensor in expected.items():
        if got[name].shape != tensor.shape:
            raise UserError(f"{path}: tensor {name}: expected {tuple(tensor.shape)}, got {tuple(got[name].shape)}")


BEST: Final = "best.safetensors"
"""File name of the weights of a run's best epoch."""


def checkpoint_name(epoch: int) -> str:
    """File name of the checkpoint after `epoch` epochs."""
    return f"epoch_{epoch:03d}.safetensors"


def checkpoints(run: Path) -> dict[int, Path]:
    """Checkpoints of a run folder by the number of epochs behind them, ascending."""
    found = ((re.fullmatch(r"epoch_(\d+)\.safetensors", path.name), path) for path in run.glob("epoch_*.safetensors"))
    return dict(sorted((int(match.group(1)), path) for match, path in found if match))


def find_checkpoint(path: Path) -> Path:
    """The weights that `path` names.

    `path` itself if it is a file; the newest checkpoint of the run folder `path`, or the best if alone; or, where
    neither is there, the weights of that name that come with the package. Raises UserError where there are none.
    """
    if path.is_file():
        return path
    if not path.is_dir():
        if str(path) in weights.names():
            return weights.path(str(path))
        shipped = "".join(f"; {name} comes with skope" for name in weights.names())
        raise UserError(f"{path}: no such checkpoint or run folder; `skope train` makes one{shipped}")
    found = checkpoints(path)
    if not found and (path / BEST).is_file():
        return path / BEST
    if not found:
        raise UserError(f"{path}: no checkpoint in this folder (epoch_NNN.safetensors); `skope train` makes one")
    return found[max(found)]


# -------------------------------------------------------------------------------------------------------------- running


@dataclass(frozen=True)
class Detections:
    """Vehicles found in one image, best score first."""

    boxes_xyxy: NDArray[np.float64]
    """(N, 4) pixels of the original image."""
    scores: NDArray[np.float64]
    """(N,) confidence that this is a vehicle, 0 to 1."""
    keypoints: NDArray[np.float64]
    """(N, 33, 3) x, y, p: pixels of the original image, and the sigmoid of the heat map's peak, 0 to 1.

    p grows with the network's certainty but is not calibrated, and says nothing on whether a point is hidden. It is
    taken in float64, from which the peak can be had back (`skope.eval.inference.score_calibration` does).
    """
    size: tuple[int, int]
    """Width and height of the image, pixels."""

    def __len__(self) -> int:
        return len(self.scores)

    def above(self, score: float) -> Self:
        """The detections that score higher than `score`, which is from 0 to 1."""
        kept = self.scores > score
        return replace(self, boxes_xyxy=self.boxes_xyxy[kept], scores=self.scores[kept], keypoints=self.keypoints[kept])

    def to_results(self, image_id: int) -> list[Result]:
        """The detections as COCO results of image `image_id`, for `skope.coco.write_results` and `skope.score`."""
        return results(image_id, self.boxes_xyxy, self.scores, self.keypoints)


def results(image_id: int, boxes_xyxy: ArrayLike, scores: ArrayLike, points: ArrayLike) -> list[Result]:
    """Detections in an image, (N, 4), (N,) and (N, 33, 3) as in `Detections`, as N COCO results."""
    rows = zip(boxes.xyxy_to_xywh(boxes_xyxy), np.asarray(scores), np.asarray(points), strict=True)
    return [Result(image_id=image_id, bbox=box, score=float(score), keypoints=found) for box, score, found in rows]


def detect(
    model: KeypointRCNN,
    images: Sequence[NDArray[np.uint8]],
    device: torch.device | str,
    *,
    min_score: float = MIN_SCORE,
    max_detections: int = MAX_DETECTIONS,
) -> list[Detections]:
    """Find vehicles in images, which go through the network as one batch.

    In an image that is less than a pixel wide or high inside the network there are none.

    Args:
        model: The detector.
        images: (H, W, 3) uint8 sRGB each, of any sizes.
        device: Where the model is.
        min_score: Only detections that score above this are made.
        max_detections: The best of an image, at most so many.

    Returns:
        The detections of each image.
    """
    seen = [i for i, image in enumerate(images) if _short_side(model, image) >= 1]
    with _inference(model, min_score, max_detections):
        found = dict(zip(seen, _found(model, [images[i] for i in seen], device), strict=True)) if seen else {}
    return [found[i] if i in found else _nothing(image) for i, image in enumerate(images)]


def _found(
    model: KeypointRCNN, images: Sequence[NDArray[np.uint8]], device: torch.device | str
) -> Iterator[Detections]:
    """The detections of images: torchvision's own path through the model, but for how heat maps are read."""
    batch, _ = model.transform([as_tensor(image, device) for image in images])
    features = model.backbone(batch.tensors)
    proposals, _ = model.rpn(batch, features)
    heads = model.roi_heads
    regions = heads.box_head(heads.box_roi_pool(features, proposals, batch.image_sizes))
    rectangles, scores, _ = heads.postprocess_detections(*heads.box_predictor(regions), proposals, batch.image_sizes)
    points = _keypoints(model, features, rectangles, batch.image_sizes)
    # One way to the processor for the whole batch: on a GPU each takes as long as a small one.
    together = torch.cat([torch.cat(rectangles), torch.cat(scores)[:, None], points.flatten(1)], dim=1).cpu().double()
    of_image = torch.split(together, [len(one) for one in scores])
    for image, inner_size, found in zip(images, batch.image_sizes, of_image, strict=True):
        yield _in_image(image, inner_size, found[:, :4], found[:, 4], found[:, 5:].view(-1, keypoints.K, 3))


def _keypoints(
    model: KeypointRCNN,
    features: Mapping[str, torch.Tensor],
    rectangles: Sequence[torch.Tensor],
    inner_sizes: Sequence[tuple[int, int]],
) -> torch.Tensor:
    """(N, 33, 3) x, y and peak logit for the N boxes of all images, (.., 4) of each, in pixels inside the network."""
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
    """What was found in an image, in its own pixels."""
    size = (image.shape[1], image.shape[0])
    scale = _scale(inner_size, size)
    in_pixels = (rectangles.reshape(-1, 2, 2) * scale).reshape(-1, 4)
    return Detections(in_pixels.numpy(), scores.numpy(), _with_probability(points, scale), size)


def _scale(inner_size: tuple[int, int], size: tuple[int, int]) -> torch.Tensor:
    """(2,) from pixels inside the network, whose height and width these are, to those of a (width, height) image."""
    return torch.tensor([size[0] / inner_size[1], size[1] / inner_size[0]], dtype=torch.float64)


def _nothing(image: NDArray[np.uint8]) -> Detections:
    """No detections: for an image that is too narrow for the network."""
    return Detections(np.zeros((0, 4)), np.zeros(0), np.zeros((0, keypoints.K, 3)), (image.shape[1], image.shape[0]))


def _short_side(model: KeypointRCNN, image: NDArray[np.uint8]) -> float:
    """Length of an image's short side inside the network, pixels."""
    short, long = sorted(image.shape[:2])
    return float(short * min(model.transform.min_size[-1] / short, model.transform.max_size / long))


def detect_on_boxes(
    model: KeypointRCNN, image: NDArray[np.uint8], boxes_xyxy: ArrayLike, device: torch.device | str
) -> NDArray[np.float64]:
    """Find the keypoints of vehicles whose boxes are given: localisation apart from detection.

    Args:
        model: The detector.
        image: (H, W, 3) uint8 sRGB.
        boxes_xyxy: (N, 4) pixels of `image`.
        device: Where the model is.

    Returns:
        (N, 33, 3) x, y in pixels of `image` and p, as in `Detections.keypoints`.
    """
    boxes = torch.as_tensor(np.asarray(boxes_xyxy, dtype=np.float32).reshape(-1, 4), device=device)
    if not len(boxes):
        return np.zeros((0, keypoints.K, 3))
    with _inference(model, MIN_SCORE, MAX_DETECTIONS):
        batch, _ = model.transform([as_tensor(image, device)])
        (inner_size,) = batch.image_sizes
        features = model.backbone(batch.tensors)
        parts = resize_boxes(boxes, list(image.shape[:2]), list(inner_size)).split(_REGIONS_AT_ONCE)
        found = torch.cat([_keypoints(model, features, [part], [inner_size]) for part in parts])
        return _with_probability(found.cpu().double(), _scale(inner_size, (image.shape[1], image.shape[0])))


@contextlib.contextmanager
def _inference(model: KeypointRCNN, min_score: float, max_detections: int) -> Iterator[None]:
    heads = model.roi_heads
    before = model.training, heads.score_thresh, heads.detections_per_img
    model.eval()
    heads.score_thresh, heads.detections_per_img = min_score, max_detections
    try:
        with torch.inference_mode():
            yield
    finally:
        model.train(before[0])
        heads.score_thresh, heads.detections_per_img = before[1:]


def as_tensor(image: NDArray[np.uint8], device: torch.device | str) -> torch.Tensor:
    """An image as torchvision's detectors take it: (H, W, 3) 0..255 -> (3, H, W) float32 0..1."""
    return torch.as_tensor(image, device=device).permute(2, 0, 1).float() / 255


def _with_probability(points: torch.Tensor, scale: torch.Tensor) -> NDArray[np.float64]:
    """(N, 33, 3) x, y and peak logit inside the network -> x, y, p in an image, which is (2,) times as large."""
    return torch.cat([points[..., :2] * scale, points[..., 2:].sigmoid()], dim=-1).numpy()
