"""Noises fitted to a log by maximum likelihood, with the likelihood that a filter computes.

Their standard errors and limits are from the observed information.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree
from numpy.typing import ArrayLike

from jaxslam.core._numbers import check_count
from jaxslam.core._record import as_record
from jaxslam.core.types import Info, Log, Status

_BOUND = 1.35
"""By how much log L falls at the 95 % upper limit of a parameter whose estimate is 0: half the 0.90
quantile of χ² with one degree of freedom, since half of the estimates are 0 where the truth is."""

_CONFOUNDED = 0.9
"""Correlation of two estimates above which they are named together."""

_PART = 0.01
"""Share of a parameter in the directions without information, from 0 to 1, above which it is not
determined. Directions over a hundred parameters have as much; rounding leaves below 1e-6."""

_STEP = 0.01
"""Largest step of log σ in the differences of the gradient."""

_NONE = 1e-3
"""A standard deviation over its estimate which counts as 0."""


class _LikelihoodPoint(NamedTuple):
    """The likelihood at one set of parameters, by the coordinates q."""

    q: np.ndarray
    value: float
    gradient: np.ndarray
    spread: np.ndarray
    """Σ g gᵀ over the rows"""
    expected: np.ndarray
    """the expected information"""
    nis: float
    dof: int
    dtype: np.dtype
    """in which the run was"""


def _without_information(here: _LikelihoodPoint) -> np.ndarray:
    """An orthonormal basis (P, K) of the directions without information, by q √diag F.

    In these coordinates it does not depend on units. Along such a direction no innovation and no S
    has a derivative: nothing is to be gained, and the gradient and the observed information along
    it are rounding.
    """
    expected = here.expected
    unit, there = _units(expected), np.flatnonzero(np.diag(expected) > 0)
    values, vectors = np.linalg.eigh((expected / np.outer(unit, unit))[np.ix_(there, there)])
    # A sum over T rows leaves T eps of 1 where it should be 0, and with derivatives handed on by a
    # run some thousand times that; above 1/400 = 1/_INFLATED² a direction is determined.
    none = values < np.sqrt(np.finfo(here.dtype).eps)
    return np.asarray(np.eye(len(expected))[:, there] @ vectors[:, none])


def _units(information: np.ndarray) -> np.ndarray:
    """√diag of the information; 1 for a parameter without any."""
    scale = np.sqrt(np.maximum(np.diag(information), 0.0))
    return np.where(scale > 0, scale, 1.0)


def _newton_step(
    information: np.ndarray, here: _LikelihoodPoint, logged: np.ndarray
) -> tuple[np.ndarray, float]:
    """Newton's step where there is information, and the gain of log L that it promises.

    In each direction a log σ moves by at most 1. Where log L is convex the step goes uphill by as
    much as it would where it is concave.
    """
    of_all = _units(here.expected)
    # Others than log σ in units in which they have the information of the best known log σ.
    unit = np.where(logged, 1.0, of_all / of_all[logged].max(initial=1.0))
    none = (unit / of_all)[:, None] * _without_information(here)
    seen = np.linalg.svd(none.T)[2][none.shape[1] :].T
    values, vectors = np.linalg.eigh(seen.T @ (information / np.outer(unit, unit)) @ seen)
    vectors = seen @ vectors / unit[:, None]
    along = vectors.T @ here.gradient
    step = along / np.maximum(np.abs(values), np.finfo(float).tiny)
    moves = np.abs(vectors * step)[logged].max(axis=0, initial=0.0)
    step /= np.maximum(moves, 1.0)
    return vectors @ step, float(np.abs(along * step).sum() / 2)


def _observed_information(
    at: Callable[[np.ndarray], _LikelihoodPoint], here: _LikelihoodPoint, logged: np.ndarray
) -> Float[np.ndarray, "P P"]:
    """The observed information -∂²log L/∂q², from differences of the gradient over part of a σ."""
    rows = []
    for i, scale in enumerate(np.diag(here.spread)):
        h = 0.05 / np.sqrt(scale) if scale > 0 else 1e-3
        move = (min(h, _STEP) if logged[i] else h) * np.eye(len(here.q))[i]
        below, above = (at((here.q + sign * move).astype(here.dtype)) for sign in (-1, 1))
        rows.append((below.gradient - above.gradient) / (above.q - below.q)[i])
    found: np.ndarray = np.array(rows)
    return np.asarray((found + found.T) / 2)


def _upper_limit(
    at: Callable[[np.ndarray], _LikelihoodPoint], here: _LikelihoodPoint, i: int
) -> float:
    """The deviation, above that of parameter i, at which log L is lower by `_BOUND`; to 2 %."""
    unit, low, high = np.eye(len(here.q))[i], 0.0, np.log(2.0)
    while at(here.q + high * unit).value > here.value - _BOUND and high < 20:
        low, high = high, high + np.log(2.0)
    for _ in range(5):
        middle = (low + high) / 2
        inside = at(here.q + middle * unit).value > here.value - _BOUND
        low, high = (middle, high) if inside else (low, middle)
    return float(np.exp(here.q[i] + (low + high) / 2))


def _standard_errors(
    observed: np.ndarray, spread: np.ndarray, without: np.ndarray
) -> tuple[np.ndarray, np.ndarray, list[list[int]]]:
    """The inverse of the observed information, robust errors, and confounded parameters of each.

    A parameter that has part in a direction without information has no error, and the others have
    that which they have when it is known.

    Args:
        without: basis of the directions without, of `_without_information`.
    """
    without = without @ without.T
    lost = (np.diag(observed) <= 0) | (np.diag(without) > _PART)
    keep = np.flatnonzero(~lost)
    unit = _units(observed)
    values, vectors = np.linalg.eigh((observed / np.outer(unit, unit))[np.ix_(keep, keep)])
    # Differences over 0.01 have an error of that squared.
    none = vectors[:, values < _STEP**2]
    without[np.ix_(keep, keep)] += none @ none.T
    lost[keep] = np.diag(none @ none.T) > _PART
    regular = np.ix_(~lost, ~lost)
    inverse = np.linalg.inv(observed[regular])
    error = np.sqrt(np.diag(inverse))
    cov, robust = np.diag(np.where(lost, np.inf, 0.0)), np.where(lost, np.inf, 0.0)
    cov[regular] = inverse
    robust[~lost] = np.sqrt(np.diag(inverse @ spread[regular] @ inverse))
    related = np.abs(without) > _PART
    related[regular] = np.abs(inverse / np.outer(error, error)) > _CONFOUNDED
    np.fill_diagonal(related, False)
    return cov, robust, [list(np.flatnonzero(row)) for row in related]


_LOOSE = 1.0
"""Standard error of log σ above which a log does not determine σ: a factor e either way."""

_INFLATED = 20.0
"""Standard error over that with all other parameters known, above which a log determines a
parameter only together with others."""


_POLISH = 5
"""Newton's steps with the observed information at most."""
_HALVINGS = 8


