"""Headings of a vehicle through time, and the error that a road user's own height gives its positions.

A body turns no faster than a vehicle can, and one of its ends is the front.

A vehicle stands above or below the plane that the road is taken for, on its whole path. From a camera of height H over
the road it seems nearer or farther by (distance / H) metres per metre of that. The filter takes errors of poses for
independent and does not know this one.
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
    """Least height of a camera over the road, metres."""
    memory_s: float = 1.5
    """Time constant of a rate of turn, seconds."""
    moving_mps: float = 1.5
    """Speed from which the direction of travel gives the heading, m/s."""
    turn_change: float = 0.35
    """Change of a driving vehicle's rate of turn per second, rad/s."""
    turning_mps: float = 5.0
    """Speed from which `turn_change` holds, m/s. It falls in proportion below."""
    least_sigma_rad: float = math.radians(0.5)
    """Least standard deviation of a measured heading, radians."""
    outlier_variances: float = 9.0
    """Squared distance, in variances, from which a heading gets less weight."""


HEADING_MODEL: Final = HeadingModel()


def with_body_error(track: Track, camera_position: Array, height_sigma_m: float) -> Track:
    """The track with the error of its height over the road, along the line of sight, added to its `body_error`.

    Args:
        track: The track.
        camera_position: (3,) world, metres.
        height_sigma_m: Standard deviation of the height, metres.
    """
    line = track.xy - camera_position[:2]
    distance = np.maximum(np.linalg.norm(line, axis=1), 1e-9)
    height = np.maximum(HEADING_MODEL.lowest_camera_m, camera_position[2] - track.position[:, 2])
    ray = line / distance[:, None]
    # What seems farther by a share of the distance seems faster by that share, along the line of sight.
    towards = np.einsum("mi,mi->m", track.velocity, ray) ** 2 / np.maximum(track.speed, 1e-9)
    return replace(
        track,
        body_error=track.body_error + ray * (distance / height * height_sigma_m)[:, None],
        speed_sigma=np.hypot(track.speed_sigma, towards / height * height_sigma_m),
    )


def smoothed_headings(times_s: Array, measured: Array, sigma: Array, velocity: Array) -> Array:
    """Headings of a vehicle through M frames, smoothed, with its front where it drives to.

    Args:
        times_s: (M,) seconds.
        measured: (M,) measured headings, radians; NaN where none was seen.
        sigma: (M,) their standard deviations, radians.
        velocity: (M, 2) smoothed, m/s.

    Returns:
        (M,) headings, radians, counter-clockwise from world x.

    Vehicles drive forwards. One that stands keeps the sense that it has when it moves next, or moved last; one that
    never moves that of most of its poses.
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
    """(M,) headings, smoothed as of a body whose turning changes slowly, and only while it moves.

    A Kalman filter and Rauch, Tung and Striebel's smoother, whose state is the heading and the rate of turn, which
    fades as accelerations do. Headings may be NaN, but for one; before the first one that is known it is taken for all.
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
            noise *= max(1.0, off**2 / (HEADING_MODEL.outlier_variances * (a + noise)))  # what is far off pulls less
            gain, turn = a / (a + noise), b / (a + noise)
            mean = (h + gain * off, w + turn * off)
            spread = (a * (1 - gain), b * (1 - gain), c - turn * b)
        after.append((mean, spread))
    # Backwards: what came later corrects what came before.
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
    """(count,) for each index the nearest of the rising indices `chosen`; of two the earlier."""
    index = np.arange(count)
    after = np.minimum(np.searchsorted(chosen, index), len(chosen) - 1)
    before = np.maximum(after - 1, 0)
    nearer = np.abs(chosen[before] - index) <= np.abs(chosen[after] - index)
    return np.where(nearer, chosen[before], chosen[after])


def _sense(unit: NDArray[np.complex128], reference: NDArray[np.complex128] | complex) -> Array:
    """1 where directions agree with the reference to 90 degrees, else -1."""
    return np.where(np.real(unit * np.conj(reference)) < 0, -1.0, 1.0)
