"""The tables of `presets.toml`."""

import tomllib
from collections.abc import Mapping, Sequence
from functools import cache
from importlib import resources
from typing import Any

from skope.types import Range


@cache
def tables() -> Mapping[str, Any]:
    """Everything that `presets.toml` says."""
    return tomllib.loads(resources.files("skope.gen.pipeline").joinpath("presets.toml").read_text(encoding="utf-8"))


def presets() -> Mapping[str, Mapping[str, Any]]:
    """The presets by name."""
    presets: Mapping[str, Mapping[str, Any]] = tables()["presets"]
    return presets


def range_pairs(table: Mapping[str, Sequence[float]]) -> dict[str, Range]:
    """Ranges of a table, in which each is a list of two numbers."""
    return {name: (low, high) for name, (low, high) in table.items()}
