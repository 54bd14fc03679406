"""Some of many models for the fast tests."""

import pytest


def a_third(models: list[str]) -> list[object]:
    """Every third model; the slow tests have the others."""
    return [pytest.param(model, marks=[pytest.mark.slow] * (i % 3 > 0)) for i, model in enumerate(models)]
