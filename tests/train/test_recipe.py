"""Recipes: the paper's values, the schedule, and the choice."""

from dataclasses import replace

import pytest
import torch

from skope.errors import UserError
from skope.train.augment import Augment
from skope.train.recipe import RECIPES, Recipe, choose


def test_paper_is_what_the_paper_gives() -> None:
    paper = RECIPES["paper"]
    assert (paper.learning_rate, paper.momentum, paper.step_size, paper.gamma, paper.epochs) == (0.001, 0.9, 3, 0.2, 10)
    assert (paper.batch_size, paper.weight_decay, paper.min_size, paper.max_size) == (2, 0.0, 800, 1333)
    assert (paper.trainable_layers, paper.regions, paper.keypoint_regions) == (3, 512, None)
    assert paper.augment == Augment(flip=0.5)
    assert not paper.bfloat16


def test_laptop_keeps_the_papers_optimiser_and_schedule() -> None:
    same = ("learning_rate", "momentum", "weight_decay", "step_size", "gamma", "epochs", "batch_size", "warmup_steps")
    assert all(getattr(RECIPES["laptop"], name) == getattr(RECIPES["paper"], name) for name in same)


def test_the_rate_is_torchs_step_schedule() -> None:
    paper = RECIPES["paper"]
    optimizer = torch.optim.SGD([torch.zeros(1, requires_grad=True)], lr=paper.learning_rate)
    schedule = torch.optim.lr_scheduler.StepLR(optimizer, step_size=paper.step_size, gamma=paper.gamma)
    for epoch in range(paper.epochs):
        assert paper.rate(epoch, epoch * 100) == pytest.approx(schedule.get_last_lr()[0])
        optimizer.step()
        schedule.step()


def test_warm_up_and_a_drop_after_half_of_the_epochs() -> None:
    recipe = replace(RECIPES["scratch"], epochs=5, warmup_steps=10, learning_rate=1.0, gamma=0.2, step_size=None)
    assert recipe.rate(0, 0) == pytest.approx(0.1)
    assert recipe.rate(0, 9) == recipe.rate(2, 50) == 1.0
    assert recipe.rate(3, 60) == recipe.rate(4, 90) == pytest.approx(0.2)


def test_choice() -> None:
    assert choose("auto", gpu=True, bfloat16=True) == RECIPES["paper"]
    assert choose("auto", gpu=False, bfloat16=False) == RECIPES["laptop"]
    assert choose("scratch", gpu=True, bfloat16=True) == replace(RECIPES["scratch"], bfloat16=True)
    with pytest.raises(UserError, match="auto, paper, laptop, scratch"):
        choose("best", gpu=False, bfloat16=False)


def test_recipes_survive_a_round_trip() -> None:
    for recipe in RECIPES.values():
        assert Recipe.from_dict(recipe.to_dict()) == recipe
    with pytest.raises(UserError, match="recipe: expected the fields"):
        Recipe.from_dict({"name": "x"})
    with pytest.raises(UserError, match="epochs: expected at least 1, got 0"):
        replace(RECIPES["paper"], epochs=0)
