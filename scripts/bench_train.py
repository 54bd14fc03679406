"""Images per second of a training step, compared with torchvision's own reference loop on the same machine.

    python scripts/bench_train.py --data data/skope                         (this machine's CPU)
    python scripts/bench_train.py --data data/skope --device cuda --amp --min-size 800 --steps 100
    torchrun --nproc-per-node 2 scripts/bench_train.py --data data/skope --device cuda --only skope --checkpoint RUN ...

The reference is the loop of torchvision's references/detection (its dataset, transforms, data loader and
train_one_epoch, reimplemented here), and its model Keypoint R-CNN with 33 keypoints, frozen norms and three trainable
stages. Both contenders start from the same weights and train on the same images in the same order and size. They run
alternately, each in a process of its own, so that memory and other load affect both equally.

The amount of work of the keypoint head depends on the number of proposals on vehicles. Both contenders therefore start
from a trained detector, `road33` unless `--checkpoint` names another one. The mean number of regions on vehicles per
image is printed.
"""

import argparse
import dataclasses
import json
import resource
import time
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
import torchvision
from benchmark import in_own_process, in_turn, machine, print_head, print_row
from PIL import Image
from torchvision.models.detection import KeypointRCNN
from torchvision.models.detection.backbone_utils import resnet_fpn_backbone
from torchvision.transforms import functional

from skope import keypoints
from skope.dataset.folder import open_dataset
from skope.detector.checkpoint import find_checkpoint, read_checkpoint
from skope.detector.device import has_bfloat16
from skope.terminal.console import Console
from skope.train import configure, distributed, init_weights, losses, optimizer, splits, step, training_samples
from skope.train.distributed import ProcessGroup
from skope.train.fold_batchnorm import fold_norms
from skope.train.recipe import SHIPPED_RECIPES, Recipe, adjusted_recipe
from skope.train.sample_loader import Loader
from skope.train.training_state import TrainingState

Batches = Iterable[Any]

SHORTCUTS = ("bfloat16=false", "keypoint_regions=none", "fold_norms=false", "channels_last=false")


def main() -> None:
    options = parse()
    if options.only:
        print(json.dumps(measured(options)), flush=True)
        return
    contenders: dict[str, list[str]] = {"torchvision": [], "skope": []}
    if options.each:
        contenders |= {f"skope {value}": ["--set", value] for value in SHORTCUTS}
    ways = {name: partial(in_own_process, "--only", name.split()[0], *more) for name, more in contenders.items()}
    report(options, in_turn(ways, options.rounds))


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="dataset folder; its split `train` is used")
    parser.add_argument(
        "--checkpoint", type=Path, default=Path("road33"), help="a trained detector: name, run folder or file"
    )
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--amp", action="store_true", help="the reference's own --amp flag")
    parser.add_argument("--batch-size", type=int, default=2, help="images per step and process")
    parser.add_argument("--min-size", type=int, default=360)
    parser.add_argument("--steps", type=int, default=5, help="measured steps of each contender and round")
    parser.add_argument("--warm-up", type=int, default=1, help="steps before the measured ones")
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--workers", type=int, default=None, help="loading processes (reference: 4 as in its script)")
    parser.add_argument("--set", action="append", default=[], help="a value of skope's recipe")
    parser.add_argument("--each", action="store_true", help="also measure without each shortcut")
    parser.add_argument("--only", choices=("torchvision", "skope"), help="measure one, in this process, as JSON")
    return parser.parse_args()


def recipe_of(options: argparse.Namespace) -> Recipe:
    """Return skope's default recipe with bounded keypoint regions, at the reference's input size."""
    bfloat16 = options.device != "cpu" or has_bfloat16(torch.device("cpu"))
    laptop = dataclasses.replace(SHIPPED_RECIPES["laptop"], bfloat16=bfloat16, val_fraction=0.0)
    return adjusted_recipe(laptop.with_min_size(options.min_size), options.set)


# ---------------------------------------------------------------------------------------------------------- contenders


