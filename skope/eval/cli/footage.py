"""From footage to the road: `skope eval predict`, `pose`, `track` and `camera`."""

import math
import shlex
from pathlib import Path
from typing import Annotated, Any

import typer

from skope.console import Console, QuietOption, VersionOption
from skope.dataset import FRAMES, PREDICTIONS
from skope.errors import UserError
from skope.outputs import claim
from skope.weights import REFERENCE

_FITTED = ("auto", "fit")
_HIGHEST = 10_000.0
_MOST_PIXELS = 10_000.0
PREDICTED = Path("runs/predict")

FolderArgument = Annotated[Path | None, typer.Argument(help="Folder that `skope eval predict` wrote.")]
AnnotationsOption = Annotated[
    Path | None, typer.Option(help="COCO file with images and cameras instead of a folder; its own keypoints count.")
]
PredictionsOption = Annotated[
    Path | None, typer.Option(help="COCO results for the images, in place of the annotations' keypoints.")
]
CameraOption = Annotated[
    Path | None,
    typer.Option(
        help="Camera file: of `skope eval camera`, OpenCV (.yml, .xml), TUMTraf (.json), Rope3D (.txt), or an "
        "annotation file.",
        show_default="that of each image",
    ),
]
GroundOption = Annotated[
    str,
    typer.Option(
        help="Height of the level road in the camera's world, metres; fit: the plane that the vehicles show; auto: 0 "
        "unless they clearly show another; none: unknown, size tells distance."
    ),
]
ScoreOption = Annotated[float, typer.Option(help="Take detections above this.")]
SigmaOption = Annotated[
    float | None,
    typer.Option(help="Standard deviation of a keypoint, pixels.", show_default="2% of the box's longer edge"),
]


def _claim(
    out: Path, command: str, files: tuple[Path | None, Path | None, Path | None, Path | None], **options: Any
) -> None:
    """Take the output folder of `pose` or `track` for a folder or annotations, predictions, and camera."""
    folder, *others = files
    inputs = [folder / FRAMES, folder / PREDICTIONS] if folder else []
    claim(out, f"skope eval {command}", [*inputs, *(path for path in others if path)], options)


def predict(
    source: Annotated[
        str, typer.Argument(help="Image, folder, glob (quoted), video file or rtsp:// / http:// stream.")
    ],
    checkpoint: Annotated[
        Path, typer.Option(help="Checkpoint file, run folder for its newest one, or weights that come with skope.")
    ] = Path(REFERENCE),
    out: Annotated[
        Path | None, typer.Option(help="Where to write.", show_default="runs/predict/ and the source's name")
    ] = None,
    camera: CameraOption = None,
    every: Annotated[int, typer.Option(help="Take every so many-th frame.")] = 1,
    start: Annotated[float, typer.Option(help="Begin at this second of a video.")] = 0.0,
    end: Annotated[float | None, typer.Option(help="End at this second of a video.", show_default="its end")] = None,
    score: Annotated[float, typer.Option(help="Keep detections above this.")] = 0.5,
    overlay: Annotated[bool, typer.Option("--overlay", help="Draw what was found: a video, or images.")] = False,
    blur: Annotated[bool, typer.Option("--blur", help="Blur plates and glass in the overlay.")] = False,
    device: Annotated[str, typer.Option(help="auto, cpu, cuda or cuda:N.")] = "auto",
    precision: Annotated[str, typer.Option(help="float32, bfloat16 or auto.")] = "float32",
    batch_size: Annotated[int | None, typer.Option(help="Images that go through the network together.")] = None,
    quiet: QuietOption = False,
    version: VersionOption = False,
) -> None:
    """Run a detector on footage: COCO results, and overlays. The same command goes on where a stopped one was."""
    from skope.eval.inference.footage import Cut, open_footage
    from skope.eval.inference.settings import Settings
    from skope.eval.pose.views import read_camera

    _probability("--score", score)
    footage = open_footage(source, Cut(every=every, start_s=start, end_s=math.inf if end is None else end))
    if blur and not overlay:
        raise UserError("--blur is for the overlay: give --overlay too")
    if overlay and footage.live:
        raise UserError("--overlay: a live stream cannot be read again; record it to a file first")
    settings = Settings(device=device, precision=precision, batch_size=batch_size, min_score=score)
    out = out or PREDICTED / (Path(footage.name).stem or "images")
    fixed = read_camera(camera)[0] if camera else None

    from skope.eval.inference.predict_footage import PredictJob, predict

    console = Console(quiet)
    job = PredictJob(
        footage=footage,
        checkpoint=checkpoint,
        out=out,
        settings=settings,
        score=score,
        camera=fixed,
        overlay=overlay,
        blur=blur,
    )
    for path in predict(job, console):
        console.result(f"wrote {path}")
    for reason in footage.skipped:
        typer.echo(f"skope: skipped: {reason}", err=True)
    if footage.skipped:
        raise typer.Exit(1)
    if fixed:
        console.result(f"next: skope eval track {shlex.quote(str(out))}")


