"""Draw the figures of docs/method.md with the project's own vehicles and renderer; takes a minute:

python scripts/draw_method.py [--out docs]
"""

import argparse
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon

from skope import keypoints
from skope.camera.model import Camera
from skope.files.atomic import replacing
from skope.gen.inspect.vehicle_models import parked_recording
from skope.gen.labels.annotate import Rules, annotate
from skope.gen.labels.visibility import VISIBILITY, behind
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

MODEL, POINT = "suv", "roof_front_left"
SITE, FRAMES = "t01_mill_south", 8
COLORS = {"visible": "#009e73", "hidden by itself": "#e69f00", "hidden by something else": "#cc3399"}
WHEEL_COLORS = ("#d55e00", "#0072b2", "#cc79a7", "#009e73")
LABELS = (0.6, 0.6, 0.4, 0.75)
"""Where the label of a distance stands, from the point (0) to the wheel centre (1)."""
Array = np.ndarray


def trilateration(renderer: str) -> Figure:
    """The 33 points of a vehicle; and one of them found from its distances to the four wheel centres."""
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
            spheres(axis, vehicle.points, vehicle.sidecar.distances[keypoints.INDEX[POINT]], camera)
            axis.set_title(f"Keypoint {keypoints.INDEX[POINT]} from its distances to the wheel centres")
        axis.set_axis_off()
        axis.set(xlim=(0, camera.width), ylim=(camera.height, 0))
    return figure


def _camera(fov: float) -> Camera:
    """A camera that looks at the middle of a vehicle at the origin, from its front left."""
    azimuth, elevation = math.radians(58), math.radians(17)
    toward = np.array([math.cos(azimuth), math.sin(azimuth), math.tan(elevation)])
    place = np.array([0, 0, 0.7]) + 19 * toward
    return Camera.looking(place, yaw=azimuth + math.pi, pitch_down=elevation, size=(1000, 760), fov=fov)


def spheres(axis: Axes, points: Array, distances: Array, camera: Camera) -> None:
    """Around each wheel centre the circle of its sphere that goes through the point and its mirror image."""
    wheels, target = points[list(keypoints.WHEELS)], points[keypoints.INDEX[POINT]]
    center, _, normal = wheel_plane(wheels)
    height = (target - center) @ normal
    mirrored = target - 2 * height * normal

    def at(places: Array) -> Array:
        return camera.project(places)[0] - 0.5  # matplotlib counts the centre of a pixel as i

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
    """A frame, and the vehicle of it that is shown."""

    recording: Recording
    view: RenderedFrame
    world: WorldKeypoints
    index: int
    annotation: Annotation


def hidden_vehicle(renderer: str) -> Scene:
    """The tallest car on a busy road of which something else hides about a third."""
    _, driver, _ = choose_renderer(renderer)
    plan = from_preset(
        "demo", seed=0, renderer=renderer, driver=driver, rules=Rules(), frames=FRAMES, sites=(SITE,),
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


def occlusion(scene: Scene) -> Figure:
    """A partly hidden vehicle, and what d_k - d_p says of each of its points."""
    camera, view = scene.recording.camera, scene.view
    points = scene.world.tested[scene.index]
    gap, shown = (values[0] for values in behind(view, camera, points))
    own = shown == scene.index + 1
    seen = scene.annotation.keypoints[:, 2]
    kinds = np.where(seen == 2, "visible", np.where(own, "hidden by itself", "hidden by something else"))
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
    tell(left, scene, int(np.nanargmin(np.where(kinds == "visible", np.abs(gap), np.nan))), points, (-80, 95))
    tell(left, scene, int(np.nanargmax(np.where(kinds == "hidden by something else", gap, np.nan))), points, (0, -95))
    for tolerance, words in (
        (VISIBILITY.point_m, "a point is hidden"),
        (VISIBILITY.vehicle_m, "counts for the whole vehicle"),
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


def tell(axis: Axes, scene: Scene, k: int, points: Array, offset: tuple[int, int]) -> None:
    """Write a point's distance from the camera and that of what its pixel shows beside it."""
    camera = scene.recording.camera
    pixel = camera.project(points[k])[0]
    column, row = (int(v) for v in pixel)
    ray, _ = camera.rays(np.array([column + 0.5, row + 0.5]))
    shown = float(scene.view.depth[row, column]) * float(np.linalg.norm(ray))
    own = float(np.linalg.norm(camera.to_camera(points[k])))
    text = f"{k} {keypoints.NAMES[k]}\n$d_k$ = {own:.2f} m, $d_p$ = {shown:.2f} m"
    axis.annotate(text, pixel - 0.5, offset, **_NOTE)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "docs")
    out = parser.parse_args().out
    renderer, _, said = choose_renderer("auto")
    print(said)
    for name, figure in (
        ("method_trilateration.jpg", trilateration(renderer)),
        ("method_occlusion.jpg", occlusion(hidden_vehicle(renderer))),
    ):
        with replacing(out / name) as temporary:
            figure.savefig(temporary, dpi=90, pil_kwargs={"quality": 82})
        print(f"wrote {out / name}")


if __name__ == "__main__":
    main()
