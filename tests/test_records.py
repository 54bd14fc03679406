"""Reading of single values, dataclasses and images."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import pytest

from skope.errors import UserError
from skope.records import (
    check_array,
    check_image,
    check_number,
    check_share,
    dataclass_of,
    is_number,
    value_of,
    with_values,
)
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
    with pytest.raises(UserError, match="a: expected a number from 0, got"):
        check_number("a", value)
    with pytest.raises(UserError, match="a: expected a number from 0 to 1, got"):
        check_number("a", value, 0, 1)
    if value is not None:
        with pytest.raises(UserError, match="a: expected a number from 0 to 1"):
            check_share("a", value)


@dataclass(frozen=True)
class Inner:
    shares: tuple[float, ...] = ()
    limits: tuple[int, int] | None = None


@dataclass(frozen=True)
class Outer:
    name: str
    count: int
    by_name: Mapping[str, float]
    inner: Inner = field(default_factory=Inner)


GOOD: dict[str, Any] = {"name": "a", "count": 3, "by_name": {"x": 1}, "inner": {"shares": [0.5, 1], "limits": [1, 2]}}


def test_a_dataclass_is_read_from_plain_values() -> None:
    made = dataclass_of(Outer, GOOD, "file: outer")
    assert made == Outer("a", 3, {"x": 1.0}, Inner((0.5, 1.0), (1, 2)))
    assert type(made.inner.shares[1]) is float
    assert dataclass_of(Outer, asdict(made), "again") == made


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"count": True}, "f: count: expected a whole number, got True"),
        ({"count": 3.0}, "f: count: expected a whole number, got 3.0"),
        ({"name": None}, "f: name: expected text, got nothing"),
        ({"by_name": {"x": "1"}}, "f: by_name.x: expected a number, got '1'"),
        ({"by_name": [1]}, "f: by_name: expected an object, got"),
        (
            {"inner": {"shares": [], "limits": [1, 2, 3]}},
            "f: inner.limits: expected a list of 2 whole numbers or none, got",
        ),
        ({"inner": {"limits": None, "shares": [1, math.nan]}}, r"f: inner.shares\[1\]: expected a number, got nan"),
        ({"inner": {"shares": [1]}}, "f: inner.limits: missing"),
        ({"inner": 4}, "f: inner: expected an object, got 4"),
        ({"inner": {"share": [1]}}, r"f: inner.share: unknown field; did you mean shares\?"),
        ({"further": 1}, "f: further: unknown field; expected by_name, count, inner, name"),
    ],
)
def test_a_wrong_field_is_named(change: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message):
        dataclass_of(Outer, {**GOOD, **change}, "f: ")


def test_a_missing_field_is_named() -> None:
    with pytest.raises(UserError, match="card: count: missing"):
        dataclass_of(Outer, {name: value for name, value in GOOD.items() if name != "count"}, "card: ")


def test_values_of_a_nested_table_change_alone() -> None:
    base = dataclass_of(Outer, GOOD, "f: ")
    changed = with_values(base, {"inner": {"shares": []}, "count": 4}, "f: ")
    assert changed == Outer("a", 4, {"x": 1.0}, Inner((), (1, 2)))


def test_none_has_a_word_where_there_is_none_in_the_language() -> None:
    base = Inner((), (1, 2))
    assert with_values(base, {"limits": "none"}, "--set ").limits is None
    with pytest.raises(UserError, match="a: expected a whole number or none, got 'none'"):
        value_of("none", int | None, "a")


def test_numbers_of_any_length_are_rejected() -> None:
    with pytest.raises(UserError, match="a: expected numbers"):
        check_array("a", [10**400], 1)


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
    taken = check_image("image", VIEWS[name])
    np.testing.assert_array_equal(taken, VIEWS[name])
    assert taken.flags.c_contiguous


def test_an_image_in_order_is_not_copied() -> None:
    assert np.shares_memory(check_image("image", RGB), RGB)


@pytest.mark.parametrize("name", NO_IMAGES)
def test_no_image_is_rejected_in_one_line(name: str) -> None:
    value, said = NO_IMAGES[name]
    with pytest.raises(UserError, match=r"^image: expected \(H, W, 3\) RGB pixels of type uint8, " + said) as error:
        check_image("image", value)
    assert "\n" not in str(error.value)
