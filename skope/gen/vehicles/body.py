"""One parametric car body: from a handful of dimensions to a mesh, its wheels and the 33 keypoints by construction.

The body is a set of grids that share their edges: two sides, two caps (front, rear), deck (hood, trunk), greenhouse
and underbody. Every keypoint but the wheel centres is a vertex of one of these grids, so it lies on the surface
whatever the dimensions are. Vehicle frame: x forward, y left, z up, origin on the ground under the box's centre.
"""

from dataclasses import dataclass, fields
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skope import keypoints
from skope.gen.mesh import Mesh, box, grid, lathe, merged

Array = NDArray[np.float64]

BUMPER_LOW, BUMPER_TOP, LAMP_LOW, LAMP_MIDDLE, LAMP_TOP, SHOULDER = range(6)
"""Rows of the sides and caps, from below."""

ACROSS: Final = np.array([0.0, 0.06, 0.14, 0.28, 0.5, 0.75, 0.93, 1.0])
"""Columns of caps, deck, windscreen and roof from the middle to the left edge, as shares of the half width."""
_PLATE, _LAMP_INNER, _GLASS = 3, 4, 6
"""Columns of `ACROSS` at the plate's edge, the lamp's inner edge and the glass's edge."""


ARCH: Final = 1.16
"""Radius of a wheel arch over that of its wheel."""
PILLAR: Final = 0.1
"""Width of the A- and C-pillars at the belt, metres."""


@dataclass(frozen=True, kw_only=True)
class Shape:
    """Dimensions of a body in metres; heights above the road, x positions from the middle of the box."""

    length: float
    width: float
    height: float
    wheelbase: float
    track: float
    wheel_radius: float
    wheel_width: float
    front_overhang: float
    clearance: float
    bumper_height: float
    """Top of the bumpers' dark lower part."""
    headlight_low: float
    headlight_high: float
    taillight_low: float
    taillight_high: float
    hood_height: float
    """Edge of the hood at the front."""
    belt_height: float
    """Shoulder under the side windows."""
    trunk_height: float
    """Trailing edge of trunk or tailgate."""
    windscreen_base_x: float
    roof_front_x: float
    roof_rear_x: float
    rear_window_base_x: float
    pillar_x: float
    """The B-pillar."""
    roof_width: float
    nose_round: float
    """How far the front corners stand back behind the middle of the nose."""
    tail_round: float

    @property
    def front_axle_x(self) -> float:
        return self.length / 2 - self.front_overhang

    @property
    def rear_axle_x(self) -> float:
        return self.front_axle_x - self.wheelbase

    def wheel_centers(self) -> Array:
        """(4, 3) front right, front left, rear right, rear left, as keypoints 16-19."""
        return np.array(
            [
                [x, y, self.wheel_radius]
                for x in (self.front_axle_x, self.rear_axle_x)
                for y in (-self.track / 2, self.track / 2)
            ]
        )

    def to_dict(self) -> dict[str, float]:
        return {f.name: getattr(self, f.name) for f in fields(self)}


