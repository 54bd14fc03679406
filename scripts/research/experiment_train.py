"""Effect of a shortcut, a choice or a label rule on PCK: the same training with and without it, over several seeds.

    python scripts/research/experiment_train.py --data data/skope --init auto --epochs 10 --device cuda --out runs/x

Each variant trains the same recipe with some values changed, from the same weights, on the same images for the same
number of steps, once per seed, and is measured on the test splits in float32. Finished trainings are not repeated: the
same command resumes after an interruption. The table gives mean and sample standard deviation over the seeds. `exact`
is torchvision's own arithmetic, without any shortcut. Variants of the labels (visible boxes, no ignored vehicles) train
on a copy of the annotations, and `varied` on the dataset of --varied. All are measured on the test splits of --data,
`visible boxes` also on its own kind of box, and on those of --varied if it is given.

On a machine with several GPUs start it several times, with different --variants or --seeds and CUDA_VISIBLE_DEVICES;
the command with all of them then adds what is missing and prints the table. --fresh-heads takes only backbone and
pyramid from --init, as from COCO weights, which do not know these keypoints either.

--images NAME=FOLDER, repeated, compares datasets: the same short training on as many images of each dataset, from
--init (such as the detector of the package), measured on the test splits of --data and on hand-labelled --photographs
(see scripts/score_photographs.py; each use is logged in a folder of its own under --out). Vehicles of the photographs
are paired: paired.md gives differences from the first dataset with their standard error over vehicles.

    python scripts/research/experiment_train.py --images varied=data/varied --images world=data/world --data data/tests
        --init road33 --set learning_rate=0.004 --max-images 1900 --epochs 3 --photographs real --out runs/worth
"""

import argparse
import shutil
import statistics
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torchvision.models.detection import KeypointRCNN

from skope.dataset.folder import CARD_FILE, open_dataset
from skope.dataset.image_selection import take
from skope.detector.build import build
from skope.detector.checkpoint import find_checkpoint, load_weights, save_weights
from skope.detector.device import choose_device
from skope.files.atomic import write_text
from skope.files.json_files import read_json, write_json
from skope.schema import VEHICLE_TYPES
from skope.terminal.console import Console
from skope.train import loop, splits, training_state, validate
from skope.train.recipe import SHIPPED_RECIPES, Recipe, adjusted_recipe
from skope.train.run_config import RunConfig

EXACT = ("bfloat16=false", "keypoint_regions=none", "fold_norms=false", "channels_last=false")
FAST = ("bfloat16=true", "keypoint_regions=48", "fold_norms=true", "channels_last=true")
VISIBLE_ONLY = "supervise=visible"
LIVELY = tuple(f"augment.{name}" for name in ("crop=0.5", "occluders=0.3", "brightness=0.3", "color=0.3", "jpeg=0.2"))

Row = dict[str, Any]


@dataclass(frozen=True)
class Variant:
    """One way to train."""

    settings: Sequence[str]
    labels: Callable[[Sequence[Row]], list[Row]] | None = None
    """Changes the rows of the annotation file before training."""
    measured_so: bool = False
    """Whether the test splits are also measured with `labels`."""
    varied: bool = False
    """Whether it trains on --varied."""
    images: Path | None = None
    """Dataset to train on instead of --data."""


def visible_boxes(rows: Sequence[Row]) -> list[Row]:
    return [{**row, "bbox": row["bbox_visible"]} for row in rows]


def none_ignored(rows: Sequence[Row]) -> list[Row]:
    """Train on ignored vehicles as background."""
    return [row for row in rows if not row["iscrowd"]]


VARIANTS: dict[str, Variant] = {
    "exact": Variant((*EXACT, VISIBLE_ONLY)),
    "folded norms, channels last": Variant((*EXACT[:2], *FAST[2:], VISIBLE_ONLY)),
    "bfloat16": Variant((FAST[0], *EXACT[1:], VISIBLE_ONLY)),
    "16 keypoint regions": Variant((EXACT[0], "keypoint_regions=16", *EXACT[2:], VISIBLE_ONLY)),
    "32 keypoint regions": Variant((EXACT[0], "keypoint_regions=32", *EXACT[2:], VISIBLE_ONLY)),
    "all shortcuts": Variant((*FAST, VISIBLE_ONLY)),
    "all shortcuts, 32 keypoint regions": Variant((FAST[0], "keypoint_regions=32", *FAST[2:], VISIBLE_ONLY)),
    "hidden points learnt": Variant((*FAST, "supervise=all")),
    "augmented": Variant((*FAST, VISIBLE_ONLY, *LIVELY)),
    "visible boxes": Variant((*FAST, VISIBLE_ONLY), labels=visible_boxes, measured_so=True),
    "none ignored": Variant((*FAST, VISIBLE_ONLY), labels=none_ignored),
    "no pickups": Variant((*FAST, VISIBLE_ONLY, "exclude_types=pickup")),
    "varied cameras": Variant((*FAST, VISIBLE_ONLY), varied=True),
}
FIGURES = ("pck", "pck_given", "keypoint_recall", "box_recall")


