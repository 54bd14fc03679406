"""A headless Chromium that tests and measurements steer through a pipe, by its DevTools protocol."""

import base64
import json
import os
import subprocess
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from tests.waiting import HANG_S, until


class _Pipes:
    """The two ends of a running Chromium's DevTools protocol."""

    def __init__(self, commands: int, answers: int) -> None:
        self._commands, self._answers = commands, answers
        self._number = 0
        self._read = b""

    def send(self, message: dict[str, Any]) -> int:
        """Send a command; its number."""
        self._number += 1
        os.write(self._commands, json.dumps({"id": self._number, **message}).encode() + b"\0")
        return self._number

    def next(self) -> dict[str, Any]:
        """The next answer or event."""
        while b"\0" not in self._read:
            data = os.read(self._answers, 1 << 20)
            assert data, "the browser has ended"
            self._read += data
        whole, _, self._read = self._read.partition(b"\0")
        return dict(json.loads(whole))


class Browser:
    """One page of a running Chromium, with nothing that other pages have left."""

    def __init__(self, pipes: _Pipes) -> None:
        self._pipes = pipes
        self._session: str | None = None
        self.events: list[dict[str, Any]] = []
        """What the browser told by itself: requests, messages on its console, errors."""
        self.context = self.call("Target.createBrowserContext")["browserContextId"]
        target = self.call("Target.createTarget", url="about:blank", browserContextId=self.context)["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: Any) -> Any:
        """The result of a command of the DevTools protocol."""
        message: dict[str, Any] = {"method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        number = self._pipes.send(message)
        while True:
            told = self._pipes.next()
            if told.get("id") == number:
                assert "error" not in told, told
                return told["result"]
            if told.get("sessionId") == self._session:
                self.events.append(told)

    def close(self) -> None:
        """Close the page, whatever work in it is not saved."""
        self._session = None
        self.call("Target.disposeBrowserContext", browserContextId=self.context)

    def run(self, script: str) -> Any:
        """The value of an expression in the page; of a promise, what it comes to."""
        told = self.call("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in told, told["exceptionDetails"]
        return told["result"].get("value")

    def until(self, script: str) -> None:
        """Wait until an expression is true."""
        until(partial(self.run, script))

    def open(self, address: str) -> None:
        """Go to an address."""
        self.call("Page.navigate", url=address)

    def press(self, key: str, text: str = "") -> None:
        """Press and release a key."""
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key=key, text=text if kind == "keyDown" else "")

    def size(self, width: int, height: int, *, phone: bool = False) -> None:
        """Make the window as large as this."""
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=phone)

    def screenshot(self, path: Path) -> None:
        """Write what is seen as a PNG file."""
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot")["data"]))

    def told(self, method: str) -> list[dict[str, Any]]:
        """The parameters of events of a kind so far."""
        return [event["params"] for event in self.events if event["method"] == method]


@contextmanager
def chromium(profile: Path) -> Iterator[Callable[[], AbstractContextManager[Browser]]]:
    """A Chromium with a profile of its own, which ends with the context: what opens a page of it, which then closes."""
    commands_out, commands_in = os.pipe()
    answers_out, answers_in = os.pipe()

    def pipes() -> None:  # Chromium reads from 3 and writes to 4
        # Neither end may lie where the other belongs.
        theirs = [os.dup2(end, 100 + i) for i, end in enumerate((commands_out, answers_in))]
        for end, place in zip(theirs, (3, 4), strict=True):
            os.dup2(end, place)

    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--remote-debugging-pipe", f"--user-data-dir={profile}"]
    process = subprocess.Popen(
        ["chromium", *flags],
        preexec_fn=pipes,
        close_fds=False,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    os.close(commands_out)
    os.close(answers_in)
    opened = _Pipes(commands_in, answers_out)

    @contextmanager
    def page() -> Iterator[Browser]:
        browser = Browser(opened)
        yield browser
        browser.close()

    try:
        yield page
    finally:
        os.close(commands_in)
        os.close(answers_out)
        process.terminate()
        process.wait(timeout=HANG_S)
