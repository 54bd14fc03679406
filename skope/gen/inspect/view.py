"""A dataset folder as the viewer shows it."""

from collections.abc import Sequence

from skope.dataset.folder import Dataset
from skope.errors import UserError
from skope.terminal.console import Console
from skope.viewer.collection import Collection, ShownSplit
from skope.viewer.pictures import read_picture


def dataset_collection(dataset: Dataset, names: Sequence[str], console: Console) -> Collection:
    """The named splits of a dataset, or all of them; a UserError says what is wrong with them."""
    wanted = tuple(dict.fromkeys(names)) or dataset.splits
    if not wanted:
        raise UserError(f"{dataset.root}: has no splits")
    files = [dataset.read(name) for name in console.bar(wanted, unit="split", label="reading")]
    return Collection(
        title=f"{dataset.root.resolve().name} ({', '.join(wanted)})",
        splits=tuple(ShownSplit(file=file) for file in files),
        picture=lambda image: read_picture(dataset.root / image.file_name),
    )
