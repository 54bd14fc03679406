"""Measure camera shake and permanent camera moves in a video by comparing each frame with the first one.

If a GPU runs the detector, image shifts are measured in a separate process. In one process, each OpenCV call would
wait for Python, which hands thousands of small jobs per second to the GPU, and the detector would wait for OpenCV.
"""

import contextlib
import os
import pickle
import subprocess
import sys
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass, replace
from queue import SimpleQueue
from typing import Final, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from skope.camera.motion.camera_motion import CameraMotion
from skope.camera.motion.image_shift import SHIFT_LIMITS, ImageMotion, ReferencePicture, SmallPicture
from skope.camera.motion.view_changes import ViewChange, changes
from skope.errors import UserError
from skope.schema import Image
from skope.types import Array, Pixels

_ONE_THREAD: Final = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL")}
"""Environment variables that limit linear algebra libraries to one thread, which is faster for small matrices."""


@dataclass(frozen=True)
class ShakeLimits:
    """Limits of measuring camera shake."""

    end_s: float = 10.0
    """Maximum time for the measuring process to end after its pipes are closed, seconds."""
    still_px: float = 0.1
    """Standard deviation of the shift, pixels per axis of an image `still_width_px` wide, below which the camera is
    still. Keypoints are ten times as uncertain."""
    still_width_px: int = 640
    rayleigh_95: float = 2.448
    """Radius that contains 95% of shifts, in standard deviations per axis."""
    around_s: float = 3.0
    """Duration before and after a move over which the mean image position is compared, seconds. Masts vibrate
    several times in it."""
    fewest_frames: int = 3
    """Minimum number of frames of such a mean."""


SHAKE_LIMITS: Final = ShakeLimits()


class MotionProcess:
    """Process that compares images with a first one. It ends with its parent. Use it from one thread at a time."""

    def __init__(self, first: SmallPicture) -> None:
        """Start the process; raises OSError if it cannot be started."""
        self.size = first.size
        # It imports the same modules as this process.
        paths = os.pathsep.join(os.path.abspath(path) for path in sys.path if isinstance(path, str))  # noqa: PTH100
        # Answers do not use its standard output, because libraries write there.
        read, write = os.pipe()
        main = f"from {__name__} import answer_pictures; answer_pictures({write})"
        try:
            self._process = subprocess.Popen(
                [sys.executable or "python", "-P", "-c", main],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                pass_fds=(write,),
                env={**os.environ, **_ONE_THREAD, "PYTHONPATH": paths},
                start_new_session=True,  # Ctrl-C is handled by this process
            )
        except OSError:
            os.close(read)
            raise
        finally:
            os.close(write)
        assert self._process.stdin is not None
        self._pictures, self._answers = self._process.stdin, os.fdopen(read, "rb")
        try:
            self._send(first)
        except BaseException:
            self.close()
            raise

    def motion(self, picture: SmallPicture) -> ImageMotion | None:
        """Measure the motion from the first image to another image, in the process; see `ReferencePicture.motion`.

        Raises UserError if the process has ended.
        """
        self._send(picture)
        try:
            answer: ImageMotion | Exception | None = pickle.load(self._answers)
        except (EOFError, pickle.UnpicklingError):
            raise self._ended() from None
        if isinstance(answer, Exception):
            raise answer
        return answer

    def close(self) -> None:
        """End the process."""
        with contextlib.suppress(BrokenPipeError):
            self._pictures.close()
        self._process.wait()
        self._answers.close()

    def _send(self, picture: SmallPicture) -> None:
        try:
            pickle.dump(picture, self._pictures, protocol=pickle.HIGHEST_PROTOCOL)
            self._pictures.flush()
        except BrokenPipeError:
            raise self._ended() from None

    def _ended(self) -> UserError:
        with contextlib.suppress(subprocess.TimeoutExpired):
            code = self._process.wait(SHAKE_LIMITS.end_s)
            if code >= 0:
                return UserError(
                    f"a process that measures camera shake ended by itself, with exit code {code}: does "
                    f"`{sys.executable} -c 'import cv2'` work?"
                )
        return UserError(
            "a process that measures camera shake was killed, perhaps for lack of memory; run the same command again "
            "to resume"
        )