class NoiseFit(NamedTuple):
    """The parameters that `fit_noise` found, and what they rest on."""

    names: tuple[str, ...]
    start: Float[np.ndarray, "P"]
    parameters: Float[np.ndarray, "P"]
    error: Float[np.ndarray, "P"]
    """standard errors from the observed information; infinite where the log determines none"""
    robust_error: Float[np.ndarray, "P"]
    """standard errors H⁻¹ (Σ g gᵀ) H⁻¹ with the gradient g of each row, which hold for other than
    Gaussian noise; twice the others or more says that the models do not fit"""
    cov: Float[np.ndarray, "P P"]
    """H⁻¹ by log σ of a standard deviation, and by other parameters as they are; rows without a
    standard error are infinite on the diagonal and 0 elsewhere"""
    log_likelihood: tuple[float, float]
    """at the start, and at the parameters"""
    nis_per_dof: tuple[float, float]
    """the same; 1 is honest"""
    dof: int
    """components of the fused measurements"""
    path: Float[np.ndarray, "iterations+1 P"]
    """parameters from the first guess on"""
    converged: bool
    """whether no step of at most a factor e is left by which log L would gain over `tolerance`"""
    upper: dict[str, float]
    """standard deviations of which the log does not say that they are above 0, and the value up to
    which it allows them (95 %), the other parameters held"""
    loose: dict[str, tuple[str, ...]]
    """parameters that the log does not determine, and those that they are confounded with"""


