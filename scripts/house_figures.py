"""Figures on the code of the package: documented parameters, names defined several times, long functions, imports.

    python scripts/house_figures.py                      # of this checkout
    python scripts/house_figures.py --before OLDER_TREE  # beside those of another checkout
    python scripts/house_figures.py --names              # and the names behind the figures

It only reads source text and does not import the package.
"""

import argparse
import ast
import re
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

DOCUMENTED_PARAMETERS: Final = 3
"""Public functions with at least this many parameters are expected to document them."""
LONG_FUNCTION_LINES: Final = 60
SHARED_CONSTANT_MODULES: Final = 2
"""A one-word constant may be defined in at most this many modules."""
GROUPS: Final = ("skope", "skope.gen", "skope.eval")
"""Packages whose folders and modules are compared as parts, as in tests/test_imports.py."""
QUESTION: Final = re.compile(r"(What|Where|How|Which|Who)\b")

Function = ast.FunctionDef | ast.AsyncFunctionDef


@dataclass
class Figures:
    """Counts of one tree. Each list holds the names, and its length is the figure."""

    documented: list[str] = field(default_factory=list)
    """Public functions of three and more parameters with `Args` in their docstring."""
    undocumented: list[str] = field(default_factory=list)
    """Public functions of three and more parameters without it."""
    shared_constants: list[str] = field(default_factory=list)
    """One-word constants that more than two modules define."""
    several_homes: list[str] = field(default_factory=list)
    """Public names that more than one module defines."""
    long_functions: list[str] = field(default_factory=list)
    long_bodies: list[str] = field(default_factory=list)
    """Functions whose statements alone, without parameters and docstring, are that long."""
    questions: list[str] = field(default_factory=list)
    """Docstrings that begin with a question word."""
    graphs: dict[str, dict[str, set[str]]] = field(default_factory=dict)
    """The parts that each part imports, by group."""
    cycles: list[str] = field(default_factory=list)
    """Modules that import each other, directly or indirectly."""

    def rows(self) -> dict[str, str]:
        """Return the figures as text, by title."""
        asked = len(self.documented) + len(self.undocumented)
        share = f"{len(self.documented)} of {asked} ({len(self.documented) / max(asked, 1):.0%})"
        rows = {
            f"public functions of {DOCUMENTED_PARAMETERS}+ parameters with Args": share,
            f"one-word constants in more than {SHARED_CONSTANT_MODULES} modules": str(len(self.shared_constants)),
            "public names defined in several modules": str(len(self.several_homes)),
            f"functions over {LONG_FUNCTION_LINES} lines": str(len(self.long_functions)),
            f"functions over {LONG_FUNCTION_LINES} lines of statements": str(len(self.long_bodies)),
            "docstrings that begin with a question": str(len(self.questions)),
        }
        for group, graph in self.graphs.items():
            edges = sum(map(len, graph.values()))
            rows[f"parts, imports, layers of {group}"] = f"{len(graph)}, {edges}, {layers(graph)}"
        return {**rows, "import cycles": str(len(self.cycles))}

    def names(self) -> dict[str, list[str]]:
        """Return the names behind the figures."""
        return {
            "without Args": self.undocumented,
            "one-word constants": self.shared_constants,
            "defined in several modules": self.several_homes,
            "long functions": self.long_functions,
            "questions": self.questions,
            "cycles": self.cycles,
        }


def figures(tree: Path) -> Figures:
    """Count in a checkout that has the package in its folder `skope`."""
    paths = modules(tree)
    parsed = {name: ast.parse(path.read_text(encoding="utf-8")) for name, path in paths.items()}
    found = Figures()
    constants: dict[str, list[str]] = defaultdict(list)
    homes: dict[str, list[str]] = defaultdict(list)
    for name, body in parsed.items():
        for constant in constants_of(body):
            if re.fullmatch(r"_?[A-Z][A-Z0-9]*", constant):
                constants[constant].append(name)
        for public in public_names(body):
            homes[public].append(name)
        for function, is_public in functions_of(body):
            location = f"{name}:{function.lineno} {function.name}"
            if is_public and len(parameters(function)) >= DOCUMENTED_PARAMETERS:
                is_documented = "Args:" in (ast.get_docstring(function) or "")
                (found.documented if is_documented else found.undocumented).append(location)
            if (function.end_lineno or function.lineno) - function.lineno >= LONG_FUNCTION_LINES:
                found.long_functions.append(location)
            if statement_lines(function) > LONG_FUNCTION_LINES:
                found.long_bodies.append(location)
        found.questions += [f"{name}:{line} {text}" for line, text in docstrings(body) if QUESTION.match(text)]
    found.shared_constants = [
        f"{constant}: {', '.join(where)}"
        for constant, where in sorted(constants.items())
        if len(where) > SHARED_CONSTANT_MODULES
    ]
    found.several_homes = [f"{name}: {', '.join(where)}" for name, where in sorted(homes.items()) if len(where) > 1]
    imports = import_graph(parsed, paths)
    found.graphs = {group: part_graph(imports, group) for group in GROUPS}
    found.cycles = [" <-> ".join(sorted(cycle)) for cycle in cycles(imports)]
    return found


def modules(tree: Path) -> dict[str, Path]:
    """Return the files of the package by dotted module name."""
    found = {}
    for path in sorted((tree / "skope").rglob("*.py")):
        parts = path.relative_to(tree).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def assigned(node: ast.stmt) -> list[str]:
    """Return the names that a statement assigns to, without type variables, which are alike everywhere."""
    if isinstance(node, ast.Assign) and ast.unparse(node.value).startswith("TypeVar("):
        return []
    if isinstance(node, ast.AnnAssign):
        targets: list[ast.expr] = [node.target]
    else:
        targets = node.targets if isinstance(node, ast.Assign) else []
    return [name.id for target in targets for name in ast.walk(target) if isinstance(name, ast.Name)]