def main() -> None:
    options = parse()
    VARIANTS.update({name: Variant((*FAST, VISIBLE_ONLY, *LIVELY), images=Path(at)) for name, at in options.images})
    names = options.variants or [name for name, _ in options.images]
    names = names or [name for name, variant in VARIANTS.items() if options.varied or not variant.varied]
    if options.fresh_heads:
        options.init = str(headless(options.init, options.out / "first_weights.safetensors"))
    rows = [measured(options, name, seed) for seed in options.seeds for name in names]
    write_json(options.out / "results.json", rows)
    text = table(rows)
    write_text(options.out / "results.md", text)
    print(text)
    if options.photographs:
        write_text(options.out / "paired.md", paired(rows, names))
        print(paired(rows, names))


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--varied", type=Path, help="dataset of the preset `varied`")
    parser.add_argument(
        "--images", type=named_folder, action="append", default=[], metavar="NAME=FOLDER", help="train on this dataset"
    )
    parser.add_argument("--photographs", type=Path, help="folder of hand-labelled photographs")
    parser.add_argument("--out", type=Path, default=Path("runs/experiment"))
    parser.add_argument("--recipe", default="paper", choices=tuple(SHIPPED_RECIPES))
    parser.add_argument("--init", default="auto", help="as `skope train` takes it")
    parser.add_argument("--fresh-heads", action="store_true", help="take only the backbone of the checkpoint --init")
    parser.add_argument("--epochs", type=int)
    parser.add_argument("--min-size", type=int)
    parser.add_argument("--max-images", type=int)
    parser.add_argument("--set", action="append", default=[], help="set a value of the recipe in every variant")
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 1, 2])
    parser.add_argument("--variants", nargs="*", help=f"default: all of --images, or all of {', '.join(VARIANTS)}")
    parser.add_argument("--splits", nargs="*", default=["easy", "medium", "hard"])
    parser.add_argument("--test-images", type=int, default=300, help="images with vehicles per split, evenly spread")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--workers", type=int, default=8)
    return parser.parse_args()


def named_folder(text: str) -> tuple[str, Path]:
    name, _, folder = text.partition("=")
    return name, Path(folder)


def recipe_of(options: argparse.Namespace, name: str) -> Recipe:
    common = [f"init={options.init}", *([f"epochs={options.epochs}"] if options.epochs else []), *options.set]
    variant = VARIANTS[name]
    # No flag changes what defines a variant. Where images define it, --set may change everything else.
    settings = [*variant.settings, *common] if variant.images else [*common, *variant.settings]
    recipe = adjusted_recipe(SHIPPED_RECIPES[options.recipe], settings)
    return recipe.with_min_size(options.min_size) if options.min_size else recipe


def headless(init: str, path: Path) -> Path:
    """Write weights with the backbone and pyramid of a checkpoint, and untrained heads; returns the path."""
    model, config, _ = load_weights(find_checkpoint(Path(init)), torch.device("cpu"))
    kept = {name: value for name, value in model.state_dict().items() if name.startswith("backbone.")}
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        fresh = build(config, trainable_layers=5)
    fresh.load_state_dict({**fresh.state_dict(), **kept})
    save_weights(path, fresh, config, {})
    return path


def measured(options: argparse.Namespace, name: str, seed: int) -> Row:
    """Train and measure, or return the result of an earlier run."""
    folder = options.out / f"{name.replace(' ', '_').replace(',', '')}_{seed}"
    done = folder / "result.json"
    if done.is_file():
        return dict(read_json(done))
    device = choose_device(options.device)
    recipe, variant = recipe_of(options, name), VARIANTS[name]
    data = variant.images or (options.varied if variant.varied else options.data)
    training_data = relabelled(data, variant.labels, folder / "data") if variant.labels else data
    config = RunConfig(recipe=recipe, seed=seed, data=(str(training_data),), mix=None, max_images=options.max_images)
    console = Console()
    console.say(f"--- {name}, seed {seed}")
    checkpoint = loop.train(
        config,
        folder / "run",
        device=device,
        workers=options.workers if device.type == "cuda" else 0,
        resume=training_state.resumable(folder / "run"),
        console=console,
        saving=loop.CheckpointPolicy(),
    )
    model, detector, _ = load_weights(checkpoint, device)

    def figures_on(folder: Path) -> dict[str, Row]:
        return figures(options, model, detector.categories, folder, device)

    found = figures_on(options.data)
    if variant.measured_so:
        found |= {f"{split}, its own boxes": row for split, row in figures_on(training_data).items()}
    if options.varied:
        found |= {f"{split}, varied": row for split, row in figures_on(options.varied).items()}
    row = {"variant": name, "seed": seed, "splits": found, "recipe": recipe.to_dict()}
    if options.photographs:
        row["photographs"] = on_photographs(options.photographs, checkpoint, folder / "photographs", device)
    write_json(done, row)
    for heavy in (folder / "run", folder / "data"):
        shutil.rmtree(heavy, ignore_errors=True)
    return row


