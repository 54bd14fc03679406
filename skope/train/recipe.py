"""Training recipes: all values that influence the result, read from TOML files and `name=value` options.

A recipe can name a teacher: a detector whose outputs a smaller network learns in addition to the labels.
"""

import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, Self, get_type_hints

from skope.detector.build import check_anchors, check_box_passes
from skope.errors import UserError, one_of
from skope.files.atomic import read_text
from skope.records import NONE_WORD, dataclass_of, plain_values, with_values
from skope.schema import VEHICLE_TYPES
from skope.train.augment import Augment
from skope.train.network_shape import NetworkShape


@dataclass(frozen=True, kw_only=True)
class TeacherRules:
    """Teacher of a distillation, and the weight of each of its losses; the losses of the labels have weight 1."""

    checkpoint: str | None = None
    """Name, run folder or file of the teacher; None: training on labels alone."""
    classes: float = 1.0
    boxes: float = 1.0
    keypoints: float = 1.0
    temperature: float = 1.0
    """Divisor of the logits before they become probabilities; larger values give softer probabilities."""
    sharpen: float = 1.0
    """Factor on the teacher's heat maps. Values above 1 restore heat maps that score calibration has flattened."""

    def __post_init__(self) -> None:
        for name in ("classes", "boxes", "keypoints"):
            if not 0 <= getattr(self, name) <= 1000:
                raise UserError(f"{name}: expected 0 to 1000, got {getattr(self, name)}")
        for name in ("temperature", "sharpen"):
            if not 0.1 <= getattr(self, name) <= 100:
                raise UserError(f"{name}: expected 0.1 to 100, got {getattr(self, name)}")

    @property
    def of_boxes(self) -> bool:
        """Whether its class or box losses have a weight."""
        return max(self.classes, self.boxes) > 0


def read_toml(path: Path) -> dict[str, Any]:
    """Return the table of a TOML file. Raises UserError if the file is missing or malformed."""
    try:
        return tomllib.loads(read_text(path))
    except ValueError as error:  # also a number with more digits than Python reads
        raise UserError(f"{path}: not valid TOML: {error}") from None


def from_flags(flags: Sequence[str], where: str) -> dict[str, Any]:
    """Return nested values of flags like `augment.blur=0.2`, written as in TOML; text also without quotes."""
    values: dict[str, Any] = {}
    for flag in flags:
        name, equals, text = flag.partition("=")
        if not equals or not name.strip():
            raise UserError(f"{where} {flag}: expected name=value")
        *tables, leaf = name.strip().split(".")
        into = values
        for table in tables:
            into = into.setdefault(table, {})
        try:
            into[leaf] = tomllib.loads(f"value = {text}")["value"]
        except ValueError:  # not TOML, or a number with more digits than Python reads
            into[leaf] = text.strip()
    return values


