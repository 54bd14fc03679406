"""The cargo bodies that the styles of further models name."""

from collections.abc import Callable, Mapping
from typing import Final

from skope.gen.vehicles.box_bodies import box_body, curtain_body, luton_body
from skope.gen.vehicles.cargo import Cargo, CargoSpace
from skope.gen.vehicles.fire_body import fire_body
from skope.gen.vehicles.flatbeds import crane_body, dropside_body, flatbed_body
from skope.gen.vehicles.motorhome_body import living_body
from skope.gen.vehicles.refuse_body import refuse_body
from skope.gen.vehicles.tank_bodies import mixer_body, tank_body
from skope.gen.vehicles.work_bodies import hook_body, recovery_body, skip_body

CARGO_BODIES: Final[Mapping[str, Callable[[CargoSpace], Cargo]]] = {
    "panels": box_body,
    "sliding": curtain_body,
    "luton": luton_body,
    "living": living_body,
    "tank": tank_body,
    "mixer": mixer_body,
    "refuse": refuse_body,
    "hook": hook_body,
    "skip": skip_body,
    "fire": fire_body,
    "recovery": recovery_body,
    "platform": flatbed_body,
    "crane": crane_body,
    "dropside": dropside_body,
}
