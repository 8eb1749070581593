"""Joint compatibility branch and bound (JCBB), with fixed memory and a search budget."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxslam.association._rules import check_new_gate, far_from_all, gate_probability
from jaxslam.core._record import field, record, static
from jaxslam.core.protocols import Association, Pairs, Prediction
from jaxslam.core.types import Scan
from jaxslam.core.validation import at_least, probability
from jaxslam.math import _linalg as linalg
from jaxslam.math._arrays import Number
from jaxslam.math.stats import chi2_quantile


@record
class JointCompatibility:
    """JCBB: the largest jointly compatible set of pairs; of several, that of least distance.

    Of a hypothesis H = {(i, j)} with m pairs, D² = ν_Hᵀ S_H⁻¹ ν_H with all cross-covariances, and
    it is compatible if every pair is (d² <= χ²(Z, p)) and D² <= χ²(m·Z, p). Neira & Tardós, "Data
    association in stochastic mapping using the joint compatibility test", IEEE T-RA 17(6), 2001.

    Depth first over the measurements, the nearest landmark first, none last. S_H = L Lᵀ grows by
    one block row a pair, and D² with it, so a branch ends where it cannot have more pairs than
    the best, or as many at a lower D², or where D² exceeds even χ² of all pairs it could still
    make. (The original ends it where the pairs so far are not compatible, and then depends on
    their order.) A measurement with no landmark within `new_gate` is new.

    Raises ValueError on a probability not above 0 and below 1, a new_gate below it, or a budget or
    candidates below 1.
    """

    probability: float = static(default=0.99, check=probability)
    """p of both tests"""
    new_gate: Number | None = field(default=None, check=gate_probability)
    """probability of the gate of new landmarks, at least `probability`; default `probability`"""
    budget: int = static(default=2000, kw_only=True, check=at_least(1))
    """largest number of nodes of the search. At this limit the best result is returned, and
    `Association.exhausted` is set"""
    candidates: int = static(default=8, kw_only=True, check=at_least(1))
    """number of nearest compatible landmarks tried for a measurement; if there are more,
    `exhausted` is set"""

    def __post_init__(self) -> None:
        check_new_gate(self.probability, self.new_gate)

    def __call__(self, prediction: Prediction, scan: Scan) -> Association:
        pairs: Pairs = jax.lax.stop_gradient(prediction.pairs(scan))
        m, _, size_z = pairs.innovation.shape
        if m == 0:
            return Association(jnp.full(0, -1, jnp.int32), scan.valid, jnp.asarray(False))
        quantiles = [chi2_quantile(self.probability, k * size_z) for k in range(1, m + 1)]
        levels = jnp.asarray([0.0, *quantiles], pairs.distance.dtype)
        cross = jax.lax.stop_gradient(prediction.cross())
        compatible = pairs.possible & (pairs.distance <= levels[1])
        order = jnp.argsort(jnp.where(compatible, pairs.distance, jnp.inf), axis=1)
        slot = order[:, : min(self.candidates, order.shape[1])].astype(jnp.int32)
        at = jnp.arange(m)[:, None], slot
        left = jnp.append(jnp.cumsum(compatible.any(axis=1)[::-1])[::-1], 0)
        problem = _Problem(
            slot=slot,
            is_compatible=compatible[at],
            innovation=pairs.innovation[at],
            cov=pairs.cov[at],
            cross=cross,
            levels=levels,
            left=left,
            cut=(compatible.sum(axis=1) > slot.shape[1]).any(),
        )
        search = _search(problem, self.budget)
        exhausted = (search.level >= 0) | problem.cut
        far = far_from_all(pairs, scan, self.probability, self.new_gate)
        return Association(search.best, far & (search.best < 0), exhausted)


class _Problem(NamedTuple):
    """The M measurements with their K nearest compatible landmarks each."""

    slot: Int[Array, "M K"]
    """candidates, the nearest first"""
    is_compatible: Bool[Array, "M K"]
    """false for the landmarks with which a row is padded to K"""
    innovation: Float[Array, "M K Z"]
    cov: Float[Array, "M K Z Z"]
    cross: Float[Array, "N Z N Z"]
    levels: Float[Array, "M+1"]
    """χ²(k·Z, p), the largest D² of k pairs"""
    left: Int[Array, "M+1"]
    """number of measurements from the i-th on that have candidates"""
    cut: Bool[Array, ""]
    """whether a measurement had more than K candidates"""


class _Search(NamedTuple):
    """The state of the depth-first search: the branch it is on, and the best leaf so far."""

    level: Int[Array, ""]
    """the measurement to decide on; -1 when all is searched"""
    option: Int[Array, "M"]
    """the next candidate of each measurement to try; K leaves it without a landmark, K + 1 ends
    its level"""
    chosen: Int[Array, "M"]
    """slot of each measurement decided on, -1 for none"""
    pairs: Int[Array, "M+1"]
    """number of pairs among the first k measurements"""
    distance: Float[Array, "M+1"]
    """D² of the pairs among the first k measurements"""
    inverse: Float[Array, "M*Z M*Z"]
    """L⁻¹, rows of zeros without a pair"""
    whitened: Float[Array, "M*Z"]
    """L⁻¹ ν"""
    best: Int[Array, "M"]
    best_count: Int[Array, ""]
    best_distance: Float[Array, ""]
    nodes: Int[Array, ""]


def _search(problem: _Problem, budget: int) -> _Search:
    m, k, size_z = problem.innovation.shape
    dtype = problem.innovation.dtype
    zero = jnp.zeros((), jnp.int32)
    start = _Search(
        level=zero,
        option=jnp.zeros(m, jnp.int32),
        chosen=jnp.full(m, -1, jnp.int32),
        pairs=jnp.zeros(m + 1, jnp.int32),
        distance=jnp.zeros(m + 1, dtype),
        inverse=jnp.zeros((m * size_z, m * size_z), dtype),
        whitened=jnp.zeros(m * size_z, dtype),
        best=jnp.full(m, -1, jnp.int32),
        best_count=zero - 1,
        best_distance=jnp.full((), jnp.inf, dtype),
        nodes=zero,
    )

    def visit(at: _Search) -> _Search:
        i, option = at.level, at.option[at.level]
        candidate = jnp.minimum(option, k - 1)
        slot = jnp.where(option < k, problem.slot[i, candidate], -1)
        rows, white, distance_term, regular = _block_row(problem, at, candidate)
        is_used = ((jnp.arange(m) < i) & (at.chosen == slot)).any()
        fits = (option == k) | (problem.is_compatible[i, candidate] & regular & ~is_used)
        pair = (option < k).astype(jnp.int32)
        count, distance = at.pairs[i] + pair, at.distance[i] + pair * distance_term
        # The bound: as many pairs as the branch can still have, at no more than its D² so far.
        most = count + problem.left[i + 1]
        better = (most > at.best_count) | ((most == at.best_count) & (distance < at.best_distance))
        go = (option <= k) & fits & better & (distance <= problem.levels[most])
        leaf = go & (i == m - 1)
        deeper = go & ~leaf
        chosen = at.chosen.at[i].set(slot)
        start_row = i * size_z  # of measurement i in L⁻¹ and L⁻¹ ν; zeros without a pair
        keep = (deeper & (option < k)).astype(dtype)
        # 0 * start_row: both indices must be of one dtype.
        inverse = jax.lax.dynamic_update_slice(at.inverse, keep * rows, (start_row, 0 * start_row))
        whitened = jax.lax.dynamic_update_slice(at.whitened, keep * white, (start_row,))
        following = jnp.minimum(i + 1, m - 1)
        options = at.option.at[i].add(1)
        options = options.at[following].set(jnp.where(deeper, 0, options[following]))
        # Down after a choice; up after the last option; else the next option of this level.
        level = jnp.where(deeper, i + 1, jnp.where(option >= k, i - 1, i))
        return _Search(
            level=level,
            option=options,
            chosen=chosen,
            pairs=at.pairs.at[i + 1].set(count),
            distance=at.distance.at[i + 1].set(distance),
            inverse=inverse,
            whitened=whitened,
            best=jnp.where(leaf, chosen, at.best),
            best_count=jnp.where(leaf, count, at.best_count),
            best_distance=jnp.where(leaf, distance, at.best_distance),
            nodes=at.nodes + 1,
        )

    return jax.lax.while_loop(lambda at: (at.level >= 0) & (at.nodes < budget), visit, start)


def _block_row(
    problem: _Problem, at: _Search, candidate: Int[Array, ""]
) -> tuple[Float[Array, "Z MZ"], Float[Array, "Z"], Float[Array, ""], Bool[Array, ""]]:
    """The next pair's rows of L⁻¹ and L⁻¹ ν, its term of D², and whether S is positive definite.

    With W = L⁻¹ C, C the covariance of the pairs before with it, and B = S - WᵀW = l lᵀ: the new
    rows of L⁻¹ are l⁻¹ [-Wᵀ L⁻¹, I], and those of L⁻¹ ν are l⁻¹ (ν - Wᵀ L⁻¹ ν).
    """
    m, _, size_z = problem.innovation.shape
    i = at.level
    slot = problem.slot[i, candidate]
    before = (jnp.arange(m) < i) & (at.chosen >= 0)
    shared = problem.cross[jnp.maximum(at.chosen, 0), :, slot]
    # (measurement, entry, entry) -> the rows of C: one block of Z rows a measurement.
    shared = jnp.where(before[:, None, None], shared, 0.0).reshape(m * size_z, size_z)
    joined = jnp.repeat(before, size_z)
    inverse = jnp.where(joined[:, None], at.inverse, 0.0)
    whitened = jnp.where(joined, at.whitened, 0.0)
    w = inverse @ shared
    factor, regular = linalg.cholesky(problem.cov[i, candidate] - w.T @ w)
    diagonal = jnp.arange(m * size_z)[None, :] == i * size_z + jnp.arange(size_z)[:, None]
    rows = linalg.solve_lower(factor, diagonal.astype(w.dtype) - w.T @ inverse)
    white = linalg.solve_lower(factor, problem.innovation[i, candidate] - w.T @ whitened)
    return rows, white, (white**2).sum(), regular
