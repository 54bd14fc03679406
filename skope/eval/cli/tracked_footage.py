"""Footage tracked by the camera of a site file, for commands that begin with tracks."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from skope.errors import UserError
from skope.eval.cli.options import MachineOptions
from skope.eval.cli.scene_options import SceneOptions
from skope.files.output_folders import claim_output
from skope.terminal.console import Console

if TYPE_CHECKING:
    from skope.site.site_file import SiteFile

_CAMERA_NAME: Final = "camera.json"
_SEEN: Final = "seen"
TRACKS_NAME: Final = "tracks"
"""The folder of tracks below the output."""


def tracked_footage(
    source: str,
    site: "SiteFile",
    checkpoint: Path,
    hardware: MachineOptions,
    out: Path,
    command: str,
    options: Mapping[str, Any],
    console: Console,
) -> Path:
    """Detect and track what a video shows, in folders below `out`; a stopped run goes on.

    Args:
        source: The video.
        site: Its site, whose camera took it.
        checkpoint: What to detect with.
        hardware: How to run it.
        out: The output folder of `command`, which is claimed here.
        command: The command that asks.
        options: What else its result depends on.
        console: Where messages go.

    Returns:
        The folder of tracks.

    Raises:
        UserError: The site has no camera, the footage cannot be read, or `out` holds other work.
    """
    from skope.dataset.camera_of_file import read_camera
    from skope.eval.camera_fit.write_camera import write_camera
    from skope.eval.inference.frame_sources import Cut, open_footage
    from skope.eval.inference.predict_footage import predict
    from skope.eval.inference.predict_job import PredictJob, content_of
    from skope.eval.pose.camera_error import camera_info
    from skope.eval.tracking.track_footage import TrackJob, follow_footage
    from skope.traffic.observation import FOOTAGE

    if site.camera is None:
        raise UserError(
            f"{site.path}: camera: missing: footage has no metres without one (`skope eval site` calibrates it); "
            "`skope eval predict` and gates with `pixels` count without one"
        )
    footage = open_footage(source, Cut())
    if footage.clip is None:
        raise UserError(
            f"{source}: images carry no times: begin with `skope eval predict` and `skope eval track --fps`"
        )
    if footage.live:
        raise UserError(f"{source}: is a live stream; record it, or begin with `skope eval predict {source}`")
    known = site.camera.known
    besides = {"covariance": known.covariance_dict()} if known else {}
    # The site file may name the camera's: what that holds is part of what the work is.
    camera = {**site.camera.camera.to_dict(), **besides}
    named = {"source": content_of(footage), "checkpoint": str(checkpoint), "camera": camera}
    claim_output(out, command, [site.path], {**options, **named})
    tracks = out / TRACKS_NAME
    if (tracks / FOOTAGE).is_file() and not list(tracks.glob(".*")):
        console.say(f"{tracks}: has the tracks of {footage.name}")
        return tracks
    for line in write_camera(out / _CAMERA_NAME, site.camera.camera, besides):
        console.say(line)
    job = PredictJob(
        footage=footage,
        checkpoint=checkpoint,
        out=out / _SEEN,
        settings=hardware.settings(tiles="none"),
        camera=read_camera(out / _CAMERA_NAME)[0],
        camera_info=camera_info(out / _CAMERA_NAME),
    )
    for path in predict(job, console):
        console.say(f"wrote {path}")
    scene_options = SceneOptions(folder=out / _SEEN)
    scene = scene_options.scene(0.0, console=console)
    scene_options.claim_output(tracks, "skope eval track", fps=None, noise=0.0)
    track_job = TrackJob(
        scene=scene,
        place=scene_options.place,
        out=tracks,
        fps=None,
        begins=None,
        noise=0.0,
        score=scene_options.score,
        sigma_px=scene_options.sigma,
        video=False,
        overlay=False,
    )
    for line in follow_footage(track_job, console):
        console.say(line)
    return tracks
