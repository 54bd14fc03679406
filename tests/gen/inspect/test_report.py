"""The page of a dataset: what it shows is what the files hold, and its switches work in a browser."""

import re
import shutil
import subprocess
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from pycocotools import mask as coco_mask
from typer.testing import CliRunner

from skope.camera.model import Camera, Distortion
from skope.cli import app
from skope.dataset import coco
from skope.dataset.depth_files import depth_png
from skope.dataset.folder import open_dataset
from skope.gen.inspect.report import spread_of, spread_out, spread_plots
from skope.gen.inspect.report_layers import shown_photo
from skope.keypoints import PUBLISHED, SKOPE33
from skope.page.templates import piece
from skope.pictures import draw
from skope.schema import Annotation, AnnotationFile, Box3D, Image
from tests.html_page import Page
from tests.samples import make_annotation, make_dataset, make_image
from tests.waiting import HANG_S

CAMERA = Camera.looking([0, 0, 6], yaw=0, pitch_down=0.3, size=(160, 120))
BOX = Box3D(center=np.array([12.0, 3.0, 0.8]), size_lwh=np.array([4.5, 1.8, 1.6]), yaw=0.0, R=np.eye(3))


def disc() -> NDArray[np.uint8]:
    """A mask with a hole."""
    rows, columns = np.mgrid[:120, :160]
    away = np.hypot(rows - 60, columns - 80)
    return ((away < 30) & (away > 12)).astype(np.uint8)


def whole_vehicle(number: int, image_id: int, **changes: Any) -> Annotation:
    """A vehicle with all that a layer can show."""
    rle = coco_mask.encode(np.asfortranarray(disc()))
    given: dict[str, Any] = {
        "segmentation": {"size": list(rle["size"]), "counts": rle["counts"].decode()},
        "box_3d": BOX,
        "velocity": np.array([10.0, 0, 0]),
    }
    return replace(make_annotation(number, image_id, (20, 20, 80, 60), hidden=5), **(given | changes))


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    """Four images of two sites and two weathers; a sedan in the first two, a bus in the last, an ignored one there."""
    root = make_dataset(tmp_path / "data", images=4, splits=("easy",))
    file = coco.read(root / "annotations/easy.json")
    images = tuple(
        replace(
            image,
            site=("north", "<south>")[i % 2],
            weather=("clear", "rain")[i // 2],
            depth_file_name=f"depth/{i}.png",
        )
        for i, image in enumerate(file.images)
    )
    (root / "depth").mkdir()
    for i in range(4):
        (root / f"depth/{i}.png").write_bytes(depth_png(np.full((120, 160), 10.0, dtype=np.float32)))
    vehicles = (
        whole_vehicle(1, images[0].id),
        whole_vehicle(2, images[1].id),
        whole_vehicle(3, images[3].id, vehicle_type="bus"),
        make_annotation(4, images[3].id, (90, 50, 40, 30), iscrowd=1),
    )
    coco.write(root / "annotations/easy.json", replace(file, images=images, annotations=vehicles))
    return root


def page_of(dataset: Path, *more: str) -> Page:
    out = dataset.parent / "out"
    result = CliRunner().invoke(app, ["gen", "report", str(dataset), "--out", str(out), "--quiet", *more])
    assert result.exit_code == 0, result.output
    assert result.output == f"wrote {out / 'index.html'}\n"
    return Page((out / "index.html").read_text(encoding="utf-8"))


def test_the_page_holds_everything_itself_and_escapes_what_it_shows(dataset: Path) -> None:
    page = page_of(dataset)
    for _, attributes in page.elements:
        for name in ("src", "href"):
            assert (attributes.get(name) or "data:").startswith("data:")
    assert len(page.all("script")) == len(page.all("style")) == 1
    assert "<south>" in page.text
    assert [a["data-site"] for a in page.all("figure") if "photo" in (a.get("class") or "")] == ["north", "<south>"] * 2
    assert "All 4 images." in page.text
    tips = [a["data-tip"] or "" for a in page.all("rect")]
    assert "sedan 1, 20 m away, 36 km/h" in tips
    assert "sedan 4, 20 m away, ignored: small" in tips


def test_of_many_images_few_are_shown_and_the_page_says_so(dataset: Path) -> None:
    page = page_of(dataset, "--max-images", "2")
    assert len([a for a in page.all("figure") if "photo" in (a.get("class") or "")]) == 2
    assert "2 of 4 images, spread evenly" in page.text
    sites = [a["data-site"] for a in page.all("figure") if "data-site" in a]
    assert sorted(filter(None, sites)) == ["<south>", "north"]


def test_a_layer_that_no_image_has_is_not_offered(tmp_path: Path) -> None:
    page = page_of(make_dataset(tmp_path / "plain", images=1))
    assert [a["data-layer"] for a in page.all("input")] == ["boxes", "points"]
    assert [a["data-filter"] for a in page.all("select")] == ["split"]


def test_keypoints_of_another_scheme_are_numbers_without_an_outline(tmp_path: Path) -> None:
    root = make_dataset(tmp_path / "published", images=1, splits=("train",), scheme=PUBLISHED)
    page = page_of(root)
    assert "skope3d_00" in page.text
    assert not [a for a in page.all("svg") if "outline" in (a.get("class") or "")]
    edges = [a["d"] or "" for a in page.all("path") if a.get("class") == "edges"]
    assert [d.count("M") for d in edges] == [len(PUBLISHED.skeleton)] * 2


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda root: (root / "images/site/00_000001.png").unlink(), "images/site/00_000001.png: no such file"),
        (lambda root: (root / "depth/0.png").write_bytes(b"no"), "depth/0.png: not a 16-bit depth image"),
    ],
)
def test_a_broken_file_is_named_and_nothing_is_written(spoil: Any, said: str, dataset: Path) -> None:
    spoil(dataset)
    out = dataset.parent / "out"
    result = CliRunner().invoke(app, ["gen", "report", str(dataset), "--out", str(out), "-q"])
    assert said in str(result.exception)
    assert not out.exists()


