"""What `gen check`, `gen stats` and the pose tables make of articulated vehicles."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from skope.dataset import coco
from skope.dataset.folder import Dataset
from skope.gen.inspect import check, label_checks, stats
from skope.gen.inspect.label_checks import box_3d_findings
from skope.keypoints import SKOPE33
from skope.pose.pose_footage import PoseErrors, pose_summary, pose_table
from skope.schema import Annotation, AnnotationFile, Image
from tests.gen.labels.test_articulated import CAMERA, labelled


def lorry(bend_deg: float) -> Annotation:
    """As read back from a file."""
    _, _, annotation = labelled("gl", bend_deg)
    return coco.annotation_from_dict(coco.annotation_to_dict(annotation))


@pytest.mark.parametrize("bend_deg", [0.0, 35.0, -35.0])
def test_a_sound_lorry_has_no_findings(bend_deg: float) -> None:
    assert (
        list(box_3d_findings(CAMERA, lorry(bend_deg))) == list(label_checks.keypoint_3d_findings(lorry(bend_deg))) == []
    )


def test_an_angle_that_the_rear_wheels_contradict_is_found() -> None:
    (text,) = label_checks.keypoint_3d_findings(replace(lorry(35.0), articulation=-0.3))
    assert text.startswith("articulation: -0.3000, expected 0.6109 from the wheels of keypoints_3d")


def test_rear_wheels_are_tested_beside_the_trailers_axle() -> None:
    annotation = lorry(35.0)
    places, wheels = label_checks._tested_places(annotation), annotation.keypoints_3d[[18, 19]]
    across = (wheels[1] - wheels[0]) / np.linalg.norm(wheels[1] - wheels[0])
    off = places[:, [18, 19]] - wheels
    straight = np.abs(off @ across - np.array([-0.11, 0.11])).max(axis=1).argmin()
    np.testing.assert_allclose(off[straight], [-0.11 * across, 0.11 * across], atol=0.005)


def moved(annotation: Annotation, id_: int, speed: float, seconds: float) -> tuple[Image, Annotation]:
    step = speed * seconds * annotation.box_3d.R[:, 0]
    box = replace(annotation.box_3d, center=annotation.box_3d.center + step)
    image = Image(id=id_, file_name=f"{id_}.png", width=640, height=360, time_s=seconds, site="s", recording="r")
    there = replace(
        annotation, id=id_, image_id=id_, box_3d=box, keypoints_3d=annotation.keypoints_3d + step,
        velocity=8.0 * annotation.box_3d.R[:, 0],
    )  # fmt: skip
    return image, there


@pytest.mark.parametrize(("speed", "findings"), [(8.0, 0), (5.0, 1)])
def test_speed_is_held_against_the_way_of_the_front_axle(speed: float, findings: int) -> None:
    annotation = lorry(20.0)
    rows = [moved(annotation, k + 1, speed, 0.2 * k) for k in range(2)]
    # While it bends, the middle of the box around both parts jumps: that is not the vehicle's way.
    image, last = rows[1]
    rows[1] = image, replace(last, box_3d=replace(last.box_3d, center=last.box_3d.center + [0.5, 0.5, 0.0]))
    file = AnnotationFile(images=tuple(i for i, _ in rows), annotations=tuple(a for _, a in rows), scheme=SKOPE33)
    assert len(list(check._check_motion("a.json", file))) == findings


def test_statistics_have_the_bend_of_articulated_vehicles_alone(tmp_path: Path) -> None:
    image = Image(id=1, file_name="1.png", width=640, height=360)
    rows = tuple(replace(lorry(bend), id=k, image_id=1, iscrowd=0, ignore_reason=None)
                 for k, bend in enumerate((-20.0, 10.0, 30.0), start=1))  # fmt: skip
    dataset = Dataset.__new__(Dataset)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stats, "_brightness", lambda *_: 100.0)
        bent = stats.split_stats(dataset, AnnotationFile(images=(image,), annotations=rows))
        none = stats.split_stats(dataset, AnnotationFile(images=(image,), annotations=()))
    assert bent.bend_deg == pytest.approx((15.0, 20.0, 25.0))
    assert "bend_deg" in bent.to_dict()
    assert "bend_deg" not in none.to_dict()
    assert any("20 (15-25)" in line for line in stats.stats_table({"test": bent}))
    assert not any("bend" in line for line in stats.stats_table({"test": none}))


def test_poses_of_articulated_vehicles_are_listed_apart() -> None:
    count = 6
    errors = PoseErrors(
        *(np.full(count, 0.1) for _ in range(5)),
        distance=np.full(count, 15.0),
        occlusion=np.zeros(count),
        bend=np.array([math.nan, math.nan, math.nan, 1.0, 30.0, 40.0]),
    )
    told = pose_summary(errors)
    assert [told["articulation"][band]["vehicles"] for band in ("0-5", "5-20", "20+")] == [1, 0, 2]
    assert told["all"]["vehicles"] == count
    lines = pose_table("poses", told)
    assert any(line.split()[:4] == ["bent", "20+", "deg", "2"] for line in lines)
    rigid = pose_summary(errors.where(~np.isfinite(errors.bend)))
    assert "articulation" not in rigid
    assert not any("bent" in line for line in pose_table("poses", rigid))
