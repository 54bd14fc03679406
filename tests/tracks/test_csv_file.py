"""tracks.csv: what is read equals what was written, and what is wrong is named with line and column."""

import codecs
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skope.errors import UserError
from skope.tracks.csv_file import TRACK_COLUMNS, as_written, read_tracks, write_tracks
from skope.tracks.track import Track
from tests.traffic.drives import drive

NOT_IN_FILES = {"boxes", "scores", "truth_ids"}


def any_track(number: int, rng: np.random.Generator, **others: Any) -> Track:
    """A track of random values: with negative zeros, a heading that is not known, and all optional columns."""
    count = 25
    spread = rng.normal(size=(count, 2, 2)) * 10 ** rng.uniform(-2, 2, (count, 1, 1))
    one = drive(number, rng.normal(0, 200, (count, 2)), np.cumsum(rng.uniform(0.03, 0.4, count)))
    heading = rng.uniform(-np.pi, np.pi, count)
    heading[3] = np.nan
    velocity = rng.normal(0, 20, (count, 2))
    velocity[4] = (-1e-9, -0.0)
    values: dict[str, Any] = {
        "position": rng.normal(0, 200, (count, 3)),
        "velocity": velocity,
        "acceleration": rng.normal(0, 3, (count, 2)),
        "heading": heading,
        "covariance": spread @ np.swapaxes(spread, 1, 2),
        "body_error": rng.normal(0, 0.3, (count, 2)),
        "speed_sigma": rng.uniform(0, 2, count),
        "located": rng.random(count) < 0.7,
        "detected": rng.random(count) < 0.9,
        "frames": 7 + np.arange(count),
        "body_type": "suv",
        "height": 1.512,
        "class_confidence": 0.8765,
        "flags": ("two_poses", "never_moved"),
    }
    return replace(one, **{**values, **others})


def assert_same(first: Track, second: Track) -> None:
    for name in {one.name for one in fields(Track)} - NOT_IN_FILES:
        a, b = getattr(first, name), getattr(second, name)
        if isinstance(a, np.ndarray):
            # Bytes: NaN equals NaN, and 0.0 is not -0.0.
            assert a.astype(float).tobytes() == b.astype(float).tobytes(), name
        else:
            assert a == b, name


@pytest.mark.parametrize("seed", range(5))
def test_what_is_read_equals_what_was_written_to_the_last_bit(tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    walker = {"category": "pedestrian", "class_name": "pedestrian", "length": None, "width": None, "height": None}
    tracks = [any_track(3, rng), any_track(12, rng, body_type="", **walker), any_track(4, rng, class_name="unknown")]
    write_tracks(tmp_path / "a.csv", tracks)
    read = read_tracks(tmp_path / "a.csv")
    assert [one.number for one in read] == [3, 12, 4]
    for made, found in zip(tracks, read, strict=True):
        assert_same(as_written(made), found)
        assert_same(as_written(found), found)
        assert abs(made.position - found.position).max() <= 0.000501
    write_tracks(tmp_path / "b.csv", read)
    assert (tmp_path / "b.csv").read_bytes() == (tmp_path / "a.csv").read_bytes()


def test_a_frame_has_the_number_that_it_has_in_its_video(tmp_path: Path) -> None:
    track = replace(drive(1, [[k, 0.0] for k in range(3)]), frames=np.array([0, 1, 2]))
    write_tracks(tmp_path / "a.csv", [track], [10, 15, 20])
    assert read_tracks(tmp_path / "a.csv")[0].frames.tolist() == [10, 15, 20]


def test_a_byte_order_mark_is_not_part_of_the_first_column(tmp_path: Path) -> None:
    """As a spreadsheet puts it before a file that it saves; the file as written has none, since programs read it."""
    path = tmp_path / "t.csv"
    track = any_track(3, np.random.default_rng(0))
    write_tracks(path, [track])
    assert path.read_bytes().startswith(b"track,")
    path.write_bytes(codecs.BOM_UTF8 + path.read_bytes())
    (back,) = read_tracks(path)
    assert_same(as_written(track), back)


def test_no_track_is_a_file_with_a_head(tmp_path: Path) -> None:
    write_tracks(tmp_path / "a.csv", [])
    assert (tmp_path / "a.csv").read_text() == ",".join(TRACK_COLUMNS) + "\n"
    assert read_tracks(tmp_path / "a.csv") == []


@pytest.mark.parametrize(
    ("column", "cell", "expected"),
    [
        ("track", "x", "track: expected a whole number, got 'x'"),
        ("category", "tram", "category: expected one of vehicle, bicycle, motorcycle, pedestrian, got 'tram'"),
        ("class", "bicycle", "class: expected one of car, van, lorry, bus, unknown, got 'bicycle'"),
        ("class_confidence", "1.5", "class_confidence: expected a probability from 0 to 1, got '1.5'"),
        ("time_s", "nan", "time_s: expected a finite number, got 'nan'"),
        ("time_s", "99", "time_s: expected times that rise along the track"),
        ("x", "", "x: expected a number, got ''"),
        ("sigma_xx", "-0.1", "sigma_xx: expected variances and standard deviations that are not negative"),
        ("length", "0", "length: expected a length above 0, got '0'"),
        ("heading_deg", "north", "heading_deg: expected a number, got 'north'"),
    ],
)
def test_a_wrong_cell_is_named_with_line_and_column(tmp_path: Path, column: str, cell: str, expected: str) -> None:
    path = tmp_path / "tracks.csv"
    write_tracks(path, [drive(1, [[float(k), 0.0] for k in range(4)])])
    head, first, *rest = path.read_text().splitlines()
    cells = first.split(",")
    cells[TRACK_COLUMNS.index(column)] = cell
    rows = [",".join(cells), *rest] if column != "track" else [row.replace("1,", "x,", 1) for row in (first, *rest)]
    path.write_text("\n".join([head, *rows]) + "\n")
    with pytest.raises(UserError) as error:
        read_tracks(path)
    assert str(error.value).startswith(f"{path}: line ")
    assert expected in str(error.value)


def test_rows_of_a_track_that_lie_apart_are_rejected(tmp_path: Path) -> None:
    path = tmp_path / "tracks.csv"
    write_tracks(path, [drive(n, [[float(k), 0.0] for k in range(3)]) for n in (1, 2)])
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines, lines[3]]) + "\n")
    with pytest.raises(UserError, match=r"line 8: track '1': rows lie apart"):
        read_tracks(path)


def test_time_before_and_after_a_track_is_no_gap() -> None:
    track = drive(1, [[float(k), 0.0] for k in range(31)])
    assert track.longest_gap(1.5, 1.0) == pytest.approx(0.1)
    assert track.longest_gap(2.9, 1.5) == pytest.approx(0.1), "the track ends at 3.0 s"
    track.located[10:20] = False
    assert track.longest_gap(1.5, 1.0) == pytest.approx(1.1)
