"""A dataset's card: dataset.json for programs and README.md for people."""

from typing import Any

from skope import keypoints, schema
from skope.depth import DEPTH_SCALE
from skope.gen import annotate
from skope.gen.plan import Parameters
from skope.gen.store import Counts
from skope.gen.vehicles import fleet

LICENCE = "CC0 1.0: the images are drawn by this program from shapes of its own; do with them what you like."

PHOTOGRAPH = "What is drawn is CC0 1.0; the background is the user's photograph, whose rights are as they were."


def card(parameters: Parameters, counts: Counts, localizer_difference: dict[str, float | None]) -> dict[str, Any]:
    """What dataset.json holds."""
    values = parameters.to_dict()
    return {
        "version": schema.VERSION,
        "keypoint_scheme": keypoints.SCHEME,
        "seed": parameters.seed,
        "command": command(parameters),
        "counts": counts.to_dict(),
        "label_rules": label_rules(parameters),
        "occlusion_rules": {
            "vehicles": counts.tally["vehicles"],
            "taken_by_others": counts.tally["occluded_others"],
            "taken_by_paper": counts.tally["occluded_paper"],
        },
        "localizer_difference_m": localizer_difference,
        "fleet": {
            "held_out": sorted(name for name, entry in fleet().items() if entry.held_out),
            "substituted": {
                name: list(entry.vehicle.substituted) for name, entry in fleet().items() if entry.vehicle.substituted
            },
        },
        "depth": f"16-bit PNG, metres = value / {DEPTH_SCALE:.0f}, 0 = sky, 65535 = 255.99 m or farther",
        "renderer": parameters.renderer,
        "foliage": "solid in depth and visibility" if parameters.renderer == "pybullet" else "cut out leaf by leaf",
        "versions": values["versions"],
        "parameters": values,
        "licence": PHOTOGRAPH if parameters.own and parameters.own.place.photograph else LICENCE,
    }


def command(parameters: Parameters) -> str:
    """The command that makes the same dataset again."""
    p = parameters
    same = len(counts := set(p.frames.values())) == 1
    frames = f" --frames {counts.pop()}" if same else ""  # else they are the preset's
    sites = f"--site {p.own.path.name}" if p.own else f"--sites {','.join(p.sites)}"
    fov = "" if p.own else f" --fov {p.fov_deg}"
    return (
        f"skope gen --preset {p.preset} --seed {p.seed} {sites}{frames}"
        f" --interval {p.interval_s} --size {p.size}{fov} --renderer {p.renderer}"
        f" --localizer {p.rules.localizer} --occlusion-rule {p.rules.occlusion}"
        f" --min-visible {p.rules.min_visible} --min-box {p.rules.min_box}"
        + (f" --vehicles {','.join(p.vehicles)}" if p.vehicles else "")
        + (" --shape-jitter" if p.shape_jitter else "")
        + "".join(f" --set {name}={low}..{high}" for name, (low, high) in p.settings.items())
    )


def label_rules(parameters: Parameters) -> list[str]:
    """The rules behind the labels, in words."""
    rules = parameters.rules
    by_rule = {
        "others": "ignored (occluded) when something else hides more than half of its keypoints inside the image",
        "paper": "removed when more than half of its 33 keypoints are hidden, by itself or by anything else",
    }[rules.occlusion]
    return [
        "v = 2: visible; v = 1: inside the image but hidden by the vehicle itself or by something else; "
        "v = 0: outside the image, x = y = 0.",
        f"A keypoint is hidden when it lies more than {annotate.POINT_TOLERANCE} m behind the surface that the four "
        f"pixels around it show, after allowing for that surface's slope (at most {annotate.SLOPE_CAP} m); where they "
        "disagree, when a vehicle's own shape stands before it on its own ray, or its own pixel shows something else.",
        f"A vehicle is {by_rule} (tolerance {annotate.VEHICLE_TOLERANCE} m).",
        "A vehicle without a visible pixel has no annotation.",
        f"Ignored (iscrowd = 1): sliver, less than {rules.min_visible:.0%} of its silhouette unhidden and inside the "
        f"image; small, shorter edge of its box under {rules.min_box:g} px or fewer than {annotate.MIN_PIXELS} visible "
        f"pixels; unseen, contrast under {annotate.MIN_CONTRAST:g}.",
        f"Keypoints are localised by {rules.localizer}; wheel centres are the wheels' own.",
    ]


def readme(content: dict[str, Any]) -> str:
    """The card as a page."""
    counts = content["counts"]
    rows = "\n".join(
        f"| {split} | {c.get('images', 0)} | {c.get('ground_truth', 0)} | {c.get('ignored', 0)} |"
        for split, c in counts["by_split"].items()
    )
    difference = content["localizer_difference_m"]
    apart = ", ".join(f"{name} {value:.4f} m" for name, value in difference.items() if value is not None)
    rules = "\n".join(f"- {rule}" for rule in content["label_rules"])
    return f"""# Roadside images with 33 keypoints per vehicle

Made by skope {content["versions"]["skope"]}:

    {content["command"]}

| split | images | vehicles | ignored |
|---|---|---|---|
{rows}

Annotations are COCO keypoints files (`annotations/<split>.json`), depth is {content["depth"]}.

## Label rules

{rules}

Trilateration and the rigid transform are apart by {apart or "nothing: no vehicles"} (keypoints of all recorded frames).

Licence: {content["licence"]}
"""
