"""Poses of bystanders: riders of two-wheelers, which SUMO moves, and pedestrians on the sidewalks."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import shapely
from shapely import LineString, Polygon
from shapely.ops import unary_union

from skope.gen.bystanders import bystander
from skope.gen.bystanders.bystander import Bystander, build_bystander
from skope.gen.bystanders.people import Look, lowered
from skope.gen.bystanders.riding import standing_lean
from skope.gen.bystanders.walking import sunk
from skope.gen.traffic.sumo import SumoRider
from skope.types import Array


@dataclass(frozen=True)
class SidewalkCrowds:
    """Numbers and positions of pedestrians on sidewalks."""

    gravity: float = 9.81
    """Acceleration of gravity, m/s^2."""
    per_100_m: float = 2.2
    """Mean number of unlabelled pedestrians per 100 m of sidewalk."""
    standing_share: float = 0.15
    """Fraction of the unlabelled pedestrians who stand still."""
    elbow_room_m: float = 0.4
    """Minimum distance from a pedestrian's middle to the side of a parked vehicle, metres."""
    groups_per_100_m: tuple[float, float] = (0.8, 12.0)
    """Range of the mean number of groups of labelled pedestrians per 100 m of sidewalk, sampled for each recording."""
    group_shares: tuple[float, float, float, float] = (0.62, 0.24, 0.09, 0.05)
    """Fractions of the groups that have one, two, three and four people."""
    running_share: float = 0.04
    """Fraction of the groups that run."""
    largest_offset_m: float = 0.65
    """Maximum distance of labelled pedestrians from the middle of a sidewalk, metres."""
    circle_m: float = 0.55
    """Distance of people who stand together from the centre of their group, metres."""
    abreast_m: float = 0.64
    """Distance between two people who walk side by side, metres."""
    offset_sigma_m: float = 0.45
    """Standard deviation of the distance of unlabelled pedestrians from the middle of the sidewalk, metres."""


SIDEWALK_CROWDS: Final = SidewalkCrowds()


@dataclass(frozen=True, eq=False)
class PlacedBystander:
    """A bystander and its pose at one time."""

    body: Bystander
    T_world_body: Array
    """(4, 4) pose of the body in the world."""
    velocity: Array
    """(3,) velocity in the world, m/s."""
    travelled: float
    """Distance since the bystander appeared, metres; determines the phase of its steps or wheels."""

    @property
    def part_poses(self) -> Array:
        """Return the poses (P, 4, 4) of the moving parts in the world."""
        return self.T_world_body @ self.body.pose(self.travelled, float(np.linalg.norm(self.velocity)))


class Riders:
    """Tracker of SUMO's riders: the distance that each has travelled, and its lean in curves."""

    def __init__(
        self, kinds: Mapping[str, str], rng_of: Callable[[str], np.random.Generator], *, jointed: bool = False
    ) -> None:
        """Create a tracker without riders.

        Args:
            kinds: Kind of each rider, by name.
            rng_of: Function that returns the generator of the appearance of the rider with a given name.
            jointed: Whether the bodies are the jointed ones of labelled riders.
        """
        self._kinds, self._rng_of, self._jointed = kinds, rng_of, jointed
        self._bodies: dict[str, Bystander] = {}
        self._travelled: dict[str, float] = {}
        self._yaw: dict[str, float] = {}
        self._lean: dict[str, float] = {}

    def follow(self, ridden: Mapping[str, SumoRider], dt: float) -> dict[str, PlacedBystander]:
        """Return the riders by name, `dt` seconds after the last call, at their positions in SUMO (`ridden`)."""
        return {name: self._place(name, state, dt) for name, state in sorted(ridden.items())}

    def _place(self, name: str, state: SumoRider, dt: float) -> PlacedBystander:
        if name not in self._bodies:
            kind, rng = self._kinds[name], self._rng_of(name)
            look = bystander.draw_look(kind, rng) if self._jointed else Look.drawn(rng)
            self._bodies[name] = build_bystander(kind, look.to_dict())
            self._travelled[name], self._yaw[name], self._lean[name] = 0.0, state.yaw, 0.0
        turn = math.remainder(state.yaw - self._yaw[name], 2 * math.pi) / dt
        self._yaw[name] = state.yaw
        self._travelled[name] += state.speed * dt
        lean = math.atan(float(np.clip(turn * state.speed / SIDEWALK_CROWDS.gravity, -0.7, 0.7)))
        self._lean[name] += (lean - self._lean[name]) * dt / (0.3 + dt)
        to_the_left = self._lean[name] + (standing_lean(state.speed) if self._jointed else 0.0)
        T = _frame(state.position, state.yaw, state.pitch, -to_the_left)
        return PlacedBystander(self._bodies[name], T, state.speed * T[:3, 0], self._travelled[name])


