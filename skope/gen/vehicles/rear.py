"""The rears of vehicles: plate in its recess, bumper, reflectors, exhausts, beside the tail lamps."""

from skope.gen.mesh import Mesh
from skope.gen.vehicles import parts
from skope.gen.vehicles.lofted_surfaces import FRONT_END, SIDE_START, WRAP, Surface
from skope.gen.vehicles.panels import Points, plate_height, quad, rectangle_outline
from skope.gen.vehicles.shape import Shape, VehicleStyle
from skope.gen.vehicles.taillights import draw_taillight
from skope.types import Array


def draw_rear(shell: Surface, w: Array, s: Shape, style: VehicleStyle, points: Points) -> list[Mesh]:
    """Draw a rear on a shell and note its keypoints; returns what stands out from it."""
    end, last = float(w[-1]), len(w) - 1
    inner, outer = end - s.taillight_inner, float(w[last - SIDE_START + 3]) - s.taillight_wrap
    low, high = s.taillight_low, s.taillight_high
    hatch = s.deck_length < 0.3
    plate = s.taillight_low - 0.03 if hatch or s.taillight_inner < 0.45 else (low + high) / 2 - 0.06
    if style.taillight in ("tall", "round") or hatch:
        plate = max(s.clearance + 0.32, min(plate, s.taillight_low + 0.02))
    badge = plate = plate_height(min(plate, s.deck_height - 0.31))
    if style.low_plate:
        plate = plate_height(s.clearance + 0.31)
        badge = max(badge, (low + high) / 2 - 0.215)
    out = []
    if style.family == "truck":
        out.append(parts.plate(-s.length / 2 - 0.002, plate_height(low), 0.0, -1.0, style.rear_plate))
    else:
        _draw_plate(shell, end, plate, style.rear_plate)
        place = shell.place((end, badge + 0.215), WRAP)[0] * [1, 0, 1]
        out.append(parts.badge(place, 0.04 * style.badge_size, -1.0, style.badge))
    if style.family != "car" or style.taillight != "pillar":
        draw_taillight(shell, style.taillight, (outer, inner), (low, high), points)
    if style.family != "car":
        return out
    out += _draw_bumper(shell, s, style, float(w[last - FRONT_END]), end)
    for a, b in ((0.34, 0.44), (0.45, 0.5)) if s.taillight_inner > 0.55 else ():
        shell.draw(rectangle_outline(end - b, end - a, badge + 0.2, badge + 0.225), WRAP, "chrome")
    return out


def _draw_plate(shell: Surface, end: float, plate: float, material: str) -> None:
    half, high = parts.PLATE
    recess = quad(end - half - 0.07, end + 0.1, (plate - 0.03,) * 2, (plate + high + 0.04,) * 2)
    shell.sink(recess, WRAP, 0.022, "trim", wall="paint")
    shell.draw(rectangle_outline(end - half, end + 0.1, plate, plate + high), WRAP, material, layer=2)
    for a in (0.1, 0.16):
        shell.draw(
            rectangle_outline(end - a - 0.04, end - a, plate + high + 0.012, plate + high + 0.03), WRAP, "lamp_clear"
        )


def _draw_bumper(shell: Surface, s: Shape, style: VehicleStyle, corner: float, end: float) -> list[Mesh]:
    """Reflectors, the trim between the pipes, and the pipes."""
    low = s.clearance
    shell.draw(rectangle_outline(corner - 0.06, corner + 0.12, low + 0.2, low + 0.235), WRAP, "gap")
    shell.draw(rectangle_outline(corner - 0.055, corner + 0.115, low + 0.205, low + 0.23), WRAP, "taillight", layer=2)
    wide = end - corner - 0.1
    shell.sink(quad(end - wide, end + 0.1, (low + 0.05,) * 2, (low + 0.17,) * 2), WRAP, 0.03, "trim")
    if style.exhausts == "fins":
        for a in (0.12, 0.28, 0.44):
            shell.draw(rectangle_outline(end - a - 0.012, end - a, low + 0.05, low + 0.17), WRAP, "gap", layer=14)
    if style.exhausts == "blend":
        shell.draw(rectangle_outline(end - wide, end - wide + 0.16, low + 0.075, low + 0.135), WRAP, "chrome", layer=3)
    if style.exhausts not in ("pipes", "middle"):
        return []
    at = shell.place((end - (wide - 0.12 if style.exhausts == "pipes" else 0.07), low + 0.1), WRAP)[0]
    return [parts.exhaust(at[0] - 0.012, at[1], at[2])]