def fit_noise(
    info: Callable[..., Info],
    start: ArrayLike,
    *data: PyTree,
    names: Sequence[str] | None = None,
    deviation: Sequence[bool] | None = None,
    guess: ArrayLike | None = None,
    iterations: int = 200,
    tolerance: float = 1e-3,
) -> NoiseFit:
    """Standard deviations, and other parameters, that maximize the likelihood of a run.

        log L(p) = Σ log N(ν; 0, S) over fused measurements = Σ_t `Info.log_likelihood`

    Fisher scoring in the coordinates q = log p of standard deviations and q = p of others, then
    Newton's steps. The gradient is exact, from one run in forward mode, which also gives the
    expected information Σ ∂νᵀS⁻¹∂ν + ½ tr(S⁻¹∂S S⁻¹∂S), that of a scan being the sum over its
    measurements. The observed information H = -∂²log L/∂q² comes from central differences of the
    gradient. Maximum likelihood by the prediction-error decomposition: Schweppe, IEEE Trans.
    Information Theory 11(1), 1965; scoring: Harvey, "Forecasting, structural time series models
    and the Kalman filter", 1989, section 3.4; robust errors: White, Econometrica 50(1), 1982.

    The same measurements must be fused whatever p, or likelihoods are not of the same data: take a
    filter without a gate and with known identities, where a landmark is born at its first
    measurement. `as_associated` brings a log with others to that form. The first measurement of a
    landmark has no likelihood.

    Args:
        info: (p (P,), *data) -> the `Info` of a run, `lambda p, log: jaxslam.run(…).info`, in which
            models are made of p. Traced once for a function and shapes of the data; of a record
            with `__call__` once for all its numbers.
        start: (P,) parameters to compare with.
        data: trees of arrays for info, as the log.
        names: of the parameters, for messages; default "p0", …
        deviation: (P,) which parameters are standard deviations, and so above 0; default all.
        guess: (P,) where the search begins; default start.
        iterations: steps at most.
        tolerance: the gain of log L that is not worth a step.
    Returns:
        `NoiseFit`; look at `converged`, `loose` and `upper`.
    Raises:
        ValueError: on parameters that are not finite, or deviations not above 0; where a run fuses
            nothing or its likelihood is not finite; where other measurements are fused at other p.
    """
    first, begin, logged, labels = _check_start(
        start, guess, names, deviation, iterations, tolerance
    )

    of_run = as_record(info)

    def tried(q: np.ndarray) -> _LikelihoodPoint:
        found = jax.device_get(_evaluate(of_run, q, logged, data))
        value, gradient, spread, expected, nis, dof = (np.asarray(x, np.float64) for x in found)
        return _LikelihoodPoint(
            q, float(value), gradient, spread, expected, float(nis), int(dof), found[1].dtype
        )

    def at(q: np.ndarray) -> _LikelihoodPoint:
        point = tried(q)
        _check_point(point, logged)
        return point

    before = at(_coordinates(first, logged))
    here = before if guess is None else at(_coordinates(begin, logged))
    _check_same(before, here, logged)
    path = [here.q]

    def better(step: np.ndarray) -> _LikelihoodPoint | None:
        """The first point above the present one on a step halved up to `_HALVINGS` times."""
        for halving in range(_HALVINGS + 1):
            trial = tried(here.q + step / 2**halving)
            if np.isfinite([trial.value, *trial.gradient]).all():  # else a step too far
                _check_same(before, trial, logged)
                if trial.value > here.value:
                    return trial
        return None

    for _ in range(iterations):
        step, gain = _newton_step(here.expected, here, logged)
        higher = better(step)
        if higher is None:
            break
        here = higher
        path.append(here.q)
        if gain <= tolerance:
            break
    observed = _observed_information(at, here, logged)
    for _ in range(_POLISH):
        step, gain = _newton_step(observed, here, logged)
        if gain <= tolerance:
            break
        higher = better(step)
        if higher is None:
            break
        here = higher
        path.append(here.q)
        observed = _observed_information(at, here, logged)
    without = _without_information(here)

    def may_be_none(i: int) -> bool:
        """Whether log L at a deviation of 0 is not lower than here by `_BOUND`."""
        at_none = tried(here.q + np.log(_NONE) * np.eye(len(here.q))[i])
        return at_none.dof == here.dof and bool(at_none.value > here.value - _BOUND)

    # A deviation that may be 0, of which little is known and less the smaller it is, has no error,
    # and the others have that which they have without it.
    little = logged & (np.diag(observed) < 1 / _LOOSE**2) & (np.diag(here.expected) > 0)
    falling = np.array([bool(little[i]) and may_be_none(i) for i in range(len(here.q))])
    falling &= (without**2).sum(axis=1) <= _PART
    kept = np.where(falling | falling[:, None], 0.0, observed)
    cov, robust, related = _standard_errors(kept, here.spread, without)
    deviations = np.where(logged, _parameters(here.q, logged), 1.0)
    error = np.sqrt(np.diag(cov))
    alone = np.sqrt(np.maximum(np.diag(kept), 0.0))  # 1 / the error with the others known
    wide = ~np.isfinite(error) | (logged & (error > _LOOSE))
    wide |= np.where(alone > 0, error, 0.0) * alone > _INFLATED
    loose = set(np.flatnonzero(wide & ~falling).tolist())
    return NoiseFit(
        names=labels,
        start=first,
        parameters=_parameters(here.q, logged),
        error=deviations * error,
        robust_error=deviations * robust,
        cov=cov,
        log_likelihood=(before.value, here.value),
        nis_per_dof=(before.nis / before.dof, here.nis / here.dof),
        dof=here.dof,
        path=_parameters(np.array(path), logged),
        converged=_newton_step(observed, here, logged)[1] <= tolerance,
        upper={labels[i]: _upper_limit(at, here, int(i)) for i in np.flatnonzero(falling)},
        loose={
            labels[i]: tuple(labels[j] for j in related[i])
            for i in range(len(labels))
            if {i, *related[i]} & loose and not falling[i]
        },
    )


