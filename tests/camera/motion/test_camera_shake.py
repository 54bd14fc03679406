"""A camera that sways, is knocked, or stands still, in videos that are parts of a picture moved by known amounts."""

import json
import math
import sys
import threading
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from skope.camera.motion import camera_shake as camera_sway
from skope.camera.motion.camera_motion import CameraMotion
from skope.camera.motion.camera_shake import (
    CameraShakeEstimator,
    CameraShakeRecord,
    MotionProcess,
    motion_of_row,
    motion_to_row,
    record_of,
)
from skope.camera.motion.image_shift import ImageMotion, ReferencePicture, SmallPicture
from skope.camera.motion.view_changes import ViewChange, ViewSamples
from skope.errors import UserError
from skope.schema import Image
from tests.camera.motion.test_image_shift import SIZE, picture, with_traffic
from tests.waiting import HANG_S

FPS = 10.0


def path(count: int, sway_px: float, period_s: float, bump_px: float = 0.0) -> list[tuple[float, float]]:
    """Shifts of frames by a sway, and by a bump halfway."""
    out = []
    for k in range(count):
        phase = 2 * math.pi * k / FPS / period_s
        out.append((sway_px * math.sin(phase) + bump_px * (k >= count / 2), 0.4 * sway_px * math.sin(1.7 * phase)))
    return out


def recorded(
    shifts: list[tuple[float, float]], processes: int = 0
) -> tuple[CameraShakeRecord, list[ViewChange], CameraMotion | None]:
    rng = np.random.default_rng(0)

    def frames() -> list[tuple[Image, Any]]:
        out = []
        for k, shift in enumerate(shifts):
            H = np.eye(3)
            H[:2, 2] = shift
            image = Image(id=k + 1, file_name=f"{k}", width=SIZE[0], height=SIZE[1], time_s=k / FPS)
            out.append((image, with_traffic(picture(H), rng, k)))
        return out

    watch, looks = CameraShakeEstimator(processes=processes), ViewSamples()
    images = [image for image, _ in looks.watch(watch.watch(iter(frames())))]
    rows = json.loads(json.dumps([motion_to_row(watch.taken(image.id)) for image in images]))
    record = record_of(images, map(motion_of_row, rows), SIZE[0])
    times = {image.id: image.time_s or 0.0 for image in images}
    changes = record.view_changes([(times[number], look) for number, look in looks.taken.items()])
    return record, changes, record.motion(changes)


def test_frames_pass_while_they_are_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    """A frame is not held up, what goes wrong with it is raised where its motion is asked for."""
    go, pixels = threading.Event(), np.zeros((20, 30, 3), np.uint8)

    def motion(self: ReferencePicture, picture: SmallPicture) -> ImageMotion | None:
        assert go.wait(HANG_S)
        if picture.fine[0, 0]:
            raise ValueError("spoilt")
        return None

    monkeypatch.setattr(ReferencePicture, "motion", motion)
    watch = CameraShakeEstimator()
    frames = [(Image(id=k, file_name=f"{k}", width=30, height=20, time_s=k / 10), pixels + (k == 2)) for k in (1, 2, 3)]
    passed = watch.watch(iter(frames))
    assert [next(passed)[0].id for _ in frames] == [1, 2, 3]
    go.set()
    assert watch.taken(1) is None
    with pytest.raises(ValueError, match="spoilt"):
        watch.taken(2)
    assert watch.taken(2) is None, "forgotten"
    assert list(passed) == []


def test_processes_measure_the_same() -> None:
    shifts = [(0.5 * k, -0.3 * k) for k in range(8)]
    several, none = (recorded(shifts, processes=count)[0] for count in (2, 0))
    assert (several.numbers, several.motions) == (none.numbers, none.motions)
    assert len(set(none.motions)) > 2


def test_a_measuring_process_tells_what_went_wrong_and_that_it_was_killed() -> None:
    first, other = (SmallPicture.of(picture(np.eye(3))), SmallPicture.of(np.zeros((10, 10, 3), dtype=np.uint8)))
    with closing(MotionProcess(first)) as process:
        with pytest.raises(ValueError, match="expected a picture of"):
            process.motion(other)
        still = process.motion(first)
        assert still is not None
        assert math.hypot(still.x, still.y) < 0.01
        process._process.kill()
        with pytest.raises(UserError, match="was killed"):
            process.motion(first)
    assert process._process.returncode is not None


@pytest.mark.parametrize("executable", ["/nowhere/python", None])
def test_where_no_process_can_be_started_this_one_measures(
    monkeypatch: pytest.MonkeyPatch, executable: str | None
) -> None:
    monkeypatch.setattr(sys, "executable", executable)
    monkeypatch.setenv("PATH", "/nowhere")
    shifts = [(0.5 * k, -0.3 * k) for k in range(4)]
    assert recorded(shifts, processes=2)[0].motions == recorded(shifts)[0].motions


def test_a_process_that_ends_by_itself_is_not_called_killed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", "/bin/true")
    with pytest.raises(UserError, match="ended by itself, with exit code 0"):
        recorded([(0.0, 0.0)] * 40, processes=1)


def test_what_libraries_print_is_no_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENCV_LOG_LEVEL", "DEBUG")
    shifts = [(0.5 * k, -0.3 * k) for k in range(4)]
    assert recorded(shifts, processes=1)[0].motions == recorded(shifts)[0].motions


