"""Make again what a check has found broken; what is sound stays as it is, byte for byte."""

from collections.abc import Sequence

from skope.console import Console
from skope.dataset import MANIFEST, Dataset
from skope.errors import UserError
from skope.gen.inspect.check import Finding
from skope.gen.output.card import command
from skope.gen.pipeline.generate import Hire, finish_rendering
from skope.gen.pipeline.store import Store


def _lost_splits(dataset: Dataset, findings: Sequence[Finding]) -> set[str]:
    """Splits of whose labels nothing can be trusted."""
    files = {finding.where for finding in findings if finding.image is None}
    if MANIFEST in files:
        return set(dataset.splits)
    return {split for split in dataset.splits if f"annotations/{split}.json" in files}


def repair(dataset: Dataset, findings: Sequence[Finding], hire: Hire, console: Console) -> None:
    """Render the frames of `findings` again and write all labels anew; UserError where that would not help."""
    if "takes" not in dataset.card:
        raise UserError(f"{dataset.root}: was not made by `skope gen`: there is nothing to make it again from")
    store = Store(dataset.root)
    with store.locked():
        begun = store.begun()
        assert begun is not None
        for finding in findings:
            if finding.stray:
                (dataset.root / finding.where).unlink(missing_ok=True)
        store.reopen({finding.image for finding in findings if finding.image}, _lost_splits(dataset, findings))
        lost = [store.recording_path(take) for take in store.takes() if not store.recorded(take)]
        lost += [dataset.root / f.where for f in findings if f.where.startswith("recordings/") and not f.stray]
        if lost:
            for path in lost:
                path.unlink(missing_ok=True)
            raise UserError(
                f"{lost[0]}: has to be simulated again; go on with: {command(begun['parameters'])} --out {store.root}"
            )
        finish_rendering(store, begun["parameters"]["renderer"], hire, console)
