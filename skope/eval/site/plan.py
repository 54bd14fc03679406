"""How large a plan is that a user has loaded, from two of its points whose distance is known; its north is up."""

import math
from collections.abc import Mapping
from typing import Any

from skope.errors import UserError
from skope.eval.site.marks import positions


def plan_scale(sent: Mapping[str, Any]) -> dict[str, Any]:
    """`metres_per_pixel` of the plan, and `origin`: the pixel of the world's (0, 0) in metres off the plan's corner.

    A pixel (u, v) of the plan lies at x = origin x + u m, y = origin y - v m, where m are the metres of a pixel.

    Args:
        sent: `ends`, two pixels of the plan, `metres` between them, and `at`, x and y of the first one; numbers may be
            texts.

    Raises:
        UserError: One of these is missing or no such number.
    """
    ends = positions(sent.get("ends"), 2)
    if ends is None or len(ends) != 2:
        raise UserError("click two points of the plan")
    apart = math.dist(*ends)
    if apart < 2:
        raise UserError("the two points are the same: click again")
    metres = _number(sent.get("metres"))
    if metres is None or not 0.1 <= metres <= 1e5:
        raise UserError("distance: expected metres from 0.1 to 100000")
    at = sent.get("at", [0, 0])
    x, y = (_number(value) for value in (at if isinstance(at, list) and len(at) == 2 else (None, None)))
    if x is None or y is None or max(abs(x), abs(y)) > 1e8:
        raise UserError("x, y: expected metres, two numbers")
    scale = metres / apart
    u, v = ends[0]
    return {"metres_per_pixel": scale, "origin": [x - u * scale, y + v * scale]}


def _number(value: Any) -> float | None:
    try:
        found = float(value)
    except (TypeError, ValueError):
        return None
    return found if math.isfinite(found) else None
