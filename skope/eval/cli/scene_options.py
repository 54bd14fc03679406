"""Options of the commands that project keypoints of vehicles onto the road."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from skope.dataset.folder import FRAMES_FILE, PREDICTIONS_FILE
from skope.errors import UserError
from skope.eval.cli.options import check_pixels, check_probability, counts, data_option, numbers_of, output
from skope.files.output_folders import claim_output
from skope.metrics.thresholds import KEPT_SCORE
from skope.terminal.command_options import DIR_METAVAR, FILE_METAVAR
from skope.terminal.console import Console

if TYPE_CHECKING:
    from skope.pose.keypoint_views import Scene

FITTED_CHOICES = ("auto", "fit")
_HIGHEST_M = 10_000.0

OutOption = Annotated[Path, output(metavar=DIR_METAVAR, help="Output folder.")]
CameraOption = Annotated[
    Path | None,
    data_option(
        metavar=FILE_METAVAR,
        help="Camera file: from `skope eval camera`, OpenCV (.yml, .xml), TUMTraf (.json), Rope3D (.txt), or an "
        "annotation file.",
        show_default="that of each image",
    ),
]
NoiseOption = Annotated[float, counts(help="Noise added to ground-truth keypoints, pixels.")]
ScoreOption = Annotated[float, counts(help="Use detections with a score above this.")]
SigmaOption = Annotated[
    float | None,
    counts(help="Standard deviation of a keypoint, pixels.", show_default="2% of the box's longer edge"),
]


@dataclass(frozen=True, kw_only=True)
class KeypointOptions:
    """Options on the source of vehicles' keypoints: a folder of predictions, or files."""

    folder: Annotated[Path | None, typer.Argument(metavar="FOLDER", help="Folder that `skope eval predict` wrote.")] = (
        None
    )
    annotations: Annotated[
        Path | None,
        data_option(
            metavar=FILE_METAVAR, help="COCO file with images and cameras instead of a folder; its own keypoints count."
        ),
    ] = None
    predictions: Annotated[
        Path | None,
        data_option(metavar=FILE_METAVAR, help="COCO results for the images, in place of the annotations' keypoints."),
    ] = None

    def read(self, camera: Path | None = None, ground: float | None = None) -> "Scene":
        """Read the keypoints, with the camera file and the road height, both as in `read_scene`."""
        from skope.pose.keypoint_views import read_scene

        return read_scene(self.folder, self.annotations, self.predictions, camera, ground)


@dataclass(frozen=True, kw_only=True)
class SceneOptions(KeypointOptions):
    """Options on the source of keypoints, and on the camera, the road and the keypoint errors."""

    camera: CameraOption = None
    ground: Annotated[
        str,
        data_option(
            metavar="[auto|fit|none|METRES]",
            help="Road height in the camera's world, metres. auto: 0, or a fitted plane if the vehicles contradict 0; "
            "fit: fit a plane; none: unknown, distance follows from vehicle size.",
        ),
    ] = "auto"
    score: ScoreOption = KEPT_SCORE
    sigma: SigmaOption = None

    def scene(self, *noise: float, console: Console) -> "Scene":
        """Return the views of vehicles and the road. Print a line if the road is fitted.

        `noise` has the noise levels of the run. Only the first is used here.
        """
        from skope.camera.fit.fit_ground import with_fitted_ground
        from skope.camera.fit.write_camera import scale_error_line
        from skope.dataset.camera_of_file import fitted_camera

        check_probability("--score", self.score)
        check_pixels("--noise", *noise)
        check_pixels("--sigma", self.sigma)
        scene = self.read(self.camera, _ground(self.ground))
        if scene.left_out:
            console.result(scene.left_out)
        if scene.camera is not None:
            for size in sorted({(image.width, image.height) for image in scene.file.images}):
                _, scaled = fitted_camera(scene.camera, size, str(self.camera), scene.file.name)
                if scaled:
                    console.result(scaled)
        if scene.motion:
            console.result(f"{scene.file.name}: {scene.motion}")
        if scene.known:
            console.result(scale_error_line(self.camera or scene.file.name, scene.known.distance_sigma()))
        if self.ground in FITTED_CHOICES:
            scene, words = with_fitted_ground(scene, self.ground, score=self.score, noise=noise[0], sigma_px=self.sigma)
            if words:
                console.result(words)
        return scene

    @property
    def images_folder(self) -> Path:
        """Folder of the file that lists the images."""
        if self.folder:
            return self.folder
        assert self.annotations  # ensured by `scene`
        return self.annotations.parent

    def claim_output(self, out: Path, command: str, **options: Any) -> None:
        """Claim the output folder of a command for these options and `options`."""
        inputs = [self.folder / FRAMES_FILE, self.folder / PREDICTIONS_FILE] if self.folder else []
        inputs += [path for path in (self.annotations, self.predictions, self.camera) if path]
        claim_output(out, command, inputs, {"ground": self.ground, **options, "score": self.score, "sigma": self.sigma})


def _ground(text: str) -> float | None:
    """Return the initial height of the road plane, metres; None: no plane."""
    if text in FITTED_CHOICES:
        return 0.0
    if text == "none":
        return None
    heights = numbers_of("--ground", text)
    if len(heights) > 1 or abs(heights[0]) > _HIGHEST_M:
        raise UserError(f"--ground: expected a height in metres up to {_HIGHEST_M:g}, got {text!r}")
    return heights[0]
