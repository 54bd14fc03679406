"""A dataset's card: dataset.json for programs, README.md for people and croissant.json for catalogues."""

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from skope import keypoints, schema
from skope.dataset.depth_files import DEPTH_CODING
from skope.dataset.folder import CARD_FILE, read_manifest
from skope.files.atomic import write_text
from skope.files.json_files import write_json
from skope.gen.labels import visibility
from skope.gen.labels.ignore_rules import LABEL_LIMITS, Rules
from skope.gen.output import card_text, licences
from skope.gen.output.croissant import croissant
from skope.gen.output.frames import Encoding
from skope.gen.output.parameters import DatasetPlan, Parameters
from skope.gen.output.writers import Counts, categories_field
from skope.gen.vehicles.fleet import fleet

CROISSANT_FILE: Final = "croissant.json"
VARIED_PRESETS: Final = ("world", "nights", "conditions")
"""Presets that have views, jitter and labelled road users unless they are told otherwise."""
PHOTOGRAPH_RIGHTS: Final = "what is drawn: {}; the background is the user's photograph, whose rights are as they were"


def card(plan: DatasetPlan, counts: Counts) -> dict[str, Any]:
    """The content of dataset.json.

    Args:
        plan: Parameters and recordings of the dataset.
        counts: Images and vehicles of the whole dataset.
    """
    parameters, variation = plan.parameters, plan.parameters.variation
    own, solid = parameters.own, parameters.renderer == "pybullet"
    asked = {name: fleet()[name] for name in parameters.vehicles if name in fleet()}
    models = {**fleet(further=variation.further_models), **asked}
    return {
        "version": schema.SCHEMA_VERSION,
        **keypoints.SKOPE33.fields(),
        **categories_field(parameters.categories),
        "format": parameters.format,
        "seed": parameters.seed,
        "command": command(parameters),
        "counts": counts.to_dict(),
        "label_rules": [*label_rules(parameters.rules), *(road_user_rules() if variation.road_users else [])],
        "occlusion_rules": {
            "vehicles": counts.tally["vehicles"],
            "taken_by_others": counts.tally["occluded_others"],
            "taken_by_paper": counts.tally["occluded_paper"],
        },
        "localizer_difference_m": counts.localizer_difference(),
        "depth": f"16-bit PNG, metres = value / {DEPTH_CODING.scale:.0f}, 0 = sky, 65535 = 255.99 m or farther"
        if parameters.encoding.depth
        else "none",
        "renderer": parameters.renderer,
        "foliage": "solid in depth and visibility" if solid else "cut out leaf by leaf",
        "fleet": {
            "held_out": sorted(name for name, entry in models.items() if entry.held_out),
            "substituted": {
                name: list(entry.vehicle.substituted) for name, entry in models.items() if entry.vehicle.substituted
            },
        },
        "versions": dict(parameters.versions),
        **plan.to_dict(),
        "licence": PHOTOGRAPH_RIGHTS.format(parameters.licence) if own and own.photograph else parameters.licence,
    }


