"""What holds for every command."""

from typing import Any

import pytest


@pytest.mark.parametrize(
    ("words", "flag"),
    [
        (["eval", "--data", "x", "compare", "a", "b"], "--data"),
        (["train", "--epochs", "3", "export"], "--epochs"),
        (["gen", "--seed", "3", "check", "x"], "--seed"),
    ],
)
def test_flags_before_a_subcommand_are_refused_not_forgotten(skope: Any, words: list[str], flag: str) -> None:
    code, out, error = skope(*words)
    assert (code, out) == (2, "")
    assert error.startswith(f"skope: {flag}: is a flag of")
    assert f"`{words[3]}` after" in error
    assert error.count("\n") == 1
