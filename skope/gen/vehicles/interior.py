"""Interior of a vehicle, visible through the windows: dashboard, seats, steering wheel and a driver."""

import numpy as np

from skope.gen.mesh import Mesh, box, grid, lathe, merged


def interior(
    *,
    cowl: float,
    floor: float,
    belt: float,
    roof: float,
    half_width: float,
    driver: float,
    rows: int,
    pitch: float = 0.85,
    ground: tuple[float, float, float] | None = None,
) -> Mesh:
    """Return a cabin interior between the heights `floor` and `roof`, metres.

    Args:
        cowl: x of the dashboard.
        floor: Height of the floor.
        belt: Height of the windows' lower edge.
        roof: Height of the roof.
        half_width: Half of the cabin's width.
        driver: x of the driver's back.
        rows: Number of rows of seats.
        pitch: Distance between rows of seats.
        ground: Plate that closes the cabin at the bottom: x of its rear, half its width, its height. None: no plate.
    """
    out: list[Mesh] = []
    y = half_width * 0.52
    top = min(roof - 0.19, floor + 0.84)
    out.append(box((cowl - 0.3, -half_width, floor), (cowl, half_width, belt - 0.02), "dashboard"))
    for row in range(rows):
        x = driver - pitch * row
        for side in (-1, 1):
            out += _seat(x, side * y, floor, top - 0.12)
    if ground is not None:
        rear, half, low = ground
        out.append(box((rear, -half, low - 0.02), (cowl, half, low), "dashboard"))
    out += _driver(driver, y, floor, top)
    out.append(_wheel(cowl - 0.36, y, belt - 0.03))
    return merged(out)


def seats(front: float, rear: float, floor: float, half_width: float, ground: tuple[float, float]) -> Mesh:
    """Return rows of seats from `front` to `rear` on a floor, without a driver.

    `ground`: half its width, its height.
    """
    half, low = ground
    out = [box((rear - 0.6, -half, low - 0.02), (front + 0.7, half, low), "dashboard")]
    for x in np.linspace(front, rear, 5):
        for side in (-1, 1):
            out += _seat(x, side * half_width * 0.52, floor, floor + 0.72)
    return merged(out)


def _seat(x: float, y: float, floor: float, top: float) -> list[Mesh]:
    return [
        box((x - 0.16, y - 0.22, floor), (x - 0.02, y + 0.22, top - 0.16), "seat"),
        box((x - 0.13, y - 0.12, top - 0.16), (x - 0.05, y + 0.12, top), "seat"),
        box((x - 0.1, y - 0.22, floor), (x + 0.38, y + 0.22, floor + 0.12), "seat"),
    ]


def _driver(x: float, y: float, floor: float, top: float) -> list[Mesh]:
    angle = np.linspace(-np.pi / 2, np.pi / 2, 6)
    head = lathe(np.stack([0.12 * np.sin(angle), 0.088 * np.cos(angle)], -1), ["driver_skin"] * 5, 8, "z")
    shoulders = top - 0.26
    torso = box((x - 0.02, y - 0.19, floor + 0.1), (x + 0.2, y + 0.19, shoulders), "driver_clothes")
    arms = [
        box(
            (x + 0.12, y + side * 0.2 - 0.05, shoulders - 0.28),
            (x + 0.4, y + side * 0.2 + 0.05, shoulders - 0.18),
            "driver_clothes",
        )
        for side in (-1, 1)
    ]
    return [head.moved((x + 0.08, y, top - 0.12)), torso, *arms]


def _wheel(x: float, y: float, z: float) -> Mesh:
    turn = np.linspace(0, 2 * np.pi, 13)
    around = np.linspace(0, 2 * np.pi, 5)
    radius = 0.18 + 0.016 * np.cos(around)[None, :]
    points = np.stack(
        [
            x + np.broadcast_to(0.016 * np.sin(around)[None, :], (13, 5)),
            y + radius * np.cos(turn)[:, None],
            z + radius * np.sin(turn)[:, None],
        ],
        axis=-1,
    )
    return grid(points, [["dashboard"] * 4] * 12)
