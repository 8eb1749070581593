"""Systematic errors: parameters from a filter's innovations, and what their uncertainty adds to the
covariance of a result."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree
from numpy.typing import ArrayLike

from jaxslam.core._numbers import is_concrete
from jaxslam.core._record import as_record
from jaxslam.core._reprs import describe
from jaxslam.core.types import Info, Status
from jaxslam.core.validation import (
    InvalidField,
    at_least,
    covariance,
    positive,
    refusals_of,
    require,
)
from jaxslam.math import _linalg as linalg


class Calibration(NamedTuple):
    """The result of `calibrate`: parameters, their covariance, and the iterates."""

    parameters: Float[np.ndarray, "P"]
    cov: Float[np.ndarray, "P P"]
    """(JᵀJ)⁻¹; valid only if the filter's noise covariances are"""
    path: Float[np.ndarray, "iterations+1 P"]
    """parameters from the start on"""
    misfit: Float[np.ndarray, "iterations"]
    """Σ ‖w‖² / dof before each step"""
    dof: Int[np.ndarray, "iterations"]
    """components of fused measurements, before each step"""
    converged: bool
    """whether the last step was small enough"""


def calibrate(
    info: Callable[[jax.Array], Info],
    start: ArrayLike,
    *,
    iterations: int = 10,
    tolerance: float = 0.01,
) -> Calibration:
    """Model parameters estimated from the whitened innovations of a run, with their covariance.

    Gauss-Newton on Σ ‖w(p)‖², w = L⁻¹ ν with S = L Lᵀ, over all fused measurements:

        p ← p - (Jᵀ J)⁻¹ Jᵀ w,    J = ∂w/∂p, S held fixed

    J comes from one run in forward mode. The innovations of a filter with correct models are white,
    and ∂ν/∂p depends on the past alone, so that E[Jᵀ w] = 0 at the true p. This is the prediction
    error method (Ljung, "System Identification", 1999, section 7.2); where all is linear with
    Gaussian noise and S does not depend on p it is the maximum-likelihood estimate.

    Associations are recomputed at each p and not differentiated. They need not be given: a filter
    with `association.Nearest` and `life.Recency(patience=…)` keeps a local map, in which landmarks
    seen close in time are associated whatever the drift, and no loop is closed.

    Each measurement of a scan is whitened by its S; the correlation between the measurements of
    one joint update is ignored, which costs a little precision.

    Args:
        info: p (P,) -> the `Info` of a run, `lambda p: jaxslam.run(…).info`, where p may enter the
            controls, the models or the mounting. Neither a noise covariance nor the size of the
            measurements may depend on it: the innovations would be least where the noise is
            largest, or the measurements smallest; `fit_noise` finds such parameters. Traced once;
            of a record with `__call__` once for all its numbers.
        start: (P,), or a number.
        iterations: steps at most.
        tolerance: stop when no parameter moves by more than this many of its standard deviations.
    Returns:
        `Calibration`; look at `converged`.
    Raises:
        ValueError: on a start that is not a finite vector, iterations below 1, a tolerance not
            above 0; where a run fuses nothing, or its innovations are not finite or do not
            distinguish the parameters.
    """
    p = np.atleast_1d(np.asarray(start, np.float64))
    with refusals_of("calibrate"):
        if p.ndim != 1 or not p.size or not np.isfinite(p).all():
            raise InvalidField("start", f"expected shape (P,), finite, got {start!r}")
        require("iterations", iterations, at_least(1))
        require("tolerance", tolerance, positive)

    of_run = as_record(info)
    path, misfit, dofs, converged = [p], [], [], False
    for _ in range(iterations):
        jacobian, (w, dof) = jax.device_get(_step(of_run, p))
        # A run hands derivatives on from step to step, which leaves half of the digits.
        rounding = np.sqrt(np.finfo(jacobian.dtype).eps)
        jacobian, w, dof = np.asarray(jacobian, np.float64), np.asarray(w, np.float64), int(dof)
        fault = ""
        if not dof:
            fault = (
                f"expected fused measurements, got none at parameters {p}: start closer, or with a "
                "larger gate"
            )
        elif not (np.isfinite(jacobian).all() and np.isfinite(w).all()):
            fault = f"the innovations or their derivatives are not finite at parameters {p}"
        if fault:
            raise InvalidField("info", fault, owner="calibrate")
        # Columns of unit length: whether parameters can be distinguished does not depend on units.
        length = np.linalg.norm(jacobian, axis=0)
        left, values, right = np.linalg.svd(jacobian / np.where(length > 0, length, 1.0), False)
        if values[-1] <= len(p) * rounding * values[0]:
            raise InvalidField(
                "info",
                f"the log does not determine all parameters at {p}: fix one, or use a log with "
                "more motion",
                owner="calibrate",
            )
        # J⁺ = V Σ⁻¹ Uᵀ without Uᵀ, in the units of the parameters; (JᵀJ)⁻¹ is its square.
        inverse = right.T / values / length[:, None]
        cov = inverse @ inverse.T
        move = -inverse @ (left.T @ w)
        p = p + move
        path.append(p)
        misfit.append(float(w @ w) / dof)
        dofs.append(dof)
        converged = bool((np.abs(move) <= tolerance * np.sqrt(np.diag(cov))).all())
        if converged:
            break
    return Calibration(p, cov, np.array(path), np.array(misfit), np.array(dofs), converged)


