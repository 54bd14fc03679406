"""Street lights: their arms reach over the road, and they light it more than what lies behind their poles."""

from dataclasses import replace

import numpy as np
import pytest
import shapely

from skope.camera.model import Camera
from skope.gen.mesh import flat
from skope.gen.render.choose_renderer import make_renderer
from skope.gen.render.daylight import Daylight
from skope.gen.render.gl import background, renderer
from skope.gen.render.gl.ground_lights import GROUND_LIGHTS, StreetLights
from skope.gen.scenery.build import Scenery, scenery
from skope.gen.scenery.street_furniture import lamp_positions, street_light
from skope.gen.towns.land_use import Layout
from skope.gen.towns.town import Town
from tests.gen.scenes import conditions, standing

NIGHT = {"sun_elevation_deg": -30.0, "street_lighting": 2.0, "gain_db": 48.0, "shutter_s": 0.04, "infrared": 0.0}
LAMP = np.array([[0.0, 0.0, 9.0, 0.0, 1.0]])
"""A street light whose arm points along +y."""


@pytest.mark.parametrize(("form", "arms"), [("curved", [1]), ("timber", [1]), ("steel", [1]), ("double", [1, -1])])
def test_arms_point_from_the_pole_to_the_lamp(form: str, arms: list[int]) -> None:
    turn = np.radians(30)
    lamps = lamp_positions([street_light(form, 2.0).moved([50.0, -20.0, 3.0], turn)])
    across = np.array([-np.sin(turn), np.cos(turn)])
    np.testing.assert_allclose(lamps[:, 3:], [side * across for side in arms], atol=0.02)
    reach = (lamps[:, :2] - [50.0, -20.0]) @ across
    assert (reach * arms > 0.5).all()


@pytest.mark.parametrize("name", ["town01", "town06"])
def test_arms_reach_toward_the_road(name: str) -> None:
    lamps, road = scenery(Town(name)).lamps, Layout.of(Town(name)).graph.road
    if Layout.of(Town(name)).graph.mirrored:
        road = shapely.affinity.scale(road, 1.0, -1.0, origin=(0, 0))
    single = lamps[np.linalg.norm(lamps[:, 3:], axis=1) > 0.5]
    before, behind = (shapely.points(single[:, :2] + side * 4.0 * single[:, 3:]) for side in (1, -1))
    nearer = shapely.distance(before, road) <= shapely.distance(behind, road)
    assert len(single) > 20
    assert nearer.mean() > 0.98


def test_less_light_falls_behind_the_pole() -> None:
    light, camera = conditions(**NIGHT), Camera.looking([0, 0, 20.0], yaw=0.0, pitch_down=1.2, size=(64, 36), fov=1.0)
    middle = np.array([0.0, 0.0, -20.0])
    lights = StreetLights.of(LAMP, camera, light, Daylight.of(light), middle)
    up = lights.on_ground()[..., 2].astype(float)
    half = GROUND_LIGHTS.lamp_map_px // 2
    # Texels are one metre wide; these are equally far from the lamp.
    behind_8, behind_6, before_6, before_8 = up[[half - 9, half - 7, half + 6, half + 8], half]
    assert behind_8 / before_8 == pytest.approx(GROUND_LIGHTS.back_light, rel=0.1)
    assert behind_6 / before_6 == pytest.approx(GROUND_LIGHTS.back_light, rel=0.1)
    # Straight below, the shield has no effect.
    even = StreetLights.of(LAMP * [1, 1, 1, 0, 0], camera, light, Daylight.of(light), middle).on_ground()[..., 2]
    assert up[half, half] == pytest.approx(float(even[half, half]), rel=0.05)


def test_images_are_brighter_before_the_lamp_than_behind_it(monkeypatch: pytest.MonkeyPatch) -> None:
    ground = flat([[(-60, -60, 0), (60, -60, 0), (60, 60, 0), (-60, 60, 0)]], "asphalt")
    camera = Camera.looking([-14, 0, 9.0], yaw=0.0, pitch_down=0.55, size=(160, 90), fov=np.radians(70))
    recording = replace(standing(camera, []), conditions=conditions(**NIGHT), signals=({},))
    left, right = [], []
    for arm in (1.0, -1.0, 0.0):
        made = Scenery(ground, (), lamps=np.array([[0.0, 0.0, 9.0, 0.0, arm]]))
        for module in (background, renderer):
            monkeypatch.setattr(module, "scenery", lambda _, made=made: made)
        rgb = make_renderer("gl", recording).render(0).rgb.astype(float)
        at = [camera.project(np.array([[0.0, y, 0.0]]))[0][0].round().astype(int) for y in (7.0, -7.0)]
        shown = [rgb[v - 2 : v + 3, u - 2 : u + 3].mean() for u, v in at]
        left.append(shown[0])
        right.append(shown[1])
    assert left[0] > right[0] + 25
    assert right[1] > left[1] + 25
    assert abs(left[2] - right[2]) < 8
