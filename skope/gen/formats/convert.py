"""Convert datasets between formats: what `skope gen convert` does."""

import itertools
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from skope.dataset.folder import Dataset
from skope.errors import UserError, one_of
from skope.files.atomic import replacing_folder, write_text
from skope.files.output_folders import move_new
from skope.gen.formats import coco_read, coco_write, folder_and_shards, kitti, mot, skope3d, yolo
from skope.gen.formats.archive import zipped
from skope.gen.formats.dataset_builder import LICENCE_FILE, SPLIT_NAME, check_outside, dataset_at
from skope.gen.output.writers import DATASET_FORMATS
from skope.terminal.console import Console


@dataclass(frozen=True, kw_only=True)
class ConversionOptions:
    """Options of some formats only; None or empty where the flag is not given."""

    map: Path | None = None
    """File that says what the keypoints of `--from skope3d` are."""
    images: Path | None = None
    """Folder with the images of COCO or CVAT annotation files."""
    split: str | None = None
    """Split that everything read goes to."""
    stored_pixels: bool = False
    """Whether labels of COCO or CVAT files are in pixels as stored, before EXIF turns the picture."""
    keypoints: tuple[str, ...] = ()
    """Names of the keypoints to write; empty for all."""


_OPTION_FORMATS: Final = {
    "map": ("--from skope3d",),
    "images": ("--from coco", "--from cvat"),
    "stored_pixels": ("--from coco", "--from cvat"),
    "keypoints": ("--to yolo",),
    "split": ("--from skope3d", "--from coco", "--from cvat"),
}
"""The formats that each option is for."""

_WRITE: Final[Mapping[str, Callable[[Dataset, Path, Console], None]]] = {
    "coco": coco_write.write,
    "cvat": coco_write.write_cvat,
    "kitti": kitti.write,
    "mot": mot.write,
    "skope3d": skope3d.write,
}
_YOLO: Final = "yolo"
WRITERS: Final = (*DATASET_FORMATS, *_WRITE, _YOLO)
READERS: Final = ("coco", "cvat", "skope3d")


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
        out: A folder that is empty or missing; for "cvat" it may be a .zip file. It is written whole or not at all.
        read_as: One of `READERS`; None for a dataset folder.
        write_as: One of `WRITERS`; None for a dataset folder.
        options: What some formats need.
        console: Where progress is shown.

    Raises:
        UserError: Formats, options and sources do not fit together, a source cannot be read, or `out` holds anything
            else than what would be written.
    """
    if read_as is not None:
        one_of("--from", read_as, READERS)
    if write_as is not None:
        one_of("--to", write_as, WRITERS)
    if read_as is None and write_as is None:
        raise UserError("say --to which format, or --from which one")
    if read_as is not None and write_as == "shards":
        raise UserError("--to shards: is for what `skope gen` made, not for what is read from other files")
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
                except UserError as error:  # of a folder that the user never sees
                    raise UserError(str(error).replace(between, " ".join(map(str, sources)))) from None
        if archive:
            zipped(folder, whole / out.name)
            move_new(whole / out.name, out)


def _read(sources: Sequence[Path], root: Path, form: str, options: ConversionOptions, console: Console) -> None:
    # Names without folders: the card is published, and must not show how the user's disk is laid out.
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
        folder_and_shards.convert(dataset, form, folder, console)
        return
    if form == _YOLO:
        yolo.write(dataset, folder, options.keypoints, console)
    else:
        _WRITE[form](dataset, folder, console)
    write_text(folder / LICENCE_FILE, f"{dataset.licence}\n")
