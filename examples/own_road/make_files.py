"""Make camera.yml, marks.csv and empty.jpg of this example: skope draws the road that a photograph would show.

python make_files.py
"""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from skope.camera import Camera
from skope.gen.generation_site import read_generation_site
from skope.gen.render.choose_renderer import make_renderer
from skope.gen.scene.recording import Recording, RecordingPlan
from skope.gen.simulation.simulate import simulate

HERE = Path(__file__).parent
SURVEYED = [(-7.4, 0.1), (17.3, 0.7), (0.1, 7.8), (-2.5, 8.2), (3.2, 5.6), (2.2, 32.8), (14.9, -5.3), (-8.3, -5.7)]
"""Places on the road, metres east and north, as a surveyor would have them: what marks.csv has the pixels of."""


def write_camera(camera: Camera, path: Path) -> None:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", camera.width)
    storage.write("image_height", camera.height)
    # OpenCV counts the centre of the first pixel as 0, not as 0.5.
    storage.write("camera_matrix", camera.K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    storage.write("distortion_coefficients", np.array([camera.distortion.coefficients]))
    storage.write("rvec", cv2.Rodrigues(camera.T_camera_world[:3, :3])[0])
    storage.write("tvec", camera.T_camera_world[:3, 3:])
    storage.release()


def write_marks(camera: Camera, path: Path) -> None:
    pixels = camera.project(np.array([(x, y, 0.0) for x, y in SURVEYED]))[0]
    rows = [f"{u:.1f},{v:.1f},{x},{y},0" for (u, v), (x, y) in zip(pixels.tolist(), SURVEYED, strict=True)]
    path.write_text("\n".join(["column,row,x,y,z", *rows]) + "\n")


def emptied(recording: Recording) -> Recording:
    """The recording without anybody in it."""
    rows = ("frame", "vehicle", "T_world_chassis", "T_world_wheels", "velocity", "lamps")
    return replace(recording, vehicles=(), **{name: getattr(recording, name)[:0] for name in rows})


if __name__ == "__main__":
    site = read_generation_site(HERE / "drawn.toml").site
    assert site.road
    camera = site.road.camera
    write_camera(camera, HERE / "camera.yml")
    write_marks(camera, HERE / "marks.csv")
    plan = RecordingPlan(
        site=site, index=0, frames=1, interval=0.5, size=(camera.width, camera.height), fov_deg=0.0, seed=0
    )
    view = make_renderer("gl", emptied(simulate(plan))).render(0)
    cv2.imwrite(str(HERE / "empty.jpg"), view.rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])