def answer_pictures(answers_fd: int) -> None:
    """Read images from standard input, compare them with the first, and write their motions.

    `answers_fd` is the file descriptor for the answers. The function returns when the asking process ends.
    """
    cv2.setNumThreads(1)  # several of these processes run in parallel
    pictures = sys.stdin.buffer
    with (
        contextlib.suppress(EOFError, BrokenPipeError, pickle.UnpicklingError),
        os.fdopen(answers_fd, "wb") as answers,
    ):
        reference = ReferencePicture(pickle.load(pictures))
        while True:
            picture = pickle.load(pictures)
            try:
                answer: ImageMotion | Exception | None = reference.motion(picture)
            except Exception as error:  # raised again in the process that asked for the motion
                answer = error
            pickle.dump(answer, answers)
            answers.flush()


class CameraShakeEstimator:
    """Measures the displacement of each frame of a video from the first frame, while the caller processes the frame."""

    def __init__(self, first: Pixels | None = None, processes: int = 0) -> None:
        """Prepare to measure a video.

        Args:
            first: The footage's first frame, if a run is resumed after it.
            processes: Number of separate processes that measure; 0: a thread of this process.
        """
        self._first = None if first is None else SmallPicture.of(first)
        self._processes = processes
        self._begun: dict[int, Future[ImageMotion | None]] = {}
        """Pending motions by frame number."""

    def watch(self, frames: Iterable[tuple[Image, Pixels]]) -> Iterator[tuple[Image, Pixels]]:
        """Yield the frames unchanged and measure them; single images, which have no times, are not measured.

        The first frame with a time is the reference, unless one was given.
        """
        idle: SimpleQueue[_Measure] | None = None
        with ExitStack() as ends, ThreadPoolExecutor(max(1, self._processes)) as pool:
            for image, pixels in frames:
                if image.time_s is not None:
                    idle = idle or self._measures(pixels, ends)
                    self._begun[image.id] = pool.submit(_motion, idle, pixels)
                yield image, pixels

    def taken(self, number: int) -> ImageMotion | None:
        """Return and forget the motion of a frame, by its number; None if it could not be measured."""
        begun = self._begun.pop(number, None)
        return None if begun is None else begun.result()

    def _measures(self, pixels: Pixels, ends: ExitStack) -> "SimpleQueue[_Measure]":
        """Start the measuring objects for all further frames, one frame at a time each; `pixels` is the first frame."""
        first = self._first or SmallPicture.of(pixels)
        idle: SimpleQueue[_Measure] = SimpleQueue()
        with suppress(OSError):  # if the processes cannot be started, this one measures
            for _ in range(self._processes):
                idle.put(ends.enter_context(closing(MotionProcess(first))))
        if idle.empty():
            idle.put(ReferencePicture(first))
        return idle


_Measure: TypeAlias = ReferencePicture | MotionProcess


def _motion(idle: "SimpleQueue[_Measure]", pixels: Pixels) -> ImageMotion | None:
    measure = idle.get()
    try:
        return measure.motion(SmallPicture.of(pixels)) if pixels.shape[1::-1] == measure.size else None
    finally:
        idle.put(measure)