@dataclass(frozen=True, eq=False)
class _Walk:
    """Walk of one pedestrian, back and forth."""

    body: Bystander
    path: Array
    """(N, 3) centre line of a sidewalk, world, metres."""
    start: float
    """Position along the path at time 0, metres."""
    speed: float
    """Speed along the path, m/s; negative for backwards, 0 for a standing pedestrian."""
    aside: float
    """Distance to the right of the path, metres."""
    facing: float
    """Heading of a standing pedestrian relative to the path, radians."""

    def meets(self, obstacles: shapely.Geometry) -> bool:
        """Return whether the walk meets an obstacle in either direction."""
        if obstacles.is_empty:
            return False
        line = LineString(self.path[:, :2])
        return any(line.offset_curve(side * self.aside).intersects(obstacles) for side in (-1, 1))


class Walkers:
    """Pedestrians who walk back and forth on sidewalks; their positions depend on the time only."""

    def __init__(self, paths: Sequence[Array], rng: np.random.Generator, parked: Sequence[Polygon] = ()) -> None:
        """Sample pedestrians.

        `paths` are centre lines (N, 3) of sidewalks, and `parked` footprints of vehicles, metres.
        """
        self._walks: list[_Walk] = []
        standing = unary_union([footprint.buffer(SIDEWALK_CROWDS.elbow_room_m) for footprint in parked])
        for path in paths:
            length = _length(path)
            for _ in range(rng.poisson(length / 100 * SIDEWALK_CROWDS.per_100_m)):
                look = Look.drawn(rng)
                speed = float(rng.normal(1.35, 0.2)) * (1 if look.height > 1.5 else 0.85) * rng.choice([-1, 1])
                stands = rng.random() < SIDEWALK_CROWDS.standing_share
                walk = _Walk(
                    build_bystander("pedestrian", look.to_dict()),
                    path,
                    float(rng.uniform(0, length)),
                    0.0 if stands else speed,
                    float(rng.normal(0, SIDEWALK_CROWDS.offset_sigma_m)),
                    float(rng.uniform(-math.pi, math.pi)) if stands else 0.0,
                )
                # A pedestrian who would walk into a parked vehicle is moved to the middle of the sidewalk, or omitted.
                free = [way for way in (walk, replace(walk, aside=0.0)) if not way.meets(standing)]
                self._walks += free[:1]

    @classmethod
    def labelled(
        cls, paths: Sequence[Array], rng: np.random.Generator, parked: Sequence[Polygon] = (), *, raining: bool = False
    ) -> "Walkers":
        """Sample labelled pedestrians: few or many, alone and in groups that walk or stand together.

        Args:
            paths: Centre lines of sidewalks, (N, 3) each, world, metres.
            rng: Random generator for all of them.
            parked: Footprints of parked vehicles, metres.
            raining: Whether it rains, which makes many pedestrians carry umbrellas.
        """
        out = cls((), rng)
        standing = unary_union([footprint.buffer(SIDEWALK_CROWDS.elbow_room_m) for footprint in parked])
        crowd = math.exp(
            rng.uniform(math.log(SIDEWALK_CROWDS.groups_per_100_m[0]), math.log(SIDEWALK_CROWDS.groups_per_100_m[1]))
        )
        for path in paths:
            length = _length(path)
            for _ in range(rng.poisson(length / 100 * crowd)):
                group = [walk for walk in _group(path, length, rng, raining) if not walk.meets(standing)]
                out._walks += group
        return out

    def at(self, time: float) -> dict[str, PlacedBystander]:
        """Return all pedestrians by name at a time in seconds."""
        return {f"p{i:04d}": _place_walker(walk, time) for i, walk in enumerate(self._walks)}


