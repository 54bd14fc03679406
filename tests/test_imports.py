"""Data flows one way: who may import whom, and what starting the command must not load."""

import ast
import subprocess
import sys
from collections.abc import Collection
from pathlib import Path

import pytest

import skope

ROOT = Path(skope.__file__).parent
HEAVY = ("torch", "torchvision", "pybullet", "moderngl", "libsumo", "matplotlib", "ray", "jinja2")


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


def modules() -> dict[str, Path]:
    """Every module of the package by its dotted name."""
    found = {}
    for path in ROOT.rglob("*.py"):
        parts = ["skope", *path.relative_to(ROOT).with_suffix("").parts]
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def graph() -> dict[str, set[str]]:
    """The modules that each module imports."""
    known = modules()

    def module(name: str) -> str:
        return name if name in known else name.rpartition(".")[0]

    return {name: {module(other) for other in imported(path)} & known.keys() for name, path in known.items()}


def across(group: str) -> set[str]:
    """What the modules of a group import from the other groups."""
    others = tuple(f"skope.{name}." for name in ("gen", "train", "eval") if name != group)
    found = sorted((ROOT / group).rglob("*.py"))
    assert found
    return {name for path in found for name in imported(path) if f"{name}.".startswith(others)}


@pytest.mark.parametrize("group", ["gen", "train", "eval", "metrics"])
def test_groups_do_not_import_each_other(group: str) -> None:
    assert across(group) == set()


GEN = (
    {"cache", "mesh"},
    {"towns", "vehicles"},
    {"bystanders"},
    {"scenery"},
    {"scene"},
    {"traffic"},
    {"simulation"},
    {"render"},
    {"labels"},
    {"output"},
    {"generation_site", "formats"},
    {"pipeline"},
    {"inspect"},
    {"cli"},
)
"""Folders and modules of skope/gen: each imports from those before it only, the last one from all."""
SHARED = (
    {"cpu_count", "errors", "confidence_level", "types", "version"},
    {"keypoints"},
    {"boxes", "files", "ray_cluster"},
    {"records"},
    {"camera", "terminal"},
    {"schema", "site"},
    {"dataset", "pictures", "tracks"},
    {"detections", "video"},
    {"metrics", "page", "camera.motion"},
    {"detector", "traffic", "viewer", "pose"},
    {"site.page", "tracking"},
    {"camera.fit"},
    {"footage"},
    {"station"},
    {"gen", "train", "eval"},
    {"doctor"},
    {"api", "cli"},
    {"__init__", "__main__"},
)
"""What lies at the top of skope/; a folder within another that is named here has a place of its own."""
EVAL = (
    {"report"},
    {"evaluate", "view"},
    {"cli"},
)


@pytest.mark.parametrize(("group", "order"), [("skope", SHARED), ("skope.gen", GEN), ("skope.eval", EVAL)])
def test_stages_import_earlier_stages_only(group: str, order: tuple[set[str], ...]) -> None:
    rank = {name: k for k, names in enumerate(order) for name in names}
    seen = set()
    for name, others in graph().items():
        if stage := stage_of(name, group, rank):
            seen.add(stage)
            for other in others:
                earlier = stage_of(other, group, rank)
                if earlier and earlier != stage:
                    assert rank[earlier] < rank[stage], f"{name} imports {other}"
    assert seen == rank.keys()


def stage_of(name: str, group: str, places: Collection[str] = ()) -> str:
    """Folder or module of `group` that a module lies in, or a folder within it that is one of `places`.

    The empty string stands for the group itself and for modules outside it.
    """
    if name == "skope" == group:
        return "__init__"
    if not name.startswith(f"{group}."):
        return ""
    first, _, rest = name.removeprefix(f"{group}.").partition(".")
    second = f"{first}.{rest.partition('.')[0]}"
    return second if second in places else first


def test_no_module_imports_itself_by_way_of_others() -> None:
    left = graph()
    while free := {name for name, others in left.items() if not others & left.keys()}:
        left = {name: others for name, others in left.items() if name not in free}
    assert not left


def test_metrics_load_numpy_alone() -> None:
    """They can be worked on where there is neither torch nor OpenCV."""
    names = sorted(name for name in modules() if name.startswith("skope.metrics"))
    assert len(names) > 8
    code = f"import sys; before = set(sys.modules); import {', '.join(names)}; print(*(set(sys.modules) - before))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = {name.partition(".")[0] for name in done.stdout.split()} - sys.stdlib_module_names
    assert {"numpy", "skope"} <= loaded
    assert {name for name in loaded if "cython" not in name} == {"numpy", "skope"}


def test_traffic_is_measured_without_torch_and_opencv() -> None:
    names = sorted(name for name in modules() if name.startswith("skope.traffic"))
    assert len(names) > 25
    code = f"import sys; import {', '.join(names)}; print(*(name for name in ('cv2', 'torch') if name in sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""


def test_no_public_class_name_stands_for_two_things() -> None:
    places: dict[str, list[str]] = {}
    for name, path in modules().items():
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places.setdefault(node.name, []).append(name)
    assert {name: where for name, where in places.items() if len(where) > 1} == {}


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
import skope.gen.labels.annotate, skope.gen.render.gl.renderer, skope.gen.render.camera_effects, skope.gen.scenery.build
import skope.gen.pipeline.dataset_store
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