def measured(options: argparse.Namespace) -> dict[str, Any]:
    """Measure the speed and memory of one contender in this process."""
    torch.manual_seed(0)
    with distributed.process_group(torch.device(options.device)) as (processes, device):
        batches, learn, trained = (reference if options.only == "torchvision" else skope)(options, device, processes)
        seen, stop_counting = count_vehicle_regions(trained)
        passed: list[float] = []
        cpu = 0.0
        for i, batch in enumerate(batches):
            if i == options.warm_up:
                stop_counting()
                cpu = time.process_time()
            if i >= options.warm_up:
                synchronise(device)
                passed.append(time.perf_counter())
            if i == options.warm_up + options.steps:
                break
            learn(batch)
        synchronise(device)
        images = options.steps * options.batch_size
        return {
            "images_per_s": images * processes.size / (passed[-1] - passed[0]),
            "cpu_s_per_image": (time.process_time() - cpu) / images,
            "peak_mb": peak_mb(device),
            "vehicle_regions": sum(seen) / max(1, len(seen)),
            "processes": processes.size,
        }


def reference(
    options: argparse.Namespace, device: torch.device, processes: ProcessGroup
) -> tuple[Batches, Callable[..., None], Any]:
    """Build torchvision's references/detection: dataset, loader, and the body of engine.train_one_epoch."""
    assert processes.size == 1, "the reference is measured in one process"
    backbone = resnet_fpn_backbone(backbone_name="resnet50", weights=None, trainable_layers=3)
    max_size = recipe_of(options).max_size
    model = KeypointRCNN(backbone, 2, num_keypoints=keypoints.K, min_size=options.min_size, max_size=max_size)
    model.load_state_dict(read_checkpoint(find_checkpoint(options.checkpoint))[1])
    model.to(device).train()
    parameters = [p for p in model.parameters() if p.requires_grad]
    optimizer = torch.optim.SGD(parameters, lr=1e-4, momentum=0.9, weight_decay=1e-4)
    scaler = torch.amp.GradScaler(device.type) if options.amp else None
    workers = 4 if options.workers is None and device.type == "cuda" else options.workers or 0
    loader = torch.utils.data.DataLoader(
        ReferenceDataset(options.data),
        batch_sampler=order(options, processes),
        num_workers=workers,
        collate_fn=lambda batch: tuple(zip(*batch, strict=True)),
    )

    def learn(batch: Any) -> None:
        images, targets = batch
        images = [image.to(device) for image in images]
        targets = [{key: value.to(device) for key, value in target.items()} for target in targets]
        with torch.amp.autocast(device.type, enabled=scaler is not None):
            losses = sum(model(images, targets).values())
        assert torch.isfinite(torch.tensor(losses.item()))
        optimizer.zero_grad()
        if scaler is not None:
            scaler.scale(losses).backward()
            scaler.step(optimizer)
            scaler.update()
        else:
            losses.backward()
            optimizer.step()

    return loader, learn, model


class ReferenceDataset(torch.utils.data.Dataset[Any]):
    """CocoDetection, ConvertCocoPolysToMask and the preset `hflip` (backend PIL), for boxes and keypoints.

    A flip renames keypoints by the table of this scheme, because the reference knows only the 17 points of a person.
    """

    def __init__(self, root: Path) -> None:
        opened = open_dataset(root)
        file = opened.read(splits.TRAINING_SPLIT)
        self._root, self._vehicles = root, file.by_image()
        self._images = [image for image in file.images if any(not a.ignored for a in self._vehicles[image.id])]

    def __getitem__(self, index: int) -> Any:
        image = self._images[index]
        pixels = Image.open(self._root / image.file_name).convert("RGB")
        vehicles = [a for a in self._vehicles[image.id] if not a.ignored]
        boxes = torch.as_tensor([a.bbox.tolist() for a in vehicles], dtype=torch.float32).reshape(-1, 4)
        boxes[:, 2:] += boxes[:, :2]
        points = torch.as_tensor([a.keypoints.tolist() for a in vehicles], dtype=torch.float32)
        points[points[..., 2] < 2] = 0  # as in skope, only visible points are learned
        if torch.rand(1) < 0.5:
            pixels = functional.hflip(pixels)
            boxes[:, [0, 2]] = image.width - boxes[:, [2, 0]]
            points = points[:, list(keypoints.FLIP)]
            points[..., 0] = torch.where(points[..., 2] > 0, image.width - points[..., 0], points[..., 0])
        tensor = functional.convert_image_dtype(functional.pil_to_tensor(pixels), torch.float)
        return tensor, {"boxes": boxes, "labels": torch.ones(len(boxes), dtype=torch.int64), "keypoints": points}