@partial(jax.jit, inline=True)
def _step(
    info: Callable[[jax.Array], Info], p: Float[Array, "P"]
) -> tuple[Float[Array, "K P"], tuple[Float[Array, "K"], Int[Array, ""]]]:
    """The derivative of the whitened innovations, these, and their degrees of freedom."""

    def whiten(
        p: Float[Array, "P"],
    ) -> tuple[Float[Array, "K"], tuple[Float[Array, "K"], Int[Array, ""]]]:
        """The whitened innovations, twice (one for `jacfwd`), and their degrees of freedom."""
        run = info(p)
        if not isinstance(run, Info):
            raise ValueError(
                "calibrate: expected info to return the Info of a run, `run(…).info`, got "
                f"{type(run).__name__}"
            )
        fused = run.status == Status.FUSED
        # T·M measurements: (T, M, Z, Z) becomes (T·M, Z, Z).
        count, size = fused.size, run.innovation.shape[-1]
        used = fused.reshape(count)
        cov = jax.lax.stop_gradient(run.innovation_cov).reshape(count, size, size)
        # Masked before and after the factor: an empty slot then has no effect on derivatives.
        cov = jnp.where(used[:, None, None], cov, jnp.eye(size, dtype=cov.dtype))
        factor = jax.vmap(lambda s: linalg.cholesky(s)[0])(cov)
        residual = jnp.where(used[:, None], run.innovation.reshape(count, size), 0.0)
        w = jax.vmap(linalg.solve_lower)(factor, residual).reshape(-1)
        return w, (w, jnp.where(fused, run.dof, 0).sum())

    derivative: tuple[Array, tuple[Array, Array]] = jax.jacfwd(whiten, has_aux=True)(p)
    return derivative


def consider_cov(
    result: Callable[[Float[Array, "P"]], PyTree[Float[Array, "*shape n"]]],
    parameters: ArrayLike,
    cov: ArrayLike,
) -> PyTree[Float[np.ndarray, "*shape n n"]]:
    """The covariance that uncertain parameters add to each row of a result.

        J C Jᵀ,    J = ∂ result / ∂ p

    A filter takes the constants of its models for exact. Where they have the covariance C and its
    estimate the covariance P for given p, the estimate's covariance is P + J C Jᵀ to first order
    (consider covariance: Schmidt 1966; Tapley, Schutz & Born, "Statistical Orbit Determination",
    2004, section 6.4). J is of the whole run, in forward mode; gates and associations stay as they
    are decided at p.

        added = consider_cov(lambda p: run(filter_of(p), …).estimate.pose, constants, cov)
        cov = trace.estimate.pose_cov + added

    This holds for constants that are independent of the log. Constants found in the same log, as by
    `calibrate`, depend on its noise: P + J C Jᵀ is then right at the last row, where it is the
    covariance of the joint estimate of state and constants, and in general too large before.

    Args:
        result: p (P,) -> an array (*shape, n), as poses (T, 3), or a tree of such arrays. Traced
            once; of a record with `__call__` once for all its numbers.
        parameters: where J is taken; a number counts as (1,).
        cov: (P, P) C, or a number for one parameter.
    Raises:
        ValueError: within a trace; on parameters that are no finite vector; on a covariance of
            another size, or that is none; on a result that is no array (*shape, n) of real numbers,
            or that is not finite at p, itself or its derivatives.
    """
    with refusals_of("consider_cov"):
        if not callable(result):
            raise InvalidField("result", f"expected a function of p, got {describe(result)}")
        if not (is_concrete(parameters) and is_concrete(cov)):
            raise InvalidField("", "computes on the host; call it outside jit, vmap and grad")
        p = np.atleast_1d(np.asarray(parameters, np.float64))
        if p.ndim != 1 or not p.size or not np.isfinite(p).all():
            raise InvalidField("parameters", f"expected shape (P,), finite, got {parameters!r}")
        c = np.asarray(cov, np.float64)
        c = c.reshape(1, 1) if c.ndim == 0 and p.size == 1 else c
        require("cov", c, covariance(p.size))

    jacobians, values = jax.device_get(_differentiate(as_record(result), p))
    if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((jacobians, values))):
        reason = f"the result or its derivatives at {p} are not finite"
        raise InvalidField("result", reason, owner="consider_cov")

    def propagate(jacobian: np.ndarray) -> np.ndarray:
        jacobian = np.asarray(jacobian, np.float64)
        return np.asarray(jacobian @ c @ np.swapaxes(jacobian, -1, -2))

    return jax.tree.map(propagate, jacobians)


@partial(jax.jit, inline=True)
def _differentiate(
    result: Callable[[Float[Array, "P"]], PyTree], p: Float[Array, "P"]
) -> tuple[PyTree, PyTree]:
    """The derivative of a result, and the result."""

    def both(p: Float[Array, "P"]) -> tuple[PyTree, PyTree]:
        value = result(p)
        for leaf in jax.tree.leaves(value) or [None]:
            array = isinstance(leaf, jax.Array)
            if not array or not leaf.shape or not jnp.issubdtype(leaf.dtype, jnp.floating):
                got = f"{leaf.shape} {leaf.dtype}" if array else type(leaf).__name__
                raise ValueError(
                    "consider_cov: expected result to return an array (*shape, n) of real numbers, "
                    f"as trace.estimate.pose, got {got}"
                )
        return value, value

    derivative: tuple[PyTree, PyTree] = jax.jacfwd(both, has_aux=True)(p)
    return derivative