def pose(
    folder: FolderArgument = None,
    annotations: AnnotationsOption = None,
    predictions: PredictionsOption = None,
    camera: CameraOption = None,
    ground: GroundOption = "auto",
    noise: Annotated[
        str, typer.Option(help="Pixels of noise added to ground-truth keypoints; several: measure each.")
    ] = "0",
    score: ScoreOption = 0.5,
    sigma: SigmaOption = None,
    out: Annotated[Path, typer.Option(help="Where to write.")] = Path("runs/pose"),
    quiet: QuietOption = False,
    version: VersionOption = False,
) -> None:
    """Position, heading and size of each vehicle in metres; with a ground truth, also how far off they are."""
    from skope.eval.pose.errors import measure, summary, table
    from skope.eval.pose.fit_ground import settled
    from skope.eval.pose.records import locate_view, records, write_poses
    from skope.eval.pose.views import read_scene
    from skope.files import write_json

    _probability("--score", score)
    levels = _numbers("--noise", noise)
    _pixels("--noise", *levels)
    _pixels("--sigma", sigma)
    scene = read_scene(folder, annotations, predictions, camera, _ground(ground))
    console = Console(quiet)
    if ground in _FITTED:
        scene, words = settled(scene, ground, score=score, noise=levels[0], sigma_px=sigma)
        if words:
            console.result(words)
    files = (folder, annotations, predictions, camera)
    _claim(out, "pose", files, ground=ground, noise=levels, score=score, sigma=sigma)
    rows, refused = [], 0
    with console.bar(total=len(scene.file.images), unit="image", label="poses") as bar:
        for view in scene.views(score=score, sigma_px=sigma, noise=levels[0]):
            found = list(records(locate_view(view, scene)))
            refused += sum(row["refused"] is not None for row in found)
            rows += found
            bar.update()
    for path in write_poses(out, rows):
        console.result(f"wrote {path}")
    console.result(f"{len(rows) - refused} poses of {len(rows)} vehicles; {refused} refused")
    if scene.has_truth:
        told = {}
        for level in levels if scene.results is None else (0.0,):
            name = f"labels with {level:g} px of noise" if scene.results is None else "predictions"
            told[name] = summary(measure(scene, noise=level, score=score, sigma_px=sigma))
            for line in table(f"{name}: median (90%, 99%)", told[name]):
                console.result(line)
        write_json(out / "pose_errors.json", told)
        console.result(f"wrote {out / 'pose_errors.json'}")


