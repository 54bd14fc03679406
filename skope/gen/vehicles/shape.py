"""Parameters of a vehicle model: its dimensions (a point in the shape space) and the style of its parts."""

from dataclasses import dataclass, fields
from typing import Final

import numpy as np

from skope.types import Array


@dataclass(frozen=True, kw_only=True)
class Dimensions:
    """Dimensions that every vehicle has, metres."""

    length: float
    width: float
    """Width without mirrors."""
    height: float
    wheelbase: float
    """Distance from the foremost to the rearmost axle."""
    track: float
    wheel_radius: float
    wheel_width: float
    front_overhang: float
    clearance: float

    @property
    def front_axle_x(self) -> float:
        return self.length / 2 - self.front_overhang

    @property
    def rear_axle_x(self) -> float:
        return self.front_axle_x - self.wheelbase

    def wheel_centers(self) -> Array:
        """(4, 3) wheel centres front right, front left, rear right, rear left, as keypoints 16-19."""
        return np.array(
            [
                [x, y, self.wheel_radius]
                for x in (self.front_axle_x, self.rear_axle_x)
                for y in (-self.track / 2, self.track / 2)
            ]
        )

    def to_dict(self) -> dict[str, float]:
        return {f.name: getattr(self, f.name) for f in fields(self)}


@dataclass(frozen=True, kw_only=True)
class Details:
    """Parts of `skope.gen.vehicles.jittered_parts.ALL_DETAILS` that replace those of a vehicle's model.

    Each value is the number of an option, 0 for the model's own part.
    """

    seams: float = 0.0
    grille: float = 0.0
    grille_frame: float = 0.0
    intake: float = 0.0
    headlight: float = 0.0
    taillight: float = 0.0
    exhausts: float = 0.0
    bumper: float = 0.0
    sills: float = 0.0
    roof: float = 0.0
    pillars: float = 0.0
    bright: float = 0.0
    glass: float = 0.0
    mirrors: float = 0.0
    roof_load: float = 0.0
    antenna: float = 0.0
    plates: float = 0.0
    plate_places: float = 0.0
    badge: float = 0.0
    decal: float = 0.0
    side: float = 0.0
    hood: float = 0.0
    panes: float = 0.0
    spoiler: float = 0.0
    spokes: float = 0.0
    dirt: float = 0.0
    """Dirt on the lower half, 0 to 1; not the number of an option."""


@dataclass(frozen=True, kw_only=True)
class TrailerDimensions:
    """Dimensions of the trailer of an articulated vehicle, metres; all are 0 without a trailer."""

    hinge_setback: float = 0.0
    """Distance of the hinge behind the front axle."""
    hinge_gap: float = 0.0
    """Distance of the rear end of a bus's front half ahead of the hinge."""
    hinge_height: float = 0.0
    """Height of the hinge above the road."""
    trailer_front: float = 0.0
    """Distance of the trailer's front ahead of the hinge; negative with a drawbar between them."""
    trailer_length: float = 0.0
    """Length of the trailer's body."""
    trailer_height: float = 0.0
    trailer_floor: float = 0.0
    """Height of the trailer's floor above the road."""
    trailer_axle: float = 0.0
    """Distance from the hinge to the trailer's rearmost axle."""


@dataclass(frozen=True, kw_only=True)
class NoseDimensions:
    """Dimensions of a lorry's long nose, metres; 0 if the cab is above the engine."""

    hood_length: float = 0.0
    """Distance of the cab's front behind the vehicle's front."""


