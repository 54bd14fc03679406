"""What counts as a number of a file or a caller, everywhere the same."""

import math
from typing import Any

import numpy as np
import pytest

from skope.api.checks import in_range
from skope.errors import UserError
from skope.field_checks import check_number, check_share, image_pixels, is_number, probability
from skope.site.mark_parser import number_or_none

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


RGB = np.random.default_rng(0).integers(0, 256, (12, 20, 3)).astype(np.uint8)
VIEWS = {
    "turned round": RGB[..., ::-1],
    "upside down": np.flipud(RGB),
    "mirrored": RGB[:, ::-1],
    "every second": RGB[::2, ::-3],
    "column order": np.asfortranarray(RGB),
    "transposed": RGB.transpose(1, 0, 2),
    "broadcast": np.broadcast_to(RGB[:1], RGB.shape),
}
"""Arrays whose values do not lie in memory in the order of the image."""
NO_IMAGES: dict[str, tuple[Any, str]] = {
    "grey": (RGB[..., 0], r"got \(12, 20\) of type uint8"),
    "four channels": (np.dstack([RGB, RGB[..., :1]]), r"got \(12, 20, 4\) of type uint8"),
    "several": (RGB[None], r"got \(1, 12, 20, 3\) of type uint8"),
    "no rows": (RGB[:0], r"got \(0, 20, 3\) of type uint8: it is empty"),
    "no columns": (RGB[:, :0], r"got \(12, 0, 3\) of type uint8: it is empty"),
    "fractions": (
        RGB / 255.0,
        r"got \(12, 20, 3\) of type float64: .* \(255 \* image\)\.round\(\)\.astype\(numpy\.uint8\)",
    ),
    "16 bits": (RGB.astype(np.uint16), r"got \(12, 20, 3\) of type uint16$"),
    "signed": (RGB.astype(np.int64), r"got \(12, 20, 3\) of type int64$"),
    "objects": (RGB.astype(object), r"got \(12, 20, 3\) of type object$"),
    "nothing, as cv2.imread gives for a missing file": (None, "got None"),
    "a list": (RGB.tolist(), "got list"),
}


@pytest.mark.parametrize("name", VIEWS)
def test_an_image_is_taken_in_any_order_of_memory(name: str) -> None:
    taken = image_pixels("image", VIEWS[name])
    np.testing.assert_array_equal(taken, VIEWS[name])
    assert taken.flags.c_contiguous


def test_an_image_in_order_is_not_copied() -> None:
    assert np.shares_memory(image_pixels("image", RGB), RGB)


@pytest.mark.parametrize("name", NO_IMAGES)
def test_no_image_is_rejected_in_one_line(name: str) -> None:
    value, said = NO_IMAGES[name]
    with pytest.raises(UserError, match=r"^image: expected \(H, W, 3\) RGB pixels of type uint8, " + said) as error:
        image_pixels("image", value)
    assert "\n" not in str(error.value)