def test_no_images_asked_for_is_refused(dataset: Path) -> None:
    result = CliRunner().invoke(app, ["gen", "report", str(dataset), "--max-images", "0"])
    assert "--max-images: expected a whole number from 1, got 0" in str(result.exception)


# --------------------------------------------------------------------------------------------------------------- choice


def many(sizes: dict[str, int], recordings: int = 1) -> list[Image]:
    """Images of sites, so many of each, recording by recording."""
    out = []
    for site, size in sizes.items():
        for i in range(size):
            recording = f"{i * recordings // size:02d}"
            out.append(replace(make_image(len(out) + 1), site=site, recording=recording, frame_index=i))
    return out


@pytest.mark.parametrize("count", [1, 2, 3, 4, 7, 20, 59, 60, 1000])
def test_sites_share_evenly_what_is_shown(count: int) -> None:
    images = many({"a": 40, "b": 3, "c": 17})
    places = spread_out(images, count)
    assert len(places) == min(count, 60)
    assert places == sorted(set(places))
    shares = Counter(images[i].site for i in places)
    open_ = [shares[site] for site, size in (("a", 40), ("b", 3), ("c", 17)) if shares[site] < size]
    full = [shares[site] for site, size in (("a", 40), ("b", 3), ("c", 17)) if shares[site] == size]
    assert not open_ or max(open_) - min(open_) <= 1
    assert not (open_ and full) or max(full) <= max(open_) + 1


def test_every_recording_has_its_turn() -> None:
    images = many({"a": 100}, recordings=10)
    chosen = [images[i] for i in spread_out(images, 10)]
    assert [image.recording for image in chosen] == [f"{i:02d}" for i in range(10)]
    assert np.ptp(np.diff([image.frame_index or 0 for image in chosen])) <= 1


# --------------------------------------------------------------------------------------------------------------- layers


