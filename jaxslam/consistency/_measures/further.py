"""NEES of the further numbers of the robot, as a velocity or a bias: of each, and of all together.

Which numbers there are depends on the motion model, so these measures are made for a campaign.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxslam.consistency._measures.measure import Measure
from jaxslam.core.logs._tables import split_unit
from jaxslam.core.types import Trace, Truth
from jaxslam.math import _linalg as linalg
from jaxslam.math.angles import wrap

_EACH, ALL = "nees_of_", "nees_further"


def measure_of(key: str) -> Measure | None:
    """The measure of a key without its computation, for tables; None of another measure's key."""
    if key == ALL:
        return Measure(key, "NEES of the further states / their number", honest=1, positive=True)
    if key.startswith(_EACH):
        return Measure(key, f"{key.removeprefix(_EACH)} NEES", honest=1, positive=True)
    return None


@functools.cache  # the same measures are one program
def measures_of_state(state: tuple[str, ...]) -> tuple[Measure, ...]:
    """The measures of `Motion.state`: one for each further number, one for several together."""
    names = [split_unit(name)[0] for name in state[3:]]
    rows = {f"{_EACH}{name}": [k] for k, name in enumerate(names)}
    if len(names) > 1:
        rows[ALL] = list(range(len(names)))
    turns = np.array([name.endswith("[rad]") for name in state[3:]])

    def _nees(truth: Truth, trace: Trace, rows: list[int]) -> Array:
        """eᵀ P⁻¹ e/n (T,) of n further numbers; NaN where P is not positive definite."""
        estimate = trace.estimate
        if estimate.further is None or estimate.further_cov is None:
            return jnp.asarray(jnp.nan)
        error = jnp.asarray(truth.further) - estimate.further
        error = jnp.where(turns, wrap(error), error)[:, np.array(rows)]
        cov = estimate.further_cov[:, np.array(rows)][:, :, np.array(rows)]

        def square(error: Array, cov: Array) -> Array:
            unit = jnp.sqrt(jnp.diagonal(cov))  # to a unit diagonal: units differ
            unit = jnp.where(unit > 0, unit, 1.0)
            root, positive = linalg.cholesky(cov / (unit[:, None] * unit[None, :]))
            white = linalg.solve_lower(root, (error / unit)[:, None])
            return jnp.where(positive, (white**2).sum() / len(rows), jnp.nan)

        return jax.vmap(square)(error, jnp.asarray(cov))

    def nees_of(rows: list[int]) -> Callable[[Truth, Trace], Array]:
        return lambda truth, trace: _nees(truth, trace, rows)

    return tuple(Measure(key, key, nees_of(at)) for key, at in rows.items())
