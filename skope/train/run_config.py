"""Configuration of a run: everything that determines its result, as recorded in `recipe.json` in its folder."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

from skope import keypoints
from skope.dataset.folder import Dataset
from skope.errors import UserError
from skope.files.json_files import read_json, write_json
from skope.keypoints import Scheme
from skope.schema import checked_categories
from skope.train.recipe import Recipe

_RUN_VERSION = 2
CONFIG_FILE = "recipe.json"


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """Everything that determines the result of a run."""

    recipe: Recipe
    seed: int
    data: tuple[str, ...]
    """Dataset folders."""
    mix: float | None
    """Share of an epoch's images from the first dataset; None: all images of all datasets once."""
    max_images: int | None
    scheme: Scheme = keypoints.SKOPE33
    """Keypoint scheme of the datasets."""
    licences: tuple[str, ...] = ()
    """Licences of the datasets, in their order, as stated on their cards."""
    categories: tuple[str, ...] | None = None
    """Names of the classes to train; None: all classes of the datasets."""

    def of(self, datasets: Sequence[Dataset], scheme: Scheme, categories: tuple[str, ...]) -> Self:
        """Return the configuration completed with the properties of the datasets.

        Images are not mirrored if the mirror partners of the scheme's keypoints are not known.
        """
        recipe = self.recipe
        if scheme.flip is None:
            recipe = replace(recipe, augment=replace(recipe.augment, flip=0.0))
        licences = tuple(d.licence for d in datasets)
        return replace(self, recipe=recipe, scheme=scheme, licences=licences, categories=categories)

    @property
    def detector_categories(self) -> tuple[str, ...]:
        """Categories of the trained detector; known once `of` has completed the configuration."""
        assert self.categories is not None
        return self.categories

    def to_dict(self) -> dict[str, Any]:
        return {
            "version": _RUN_VERSION,
            "scheme": self.scheme.name,
            "recipe": self.recipe.to_dict(),
            "seed": self.seed,
            "data": list(self.data),
            "mix": self.mix,
            "max_images": self.max_images,
            "licences": list(self.licences),
            "categories": list(self.detector_categories),
        }

    @classmethod
    def read(cls, run: Path) -> Self:
        """Return the configuration that a run folder records."""
        values = read_json(run / CONFIG_FILE)
        try:
            if not isinstance(values, dict) or values.get("version") != _RUN_VERSION:
                raise UserError(f"version: expected {_RUN_VERSION}")
            names = ("seed", "mix", "max_images")
            recipe, data = Recipe.from_dict(values["recipe"]), tuple(values["data"])
            categories = checked_categories(values["categories"])
            return cls(recipe=recipe, data=data, categories=categories, **{name: values[name] for name in names})
        except KeyError as error:
            raise UserError(f"{run / CONFIG_FILE}: field {error.args[0]} is missing") from None
        except UserError as error:
            raise UserError(f"{run / CONFIG_FILE}: {error}") from None


def record_config(run: Path, config: RunConfig) -> None:
    """Write the configuration of a run into its folder."""
    write_json(run / CONFIG_FILE, config.to_dict())
