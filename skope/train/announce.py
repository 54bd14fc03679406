"""Messages of a training run before it begins."""

from collections.abc import Sequence

from skope.terminal.console import Console, counted
from skope.train.run_config import RunConfig
from skope.train.splits import TrainingSource
from skope.train.training_samples import TrainingSet
from skope.train.training_state import TrainingState


def announce(
    config: RunConfig,
    training: TrainingState,
    training_set: TrainingSet,
    parts: Sequence[TrainingSource],
    where: str,
    console: Console,
) -> None:
    """Say how a run trains, on what, and what is unusual about it.

    Args:
        config: Datasets, recipe and seed.
        training: The state that it begins or goes on with.
        training_set: What is learnt from, of all datasets.
        parts: The datasets, one by one.
        where: Device and processes, in words.
        console: Where it is said.
    """
    recipe = config.recipe
    console.say(f"{recipe.describe(training.config.min_size)}; {training.origin}; seed {config.seed}; {where}")
    if not training.config.stock:
        console.say(f"network: {training.config.architecture}")
    if training.teacher is not None:
        console.say(f"learns from {recipe.teacher.checkpoint} beside the labels")
        theirs, ours = training.teacher.config.keypoint_edition, training.config.keypoint_edition
        if theirs != ours and recipe.teacher.keypoints:
            console.warn(
                f"{recipe.teacher.checkpoint} has learnt keypoints of edition {theirs}, the data holds edition {ours}: "
                "corners of bumpers, hoods and trunks lie elsewhere (--set teacher.keypoints=0 leaves them out)"
            )
    names = " + ".join(config.data)
    if config.scheme.flip is None:
        console.say(f"images are not mirrored: of scheme {config.scheme.name} no mirror partners are known")
    learnt = f"{counted(len(training_set), 'image')} with {counted(training_set.vehicles, 'vehicle')} to learn from"
    kept = [part.validated for part in parts]
    images, vehicles = sum(len(file.images) for file in kept), sum(not a.ignored for f in kept for a in f.annotations)
    checked = f"{counted(images, 'image')} with {counted(vehicles, 'vehicle')}" if images else "none"
    console.say(f"{names}: {learnt}, {checked} to validate on")
    if len(config.detector_categories) > 1:
        learnt = f"{counted(training_set.road_users, 'other road user')} to learn from"
        console.say(f"categories {', '.join(config.detector_categories)}: {learnt}; keypoints of vehicles alone")
    for part in parts if recipe.exclude_types else ():
        types = ", ".join(recipe.exclude_types)
        console.say(f"{part.dataset.root}: {counted(part.excluded, 'vehicle')} left out by type ({types})")
        if part.untyped:
            console.warn(
                f"{part.dataset.root}: does not say the type of {counted(part.untyped, 'vehicle')}: they are learnt, "
                f"whether {types} or not"
            )
    if training.epochs_done or training.steps_done:
        within = f" and {training.steps_done} steps" if training.steps_done else ""
        console.say(f"resumed after epoch {training.epochs_done}{within}")
    elif training.config.norm == "batch" and recipe.learning_rate < 0.01 and "random" in training.origin:
        console.say(f"recipe {recipe.name} fine-tunes trained weights; `--recipe scratch` is made for random ones")
