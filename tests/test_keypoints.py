import re

import pytest

from skope import keypoints
from skope.keypoints import FLIP, INDEX, NAMES, SKELETON

EDGES = """
    0-1 1-3 3-2 2-0  0-4 1-5 2-6 3-7  4-5 6-7  4-24 5-25 24-25 6-26 7-27 26-27
    24-8 25-9 8-12 9-13 12-32 13-32 8-20 9-21 20-21  26-10 27-11 10-14 11-15 14-15 10-22 11-23 22-23
    20-16 16-18 18-22 21-17 17-19 19-23  4-28 5-29  4-30 30-6 5-31 31-7
"""
"""The skeleton as it is agreed."""


def test_the_order_of_the_groups() -> None:
    assert keypoints.K == len(set(NAMES)) == 33
    assert {i: NAMES[i] for i in (0, 4, 8, 12, 16, 20, 24, 28, 30, 32)} == {
        0: "roof_front_right",
        4: "windscreen_base_right",
        8: "headlight_outer_right",
        12: "headlight_inner_right",
        16: "wheel_front_right",
        20: "bumper_front_right",
        24: "hood_front_right",
        28: "mirror_right",
        30: "beltline_right",
        32: "front_logo",
    }
    assert keypoints.WHEELS == (16, 17, 18, 19)
    assert [NAMES[i] for i in keypoints.WHEELS] == [
        *("wheel_front_right", "wheel_front_left", "wheel_rear_right", "wheel_rear_left"),
    ]


def test_groups_run_front_right_front_left_rear_right_rear_left() -> None:
    front = {"roof_front", "windscreen_base", "headlight_outer", "headlight_inner", "wheel_front"}
    front |= {"bumper_front", "hood_front"}
    for first in range(0, 28, 4):
        stems = [re.sub("_(right|left)$", "", name) for name in NAMES[first : first + 4]]
        assert stems[0] == stems[1] in front
        assert stems[2] == stems[3] not in front
    for first in range(0, 32, 2):
        assert NAMES[first].endswith("_right")
        assert NAMES[first + 1].endswith("_left")


def test_mirroring_swaps_right_and_left_and_keeps_the_logo() -> None:
    assert list(FLIP) == [*(i ^ 1 for i in range(32)), 32]


def test_exchanging_the_ends_pairs_front_and_rear_of_the_same_side() -> None:
    pairs = {
        *((0, 2), (1, 3), (4, 6), (5, 7), (8, 10), (9, 11), (12, 14), (13, 15)),  # roof, glass, outer and inner lamps
        *((16, 18), (17, 19), (20, 22), (21, 23), (24, 26), (25, 27)),  # wheels, bumpers, hood and trunk
    }
    assert {(i, j) for i, j in enumerate(keypoints.OTHER_END) if i < j} == pairs
    assert [keypoints.OTHER_END[j] for j in keypoints.OTHER_END] == list(range(33))
    assert [keypoints.OTHER_END[i] for i in range(28, 33)] == list(range(28, 33))  # mirrors, beltline, logo


def test_the_skeleton_is_the_one_agreed_on() -> None:
    agreed = {frozenset(map(int, edge.split("-"))) for edge in EDGES.split()}
    assert {frozenset(edge) for edge in SKELETON} == agreed
    assert len(SKELETON) == len(agreed)


def test_the_skeleton_reaches_every_keypoint_in_one_piece() -> None:
    reached = {0}
    for _ in NAMES:
        reached |= {b for edge in SKELETON for a, b in (edge, edge[::-1]) if a in reached}
    assert reached == set(range(33))


def test_sigmas_and_colours_are_there_for_all() -> None:
    assert keypoints.SIGMAS == (0.05,) * 33
    assert len(keypoints.COLORS) == 33
    assert all(keypoints.COLORS[i] == keypoints.COLORS[FLIP[i]] for i in range(33))


FOREIGN_MIRRORS = {
    # The pairs that change places when an image of that scheme is mirrored, among the points that have a counterpart.
    "apollo24": {(0, 1), (4, 5), (7, 19), (8, 18), (10, 11), (14, 15), (22, 23)},
    "carfusion14": {(0, 1), (2, 3), (9, 10), (11, 12)},
    "veri20": {(0, 2), (1, 3), (10, 11), (12, 13), (14, 15)},
    "skope3d": {(0, 1), (2, 3)},
}


@pytest.mark.parametrize("scheme", keypoints.FOREIGN_SCHEMES)
def test_mapping_commutes_with_the_other_schemes_own_mirror(scheme: str) -> None:
    table = keypoints.FOREIGN_SCHEMES[scheme]
    mirror = {a: b for pair in FOREIGN_MIRRORS[scheme] for a, b in (pair, pair[::-1])}
    for foreign, ours in table.items():
        assert table[mirror.get(foreign, foreign)] == FLIP[ours]


@pytest.mark.parametrize("scheme", keypoints.FOREIGN_SCHEMES)
def test_no_two_foreign_points_share_one_of_ours(scheme: str) -> None:
    targets = list(keypoints.FOREIGN_SCHEMES[scheme].values())
    assert len(targets) == len(set(targets))
    assert set(targets) <= set(range(33))


def test_some_foreign_points_by_name() -> None:
    assert keypoints.CARFUSION14[0] == INDEX["wheel_front_right"]
    assert keypoints.VERI20[0] == INDEX["wheel_front_left"]
    assert keypoints.APOLLO24[7] == INDEX["wheel_front_left"]
    assert keypoints.SKOPE3D == {0: 0, 1: 1, 2: 2, 3: 3, 32: 32}
