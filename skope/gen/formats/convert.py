"""Convert datasets between formats (`skope gen convert`)."""

import itertools
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from skope.dataset.folder import CARD_FILE, MANIFEST_FILE, Dataset
from skope.errors import UserError, one_of
from skope.files.atomic import read_bytes, replacing_folder, write_bytes, write_text
from skope.files.output_folders import move_new
from skope.gen.formats import coco_read, coco_write, kitti, mot, skope3d, yolo
from skope.gen.formats.dataset_builder import LICENCE_FILE, SPLIT_NAME, check_outside, dataset_at
from skope.gen.formats.source_files import zipped
from skope.gen.output import dataset_card
from skope.gen.output.parameters import DatasetPlan
from skope.gen.output.writers import DATASET_FORMATS, frames_of_split, writer_of
from skope.terminal.console import Console


def _to_folder_or_shards(dataset: Dataset, form: str, out: Path, console: Console) -> None:
    """Write a dataset that `skope gen` made in the other of the two forms to `out`, an empty folder."""
    if not (dataset.root / MANIFEST_FILE).is_file():
        raise UserError(
            f"{dataset.root / MANIFEST_FILE}: no such file: only datasets made by `skope gen` can be converted"
        )
    if not dataset.card.get("takes") or "parameters" not in dataset.card:
        raise UserError(f"{dataset.root / CARD_FILE}: takes, parameters: missing")
    plan = DatasetPlan.from_dict(dataset.card, dataset.root / CARD_FILE)
    if form == dataset.card.get("format"):
        raise UserError(f"{dataset.root}: is already in this format ({form})")
    writer = writer_of(form, out, dataset.scheme, dataset.categories)
    for name in sorted(p.name for p in (dataset.root / "recordings").glob("*.npz")):
        write_bytes(out / "recordings" / name, read_bytes(dataset.root / "recordings" / name))
        writer.add_file(Path("recordings") / name)
    splits = {split: frames_of_split(dataset, split) for split in {info.split: None for info in plan.recordings}}
    for info in console.bar(plan.recordings, unit="recording", label=f"writing {form}"):
        frames = list(islice(splits[info.split], info.frames))
        if len(frames) < info.frames:
            raise UserError(
                f"{dataset.root}: {info.split}: has fewer images than its card states; see `skope gen check`"
            )
        writer.add(info.split, frames)
    writer.finish()
    parameters = replace(plan.parameters, format=form)
    content = {**dataset.card, "format": form, "parameters": parameters.to_dict()}
    dataset_card.write_card(out, {**content, "command": dataset_card.command(parameters)})


@dataclass(frozen=True, kw_only=True)
class ConversionOptions:
    """Options of single formats; None or empty if the flag is not given."""

    map: Path | None = None
    """File that maps the keypoints of `--from skope3d`."""
    images: Path | None = None
    """Folder with the images of COCO or CVAT annotation files."""
    split: str | None = None
    """Split of everything that is read."""
    stored_pixels: bool = False
    """Whether labels of COCO or CVAT files are in stored pixels, before EXIF rotates the image."""
    keypoints: tuple[str, ...] = ()
    """Names of the keypoints to write; empty for all."""


_OPTION_FORMATS: Final = {
    "map": ("--from skope3d",),
    "images": ("--from coco", "--from cvat"),
    "stored_pixels": ("--from coco", "--from cvat"),
    "keypoints": ("--to yolo",),
    "split": ("--from skope3d", "--from coco", "--from cvat"),
}
"""Formats of each option."""

_FORMAT_WRITERS: Final[Mapping[str, Callable[[Dataset, Path, Console], None]]] = {
    "coco": coco_write.write,
    "cvat": coco_write.write_cvat,
    "kitti": kitti.write,
    "mot": mot.write,
    "skope3d": skope3d.write,
}
_YOLO_FORMAT: Final = "yolo"
WRITER_NAMES: Final = (*DATASET_FORMATS, *_FORMAT_WRITERS, _YOLO_FORMAT)
READER_NAMES: Final = ("coco", "cvat", "skope3d")


