"""The configuration of a run, new or resumed, from the flags of `skope train`."""

import os
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from skope.cpu_count import usable_processors
from skope.detector.checkpoint import find_checkpoint
from skope.errors import UserError
from skope.files.output_folders import changed_options
from skope.schema import checked_categories
from skope.train import init_weights
from skope.train import recipe as recipes
from skope.train.run_config import RunConfig
from skope.train.training_state import resumable

_MOST_WORKERS = 8
_RECIPE_FLAGS = ("epochs", "init", "batch_size", "supervise", "exclude_types", "val_fraction")
"""Flags that replace the recipe's value of the same name."""


def new(data: Sequence[Path], flags: Mapping[str, Any], *, gpu: bool, bfloat16: bool) -> RunConfig:
    """Return the configuration of a new run.

    Args:
        data: Dataset folders.
        flags: Values of the flags by name; None or an empty value keeps the recipe's value.
        gpu: Whether the run uses a GPU.
        bfloat16: Whether the processor supports bfloat16.

    Raises:
        UserError: A flag is wrong.
    """
    recipe = recipes.choose_recipe(flags["recipe"] or "auto", gpu=gpu, bfloat16=bfloat16)
    given = {name: flags[name] for name in _RECIPE_FLAGS if flags[name] not in (None, ())}
    try:
        recipe = replace(recipe, **given)
        if flags["backbone"] is not None:
            recipe = replace(recipe, network=replace(recipe.network, backbone=flags["backbone"]))
    except UserError as error:
        raise UserError(f"--{str(error).replace('_', '-', 1)}") from None
    if flags["min_size"] is not None:
        recipe = recipe.with_min_size(flags["min_size"])
    recipe = recipes.adjusted_recipe(recipe, flags["set"] or ())
    init_weights.check_init(recipe.init)
    if recipe.teacher.checkpoint is not None:
        find_checkpoint(Path(recipe.teacher.checkpoint))
    mix = flags["mix"]
    if mix is not None and len(data) < 2:
        raise UserError("--mix: is the first dataset's share, which needs two or more --data")
    if mix is not None and not 0 < mix < 1:
        raise UserError(f"--mix: expected a share between 0 and 1, got {mix}")
    try:
        categories = checked_categories(flags["categories"]) if flags["categories"] else None
    except UserError as error:
        raise UserError(f"--{error}") from None
    return RunConfig(
        recipe=recipe,
        seed=flags["seed"] or 0,
        data=tuple(str(path) for path in data),
        mix=mix,
        max_images=flags["max_images"],
        categories=categories,
    )


def new_or_same(
    out: Path, data: Sequence[Path], flags: Mapping[str, Any], *, gpu: bool, bfloat16: bool
) -> tuple[RunConfig, bool]:
    """Return the configuration of a run and whether it resumes: the run in `out` if its flags are the same.

    Args:
        out: The run folder.
        data: Dataset folders.
        flags: As for `new`.
        gpu: Whether the run uses a GPU.
        bfloat16: Whether the processor supports bfloat16.

    Raises:
        UserError: A flag is wrong, or `out` contains a run with different flags.
    """
    wanted = new(data, flags, gpu=gpu, bfloat16=bfloat16)
    if not resumable(out):
        return wanted, False
    try:
        held = RunConfig.read(out)
    except UserError as error:
        raise UserError(f"{error}; choose another folder by --out, or move this one away") from None
    if changes := changed_options(_flat(held), _flat(_completed(wanted, held))):
        raise UserError(
            f"{out}: holds another run: {'; '.join(changes)}. --resume continues it with its saved options, "
            "--epochs extends it; or choose another folder by --out"
        )
    return replace(held, data=wanted.data), True


def _completed(wanted: RunConfig, held: RunConfig) -> RunConfig:
    """Return a configuration with the values that follow from the datasets of a run."""
    recipe = wanted.recipe
    if held.recipe.augment.flip == 0:  # of keypoints without mirror partners
        recipe = replace(recipe, augment=replace(recipe.augment, flip=0.0))
    return replace(wanted, recipe=recipe, categories=wanted.categories or held.categories)


def _flat(config: RunConfig) -> dict[str, Any]:
    """Return the values that determine a run, by the names of flags and of `--set`."""
    values: dict[str, Any] = {"seed": config.seed, "mix": config.mix, "max_images": config.max_images}
    values |= {"datasets": len(config.data), "categories": ",".join(config.detector_categories)}
    for name, value in config.recipe.to_dict().items():
        values |= {f"{name}.{part}": item for part, item in value.items()} if isinstance(value, dict) else {name: value}
    return values


def again(out: Path, data: Sequence[Path], flags: Mapping[str, Any]) -> RunConfig:
    """Return the configuration of a run to resume. Only the number of epochs and the paths of datasets can change.

    Args:
        out: The run folder.
        data: Dataset folders; empty for those of the run.
        flags: As in `new`.

    Raises:
        UserError: There is no such run, or a flag differs from that of the run.
    """
    if not out.is_dir():
        raise UserError(f"--resume: {out}: no such run folder")
    recorded = RunConfig.read(out)
    known = {**recorded.recipe.to_dict(), **recorded.to_dict(), "recipe": recorded.recipe.name}
    known["categories"] = list(recorded.detector_categories)
    known["backbone"] = recorded.recipe.network.backbone
    for name, value in flags.items():
        if name in ("epochs", "set") or value is None or value == ():
            continue
        value = Path(value).stem if name == "recipe" else list(value) if isinstance(value, tuple) else value
        if value != known[name]:
            raise UserError(f"--{name.replace('_', '-')} {value}: the run in {out} has {known[name]}; leave it out")
    recipe = recorded.recipe
    if recipes.adjusted_recipe(recipe, flags["set"] or ()) != recipe:
        raise UserError(f"--set {' '.join(flags['set'])}: the run in {out} has other values; leave it out")
    if flags["epochs"] is not None:
        recipe = replace(recipe, epochs=flags["epochs"])
    if data and len(data) != len(recorded.data):
        raise UserError(f"--data: the run in {out} has {len(recorded.data)} datasets, got {len(data)}")
    return replace(recorded, recipe=recipe, data=tuple(str(path) for path in data) or recorded.data)


def loading_workers(*, gpu: bool) -> int:
    """Return the number of loading processes. On a CPU, loading in the main process is fast enough."""
    processes = int(os.environ.get("LOCAL_WORLD_SIZE", "1"))  # number of processes that torchrun starts on this machine
    return min(_MOST_WORKERS, max(1, usable_processors() // processes)) if gpu else 0


def how_to_go_on(out: Path) -> str:
    """Return advice after an interruption."""
    if resumable(out):
        return "run the same command again to resume"
    return "nothing was saved yet, so the same command begins again"


def next_command(out: Path, data: Path, splits: Sequence[str], default_out: Path, default_data: Path) -> str:
    """Return the command that evaluates a run on a split of its dataset; flags with default values are left out."""
    parts = ["skope eval"]
    tests = [split for split in splits if split not in ("train", "val")]
    if tests:
        parts.append(f"--split {'hard' if 'hard' in tests else tests[-1]}")
    if data != default_data:
        parts.append(f"--data {shlex.quote(str(data))}")
    if out != default_out:
        parts.append(f"--checkpoint {shlex.quote(str(out))}")
    return " ".join(parts)
