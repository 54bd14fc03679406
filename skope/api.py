"""The functions of `import skope`: datasets, the detector, positions, tracks, traffic, scores and generated images.

Each loads what it needs when it is called, so that reading a dataset does not wait for torch. What is wrong with a
user's files raises a `skope.UserError` of one line that names file and field.
"""

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from skope.camera.model import Camera
from skope.dataset import coco, folder
from skope.dataset.folder import Dataset
from skope.detections import apart
from skope.detector import weights
from skope.errors import UserError
from skope.schema import AnnotationFile, AnyResult

if TYPE_CHECKING:
    from skope.detections import Detections
    from skope.eval.inference.predictor import Predictor
    from skope.eval.pose.records import Located
    from skope.eval.tracking.tracks import Track
    from skope.site.site_file import SiteFile
    from skope.traffic.counts import Count
    from skope.traffic.report import TrafficReport
    from skope.train.data import DetectionDataset

Pixels = NDArray[np.uint8]


def open_dataset(path: str | Path) -> Dataset:
    """Open a dataset that `skope gen` made.

    Args:
        path: The dataset's folder.

    Returns:
        The dataset. Iterating over it gives `LabelledImage`s: an image's record, its camera, its annotations, and its
        pixels when they are asked for. `dataset.read("train")` gives all records of a split at once.

    Raises:
        UserError: There is no finished dataset in the folder.
    """
    return folder.open_dataset(Path(path))


def torch_dataset(path: str | Path, split: str = "train", *, supervise: str = "visible") -> "DetectionDataset":
    """The images of a split as torchvision's detection models take them, for `torch.utils.data.DataLoader`.

    Args:
        path: The dataset's folder.
        split: One of `open_dataset(path).splits`.
        supervise: "visible" for the keypoints that can be seen, "all" for hidden ones too.

    Returns:
        A `torch.utils.data.Dataset` of pairs: pixels (3, H, W) float32 from 0 to 1, and a dict of `boxes` (N, 4) xyxy
        in pixels, `labels` (N,), `keypoints` (N, 33, 3) x, y, v, and `ignored_boxes` (M, 4), which count neither as
        vehicles nor as background. Vehicles have label 1; where the dataset labels other road users, these follow with
        labels from 2, in the order of the file's `categories`, and keypoints that are all v = 0.

    Raises:
        UserError: There is no such dataset or split.
    """
    from skope.train.data import DetectionDataset

    return DetectionDataset(open_dataset(path), split, supervise)


class Detector:
    """A detector that is ready to run; `load_detector` makes one."""

    def __init__(self, predictor: "Predictor") -> None:
        self._predictor = predictor

    @property
    def checkpoint(self) -> Path:
        """The file that the weights were read from."""
        return self._predictor.weights

    def __call__(self, image: Pixels | str | Path) -> "Detections":
        """Find the vehicles in an image.

        Args:
            image: (H, W, 3) RGB pixels of type uint8, or the path of an image file. OpenCV reads BGR: turn it round.

        Returns:
            Detections with `boxes_xyxy` (N, 4), `scores` (N,) and `keypoints` (N, 33, 3), in pixels of the image and
            best score first; `detections.above(0.5)` keeps those with higher scores. Where the detector has learnt
            them, `road_users` has boxes, scores and categories of people on foot and on two wheels.

        Raises:
            UserError: The file cannot be read.
            ValueError: The pixels are of another shape or type.
        """
        return self.many([image])[0]

    def many(self, images: Sequence[Pixels | str | Path]) -> "list[Detections]":
        """Find the vehicles in several images, which go through the network together where they have one size."""
        pixels = [one if isinstance(one, np.ndarray) else folder.read_image(Path(one)) for one in images]
        for one in pixels:
            if one.ndim != 3 or one.shape[2] != 3 or one.dtype != np.uint8:
                raise ValueError(f"expected (H, W, 3) pixels of type uint8, got {one.shape} of type {one.dtype}")
        scheme = self._predictor.scheme
        return [replace(found, scheme=scheme) for found in self._predictor.detections(pixels)]


