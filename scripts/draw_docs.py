"""Draw the images of README and docs again, with the commands that they show. Takes ten minutes on two cores.

    make demo                                                  # needed for birdseye and footage_overlay
    python scripts/draw_docs.py                                # all
    python scripts/draw_docs.py noon fog --out elsewhere       # some

Chromium takes the screenshots `gallery` and `report`. docs/real_footage.jpg is a frame of real footage, from
`skope eval predict VIDEO --overlay`. `python scripts/legs_table.py --curve docs/legs.svg` draws docs/legs.svg.
"""

import argparse
import math
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon
from numpy.typing import NDArray

from skope import keypoints as scheme
from skope.camera.model import Camera
from skope.dataset.folder import open_dataset, read_image
from skope.files.atomic import replacing
from skope.gen.inspect.vehicle_models import parked_recording
from skope.gen.labels.annotate import annotate
from skope.gen.labels.ignore_rules import Rules
from skope.gen.labels.visibility import VISIBILITY_TOLERANCES, behind
from skope.gen.labels.world_keypoints import WorldKeypoints, world_keypoints
from skope.gen.pipeline.config import from_preset
from skope.gen.render.choose_renderer import choose_renderer, make_renderer
from skope.gen.render.frame import RenderedFrame
from skope.gen.scene.recording import Recording
from skope.gen.simulation.simulate import simulate
from skope.gen.vehicles.fleet import fleet
from skope.gen.vehicles.model import wheel_plane
from skope.pictures import draw
from skope.schema import Annotation

JUNCTION: Final = "t01_mill_corner"
Pixels = NDArray[np.uint8]

ROOT: Final = Path(__file__).parents[1]
MOST_BYTES: Final = 290_000
"""Largest file size; a page shows many of these files."""
OVERLAY_FRAME: Final = 30


@dataclass(frozen=True)
class Places:
    """Folders that the images come from."""

    work: Path
    """Folder for intermediate files."""
    run: Path
    """Folder that `make demo` wrote."""


def skope(*words: object, at: Path = ROOT) -> None:
    """Run a command in the folder `at`."""
    subprocess.run([sys.executable, "-m", "skope", *map(str, words), "--quiet"], check=True, cwd=at)


def generated(folder: Path, *options: object) -> Pixels:
    """Generate a dataset and return its image with the most vehicles, the last one among equals."""
    skope("gen", *options, "--size", "1280x720", "--out", folder)
    dataset = open_dataset(folder)
    vehicles: Counter[str] = Counter()
    for file in map(dataset.read, dataset.splits):
        names = {image.id: image.file_name for image in file.images}
        vehicles.update(names[label.image_id] for label in file.annotations if not label.ignored)
    return read_image(folder / max(vehicles, key=lambda name: (vehicles[name], name)))


def weather(name: str, sky: str, time: str) -> Callable[[Places], Pixels]:
    """Return a function that draws the same junction in some weather."""

    def draw(places: Places) -> Pixels:
        options = ("--site", JUNCTION, "--weather", sky, "--time-of-day", time, "--frames", 2)
        return generated(places.work / name, *options)

    return draw


def own_road(places: Places) -> Pixels:
    """Draw the road of the example in the rush hour."""
    folder = places.work / "own_road"
    shutil.copytree(ROOT / "examples/own_road", folder)
    site = folder / "site.toml"
    usual, busy = "vehicles_per_hour = 900", "vehicles_per_hour = 2400"
    text = site.read_text(encoding="utf-8")
    if usual not in text:
        sys.exit(f"{site}: does not contain {usual!r}")
    site.write_text(text.replace(usual, busy), encoding="utf-8")
    return generated(folder / "data", "--site", site, "--frames", 24)


def vehicle_sheet(places: Places) -> Pixels:
    skope("gen", "vehicles", "show", "suv", "--out", places.work / "vehicles")
    return narrowed(read_image(places.work / "vehicles" / "suv.png"), 1350)


def keypoints(places: Places) -> Pixels:
    """Draw the two three-quarter views of each kind of body, with its keypoints."""
    rows = []
    for model in ("suv", "van", "truck", "bus"):
        skope("gen", "vehicles", "show", model, "--out", places.work / "vehicles")
        sheet = read_image(places.work / "vehicles" / f"{model}.png")
        # Plain and labelled rows alternate, with three views in each, below a line of text.
        high, wide = sheet.shape[1] // 3 * 400 // 640, sheet.shape[1] * 2 // 3
        top = sheet.shape[0] - 3 * (high + 3)
        rows.append(sheet[top : top + high, :wide])
    return narrowed(np.vstack(rows), 1000)


