"""What one run says of a filter: the numbers that a campaign adds up or keeps, run by run.

A run's error is compared with the covariance the filter claims for it. With e = truth - estimate,
heading wrapped, NEES = eᵀ P⁻¹ e has mean dof for an honest filter; it is *not* divided by dof
anywhere here. While P is singular (a start with P0 = 0) there is no NEES: such steps are left out,
and counted, never filled with 0. (Bar-Shalom, Li, Kirubarajan 2001, 5.4; Bailey et al. 2006.)
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam import lapack, linalg
from jaxslam.angles import wrap
from jaxslam.consistency.associations import associations, identities
from jaxslam.linalg import mahalanobis_squared
from jaxslam.protocols import Chart, Sensor
from jaxslam.stats import chi2_quantile
from jaxslam.types import Status, Trace, Truth

DOF = {"pose": 3, "position": 2, "heading": 1}
"""Blocks of the pose error whose NEES is taken, and the mean of an honest one."""

LANDMARK_DOF = 2
"""of the NEES of one landmark's position."""

DROPS = (
    Status.REJECTED,
    Status.OVERFLOW,
    Status.DEFERRED,
    Status.REPEATED,
    Status.SINGULAR,
    Status.UNMATCHED,
)
"""What can keep a measurement from the map; each is counted."""

EVENTS = (
    *("removed", "merged", "reduced", "exhausted", "resampled", "underflow"),
    *("invalid", "injected", "capped"),
)
"""Fields of `Info` that not every filter has; each is counted where it is there."""

LEVELS = tuple(np.round(np.arange(0.05, 0.96, 0.05), 2).tolist()) + (0.99,)
"""Probabilities of the coverage curves."""

LAGS = 10
"""The autocorrelation of innovations is taken up to so many steps."""

SNAPSHOTS = 25
"""Steps of each run at which error and covariance are kept as they are."""


class Score(NamedTuple):
    """One run; with a leading axis, many. Everything is zero where the run is not finite."""

    finite: Any
    """() bool: every number of the run is finite."""
    divergent: Any
    """() bool: finite, and ends too far from the truth."""
    measures: dict[str, tuple[Any, Any]]
    """the run's own averages, and whether there is one."""
    snapshots: tuple[Any, Any, Any]
    """pose error (K, 3), its covariance (K, 3, 3), whether that is regular (K,)."""
    sums: dict[str, Any]
    """what is added up over runs: (T,) curves, (LEVELS,) and (LAGS, 3) sums, () drops."""


def snapshot_steps(steps: int) -> np.ndarray:
    """The steps (K,) of the snapshots, the last among them."""
    return np.unique(np.round(np.linspace(0, steps - 1, SNAPSHOTS)).astype(int))