def load_detector(
    checkpoint: str | Path = weights.DEFAULT,
    *,
    device: str = "auto",
    backend: str = "torch",
    precision: str = "float32",
    min_score: float = 0.05,
    tiles: str = "none",
) -> Detector:
    """Load a detector.

    Args:
        checkpoint: A checkpoint file, the folder of a training run, or the name of weights that come with skope.
        device: "auto" (a GPU where there is one), "cpu", "cuda" or "cuda:1".
        backend: What computes the costly parts: "torch", "openvino" (2 to 4 times as fast on a CPU; pip install
            'skope[openvino]'), "onnx", or "auto": OpenVINO where it is installed and no GPU is.
        precision: "float32", "bfloat16", "int8" (of OpenVINO), or "auto": the fastest that backend, processor and
            checkpoint have.
        min_score: Vehicles with lower scores are not reported, and cost no time.
        tiles: "auto" to look at parts of an image too where it is larger than the network takes it.

    Returns:
        The detector, to be called with an image.

    Raises:
        UserError: There is no such checkpoint, it is damaged, or there is no such device.
    """
    from skope.eval.inference.predictor import Predictor
    from skope.eval.inference.settings import Settings
    from skope.terminal.console import Console

    settings = Settings(device=device, backend=backend, precision=precision, min_score=min_score, tiles=tiles)
    return Detector(Predictor.load(Path(checkpoint), settings, Console(quiet=True)))


def read_camera(path: str | Path) -> Camera:
    """Read a camera with its pose in the world.

    Args:
        path: What `skope eval camera` wrote, OpenCV's .yml or .xml, a TUMTraf or Rope3D calibration, or an annotation
            file, of which the first image's camera is taken.

    Raises:
        UserError: The file cannot be read, or does not say where the camera hangs.
    """
    from skope.dataset import camera_of_file

    camera, posed = camera_of_file.read_camera(Path(path))
    if not posed:
        raise UserError(f"{path}: does not say where the camera hangs; `skope eval camera` finds that out")
    return camera


def locate(detections: "Detections", camera: Camera, *, ground: float | None = 0.0) -> "Located":
    """Position, heading and size of the vehicles of one image, in metres.

    Args:
        detections: What the detector found; drop weak ones before, as in `detections.above(0.5)`.
        camera: The image's camera, as `read_camera` reads it; of the image's size, or a multiple.
        ground: Height of the level road in the camera's world, metres; None where it is unknown: then the size of
            vehicles tells how far away they are, and less exactly.

    Returns:
        The vehicles in the order of the detections: its `poses` hold `position` (N, 3), `yaw` (N,) in radians
        counter-clockwise from world x, `size_lwh` (N, 3), `covariance` (N, 4, 4), `types`, and what to distrust in
        `refusal` and `flags`; its `good` (N,) says which vehicles have a pose.

    Raises:
        UserError: The camera's shape is not the image's.
    """
    from skope.dataset.camera_of_file import sized
    from skope.eval.pose.ground import Ground
    from skope.eval.pose.records import Located
    from skope.eval.pose.shape_model import fleet_shapes
    from skope.eval.pose.solver import locate as solve
    from skope.eval.pose.views import view_of

    own = sized(camera, detections.size, "image")
    view = view_of(detections)
    road = None if ground is None else Ground(height=ground)
    shapes = fleet_shapes(detections.scheme.edition)
    poses = solve(own, view.found, sigma_px=view.sigma_px, ground=road, shapes=shapes, cut=view.cut)
    return Located(view, own, poses)


def track(frames: "Iterable[Located]", times_s: Sequence[float]) -> "list[Track]":
    """Follow vehicles through the frames of one camera.

    Args:
        frames: What `locate` gave for each frame.
        times_s: The time of each frame, seconds, rising.

    Returns:
        Tracks with smoothed `position` (M, 3), `velocity` (M, 2), `heading` (M,) and `speed` (M,) in each of the
        vehicle's M `frames`.

    Raises:
        ValueError: The times do not rise.
    """
    from skope.eval.tracking.detections import detections_of
    from skope.eval.tracking.tracker import follow

    if (np.diff(times_s) <= 0).any():
        raise ValueError("times_s: expected times that rise from frame to frame")
    return follow((detections_of(one) for one in frames), times_s)


