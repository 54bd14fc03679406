"""Write the files of a traffic report: events, trajectories, one table per measure, and a summary.

Cells without a value are empty.
"""

import math
from pathlib import Path
from typing import Any, Final

import numpy as np

from skope.confidence_level import INTERVAL_LEVEL
from skope.files.csv_files import write_csv
from skope.files.json_files import write_json
from skope.traffic.count_uncertainty import count_interval, in_json
from skope.traffic.peak_hour import peak_hours_in_json
from skope.traffic.report_tables import report_tables
from skope.traffic.traffic_report import TrafficReport
from skope.version import __version__

_TABLE_DIGITS: Final = 3
SUMMARY_FILE: Final = "summary.json"
"""Name of the summary, which is written last: if the file exists, the report is complete."""


def write_traffic_report(
    out: Path, report: TrafficReport, *, tracks: str | list[str], revision: str | None
) -> list[Path]:
    """Write the files of a report.

    Args:
        out: The folder.
        report: The report.
        tracks: Names of the folders or files that the tracks were read from, for the summary.
        revision: Digest of the site file; None: there is none.

    Returns:
        The files, the summary last.
    """
    written = []
    for name, table in report_tables(report).items():
        written.append(out / f"{name}.csv")
        write_csv(written[-1], table.columns, table.rows, digits=_TABLE_DIGITS)
    write_json(out / SUMMARY_FILE, report_summary(report, tracks=tracks, revision=revision))
    return [*written, out / SUMMARY_FILE]


def _recordings(report: TrafficReport) -> list[dict[str, Any]]:
    return [
        {
            "recording": number,
            "tracks": str(recording.folder),
            "footage": recording.source,
            "begin": recording.begin.isoformat(),
            "begin_s": recording.begin_s,
            "guessed": recording.guessed,
            "later_s": recording.late_s,
            "added_to_track": recording.added,
        }
        for number, recording in enumerate(report.recordings, start=1)
    ]


def report_summary(report: TrafficReport, *, tracks: str | list[str], revision: str | None) -> dict[str, Any]:
    """Return the totals of a report with its inputs and versions, so that it can be reproduced.

    Args:
        report: The report.
        tracks: Name of the folder or file that the tracks were read from; a list for several recordings.
        revision: Digest of the site file; None: there is none.
    """
    observation = report.observation
    spans = observation.spans
    totals = [
        {
            "gate": row.gate,
            "direction": row.direction,
            "class": row.class_name,
            "count": row.count,
            **in_json(row.confidence_interval),
            **({} if row.pce is None else {"pce": row.pce}),
        }
        for row in report.counts_total
    ]
    likely = [conflict.probability for conflict in report.conflicts.conflicts if not math.isnan(conflict.probability)]
    sure = count_interval(likely, (0.0, 1.0))
    return {
        "skope": __version__,
        "tracks": tracks,
        "footage": observation.source,
        **({"recordings": _recordings(report)} if report.recordings else {}),
        "site_revision": revision,
        "settings": report.site.traffic.to_dict(),
        "start": None if report.start is None else report.start.isoformat(),
        "time_zone": report.site.time_zone,
        "metres": report.metres,
        "observed_s": round(observation.observed_s, 3),
        "observed_spans_s": np.round(spans, 3).tolist(),
        "camera_common_sigma": observation.common_scale_sigma,
        "interval_level": INTERVAL_LEVEL,
        "trajectories": len(report.trajectories),
        "joined": [[trajectory.number, *trajectory.joined] for trajectory in report.trajectories if trajectory.joined],
        "counts": totals,
        "peak_hour": peak_hours_in_json(report),
        "manual_counts": len(report.manual_count_checks),
        "turning": [
            {
                "from": list(row.origin),
                "to": list(row.destination),
                "class": row.class_name,
                "count": row.count,
                **in_json(row.confidence_interval),
            }
            for row in report.turning_total
        ],
        "conflicts_by_ttc": {"count": len(likely), "low": sure.low, "high": sure.high},
        "hard_brakings": len(report.brakings),
        "notes": list(report.notes),
    }