def track(
    folder: FolderArgument = None,
    annotations: AnnotationsOption = None,
    predictions: PredictionsOption = None,
    camera: CameraOption = None,
    ground: GroundOption = "auto",
    fps: Annotated[
        float | None, typer.Option(help="Frames a second.", show_default="the times that the frames carry")
    ] = None,
    noise: Annotated[float, typer.Option(help="Pixels of noise added to ground-truth keypoints.")] = 0.0,
    score: ScoreOption = 0.5,
    sigma: SigmaOption = None,
    video: Annotated[bool, typer.Option("--video", help="Also a bird's-eye video.")] = False,
    out: Annotated[Path, typer.Option(help="Where to write.")] = Path("runs/tracks"),
    quiet: QuietOption = False,
    version: VersionOption = False,
) -> None:
    """Follow vehicles through footage: tracks in metres with speeds, as CSV, MOTChallenge and SUMO's FCD."""
    from skope.eval.pose.fit_ground import settled
    from skope.eval.pose.views import read_scene
    from skope.eval.tracking.run import TrackJob, run

    _probability("--score", score)
    _pixels("--noise", noise)
    _pixels("--sigma", sigma)
    if fps is not None and not 0.001 <= fps <= 1000:
        raise UserError(f"--fps: expected a number from 0.001 to 1000, got {fps:g}")
    scene = read_scene(folder, annotations, predictions, camera, _ground(ground))
    console = Console(quiet)
    if ground in _FITTED:
        scene, words = settled(scene, ground, score=score, noise=noise, sigma_px=sigma)
        if words:
            console.result(words)
    files = (folder, annotations, predictions, camera)
    _claim(out, "track", files, ground=ground, fps=fps, noise=noise, score=score, sigma=sigma)
    job = TrackJob(scene=scene, fps=fps, noise=noise, score=score, sigma_px=sigma, video=video, out=out)
    for line in run(job, console):
        console.result(line)


def camera(
    folder: FolderArgument = None,
    annotations: AnnotationsOption = None,
    predictions: PredictionsOption = None,
    points: Annotated[
        Path | None,
        typer.Option(help="Marked points instead of vehicles: CSV with column, row, x, y, z in pixels and metres."),
    ] = None,
    size: Annotated[str | None, typer.Option(help="WIDTHxHEIGHT of the image that --points were marked in.")] = None,
    vehicles: Annotated[int, typer.Option(help="Use at most so many vehicles.")] = 40,
    noise: Annotated[float, typer.Option(help="Pixels of noise added to ground-truth keypoints.")] = 0.0,
    score: ScoreOption = 0.9,
    sigma: SigmaOption = None,
    out: Annotated[Path, typer.Option(help="Camera file to write.")] = Path("runs/camera.json"),
    quiet: QuietOption = False,
    version: VersionOption = False,
) -> None:
    """Find a camera's focal length, height and tilt from vehicles on a level road, or all of it from marked points.

    (`skope eval calibrate` is about a detector's keypoint scores.)
    """
    from skope.eval.pose.write_camera import from_points, from_vehicles

    _probability("--score", score)
    _pixels("--noise", noise)
    _pixels("--sigma", sigma)
    console = Console(quiet)
    if points is not None:
        if folder or annotations or predictions:
            raise UserError("--points stands alone: no folder, --annotations or --predictions with it")
        lines = from_points(points, size, out)
    else:
        if vehicles < 5:
            raise UserError(f"--vehicles: expected a whole number from 5, got {vehicles}")
        lines = from_vehicles(
            (folder, annotations, predictions), vehicles, score=score, noise=noise, sigma_px=sigma, out=out
        )
    for line in lines:
        console.result(line)


def _ground(text: str) -> float | None:
    """Height of the plane to begin with; None: no plane."""
    if text in _FITTED:
        return 0.0
    if text == "none":
        return None
    heights = _numbers("--ground", text)
    if len(heights) > 1 or abs(heights[0]) > _HIGHEST:
        raise UserError(f"--ground: expected a height in metres up to {_HIGHEST:g}, got {text!r}")
    return heights[0]


def _numbers(flag: str, text: str) -> list[float]:
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = [math.nan]
    if not all(math.isfinite(value) for value in values):
        raise UserError(f"{flag}: expected numbers, got {text!r}")
    return values


def _pixels(flag: str, *values: float | None) -> None:
    for value in values:
        if value is not None and not 0 <= value <= _MOST_PIXELS:
            raise UserError(f"{flag}: expected pixels from 0 to {_MOST_PIXELS:g}, got {value:g}")


def _probability(flag: str, value: float) -> None:
    if not 0 <= value <= 1:
        raise UserError(f"{flag}: expected a number from 0 to 1, got {value}")
