"""Is the covariance honest that a robot published while a reference watched it? One recording.

A campaign has many independent runs; a recording has one, in which the errors of consecutive poses
are correlated. How many independent errors it amounts to is estimated, and every interval is as
wide as that number makes it.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from jaxslam.consistency._correlated import error_of_sum, mean_of, mean_square, share_within
from jaxslam.consistency._intervals import LEVEL, Average, percentage
from jaxslam.consistency._measures.nees import DOF
from jaxslam.consistency._recorded_errors import AXES, SHORTEST, STEPS, Alignment, Claims, Rows
from jaxslam.consistency._verdict import TOLERANCE
from jaxslam.consistency.metrics._paths import alignment
from jaxslam.core._table import Row, Table, text_of
from jaxslam.core._units import are_headings_in_degrees
from jaxslam.core.validation import (
    InvalidField,
    array_of,
    one_of,
    or_none,
    positive,
    refusals_of,
    require,
)
from jaxslam.math.numpy_poses import compose
from jaxslam.math.stats import chi2_quantile, t_quantile

COMPONENTS = ("along", "across", "heading")
"""The components of the error, in the axes of the estimate."""

LEVELS = (0.5, 0.9, 0.95, 0.99)
"""Levels of the ellipsoids whose coverage is counted."""

ALIGNMENTS = ("none", "first", "best")
FRAMES = ("world", "body")

_FAULTY = 0.05
"""Share of the poses without a valid covariance beyond which the others do not decide, as of the
runs of a campaign."""

_SHARE_OF_FRAMES = 0.1
"""Share of the position errors that the best rigid motion leaves, below which the estimate and the
truth may be in two frames."""


class RecordedBlock(NamedTuple):
    """The NEES of a block of the pose error over a recording."""

    poses: int
    """number of poses with a valid covariance of the block"""
    nees: Average
    honest: tuple[float, float]
    """the range of an honest mean NEES: the degrees of freedom, less what an alignment takes"""
    independent: float
    """number of independent errors with the same spread of the mean NEES"""
    coverage: Mapping[float, Average]
    """share of the poses whose error lies in the claimed ellipsoid, by its level"""
    honest_coverage: Mapping[float, tuple[float, float]]


class ClockLag(NamedTuple):
    """The time by which the estimate is behind the truth, and the NEES without it."""

    seconds: Average
    """positive where the estimate at a stamp is the pose of an earlier time"""
    error: float
    """standard error [s]"""
    nees: Mapping[str, Average]
    """NEES of each block with the truth shifted by the lag"""
    verdict: str


class RecordedErrors(NamedTuple):
    """Errors, truth minus estimate, in the axes of the estimate, at n times."""

    time: Float[np.ndarray, "n"]
    """[s]"""
    error: Float[np.ndarray, "n 3"]
    """along, across and heading [m, m, rad]"""
    sigma: Float[np.ndarray, "n 3"]
    """claimed standard deviations; NaN without a valid covariance"""
    pose: Float[np.ndarray, "n 3"]
    """the estimate"""
    truth: Float[np.ndarray, "n 3"]
    """the truth at the time of the estimate, in its frame"""


@dataclass(frozen=True, eq=False)
class RecordingScores:
    """NEES, coverage, factors of σ and clock lag of a recording; prints as a table.

    Intervals have the level 95 %. What needs a covariance is empty if there is none.
    """

    verdict: str
    """consistent, optimistic, pessimistic, incomplete or undecided"""
    errors: RecordedErrors
    rmse: Mapping[str, float]
    """root of the mean square of each component [m, m, rad]"""
    mean: Mapping[str, Average]
    """mean of each component"""
    blocks: Mapping[str, RecordedBlock]
    """pose, position and heading, as far as they have a valid covariance"""
    factors: Mapping[str, Average]
    """factor by which the claimed σ of each component is too small"""
    lag: ClockLag | None
    """None if the motion does not determine it"""
    dropped: Mapping[str, int]
    """numbers of poses that are not compared, or not judged, by reason"""
    doubts: tuple[str, ...]
    """sentences that qualify the verdict, and on alignment and lag"""

    def rows(self) -> list[Row]:
        """The table: label; value with interval, honest value, number of independent errors."""
        time = self.errors.time
        span = time[-1] - time[0]
        rows = [
            Row("verdict", [self.verdict + "*" * bool(self.doubts), "consistent", ""]),
            Row("poses compared", [f"{len(time):,} over {span:,.4g} s", "", ""]),
        ]
        for name, block in self.blocks.items():
            honest = _range_text(block.honest)
            count = f"{block.independent:,.0f} of {block.poses:,}"
            rows.append(Row(f"NEES, {name}", [_text(block.nees), honest, count]))
        for name, block in self.blocks.items():
            for level, share in block.coverage.items():
                ends = tuple(100 * end for end in block.honest_coverage[level])
                label = f"within the {percentage(level)} set, {name}"
                rows.append(Row(label, [_text(share, 100.0), _range_text(ends), ""], "%"))
        for name, factor in self.factors.items():
            rows.append(Row(f"σ too small by, {name}", [_text(factor), "1", ""]))
        for name in COMPONENTS:
            unit, scale = ("°", np.rad2deg(1.0)) if name == "heading" else ("m", 1.0)
            rows.append(Row(f"RMSE, {name}", [f"{scale * self.rmse[name]:.3g}", "", ""], unit))
            rows.append(Row(f"mean error, {name}", [_text(self.mean[name], scale), "", ""], unit))
        if self.lag is not None:
            rows.append(Row("lag of the estimate", [_text(self.lag.seconds, 1e3), "0", ""], "ms"))
            rows.append(Row("  its standard error", [f"{1e3 * self.lag.error:.2g}", "", ""]))
            for name, nees in self.lag.nees.items():
                honest = _range_text(self.blocks[name].honest)
                rows.append(Row(f"  NEES without it, {name}", [_text(nees), honest, ""]))
            if self.lag.nees:
                rows.append(Row("  verdict without it", [self.lag.verdict, "", ""]))
        return rows

    def __str__(self) -> str:
        heads = "", f"value [{percentage(LEVEL)}]", "honest", "independent errors"
        dropped = [f"{count:,} of the poses: {reason}" for reason, count in self.dropped.items()]
        doubts = [f"* {doubt}" for doubt in self.doubts]
        table = text_of(Table(heads, self.rows()))
        return "\n".join([table, *([""] * bool(dropped or doubts)), *dropped, *doubts])


def judge_recording(
    estimate: tuple[ArrayLike, ArrayLike, ArrayLike | None],
    truth: tuple[ArrayLike, ArrayLike],
    *,
    align: str = "none",
    covariance_frame: str = "world",
    longest_gap: float | None = None,
) -> RecordingScores:
    """The scores of recorded poses: errors, compared with the covariances that were claimed.

    With the estimate (x̂, ŷ, θ̂) at a time, its claimed covariance P and the truth (x, y, θ),
    interpolated on SE(2), the error is e = (R(θ̂)ᵀ (p - p̂), θ - θ̂): along, across, heading. Its
    NEES is q = eᵀ P⁻¹ e, with P in the same axes; blocks of e and P give those of position and
    heading. An honest q has the mean d = 3, 2 or 1, and its ellipsoid of level p, {q <= χ²_d(p)},
    covers the truth with probability p.

    **Intervals.** With e and P in the axes of the world write P = L Lᵀ, z = L⁻¹ e, so q = zᵀz, and
    C_k = (1/n) Σ z_t z_{t+k}ᵀ. For Gaussian errors cov(q_t, q_{t+k}) = 2 |C_k|² (Frobenius;
    Isserlis 1918), so that

        var q̄ = (2/n) Σ_k |C_k|²,    ν = 2 q̄²/var q̄,    ν q̄/E q ~ χ²_ν approximately,

    the effective number of Bayley & Hammersley 1946, "The effective number of independent
    observations in an autocorrelated time series", Suppl. JRSS 8, with the degrees of freedom of
    Satterthwaite 1946. ν/d independent errors have the same spread. C_k is not centred: an error
    that stays is one error, however often it is seen. The sum ends where |C_k|² first is no larger
    than independent errors have it, and is without what such noise adds (Bartlett 1946). Where the
    autocovariances of q itself, over the same lags, have a larger sum, they take the place of
    2 |C_k|²: with heavy tails, or a correlation that changes along the way. Errors that are
    correlated over K poses show ν in some n/2K stretches, so intervals take ν (z/t)², with the
    quantiles of the normal and of Student's t with n/2K degrees of freedom (as Korn & Graubard
    1998, "Confidence intervals for proportions with small expected number of positive counts",
    Survey Methodology 24). Factors of σ are √(mean z_i²), z_i = e_i/σ_i, with the roots of that
    interval. Coverage has the interval of Jeffreys, with the number of independent indicators of
    q <= χ²_d(p) that follows from the same correlation (Kibble 1941) in place of the number of
    poses. `python -m benchmarks --only recordings` measures how often they hold.

    **Lag.** The least-squares δ and b of e_t = δ ξ_t + b, with ξ the velocity of the truth in the
    axes of the estimate and b a constant offset, components weighted by their variance; the truth
    is shifted by δ and the fit repeated. Its standard error is that of correlated residuals
    r: with scores ψ_t = ξ_tᵀ W r_t, √(Σ_k Σ_t ψ_t ψ_{t+k})/Σ ξᵀ W ξ. A constant velocity
    determines no lag, as it cannot be told from an offset.

    **Alignment.** Without one the estimate and the truth are in one frame. "first" carries the
    truth so that the first errors vanish. That error is then in all of the others; whether it adds
    to them, as where a filter forgets it, or is contained in them, as in odometry, P does not say:
    honest is a mean NEES of d ∓ mean tr P⁻¹ J P₀ Jᵀ, with J P₀ Jᵀ the covariance of the first error
    carried to each pose. "best" carries the truth by the rigid motion a that minimizes Σ eᵀ P⁻¹ e,
    which takes with it the error that all poses share: honest is d (1 - 2g) to d, with g the
    expected share of Σ eᵀ P⁻¹ e that it takes, from the long-run covariance of the gradients
    Jᵀ P⁻¹ e. A constant offset between the two frames cannot be seen then.

    **Covariances** that are zero, not finite, not symmetric, singular, above 1e4 m² or rad², of
    -1 first, which in ROS is an unknown one, or constant from beginning to end, which no filter
    computes, are counted in `dropped`, and not judged. Position and heading are judged apart.

    **Verdict**: the first that holds. optimistic: the interval of the pose NEES (or of position or
    heading, if the pose has none) lies above the honest values. incomplete: under 95 % of the
    poses have a valid covariance. pessimistic: it lies below. undecided: a NEES of twice the honest
    one would not have been noticed either. Else consistent, which proves nothing.

    Args:
        estimate: times (n,) [s], rising; poses (n, 3); and covariances (n, 3, 3) of (x, y, θ), or
            None for the errors alone.
        truth: times (m,) and poses (m, 3).
        align: "none", "first" or "best".
        covariance_frame: the axes of x and y in the covariances: "world", or "body" for along and
            across.
        longest_gap: the longest interval of the truth that is interpolated [s]; default ten times
            its median.
    Raises:
        ValueError: on other shapes, times that do not rise, poses that are not finite, headings
            that fit the positions in degrees, fewer than two times of the estimate at which the
            truth is known.
    """
    with refusals_of("judge_recording"):
        require("align", align, one_of(*ALIGNMENTS))
        require("covariance_frame", covariance_frame, one_of(*FRAMES))
        require("longest_gap", longest_gap, or_none(positive))
        time, pose = require("estimate", estimate[:2], _stamped_poses)
        clock, path = require("truth", truth, _stamped_poses)
        cov = None
        if estimate[2] is not None:
            cov = np.asarray(estimate[2], np.float64)
            require("estimate: covariances", cov, array_of(len(time), 3, 3))
    # The truth at the times of the estimate, in one frame with it, and the errors that are claimed.
    rows = Rows(time, pose, clock, path, longest_gap)
    true, is_known = rows.truth()
    if is_known.sum() < 2:
        raise InvalidField(
            "",
            f"expected at least two times of the estimate, {time[0]:.12g} to {time[-1]:.12g} s, at "
            f"which the truth is known, {clock[0]:.12g} to {clock[-1]:.12g} s, got "
            f"{int(is_known.sum())}",
            owner="judge_recording",
        )
    claims = Claims.of(cov, pose, covariance_frame)
    aligned = Alignment.of(align, claims, pose, true, is_known)
    is_compared = is_known.copy()
    if align == "first":
        is_compared[np.argmax(is_known)] = False  # its error is zero by construction
    judged = {name: claims.valid[name] & is_compared for name in DOF}
    of_poses = time, aligned.error, claims.sigma(), pose, aligned.truth
    errors = RecordedErrors(*(part[is_compared] for part in of_poses))
    is_outside = (time < clock[0]) | (time > clock[-1])
    left_out = {
        "before the first or after the last time of the truth": is_outside & ~is_known,
        "in a gap of the truth": ~is_outside & ~is_known,
        "the first, to which the truth is aligned": is_known & ~is_compared,
        **{reason: faulty & is_compared for reason, faulty in claims.faults.items()},
    }

    # The scores: NEES by block, factors of σ by component, the lag of the clocks.
    blocks = _blocks(aligned, judged)
    factors = {}
    for k, name in enumerate(COMPONENTS):
        valid = judged["heading" if name == "heading" else "position"]
        if valid.sum() > 1:
            factors[name] = _sigma_factor(aligned, k, valid)
    lag, note = _clock_lag(rows, claims, align, is_compared, judged)

    # What qualifies them.
    doubts = list(aligned.notes)
    if align == "none":
        doubts += _doubt_on_frames(errors.pose, errors.truth)
    if cov is None:
        doubts.append("the estimate has no covariance: its errors alone are measured")
    elif not blocks:
        doubts.append("no covariance can be judged")
    doubts += [note] * bool(note)
    return RecordingScores(
        verdict=_verdict(blocks, int(is_compared.sum())),
        errors=errors,
        rmse=dict(zip(COMPONENTS, np.sqrt((errors.error**2).mean(axis=0)).tolist(), strict=True)),
        mean={name: mean_of(errors.error[:, k]) for k, name in enumerate(COMPONENTS)},
        blocks=blocks,
        factors=factors,
        lag=lag,
        dropped={reason: int(mask.sum()) for reason, mask in left_out.items() if mask.any()},
        doubts=tuple(doubts),
    )


def _stamped_poses(
    value: tuple[ArrayLike, ArrayLike],
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n 3"]]:
    """The check of times and poses, in float64: the times rise, and all is finite."""
    time, pose = (np.asarray(numbers, np.float64) for numbers in value)
    if time.ndim != 1 or pose.shape != (len(time), 3) or not len(time):
        raise ValueError(f"expected times (n,) and poses (n, 3), got {time.shape} and {pose.shape}")
    finite = np.isfinite(time) & np.isfinite(pose).all(axis=1)
    if not finite.all():
        raise ValueError(f"expected finite times and poses, row {int(np.argmin(finite))} is not")
    if back := np.flatnonzero(np.diff(time) <= 0).tolist():
        before, after = time[back[0] : back[0] + 2]
        raise ValueError(
            f"expected times that rise, got {after} in row {back[0] + 1} after {before}"
        )
    if are_headings_in_degrees(pose):
        raise ValueError("expected headings in radians, got some that fit the positions in degrees")
    return time, pose


def _doubt_on_frames(pose: Float[np.ndarray, "n 3"], truth: Float[np.ndarray, "n 3"]) -> list[str]:
    """A sentence where nearly all of the position errors are one rigid motion, as of two frames."""
    if not np.ptp(truth[:, :2], axis=0).any():  # positions show no turn
        return []
    carried = compose(alignment(truth[:, :2], pose[:, :2]), truth)
    before, after = (
        float(np.sqrt(((path[:, :2] - pose[:, :2]) ** 2).sum(axis=1).mean()))
        for path in (truth, carried)
    )
    if not after < _SHARE_OF_FRAMES * before:
        return []
    return [
        f"one rigid motion of the truth reduces its distance from the estimate from {before:.3g} m "
        f"to {after:.3g} m (RMS): if the two are in different frames, align best"
    ]


def _blocks(
    aligned: Alignment, judged: Mapping[str, Bool[np.ndarray, "n"]]
) -> dict[str, RecordedBlock]:
    """The scores of each block that has two poses, at the poses where it is judged."""
    blocks = {}
    for name, valid in judged.items():
        if valid.sum() < 2:
            continue
        axes, dof = AXES[name], DOF[name]
        # In the axes of the world, where an error that stays does not turn with the robot
        turn = aligned.claims.turn[valid]
        cov = np.swapaxes(turn, 1, 2) @ aligned.claims.cov[valid] @ turn
        error = np.swapaxes(turn, 1, 2) @ aligned.error[valid, :, None]
        z = np.linalg.solve(np.linalg.cholesky(cov[:, axes, axes]), error[:, axes])[..., 0]
        honest = aligned.honest(name, valid)
        nees = mean_square(z, 1 - sum(honest) / (2 * dof))
        square = (z**2).sum(axis=1)
        coverage, honest_coverage = {}, {}
        for level in LEVELS:
            bound = chi2_quantile(level, dof)
            coverage[level] = share_within(square <= bound, level, dof, nees)
            # Of errors whose NEES is honest/dof times χ²
            low, high = (
                float(scipy.special.gammainc(dof / 2, bound * dof / end / 2)) if end > 0 else 1.0
                for end in reversed(honest)
            )
            honest_coverage[level] = low, high
        blocks[name] = RecordedBlock(
            int(valid.sum()), nees.average, honest, nees.nu / dof, coverage, honest_coverage
        )
    return blocks


def _sigma_factor(aligned: Alignment, k: int, valid: Bool[np.ndarray, "n"]) -> Average:
    """√(mean (e_k/σ_k)²): the factor by which the claimed σ of component k is too small.

    An alignment makes the honest mean square of e_k/σ_k a range: the interval is as wide as that
    range has it, and the value is beside its middle.
    """
    scaled = aligned.error[valid, k] / np.sqrt(aligned.claims.cov[valid, k, k])
    low, high = aligned.honest(k, valid)
    honest = (low + high) / 2
    square = mean_square(scaled[:, None], 1 - honest).average
    return Average(
        float(np.sqrt(square.value / honest)),
        float(np.sqrt(square.low / high)),
        float(np.sqrt(square.high / low)) if low > 0 else np.inf,
    )


def _verdict(blocks: Mapping[str, RecordedBlock], compared: int) -> str:
    """The verdict by the first block that is judged, of so many poses that are compared."""
    if not blocks:
        return "incomplete"
    block = next(iter(blocks.values()))
    nees, (low, high) = block.nees, block.honest
    if nees.low > high and nees.high > high * (1 + TOLERANCE):
        return "optimistic"
    if block.poses < (1 - _FAULTY) * compared:
        return "incomplete"
    if nees.high < low and nees.low < low / (1 + TOLERANCE):
        return "pessimistic"
    # Narrow enough to notice a NEES of twice the honest one.
    return "consistent" if nees.low > nees.value / 2 else "undecided"


def _clock_lag(
    rows: Rows,
    claims: Claims,
    align: str,
    is_compared: Bool[np.ndarray, "n"],
    judged: Mapping[str, Bool[np.ndarray, "n"]],
) -> tuple[ClockLag | None, str]:
    """The δ of e_t = δ ξ_t + b by least squares, and a sentence on it or on why there is none.

    Centring e and ξ removes b, so δ = Σ ξᵀ W e / Σ ξᵀ W ξ. The truth is shifted by δ, and the fit
    repeated, since ξ and the frame change along a curve.
    """
    lag = 0.0
    for _ in range(STEPS):
        truth, is_known = rows.truth(lag)
        aligned = Alignment.of(align, claims, rows.pose, truth, is_known)
        velocity, moves = rows.velocity(lag)
        kept = is_compared & is_known & moves
        # A lag of half of the recording is no lag: what is left then decides nothing.
        if kept.sum() < 3 or 2 * kept.sum() < is_compared.sum():
            return None, "no lag: too few poses at which the velocity of the truth is known"
        error, velocity = aligned.error[kept], velocity[kept]
        variance = error.var(axis=0)
        weight = 1 / np.where(variance > 0, variance, 1.0)
        error, change = error - error.mean(axis=0), velocity - velocity.mean(axis=0)
        information = float((change**2 * weight).sum())
        # The part of a velocity that rounding makes of a constant one.
        if not information > 1e-12 * float((velocity**2 * weight).sum()):
            return None, "no lag: the velocity is constant, and a lag is like an offset then"
        step = float((change * weight * error).sum()) / information
        lag += step
        if abs(step) < SHORTEST:
            break

    residual = error - step * change
    spread, dof = error_of_sum((change * weight * residual).sum(axis=1, keepdims=True))
    deviation = spread / information
    half = t_quantile(0.5 + LEVEL / 2, dof) * deviation

    # The NEES of the errors that the truth, shifted by the lag, leaves.
    truth, is_known = rows.truth(lag)
    aligned = Alignment.of(align, claims, rows.pose, truth, is_known)
    blocks = _blocks(aligned, {name: valid & is_known for name, valid in judged.items()})
    nees = {name: block.nees for name, block in blocks.items()}
    verdict = _verdict(blocks, int((is_compared & is_known).sum()))
    note = ""
    if abs(lag) > half and blocks:
        note = (
            f"the estimate is {abs(1e3 * lag):.3g} ms {'behind' if lag > 0 else 'ahead of'} the "
            f"truth; without that lag the NEES is {next(iter(nees.values())).value:.3g}, and the "
            f"verdict {verdict}"
        )
    return ClockLag(Average(lag, lag - half, lag + half), deviation, nees, verdict), note


def _text(average: Average, scale: float = 1.0) -> str:
    """A number with its interval."""
    value, low, high = (f"{scale * number:.3g}" for number in average)
    return f"{value} [{low}, {high}]".replace("inf", "∞")


def _range_text(ends: tuple[float, ...]) -> str:
    low, high = (f"{end:.3g}" for end in ends)
    return low if low == high else f"{low} to {high}"
