"""Checks of the results of user-defined filters, by chex during tracing."""

from collections.abc import Callable
from typing import Any, TypeVar

import chex
import numpy as np

from jaxslam.types import Estimate, Info, Scan

_S = TypeVar("_S")


def same_state(name: str, before: _S, after: Any) -> _S:
    """The state that a filter's function returned; ValueError unless its structure is that before.

    Tree, shapes and dtypes must be the same, since the state is the carry of a `lax.scan`.
    """
    _expect(name, chex.assert_trees_all_equal_structs, before, after)
    _expect(name, chex.assert_trees_all_equal_shapes_and_dtypes, before, after)
    state: _S = after
    return state


def state_and_info(name: str, state: _S, scan: Scan, found: Any) -> tuple[_S, Info]:
    """The result of a filter's update; ValueError unless it is a state as before, and an `Info`."""
    if not (isinstance(found, tuple) and len(found) == 2 and isinstance(found[1], Info)):
        got = type(found).__name__
        if isinstance(found, tuple) and not hasattr(found, "_fields"):
            got = "(" + ", ".join(type(part).__name__ for part in found) + ")"
        raise ValueError(f"{name}: expected update to return (state, Info), got {got}")
    info: Info = found[1]
    m = scan.tag.shape[0]
    for field in ("nis", "dof", "slot", "status"):
        _expect(f"{name}: Info.{field}", chex.assert_shape, getattr(info, field), (m,))
    _expect(f"{name}: Info.innovation", chex.assert_shape, info.innovation, (m, None))
    _expect(f"{name}: Info.innovation_cov", chex.assert_shape, info.innovation_cov, (m, None, None))
    _expect(f"{name}: Info.log_likelihood", chex.assert_shape, info.log_likelihood, ())
    _expect(f"{name}: Info.status", chex.assert_type, info.status, int)
    return same_state(f"{name}: update", state, found[0]), info


def checked_estimate(name: str, estimate: Any) -> Estimate:
    """The result of a filter's estimate; ValueError unless it is an `Estimate` of N landmarks."""
    if not isinstance(estimate, Estimate):
        raise ValueError(
            f"{name}: expected estimate to return an Estimate, got {type(estimate).__name__}"
        )
    n = np.shape(estimate.alive)[0] if np.ndim(estimate.alive) == 1 else -1
    shapes = {"pose": (3,), "pose_cov": (3, 3), "points": (n, 2), "point_covs": (n, 2, 2)}
    for field, shape in (shapes | {"alive": (n,), "tag": (n,)}).items():
        _expect(f"{name}: Estimate.{field}", chex.assert_shape, getattr(estimate, field), shape)
    return estimate


def _expect(name: str, assertion: Callable[..., None], *arguments: Any) -> None:
    """Run an assertion of chex; its failure becomes a ValueError that begins with a name."""
    try:
        assertion(*arguments)
    except AssertionError as error:
        why = str(error).split("failed:", 1)[-1].strip()
        raise ValueError(f"{name}: {' '.join(why.split())}") from None
