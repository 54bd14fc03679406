"""A small dataset by the command line."""

import sys
from pathlib import Path

SMALL = ["--sites", "t01_mill_corner,t01_main_west", "--frames", "5", "--size", "192x108", "--quiet"]


def gen(out: Path, *more: str) -> list[str]:
    return [sys.executable, "-m", "skope", "gen", "--out", str(out), *SMALL, *more]


def content(root: Path) -> dict[str, bytes]:
    """Every file of a dataset, by its path."""
    return {str(p.relative_to(root)): p.read_bytes() for p in sorted(root.rglob("*")) if p.is_file()}
