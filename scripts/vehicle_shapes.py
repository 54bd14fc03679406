"""Work out the fleet's shape space for `skope eval pose`: of each body type the mean and principal directions of its
33 keypoints and its dimensions. Writes skope/eval/pose/vehicle_shapes.json; takes two minutes. Run after the fleet
changes:

    python scripts/vehicle_shapes.py

Models that are held out for test sites are left out here too, so that evaluation meets shapes that nobody has seen.
A type has two models or three: how much its unseen models may differ is taken from how much the models of all types,
of heavy and of other vehicles apart, differ from their type's mean, in shares of its length, width and height. Trailers
of articulated vehicles are straight behind them.
"""

import argparse
from pathlib import Path

import numpy as np

from skope import keypoints
from skope.files.atomic import write_text
from skope.gen.traffic.demand import HEAVY
from skope.gen.vehicles.fleet import build, fleet
from skope.gen.vehicles.model import Vehicle, straight_lwh
from skope.gen.vehicles.shape_jitter import jittered

DEFAULT_OUT = Path(__file__).parents[1] / "skope" / "eval" / "pose" / "vehicle_shapes.json"
POOLED = 0.5
"""Share of the other types' variance between models that a type gets besides its own."""
DIRECTIONS = 8
Array = np.ndarray


def row(vehicle: Vehicle) -> Array:
    """(34, 3) keypoints and, last, length, width, height; metres. A trailer is straight behind its vehicle.

    The origin is on the road under the middle of the whole vehicle.
    """
    size = straight_lwh(vehicle)
    behind = [(size[0] - vehicle.size_lwh[0]) / 2, 0.0, 0.0]
    return np.concatenate([vehicle.points + behind, [size]])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=12, help="jittered shapes of each model")
    parser.add_argument("--out", type=Path, default=DEFAULT_OUT)
    options = parser.parse_args()
    rng = np.random.default_rng(0)
    kinds: dict[str, list[Array]] = {}
    shares: dict[str, float] = {}
    heavy: dict[str, bool] = {}
    usual = {entry.vehicle.vehicle_type for entry in fleet(further=False).values()}
    for model, entry in fleet().items():
        if entry.held_out:
            continue
        kind = entry.vehicle.vehicle_type
        samples = [row(entry.vehicle)] + [row(build(model, jittered(model, rng))) for _ in range(options.samples)]
        kinds.setdefault(kind, []).append(np.stack(samples))
        heavy[kind] = entry.vehicle.mass > HEAVY
        # Further models of a type share its traffic with the others.
        if not entry.further or kind not in usual:
            shares[kind] = shares.get(kind, 0.0) + entry.share

    # Deviations of models from their type, in shares of the type's dimensions.
    between: dict[bool, list[Array]] = {True: [], False: []}
    for kind, models in kinds.items():
        means = np.stack([samples.mean(axis=0) for samples in models])
        mean = means.mean(axis=0)
        between[heavy[kind]] += [
            (one - mean) / mean[-1] * np.sqrt(len(means) / max(1, len(means) - 1)) for one in means
        ]
    lines = []
    for kind, models in sorted(kinds.items()):
        mean = np.stack([samples.mean(axis=0) for samples in models]).mean(axis=0)
        own = np.concatenate(models) - mean
        pooled = np.stack(between[heavy[kind]]) * mean[-1]
        # Rows whose sum of squares is the covariance.
        scaled = np.concatenate([own / np.sqrt(len(own)), pooled * np.sqrt(POOLED / len(pooled))])
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
    head = f'"version":1,"scheme":"{keypoints.SCHEME}","edition":{keypoints.EDITION},"unit":"m"'
    body = ",\n".join(lines)
    write_text(options.out, f'{{{head},\n"types":{{\n{body}\n}}}}\n')
    print(f"wrote {options.out} ({options.out.stat().st_size / 1000:.0f} kB)")


def text(values: Array) -> str:
    """Numbers of a JSON list at 0.1 mm."""
    return f"[{','.join(f'{value:.4f}' for value in (np.round(values, 4) + 0.0).ravel())}]"


if __name__ == "__main__":
    main()
