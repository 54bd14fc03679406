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
"""Presets that have views, jitter and labelled road users by default."""
PHOTOGRAPH_RIGHTS: Final = "what is drawn: {}; the background is the user's photograph, whose rights are as they were"


def card(plan: DatasetPlan, counts: Counts) -> dict[str, Any]:
    """Return the content of dataset.json.

    Args:
        plan: Parameters and recordings of the dataset.
        counts: Counts of images and vehicles in the whole dataset.
    """
    parameters, variation = plan.parameters, plan.parameters.variation
    user_site, solid = parameters.own, parameters.renderer == "pybullet"
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
        "licence": PHOTOGRAPH_RIGHTS.format(parameters.licence)
        if user_site and user_site.photograph
        else parameters.licence,
    }


def command(p: Parameters) -> str:
    """Return the command that reproduces the dataset."""
    variation, counts = p.variation, set(p.frames.values())
    parts = [f"skope gen --preset {p.preset} --seed {p.seed}"]
    parts.append(f"--site {p.own.file}" if p.own else f"--sites {','.join(p.sites)}")
    if len(counts) == 1:  # otherwise they are the preset's
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
    """Return the rules of the labels in words."""
    by_rule = {
        "others": "ignored (occluded) if other objects hide more than half of its keypoints inside the image",
        "paper": "removed if more than half of its 33 keypoints are hidden, by itself or by other objects",
    }[rules.occlusion]
    return [
        "v = 2: visible; v = 1: inside the image but hidden by the vehicle itself or by another object; "
        "v = 0: outside the image, x = y = 0.",
        f"A keypoint is hidden if it is more than {visibility.VISIBILITY_TOLERANCES.point_m} m behind the "
        f"surface that "
        f"the four pixels around it show, after an allowance for the slope of that surface (at most "
        f"{visibility.VISIBILITY_TOLERANCES.slope_m} m). If "
        "the pixels disagree, it is hidden if a road user's shape is in front of it on its own ray, if its own "
        "pixel shows scenery in front of it, or if all four pixels show something in front, at least one scenery.",
        f"A vehicle is {by_rule} (tolerance {visibility.VISIBILITY_TOLERANCES.vehicle_m} m).",
        "A vehicle without a visible pixel has no annotation.",
        f"Ignored (iscrowd = 1): sliver, less than {rules.min_visible:.0%} of its silhouette is visible inside the "
        f"image; small, the shorter edge of its box is under {rules.min_box:g} px or it has fewer than "
        f"{LABEL_LIMITS.pixels} visible pixels; unseen, its contrast is under {LABEL_LIMITS.contrast:g}.",
        f"Keypoints are localised by {rules.localizer}; wheel centres are those of the simulated wheels.",
    ]


def road_user_rules() -> list[str]:
    """Return the rules of the labels of pedestrians and two-wheelers in words."""
    return [
        "Bicycles, motorcycles (each with its rider, passengers and load) and pedestrians are categories of their own, "
        "without keypoints: v = 0 in all 33.",
        "The same rules decide which of them are ignored. Without keypoints, they are occluded if other objects hide "
        "more than half of the pixels of their silhouette inside the image.",
    ]


def write_card(root: Path, content: Mapping[str, Any]) -> None:
    """Write the card of the dataset at `root` after its manifest; dataset.json comes last and completes the dataset."""
    sums = read_manifest(root)["sha256"]
    write_text(root / "README.md", readme(content))
    write_json(root / CROISSANT_FILE, croissant(content, sums))
    write_json(root / CARD_FILE, content)


def readme(content: Mapping[str, Any]) -> str:
    """Return the card as the text of README.md."""
    return card_text.markdown(content)