def _group(path: Array, length: float, rng: np.random.Generator, raining: bool) -> list[_Walk]:
    """Sample one or more people who walk side by side, or stand together and face each other."""
    count = 1 + int(rng.choice(len(SIDEWALK_CROWDS.group_shares), p=SIDEWALK_CROWDS.group_shares))
    start, aside = float(rng.uniform(0, length)), float(rng.normal(0, SIDEWALK_CROWDS.offset_sigma_m))
    stands, way = rng.random() < SIDEWALK_CROWDS.standing_share, float(rng.choice([-1, 1]))
    # There are walls at the ends of a sidewalk.
    room = SIDEWALK_CROWDS.largest_offset_m - (
        (SIDEWALK_CROWDS.circle_m if stands else SIDEWALK_CROWDS.abreast_m / 2) if count > 1 else 0.0
    )
    aside = min(max(aside, -room), room)
    speed = way * float(
        rng.choice(
            [rng.normal(1.35, 0.2), rng.normal(2.7, 0.3)],
            p=[1 - SIDEWALK_CROWDS.running_share, SIDEWALK_CROWDS.running_share],
        )
    )
    facing = float(rng.uniform(-math.pi, math.pi))
    out = []
    for k in range(count):
        body = build_bystander("pedestrian", bystander.draw_look("pedestrian", rng, raining=raining).to_dict())
        if stands and count > 1:
            around = 2 * math.pi * k / count
            ahead, beside = SIDEWALK_CROWDS.circle_m * math.cos(around), SIDEWALK_CROWDS.circle_m * math.sin(around)
            facing = math.atan2(beside, -ahead)
        elif stands:
            ahead = beside = 0.0
        else:  # in pairs, since a sidewalk is narrow
            ahead, beside = (
                float(0.15 * rng.normal()) - 0.9 * (k // 2),
                SIDEWALK_CROWDS.abreast_m * (k % 2 - 0.5 * (count > 1)),
            )
        speed_of = 0.0 if stands else speed
        out.append(_Walk(body, path, start + ahead, speed_of, aside + beside, facing if stands else 0.0))
    return out


def _place_walker(walk: _Walk, time: float) -> PlacedBystander:
    length, travelled = _length(walk.path), abs(walk.speed) * time
    # Pedestrians turn around at the ends of the path.
    lap = (walk.start + walk.speed * time) % (2 * length)
    s, way = (lap, 1.0) if lap < length else (2 * length - lap, -1.0)
    way *= math.copysign(1.0, walk.speed)
    marks = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(walk.path, axis=0), axis=1))])
    here, ahead = (np.array([np.interp(t, marks, c) for c in walk.path.T]) for t in (s, s + 0.4 * way))
    before = np.array([np.interp(s - 0.4 * way, marks, c) for c in walk.path.T])
    along = ahead - before
    yaw = math.atan2(along[1], along[0])
    # The offset is to the right of the path's direction, whichever way the pedestrian walks.
    right = np.array([along[1], -along[0], 0.0]) * way / max(float(np.hypot(along[0], along[1])), 1e-9)
    position = here + walk.aside * right
    look, speed = walk.body.look, abs(walk.speed)
    position[2] -= sunk(look, travelled, speed) if walk.body.jointed else lowered(look, travelled)
    T = _frame((float(position[0]), float(position[1]), float(position[2])), yaw + walk.facing, 0.0, 0.0)
    return PlacedBystander(walk.body, T, abs(walk.speed) * np.array([math.cos(yaw), math.sin(yaw), 0.0]), travelled)


def _length(path: Array) -> float:
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


def _frame(position: tuple[float, float, float], yaw: float, pitch: float, roll: float) -> Array:
    """Return the (4, 4) pose at a position (metres); angles in radians, positive uphill and to the right."""
    (cy, sy), (cp, sp), (cr, sr) = ((math.cos(a), math.sin(a)) for a in (yaw, -pitch, roll))
    R = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]]) @ np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    T = np.eye(4)
    T[:3, :3] = R @ np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    T[:3, 3] = position
    return T
