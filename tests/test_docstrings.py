"""Names in backticks in docstrings are names of something that is there."""

import ast
import builtins
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

import skope

ROOT = Path(skope.__file__).parent
NAME = re.compile(r"[A-Za-z_]\w*(\.\w+)*")
OF_OTHERS = {
    "NAME.md": "a pattern",
    "NAME.safetensors": "a pattern",
    "NAME.steps": "a pattern",
    "Validation": "a name as others write it",
    "calib": "a folder of Rope3D",
    "calib3d": "a module of OpenCV",
    "denorm": "a folder of Rope3D",
    "heatmaps_to_keypoints": "a function of torchvision",
    "instances_val2017": "a file of COCO",
    "interpolate": "a function of torch",
    "kp_32": "a name as users write it",
    "loadRes": "a method of pycocotools",
    "logging": "an extra of pyproject.toml",
    "np.cross": "a function of numpy",
    "ry": "a column of KITTI",
    "torch.utils.data.DataLoader": "a class of torch",
    "torch.utils.data.Dataset": "a class of torch",
    "torchrun": "a program of torch",
    "xywh": "a format of boxes",
    "xyxy": "a format of boxes",
}
"""Names in docstrings that stand nowhere in the code, since others gave them."""


def identifiers(tree: ast.AST) -> set[str]:
    """Names that stand in code: variables, arguments, attributes, imports, and words of its strings."""
    told = {id(node.value) for node in docstrings(tree)}
    found: set[str] = set()
    for node in ast.walk(tree):
        for kind in ("id", "attr", "arg", "name", "asname", "module"):
            if isinstance(value := getattr(node, kind, None), str):
                found |= set(value.split("."))
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in told:
            found |= set(re.findall(r"\w+", node.value))
    return found


def docstrings(tree: ast.AST) -> Iterator[ast.Expr]:
    """Texts that stand alone: in modules, classes and functions, and below constants and fields."""
    for node in ast.walk(tree):
        for one in body if isinstance(body := getattr(node, "body", None), list) else ():
            if isinstance(one, ast.Expr) and isinstance(one.value, ast.Constant) and isinstance(one.value.value, str):
                yield one


def defined(body: list[ast.stmt]) -> set[str]:
    """Names that statements define or import."""
    found: set[str] = set()
    for node in body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            found.add(node.name)
        elif isinstance(node, ast.Import | ast.ImportFrom):
            found |= {alias.asname or alias.name for alias in node.names}
        else:
            found |= {one.id for one in ast.walk(node) if isinstance(one, ast.Name) and isinstance(one.ctx, ast.Store)}
    return found


@dataclass(frozen=True)
class Package:
    """What there is in a package that a docstring can speak of."""

    root: Path
    modules: dict[str, ast.Module] = field(default_factory=dict)
    """Modules by dotted name."""
    members: dict[str, set[str]] = field(default_factory=dict)
    """Names of attributes by the name of their class."""

    def __post_init__(self) -> None:
        for path in self.root.rglob("*.py"):
            parts = [self.root.name, *path.relative_to(self.root).with_suffix("").parts]
            tree = ast.parse(path.read_text(encoding="utf-8"))
            self.modules[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = tree
            for node in ast.walk(tree):
                if isinstance(node, ast.ClassDef):
                    inside = {one.attr for one in ast.walk(node) if isinstance(one, ast.Attribute)}
                    self.members.setdefault(node.name, set()).update(inside, defined(node.body))

    def has(self, path: str) -> bool:
        """Whether a dotted name that begins with the package's is that of a module or of something in one."""
        module, _, name = path.rpartition(".")
        if path in self.modules:
            return True
        tree = self.modules.get(module)
        # What a package hands on may be loaded when it is first used: then its name is text there.
        handed_on = values_in(tree) if tree and module == self.root.name else set()
        return tree is not None and name in defined(tree.body) | handed_on

    def public(self) -> set[str]:
        """Names of modules, of what they define, and of members of classes, that do not begin with an underscore."""
        names = {name.rpartition(".")[2] for name in self.modules}
        names |= set().union(*(defined(tree.body) for tree in self.modules.values()), *self.members.values())
        return {name for name in names if not name.startswith("_")}

    def unknown(self) -> list[str]:
        """Module, line and name of each name in backticks that is not there."""
        return sorted(set(self._unknown()))

    def _unknown(self) -> Iterator[str]:
        public = self.public()
        strings = set().union(*(values_in(tree) for tree in self.modules.values()))
        for module, tree in self.modules.items():
            here = identifiers(tree) | set(dir(builtins))
            for node in docstrings(tree):
                for name in re.findall(r"`([^`\n]+)`", node.value.value):  # type: ignore[attr-defined]
                    if not NAME.fullmatch(name) or name in OF_OTHERS or name in strings:
                        continue
                    first, *rest = name.split(".")
                    if first == self.root.name:
                        there = self.has(name)
                    elif rest and first in self.members:
                        there = set(rest) <= self.members[first]
                    else:
                        there = (first in here or first in public) and set(rest) <= here | public
                    if not there:
                        yield f"{module}:{node.lineno}: {name}"


def values_in(tree: ast.AST) -> set[str]:
    """Strings in code: keys and values in files; of paths the names of the files."""
    texts = (one.value for one in ast.walk(tree) if isinstance(one, ast.Constant) and isinstance(one.value, str))
    return {text.rpartition("/")[2] for text in texts}


def test_every_name_in_a_docstring_is_there() -> None:
    assert Package(ROOT).unknown() == []


def test_what_others_named_is_told_of() -> None:
    told = "".join(path.read_text(encoding="utf-8") for path in ROOT.rglob("*.py"))
    assert [name for name in OF_OTHERS if f"`{name}`" not in told] == []


@pytest.mark.parametrize(
    ("told", "unknown"),
    [
        ("`here` and `there.Thing` and `Thing.part`, `small.there.made`, `--flag`, `skope gen`, `a + b`", []),
        ("`gone`", ["gone"]),
        ("`Thing.gone`", ["Thing.gone"]),
        ("`small.there.gone` and `small.gone`", ["small.gone", "small.there.gone"]),
        ("`there.gone`", ["there.gone"]),
        ("`_inner`", ["_inner"]),
    ],
)
def test_what_is_not_there_is_found(tmp_path: Path, told: str, unknown: list[str]) -> None:
    root = tmp_path / "small"
    root.mkdir()
    (root / "__init__.py").write_text("")
    (root / "there.py").write_text("class Thing:\n    part: int\n\n\ndef made():\n    _inner = 1\n    return _inner\n")
    (root / "module.py").write_text(f'def here():\n    """Tells of {told}."""\n')
    assert [line.rpartition(" ")[2] for line in Package(root).unknown()] == unknown
