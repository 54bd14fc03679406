"""A camera: how it projects, files of its calibration, its pose from marked points."""

from skope.camera.model import Camera as Camera
from skope.camera.model import Distortion as Distortion
