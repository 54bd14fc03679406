"""A camera from everything that a user has: marked points, lengths, parallel lines, verticals, and what else is known.

One least-squares problem, each residual in units of its own standard deviation (Levenberg and Marquardt's method). Its
covariance says how well each place in the image is known. Residuals of lines on the road are taken on the road, since
the marks' errors are carried there; lens distortion and focal length are always unknown, under what lenses are like.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import chi2

from skope.camera.derivatives import slopes
from skope.camera.evidence import Evidence, MarkedLength, MarkedPoint, ParallelLines, Vertical
from skope.camera.ground_plane import ground_places
from skope.camera.model import Camera
from skope.camera.pose_from_points import FEWEST, fit_camera
from skope.camera.uncertain_camera import PARAMETERS, UncertainCamera, camera_of, values_of
from skope.errors import UserError
from skope.types import Array

_FREE: Final = ("x", "y", "yaw")
"""Where the world's origin and axes are, which points alone can say."""
_LENS: Final = (("k1", -0.05, 0.15), ("roll", 0.0, 0.2), ("focal", None, 1.0))
"""What cameras at roads are like: mean and standard deviation; None: a focal length as long as images are wide."""
_TILTS_DEG: Final = (4.0, 10.0, 18.0, 28.0, 40.0, 55.0)
_LENGTHS: Final = (0.45, 0.7, 1.1, 1.7, 2.6, 4.0)
"""Focal lengths that the search begins with, in widths of the image."""
_HEIGHT_M: Final = 6.0
_ROUNDS: Final = 4
"""Rounds in which the weights follow the camera."""
_STEPS: Final = 60
"""Steps of a round at most."""
_FINALISTS: Final = 2
"""So many starts are followed to the end."""
_FIRST_STEPS: Final = 12
"""Steps after which they are chosen."""
CHECKED_POINTS: Final = 6
"""From so many points on, one that contradicts the others is found."""
_WRONG: Final = 1e-3
"""Probability that a set of right points loses one."""
_DOUBTED: Final = 4
"""So many points are left out by turns, those that the others contradict most."""
_RIVAL_COST: Final = 9.2
"""Points without which the cost is within this of the least cannot be told apart (99% of chi-squared, two degrees)."""
_SURPRISE: Final = 0.01
"""Residuals that are less likely than this widen the covariance."""


@dataclass(frozen=True)
class Residual:
    """How far one piece of evidence is from the camera that was found."""

    kind: str
    """"point", "length", "parallel lines", "vertical" or "belief"."""
    name: str
    value: float
    """Pixels for points and verticals, metres for lengths, degrees for parallel lines."""
    sigmas: float
    """The same in standard deviations."""


@dataclass(frozen=True, eq=False)
class SiteCalibration(UncertainCamera):
    """A calibrated camera and how well it is known."""

    residuals: tuple[Residual, ...]
    outliers: tuple[str, ...]
    """Names of points that contradict the others and were left out."""
    warnings: tuple[str, ...]
    """What the evidence leaves open, a sentence each."""


# --------------------------------------------------------------------------------------------------------- the evidence


@dataclass(frozen=True, eq=False)
class _Term:
    """One piece of evidence: residuals (M,) of a camera, and their covariance (M, M)."""

    kind: str
    name: str
    residual: Callable[[Camera], Array]
    covariance: Callable[[Camera], Array]


def _point_term(point: MarkedPoint) -> _Term:
    def residual(camera: Camera) -> Array:
        return _finite(camera.project(point.place)[0] - point.pixel)

    def covariance(camera: Camera) -> Array:
        J = _finite_slopes(lambda place: camera.project(place)[0], point.place, 0.01)
        of_place = np.diag([point.sigma_m, point.sigma_m, point.sigma_z_m]) ** 2
        return np.asarray(point.sigma_px**2 * np.eye(2) + J @ of_place @ J.T)

    return _Term("point", point.name, residual, covariance)


def _length_term(length: MarkedLength) -> _Term:
    def residual(camera: Camera) -> Array:
        begin, end = ground_places(camera, length.pixels)
        return _finite(np.array([np.linalg.norm(end - begin) - length.metres]))

    def covariance(camera: Camera) -> Array:
        begin, end = ground_places(camera, length.pixels)[:, :2]
        along = (end - begin) / max(float(np.linalg.norm(end - begin)), 1e-9)
        by_marks = _finite(along @ _by_pixels(camera, length.pixels))
        return np.array([[length.sigma_m**2 + length.sigma_px**2 * float((by_marks**2).sum())]])

    return _Term("length", length.name, residual, covariance)


