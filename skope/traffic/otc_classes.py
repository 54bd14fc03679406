"""OpenTrafficCam's names of the classes, as OTVision and OTAnalytics know them."""

from typing import Final

OTC_CLASSES: Final = {
    "car": "car",
    "van": "delivery_van",
    "lorry": "truck",
    "bus": "bus",
    "unknown": "other",
    "motorcycle": "motorcyclist",
    "bicycle": "bicyclist",
    "pedestrian": "pedestrian",
}
"""Each class of `skope.site.traffic_settings.TRAFFIC_CLASSES`, and its name there."""
