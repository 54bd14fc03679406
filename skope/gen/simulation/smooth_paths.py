"""Smooth SUMO's places of vehicles to ways that vehicles can drive.

SUMO puts vehicles on the middle of lanes: it turns them at the corners of polylines, shifts them sideways within a
step and decides speeds in jumps. Here the place of each is smoothed over time, and a bicycle model follows it: the rear
axle moves along the heading only, and the heading turns as far as the steering lock allows (R. Rajamani, Vehicle
Dynamics and Control, 2nd ed., 2.2).
"""

import math
from array import array
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skope.gen.traffic.sumo import Snapshot, SumoVehicle
from skope.gen.vehicles.trailer_motion import DrivenTrailer, Follower


@dataclass(frozen=True)
class PathSmoothing:
    """Smoothing of vehicle paths."""

    sigmas_s: tuple[float, float] = (0.2, 0.5)
    """Standard deviations of the Gaussians that smooth places over time, seconds: for slow vehicles and for fast
    ones."""
    reach_s: float = 1.25
    """Time to either side at which the Gaussians are cut off, seconds."""
    lock_rad: float = 0.65
    """Largest steering angle of the front wheels, radians: from kerb to kerb a sedan turns within 11 m, a bus in 21
    m."""
    place_columns: int = 6
    """Of a vehicle's place at a step: x and y of its lane point, distance driven, speed, height, slope. An articulated
    vehicle has one more, the height under its trailer's axles."""
    chunk_steps: int = 200
    """Number of steps that are smoothed at once."""


PATH_SMOOTHING: Final = PathSmoothing()

SLOW, FAST = 8.0, 16.0
"""Speeds up to which a vehicle is slow and from which it is fast, m/s; between them the two averages are mixed."""


class Driven(NamedTuple):
    """Motion of one vehicle at one step, after smoothing; a tuple as `SumoVehicle` is."""

    position: tuple[float, float, float]
    """World: under the middle of the vehicle, on the line through its axles' places on the road, metres."""
    yaw: float
    """Heading, counter-clockwise from east, radians."""
    pitch: float
    """Slope of the road from axle to axle, uphill positive, radians."""
    speed: float
    """Speed of the rear axle, forwards, m/s."""
    lamps: int
    """Lamps that are lit, as bits of `skope.gen.scene.recording.LAMP_BITS`."""
    trailer: DrivenTrailer | None = None
    """Place of an articulated vehicle's trailer."""


@dataclass
class _Bicycle:
    """A bicycle model: place of a vehicle's rear axle, and its heading, after the last step."""

    x: float
    """World, metres."""
    y: float
    """World, metres."""
    yaw: float
    """Counter-clockwise from east, radians."""

    @classmethod
    def behind(cls, x: float, y: float, yaw: float, length: float) -> "_Bicycle":
        """A bicycle with heading `yaw` whose rear axle is `length` metres behind the point (x, y)."""
        return cls(x - length * math.cos(yaw), y - length * math.sin(yaw), yaw)

    def follow(self, x: float, y: float, length: float, sharpest: float) -> float:
        """Drive on until the point `length` metres ahead of the rear axle is as near to (x, y) as it can be.

        `sharpest` is the largest curvature, 1/m. Returns the metres that the rear axle has moved; vehicles stand
        rather than move backwards.
        """
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        travel = max((x - self.x) * cos + (y - self.y) * sin - length, 0.0)
        bearing = math.atan2(y - self.y - travel * sin, x - self.x - travel * cos)
        turn = math.remainder(bearing - self.yaw, 2 * math.pi)
        turn = min(max(turn, -travel * sharpest), travel * sharpest)
        middle = self.yaw + turn / 2
        self.x += travel * math.cos(middle)
        self.y += travel * math.sin(middle)
        self.yaw += turn
        return travel


