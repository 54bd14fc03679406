"""Run the detector on many images: a thread decodes ahead, and images are batched if this helps."""

import contextlib
import copy
import itertools
import queue
import threading
import time
from collections import deque
from collections.abc import Container, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torchvision.models.detection import KeypointRCNN

from skope import boxes
from skope.dataset.folder import read_image
from skope.detections import Detections, apart
from skope.detector import score_calibration
from skope.detector.backends.prepare import prepare
from skope.detector.build import DetectorConfig
from skope.detector.checkpoint import find_checkpoint, load_weights
from skope.detector.detect import detect, detect_on_boxes
from skope.detector.device import choose_device
from skope.detector.network_settings import MIN_SCORE, Settings
from skope.detector.tiles import Tile, join_tiles, tiles_of
from skope.detector.weights import shipped
from skope.errors import UserError
from skope.keypoints import Scheme
from skope.schema import Annotation, AnnotationFile, AnyResult, Image, Result
from skope.terminal.console import Console, minutes
from skope.types import Pixels

Item = TypeVar("Item")

END_MARK: Final = object()


@dataclass(frozen=True)
class BatchSizes:
    """Batches and threads of a predictor."""

    poll_s: float = 0.1
    """Interval at which a waiting thread checks whether its caller still exists, seconds."""
    gpu: int = 8
    """Number of images per batch on a GPU. A CPU gains nothing from batches."""
    large_gpu: int = 16
    """Number of images per batch on a GPU with `large_gpu_bytes` or more. At a short side of 1080, a batch takes 10 GB
    and is a tenth faster."""
    large_gpu_bytes: int = 24 * 10**9
    """Memory of a large GPU, bytes."""
    decoders: int = 2
    """Number of threads that decode images."""


BATCH_SIZES: Final = BatchSizes()


def read_ahead(items: Iterable[Item], count: int) -> Generator[Item]:
    """Yield the items of an iterable in order; a thread computes up to `count` items ahead.

    An exception of the iterable is raised at its position. The thread ends when the caller closes this generator.
    """
    made: queue.Queue[object] = queue.Queue(count)
    unwanted = threading.Event()

    def put(item: object) -> None:
        while not unwanted.is_set():
            with contextlib.suppress(queue.Full):
                made.put(item, timeout=BATCH_SIZES.poll_s)
                return

    def make() -> None:
        try:
            for item in items:
                put(item)
                if unwanted.is_set():
                    return
            put(END_MARK)
        except BaseException as error:  # raised again when the items are taken
            put(_Raised(error))

    thread = threading.Thread(target=make, daemon=True)
    thread.start()
    try:
        while (item := made.get()) is not END_MARK:
            if isinstance(item, _Raised):
                raise item.error
            yield item  # type: ignore[misc]
    finally:
        unwanted.set()
        thread.join()


class _Raised:
    def __init__(self, error: BaseException) -> None:
        self.error = error


T = TypeVar("T")

CALIBRATED_KEY: Final = "calibrated"
"""Metadata key that describes the data on which the scores of a checkpoint were calibrated."""


