"""Cameras from marked points, lengths, parallel lines and verticals, against closed forms and OpenCV."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

from skope.camera.calibrate import calibrate
from skope.camera.evidence import (
    MARKING_ERRORS,
    CameraPrior,
    Evidence,
    MarkedLength,
    MarkedPoint,
    ParallelLines,
    Vertical,
    marked_points,
)
from skope.camera.evidence_terms import ResidualTerm
from skope.camera.ground_plane import intersect_ground
from skope.camera.model import Camera, Distortion
from skope.camera.uncertain_camera import CAMERA_PARAMETERS, radius_of, values_of
from skope.camera.weighted_fit import WeightedFit, fit_terms
from skope.errors import UserError
from skope.types import Array

SIZE = (1280, 720)
LENS = Distortion("brown", (-0.1, 0.0, 0.0, 0.0))
CAMERA = Camera.looking([12.0, -30.0, 7.0], yaw=1.1, pitch_down=0.3, size=SIZE, fov=2 * math.atan(0.5), distortion=LENS)
"""Its focal length and its distortion are those that cameras are taken to have in the mean."""
PIXELS = np.array([[200, 300], [1100, 330], [640, 420], [150, 650], [1150, 600], [600, 690], [900, 250], [420, 500.0]])


def on_road(pixels: Array, camera: Camera = CAMERA) -> Array:
    return intersect_ground(camera, pixels)


def known(*names: str, sigma: float = 1e-7) -> CameraPrior:
    """That parameters are those of `CAMERA`."""
    yaw, pitch, roll = CAMERA.angles
    values = dict(
        zip(
            CAMERA_PARAMETERS,
            [math.log(CAMERA.K[0, 0]), LENS.coefficients[0], *CAMERA.position, pitch, roll, yaw],
            strict=True,
        )
    )
    return CameraPrior(names, np.array([values[name] for name in names]), sigma**2 * np.eye(len(names)))


@pytest.mark.parametrize("count", [4, 6, 8])
def test_exact_points_give_the_camera(count: int) -> None:
    found = calibrate(Evidence(SIZE, points=marked_points(PIXELS[:count], on_road(PIXELS[:count]))))
    assert found.camera.position == pytest.approx(CAMERA.position, abs=1e-3)
    assert found.camera.K[0, 0] == pytest.approx(CAMERA.K[0, 0], rel=1e-4)
    assert found.outliers == ()
    assert max(residual.value for residual in found.residuals) < 1e-3


def test_the_pose_is_opencvs_where_the_lens_is_known() -> None:
    rng = np.random.default_rng(3)
    places = on_road(PIXELS) + np.column_stack([np.zeros((8, 2)), rng.uniform(0, 2, 8)])
    camera = replace(CAMERA, distortion=Distortion())
    pixels = camera.project(places)[0] + rng.normal(0, 1.5, (8, 2))
    # Places that are known exactly, so that both minimise the distances in the image.
    points = tuple(MarkedPoint(a, b, sigma_m=1e-6, sigma_z_m=1e-6) for a, b in zip(pixels, places, strict=True))
    lens = CameraPrior(("focal", "k1"), np.array([math.log(CAMERA.K[0, 0]), 0.0]), 1e-14 * np.eye(2))
    prior = CameraPrior(("roll",), np.zeros(1), np.array([[1e6]]))
    found = calibrate(Evidence(SIZE, points=points, priors=(lens, prior))).camera
    _, turn, shift = cv2.solvePnP(places, pixels, camera.K, None)
    turn, shift = cv2.solvePnPRefineLM(places, pixels, camera.K, None, turn, shift)
    theirs = -cv2.Rodrigues(turn)[0].T @ shift.ravel()
    # They know nothing of how cameras hang (roll of 0 with 0.2 rad), which moves ours by little.
    assert found.position == pytest.approx(theirs, abs=0.02)


def test_a_length_gives_the_height_by_similar_triangles() -> None:
    """On level ground all distances grow with the camera's height."""
    ends = np.array([[400.0, 500.0], [900.0, 520.0]])
    unit = Camera.looking([0, 0, 1.0], yaw=0, pitch_down=0.3, size=SIZE, fov=2 * math.atan(0.5), distortion=LENS)
    a, b = intersect_ground(unit, ends)
    metres = 5.5
    found = calibrate(
        Evidence(SIZE, lengths=(MarkedLength(ends, metres),), priors=(known("focal", "k1", "pitch", "roll"),))
    )
    assert found.camera.position[2] == pytest.approx(metres / np.linalg.norm(b - a), rel=1e-5)
    # 0.05 m of 5.5, and ends that are 1.5 px off.
    slope = np.linalg.norm(
        intersect_ground(found.camera, ends + [[0, 0], [1, 0]])[1] - intersect_ground(found.camera, ends)[1]
    )
    z = found.parameters.index("z")
    height_sigma = math.sqrt(found.covariance[z, z])
    assert height_sigma > found.camera.position[2] * 0.05 / metres
    assert height_sigma < found.camera.position[2] * math.hypot(0.05, 6 * slope) / metres


