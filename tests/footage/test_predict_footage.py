"""`skope eval predict` where things go wrong: two at once, odd names, odd images, full disks, broken files."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image as Picture

from skope.dataset import coco
from skope.errors import UserError
from skope.files import progress
from skope.files.progress import Progress
from skope.video.footage import open_footage


def picture(path: Path, shape: tuple[int, ...] = (60, 80, 3)) -> Path:
    """Noise of little contrast: in colourful noise a detector that has learned nothing finds a hundred vehicles."""
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.random.default_rng(len(path.name)).integers(60, 180, shape, dtype=np.uint8))
    return path


@pytest.fixture
def call(skope: Any, random_run: Path) -> Any:
    """`skope eval predict` with a detector that has learned nothing."""
    return lambda source, *more: skope("eval", "predict", source, "--checkpoint", random_run, "-q", *more)


def test_one_run_at_a_time_writes_into_a_folder(call: Any, skope: Any) -> None:
    picture(Path("in/a.png"))
    first = Progress(Path("road/.poses.jsonl"), ("sights",))
    with pytest.raises(UserError, match="road: another run is at work here"):
        Progress(Path("road/.poses.jsonl"), ("sights",))
    first.end()
    Progress(Path("road/.poses.jsonl"), ("sights",)).end()

    assert call("in", "--out", "seen")[0] == 0
    held = Progress(Path("seen/.predict.jsonl"), ("image", "results", "skipped"))
    code, _, error = call("in", "--out", "seen")
    assert (code, error.count("\n")) == (2, 1)
    assert "another run is at work here" in error
    held.end()
    assert call("in", "--out", "seen")[0] == 0


def test_a_full_disk_is_one_line(call: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    picture(Path("in/a.png"))

    def full(self: Any, row: Any) -> None:
        with progress.writing(self._path.parent):
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(progress.Progress, "add", full)
    code, _, error = call("in", "--out", "seen")
    assert (code, error) == (2, "skope: seen: cannot be written: No space left on device\n")


def test_what_could_not_be_read_is_remembered_by_the_next_run(call: Any, stops_after: Any) -> None:
    for name in "bcdef":
        picture(Path(f"in/{name}.png"))
    Path("in/a.jpg").write_bytes(b"\xff\xd8 no picture")
    with stops_after(3):
        assert call("in", "--out", "parts")[0] == 130
    stopped, whole = call("in", "--out", "parts", "--strict"), call("in", "--out", "whole", "--strict")
    assert stopped[0] == whole[0] == 1
    assert "a.jpg" in stopped[2]
    assert stopped[2] == whole[2]
    assert Path("parts/predictions.json").read_bytes() == Path("whole/predictions.json").read_bytes()


def test_images_keep_names_of_their_own(call: Any) -> None:
    for name in ("x/i.jpg", "y/i.jpg", "y/i.png"):
        picture(Path("in", name))
    assert call("in/*/*", "--overlay", "--out", "seen")[0] == 0
    assert [image.file_name for image in coco.read(Path("seen/frames.json")).images] == [
        "x/i.jpg",
        "y/i.jpg",
        "y/i.png",
    ]
    assert coco.read(Path("seen/frames.json")).info["found_at"] == "../in"
    drawn = {str(path.relative_to("seen/overlays")) for path in Path("seen/overlays").rglob("*.jpg")}
    assert drawn == {"x/i.jpg", "y/i.jpg.jpg", "y/i.png.jpg"}


def test_an_image_thinner_than_a_pixel_shows_nothing(call: Any) -> None:
    picture(Path("in/a.png"))
    picture(Path("in/thin.png"), (3000, 2, 3))
    assert call("in", "--score", 0.05, "--out", "seen")[0] == 0
    assert len(coco.read(Path("seen/frames.json")).images) == 2
    assert {result.image_id for result in coco.read_results(Path("seen/predictions.json"))} == {1}


def test_a_name_that_no_dataset_can_hold_is_refused_before_anything_is_done(call: Any) -> None:
    picture(Path("in/a.png"))
    picture(Path("in/z\nz.png"))
    code, _, error = call("in", "--out", "seen")
    assert code == 2
    assert r"in/z\nz.png" in error
    assert not Path("seen").exists()


@pytest.mark.parametrize(
    ("command", "flags", "message"),
    [
        *(("track", ("--fps", rate), "--fps: expected a number") for rate in ("nan", "0", "1e-300")),
        *(("track", ("--ground", height), "--ground: expected a height") for height in ("5,7", "1e300")),
        ("pose", ("--ground", "5,7"), "--ground: expected a height"),
        ("pose", ("--noise", "1e300"), "--noise: expected pixels"),
        ("track", ("--sigma", "1e300"), "--sigma: expected pixels"),
    ],
)
def test_flags_out_of_range_claim_no_folder(skope: Any, command: str, flags: tuple[str, str], message: str) -> None:
    code, _, error = skope("eval", command, "--annotations", "none.json", *flags, "--out", "t")
    assert code == 2
    assert message in error
    assert not Path("t").exists()


def test_whether_all_images_have_one_size_is_told_by_their_headers(tmp_path: Path) -> None:
    """As they are shown: one that is turned by its EXIF is as wide as the others are high."""

    def save(name: str, size: tuple[int, int], orientation: int = 1) -> None:
        exif = Picture.Exif()
        exif[274] = orientation
        Picture.new("RGB", size).save(tmp_path / name, exif=exif)

    save("a.jpg", (96, 64))
    save("b.jpg", (64, 96), orientation=6)
    (tmp_path / "c.jpg").write_bytes(b"none")
    assert open_footage(str(tmp_path)).one_size
    save("d.jpg", (64, 96))
    assert not open_footage(str(tmp_path)).one_size