def constants_of(body: ast.Module) -> list[str]:
    """Return the names of a module's constants, which are in capitals."""
    return [name for node in body.body for name in assigned(node) if name.isupper()]


def public_names(body: ast.Module) -> set[str]:
    """Return the public functions, classes, constants and types of a module."""
    defined = {node.name for node in body.body if isinstance(node, ast.ClassDef | Function)}
    return {name for name in defined.union(*map(assigned, body.body)) if not name.startswith("_")}


def functions_of(body: ast.Module) -> Iterator[tuple[Function, bool]]:
    """Yield every function, and whether it is public.

    Public are functions of a module or a public class, except commands with options.
    """
    public = [*body.body]
    for node in body.body:
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            public += node.body
    shown = {id(node) for node in public}
    for function in ast.walk(body):
        if isinstance(function, Function):
            yield function, id(function) in shown and not function.name.startswith("_") and not is_command(function)


def is_command(function: Function) -> bool:
    """Return whether the parameters of a function are command-line options, which have help texts instead."""
    text = " ".join(ast.unparse(decorator) for decorator in function.decorator_list)
    return bool(re.search(r"\.(command|callback)\(", text))


def statement_lines(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Count the lines of a function's statements, without its decorators, parameters and docstring."""
    documented = ast.get_docstring(function) is not None
    statements = function.body[1:] if documented else function.body
    return (function.end_lineno or 0) - statements[0].lineno + 1 if statements else 0


def parameters(function: Function) -> list[str]:
    """Return the parameters of a function except `self` and `cls`."""
    arguments = function.args
    every = [
        *arguments.posonlyargs,
        *arguments.args,
        *arguments.kwonlyargs,
        *filter(None, (arguments.vararg, arguments.kwarg)),
    ]
    return [argument.arg for argument in every if argument.arg not in ("self", "cls")]


def docstrings(body: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield the line and text of each docstring: of modules, classes, functions and fields."""
    for node in ast.walk(body):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            yield node.lineno, node.value.value.strip().partition("\n")[0]


def import_graph(parsed: Mapping[str, ast.Module], paths: Mapping[str, Path]) -> dict[str, set[str]]:
    """Return the modules of the package that each module imports anywhere in its code."""
    graph: dict[str, set[str]] = {}
    for name, body in parsed.items():
        package = name if paths[name].name == "__init__.py" else name.rpartition(".")[0]
        imported: set[str] = set()
        for node in ast.walk(body):
            if isinstance(node, ast.Import):
                imported |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                above = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
                base = ".".join([*above, *filter(None, [node.module])])
                imported |= {f"{base}.{alias.name}" for alias in node.names}
        known = {target if target in parsed else target.rpartition(".")[0] for target in imported}
        graph[name] = (known & parsed.keys()) - {name}
    return graph


def part_graph(imports: Mapping[str, set[str]], group: str) -> dict[str, set[str]]:
    """Return the parts (folders and modules) of a group, each with the parts that it imports."""

    def part_of(name: str) -> str:
        return name.removeprefix(f"{group}.").partition(".")[0] if name.startswith(f"{group}.") else ""

    graph: dict[str, set[str]] = {}
    for name, imported in imports.items():
        if part := part_of(name):
            graph.setdefault(part, set()).update(
                target for module in imported if (target := part_of(module)) not in ("", part)
            )
    return graph


def layers(graph: Mapping[str, set[str]]) -> int:
    """Count the parts on the longest path of imports; parts of a cycle share one layer."""
    left, count = dict(graph), 0
    while left:
        free = {name for name, imported in left.items() if not imported & left.keys()} or set(left)
        left = {name: imported for name, imported in left.items() if name not in free}
        count += 1
    return count


def cycles(graph: Mapping[str, set[str]]) -> list[set[str]]:
    """Return the groups of modules that import each other."""
    left = dict(graph)
    while free := {name for name, imported in left.items() if not imported & left.keys()}:
        left = {name: imported for name, imported in left.items() if name not in free}
    reached = {name: reach(left, name) for name in left}
    found: list[set[str]] = []
    for name in left:
        cycle = {module for module in reached[name] if name in reached[module]}
        if cycle and cycle not in found:
            found.append(cycle)
    return found


def reach(graph: Mapping[str, set[str]], begin: str) -> set[str]:
    """Return everything that a module imports, directly or indirectly."""
    seen: set[str] = set()
    waiting = [begin]
    while waiting:
        new = graph.get(waiting.pop(), set()) - seen
        seen |= new
        waiting += new
    return seen & graph.keys()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tree", nargs="?", type=Path, default=Path(__file__).parents[1], help="a checkout of skope")
    parser.add_argument("--before", type=Path, help="another checkout, whose figures come first")
    parser.add_argument("--names", action="store_true", help="also list the names behind the figures")
    asked = parser.parse_args()
    for tree in filter(None, (asked.tree, asked.before)):
        if not (tree / "skope").is_dir():
            parser.error(f"{tree}: has no folder skope")
    now = figures(asked.tree)
    before = figures(asked.before).rows() if asked.before else {}
    print("| figure | before | now |\n|---|---|---|" if before else "| figure | now |\n|---|---|")
    for name, value in now.rows().items():
        print(f"| {name} | {before[name]} | {value} |" if before else f"| {name} | {value} |")
    if asked.names:
        for name, every in now.names().items():
            print(f"\n{name}", *every, sep="\n  ")


if __name__ == "__main__":
    main()
