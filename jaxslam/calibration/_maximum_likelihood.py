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

from jaxslam.core._record import as_record
from jaxslam.core.types import Info, Log, Status
from jaxslam.core.validation import InvalidField, at_least, positive, refusals_of, require

_BOUND = 1.35
"""The fall of log L at the 95 % upper limit of a parameter whose estimate is 0: half the 0.90
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


def _directions_without_information(point: _LikelihoodPoint) -> np.ndarray:
    """An orthonormal basis (P, K) of the directions without information, by q √diag F.

    In these coordinates it does not depend on units. Along such a direction no innovation and no S
    has a derivative: nothing is to be gained, and the gradient and the observed information along
    it are rounding.
    """
    expected = point.expected
    unit, informed = _units(expected), np.flatnonzero(np.diag(expected) > 0)
    scaled = (expected / np.outer(unit, unit))[np.ix_(informed, informed)]
    values, vectors = np.linalg.eigh(scaled)
    # A sum over T rows leaves T eps of 1 where it should be 0, and with derivatives handed on by a
    # run some thousand times that; above 1/400 = 1/_INFLATED² a direction is determined.
    none = values < np.sqrt(np.finfo(point.dtype).eps)
    return np.asarray(np.eye(len(expected))[:, informed] @ vectors[:, none])


def _units(information: np.ndarray) -> np.ndarray:
    """√diag of the information; 1 for a parameter without any."""
    scale = np.sqrt(np.maximum(np.diag(information), 0.0))
    return np.where(scale > 0, scale, 1.0)


def _newton_step(
    information: np.ndarray, point: _LikelihoodPoint, logged: np.ndarray
) -> tuple[np.ndarray, float]:
    """Newton's step where there is information, and the gain of log L that it promises.

    In each direction a log σ moves by at most 1. Where log L is convex the step goes uphill by as
    much as it would where it is concave.
    """
    of_all = _units(point.expected)
    # Others than log σ in units in which they have the information of the best known log σ.
    unit = np.where(logged, 1.0, of_all / of_all[logged].max(initial=1.0))
    none = (unit / of_all)[:, None] * _directions_without_information(point)
    seen = np.linalg.svd(none.T)[2][none.shape[1] :].T
    values, vectors = np.linalg.eigh(seen.T @ (information / np.outer(unit, unit)) @ seen)
    vectors = seen @ vectors / unit[:, None]
    along = vectors.T @ point.gradient
    step = along / np.maximum(np.abs(values), np.finfo(float).tiny)
    moves = np.abs(vectors * step)[logged].max(axis=0, initial=0.0)
    step /= np.maximum(moves, 1.0)
    return vectors @ step, float(np.abs(along * step).sum() / 2)


def _observed_information(
    evaluate: Callable[[np.ndarray], _LikelihoodPoint], point: _LikelihoodPoint, logged: np.ndarray
) -> Float[np.ndarray, "P P"]:
    """The observed information -∂²log L/∂q², from differences of the gradient over part of a σ."""
    rows = []
    for i, scale in enumerate(np.diag(point.spread)):
        h = 0.05 / np.sqrt(scale) if scale > 0 else 1e-3
        # A twentieth of a σ by Σ g gᵀ; where the gradient is zero in all rows any step is as good.
        move = (min(h, _STEP) if logged[i] else h) * np.eye(len(point.q))[i]
        below, above = (evaluate((point.q + sign * move).astype(point.dtype)) for sign in (-1, 1))
        rows.append((below.gradient - above.gradient) / (above.q - below.q)[i])
    information: np.ndarray = np.array(rows)
    return np.asarray((information + information.T) / 2)


def _upper_limit(
    evaluate: Callable[[np.ndarray], _LikelihoodPoint], point: _LikelihoodPoint, i: int
) -> float:
    """The deviation i, above its estimate, at which log L is lower by `_BOUND`; to 2 %."""
    unit, low, high = np.eye(len(point.q))[i], 0.0, np.log(2.0)
    while evaluate(point.q + high * unit).value > point.value - _BOUND and high < 20:
        low, high = high, high + np.log(2.0)
    for _ in range(5):
        middle = (low + high) / 2
        inside = evaluate(point.q + middle * unit).value > point.value - _BOUND
        low, high = (middle, high) if inside else (low, middle)
    return float(np.exp(point.q[i] + (low + high) / 2))


def _standard_errors(
    observed: np.ndarray, spread: np.ndarray, without: np.ndarray
) -> tuple[np.ndarray, np.ndarray, list[list[int]]]:
    """The inverse of the observed information, robust errors, and confounded parameters of each.

    A parameter that has part in a direction without information has no error, and the others have
    that which they have when it is known.

    Args:
        without: basis of the directions without, of `_directions_without_information`.
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
"""The largest number of Newton's steps with the observed information."""
_HALVINGS = 8
"""The largest number of halvings of a step: to a 256th."""


