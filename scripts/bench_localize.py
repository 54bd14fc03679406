"""Milliseconds for localising all keypoints of 100 vehicles by trilateration, against solving each with scipy.

Both find the 33 keypoints from the wheels' world positions and the distances in the vehicles' sidecars; scipy's
least_squares is started on the right side of the wheel plane. Run: make bench
"""

import argparse
import time

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from skope import keypoints
from skope.gen.labels.world_keypoints import transform, trilaterate
from skope.gen.vehicles.fleet import fleet
from skope.gen.vehicles.model import wheel_plane


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--vehicles", type=int, default=100)
    parser.add_argument("--repeats", type=int, default=50, help="of skope's, whose median time counts")
    options = parser.parse_args()
    rng = np.random.default_rng(0)
    models = [entry.vehicle for entry in fleet(further=False).values()]
    chosen = [models[i] for i in rng.integers(len(models), size=options.vehicles)]
    T = np.tile(np.eye(4), (len(chosen), 1, 1))
    T[:, :3, :3] = Rotation.from_euler(
        "zyx", rng.uniform([-3, -0.1, -0.05], [3, 0.1, 0.05], (len(chosen), 3))
    ).as_matrix()
    T[:, :3, 3] = rng.uniform([-300, -300, 0], [300, 300, 5], (len(chosen), 3))
    truth = transform(T, np.stack([vehicle.points for vehicle in chosen]))
    wheels = truth[:, list(keypoints.WHEELS)]
    distances = np.stack([vehicle.sidecar.distances for vehicle in chosen])
    side = np.stack([vehicle.sidecar.side for vehicle in chosen])

    times = []
    for _ in range(options.repeats):
        begun = time.perf_counter()
        ours = trilaterate(wheels, distances, side)
        times.append(time.perf_counter() - begun)
    fast = float(np.median(times))

    center, _, normal = wheel_plane(wheels)
    begun = time.perf_counter()
    peer = np.empty_like(ours)
    for i in range(len(chosen)):
        for k in range(keypoints.K):

            def residual(p: np.ndarray, i: int = i, k: int = k) -> np.ndarray:
                return np.linalg.norm(p - wheels[i], axis=1) - distances[i, k]

            start = center[i] + (0.5 * side[i, k] + 1e-3) * normal[i]
            peer[i, k] = least_squares(residual, start, xtol=1e-12, ftol=1e-12, gtol=1e-12).x
    slow = time.perf_counter() - begun
    # In the wheel plane a distance tells nothing of the height to first order: there the peer's own error shows.
    off = np.abs(side) > 0
    print(f"{keypoints.K} keypoints of {len(chosen)} vehicles")
    print(f"  skope      {1e3 * fast:10.2f} ms, at most {np.abs(ours - truth).max():.1e} m off")
    print(f"  scipy      {1e3 * slow:10.1f} ms, {slow / fast:.0f} times as long")
    print(f"  apart      {np.abs(ours - peer)[off].max():.1e} m off the wheel plane")


if __name__ == "__main__":
    main()
