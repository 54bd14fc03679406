"""`skope eval station`: cameras that are detected, tracked and measured for as long as they run."""

import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from skope.errors import UserError
from skope.eval.cli.options import FastMachineOptions, data_option, machine
from skope.records import check_number
from skope.terminal.command_options import FILE_METAVAR
from skope.terminal.console import Console

if TYPE_CHECKING:
    from skope.station.archive import Engine
    from skope.station.database import Database
    from skope.station.measure_days import StationWork
    from skope.station.station_file import Station
    from skope.station.supervise import Supervisor

CORES_OF_A_VIDEO: Final = 2
"""Number of processor cores of a task of Ray."""


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
    engine: Annotated[
        str,
        machine(
            choices=("local", "ray"),
            help="Where --once detects videos. ray: a Ray cluster with a shared disk (pip install 'skope[ray]').",
        ),
    ] = "local",
    address: Annotated[
        str | None,
        machine(help="Address of the Ray cluster.", show_default="the cluster of this machine, else a new one"),
    ] = None,
    interval: Annotated[float, data_option(help="Time between two searches for new recordings, seconds.")] = 10.0,
    hardware: FastMachineOptions,
    console: Console,
) -> None:
    """Detect, track and measure the traffic of several cameras; counts, events and speeds go to a database."""
    check_number("--interval", interval, 1.0, 86400.0)
    try:
        from skope.station.archive import record_archives
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
    if not once and (engine != "local" or address is not None):
        raise UserError("--engine, --address: need --once")
    database = Database.open(read.database)
    if once:
        for line in record_archives(read, partial(record_video, hardware), _engine(engine, address)):
            console.result(line)
        for line in _work_of(read, database, console).work_off(rest=False):
            console.result(line)
        return
    from skope.station.supervise import held_station

    with held_station(read):
        _supervisor(read, database, interval, hardware, console).run()


def _supervisor(
    read: "Station", database: "Database", interval: float, hardware: FastMachineOptions, console: Console
) -> "Supervisor":
    """Return the supervisor of a station, with its publishers connected."""
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


def _engine(engine: str, address: str | None) -> "Engine":
    from skope.station.archive import in_this_process, on_ray

    if engine == "ray":
        from skope.ray_cluster import ray_cluster

        return on_ray(partial(ray_cluster, address), CORES_OF_A_VIDEO)
    if address is not None:
        raise UserError("--address: needs --engine ray")
    return in_this_process


def record_video(hardware: FastMachineOptions, file: Path, name: str, video: Path) -> None:
    """Detect and track a video of a camera's archive; its tracks become a recording. A stopped run resumes.

    Args:
        hardware: The machine settings.
        file: The station file.
        name: Name of the camera.
        video: The video. Its name has its start time.

    Raises:
        UserError: The video cannot be read, or its camera does not fit.
    """
    import shutil

    from skope.detector import weights
    from skope.eval.cli.tracked_footage import recorded_video, site_at_size, tracked_footage
    from skope.station.station_file import read_station

    camera = read_station(file).camera(name)
    quiet, footage = Console(quiet=True), recorded_video(str(video))
    site = site_at_size(camera.site, footage, quiet)
    work = camera.tracking / video.stem
    checkpoint = Path(camera.detector or weights.LIGHT_WEIGHTS)
    tracks = tracked_footage(footage, site, checkpoint, hardware, work, "skope eval station", {}, quiet)
    camera.tracks.mkdir(parents=True, exist_ok=True)
    tracks.rename(camera.tracks / video.stem)
    shutil.rmtree(work)


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
        read, problem = read_station(file), ""
        while True:
            try:
                work = work or _work_of(read, Database.open(read.database), console)
                for line in work.work_off():
                    console.result(line)
                if problem:
                    console.result("database: reached again")
                problem = ""
            except UserError as error:
                if str(error) != problem:  # a long outage is one line
                    problem = str(error)
                    console.warn(f"{problem}; trying again")
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
    try:
        StreamWatch(read.camera(name), read.window_s, hardware.settings(tiles="none"), Console(quiet=True)).run()
    except KeyboardInterrupt:
        return
