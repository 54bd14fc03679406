"""A dataset's card in words: the sections of its README and gallery, from dataset.json.

Cards of imported datasets contain less; missing information is left out.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from skope import keypoints
from skope.gen.output.licences import LICENCE_ADDRESSES
from skope.page.templates import Table
from skope.terminal.console import counted

Card = Mapping[str, Any]

DATASET_TITLE: Final = "Roadside images with 33 keypoints per vehicle"
LIMITS_HEADING: Final = "Limits"
READ_BY_TORCHVISION: Final = """from torchvision.datasets import CocoDetection

{split} = CocoDetection(".", "annotations/{split}.json")
image, labels = {split}[0]"""
READ_BY_FIFTYONE: Final = """import fiftyone as fo

{split} = fo.Dataset.from_dir(
    dataset_type=fo.types.COCODetectionDataset,
    data_path=".",
    labels_path="annotations/{split}.json",
    label_types=["detections", "keypoints"],
)"""
READ_BY_DATASETS: Final = """from datasets import load_dataset

{split} = load_dataset("webdataset", data_files={{"{split}": "shards/{split}-*.tar"}}, split="{split}")
image, labels = {split}[0]["jpg"], {split}[0]["json"]"""
HUB_SIZES: Final = ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"), (1_000_000, "100K<n<1M"))
"""Numbers of images below which the classes of Hugging Face's hub apply."""


@dataclass(frozen=True)
class Command:
    """Lines of a command or program."""

    command: str


@dataclass(frozen=True)
class Section:
    title: str
    blocks: Sequence[str | list[str] | Command | Table]
    """Paragraphs, lists, commands and tables of the section."""


def sections(card: Card) -> list[Section]:
    """Return the sections of a dataset's README in reading order."""
    parts = [
        Section("What it is for", purposes()),
        Section("How to read it", reading(card)),
        Section("How it was made", [*_command(card), made(card), _sources(card)]),
        Section("What the labels mean", [list(card.get("label_rules", [])), *_rules_in_numbers(card)]),
        Section("Balance", _balance(card)),
        Section(LIMITS_HEADING, [limits(card)]),
        Section("People", [people(card)]),
        Section("Licence", [licence(card)]),
    ]
    return [Section(part.title, blocks) for part in parts if (blocks := [block for block in part.blocks if block])]


def card_summary(card: Card) -> str:
    """Return a one-sentence summary of a dataset."""
    counts = card.get("counts", {})
    if "images" not in counts:
        return f"Images of vehicles with 33 keypoints each{_scheme(card)}."
    size, sites = card.get("parameters", {}).get("size"), len(counts.get("by_site", {}))
    ignored = sum(counts.get("ignored", {}).values())
    category_texts = [f", {counted(row['ground_truth'], name)}" for name, row in _by_category(card).items()]
    ignored_text = f", and {ignored} more that are marked as ignored" if ignored else ""
    return (
        f"{counted(counts['images'], 'image')}{f' of {size} pixels' if size else ''}"
        f"{f' from {sites} camera site' + ('s' if sites > 1 else '') if sites else ''} with "
        f"{counted(counts['ground_truth'], 'vehicle')} of 33 keypoints each{_scheme(card)}"
        f"{''.join(category_texts)}{ignored_text}."
    )


def _by_category(card: Card) -> dict[str, Mapping[str, int]]:
    """Return the counts of each labelled category without keypoints."""
    stated = card.get("counts", {}).get("by_category", {})
    return {name: stated.get(name, {"ground_truth": 0, "ignored": 0}) for name in card.get("categories", ())[1:]}


def _scheme(card: Card) -> str:
    """Return the name of the keypoint scheme in brackets, unless it is `skope33`."""
    scheme = card.get("keypoint_scheme")
    return f" (scheme {scheme})" if scheme != keypoints.SCHEME else ""


def purposes() -> list[str]:
    """Return the purposes of a dataset."""
    return [
        "Training and evaluating detectors of vehicle keypoints for fixed roadside cameras, and developing methods "
        "that use keypoints: position, heading, size and speed of vehicles from one camera. With masks, 3D boxes, "
        "depth and track numbers, it also serves segmentation, monocular 3D detection and tracking.",
    ]


