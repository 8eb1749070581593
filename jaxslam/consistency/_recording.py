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

from jaxslam.consistency._intervals import LEVEL, Average, percentage
from jaxslam.consistency._measures.nees import DOF
from jaxslam.consistency._verdict import TOLERANCE
from jaxslam.consistency.metrics._paths import alignment
from jaxslam.core._table import Row, Table, text_of
from jaxslam.core._units import are_headings_in_degrees
from jaxslam.core.logs._streams import geodesic_poses, known_poses
from jaxslam.core.validation import (
    InvalidField,
    array_of,
    one_of,
    or_none,
    positive,
    refusals_of,
    require,
)
from jaxslam.math._definite import is_asymmetric, is_invertible
from jaxslam.math.numpy_poses import compose, inverse, wrapped
from jaxslam.math.stats import chi2_quantile, normal_quantile, t_quantile

COMPONENTS = ("along", "across", "heading")
"""The components of the error, in the axes of the estimate."""

LEVELS = (0.5, 0.9, 0.95, 0.99)
"""Levels of the ellipsoids whose coverage is counted."""

ALIGNMENTS = ("none", "first", "best")
FRAMES = ("world", "body")

LARGEST = 1e4
"""A variance above it [m², rad²] stands for an unknown coordinate: 1e6 and 99999 are usual."""

_AXES = {"pose": slice(0, 3), "position": slice(0, 2), "heading": slice(2, 3)}
"""The rows of the error of each block of `DOF`."""

_FAULTY = 0.05
"""Share of the poses without a valid covariance beyond which the others do not decide, as of the
runs of a campaign."""

_SHARE_OF_FRAMES = 0.1
"""Share of the position errors that the best rigid motion leaves, below which the estimate and the
truth may be in two frames."""

_HALF = 0.1
"""Half of the time over which the velocity of the truth is taken [s], at least: the noise of a
motion capture at 100 Hz, 1 mm, is then 7 mm/s, and a robot's velocity hardly changes."""

_ORDERS = 30
"""Orders of the correlation of indicators; the shares of higher ones are taken for independent."""

