"""A dataset's card in words: the sections of its README and of its gallery, from what dataset.json says.

Cards of imported datasets say less; what they do not say is left out.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from skope import keypoints
from skope.gen.output.licences import LICENCE_ADDRESSES
from skope.page.templates import Table

Card = Mapping[str, Any]

DATASET_TITLE: Final = "Roadside images with 33 keypoints per vehicle"
LIMITS_HEADING: Final = "Limits"


@dataclass(frozen=True)
class Command:
    """A line for the shell."""

    command: str


@dataclass(frozen=True)
class Section:
    title: str
    blocks: Sequence[str | list[str] | Command | Table]
    """Paragraphs, lists, commands and tables."""


def sections(card: Card) -> list[Section]:
    """The sections of a dataset's README, in the order of reading."""
    parts = [
        Section("What it is for", purposes()),
        Section("How it was made", [*_command(card), made(card), _sources(card)]),
        Section("What the labels mean", [list(card.get("label_rules", [])), *_rules_in_numbers(card)]),
        Section("Balance", _balance(card)),
        Section(LIMITS_HEADING, [limits(card)]),
        Section("People", [people(card)]),
        Section("Licence", [licence(card)]),
    ]
    return [Section(part.title, blocks) for part in parts if (blocks := [block for block in part.blocks if block])]


def card_summary(card: Card) -> str:
    """A dataset in one sentence."""
    counts = card.get("counts", {})
    if "images" not in counts:
        return f"Images of vehicles with 33 keypoints each{_scheme(card)}."
    size, sites = card.get("parameters", {}).get("size"), len(counts.get("by_site", {}))
    ignored = sum(counts.get("ignored", {}).values())
    others = [f", {row['ground_truth']} {name}s" for name, row in _by_category(card).items()]
    besides = f", and {ignored} more that are marked as ignored" if ignored else ""
    return (
        f"{counts['images']} images{f' of {size} pixels' if size else ''}"
        f"{f' from {sites} camera site' + ('s' if sites > 1 else '') if sites else ''} with "
        f"{counts['ground_truth']} vehicles of 33 keypoints each{_scheme(card)}{''.join(others)}{besides}."
    )


def _by_category(card: Card) -> dict[str, Mapping[str, int]]:
    """Counts of each category without keypoints that a dataset labels."""
    told = card.get("counts", {}).get("by_category", {})
    return {name: told.get(name, {"ground_truth": 0, "ignored": 0}) for name in card.get("categories", ())[1:]}


def _scheme(card: Card) -> str:
    """The name of the keypoint scheme in brackets, where it is not `skope33`."""
    scheme = card.get("keypoint_scheme")
    return f" (scheme {scheme})" if scheme != keypoints.SCHEME else ""


def purposes() -> list[str]:
    """Purposes of a dataset."""
    return [
        "Training and measuring detectors of vehicle keypoints for fixed roadside cameras, and developing what builds "
        "on keypoints: position, heading, size and speed of vehicles from one camera. Where there are masks, 3D boxes, "
        "depth and track numbers, it serves segmentation, monocular 3D detection and tracking too.",
    ]


def _command(card: Card) -> list[Command]:
    return [Command(card["command"])] if "command" in card else []


def _sources(card: Card) -> list[str]:
    """The datasets that a joined one was joined from."""
    return [
        f"{of['name']} ({of['licence']})" + (f": `{of['command']}`" if of.get("command") else "")
        for of in card.get("sources", ())
    ]


def made(card: Card) -> list[str]:
    """Origin of a dataset that `skope gen` made."""
    values, versions = card.get("parameters", {}), card.get("versions", {})
    if not values:
        return []
    own, fleet = values.get("own"), card.get("fleet", {})
    if own:
        place = (
            f"of the site file {own['file']}, {'on a photograph of the empty road' if own['photograph'] else 'drawn'}"
        )
    else:
        place = "of sites in seven invented towns (`skope gen sites` lists them)"
    return [
        "Everything is simulated and drawn; nobody labelled anything by hand, and the same command gives the same "
        f"labels again (seed {card.get('seed')}).",
        f"Traffic is SUMO's, past cameras {place}; vehicles are bodies with sprung wheels in pybullet, and their "
        "keypoints come from where those bodies are.",
        f"Pictures are drawn by the renderer `{card.get('renderer')}`, with weather, light, exposure, noise and lens "
        "of each recording's own; visibility is told from the depth and instance images of the same frame.",
        *_asked(values),
        *(
            [f"Models that only test sites show: {', '.join(fleet['held_out'])}."]
            if fleet.get("held_out") and not own
            else []
        ),
        f"Versions: {', '.join(f'{name} {version}' for name, version in versions.items())}.",
    ]


def _asked(values: Mapping[str, Any]) -> list[str]:
    """Light and traffic that were asked for, where they were."""
    said = [
        f"{what} is never another than {' or '.join(names)}, which was asked for."
        for what, names in (("The weather", values.get("weather")), ("The time of day", values.get("time_of_day")))
        if names
    ]
    share = values.get("vehicle_share")
    if share:
        said.append(
            f"Of the traffic {share:.0%} is of the models that were asked for: {', '.join(values['vehicles'])}."
        )
    return said