def convert_dataset(
    sources: Sequence[Path],
    out: Path,
    *,
    read_as: str | None,
    write_as: str | None,
    options: ConversionOptions,
    console: Console,
) -> None:
    """Write datasets of one format in another.

    Args:
        sources: Files or folders of the format `read_as`; without it, one dataset folder.
        out: An empty or missing folder; for "cvat" it may be a .zip file. It is written completely or not at all.
        read_as: One of `READER_NAMES`; None for a dataset folder.
        write_as: One of `WRITER_NAMES`; None for a dataset folder.
        options: Options of single formats.
        console: Shows progress.

    Raises:
        UserError: Formats, options and sources do not match, a source cannot be read, or `out` has other content than
            the output.
    """
    if read_as is not None:
        one_of("--from", read_as, READER_NAMES)
    if write_as is not None:
        one_of("--to", write_as, WRITER_NAMES)
    if read_as is None and write_as is None:
        raise UserError("expected --to or --from with a format")
    if read_as is not None and write_as == "shards":
        raise UserError("--to shards: only for datasets made by `skope gen`, not for files of other programs")
    for name, formats in _OPTION_FORMATS.items():
        if getattr(options, name) and not {f"--from {read_as}", f"--to {write_as}"} & set(formats):
            raise UserError(f"--{name.replace('_', '-')} is for {', '.join(formats)}")
    if options.split is not None and not SPLIT_NAME.fullmatch(options.split):
        raise UserError(f"--split: expected letters, digits, _, . and -, got {options.split!r}")
    if read_as is None and len(sources) != 1:
        raise UserError(f"expected one dataset folder and a new folder, got {len(sources)} before {out}")
    check_outside(out, sources)
    archive = write_as == "cvat" and out.suffix == ".zip"
    with replacing_folder(out.with_suffix("") if archive else out, keep=not archive) as whole:
        folder = whole / "content" if archive else whole
        if read_as is None:
            _write(dataset_at(sources[0]), write_as or "folder", folder, options, console)
        elif write_as in (None, "folder"):
            _read(sources, folder, read_as, options, console)
        else:
            with TemporaryDirectory(prefix=".between.", dir=folder.parent) as between:
                _read(sources, Path(between), read_as, options, console)
                try:
                    _write(dataset_at(Path(between)), write_as, folder, options, console)
                except UserError as error:  # for a folder that the user never sees
                    raise UserError(str(error).replace(between, " ".join(map(str, sources)))) from None
        if archive:
            zipped(folder, whole / out.name)
            move_new(whole / out.name, out)


def _read(sources: Sequence[Path], root: Path, form: str, options: ConversionOptions, console: Console) -> None:
    # Names without folders: the card is published, and must not show the user's folders.
    given = {name: getattr(options, name) for name in _OPTION_FORMATS}
    flags = [(f"--{name}", Path(value).name) for name, value in given.items() if isinstance(value, str | Path)]
    names = [path.resolve().name for path in sources]
    switches = ["--stored-pixels"] if options.stored_pixels else []
    command = shlex.join(["skope", "gen", "convert", *names, "--from", form, *itertools.chain(*flags), *switches])
    if form == "skope3d":
        skope3d.read(sources, root, split=options.split, map_file=options.map, command=command, console=console)
    else:
        coco_read.read(
            sources,
            root,
            form=form,
            images=options.images,
            split=options.split,
            stored_pixels=options.stored_pixels,
            command=command,
            console=console,
        )


def _write(dataset: Dataset, form: str, folder: Path, options: ConversionOptions, console: Console) -> None:
    if form in DATASET_FORMATS:
        _to_folder_or_shards(dataset, form, folder, console)
        return
    if form == _YOLO_FORMAT:
        yolo.write(dataset, folder, options.keypoints, console)
    else:
        _FORMAT_WRITERS[form](dataset, folder, console)
    write_text(folder / LICENCE_FILE, f"{dataset.licence}\n")
