"""Training recipes: all values that influence the result, read from TOML files and `name=value` options.

A recipe can name a teacher: a detector that a smaller one is distilled from.
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
    """A name, run folder or file, as `--checkpoint` takes it; None: labels alone are learnt."""
    classes: float = 1.0
    boxes: float = 1.0
    keypoints: float = 1.0
    temperature: float = 1.0
    """Logits are divided by it before they become probabilities: more makes them softer."""
    sharpen: float = 1.0
    """Factor on the heat maps of the teacher. Calibration of its scores has flattened them; this restores them."""

    def __post_init__(self) -> None:
        for name in ("classes", "boxes", "keypoints"):
            if not 0 <= getattr(self, name) <= 1000:
                raise UserError(f"{name}: expected 0 to 1000, got {getattr(self, name)}")
        for name in ("temperature", "sharpen"):
            if not 0.1 <= getattr(self, name) <= 100:
                raise UserError(f"{name}: expected 0.1 to 100, got {getattr(self, name)}")

    @property
    def of_boxes(self) -> bool:
        """Whether its classes or boxes count."""
        return max(self.classes, self.boxes) > 0


def read_toml(path: Path) -> dict[str, Any]:
    """The table of a TOML file; a missing or malformed one is a UserError that names it."""
    try:
        return tomllib.loads(read_text(path))
    except ValueError as error:  # also a number with more digits than Python reads
        raise UserError(f"{path}: not valid TOML: {error}") from None


def from_flags(flags: Sequence[str], where: str) -> dict[str, Any]:
    """Nested values of flags like `augment.blur=0.2`; a value is written as in TOML, text without quotes too."""
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
        except ValueError:  # no TOML, or a number with more digits than Python reads
            into[leaf] = text.strip()
    return values


def with_flag_lists(cls: type[Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """Values of flags and TOML files, with texts like "car,van" split where the field of `cls` is a list."""
    hints = get_type_hints(cls)
    return {name: _split(value) if "tuple" in str(hints.get(name)) else value for name, value in values.items()}


def _split(value: Any) -> Any:
    """The items of a text with commas, whole numbers as such. Any other value is returned unchanged."""
    if not isinstance(value, str) or value == NONE_WORD:
        return value
    items = [item.strip() for item in value.split(",") if item.strip()]
    return [int(item) if item.isdecimal() else item for item in items]


SUPERVISE_CHOICES: Final = ("visible", "all")
SMALL_SIZE: Final = (360, 640)
"""Short and largest long side of images inside the network where two cores are to learn from them, pixels."""
NORM_CHOICES: Final = ("given", "frozen", "batch")


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """The parameters of a training. Sizes are pixels, rates per step, counts per image where not said otherwise."""

    name: str
    init: str
    """First weights: one of the names that `--init` takes, or a file."""
    norm: str
    """Normalisation: `given` by the first weights, `frozen`, or `batch` (it learns)."""
    learning_rate: float
    momentum: float
    weight_decay: float
    step_size: int | None
    """Number of epochs after which the learning rate is multiplied by `gamma`; None: once, after half the epochs."""
    gamma: float
    cosine_to: float | None
    """The learning rate falls along half a cosine to this share of itself instead; None: in steps."""
    ema_decay: float | None
    """Decay, per step, of a running mean of weights and statistics that is validated and saved in place of the last
    ones; None: there is no mean."""
    epochs: int
    batch_size: int
    """Images that a step learns from, of all processes together."""
    images_at_once: int | None
    """Images of a step that one process takes through the network at a time; None: all of its share. Fewer save memory;
    each part's losses count by its images."""
    warmup_steps: int
    """Steps over which the learning rate rises linearly from 0."""
    gradient_clip: float | None
    """Largest 2-norm of all gradients together; None leaves them alone."""
    min_size: int | None
    """Short side of the image inside the network; None: as the first weights have it, 360 if they do not say."""
    max_size: int | None
    """Most that the long side has there; None: as the first weights have it, 640 if they do not say."""
    anchors: tuple[int, ...] | None
    """Sides of the network's anchors, one for each of its five levels, pixels; None: those of the first weights."""
    box_passes: int | None
    """Number of box head passes, 1 or 2; None: as in the initial weights."""
    ignore_below: float
    """Minimum shorter edge of a vehicle's box inside the network, pixels. Smaller vehicles are ignored in training."""
    trainable_layers: int
    """Stages of a trained backbone that learn on, 0 to 5 from the last (random weights learn in all)."""
    regions: int
    """Regions that the second stage learns from, at most a quarter of them vehicles."""
    keypoint_regions: int | None
    """Number of these vehicles that enter the keypoint head; None for all."""
    supervise: str
    """Keypoints that are learnt: `visible` (v = 2), or `all` inside the image, hidden ones (v = 1) too."""
    exclude_types: tuple[str, ...]
    """Vehicle types that are neither learnt nor background."""
    val_fraction: float
    """Share of each training recording, at its end, that is validated on instead of learnt from."""
    val_images: int
    """Most images, evenly spread over that share, that an epoch's validation looks at (and a fifth of those learnt)."""
    bfloat16: bool
    """Multiply in bfloat16 where autocast thinks it safe."""
    fold_norms: bool
    """Multiply frozen normalisation into the convolutions before it: the same up to rounding, in less time."""
    channels_last: bool
    """Keep channels together in memory: the same up to rounding, in less time."""
    augment: Augment = field(default_factory=Augment)
    network: NetworkShape = field(default_factory=NetworkShape)
    """Backbone and widths."""
    teacher: TeacherRules = field(default_factory=TeacherRules)
    """The detector that is learnt from beside the labels."""

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
        """JSON values of the fields by name."""
        return plain_values(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """The recipe of `to_dict`; a UserError says when fields are missing or unknown."""
        return dataclass_of(cls, values, "recipe")

    def with_min_size(self, min_size: int) -> Self:
        """The recipe with another short side, pixels; the long side's limit changes in proportion."""
        short, long = self.inside or SMALL_SIZE
        return replace(self, min_size=min_size, max_size=round(min_size * long / short))

    @property
    def inside(self) -> tuple[int, int] | None:
        """Short and largest long side of images inside the network, pixels; None: as the first weights have them."""
        return None if self.min_size is None or self.max_size is None else (self.min_size, self.max_size)

    @property
    def decay_epochs(self) -> int:
        """Epochs after which the learning rate falls by `gamma`, again and again."""
        return self.step_size or (self.epochs + 1) // 2

    def describe(self, min_size: int) -> str:
        """The recipe in one line for people, with the short side that the first weights left or gave, pixels."""
        falls = f"x {self.gamma:g} every {self.decay_epochs}"
        if self.cosine_to is not None:
            falls = f"to {self.cosine_to * self.learning_rate:g} along a cosine"
        return (
            f"recipe {self.name}: {self.epochs} epochs, batch {self.batch_size}, SGD {self.learning_rate:g} {falls}, "
            f"short side {min_size} px, {'bfloat16' if self.bfloat16 else 'float32'}"
        )


PAPER_VALUES: Final[dict[str, Any]] = {
    # What the paper gives.
    "learning_rate": 0.001,
    "momentum": 0.9,
    "step_size": 3,
    "gamma": 0.2,
    "epochs": 10,
    # What the paper leaves open.
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

# A step on two cores spends its time on pixels, and on the keypoint head: 22 GFLOP a region forward and backward.
_SMALL_NETWORK: Final[dict[str, Any]] = {
    "min_size": None,
    "max_size": None,
    "keypoint_regions": 48,
    "val_fraction": 0.1,
    "val_images": 24,
}

# Random weights need a high rate, which needs a warm-up and bounded gradients; while weights change that fast the
# running means of BatchNorm2d lag behind them and nothing is found: the slower second half mends that.
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
"""Key of a TOML recipe under which it names the recipe that it changes."""


def choose_recipe(name: str, *, gpu: bool, bfloat16: bool) -> Recipe:
    """The recipe that the flag `--recipe` names.

    Args:
        name: One of `RECIPE_CHOICES`, or a TOML file that changes one of them. `auto` is `paper` on a GPU and
            `laptop` on a CPU.
        gpu: Whether the run is on a GPU.
        bfloat16: Whether this processor has instructions for such numbers, which all recipes but `paper` make use of:
            on two cores a step takes half the time. It is part of the recipe that the run records.

    Raises:
        UserError: There is no such recipe, or the file holds unknown names or wrong values.
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
    """The recipe with the values of `--set name=value` flags."""
    return with_values(recipe, with_flag_lists(Recipe, from_flags(flags, "--set")), "--set ")
