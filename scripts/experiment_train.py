"""What a shortcut or a choice does to PCK: the same training with and without it, over several seeds.

    python scripts/experiment_train.py --data data/skope --init auto --epochs 10 --device cuda --out runs/experiment

Each variant trains the same recipe with some values set otherwise, from the same weights, on the same images for the
same number of steps, once a seed, and is measured on the test splits in float32. Finished trainings are not done again:
the same command goes on after an interruption. The table gives mean and sample standard deviation over the seeds;
`exact` is torchvision's own arithmetic, without any shortcut.
"""

import argparse
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from skope import detector
from skope.console import Console
from skope.dataset import open_dataset, take
from skope.files import read_json, write_json, write_text
from skope.train import loop, run, validate
from skope.train.recipe import RECIPES, Recipe, adjusted
from skope.train.run import RunConfig

EXACT = ("bfloat16=false", "keypoint_regions=none", "fold_norms=false", "channels_last=false")
FAST = ("bfloat16=true", "keypoint_regions=16", "fold_norms=true", "channels_last=true")
SIGHT = "supervise=visible"
LIVELY = tuple(f"augment.{name}" for name in ("crop=0.5", "occluders=0.3", "brightness=0.3", "color=0.3", "jpeg=0.2"))

VARIANTS: Mapping[str, Sequence[str]] = {
    "exact": (*EXACT, SIGHT),
    "folded norms, channels last": (*EXACT[:2], *FAST[2:], SIGHT),
    "bfloat16": (FAST[0], *EXACT[1:], SIGHT),
    "16 keypoint regions": (EXACT[0], FAST[1], *EXACT[2:], SIGHT),
    "8 keypoint regions": (EXACT[0], "keypoint_regions=8", *EXACT[2:], SIGHT),
    "all shortcuts": (*FAST, SIGHT),
    "all shortcuts, hidden points learnt": (*FAST, "supervise=all"),
    "all shortcuts, augmented": (*FAST, SIGHT, *LIVELY),
}
FIGURES = ("pck", "pck_given", "keypoint_recall", "box_recall")

Row = dict[str, Any]


def main() -> None:
    options = parse()
    rows = [
        measured(options, name, seed) for seed in range(options.seeds) for name in options.variants or tuple(VARIANTS)
    ]
    write_json(options.out / "results.json", rows)
    text = table(rows, options.splits)
    write_text(options.out / "results.md", text)
    print(text)


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--out", type=Path, default=Path("runs/experiment"))
    parser.add_argument("--recipe", default="paper", choices=tuple(RECIPES))
    parser.add_argument("--init", default="auto", help="as `skope train` takes it")
    parser.add_argument("--epochs", type=int)
    parser.add_argument("--min-size", type=int)
    parser.add_argument("--max-images", type=int)
    parser.add_argument("--set", action="append", default=[], help="a value of the recipe, for every variant")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--variants", nargs="*", choices=tuple(VARIANTS), help="default: all")
    parser.add_argument("--splits", nargs="*", default=["easy", "medium", "hard"])
    parser.add_argument("--test-images", type=int, default=300, help="of each split, with vehicles, evenly spread")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--workers", type=int, default=8)
    return parser.parse_args()


def recipe_of(options: argparse.Namespace, name: str) -> Recipe:
    common = [f"init={options.init}", *([f"epochs={options.epochs}"] if options.epochs else []), *options.set]
    recipe = adjusted(RECIPES[options.recipe], [*common, *VARIANTS[name]])
    return recipe.with_min_size(options.min_size) if options.min_size else recipe


def measured(options: argparse.Namespace, name: str, seed: int) -> Row:
    """Train and measure, or what was found when that was done before."""
    folder = options.out / f"{name.replace(' ', '_').replace(',', '')}_{seed}"
    done = folder / "result.json"
    if done.is_file():
        return dict(read_json(done))
    device = detector.choose_device(options.device)
    recipe = recipe_of(options, name)
    config = RunConfig(recipe=recipe, seed=seed, data=(str(options.data),), mix=None, max_images=options.max_images)
    console = Console()
    console.say(f"--- {name}, seed {seed}")
    workers = options.workers if device.type == "cuda" else 0
    checkpoint = loop.train(
        config,
        folder,
        device=device,
        workers=workers,
        resume=run.resumable(folder),
        console=console,
        saving=loop.Saving(),
    )
    row = {"variant": name, "seed": seed, "splits": figures(options, checkpoint, device), "recipe": recipe.to_dict()}
    write_json(done, row)
    for heavy in (checkpoint, folder / "resume.pt", folder / run.BEST):
        heavy.unlink(missing_ok=True)
    return row


def figures(options: argparse.Namespace, checkpoint: Path, device: torch.device) -> dict[str, Row]:
    """Of each test split."""
    model, _, _ = detector.load_weights(checkpoint, device)
    data = open_dataset(options.data)
    found = {}
    for split in options.splits:
        file = take(data.read(split), options.test_images)
        paths = [data.root / image.file_name for image in file.images]
        found[split] = validate.validate(model, file, paths, device)
    return found


def table(rows: Sequence[Row], splits: Sequence[str]) -> str:
    """Markdown: a line for each variant and split."""
    lines = ["| variant | split | " + " | ".join(FIGURES) + " |", "|---" * (2 + len(FIGURES)) + "|"]
    for name in dict.fromkeys(row["variant"] for row in rows):
        for split in splits:
            cells = []
            for figure in FIGURES:
                values = [row["splits"][split][figure] for row in rows if row["variant"] == name]
                known = [100 * value for value in values if value is not None]
                spread = f" ± {statistics.stdev(known):.2f}" if len(known) > 1 else ""
                cells.append(f"{statistics.mean(known):.2f}{spread}" if known else "-")
            lines.append(f"| {name} | {split} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
