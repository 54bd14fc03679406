"""Categories of a COCO file: which of its vehicles and others are ours, by keypoints and by name."""

import re
from dataclasses import dataclass

from skope import keypoints, schema
from skope.errors import UserError
from skope.gen.formats.coco_sources import AnnotationSource
from skope.keypoints import SKOPE33, K, Scheme
from skope.terminal.console import Console


@dataclass(frozen=True)
class Label:
    """Keypoints of one category: where each of them goes."""

    scheme: Scheme
    count: int
    columns: tuple[int, ...]
    """In the file ..."""
    places: tuple[int, ...]
    """... and in the scheme."""
    vehicle_type: str | None
    """The type that the category is called, where it is one of ours."""


def vehicle_categories(file: AnnotationSource, console: Console) -> dict[int, Label]:
    """Categories that have keypoints of one of skope's schemes, by their ids.

    It is said which of their names and keypoints are not ours. Raises UserError where none is, or two schemes are
    mixed.
    """
    out: dict[int, Label] = {}
    names_seen: list[str] = []
    lost: list[str] = []
    for category in file.document["categories"]:
        stated = category.get("keypoints")
        names = [bare(name) for name in stated] if isinstance(stated, list) else []
        names_seen += names
        for scheme in keypoints.SCHEMES.values():
            known = [i for i, name in enumerate(names) if name in scheme.names]
            if not known:
                continue
            places = [scheme.names.index(names[i]) for i in known]
            if len(set(places)) < len(places):
                raise UserError(f"{file.path}: category {category.get('name')!r} has a keypoint twice")
            unknown = [name for name in names if name not in scheme.names]
            if unknown:
                console.say(f"{file.path}: left out keypoints that are not of {scheme.name}: {', '.join(unknown)}")
            if len(known) < K:
                console.say(f"{file.path}: {len(known)} of the {K} keypoints of {scheme.name}; the rest is unlabelled")
            called = bare(category.get("name"))
            vehicle_type = called if called in schema.VEHICLE_TYPES else None
            if vehicle_type is None:
                lost.append(str(category.get("name")))
            out[category["id"]] = Label(_marked(scheme, file), len(names), tuple(known), tuple(places), vehicle_type)
    if not out:
        found = f"its keypoints are {', '.join(names_seen[:5])} ..." if names_seen else "it has none"
        raise UserError(f"{file.path}: categories: no keypoint has a name of {SKOPE33.name}: {found}")
    if len({label.scheme.name for label in out.values()}) > 1:
        raise UserError(f"{file.path}: categories: keypoints of two schemes")
    if len(out) > 1 and lost:
        console.warn(
            f"{file.path}: of classes {', '.join(lost)} only `{schema.category()['name']}` is left: no vehicle type of "
            f"ours is called so ({', '.join(schema.VEHICLE_TYPES)})"
        )
    return out


def road_user_categories(file: AnnotationSource, console: Console) -> dict[int, str]:
    """Categories without keypoints that are called as ours are, by the ids that the file gives them.

    Where the file is not one of ours it is said, as somebody else's bicycles may be without whoever rides them.
    """
    out = {
        row["id"]: name
        for row in file.document["categories"]
        if (name := bare(row.get("name"))) in schema.CATEGORIES[1:] and not row.get("keypoints")
    }
    if out and not file.ours:
        console.say(f"{file.path}: taken for ours, without keypoints: {', '.join(out.values())}")
    return out


def _marked(scheme: Scheme, file: AnnotationSource) -> Scheme:
    """The scheme in the edition that a file of ours states; people mark what they see, as today's edition does."""
    if not file.ours or file.document["info"]["keypoint_scheme"] != scheme.name:
        return scheme
    try:
        return keypoints.scheme_in(file.document["info"])
    except UserError as error:
        raise UserError(f"{file.path}: info.{error}") from None


def bare(name: object) -> str:
    return re.sub(r"[\s-]+", "_", str(name).strip().lower())