def birdseye(places: Places) -> Pixels:
    return narrowed(read_image(places.run / "tracks" / "birdseye.png"), 1500)


def footage_overlay(places: Places) -> Pixels:
    video = cv2.VideoCapture(str(places.run / "seen" / "overlay.mp4"))
    video.set(cv2.CAP_PROP_POS_FRAMES, OVERLAY_FRAME)
    was_read, frame = video.read()
    if not was_read:
        sys.exit(f"{places.run / 'seen' / 'overlay.mp4'}: has no frame {OVERLAY_FRAME}: run `make demo`")
    return np.asarray(cv2.cvtColor(frame, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def gallery(places: Places) -> Pixels:
    skope("gen", "report", queue(places), "--out", "gallery", at=places.work)
    return photographed(places.work / "gallery" / "index.html", 1240, 860)


def report(places: Places) -> Pixels:
    skope("eval", "--data", queue(places), "--split", "hard", "--checkpoint", "road33", "--out", "eval", at=places.work)
    return photographed(places.work / "eval" / "report.html", 1100, 1000)


def queue(places: Places) -> str:
    """Generate a dataset of vehicles waiting at a signal; returns its name, which reports show as given."""
    skope("gen", "--site", "t01_mill_south", "--frames", 8, "--size", "1280x720", "--out", "queue", at=places.work)
    return "queue"


def photographed(page: Path, width: int, height: int) -> Pixels:
    """Return a screenshot of the upper part of a page."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "page.png"
        flags = ["--headless=new", "--no-sandbox", "--hide-scrollbars", f"--user-data-dir={folder}/profile"]
        flags += [f"--window-size={width},{height}", f"--screenshot={path}", page.resolve().as_uri()]
        subprocess.run(["chromium", *flags], check=True, capture_output=True)
        return read_image(path)


def narrowed(pixels: Pixels, width: int) -> Pixels:
    scale = min(1.0, width / pixels.shape[1])
    return np.asarray(cv2.resize(pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), dtype=np.uint8)


MODEL, POINT = "suv", "roof_front_left"
BUSY_SITE, BUSY_FRAMES = "t01_mill_south", 8
COLORS = {"visible": "#009e73", "hidden by itself": "#e69f00", "hidden by something else": "#cc3399"}
WHEEL_COLORS = ("#d55e00", "#0072b2", "#cc79a7", "#009e73")
LABELS = (0.6, 0.6, 0.4, 0.75)
"""Position of the label of each distance, from the point (0) to the wheel centre (1)."""
Array = np.ndarray


def trilateration_figure(renderer: str) -> Figure:
    """Show the 33 points of a vehicle, and how one of them follows from its distances to the four wheel centres."""
    vehicle = fleet()[MODEL].vehicle
    figure = Figure(figsize=(16, 6.3), layout=ConstrainedLayoutEngine(h_pad=0.12))
    left, right = figure.subplots(1, 2)
    for axis, fov in ((left, 15.5), (right, 20.0)):
        camera = _camera(math.radians(fov))
        recording = parked_recording(vehicle, camera)
        view = make_renderer(renderer, recording).render(0)
        if axis is left:
            annotations, _ = annotate(recording.moment(0), view, camera, Rules(), image_id=1)
            axis.imshow(draw.numbered(view.rgb, annotations))
            axis.set_title("The 33 keypoints (pale: hidden from here)")
        else:
            axis.imshow(view.rgb // 2 + 110)
            spheres(axis, vehicle.points, vehicle.sidecar.distances[scheme.INDEX[POINT]], camera)
            axis.set_title(f"Keypoint {scheme.INDEX[POINT]} from its distances to the wheel centres")
        axis.set_axis_off()
        axis.set(xlim=(0, camera.width), ylim=(camera.height, 0))
    return figure


def _camera(fov: float) -> Camera:
    """Return a camera that looks at the middle of a vehicle at the origin, from its front left."""
    azimuth, elevation = math.radians(58), math.radians(17)
    toward = np.array([math.cos(azimuth), math.sin(azimuth), math.tan(elevation)])
    position = np.array([0, 0, 0.7]) + 19 * toward
    return Camera.looking(position, yaw=azimuth + math.pi, pitch_down=elevation, size=(1000, 760), fov=fov)


def spheres(axis: Axes, points: Array, distances: Array, camera: Camera) -> None:
    """Draw, around each wheel centre, the circle of its sphere through the point and its mirror image."""
    wheels, target = points[list(scheme.WHEELS)], points[scheme.INDEX[POINT]]
    center, _, normal = wheel_plane(wheels)
    height = (target - center) @ normal
    mirrored = target - 2 * height * normal

    def at(places: Array) -> Array:
        return camera.project(places)[0] - 0.5  # matplotlib puts the centre of a pixel at integers

    axis.add_patch(Polygon(at(wheels[[0, 1, 3, 2]]), color="#56b4e9", alpha=0.35, lw=0))
    turn = np.linspace(0, 2 * math.pi, 200)[:, None]
    for wheel, distance, color, part, name in zip(wheels, distances, WHEEL_COLORS, LABELS, "1234", strict=True):
        along = (target - wheel) - ((target - wheel) @ normal) * normal
        along = along / np.linalg.norm(along)
        circle = wheel + distance * (np.cos(turn) * along + np.sin(turn) * normal)
        axis.plot(*at(circle).T, color=color, lw=1.4)
        axis.plot(*at(np.stack([wheel, target])).T, color=color, lw=1.2, ls="--")
        axis.plot(*at(wheel[None]).T, "o", color=color, ms=7, mec="black")
        middle = at((part * wheel + (1 - part) * target)[None])[0]
        label = {"ha": "center", "va": "center", "fontsize": 9, "color": color}
        axis.text(*middle, f"$d_{name}$ = {distance:.2f} m", bbox={"fc": "white", "ec": "none", "pad": 1.5}, **label)
    axis.plot(*at(target[None]).T, "o", color="black", ms=9, mfc="yellow")
    axis.plot(*at(mirrored[None]).T, "o", color="black", ms=9, mfc="none")
    axis.annotate("mirror solution, below\nthe plane of the wheels", at(mirrored[None])[0], (34, -6), **_NOTE)


_NOTE = {"textcoords": "offset points", "fontsize": 9, "arrowprops": {"arrowstyle": "-"}, "bbox": {"fc": "white"}}


@dataclass(frozen=True)
class Scene:
    """A frame, and the vehicle in it that is shown."""

    recording: Recording
    view: RenderedFrame
    world: WorldKeypoints
    index: int
    annotation: Annotation


def hidden_vehicle(renderer: str) -> Scene:
    """Return the tallest car on a busy road that something else hides by about a third."""
    _, driver, _ = choose_renderer(renderer)
    plan = from_preset(
        "demo", seed=0, renderer=renderer, driver=driver, rules=Rules(), frames=BUSY_FRAMES, sites=(BUSY_SITE,),
        size="1280x720", fov_deg=70.0,
    ).plans()[0]  # fmt: skip
    recording = simulate(plan)
    drawn = make_renderer(renderer, recording)
    found = []
    for frame in range(len(recording)):
        view, moment = drawn.render(frame), recording.moment(frame)
        world = world_keypoints(moment, "rigid")
        tracks = [vehicle.track_id for vehicle in moment.vehicles]
        for annotation in annotate(moment, view, recording.camera, Rules(), image_id=1)[0]:
            if not annotation.ignored and 0.2 < (annotation.occlusion or 0) < 0.5 and not annotation.truncation:
                index = tracks.index(annotation.track_id)
                found.append((annotation.bbox[3], Scene(recording, view, world, index, annotation)))
    return max(found, key=lambda pair: pair[0])[1]


def occlusion_figure(scene: Scene) -> Figure:
    """Show a partly hidden vehicle, and d_k - d_p of each of its points."""
    camera, view = scene.recording.camera, scene.view
    points = scene.world.tested[scene.index]
    gap, shown = (values[0] for values in behind(view, camera, points))
    on_itself = shown == scene.index + 1
    seen = scene.annotation.keypoints[:, 2]
    kinds = np.where(seen == 2, "visible", np.where(on_itself, "hidden by itself", "hidden by something else"))
    figure = Figure(figsize=(16, 5.6), layout=ConstrainedLayoutEngine(h_pad=0.12))
    left, right = figure.subplots(1, 2, width_ratios=(1, 1.25))
    x, y, w, h = scene.annotation.bbox
    left.imshow(view.rgb)
    left.set(xlim=(x - 0.35 * w, x + 1.35 * w), ylim=(y + h / 2 + 0.72 * w, y + h / 2 - 0.72 * w))
    left.set_axis_off()
    for kind, color in COLORS.items():
        mine = (kinds == kind) & (seen > 0)
        fill = color if kind == "visible" else "none"
        left.plot(*(scene.annotation.keypoints[mine, :2] - 0.5).T, "o", color=color, ms=7, mfc=fill, mew=2)
        right.plot(np.flatnonzero(mine), gap[mine], "o", color=color, ms=7, mfc=fill, mew=2)
        right.vlines(np.flatnonzero(mine), 0, gap[mine], color=color, lw=1)
    annotate_depths(
        left, scene, int(np.nanargmin(np.where(kinds == "visible", np.abs(gap), np.nan))), points, (-80, 95)
    )
    annotate_depths(
        left, scene, int(np.nanargmax(np.where(kinds == "hidden by something else", gap, np.nan))), points, (0, -95)
    )
    for tolerance, words in (
        (VISIBILITY_TOLERANCES.point_m, "a point is hidden"),
        (VISIBILITY_TOLERANCES.vehicle_m, "counts for the whole vehicle"),
    ):
        right.axhline(tolerance, color="black", lw=0.8, ls="--")
        right.text(32.4, tolerance * 1.08, f"> {tolerance:g} m: {words}", ha="right", va="bottom", fontsize=9)
    right.set_yscale("symlog", linthresh=0.05, linscale=0.6)
    right.set_yticks(ticks := (-5, -1, -0.2, -0.05, 0, 0.05, 0.2, 1, 5), [f"{tick:g}" for tick in ticks])
    right.minorticks_off()
    right.set(xlabel="keypoint", ylabel="$d_k - d_p$ less the slope's allowance, m", xticks=range(0, 33, 2))
    right.spines[["top", "right"]].set_visible(False)
    handles = [
        Line2D([], [], marker="o", ls="", color=color, mfc=color if kind == "visible" else "none", mew=2, label=kind)
        for kind, color in COLORS.items()
    ]
    right.legend(handles=handles, frameon=False, loc="upper left", bbox_to_anchor=(0, 1.12), ncols=3)
    return figure


def annotate_depths(axis: Axes, scene: Scene, k: int, points: Array, offset: tuple[int, int]) -> None:
    """Annotate a point with its distance from the camera and with the distance that its pixel shows."""
    camera = scene.recording.camera
    pixel = camera.project(points[k])[0]
    column, row = (int(v) for v in pixel)
    ray, _ = camera.rays(np.array([column + 0.5, row + 0.5]))
    shown = float(scene.view.depth[row, column]) * float(np.linalg.norm(ray))
    distance = float(np.linalg.norm(camera.to_camera(points[k])))
    text = f"{k} {scheme.NAMES[k]}\n$d_k$ = {distance:.2f} m, $d_p$ = {shown:.2f} m"
    axis.annotate(text, pixel - 0.5, offset, **_NOTE)


def method_trilateration(_: Places) -> Pixels:
    """Draw the figure of docs/method.md on trilateration."""
    return rasterised(trilateration_figure(choose_renderer("auto")[0]))


def method_occlusion(_: Places) -> Pixels:
    """Draw the figure of docs/method.md on hidden points."""
    return rasterised(occlusion_figure(hidden_vehicle(choose_renderer("auto")[0])))


def rasterised(figure: Figure) -> Pixels:
    """Rasterise a figure to (H, W, 3) pixels."""
    figure.set_dpi(90)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[..., :3])


PICTURES: Final[dict[str, Callable[[Places], Pixels]]] = {
    "noon": weather("noon", "clear", "noon"),
    "low_sun": weather("low_sun", "clear", "low_sun"),
    "rain_night": weather("rain_night", "rain", "night"),
    "fog": weather("fog", "fog", "noon"),
    **{
        draw.__name__: draw
        for draw in (
            *(own_road, vehicle_sheet, keypoints, method_trilateration, method_occlusion),
            *(birdseye, footage_overlay, gallery, report),
        )
    },
}
NEEDS_BROWSER: Final = ("gallery", "report")


def write(path: Path, pixels: Pixels) -> None:
    """Write a JPEG in the best quality that keeps it within `MOST_BYTES`."""
    for quality in range(90, 40, -5):
        made, data = cv2.imencode(".jpg", cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])
        if made and len(data) <= MOST_BYTES:
            break
    with replacing(path) as temporary:
        temporary.write_bytes(data.tobytes())
    print(f"{path}: {pixels.shape[1]}x{pixels.shape[0]}, {len(data) // 1000} kB")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"one of {', '.join(PICTURES)}; default: all")
    parser.add_argument("--out", type=Path, default=ROOT / "docs")
    parser.add_argument("--run", type=Path, default=ROOT / "runs/demo", help="folder that `make demo` wrote")
    options = parser.parse_args()
    names = options.names or list(PICTURES)
    if unknown := set(names) - PICTURES.keys():
        parser.error(f"no image is called {', '.join(sorted(unknown))}; there are {', '.join(PICTURES)}")
    if set(names) & set(NEEDS_BROWSER) and shutil.which("chromium") is None:
        parser.error(f"{', '.join(NEEDS_BROWSER)}: chromium is not installed")
    options.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        places = Places(Path(folder), options.run)
        for name in names:
            write(options.out / f"{name}.jpg", PICTURES[name](places))


if __name__ == "__main__":
    main()
