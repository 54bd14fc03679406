"""Traffic from tracks: site files, counts, and all measurements of `skope eval traffic`."""

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
    """Read a site file: camera, marks, gates, zones, lanes and settings (docs/own-road.md).

    Args:
        path: The .toml file, for example from `skope eval site`.

    Returns:
        The site with its `gates`, `zones` and `lanes`. Coordinates are in metres. A gate that was drawn in the image
        also has `pixels`, and has no coordinates in metres if the site has no camera.

    Raises:
        UserError: The file cannot be read, or a value in it is wrong.
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
    """Count and measure traffic, as `skope eval traffic` does, in memory.

    Args:
        tracks: Output folder of `skope eval track`, several such folders of one site, or the result of `track` or
            `Video.tracks`.
        site: A site file with gates, zones, lanes and settings, or the result of `read_site`.
        start_time: Start of the footage, a time or a text as `--start-time` takes it. For several recordings a time for
            each, in their order. Default: from `footage.json`, the site file or the names of the footage.
        times_s: Times of all frames, seconds, for tracks in memory, including frames without tracks. Gaps between them
            are unobserved. Default: the times of `track` or `Video.tracks`.
        manual_count: CSV file of manual counts (docs/manual-counts.md). They narrow the intervals; counts do not
            change.

    Returns:
        The report with `crossings`, `visits`, `counts`, `turning`, `speeds`, `headways`, `queues`, `delays` and
        `conflicts`, each with its uncertainty. `notes` lists what could not be measured, and why.

    Raises:
        UserError: A file is missing or wrong, recordings overlap in time, or the start of one is not known.
        ValueError: `tracks` mixes folders and tracks.
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
    """Count the road users that crossed each gate, by direction, lane, class and clock interval.

    Args:
        tracks: As in `measure_traffic`.
        site: The site file with the gates, or the result of `read_site`.
        start_time: As in `measure_traffic`.
        times_s: As in `measure_traffic`.

    Returns:
        One record per `interval`, `gate`, `direction`, `lane` and `class_name` (each can be "all"). `count` is None if
        nothing was observed. `confidence_interval.low` to `confidence_interval.high` is the 90% interval of the true
        number.

    Raises:
        UserError: A file is missing or wrong.
    """
    return list(measure_traffic(tracks, site, start_time=start_time, times_s=times_s).counts)