def score(
    trace: Trace,
    truth: Truth,
    sensor: Sensor,
    limit: jax.Array,
    own_error: jax.Array | None = None,
) -> Score:
    """Score one run.

    limit () [m]: a final position error above is divergence. own_error (T, 3): the pose errors in
    the filter's own coordinates (see `own_error_of`), by default those in (x, y, θ).
    """
    error = truth.pose - trace.estimate.pose
    error = jnp.concatenate([error[:, :2], wrap(error[:, 2:])], axis=1)
    cov = trace.estimate.pose_cov
    sums: dict[str, jax.Array] = {}
    measures: dict[str, tuple[jax.Array, jax.Array]] = {}
    steps = jnp.asarray(error.shape[0])
    scale = _scale(cov)
    for block, at in (("pose", slice(0, 3)), ("position", slice(0, 2)), ("heading", slice(2, 3))):
        nees, regular = jax.vmap(mahalanobis_squared)(error[:, at], cov[:, at, at], scale[:, at])
        sums[f"nees_{block}"], sums[f"regular_{block}"] = nees, regular.astype(nees.dtype)
        measures[f"nees_{block}"] = nees.sum(), regular.sum()
        covered = _covered(nees, regular, DOF[block])
        count = jnp.maximum(regular.sum(), 1)
        sums[f"coverage_{block}"] = covered.sum(axis=0) / count
        sums[f"coverage_runs_{block}"] = (regular.sum() > 0).astype(nees.dtype)
        at_95 = covered[:, LEVELS.index(0.95)].sum()
        measures[f"coverage_95_{block}"] = at_95.astype(nees.dtype), regular.sum()
    own = error if own_error is None else own_error
    nees, regular = jax.vmap(mahalanobis_squared)(own, cov, scale)
    measures["nees_own"] = nees.sum(), regular.sum()

    sums["square_position"] = (error[:, :2] ** 2).sum(axis=1)
    sums["square_heading"] = error[:, 2] ** 2
    fused = trace.info.status == Status.FUSED
    sums["nis"] = jnp.where(fused, trace.info.nis, 0.0).sum(axis=1)
    sums["nis_dof"] = trace.info.dof.sum(axis=1).astype(error.dtype)
    measures["square_position"] = sums["square_position"].sum(), steps
    measures["square_heading"] = sums["square_heading"].sum(), steps
    measures["nis_per_dof"] = sums["nis"].sum(), sums["nis_dof"].sum()
    held = jnp.where(trace.estimate.alive, trace.estimate.tag, -1)
    if not isinstance(truth.origin, tuple):
        held = identities(trace, truth.origin)
        measures |= associations(trace, truth.origin, held)
    measures |= _landmarks(trace, truth, sensor, held)
    measures["log_likelihood"] = trace.info.log_likelihood.sum(), jnp.asarray(1)
    sums["autocorrelation"] = _autocorrelation(trace)
    measures["autocorrelation"] = sums["autocorrelation"][0, 0], sums["autocorrelation"][0, 1]
    if getattr(trace.final, "watch", ()):
        gained, dimensions = _null_space(trace.probe, trace.final.watch)
        sums["rotation_information"] = gained
        measures["rotation_information"] = gained[-1], jnp.asarray(1)
        measures["unobservable"] = dimensions.astype(error.dtype), jnp.asarray(1)

    sums |= {s.name.lower(): (trace.info.status == s).sum() for s in DROPS}
    sums |= _events(trace)
    sums |= {"missed": truth.missed.sum(), "singular_steps": (sums["regular_pose"] == 0).sum()}
    finite = _all_finite((trace.estimate, trace.info, sums, measures))
    far = jnp.sqrt(sums["square_position"][-1]) > limit

    def kept(value: jax.Array) -> jax.Array:
        return jnp.where(finite, value, jnp.zeros_like(value))

    averages = {}
    for name, (total, weight) in measures.items():
        defined = finite & (weight > 0)
        averages[name] = jnp.where(defined, total / jnp.where(weight > 0, weight, 1), 0.0), defined
    at_snapshots = snapshot_steps(error.shape[0])
    shots = error[at_snapshots], cov[at_snapshots], sums["regular_pose"][at_snapshots] > 0
    return Score(
        finite=finite,
        divergent=finite & far,
        measures=averages,
        snapshots=jax.tree.map(kept, shots),
        sums=jax.tree.map(kept, sums),
    )


def _events(trace: Trace) -> dict[str, jax.Array]:
    """How often each of `EVENTS` happened."""
    there = {name: getattr(trace.info, name) for name in EVENTS}
    there = {name: value for name, value in there.items() if not isinstance(value, tuple)}
    if "merged" in there:
        there["merged"] = there["merged"][:, 0] >= 0
    return {name: value.sum() for name, value in there.items()}


def _all_finite(tree: Any) -> jax.Array:
    """Whether every number is; arrays of one shape together, which compiles faster."""
    by_shape: dict[Any, list[jax.Array]] = {}
    for leaf in map(jnp.asarray, jax.tree.leaves(tree)):
        if jnp.issubdtype(leaf.dtype, jnp.floating):
            by_shape.setdefault((leaf.shape, leaf.dtype), []).append(leaf)
    each = [jnp.isfinite(jnp.stack(leaves)).all() for leaves in by_shape.values()]
    return jnp.stack(each).all()


def _scale(cov: jax.Array) -> jax.Array:
    """Units (T, 3) in which a pose covariance is judged: x and y, both metres, have one."""
    variance = jnp.maximum(jnp.diagonal(cov, axis1=1, axis2=2), 0.0)
    spread = jnp.stack([variance[:, :2].max(axis=1)] * 2 + [variance[:, 2]], axis=1)
    return jnp.where(spread > 0, jnp.sqrt(jnp.where(spread > 0, spread, 1.0)), 0.0)


def _covered(nees: jax.Array, regular: jax.Array, dof: int) -> jax.Array:
    """(T, LEVELS): whether the truth lies in the ellipsoid of that probability."""
    radii = jnp.asarray([chi2_quantile(p, dof) for p in LEVELS], nees.dtype)
    return (nees[:, None] <= radii[None, :]) & regular[:, None]