class Body:
    """The surfaces of a `Shape`. `mesh` is the body without wheels; `points` the 33 keypoints, (33, 3) metres."""

    def __init__(self, shape: Shape) -> None:
        self.shape = shape
        self._t = np.concatenate([-ACROSS[:0:-1], ACROSS])
        self._middle = len(ACROSS) - 1
        self._stations = self._station_shares()

    # Columns of the sides: shares of the way from the tail (0) to the nose (1), at every x where something happens.
    def _station_shares(self) -> Array:
        s = self.shape
        # The arch ends in vertical edges: one station just inside and one just outside.
        arch = s.wheel_radius * np.array([-1.18, *(ARCH * np.cos(np.linspace(0, np.pi, 9))), 1.18])
        lamp = 0.09
        xs = [
            *(s.front_axle_x + arch),
            *(s.rear_axle_x + arch),
            *(s.windscreen_base_x, s.windscreen_base_x - PILLAR, s.rear_window_base_x, s.rear_window_base_x + PILLAR),
            *(s.pillar_x - 0.06, s.pillar_x, s.pillar_x + 0.06),
        ]
        shares = [self._share_of(x) for x in xs]
        shares += [0.0, lamp * 0.6, 1 - lamp, 1.0]
        return np.unique(np.round(np.clip(shares, 0, 1), 6))

    def _share_of(self, x: float) -> float:
        tail, nose = self._ends(SHOULDER)
        return float((x - tail) / (nose - tail))

    def _column(self, x: float) -> int:
        return int(np.abs(self._stations - self._share_of(x)).argmin())

    def _ends(self, row: int) -> tuple[float, float]:
        """x of the side's rear and front edge in a row: the bumpers stand out, hood and trunk edges stand back."""
        s = self.shape
        lean = (0.05, 0.0, 0.015, 0.03, 0.05, 0.08)[row]
        return -s.length / 2 + s.tail_round + lean, s.length / 2 - s.nose_round - lean

    def _row_x(self, row: int, share: Array) -> Array:
        """x of the stations in a row: the shoulder's, shifted near the ends only, so that stations stand upright."""
        (tail, nose), (row_tail, row_nose) = self._ends(SHOULDER), self._ends(row)
        near_end = np.abs(2 * share - 1) ** 16
        return np.asarray(
            tail + (nose - tail) * share + near_end * np.where(share > 0.5, row_nose - nose, row_tail - tail)
        )

    def _row_height(self, row: int, share: Array) -> Array:
        s = self.shape
        rear = (s.clearance, s.bumper_height, s.taillight_low, 0, s.taillight_high, s.trunk_height)
        front = (s.clearance, s.bumper_height, s.headlight_low, 0, s.headlight_high, s.hood_height)
        if row == LAMP_MIDDLE:
            return (self._row_height(LAMP_LOW, share) + self._row_height(LAMP_TOP, share)) / 2
        if row != SHOULDER:
            return rear[row] + (front[row] - rear[row]) * share
        knots = [0.0, self._share_of(s.rear_window_base_x), self._share_of(s.windscreen_base_x), 1.0]
        return np.interp(share, knots, [s.trunk_height, s.belt_height, s.belt_height, s.hood_height])

    @cached_property
    def _side(self) -> Array:
        """(6 rows, stations, 3) the left side."""
        s, share = self.shape, self._stations
        out = np.zeros((6, len(share), 3))
        for row in range(6):
            x = self._row_x(row, share)
            taper = 1 - 0.09 * np.abs(2 * share - 1) ** 5
            tuck = (0.96, 1.0, 1.0, 1.0, 0.985, 0.94)[row]
            z = self._row_height(row, share)
            if row == BUMPER_LOW:
                for axle in (s.front_axle_x, s.rear_axle_x):
                    reach = (ARCH * s.wheel_radius) ** 2 - (x - axle) ** 2
                    z = np.maximum(z, np.where(reach > 0, s.wheel_radius + np.sqrt(np.maximum(reach, 0)), 0))
            else:
                z = np.maximum(z, out[row - 1, :, 2] + 0.012)
            out[row] = np.stack([x, s.width / 2 * taper * tuck, z], axis=-1)
        return out

    def _across(self, left: Array, bulge_x: float = 0.0, crown: float = 0.0) -> Array:
        """(..., 3) points of the left edge -> (..., across, 3) from right to left, bulging towards the middle."""
        t = self._t
        y = left[..., None, 1] * t
        x = left[..., None, 0] + bulge_x * (1 - np.abs(t) ** 3)
        z = left[..., None, 2] + crown * (1 - t * t)
        return np.stack(np.broadcast_arrays(x, y, z), axis=-1)

    @cached_property
    def _front(self) -> Array:
        """(6 rows, across, 3) nose, from right to left."""
        return self._across(self._side[:, -1], bulge_x=self.shape.nose_round)

    @cached_property
    def _rear(self) -> Array:
        return self._across(self._side[:, 0], bulge_x=-self.shape.tail_round)

    def _deck(self, first: int, last: int, bulge: float, crown: float) -> Array:
        """(stations, across, 3) the surface between both shoulders; the outer end bulges with its cap."""
        edge = self._side[SHOULDER, first : last + 1]
        outward = np.linspace(0, 1, len(edge)) if bulge > 0 else np.linspace(1, 0, len(edge))
        rows = [
            self._across(point, bulge_x=bulge * out, crown=crown * (1 - out))
            for point, out in zip(edge, outward, strict=True)
        ]
        return np.stack(rows)

    @cached_property
    def _hood(self) -> Array:
        last = len(self._stations) - 1
        return self._deck(self._column(self.shape.windscreen_base_x), last, self.shape.nose_round, 0.05)

    @cached_property
    def _trunk(self) -> Array:
        return self._deck(0, self._column(self.shape.rear_window_base_x), -self.shape.tail_round, 0.03)

    @cached_property
    def _roof_edge(self) -> Array:
        """(stations, 3) left edge of the roof above the belt's stations, front row last."""
        s = self.shape
        share = self._stations[self._column(s.rear_window_base_x) : self._column(s.windscreen_base_x) + 1]
        u = (share - share[0]) / (share[-1] - share[0])
        x = s.roof_rear_x + (s.roof_front_x - s.roof_rear_x) * u
        z = s.height - 0.05 - 0.05 * (2 * u - 1) ** 2
        return np.stack([x, np.full_like(u, s.roof_width / 2), z], axis=-1)

    @cached_property
    def _roof(self) -> Array:
        return np.stack([self._across(point, crown=0.05) for point in self._roof_edge])

    def _glass(self, base: Array, top: Array) -> Array:
        """(3, across, 3) a screen from its base line to the roof; the middle row stays flat."""
        return np.stack([base, (base + top) / 2, top])

    @cached_property
    def mesh(self) -> Mesh:
        """The body without wheels."""
        left_side = self._left_side_mesh()
        left_windows = self._left_window_mesh()
        mirror = self._left_mirror_mesh()
        return merged(
            [
                *(left_side, left_side.mirrored(), left_windows, left_windows.mirrored(), mirror, mirror.mirrored()),
                self._cap_mesh(self._front, "headlight", "grille", facing=1),
                self._cap_mesh(self._rear, "taillight", "paint", facing=-1),
                *(self._paint(self._hood), self._paint(self._trunk), self._paint(self._roof)),
                self._screen_mesh(self._glass(self._hood[0], self._roof[-1])),
                self._screen_mesh(self._glass(self._trunk[-1], self._roof[0])[:, ::-1]),
                self._underbody_mesh(),
            ]
        )

    def _paint(self, points: Array) -> Mesh:
        # Columns run right to left and rows to the front: reversed, the surface faces up.
        return grid(points[:, ::-1], [["paint"] * (points.shape[1] - 1)] * (points.shape[0] - 1))

    def _left_side_mesh(self) -> Mesh:
        columns = len(self._stations) - 1
        cells = [["trim"] * columns, *([["paint"] * columns] * 4)]
        for row in (LAMP_LOW, LAMP_MIDDLE):
            cells[row] = ["taillight", *["paint"] * (columns - 2), "headlight"]
        return grid(self._side[:, ::-1], [row[::-1] for row in cells])

    def _left_window_mesh(self) -> Mesh:
        first, last = self._column(self.shape.rear_window_base_x), self._column(self.shape.windscreen_base_x)
        belt, roof = self._side[SHOULDER, first : last + 1], self._roof_edge
        heights = np.array([0.0, 0.06, 0.9, 1.0])[:, None, None]
        points = belt + (roof - belt) * heights
        columns = last - first
        pillar = self._column(self.shape.pillar_x) - first
        middle = ["glass"] * columns
        for column in (0, pillar - 1, pillar, columns - 1):
            middle[column] = "paint"
        cells = [["paint"] * columns, middle, ["paint"] * columns]
        return grid(points[:, ::-1], [row[::-1] for row in cells])

    def _screen_mesh(self, points: Array) -> Mesh:
        row = ["glass"] * (len(self._t) - 1)
        row[0] = row[-1] = "paint"
        return grid(points, [row, row])

    def _cap_mesh(self, points: Array, lamp: str, middle: str, facing: int) -> Mesh:
        half = len(ACROSS) - 1
        rows: list[list[str]] = [
            ["trim"] * half,
            ["paint"] * half,
            ["paint"] * half,
            ["paint"] * half,
            ["paint"] * half,
        ]
        rows[BUMPER_TOP][:_PLATE] = ["plate"] * _PLATE
        for row in (LAMP_LOW, LAMP_MIDDLE):
            rows[row][:_LAMP_INNER] = [middle] * _LAMP_INNER
            rows[row][_LAMP_INNER:] = [lamp] * (half - _LAMP_INNER)
            if facing > 0:
                rows[row][0] = "chrome"
        cells = [[*row[::-1], *row] for row in rows]
        return grid(points if facing > 0 else points[:, ::-1], cells)

    def _left_mirror_mesh(self) -> Mesh:
        low, high = self._mirror_box()
        return box(low, high, "paint")

    def _mirror_box(self) -> tuple[Array, Array]:
        base = self._side[SHOULDER, self._column(self.shape.windscreen_base_x)]
        low = base + np.array([-0.22, -0.05, 0.05])
        return low, low + np.array([0.1, 0.24, 0.15])

    def _underbody_mesh(self) -> Mesh:
        left = self._side[BUMPER_LOW]
        right = left * [1, -1, 1]
        return grid(np.stack([right, left])[:, ::-1], [["under"] * (len(left) - 1)])

    @cached_property
    def points(self) -> Array:
        """(33, 3) the keypoints in the vehicle frame, metres."""
        m, nose = self._middle, len(self._stations) - 1
        low, high = self._mirror_box()
        left = {
            "roof_front": self._roof[-1, m + _GLASS],
            "roof_rear": self._roof[0, m + _GLASS],
            "windscreen_base": self._hood[0, m + _GLASS],
            "rear_window_base": self._trunk[-1, m + _GLASS],
            "headlight_outer": self._side[LAMP_MIDDLE, nose - 1],
            "taillight_outer": self._side[LAMP_MIDDLE, 1],
            "headlight_inner": self._front[LAMP_MIDDLE, m + _LAMP_INNER],
            "taillight_inner": self._rear[LAMP_MIDDLE, m + _LAMP_INNER],
            "wheel_front": self.shape.wheel_centers()[1],
            "wheel_rear": self.shape.wheel_centers()[3],
            "bumper_front": self._side[BUMPER_LOW, nose],
            "bumper_rear": self._side[BUMPER_LOW, 0],
            "hood_front": self._side[SHOULDER, nose],
            "trunk_rear": self._side[SHOULDER, 0],
            "mirror": np.array([(low[0] + high[0]) / 2, high[1], (low[2] + high[2]) / 2]),
            "beltline": self._side[SHOULDER, self._column(self.shape.pillar_x)],
        }
        out = np.empty((keypoints.K, 3))
        for i, name in enumerate(keypoints.NAMES):
            stem = name.removesuffix("_left").removesuffix("_right")
            if name == "front_logo":
                out[i] = self._front[LAMP_MIDDLE, m]
            else:
                out[i] = left[stem] * ([1, -1, 1] if name.endswith("_right") else [1, 1, 1])
        return out