def _parallel_term(group: ParallelLines) -> _Term:
    def directions(camera: Camera) -> Array:
        """(L, 2) from one end of each line to the other, metres."""
        ends = ground_places(camera, group.lines)[..., :2]
        return np.asarray(ends[:, 1] - ends[:, 0])

    def variances(camera: Camera) -> Array:
        """(L,) of the lines' angles, square radians."""
        way = directions(camera)
        across = np.stack([-way[:, 1], way[:, 0]], axis=-1) / np.maximum((way**2).sum(axis=-1), 1e-9)[:, None]
        by_marks = np.einsum("li,leij->lej", across, _by_pixels(camera, group.lines))
        return _finite(group.sigma_px**2 * (by_marks**2).sum(axis=(1, 2)))

    def residual(camera: Camera) -> Array:
        """Angles from their mean: where a camera is far from right, the mean moves, not the lines."""
        way, weight = directions(camera), 1 / np.maximum(variances(camera), 1e-12)
        angles = np.arctan2(way[:, 1], way[:, 0])
        # Lines have no direction: those that were drawn the other way round are turned.
        angles = angles[0] + np.mod(angles - angles[0] + np.pi / 2, np.pi) - np.pi / 2
        return _finite(angles - (weight * angles).sum() / weight.sum())

    return _Term("parallel lines", group.name, residual, lambda camera: np.diag(variances(camera)))


def _vertical_term(vertical: Vertical) -> _Term:
    foot, top = vertical.pixels

    def line(camera: Camera) -> tuple[Array, Array]:
        """Unit vector of the vertical in the image near its top, and pixels that a metre of it is long there."""
        place = ground_places(camera, foot)
        ray = camera.rays(top)[0] @ camera.T_camera_world[:3, :3]
        flat = float(np.linalg.norm((place - camera.position)[:2])) / max(float(np.linalg.norm(ray[:2])), 1e-9)
        height = vertical.metres or max(float(camera.position[2] + flat * ray[2]), 0.1)
        ends, _, _ = camera.project(place + np.array([[0, 0, height - 0.05], [0, 0, height + 0.05], [0, 0, height]]))
        return (ends[1] - ends[0]) / 0.1, ends[2]

    def residual(camera: Camera) -> Array:
        a_metre, end = line(camera)
        along = a_metre / max(float(np.linalg.norm(a_metre)), 1e-9)
        off = top - end
        across = off @ np.array([-along[1], along[0]])
        return _finite(np.array([across] if vertical.metres is None else [across, off @ along]))

    def covariance(camera: Camera) -> Array:
        a_metre, _ = line(camera)
        both = 2 * vertical.sigma_px**2
        if vertical.metres is None:
            return np.array([[both]])
        return np.diag([both, both + float(a_metre @ a_metre) * vertical.sigma_m**2])

    return _Term("vertical", vertical.name, residual, covariance)


def _gaussian_term(kind: str, name: str, of: Sequence[str], mean: Array, covariance: Array) -> _Term:
    which = [PARAMETERS.index(parameter) for parameter in of]

    def residual(camera: Camera) -> Array:
        return np.asarray(values_of(camera)[which] - mean)

    return _Term(kind, name, residual, lambda _: covariance)


def _terms(evidence: Evidence) -> list[_Term]:
    out = [_point_term(point) for point in evidence.points]
    out += [_length_term(length) for length in evidence.lengths]
    out += [_parallel_term(group) for group in evidence.parallels]
    out += [_vertical_term(vertical) for vertical in evidence.verticals]
    out += [
        _gaussian_term("belief", belief.name, belief.of, belief.mean, belief.covariance) for belief in evidence.beliefs
    ]
    for name, mean, sigma in _LENS:
        center = math.log(evidence.size[0]) if mean is None else mean
        out.append(_gaussian_term("lens", name, (name,), np.array([center]), np.array([[sigma**2]])))
    return out


# ------------------------------------------------------------------------------------------------------------- solver


