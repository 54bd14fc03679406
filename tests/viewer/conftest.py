import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import pytest

from skope.dataset import coco
from skope.dataset.folder import open_dataset
from skope.metrics.keypoint_outcomes import MetricOptions
from skope.schema import CATEGORY_NAMES, Result
from skope.viewer.collection import Collection, ShownSplit, read_picture
from skope.viewer.documents import Documents
from skope.viewer.server import bound
from tests.eval.report.test_page import detector_of
from tests.samples import make_annotation, make_dataset, make_road_user

HOSTILE = "</script><img src=x onerror=alert(1)>\"'&"
"""A name that would become markup where it is not taken for text."""


@pytest.fixture
def labelled(tmp_path: Path) -> Collection:
    """Four images with a van and a sedan each, a hidden bus in the second and an ignored truck in the last one.

    The sites are "north" and `HOSTILE` by turns; the first two images have clear weather, the others rain.
    """
    root = make_dataset(tmp_path / "data", images=4, splits=("easy",))
    file = coco.read(root / "annotations/easy.json")
    images = tuple(
        replace(image, site=("north", HOSTILE.replace("/", ""))[i % 2], weather=("clear", "rain")[i // 2])
        for i, image in enumerate(file.images)
    )
    bus = replace(make_annotation(50, images[1].id, (30, 20, 30, 20), vehicle_type="bus", hidden=5), occlusion=0.5)
    ignored = make_annotation(51, images[3].id, (2, 90, 40, 30), iscrowd=1, vehicle_type="truck")
    vans = [replace(a, vehicle_type="van") if a.id % 2 else a for a in file.annotations]
    made = replace(file, images=images, annotations=(*vans, bus, ignored))
    return Collection(
        title=f"data {HOSTILE}",
        splits=(ShownSplit(file=made),),
        picture=lambda image: read_picture(root / image.file_name),
    )


@pytest.fixture
def peopled(labelled: Collection) -> Collection:
    """The same with a pedestrian and a bicycle in the first image, and an ignored motorcycle in the second."""
    (split,) = labelled.splits
    first, second = (image.id for image in split.file.images[:2])
    others = (
        make_road_user(60, first, (100.0, 5, 10, 30)),
        make_road_user(61, first, (120.0, 5, 20, 30), "bicycle"),
        make_road_user(62, second, (140.0, 5, 9, 9), "motorcycle", iscrowd=1),
    )
    return replace(
        labelled, splits=(ShownSplit(file=replace(split.file, road_users=others, categories=CATEGORY_NAMES)),)
    )


@pytest.fixture
def predicted(labelled: Collection) -> Collection:
    """The same with a detector's results, which `tests.eval.report.test_page.detector_of` describes, score above 0.5.

    The bus and the sedan of every other image are missed; the last image has a false detection.
    """
    (split,) = labelled.splits
    truth = replace(split.file, annotations=tuple(a for a in split.file.annotations if a.id < 50))
    results: tuple[Result, ...] = tuple(detector_of(truth))
    return replace(labelled, splits=(replace(split, results=results),), options=MetricOptions(score=0.5))


@pytest.fixture
def served() -> Iterator[Callable[[Collection], int]]:
    """Serve a collection in this process; returns the port."""
    with ExitStack() as stack:

        def serve(collection: Collection) -> int:
            server = stack.enter_context(bound(Documents(collection), 0))
            threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True).start()
            stack.callback(server.shutdown)
            return server.server_port

        yield serve


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    """A dataset folder of two splits."""
    return open_dataset(make_dataset(tmp_path / "roads")).root
