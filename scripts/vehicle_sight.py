"""Work out from where each keypoint of a vehicle is seen past the vehicle's own body, for `skope eval pose`. Writes
skope/pose/keypoint_visibility.json; takes a minute. Run after the fleet changes:

    python scripts/vehicle_sight.py

Rays are cast from eyes all around the models of each body type; what they say is kept as a logistic regression on the
direction from the keypoint to the eye, four numbers a keypoint. Models held out for test sites are left out.
"""

import argparse
import itertools
import math
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

from skope import keypoints
from skope.files.atomic import write_text
from skope.gen.labels.raycast import Fan
from skope.gen.vehicles.fleet import fleet
from skope.gen.vehicles.model import Vehicle, straight_mesh

DEFAULT_OUT = Path(__file__).parents[1] / "skope" / "eval" / "pose" / "keypoint_visibility.json"
ELEVATIONS = np.radians([4, 10, 18, 28, 40, 55])
DISTANCE = 25.0
TOLERANCE = 0.05
"""Metres, as for labels."""
RIDGE = 0.02
"""Holds the numbers of keypoints that are always or never seen."""
Array = np.ndarray


def seen(vehicle: Vehicle, eye: Array) -> Array:
    """(33,) whether an eye sees the keypoints; a wheel's at the middle of its outer face, a trailer straight behind."""
    wheels = list(keypoints.WHEELS)
    own, hitched = vehicle.parts[1:5], vehicle.parts[6:]
    places = [*vehicle.shape.wheel_centers(), *vehicle.points[wheels[2:]][: len(hitched)]]
    body = straight_mesh(vehicle)
    corners = [body.vertices[body.triangles]]
    corners += [part.vertices[part.triangles] + place for part, place in zip((*own, *hitched), places, strict=True)]
    targets = vehicle.points.copy()
    targets[wheels] += vehicle.wheel_face_offsets
    rays = targets - eye
    reach, _ = Fan(np.concatenate(corners) - eye).first_hits(rays)
    return np.asarray((1 - reach) * np.linalg.norm(rays, axis=1) < TOLERANCE)


def logistic(directions: Array, was_seen: Array) -> Array:
    """(4,) weights of a direction's x, y, z and 1."""
    x = np.column_stack([directions, np.ones(len(directions))])
    sign = np.where(was_seen, 1.0, -1.0)

    def loss(w: Array) -> float:
        return float(np.logaddexp(0, -sign * (x @ w)).sum() + RIDGE * (w @ w))

    return np.asarray(minimize(loss, np.zeros(4), method="BFGS").x)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--azimuth-step", type=float, default=15, help="degrees between the eyes around a vehicle")
    parser.add_argument("--out", type=Path, default=DEFAULT_OUT)
    options = parser.parse_args()
    azimuths = np.radians(np.arange(0, 360, options.azimuth_step))
    kinds: dict[str, list[Vehicle]] = {}
    for entry in fleet().values():
        if not entry.held_out:
            kinds.setdefault(entry.vehicle.vehicle_type, []).append(entry.vehicle)
    lines = []
    for kind, models in sorted(kinds.items()):
        directions, hits = [], []
        for vehicle, azimuth, elevation in itertools.product(models, azimuths, ELEVATIONS):
            flat = math.cos(elevation)
            eye = DISTANCE * np.array([flat * math.cos(azimuth), flat * math.sin(azimuth), math.sin(elevation)])
            away = eye - vehicle.points
            directions.append(away / np.linalg.norm(away, axis=1, keepdims=True))
            hits.append(seen(vehicle, eye))
        u, hit = np.stack(directions), np.stack(hits)
        rows = np.stack([logistic(u[:, k], hit[:, k]) for k in range(keypoints.K)])
        guess = np.einsum("nki,ki->nk", u, rows[:, :3]) + rows[:, 3] > 0
        print(f"{kind:<10} {hit.mean():.1%} seen, {(guess == hit).mean():.1%} of them told right")
        lines.append(f'"{kind}":[{",".join(f"{value:.2f}" for value in rows.ravel())}]')
    body = ",\n".join(lines)
    write_text(options.out, f'{{"version":1,"scheme":"{keypoints.SCHEME}","types":{{\n{body}\n}}}}\n')
    print(f"wrote {options.out} ({options.out.stat().st_size / 1000:.0f} kB)")


if __name__ == "__main__":
    main()