def as_associated(log: Log, info: Info) -> Log:
    """The log with the decisions of a run in it, for a filter with known identities and no gate.

    The tag of a fused or born measurement is its landmark's slot, and others are not valid. The run
    must not have removed landmarks, or slots are of several.

    Args:
        log, info: of the run, (T, M) measurements.
    """
    status = np.asarray(info.status)
    used = (status == Status.FUSED) | (status == Status.BORN)
    held: PyTree = np.where(used, np.asarray(info.slot), -1).astype(np.int32)
    return log._replace(scan=log.scan._replace(tag=held, valid=used))


@partial(jax.jit, inline=True)
def _evaluate(
    info: Callable[..., Info],
    q: Float[Array, "P"],
    logged: Bool[Array, "P"],
    data: tuple[PyTree, ...],
) -> tuple[Array, ...]:
    """log L, its gradient, Σ g gᵀ over the rows, the expected information, NIS and dof."""

    def rows(q: Float[Array, "P"]) -> PyTree:
        found = info(jnp.where(logged, jnp.exp(jnp.where(logged, q, 0.0)), q), *data)
        fused = found.status == Status.FUSED
        nis = jnp.where(fused, found.nis, 0.0).sum()
        dof = jnp.where(fused, found.dof, 0).sum()
        size = found.innovation.shape[-1]
        innovation = jnp.where(fused[..., None], found.innovation, 0.0).reshape(-1, size)
        cov = jnp.where(fused[..., None, None], found.innovation_cov, 0.0).reshape(-1, size, size)
        differentiated = found.log_likelihood, innovation, cov
        return differentiated, (found.log_likelihood.sum(), cov, nis, dof)

    (by_row, by_mean, by_cov), (value, cov, nis, dof) = jax.jacfwd(rows, has_aux=True)(q)
    by_row = by_row.reshape(-1, q.shape[0])

    def expected(cov: Array, by_mean: Array, by_cov: Array) -> Array:
        # The identity where nothing is fused, and in the unused rows of a smaller part of a suite.
        cov = cov + jnp.diag((jnp.diag(cov) == 0).astype(cov.dtype))
        relative = jnp.linalg.solve(cov, by_cov.reshape(cov.shape[0], -1)).reshape(by_cov.shape)
        shape = jnp.einsum("ijp,jiq->pq", relative, relative) / 2
        found: Array = by_mean.T @ jnp.linalg.solve(cov, by_mean) + shape
        return found

    information = jax.vmap(expected)(cov, by_mean, by_cov).sum(axis=0)
    return value, by_row.sum(axis=0), by_row.T @ by_row, information, nis, dof


