"""Work out the fleet's shape space for `skope eval pose`: of each body type the mean and principal directions of its
33 keypoints and its dimensions. Writes skope/pose/vehicle_shapes.json; takes two minutes. Run after the fleet
changes:

    python scripts/vehicle_shapes.py

Models that are held out for test sites are left out here too, so that evaluation meets shapes that nobody has seen.
Each model counts as often as it drives by. A type may have two models only: how much its unseen models may differ is
taken from how much the models of all types, of heavy and of other vehicles apart, differ from their type's mean, in
shares of its length, width and height. Trailers of articulated vehicles bend behind them, `BEND_DEG` as a rule.
"""

import argparse
import math
from pathlib import Path

import numpy as np

from skope import keypoints
from skope.files.atomic import write_text
from skope.gen.labels.boxes_and_masks import box_around
from skope.gen.traffic.demand import DEMAND_LIMITS
from skope.gen.vehicles.fleet import build_vehicle, fleet, jittered
from skope.gen.vehicles.model import ON_TRAILER, Vehicle

DEFAULT_OUT = Path(__file__).parents[1] / "skope" / "eval" / "pose" / "vehicle_shapes.json"
POOLED = 0.5
"""Share of the other types' variance between models that a type gets besides its own."""
DIRECTIONS = 8
BEND_DEG = 3.0
"""Standard deviation of the angle between an articulated vehicle and its trailer, degrees."""
BENDS = 2
"""Angles to either side that each shape of an articulated vehicle is taken at."""
Array = np.ndarray


def row(vehicle: Vehicle, bend: float = 0.0) -> Array:
    """(34, 3) keypoints and, last, length, width, height; metres. A trailer is bent by so many radians.

    The origin is on the road under the middle of the box around the whole vehicle, along the axes of its first part.
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=12, help="jittered shapes of each model")
    parser.add_argument("--out", type=Path, default=DEFAULT_OUT)
    options = parser.parse_args()
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
        for _ in range(options.samples):
            vehicle = build_vehicle(model, jittered(model, rng))
            # As much to the left as to the right, so that the mean vehicle is symmetric.
            bends = rng.normal(0, math.radians(BEND_DEG), BENDS) if vehicle.trailer else np.zeros(1)
            samples += [row(vehicle, bend) for bend in np.unique([bends, -bends])]
        kinds.setdefault(kind, []).append(np.stack(samples))
        weights.setdefault(kind, []).append(entry.share)
        heavy[kind] = entry.vehicle.mass > DEMAND_LIMITS.heavy_from_kg
        # Further models of a type share its traffic with the others.
        if not entry.further or kind not in usual:
            shares[kind] = shares.get(kind, 0.0) + entry.share

    # Deviations of models from their type, in shares of the type's dimensions, and how often each drives by.
    between: dict[bool, list[tuple[Array, float]]] = {True: [], False: []}
    means: dict[str, Array] = {}
    for kind, models in kinds.items():
        each, often = np.stack([samples.mean(axis=0) for samples in models]), np.array(weights[kind])
        means[kind] = mean = np.average(each, axis=0, weights=often)
        counted = often.sum() ** 2 / (often**2).sum()
        unbiased = np.sqrt(counted / max(1.0, counted - 1))
        between[heavy[kind]] += [((one - mean) / mean[-1] * unbiased, w) for one, w in zip(each, often, strict=True)]
    lines = []
    for kind, models in sorted(kinds.items()):
        mean = means[kind]
        own = np.concatenate(models) - mean
        often = np.repeat(weights[kind], [len(samples) for samples in models])
        others, frequent = zip(*between[heavy[kind]], strict=True)
        # Rows whose sum of squares is the covariance.
        scaled = np.concatenate(
            [
                own * np.sqrt(often / often.sum())[:, None, None],
                np.stack(others) * mean[-1] * np.sqrt(POOLED * np.array(frequent) / sum(frequent))[:, None, None],
            ]
        )
        _, spread, basis = np.linalg.svd(scaled.reshape(len(scaled), -1), full_matrices=False)
        directions = (spread[:, None] * basis).reshape(-1, keypoints.K + 1, 3)
        rest = np.sqrt((directions[DIRECTIONS:, :-1] ** 2).sum(axis=0).mean(axis=1))
        share = shares[kind] / sum(shares.values())
        ways = ",\n".join(text(one) for one in directions[:DIRECTIONS])
        lines.append(
            f'"{kind}":{{"share":{share:.4f},\n"mean":{text(mean)},\n"directions":[{ways}],\n"rest":{text(rest)}}}'
        )
        print(
            f"{kind:<10} {len(own):3d} shapes; beyond {DIRECTIONS} directions a keypoint has {rest.mean():.3f} m left"
        )
    head = f'"version":1,"scheme":"{keypoints.SCHEME}","unit":"m"'
    body = ",\n".join(lines)
    write_text(options.out, f'{{{head},\n"types":{{\n{body}\n}}}}\n')
    print(f"wrote {options.out} ({options.out.stat().st_size / 1000:.0f} kB)")


def text(values: Array) -> str:
    """Numbers of a JSON list at 0.1 mm."""
    return f"[{','.join(f'{value:.4f}' for value in (np.round(values, 4) + 0.0).ravel())}]"


if __name__ == "__main__":
    main()
