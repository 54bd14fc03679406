"""The options that say who does the work."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import partial
from typing import TYPE_CHECKING, Annotated

import typer

from skope.errors import UserError, one_of

if TYPE_CHECKING:
    from skope.gen.pipeline.workers import Crew

WorkersOption = Annotated[int | None, typer.Option(help="Worker processes; by default one per core.")]
EngineOption = Annotated[
    str, typer.Option(help="local: processes of this machine; ray: a Ray cluster's (pip install skope[ray]).")
]
AddressOption = Annotated[
    str | None, typer.Option(help="Of the Ray cluster; by default one that this machine belongs to, or a new one here.")
]


def hired(
    engine: str, workers: int | None, address: str | None
) -> tuple[Callable[[], "AbstractContextManager[Crew]"], str]:
    """How to hire who does the work, and who that is."""
    from skope.gen.pipeline.workers import check_workers, default_workers, local

    count = check_workers(workers) if workers is not None else None
    if one_of("--engine", engine, ("local", "ray")) == "ray":
        from skope.gen.pipeline.ray_workers import cluster

        return partial(cluster, count, address), f"{count or 'all'} workers of Ray"
    if address is not None:
        raise UserError("--address: is for --engine ray")
    count = count or default_workers()
    return partial(local, count), f"{count} worker{'' if count == 1 else 's'}"