class _Way:
    """One vehicle's way: where SUMO had it at each step from `first` on, and the bicycle that follows."""

    def __init__(self, first: int) -> None:
        self.first = first
        self.placed: list[SumoVehicle] = []
        self.bicycle: _Bicycle | None = None
        self._trailer: Follower | None = None
        self._rows = array("d")
        self._columns = PATH_SMOOTHING.place_columns

    def add(self, placed: SumoVehicle) -> None:
        """Note where SUMO had the vehicle at the next step."""
        self.placed.append(placed)
        self._rows.extend((*placed.lane_point, placed.driven, placed.speed, placed.height, placed.pitch))
        if placed.trailer:
            self._columns = PATH_SMOOTHING.place_columns + 1
            self._rows.append(placed.trailer.height)

    def driven(self, start: int, stop: int, weights: NDArray[np.float64], dt: float) -> Iterator[tuple[int, Driven]]:
        """Steps in `start` <= step < `stop` at which SUMO had the vehicle, each with how it drives.

        Args:
            start: First step.
            stop: Step after the last one.
            weights: (2 * reach + 1, 2) weights of the steps around, for slow and for fast vehicles.
            dt: Length of a step, seconds.
        """
        start, stop = max(start, self.first), min(stop, self.first + len(self.placed))
        if start >= stop:
            return
        rows = self._smoothed(start, stop, weights, dt).tolist()
        for k, (x, y, height, pitch, *trailer_height) in enumerate(rows, start=start):
            placed = self.placed[k - self.first]
            chassis, level = placed.chassis, math.cos(pitch)
            if self.bicycle is None:
                self.bicycle = _Bicycle.behind(x, y, placed.yaw, chassis.lane_point * level)
                travel = placed.speed * dt
            else:
                travel = self.bicycle.follow(
                    x, y, chassis.lane_point * level, math.tan(PATH_SMOOTHING.lock_rad) / chassis.wheelbase
                )
            one, middle = self.bicycle, chassis.middle * level
            place = (one.x + middle * math.cos(one.yaw), one.y + middle * math.sin(one.yaw), height)
            trailer = self._follow(placed, one, level, trailer_height[0]) if trailer_height else None
            yield k, Driven(place, one.yaw, pitch, travel / dt / level, placed.lamps, trailer)

    def _follow(self, placed: SumoVehicle, one: _Bicycle, level: float, height: float) -> DrivenTrailer:
        """Draw the trailer behind the vehicle's place at a step; it begins as it hung in SUMO.

        Args:
            placed: Where SUMO has the vehicle.
            one: Where the vehicle is.
            level: What a metre along the road is on the map, metres.
            height: Of the road under the trailer's axles, metres.
        """
        hitch = placed.chassis.hitch
        assert hitch is not None
        assert placed.trailer is not None
        hinge = one.x + hitch.hinge * level * math.cos(one.yaw), one.y + hitch.hinge * level * math.sin(one.yaw)
        if self._trailer is None:
            self._trailer = Follower(hitch, *hinge, placed.trailer.yaw)
        self._trailer.follow(*hinge, one.yaw)
        return DrivenTrailer(self._trailer.yaw, height, self._trailer.rolled)

    def _smoothed(self, start: int, stop: int, weights: NDArray[np.float64], dt: float) -> NDArray[np.float64]:
        """(stop - start, 4) x and y of the lane point, height (metres) and slope (radians) of the road; of an
        articulated vehicle (stop - start, 5), with the height under its trailer.

        Places are averaged over time; height and slope are those of the road at the averaged place. Before the first
        and after the last known step the vehicle is assumed to drive on evenly.
        """
        half = len(weights) // 2
        rows = np.array(self._rows).reshape(-1, self._columns)
        begin, end = start - half - self.first, stop + half - self.first
        inside = rows[max(begin, 0) : end]
        before = rows[0] + np.arange(min(begin, 0), 0)[:, None] * (dt * self._change_per_second(self.placed[0]))
        after = rows[-1] + np.arange(1, max(end - len(rows), 0) + 1)[:, None] * (
            dt * self._change_per_second(self.placed[-1])
        )
        known = np.concatenate([before, inside, after])
        # Summed weight by weight, so that rounding does not depend on how many steps are smoothed at once.
        averages = np.zeros((2, stop - start, 4))
        for k, pair in enumerate(weights):
            averages += pair[:, None, None] * known[k : k + stop - start, :4]
        slow, fast = averages
        share = np.clip((fast[:, 3:] - SLOW) / (FAST - SLOW), 0.0, 1.0)
        mean = slow + share * (fast - slow)
        road = [np.interp(mean[:, 2], known[:, 2], column) for column in known.T[4:]]
        return np.column_stack([mean[:, :2], *road])

    def forget(self, before: int) -> None:
        """Drop the steps before a step."""
        count = min(max(before - self.first, 0), len(self.placed))
        del self.placed[:count], self._rows[: count * self._columns]
        self.first += count

    def _change_per_second(self, placed: SumoVehicle) -> NDArray[np.float64]:
        """(6,) or (7,) change of a row in a second."""
        speed, level = placed.speed, placed.speed * math.cos(placed.pitch)
        ahead, up = (level * math.cos(placed.yaw), level * math.sin(placed.yaw)), speed * math.sin(placed.pitch)
        return np.array([*ahead, speed, 0.0, up, 0.0, up][: self._columns])


def reach(step: float) -> int:
    """Number of steps that SUMO has to be ahead of the smoothed vehicles, for steps of `step` seconds."""
    return round(PATH_SMOOTHING.reach_s / step)


def drivable(snapshots: Iterable[Snapshot], step: float) -> Iterator[tuple[Snapshot, dict[str, Driven]]]:
    """Smooth SUMO's snapshots to how vehicles drive.

    Args:
        snapshots: One for each step.
        step: Length of a step, seconds.

    Yields:
        Each snapshot but the first and last `reach(step)`, with its vehicles as they drive, by name. It depends on
        nothing later than `reach(step)` steps after it.
    """
    half = reach(step)
    weights = np.exp(-0.5 * (np.arange(-half, half + 1)[:, None] * step / PATH_SMOOTHING.sigmas_s) ** 2)
    weights /= weights.sum(axis=0)
    ways: dict[str, _Way] = {}
    waiting: deque[Snapshot] = deque()
    read, done = 0, half
    coming = iter(snapshots)
    while batch := list(islice(coming, PATH_SMOOTHING.chunk_steps)):
        for k, snapshot in enumerate(batch, start=read):
            for name, placed in snapshot.vehicles.items():
                way = ways.get(name)
                if way is None:
                    way = ways[name] = _Way(k)
                way.add(placed)
        read += len(batch)
        waiting.extend(batch)
        if read - half <= done:
            continue
        driven: list[dict[str, Driven]] = [{} for _ in range(done, read - half)]
        for name, way in ways.items():
            for k, state in way.driven(done, read - half, weights, step):
                driven[k - done][name] = state
            way.forget(read - 2 * half)
        ways = {name: way for name, way in ways.items() if way.placed}
        while len(waiting) > len(driven) + half:
            waiting.popleft()
        for states in driven:
            yield waiting.popleft(), states
        done = read - half
