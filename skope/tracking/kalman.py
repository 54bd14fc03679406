"""Kalman filter of a vehicle's motion on the road from its poses, and the smoother over all frames.

The state is x, y, vx, vy, ax, ay: position (metres, world), velocity (m/s) and a slowly changing acceleration (m/s^2).
Prediction is Singer's model, smoothing is Rauch, Tung and Striebel's.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from skope.tracking.tracker_inputs import PoseMeasurement
from skope.types import Array

State = tuple[Array, Array]
"""Mean (6,) and covariance (6, 6) of a vehicle's state."""


@dataclass(frozen=True)
class KalmanSettings:
    """Noise model of the Kalman filter."""

    gate_variances: float = 16.0
    """Squared Mahalanobis distance at and above which a measurement is not assigned to a track."""
    jerk_density: float = 1.0
    """Spectral density of the change of acceleration, m^2 / s^5. The value allows hard braking within one or two
    seconds."""
    memory_s: float = 1.5
    """Time constant of the decay of an acceleration, seconds."""
    speed_mps: float = 15.0
    """Standard deviation of a new vehicle's speed along its heading, m/s."""
    sideways_speed_mps: float = 2.0
    """Standard deviation of a new vehicle's lateral speed, m/s."""
    acceleration_mps2: float = 2.0
    """Standard deviation of a new vehicle's acceleration, m/s^2."""
    slide_mps: float = 0.5
    """Standard deviation of a standing vehicle's lateral speed, m/s."""
    slip_ratio: float = 0.15
    """Share of the speed that is added to `slide_mps`. The middle of a turning vehicle does not move along its
    heading."""


KALMAN_SETTINGS: Final = KalmanSettings()


def first_state(pose: PoseMeasurement) -> State:
    """Return the state of a vehicle after its first pose: it may be still, or drive forwards or backwards."""
    mean = np.array([*pose.place, 0, 0, 0, 0], dtype=np.float64)
    spread = np.zeros((6, 6))
    spread[:2, :2] = pose.covariance
    ahead = np.array([math.cos(pose.heading), math.sin(pose.heading)])
    aside = math.hypot(KALMAN_SETTINGS.sideways_speed_mps, KALMAN_SETTINGS.speed_mps * min(pose.heading_sigma, 1.0))
    spread[2:4, 2:4] = aside**2 * np.eye(2) + (KALMAN_SETTINGS.speed_mps**2 - aside**2) * np.outer(ahead, ahead)
    spread[4:, 4:] = KALMAN_SETTINGS.acceleration_mps2**2 * np.eye(2)
    return mean, spread


def first_state_at(position: Array, covariance: Array, speed_sigma: float) -> State:
    """Return the state of a road user after its first detection, with any direction of travel.

    Args:
        position: (2,) world x, y, metres.
        covariance: (2, 2) covariance of the position, square metres.
        speed_sigma: Standard deviation of the speed in any direction, m/s.
    """
    spread = np.zeros((6, 6))
    spread[:2, :2] = covariance
    spread[2:4, 2:4] = speed_sigma**2 * np.eye(2)
    spread[4:, 4:] = KALMAN_SETTINGS.acceleration_mps2**2 * np.eye(2)
    return np.array([*position, 0, 0, 0, 0], dtype=np.float64), spread


def motion(dt: float) -> tuple[Array, Array]:
    """Return the transition and noise, (6, 6) each, of `dt` seconds of Singer's model (IEEE Trans. AES, 1970).

    The acceleration decays, so that an undetected vehicle continues at constant speed. The noise is that of constant
    acceleration (Bar-Shalom et al. 2001, section 6.2.3), which equals the model's noise for short steps.
    """
    fade = math.exp(-dt / KALMAN_SETTINGS.memory_s)
    to_speed = KALMAN_SETTINGS.memory_s * (1 - fade)
    F1 = np.array([[1, dt, KALMAN_SETTINGS.memory_s * (dt - to_speed)], [0, 1, to_speed], [0, 0, fade]])
    Q1 = KALMAN_SETTINGS.jerk_density * np.array(
        [[dt**5 / 20, dt**4 / 8, dt**3 / 6], [dt**4 / 8, dt**3 / 3, dt**2 / 2], [dt**3 / 6, dt**2 / 2, dt]]
    )
    identity = np.eye(2)  # x and y move independently by the same model
    return np.asarray(np.kron(F1, identity)), np.asarray(np.kron(Q1, identity), dtype=np.float64)


