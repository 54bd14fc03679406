"""`skope gen sites`: the camera sites listed, and plans of their towns."""

from pathlib import Path
from typing import Annotated, Any

from skope.files.output_folders import replaceable_output
from skope.terminal.command_options import DIR_METAVAR, FILE_METAVAR, SITE_PLANS, JsonOption, option
from skope.terminal.console import Console, text_table


def sites(
    console: Console,
    maps: Annotated[bool, option("--maps", help="Draw every town's plan to a PNG file.")] = False,
    site: Annotated[
        Path | None,
        option(metavar=FILE_METAVAR, help="Check a site file, and draw its lanes over its photograph to a PNG file."),
    ] = None,
    out: Annotated[
        Path | None,
        option(
            metavar=DIR_METAVAR,
            help="Folder for the images.",
            show_default=f"{SITE_PLANS}/towns, or {SITE_PLANS}/ and the site's name",
        ),
    ] = None,
    json: JsonOption = False,
) -> None:
    """List the camera sites: town, height above the road, pitch, split, and view. Draw plans of their towns."""
    if site:
        document, lines = _own_road(site, out)
    elif maps:
        document, lines = _plans(out or SITE_PLANS / "towns", console if not json else Console(quiet=True))
    else:
        document, lines = _table()
    if json:
        console.document(document)
        return
    for line in lines:
        console.result(line)


def _table() -> tuple[dict[str, Any], list[str]]:
    """Return all sites, as a document and as lines of a table."""
    from skope.gen.towns.land_use import Layout
    from skope.gen.towns.town import towns

    found = [
        {
            "name": site.name,
            "town": town.name,
            "height_m": float(site.position[2] - layout.road_below(site)),
            "pitch_deg": float(site.pitch_deg),
            "split": site.split,
            "sees": site.sees,
        }
        for town in towns()
        for layout in [Layout.of(town)]
        for site in layout.sites
    ]
    rows = [
        [row["name"], row["town"], f"{row['height_m']:.1f} m", f"{row['pitch_deg']:.0f}°", row["split"], row["sees"]]
        for row in found
    ]
    table = text_table(["site", "town", "height", "pitch", "split", "sees"], rows, "llrrll")
    return {"sites": found}, [*table, f"{len(found)} sites; plans of the towns: skope gen sites --maps"]


def _plans(out: Path, console: Console) -> tuple[dict[str, Any], list[str]]:
    """Draw the plan of each town; return the written files, as a document and as lines."""
    from skope.gen.inspect.town_maps import town_map
    from skope.gen.towns.town import towns
    from skope.pictures import draw

    paths = []
    with replaceable_output(out, "skope gen sites --maps", "the towns") as drawn:
        for town in towns():
            paths.append(out / f"{town.name}.png")
            draw.write(drawn / paths[-1].name, town_map(town))
            console.say(f"drew {paths[-1]}")
    return {"maps": list(map(str, paths))}, [f"wrote {len(paths)} plans to {out}"]


def _own_road(path: Path, out: Path | None) -> tuple[dict[str, Any], list[str]]:
    """Check a site file and draw its lanes; return its content, as a document and as lines."""
    from skope.gen.generation_site import read_generation_site
    from skope.gen.inspect.town_maps import draw_lanes
    from skope.gen.towns.road_graph import RoadGraph
    from skope.pictures import draw

    user_site = read_generation_site(path)
    road, graph = user_site.road, RoadGraph.of(user_site.site.town)
    camera = road.camera
    height = float(camera.position[2] - graph.road_level(camera.position[:2]))
    out = out or SITE_PLANS / road.title
    picture = out / f"{road.title}.png"
    with replaceable_output(out, "skope gen sites --site", path) as drawn:
        draw.write(drawn / picture.name, draw_lanes(road))
    traffic = "left" if graph.mirrored else "right"
    document = {
        "site": road.title,
        "size": [camera.width, camera.height],
        "height_m": height,
        "pitch_deg": float(user_site.site.pitch_deg),
        "traffic": traffic,
        "notes": list(user_site.messages),
        "picture": str(picture),
    }
    summary = (
        f"{road.title}: {camera.width}x{camera.height}, {height:.1f} m over the road, "
        f"{user_site.site.pitch_deg:.0f} degrees down, traffic on the {traffic}; wrote {picture}; "
        f"next: skope gen --site {path}"
    )
    return document, [*user_site.messages, summary]
