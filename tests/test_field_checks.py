"""What counts as a number of a file or a caller, everywhere the same."""

import math
from typing import Any

import numpy as np
import pytest

from skope.api.checks import in_range
from skope.errors import UserError
from skope.eval.site_page.document_values import number_or_none
from skope.field_checks import check_number, check_share, is_number, probability

NO_NUMBERS = (True, False, None, "1", [1], math.nan, math.inf, -math.inf, 10**400)
"""Whole numbers have any length in JSON and in Python: no float holds the last one."""


@pytest.mark.parametrize("value", [0, 1, -3, 2.5, np.float64(0.5)])
def test_numbers(value: Any) -> None:
    assert is_number(value)
    assert number_or_none(value) == value


@pytest.mark.parametrize("value", NO_NUMBERS, ids=lambda value: repr(value)[:12])
def test_everything_else_is_refused_wherever_a_number_is_expected(value: Any) -> None:
    assert not is_number(value)
    assert number_or_none(value) is None
    for check in (check_number, probability):
        with pytest.raises(UserError, match="a: expected a number from 0"):
            check("a", value)
    with pytest.raises(UserError, match="a: expected a number from 0 to 1"):
        in_range("a", value, 0, 1)
    if value is not None:
        with pytest.raises(UserError, match="a: expected a share from 0 to 1"):
            check_share("a", value)
