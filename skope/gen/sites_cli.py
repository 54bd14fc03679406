"""`skope gen sites`: the camera sites listed, and plans of their towns."""

from pathlib import Path
from typing import Annotated

import typer

from skope.console import Console, QuietOption, VersionOption


def sites(
    maps: Annotated[bool, typer.Option("--map", help="Draw every town's plan to a PNG file.")] = False,
    out: Annotated[Path, typer.Option(help="Folder for the plans.")] = Path("runs/sites"),
    quiet: QuietOption = False,
    version: VersionOption = False,
) -> None:
    """A table of the camera sites: town, height over the road, pitch, split, what they see; their towns' plans."""
    from skope.gen.towns import sites as all_sites
    from skope.gen.towns import towns
    from skope.gen.towns.layout import Layout

    console = Console(quiet)
    if maps:
        import cv2

        from skope.files import replacing
        from skope.gen.towns.maps import town_map

        out.mkdir(parents=True, exist_ok=True)
        for town in towns():
            ok, data = cv2.imencode(".png", town_map(town)[..., ::-1])
            assert ok
            with replacing(out / f"{town}.png") as temporary:
                temporary.write_bytes(data.tobytes())
            console.say(f"drew {out / f'{town}.png'}")
        console.result(f"wrote {len(towns())} plans to {out}")
        return
    console.result(f"{'site':<20} {'town':<7} {'height':>7} {'pitch':>6} {'split':<7} sees")
    for town in towns():
        layout = Layout.of(town)
        for site in layout.sites:
            height = site.position[2] - layout.road_below(site)
            console.result(
                f"{site.name:<20} {town:<7} {height:5.1f} m {site.pitch_deg:4.0f}° {site.split:<7} {site.sees}"
            )
    console.result(f"{len(all_sites())} sites; plans of the towns: skope gen sites --map")
