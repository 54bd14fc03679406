"""Compute the shapes and keypoint visibilities that `skope eval pose` uses, from the fleet. Takes ten minutes.

    python scripts/vehicle_shapes.py

Run it after the fleet has changed. It writes two files of skope/pose. Models that are held out for test sites are left
out, so that evaluation meets shapes that were not used here.

vehicle_shapes.json is the shape space: mean and principal directions of the 33 keypoints and the dimensions of each
body type. The weight of a model is its share of traffic. A type may have only two models. The variation that its other
models may have is therefore estimated from the models of all types: how much they differ from their type's mean, as
shares of length, width and height, separately for heavy and other vehicles. Trailers of articulated vehicles bend
behind them, with a standard deviation of `BEND_DEG`.

keypoint_visibility.json has the directions from which each keypoint is visible past the vehicle's own body. Rays are
cast from eyes around the models of each body type. The file holds a logistic regression on the direction from
keypoint to eye, four numbers per keypoint.
"""

import argparse
import itertools
import math
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

from skope import keypoints
from skope.files.atomic import write_text
from skope.gen.labels.annotate import box_around
from skope.gen.labels.raycast import Fan
from skope.gen.traffic.demand import DEMAND_LIMITS
from skope.gen.vehicles.fleet import build_vehicle, fleet, jittered
from skope.gen.vehicles.model import ON_TRAILER, Vehicle, straight_mesh

POOLED = 0.5
"""Share of the other types' variance between models that is added to a type's own variance."""
DIRECTIONS = 8
BEND_DEG = 3.0
"""Standard deviation of the angle between an articulated vehicle and its trailer, degrees."""
BENDS = 2
"""Angles to each side at which each shape of an articulated vehicle is sampled."""
Array = np.ndarray


def row(vehicle: Vehicle, bend: float = 0.0) -> Array:
    """Return keypoints and, in the last row, length, width and height, (34, 3) in metres.

    `bend` is the angle of a trailer, radians. The origin is on the road below the middle of the box around the whole
    vehicle. The axes are those of its first part.
    """
    if vehicle.trailer is None:
        return np.concatenate([vehicle.points, [vehicle.size_lwh]])
    c, s = math.cos(bend), math.sin(bend)
    T = np.eye(4)
    T[:2, :2], T[:2, 3] = [[c, -s], [s, c]], vehicle.trailer.hinge[:2]
    points = vehicle.points.copy()
    points[ON_TRAILER] = (points[ON_TRAILER] - T[:3, 3]) @ T[:3, :3].T + T[:3, 3]
    middle, size = box_around(vehicle, vehicle.trailer, np.eye(4), T)
    return np.concatenate([points - middle * [1, 1, 0], [size]])


def text(values: Array) -> str:
    """Format numbers for a JSON list, rounded to 0.1 mm."""
    return f"[{','.join(f'{value:.4f}' for value in (np.round(values, 4) + 0.0).ravel())}]"


ELEVATIONS = np.radians([4, 10, 18, 28, 40, 55])
DISTANCE = 25.0
TOLERANCE = 0.05
"""Metres; as for labels."""
RIDGE = 0.02
"""Penalty on the weights, which keeps them finite for keypoints that are always or never visible."""


def seen(vehicle: Vehicle, eye: Array) -> Array:
    """Return whether keypoints (33,) are visible from an eye; wheels count as the middle of their outer faces."""
    wheels = list(keypoints.WHEELS)
    main_wheels, hitched = vehicle.parts[1:5], vehicle.parts[6:]
    places = [*vehicle.shape.wheel_centers(), *vehicle.points[wheels[2:]][: len(hitched)]]
    body = straight_mesh(vehicle)
    corners = [body.vertices[body.triangles]]
    corners += [
        part.vertices[part.triangles] + center for part, center in zip((*main_wheels, *hitched), places, strict=True)
    ]
    targets = vehicle.points.copy()
    targets[wheels] += vehicle.wheel_face_offsets
    rays = targets - eye
    reach, _ = Fan(np.concatenate(corners) - eye).first_hits(rays)
    return np.asarray((1 - reach) * np.linalg.norm(rays, axis=1) < TOLERANCE)


def logistic(directions: Array, was_seen: Array) -> Array:
    """Fit the weights (4,) of a direction's x, y, z and 1."""
    x = np.column_stack([directions, np.ones(len(directions))])
    sign = np.where(was_seen, 1.0, -1.0)

    def loss(w: Array) -> float:
        return float(np.logaddexp(0, -sign * (x @ w)).sum() + RIDGE * (w @ w))

    return np.asarray(minimize(loss, np.zeros(4), method="BFGS").x)