def reading(card: Card) -> list[str | Command]:
    """Return programs that read a dataset, to run in its folder, with other libraries than skope."""
    splits = card.get("counts", {}).get("by_split", {})
    if not splits:
        return []
    split = "train" if "train" in splits else next(iter(splits))
    if card.get("format") == "shards":
        return [
            "Each shard is a tar file with an image and a JSON file of its labels for each sample. With `datasets` of "
            "Hugging Face:",
            Command(READ_BY_DATASETS.format(split=split)),
        ]
    return [
        "Labels are COCO files, one for each split. Paths in them begin at this folder. manifest.json has the SHA-256 "
        "of each file. With torchvision:",
        Command(READ_BY_TORCHVISION.format(split=split)),
        "With FiftyOne:",
        Command(READ_BY_FIFTYONE.format(split=split)),
        "Hugging Face's `datasets` reads the form that `skope gen convert . ../shards --to shards` writes.",
    ]


def _command(card: Card) -> list[Command]:
    return [Command(card["command"])] if "command" in card else []


def _sources(card: Card) -> list[str]:
    """Return the datasets that were merged into this one."""
    return [
        f"{of['name']} ({of['licence']})" + (f": `{of['command']}`" if of.get("command") else "")
        for of in card.get("sources", ())
    ]


def made(card: Card) -> list[str]:
    """Return a description of how `skope gen` made a dataset."""
    values, versions = card.get("parameters", {}), card.get("versions", {})
    if not values:
        return []
    user_site, fleet = values.get("own"), card.get("fleet", {})
    if user_site:
        cameras = (
            f"of the site file {user_site['file']}, "
            f"{'on a photograph of the empty road' if user_site['photograph'] else 'drawn'}"
        )
    else:
        cameras = "of sites in seven invented towns (`skope gen sites` lists them)"
    return [
        "All scenes are simulated and rendered. All labels are computed, and the same command gives the same labels "
        f"again (seed {card.get('seed')}).",
        f"The traffic is simulated by SUMO, past cameras {cameras}. Vehicles are bodies with sprung wheels in "
        "pybullet, and their keypoints follow from the poses of these bodies.",
        f"Images are rendered by `{card.get('renderer')}`; each recording has its own weather, light, exposure, noise "
        "and lens. Visibility is computed from the depth and instance images of the same frame.",
        *_asked(values),
        *(
            [f"Models that appear at test sites only: {', '.join(fleet['held_out'])}."]
            if fleet.get("held_out") and not user_site
            else []
        ),
        f"Versions: {', '.join(f'{name} {version}' for name, version in versions.items())}.",
    ]


def _asked(values: Mapping[str, Any]) -> list[str]:
    """Return sentences on the weather, hours and traffic that the user requested."""
    sentences = [
        f"{subject} is always {' or '.join(names)}, as requested."
        for subject, names in (("The weather", values.get("weather")), ("The time of day", values.get("time_of_day")))
        if names
    ]
    share = values.get("vehicle_share")
    if share:
        sentences.append(f"{share:.0%} of the traffic is of the requested models: {', '.join(values['vehicles'])}.")
    return sentences


def _rules_in_numbers(card: Card) -> list[str]:
    taken, apart = card.get("occlusion_rules", {}), card.get("localizer_difference_m", {})
    known = [f"{name} {value:.4f} m" for name, value in apart.items() if value is not None]
    sentences = []
    if taken:
        sentences.append(
            f"The occlusion rule `others` applies to {taken['taken_by_others']} of {taken['vehicles']} vehicles, "
            f"the rule `paper` to {taken['taken_by_paper']}."
        )
    if known:
        sentences.append(f"Distance between keypoints of trilateration and the rigid transform: {', '.join(known)}.")
    return sentences


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
    if category_counts := _by_category(card):
        rows = [[name, str(row["ground_truth"]), str(row["ignored"])] for name, row in category_counts.items()]
        tables.append(
            Table(caption="Other road users", head=["category", "ground_truth", "ignored"], rows=rows, sortable=True)
        )
    return tables


