"""Cameras turned by what their images show, and places that are the same whether the camera sways or not."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skope.camera.model import Camera, Distortion
from skope.camera.motion.camera_motion import CameraMotion, turned_camera
from skope.camera.motion.image_shift import ImageMotion
from skope.camera.uncertain_camera import UncertainCamera
from skope.dataset import coco
from skope.errors import UserError
from skope.traffic.observation import read_observation
from tests.sightings import CAMERA, drive

BENT = Camera.looking(
    [3, -2, 7], yaw=0.4, pitch_down=0.3, roll=0.02, fov=1.4, distortion=Distortion("brown", (-0.2, 0.02, 0.0, 0.0))
)


@pytest.mark.parametrize("camera", [CAMERA, BENT])
def test_a_turned_camera_has_its_middle_where_it_is_said_and_turns_around_it(camera: Camera) -> None:
    middle = np.array([camera.width, camera.height]) / 2
    ray = camera.rays(middle)[0] @ camera.T_camera_world[:3, :3]
    turned = turned_camera(camera, 12.0, -7.0, 0.01)
    assert turned.position == pytest.approx(camera.position)
    assert turned.project(camera.position + 30 * ray)[0] == pytest.approx(middle + [12, -7], abs=1e-6)
    still = turned_camera(camera, 0.0, 0.0, 0.01)
    beside = camera.rays(middle + [20, 0])[0] @ camera.T_camera_world[:3, :3]
    to = still.project(camera.position + 30 * beside)[0] - middle
    assert math.atan2(to[1], to[0]) == pytest.approx(0.01, abs=1e-6)
    assert turned_camera(camera, 0, 0, 0).T_camera_world == pytest.approx(camera.T_camera_world)


def test_stilled_pixels_are_those_of_the_resting_camera() -> None:
    motion = CameraMotion({1: ImageMotion(9.0, -5.0, 0.02, 0.05, 1e-4)}, (5.0, 5.0, 0.01))
    image = drive(0.2, 10).images[0]
    places = np.array([[20.0, 5.0, 0.0], [15.0, 8.0, 1.0]])
    swayed = motion.camera_in(CAMERA, 1).project(places)[0]
    assert motion.stilled(CAMERA, image, swayed) == pytest.approx(CAMERA.project(places)[0], abs=1e-6)
    unknown = replace(image, id=99)
    assert motion.stilled(CAMERA, unknown, swayed) == pytest.approx(swayed), "at rest, as `camera_in` has it"
    near = motion.stilled(None, image, np.array([[960.0, 540.0]]))
    assert near == pytest.approx(motion.stilled(CAMERA, image, np.array([[960.0, 540.0]])), abs=0.3)


def test_the_sway_adds_to_how_uncertain_the_resting_camera_is() -> None:
    """A pixel's standard deviation turns a camera of focal length f by 1 / f."""
    focal = CAMERA.K[0, 0]
    level = Camera.looking([0, 0, 7], yaw=0.4, pitch_down=0.0)
    motion = CameraMotion({1: ImageMotion(0, 0, 0, 0.05, 1e-4)}, (3.0, 2.0, 0.004))
    known = motion.at_rest(level, UncertainCamera(level, ("z",), np.array([[0.01]])))
    sigma = dict(zip(known.parameters, np.sqrt(np.diag(known.covariance)), strict=True))
    expected = {"z": 0.1, "pitch": 2 / focal, "roll": 0.004, "yaw": 3 / focal}
    assert sigma == pytest.approx(expected, rel=1e-4)
    rest = motion.rest_in(level, 1)
    assert np.sqrt(np.diag(rest.covariance)) == pytest.approx([0.05 / focal, 1e-4, 0.05 / focal], rel=1e-4)
    unknown = motion.rest_in(level, 2)
    assert np.sqrt(np.diag(unknown.covariance)) == pytest.approx([2 / focal, 0.004, 3 / focal], rel=1e-4)


def test_what_a_file_says_of_a_sway_is_checked() -> None:
    motion = CameraMotion({1: ImageMotion(1.5, 2, 0.001, 0.05, 1e-4)}, (3.0, 2.0, 0.004))
    read = CameraMotion.from_dict("v", json.loads(json.dumps(motion.to_dict())))
    assert read.frames == motion.frames
    assert read.shake_sigmas == motion.shake_sigmas
    for wrong in ({}, {"sway": [1, 1, 1], "frames": []}, {"sway": [1, 1], "frames": [[1, 0, 0, 0, 0, 0]]}):
        with pytest.raises(UserError, match=r"v: info\.camera_motion: expected sway"):
            CameraMotion.from_dict("v", wrong)


def test_places_and_speeds_are_those_of_a_camera_that_stands_still(skope: Any) -> None:
    still = drive(3, 8, speeds=(9.0, -5.0))
    swaying: dict[int, ImageMotion] = {}
    images, annotations = [], []
    for image in still.images:
        x, y = 12 * math.sin(2.1 * image.id), 6 * math.sin(1.3 * image.id)
        swaying[image.id] = ImageMotion(x, y, 0.003 * math.sin(image.id), 0.03, 5e-5)
    motion = CameraMotion(swaying, (8.0, 4.0, 0.002))
    by_image = still.by_image()
    for image in still.images:
        moved = motion.camera_in(CAMERA, image.id)
        images.append(replace(image, camera=CAMERA))
        for a in by_image[image.id]:
            rays = CAMERA.rays(a.keypoints[:, :2])[0] @ CAMERA.T_camera_world[:3, :3]
            seen = a.keypoints[:, 2] > 0
            pixels = np.where(seen[:, None], moved.project(CAMERA.position + rays)[0], 0.0)
            annotations.append(replace(a, keypoints=np.column_stack([pixels, a.keypoints[:, 2]])))
    shaken = replace(still, images=tuple(images), annotations=tuple(annotations))
    told = {**still.info, "camera_motion": motion.to_dict()}
    tracks = {}
    for name, file in (("still", still), ("shaken", replace(shaken, info=told)), ("untold", shaken)):
        coco.write(Path(f"{name}.json"), file)
        code, out, error = skope("eval", "track", "--annotations", f"{name}.json", "--ground", 0, "--out", name)
        assert code == 0, error
        assert ("corrected in each frame" in out) == (name == "shaken")
        lines = Path(f"{name}/tracks.csv").read_text().splitlines()
        columns = lines[0].split(",")
        tracks[name] = [dict(zip(columns, line.split(","), strict=True)) for line in lines[1:]]

    def off(name: str) -> float:
        pairs = zip(tracks["still"], tracks[name], strict=False)
        return max(math.hypot(float(a["x"]) - float(b["x"]), float(a["y"]) - float(b["y"])) for a, b in pairs)

    assert len(tracks["shaken"]) == len(tracks["still"])
    assert off("shaken") < 0.05
    assert off("untold") > 0.15
    for a, b in zip(tracks["still"], tracks["shaken"], strict=True):
        assert float(b["speed"]) == pytest.approx(float(a["speed"]), abs=0.05)
    still, shaken = (read_observation(Path(name)) for name in ("still", "shaken"))
    assert still.uncertainty is None
    assert shaken.uncertainty is not None, "of the shake, one error of all frames"
    assert shaken.uncertainty.covariance.any()
