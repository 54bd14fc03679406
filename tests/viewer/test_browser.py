"""The page in a browser: what is switched, filtered and paged is what is seen, and nothing outside is asked."""

import shutil
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pytest

from skope.viewer.collection import Collection
from tests.chromium import Browser

pytestmark = pytest.mark.skipif(shutil.which("chromium") is None, reason="needs chromium")

SHOWN = "+document.getElementById('stage').dataset.number"
READY = f"document.getElementById('stage') && {SHOWN} >= 0 && document.getElementById('filters').children.length > 1"


@pytest.fixture(scope="module")
def browser(chromium_pages: Callable[[], AbstractContextManager[Browser]]) -> Iterator[Browser]:
    with chromium_pages() as page:
        yield page


@pytest.fixture
def looking(
    browser: Browser,
    served: Callable[[Collection], int],
    tmp_path: Path,  # so that the images outlive the page, which reads the next ones ahead
) -> Iterator[Callable[..., Browser]]:
    """Open a collection in a browser window; at the end nothing has gone wrong in it or been asked elsewhere."""
    origin = ""

    def look(collection: Collection, width: int = 1280, height: int = 800) -> Browser:
        nonlocal origin
        origin = f"http://127.0.0.1:{served(collection)}/"
        browser.open("about:blank")  # what the page before still asks for is not this one's
        browser.run("0")
        browser.events.clear()
        browser.size(width, height, phone=width < 600)
        browser.open(origin)
        browser.until(READY)
        return browser

    yield look
    browser.run("0")  # the events so far
    asked = [event["request"]["url"] for event in browser.told("Network.requestWillBeSent")]
    assert asked
    assert all(url.startswith((origin, "data:")) for url in asked), asked
    assert browser.told("Runtime.exceptionThrown") == []
    assert [(event["entry"]["text"], event["entry"].get("url")) for event in browser.told("Log.entryAdded")] == []


def seen(browser: Browser, css: str) -> int:
    """How many elements of the drawing are displayed."""
    return int(
        browser.run(f"[...document.querySelectorAll('#stage {css}')].filter(e => e.getClientRects().length).length")
    )


def view_of(browser: Browser) -> list[float]:
    """Left, top, width and height of what is seen of the image, pixels."""
    return [float(v) for v in browser.run("document.getElementById('drawing').getAttribute('viewBox')").split()]


def choose(browser: Browser, name: str, words: str) -> str:
    """Choose an entry of a filter by its words; returns what the page says of how many images there are."""
    browser.run(
        f"""(() => {{
          const select = document.querySelector('select[data-filter="{name}"]');
          select.value = [...select.options].find((option) => option.textContent === {words!r}).value;
          select.dispatchEvent(new Event("change"));
        }})()"""
    )
    return str(browser.run("document.getElementById('count').textContent"))


def test_keys_turn_pages_and_switch_layers(looking: Callable[..., Browser], labelled: Collection) -> None:
    browser = looking(labelled)
    for key, number in (
        ("ArrowRight", 1),
        (" ", 2),
        ("ArrowRight", 3),
        ("ArrowRight", 3),
        ("ArrowLeft", 2),
        ("Home", 0),
        ("End", 3),
    ):
        browser.press(key)
        browser.until(f"{SHOWN} === {number}")
    assert browser.run("document.getElementById('count').textContent").startswith("image 4 of 4: images/site/")
    boxes = {"b": ".box", "k": ".dots", "s": ".edges", "i": ".ignored .box"}
    before = {key: seen(browser, css) for key, css in boxes.items()}
    assert before == {"b": 2, "k": 2, "s": 2, "i": 0}
    for key, css in boxes.items():
        browser.press(key)
        assert (seen(browser, css) > 0) == (key == "i"), key
        browser.press(key)
        assert seen(browser, css) == before[key]
    browser.press("0")
    assert seen(browser, "svg") == 0
    browser.press("0")
    browser.press("?")
    assert browser.run("document.getElementById('help').open")
    browser.press("Escape")


