"""What one run says of a filter: the numbers that a campaign adds up or keeps, run by run.

A run's error is compared with the covariance the filter claims for it. With e = truth - estimate,
heading wrapped, NEES = eᵀ P⁻¹ e has mean dof for an honest filter; it is *not* divided by dof
anywhere here. While P is singular (a start with P0 = 0, or a deviation that is rounding; see
`block_nees`) there is no NEES: such steps are left out, and counted, never filled with 0.
(Bar-Shalom, Li, Kirubarajan 2001, 5.4; Bailey et al. 2006.)
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam import lapack, linalg
from jaxslam.consistency.associations import associations, identities
from jaxslam.consistency.nees import DOF, block_nees, pose_error
from jaxslam.linalg import mahalanobis_squared
from jaxslam.protocols import Sensor
from jaxslam.staging import settle
from jaxslam.stats import chi2_quantile
from jaxslam.types import Status, Trace, Truth

LANDMARK_DOF = 2
"""of the NEES of one landmark's position."""

KEPT = (Status.FUSED, Status.BORN, Status.SIGHTED)
"""What a measurement does for the map; each is counted."""

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
    """One run; with a leading axis, many. Of a run that is not finite, the rest means nothing."""

    finite: Any
    """() bool: every number of the run is finite."""
    measures: dict[str, tuple[Any, Any]]
    """the run's own averages: what is averaged, and over how much; there is none over 0."""
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
    own_error: jax.Array | None = None,
) -> Score:
    """Score one run.

    own_error (T, 3): the pose errors in the filter's own coordinates (see `own_error_of`), by
    default those in (x, y, θ).
    """
    error = pose_error(truth.pose, trace.estimate.pose)
    cov = trace.estimate.pose_cov
    pose = trace.estimate.pose
    nees = block_nees(pose, error, error if own_error is None else own_error, cov)
    fused = trace.info.status == Status.FUSED
    held = jnp.where(trace.estimate.alive, trace.estimate.tag, -1)
    curves = {f"nees_{block}": nees[block][0] for block in DOF}
    curves |= {f"regular_{block}": nees[block][1].astype(error.dtype) for block in DOF}
    curves |= {
        "square_position": (error[:, :2] ** 2).sum(axis=1),
        "square_heading": error[:, 2] ** 2,
        "nis": jnp.where(fused, trace.info.nis, 0.0).sum(axis=1),
        "nis_dof": trace.info.dof.sum(axis=1).astype(error.dtype),
    }
    measures: dict[str, tuple[Any, Any]] = {}
    sums: dict[str, jax.Array] = {}
    if not isinstance(truth.origin, tuple):
        held = identities(trace, truth.origin)
        measures |= associations(trace, truth.origin, held)
    if getattr(trace.final, "watch", ()):
        gained, dimensions = _null_space(trace.probe, trace.final.watch)
        curves["rotation_information"] = gained
        measures["rotation_information"] = gained[-1], 1
        measures["unobservable"] = dimensions.astype(error.dtype), 1
    of_landmarks, squares = _landmarks(trace, truth, sensor, held)
    # One sum over time for all: each sum of its own is three kernels, and each kernel is compiled.
    summed = curves | of_landmarks
    summed |= {"nees_own": nees["own"][0], "regular_own": nees["own"][1].astype(error.dtype)}
    summed |= {"log_likelihood": trace.info.log_likelihood}
    added = settle(jnp.stack(list(summed.values())).sum(axis=1))
    totals = dict(zip(summed, added, strict=True))
    covered = _covered(*(jnp.stack([nees[block][i] for block in DOF]) for i in (0, 1)))
    for at, block in enumerate(DOF):
        count = totals[f"regular_{block}"]
        sums[f"coverage_{block}"] = covered[at] / jnp.maximum(count, 1)
        sums[f"coverage_runs_{block}"] = (count > 0).astype(error.dtype)
        measures[f"coverage_95_{block}"] = covered[at, LEVELS.index(0.95)], count
    for block in (*DOF, "own", "landmarks"):
        measures[f"nees_{block}"] = totals[f"nees_{block}"], totals[f"regular_{block}"]
    for name in ("square_position", "square_heading"):
        measures[name] = totals[name], error.shape[0]
    measures["square_landmarks"] = squares
    measures["nis_per_dof"] = totals["nis"], totals["nis_dof"]
    measures["log_likelihood"] = totals["log_likelihood"], 1
    sums["autocorrelation"] = _autocorrelation(trace)
    measures["autocorrelation"] = sums["autocorrelation"][0, 0], sums["autocorrelation"][0, 1]

    became = trace.info.status[:, :, None] == jnp.asarray(KEPT + DROPS)[None, None]
    sums |= {
        status.name.lower(): count
        for status, count in zip(KEPT + DROPS, became.sum(axis=(0, 1)), strict=True)
    }
    sums |= _events(trace)
    sums |= {"missed": truth.missed.sum()}
    sums |= {"singular_steps": (error.shape[0] - totals["regular_pose"]).astype(int)}
    finite = settle(_all_finite((trace.estimate, trace.info), (added, sums, measures)))

    at_snapshots = snapshot_steps(error.shape[0])
    return Score(
        finite=finite,
        measures=measures,
        snapshots=(
            error[at_snapshots],
            cov[at_snapshots],
            curves["regular_pose"][at_snapshots] > 0,
        ),
        sums=sums | curves,
    )


