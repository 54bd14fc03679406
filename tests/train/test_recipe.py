"""Recipes: the paper's values, the schedule, and the choice."""

import json
from dataclasses import replace

import pytest
import torch

from skope.errors import UserError
from skope.train.augment import Augment
from skope.train.network_shape import NetworkShape
from skope.train.optimizer import learning_rate_at
from skope.train.recipe import SHIPPED_RECIPES, Recipe, TeacherRules, choose_recipe


def test_paper_is_what_the_paper_gives() -> None:
    paper = SHIPPED_RECIPES["paper"]
    assert (paper.learning_rate, paper.momentum, paper.step_size, paper.gamma, paper.epochs) == (0.001, 0.9, 3, 0.2, 10)
    assert (paper.batch_size, paper.weight_decay, paper.min_size, paper.max_size) == (2, 0.0, 800, 1333)
    assert (paper.trainable_layers, paper.regions, paper.keypoint_regions) == (3, 512, None)
    assert paper.augment == Augment(flip=0.5)
    assert not paper.bfloat16


def test_laptop_keeps_the_papers_optimiser_and_schedule() -> None:
    same = ("learning_rate", "momentum", "weight_decay", "step_size", "gamma", "epochs", "batch_size", "warmup_steps")
    assert all(getattr(SHIPPED_RECIPES["laptop"], name) == getattr(SHIPPED_RECIPES["paper"], name) for name in same)


def test_the_rate_is_torchs_step_schedule() -> None:
    paper = SHIPPED_RECIPES["paper"]
    optimizer = torch.optim.SGD([torch.zeros(1, requires_grad=True)], lr=paper.learning_rate)
    schedule = torch.optim.lr_scheduler.StepLR(optimizer, step_size=paper.step_size, gamma=paper.gamma)
    for epoch in range(paper.epochs):
        assert learning_rate_at(paper, epoch * 100, 100) == pytest.approx(schedule.get_last_lr()[0])
        optimizer.step()
        schedule.step()


def test_warm_up_and_a_drop_after_half_of_the_epochs() -> None:
    recipe = replace(
        SHIPPED_RECIPES["scratch"], epochs=5, warmup_steps=10, learning_rate=1.0, gamma=0.2, step_size=None
    )
    assert learning_rate_at(recipe, 0, 20) == pytest.approx(0.1)
    assert learning_rate_at(recipe, 9, 20) == learning_rate_at(recipe, 59, 20) == 1.0
    assert learning_rate_at(recipe, 60, 20) == learning_rate_at(recipe, 99, 20) == pytest.approx(0.2)


def test_a_rate_that_falls_along_a_cosine() -> None:
    recipe = replace(SHIPPED_RECIPES["scratch"], epochs=4, warmup_steps=10, learning_rate=0.8, cosine_to=0.25)
    optimizer = torch.optim.SGD([torch.zeros(1, requires_grad=True)], lr=0.8)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, T_max=100, eta_min=0.2)
    for step in range(100):
        warm = min(1.0, (step + 1) / 10)
        assert learning_rate_at(recipe, step, 25) == pytest.approx(warm * schedule.get_last_lr()[0])
        optimizer.step()
        schedule.step()
    assert "to 0.2 along a cosine" in recipe.describe(360)


def test_choice() -> None:
    assert choose_recipe("auto", gpu=True, bfloat16=True) == SHIPPED_RECIPES["paper"]
    assert choose_recipe("auto", gpu=False, bfloat16=False) == SHIPPED_RECIPES["laptop"]
    assert choose_recipe("scratch", gpu=True, bfloat16=True) == replace(SHIPPED_RECIPES["scratch"], bfloat16=True)
    with pytest.raises(UserError, match="auto, paper, laptop, scratch"):
        choose_recipe("best", gpu=False, bfloat16=False)


def test_recipes_survive_a_round_trip() -> None:
    for recipe in SHIPPED_RECIPES.values():
        assert Recipe.from_dict(recipe.to_dict()) == recipe
    own = replace(
        SHIPPED_RECIPES["scratch"], anchors=(16, 32, 64, 160, 400), ema_decay=0.99, cosine_to=0.05, ignore_below=8.0
    )
    own = replace(own, box_passes=2)
    assert Recipe.from_dict(json.loads(json.dumps(own.to_dict()))) == own
    narrow = replace(own, network=NetworkShape(backbone="resnet18", keypoint_layers=4))
    narrow = replace(narrow, teacher=TeacherRules(checkpoint="road33", temperature=2.0))
    assert Recipe.from_dict(json.loads(json.dumps(narrow.to_dict()))) == narrow
    with pytest.raises(UserError, match=r"recipe\.ema_decay: missing"):
        Recipe.from_dict({name: value for name, value in own.to_dict().items() if name != "ema_decay"})
    with pytest.raises(UserError, match=r"augment.reduce: needs min_size and max_size"):
        replace(SHIPPED_RECIPES["laptop"], augment=Augment(reduce=0.5))
    with pytest.raises(UserError, match="epochs: expected at least 1, got 0"):
        replace(SHIPPED_RECIPES["paper"], epochs=0)
    with pytest.raises(UserError, match=r"anchors: expected 5 rising sides from 4 pixels, got \[16, 32\]"):
        replace(SHIPPED_RECIPES["paper"], anchors=(16, 32))
    with pytest.raises(UserError, match="ema_decay: expected 0 to 1, got 2"):
        replace(SHIPPED_RECIPES["paper"], ema_decay=2.0)
