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
    """Foremost to rearmost axle."""
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
        """(4, 3) front right, front left, rear right, rear left, as keypoints 16-19."""
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
    """Parts of `skope.gen.vehicles.jittered_parts.ALL_DETAILS` that a vehicle has in place of its model's.

    Each is the option's number, 0 for the model's own.
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
    """Not an option's number: how dirty its lower half is, 0 to 1."""


@dataclass(frozen=True, kw_only=True)
class TrailerDimensions:
    """Dimensions of what is hitched to an articulated vehicle, metres; all are 0 where nothing is."""

    hinge_setback: float = 0.0
    """Hinge behind the front axle."""
    hinge_gap: float = 0.0
    """Rear end of a bus's front half ahead of the hinge."""
    hinge_height: float = 0.0
    """Hinge above the road."""
    trailer_front: float = 0.0
    """Front of the trailer's body ahead of the hinge; negative where a drawbar is between them."""
    trailer_length: float = 0.0
    """Length of the trailer's body."""
    trailer_height: float = 0.0
    trailer_floor: float = 0.0
    """Floor of the trailer above the road."""
    trailer_axle: float = 0.0
    """Hinge to the trailer's rearmost axle."""


@dataclass(frozen=True, kw_only=True)
class NoseDimensions:
    """Dimensions of a lorry's long nose, metres; 0 where the cab stands over the engine."""

    hood_length: float = 0.0
    """The cab's front behind the vehicle's."""


@dataclass(frozen=True, kw_only=True)
class Shape(Details, NoseDimensions, TrailerDimensions, Dimensions):
    """A point in the shape space: heights above the road, positions along the vehicle from its own parts, so that a
    shape stays whole when it is stretched."""

    bumper_height: float
    """Top of the dark lower trim."""
    headlight_low: float
    headlight_high: float
    headlight_inner: float
    """Width from the middle to the lamp's inner end."""
    headlight_wrap: float
    """Reach of the lamp around the corner."""
    taillight_low: float
    taillight_high: float
    taillight_inner: float
    taillight_wrap: float
    hood_height: float
    """Edge of the hood at the front."""
    cowl_height: float
    """Edge of the hood at the windscreen."""
    belt_height: float
    """Shoulder under the side windows."""
    deck_height: float
    """Trailing edge of trunk, tailgate or bed."""
    cowl_setback: float
    """Windscreen's base behind the front axle."""
    screen_run: float
    """Windscreen's length along the vehicle."""
    backlight_run: float
    """Rear window's length along the vehicle."""
    deck_length: float
    """Rear end to the rear window's base."""
    roof_inset: float
    """Lean of the side windows inwards."""
    shoulder_inset: float
    """Distance of the side windows inside the body's side."""
    nose_round: float
    """Distance of the front corners behind the middle of the nose."""
    tail_round: float
    nose_lean: float
    """Distance of the hood's edge behind the bumper."""
    tail_lean: float
    roof_droop: float
    """Distance by which the roof is lower at its ends."""
    pillar: float
    """The B-pillar's place, as a share of the side windows from the front."""
    cab_length: float = 0.0
    """A truck's cab, front to back."""
    box_height: float = 0.0
    """A truck's floor above the road."""

    def to_dict(self) -> dict[str, float]:
        """All parameters by name, without details that are the model's own, a trailer or a nose that are not there."""
        return {name: value for name, value in super().to_dict().items() if value or name not in _LEFT_OUT}

    @property
    def hinge_x(self) -> float:
        """The hinge's place along the vehicle."""
        return self.front_axle_x - self.hinge_setback

    @property
    def cowl_x(self) -> float:
        """The windscreen's base in the middle."""
        return self.front_axle_x - self.cowl_setback

    @property
    def backlight_x(self) -> float:
        """The rear window's base in the middle."""
        return -self.length / 2 + self.deck_length


DETAIL_NAMES: Final = frozenset(f.name for f in fields(Details))
_LEFT_OUT: Final = DETAIL_NAMES | {f.name for kind in (TrailerDimensions, NoseDimensions) for f in fields(kind)}