@dataclass(frozen=True, eq=False)
class CameraShakeRecord:
    """Motion of all frames of a video, relative to the first one."""

    numbers: tuple[int, ...]
    """`Image.id` of each frame."""
    times_s: Array
    """(N,) times of the frames, seconds, rising."""
    motions: tuple[ImageMotion | None, ...]
    width: int
    """Width of the images, pixels."""

    def view_changes(self, looks: Sequence[tuple[float, str]]) -> list[ViewChange]:
        """Return the permanent changes of the view: jumps of the mean image position, and otherwise those of `changes`.

        The small images are half a second apart. Alone, they may all show the same phase of a shake.
        """
        return sorted([*self._moves(), *changes(looks, self._unmeasured)], key=lambda change: change.time_s)

    def motion(self, view_changes: Sequence[ViewChange]) -> CameraMotion | None:
        """Return the camera's shake around its rest position in each of its views; None for a still camera."""
        part = np.searchsorted([change.time_s for change in view_changes], self.times_s, side="right")
        values = self._values
        for change in view_changes:
            if change.settled_s is not None:  # the movement to another view is not shake
                values[(self.times_s >= change.time_s) & (self.times_s < change.settled_s)] = np.nan
        known = np.isfinite(values[:, 0])
        for k in np.unique(part):
            rows = (part == k) & known
            if rows.any():
                values[rows] -= np.median(values[rows], axis=0)
        if not known.any():
            return None
        away = np.linalg.norm(values[known, :2], axis=1)
        still = SHAKE_LIMITS.still_px * max(1.0, self.width / SHAKE_LIMITS.still_width_px)
        if np.percentile(away, 95) <= SHAKE_LIMITS.rayleigh_95 * still:
            return None
        frames = {
            number: replace(motion, x=float(row[0]), y=float(row[1]), turn=float(row[2]))
            for number, motion, row in zip(self.numbers, self.motions, values, strict=True)
            if motion is not None and np.isfinite(row).all()
        }
        x, y, turn = np.sqrt((values[known] ** 2).mean(axis=0)).tolist()
        return CameraMotion(frames, (x, y, turn))

    @property
    def _values(self) -> Array:
        """(N, 3) x, y, turn; NaN if unknown."""
        nothing = (np.nan,) * 3
        rows = [
            nothing if frame_motion is None else (frame_motion.x, frame_motion.y, frame_motion.turn)
            for frame_motion in self.motions
        ]
        return np.array(rows, dtype=np.float64).reshape(-1, 3)

    def _unmeasured(self, time_s: float) -> bool:
        """Return whether too few frames after a time have a known motion."""
        soon = (self.times_s >= time_s) & (self.times_s < time_s + SHAKE_LIMITS.around_s)
        return int(np.isfinite(self._values[soon, 0]).sum()) < SHAKE_LIMITS.fewest_frames

    def _moves(self) -> list[ViewChange]:
        """Return changes of the view: times at which the mean image position over some seconds jumps.

        Turns and zooms count as the displacement of the image's left and right edge.
        """
        known = np.isfinite(self._values[:, 0])
        half = self.width / 2
        measured = [motion for motion in self.motions if motion is not None]
        rows = [
            (frame_motion.x, frame_motion.y, half * frame_motion.turn, half * frame_motion.growth)
            for frame_motion in measured
        ]
        places, times = np.array(rows, dtype=np.float64).reshape(-1, 4), self.times_s[known]
        if not len(times):
            return []
        ends = np.searchsorted(times, times + SHAKE_LIMITS.around_s)
        # Windows that are cut short by the footage are less reliable.
        whole = (ends - np.arange(len(times)) >= SHAKE_LIMITS.fewest_frames) & (
            times + SHAKE_LIMITS.around_s <= times[-1] + 1e-6
        )
        sums = np.concatenate([np.zeros((1, 4)), np.cumsum(places, axis=0)])
        means = (sums[ends] - sums[: len(times)]) / np.maximum(ends - np.arange(len(times)), 1)[:, None]
        out, begin = list[ViewChange](), 0
        while begin < len(times) and whole[begin]:
            away = np.linalg.norm(means - means[begin], axis=1) > SHIFT_LIMITS.moved_share * self.width
            later = np.flatnonzero(away & whole & (np.arange(len(times)) > begin))
            if not len(later):
                break
            low = max(begin, int(np.searchsorted(times, times[later[0]] - SHAKE_LIMITS.around_s)))
            at = low + _split(places[low : np.searchsorted(times, times[later[0]] + 2 * SHAKE_LIMITS.around_s)])
            if whole[at]:
                shift = float(np.linalg.norm(means[at] - places[low:at].mean(axis=0))) / self.width
                if shift > SHIFT_LIMITS.moved_share:
                    out.append(ViewChange(float(times[at]), cut=False, shift=shift))
            begin = max(at, begin + 1)
        return out


def _split(places: Array) -> int:
    """Return the index that splits positions (N, 4) into two parts with the least squares around their means."""
    count = np.arange(1, len(places))[:, None]
    sums = np.cumsum(places, axis=0)
    before, after = sums[:-1], sums[-1] - sums[:-1]
    # The squares around two means equal those around zero less these.
    explained = (before**2 / count + after**2 / (len(places) - count)).sum(axis=1)
    return 1 + int(explained.argmax())


def motion_to_row(motion: ImageMotion | None) -> list[float] | None:
    """Return JSON values of a frame's motion, not rounded."""
    if motion is None:
        return None
    return [motion.x, motion.y, motion.turn, motion.sigma_px, motion.sigma_turn, motion.growth]


def motion_of_row(row: Sequence[float] | None) -> ImageMotion | None:
    """Return the motion of a row from `motion_to_row`."""
    return None if row is None else ImageMotion(*row)


def record_of(images: Iterable[Image], motions: Iterable[ImageMotion | None], width: int) -> CameraShakeRecord:
    """Return the record of the motions of images `width` pixels wide; images without times are left out."""
    timed = [
        (image.id, image.time_s, motion)
        for image, motion in zip(images, motions, strict=True)
        if image.time_s is not None
    ]
    seconds: NDArray[np.float64] = np.array([time_s for _, time_s, _ in timed], dtype=np.float64)
    return CameraShakeRecord(
        tuple(number for number, _, _ in timed), seconds, tuple(frame_motion for _, _, frame_motion in timed), width
    )