def test_the_drawing_lies_where_the_labels_are(looking: Callable[..., Browser], labelled: Collection) -> None:
    browser = looking(labelled)
    vehicle = labelled.splits[0].file.annotations[0]
    place = browser.run(
        "(() => { const c = document.querySelector('canvas').getBoundingClientRect(),"
        " b = document.querySelector('.truth .box').getBoundingClientRect(), s = 160 / c.width;"
        " return [(b.left - c.left) * s, (b.top - c.top) * s, b.width * s, b.height * s]; })()"
    )
    assert place == pytest.approx(vehicle.bbox.tolist(), abs=1.0)
    assert view_of(browser) == pytest.approx([0, 0, 160, 120], abs=0.1)


def test_people_and_two_wheelers_have_a_layer_of_their_own(
    looking: Callable[..., Browser], labelled: Collection, peopled: Collection
) -> None:
    browser = looking(peopled)
    assert (seen(browser, ".others .box"), seen(browser, ".truth .box")) == (2, 2)
    facts = browser.run("document.getElementById('facts').textContent")
    assert "pedestrians1" in facts
    assert "bicycles1" in facts
    browser.press("o")
    assert (seen(browser, ".others .box"), seen(browser, ".truth .box")) == (0, 2)
    browser.press("o")
    browser.press("ArrowRight")
    browser.until(f"{SHOWN} === 1")
    browser.press("i")
    assert (seen(browser, ".others .box"), seen(browser, ".ignored .box")) == (0, 1)
    browser = looking(labelled)
    assert not browser.run("document.getElementById('layers').textContent").count("two-wheelers")


def test_filters_of_images_and_vehicles(looking: Callable[..., Browser], labelled: Collection) -> None:
    browser = looking(labelled)
    assert choose(browser, "weather", "rain").startswith("image 1 of 2 (4 in all)")
    assert choose(browser, "vehicle type", "bus") == "no image is like that"
    assert seen(browser, "svg") == 0
    assert choose(browser, "weather", "all").startswith("image 1 of 1 (4 in all): images/site/00_000002.png")
    browser.until(f"{SHOWN} === 1")
    assert seen(browser, ".truth .box") == 1  # the bus alone
    # The bus is hidden by half: no vehicle that is a bus and seen whole.
    assert choose(browser, "hidden share", "0-0.1") == "no image is like that"
    assert choose(browser, "vehicle type", "all").startswith("image 1 of 4")


def test_predictions_beside_truth_and_the_worst_first(looking: Callable[..., Browser], predicted: Collection) -> None:
    browser = looking(predicted)
    assert (seen(browser, ".truth .box"), seen(browser, ".found .box"), seen(browser, ".stray")) == (2, 2, 1)
    assert choose(browser, "show", "with misses").startswith("image 1 of 2 (4 in all): images/site/00_000002.png")
    browser.until(f"{SHOWN} === 1")
    assert browser.run("[...document.querySelectorAll('.wrong text')].map(e => e.textContent)") == ["missed"] * 2
    # Of missed vehicles those count that the filters want.
    assert choose(browser, "vehicle type", "bus").startswith("image 1 of 1")
    assert choose(browser, "vehicle type", "van") == "no image is like that"
    choose(browser, "vehicle type", "all")
    assert choose(browser, "show", "with false alarms").startswith("image 1 of 1 (4 in all): images/site/00_000004.png")
    choose(browser, "show", "all")
    assert choose(browser, "order", "worst first").startswith("image 1 of 4: images/site/00_000004.png")
    browser.until(f"{SHOWN} === 3")
    browser.run("document.getElementById('threshold').value = 1000")
    browser.run("document.getElementById('threshold').dispatchEvent(new Event('input'))")
    assert seen(browser, ".found .box") == 0
    assert seen(browser, ".truth .failed") == 2
    browser.until("[...document.querySelectorAll('#facts div')].some(d => d.textContent === 'missed2')")
    assert choose(browser, "show", "without detections").startswith("image 4 of 4:")


