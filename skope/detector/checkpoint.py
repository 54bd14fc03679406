"""Checkpoints: safetensors files with the model configuration in the header; selection of a file of a run."""

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as serialized
from torch.overrides import TorchFunctionMode
from torchvision.models.detection import KeypointRCNN

from skope import keypoints
from skope.detector import compact_weights, weights
from skope.detector.build import DetectorConfig, build
from skope.errors import UserError, one_of
from skope.files.atomic import write_bytes

HEADER_FIELD: Final = "skope"
PACKED_FIELD: Final = "packed"
CHECKSUM_FIELD: Final = "sha256"
_FORMAT_VERSION: Final = 1


def save_weights(path: Path, model: KeypointRCNN, config: DetectorConfig, metadata: Mapping[str, Any]) -> None:
    """Write a checkpoint. Its tensors can be loaded into torchvision's model with `strict=True`.

    Args:
        path: The .safetensors file to write.
        model: The weights.
        config: Model configuration that the weights do not contain.
        metadata: JSON values, which `load_weights` returns.
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
    """Return a checkpoint as bytes: safetensors with scheme, config and metadata as JSON in the header.

    Args:
        model: The model. Equal weights give equal bytes.
        config: Model configuration that the state dict does not contain.
        metadata: JSON values.
        packed: Whether the tensors are packed by `skope.detector.compact_weights`: a seventh of the bytes, with a
            checksum.
        moments: The argument of `pack`.
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
        state, header[PACKED_FIELD] = compact_weights.pack(state, moments=moments)
        header[CHECKSUM_FIELD] = compact_weights.digest(state, header)
    # safetensors writes several metadata fields in any order; one field keeps the bytes the same.
    return serialized(state, {HEADER_FIELD: json.dumps(header, allow_nan=False)})


def full_state(model: KeypointRCNN) -> dict[str, torch.Tensor]:
    """Return the model's tensors, which load strictly into torchvision's own model with either normalisation."""
    state = {name: tensor.detach().cpu().contiguous() for name, tensor in model.state_dict().items()}
    # BatchNorm2d counts batches and FrozenBatchNorm2d does not; a count that is always present suits both.
    for name in [name for name in state if name.endswith(".running_var")]:
        state.setdefault(name.removesuffix("running_var") + "num_batches_tracked", torch.zeros((), dtype=torch.int64))
    return state


def load_weights(
    path: Path, device: torch.device | str, *, trainable_layers: int = 5
) -> tuple[KeypointRCNN, DetectorConfig, dict[str, Any]]:
    """Load a checkpoint from `save_weights`.

    Args:
        path: The .safetensors file.
        device: Device of the model.
        trainable_layers: As in `build`.

    Returns:
        The model in evaluation mode, its config, and the metadata.

    Raises:
        UserError: The file is not such a checkpoint, or has an unknown keypoint scheme.
    """
    header, state = read_checkpoint(path)
    config = config_in(path, header)
    with _NotDrawn():
        model = build(config, trainable_layers=trainable_layers)
    _check_tensors(path, model.state_dict(), state)
    model.load_state_dict(state)
    return model.to(device).eval(), config, header["metadata"]


class _NotDrawn(TorchFunctionMode):
    """Context that skips the random initialisation of weights, which takes longer than reading them from a file."""

    _DRAWS: Final = (
        torch.Tensor.normal_,
        torch.Tensor.uniform_,
        torch.nn.init.kaiming_uniform_,
        torch.nn.init.normal_,
        torch.nn.init.uniform_,
    )

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func not in self._DRAWS:
            return func(*args, **(kwargs or {}))
        return args[0] if args else (kwargs or {})["tensor"]


def read_checkpoint(path: Path) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
    """Return the checked header (config, metadata ...) and the tensors of a checkpoint."""
    if not path.is_file():
        raise UserError(f"{path}: no such checkpoint file")
    try:
        with safe_open(path, framework="pt") as file:
            header = _check_header(path, file.metadata() or {})
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a mapping)
    except (SafetensorError, OSError) as error:
        raise UserError(f"{path}: not a safetensors file, or a truncated one ({error})") from None
    return header, _unpacked(path, header, tensors) if PACKED_FIELD in header else tensors