_STEPS, _SHORTEST = 10, 1e-7
"""Gauss-Newton steps to the lag at most, and the step [s] that ends them."""


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
    rows = _Rows(time, pose, clock, path, longest_gap)
    true, is_known = rows.truth()
    if is_known.sum() < 2:
        raise InvalidField(
            "",
            f"expected at least two times of the estimate, {time[0]:.12g} to {time[-1]:.12g} s, at "
            f"which the truth is known, {clock[0]:.12g} to {clock[-1]:.12g} s, got "
            f"{int(is_known.sum())}",
            owner="judge_recording",
        )
    dropped: dict[str, int] = {}
    outside = (time < clock[0]) | (time > clock[-1])
    if count := int((outside & ~is_known).sum()):
        dropped["before the first or after the last time of the truth"] = count
    if count := int((~outside & ~is_known).sum()):
        dropped["in a gap of the truth"] = count
    claims = _Claims.of(cov, pose, covariance_frame)
    aligned = _Alignment.of(align, claims, pose, true, is_known)
    is_compared = is_known.copy()
    if align == "first":
        is_compared[np.argmax(is_known)] = False  # its error is zero by construction
        dropped["the first, to which the truth is aligned"] = 1
    for reason, faulty in claims.faults.items():
        if count := int((faulty & is_compared).sum()):
            dropped[reason] = count
    error = aligned.error
    judged = {name: claims.valid[name] & is_compared for name in DOF}
    blocks = _blocks(aligned, judged)
    factors = {}
    for k, name in enumerate(COMPONENTS):
        valid = judged["heading" if name == "heading" else "position"]
        if valid.sum() > 1:
            scaled = error[valid, k] / np.sqrt(claims.cov[valid, k, k])
            low, high = aligned.honest(k, valid)
            square = _mean_square(scaled[:, None], 1 - (low + high) / 2).average
            factors[name] = Average(
                float(np.sqrt(square.value / ((low + high) / 2))),
                float(np.sqrt(square.low / high)),
                float(np.sqrt(square.high / low)) if low > 0 else np.inf,
            )
    sigma = np.full_like(error, np.nan)
    variance = np.diagonal(claims.cov, axis1=1, axis2=2)
    for name in ("position", "heading"):
        ok = claims.valid[name]
        sigma[ok, _AXES[name]] = np.sqrt(variance[ok, _AXES[name]])
    compared = error[is_compared]
    doubts = list(aligned.notes)
    if align == "none":
        doubts += _frames_note(pose[is_compared], true[is_compared])
    if cov is None:
        doubts.append("the estimate has no covariance: its errors alone are measured")
    elif not blocks:
        doubts.append("no covariance can be judged")
    lag, note = _lag(rows, claims, align, is_compared, judged)
    doubts += [note] * bool(note)
    return RecordingScores(
        verdict=_word(blocks, int(is_compared.sum())),
        errors=RecordedErrors(
            time[is_compared],
            compared,
            sigma[is_compared],
            pose[is_compared],
            aligned.truth[is_compared],
        ),
        rmse=dict(zip(COMPONENTS, np.sqrt((compared**2).mean(axis=0)).tolist(), strict=True)),
        mean={name: _mean(compared[:, k]) for k, name in enumerate(COMPONENTS)},
        blocks=blocks,
        factors=factors,
        lag=lag,
        dropped=dropped,
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


def _frames_note(pose: Float[np.ndarray, "n 3"], truth: Float[np.ndarray, "n 3"]) -> list[str]:
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


class _Rows(NamedTuple):
    """The times and poses of an estimate, and the path of the truth with its times."""

    time: Float[np.ndarray, "n"]
    pose: Float[np.ndarray, "n 3"]
    clock: Float[np.ndarray, "m"]
    path: Float[np.ndarray, "m 3"]
    longest_gap: float | None

    def truth(self, shift: float = 0.0) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, "n"]]:
        """The truth at the times of the estimate less a shift [s], and where it is known; elsewhere
        the estimate, so that sums over masked rows stay finite."""
        at = self.time - shift
        path, is_known = known_poses(self.clock, self.path, at, self.longest_gap, geodesic_poses)
        return np.where(is_known[:, None], path, self.pose), is_known

    def velocity(self, shift: float) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, "n"]]:
        """The velocity of the truth at the times less a shift, in its own axes: of the estimate's
        its noise would be a part."""
        half = max(_HALF, float(np.median(np.diff(self.clock))) if len(self.clock) > 1 else _HALF)
        before, in_time = self.truth(shift + half)
        after, still_in_time = self.truth(shift - half)
        moved = np.column_stack([after[:, :2] - before[:, :2], wrapped(after[:, 2] - before[:, 2])])
        return _in_axes(self.truth(shift)[0], moved) / (2 * half), in_time & still_in_time


