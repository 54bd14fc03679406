"""Plain English: texts are free of constructions that this field does not use; sentences of guides are short."""

import ast
import io
import re
import tokenize
from functools import cache
from pathlib import Path
from typing import Final

import pytest

ROOT: Final = Path(__file__).parent.parent
MODULES: Final = sorted((ROOT / "skope").rglob("*.py"))
GUIDES: Final = (
    "README.md",
    "docs/python.md",
    "docs/files.md",
    "docs/site-on-the-screen.md",
    "docs/own-road.md",
    "docs/privacy.md",
    "docs/installing.md",
    "docs/generating.md",
    "docs/training.md",
    "docs/exporting.md",
    "docs/evaluation.md",
    "docs/vehicles.md",
    "docs/scale.md",
    "docs/results.md",
    "docs/speed.md",
    "docs/comparison.md",
    "docs/traffic.md",
    "docs/traffic-files.md",
    "docs/hours-and-days.md",
    "docs/manual-counts.md",
    "docs/how-counts-are-made.md",
    "docs/from-camera-to-tracks.md",
    "docs/how-a-camera-is-calibrated.md",
    "docs/footage.md",
    "docs/tracks.md",
    "docs/conventions.md",
    "docs/architecture.md",
    "docs/glossary.md",
    "docs/rendering.md",
    "docs/formats.md",
    "docs/method.md",
)
"""Pages that are checked. The others follow."""

BANNED: Final = {
    r"\bso (?:many|much|often|near|long)-?(?:th)?\b(?! (?:as|that)\b)": "name the quantity: 'maximum number of ...'",
    r"\b[Oo]f (?:which|whom)\b|\bwhom\b": "make two sentences, or write 'with', 'that has'",
    r"\b(?:is|are|was|were|be) (?:said|told)\b|\b(?:says|tells) nothing\b": "'reported', 'not available'",
    r"\b[Bb]esides\b": "'in addition', 'also'",
    r"\b(?:go|goes|going|gone|went) on\b": "'continue', 'resume'",
    r"\b(?:held|hold|holds) against\b": "'compare with'",
    r"\b[Hh]and[- ]count": "'manual count'",
    r"\b[Pp]hantom": "'false positive'",
    r"\b(?:another one|other ones)\b": "name the thing",
    r"\b(?:[Nn]obody|[Ww]hoever|[Ss]omebody)\b": "name the thing: vehicle, caller, file",
    r"\bshall\b": "'must', 'is'",
}
"""Constructions that no other package of the field uses, and what to write instead."""
FIRST_WORDS: Final = ("Of", "What", "Who", "Whose", "So", "Those", "Whereby", "By")
"""The first line of a docstring is a noun or a verb."""
MAX_MEAN_WORDS: Final = 18.0
"""Maximum mean length of the sentences of a guide, words."""


@cache
def texts(path: Path) -> list[tuple[int, str]]:
    """Return line numbers and texts of comments and strings, without the code in f-strings."""
    return [
        (token.start[0], re.sub(r"\{[^{}]*\}", "", token.string))
        for token in tokenize.generate_tokens(io.StringIO(path.read_text(encoding="utf-8")).readline)
        if token.type in (tokenize.COMMENT, tokenize.STRING)
    ]


def prose(page: str) -> str:
    """Return the sentences of a page: no code, tables, headings or links."""
    text = (ROOT / page).read_text(encoding="utf-8")
    text = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    lines = [line for line in text.splitlines() if not re.match(r"^(?: {4}|#|\||!)", line)]
    return re.sub(r"\]\([^)]*\)", "]", "\n".join(lines))


@pytest.mark.parametrize("pattern", BANNED)
def test_banned_constructions_are_absent(pattern: str) -> None:
    found = [
        f"{path.relative_to(ROOT)}:{number}: {match[0]!r}, write {BANNED[pattern]}"
        for path in MODULES
        for number, text in texts(path)
        for match in re.finditer(pattern, text)
    ]
    found += [f"{page}: {match[0]!r}" for page in GUIDES for match in re.finditer(pattern, prose(page))]
    assert found == []


def test_docstrings_begin_with_a_noun_or_a_verb() -> None:
    found = []
    for path in MODULES:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
                first = (ast.get_docstring(node) or "-").split()[0]
                if first in FIRST_WORDS:
                    found.append(f"{path.relative_to(ROOT)}: {getattr(node, 'name', 'module')}: {first}")
    assert found == []


@pytest.mark.parametrize("page", GUIDES)
def test_sentences_of_guides_are_short(page: str) -> None:
    sentences = [one for one in re.split(r"(?<=[.!?:])\s+|\n\s*\n|\n- ", prose(page)) if len(one.split()) > 2]
    words = [len(one.split()) for one in sentences]
    assert sum(words) / len(words) <= MAX_MEAN_WORDS, max(sentences, key=lambda one: len(one.split()))