def wheel_mesh(radius: float, width: float) -> Mesh:
    """A wheel about the y axis, its outer face at y = width / 2 (the left side of a vehicle)."""
    half, rim = width / 2, radius * 0.66
    tyre = lathe(
        [
            (-half, 0.0),
            (-half, radius * 0.93),
            (-half * 0.6, radius),
            (half * 0.6, radius),
            (half, radius * 0.93),
            (half, rim),
        ],
        ["under", "tyre", "tyre", "tyre", "tyre"],
        24,
        "y",
    )
    angle = np.linspace(0, 2 * np.pi, 21)
    ring = np.stack([rim * np.sin(angle), np.full_like(angle, half - 0.02), rim * np.cos(angle)], axis=-1)
    hub = np.stack([0.25 * rim * np.sin(angle), np.full_like(angle, half - 0.005), 0.25 * rim * np.cos(angle)], axis=-1)
    center = np.tile([0.0, half, 0.0], (21, 1))
    spokes = ["rim" if i % 4 < 2 else "under" for i in range(20)]
    lip = grid(np.stack([ring * [1, 0, 1] + [0, half, 0], ring]), [["rim"] * 20])
    face = grid(np.stack([ring, hub, center]), [spokes, ["rim"] * 20])
    return merged([tyre, lip, face])
