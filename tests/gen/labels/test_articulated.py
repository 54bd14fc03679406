"""Labels of articulated vehicles: which points turn with the trailer, the box around both parts, the angle."""

import math
from dataclasses import replace

import numpy as np
import pytest

from skope import keypoints
from skope.camera.model import Camera
from skope.dataset import coco
from skope.gen.labels.annotate import annotate
from skope.gen.labels.ignore_rules import Rules
from skope.gen.labels.world_keypoints import world_keypoints
from skope.gen.render.choose_renderer import make_renderer
from skope.gen.render.frame import RenderedFrame
from skope.gen.render.lit_lamps import lit_lamps
from skope.gen.scene.recording import LAMP_BITS, Recording
from skope.gen.vehicles.fleet import fleet
from skope.gen.vehicles.model import ON_TRAILER
from skope.schema import Annotation
from tests.gen.rays import cast, vehicle_triangles
from tests.gen.scenes import standing

CAMERA = Camera.looking([300.0, -205.0, 9.0], yaw=math.pi / 2, pitch_down=0.35, size=(640, 360), fov=math.radians(80))
LORRY = ("articulated_curtain", 303.0, -188.0, 0.2)
MODELS = [name for name, entry in fleet().items() if entry.vehicle.trailer]


def scene(bend_deg: float, model: str = LORRY[0]) -> Recording:
    return standing(CAMERA, [(model, *LORRY[1:])], bend=math.radians(bend_deg))


def labelled(renderer: str, bend_deg: float) -> tuple[Recording, RenderedFrame, Annotation]:
    recording = scene(bend_deg)
    view = make_renderer(renderer, recording).render(0)
    (annotation,), _ = annotate(recording.moment(0), view, CAMERA, Rules(), 1)
    return recording, view, annotation


def test_front_points_ride_on_the_tractor_and_rear_ones_on_the_trailer() -> None:
    on = {keypoints.NAMES[k] for k in np.flatnonzero(ON_TRAILER)}
    stems = {name.removesuffix("_left").removesuffix("_right") for name in on}
    lamps = {"taillight_outer", "taillight_inner"}
    assert stems == lamps | {"roof_rear", "rear_window_base", "wheel_rear", "bumper_rear", "trunk_rear"}
    assert len(on) == 14


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("localizer", ["rigid", "trilateration"])
def test_points_of_the_trailer_turn_about_the_hinge(model: str, localizer: str) -> None:
    vehicle, bend = fleet()[model].vehicle, 0.5
    straight = world_keypoints(scene(0.0, model).moment(0), localizer).points[0]
    bent = world_keypoints(scene(math.degrees(bend), model).moment(0), localizer).points[0]
    np.testing.assert_allclose(bent[~ON_TRAILER], straight[~ON_TRAILER], atol=1e-6)
    yaw = LORRY[3]
    hinge = np.array(LORRY[1:3]) + vehicle.trailer.hinge[0] * np.array([math.cos(yaw), math.sin(yaw)])
    c, s = math.cos(bend), math.sin(bend)
    turned = (straight[ON_TRAILER, :2] - hinge) @ np.array([[c, s], [-s, c]]) + hinge
    np.testing.assert_allclose(bent[ON_TRAILER, :2], turned, atol=1e-6)
    np.testing.assert_allclose(bent[ON_TRAILER, 2], straight[ON_TRAILER, 2], atol=1e-6)


@pytest.mark.parametrize("bend_deg", [0.0, 30.0, -30.0])
def test_the_box_holds_both_parts_tightly_along_the_tractors_axes(bend_deg: float) -> None:
    recording, _, annotation = labelled("gl", bend_deg)
    assert annotation.articulation == pytest.approx(math.radians(bend_deg))
    box = annotation.box_3d
    assert box.yaw == pytest.approx(LORRY[3])
    corners = vehicle_triangles(recording.moment(0), 0).reshape(-1, 3)
    own = (corners - box.center) @ box.R
    mirrors = np.array([0.02, 0.35, 0.02])
    assert (np.abs(own) < box.size_lwh / 2 + mirrors).all()
    assert (np.ptp(own, axis=0) > box.size_lwh - 0.2).all()
    if bend_deg == 0:
        np.testing.assert_allclose(box.size_lwh, [16.5, 2.5, 4.0], atol=0.02)
    assert annotation.distance == pytest.approx(np.linalg.norm(box.center - CAMERA.position))