def on_photographs(photographs: Path, checkpoint: Path, out: Path, device: torch.device) -> Row:
    """Run scripts/score_photographs.py; returns its figures of all photographs and of each vehicle."""
    script = Path(__file__).parents[1] / "score_photographs.py"
    command = [sys.executable, str(script), str(photographs), "--checkpoint", str(checkpoint), "--out", str(out)]
    subprocess.run([*command, "--device", str(device)], check=True, stdout=subprocess.DEVNULL)
    found = read_json(out / "metrics.json")
    scenes = {name: scene["keypoints"]["share_of_all"] for name, scene in found["scenes"].items()}
    return {"all": found["all"], "scenes": scenes, "vehicles": found["vehicles"]}


def paired(rows: Sequence[Row], names: Sequence[str]) -> str:
    """Format figures on the photographs, and differences from the first variant, as Markdown.

    Differences are means over the seeds, with their standard error over vehicles.
    """
    head = ["images", "found, %", "in given boxes, %", "difference", "difference in given boxes"]
    head += ["AP50", "recall at precision .90", "phantoms per frame"]
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    first: dict[str, np.ndarray] = {}
    for name in names:
        scored = [row["photographs"] for row in rows if row["variant"] == name]
        points, boxes = ([row["all"][part] for row in scored] for part in ("keypoints", "boxes"))
        cells = [name]
        shown = ("share_of_all", "share_in_given_boxes")
        cells += [spread([100 * of[figure] for of in points]) for figure in shown]
        for figure in ("found", "found_in_given_boxes"):
            shares = np.array(
                [[v[figure], v["labelled"]] for row in scored for v in row["vehicles"].values()], dtype=float
            )
            mine = shares.reshape(len(scored), -1, 2).mean(axis=0)
            gap = 100 * (mine[:, 0] - first.setdefault(figure, mine)[:, 0]) / mine[:, 1].mean()
            cells.append(f"{gap.mean():+.1f} ± {gap.std(ddof=1) / len(gap) ** 0.5:.1f}")
        cells.append(spread([of["ap50"] for of in boxes], 3))
        cells.append(spread([of["recall_at_precision"]["0.90"]["recall"] for of in boxes], 3))
        cells.append(spread([of["phantoms_a_frame"] for of in boxes], 1))
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def spread(values: Sequence[float], digits: int = 1) -> str:
    """Format the mean, and the standard deviation of several values."""
    beside = f" ± {statistics.stdev(values):.{digits}f}" if len(values) > 1 else ""
    return f"{statistics.mean(values):.{digits}f}{beside}"


def relabelled(data: Path, change: Callable[[Sequence[Row]], list[Row]], out: Path) -> Path:
    """Write a dataset folder with the images of another one and changed annotations."""
    for path in (data / "annotations").glob("*.json"):
        document = read_json(path)
        write_json(out / "annotations" / path.name, {**document, "annotations": change(document["annotations"])})
    for name in ("images", "depth"):
        if (data / name).is_dir() and not (out / name).exists():
            (out / name).symlink_to((data / name).resolve(), target_is_directory=True)
    write_json(out / CARD_FILE, read_json(data / CARD_FILE))
    return out


def figures(
    options: argparse.Namespace, model: KeypointRCNN, categories: Sequence[str], folder: Path, device: torch.device
) -> dict[str, Row]:
    """Measure each test split, and its pickups alone if it has any."""
    data = open_dataset(folder)
    found = {}
    for split in options.splits:
        file = splits.of_categories(take(data.read(split), options.test_images), categories)
        paths = [data.root / image.file_name for image in file.images]
        results = validate.run_model(model, file, paths, device)
        found[split] = validate.figures(file, results)
        pickups = splits.excluding(file, [name for name in VEHICLE_TYPES if name != "pickup"])
        if not all(annotation.ignored for annotation in pickups.annotations):
            found[f"{split}, pickups"] = validate.figures(pickups, results)
    return found


def table(rows: Sequence[Row]) -> str:
    """Format a row for each variant and split as Markdown."""
    lines = ["| variant | split | " + " | ".join(FIGURES) + " |", "|---" * (2 + len(FIGURES)) + "|"]
    for name in dict.fromkeys(row["variant"] for row in rows):
        by_seed = [row["splits"] for row in rows if row["variant"] == name]
        for split in by_seed[0]:
            cells = []
            for figure in FIGURES:
                known = [100 * row[split][figure] for row in by_seed if row[split][figure] is not None]
                spread = f" ± {statistics.stdev(known):.2f}" if len(known) > 1 else ""
                cells.append(f"{statistics.mean(known):.2f}{spread}" if known else "-")
            lines.append(f"| {name} | {split} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
