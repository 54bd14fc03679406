"""Scale and rotation of a plan that a user has loaded, from two of its points."""

import math
from collections.abc import Mapping
from typing import Any, Final

from skope.errors import UserError
from skope.site.page.document_values import positions

_AGREE: Final = 0.02
"""A typed distance and that of typed places may differ by this share."""


def plan_scale(sent: Mapping[str, Any]) -> dict[str, Any]:
    """`metres_per_pixel` of the plan, `origin`: x and y of its top-left corner, and `rotation_deg`.

    A pixel (u, v) of the plan lies at origin + m R (u, -v), where m are the metres of a pixel and R turns by the
    rotation, counter-clockwise. Where one of the two places is known alone, north is up: the rotation is 0.

    Args:
        sent: `ends`, two pixels of the plan, `metres` between them, `at`, x and y of the first one, and `second`, those
            of the second one where they are known; numbers may be texts, and empty ones are not known.

    Raises:
        UserError: One of these is missing, no such number, or contradicts the others.
    """
    ends = positions(sent.get("ends"), 2)
    if ends is None or len(ends) != 2:
        raise UserError("click two points of the plan")
    apart = math.dist(*ends)
    if apart < 2:
        raise UserError("the two points are the same: click again")
    first, second = _place(sent.get("at", [0, 0]), "first"), _place(sent.get("second"), "second")
    if first is None:
        raise UserError("x, y: expected metres, two numbers")
    typed = sent.get("metres")
    metres = None if typed in (None, "") else _number(typed)
    needed = second is None or typed not in (None, "")
    if needed and (metres is None or not 0.1 <= metres <= 1e5):
        raise UserError("distance: expected metres from 0.1 to 100000")
    rotation = 0.0
    if second is not None:
        between = math.dist(first, second)
        if not 0.1 <= between <= 1e5:
            raise UserError("the two places are the same, or farther apart than any road's")
        if metres is not None and abs(metres - between) > _AGREE * between:
            raise UserError(f"the two places are {between:.2f} m apart, not {metres:g}: which is right?")
        metres = between
        on_plan = math.atan2(ends[0][1] - ends[1][1], ends[1][0] - ends[0][0])
        turn = math.atan2(second[1] - first[1], second[0] - first[0]) - on_plan
        rotation = math.degrees(math.remainder(turn, 2 * math.pi))
    assert metres is not None
    scale, turn = metres / apart, math.radians(rotation)
    u, v = (scale * value for value in ends[0])
    corner = [
        first[0] - (u * math.cos(turn) + v * math.sin(turn)),
        first[1] - (u * math.sin(turn) - v * math.cos(turn)),
    ]
    return {"metres_per_pixel": scale, "origin": corner, "rotation_deg": rotation}


def _place(value: Any, which: str) -> tuple[float, float] | None:
    """x and y; None where both are empty."""
    pair = value if isinstance(value, list) and len(value) == 2 else [None, None]
    if all(one in (None, "") for one in pair):
        return None
    x, y = (_number(one) for one in pair)
    if x is None or y is None or max(abs(x), abs(y)) > 1e8:
        raise UserError(f"x, y of the {which} one: expected metres, two numbers")
    return x, y


def _number(value: Any) -> float | None:
    try:
        found = float(value)
    except (TypeError, ValueError):
        return None
    return found if math.isfinite(found) else None
