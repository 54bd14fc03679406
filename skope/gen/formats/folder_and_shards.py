"""A dataset that `skope gen` made, in folders or in shards."""

from dataclasses import replace
from itertools import islice
from pathlib import Path

from skope.dataset.folder import CARD, MANIFEST, Dataset
from skope.errors import UserError
from skope.files.atomic import write_bytes
from skope.files.reading import read_bytes
from skope.gen.output import dataset_card
from skope.gen.output.parameters import DatasetPlan
from skope.gen.output.writers import frames_of_split, writer_of
from skope.terminal.console import Console


def convert(dataset: Dataset, form: str, out: Path, console: Console) -> None:
    """Write a dataset that `skope gen` made in the other of the two forms at `out`, an empty folder."""
    if not (dataset.root / MANIFEST).is_file():
        raise UserError(f"{dataset.root / MANIFEST}: no such file: only what `skope gen` made can be converted")
    if not dataset.card.get("takes") or "parameters" not in dataset.card:
        raise UserError(f"{dataset.root / CARD}: takes, parameters: missing")
    plan = DatasetPlan.from_dict(dataset.card, dataset.root / CARD)
    if form == dataset.card.get("format"):
        raise UserError(f"{dataset.root}: is in this format already ({form})")
    writer = writer_of(form, out, dataset.scheme, dataset.categories)
    for name in sorted(p.name for p in (dataset.root / "recordings").glob("*.npz")):
        write_bytes(out / "recordings" / name, read_bytes(dataset.root / "recordings" / name))
        writer.add_file(Path("recordings") / name)
    splits = {split: frames_of_split(dataset, split) for split in {info.split: None for info in plan.recordings}}
    for info in console.bar(plan.recordings, unit="recording", label=f"writing {form}"):
        frames = list(islice(splits[info.split], info.frames))
        if len(frames) < info.frames:
            raise UserError(f"{dataset.root}: {info.split}: has fewer images than its card says; see `skope gen check`")
        writer.add(info.split, frames)
    writer.finish()
    parameters = replace(plan.parameters, format=form)
    content = {**dataset.card, "format": form, "parameters": parameters.to_dict()}
    dataset_card.write_card(out, {**content, "command": dataset_card.command(parameters)})