class NoiseFit(NamedTuple):
    """The result of `fit_noise`: parameters, their errors, and the likelihood."""

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
    """at the start, and at the parameters; 1 where S is as large as the innovations are"""
    dof: int
    """components of the fused measurements"""
    path: Float[np.ndarray, "iterations+1 P"]
    """parameters from the first guess on"""
    converged: bool
    """whether no step of at most a factor e is left by which log L would gain over `tolerance`"""
    upper: dict[str, float]
    """95 % upper limits of standard deviations that may be 0 for all the log says, with the other
    parameters held"""
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
    expected information Σ ∂νᵀS⁻¹∂ν + ½ tr(S⁻¹∂S S⁻¹∂S), for a scan the sum over its
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
    with refusals_of("fit_noise"):
        require("iterations", iterations, at_least(1))
        require("tolerance", tolerance, positive)
        first, begin, logged, labels = _check_start(start, guess, names, deviation)

    of_run = as_record(info)

    def try_point(q: np.ndarray) -> _LikelihoodPoint:
        results = jax.device_get(_evaluate(of_run, q, logged, data))
        value, gradient, spread, expected, nis, dof = (np.asarray(x, np.float64) for x in results)
        dtype = results[1].dtype
        return _LikelihoodPoint(
            q, float(value), gradient, spread, expected, float(nis), int(dof), dtype
        )

    def evaluate(q: np.ndarray) -> _LikelihoodPoint:
        point = try_point(q)
        where = f"at parameters {_parameters(q, logged)}"
        if not point.dof:
            raise InvalidField("info", f"expected fused measurements, got none {where}")
        if not (np.isfinite(point.value) and np.isfinite(point.gradient).all()):
            raise InvalidField("info", f"the likelihood or its gradient is not finite {where}")
        return point

    with refusals_of("fit_noise"):
        before = evaluate(_coordinates(first, logged))
        point = before if guess is None else evaluate(_coordinates(begin, logged))
        _check_same(before, point, logged)
    path = [point.q]

    def line_search(step: np.ndarray) -> _LikelihoodPoint | None:
        """The first point above the present one on a step halved up to `_HALVINGS` times."""
        for halving in range(_HALVINGS + 1):
            trial = try_point(point.q + step / 2**halving)
            if np.isfinite([trial.value, *trial.gradient]).all():  # else a step too far
                _check_same(before, trial, logged)
                if trial.value > point.value:
                    return trial
        return None

    # Fisher scoring, by the expected information.
    for _ in range(iterations):
        step, gain = _newton_step(point.expected, point, logged)
        with refusals_of("fit_noise"):
            higher = line_search(step)
        if higher is None:
            break
        point = higher
        path.append(point.q)
        if gain <= tolerance:
            break

    # Newton's steps, by the observed information, which takes 2 P runs.
    observed = _observed_information(evaluate, point, logged)
    for _ in range(_POLISH):
        step, gain = _newton_step(observed, point, logged)
        if gain <= tolerance:
            break
        with refusals_of("fit_noise"):
            higher = line_search(step)
        if higher is None:
            break
        point = higher
        path.append(point.q)
        observed = _observed_information(evaluate, point, logged)

    # Standard errors.
    without = _directions_without_information(point)

    def may_be_none(i: int) -> bool:
        """Whether log L at a deviation of 0 is at most `_BOUND` below the present one."""
        at_none = try_point(point.q + np.log(_NONE) * np.eye(len(point.q))[i])
        return at_none.dof == point.dof and bool(at_none.value > point.value - _BOUND)

    # A deviation that may be 0, of which little is known and less the smaller it is, has no error,
    # and the others have that which they have without it.
    little = logged & (np.diag(observed) < 1 / _LOOSE**2) & (np.diag(point.expected) > 0)
    vanishing = np.array([bool(little[i]) and may_be_none(i) for i in range(len(point.q))])
    vanishing &= (without**2).sum(axis=1) <= _PART
    kept = np.where(vanishing | vanishing[:, None], 0.0, observed)
    cov, robust, related = _standard_errors(kept, point.spread, without)
    deviations = np.where(logged, _parameters(point.q, logged), 1.0)
    error = np.sqrt(np.diag(cov))
    alone = np.sqrt(np.maximum(np.diag(kept), 0.0))  # 1 / the error with the others known
    wide = ~np.isfinite(error) | (logged & (error > _LOOSE))
    wide |= np.where(alone > 0, error, 0.0) * alone > _INFLATED
    loose = set(np.flatnonzero(wide & ~vanishing).tolist())
    return NoiseFit(
        names=labels,
        start=first,
        parameters=_parameters(point.q, logged),
        error=deviations * error,
        robust_error=deviations * robust,
        cov=cov,
        log_likelihood=(before.value, point.value),
        nis_per_dof=(before.nis / before.dof, point.nis / point.dof),
        dof=point.dof,
        path=_parameters(np.array(path), logged),
        converged=_newton_step(observed, point, logged)[1] <= tolerance,
        upper={labels[i]: _upper_limit(evaluate, point, int(i)) for i in np.flatnonzero(vanishing)},
        loose={
            labels[i]: tuple(labels[j] for j in related[i])
            for i in range(len(labels))
            if {i, *related[i]} & loose and not vanishing[i]
        },
    )