def skope(
    options: argparse.Namespace, device: torch.device, processes: ProcessGroup
) -> tuple[Batches, Callable[..., None], Any]:
    """Build skope's loader and training step."""
    recipe = dataclasses.replace(recipe_of(options), batch_size=options.batch_size * processes.size)
    checkpoint = str(options.checkpoint)
    model, config, origin = init_weights.initialise(
        checkpoint,
        norm="frozen",
        min_size=recipe.min_size,
        max_size=recipe.max_size,
        trainable_layers=recipe.trainable_layers,
        seed=0,
    )
    model = optimizer.placed(model, recipe, device)
    if recipe.fold_norms:
        fold_norms(model)
    training = TrainingState(model, config, optimizer.make_sgd(model, recipe), origin, [], 0, 0, {}, [], None)
    source = splits.read(options.data, exclude_types=(), val_fraction=0.0, max_images=count(options.data))
    source = source.of_categories(config.categories)
    images = training_samples.TrainingSet([source], seed=0, augment=recipe.augment, supervise=recipe.supervise)
    groups = [[(0, i, 0) for i in group] for group in order(options, processes)]
    workers = configure.loading_workers(gpu=device.type == "cuda") if options.workers is None else options.workers
    model.train()

    def learn(batch: Sequence[training_samples.TrainingSample]) -> None:
        step.train_on_batch(training, batch, recipe, rate=1e-4, images=recipe.batch_size, processes=processes, votes=())

    loader = Loader(images, workers=workers, console=Console(), pin=device.type == "cuda")
    return loader.batches(groups, max(map(len, groups))), learn, model


def count(root: Path) -> int:
    """Count the images with vehicles."""
    file = open_dataset(root).read(splits.TRAINING_SPLIT)
    return len({a.image_id for a in file.annotations if not a.ignored})


def order(options: argparse.Namespace, processes: ProcessGroup) -> list[list[int]]:
    """Draw the images with vehicles, the same for both contenders. Each of several processes draws its own."""
    number = (options.warm_up + options.steps + 1) * options.batch_size
    generator = torch.Generator().manual_seed(processes.rank)
    drawn = torch.randint(count(options.data), (number,), generator=generator).tolist()
    return [drawn[i : i + options.batch_size] for i in range(0, number, options.batch_size)]


# ----------------------------------------------------------------------------------------------------------- measuring


def count_vehicle_regions(model: KeypointRCNN) -> tuple[list[int], Callable[[], None]]:
    """Count the vehicle regions of each image before any limit; returns the list and a function that stops counting.

    Counting takes time, so it stops before the measured steps.
    """
    seen: list[int] = []
    select, regions = model.roi_heads.select_training_samples, losses._regions

    def selected(*args: Any) -> Any:
        answer = select(*args)
        seen.extend(int((labels > 0).sum()) for labels in answer[2])
        return answer

    def drawn(*args: Any) -> Any:
        answer = regions(*args)
        seen.extend(((answer[1] > 0) & answer[3]).sum(dim=1).tolist())
        return answer

    def stop() -> None:
        model.roi_heads.select_training_samples, losses._regions = select, regions

    model.roi_heads.select_training_samples, losses._regions = selected, drawn
    return seen, stop


def synchronise(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def peak_mb(device: torch.device) -> float:
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 2**20
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10


def report(options: argparse.Namespace, rows: dict[str, list[dict[str, Any]]]) -> None:
    """Print the best figures of each contender, and compare them with torchvision's."""
    names = ("images_per_s", "cpu_s_per_image", "peak_mb", "vehicle_regions")
    best = {name: {key: best_of(key, each) for key in names} for name, each in rows.items()}
    print(f"{machine(options.device)}, torchvision {torchvision.__version__}; batch {options.batch_size}, short side")
    print(f"{options.min_size} px, {options.steps} steps x {options.rounds} rounds, best figures of each contender")
    print_head(("contender", "images/s", "times", "CPU s/image", "times", "peak MB", "vehicle regions/image"))
    peer = best["torchvision"]
    for name, row in best.items():
        faster = row["images_per_s"] / peer["images_per_s"]
        cheaper = peer["cpu_s_per_image"] / row["cpu_s_per_image"]
        rates = (f"{row['images_per_s']:.3f}", f"{faster:.2f}", f"{row['cpu_s_per_image']:.2f}", f"{cheaper:.2f}")
        print_row((name, *rates, f"{row['peak_mb']:.0f}", f"{row['vehicle_regions']:.1f}"))


def best_of(key: str, rows: Sequence[dict[str, Any]]) -> float:
    """Return the best figure over the rounds."""
    values = [float(row[key]) for row in rows]
    return max(values) if key == "images_per_s" else min(values)


if __name__ == "__main__":
    main()
