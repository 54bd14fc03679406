"""A road with markings at known places, a camera that sees it, and the page of it in a headless Chromium."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from skope.camera.model import Camera
from skope.site.page.inputs import SiteFrames
from skope.site.page.site_server import SiteServer, bound_site
from tests.chromium import Browser

SIZE = (640, 360)
CAMERA = Camera.looking([2.0, -3.0, 6.5], yaw=1.2, pitch_down=0.32, roll=0.02, size=SIZE, fov=1.15)
"""The camera of all tests here: 6.5 m over a road, towards north-north-east."""
PLACES = np.array([[6.0, 9.0], [1.5, 11.0], [9.5, 16.0], [3.0, 22.0], [14.0, 26.0], [8.0, 33.0]])
"""(6, 2) crosses that are painted on the road, metres; all are in the image."""


def pixels_of(places: Any) -> Any:
    """(N, 2) pixels of places (N, 2) on the road."""
    xy = np.asarray(places, dtype=np.float64)
    return CAMERA.project(np.concatenate([xy, np.zeros((len(xy), 1))], axis=1))[0]


def road_picture() -> Any:
    """(H, W, 3) BGR: grey road with crosses at `PLACES`, pale sky."""
    picture = np.full((SIZE[1], SIZE[0], 3), (110, 108, 104), dtype=np.uint8)
    rays, _ = CAMERA.rays(np.stack(np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5), axis=-1))
    picture[(rays @ CAMERA.T_camera_world[:3, :3])[..., 2] > 0] = (220, 205, 190)
    for place in PLACES:
        for way in ([0.6, 0.0], [0.0, 0.6]):
            a, b = pixels_of([place - way, place + way])
            ends = [tuple(int(v * 16) for v in end - 0.5) for end in (a, b)]
            cv2.line(picture, ends[0], ends[1], (250, 250, 250), 2, cv2.LINE_AA, 4)
    return picture


def empty_document(**lists: Any) -> dict[str, Any]:
    """A document of the page with these lists."""
    kinds = ("points", "lengths", "parallels", "verticals", "gates", "zones", "lanes", "occluders")
    return {kind: [] for kind in kinds} | {"camera": None, "known": {}} | lists


def marked_points(count: int = 6) -> list[dict[str, Any]]:
    """Points of a document, exactly where the camera sees them."""
    pixels = pixels_of(PLACES[:count])
    return [
        {"name": str(i + 1), "pixel": pixel.tolist(), "place": [*place.tolist(), 0.0]}
        for i, (pixel, place) in enumerate(zip(pixels, PLACES[:count], strict=True))
    ]


@dataclass
class Served:
    """A page that is served from this process."""

    server: SiteServer
    path: Path

    @property
    def origin(self) -> str:
        return f"http://127.0.0.1:{self.server.server_port}"


@pytest.fixture
def image(tmp_path: Path) -> Path:
    path = tmp_path / "road.png"
    assert cv2.imwrite(str(path), road_picture())
    return path


@pytest.fixture
def serve(tmp_path: Path, image: Path) -> Iterator[Callable[..., Served]]:
    """Serve the page of the road, or of other frames; more than one window may be opened on it."""
    with ExitStack() as stack:

        def start(frames: SiteFrames | None = None, path: Path = tmp_path / "site.toml", **added: Any) -> Served:
            server = stack.enter_context(bound_site(frames or SiteFrames.of_footage(str(image)), path, added, 0))
            threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True).start()
            stack.callback(server.shutdown)
            return Served(server, path)

        yield start


@pytest.fixture
def browser(chromium_pages: Callable[[], AbstractContextManager[Browser]]) -> Iterator[Browser]:
    """One for each test: a page with work that is not saved asks before it is left, and nobody would answer."""
    with chromium_pages() as page:
        yield page


class SitePage:
    """The page in a browser, steered as a person does."""

    def __init__(self, browser: Browser, served: Served, width: int, height: int) -> None:
        self.browser, self.served = browser, served
        phone = width < 600
        browser.call("Emulation.setTouchEmulationEnabled", enabled=phone)
        browser.size(width, height, phone=phone)
        browser.events.clear()
        browser.call("Page.navigate", url=served.origin + "/")
        browser.until("document.getElementById('stage')?.dataset.ready === 'true'")
        self.settle()

    def settle(self) -> None:
        """Wait until the server has answered to the last change."""
        time.sleep(0.05)
        self.browser.until("document.getElementById('stage').getAttribute('aria-busy') === 'false'")

    def screen(self, position: Any, size: tuple[int, int] = SIZE) -> tuple[float, float]:
        """Where a pixel of the view is on the screen."""
        box = self.browser.run(
            "(() => { const v = document.getElementById('drawing').viewBox.baseVal,"
            " b = document.getElementById('stage').getBoundingClientRect();"
            " return [b.left, b.top, b.width / v.width, v.x, v.y]; })()"
        )
        left, top, scale, x, y = box
        return left + (float(position[0]) - x) * scale, top + (float(position[1]) - y) * scale

    def click(self, position: Any) -> None:
        """Press and release the mouse on a pixel of the view."""
        x, y = self.screen(position)
        self.drag((x, y), (x, y))

    def drag(self, begin: tuple[float, float], end: tuple[float, float]) -> None:
        """Press the mouse at a place of the screen and release it at another."""
        steps = [] if begin == end else [((begin[0] + end[0]) / 2, (begin[1] + end[1]) / 2), end]
        self._mouse("mouseMoved", begin, 0)
        self._mouse("mousePressed", begin, 1)
        for step in steps:
            self._mouse("mouseMoved", step, 1)
        self._mouse("mouseReleased", end, 0)

    def _mouse(self, kind: str, at: tuple[float, float], buttons: int) -> None:
        click = 0 if kind == "mouseMoved" else 1
        button = "none" if kind == "mouseMoved" and not buttons else "left"
        self.browser.call(
            "Input.dispatchMouseEvent", type=kind, x=at[0], y=at[1], button=button, buttons=buttons, clickCount=click
        )

    def touch(self, *way: Any) -> None:
        """Put a finger on a pixel of the view, move it over the others, and lift it on the last one."""
        for i, position in enumerate(way):
            x, y = self.screen(position)
            kind = "touchMove" if i else "touchStart"
            self.browser.call("Input.dispatchTouchEvent", type=kind, touchPoints=[{"x": x, "y": y}])
        self.browser.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])

    def tool(self, name: str) -> None:
        self.browser.run(f"document.querySelector('[data-tool={name}]').click()")

    def press(self, key: str, *, shift: bool = False, ctrl: bool = False, times: int = 1) -> None:
        """Press a key so many times, as a keyboard sends it."""
        modifiers = (8 if shift else 0) | (2 if ctrl else 0)
        codes = {"Tab": 9, "Enter": 13, "Escape": 27, "Delete": 46, "ArrowLeft": 37, "ArrowUp": 38, "ArrowRight": 39}
        codes |= {"ArrowDown": 40, " ": 32}
        code = codes.get(key, ord(key.upper()) if len(key) == 1 else 0)
        text = "\r" if key == "Enter" else key if len(key) == 1 and not ctrl else ""
        for _ in range(times):
            down: dict[str, Any] = {"key": key, "windowsVirtualKeyCode": code, "modifiers": modifiers}
            self.browser.call("Input.dispatchKeyEvent", type="keyDown", text=text, **down)
            self.browser.call("Input.dispatchKeyEvent", type="keyUp", **down)

    def type(self, text: str) -> None:
        """Type over what the field that has the focus holds, and leave it by Tab."""
        self.browser.run("document.activeElement.select()")
        self.browser.call("Input.insertText", text=text)
        self.press("Tab")

    def fill(self, focus: str, text: str) -> None:
        """Type into the field with this key."""
        self.browser.run(f"document.querySelector('[data-focus=\"{focus}\"]').focus()")
        self.type(text)

    def text(self, css: str) -> str:
        """The text of an element that is shown; empty where none is."""
        shown = f"[...document.querySelectorAll({css!r})].filter((e) => !e.closest('[hidden]'))"
        return str(self.browser.run(f"{shown}.map((e) => e.innerText ?? e.textContent).join(' ')"))

    def count(self, css: str) -> int:
        return int(self.browser.run(f"document.querySelectorAll({css!r}).length"))


@pytest.fixture
def open_page(browser: Browser, serve: Callable[..., Served]) -> Iterator[Callable[..., SitePage]]:
    """Open the page; at the end nothing has gone wrong in it or been asked elsewhere."""
    origins: list[str] = []

    def start(served: Served | None = None, width: int = 1280, height: int = 800) -> SitePage:
        browser.call("Page.navigate", url="about:blank")
        page = SitePage(browser, served or serve(), width, height)
        origins.append(page.served.origin)
        return page

    yield start
    browser.run("0")  # the events so far
    asked = [event["request"]["url"] for event in browser.told("Network.requestWillBeSent")]
    assert asked
    assert all(url.startswith((*origins, "data:", "about:", "blob:")) for url in asked), asked
    thrown = [event["exceptionDetails"] for event in browser.told("Runtime.exceptionThrown")]
    assert [one.get("exception", one).get("description") for one in thrown] == []
    said = [event["entry"]["text"] for event in browser.told("Log.entryAdded")]
    assert [text for text in said if "status of 4" not in text] == []  # what the server refuses, browsers log