def test_verticals_give_tilt_and_roll() -> None:
    """Without a distance: the directions of verticals in the image are those of their vanishing point."""
    feet = on_road(PIXELS[[0, 1, 2, 3, 4]])
    tops = CAMERA.project(feet + [0, 0, 3.0])[0]
    verticals = tuple(Vertical(np.stack([foot, top])) for foot, top in zip(PIXELS[[0, 1, 2, 3, 4]], tops, strict=True))
    found = calibrate(
        Evidence(SIZE, verticals=verticals, priors=(known("focal", "k1"), CameraPrior.of_height(7.0, 0.01)))
    )
    _, pitch, roll = found.camera.angles
    assert pitch == pytest.approx(0.3, abs=1e-4)
    assert roll == pytest.approx(0.0, abs=1e-4)
    high = calibrate(
        Evidence(SIZE, verticals=tuple(replace(one, metres=3.0) for one in verticals), priors=(known("focal", "k1"),))
    )
    assert high.camera.position[2] == pytest.approx(7.0, abs=1e-2)


def test_parallel_lines_and_lengths_alone_give_distances() -> None:
    begin = on_road(np.array([[350.0, 640.0], [620.0, 640.0], [880.0, 640.0]]))
    ahead = np.array([math.cos(1.1), math.sin(1.1), 0.0])
    lines = np.stack([CAMERA.project(np.stack([place, place + 14 * ahead]))[0] for place in begin])
    ends = [np.stack([place, place + 5 * ahead]) for place in begin]
    ends.append(begin[[0, 2]])
    lengths = tuple(MarkedLength(CAMERA.project(pair)[0], float(np.linalg.norm(pair[1] - pair[0]))) for pair in ends)
    found = calibrate(Evidence(SIZE, lengths=lengths, parallels=(ParallelLines(lines),)))
    pair = np.array([[250.0, 420.0], [1000.0, 480.0]])
    true = float(np.linalg.norm(np.diff(on_road(pair), axis=0)))
    assert np.linalg.norm(np.diff(found.places(pair), axis=0)) == pytest.approx(true, rel=0.02)
    assert not {"x", "y", "yaw"} & set(found.parameters)


def test_four_points_that_suit_two_cameras_give_the_likelier_one_and_hold_both() -> None:
    """Seen by a bent wide lens from 5 m; the search from all points ends at one of 4 times the length, 9 m high."""
    pixels = np.array([[795.2, 283.6], [176.0, 661.4], [433.7, 623.9], [950.3, 550.2]])
    places = np.array([[-45.92, 12.76, 0.0], [-23.39, 18.91, -0.06], [-26.03, 20.18, 0.03], [-31.2, 23.92, -0.01]])
    found = calibrate(Evidence(SIZE, points=marked_points(pixels, places)))
    truth = [math.log(640 / math.tan(math.radians(40))), -0.2, -22.51, 26.645, 5.0]
    off = values_of(found.camera)[:5] - truth
    assert (np.abs(off) < 2 * np.sqrt(np.diag(found.covariance)[:5])).all()
    assert abs(off[4]) < 0.5
    assert "a second camera fits the points" in found.warnings[0]