def write_shapes(path: Path, samples_per_model: int) -> None:
    """Write the shape space of the fleet."""
    rng = np.random.default_rng(0)
    kinds: dict[str, list[Array]] = {}
    weights: dict[str, list[float]] = {}
    shares: dict[str, float] = {}
    heavy: dict[str, bool] = {}
    usual = {entry.vehicle.vehicle_type for entry in fleet(further=False).values()}
    for model, entry in fleet().items():
        if entry.held_out:
            continue
        kind = entry.vehicle.vehicle_type
        samples = [row(entry.vehicle)]
        for _ in range(samples_per_model):
            vehicle = build_vehicle(model, jittered(model, rng))
            # Equally to the left and to the right, so that the mean vehicle is symmetric.
            bends = rng.normal(0, math.radians(BEND_DEG), BENDS) if vehicle.trailer else np.zeros(1)
            samples += [row(vehicle, bend) for bend in np.unique([bends, -bends])]
        kinds.setdefault(kind, []).append(np.stack(samples))
        weights.setdefault(kind, []).append(entry.share)
        heavy[kind] = entry.vehicle.mass > DEMAND_LIMITS.heavy_from_kg
        # Further models of a type share the traffic of that type.
        if not entry.further or kind not in usual:
            shares[kind] = shares.get(kind, 0.0) + entry.share

    # Deviations of models from their type, relative to the type's dimensions, and the weight of each model.
    between: dict[bool, list[tuple[Array, float]]] = {True: [], False: []}
    means: dict[str, Array] = {}
    for kind, models in kinds.items():
        each, often = np.stack([samples.mean(axis=0) for samples in models]), np.array(weights[kind])
        means[kind] = mean = np.average(each, axis=0, weights=often)
        counted = often.sum() ** 2 / (often**2).sum()
        unbiased = np.sqrt(counted / max(1.0, counted - 1))
        between[heavy[kind]] += [
            ((shape - mean) / mean[-1] * unbiased, w) for shape, w in zip(each, often, strict=True)
        ]
    lines = []
    for kind, models in sorted(kinds.items()):
        mean = means[kind]
        deviations = np.concatenate(models) - mean
        often = np.repeat(weights[kind], [len(samples) for samples in models])
        pooled, frequent = zip(*between[heavy[kind]], strict=True)
        # Rows whose sum of squares is the covariance.
        scaled = np.concatenate(
            [
                deviations * np.sqrt(often / often.sum())[:, None, None],
                np.stack(pooled) * mean[-1] * np.sqrt(POOLED * np.array(frequent) / sum(frequent))[:, None, None],
            ]
        )
        _, spread, basis = np.linalg.svd(scaled.reshape(len(scaled), -1), full_matrices=False)
        directions = (spread[:, None] * basis).reshape(-1, keypoints.K + 1, 3)
        rest = np.sqrt((directions[DIRECTIONS:, :-1] ** 2).sum(axis=0).mean(axis=1))
        share = shares[kind] / sum(shares.values())
        ways = ",\n".join(text(direction) for direction in directions[:DIRECTIONS])
        lines.append(
            f'"{kind}":{{"share":{share:.4f},\n"mean":{text(mean)},\n"directions":[{ways}],\n"rest":{text(rest)}}}'
        )
        print(
            f"{kind:<10} {len(deviations):3d} shapes; {rest.mean():.3f} m per keypoint beyond {DIRECTIONS} directions"
        )
    write_types(path, '"unit":"m",\n', lines)


def write_visibility(path: Path, azimuth_step_deg: float) -> None:
    """Write the directions from which keypoints are visible."""
    azimuths = np.radians(np.arange(0, 360, azimuth_step_deg))
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
        print(f"{kind:<10} {hit.mean():.1%} visible, {(guess == hit).mean():.1%} of them predicted correctly")
        lines.append(f'"{kind}":[{",".join(f"{value:.2f}" for value in rows.ravel())}]')
    write_types(path, "", lines)


def write_types(path: Path, head: str, lines: list[str]) -> None:
    """Write a file with at least one line per body type."""
    body = ",\n".join(lines)
    write_text(path, f'{{"version":1,"scheme":"{keypoints.SCHEME}",{head}"types":{{\n{body}\n}}}}\n')
    print(f"wrote {path} ({path.stat().st_size / 1000:.0f} kB)")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=12, help="jittered shapes per model")
    parser.add_argument("--azimuth-step", type=float, default=15, help="degrees between the eyes around a vehicle")
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "skope" / "pose", help="folder")
    options = parser.parse_args()
    write_shapes(options.out / "vehicle_shapes.json", options.samples)
    write_visibility(options.out / "keypoint_visibility.json", options.azimuth_step)


if __name__ == "__main__":
    main()
