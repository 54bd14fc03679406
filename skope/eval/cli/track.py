"""`skope eval pose` and `skope eval track`: vehicles in metres, frame by frame and through footage."""

from typing import Annotated

from skope.errors import UserError
from skope.eval.cli.options import counts, data_option, numbers_of, output
from skope.eval.cli.scene_options import NoiseOption, OutOption, SceneOptions
from skope.terminal.command_options import DEFAULT_TRACKS, LIST_METAVAR, POSE_FOLDER
from skope.terminal.console import Console


def pose(
    options: SceneOptions,
    console: Console,
    noise: Annotated[
        str,
        counts(metavar=LIST_METAVAR, help="Noise added to ground-truth keypoints, pixels; several: measure each."),
    ] = "0",
    out: OutOption = POSE_FOLDER,
) -> None:
    """Estimate position, heading and size of each vehicle in metres; with a ground truth, also their errors."""
    from skope.pose.pose_footage import PoseJob, locate_footage

    levels = numbers_of("--noise", noise)
    scene = options.scene(*levels, console=console)
    options.claim_output(out, "skope eval pose", noise=levels)
    job = PoseJob(scene=scene, out=out, score=options.score, sigma_px=options.sigma, noise=levels)
    for line in locate_footage(job, console):
        console.result(line)


def track(
    options: SceneOptions,
    console: Console,
    fps: Annotated[float | None, data_option(help="Frames per second.", show_default="the times of the frames")] = None,
    start_time: Annotated[
        str | None,
        data_option(
            metavar="TIME",
            help="Time of second 0 of the footage, as 2026-11-26T10:00:00+01:00; for `skope eval traffic`.",
            show_default="that of a live stream",
        ),
    ] = None,
    noise: NoiseOption = 0.0,
    video: Annotated[bool, output("--video", help="Also a bird's-eye video.")] = False,
    overlay: Annotated[
        bool, output("--overlay", help="Also the footage, with number, class and speed of each vehicle.")
    ] = False,
    out: OutOption = DEFAULT_TRACKS,
) -> None:
    """Track vehicles through footage: tracks in metres with speeds, as CSV, MOTChallenge and SUMO's FCD."""
    from skope.tracking.track_footage import TrackJob, follow_footage
    from skope.traffic.observation import read_start_time

    if fps is not None and not 0.001 <= fps <= 1000:
        raise UserError(f"--fps: expected a number from 0.001 to 1000, got {fps:g}")
    begin = None if start_time is None else read_start_time(start_time, "--start-time")
    scene = options.scene(noise, console=console)
    start_option = {} if begin is None else {"start_time": begin.isoformat()}
    options.claim_output(out, "skope eval track", fps=fps, noise=noise, **start_option)
    job = TrackJob(
        scene=scene,
        place=options.images_folder,
        fps=fps,
        start_time=begin,
        noise=noise,
        score=options.score,
        sigma_px=options.sigma,
        video=video,
        overlay=overlay,
        out=out,
    )
    for line in follow_footage(job, console):
        console.result(line)
