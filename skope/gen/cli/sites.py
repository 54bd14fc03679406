"""`skope gen sites`: the camera sites listed, and plans of their towns."""

from pathlib import Path
from typing import Annotated

import typer

from skope.console import Console, QuietOption, VersionOption
from skope.outputs import look

DRAWN = Path("runs/sites")


def sites(
    maps: Annotated[bool, typer.Option("--map", help="Draw every town's plan to a PNG file.")] = False,
    site: Annotated[
        Path | None, typer.Option(help="Check a site file, and draw its lanes over its photograph to a PNG file.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder for the pictures.", show_default="runs/sites/towns, or runs/sites/ and the site's name"
        ),
    ] = None,
    quiet: QuietOption = False,
    version: VersionOption = False,
) -> None:
    """A table of the camera sites: town, height over the road, pitch, split, what they see; their towns' plans."""
    from skope.gen.towns.layout import Layout
    from skope.gen.towns.sites import sites as all_sites
    from skope.gen.towns.town import towns

    console = Console(quiet)
    if site:
        _show(site, out, console)
        return
    if maps:
        from skope import draw
        from skope.gen.inspect.town_maps import town_map

        out = out or DRAWN / "towns"
        with look(out, "skope gen sites --map", "the towns") as drawn:
            for town in towns():
                draw.write(drawn / f"{town.name}.png", town_map(town))
                console.say(f"drew {out / f'{town.name}.png'}")
        console.result(f"wrote {len(towns())} plans to {out}")
        return
    console.result(f"{'site':<20} {'town':<7} {'height':>7} {'pitch':>6} {'split':<7} sees")
    for town in towns():
        layout = Layout.of(town)
        for one in layout.sites:
            height = one.position[2] - layout.road_below(one)
            console.result(f"{one.name:<20} {town.name:<7} {height:5.1f} m {one.pitch_deg:4.0f}° {one.split:<7} {one.sees}")
    console.result(f"{len(all_sites())} sites; plans of the towns: skope gen sites --map")


def _show(path: Path, out: Path | None, console: Console) -> None:
    from skope import draw
    from skope.gen.site_files.overlay import overlay
    from skope.gen.site_files.site_file import read_site
    from skope.gen.towns.layout import Layout

    own = read_site(path)
    road, layout = own.road, Layout.of(own.site.town)
    height = road.camera.position[2] - layout.road_level(road.camera.position[:2])
    out = out or DRAWN / road.title
    picture = out / f"{road.title}.png"
    with look(out, "skope gen sites --site", path) as drawn:
        draw.write(drawn / picture.name, overlay(road))
    for line in own.said:
        console.result(line)
    traffic = "left" if layout.mirrored else "right"
    console.result(
        f"{road.title}: {road.camera.width}x{road.camera.height}, {height:.1f} m over the road, "
        f"{own.site.pitch_deg:.0f} degrees down, traffic on the {traffic}; wrote {picture}; "
        f"next: skope gen --site {path}"
    )
