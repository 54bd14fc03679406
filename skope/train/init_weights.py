"""Initial weights of a training: from COCO, ImageNet, a file or the package, or random.

Published weights are files in torchvision's cache, in torch's own format.
"""

import argparse
import math
import pickle
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlparse

import torch
from safetensors import SafetensorError, safe_open
from torch import nn
from torchvision.models import WeightsEnum
from torchvision.models.detection import KeypointRCNN, KeypointRCNN_ResNet50_FPN_Weights
from torchvision.models.detection.keypoint_rcnn import KeypointRCNNPredictor

from skope import keypoints
from skope.detector import weights
from skope.detector.backbones import BACKBONE_CHOICES, DEFAULT_BACKBONE
from skope.detector.build import DetectorConfig, build
from skope.detector.checkpoint import HEADER_FIELD, config_in, find_checkpoint, read_checkpoint
from skope.errors import UserError, first_line
from skope.keypoints import Scheme
from skope.schema import VEHICLE_ALONE
from skope.train.network_shape import AS_GIVEN, NetworkShape
from skope.train.recipe import SMALL_SIZE

PublishedState = dict[str, torch.Tensor]
_NO_WEIGHTS: Final = "not a file of weights of torch's, or one that did not arrive whole"


def cached_weights(weights: WeightsEnum) -> Path:
    """Return the path at which torchvision stores the file of published weights, whether or not it exists."""
    return Path(torch.hub.get_dir()) / "checkpoints" / Path(urlparse(weights.url).path).name


def fetch(init: str, weights: WeightsEnum) -> Path:
    """Return the file of published weights, downloaded if missing. Raises UserError if the download fails."""
    path = cached_weights(weights)
    if path.is_file():
        return path
    digest = re.search(r"-([0-9a-f]{8,})\.pth$", path.name)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        torch.hub.download_url_to_file(weights.url, str(path), digest.group(1) if digest else None)
    except (OSError, RuntimeError) as error:
        raise UserError(
            f"--init {init}: cannot download {weights.url} ({error}); put the file at {path}, or take --init random"
        ) from None
    return path


def unpickled(path: Path) -> PublishedState:
    """Return the state dict in a torch file; torchvision's training scripts store it under the key `model`.

    These scripts also store their arguments, in a class that contains only values.
    """
    try:
        with torch.serialization.safe_globals([argparse.Namespace]):
            state: Any = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        blocked = re.search(r"Unsupported global: GLOBAL (\S+)", str(error))
        if blocked is None:
            raise UserError(f"{path}: {_NO_WEIGHTS}") from None
        raise UserError(
            f"{path}: holds more than tensors ({blocked[1]}), and is not loaded: it might run anything. "
            "If you trust it, take the weights out of it in Python: checkpoint = torch.load(FILE, weights_only=False), "
            'then torch.save(checkpoint["model"], NEW), or under whichever key they are'
        ) from None
    except Exception as error:  # torch.load raises various exceptions for broken archives
        reason = first_line(error)
        raise UserError(f"{path}: {_NO_WEIGHTS} ({reason})") from None
    if isinstance(state, dict) and isinstance(state.get("model"), dict):
        state = state["model"]
    if not isinstance(state, dict) or not all(isinstance(value, torch.Tensor) for value in state.values()):
        raise UserError(f"{path}: not a file of weights: expected tensors by name")
    return state


INIT_CHOICES: Final = ("auto", "coco", "imagenet", "random")


@dataclass(frozen=True)
class FirstWeights:
    """Constants of published weights, and the bias of a new class."""

    coco_keypoints: int = 17
    """Number of keypoints of the COCO weights."""
    coco_eps: float = 0.0
    """Value added to the variance by normalisation when these weights were trained."""
    class_bias: float = math.log(0.01)
    """Bias of a new class: a hundredth as likely as a logit of 0, as in RetinaNet (Lin et al., 2017)."""


FIRST_WEIGHTS: Final = FirstWeights()

PREDICTOR_WEIGHT: Final = "roi_heads.keypoint_predictor.kps_score_lowres.weight"
_BOX_PREDICTOR: Final = "roi_heads.box_predictor."