def command(p: Parameters) -> str:
    """The command that makes the same dataset again."""
    variation, counts = p.variation, set(p.frames.values())
    parts = [f"skope gen --preset {p.preset} --seed {p.seed}"]
    parts.append(f"--site {p.own.file}" if p.own else f"--sites {','.join(p.sites)}")
    if len(counts) == 1:  # else they are the preset's
        parts.append(f"--frames {counts.pop()}")
    parts.append(f"--recordings {p.recordings} --interval {p.interval_s} --size {p.size}")
    if not p.own:
        parts.append(f"--fov {p.fov_deg}")
    parts.append(f"--renderer {p.renderer} --localizer {p.rules.localizer} --occlusion-rule {p.rules.occlusion}")
    parts.append(f"--min-visible {p.rules.min_visible} --min-box {p.rules.min_box}")
    if p.encoding != Encoding():
        parts.append(f"--image-format {p.encoding.image} --quality {p.encoding.quality}")
        parts += [] if p.encoding.depth else ["--no-depth"]
    parts += [f"--format {p.format}"] if p.format != "folder" else []
    parts += [f"--weather {','.join(p.weather)}"] if p.weather else []
    parts += [f"--time-of-day {','.join(p.time_of_day)}"] if p.time_of_day else []
    parts += [f"--vehicles {','.join(p.vehicles)}"] if p.vehicles else []
    parts += [f"--share {p.vehicle_share}"] if p.vehicle_share else []
    if p.preset in VARIED_PRESETS:
        parts += [
            f"--views {variation.views}",
            _switch("town-jitter", variation.town_jitter),
            _switch("shape-jitter", variation.shape_jitter),
        ]
        parts += [] if variation.road_users else ["--no-road-users"]
    else:
        parts += ["--shape-jitter"] if variation.shape_jitter else []
        parts += [f"--views {variation.views}"] if variation.views else []
        parts += ["--town-jitter"] if variation.town_jitter else []
        parts += ["--road-users"] if variation.road_users else []
    parts += ["--camera-jitter"] if "zoom_by" in variation.cameras else []
    parts += [f"--licence {shlex.quote(p.licence)}"] if p.licence != licences.DEFAULT_LICENCE else []
    settings = [f"--set {name}={low:.12g}..{high:.12g}" for name, (low, high) in variation.settings.items()]
    return " ".join([*parts, *settings])


def _switch(name: str, on: bool) -> str:
    return f"--{name}" if on else f"--no-{name}"


def label_rules(rules: Rules) -> list[str]:
    """The rules behind the labels, in words."""
    by_rule = {
        "others": "ignored (occluded) when something else hides more than half of its keypoints inside the image",
        "paper": "removed when more than half of its 33 keypoints are hidden, by itself or by anything else",
    }[rules.occlusion]
    return [
        "v = 2: visible; v = 1: inside the image but hidden by the vehicle itself or by something else; "
        "v = 0: outside the image, x = y = 0.",
        f"A keypoint is hidden when it lies more than {visibility.VISIBILITY_TOLERANCES.point_m} m behind the "
        f"surface that "
        f"the four pixels around it show, after allowing for that surface's slope (at most "
        f"{visibility.VISIBILITY_TOLERANCES.slope_m} m); where "
        "they disagree, when a vehicle's own shape stands before it on its own ray, or its own pixel shows something "
        "else.",
        f"A vehicle is {by_rule} (tolerance {visibility.VISIBILITY_TOLERANCES.vehicle_m} m).",
        "A vehicle without a visible pixel has no annotation.",
        f"Ignored (iscrowd = 1): sliver, less than {rules.min_visible:.0%} of its silhouette unhidden and inside the "
        f"image; small, shorter edge of its box under {rules.min_box:g} px or fewer than "
        f"{LABEL_LIMITS.pixels} visible pixels; unseen, contrast under {LABEL_LIMITS.contrast:g}.",
        f"Keypoints are localised by {rules.localizer}; wheel centres are the wheels' own.",
    ]


def road_user_rules() -> list[str]:
    """The rules behind the labels of people on foot and on two wheels, in words."""
    return [
        "Bicycles, motorcycles (each with its rider, passengers and load) and pedestrians are categories of their own, "
        "without keypoints: v = 0 in all 33.",
        "They are ignored by the same rules; as they have no keypoints, they are occluded when something else hides "
        "more than half of the pixels that their silhouette has inside the image.",
    ]


def write_card(root: Path, content: Mapping[str, Any]) -> None:
    """Write the card of the dataset at `root`, whose manifest is there; dataset.json makes it one and comes last."""
    sums = read_manifest(root)["sha256"]
    write_text(root / "README.md", readme(content))
    write_json(root / CROISSANT_FILE, croissant(content, sums))
    write_json(root / CARD_FILE, content)


def readme(content: Mapping[str, Any]) -> str:
    """The card as a page."""
    return card_text.markdown(content)