def limits(card: Card) -> list[str]:
    """Return the limits that a user must know before relying on a dataset."""
    fleet, depth = card.get("fleet", {}), card.get("depth", "")
    sentences = [
        "Not validated for safety or enforcement: neither this dataset nor a detector trained on it has been validated "
        "for safety-related functions, or for measuring and prosecuting offences.",
    ]
    if not card.get("parameters"):
        return sentences
    sentences += [
        "The images are synthetic. A detector trained only on them finds fewer vehicles in photographs: evaluate it on "
        "labelled footage of the road where you want to use it, and fine-tune it there.",
        _left_unlabelled(card),
        "Hidden keypoints (v = 1) are exact, unlike those in manual labels of photographs.",
    ]
    if fleet.get("substituted"):
        sentences.append(
            "A body without a certain part has the keypoint at the nearest equivalent: "
            + "; ".join(f"{name} ({len(points)})" for name, points in fleet["substituted"].items())
            + " (dataset.json names them)."
        )
    if depth and depth != "none":
        sentences.append("Depth files store distances up to 255.99 m.")
    return sentences


def _left_unlabelled(card: Card) -> str:
    if len(card.get("categories", ())) > 1:
        return (
            "Only motor vehicles with four or more wheels have keypoints. Bicycles and motorcycles (including their "
            "riders) and pedestrians have their own categories, with boxes and masks. If a truck has a trailer, "
            "the tractor is labelled. People in vehicles, parked bicycles and parked motorcycles have no labels."
        )
    return (
        "Only motor vehicles with four or more wheels are labelled. Pedestrians, bicycles and motorcycles can hide "
        "them but have no labels. If a truck has a trailer, the tractor is labelled."
    )


def people(card: Card) -> str:
    """Return a statement on the people in a dataset."""
    values = card.get("parameters")
    if not values:
        return ""
    if (values.get("own") or {}).get("photograph"):
        return (
            "Vehicles, plates and drivers are invented. The background is the user's photograph of a real place: "
            "anyone who passes the dataset on is responsible for the people in it."
        )
    return "No person, vehicle, plate or place in the images is real."


def licence(card: Card) -> str:
    """Return the licence of a dataset, with its address if it is known."""
    stated = str(card.get("licence", ""))
    return f"{stated} ({LICENCE_ADDRESSES[stated]})" if stated in LICENCE_ADDRESSES else stated


def markdown(card: Card) -> str:
    """Return a card as the text of README.md, with a header that hubs of datasets read."""
    lines = [*_hub_header(card), f"# {DATASET_TITLE}", "", card_summary(card), ""]
    for section in sections(card):
        lines += [f"## {section.title}", ""]
        for block in section.blocks:
            lines += [*_markdown(block), ""]
    return "\n".join(lines)


def _hub_header(card: Card) -> list[str]:
    """Return the YAML header of Hugging Face's hub: licence, tasks and size."""
    stated, images = str(card.get("licence", "")), card.get("counts", {}).get("images")
    name = stated.lower().replace(" ", "-") if stated in LICENCE_ADDRESSES else "other"
    if name.startswith("od"):  # the hub names licences of Open Data Commons without a version
        name = name.rpartition("-")[0]
    size = next((text for below, text in HUB_SIZES if images < below), "1M<n<10M") if images is not None else None
    return [
        "---",
        f"license: {name}",
        "task_categories: [keypoint-detection, object-detection]",
        "tags: [traffic, vehicles, roadside camera]",
        *([f"size_categories: [{size}]"] if size else []),
        "---",
        "",
    ]


def _markdown(block: str | list[str] | Command | Table) -> list[str]:
    if isinstance(block, Command):
        return [f"    {line}".rstrip() for line in block.command.splitlines()]
    if isinstance(block, list):
        return [f"- {line}" for line in block]
    if isinstance(block, Table):
        rows = (block.head, ["---"] * len(block.head), *block.rows)
        return ["| " + " | ".join(str(cell).replace("|", "/") for cell in row) + " |" for row in rows]
    return [block]