def initialise(
    init: str,
    *,
    norm: str,
    min_size: int | None,
    max_size: int | None,
    trainable_layers: int,
    seed: int,
    scheme: Scheme = keypoints.SKOPE33,
    anchors: tuple[int, ...] | None = None,
    box_passes: int | None = None,
    categories: tuple[str, ...] = VEHICLE_ALONE,
    network: NetworkShape = AS_GIVEN,
) -> tuple[KeypointRCNN, DetectorConfig, str]:
    """Build a detector with its initial weights.

    If the weights were trained for other categories, the common categories and the background are kept; the others
    start from random weights. The only class of weights without category names is taken for vehicles.

    Args:
        init: `auto`: COCO weights if they are in torchvision's cache, else the shipped detector if it has the same
            keypoints, else random weights. For a different network than `road33` has: an ImageNet backbone if it is in
            that cache, else random weights; `auto` never downloads. `coco` and `imagenet` download missing weights.
            `random`: random weights. Any other value is a checkpoint of skope or torchvision, as in `find_checkpoint`.
        norm: Normalisation, one of `skope.train.recipe.NORM_CHOICES`. `given` is frozen for trained weights and
            trainable for random ones, as in torchvision.
        min_size: Short side of the images inside the network, pixels; None: that of the initial weights if they are a
            checkpoint of skope, else that of `SMALL_SIZE`.
        max_size: Maximum long side of the images inside the network, pixels; None: as for `min_size`.
        trainable_layers: Number of trainable stages of a trained backbone, 0 to 5, from the last one.
        seed: Seed of the random weights.
        scheme: Keypoints to train; a checkpoint of skope must have them.
        anchors: Anchor sizes of each level; None: those of the initial weights.
        box_passes: Number of box head passes, 1 or 2; None: as in the initial weights.
        categories: Names of the classes.
        network: Backbone and widths. A checkpoint of skope must have them; for torchvision files they must be those of
            torchvision's model.

    Returns:
        The model, its config, and a description of the chosen weights.

    Raises:
        UserError: The weights do not exist, belong to a different model or keypoint scheme, or cannot be downloaded.
    """

    def completed(given: DetectorConfig) -> DetectorConfig:
        return replace(
            given,
            norm=given.norm if norm == "given" else norm,
            min_size=min_size or given.min_size,
            max_size=max_size or given.max_size,
            scheme=scheme.name,
            anchors=anchors or given.anchors,
            box_passes=box_passes or given.box_passes,
            categories=categories,
        )

    def loaded(
        path: Path, state: PublishedState, given: DetectorConfig, words: str
    ) -> tuple[KeypointRCNN, DetectorConfig, str]:
        chosen = completed(given)
        anew = [name for name in categories if name not in given.categories]
        words += f"; {', '.join(anew)} anew" if anew else ""
        return _loaded(path, state, given.categories, chosen, trainable_layers), chosen, words

    check_init(init)
    given = _plain("batch", network)
    if init == "auto" and not given.stock:
        init = "imagenet" if cached_weights(BACKBONE_CHOICES[given.backbone].imagenet).is_file() else "random"
    coco_file = cached_weights(KeypointRCNN_ResNet50_FPN_Weights.COCO_V1)
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(seed)
        if init == "coco" or (init == "auto" and coco_file.is_file()):
            coco = replace(_plain("frozen", AS_GIVEN), norm_eps=FIRST_WEIGHTS.coco_eps)
            _check_network("--init coco", coco, network)
            path = fetch("coco", KeypointRCNN_ResNet50_FPN_Weights.COCO_V1)
            return loaded(path, unpickled(path), coco, "weights trained on COCO")
        if init == "imagenet":
            chosen = completed(replace(given, norm="frozen"))
            return _from_imagenet(chosen, trainable_layers), chosen, "a backbone trained on ImageNet"
        shipped = init == "auto" and scheme.name == keypoints.SCHEME and weights.DEFAULT_WEIGHTS in weights.names()
        if init in INIT_CHOICES and not shipped:
            chosen = completed(given)
            return build(chosen, trainable_layers=5), chosen, "random weights"
        file = weights.path(weights.DEFAULT_WEIGHTS) if shipped else find_checkpoint(Path(init))
        state, file_config = _from_file(file, scheme, categories, network)
        words = f"weights `{file.stem}` of the package" if weights.shipped(file) else f"weights of {file}"
        return loaded(file, state, file_config, words)


def check_init(init: str) -> None:
    """Raise a UserError unless a value of `--init` is one of `INIT_CHOICES` or refers to existing weights."""
    if init in INIT_CHOICES:
        return
    if not Path(init).exists() and init not in weights.names():
        raise UserError(f"--init: {init!r} is neither a file nor one of {', '.join((*INIT_CHOICES, *weights.names()))}")
    find_checkpoint(Path(init))


def _from_file(
    path: Path, scheme: Scheme, categories: tuple[str, ...], network: NetworkShape
) -> tuple[PublishedState, DetectorConfig]:
    """Return weights and config of a checkpoint of skope, or of a file with torchvision's names (.pth or safetensors).

    A checkpoint of skope contains its config. For other files, batch counts distinguish BatchNorm2d from
    FrozenBatchNorm2d. The value of eps is 0 for frozen weights with COCO's 17 keypoints, as in torchvision, and
    otherwise the usual one of the backbone. If the number of classes equals that of `categories`, those are assumed,
    else vehicles only. Backbone and widths are those requested.
    """
    if path.suffix == ".safetensors":
        if _is_ours(path):
            header, state = read_checkpoint(path)
            file_config = config_in(path, header)
            if file_config.scheme != scheme.name:
                raise UserError(f"{path}: has keypoint scheme {file_config.scheme}, the dataset has {scheme.name}")
            _check_network(str(path), file_config, network)
            return state, file_config
        with safe_open(path, framework="pt") as file:
            state = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a mapping)
    else:
        state = unpickled(path)
    counted = any(name.endswith(".num_batches_tracked") for name in state)
    coco = _num_keypoints(path, state) == FIRST_WEIGHTS.coco_keypoints and not counted
    plain = _plain("batch" if counted else "frozen", network)
    plain = replace(plain, norm_eps=FIRST_WEIGHTS.coco_eps) if coco else plain
    classes = state.get(f"{_BOX_PREDICTOR}cls_score.bias")
    alike = classes is not None and len(classes) == 1 + len(categories)
    return state, replace(plain, categories=categories) if alike else plain


