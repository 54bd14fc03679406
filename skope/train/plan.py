"""From flags to the configuration of a run, new or resumed, and what to say around it."""

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from skope import detector
from skope.errors import UserError, one_of
from skope.train import recipe as recipes
from skope.train.run import RunConfig, resumable

_MOST_WORKERS = 4


def multiplies_bfloat16() -> bool:
    """Whether this CPU has instructions for bfloat16; without them it is many times slower than float32."""
    try:
        flags = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return False
    return "avx512_bf16" in flags or "amx_bf16" in flags


def new(data: Path, flags: Mapping[str, Any], *, gpu: bool, bfloat16: bool) -> RunConfig:
    """Configuration of a new run; a flag that is None leaves the recipe's value."""
    recipe = recipes.choose(flags["recipe"] or "auto", gpu=gpu, bfloat16=bfloat16)
    for name in ("epochs", "batch_size"):
        if flags[name] is not None:
            recipe = replace(recipe, **{name: flags[name]})
    if flags["min_size"] is not None:
        # The same shapes of image reach the short side as in the recipe.
        long_side = round(flags["min_size"] * recipe.max_size / recipe.min_size)
        recipe = replace(recipe, min_size=flags["min_size"], max_size=long_side)
    init = one_of("--init", flags["init"] or recipe.init, detector.INITS)
    return RunConfig(recipe=recipe, init=init, seed=flags["seed"] or 0, data=str(data), max_images=flags["max_images"])


def again(out: Path, data: Path | None, flags: Mapping[str, Any]) -> RunConfig:
    """Configuration of the run in `out`, to go on with; only its length, and the dataset's place, may change."""
    if not out.is_dir():
        raise UserError(f"--resume: {out}: no such run folder")
    recorded = RunConfig.read(out)
    known = {**recorded.recipe.to_dict(), **recorded.to_dict(), "recipe": recorded.recipe.name}
    for name, value in flags.items():
        if name != "epochs" and value not in (None, known[name]):
            raise UserError(f"--{name.replace('_', '-')} {value}: the run in {out} has {known[name]}; leave it out")
    recipe = recorded.recipe
    if flags["epochs"] is not None:
        recipe = replace(recipe, epochs=flags["epochs"])
    return replace(recorded, recipe=recipe, data=recorded.data if data is None else str(data))


def loading_workers(*, gpu: bool) -> int:
    """Loading in the same process is fast enough for a CPU, which has no time to spare for others."""
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(_MOST_WORKERS, usable) if gpu else 0


def how_to_go_on(out: Path) -> str:
    """What to do after an interruption."""
    if resumable(out):
        return "the same command with --resume goes on after the last saved epoch"
    return "no epoch was saved yet, so the same command begins again"


def next_command(out: Path, data: Path, default_out: Path, default_data: Path) -> str:
    """The command that evaluates a run, with the flags that differ from the defaults."""
    parts = ["skope eval --split hard"]
    if data != default_data:
        parts.append(f"--data {data}")
    if out != default_out:
        parts.append(f"--checkpoint {out}")
    return " ".join(parts)
