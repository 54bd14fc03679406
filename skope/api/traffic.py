"""From tracks to traffic: the site's gates and zones, counts, and everything that `skope eval traffic` measures."""

from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from skope.errors import UserError

if TYPE_CHECKING:
    from skope.site.site_file import SiteFile
    from skope.tracks.track import Track
    from skope.traffic.gate_counts import Count
    from skope.traffic.traffic_report import TrafficReport


def read_site(path: str | Path) -> "SiteFile":
    """Read a site file: camera, marks, gates, zones, lanes and settings (docs/traffic.md).

    Args:
        path: The .toml file, as `skope eval site` saves it.

    Returns:
        The site, with its `gates`, `zones` and `lanes`, places in metres.

    Raises:
        UserError: The file cannot be read, or a key in it is wrong.
    """
    from skope.site import site_file

    return site_file.read_site(Path(path))


def measure_traffic(
    tracks: "str | Path | Sequence[str | Path] | Sequence[Track]",
    site: "str | Path | SiteFile",
    *,
    start_time: str | datetime | Sequence[str | datetime] | None = None,
    times_s: Sequence[float] | None = None,
    manual_count: str | Path | None = None,
) -> "TrafficReport":
    """Count and measure traffic: what `skope eval traffic` writes, in memory.

    Args:
        tracks: The folder that `skope eval track` wrote, several such folders of one site, or what `track` or
            `Video.tracks` gave.
        site: A site file with gates, zones, lanes and settings, or what `read_site` has read.
        start_time: Start of the footage, a time or a text as `--start-time` takes it. For several recordings a time for
            each, in their order. Default: from `footage.json`, the site file or the names of the footage.
        times_s: Of tracks in memory the times of all frames, seconds, also of those without any track; by default
            those that `track` or `Video.tracks` had. Between them it is known when nothing was observed.
        manual_count: CSV of what was counted by hand (docs/traffic.md), from which the intervals of counts learn.

    Returns:
        The report: its `crossings`, `visits`, `counts`, `turning`, `speeds`, `headways`, `queues`, `delays` and
        `conflicts`, each with how uncertain it is, and in `refused` what could not be measured, and why.

    Raises:
        UserError: A file is missing or wrong, recordings overlap in time, or it is not known when one began.
        ValueError: `tracks` are folders and tracks.
    """
    from skope.site.site_file import SiteFile
    from skope.tracking.track_list import Tracks
    from skope.tracks.csv_file import as_written
    from skope.traffic.counting_intervals import local_start
    from skope.traffic.gates import gates_on_road
    from skope.traffic.manual_count_file import read_manual_counts
    from skope.traffic.measure import measure
    from skope.traffic.observation import Observation
    from skope.traffic.recordings import RecordedTraffic, parse_start_time, read_recordings

    read = site if isinstance(site, SiteFile) else read_site(site)
    said = [start_time] if isinstance(start_time, str | datetime) else list(start_time or ())
    given = [tracks] if isinstance(tracks, str | Path) else list(tracks)
    folders = [Path(one) for one in given if isinstance(one, str | Path)]
    if folders and len(folders) < len(given):
        raise ValueError("tracks: expected folders, or what `track` gave, not both")
    if not folders and len(said) > 1:
        raise UserError(f"start_time: expected one time for one recording, got {len(said)}")
    if folders:
        footage = read_recordings(folders, said, read, "start_time")
    else:
        followed = [one for one in given if not isinstance(one, str | Path)]
        if times_s is not None:
            observed = Observation(times_s=np.asarray(times_s, dtype=np.float64))
        elif isinstance(tracks, Tracks):
            observed = tracks.observation
        else:
            times = [one.times_s for one in followed] or [np.zeros(0)]
            observed = Observation(times_s=np.unique(np.concatenate(times)))
        footage = RecordedTraffic(
            tracks=tuple(as_written(one) for one in followed),
            observation=observed,
            start=parse_start_time(said[0], read, "start_time") if said else local_start(read),
        )
    start, observation = footage.start, footage.observation
    counted = (
        ()
        if manual_count is None
        else read_manual_counts(Path(manual_count), gates_on_road(read.gates), read.traffic, start, observation)
    )
    return measure(footage.tracks, observation, read, start, counted, recordings=footage.recordings)


def count(
    tracks: "str | Path | Sequence[str | Path] | Sequence[Track]",
    site: "str | Path | SiteFile",
    *,
    start_time: str | datetime | Sequence[str | datetime] | None = None,
    times_s: Sequence[float] | None = None,
) -> "list[Count]":
    """Count who crossed each gate, by direction, lane, class and interval on the clock.

    Args:
        tracks: As `measure_traffic` takes them.
        site: The site file with the gates, or what `read_site` has read.
        start_time: As in `measure_traffic`.
        times_s: As `measure_traffic` takes them.

    Returns:
        A count for each `interval`, `gate`, `direction`, `lane` and `class_name`, of which each may be "all", with
        `count`, None where nothing was observed, and `expected`: between `expected.low` and `expected.high` is how many
        there were, with 90%.

    Raises:
        UserError: A file is missing or wrong.
    """
    return list(measure_traffic(tracks, site, start_time=start_time, times_s=times_s).counts)