def measure_traffic(
    tracks: "str | Path | Sequence[str | Path] | Sequence[Track]",
    site: "str | Path | SiteFile",
    *,
    begins: str | datetime | Sequence[str | datetime] | None = None,
    times_s: Sequence[float] | None = None,
    hand_count: str | Path | None = None,
) -> "TrafficReport":
    """Count and measure traffic: what `skope eval traffic` writes, in memory.

    Args:
        tracks: The folder that `skope eval track` wrote, several such folders of one site, or what `track` gave.
        site: A site file with gates, zones, lanes and settings, or what `skope.site.site_file.read_site` has read.
        begins: When the footage begins, as a time or as `--begins` takes it; of several recordings a time for each, in
            their order. Default: as their `footage.json`, the site or, of several, the names of their footage say.
        times_s: Of tracks in memory the times of all frames, seconds, also of those without any track; by default
            those of the tracks. Between them it is known when nothing was observed.
        hand_count: CSV of what was counted by hand (docs/traffic.md), from which the intervals of counts learn.

    Returns:
        The report: its `crossings`, `visits`, `counts`, `turning`, `speeds`, `headways`, `queues`, `delays` and
        `conflicts`, each with how uncertain it is, and in `refused` what could not be measured, and why.

    Raises:
        UserError: A file is missing or wrong, recordings overlap in time, or it is not known when one began.
        ValueError: `tracks` are folders and tracks.
    """
    from skope.eval.tracking.trajectories_of_tracks import trajectories_of_tracks
    from skope.site.site_file import SiteFile, read_site
    from skope.traffic.clock import local_start
    from skope.traffic.hand_count_file import read_hand_counts
    from skope.traffic.measure import measure
    from skope.traffic.observation import Observation
    from skope.traffic.recording_begin import said_begin
    from skope.traffic.recordings import RecordedTraffic, read_recordings

    read = site if isinstance(site, SiteFile) else read_site(Path(site))
    said = [begins] if isinstance(begins, str | datetime) else list(begins or ())
    given = [tracks] if isinstance(tracks, str | Path) else list(tracks)
    folders = [Path(one) for one in given if isinstance(one, str | Path)]
    if folders and len(folders) < len(given):
        raise ValueError("tracks: expected folders, or what `track` gave, not both")
    if not folders and len(said) > 1:
        raise UserError(f"begins: expected one time for one recording, got {len(said)}")
    if folders:
        footage = read_recordings(folders, said, read, "begins")
    else:
        followed = [one for one in given if not isinstance(one, str | Path)]
        times = [one.times_s for one in followed] or [np.zeros(0)]
        seen = np.unique(np.concatenate(times)) if times_s is None else np.asarray(times_s, dtype=np.float64)
        footage = RecordedTraffic(
            tracks=tuple(trajectories_of_tracks(followed)),
            observation=Observation(times_s=seen),
            start=said_begin(said[0], read, "begins") if said else local_start(read),
        )
    start, observation = footage.start, footage.observation
    counted = (
        () if hand_count is None else read_hand_counts(Path(hand_count), read.gates, read.traffic, start, observation)
    )
    return measure(footage.tracks, observation, read, start, counted, recordings=footage.recordings)


def count(
    tracks: "str | Path | Sequence[str | Path] | Sequence[Track]",
    site: "str | Path | SiteFile",
    *,
    begins: str | datetime | Sequence[str | datetime] | None = None,
    times_s: Sequence[float] | None = None,
) -> "list[Count]":
    """How many crossed each gate, by direction, lane, class and interval on the clock.

    Args:
        tracks: As `measure_traffic` takes them.
        site: Likewise.
        begins: Likewise.
        times_s: Likewise.

    Returns:
        A count for each, with `count`, None where nothing was observed, and `expected`: between `expected.low` and
        `expected.high` is how many there were, with 90%.

    Raises:
        UserError: A file is missing or wrong.
    """
    return list(measure_traffic(tracks, site, begins=begins, times_s=times_s).counts)


