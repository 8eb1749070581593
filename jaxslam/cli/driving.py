"""A filter over a long log in pieces of one compiled program, with a look at it between them."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaxslam.protocols import Filter
from jaxslam.types import Estimate, Log

LOOKS = 20
"""how often progress is shown, and the covariance looked at, where the user does not say"""

_LONGEST = 500
"""steps between two looks at the most"""


class Driven(NamedTuple):
    """What a filter made of a log, on the host."""

    path: Estimate
    """pose (T, 3) and pose_cov (T, 3, 3) with leading T; of the map nothing"""
    status: NDArray[np.int32]
    """(T, M)"""
    nis: NDArray[np.float64]
    """(T, M)"""
    dof: NDArray[np.int32]
    """(T, M)"""
    log_likelihood: NDArray[np.float64]
    """(T,)"""
    last: Estimate
    """after the last step"""
    looked: list[int]
    """the steps, from 1, after which the state was looked at"""
    found: list[bool]
    """what was seen there"""


def drive(
    filter: Filter,
    log: Log,
    pose: np.ndarray,
    pose_cov: np.ndarray,
    *,
    every: int | None = None,
    look: Callable[[Any], bool],
    progress: Callable[[int, int], object],
) -> Driven:
    """Predict and update row by row, as `run` does for a log whose values have been checked.

    The log's rows go through one program, piece by piece, of which it takes as many as there are.

    Args:
        log: T rows of arrays in the dtype of the arithmetic.
        every: look at the state after so many steps, and after the last; 0 not at all. Default
            `LOOKS` times.
        look: called with the filter's own state.
        progress: called with the steps done and all of them, every now and then.
    """
    total = log.control.shape[0]
    every = max(1, -(-total // LOOKS)) if every is None else every
    size = min(every or _LONGEST, _LONGEST, total)
    key = jax.random.key(0)  # the filters here draw nothing

    def step(state: Any, row: Log) -> tuple[Any, tuple[Any, ...]]:
        state = filter.predict(state, row.control, key)
        state, info = filter.update(state, row.scan, key)
        at = filter.estimate(state)
        kept = info.status, info.nis, info.dof, info.log_likelihood
        return state, (at.pose, at.pose_cov, *kept)

    @jax.jit
    def piece(state: Any, rows: Log, count: jax.Array) -> tuple[Any, Any, Estimate]:
        def one(i: jax.Array, carry: tuple[Any, Any]) -> tuple[Any, Any]:
            state, kept = carry
            state, new = step(state, jax.tree.map(lambda leaf: leaf[i], rows))
            return state, jax.tree.map(lambda all, one: all.at[i].set(one), kept, new)

        first = jax.tree.map(lambda leaf: leaf[0], rows)
        shapes = jax.eval_shape(step, state, first)[1]
        kept = jax.tree.map(lambda leaf: jnp.zeros((size, *leaf.shape), leaf.dtype), shapes)
        state, kept = jax.lax.fori_loop(0, count, one, (state, kept))
        return state, kept, filter.estimate(state)

    kind = log.control.dtype
    state = jax.jit(filter.init)(pose.astype(kind), pose_cov.astype(kind))
    pieces, looked, found, done = [], [], [], 0
    while done < total:
        until = total if not every else min(total, (done // every + 1) * every)
        until = min(until, done + size)
        rows = jax.tree.map(lambda leaf, a=done, b=until: _padded(leaf[a:b], size), log)
        state, kept, last = piece(state, rows, jnp.asarray(until - done))
        pieces.append([np.asarray(part)[: until - done] for part in kept])
        done = until
        progress(done, total)
        if every and (done % every == 0 or done == total):
            looked.append(done)
            found.append(look(state))
    whole: list[Any] = [np.concatenate(parts) for parts in zip(*pieces, strict=True)]
    pose, cov, status, nis, dof, log_likelihood = whole
    path = last._replace(pose=pose, pose_cov=cov, points=(), point_covs=(), alive=(), tag=())
    return Driven(
        path=path,
        status=status,
        nis=nis,
        dof=dof,
        log_likelihood=log_likelihood,
        last=jax.tree.map(np.asarray, last),
        looked=looked,
        found=found,
    )


def _padded(rows: np.ndarray, size: int) -> np.ndarray:
    rows = np.asarray(rows)
    return np.pad(rows, [(0, size - len(rows)), *[(0, 0)] * (rows.ndim - 1)])