def as_associated(log: Log, info: Info) -> Log:
    """The log with the decisions of a run in it, for a filter with known identities and no gate.

    The tag of a fused or born measurement is its landmark's slot; others are not valid. The run
    must not have removed landmarks, or a slot is of several.

    Args:
        log, info: of the run, (T, M) measurements.
    """
    status = np.asarray(info.status)
    used = (status == Status.FUSED) | (status == Status.BORN)
    tag: PyTree = np.where(used, np.asarray(info.slot), -1).astype(np.int32)
    return log._replace(scan=log.scan._replace(tag=tag, valid=used))


@partial(jax.jit, inline=True)
def _evaluate(
    info: Callable[..., Info],
    q: Float[Array, "P"],
    logged: Bool[Array, "P"],
    data: tuple[PyTree, ...],
) -> tuple[Array, ...]:
    """log L, its gradient, Σ g gᵀ over the rows, the expected information, NIS and dof."""

    def rows(q: Float[Array, "P"]) -> PyTree:
        run = info(jnp.where(logged, jnp.exp(jnp.where(logged, q, 0.0)), q), *data)
        fused = run.status == Status.FUSED
        nis = jnp.where(fused, run.nis, 0.0).sum()
        dof = jnp.where(fused, run.dof, 0).sum()
        size = run.innovation.shape[-1]
        innovation = jnp.where(fused[..., None], run.innovation, 0.0).reshape(-1, size)
        cov = jnp.where(fused[..., None, None], run.innovation_cov, 0.0).reshape(-1, size, size)
        differentiated = run.log_likelihood, innovation, cov
        return differentiated, (run.log_likelihood.sum(), cov, nis, dof)

    (by_row, by_mean, by_cov), (value, cov, nis, dof) = jax.jacfwd(rows, has_aux=True)(q)
    by_row = by_row.reshape(-1, q.shape[0])

    def expected_information(cov: Array, by_mean: Array, by_cov: Array) -> Array:
        # The identity where nothing is fused, and in the unused rows of a smaller part of a suite.
        cov = cov + jnp.diag((jnp.diag(cov) == 0).astype(cov.dtype))
        # S⁻¹ ∂S for all parameters at once: (Z, Z, P) as one right-hand side (Z, Z P).
        relative = jnp.linalg.solve(cov, by_cov.reshape(cov.shape[0], -1)).reshape(by_cov.shape)
        of_cov = jnp.einsum("ijp,jiq->pq", relative, relative) / 2
        of_mean: Array = by_mean.T @ jnp.linalg.solve(cov, by_mean)
        return of_mean + of_cov

    information = jax.vmap(expected_information)(cov, by_mean, by_cov).sum(axis=0)
    return value, by_row.sum(axis=0), by_row.T @ by_row, information, nis, dof


def _coordinates(p: np.ndarray, logged: np.ndarray) -> np.ndarray:
    """The coordinates q: log p of deviations, others as they are."""
    return np.where(logged, np.log(np.where(logged, p, 1.0)), p)


def _parameters(q: np.ndarray, logged: np.ndarray) -> np.ndarray:
    """The parameters p at coordinates q."""
    return np.where(logged, np.exp(np.where(logged, q, 0.0)), q)


def _check_start(
    start: ArrayLike,
    guess: ArrayLike | None,
    names: Sequence[str] | None,
    deviation: Sequence[bool] | None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, tuple[str, ...]]:
    """Start, guess, which parameters are deviations, and names; InvalidField on invalid ones."""
    first = np.atleast_1d(np.asarray(start, np.float64))
    begin = first if guess is None else np.atleast_1d(np.asarray(guess, np.float64))
    logged = np.ones(first.shape, bool) if deviation is None else np.asarray(deviation, bool)
    labels = tuple(names or (f"p{i}" for i in range(first.size)))
    for argument, p in (("start", first), ("guess", begin)):
        if p.ndim != 1 or not p.size or not np.isfinite(p).all() or p.shape != first.shape:
            raise InvalidField(argument, f"expected shape (P,), finite, got {p}")
        if logged.shape != p.shape or len(labels) != p.size:
            raise InvalidField("names, deviation", f"expected {p.size} of each, as the start has")
        if (p[logged] <= 0).any():
            raise InvalidField(argument, f"expected standard deviations above 0, got {p}")
    return first, begin, logged, labels


def _check_same(before: _LikelihoodPoint, after: _LikelihoodPoint, logged: np.ndarray) -> None:
    """Raise InvalidField where other measurements are fused at one point than at another."""
    if before.dof != after.dof:
        p, q = (_parameters(point.q, logged) for point in (before, after))
        raise InvalidField(
            "info",
            f"expected the same measurements at all parameters, got {before.dof} fused components "
            f"at {p} and {after.dof} at {q}: take a filter without a gate and with known "
            "identities (as_associated)",
        )