def own_error_of(chart: Chart, sensor: Sensor, trace: Trace, truth: Truth) -> jax.Array:
    """The pose error in the filter's coordinates, brought to (x, y, θ) by its basis, (T, 3).

    ξᵀ P_ξ⁻¹ ξ = (E ξ)ᵀ P⁻¹ (E ξ) with P = E P_ξ Eᵀ as the filter reports it.
    """
    ground = jnp.zeros(len(sensor.landmark), truth.pose.dtype)

    def one(pose: jax.Array, true_pose: jax.Array) -> jax.Array:
        dx, _ = chart.local(pose, ground, true_pose, ground)
        return dx if chart.basis is None else chart.basis(pose, ground).pose @ dx

    return jax.vmap(one)(trace.estimate.pose, truth.pose)


def _landmarks(
    trace: Trace, truth: Truth, sensor: Sensor, held: jax.Array
) -> dict[str, tuple[jax.Array, jax.Array]]:
    """NEES of each landmark of the map at each step; |p̂ - p|² of the final map, unaligned.

    held: (T, N) which true landmark each slot holds, -1 for none.
    """
    estimate = trace.estimate
    named = held >= 0
    true_points = jax.vmap(sensor.position)(truth.landmarks)
    off = true_points[jnp.maximum(held, 0)] - estimate.points
    nees, regular = jax.vmap(jax.vmap(mahalanobis_squared))(off, estimate.point_covs)
    counts = named & regular
    square = jnp.where(named[-1], (off[-1] ** 2).sum(axis=-1), 0.0)
    return {
        "nees_landmarks": (jnp.where(counts, nees, 0.0).sum(), counts.sum()),
        "square_landmarks": (square.sum(), named[-1].sum()),
    }


def _autocorrelation(trace: Trace) -> jax.Array:
    """(LAGS, 3): of whitened innovations Σ w_tᵀ w_{t+l}, √(Σ|w_t|² Σ|w_{t+l}|²), and how
    many products of numbers that is.

    Of the same landmark at t and t + l, w = L⁻¹ν with S = L Lᵀ; without landmarks, of one place.
    """
    info = trace.info
    fused = info.status == Status.FUSED
    count = trace.estimate.alive.shape[1]

    def whiten(nu: jax.Array, cov: jax.Array) -> jax.Array:
        return linalg.solve_lower(linalg.cholesky(cov)[0], nu)

    white = jax.vmap(jax.vmap(whiten))(info.innovation, info.innovation_cov)
    white = jnp.where(fused[:, :, None], white, 0.0)
    if count > 0:
        mine = (info.slot[:, :, None] == jnp.arange(count)[None, None]) & fused[:, :, None]
        # Not a product with zeros and ones, whose last bit would go by how many runs are batched.
        place = jnp.argmax(mine, axis=1)
        white = jnp.take_along_axis(white, place[:, :, None], axis=1)
        white = jnp.where(mine.any(axis=1)[:, :, None], white, 0.0)
        fused = mine.any(axis=1)
    # By landmark: (w_t, |w_t|², whether there is one), zeros beyond the end.
    there = fused.astype(white.dtype)
    energy = (white**2).sum(axis=2)
    later = [jnp.pad(x, [(0, LAGS)] + [(0, 0)] * (x.ndim - 1)) for x in (white, energy, there)]

    def pairs(lag: jax.Array) -> jax.Array:
        w, e, f = (jax.lax.dynamic_slice_in_dim(x, lag, len(white)) for x in later)
        size = (energy * f).sum() * (e * there).sum()
        size = jnp.where(size > 0, jnp.sqrt(jnp.where(size > 0, size, 1.0)), 0.0)
        return jnp.stack([(white * w).sum(), size, (f * there).sum() * white.shape[2]])

    out: jax.Array = jax.lax.map(pairs, jnp.arange(1, LAGS + 1))
    return out


def _null_space(information: jax.Array, watch: Any) -> tuple[jax.Array, jax.Array]:
    """Information gained along a turn of the whole frame by each step (T,), and the dimension of
    the unobservable subspace of the filter's linearized system, ().

    A direction is unobservable if what was gained along it is rounding: below eps^(3/4) of the
    same sum of squares with absolute values.
    """
    scale = jnp.sqrt(jnp.where(watch.scale > 0, watch.scale, 1.0))
    size = lapack.eigenvalues(watch.information / scale[:, None] / scale[None, :])
    dimensions = (size < float(jnp.finfo(size.dtype).eps) ** 0.75).sum()
    return information @ watch.turn @ watch.turn, dimensions
