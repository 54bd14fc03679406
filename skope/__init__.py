"""Synthetic roadside images with 33 keypoints per vehicle, the detector that learns from them, and its measurement.

The names below are all that most programs need; each is loaded when it is first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from skope.version import __version__ as __version__

if TYPE_CHECKING:
    from skope.api import Detector as Detector
    from skope.api import count as count
    from skope.api import generate as generate
    from skope.api import load_detector as load_detector
    from skope.api import locate as locate
    from skope.api import measure_traffic as measure_traffic
    from skope.api import open_dataset as open_dataset
    from skope.api import read_camera as read_camera
    from skope.api import score as score
    from skope.api import torch_dataset as torch_dataset
    from skope.api import track as track
    from skope.camera.model import Camera as Camera
    from skope.dataset import coco as coco
    from skope.errors import UserError as UserError
    from skope.pictures import draw as draw

_PLACES = {
    **dict.fromkeys(
        (
            "Detector",
            "count",
            "generate",
            "load_detector",
            "locate",
            "measure_traffic",
            "open_dataset",
            "read_camera",
            "score",
            "torch_dataset",
            "track",
        ),
        "skope.api",
    ),
    "Camera": "skope.camera.model",
    "UserError": "skope.errors",
}
_MODULES = {"coco": "skope.dataset.coco", "draw": "skope.pictures.draw"}

__all__ = sorted((*_PLACES, *_MODULES, "__version__"))


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return import_module(_MODULES[name])
    if name not in _PLACES:
        raise AttributeError(f"module 'skope' has no attribute {name!r}")
    return getattr(import_module(_PLACES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
