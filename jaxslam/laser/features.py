"""Features of laser scans: straight segments by split and merge, each with its covariance.

On the host by NumPy in float64. Lines are fitted to the ends of beams, weighted by their noise.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxslam.core.types import Beams
from jaxslam.core.validation import (
    InvalidField,
    at_least,
    finite,
    instance_of,
    positive,
    refusals_of,
    require,
)
from jaxslam.math.stats import chi2_quantile

__all__ = ["Segments", "fit_line", "segments"]

_ITERATIONS = 4
"""Gauss-Newton steps of a fit: it is nearly linear, and starts at the total least squares."""
_LEAST_TOWARD = 1e-3
"""Least n·e of a beam, and least noise of an end in σ: a beam along the wall has no information on
the line, and must not have an infinite weight."""


def _ends_of(
    angle: Float[np.ndarray, "n"], distance: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n 2"]:
    """The ends of beams [m]."""
    return np.asarray(distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1))


def fit_line(
    angle: Float[np.ndarray, "n"],
    distance: Float[np.ndarray, "n"],
    sigma: float,
    sigma_angle: float = 0.0,
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2 2"], float]:
    """The line (r, α) through the ends of some beams, its covariance, and χ² of the residuals.

    With e the direction of a beam and n the normal, the wall is met at ρ* = r/(n·e), and the end ρe
    is off the line by d = n·e (ρ - ρ*). To first order d has the variance
    w⁻¹ = (n·e)² σ² + (ρ* n⊥·e)² σ_β². The fit minimizes Σ w d²: first in closed form with weights
    of 1, the total least squares, then by Gauss-Newton steps with the slopes
    g = ∂d/∂(r, α) = (-1, n⊥·ρ*e) at the predicted points; at the measured points the noise in g
    would bias α. The covariance is (Σ w g gᵀ)⁻¹, the bound of Cramér and Rao.

    The normal points away from the laser (n·e > 0), so r may come out below 0 for a wall that the
    laser is nearly on.

    Raises ValueError for a sigma not above 0 or a sigma_angle below 0, beams that are not finite,
    fewer than 2, all the same, or in line with the laser.
    """
    with refusals_of("fit_line"):
        require("sigma", sigma, positive)
        require("sigma_angle", sigma_angle, finite(least=0.0))
        if np.ndim(angle) != 1 or np.shape(angle) != np.shape(distance):
            raise InvalidField(
                "",
                f"expected as many angles as ranges, got shapes {np.shape(angle)} and "
                f"{np.shape(distance)}",
            )
        points = _ends_of(angle, distance)
        if not np.isfinite(points).all():
            raise InvalidField("", "expected finite angles and ranges")
        if len(points) < 2 or not np.ptp(points, axis=0).max() > 0:
            raise InvalidField("", f"expected beams that end at different points, got {len(angle)}")
    e = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    middle = points.mean(axis=0)
    # Start at total least squares: the normal is the direction of least spread, into the wall.
    n = np.linalg.svd(points - middle, full_matrices=len(points) < 2)[2][1]
    n = n * (1.0 if (e @ n).sum() >= 0 else -1.0)
    line = np.array([n @ middle, np.arctan2(n[1], n[0])])
    information = np.eye(2)
    for _ in range(_ITERATIONS):
        n = np.array([np.cos(line[1]), np.sin(line[1])])
        toward, across = e @ n, e @ np.array([-n[1], n[0]])
        toward = np.maximum(toward, _LEAST_TOWARD)
        met = line[0] / toward
        if np.ptp(met * across) <= 1e-9 * max(sigma, np.abs(distance).max()):
            raise InvalidField(
                "", "expected beams whose ends are not in line with the laser", owner="fit_line"
            )
        weight = 1 / ((toward * sigma) ** 2 + (met * across * sigma_angle) ** 2)
        off = toward * distance - line[0]
        # ∂(d n·e - r)/∂(r, α) at the range d at which the beam meets the line.
        slope = np.stack([-np.ones_like(met), met * across], axis=1)
        information = (weight[:, None] * slope).T @ slope
        line = line - np.linalg.solve(information, slope.T @ (weight * off))
    cov = np.linalg.inv(information)
    line[1] = np.arctan2(np.sin(line[1]), np.cos(line[1]))
    return line, cov, float((weight * off**2).sum())


def _misfit_of_parabola(
    angle: Float[np.ndarray, "n"],
    distance: Float[np.ndarray, "n"],
    sigma: float,
    sigma_angle: float = 0.0,
) -> float:
    """The χ² of the residuals of a parabola through the ends of n beams, n - 3 degrees of freedom.

    y = f(x) with x along the line of total least squares. With t its direction and n its normal,
    y - f has to first order the variance (n·e - f' t·e)² σ² + ρ² (t·e + f' n·e)² σ_β².
    """
    e = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points = distance[:, None] * e
    axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
    (x, y), (along, toward) = ((rows @ axes.T).T for rows in (points, e))
    x = x - x.mean()
    scale = np.abs(x).max()
    # |x/scale| <= 1, so that the columns are of one size.
    powers = np.stack([np.ones_like(x), x / scale, (x / scale) ** 2], axis=1)
    slope, off = np.zeros_like(x), y
    for _ in range(_ITERATIONS):
        deviation = np.hypot(
            (toward - slope * along) * sigma, distance * (along + slope * toward) * sigma_angle
        )
        deviation = np.maximum(deviation, _LEAST_TOWARD * sigma)
        coefficients = np.linalg.lstsq(powers / deviation[:, None], y / deviation)[0]
        slope = (coefficients[1] + 2 * coefficients[2] * x / scale) / scale
        off = (y - powers @ coefficients) / deviation
    return float(off @ off)


_SLANT = np.deg2rad(10.0)
"""Least angle between a beam and a wall on which neighbouring beams count as connected."""
_SPLIT = 4.0
"""[σ] from a chord to a point at which a run of points is divided (chosen)."""
_MERGE_GATE = -2 * np.log(0.001)
"""χ² up to which two lines are the same: the 99.9 % quantile of two degrees of freedom."""


class Segments(NamedTuple):
    """The straight segments of a scan, in the frame of the laser, in the order of its beams."""

    line: Float[np.ndarray, "K 2"]
    """(r [m], α [rad]) as `sensors.Line` measures; the normal points into the wall"""
    cov: Float[np.ndarray, "K 2 2"]
    """of the line"""
    ends: Float[np.ndarray, "K 2 2"]
    """first and last point [m], on the line"""
    size: Int[np.ndarray, "K"]
    """number of beams"""
    chi2: Float[np.ndarray, "K"]
    """squared residuals over σ², of size - 2 degrees of freedom where the wall is straight"""
    left: int
    """usable beams outside of all segments"""


def segments(
    beams: Beams,
    *,
    sigma: float,
    max_range: float,
    sigma_angle: float = 0.0,
    least: int = 8,
    trim: int = 2,
    probability: float = 0.999,
) -> Segments:
    """The segments of a scan by split and merge, each line with its covariance.

    Neighbours further apart than a wall at 10° to the beam explains begin a new run. A run is
    divided at the point furthest from its chord, while that is more than 4 σ away (Pavlidis &
    Horowitz 1974); neighbours whose lines agree by the χ² test of their difference are merged, also
    around the seam of a scan all around. Then `trim` beams at each end are given up, since those at
    a corner may be of the other wall, and a line is fitted (`fit_line`). Those of fewer than
    `least` beams are left out, and those of a wall that is not straight: that fail the χ² test of
    their residuals; that a parabola fits better, by the χ² test of its one parameter more; that
    together with a neighbour a parabola fits no worse than two lines, by the same test, as pieces
    of an arc do and walls at a corner do not.

    For n beams that meet the wall steeply, an arc of sagitta h adds λ = (4/45) n (h/σ)² to χ² of
    the second test. At `probability` 0.999 that shows h = 11 σ/√n in one of two segments, and 17
    σ/√n in 95 %: 4 and 6 σ for 8 beams. A flatter arc shows beside its neighbours. In a round room
    of radius 3 m (σ = 2 cm, 90 to 720 beams) at most 0.04 segments a scan remain. A flat arc that
    is seen alone may pass. Two walls are also lost if their corner is too low to be told from an
    arc: one in two where it is 46 σ/√n above their common chord, n beams on both.

    Args:
        beams: of one scan, (B,) each, angles increasing. Where the last is within half a step of a
            full turn from the first, both are one beam.
        sigma: standard deviation of a range [m]. sigma_angle: of a beam's direction [rad].
        max_range: [m]; `Beams` defines the meaning of a range.
        least: number of beams of a segment, at least 3.
        trim: beams given up at each end.
        probability: of a straight wall to pass each test.
    Raises:
        ValueError: on beams of unlike lengths, numbers out of range, angles that do not increase,
            and beams that `fit_line` refuses: their ends coincide, or lie in line with the laser.
    """
    with refusals_of("segments"):
        require("beams", beams, instance_of(Beams))
        angle, distance = (np.asarray(part, np.float64) for part in (beams.angle, beams.range))
        valid = np.asarray(beams.valid, bool)
        if angle.ndim != 1 or not angle.shape == distance.shape == valid.shape:
            raise InvalidField(
                "",
                f"expected one scan, (B,) each, got {angle.shape}, {distance.shape} and "
                f"{valid.shape}",
            )
        require("sigma", sigma, positive)
        if not max_range > 0:
            raise InvalidField("max_range", f"expected a number above 0, got {max_range}")
        require("sigma_angle", sigma_angle, finite(least=0.0))
        require("trim", trim, finite(least=0.0))
        require("least", least, at_least(3))

    # The beams that met an obstacle.
    usable = np.isfinite(angle)
    angle, distance, valid = angle[usable], distance[usable], valid[usable]
    step = np.diff(angle)
    beyond = np.sum(step) - 2 * np.pi
    half = 0.5 * np.median(step) if len(step) else 0.0
    if not (step > 0).all() or not beyond <= half:
        raise InvalidField("", "expected angles that increase within one turn", owner="segments")
    used, _ = Beams(distance, angle, valid).returns(max_range)
    if beyond > -half and used[0]:  # the last beam has the direction of the first
        used[-1] = False
    angle, distance = angle[used], distance[used]
    noise = sigma, sigma_angle

    def line_of(run: Int[np.ndarray, "n"]) -> tuple[np.ndarray, np.ndarray, float]:
        return fit_line(angle[run], distance[run], *noise)

    # Pieces of walls: split, then merged.
    pieces = [
        piece
        for run in _runs(angle, distance, sigma)
        for piece in _divide(run, angle, distance, noise)
        if len(piece) >= 3
    ]
    pieces = _merge(pieces, angle, distance, noise, trim)
    # Without the short ones between them, pieces of one wall may be neighbours.
    long = [piece for piece in pieces if len(piece) >= least]
    pieces = _merge(long, angle, distance, noise, trim)

    # Pieces that are no walls.
    misfit = [line_of(piece)[2] for piece in pieces]
    gain = chi2_quantile(probability, 1)  # of a further parameter

    def parabola_misfit(run: Int[np.ndarray, "n"]) -> float:
        return _misfit_of_parabola(angle[run], distance[run], *noise)

    def is_arc(k: int) -> bool:
        """Whether a piece and its successor belong to a common arc."""
        after = (k + 1) % len(pieces)
        if after == k or not _are_neighbours(pieces[k][-1], pieces[after][0], angle):
            return False
        together = parabola_misfit(np.concatenate([pieces[k], pieces[after]]))
        return together <= misfit[k] + misfit[after] + gain

    arcs = [is_arc(k) for k in range(len(pieces))]

    # Lines.
    rows, counted = [], 0
    for k, piece in enumerate(pieces):
        run = piece[trim : len(piece) - trim]
        # arcs[-1] is the last piece, whose successor is the first.
        if len(run) < least or arcs[k] or arcs[k - 1]:
            continue
        line, cov, chi2 = line_of(run)
        if not chi2 <= min(chi2_quantile(probability, len(run) - 2), parabola_misfit(run) + gain):
            continue
        n = np.array([np.cos(line[1]), np.sin(line[1])])
        ends = _ends_of(angle[run[[0, -1]]], distance[run[[0, -1]]])
        ends = ends - (ends @ n - line[0])[:, None] * n
        rows.append((line, cov, ends, len(run), chi2))
        counted += len(run)
    columns = [np.array(part, np.float64) for part in zip(*rows, strict=True)]
    columns = columns or [np.zeros(0)] * 5
    return Segments(
        line=columns[0].reshape(-1, 2),
        cov=columns[1].reshape(-1, 2, 2),
        ends=columns[2].reshape(-1, 2, 2),
        size=columns[3].astype(int),
        chi2=columns[4],
        left=len(angle) - counted,
    )


def _runs(angle: np.ndarray, distance: np.ndarray, sigma: float) -> list[Int[np.ndarray, "n"]]:
    """Runs of beams without a jump; a scan all around begins after a jump, if it has any."""
    count = len(angle)
    if count < 2:
        return []
    order = np.arange(count)
    after = np.roll(order, -1)
    turn = np.mod(angle[after] - angle, 2 * np.pi)
    near = np.minimum(distance, distance[after])
    # Gap on a wall at the least slant λ, by the law of sines: near sin(Δφ)/sin(λ - Δφ).
    reach = np.where(turn < _SLANT, np.sin(turn) / np.sin(np.maximum(_SLANT - turn, 1e-3)), 0.0)
    points = _ends_of(angle, distance)
    gap = np.linalg.norm(points[after] - points, axis=1)
    breaks = gap > near * reach + 3 * np.sqrt(2) * sigma  # 3 σ of the difference of two ranges
    starts = np.flatnonzero(breaks) + 1
    if not len(starts):  # all around without a jump: from the farthest point, which is a corner
        return [np.roll(order, -int(np.argmax(distance)))]
    order = np.roll(order, -int(starts[0]))
    return np.split(order, np.flatnonzero(breaks[order])[:-1] + 1)


def _divide(
    run: Int[np.ndarray, "n"], angle: np.ndarray, distance: np.ndarray, noise: tuple[float, float]
) -> list[Int[np.ndarray, "n"]]:
    """The straight pieces of a run: divided at the point furthest from the chord, in σ."""
    if len(run) < 3:
        return [run]
    points = _ends_of(angle[run], distance[run])
    chord = points[-1] - points[0]
    length = np.hypot(*chord)
    if length == 0:
        return [run]
    normal = np.array([-chord[1], chord[0]]) / length
    e = points / distance[run][:, None]
    sigma = np.hypot((e @ normal) * noise[0], distance[run] * (e @ chord) / length * noise[1])
    off = np.abs((points - points[0]) @ normal)
    at = int(np.argmax(off[1:-1])) + 1
    # The ends of the chord have noise as well.
    if off[at] <= _SPLIT * np.sqrt(sigma[at] ** 2 + max(sigma[0], sigma[-1]) ** 2):
        return [run]
    return [
        *_divide(run[: at + 1], angle, distance, noise),
        *_divide(run[at + 1 :], angle, distance, noise),
    ]


def _merge(
    pieces: list[Int[np.ndarray, "n"]],
    angle: np.ndarray,
    distance: np.ndarray,
    noise: tuple[float, float],
    trim: int,
) -> list[Int[np.ndarray, "n"]]:
    """Neighbouring pieces joined while their lines agree, the last with the first as well."""

    def fit(piece: Int[np.ndarray, "n"]) -> tuple[np.ndarray, np.ndarray]:
        inner = piece[trim : len(piece) - trim] if len(piece) >= 3 + 2 * trim else piece
        return fit_line(angle[inner], distance[inner], *noise)[:2]

    fits = [fit(piece) for piece in pieces]
    k = 0
    while k < len(pieces) and len(pieces) > 1:
        after = (k + 1) % len(pieces)
        gap = fits[after][0] - fits[k][0]
        gap[1] = np.arctan2(np.sin(gap[1]), np.cos(gap[1]))
        near = _are_neighbours(pieces[k][-1], pieces[after][0], angle)
        if near and gap @ np.linalg.solve(fits[k][1] + fits[after][1], gap) <= _MERGE_GATE:
            joined = np.concatenate([pieces[k], pieces[after]])
            pieces[k], fits[k] = joined, fit(joined)
            del pieces[after], fits[after]
            # The piece before may agree with the joined one; its index fell if `after` was the
            # first piece.
            k = max(k - 1 - (after < k), 0)
        else:
            k += 1
    return pieces


def _are_neighbours(last: int, first: int, angle: np.ndarray) -> bool:
    """Whether two beams are neighbours in direction, but for a few that are missing."""
    return bool(np.mod(angle[first] - angle[last], 2 * np.pi) < _SLANT)
