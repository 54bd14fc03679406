"""`skope eval predict`: run a detector on footage."""

import math
import shlex
from pathlib import Path
from typing import Annotated

import typer

from skope.detector import weights
from skope.detector.network_settings import TILE_CHOICES
from skope.errors import UserError
from skope.eval.cli.options import FastMachineOptions, check_probability, counts, data_option, output
from skope.eval.cli.scene_options import CameraOption
from skope.metrics.thresholds import KEPT_SCORE
from skope.terminal.command_options import DIR_METAVAR, PREDICTION_FOLDER
from skope.terminal.console import Console


def predict(
    source: Annotated[
        str,
        typer.Argument(metavar="SOURCE", help="Image, folder, glob (quoted), video file or rtsp:// / http:// stream."),
    ],
    *,
    checkpoint: Annotated[
        Path | None,
        data_option(
            metavar="PATH",
            help="Checkpoint file, run folder for its newest one, or weights that come with skope.",
            show_default=f"{weights.DEFAULT_WEIGHTS}; for a live stream the first of "
            f"{', '.join(weights.BY_ACCURACY)} that runs in real time",
        ),
    ] = None,
    camera: CameraOption = None,
    every: Annotated[int, data_option(help="Frame stride: 1 takes every frame, 5 every fifth.")] = 1,
    start: Annotated[float, data_option(help="Start time in a video, seconds.")] = 0.0,
    end: Annotated[float | None, data_option(help="End time in a video, seconds.", show_default="its end")] = None,
    fps: Annotated[
        float | None,
        data_option(
            help="Frames per second of a video with missing or wrong time stamps.",
            show_default="its time stamps",
        ),
    ] = None,
    tiles: Annotated[
        str,
        counts(choices=TILE_CHOICES, help="auto: also detect in tiles if the image is larger than the network input."),
    ] = "none",
    score: Annotated[float, output(help="Keep detections with a score above this.")] = KEPT_SCORE,
    unconfirmed: Annotated[
        bool, output("--unconfirmed", help="On video, also keep detections that no other frame confirms.")
    ] = False,
    every_frame: Annotated[
        bool,
        counts(
            "--every-frame",
            help="Run the detector on every frame of a video. On a CPU it runs twice per second by default, and points "
            "on the vehicles are tracked in between.",
        ),
    ] = False,
    strict: Annotated[
        bool, output("--strict", help="Exit with code 1 if a part of the footage could not be read.")
    ] = False,
    overlay: Annotated[bool, output("--overlay", help="Draw the detections: a video, or images.")] = False,
    blur: Annotated[bool, output("--blur", help="Blur plates, glass and heads in the overlay.")] = False,
    out: Annotated[
        Path | None,
        output(metavar=DIR_METAVAR, help="Output folder.", show_default=f"{PREDICTION_FOLDER}/ and the source's name"),
    ] = None,
    hardware: FastMachineOptions,
    console: Console,
) -> None:
    """Run a detector on footage: COCO results, and overlays. The same command resumes a stopped run."""
    from skope.dataset.camera_of_file import fitted_camera, read_camera
    from skope.video.footage import FrameRange, open_footage

    check_probability("--score", score)
    footage = open_footage(
        source, FrameRange(every=every, start_s=start, end_s=math.inf if end is None else end), fps=fps
    )
    if blur and not overlay:
        raise UserError("--blur: applies to the overlay; add --overlay")
    if overlay and footage.live:
        raise UserError("--overlay: a live stream cannot be read again; record it to a file first")
    settings = hardware.settings(tiles=tiles)
    out = out or PREDICTION_FOLDER / (Path(footage.name).stem or "images")
    fixed = None
    if camera:
        size = footage.frame_size()
        fixed = read_camera(camera, size)[0]
        if size:
            fixed, scaled = fitted_camera(fixed, size, str(camera), footage.name)
            if scaled:
                console.result(scaled)

    from skope.footage.predict_footage import predict
    from skope.footage.predict_job import PredictJob
    from skope.pose.camera_error import camera_info

    job = PredictJob(
        footage=footage,
        checkpoint=checkpoint,
        out=out,
        settings=settings,
        score=score,
        camera=fixed,
        camera_info=camera_info(camera) if camera else {},
        overlay=overlay,
        blur=blur,
        unconfirmed=unconfirmed,
        every_frame=every_frame,
    )
    for path in predict(job, console):
        console.result(f"wrote {path}")
    for reason in footage.skipped:
        typer.echo(f"skope: skipped: {reason}", err=True)
    if footage.broken_off or (strict and footage.skipped):
        raise typer.Exit(1)
    here = shlex.quote(str(out))
    if fixed:
        console.result(f"next: skope eval track {here}")
    elif footage.clip is not None:
        console.result(
            f"next, for metres: skope eval camera {here}, or your own: skope eval track {here} --camera FILE"
        )
