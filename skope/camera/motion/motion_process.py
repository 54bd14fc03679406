"""Measure how far an image has moved in a process of its own.

Beside a GPU's detector in one process, which gives the GPU thousands of small jobs a second, each call of OpenCV would
wait for its turn in Python, and the detector for that.
"""

import contextlib
import os
import pickle
import subprocess
import sys
from typing import Final

import cv2

from skope.camera.motion.image_shift import ImageMotion, ReferencePicture, SmallPicture
from skope.errors import UserError

_ONE_THREAD: Final = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL")}
"""Variables that keep libraries of linear algebra to one thread: for matrices as small as these more are slower."""
_END_S: Final = 10.0
"""A process whose pipes are closed has ended by then."""


class MotionProcess:
    """A process that holds pictures against a first one; it ends with this one, too. For one thread at a time."""

    def __init__(self, first: SmallPicture) -> None:
        """Start it; OSError where there can be no such process."""
        self.size = first.size
        # It imports what this process does.
        paths = os.pathsep.join(os.path.abspath(path) for path in sys.path if isinstance(path, str))  # noqa: PTH100
        # Its standard output is not for answers: libraries write there.
        read, write = os.pipe()
        main = f"from {__name__} import answer_pictures; answer_pictures({write})"
        try:
            self._process = subprocess.Popen(
                [sys.executable or "python", "-P", "-c", main],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                pass_fds=(write,),
                env={**os.environ, **_ONE_THREAD, "PYTHONPATH": paths},
                start_new_session=True,  # Ctrl-C is this process's to answer
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
        """The same as `ReferencePicture.motion` of the first picture; UserError where the process has ended."""
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
            code = self._process.wait(_END_S)
            if code >= 0:
                return UserError(
                    f"a process that measures the camera's sway ended by itself, with exit code {code}: does "
                    f"`{sys.executable} -c 'import cv2'` work?"
                )
        return UserError(
            "a process that measures the camera's sway was killed, perhaps for want of memory; the same command goes "
            "on from here"
        )


def answer_pictures(answers_fd: int) -> None:
    """Read pictures from standard input, the first one to hold the others against, and write their motions.

    `answers_fd` is the file that answers go to. It ends where the process that asks does, in whatever way.
    """
    cv2.setNumThreads(1)  # there are others of its kind
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
            except Exception as error:  # raised again where the motion is asked for
                answer = error
            pickle.dump(answer, answers)
            answers.flush()
