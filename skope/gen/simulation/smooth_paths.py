"""Smooth the positions of vehicles in SUMO to paths that vehicles can drive.

SUMO places vehicles on the centre lines of lanes. It turns them at the corners of polylines, shifts them sideways
within one step, and changes speeds abruptly. This module smooths the position of each vehicle over time, and a bicycle
model follows the smoothed position. The rear axle moves only along the heading, and the heading turns only as far as
the steering lock allows (R. Rajamani, Vehicle Dynamics and Control, 2nd ed., 2.2).
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
    """Settings for the smoothing of vehicle paths."""

    sigmas_s: tuple[float, float] = (0.2, 0.5)
    """Standard deviations of the Gaussians that smooth positions over time, seconds: for slow and for fast vehicles."""
    reach_s: float = 1.25
    """Time to either side at which the Gaussians are truncated, seconds."""
    lock_rad: float = 0.65
    """Maximum steering angle of the front wheels, radians; kerb-to-kerb turning circle: sedan 11 m, bus 21 m."""
    state_columns: int = 6
    """Number of columns per vehicle and step: x and y of its lane point, travelled distance, speed, height, slope.

    An articulated vehicle has one more column, the height of the road under its trailer's axles."""
    chunk_steps: int = 200
    """Number of steps that are smoothed at once."""


PATH_SMOOTHING: Final = PathSmoothing()

SLOW, FAST = 8.0, 16.0
"""Maximum speed of slow vehicles and minimum speed of fast ones, m/s; in between, the two averages are blended."""


class Driven(NamedTuple):
    """Motion of one vehicle at one step, after smoothing; a tuple like `SumoVehicle`."""

    position: tuple[float, float, float]
    """World position under the vehicle's middle, on the line between the road points under its axles, metres."""
    yaw: float
    """Heading, counter-clockwise from east, radians."""
    pitch: float
    """Slope of the road from axle to axle, radians; uphill is positive."""
    speed: float
    """Forward speed of the rear axle, m/s."""
    lamps: int
    """Lit lamps, as bits of `skope.gen.scene.recording.LAMP_BITS`."""
    trailer: DrivenTrailer | None = None
    """Motion of an articulated vehicle's trailer; None for other vehicles."""