def _coordinates(p: np.ndarray, logged: np.ndarray) -> np.ndarray:
    return np.where(logged, np.log(np.where(logged, p, 1.0)), p)


def _parameters(q: np.ndarray, logged: np.ndarray) -> np.ndarray:
    return np.where(logged, np.exp(np.where(logged, q, 0.0)), q)


def _check_start(
    start: ArrayLike,
    guess: ArrayLike | None,
    names: Sequence[str] | None,
    deviation: Sequence[bool] | None,
    iterations: int,
    tolerance: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, tuple[str, ...]]:
    """Start, guess, which parameters are deviations, and names; ValueError on what is none."""
    first = np.atleast_1d(np.asarray(start, np.float64))
    begin = first if guess is None else np.atleast_1d(np.asarray(guess, np.float64))
    logged = np.ones(first.shape, bool) if deviation is None else np.asarray(deviation, bool)
    labels = tuple(names or (f"p{i}" for i in range(first.size)))
    for what, p in (("start", first), ("guess", begin)):
        if p.ndim != 1 or not p.size or not np.isfinite(p).all() or p.shape != first.shape:
            raise ValueError(f"fit_noise: expected a {what} of shape (P,), finite, got {p}")
        if logged.shape != p.shape or len(labels) != p.size:
            raise ValueError(f"fit_noise: expected {p.size} names and deviations, as the start")
        if (p[logged] <= 0).any():
            raise ValueError(f"fit_noise: expected standard deviations above 0, got {p}")
    check_count("fit_noise: iterations", iterations)
    if not tolerance > 0:
        raise ValueError(f"fit_noise: expected a tolerance above 0, got {tolerance}")
    return first, begin, logged, labels


def _check_point(point: _LikelihoodPoint, logged: np.ndarray) -> None:
    where = f"at parameters {_parameters(point.q, logged)}"
    if not point.dof:
        raise ValueError(f"fit_noise: expected fused measurements, got none {where}")
    if not (np.isfinite(point.value) and np.isfinite(point.gradient).all()):
        raise ValueError(f"fit_noise: the likelihood or its gradient is not finite {where}")


def _check_same(one: _LikelihoodPoint, other: _LikelihoodPoint, logged: np.ndarray) -> None:
    if one.dof != other.dof:
        p, q = (_parameters(point.q, logged) for point in (one, other))
        raise ValueError(
            f"fit_noise: expected the same measurements at all parameters, got {one.dof} fused "
            f"components at {p} and {other.dof} at {q}: take a filter without a gate and with "
            "known identities (as_associated)"
        )
