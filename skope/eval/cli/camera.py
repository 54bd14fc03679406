"""`skope eval camera`: a camera's focal length and pose, from vehicles or marked points."""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

from skope.errors import UserError
from skope.eval.cli.options import check_pixels, check_probability, counts, data_option, output
from skope.eval.cli.scene_options import KeypointOptions, NoiseOption, ScoreOption, SigmaOption
from skope.terminal.command_options import CAMERA_FILE, FILE_METAVAR, SIZE_METAVAR, panel
from skope.terminal.console import Console

turned = panel("A camera that was turned")


def estimate_camera(
    keypoints: KeypointOptions,
    console: Console,
    points: Annotated[
        Path | None,
        data_option(
            metavar=FILE_METAVAR,
            help="Marked points instead of vehicles: CSV with column, row, x, y, z in pixels and metres (or longitude, "
            "latitude), OTVision's .otrfpts, or a site.toml with [calibration].",
        ),
    ] = None,
    size: Annotated[
        str | None,
        data_option(
            metavar=SIZE_METAVAR, help="Size of the image in which --points were marked; a site.toml may contain it."
        ),
    ] = None,
    max_vehicles: Annotated[int, counts(least=5, help="Maximum number of vehicles to use.")] = 40,
    height: Annotated[float | None, data_option(help="Height of the camera above the road, metres, if known.")] = None,
    fov: Annotated[float | None, data_option(help="Horizontal field of view, degrees, if known.")] = None,
    length: Annotated[
        list[str] | None,
        data_option(
            metavar="C,R,C,R,METRES",
            help="A known length on the road: column and row of its two ends, metres; repeatable.",
        ),
    ] = None,
    noise: NoiseOption = 0.0,
    score: ScoreOption = 0.9,
    sigma: SigmaOption = None,
    refit: Annotated[
        str | None,
        turned(
            metavar="SOURCE",
            help="Picture or video (FILE@SECONDS) of a camera that was turned: finds its new pose from --picture "
            "with --points or --camera.",
        ),
    ] = None,
    picture: Annotated[
        str | None,
        turned(metavar="SOURCE", help="Picture or video (FILE@SECONDS) in which --points were marked, for --refit."),
    ] = None,
    camera: Annotated[
        Path | None, turned(metavar=FILE_METAVAR, help="The old camera, for --refit, if its points are not available.")
    ] = None,
    out: Annotated[Path, output(metavar=FILE_METAVAR, help="Camera file to write.")] = CAMERA_FILE,
) -> None:
    """Calibrate a camera: focal length, height and tilt from vehicles on a level road, or all from marked points."""
    from skope.camera.fit.camera_from_marks import camera_from_marks
    from skope.camera.fit.write_camera import from_vehicles, known_length

    check_probability("--score", score)
    check_pixels("--noise", noise)
    check_pixels("--sigma", sigma)
    for name, value, most in (("--height", height, 200.0), ("--fov", fov, 170.0)):
        if value is not None and not 0.5 <= value <= most:
            raise UserError(f"{name}: expected a number from 0.5 to {most:g}, got {value:g}")
    if refit is not None:
        lines = _refitted(keypoints, refit, picture, points, camera, size, out)
    elif picture is not None or camera is not None:
        raise UserError("--picture, --camera: need --refit")
    elif points is not None:
        if height is not None or fov is not None or length:
            raise UserError(
                "--height, --fov and --length: apply to vehicles; with --points, use [calibration] of a site.toml"
            )
        if keypoints.folder or keypoints.annotations or keypoints.predictions:
            raise UserError("--points: cannot be combined with a folder, --annotations or --predictions")
        lines = camera_from_marks(points, size, out)
    else:
        lines = from_vehicles(
            keypoints.read(),
            keypoints.folder,
            max_vehicles,
            score=score,
            noise=noise,
            sigma_px=sigma,
            height=height,
            fov_deg=fov,
            lengths=[known_length(text) for text in length or ()],
            out=out,
        )
    for line in lines:
        console.result(line)
    if keypoints.folder:
        drawn = _picture(keypoints.folder, out, console)
        if drawn is not None:
            console.result(f"wrote {drawn}: check that the grid lies on the road, and the boxes on the vehicles")


def _refitted(
    keypoints: KeypointOptions,
    refit: str,
    picture: str | None,
    points: Path | None,
    camera: Path | None,
    size: str | None,
    out: Path,
) -> Iterator[str]:
    from skope.camera.fit import refit_camera

    if keypoints.folder or keypoints.annotations or keypoints.predictions:
        raise UserError("--refit: cannot be combined with a folder, --annotations or --predictions")
    if picture is None or (points is None) == (camera is None):
        raise UserError("--refit: needs --picture, and either --points or --camera")
    return refit_camera.refit(picture, refit, points=points, camera=camera, size=size, out=out)


def _picture(folder: Path, camera: Path, console: Console) -> Path | None:
    """Draw the camera's grid and boxes on an image beside its file; None if the footage is not available."""
    import cv2

    from skope.files.output_folders import write_new
    from skope.pose.keypoint_views import read_scene
    from skope.tracking.camera_picture import draw_camera_picture

    path = camera.with_suffix(".jpg")
    try:
        pixels = draw_camera_picture(read_scene(folder, None, None, camera, 0.0), folder)
        if pixels is not None:
            _, encoded = cv2.imencode(".jpg", cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR))
            write_new(path, encoded.tobytes())
    except UserError as error:
        console.say(f"{path} is not drawn: {error}")
        return None
    return path if pixels is not None else None
