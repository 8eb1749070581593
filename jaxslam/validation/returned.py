"""Checks of the results of user-defined filters, during tracing."""

from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree
from numpy.typing import ArrayLike

from jaxslam.core.numbers import check_array, shape_told
from jaxslam.types import Estimate, Info, Scan

_S = TypeVar("_S")

_REAL = ("nis", "innovation", "innovation_cov", "log_likelihood")
"""Fields of `Info` in the dtype of the measurements."""


def same_state(name: str, before: _S, after: PyTree) -> _S:
    """The state that a filter's function returned; ValueError unless its structure is that before.

    Tree, shapes and dtypes must be the same, since the state is the carry of a `lax.scan`.
    """
    old: PyTree = jax.tree.structure(before)
    if old != jax.tree.structure(after):
        told = f"expected a state as before, {_kind(before)}, got {_kind(after)}"
        raise ValueError(f"{name}: {told}")
    pairs = zip(jax.tree.leaves_with_path(before), jax.tree.leaves(after), strict=True)
    unlike = [
        f"state{jax.tree_util.keystr(path)}: expected {_array(old)}, got {_array(new)}"
        for (path, old), new in pairs
        if _array(old) != _array(new)
    ]
    if unlike:
        raise ValueError(f"{name}: {'; '.join(unlike)}")
    state: _S = after
    return state


def _kind(state: PyTree) -> str:
    """The type of a state, and where its arrays are."""
    at = [jax.tree_util.keystr(path) for path, _ in jax.tree.leaves_with_path(state)]
    return "an array" if at == [""] else f"{type(state).__name__} of {', '.join(at) or 'nothing'}"


def _array(leaf: ArrayLike) -> str:
    return f"{jnp.result_type(leaf)} {shape_told(leaf)}"


def state_and_info(name: str, state: _S, scan: Scan, found: object) -> tuple[_S, Info]:
    """The result of a filter's update; ValueError unless it is a state as before, and an `Info`."""
    if not (isinstance(found, tuple) and len(found) == 2 and isinstance(found[1], Info)):
        got = type(found).__name__
        if isinstance(found, tuple) and not hasattr(found, "_fields"):
            got = "(" + ", ".join(type(part).__name__ for part in found) + ")"
        raise ValueError(f"{name}: expected update to return (state, Info), got {got}")
    info: Info = found[1]
    m, real = scan.tag.shape[0], scan.z.dtype.type
    for field, shape in {
        "nis": (m,),
        "dof": (m,),
        "slot": (m,),
        "status": (m,),
        "innovation": (m, "Z"),
        "innovation_cov": (m, "Z", "Z"),
        "log_likelihood": (),
    }.items():
        kind = real if field in _REAL else np.integer if field == "status" else np.generic
        check_array(f"{name}: update: Info.{field}", getattr(info, field), shape, kind)
    return same_state(f"{name}: update", state, found[0]), info


def checked_estimate(name: str, estimate: object, dtype: np.dtype) -> Estimate:
    """The result of a filter's estimate; ValueError unless it is an `Estimate` of N landmarks, with
    numbers of this dtype."""
    if not isinstance(estimate, Estimate):
        raise ValueError(
            f"{name}: expected estimate to return an Estimate, got {type(estimate).__name__}"
        )
    n = np.shape(estimate.alive)[0] if np.ndim(estimate.alive) == 1 else -1
    shapes = {"pose": (3,), "pose_cov": (3, 3), "points": (n, 2), "point_covs": (n, 2, 2)}
    for field, shape in (shapes | {"alive": (n,), "tag": (n,)}).items():
        kind = dtype.type if field in shapes else np.generic
        check_array(f"{name}: Estimate.{field}", getattr(estimate, field), shape, kind)
    return estimate