@dataclass(frozen=True, kw_only=True)
class Shape(Details, NoseDimensions, TrailerDimensions, Dimensions):
    """Point in the shape space.

    Heights are above the road. Positions along the vehicle are relative to its own parts, so that a scaled shape stays
    consistent.
    """

    bumper_height: float
    """Height of the top of the dark lower trim."""
    headlight_low: float
    headlight_high: float
    headlight_inner: float
    """Distance from the middle to the lamp's inner end."""
    headlight_wrap: float
    """Length of the lamp around the corner."""
    taillight_low: float
    taillight_high: float
    taillight_inner: float
    taillight_wrap: float
    hood_height: float
    """Height of the hood's front edge."""
    cowl_height: float
    """Height of the hood's edge at the windscreen."""
    belt_height: float
    """Height of the shoulder under the side windows."""
    deck_height: float
    """Height of the trailing edge of trunk, tailgate or bed."""
    cowl_setback: float
    """Distance of the windscreen's base behind the front axle."""
    screen_run: float
    """Length of the windscreen along the vehicle."""
    backlight_run: float
    """Length of the rear window along the vehicle."""
    deck_length: float
    """Distance from the rear end to the rear window's base."""
    roof_inset: float
    """Inward lean of the side windows."""
    shoulder_inset: float
    """Distance of the side windows inside the body's side."""
    nose_round: float
    """Distance of the front corners behind the middle of the nose."""
    tail_round: float
    nose_lean: float
    """Distance of the hood's edge behind the bumper."""
    tail_lean: float
    roof_droop: float
    """Difference between the roof's height in the middle and at its ends."""
    pillar: float
    """Position of the B-pillar, as a share of the side windows from the front."""
    cab_length: float = 0.0
    """Length of a truck's cab."""
    box_height: float = 0.0
    """Height of a truck's floor above the road."""

    def to_dict(self) -> dict[str, float]:
        """Return all parameters by name.

        Details with the model's own value and the dimensions of a missing trailer or nose are left out.
        """
        return {name: value for name, value in super().to_dict().items() if value or name not in _LEFT_OUT}

    @property
    def hinge_x(self) -> float:
        """x of the hinge."""
        return self.front_axle_x - self.hinge_setback

    @property
    def cowl_x(self) -> float:
        """x of the windscreen's base in the middle."""
        return self.front_axle_x - self.cowl_setback

    @property
    def backlight_x(self) -> float:
        """x of the rear window's base in the middle."""
        return -self.length / 2 + self.deck_length


DETAIL_NAMES: Final = frozenset(f.name for f in fields(Details))
_LEFT_OUT: Final = DETAIL_NAMES | {f.name for kind in (TrailerDimensions, NoseDimensions) for f in fields(kind)}


