"""`skope eval station`: the traffic of several cameras in one database."""

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from skope.errors import UserError
from skope.eval.cli.options import data_option
from skope.records import check_number
from skope.terminal.command_options import FILE_METAVAR
from skope.terminal.console import Console

if TYPE_CHECKING:
    from skope.station.measure_days import StationWork


def station(
    file: Annotated[
        Path, typer.Argument(metavar=FILE_METAVAR, help="Station file: cameras and database (docs/station.md).")
    ],
    *,
    once: Annotated[bool, data_option("--once", help="Measure the recordings that are there, then stop.")] = False,
    interval: Annotated[float, data_option(help="Time between two searches for new recordings, seconds.")] = 60.0,
    console: Console,
) -> None:
    """Measure the recordings of several cameras, and keep their counts, events and speeds in a database."""
    check_number("--interval", interval, 1.0, 86400.0)
    try:
        from skope.station.database import Database
    except ModuleNotFoundError as error:
        raise UserError(f"station: {error.name} is not installed: pip install 'skope[station]'") from None
    from skope.station.measure_days import StationWork
    from skope.station.station_file import read_station

    read = read_station(file)
    work = StationWork(read, Database.open(read.database))
    while True:
        _work_off(work, console, once=once)
        if once:
            return
        time.sleep(interval)


def _work_off(work: "StationWork", console: Console, *, once: bool) -> None:
    """Measure what is new. A database that cannot be reached is tried again at the next search, except with --once."""
    try:
        for line in work.work_off():
            console.result(line)
    except UserError as error:
        if once:
            raise
        console.warn(f"{error}; trying again")