def calibrate(evidence: Evidence, *, start: Camera | None = None, check: bool = True) -> SiteCalibration:
    """The likeliest camera under all evidence, without a point that contradicts the others.

    Args:
        evidence: What is known. Places come out in metres only where points, lengths, a vertical's height or the
            camera's own are among it.
        start: A camera to begin with; None: one that the points show, or the best of many.
        check: Whether points that contradict the others are looked for.

    Raises:
        UserError: There is nothing to tell the scale by, or no camera agrees with the evidence.
    """
    scaled = evidence.points or evidence.lengths or any(v.metres for v in evidence.verticals)
    if not scaled and not any("z" in belief.of for belief in evidence.beliefs):
        raise UserError("calibration: nothing tells metres: mark points with places or a known length")
    if 0 < len(evidence.points) < FEWEST and not (evidence.lengths or evidence.parallels or evidence.beliefs):
        raise UserError(f"calibration: expected {FEWEST} points or more, got {len(evidence.points)}")
    unknown = [name for name in PARAMETERS if len(evidence.points) >= 2 or name not in _FREE]
    terms = _terms(evidence)
    solved = _best(terms, _starts(evidence, start, terms), unknown, evidence.size)
    if not math.isfinite(solved.cost):
        raise UserError("calibration: no camera agrees with what is marked; are two points swapped?")
    outliers, doubts = list[str](), list[str]()
    while (
        check
        and len(outliers) < len(evidence.points) // 4
        and (wrong := _contradicting(terms, solved, unknown, evidence.size)) is not None
    ):
        outliers.append(terms[wrong[0]].name)
        if wrong[2]:
            doubts.append(
                f"point {outliers[-1]} contradicts the others and is left out, but they agree nearly as well without "
                f"{' or '.join(wrong[2])}: mark these again"
            )
        terms, solved = [term for i, term in enumerate(terms) if i != wrong[0]], wrong[1]
    camera = camera_of(solved.at, evidence.size)
    covariance = np.asarray(np.linalg.pinv(solved.J.T @ solved.J), dtype=np.float64)
    spare = max(1, len(solved.J) - len(unknown))
    if chi2.sf(solved.cost, spare) < _SURPRISE:
        covariance = covariance * solved.cost / spare
    calibration = SiteCalibration(camera, tuple(unknown), covariance, _residuals(terms, camera), tuple(outliers), ())
    return replace(calibration, warnings=(*doubts, *_warnings(evidence, calibration)))


@dataclass(frozen=True, eq=False)
class _Solved:
    at: Array
    """(8,) values of `PARAMETERS`."""
    cost: float
    """Sum of the squares of the residuals, in standard deviations."""
    J: Array
    """(R, P) derivatives of these residuals by the unknown parameters."""
    blocks: tuple[Array, ...] = ()
    """The residuals of each piece of evidence."""


def _best(terms: Sequence[_Term], starts: Sequence[Array], unknown: Sequence[str], size: tuple[int, int]) -> _Solved:
    """The likeliest solution; of many starts those that are ahead after some steps go on."""
    if len(starts) > _FINALISTS:
        begun = [_solved(terms, at, unknown, size, rounds=1, steps=_FIRST_STEPS) for at in starts]
        starts = [fit.at for fit in sorted(begun, key=lambda fit: fit.cost)[:_FINALISTS]]
    return min((_solved(terms, at, unknown, size) for at in starts), key=lambda fit: fit.cost)


def _solved(
    terms: Sequence[_Term],
    begun: Array,
    unknown: Sequence[str],
    size: tuple[int, int],
    *,
    rounds: int = _ROUNDS,
    steps: int = _STEPS,
) -> _Solved:
    """Solve for the unknown parameters; weights are those of the camera of the round before."""
    columns = [PARAMETERS.index(name) for name in unknown]
    at, fit = begun.copy(), None
    for _ in range(rounds):
        camera = camera_of(at, size)
        weights = [np.linalg.inv(np.linalg.cholesky(term.covariance(camera) + 1e-12)) for term in terms]

        def residuals(values: Array, at: Array = at, weights: list[Array] = weights) -> Array:
            moved = at.copy()
            moved[columns] = values
            camera = camera_of(moved, size)
            return np.concatenate([W @ term.residual(camera) for W, term in zip(weights, terms, strict=True)])

        try:
            fit = least_squares(residuals, at[columns], x_scale=_SCALES[columns], method="trf", max_nfev=steps)
        except (ValueError, np.linalg.LinAlgError):
            return _Solved(at, math.inf, np.zeros((1, len(columns))))
        step, at = fit.x - at[columns], at.copy()
        at[columns] = fit.x
        if (np.abs(step) < 1e-6 * _SCALES[columns]).all():
            break
    assert fit is not None
    ends = np.cumsum([len(W) for W in weights])[:-1]
    return _Solved(at, float(2 * fit.cost), np.asarray(fit.jac), tuple(np.split(fit.fun, ends)))


_SCALES: Final = np.array([0.1, 0.05, 1.0, 1.0, 0.5, 0.05, 0.05, 0.05])


def _starts(evidence: Evidence, start: Camera | None, terms: Sequence[_Term]) -> list[Array]:
    """Values of `PARAMETERS` to begin with."""
    if start is not None:
        return [values_of(start)]
    if len(evidence.points) >= FEWEST:
        uv = np.array([point.pixel for point in evidence.points])
        places = np.array([point.place for point in evidence.points])
        # With one wrong point all may be led astray: each is left out once.
        keep = [np.arange(len(uv))]
        if len(uv) >= CHECKED_POINTS:
            keep += [np.delete(np.arange(len(uv)), i) for i in range(len(uv))]
        out = []
        for rows in keep:
            try:
                out.append(values_of(fit_camera(uv[rows], places[rows], evidence.size).camera))
            except UserError:
                continue
        if not out:
            raise UserError("calibration: no camera sees the points so; do they lie on one line, or are two swapped?")
        return sorted(out, key=lambda at: _capped_cost(terms, camera_of(at, evidence.size)))[:2]
    grid = [
        np.array([math.log(share * evidence.size[0]), 0, 0, 0, _HEIGHT_M, math.radians(tilt), 0, 0])
        for share in _LENGTHS
        for tilt in _TILTS_DEG
    ]
    return sorted(grid, key=lambda at: _smooth_cost(terms, camera_of(at, evidence.size)))[:6]