def test_where_no_weights_can_be_told_there_is_no_fit() -> None:
    """As where a camera stands on its head and sees a mark where its lens ends."""
    term = ResidualTerm("point", "", lambda _: np.zeros(2), lambda _: np.array([[1.0, 2.0], [2.0, 1.0]]))
    assert fit_terms([term], values_of(CAMERA), CAMERA_PARAMETERS, SIZE).cost == math.inf


def test_a_wrong_point_is_named_and_left_out() -> None:
    places = on_road(PIXELS)
    places[2] += [3.0, 2.0, 0.0]
    found = calibrate(Evidence(SIZE, points=marked_points(PIXELS, places, "abcdefgh")))
    assert found.outliers == ("c",)
    assert found.camera.position == pytest.approx(CAMERA.position, abs=0.02)


def test_points_of_which_either_may_be_wrong_are_both_named() -> None:
    """Two marks of one place that are 1 m apart: the other four points do not tell which of them is wrong."""
    pixels = np.concatenate([PIXELS[:6], PIXELS[:1] + 2])
    places = on_road(pixels)
    places[6] += [0.8, 0.6, 0.0]
    found = calibrate(
        Evidence(SIZE, points=marked_points(pixels[[0, 1, 2, 3, 6, 5]], places[[0, 1, 2, 3, 6, 5]], "abcdef"))
    )
    assert len(found.outliers) == 1
    other = ({"a", "e"} - set(found.outliers)).pop()
    assert any(f"nearly as well without {other}" in line for line in found.warnings)


def test_marks_that_contradict_each_other_make_all_less_certain() -> None:
    """Five points on a road that bulges by a metre: no camera agrees, and none of them is the wrong one."""
    places = on_road(PIXELS[:5])
    flat = calibrate(Evidence(SIZE, points=marked_points(PIXELS[:5], places)))
    places[[0, 2, 4], 2] += [1.0, -1.0, 1.0]
    bulging = calibrate(Evidence(SIZE, points=marked_points(PIXELS[:5], places)))
    assert not any("contradict each other" in line for line in flat.warnings)
    assert any("contradict each other" in line for line in bulging.warnings)
    assert bulging.place_error([640.0, 420.0]) > 2 * flat.place_error([640.0, 420.0])


def test_two_wrong_points_of_ten_are_left_out() -> None:
    pixels = np.concatenate([PIXELS, [[750.0, 330.0], [300.0, 380.0]]])
    rng = np.random.default_rng(8)
    places = on_road(pixels) + rng.normal(0, 0.05, (10, 3)) * [1, 1, 0]
    places[1] += [2.0, -3.0, 0.0]
    places[7] += [-2.5, 1.0, 0.0]
    found = calibrate(Evidence(SIZE, points=marked_points(pixels, places, "abcdefghij")))
    assert found.outliers == ("b", "h")
    assert np.linalg.norm(found.camera.position - CAMERA.position) < 0.5


def test_where_another_point_may_be_the_wrong_one_places_are_less_known() -> None:
    """The camera without the other one counts too, by how likely it is."""
    pixels = np.concatenate([PIXELS[:4], PIXELS[:1] + 2, PIXELS[5:6]])
    places = on_road(pixels)
    places[4] += [0.8, 0.6, 0.0]
    points = marked_points(pixels, places, "abcdef")
    found = calibrate(Evidence(SIZE, points=points))
    (wrong,) = found.outliers
    sure = calibrate(Evidence(SIZE, points=tuple(point for point in points if point.name != wrong)), check=False)
    other = ({"a", "e"} - {wrong}).pop()
    rival = calibrate(Evidence(SIZE, points=tuple(point for point in points if point.name != other)), check=False)
    at = np.array([[250.0, 330.0]])
    apart = (rival.places(at) - sure.places(at))[0, :2]
    assert np.linalg.norm(apart) > 0.5
    assert found.places(at) == pytest.approx(sure.places(at), abs=0.02)
    # Told are points from a probability of 5% on: a mixture of two that are d apart has the variance p d^2 more.
    added = apart @ (found.place_covariance(at) - sure.place_covariance(at))[0] @ apart / np.linalg.norm(apart) ** 2
    assert any(f"without {other}" in line for line in found.warnings)
    assert 0.05 * np.linalg.norm(apart) ** 2 < added < np.linalg.norm(apart) ** 2


