"""Measure how far an image has moved in a process of its own.

Beside a GPU's detector in one process, which gives the GPU thousands of small jobs a second, each call of OpenCV would
wait for its turn in Python, and the detector for that.
"""

import contextlib
import os
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Final

import cv2

from skope.errors import UserError
from skope.eval.image_shift import ImageMotion, ReferencePicture, SmallPicture

_ONE_THREAD: Final = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL")}
"""Variables that keep libraries of linear algebra to one thread: for matrices as small as these more are slower."""
_MAIN: Final = f"from {__name__} import answer_pictures; answer_pictures()"


class MotionProcess:
    """A process that holds pictures against a first one; it ends with this one, too. For one thread at a time."""

    def __init__(self, first: SmallPicture) -> None:
        self.size = first.size
        # It imports what this process does; Ctrl-C is this process's to answer.
        paths = os.pathsep.join(path or str(Path.cwd()) for path in sys.path)
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-c", _MAIN],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, **_ONE_THREAD, "PYTHONPATH": paths},
            start_new_session=True,
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._pictures, self._answers = self._process.stdin, self._process.stdout
        self._send(first)

    def motion(self, picture: SmallPicture) -> ImageMotion | None:
        """The same as `ReferencePicture.motion` of the first picture; UserError where the process was killed."""
        self._send(picture)
        try:
            answer: ImageMotion | Exception | None = pickle.load(self._answers)
        except EOFError:
            raise self._killed() from None
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
            raise self._killed() from None

    def _killed(self) -> UserError:
        return UserError(
            "a process that measures the camera's sway was killed, perhaps for want of memory; the same command goes "
            "on from here"
        )


def answer_pictures() -> None:
    """Read pictures from standard input, the first one to hold the others against, and write their motions."""
    cv2.setNumThreads(1)  # there are others of its kind
    pictures, answers = sys.stdin.buffer, sys.stdout.buffer
    with contextlib.suppress(EOFError):
        reference = ReferencePicture(pickle.load(pictures))
        while True:
            picture = pickle.load(pictures)
            try:
                answer: ImageMotion | Exception | None = reference.motion(picture)
            except Exception as error:  # raised again where the motion is asked for
                answer = error
            pickle.dump(answer, answers)
            answers.flush()
