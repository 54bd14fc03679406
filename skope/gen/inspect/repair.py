"""Repair a dataset: render broken frames again after a check; sound files stay as they are, byte for byte."""

from collections.abc import Sequence

from skope.dataset.folder import MANIFEST, Dataset
from skope.errors import UserError
from skope.gen.inspect.check import Finding
from skope.gen.output.dataset_card import command
from skope.gen.pipeline.dataset_store import Store
from skope.gen.pipeline.generate import PoolFactory, finish_rendering
from skope.terminal.console import Console


def _lost_splits(dataset: Dataset, findings: Sequence[Finding]) -> set[str]:
    """Splits whose annotation file, or the manifest, is broken: none of their labels can be trusted."""
    files = {finding.where for finding in findings if finding.image is None}
    if MANIFEST in files:
        return set(dataset.splits)
    return {split for split in dataset.splits if f"annotations/{split}.json" in files}


def repair(dataset: Dataset, findings: Sequence[Finding], start_pool: PoolFactory, console: Console) -> None:
    """Render broken frames of a dataset again, and write all labels anew.

    Args:
        dataset: A dataset that `skope gen` made.
        findings: What `check` found.
        start_pool: Starts the workers.
        console: Where progress is shown.

    Raises:
        UserError: The dataset has another origin, or recordings are broken: these are removed, and the message names
            the command that simulates them again.
    """
    if "takes" not in dataset.card:
        raise UserError(f"{dataset.root}: was not made by `skope gen`: there is nothing to make it again from")
    store = Store(dataset.root)
    with store.locked():
        plan = store.plan
        for finding in findings:
            if finding.stray:
                (dataset.root / finding.where).unlink(missing_ok=True)
        store.reopen({finding.image for finding in findings if finding.image}, _lost_splits(dataset, findings))
        lost = [store.recording_path(recording) for recording in plan.recordings if not store.recorded(recording)]
        lost += [dataset.root / f.where for f in findings if f.where.startswith("recordings/") and not f.stray]
        if lost:
            for path in lost:
                path.unlink(missing_ok=True)
            raise UserError(
                f"{lost[0]}: has to be simulated again; go on with: {command(plan.parameters)} --out {store.root}"
            )
        finish_rendering(store, plan.parameters.renderer, start_pool, console)
