"""From footage to the road: `skope eval predict`, `pose`, `track` and `camera`."""

import math
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from skope.dataset.folder import FRAMES, PREDICTIONS
from skope.detector import weights
from skope.errors import UserError
from skope.eval.cli.options import FastMachineOptions
from skope.eval.inference.settings import TILES
from skope.files.output_folders import claim_output
from skope.terminal.command_options import CAMERA_FILE, DIR, FILE, LIST, POSES, PREDICTED, SIZE, TRACKS, Formerly, panel
from skope.terminal.console import Console

if TYPE_CHECKING:
    from skope.eval.pose.views import Scene

_FITTED = ("auto", "fit")
_HIGHEST = 10_000.0
_MOST_PIXELS = 10_000.0

data, counts, output = map(panel, ("Data", "What counts", "Output"))

OutOption = Annotated[Path, output(metavar=DIR, help="Where to write.")]
CameraOption = Annotated[
    Path | None,
    data(
        metavar=FILE,
        help="Camera file: of `skope eval camera`, OpenCV (.yml, .xml), TUMTraf (.json), Rope3D (.txt), or an "
        "annotation file.",
        show_default="that of each image",
    ),
]
NoiseOption = Annotated[float, counts(help="Pixels of noise added to ground-truth keypoints.")]
ScoreOption = Annotated[float, counts(help="Take detections above this.")]
SigmaOption = Annotated[
    float | None,
    counts(help="Standard deviation of a keypoint, pixels.", show_default="2% of the box's longer edge"),
]


@dataclass(frozen=True, kw_only=True)
class KeypointOptions:
    """Where the keypoints of vehicles come from: a folder of predictions, or files."""

    folder: Annotated[Path | None, typer.Argument(metavar="FOLDER", help="Folder that `skope eval predict` wrote.")] = (
        None
    )
    annotations: Annotated[
        Path | None,
        data(metavar=FILE, help="COCO file with images and cameras instead of a folder; its own keypoints count."),
    ] = None
    predictions: Annotated[
        Path | None, data(metavar=FILE, help="COCO results for the images, in place of the annotations' keypoints.")
    ] = None


@dataclass(frozen=True, kw_only=True)
class SceneOptions(KeypointOptions):
    """Whose keypoints are taken to the road, and what is known of the camera, the road and the keypoints."""

    camera: CameraOption = None
    ground: Annotated[
        str,
        data(
            metavar="[auto|fit|none|METRES]",
            help="Height of the level road in the camera's world; fit: the plane that the vehicles show; auto: 0 "
            "unless they clearly show another; none: unknown, size tells distance.",
        ),
    ] = "auto"
    score: ScoreOption = 0.5
    sigma: SigmaOption = None

    def scene(self, *noise: float, console: Console) -> "Scene":
        """The vehicles' views and the road, fitted if it shall be; says so then.

        `noise` are the levels that will be added, of which the first one counts here.
        """
        from skope.eval.pose.fit_ground import with_fitted_ground
        from skope.eval.pose.views import read_scene
        from skope.eval.pose.write_camera import doubt

        _probability("--score", self.score)
        _pixels("--noise", *noise)
        _pixels("--sigma", self.sigma)
        scene = read_scene(self.folder, self.annotations, self.predictions, self.camera, _ground(self.ground))
        if self.camera and (words := doubt(self.camera)):
            console.result(f"{words}: distances and speeds may all be off by as much, beyond what sigma says")
        if self.ground in _FITTED:
            scene, words = with_fitted_ground(scene, self.ground, score=self.score, noise=noise[0], sigma_px=self.sigma)
            if words:
                console.result(words)
        return scene

    @property
    def place(self) -> Path:
        """Folder of the file that lists the images."""
        if self.folder:
            return self.folder
        assert self.annotations  # `scene` has seen to it
        return self.annotations.parent

    def claim_output(self, out: Path, command: str, **options: Any) -> None:
        """Take the output folder of a command for these options and `options`."""
        inputs = [self.folder / FRAMES, self.folder / PREDICTIONS] if self.folder else []
        inputs += [path for path in (self.annotations, self.predictions, self.camera) if path]
        claim_output(out, command, inputs, {"ground": self.ground, **options, "score": self.score, "sigma": self.sigma})