def _capped_cost(terms: Sequence[_Term], camera: Camera) -> float:
    """Sum of the squares of the residuals in standard deviations, each piece of evidence up to 16: one may be wrong."""
    cost = 0.0
    for term in terms:
        off = term.residual(camera)
        cost += min(float(off @ np.linalg.solve(term.covariance(camera) + 1e-12, off)), 16.0)
    return cost


def _smooth_cost(terms: Sequence[_Term], camera: Camera) -> float:
    """What ranks cameras that may be far from right."""
    return sum(float(np.linalg.norm(np.arcsinh(term.residual(camera)))) for term in terms)


def _contradicting(
    terms: Sequence[_Term], solved: _Solved, unknown: Sequence[str], size: tuple[int, int]
) -> tuple[int, _Solved, list[str]] | None:
    """The point without which the others agree so much better that it must be wrong, the camera without it, and the
    names of points of which the same may be said."""
    points = [i for i, term in enumerate(terms) if term.kind == "point"]
    if len(points) < CHECKED_POINTS:
        return None
    # How much the cost falls without each, for a linear model: r (1 - H)^-1 r, H the projection onto the model.
    first = np.cumsum([0, *(len(block) for block in solved.blocks)])
    hat = solved.J @ np.linalg.pinv(solved.J)
    gains = []
    for i in points:
        rows = slice(first[i], first[i + 1])
        free = np.eye(len(solved.blocks[i])) - hat[rows, rows] + 1e-9 * np.eye(len(solved.blocks[i]))
        gains.append(float(solved.blocks[i] @ np.linalg.solve(free, solved.blocks[i])))
    doubted = [points[k] for k in np.argsort(gains)[::-1][:_DOUBTED]]
    without = {i: _solved([term for k, term in enumerate(terms) if k != i], solved.at, unknown, size) for i in doubted}
    worst = min(doubted, key=lambda i: without[i].cost)
    unlikely = chi2.sf(solved.cost - without[worst].cost, 2) < _WRONG / len(points)
    if not unlikely:
        return None
    rivals = [terms[i].name for i in doubted if i != worst and without[i].cost - without[worst].cost < _RIVAL_COST]
    return worst, without[worst], rivals


def _residuals(terms: Sequence[_Term], camera: Camera) -> tuple[Residual, ...]:
    out = []
    for term in terms:
        if term.kind == "lens":
            continue
        off, C = term.residual(camera), term.covariance(camera)
        sigmas = math.sqrt(float(off @ np.linalg.solve(C, off)))
        size = float(np.abs(np.degrees(off)).max()) if term.kind == "parallel lines" else float(np.linalg.norm(off))
        out.append(Residual(term.kind, term.name, size, sigmas))
    return tuple(out)


def _warnings(evidence: Evidence, calibration: SiteCalibration) -> tuple[str, ...]:
    out, places = [], np.array([point.place for point in evidence.points]).reshape(-1, 3)
    if FEWEST <= len(places) < CHECKED_POINTS and not (evidence.lengths or evidence.beliefs):
        out.append(
            f"{len(places)} points: a wrong one among them cannot be found; {CHECKED_POINTS} or more check each other"
        )
    if len(places) >= FEWEST:
        spread = np.linalg.svd(places[:, :2] - places[:, :2].mean(axis=0), compute_uv=False)
        if spread[1] < 0.1 * spread[0]:
            out.append("the points lie nearly on one line: places beside it are not known")
        away = np.linalg.norm(places - calibration.camera.position, axis=1)
        out.append(f"the points lie {away.min():.0f} to {away.max():.0f} m away: places farther off are extrapolated")
    return tuple(out)


# ------------------------------------------------------------------------------------------------------------ numbers


def _by_pixels(camera: Camera, pixels: Array) -> Array:
    """(..., 2, 2) derivatives of the places that pixels (..., 2) show on the road, metres a pixel."""
    return slopes(lambda step: ground_places(camera, pixels + step)[..., :2], np.zeros(2), 0.25)


def _finite_slopes(of: Callable[[Array], Array], at: Array, step: float) -> Array:
    return _finite(slopes(of, at, step))


def _finite(values: Array) -> Array:
    """Residuals of cameras that do not see what is marked are large, not NaN."""
    return np.asarray(np.where(np.isfinite(values), values, 1e3))