def with_flag_lists(cls: type[Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """Return values of flags and TOML files; texts like "car,van" are split if the field of `cls` is a list."""
    hints = get_type_hints(cls)
    return {name: _split(value) if "tuple" in str(hints.get(name)) else value for name, value in values.items()}


def _split(value: Any) -> Any:
    """Return the items of a text with commas; whole numbers are converted. Other values are returned unchanged."""
    if not isinstance(value, str) or value == NONE_WORD:
        return value
    items = [item.strip() for item in value.split(",") if item.strip()]
    return [int(item) if item.isdecimal() else item for item in items]


SUPERVISE_CHOICES: Final = ("visible", "all")
SMALL_SIZE: Final = (360, 640)
"""Short and maximum long side of images inside the network for training on two cores, pixels."""
NORM_CHOICES: Final = ("given", "frozen", "batch")


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """Parameters of a training. Unless stated otherwise, sizes are in pixels, rates per step and counts per image."""

    name: str
    init: str
    """Initial weights: one of the names for `--init`, or a file."""
    norm: str
    """Normalisation: `given` by the initial weights, `frozen`, or `batch` (trainable)."""
    learning_rate: float
    momentum: float
    weight_decay: float
    step_size: int | None
    """Number of epochs after which the learning rate is multiplied by `gamma`; None: once, after half the epochs."""
    gamma: float
    cosine_to: float | None
    """Final fraction of the learning rate, which falls along half a cosine; None: the rate falls in steps."""
    ema_decay: float | None
    """Decay per step of a running mean of weights and statistics. The mean is validated and saved instead of the last
    weights. None: the last weights are saved."""
    epochs: int
    batch_size: int
    """Number of images per step, of all processes together."""
    images_at_once: int | None
    """Number of images of a step that one process sends through the network at once; None: all of its share. Smaller
    values save memory. The loss of each part is weighted by its number of images."""
    warmup_steps: int
    """Number of steps over which the learning rate rises linearly from 0."""
    gradient_clip: float | None
    """Maximum 2-norm of all gradients together; None: no limit."""
    min_size: int | None
    """Short side of the image inside the network; None: the value in the initial weights, or 360 if they contain
    none."""
    max_size: int | None
    """Maximum long side of the image inside the network; None: that of the initial weights, or 640."""
    anchors: tuple[int, ...] | None
    """Sides of the anchors for each of the five levels, pixels; None: those of the initial weights."""
    box_passes: int | None
    """Number of box head passes, 1 or 2; None: as in the initial weights."""
    ignore_below: float
    """Minimum shorter edge of a vehicle's box inside the network, pixels. Smaller vehicles are ignored in training."""
    trainable_layers: int
    """Number of trainable stages of a trained backbone, 0 to 5, from the last. Random weights: all are trainable."""
    regions: int
    """Number of regions per image that the second stage is trained on; at most a quarter are vehicles."""
    keypoint_regions: int | None
    """Maximum number of these vehicles per image that enter the keypoint head; None: all."""
    supervise: str
    """Trained keypoints: `visible` (v = 2), or `all` inside the image, including hidden ones (v = 1)."""
    exclude_types: tuple[str, ...]
    """Vehicle types that are excluded from training and do not count as background."""
    val_fraction: float
    """Fraction of the training frames held out for validation (`skope.dataset.image_selection.held_back`)."""
    val_images: int
    """Maximum number of images to validate per epoch, evenly spread over the held-out frames; at most a fifth of the
    number of training images."""
    bfloat16: bool
    """Whether to multiply in bfloat16 where autocast considers it safe."""
    fold_norms: bool
    """Whether to fold frozen normalisation into the preceding convolutions, which saves time. Results are equal up to
    rounding."""
    channels_last: bool
    """Whether to store channels last in memory, which saves time. Results are equal up to rounding."""
    augment: Augment = field(default_factory=Augment)
    network: NetworkShape = field(default_factory=NetworkShape)
    """Backbone and widths."""
    teacher: TeacherRules = field(default_factory=TeacherRules)
    """Detector whose outputs are learnt in addition to the labels."""

    def __post_init__(self) -> None:
        one_of("supervise", self.supervise, SUPERVISE_CHOICES)
        one_of("norm", self.norm, NORM_CHOICES)
        for name in self.exclude_types:
            one_of("exclude_types", name, VEHICLE_TYPES)
        for name in ("epochs", "batch_size", "step_size", "images_at_once", "regions", "keypoint_regions"):
            self._in_range(name, 1, math.inf)
        for name in ("warmup_steps", "weight_decay", "learning_rate", "gradient_clip", "ignore_below"):
            self._in_range(name, 0, math.inf)
        for name in ("cosine_to", "ema_decay"):
            self._in_range(name, 0, 1)
        if self.anchors is not None:
            check_anchors(self.anchors)
        if self.box_passes is not None:
            check_box_passes(self.box_passes)
        self._in_range("trainable_layers", 0, 5)
        self._in_range("momentum", 0, 1)
        self._in_range("val_fraction", 0, 0.5)
        self._in_range("val_images", 1, math.inf)
        if self.augment.reduce and self.inside is None:
            raise UserError("augment.reduce: needs min_size and max_size, which the first weights give here")

    def _in_range(self, name: str, low: float, high: float) -> None:
        value = getattr(self, name)
        if value is not None and not low <= value <= high:
            limits = f"at least {low:g}" if high == math.inf else f"{low:g} to {high:g}"
            raise UserError(f"{name}: expected {limits}, got {value}")

    def to_dict(self) -> dict[str, Any]:
        """Return JSON values of the fields by name."""
        return plain_values(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """Return the recipe from the result of `to_dict`. Raises UserError if a field is missing or unknown."""
        return dataclass_of(cls, values, "recipe")

    def with_min_size(self, min_size: int) -> Self:
        """Return the recipe with short side `min_size`, pixels; the limit of the long side changes in proportion."""
        short, long = self.inside or SMALL_SIZE
        return replace(self, min_size=min_size, max_size=round(min_size * long / short))

    @property
    def inside(self) -> tuple[int, int] | None:
        """Return short and maximum long side of images inside the network, pixels; None: as in the initial weights."""
        return None if self.min_size is None or self.max_size is None else (self.min_size, self.max_size)

    @property
    def decay_epochs(self) -> int:
        """Number of epochs between two decays of the learning rate by `gamma`."""
        return self.step_size or (self.epochs + 1) // 2

    def describe(self, min_size: int) -> str:
        """Return the recipe on one line for people, with the resulting short side, pixels."""
        falls = f"x {self.gamma:g} every {self.decay_epochs}"
        if self.cosine_to is not None:
            falls = f"to {self.cosine_to * self.learning_rate:g} along a cosine"
        return (
            f"recipe {self.name}: {self.epochs} epochs, batch {self.batch_size}, SGD {self.learning_rate:g} {falls}, "
            f"short side {min_size} px, {'bfloat16' if self.bfloat16 else 'float32'}"
        )


PAPER_VALUES: Final[dict[str, Any]] = {
    # Values from the paper.
    "learning_rate": 0.001,
    "momentum": 0.9,
    "step_size": 3,
    "gamma": 0.2,
    "epochs": 10,
    # Values that the paper does not specify.
    "init": "auto",
    "norm": "given",
    "cosine_to": None,
    "ema_decay": None,
    "weight_decay": 0.0,
    "batch_size": 2,
    "images_at_once": None,
    "warmup_steps": 0,
    "gradient_clip": None,
    "min_size": 800,
    "max_size": 1333,
    "anchors": None,
    "box_passes": None,
    "ignore_below": 0.0,
    "trainable_layers": 3,
    "regions": 512,
    "keypoint_regions": None,
    "supervise": "visible",
    "exclude_types": (),
    "val_fraction": 0.0,
    "val_images": 100,
    "bfloat16": False,
    "fold_norms": True,
    "channels_last": True,
}

# On two cores, a step is dominated by pixels and the keypoint head: 22 GFLOP per region forward and backward.
_SMALL_NETWORK: Final[dict[str, Any]] = {
    "min_size": None,
    "max_size": None,
    "keypoint_regions": 48,
    "val_fraction": 0.1,
    "val_images": 24,
}

# Random weights need a high rate, which needs a warm-up and bounded gradients. While weights change that fast, the
# running means of BatchNorm2d lag behind and nothing is detected; the slower second half corrects this.
_FROM_NOTHING: Final[dict[str, Any]] = {
    "init": "random",
    "min_size": SMALL_SIZE[0],
    "max_size": SMALL_SIZE[1],
    "learning_rate": 0.02,
    "weight_decay": 1e-4,
    "step_size": None,
    "epochs": 40,
    "batch_size": 1,
    "warmup_steps": 20,
    "gradient_clip": 5.0,
    "regions": 128,
}

SHIPPED_RECIPES: Final[Mapping[str, Recipe]] = MappingProxyType(
    {
        "paper": Recipe(**{**PAPER_VALUES, "name": "paper"}),
        "laptop": Recipe(**{**PAPER_VALUES, **_SMALL_NETWORK, "name": "laptop"}),
        "scratch": Recipe(**{**PAPER_VALUES, **_SMALL_NETWORK, **_FROM_NOTHING, "name": "scratch"}),
    }
)
RECIPE_CHOICES: Final = ("auto", *SHIPPED_RECIPES)
BASE_KEY: Final = "base"
"""Key of a TOML recipe for the name of the recipe that it changes."""


def choose_recipe(name: str, *, gpu: bool, bfloat16: bool) -> Recipe:
    """Return the recipe of the flag `--recipe`.

    Args:
        name: One of `RECIPE_CHOICES`, or a TOML file that changes one of them. `auto` is `paper` on a GPU and `laptop`
            on a CPU.
        gpu: Whether the run is on a GPU.
        bfloat16: Whether this processor has instructions for bfloat16, which all recipes except `paper` use. With
            bfloat16 a step takes half the time on two cores. The run records the value as part of its recipe.

    Raises:
        UserError: There is no such recipe, or the file contains unknown names or wrong values.
    """
    if name.endswith(".toml"):
        path = Path(name)
        values = read_toml(path)
        base = values.pop(BASE_KEY, "auto")
        if base not in RECIPE_CHOICES:
            raise UserError(f"{path}: {BASE_KEY}: {base!r} is not one of {', '.join(RECIPE_CHOICES)}")
        recipe = choose_recipe(base, gpu=gpu, bfloat16=bfloat16)
        return with_values(recipe, with_flag_lists(Recipe, {"name": path.stem, **values}), f"{path}: ")
    one_of("--recipe", name, RECIPE_CHOICES)
    recipe = SHIPPED_RECIPES[("paper" if gpu else "laptop") if name == "auto" else name]
    return recipe if recipe.name == "paper" else replace(recipe, bfloat16=bfloat16)


def adjusted_recipe(recipe: Recipe, flags: Sequence[str]) -> Recipe:
    """Return the recipe with the values of `--set name=value` flags."""
    return with_values(recipe, with_flag_lists(Recipe, from_flags(flags, "--set")), "--set ")