def predict(
    source: Annotated[
        str,
        typer.Argument(metavar="SOURCE", help="Image, folder, glob (quoted), video file or rtsp:// / http:// stream."),
    ],
    *,
    checkpoint: Annotated[
        Path,
        data(metavar="PATH", help="Checkpoint file, run folder for its newest one, or weights that come with skope."),
    ] = Path(weights.DEFAULT),
    camera: CameraOption = None,
    every: Annotated[int, data(help="Take every so many-th frame.")] = 1,
    start: Annotated[float, data(help="Begin at this second of a video.")] = 0.0,
    end: Annotated[float | None, data(help="End at this second of a video.", show_default="its end")] = None,
    tiles: Annotated[
        str,
        counts(choices=TILES, help="auto: look at parts too where the image is larger than in the network."),
    ] = "none",
    score: Annotated[float, output(help="Keep detections above this.")] = 0.5,
    unconfirmed: Annotated[
        bool, output("--unconfirmed", help="On video, keep also what no other frame confirms.")
    ] = False,
    every_frame: Annotated[
        bool,
        counts(
            "--every-frame",
            help="Run the detector on every frame of a video; on a CPU it runs twice a second by default, and points "
            "on the vehicles are followed between.",
        ),
    ] = False,
    overlay: Annotated[bool, output("--overlay", help="Draw what was found: a video, or images.")] = False,
    blur: Annotated[bool, output("--blur", help="Blur plates and glass in the overlay.")] = False,
    out: Annotated[
        Path | None,
        output(metavar=DIR, help="Where to write.", show_default=f"{PREDICTED}/ and the source's name"),
    ] = None,
    hardware: FastMachineOptions,
    console: Console,
) -> None:
    """Run a detector on footage: COCO results, and overlays. The same command goes on where a stopped one was."""
    from skope.dataset.camera_of_file import read_camera
    from skope.eval.inference.footage import Cut, open_footage

    _probability("--score", score)
    footage = open_footage(source, Cut(every=every, start_s=start, end_s=math.inf if end is None else end))
    if blur and not overlay:
        raise UserError("--blur is for the overlay: give --overlay too")
    if overlay and footage.live:
        raise UserError("--overlay: a live stream cannot be read again; record it to a file first")
    settings = hardware.settings(tiles=tiles)
    out = out or PREDICTED / (Path(footage.name).stem or "images")
    fixed = read_camera(camera)[0] if camera else None

    from skope.eval.inference.predict_footage import PredictJob, predict

    job = PredictJob(
        footage=footage,
        checkpoint=checkpoint,
        out=out,
        settings=settings,
        score=score,
        camera=fixed,
        overlay=overlay,
        blur=blur,
        unconfirmed=unconfirmed,
        every_frame=every_frame,
    )
    for path in predict(job, console):
        console.result(f"wrote {path}")
    for reason in footage.skipped:
        typer.echo(f"skope: skipped: {reason}", err=True)
    if footage.skipped:
        raise typer.Exit(1)
    here = shlex.quote(str(out))
    if fixed:
        console.result(f"next: skope eval track {here}")
    elif footage.clip is not None:
        console.result(
            f"next, for metres: skope eval camera {here}, or your own: skope eval track {here} --camera FILE"
        )


def pose(
    options: SceneOptions,
    console: Console,
    noise: Annotated[
        str,
        counts(metavar=LIST, help="Pixels of noise added to ground-truth keypoints; several: measure each."),
    ] = "0",
    out: OutOption = POSES,
) -> None:
    """Position, heading and size of each vehicle in metres; with a ground truth, also how far off they are."""
    from skope.eval.pose.pose_errors import measure, summary, table
    from skope.eval.pose.records import locate_view, records, write_poses
    from skope.files.json_files import write_json

    levels, score, sigma = _numbers("--noise", noise), options.score, options.sigma
    scene = options.scene(*levels, console=console)
    options.claim_output(out, "skope eval pose", noise=levels)
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
        summaries = {}
        for level in levels if scene.results is None else (0.0,):
            name = f"labels with {level:g} px of noise" if scene.results is None else "predictions"
            summaries[name] = summary(measure(scene, noise=level, score=score, sigma_px=sigma))
            for line in table(f"{name}: median (90%, 99%)", summaries[name]):
                console.result(line)
        write_json(out / "pose_errors.json", summaries)
        console.result(f"wrote {out / 'pose_errors.json'}")


def track(
    options: SceneOptions,
    console: Console,
    fps: Annotated[float | None, data(help="Frames a second.", show_default="the times that the frames carry")] = None,
    noise: NoiseOption = 0.0,
    video: Annotated[bool, output("--video", help="Also a bird's-eye video.")] = False,
    out: OutOption = TRACKS,
) -> None:
    """Follow vehicles through footage: tracks in metres with speeds, as CSV, MOTChallenge and SUMO's FCD."""
    from skope.eval.tracking.track_footage import TrackJob, run

    if fps is not None and not 0.001 <= fps <= 1000:
        raise UserError(f"--fps: expected a number from 0.001 to 1000, got {fps:g}")
    scene = options.scene(noise, console=console)
    options.claim_output(out, "skope eval track", fps=fps, noise=noise)
    job = TrackJob(
        scene=scene,
        place=options.place,
        fps=fps,
        noise=noise,
        score=options.score,
        sigma_px=options.sigma,
        video=video,
        out=out,
    )
    for line in run(job, console):
        console.result(line)


def camera(
    keypoints: KeypointOptions,
    console: Console,
    points: Annotated[
        Path | None,
        data(
            metavar=FILE,
            help="Marked points instead of vehicles: CSV with column, row, x, y, z in pixels and metres.",
        ),
    ] = None,
    size: Annotated[str | None, data(metavar=SIZE, help="Size of the image that --points were marked in.")] = None,
    max_vehicles: Annotated[int, counts(least=5, help="Use at most so many vehicles."), Formerly("--vehicles")] = 40,
    noise: NoiseOption = 0.0,
    score: ScoreOption = 0.9,
    sigma: SigmaOption = None,
    out: Annotated[Path, output(metavar=FILE, help="Camera file to write.")] = CAMERA_FILE,
) -> None:
    """Find a camera's focal length, height and tilt from vehicles on a level road, or all of it from marked points.

    (`skope eval calibrate` is about a detector's keypoint scores.)
    """
    from skope.eval.pose.write_camera import from_points, from_vehicles

    _probability("--score", score)
    _pixels("--noise", noise)
    _pixels("--sigma", sigma)
    if points is not None:
        if keypoints.folder or keypoints.annotations or keypoints.predictions:
            raise UserError("--points stands alone: no folder, --annotations or --predictions with it")
        lines = from_points(points, size, out)
    else:
        where = (keypoints.folder, keypoints.annotations, keypoints.predictions)
        lines = from_vehicles(where, max_vehicles, score=score, noise=noise, sigma_px=sigma, out=out)
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
