"""NEES: eᵀ P⁻¹ e of a pose and of its blocks, e = truth - estimate, in (x, y, θ) and in the
error coordinates of the filter, and of landmarks; on the host, by NumPy in float64.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxslam.consistency._intervals import LEVEL
from jaxslam.consistency._measures.measure import Measure, Nees, Runs, RunScores, Sums, ratio
from jaxslam.core.protocols import Chart, Sensor
from jaxslam.core.types import Trace, Truth
from jaxslam.core.validation import InvalidField
from jaxslam.math._pose_covariances import asymmetry, inverse_deviations
from jaxslam.math.stats import chi2_quantiles

DOF = {"pose": 3, "position": 2, "heading": 1}
"""Blocks of the pose error with a NEES, and its honest mean."""


@dataclass(frozen=True, eq=False)
class NeesMeasure(Measure):
    """The NEES of a block of `Runs.nees`. That of a pose block has a curve with a band."""

    positive: bool = True
    block: str = ""

    def of_runs(self, runs: Runs) -> RunScores:
        """The sum of the NEES over the steps with a regular covariance."""
        value, regular = runs.nees[self.block]
        sums = {self.key: value, f"regular_{self.block}": regular.astype(np.float64)}
        return RunScores(value.sum(axis=1), regular.sum(axis=1), sums if self.block in DOF else {})

    def curves(self, sums: Sums, runs: int) -> dict[str, np.ndarray]:
        """The average NEES, its 95 % band, and over how many runs it is."""
        if self.block not in DOF:
            return {}
        count, dof = sums[f"regular_{self.block}"], DOF[self.block]
        safe, tail = np.maximum(count, 1), (1 - LEVEL) / 2
        band = {"low": tail, "high": 1 - tail}
        edges = {end: chi2_quantiles(p, dof * safe) / safe for end, p in band.items()}
        return {
            self.key: ratio(sums[self.key], count),
            **{f"{self.key}_{end}": np.where(count > 0, x, np.nan) for end, x in edges.items()},
            f"runs_{self.block}": count,
        }


MEASURES = tuple(
    NeesMeasure(
        f"nees_{block}",
        label,
        honest=dof,
        block=block,
        figure="nees" if block in DOF else "",
        axis=f"{block} NEES (dof {dof})",
        better="honest" if block == "pose" else "",
    )
    for block, label, dof in (
        ("pose", "pose NEES (x, y, θ)", DOF["pose"]),
        ("own", "pose NEES, in its chart", DOF["pose"]),
        ("position", "position NEES", DOF["position"]),
        ("heading", "heading NEES", DOF["heading"]),
        ("landmarks", "landmark NEES", 2),
    )
)


def inside_bands(curves: Mapping[str, np.ndarray]) -> dict[str, float]:
    """The share of the steps whose average NEES lies in its band, by block."""
    shares = {}
    for block in DOF:
        mean, has = curves[f"nees_{block}"], curves[f"runs_{block}"] > 0
        if has.any():
            low, high = curves[f"nees_{block}_low"], curves[f"nees_{block}_high"]
            shares[block] = float(np.mean((mean >= low)[has] & (mean <= high)[has]))
    return shares


def pose_error(
    truth: Float[np.ndarray, "*steps 3"], pose: Float[np.ndarray, "*steps 3"]
) -> Float[np.ndarray, "*steps 3"]:
    """The error truth - estimate of a pose, heading wrapped to (-π, π]."""
    error = np.asarray(truth, np.float64) - np.asarray(pose, np.float64)
    turn = error[..., 2]
    error[..., 2] = turn - 2 * np.pi * np.ceil((turn - np.pi) / (2 * np.pi))
    return error


def block_nees(
    pose: Float[np.ndarray, "*steps 3"],
    error: Float[np.ndarray, "*steps 3"],
    chart_error: Float[np.ndarray, "*steps 3"],
    cov: Float[np.ndarray, "*steps 3 3"],
) -> dict[str, Nees]:
    """The NEES of each block of `DOF`, and of the error in the coordinates of the filter ("own").

    A step has no NEES in three cases:

    - P is singular, that is, a direction is known exactly: 1/tr P⁻¹, between a third of the least
      eigenvalue and all of it, is at most 100 n·eps, for P scaled to a diagonal of at most 1, x and
      y by one unit.
    - A claimed deviation is what rounding makes of zero: at most 32 ulp of the coordinate, of π for
      the heading and of max(|x|, |y|) for the position. So particles that are copies of one
      particle, whose sample covariance is rounding, have no NEES, instead of 1e27.
    - P is not symmetric (`covariance_faults`).

    Args:
        pose: the estimated pose.
        error, chart_error: the error in (x, y, θ), and in the filter's coordinates.
        cov: P, the claimed covariance. Its dtype gives eps.

    Raises:
        ValueError: if the shapes differ.
    """
    shapes = [np.shape(array) for array in (pose, error, chart_error, cov)]
    if shapes != [pose.shape] * 3 + [(*pose.shape, 3)] or pose.shape[-1:] != (3,):
        raise InvalidField(
            "",
            "expected pose, error and chart_error of one shape (..., 3) and cov of "
            f"(..., 3, 3), got {', '.join(map(str, shapes))}",
            owner="block_nees",
        )
    eps = float(np.finfo(cov.dtype).eps)
    # A covariance that is none may overflow; its steps are masked below.
    with np.errstate(all="ignore"):
        unit = inverse_deviations(pose, cov, eps)
        scaled = {
            (i, j): cov[..., i, j] * unit[i] * unit[j] for i in range(3) for j in range(i + 1)
        }
        factor, pivots = _cholesky(scaled, eps)
        nees = {}
        for name, e in (("pose", error), ("own", chart_error)):
            squares, finite = _whiten(factor, e, unit)
            # The two leading rows of the factor are the position's. The error in the filter's
            # coordinates has no such block.
            for block, k in (("position", 2), ("pose", 3)):
                if name == "pose" or block == "pose":
                    regular = (
                        (_least_eigenvalue(factor, pivots, k) > 100 * k * eps)
                        & _all(finite[:k])
                        & (asymmetry(cov, unit, k) <= np.cbrt(eps))
                    )
                    value = np.where(regular, sum(squares[:k]), 0.0)
                    nees[block if name == "pose" else name] = Nees(value, regular)
        turn = error[..., 2]
        regular = (scaled[2, 2] > 100 * eps) & np.isfinite(turn)
        square = (turn * unit[2]) ** 2 / np.where(regular, scaled[2, 2], 1.0)
        nees["heading"] = Nees(np.where(regular, square, 0.0), regular)
    return nees


def chart_error_of(chart: Chart, sensor: Sensor, trace: Trace, truth: Truth) -> Float[Array, "T 3"]:
    """The pose error in the filter's coordinates, brought to (x, y, θ) by its basis.

    ξᵀ P_ξ⁻¹ ξ = (E ξ)ᵀ P⁻¹ (E ξ) with P = E P_ξ Eᵀ as the filter reports it.
    """
    ground = jnp.zeros(len(sensor.landmark), truth.pose.dtype)

    def error_at(pose: Array, true_pose: Array) -> Array:
        dx, _ = chart.local(pose, ground, true_pose, ground)
        return dx if chart.basis is None else chart.basis(pose, ground).pose @ dx

    return jax.vmap(error_at)(jnp.asarray(trace.estimate.pose), jnp.asarray(truth.pose))


def _cholesky(
    matrix: dict[tuple[int, int], np.ndarray], eps: float
) -> tuple[dict[tuple[int, int], np.ndarray], list[np.ndarray]]:
    """The lower factor of 3×3 matrices, entry by entry, and its pivots before the root is taken.

    A pivot not above 3 eps times its diagonal entry counts as zero, as do the entries below it:
    np.linalg.cholesky raises an error for the whole stack where one of its matrices is singular.
    """
    factor: dict[tuple[int, int], np.ndarray] = {}
    pivots = []
    for j in range(3):
        pivot = matrix[j, j] - sum(factor[j, k] ** 2 for k in range(j))
        good = pivot > 3 * eps * np.abs(matrix[j, j])
        pivots.append(np.where(good, pivot, 0.0))
        root = np.sqrt(np.where(good, pivot, 1.0))
        factor[j, j] = np.where(good, root, 0.0)
        for i in range(j + 1, 3):
            rest = matrix[i, j] - sum(factor[i, k] * factor[j, k] for k in range(j))
            factor[i, j] = np.where(good, rest / root, 0.0)
    return factor, pivots


def _whiten(
    factor: dict[tuple[int, int], np.ndarray], error: np.ndarray, unit: list[np.ndarray]
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """The squares of L⁻¹e by coordinate, and whether the error is finite there."""
    finite = [np.isfinite(error[..., i]) for i in range(3)]
    rows: list[np.ndarray] = []
    for i in range(3):
        rest = np.where(finite[i], error[..., i], 0.0) * unit[i]
        rest = rest - sum(factor[i, k] * rows[k] for k in range(i))
        regular = factor[i, i] > 0
        rows.append(np.where(regular, rest / np.where(regular, factor[i, i], 1.0), 0.0))
    return [row**2 for row in rows], finite


def _least_eigenvalue(
    factor: dict[tuple[int, int], np.ndarray], pivots: list[np.ndarray], size: int
) -> np.ndarray:
    """1/tr (L Lᵀ)⁻¹ of the leading block, between a third of its least eigenvalue and all of it; 0
    where a pivot is."""
    positive = _all([pivot > 0 for pivot in pivots[:size]])
    rows: dict[tuple[int, int], np.ndarray] = {}
    for i in range(size):
        inverse = 1.0 / np.where(factor[i, i] > 0, factor[i, i], 1.0)
        rows[i, i] = inverse
        for j in range(i):
            rows[i, j] = -inverse * sum(factor[i, k] * rows[k, j] for k in range(j, i))
    inverse_trace: np.ndarray = np.where(positive, 1.0 / sum(row**2 for row in rows.values()), 0.0)
    return inverse_trace


def _all(flags: list[np.ndarray]) -> np.ndarray:
    conjunction: np.ndarray = np.logical_and.reduce(flags)
    return conjunction
