"""Camera model, calibration files and calibration from marked points."""

from skope.camera.model import Camera as Camera
from skope.camera.model import Distortion as Distortion