def lines_of(markup: str, class_: str) -> NDArray[np.float64]:
    """(N, 2, 2) the straight lines of a path."""
    (d,) = re.findall(rf'class="{class_}" d="([^"]*)"', markup)
    return np.array(re.findall(r"-?[\d.]+", d), dtype=np.float64).reshape(-1, 2, 2)


def shown(dataset: Path, **changes: Any) -> str:
    folder = open_dataset(dataset)
    image = replace(folder.read("easy").images[0], camera=CAMERA)
    return shown_photo(folder, replace(image, **changes), [whole_vehicle(1, 1)]).drawing


@pytest.mark.parametrize("lens", ["none", "brown"])
def test_3d_boxes_go_from_corner_to_corner(lens: str, dataset: Path) -> None:
    k1 = () if lens == "none" else (-0.1, 0.0, 0.0, 0.0)
    camera = replace(CAMERA, distortion=Distortion(lens, k1))
    markup = shown(dataset, camera=camera)
    found = np.concatenate([lines_of(markup, "edges_3d"), lines_of(markup, "front")])
    corners = {
        (x, y, z): camera.project(BOX.center + np.array([x, y, z]) * BOX.size_lwh / 2)[0]
        for x in (-1, 1)
        for y in (-1, 1)
        for z in (-1, 1)
    }
    ends = found.reshape(-1, 2)
    for corner in corners.values():
        assert np.abs(ends - corner).max(axis=1).min() < 0.1
    front = lines_of(markup, "front").reshape(-1, 2)
    assert all(np.abs(front - corners[1, y, z]).max(axis=1).min() < 0.1 for y in (-1, 1) for z in (-1, 1))
    assert all(np.abs(front - corners[-1, y, z]).max(axis=1).min() > 1 for y in (-1, 1) for z in (-1, 1))
    assert len(found) == (12 if lens == "none" else 12 * 16)


def test_a_masks_outline_encloses_its_pixels(dataset: Path) -> None:
    (d,) = re.findall(r'class="area" d="([^"]*)"', shown(dataset))
    rings = [np.array(re.findall(r"[\d.]+", ring), dtype=np.float64).reshape(-1, 2) for ring in d.split("Z") if ring]
    assert len(rings) == 2
    # Drawn as the browser does: filled by the even-odd rule, with a line of one pixel around it.
    drawn = np.zeros((120, 160), dtype=np.uint8)
    fixed = [np.rint((ring - 0.5) * 16).astype(np.int32) for ring in rings]
    cv2.fillPoly(drawn, fixed, 1, shift=4)
    for ring in fixed:
        cv2.polylines(drawn, [ring], True, 1, 1, shift=4)
    inside = disc().astype(bool)
    both = (drawn.astype(bool) & inside).sum() / (drawn.astype(bool) | inside).sum()
    assert both > 0.93


def test_vehicles_have_the_colours_of_the_overlays(dataset: Path) -> None:
    assert "--c:#{:02x}{:02x}{:02x}".format(*draw.DRAWING_STYLE.palette[1]) in shown(dataset)


def plots_of(file: AnnotationFile) -> str:
    """Markup of the plots of a file."""
    return "".join(piece("block", plot) for plot in spread_plots({"easy": spread_of(file)}, SKOPE33))


def test_plots_count_every_vehicle_once() -> None:
    rows = [replace(make_annotation(i, 1, (0, 0, 40, 30 + i), hidden=3), distance=float(i)) for i in range(1, 11)]
    ignored = make_annotation(11, 1, (0, 0, 9, 9), iscrowd=1)
    file = AnnotationFile(images=(make_image(1),), annotations=(*rows, ignored), name="easy")
    page = Page(plots_of(file))
    tips = [a["data-tip"] or "" for a in page.all("path") if "data-tip" in a]
    far = [tip for tip in tips if "distance" in tip]
    # Bands of 1 m up to 20 m; only bars that are higher than nothing say what they are.
    assert far == [f"easy (10): distance, m {i} to {i + 1}, share of vehicles 0.100" for i in range(1, 11)]
    dots = {(a["data-tip"] or "").split(":")[0]: a["data-tip"] for a in page.all("g") if "data-tip" in a}
    assert dots["front_logo"] == "front_logo: visible on 0 of 10"
    assert dots["roof_front_right"] == "roof_front_right: visible on 10 of 10"


