"""Poses are taken out of the normal equations also where what is seen of a vehicle does not tell its pose."""

import numpy as np

from skope.camera.fit.normal_equations import Linearised


def test_a_pose_that_is_not_told_gives_finite_steps() -> None:
    """A view of keypoints that all pull one way, strongly: exactly singular, whatever is added that is small."""
    way = np.array([1.0, 2.0, 4.0, 0.5, 0.25]) * 2.0**20
    normal = np.outer(way, way)[None]
    parts = Linearised(np.zeros((1, 33)), np.zeros(1), normal, way[None] / 2.0**20, 1).without_poses(
        np.zeros(1, dtype=np.intp), np.zeros((1, 1)), np.zeros(1)
    )
    assert np.isfinite(parts.information).all()
    shape, pose = parts.back(np.zeros(1), np.zeros(1, dtype=np.intp))
    assert np.isfinite(shape).all()
    assert np.isfinite(pose).all()