@dataclass(frozen=True, kw_only=True)
class VehicleStyle:
    """Style of a vehicle beside its dimensions: its model's, but for what its details replace."""

    family: str = "car"
    """"car", "truck" or "bus": which builder makes it."""
    grille: str = "wide"
    """"wide", "shield", "slim", "split", "hexagon", "oval", "bar", "blocks" or "closed"; of vehicles with details of
    their own also "frame", "kidneys", "tall", "double", "panel", "strip" or "none"."""
    grille_frame: str = ""
    """Material of the grille's frame. Default: chrome or trim, as `chrome` says."""
    intake: str = "wide"
    """Air intake in the front bumper: "wide", "triple", "deep", "slot", "skid", "plain", "corners" or
    "mouth"."""
    headlight: str = "swept"
    """"swept", "hook", "slim", "drop", "box", "twin", "round", "ring", "narrow", "blade", "tall", "pixel" or
    "split"."""
    taillight: str = "wide"
    """"wide", "tall", "band", "hook", "round", "bar", "column", "slim", "rings", "blade", "clear" or "block"; of cars
    also "pillar" for a column beside the rear window."""
    exhausts: str = ""
    """Exhausts between the rear bumper's corners: "pipes", "blend", "fins", "middle", or none."""
    chrome: bool = False
    """Bright frames around grille and side panes, bright door handles."""
    soft: bool = False
    """No shoulder line along the sides."""
    dome: float = 0.014
    """Rise of the hood between its creases, metres."""
    spoiler: bool = False
    """A lip over the rear window."""
    palette: str = "private"
    """Name of the group of `ALL_PAINTS` that the model comes in."""
    sign: bool = False
    """A taxi's sign on the roof."""
    spokes: int = 5
    panes: tuple[float, ...] = (0.0, 1.0)
    """Edges of the side panes but the B-pillar's, as shares of the side windows, in pairs."""
    glazed: float = 1.0
    """Share of the side windows' length, from the front, that is glass rather than sheet metal."""
    tinted: bool = False
    """Dark glass behind the B-pillar."""
    doors: int = 4
    sliding: bool = False
    cladding: bool = False
    """Dark trim around arches and sills."""
    rails: bool = False
    bed: bool = False
    """An open cargo bed behind the cabin."""
    canopy: bool = False
    """A hardtop over the bed."""
    body: str = "box"
    """Cargo body of a truck: "box", "flatbed", "tipper", "curtain", "tractor" for a fifth wheel in its place, or one of
    `truck.CARGO_BODIES`."""
    trailer: str = ""
    """Part that hangs on the vehicle's hinge: "box", "reefer", "curtain", "tank", "container", "bus" for the rear half
    of one, or nothing."""
    trailer_axles: tuple[float, ...] = ()
    """Distances of the trailer's further axles before its rearmost one, metres."""
    bend_deg: float = 0.0
    """Largest angle between a vehicle and its trailer, degrees."""
    axles: tuple[float, ...] = ()
    """Middle axles' distances before the rearmost one, metres."""
    steered: tuple[float, ...] = ()
    """Second front axles' distances behind the foremost one, metres."""
    dual: bool = False
    """Twin tyres at the rear."""
    cab_width: float = 1.0
    """Width of a cab with its engine before it, as a share of the vehicle's width."""
    skirts: bool = False
    """A body that reaches down to the sills, and so hides frame, tank and guards."""
    cab_share: float = 0.0
    """Height of a cab's roof, as a share of the vehicle's height; 0 for what follows from its body."""
    deflector: bool = True
    """A wind deflector over a cab that is lower than the body behind it."""
    cooled: bool = False
    """A cooling unit at the front of a box."""
    face: str = ""
    """Between the headlights and windscreen of a cab over the engine: one large grille, or "slots", "mask", "shield" or
    "ladder"; "any" for one of these that the vehicle's length draws."""
    arms: bool = False
    """Mirrors that stand on arms."""
    soft_seams: bool = False
    """Panel gaps wide and pale enough to be whole lines 15 m away, and wheel arches without a
    painted lip."""
    bumper: str = ""
    """Lower part of the bumpers: "black", "low" (half as high), or as the body."""
    sill: str = ""
    """Edge of the sills: "paint", "chrome" for a bright line, or dark."""
    roof_tone: str = ""
    """Material of the roof. Default: the body's paint."""
    pillar_tone: str = ""
    """Material of the pillars. Default: the body's paint."""
    mirror: str = ""
    """Material of the mirrors. Default: the body's paint, or dark trim with cladding or on a tall body."""
    load: str = ""
    """The load on the roof: "box", "bars", "ladder", "beacons" or nothing."""
    antenna: str = ""
    """"fin", "rod" or none."""
    front_plate: str = "plate"
    """Material of the front number plate; "" for none."""
    rear_plate: str = "plate"
    plate_steps: int = 0
    """Number of places by which the front number plate hangs above its usual one; a place is
    `parts.PART_SIZES.plate_step_m`."""
    low_plate: bool = False
    """The rear number plate hangs in the bumper."""
    badge: str = "chrome"
    """Material of the badges' faces."""
    badge_size: float = 1.0
    """Size of the badges, 1 for the usual one."""
    decal: str = ""
    """The sticker on the sides: "stripe", "panel", "letters", "checks", or, on the hood, "racing"; or
    nothing."""