def _plain(norm: str, network: NetworkShape) -> DetectorConfig:
    """Return the config of weights without metadata, as far as it follows from their tensors."""
    asked = network.asked
    eps = BACKBONE_CHOICES[asked.get("backbone", DEFAULT_BACKBONE)].norm_eps
    return DetectorConfig(norm=norm, norm_eps=eps, min_size=SMALL_SIZE[0], max_size=SMALL_SIZE[1], **asked)


def _check_network(where: str, given: DetectorConfig, network: NetworkShape) -> None:
    """Raise a UserError, beginning with `where`, unless the config of weights has the requested network."""
    for name, value in network.asked.items():
        if getattr(given, name) != value:
            raise UserError(
                f"{where}: {name}: the recipe asks for {value}, these weights have {getattr(given, name)}; begin with "
                "--init imagenet or random"
            )


def _is_ours(path: Path) -> bool:
    try:
        with safe_open(path, framework="pt") as file:
            return HEADER_FIELD in (file.metadata() or {})
    except (SafetensorError, OSError) as error:
        raise UserError(f"{path}: not a safetensors file, or a truncated one ({error})") from None


def _loaded(
    path: Path, state: PublishedState, categories: tuple[str, ...], config: DetectorConfig, trainable_layers: int
) -> KeypointRCNN:
    """Return a model with the weights in `state`, which were trained for `categories`.

    A predictor for COCO's 17 keypoints is replaced by a new one for 33.
    """
    count = _num_keypoints(path, state)
    if count not in (keypoints.K, FIRST_WEIGHTS.coco_keypoints):
        raise UserError(
            f"{path}: predicts {count} keypoints; expected {keypoints.K}, or COCO's {FIRST_WEIGHTS.coco_keypoints}"
        )
    model = build(config, trainable_layers=trainable_layers, num_keypoints=count)
    if categories != config.categories:
        state = _with_categories(path, state, categories, model.state_dict(), config.categories)
    _load(path, model, state)
    if count != keypoints.K:
        heads = model.roi_heads
        channels = heads.keypoint_predictor.kps_score_lowres.in_channels
        heads.keypoint_predictor = KeypointRCNNPredictor(channels, keypoints.K)
    return model


def _with_categories(
    path: Path, state: PublishedState, categories: tuple[str, ...], drawn: PublishedState, wanted: tuple[str, ...]
) -> PublishedState:
    """Return `state`, trained for `categories`, with a box predictor for the wanted ones.

    The rows of new classes are those of `drawn` (random weights).

    The predictor's weights have rows for the background and each category: one for classes and four for boxes. New
    classes start as rare. The scores of the existing classes then stay nearly unchanged, whereas new classes as likely
    as the background would reduce them strongly.
    """
    before, after = (("background", *names) for names in (categories, wanted))
    out = dict(state)
    for name in [name for name in drawn if name.startswith(_BOX_PREDICTOR)]:
        if name not in state or len(state[name]) % len(before):
            raise UserError(f"{path}: tensor {name}: expected rows for {', '.join(before)}")
        old, new = (
            rows.view(len(names), -1, *rows.shape[1:])
            for rows, names in ((state[name], before), (drawn[name].clone(), after))
        )
        if old.shape[1:] != new.shape[1:]:
            raise UserError(f"{path}: tensor {name}: expected rows for {', '.join(before)}")
        for i, category in enumerate(after):
            if category in before:
                new[i] = old[before.index(category)]
            elif name.endswith("cls_score.bias"):
                new[i] = FIRST_WEIGHTS.class_bias
        out[name] = new.flatten(0, 1)
    return out


def _num_keypoints(path: Path, state: PublishedState) -> int:
    if PREDICTOR_WEIGHT not in state:
        raise UserError(f"{path}: not the weights of a Keypoint R-CNN of torchvision (no tensor {PREDICTOR_WEIGHT})")
    return int(state[PREDICTOR_WEIGHT].shape[1])


def _from_imagenet(config: DetectorConfig, trainable_layers: int) -> KeypointRCNN:
    kind = BACKBONE_CHOICES[config.backbone]
    path = fetch("imagenet", kind.imagenet)
    model = build(config, trainable_layers=trainable_layers)
    prefix = f"{kind.layers}." if kind.layers else ""
    state = {name.removeprefix(prefix): tensor for name, tensor in unpickled(path).items() if name.startswith(prefix)}
    _load(path, model.backbone.body, {name: tensor for name, tensor in state.items() if not name.startswith("fc.")})
    return model


def _load(path: Path, model: nn.Module, state: PublishedState) -> None:
    try:
        model.load_state_dict(state)
    except RuntimeError as error:
        raise UserError(f"{path}: not the weights of this model: {' '.join(str(error).split())[:160]}") from None