@dataclass
class _Bicycle:
    """Bicycle model: position of a vehicle's rear axle and its heading after the last step."""

    x: float
    """World x of the rear axle, metres."""
    y: float
    """World y of the rear axle, metres."""
    yaw: float
    """Heading, counter-clockwise from east, radians."""

    @classmethod
    def behind(cls, x: float, y: float, yaw: float, length: float) -> "_Bicycle":
        """Return a bicycle with heading `yaw` and its rear axle `length` metres behind the point (x, y)."""
        return cls(x - length * math.cos(yaw), y - length * math.sin(yaw), yaw)

    def follow(self, x: float, y: float, length: float, sharpest: float) -> float:
        """Drive until the point `length` metres ahead of the rear axle is as near as possible to (x, y).

        `sharpest` is the maximum curvature, 1/m. Returns the distance that the rear axle has moved, metres. Vehicles
        stop instead of moving backwards.
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
    """Path of one vehicle: its positions in SUMO from step `first` on, and the bicycle model that follows them."""

    def __init__(self, first: int) -> None:
        self.first = first
        self.placed: list[SumoVehicle] = []
        self.bicycle: _Bicycle | None = None
        self._trailer: Follower | None = None
        self._rows = array("d")
        self._columns = PATH_SMOOTHING.state_columns

    def add(self, placed: SumoVehicle) -> None:
        """Add the vehicle's state in SUMO at the next step."""
        self.placed.append(placed)
        self._rows.extend((*placed.lane_point, placed.driven, placed.speed, placed.height, placed.pitch))
        if placed.trailer:
            self._columns = PATH_SMOOTHING.state_columns + 1
            self._rows.append(placed.trailer.height)

    def driven(self, start: int, stop: int, weights: NDArray[np.float64], dt: float) -> Iterator[tuple[int, Driven]]:
        """Yield the steps in `start` <= step < `stop` at which SUMO has the vehicle, each with its smoothed motion.

        Args:
            start: First step.
            stop: Step after the last one.
            weights: (2 * reach + 1, 2) weights of the surrounding steps, for slow and for fast vehicles.
            dt: Duration of a step, seconds.
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
            bicycle, middle = self.bicycle, chassis.middle * level
            position = (bicycle.x + middle * math.cos(bicycle.yaw), bicycle.y + middle * math.sin(bicycle.yaw), height)
            trailer = self._follow(placed, bicycle, level, trailer_height[0]) if trailer_height else None
            yield k, Driven(position, bicycle.yaw, pitch, travel / dt / level, placed.lamps, trailer)

    def _follow(self, placed: SumoVehicle, bicycle: _Bicycle, level: float, height: float) -> DrivenTrailer:
        """Move the trailer behind the vehicle at a step; it starts with its heading in SUMO.

        Args:
            placed: State of the vehicle in SUMO.
            bicycle: Smoothed position of the vehicle.
            level: Horizontal length of one metre along the road, metres.
            height: Height of the road under the trailer's axles, metres.
        """
        hitch = placed.chassis.hitch
        assert hitch is not None
        assert placed.trailer is not None
        hinge = (
            bicycle.x + hitch.hinge * level * math.cos(bicycle.yaw),
            bicycle.y + hitch.hinge * level * math.sin(bicycle.yaw),
        )
        if self._trailer is None:
            self._trailer = Follower(hitch, *hinge, placed.trailer.yaw)
        self._trailer.follow(*hinge, bicycle.yaw)
        return DrivenTrailer(self._trailer.yaw, height, self._trailer.rolled)

    def _smoothed(self, start: int, stop: int, weights: NDArray[np.float64], dt: float) -> NDArray[np.float64]:
        """Return (stop - start, 4) x and y of the lane point, height (metres) and slope (radians) of the road.

        For an articulated vehicle, (stop - start, 5) with the height under its trailer. Positions are averaged over
        time; height and slope are those of the road at the averaged position. Before the first and after the last known
        step, the vehicle is assumed to keep its speed and heading.
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
        # The sum runs weight by weight, so that rounding does not depend on the number of steps smoothed at once.
        averages = np.zeros((2, stop - start, 4))
        for k, pair in enumerate(weights):
            averages += pair[:, None, None] * known[k : k + stop - start, :4]
        slow, fast = averages
        share = np.clip((fast[:, 3:] - SLOW) / (FAST - SLOW), 0.0, 1.0)
        mean = slow + share * (fast - slow)
        road = [np.interp(mean[:, 2], known[:, 2], column) for column in known.T[4:]]
        return np.column_stack([mean[:, :2], *road])

    def forget(self, before: int) -> None:
        """Drop all steps before the given step."""
        count = min(max(before - self.first, 0), len(self.placed))
        del self.placed[:count], self._rows[: count * self._columns]
        self.first += count

    def _change_per_second(self, placed: SumoVehicle) -> NDArray[np.float64]:
        """Return the change of a row per second, (6,) or (7,)."""
        speed, level = placed.speed, placed.speed * math.cos(placed.pitch)
        ahead, up = (level * math.cos(placed.yaw), level * math.sin(placed.yaw)), speed * math.sin(placed.pitch)
        return np.array([*ahead, speed, 0.0, up, 0.0, up][: self._columns])


def reach(step: float) -> int:
    """Return how many steps of `step` seconds SUMO must run ahead of the smoothed vehicles."""
    return round(PATH_SMOOTHING.reach_s / step)


def drivable(snapshots: Iterable[Snapshot], step: float) -> Iterator[tuple[Snapshot, dict[str, Driven]]]:
    """Smooth SUMO's snapshots to drivable motions.

    Args:
        snapshots: One snapshot per step.
        step: Duration of a step, seconds.

    Yields:
        Each snapshot except the first and last `reach(step)`, with the motions of its vehicles by name. The result
        depends on nothing later than `reach(step)` steps after it.
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
