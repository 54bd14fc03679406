from pathlib import Path

import cv2
import numpy as np
from typer.testing import CliRunner

from skope.cli import app
from skope.errors import UserError
from skope.gen.vehicles.fleet import fleet


def test_the_list_has_a_line_for_each_model() -> None:
    result = CliRunner().invoke(app, ["gen", "vehicles", "list"])
    assert result.exit_code == 0
    lines = result.output.splitlines()[1:]
    assert [line.split()[0] for line in lines] == list(fleet())


def test_a_sheet_shows_the_vehicle_from_all_sides(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["gen", "vehicles", "show", "sedan", "--out", str(tmp_path), "--quiet"])
    assert result.exit_code == 0, result.output
    assert sorted(path.name for path in tmp_path.iterdir()) == ["sedan.png", "work.json"]
    sheet = cv2.imread(str(tmp_path / "sedan.png"))
    assert sheet is not None
    rows, columns = 4, 3
    body = sheet[-rows * 404 :]
    for row in range(rows):
        for column in range(columns):
            cell = body[row * 404 + 4 : (row + 1) * 404, column * 644 : column * 644 + 640].astype(int)
            # Red paint: much more red than blue.
            assert 2000 < int((cell[..., 2] - cell[..., 0] > 60).sum()) < 0.6 * cell[..., 0].size
            assert np.ptp(cell) > 150


def test_an_unknown_model_is_refused(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["gen", "vehicles", "show", "spaceship", "--out", str(tmp_path)])
    assert isinstance(result.exception, UserError)
    assert "spaceship" in str(result.exception)