def predicted_state(state: State, F: Array, Q: Array) -> State:
    """Return a state after one step of `motion`, before any measurement.

    Args:
        state: Mean (6,) and covariance (6, 6).
        F: (6, 6) transition.
        Q: (6, 6) covariance of the process noise of the step.
    """
    mean, spread = state
    return F @ mean, F @ spread @ F.T + Q


def before(state: State, dt: float) -> State:
    """Return the state `dt` seconds earlier. The model is symmetric in time."""
    back = np.diag([1.0, 1.0, -1.0, -1.0, 1.0, 1.0])
    mean, spread = predicted_state((back @ state[0], back @ state[1] @ back), *motion(dt))
    return back @ mean, back @ spread @ back


def updated(state: State, pose: PoseMeasurement) -> State:
    """Return a state updated with a pose: its position, and the direction in which the wheels roll."""
    return _rolling(*updated_at(state, pose.place, pose.covariance), pose)


def updated_at(state: State, position: Array, covariance: Array) -> State:
    """Return a state updated with a position.

    Args:
        state: Mean (6,) and covariance (6, 6).
        position: (2,) world x, y, metres.
        covariance: (2, 2) covariance of the position, square metres.
    """
    mean, spread = state
    gain = np.linalg.solve(spread[:2, :2] + covariance, spread[:2]).T
    kept = np.eye(len(mean))
    kept[:, :2] -= gain
    # Joseph's form stays symmetric and positive definite over any number of steps.
    after = kept @ spread @ kept.T + gain @ covariance @ gain.T
    return mean + gain @ (position - mean[:2]), after


def _rolling(mean: Array, spread: Array, pose: PoseMeasurement) -> State:
    """Return a state updated with the constraint that wheels roll along the heading, with little lateral slip."""
    aside = np.array([0, 0, -math.sin(pose.heading), math.cos(pose.heading), 0, 0])
    speed = float(np.linalg.norm(mean[2:4]))
    slides = float(aside @ mean)
    variance = KALMAN_SETTINGS.slide_mps**2 + (speed * math.hypot(KALMAN_SETTINGS.slip_ratio, pose.heading_sigma)) ** 2
    across = spread @ aside
    total = float(aside @ across) + variance
    if slides**2 > KALMAN_SETTINGS.gate_variances * total:  # the pose's heading must be wrong
        return mean, spread
    gain = across / total
    kept = np.eye(len(mean)) - np.outer(gain, aside)
    return mean - gain * slides, kept @ spread @ kept.T + variance * np.outer(gain, gain)


def smoothed(
    transitions: Sequence[Array], predictions: Sequence[State], filtered: Sequence[State]
) -> tuple[Array, Array]:
    """Return smoothed states of M frames, which use later measurements too (Rauch, Tung and Striebel, 1965).

    Args:
        transitions: (6, 6) each, from the previous frame to each frame; the first is not used.
        predictions: States before each frame's measurement; the first is not used.
        filtered: States after each frame's measurement.

    Returns:
        Means (M, 6) and covariances (M, 6, 6).
    """
    means = np.array([mean for mean, _ in filtered]).reshape(-1, 6)
    spreads = np.array([spread for _, spread in filtered]).reshape(-1, 6, 6)
    for k in range(len(filtered) - 2, -1, -1):
        ahead, spread_ahead = predictions[k + 1]
        gain = np.linalg.solve(spread_ahead, transitions[k + 1] @ filtered[k][1]).T
        means[k] += gain @ (means[k + 1] - ahead)
        spreads[k] += gain @ (spreads[k + 1] - spread_ahead) @ gain.T
    return means, spreads


def position_and_speed_errors(means: Array, spreads: Array) -> tuple[Array, Array]:
    """Return position covariances (M, 2, 2), square metres, and speed standard deviations (M,), m/s, of M states.

    Rounding can make tiny variances negative; these are raised to 0.

    Args:
        means: (M, 6) states.
        spreads: (M, 6, 6) covariances of the states.
    """
    variances, axes = np.linalg.eigh(spreads[:, :2, :2])
    position = np.einsum("mik,mk,mjk->mij", axes, np.maximum(0.0, variances), axes)
    velocity, speed = means[:, 2:4], np.linalg.norm(means[:, 2:4], axis=1)
    ahead = np.divide(velocity, speed[:, None], out=np.zeros_like(velocity), where=speed[:, None] > 0)
    along = np.einsum("mi,mij,mj->m", ahead, spreads[:, 2:4, 2:4], ahead)
    worst = np.linalg.eigvalsh(spreads[:, 2:4, 2:4])[:, -1]
    return np.asarray(position), np.sqrt(np.maximum(0, np.where(speed > 0, along, worst)))
