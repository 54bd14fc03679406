"""Data flows one way: who may import whom, and what starting the command must not load."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import skope

ROOT = Path(skope.__file__).parent
HEAVY = ("torch", "torchvision", "pybullet", "moderngl", "libsumo", "matplotlib", "ray")


def imported(path: Path) -> set[str]:
    """Dotted names that a module imports anywhere in it; `from a import b` counts as a.b."""
    package = ["skope", *path.relative_to(ROOT).parent.parts]
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else []
            base = ".".join([*above, *([node.module] if node.module else [])])
            names |= {f"{base}.{alias.name}" for alias in node.names}
    return names


def across(group: str) -> set[str]:
    """What the modules of a group import from the other groups."""
    others = tuple(f"skope.{name}." for name in ("gen", "train", "eval") if name != group)
    modules = sorted((ROOT / group).rglob("*.py"))
    assert modules
    return {name for path in modules for name in imported(path) if f"{name}.".startswith(others)}


@pytest.mark.parametrize("group", ["gen", "eval"])
def test_gen_and_eval_import_no_other_group(group: str) -> None:
    assert across(group) == set()


def test_train_imports_metrics_and_nothing_else_across() -> None:
    allowed = ("skope.eval.metrics", "skope.eval.match")
    assert {name for name in across("train") if not name.startswith(allowed)} == set()


def test_shared_modules_import_no_group() -> None:
    groups = ("skope.gen.", "skope.train.", "skope.eval.")
    for path in (*ROOT.glob("*.py"), *(ROOT / "page").glob("*.py")):
        if path.name != "cli.py":
            assert not any(f"{name}.".startswith(groups) for name in imported(path)), path.name


def test_metrics_are_numpy_alone() -> None:
    for name in ("metrics", "match", "tally", "intervals", "breakdown", "failures", "confidence"):
        roots = {module.split(".")[0] for module in imported(ROOT / "eval" / f"{name}.py")}
        assert roots - sys.stdlib_module_names <= {"numpy", "skope"}


def test_the_walk_sees_relative_and_nested_imports(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.modules[__name__], "ROOT", tmp_path)
    (tmp_path / "eval").mkdir()
    (tmp_path / "gen").mkdir()
    (tmp_path / "gen" / "a.py").write_text("def f():\n    from ..eval import metrics\n    import skope.train.loop\n")
    (tmp_path / "eval" / "b.py").write_text("from skope import gen\nfrom . import c\n")
    assert across("gen") == {"skope.eval.metrics", "skope.train.loop"}
    assert across("eval") == {"skope.gen"}


def test_starting_the_command_loads_no_engine() -> None:
    code = f"import sys, skope.cli; print(*(name for name in {HEAVY!r} if name in sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""


def test_rendering_a_recording_needs_no_simulator() -> None:
    """Frames are drawn and written on machines that have neither SUMO nor pybullet."""
    code = """
import sys
for name in ("pybullet", "libsumo"):
    sys.modules[name] = None
import skope.gen.annotate, skope.gen.render.gl.renderer, skope.gen.render.sensor, skope.gen.store
import skope.gen.towns.scenery
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
