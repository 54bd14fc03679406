"""Parameters of a vehicle model: its dimensions (a point in the shape space) and the style of its parts."""

from dataclasses import dataclass, fields

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
class Shape(Dimensions):
    """A point in the shape space: heights above the road, positions along the vehicle from its own parts, so that a
    shape stays whole when it is stretched."""

    bumper_height: float
    """Top of the dark lower trim."""
    headlight_low: float
    headlight_high: float
    headlight_inner: float
    """Width from the middle to the lamp's inner end."""
    headlight_wrap: float
    """How far the lamp reaches around the corner."""
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
    """How far the side windows lean inwards."""
    shoulder_inset: float
    """How far the side windows stand inside the body's side."""
    nose_round: float
    """How far the front corners stand back behind the middle of the nose."""
    tail_round: float
    nose_lean: float
    """How far the hood's edge stands behind the bumper."""
    tail_lean: float
    roof_droop: float
    """How much lower the roof is at its ends."""
    pillar: float
    """The B-pillar's place, as a share of the side windows from the front."""
    cab_length: float = 0.0
    """A truck's cab, front to back."""
    box_height: float = 0.0
    """A truck's floor above the road."""

    @property
    def cowl_x(self) -> float:
        """The windscreen's base in the middle."""
        return self.front_axle_x - self.cowl_setback

    @property
    def backlight_x(self) -> float:
        """The rear window's base in the middle."""
        return -self.length / 2 + self.deck_length


@dataclass(frozen=True, kw_only=True)
class VehicleStyle:
    """What a model's shape parameters do not say; the same for all shapes of the model."""

    family: str = "car"
    """"car", "truck" or "bus": which builder makes it."""
    grille: str = "wide"
    """"wide", "shield", "slim", "split", "hexagon", "oval", "bar", "blocks" or "closed"."""
    intake: str = "wide"
    """Air intake in the front bumper: "wide", "triple", "deep", "slot", "skid" or "plain"."""
    headlight: str = "swept"
    """"swept", "hook", "slim", "drop", "box", "twin" or "round"."""
    taillight: str = "wide"
    """"wide", "tall", "band", "hook" or "round"."""
    exhausts: str = ""
    """Exhausts between the rear bumper's corners: "pipes", "blend", "fins", or none."""
    chrome: bool = False
    """Bright frames around grille and side panes, bright door handles."""
    soft: bool = False
    """No shoulder line along the sides."""
    dome: float = 0.014
    """How far the hood rises between its creases, metres."""
    spoiler: bool = False
    """A lip over the rear window."""
    palette: str = "private"
    """Name of the group of `PAINTS` that the model comes in."""
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
    body: str = "box"
    """Cargo body of a truck: "box", "flatbed", "tipper" or "curtain"."""
    axles: tuple[float, ...] = ()
    """Middle axles' distances before the rearmost one, metres."""
    dual: bool = False
    """Twin tyres at the rear."""
