"""Headings of a vehicle over time, and the position error from a road user's height above the road.

A body turns no faster than a vehicle can, and one of its ends is the front.

A vehicle may be above or below the assumed plane of the road on its whole path. For a camera at height H over the road,
each metre of this offset shifts the position by (distance / H) metres along the viewing ray. The filter assumes
independent errors of poses and does not include this one.
"""

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skope.tracks.track import Track
from skope.types import Array


@dataclass(frozen=True)
class HeadingModel:
    """Noise model of headings."""

    lowest_camera_m: float = 1.0
    """Minimum height of a camera over the road, metres. Lower cameras are taken to be this high."""
    memory_s: float = 1.5
    """Time constant of the rate of turn, seconds."""
    moving_mps: float = 1.5
    """Speed above which the direction of travel gives the heading, m/s."""
    turn_change: float = 0.35
    """Change of a driving vehicle's rate of turn per second, rad/s."""
    turning_mps: float = 5.0
    """Speed at and above which `turn_change` holds, m/s. Below, it falls in proportion."""
    least_sigma_rad: float = math.radians(0.5)
    """Minimum standard deviation of a measured heading, radians."""
    outlier_variances: float = 9.0
    """Squared distance, in variances, above which a heading gets less weight."""


HEADING_MODEL: Final = HeadingModel()


def with_body_error(track: Track, camera_position: Array, height_sigma_m: float) -> Track:
    """Add the error of the height over the road, along the viewing ray, to the `body_error` of a track.

    Args:
        track: The track.
        camera_position: (3,) world, metres.
        height_sigma_m: Standard deviation of the height, metres.
    """
    line = track.xy - camera_position[:2]
    distance = np.maximum(np.linalg.norm(line, axis=1), 1e-9)
    height = np.maximum(HEADING_MODEL.lowest_camera_m, camera_position[2] - track.position[:, 2])
    ray = line / distance[:, None]
    # A relative error of the distance is the same relative error of the speed along the viewing ray.
    towards = np.einsum("mi,mi->m", track.velocity, ray) ** 2 / np.maximum(track.speed, 1e-9)
    return replace(
        track,
        body_error=track.body_error + ray * (distance / height * height_sigma_m)[:, None],
        speed_sigma=np.hypot(track.speed_sigma, towards / height * height_sigma_m),
    )


def smoothed_headings(times_s: Array, measured: Array, sigma: Array, velocity: Array) -> Array:
    """Smooth the headings of a vehicle over M frames and turn them to the direction of travel.

    Args:
        times_s: (M,) times, seconds.
        measured: (M,) measured headings, radians; NaN if not measured.
        sigma: (M,) their standard deviations, radians.
        velocity: (M, 2) smoothed velocities, m/s.

    Returns:
        (M,) headings, radians, counter-clockwise from world x.

    Vehicles are assumed to drive forwards. A stationary vehicle keeps the direction of its nearest motion in time. A
    vehicle that never moves has the direction of most of its poses.
    """
    seen = np.isfinite(measured)
    unit = np.where(seen, np.exp(1j * np.where(seen, measured, 0.0)), 0)
    travel: NDArray[np.complex128] = velocity[:, 0] + 1j * velocity[:, 1]
    moving = np.flatnonzero(seen & (np.abs(travel) > HEADING_MODEL.moving_mps))
    if moving.size:
        unit[moving] = unit[moving] * _sense(unit[moving], travel[moving])
        unit = unit * _sense(unit, unit[_nearest(moving, len(unit))])
    else:
        sense = _sense(unit, unit[np.nanargmin(np.where(seen, sigma, np.nan))])
        unit = unit * sense * (1 if sense[seen].sum() >= 0 else -1)
    return _turning(times_s, np.where(seen, np.angle(unit), np.nan), sigma, np.abs(travel))


def _turning(times_s: Array, measured: Array, sigma: Array, speed: Array) -> Array:
    """Return (M,) smoothed headings of a body with a slowly changing rate of turn, and only while it moves.

    This is a Kalman filter with Rauch, Tung and Striebel's smoother. The state is the heading and the rate of turn,
    which decays like the accelerations. At least one heading must not be NaN; the first known one also starts the
    filter.
    """
    # Forwards: predict and update. A covariance ((a, b), (b, c)) is kept as (a, b, c).
    ahead, after, moves = [], [], []
    first = int(np.flatnonzero(np.isfinite(measured))[0])
    mean, spread = (float(measured[first]), 0.0), (float(sigma[first]) ** 2, 0.0, HEADING_MODEL.turn_change**2)
    before = float(times_s[0])
    for time_s, z, error, v in zip(times_s.tolist(), measured.tolist(), sigma.tolist(), speed.tolist(), strict=True):
        dt, before = time_s - before, time_s
        fade = math.exp(-dt / HEADING_MODEL.memory_s)
        reach = HEADING_MODEL.memory_s * (1 - fade)
        q = (HEADING_MODEL.turn_change * min(1.0, max(v / HEADING_MODEL.turning_mps, 0.02))) ** 2 * dt
        (h, w), (a, b, c) = mean, spread
        mean = (h + reach * w, fade * w)
        spread = (
            a + 2 * reach * b + reach**2 * c + q * dt**2 / 3,
            fade * (b + reach * c) + q * dt / 2,
            fade**2 * c + q,
        )
        ahead.append((mean, spread))
        moves.append((reach, fade))
        if not math.isnan(z):
            (h, w), (a, b, c) = mean, spread
            off = (z - h + math.pi) % (2 * math.pi) - math.pi
            noise = error**2 + HEADING_MODEL.least_sigma_rad**2
            noise *= max(1.0, off**2 / (HEADING_MODEL.outlier_variances * (a + noise)))  # outliers get less weight
            gain, turn = a / (a + noise), b / (a + noise)
            mean = (h + gain * off, w + turn * off)
            spread = (a * (1 - gain), b * (1 - gain), c - turn * b)
        after.append((mean, spread))
    # Backwards: later frames correct earlier ones.
    out = [after[-1][0]]
    for k in range(len(after) - 2, -1, -1):
        (h, w), (a, b, c) = after[k]
        (h1, w1), (a1, b1, c1) = ahead[k + 1]
        reach, fade = moves[k + 1]
        # Gain: spread F^T of this frame times the inverse of the spread ahead.
        m00, m01, m10, m11 = a + reach * b, fade * b, b + reach * c, fade * c
        det = a1 * c1 - b1 * b1
        dh, dw = out[-1][0] - h1, out[-1][1] - w1
        u, v = (c1 * dh - b1 * dw) / det, (a1 * dw - b1 * dh) / det
        out.append((h + m00 * u + m01 * v, w + m10 * u + m11 * v))
    headings = np.array([h for h, _ in reversed(out)])
    return np.asarray(np.angle(np.exp(1j * headings)))


def _nearest(chosen: NDArray[np.intp], count: int) -> NDArray[np.intp]:
    """Return (count,) the nearest of the rising indices `chosen` for each index; of two, the earlier."""
    index = np.arange(count)
    after = np.minimum(np.searchsorted(chosen, index), len(chosen) - 1)
    before = np.maximum(after - 1, 0)
    nearer = np.abs(chosen[before] - index) <= np.abs(chosen[after] - index)
    return np.where(nearer, chosen[before], chosen[after])


def _sense(unit: NDArray[np.complex128], reference: NDArray[np.complex128] | complex) -> Array:
    """Return 1 where directions agree with the reference to within 90 degrees, else -1."""
    return np.where(np.real(unit * np.conj(reference)) < 0, -1.0, 1.0)
