"""Recordings with articulated vehicles, and those without."""

import io
from dataclasses import replace
from pathlib import Path

import numpy as np

from skope.camera.model import Camera
from skope.gen.scene import recording as recordings
from skope.gen.scene.recording import Recording, packed_recording, unpacked_recording
from tests.gen.scenes import standing

CAMERA = Camera.looking([300.0, -190.0, 6.0], yaw=0.7, pitch_down=0.25, size=(320, 180))
PLACES = [("sedan", 310.0, -184.0, 0.3), ("articulated_curtain", 318.0, -178.0, 1.9)]


def bent() -> Recording:
    return standing(CAMERA, PLACES, bend=0.4)


def test_poses_of_trailers_survive_the_disk(tmp_path: Path) -> None:
    recording = bent()
    recordings.save(tmp_path / "r.npz", recording)
    again = recordings.load(tmp_path / "r.npz").moment(0)
    np.testing.assert_array_equal(again.T_world_trailer, recording.T_world_trailer)
    np.testing.assert_array_equal(again.T_world_trailer[0], np.tile(np.eye(4), (3, 1, 1)))
    assert again.part_poses(1).shape == (8, 4, 4)
    np.testing.assert_array_equal(again.part_poses(1)[5:], recording.T_world_trailer[1])
    assert packed_recording(recordings.load(tmp_path / "r.npz")) == packed_recording(recording)


def test_a_file_without_an_articulated_vehicle_has_no_trailers() -> None:
    recording = standing(CAMERA, PLACES[:1])
    without = replace(recording, T_world_trailer=None)
    assert packed_recording(recording) == packed_recording(without)
    with np.load(io.BytesIO(packed_recording(recording))) as file:
        assert "T_world_trailer" not in file.files
    again = unpacked_recording(packed_recording(without), Path("r.npz"))
    np.testing.assert_array_equal(again.moment(0).T_world_trailer[0], np.tile(np.eye(4), (3, 1, 1)))
    assert again.starts_like(recording)


def test_a_recording_whose_trailer_is_elsewhere_starts_differently() -> None:
    assert bent().starts_like(bent())
    assert not bent().starts_like(standing(CAMERA, PLACES, bend=0.3))


def test_a_part_of_a_moment_keeps_its_trailers() -> None:
    moment = bent().moment(0)
    np.testing.assert_array_equal(moment.only([1]).T_world_trailer[0], moment.T_world_trailer[1])
