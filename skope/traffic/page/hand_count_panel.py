"""The part of the page in which somebody counts by hand while the footage plays."""

import json
from importlib import resources
from typing import Final

from skope.camera.model import Camera
from skope.page.html_pieces import tag
from skope.traffic.page.hand_count_data import hand_count_data
from skope.traffic.traffic_report import TrafficReport

_SCRIPTS: Final = ("hand_count_numbers.js", "hand_count.js")


def hand_count_panel(report: TrafficReport, camera: Camera | None = None) -> str:
    """Markup, style and script; nothing where the report has no gates, or the footage no frames.

    Args:
        report: The report.
        camera: What the footage was seen with, for the gates that are drawn over it; None: not known.
    """
    if not report.gates or not len(report.observation.spans):
        return ""
    # No "<" of a name may end the element.
    data = json.dumps(hand_count_data(report, camera), separators=(",", ":")).replace("<", "\\u003c")
    script = "\n".join(map(_text, _SCRIPTS))
    return "".join(
        (
            tag("style", _text("hand_count.css")),
            tag("section", _text("hand_count.html"), id="hand", hidden="hidden"),
            tag("script", data, type="application/json", id="hand-data"),
            # Its names are its own.
            tag("script", f'"use strict";\n{{\n{script}\n}}'),
        )
    )


def _text(name: str) -> str:
    return resources.files("skope.traffic.page").joinpath(name).read_text(encoding="utf-8")