def test_what_nothing_tells_is_known_badly_not_exactly() -> None:
    J = np.array([[1.0, 0.0, 0.0], [0.0, 2.0, 0.0]])
    fit = WeightedFit(np.zeros(8), 0.0, J)
    C = fit.covariance(np.ones(3))
    assert np.diag(C)[:2] == pytest.approx([1.0, 0.25])
    assert C[2, 2] >= 1e6


def test_stated_errors_are_those_of_repeated_calibrations() -> None:
    rng, at = np.random.default_rng(5), np.array([[700.0, 300.0], [300.0, 600.0]])
    found, stated = [], []
    for _ in range(40):
        off = rng.normal(0, [0.1, 0.1, MARKING_ERRORS.height_m], (8, 3))
        points = marked_points(PIXELS + rng.normal(0, 1.5, (8, 2)), on_road(PIXELS) + off)
        one = calibrate(Evidence(SIZE, points=points), start=CAMERA, check=False)
        found.append(one.places(at))
        stated.append(one.place_error(at))
    within = np.linalg.norm(np.array(found)[..., :2] - on_road(at)[:, :2], axis=-1) <= np.array(stated)
    assert within.mean() >= 0.8
    assert np.median(stated) < 0.6  # and not by saying too much
    assert np.isnan(one.place_error([640.0, -200.0]))


def test_radii_that_hold_a_share() -> None:
    assert radius_of(0.04 * np.eye(2), 0.9) == pytest.approx(0.2 * math.sqrt(-2 * math.log(0.1)), rel=1e-3)
    assert radius_of(np.diag([0.0, 0.09]), 0.9) == pytest.approx(0.3 * 1.6449, rel=0.02)
    C = np.array([[0.5, 0.3], [0.3, 0.4]])
    drawn = np.random.default_rng(0).multivariate_normal([0, 0], C, 200_000)
    assert (np.linalg.norm(drawn, axis=1) < radius_of(C, 0.9)).mean() == pytest.approx(0.9, abs=0.003)


@pytest.mark.parametrize(
    ("evidence", "said"),
    [
        (Evidence(SIZE), "the scale is unknown"),
        (Evidence(SIZE, points=marked_points(PIXELS[:3], on_road(PIXELS[:3]))), "expected 4 points or more, got 3"),
    ],
)
def test_too_little_is_refused(evidence: Evidence, said: str) -> None:
    with pytest.raises(UserError, match=said):
        calibrate(evidence)


def test_fields_are_named() -> None:
    with pytest.raises(UserError, match="lengths 'lane': metres: expected a number above 0"):
        MarkedLength(np.zeros((2, 2)), -1.0, name="lane")
    with pytest.raises(UserError, match="points: pixel: expected 2 finite numbers"):
        MarkedPoint(np.array([1.0]), np.zeros(3))
    with pytest.raises(UserError, match="expected two lines or more, got 1"):
        ParallelLines(np.zeros((1, 2, 2)))


def test_points_that_leave_much_open_are_told() -> None:
    few = calibrate(Evidence(SIZE, points=marked_points(PIXELS[:5], on_road(PIXELS[:5]))))
    assert any("cannot be found" in line for line in few.warnings)
    row = np.column_stack([np.linspace(100, 1200, 6), np.linspace(500, 540, 6)])
    row[2] += [0, 3.0]
    places = on_road(row)
    assert any(
        "nearly on one line" in line for line in calibrate(Evidence(SIZE, points=marked_points(row, places))).warnings
    )