def config_in(path: Path, header: Mapping[str, Any]) -> DetectorConfig:
    """Return the config in a checkpoint's header. Raises UserError with the file and the invalid field."""
    try:
        return DetectorConfig.from_dict(header["config"])
    except UserError as error:
        raise UserError(f"{path}: {error}") from None


def _unpacked(path: Path, header: dict[str, Any], tensors: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    digested = {name: value for name, value in header.items() if name != CHECKSUM_FIELD}
    if compact_weights.digest(tensors, digested) != header.get(CHECKSUM_FIELD):
        raise UserError(f"{path}: {CHECKSUM_FIELD} differs: the file is damaged, or was changed after it was written")
    try:
        return compact_weights.unpack(tensors, header[PACKED_FIELD])
    except compact_weights.DamagedError as error:
        raise UserError(f"{path}: {error}") from None


def _check_header(path: Path, metadata: Mapping[str, str]) -> dict[str, Any]:
    if HEADER_FIELD not in metadata:
        raise UserError(f"{path}: not a checkpoint of skope (its header has no field {HEADER_FIELD})")
    try:
        header = json.loads(metadata[HEADER_FIELD])
    except json.JSONDecodeError:
        header = None
    if not isinstance(header, dict) or not {"config", "metadata"} <= set(header):
        raise UserError(f"{path}: the header's field {HEADER_FIELD} is damaged")
    expected = {"version": _FORMAT_VERSION, "num_keypoints": keypoints.K}
    for name, value in expected.items():
        if header.get(name) != value:
            raise UserError(f"{path}: {name}: expected {value!r}, got {header.get(name)!r}")
    one_of(f"{path}: scheme", header.get("scheme"), tuple(keypoints.SCHEMES))
    return header


def _check_tensors(path: Path, expected: Mapping[str, torch.Tensor], got: Mapping[str, torch.Tensor]) -> None:
    counts = {name for name in got if name.endswith(".num_batches_tracked")}
    missing, extra = sorted(set(expected) - set(got)), sorted(set(got) - set(expected) - counts)
    for problem, names in (("lacks", missing), ("has unknown", extra)):
        if names:
            raise UserError(f"{path}: {problem} {len(names)} tensor(s), first {names[0]}")
    for name, tensor in expected.items():
        if got[name].shape != tensor.shape:
            raise UserError(f"{path}: tensor {name}: expected {tuple(tensor.shape)}, got {tuple(got[name].shape)}")


BEST_WEIGHTS: Final = "best.safetensors"
"""Return the file name of the weights of a run's best epoch."""


def checkpoint_name(epoch: int) -> str:
    """Return the file name of the checkpoint after `epoch` epochs."""
    return f"epoch_{epoch:03d}.safetensors"


def checkpoints(run: Path) -> dict[int, Path]:
    """Return the checkpoints of a run folder by number of completed epochs, ascending."""
    found = ((re.fullmatch(r"epoch_(\d+)\.safetensors", path.name), path) for path in run.glob("epoch_*.safetensors"))
    return dict(sorted((int(match.group(1)), path) for match, path in found if match))


def find_checkpoint(path: Path) -> Path:
    """Return the weights file that `path` refers to.

    A file is returned unchanged. For a run folder, the result is its newest checkpoint, or `BEST_WEIGHTS` if no other
    exists. If `path` does not exist, the result is the file of the weights of that name in the package.

    Raises:
        UserError: There are no such weights.
    """
    if path.is_file():
        return path
    if not path.is_dir():
        if str(path) in weights.names():
            return weights.path(str(path))
        shipped = "".join(f"; {name} comes with skope" for name in weights.names())
        raise UserError(f"{path}: no such checkpoint or run folder; `skope train` makes one{shipped}")
    found = checkpoints(path)
    if not found and (path / BEST_WEIGHTS).is_file():
        return path / BEST_WEIGHTS
    if not found:
        raise UserError(f"{path}: no checkpoint in this folder (epoch_NNN.safetensors); `skope train` makes one")
    return found[max(found)]