class Predictor:
    """Detector on a device, with its score calibration if one exists."""

    def __init__(
        self,
        model: KeypointRCNN,
        config: DetectorConfig,
        metadata: dict[str, Any],
        *,
        weights: Path,
        calibration: score_calibration.ScoreCalibration | None,
        settings: Settings,
        device: torch.device,
        console: Console,
    ) -> None:
        self.model = model
        """The network; a backend may compute parts of it."""
        self.config, self.metadata = config, metadata
        self.weights = weights
        self._calibration, self._settings = calibration, settings
        self._device, self._console = device, console
        self.batch_size = settings.batch_size or default_batch_size(device)
        """Maximum number of images of one size per batch."""
        self.scheme = config.keypoint_scheme

    @classmethod
    def load(cls, checkpoint: Path, settings: Settings, console: Console) -> "Predictor":
        """Load a checkpoint and prepare the backend that `settings` select.

        Args:
            checkpoint: A checkpoint file, a run folder, or the name of weights that come with skope.
            settings: Settings of inference.
            console: Receives a description of detector and backend.

        Raises:
            UserError: Checkpoint, device or backend does not exist, or a file is damaged.
        """
        device = choose_device(settings.device)
        weights = find_checkpoint(checkpoint)
        model, config, metadata = load_weights(weights, device)
        calibration = score_calibration.read(weights, config.scheme) if settings.calibrated else None
        if settings.min_size is not None:
            config = config.with_min_size(settings.min_size)
            model.transform.min_size, model.transform.max_size = (config.min_size,), config.max_size
        number = prepare(
            model,
            metadata,
            device,
            backend=settings.backend,
            precision=settings.precision,
            one_size=settings.one_size,
            console=console,
        )
        predictor = cls(
            model,
            config,
            metadata,
            weights=weights,
            calibration=calibration,
            settings=settings,
            device=device,
            console=console,
        )
        console.say(predictor.described(number))
        if len(config.categories) > 1:
            console.say(f"finds {', '.join(config.categories)}; keypoints of vehicles alone")
        return predictor

    def described(self, number: str) -> str:
        """Return a description of the detector; `number` describes backend and number format."""
        sides = f"short side {self.config.min_size}, long side at most {self.config.max_size} px"
        scores = "calibrated" if self.calibrated else "uncalibrated"
        return f"{self.name} on {self._device} in {number} ({sides}; {scores} keypoint scores)"

    @property
    def name(self) -> str:
        """Name of the weights in the package, or path of the file."""
        return self.weights.stem if shipped(self.weights) else str(self.weights)

    def reporting(self, min_score: float, *, batch_size: int | None = None) -> "Predictor":
        """Return a detector with the same weights and a different score threshold, `min_score`.

        `batch_size` is the maximum number of images of one size per batch; None: unchanged.
        """
        copied = copy.copy(self)
        copied.batch_size = batch_size or self.batch_size
        copied._settings = replace(self._settings, min_score=min_score, batch_size=copied.batch_size)
        return copied

    @property
    def settings(self) -> Settings:
        """Settings with which the checkpoint is run."""
        return self._settings

    def check_scheme(self, scheme: Scheme, data: Path) -> None:
        """Raise a UserError unless `data` has the keypoint scheme of this checkpoint."""
        if scheme.name != self.scheme.name:
            raise UserError(
                f"{self.weights}: has keypoint scheme {self.scheme.name}, {data} has {scheme.name}: they cannot be "
                "compared"
            )

    @property
    def calibrated(self) -> bool:
        """Whether keypoint scores are calibrated, by the file beside the weights or in the weights."""
        return self._calibration is not None or CALIBRATED_KEY in self.metadata

    @property
    def categories(self) -> tuple[str, ...]:
        """Names of the categories that the detector has learnt."""
        return self.config.categories

    @property
    def files(self) -> tuple[Path, ...]:
        """Files that determine the detections: the weights and, if it exists, their score calibration."""
        beside = () if self._calibration is None else (score_calibration.path_beside(self.weights),)
        return (self.weights, *beside)

    def split(self, file: AnnotationFile, root: Path) -> tuple[Result, ...]:
        """Yield the vehicles of each image of `file`, in order. File names are relative to `root`."""
        return tuple(vehicle for _, found in self.by_image(file, root) for vehicle in apart(found)[0])

    def by_image(
        self, file: AnnotationFile, root: Path, known: Container[int] = ()
    ) -> Iterator[tuple[int, list[AnyResult]]]:
        """Find vehicles and other road users in the images of a file, one after another.

        Args:
            file: The images and, with `Settings.given`, the vehicles.
            root: Folder that file names are relative to.
            known: Ids of images to skip, because their results exist.

        Yields:
            Id and detections of each image, vehicles first, in the order of `file`. With given boxes, only vehicles.
        """
        annotations = file.by_image()
        images = [image for image in file.images if image.id not in known]
        with self._console.bar(total=len(file.images), unit="image", label=file.name) as bar:
            before = len(file.images) - len(images)
            bar.update(before)
            begun, done = time.perf_counter(), before
            for batch in _batches(_decoded(images, root, 2 * self.batch_size), self.batch_size):
                if self._settings.given:
                    for image, pixels in batch:
                        yield image.id, self._on_boxes(image.id, pixels, annotations[image.id])
                else:
                    yield from ((image.id, found) for image, found in self._found(batch))
                bar.update(len(batch))
                # The first batch also warms up the libraries, so the second one (if any) is timed.
                if bar.n == before + len(batch) < len(file.images):
                    begun, done = time.perf_counter(), bar.n
                elif bar.n <= before + 2 * self.batch_size and not self._console.quiet:
                    seconds = (time.perf_counter() - begun) * len(images) / (bar.n - done)
                    bar.write(f"{file.name}: about {minutes(seconds)} for {len(images)} images")

    def each(self, images: Iterator[tuple[Image, Pixels]]) -> Iterator[tuple[Image, list[AnyResult]]]:
        """Yield the results of each image as soon as they are available, vehicles first."""
        for batch in _batches(images, self.batch_size):
            yield from self._found(batch)

    def each_ahead(self, images: Iterator[tuple[Image, Pixels]]) -> Iterator[tuple[Image, list[AnyResult]]]:
        """Yield the same results if images can wait: threads prepare and process batches in advance."""
        prepared = ((image, _pinned(pixels)) for image, pixels in images) if self._device.type == "cuda" else images
        return read_ahead(self.each(read_ahead(prepared, 2 * self.batch_size)), self.batch_size)

    def detections(self, images: Sequence[Pixels]) -> list[Detections]:
        """Detect vehicles and other road users in several images, (H, W, 3) uint8 sRGB each."""
        batches = _batches(enumerate(images), self.batch_size)
        return [found for batch in batches for found in self._detect([pixels for _, pixels in batch])]

    def _found(self, batch: Sequence[tuple[Image, Pixels]]) -> Iterator[tuple[Image, list[AnyResult]]]:
        """Yield the images of a batch, each with its results."""
        answers = self._detect([pixels for _, pixels in batch])
        for (image, _), found in zip(batch, answers, strict=True):
            yield image, found.all_results(image.id)

    def _detect(self, batch: Sequence[Pixels]) -> list[Detections]:
        """Run one pass of images of one size through the network."""
        answers = self._run(batch)
        if self._settings.tiles == "auto" and (parts := self._tiles(batch[0])):
            answers = [self._with_tiles(image, whole, parts) for image, whole in zip(batch, answers, strict=True)]
        return [replace(found, keypoints=self._scored(found.keypoints)) for found in answers]

    def _tiles(self, image: Pixels) -> list[Tile]:
        height, width = image.shape[:2]
        return tiles_of(width, height, short=self.config.min_size, long=self.config.max_size)

    def _with_tiles(self, image: Pixels, whole: Detections, parts: list[Tile]) -> Detections:
        """Join detections of the whole image and of its tiles."""
        batches = _batches(((part, part.of(image)) for part in parts), self.batch_size)
        found = [detections for batch in batches for detections in self._run([pixels for _, pixels in batch])]
        return join_tiles(whole, list(zip(parts, found, strict=True)))

    def _run(self, images: Sequence[Pixels]) -> list[Detections]:
        """Run images of one size through the network; keypoint scores are not calibrated."""
        least = MIN_SCORE if self._settings.min_score is None else self._settings.min_score
        try:
            return detect(self.model, images, self._device, min_score=least, categories=self.categories)
        except torch.OutOfMemoryError:
            raise UserError(
                f"{self._device}: out of memory with {len(images)} images in the network at a time, short side "
                f"{self.config.min_size} px: lower --batch-size or --min-size"
            ) from None

    def _on_boxes(self, image_id: int, pixels: Pixels, annotations: list[Annotation]) -> list[AnyResult]:
        # In order of id, so that of two vehicles with the same box each is matched to itself.
        truth = sorted((a for a in annotations if not a.ignored), key=lambda a: a.id)
        given = np.array([a.bbox for a in truth]).reshape(-1, 4)
        points = detect_on_boxes(self.model, pixels, boxes.xywh_to_xyxy(given), self._device)
        rows = zip(truth, self._scored(points), strict=True)
        return [Result(image_id=image_id, bbox=vehicle.bbox, score=1.0, keypoints=p) for vehicle, p in rows]

    def _scored(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        return self._calibration(points) if self._calibration else points


def default_batch_size(device: torch.device) -> int:
    """Return the default number of images per batch on a device."""
    if device.type != "cuda":
        return 1
    large = torch.cuda.get_device_properties(device).total_memory >= BATCH_SIZES.large_gpu_bytes
    return BATCH_SIZES.large_gpu if large else BATCH_SIZES.gpu


def _decoded(images: Sequence[Image], root: Path, ahead: int) -> Iterator[tuple[Image, Pixels]]:
    """Yield images with their pixels in order; up to `ahead` of them are decoded while the caller computes."""

    def read(image: Image) -> Pixels:
        return read_image(root / image.file_name, size=(image.width, image.height))

    left = iter(images)
    waiting: deque[tuple[Image, Future[Any]]] = deque()
    with ThreadPoolExecutor(BATCH_SIZES.decoders) as pool:
        try:
            for image in itertools.islice(left, ahead):
                waiting.append((image, pool.submit(read, image)))
            while waiting:
                image, future = waiting.popleft()
                pixels = future.result()
                for following in itertools.islice(left, 1):
                    waiting.append((following, pool.submit(read, following)))
                yield image, pixels
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def _pinned(pixels: Pixels) -> Pixels:
    """Return the same pixels in pinned memory, which a GPU reads directly and six times as fast."""
    return torch.from_numpy(pixels).pin_memory().numpy()


def _batches(images: Iterable[tuple[T, Pixels]], size: int) -> Iterator[list[tuple[T, Pixels]]]:
    """Group consecutive images of equal size, at most `size` per group: padding would change the detections."""
    for _, alike in itertools.groupby(images, key=lambda pair: pair[1].shape):
        while batch := list(itertools.islice(alike, size)):
            yield batch