@pytest.mark.parametrize("renderer", ["gl", "pybullet"])
def test_pixels_of_both_parts_are_the_one_vehicles(renderer: str) -> None:
    """Ids and silhouette against rays to both parts."""
    recording, view, annotation = labelled(renderer, 30.0)
    triangles = vehicle_triangles(recording.moment(0), 0)
    rng = np.random.default_rng(3)
    low, size = annotation.bbox[:2], annotation.bbox[2:]
    places = np.floor(low + rng.uniform(0, 1, (400, 2)) * size) + 0.5
    rays, _ = CAMERA.rays(places)
    hits, _ = cast(CAMERA.position, rays @ CAMERA.T_camera_world[:3, :3], triangles)
    columns, rows = (places - 0.5).astype(int).T
    shown = view.ids[rows, columns] == 1
    silhouette = view.silhouettes[0].mask[rows - view.silhouettes[0].y, columns - view.silhouettes[0].x]
    assert 100 < np.isfinite(hits).sum() < 380
    assert (silhouette == np.isfinite(hits)).mean() > 0.98
    assert (shown == np.isfinite(hits)).mean() > 0.97
    seen = shown & np.isfinite(hits)
    assert np.median(np.abs(view.depth[rows, columns] - hits)[seen]) < 0.01


def test_visibility_of_a_bent_lorry_is_that_of_rays() -> None:
    for bend_deg in (35.0, -35.0):
        recording, _, annotation = labelled("gl", bend_deg)
        tested = world_keypoints(recording.moment(0), "rigid").tested[0]
        away = np.linalg.norm(tested - CAMERA.position, axis=1)
        hits, _ = cast(
            CAMERA.position, (tested - CAMERA.position) / away[:, None], vehicle_triangles(recording.moment(0), 0)
        )
        v = annotation.keypoints[:, 2]
        expected = np.where(away - hits > 0.05, 1, 2)
        assert (v[v > 0] == expected[v > 0]).mean() > 0.95
        assert {1, 2} <= set(v.astype(int).tolist())


def test_the_trailers_lamps_shine_where_the_trailer_is() -> None:
    recording = scene(40.0)
    moment = replace(recording.moment(0), lamps=np.array([LAMP_BITS["low_beam"]], dtype=np.uint8))
    lit = [lamp.center for lamp in lit_lamps(moment) if lamp.color[0] > 3 * lamp.color[1]]
    points = world_keypoints(moment, "rigid").points[0]
    for side in ("right", "left"):
        middle = points[[keypoints.INDEX[f"taillight_{end}_{side}"] for end in ("outer", "inner")]].mean(axis=0)
        assert min(np.linalg.norm(center - middle) for center in lit) < 0.3


def test_the_angle_survives_the_file_and_is_not_written_for_others() -> None:
    _, _, annotation = labelled("gl", 30.0)
    row = coco.annotation_to_dict(annotation)
    assert coco.annotation_from_dict(row).articulation == annotation.articulation
    recording = standing(CAMERA, [("sedan", 300.0, -193.0, 0.2)])
    (other,), _ = annotate(recording.moment(0), make_renderer("gl", recording).render(0), CAMERA, Rules(), 1)
    assert "articulation" not in coco.annotation_to_dict(other)


@pytest.mark.parametrize("angle", [4.0, float("nan"), True, "0.1"])
def test_a_wrong_angle_is_named(angle: object) -> None:
    _, _, annotation = labelled("gl", 30.0)
    with pytest.raises(Exception, match="articulation"):
        coco.annotation_from_dict({**coco.annotation_to_dict(annotation), "articulation": angle})
