"""poses.csv: a row per vehicle, whose file names run as no formula in a spreadsheet."""

from pathlib import Path

from skope.files.csv_files import read_csv
from skope.pose.pose_records import write_poses


def test_a_file_name_never_begins_like_a_formula(tmp_path: Path) -> None:
    row = {"image_id": 1, "file_name": "=1+1.jpg", "time_s": -0.5, "vehicle": 0, "score": 0.9}
    _, path = write_poses(tmp_path, lambda: [row | {"refused": "too small", "flags": []}])
    assert path.read_text().splitlines()[1].startswith("1,'=1+1.jpg,-0.5,0,0.9,too small,")
    _, (read,) = read_csv(path)
    assert read["file_name"] == row["file_name"]