def test_names_are_shown_and_run_nothing(looking: Callable[..., Browser], predicted: Collection) -> None:
    browser = looking(predicted)
    assert browser.run("document.getElementById('title').textContent") == predicted.title
    assert "onerror" in browser.run("document.querySelector('select[data-filter=site]').textContent")
    assert browser.run("document.querySelectorAll('main img, main script').length") == 0


def test_a_missing_picture_is_named_and_the_labels_stay(
    looking: Callable[..., Browser], labelled: Collection, tmp_path: Path
) -> None:
    (tmp_path / "data/images/site/00_000002.png").write_bytes(b"no picture")
    browser = looking(labelled)
    browser.press("ArrowRight")
    browser.until(f"{SHOWN} === 1")
    said = browser.run("document.getElementById('problem').textContent")
    assert said == "images/site/00_000002.png: not an image that a browser shows"
    assert seen(browser, ".box") == 3
    browser.press("ArrowRight")
    browser.until(f"{SHOWN} === 2")
    assert browser.run("document.getElementById('problem').hidden")


@pytest.mark.parametrize("size", [(390, 844), (1280, 800)])
def test_it_fits_a_phone_and_a_screen(
    looking: Callable[..., Browser], predicted: Collection, size: tuple[int, int]
) -> None:
    browser = looking(predicted, *size)
    assert browser.run("document.documentElement.scrollWidth <= innerWidth")
    for button in ("before", "after"):
        place: Any = browser.run(f"document.getElementById('{button}').getBoundingClientRect().toJSON()")
        assert place["left"] >= 0
        assert place["right"] <= size[0]
        assert place["bottom"] <= size[1]
        assert place["height"] >= (44 if size[0] < 600 else 24)
    browser.run("document.getElementById('after').click()")
    browser.until(f"{SHOWN} === 1")
    browser.run("document.getElementById('larger').click()")
    assert view_of(browser)[2] == pytest.approx(80, abs=0.1)
    assert browser.run("document.getElementById('stage').classList.contains('enlarged')")
    assert browser.run("document.documentElement.scrollWidth <= innerWidth")


def test_wheel_and_mouse_move_the_picture_and_a_swipe_turns_the_page(
    looking: Callable[..., Browser], labelled: Collection
) -> None:
    browser = looking(labelled)
    box = browser.run("document.getElementById('stage').getBoundingClientRect().toJSON()")
    x, y = box["left"] + box["width"] / 2, box["top"] + box["height"] / 2
    browser.call("Input.dispatchMouseEvent", type="mouseWheel", x=x, y=y, deltaX=0, deltaY=-100)
    browser.until("document.getElementById('stage').classList.contains('enlarged')")
    left, _, width, _ = view_of(browser)
    assert width < 140
    assert left + width / 2 == pytest.approx(80, abs=1)
    for kind, at in (("mousePressed", x), ("mouseMoved", x - 20), ("mouseReleased", x - 20)):
        browser.call("Input.dispatchMouseEvent", type=kind, x=at, y=y, button="left", buttons=1, clickCount=1)
    assert view_of(browser)[0] == pytest.approx(left + 20 * width / box["width"], abs=0.5)
    browser.call("Emulation.setTouchEmulationEnabled", enabled=True)
    looking(labelled, 390, 844)
    box = browser.run("document.getElementById('stage').getBoundingClientRect().toJSON()")
    y = box["top"] + box["height"] / 2
    for kind, places in (("touchStart", [300]), ("touchMove", [200]), ("touchMove", [120]), ("touchEnd", [])):
        points = [{"x": place, "y": y} for place in places]
        browser.call("Input.dispatchTouchEvent", type=kind, touchPoints=points)
    browser.until(f"{SHOWN} === 1")
    browser.call("Emulation.setTouchEmulationEnabled", enabled=False)