def _rules_in_numbers(card: Card) -> list[str]:
    taken, apart = card.get("occlusion_rules", {}), card.get("localizer_difference_m", {})
    known = [f"{name} {value:.4f} m" for name, value in apart.items() if value is not None]
    said = []
    if taken:
        said.append(
            f"Of {taken['vehicles']} vehicles the occlusion rule `others` takes {taken['taken_by_others']}, the rule "
            f"`paper` {taken['taken_by_paper']}."
        )
    if known:
        said.append(f"Trilateration and the rigid transform are apart by {', '.join(known)} over their keypoints.")
    return said


def _balance(card: Card) -> list[Table]:
    counts = card.get("counts", {})
    tables = []
    for key, title in (("split", "Split"), ("weather", "Weather"), ("vehicle_type", "Vehicle type"), ("site", "Site")):
        groups: Mapping[str, Mapping[str, int]] = counts.get(f"by_{key}", {})
        if not groups:
            continue
        columns = [name for name in ("images", "ground_truth", "ignored") if name in next(iter(groups.values()))]
        total = sum(group.get("ground_truth", 0) for group in groups.values())
        names = list(groups)
        if key in ("weather", "vehicle_type"):
            names.sort(key=lambda name: -groups[name].get("ground_truth", 0))
        rows = [
            [
                name,
                *(str(groups[name].get(column, 0)) for column in columns),
                f"{groups[name].get('ground_truth', 0) / total:.1%}" if total else "-",
            ]
            for name in names
        ]
        heads = {"ground_truth": "vehicles"}
        head = [key.replace("_", " "), *(heads.get(c, c) for c in columns), "of vehicles"]
        tables.append(Table(caption=title, head=head, rows=rows, sortable=True))
    if others := _by_category(card):
        rows = [[name, str(row["ground_truth"]), str(row["ignored"])] for name, row in others.items()]
        tables.append(
            Table(caption="Other road users", head=["category", "ground_truth", "ignored"], rows=rows, sortable=True)
        )
    return tables


def limits(card: Card) -> list[str]:
    """Limits that a user must know before relying on a dataset."""
    fleet, depth = card.get("fleet", {}), card.get("depth", "")
    said = [
        "Not validated for safety or enforcement: neither this dataset nor a detector trained on it has been validated "
        "for functions on which safety depends, or for measuring and prosecuting offences.",
    ]
    if not card.get("parameters"):
        return said
    said += [
        "The pictures are drawn. A detector trained on them alone finds less in photographs: measure it on labelled "
        "footage of the road where it is to work, and fine-tune it there.",
        _left_unlabelled(card),
        "Hidden keypoints (v = 1) are exact although nobody could see them: labels by hand of photographs are not.",
    ]
    if fleet.get("substituted"):
        said.append(
            "A body without a part has its keypoint at the nearest equivalent: "
            + "; ".join(f"{name} ({len(points)})" for name, points in fleet["substituted"].items())
            + " (dataset.json names them)."
        )
    if depth and depth != "none":
        said.append("Depth files end at 255.99 m.")
    return said


def _left_unlabelled(card: Card) -> str:
    if len(card.get("categories", ())) > 1:
        return (
            "Only motor vehicles with four or more wheels have keypoints. Bicycles and motorcycles (with whoever rides "
            "them) and pedestrians are categories of their own, with boxes and masks; of a truck with a trailer the "
            "tractor is labelled. People in vehicles have no labels, nor have parked bicycles and motorcycles."
        )
    return (
        "Only motor vehicles with four or more wheels are labelled. Pedestrians, bicycles and motorcycles may stand "
        "before them and have no labels; of a truck with a trailer the tractor is labelled."
    )


def people(card: Card) -> str:
    """Statement on persons in a dataset."""
    values = card.get("parameters")
    if not values:
        return ""
    if (values.get("own") or {}).get("photograph"):
        return (
            "Vehicles, plates and drivers are invented. The background is the user's photograph of a real place: "
            "whoever passes the dataset on answers for whom it shows."
        )
    return "No person, vehicle, plate or place in the pictures is real."


def licence(card: Card) -> str:
    """Licence of a dataset, with the address of a known one."""
    stated = str(card.get("licence", ""))
    return f"{stated} ({LICENCE_ADDRESSES[stated]})" if stated in LICENCE_ADDRESSES else stated


def markdown(card: Card) -> str:
    """A card as README.md."""
    lines = [f"# {DATASET_TITLE}", "", card_summary(card), ""]
    for section in sections(card):
        lines += [f"## {section.title}", ""]
        for block in section.blocks:
            lines += [*_markdown(block), ""]
    return "\n".join(lines)


def _markdown(block: str | list[str] | Command | Table) -> list[str]:
    if isinstance(block, Command):
        return [f"    {block.command}"]
    if isinstance(block, list):
        return [f"- {line}" for line in block]
    if isinstance(block, Table):
        rows = (block.head, ["---"] * len(block.head), *block.rows)
        return ["| " + " | ".join(str(cell).replace("|", "/") for cell in row) + " |" for row in rows]
    return [block]
