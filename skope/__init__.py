"""Synthetic roadside images with 33 keypoints per vehicle, a detector trained on them, and measurements with it.

The names below are sufficient for most programs; each is loaded on first use.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from skope.version import __version__ as __version__

if TYPE_CHECKING:
    from skope.api.cameras import calibrate_camera as calibrate_camera
    from skope.api.cameras import save_camera as save_camera
    from skope.api.datasets import generate as generate
    from skope.api.datasets import open_dataset as open_dataset
    from skope.api.datasets import torch_dataset as torch_dataset
    from skope.api.detector import Detector as Detector
    from skope.api.detector import load_detector as load_detector
    from skope.api.footage import Video as Video
    from skope.api.footage import VideoFrame as VideoFrame
    from skope.api.metres import estimate_poses as estimate_poses
    from skope.api.metres import read_camera as read_camera
    from skope.api.metres import track as track
    from skope.api.scores import score as score
    from skope.api.traffic import count as count
    from skope.api.traffic import measure_traffic as measure_traffic
    from skope.api.traffic import read_site as read_site
    from skope.api.training import train_detector as train_detector
    from skope.camera.model import Camera as Camera
    from skope.dataset import coco as coco
    from skope.dataset.folder import read_image as read_image
    from skope.detections import Detections as Detections
    from skope.errors import UserError as UserError
    from skope.pictures import draw as draw

PUBLIC_PLACES = {
    "Camera": "skope.camera.model",
    "Detections": "skope.detections",
    "Detector": "skope.api.detector",
    "UserError": "skope.errors",
    "Video": "skope.api.footage",
    "VideoFrame": "skope.api.footage",
    "calibrate_camera": "skope.api.cameras",
    "count": "skope.api.traffic",
    "generate": "skope.api.datasets",
    "load_detector": "skope.api.detector",
    "estimate_poses": "skope.api.metres",
    "measure_traffic": "skope.api.traffic",
    "open_dataset": "skope.api.datasets",
    "read_camera": "skope.api.metres",
    "read_image": "skope.dataset.folder",
    "read_site": "skope.api.traffic",
    "save_camera": "skope.api.cameras",
    "score": "skope.api.scores",
    "torch_dataset": "skope.api.datasets",
    "track": "skope.api.metres",
    "train_detector": "skope.api.training",
}
PUBLIC_MODULES = {"coco": "skope.dataset.coco", "draw": "skope.pictures.draw"}

__all__ = sorted((*PUBLIC_PLACES, *PUBLIC_MODULES, "__version__"))


def __getattr__(name: str) -> Any:
    if name in PUBLIC_MODULES:
        return import_module(PUBLIC_MODULES[name])
    if name not in PUBLIC_PLACES:
        raise AttributeError(f"module 'skope' has no attribute {name!r}")
    return getattr(import_module(PUBLIC_PLACES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
