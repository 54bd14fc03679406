"""The figures on the package's code, of a tree that is small enough to count by hand."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / "scripts" / "house_figures.py"
MODULES = {
    "__init__.py": "",
    "low.py": '''
        """Nouns."""
        NEAR = 1
        FAR_M: float = 2.0
        """How far."""
        def shared(): ...
        ''',
    "high/__init__.py": "",
    "high/told.py": '''
        from skope.low import NEAR as _NEAR
        from . import other
        NEAR = 1
        class Thing:
            def three(self, a, b, *, c):
                """Do it.

                Args:
                    a: One.
                """
        def shared(a, b, c):
            """Does not tell."""
        @app.command()
        def command(a, b, c): ...
        ''',
    "high/other.py": """
        NEAR = 1
        def _inner(a, b, c): ...
        def few(a, b): ...
        def long():
            x = 1
        """
    + "    x += 1\n        " * 60,
}


def write(root: Path, changed: dict[str, str]) -> Path:
    for name, text in {**MODULES, **changed}.items():
        path = root / "skope" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("\n".join(line[8:] for line in text.split("\n")))
    return root


def run(*arguments: object) -> str:
    command = [sys.executable, str(SCRIPT), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def test_a_small_tree_is_counted(tmp_path: Path) -> None:
    tree = write(tmp_path / "now", {})
    round_about = "from skope.high import other\n"
    before = write(
        tmp_path / "before", {"low.py": " " * 8 + round_about, "high/other.py": " " * 8 + "import skope.low\n"}
    )
    said = run(tree, "--before", before, "--names")
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in said.splitlines()[2:12]]
    assert rows == [
        ["public functions of 3+ parameters with Args", "1 of 2 (50%)", "1 of 2 (50%)"],
        ["one-word constants in more than 2 modules", "0", "1"],
        ["public names defined in several modules", "0", "2"],
        ["functions over 60 lines", "0", "1"],
        ["functions over 60 lines of statements", "0", "1"],
        ["docstrings that begin with a question", "0", "1"],
        ["parts, imports, layers of skope", "2, 2, 1", "2, 1, 2"],
        ["parts, imports, layers of skope.gen", "0, 0, 0", "0, 0, 0"],
        ["parts, imports, layers of skope.eval", "0, 0, 0", "0, 0, 0"],
        ["import cycles", "1", "0"],
    ]
    assert re.search(r"without Args\n  skope.high.told:\d+ shared\n\n", said)
    assert "NEAR: skope.high.other, skope.high.told, skope.low" in said


@pytest.mark.parametrize("name", ["--before", ""])
def test_a_folder_without_the_package_is_refused(tmp_path: Path, name: str) -> None:
    command = [sys.executable, str(SCRIPT), *filter(None, [name]), str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, "has no folder skope" in done.stderr) == (2, True)