def test_splits_with_no_vehicle_and_with_one_at_no_distance_have_plots_too() -> None:
    file = AnnotationFile(images=(make_image(1),), annotations=(), name="easy")
    assert Page(plots_of(file)).all("svg")
    here = replace(make_annotation(1, 1, (0, 0, 40, 30)), distance=0.0)
    page = Page(plots_of(replace(file, annotations=(here,))))
    assert "easy (1): distance, m 0 to 1, share of vehicles 1.000" in [a.get("data-tip") for a in page.all("path")]


def test_a_split_is_called_by_its_file_where_images_do_not_say_it(dataset: Path) -> None:
    path = dataset / "annotations/easy.json"
    file = coco.read(path)
    coco.write(path, replace(file, images=tuple(replace(image, split=None) for image in file.images)))
    assert {a["data-split"] for a in page_of(dataset).all("figure") if "data-split" in a} == {"easy"}


# -------------------------------------------------------------------------------------------------------------- browser

_USE = """
<script>
const said = [];
const note = (what, value) => said.push(what + "=" + value);
const layer = (name) => document.querySelectorAll(`.stage .${name} rect, .stage .${name} path, .stage img.${name}`);
const shown = (nodes) => [...nodes].filter((n) => n.getClientRects().length).length;
const pick = (key, value) => {
  const select = document.querySelector(`select[data-filter=${key}]`);
  select.value = value;
  select.dispatchEvent(new Event("change"));
};
const figures = document.querySelectorAll("figure.photo");
for (const name of ["boxes", "points", "boxes3d", "masks", "depth", "ignored"]) {
  const before = shown(layer(name));
  document.querySelector(`input[data-layer=${name}]`).click();
  note(name, before + ">" + shown(layer(name)));
}
note("all", shown(figures));
pick("site", "<south>"); note("south", shown(figures));
pick("weather", "rain"); note("rain", shown(figures));
pick("type", "sedan"); note("none", shown(figures) + ":" + document.querySelector("output.count").textContent);
pick("site", ""); pick("weather", "");
note("sedans", shown(figures) + ":" + document.querySelector("output.count").textContent);
pick("type", "bus"); note("bus", [...figures].filter((f) => !f.hidden).map((f) => f.dataset.type));
pick("type", ""); note("again", shown(figures));
document.querySelector("button.larger").click(); note("larger", document.querySelectorAll("figure.photo.wide").length);
note("fits", document.documentElement.scrollWidth <= innerWidth);
document.title = said.join(" ");
</script>
"""


@pytest.mark.skipif(shutil.which("chromium") is None, reason="needs chromium")
def test_switches_and_filters_work_in_a_browser(dataset: Path, tmp_path: Path) -> None:
    page_of(dataset)
    text = (dataset.parent / "out/index.html").read_text(encoding="utf-8")
    used = tmp_path / "used.html"
    used.write_text(text.replace("</body>", f"{_USE}</body>"), encoding="utf-8")
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--dump-dom"]
    done = subprocess.run(
        ["chromium", *flags, f"--user-data-dir={tmp_path / 'profile'}", used.as_uri()],
        capture_output=True,
        text=True,
        check=True,
        timeout=HANG_S,
    )
    (title,) = re.findall(r"<title>(.*?)</title>", done.stdout)
    layers = "boxes=3&gt;0 points=9&gt;0 boxes3d=0&gt;6 masks=0&gt;3 depth=0&gt;4 ignored=0&gt;1"
    filters = "all=4 south=2 rain=1 none=0:no image is like that sedans=2:2 images bus=bus again=4"
    assert title == f"{layers} {filters} larger=1 fits=true"
    assert "CONSOLE" not in done.stderr