def _in_axes(
    pose: Float[np.ndarray, "n 3"], vector: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """Vectors (x, y, θ) of the world in the axes of poses: along, across, heading."""
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    x, y, turn = vector.T
    return np.column_stack([c * x + s * y, c * y - s * x, turn])


def _error(
    pose: Float[np.ndarray, "n 3"], truth: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """Truth minus estimate, along, across and in heading."""
    gap = truth - pose
    return _in_axes(pose, np.column_stack([gap[:, :2], wrapped(gap[:, 2])]))


class _Claims(NamedTuple):
    """The claimed covariances in the axes of the estimate, and which of them can be judged."""

    cov: Float[np.ndarray, "n 3 3"]
    """unit matrices where not valid"""
    valid: dict[str, Bool[np.ndarray, "n"]]
    """by block of `DOF`"""
    faults: dict[str, Bool[np.ndarray, "n"]]
    """poses by what is wrong with their covariance"""
    turn: Float[np.ndarray, "n 3 3"]
    """matrices that turn (x, y, θ) of the world into the axes of the estimate"""

    @classmethod
    def of(
        cls,
        cov: Float[np.ndarray, "n 3 3"] | None,
        pose: Float[np.ndarray, "n 3"],
        frame: str,
    ) -> "_Claims":
        """The claims of covariances, None for none, in the axes of the frame."""
        count = len(pose)
        turn = np.stack([_in_axes(pose, np.tile(axis, (count, 1))) for axis in np.eye(3)], axis=2)
        unit = np.tile(np.eye(3), (count, 1, 1))
        if cov is None:
            return cls(unit, {name: np.zeros(count, bool) for name in DOF}, {}, turn)
        is_unknown = cov[:, 0, 0] == -1
        faults_by_block: dict[str, dict[str, np.ndarray]] = {}
        valid = {}
        for name, axes in _AXES.items():
            block = cov[:, axes, axes]
            finite = np.isfinite(block).all(axis=(1, 2))
            safe = np.where(finite[:, None, None], block, 0.0)
            variance = np.diagonal(safe, axis1=1, axis2=2)
            tests = {
                "-1 first, unknown": is_unknown,
                "not finite": ~finite,
                "zero": (safe == 0).all(axis=(1, 2)),
                f"above {LARGEST:g}": (variance > LARGEST).any(axis=1),
                "not symmetric": is_asymmetric(safe, 1e-6),  # of float32
                "singular, or not positive definite": ~is_invertible(safe),
            }
            # A pose has one fault: of several the first.
            sound = np.ones(count, bool)
            faults_by_block[name] = {}
            for fault, fails in tests.items():
                faults_by_block[name][fault] = sound & fails
                sound = sound & ~fails
            rest = block[sound]
            is_constant = len(rest) > 1 and bool((rest == rest[:1]).all())
            faults_by_block[name]["constant from beginning to end"] = sound & is_constant
            valid[name] = sound & (not is_constant)
        valid["pose"] &= valid["position"] & valid["heading"]
        faults = {}
        for fault, position in faults_by_block["position"].items():
            heading = faults_by_block["heading"][fault]
            both = position & heading
            faults[f"covariance {fault}"] = both
            faults[f"covariance of the position {fault}"] = position & ~both
            faults[f"variance of the heading {fault}"] = heading & ~both
        apart = valid["position"] & valid["heading"] & ~valid["pose"]
        faults["covariance of position and heading singular together"] = apart
        usable = valid["position"] | valid["heading"]
        safe = np.where(usable[:, None, None], np.nan_to_num(cov), unit)
        safe = (safe + np.swapaxes(safe, 1, 2)) / 2
        if frame == "world":
            safe = turn @ safe @ np.swapaxes(turn, 1, 2)
        # A block without the other: nothing of the other enters.
        safe[~valid["position"], :2] = safe[~valid["position"], :, :2] = 0.0
        safe[~valid["heading"], 2] = safe[~valid["heading"], :, 2] = 0.0
        for name in ("position", "heading"):
            for k in range(3)[_AXES[name]]:
                safe[~valid[name], k, k] = 1.0
        return cls(safe, valid, faults, turn)

    def weight(self, part: str | int, valid: Bool[np.ndarray, "n"]) -> Float[np.ndarray, "n 3 3"]:
        """M of eᵀ M e, the square of a block of the error, or of component k; 0 if not valid."""
        axes = _AXES[part] if isinstance(part, str) else slice(part, part + 1)
        weight = np.zeros_like(self.cov)
        weight[:, axes, axes] = np.linalg.inv(self.cov[:, axes, axes])
        return np.where(valid[:, None, None], weight, 0.0)


class _Alignment(NamedTuple):
    """The truth in the frame of the estimate, and what carrying it there does to honest NEES."""

    truth: Float[np.ndarray, "n 3"]
    notes: tuple[str, ...]
    claims: _Claims
    lever: Float[np.ndarray, "n 3 3"]
    """J: change of each error by a small motion of the truth"""
    start_cov: Float[np.ndarray, "3 3"]
    """covariance of that motion by the first error; zeros unless aligned there"""
    weight: Float[np.ndarray, "n 3 3"]
    """P⁻¹ of the poses that have determined the best motion, else zeros"""
    error: Float[np.ndarray, "n 3"]

    @classmethod
    def of(
        cls,
        align: str,
        claims: _Claims,
        pose: Float[np.ndarray, "n 3"],
        truth: Float[np.ndarray, "n 3"],
        is_known: Bool[np.ndarray, "n"],
    ) -> "_Alignment":
        """The truth carried as `align` says, by the poses at which it is known."""
        turn = claims.turn
        frame, centre = np.zeros(3), np.zeros(3)
        notes: tuple[str, ...] = ()
        start_cov, weight = np.zeros((3, 3)), np.zeros_like(turn)
        start = int(np.argmax(is_known))
        if align == "first":
            frame, centre = compose(pose[start], inverse(truth[start])), pose[start]
            notes = ("aligned at the first pose: its error is in all of the others",)
            if claims.valid["pose"][start]:
                start_cov = turn[start].T @ claims.cov[start] @ turn[start]
            elif claims.valid["pose"].any() and not claims.faults["covariance zero"][start]:
                notes += ("the first pose has no valid covariance: honest values leave it out",)
        elif align == "best":
            usable = is_known & claims.valid["pose"]
            if usable.any():
                weight = claims.weight("pose", usable)
                fit = weight
            else:
                usable = is_known
                fit = np.where(usable[:, None, None], np.eye(3), 0.0)
            frame = compose(pose[start], inverse(truth[start]))
            if np.ptp(truth[usable, :2], axis=0).any():  # else positions show no turn
                frame = alignment(truth[usable, :2], pose[usable, :2])
            for _ in range(_STEPS):
                carried = compose(frame, truth)
                centre = carried[usable].mean(axis=0)
                lever = _lever(turn, carried, centre)
                curvature, gradient = _normal_equations(lever, fit, _error(pose, carried))
                x, y, angle = -np.linalg.solve(curvature, gradient.sum(axis=0))
                moved = np.array([centre[0] + x, centre[1] + y, angle])
                about = np.array([-centre[0], -centre[1], 0.0])
                frame = compose(moved, compose(about, frame))
                if max(abs(x), abs(y), abs(angle)) < _SHORTEST:
                    break
            notes = (
                "aligned by the best rigid motion, which takes 3 degrees of freedom: an error that "
                "all poses have in common cannot be seen",
            )
        carried = compose(frame, truth)
        lever = _lever(turn, carried, centre)
        return cls(carried, notes, claims, lever, start_cov, weight, _error(pose, carried))

    def honest(self, part: str | int, valid: Bool[np.ndarray, "n"]) -> tuple[float, float]:
        """The range of an honest mean of eᵀ M e, of a block or a component k; see
        `judge_recording`."""
        dof = float(DOF[part]) if isinstance(part, str) else 1.0
        if self.start_cov.any():
            weight = self.claims.weight(part, valid)
            carried = self.lever @ self.start_cov @ np.swapaxes(self.lever, 1, 2)
            added = float(np.einsum("nij,nji->", weight, carried)) / max(valid.sum(), 1)
            return max(dof - added, 0.0), dof + added
        if not self.weight.any():
            return dof, dof
        # The errors before the motion are e + J a, a = A⁻¹ Σ Jᵀ W e. Their sum of squares has the
        # expectation E Σ eᵀ M e + 2 E uᵀ a - E aᵀ B a, with u = Σ Jᵀ M (e + J a), B = Σ Jᵀ M J.
        weight = self.claims.weight(part, valid)
        curvature, s = _normal_equations(self.lever, self.weight, self.error)
        block_curvature, u = _normal_equations(self.lever, weight, self.error)
        used = self.weight.any(axis=(1, 2))
        error = np.einsum("nji,nj->ni", self.claims.turn, self.error)  # in the axes of the world
        error = np.where(used[:, None], error, 0.0)
        size = np.sqrt((error**2).mean(axis=0))
        length = _correlation_length(error / np.where(size > 0, size, 1.0))
        # What is left has no mean, which takes a share 2K/n of its long-run covariance.
        remains = max(1 - (2 * length - 1) / used.sum(), 0.5)
        root = np.linalg.inv(curvature)
        shared = root @ _long_run(s, s, length) @ root
        removed = 2 * np.trace(_long_run(u, s, length) @ root) - np.trace(block_curvature @ shared)
        removed /= remains
        left = float(np.einsum("ni,nij,nj->", self.error, weight, self.error))
        share = float(np.clip(removed / (left + removed), 0.0, 1.0)) if removed > 0 else 0.0
        # What it takes is random, as it is of a few errors: from nothing to twice its expectation.
        return dof * max(1 - 2 * share, 0.0), dof


def _lever(
    turn: Float[np.ndarray, "n 3 3"],
    truth: Float[np.ndarray, "n 3"],
    centre: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "n 3 3"]:
    """J: the change of each error by a motion (x, y, θ) of the truth about a centre."""
    motion = np.tile(np.eye(3), (len(truth), 1, 1))
    motion[:, 0, 2], motion[:, 1, 2] = -(truth[:, 1] - centre[1]), truth[:, 0] - centre[0]
    return turn @ motion


def _normal_equations(
    lever: Float[np.ndarray, "n 3 3"],
    weight: Float[np.ndarray, "n 3 3"],
    error: Float[np.ndarray, "n 3"],
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "n 3"]]:
    """Σ Jᵀ W J, and Jᵀ W e of each pose."""
    weighted = np.swapaxes(lever, 1, 2) @ weight
    return (weighted @ lever).sum(axis=0), np.einsum("nij,nj->ni", weighted, error)


def _products(
    u: Float[np.ndarray, "n c"], s: Float[np.ndarray, "n d"]
) -> Float[np.ndarray, "n c d"]:
    """Σ_t u_t s_{t+k}ᵀ for each lag k from 0 to n - 1, by FFT."""
    size = scipy.fft.next_fast_len(2 * len(u), real=True)
    a, b = (scipy.fft.rfft(part, size, axis=0) for part in (u, s))
    lags = scipy.fft.irfft(a.conj()[:, :, None] * b[:, None, :], size, axis=0)
    return np.asarray(lags[: len(u)])


def _correlation_length(z: Float[np.ndarray, "n d"]) -> int:
    """The number of poses over which errors are correlated: the first lag with tr Σ z zᵀ <= 0."""
    ends = np.trace(_products(z, z), axis1=1, axis2=2) <= 0
    return int(np.argmax(ends)) if ends.any() else len(z)


def _long_run(
    u: Float[np.ndarray, "n c"], s: Float[np.ndarray, "n d"], length: int
) -> Float[np.ndarray, "c d"]:
    """The covariance of Σ u and Σ s: Σ_t u_t s_{t+k}ᵀ over lags |k| below a length."""
    after, before = _products(u, s)[:length], _products(s, u)[1:length]
    return np.asarray(after.sum(axis=0) + before.sum(axis=0).T)


class _MeanSquare(NamedTuple):
    """The mean q̄ of q = zᵀz over n poses, and how far its expectation may be away."""

    average: Average
    nu: float
    """effective degrees of freedom: ν q̄/E q ~ χ²_ν"""
    r: Float[np.ndarray, "K"]
    """correlation of q_t and q_{t+k}, of Gaussian errors, from k = 0 to where it ends"""
    excess: float
    """variance of q̄ over that of Gaussian errors, and what its estimate adds to the interval"""


def _mean_square(z: Float[np.ndarray, "n d"], absorbed: float = 0.0) -> _MeanSquare:
    """The mean square of errors z that are correlated; see `judge_recording`.

    absorbed: share of zᵀz that an alignment has taken from all of them alike, if above 0.
    """
    count, dof = z.shape
    q = (z**2).sum(axis=1)
    mean = float(q.mean())
    if not mean > 0:
        return _MeanSquare(Average(mean, 0.0, np.inf), 1.0, np.ones(1), 1.0)
    before = mean / (1 - np.clip(absorbed, 0.0, 0.9))  # the alignment
    products = _products(z, z) / count + (before - mean) / dof * np.eye(dof)
    square = np.trace(products, axis1=1, axis2=2) ** 2
    size = (products**2).sum(axis=(1, 2))
    # The expectation of |C_k|² of errors that are independent at lag k, and correlated at the lags
    # below it (Bartlett 1946)
    noise = (2 * (np.cumsum(square) - square) - square[0]) / count
    noise[0] = 0.0
    is_noise = size <= noise
    length = int(np.argmax(is_noise)) if is_noise.any() else count
    # Without that noise of its d² entries |C_k|² is at least (tr C_k)²/d, by Cauchy and Schwarz.
    size = np.maximum(size[:length] - noise[length - 1], square[:length] / dof)
    size[0] = (products[0] ** 2).sum()
    gaussian = 2 * float(size[0] + 2 * size[1:].sum())
    centred = (q - mean)[:, None]
    excess = max(1.0, float(_long_run(centred, centred, length)[0, 0]) / count / gaussian)
    nu = float(np.clip(2 * count * before**2 / (excess * gaussian), 1.0, count * dof))
    # Of n/2K stretches; Student's t in place of the normal
    half = t_quantile((1 + LEVEL) / 2, max(count / (2 * length), 1.0))
    shrunk = (normal_quantile((1 + LEVEL) / 2) / half) ** 2
    fewer = max(nu * shrunk, 1.0)
    low, high = (fewer * mean / chi2_quantile(p, fewer) for p in ((1 + LEVEL) / 2, (1 - LEVEL) / 2))
    return _MeanSquare(Average(mean, low, high), nu, size / size[0], excess / shrunk)


def _share(inside: Bool[np.ndarray, "n"], level: float, dof: int, nees: _MeanSquare) -> Average:
    """The share of poses within an ellipsoid of a level, with its interval of Jeffreys.

    Two χ²_d numbers with correlation r have the joint density f f' Σ_m r^m L_m L_m', with L_m the
    normalized polynomials of Laguerre (Kibble 1941, "A two-variate gamma type distribution",
    Sankhyā 5). So the indicators of q <= χ²_d(p) have the correlation Σ_m w_m r^m, w_m the share of
    their variance of order m, and as many independent ones have the same spread.
    """
    c, a = chi2_quantile(level, dof) / 2, dof / 2
    m = np.arange(1, _ORDERS + 1)
    gammaln = scipy.special.gammaln
    # ∫ f L_m over [0, c], and the square of the norm of L_m
    integral = np.exp(a * np.log(c) - c - gammaln(a)) / m
    integral *= scipy.special.eval_genlaguerre(m - 1, a, c)
    norm = np.exp(gammaln(m + a) - gammaln(m + 1) - gammaln(a))
    weight = integral**2 / norm / (level * (1 - level))
    sums = np.array([(nees.r[1:] ** order).sum() for order in m])
    independent = max(len(inside) / (1 + 2 * float(weight @ sums)) / nees.excess, 1.0)
    share = float(inside.mean())
    shape = independent * share + 0.5, independent * (1 - share) + 0.5
    low, high = (
        float(scipy.special.betaincinv(*shape, p)) for p in ((1 - LEVEL) / 2, (1 + LEVEL) / 2)
    )
    # Of none or all, the end that is sure (Brown, Cai & DasGupta 2001).
    return Average(share, low if share > 0 else 0.0, high if share < 1 else 1.0)


def _mean(values: Float[np.ndarray, "n"]) -> Average:
    """The mean of correlated numbers with its t interval."""
    mean = float(values.mean())
    error, dof = _error_of_sum((values - mean)[:, None])
    half = t_quantile(0.5 + LEVEL / 2, dof) * error / len(values)
    return Average(mean, mean - half, mean + half)


def _error_of_sum(scores: Float[np.ndarray, "n 1"]) -> tuple[float, float]:
    """The standard error of a sum of correlated numbers of mean 0, and its degrees of freedom."""
    total = float((scores**2).sum())
    if not total > 0:
        return 0.0, 1.0
    length = _correlation_length(scores)
    long_run = max(float(_long_run(scores, scores, length)[0, 0]), total)
    return float(np.sqrt(long_run)), max(len(scores) / (2 * length), 1.0)


def _blocks(
    aligned: _Alignment, judged: Mapping[str, Bool[np.ndarray, "n"]]
) -> dict[str, RecordedBlock]:
    """The scores of each block that has two poses, at the poses where it is judged."""
    blocks = {}
    for name, valid in judged.items():
        if valid.sum() < 2:
            continue
        axes, dof = _AXES[name], DOF[name]
        # In the axes of the world, where an error that stays does not turn with the robot
        turn = aligned.claims.turn[valid]
        cov = np.swapaxes(turn, 1, 2) @ aligned.claims.cov[valid] @ turn
        error = np.swapaxes(turn, 1, 2) @ aligned.error[valid, :, None]
        z = np.linalg.solve(np.linalg.cholesky(cov[:, axes, axes]), error[:, axes])[..., 0]
        honest = aligned.honest(name, valid)
        nees = _mean_square(z, 1 - sum(honest) / (2 * dof))
        square = (z**2).sum(axis=1)
        coverage, honest_coverage = {}, {}
        for level in LEVELS:
            bound = chi2_quantile(level, dof)
            coverage[level] = _share(square <= bound, level, dof, nees)
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


def _word(blocks: Mapping[str, RecordedBlock], compared: int) -> str:
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


def _lag(
    rows: _Rows,
    claims: _Claims,
    align: str,
    is_compared: Bool[np.ndarray, "n"],
    judged: Mapping[str, Bool[np.ndarray, "n"]],
) -> tuple[ClockLag | None, str]:
    """The lag of the estimate, and a note on it or on why there is none."""
    lag = 0.0
    for _ in range(_STEPS):
        truth, is_known = rows.truth(lag)
        aligned = _Alignment.of(align, claims, rows.pose, truth, is_known)
        velocity, moves = rows.velocity(lag)
        kept = is_compared & is_known & moves
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
        if abs(step) < _SHORTEST:
            break
    residual = error - step * change
    spread, dof = _error_of_sum((change * weight * residual).sum(axis=1, keepdims=True))
    deviation = spread / information
    half = t_quantile(0.5 + LEVEL / 2, dof) * deviation
    truth, is_known = rows.truth(lag)
    aligned = _Alignment.of(align, claims, rows.pose, truth, is_known)
    blocks = _blocks(aligned, {name: valid & is_known for name, valid in judged.items()})
    without = _word(blocks, int((is_compared & is_known).sum()))
    note = ""
    if abs(lag) > half and blocks:
        nees = next(iter(blocks.values())).nees.value
        note = (
            f"the estimate is {abs(1e3 * lag):.3g} ms {'behind' if lag > 0 else 'ahead of'} the "
            f"truth; without that lag the NEES is {nees:.3g}, and the verdict {without}"
        )
    nees_by_block = {name: block.nees for name, block in blocks.items()}
    return ClockLag(Average(lag, lag - half, lag + half), deviation, nees_by_block, without), note


def _text(average: Average, scale: float = 1.0) -> str:
    """A number with its interval."""
    value, low, high = (f"{scale * number:.3g}" for number in average)
    return f"{value} [{low}, {high}]".replace("inf", "∞")


def _range_text(ends: tuple[float, ...]) -> str:
    low, high = (f"{end:.3g}" for end in ends)
    return low if low == high else f"{low} to {high}"
