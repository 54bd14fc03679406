"""Values of a recipe from TOML files and flags."""

from pathlib import Path

import pytest

from skope.errors import UserError
from skope.train.recipe import SHIPPED_RECIPES, adjusted_recipe, choose_recipe


def test_every_value_of_a_recipe_can_be_set() -> None:
    for text in ("16,32,64,160,400", "[16, 32, 64, 160, 400]", " 16, 32,64,160,400"):
        assert adjusted_recipe(SHIPPED_RECIPES["paper"], [f"anchors={text}"]).anchors == (16, 32, 64, 160, 400)
    flags = ["learning_rate=1", "step_size=none", "augment.blur=0.25", "exclude_types=pickup, bus", "bfloat16=true"]
    recipe = adjusted_recipe(SHIPPED_RECIPES["paper"], [*flags, "init=a/b.pth", "name='mine'", "keypoint_regions=8"])
    assert (recipe.learning_rate, recipe.step_size, recipe.augment.blur) == (1.0, None, 0.25)
    assert (recipe.exclude_types, recipe.bfloat16, recipe.init) == (("pickup", "bus"), True, "a/b.pth")
    assert (recipe.name, recipe.keypoint_regions) == ("mine", 8)
    assert recipe.augment.flip == 0.5
    for name, value in SHIPPED_RECIPES["scratch"].to_dict().items():
        if name not in ("augment", "network", "teacher"):
            text = "none" if value is None else repr(value).lower() if isinstance(value, bool) else repr(value)
            assert getattr(adjusted_recipe(SHIPPED_RECIPES["scratch"], [f"{name}={text}"]), name) == getattr(
                SHIPPED_RECIPES["scratch"], name
            )


@pytest.mark.parametrize(
    ("flag", "words"),
    [
        ("epochs", "--set epochs: expected name=value"),
        ("epoch=3", "--set epoch: unknown field; did you mean epochs?"),
        ("epochs=three", "--set epochs: expected a whole number, got 'three'"),
        ("epochs=2.5", "--set epochs: expected a whole number, got 2.5"),
        ("epochs=0", "--set epochs: expected at least 1, got 0"),
        ("bfloat16=1", "--set bfloat16: expected true or false, got 1"),
        ("augment=0.1", "--set augment: expected an object, got 0.1"),
        ("augment.blur=2", "--set augment.blur: expected a probability from 0 to 1, got 2.0"),
        ("exclude_types=car", "--set exclude_types: 'car' is not one of"),
        ("anchors=16,big", "--set anchors[1]: expected a whole number, got 'big'"),
        ("anchors=[16, 3.5]", "--set anchors[1]: expected a whole number, got 3.5"),
        ("momentum=2", "--set momentum: expected 0 to 1, got 2"),
        ("learning_rate=-1", "--set learning_rate: expected at least 0, got -1"),
    ],
)
def test_mistakes_name_the_value(flag: str, words: str) -> None:
    with pytest.raises(UserError) as caught:
        adjusted_recipe(SHIPPED_RECIPES["paper"], [flag])
    assert str(caught.value).startswith(words)


def test_a_recipe_of_ones_own(tmp_path: Path) -> None:
    path = tmp_path / "night.toml"
    path.write_text('base = "scratch"\nepochs = 3\nexclude_types = ["bus"]\n[augment]\nbrightness = 0.5\n')
    recipe = choose_recipe(str(path), gpu=False, bfloat16=True)
    assert (recipe.name, recipe.epochs, recipe.exclude_types) == ("night", 3, ("bus",))
    assert recipe.augment.brightness == 0.5
    assert recipe.learning_rate == SHIPPED_RECIPES["scratch"].learning_rate
    assert recipe.bfloat16
    for text, words in [
        ("epochs = ", "night.toml: not valid TOML"),
        ("base = 'x'", "night.toml: base: 'x' is not one of auto, paper"),
        ("[augment]\nblurr = 1", "night.toml: augment.blurr: unknown field; did you mean blur?"),
    ]:
        path.write_text(text)
        with pytest.raises(UserError, match=words):
            choose_recipe(str(path), gpu=False, bfloat16=True)
    with pytest.raises(UserError, match="no such file"):
        choose_recipe(str(tmp_path / "none.toml"), gpu=False, bfloat16=True)