def score(
    predictions: str | Path | Sequence[AnyResult],
    annotations: str | Path | AnnotationFile,
    *,
    min_score: float = 0.9,
    alpha: float = 0.1,
    iou: Sequence[float] = (0.9, 0.8, 0.7, 0.6),
) -> Mapping[str, Any]:
    """Measure detections against a ground truth.

    Args:
        predictions: A COCO results file, or its results.
        annotations: A COCO annotation file, or its records (`dataset.read(split)`).
        min_score: A detection counts when it scores above this.
        alpha: A keypoint is correct within this share of the longer edge of its vehicle's box.
        iou: Overlaps at which a detection matches a vehicle.

    Returns:
        A split's entry as in `metrics.json`: counts, and for each IoU ("0.6") `pck` and the precision and recall of
        boxes and keypoints, `pooled` over all images and as the `paper` counts them. A ratio without anything to
        divide by is None. Where the predictions hold other road users than vehicles, `categories` has the figures of
        those that the ground truth labels, by category and size.

    Raises:
        UserError: A file cannot be read, or the predictions are of other images.
    """
    from skope.metrics import read_inputs
    from skope.metrics.precision_recall import Options, score_split
    from skope.metrics.road_users import category_figures

    file = annotations if isinstance(annotations, AnnotationFile) else coco.read(Path(annotations))
    given = predictions
    found = read_inputs.read_all_results(Path(given), file) if isinstance(given, str | Path) else given
    vehicles, road_users = apart(found)
    entry = score_split(file, vehicles, Options(score=min_score, alpha=alpha, iou=tuple(iou)))
    figures = category_figures(file, road_users, score=min_score) if road_users else {}
    return entry | ({"categories": figures} if figures else {})


def generate(
    out: str | Path,
    *,
    preset: str = "demo",
    sites: Sequence[str] | None = None,
    site: str | Path | None = None,
    frames: int | None = None,
    interval: float | None = None,
    size: str | None = None,
    seed: int = 0,
    workers: int | None = None,
    quiet: bool = True,
    **options: Any,
) -> Dataset:
    """Generate annotated images, or go on where a stopped call was; the same arguments give the same bytes.

    Args:
        out: The dataset's folder; a new one, or one that the same call began.
        preset: What kind of dataset: "demo", "paper", "full", "extra", "varied", "world" or "conditions".
        sites: Names of camera sites in place of the preset's (`skope gen sites` lists them).
        site: One name in place of `sites`, or a site file of your own road and camera.
        frames: Images for each site.
        interval: Seconds between a recording's frames.
        size: Width and height of the images, as in "1280x720".
        seed: What everything that is random follows from.
        workers: Processes; by default one for each core.
        quiet: Print nothing on the way.
        options: Any other option of `skope gen` by its name with underscores, as in `shape_jitter=True`.

    Returns:
        The finished dataset.

    Raises:
        UserError: An option is wrong, or the folder holds other work.
    """
    with suppress(ImportError):
        # A program that goes on with torch crashes where Mesa's compiler (LLVM) was loaded before torchvision's.
        import torchvision  # noqa: F401

    from skope.gen.cli.options import DatasetOptions, WorkerOptions
    from skope.gen.pipeline.generate import generate_dataset
    from skope.terminal.console import Console

    asked = DatasetOptions(
        preset=preset,
        sites=None if sites is None else ",".join(sites),
        site=None if site is None else str(site),
        frames=frames,
        interval=interval,
        size=size,
        seed=seed,
        **options,
    )
    request, _ = asked.request()
    start_pool, _ = WorkerOptions(workers=workers).pool_factory()
    generate_dataset(request, Path(out), start_pool, Console(quiet=quiet))
    return open_dataset(out)
