"""Runs a filter over a long log piece by piece, and checks its state between pieces."""

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, PyTree

from jaxslam.core.protocols import Filter
from jaxslam.core.types import Estimate, Info, JaxOrNumPy, Log

State: TypeAlias = PyTree
"""The state of a filter, a pytree."""

Rows: TypeAlias = tuple[tuple[PyTree, ...], PyTree]
"""Results of each step, and of the watched steps: arrays with leading T."""

PIECES = 20
"""Number of pieces of a log, unless they exceed `MAX_STEPS`: the progress moves by 5 %."""
MAX_STEPS = 500
"""Largest number of steps of a piece, after which the state is checked."""


class PiecewiseRun(NamedTuple):
    """The results of a filter over a log of T steps, as NumPy arrays."""

    path: Estimate
    """pose (T, 3), pose_cov (T, 3, 3), and further states; the fields of the map are ()"""
    status: Int[np.ndarray, "T M"]
    slot: Int[np.ndarray, "T M"]
    nis: Float[np.ndarray, "T M"]
    dof: Int[np.ndarray, "T M"]
    log_likelihood: Float[np.ndarray, "T"]
    last: Estimate
    """the estimate after the last step"""
    final: State
    """the state of the filter after the last step"""
    checked: list[int]
    """the steps, from 1, after which the state was checked"""
    passed: list[bool]
    """the result of each check"""
    estimates: Estimate | None = None
    """the whole estimates (F, …) after the watched steps, if any"""
    watched: PyTree = None
    """the results of `watch` after the watched steps"""
    kept: PyTree = None
    """the results of `keep`, leading T"""


def run_in_pieces(
    filter: Filter,
    log: Log,
    pose: np.ndarray,
    pose_cov: np.ndarray,
    *,
    progress: Callable[[int, int], object],
    check: Callable[[State], bool] | None = None,
    seed: int = 0,
    at: Int[np.ndarray, "F"] | None = None,
    watch: Callable[[State], PyTree] = lambda state: None,
    keep: Callable[[Info], PyTree] = lambda info: None,
) -> PiecewiseRun:
    """Predict and update row by row, as `run` does, for a log whose values have been checked.

    One compiled program processes the log piece by piece; the last piece is padded.

    Args:
        log: T rows of arrays in the dtype of the arithmetic.
        progress: called after each piece with the number of steps done and of all steps.
        check: called after each piece with the state of the filter.
        seed: seed of the random numbers of a particle filter.
        at: the watched steps, counted from 0, in order: the whole estimate after each of them is
            kept, and `watch` of the state. Default none.
        keep: called with the info of each step.
    """
    total = log.control.shape[0]
    size = min(-(-total // PIECES), MAX_STEPS)
    key = jax.random.key(seed)

    def step(state: State, row: Log, number: jax.Array) -> tuple[State, Rows]:
        to_predict, to_update = jax.random.split(jax.random.fold_in(key, number))
        state = filter.predict(state, row.control, to_predict)
        state, info = filter.update(state, row.scan, to_update)
        estimate = filter.estimate(state)
        row_results = (
            estimate.pose,
            estimate.pose_cov,
            info.status,
            info.slot,
            info.nis,
            info.dof,
            info.log_likelihood,
            keep(info),
            (estimate.further, estimate.further_cov),
        )
        return state, (row_results, None if at is None else (estimate, watch(state)))

    @jax.jit
    def piece(
        state: State, rows: Log, count: jax.Array, before: jax.Array
    ) -> tuple[State, Rows, Estimate]:
        def add_step(i: jax.Array, carry: tuple[State, Rows]) -> tuple[State, Rows]:
            state, results = carry
            state, row = step(state, jax.tree.map(lambda leaf: leaf[i], rows), before + i)
            return state, jax.tree.map(lambda leaf, value: leaf.at[i].set(value), results, row)

        # A loop of `count` steps, not a scan of `size`: padding rows do not change the state.
        first = jax.tree.map(lambda leaf: leaf[0], rows)
        shapes = jax.eval_shape(step, state, first, before)[1]
        results = jax.tree.map(lambda leaf: jnp.zeros((size, *leaf.shape), leaf.dtype), shapes)
        state, results = jax.lax.fori_loop(0, count, add_step, (state, results))
        return state, results, filter.estimate(state)

    dtype = log.control.dtype
    state = jax.jit(filter.init)(pose.astype(dtype), pose_cov.astype(dtype))
    pieces, films, checked, passed = [], [], [], []
    for begin in range(0, total, size):
        end = min(begin + size, total)
        rows = jax.tree.map(lambda leaf, a=begin, b=end: padded_rows(leaf[a:b], size), log)
        state, (of_steps, of_film), last = piece(
            state, rows, jnp.asarray(end - begin), jnp.asarray(begin)
        )
        pieces.append(jax.tree.map(lambda leaf, n=end - begin: np.asarray(leaf)[:n], of_steps))
        if at is not None:
            chosen = at[(at >= begin) & (at < end)] - begin
            films.append(jax.tree.map(lambda leaf, a=chosen: np.asarray(leaf)[a], of_film))
        progress(end, total)
        if check is not None:
            checked.append(end)
            passed.append(check(state))
    pose, cov, status, slot, nis, dof, log_likelihood, kept, beside = jax.tree.map(
        lambda *parts: np.concatenate(parts), *pieces
    )
    path = last._replace(pose=pose, pose_cov=cov, points=(), point_covs=(), alive=(), tag=())
    path = path._replace(further=beside[0], further_cov=beside[1])
    estimates, watched = (
        jax.tree.map(lambda *parts: np.concatenate(parts), *films) if films else (None, None)
    )
    return PiecewiseRun(
        path=path,
        status=status,
        slot=slot,
        nis=nis,
        dof=dof,
        log_likelihood=log_likelihood,
        last=jax.tree.map(np.asarray, last),
        final=state,
        checked=checked,
        passed=passed,
        estimates=estimates,
        watched=watched,
        kept=kept,
    )


def padded_rows(rows: JaxOrNumPy, size: int) -> np.ndarray:
    """The rows, padded with zeros to `size` rows."""
    rows = np.asarray(rows)
    return np.pad(rows, [(0, size - len(rows)), *[(0, 0)] * (rows.ndim - 1)])