@dataclass(frozen=True, kw_only=True)
class VehicleStyle:
    """Style of a vehicle's parts: its model's style, with the changes of its details."""

    family: str = "car"
    """Builder of the vehicle: "car", "truck" or "bus"."""
    grille: str = "wide"
    """Grille: "wide", "shield", "slim", "split", "hexagon", "oval", "bar", "blocks" or "closed"; for jittered
    vehicles also "frame", "kidneys", "tall", "double", "panel", "strip" or "none"."""
    grille_frame: str = ""
    """Material of the grille's frame. Default: chrome or trim, depending on `chrome`."""
    intake: str = "wide"
    """Air intake in the front bumper: "wide", "triple", "deep", "slot", "skid", "plain", "corners" or
    "mouth"."""
    headlight: str = "swept"
    """Headlight: "swept", "hook", "slim", "drop", "box", "twin", "round", "ring", "narrow", "blade", "tall", "pixel"
    or "split"."""
    taillight: str = "wide"
    """Tail lamp: "wide", "tall", "band", "hook", "round", "bar", "column", "slim", "rings", "blade", "clear" or
    "block"; for cars also "pillar" for a column beside the rear window."""
    exhausts: str = ""
    """Exhausts between the rear bumper's corners: "pipes", "blend", "fins", "middle", or none."""
    chrome: bool = False
    """Whether grille and side panes have bright frames, and doors bright handles."""
    soft: bool = False
    """Whether the sides have no shoulder line."""
    dome: float = 0.014
    """Height of the hood's dome between its creases, metres."""
    spoiler: bool = False
    """Whether there is a lip above the rear window."""
    palette: str = "private"
    """Name of the group of `ALL_PAINTS` for the model."""
    sign: bool = False
    """Whether a taxi's sign is on the roof."""
    spokes: int = 5
    panes: tuple[float, ...] = (0.0, 1.0)
    """Edges of the side panes without the B-pillar's, as shares of the side windows, in pairs."""
    glazed: float = 1.0
    """Share of the side windows' length, from the front, that is glass; the rest is sheet metal."""
    tinted: bool = False
    """Whether the glass behind the B-pillar is dark."""
    doors: int = 4
    sliding: bool = False
    cladding: bool = False
    """Whether arches and sills have dark trim."""
    rails: bool = False
    bed: bool = False
    """Whether there is an open cargo bed behind the cabin."""
    canopy: bool = False
    """Whether there is a hardtop over the bed."""
    body: str = "box"
    """Cargo body of a truck: "box", "flatbed", "tipper", "curtain", "tractor" (a fifth wheel and no body), or one of
    `truck.CARGO_BODIES`."""
    trailer: str = ""
    """Part on the vehicle's hinge: "box", "reefer", "curtain", "tank", "container", "bus" for the rear half of a
    bus, or "" for none."""
    trailer_axles: tuple[float, ...] = ()
    """Distances of the trailer's other axles ahead of its rearmost axle, metres."""
    bend_deg: float = 0.0
    """Maximum angle between a vehicle and its trailer, degrees."""
    axles: tuple[float, ...] = ()
    """Distances of the middle axles ahead of the rearmost axle, metres."""
    steered: tuple[float, ...] = ()
    """Distances of further front axles behind the foremost axle, metres."""
    dual: bool = False
    """Whether the rear has twin tyres."""
    cab_width: float = 1.0
    """Width of a cab behind its engine, as a share of the vehicle's width."""
    skirts: bool = False
    """Whether the body extends down to the sills and hides frame, tank and guards."""
    cab_share: float = 0.0
    """Height of a cab's roof, as a share of the vehicle's height; 0: it follows from the body."""
    deflector: bool = True
    """Whether a cab that is lower than the body behind it has a wind deflector."""
    cooled: bool = False
    """Whether a box has a cooling unit at its front."""
    face: str = ""
    """Front between headlights and windscreen of a cab above the engine: "" for one large grille, or "slots",
    "mask", "shield" or "ladder"; "any" for a choice that follows from the vehicle's length."""
    arms: bool = False
    """Whether the mirrors are on arms."""
    soft_seams: bool = False
    """Whether panel gaps are wide and pale enough to be unbroken lines at 15 m, and wheel arches have no painted
    lip."""
    bumper: str = ""
    """Lower part of the bumpers: "black", "low" (half as high), or "" for the body's material."""
    sill: str = ""
    """Edge of the sills: "paint", "chrome" for a bright line, or "" for dark."""
    roof_tone: str = ""
    """Material of the roof. Default: the body's paint."""
    pillar_tone: str = ""
    """Material of the pillars. Default: the body's paint."""
    mirror: str = ""
    """Material of the mirrors. Default: the body's paint, or dark trim with cladding or on a tall body."""
    load: str = ""
    """Load on the roof: "box", "bars", "ladder", "beacons" or "" for none."""
    antenna: str = ""
    """Antenna: "fin", "rod" or "" for none."""
    front_plate: str = "plate"
    """Material of the front number plate; "" for none."""
    rear_plate: str = "plate"
    plate_steps: int = 0
    """Number of steps of the front number plate above its usual height; the step is `parts.PART_SIZES.plate_step_m`."""
    low_plate: bool = False
    """Whether the rear number plate is in the bumper."""
    badge: str = "chrome"
    """Material of the badges' faces."""
    badge_size: float = 1.0
    """Relative size of the badges; 1 is the usual size."""
    decal: str = ""
    """Sticker on the sides: "stripe", "panel", "letters", "checks"; "racing" on the hood; "" for none."""