def _events(trace: Trace) -> dict[str, jax.Array]:
    """How often each of `EVENTS` happened."""
    there = {name: getattr(trace.info, name) for name in EVENTS}
    there = {name: value for name, value in there.items() if not isinstance(value, tuple)}
    if "merged" in there:
        there["merged"] = there["merged"][:, 0] >= 0
    return {name: value.sum() for name, value in there.items()}


def _all_finite(by_time: Any, others: Any) -> jax.Array:
    """Whether every number is. by_time: arrays of leading T; a row each, then all at once."""

    def good(tree: Any, axes: Callable[[int], Any]) -> list[jax.Array]:
        leaves = map(jnp.asarray, jax.tree.leaves(tree))
        there = [leaf for leaf in leaves if jnp.issubdtype(leaf.dtype, jnp.floating)]
        return [jnp.isfinite(leaf).all(axis=axes(leaf.ndim)) for leaf in there]

    rows = good(by_time, lambda ndim: tuple(range(1, ndim)))
    every = good(others, lambda ndim: None)
    return jnp.concatenate([jnp.stack(rows).all(axis=1), jnp.stack(every)]).all()


def _covered(nees: jax.Array, regular: jax.Array) -> jax.Array:
    """(3, LEVELS): at how many steps the truth lies in the ellipsoid of that probability.

    nees, regular: (3, T), by the blocks of `DOF`.
    """
    radii = [[chi2_quantile(p, dof) for p in LEVELS] for dof in DOF.values()]
    inside = nees[:, :, None] <= jnp.asarray(radii, nees.dtype)[:, None, :]
    return (inside & regular[:, :, None]).sum(axis=1).astype(nees.dtype)


def _landmarks(
    trace: Trace, truth: Truth, sensor: Sensor, held: jax.Array
) -> tuple[dict[str, jax.Array], tuple[jax.Array, jax.Array]]:
    """By step (T,), summed over the landmarks of the map: NEES, and how many have one; of the final
    map, unaligned, |p̂ - p|² and how many landmarks that is.

    held: (T, N) which true landmark each slot holds, -1 for none.
    """
    estimate = trace.estimate
    named = held >= 0
    true_points = jax.vmap(sensor.position)(truth.landmarks)
    off = true_points[jnp.maximum(held, 0)] - estimate.points
    nees, regular = jax.vmap(jax.vmap(mahalanobis_squared))(off, estimate.point_covs)
    counts = named & regular
    by_step = {
        "nees_landmarks": jnp.where(counts, nees, 0.0).sum(axis=1),
        "regular_landmarks": counts.sum(axis=1).astype(nees.dtype),
    }
    square = jnp.where(named[-1], (off[-1] ** 2).sum(axis=-1), 0.0)
    return by_step, (square.sum(), named[-1].sum())


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
