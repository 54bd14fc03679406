"""`skope eval station`: cameras that are detected, tracked and measured for as long as they run."""

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from skope.errors import UserError
from skope.eval.cli.options import FastMachineOptions, data_option
from skope.records import check_number
from skope.terminal.command_options import FILE_METAVAR
from skope.terminal.console import Console

if TYPE_CHECKING:
    from skope.station.database import Database
    from skope.station.measure_days import StationWork
    from skope.station.station_file import Station
    from skope.station.supervise import Supervisor


def station(
    file: Annotated[
        Path, typer.Argument(metavar=FILE_METAVAR, help="Station file: cameras and database (docs/station.md).")
    ],
    *,
    once: Annotated[
        bool, data_option("--once", help="Track and measure the recordings that are there, then stop.")
    ] = False,
    check: Annotated[
        bool, data_option("--check", help="Try streams, cameras, database and broker; a line for each.")
    ] = False,
    interval: Annotated[float, data_option(help="Time between two searches for new recordings, seconds.")] = 10.0,
    hardware: FastMachineOptions,
    console: Console,
) -> None:
    """Detect, track and measure the traffic of several cameras; counts, events and speeds go to a database."""
    check_number("--interval", interval, 1.0, 86400.0)
    try:
        from skope.station.database import Database
        from skope.station.station_file import read_station
    except ModuleNotFoundError as error:
        raise UserError(f"station: {error.name} is not installed: pip install 'skope[station]'") from None
    read = read_station(file)
    if check:
        from skope.station.check import check_station

        if not check_station(read, console):
            raise typer.Exit(1)
        return
    database = Database.open(read.database)
    if once:
        for line in _work_of(read, database, console).work_off(rest=False):
            console.result(line)
        return
    _supervisor(read, database, interval, hardware, console).run()


def _supervisor(
    read: "Station", database: "Database", interval: float, hardware: FastMachineOptions, console: Console
) -> "Supervisor":
    """Return the supervisor of a station, with its publishers connected."""
    from functools import partial

    from skope.station.supervise import Publisher, Supervisor

    publishers = list[Publisher]()
    supervisor = Supervisor(
        read, partial(watch_camera, hardware), partial(measure_station, interval), publishers, console
    )
    if read.http:
        from skope.station.http_api import HttpServer, make_app

        app = make_app(read.cameras, database, supervisor.health, read.http.token)
        publishers.append(HttpServer(app, read.http))
        console.result(f"page: http://{read.http.host}:{read.http.port}")
    if read.mqtt:
        from skope.station.mqtt import MqttPublisher

        publishers.append(MqttPublisher(read.mqtt, database, console))
    return supervisor


def _work_of(read: "Station", database: "Database", console: Console) -> "StationWork":
    from skope.eval.cli.tracked_footage import track_folder
    from skope.station.measure_days import StationWork

    quiet = Console(quiet=True)
    return StationWork(read, database, lambda seen, out: track_folder(seen, out, quiet))


def measure_station(interval: float, file: Path) -> None:
    """Track and measure for as long as the process runs. A database that cannot be reached is tried again."""
    from skope.station.database import Database
    from skope.station.station_file import read_station
    from skope.station.supervise import end_with_parent

    end_with_parent()
    console, work = Console(), None
    try:
        read = read_station(file)
        while True:
            try:
                work = work or _work_of(read, Database.open(read.database), console)
                for line in work.work_off():
                    console.result(line)
            except UserError as error:
                console.warn(f"{error}; trying again")
            time.sleep(interval)
    except KeyboardInterrupt:
        return


def watch_camera(hardware: FastMachineOptions, file: Path, name: str) -> None:
    """Detect road users in the stream of a camera for as long as the process runs."""
    from skope.station.station_file import read_station
    from skope.station.supervise import end_with_parent
    from skope.station.watch_stream import StreamWatch

    end_with_parent()
    read = read_station(file)
    camera = next(camera for camera in read.cameras if camera.name == name)
    try:
        StreamWatch(camera, read.window_s, hardware.settings(tiles="none"), Console(quiet=True)).run()
    except KeyboardInterrupt:
        return