def test_measuring_processes_end_with_the_watch() -> None:
    pixels = picture(np.eye(3))
    frames = (
        (Image(id=k, file_name=f"{k}", width=SIZE[0], height=SIZE[1], time_s=k / FPS), pixels) for k in range(1, 9)
    )
    made: list[MotionProcess] = []
    watch = CameraShakeEstimator(processes=2)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(camera_sway, "MotionProcess", lambda first: made.append(MotionProcess(first)) or made[-1])
        passed = watch.watch(frames)
        next(passed)
        passed.close()  # type: ignore[attr-defined]
    assert [process._process.returncode for process in made] == [0, 0]
    assert watch.taken(1) is not None


def test_a_camera_that_stands_still_has_no_motion() -> None:
    record, changes, motion = recorded([(0.0, 0.0)] * 20)
    assert None not in record.motions
    assert (changes, motion) == ([], None)


@pytest.mark.parametrize(("sway_px", "period_s"), [(1.0, 1.3), (10.0, 1.3), (10.0, 0.52)])
def test_a_sway_is_no_other_view_and_is_measured_from_its_middle(sway_px: float, period_s: float) -> None:
    """Looks half a second apart see one side of a sway of 0.52 s again and again."""
    shifts = path(52, sway_px, period_s)
    _, changes, motion = recorded(shifts)
    assert changes == []
    assert motion is not None
    found = np.array([(one.x, one.y) for one in motion.frames.values()])
    assert found - np.median(found, axis=0) == pytest.approx(np.array(shifts) - np.median(shifts, axis=0), abs=0.2)
    assert np.median(found, axis=0) == pytest.approx([0, 0], abs=1e-6)
    assert motion.shake_sigmas[0] == pytest.approx(np.std([x for x, _ in shifts]), rel=0.15)


def test_a_bump_is_told_to_the_frame_and_each_part_has_its_own_rest() -> None:
    shifts = path(78, 3.0, 1.3, bump_px=40.0)
    _, (change,), motion = recorded(shifts)
    assert not change.cut
    assert change.time_s == pytest.approx(3.9)
    assert change.shift * SIZE[0] == pytest.approx(40, abs=1.5)
    assert motion is not None
    assert motion.largest_px < 5


@pytest.mark.parametrize(("turn", "growth"), [(0.03, 0.0), (0.0, 0.03)])
def test_a_turn_or_zoom_about_the_middle_is_another_view(turn: float, growth: float) -> None:
    """The image's edges move by 9.6 px, its middle does not."""
    still, moved = ImageMotion(0, 0, 0, 0.1, 1e-4), ImageMotion(0, 0, turn, 0.1, 1e-4, growth=growth)
    record = CameraShakeRecord(tuple(range(80)), np.arange(80) / FPS, (still,) * 40 + (moved,) * 40, SIZE[0])
    (change,) = record.view_changes([])
    assert change.time_s == pytest.approx(4.0)
    assert change.shift * SIZE[0] == pytest.approx(9.6)


def test_the_movement_to_another_view_is_no_sway() -> None:
    shifts = [0.0] * 40 + [20.0, 40.0, 30.0, 50.0, 45.0] + [40.0] * 35
    motions = tuple(ImageMotion(x, 0, 0, 0.1, 1e-4) for x in shifts)
    record = CameraShakeRecord(tuple(range(80)), np.arange(80) / FPS, motions, SIZE[0])
    change = ViewChange(4.0, cut=False, shift=40 / SIZE[0])
    assert record.motion([change]) is not None
    assert record.motion([replace(change, settled_s=4.5)]) is None


def test_frames_that_cannot_be_told_have_none() -> None:
    record = CameraShakeRecord((1, 2, 3), np.arange(3.0), (None, None, None), 640)
    assert record.motion([]) is None
    moving = (ImageMotion(3, 0, 0, 0.1, 1e-4), None, ImageMotion(-3, 0, 0, 0.1, 1e-4))
    motion = replace(record, motions=moving).motion([])
    assert motion is not None
    assert motion.frames.keys() == {1, 3}
    assert motion.shake_sigmas == pytest.approx((3, 0, 0))


def write_video(path: Path, shifts: list[tuple[float, float]]) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), FPS, SIZE)
    for shift in shifts:
        H = np.eye(3)
        H[:2, 2] = shift
        writer.write(picture(H)[..., ::-1])
    writer.release()
    return path


def test_predict_notes_the_sway_and_a_stopped_run_measures_from_the_same_frame(
    skope: Any, random_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shifts = path(14, 4.0, 1.3)
    video = write_video(tmp_path / "mast.avi", shifts)
    call = ("eval", "predict", video, "--checkpoint", random_run, "--min-size", 64, "--every-frame", "--batch-size", 1)
    code, out, error = skope(*call, "--out", "whole")
    assert code == 0, error
    assert "mast: camera shake of" in out
    info = json.loads(Path("whole/frames.json").read_text())["info"]
    read = CameraMotion.from_dict("mast", info["camera_motion"])
    found = np.array([(one.x, one.y) for one in read.frames.values()])
    assert found == pytest.approx(np.array(shifts) - np.median(shifts, axis=0), abs=0.35)
    stop = CameraShakeEstimator.watch

    def stopping(self: CameraShakeEstimator, frames: Any) -> Any:
        for image, pixels in stop(self, frames):
            if image.id > 8:
                raise KeyboardInterrupt
            yield image, pixels

    monkeypatch.setattr(CameraShakeEstimator, "watch", stopping)
    assert skope(*call, "--out", "parts")[0] != 0
    monkeypatch.setattr(CameraShakeEstimator, "watch", stop)
    code, _, error = skope(*call, "--out", "parts")
    assert code == 0, error
    assert Path("parts/frames.json").read_bytes() == Path("whole/frames.json").read_bytes()
