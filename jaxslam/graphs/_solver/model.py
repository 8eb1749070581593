"""The functions of a graph: a factor for each table, and optional robust kernels."""

from collections.abc import Mapping
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from jaxslam.core._record import record
from jaxslam.graphs._factor import REGISTRY, Factor
from jaxslam.graphs._graph import Graph
from jaxslam.graphs._solver.kernels import Kernel


@record
class Model:
    """Factors and kernels by table."""

    factors: dict[str, Factor]
    """in the order of the names"""
    kernels: dict[str, Kernel]
    """of the tables that have one"""

    @property
    def holds(self) -> bool:
        """Whether the noise of a factor depends on the variables (`Factor.whiten`)."""
        return any(factor.whiten is not None for factor in self.factors.values())


def model_of(
    name: str,
    graph: Graph,
    factors: Mapping[str, Factor] | None,
    kernel: Kernel | Mapping[str, Kernel] | None = None,
) -> Model:
    """The model of a graph's tables. Raises ValueError, which begins with a caller's name."""
    known = factors_of(name, graph, factors)
    if kernel is not None and not isinstance(kernel, Mapping):
        kernel = dict.fromkeys(graph.tables, kernel)
    for each in (kernel or {}).values():
        _check_made(name, each, Kernel, "graphs.Huber()")
    if lost := sorted(set(kernel or ()) - set(graph.tables)):
        raise ValueError(
            f"{name}: kernels of tables that are not in the graph: {', '.join(lost)}; "
            f"there are: {', '.join(graph.tables)}"
        )
    return Model(known, dict(kernel or {}))


def factors_of(name: str, graph: Graph, factors: Mapping[str, Factor] | None) -> dict[str, Factor]:
    """The factor of each table: of the same name, or of the part before a slash.

    They are in the order of the names, as in a graph that has been through `jax.tree.map`. Without
    factors they are those of files. Raises ValueError, which begins with a caller's name, also on a
    factor whose residual has another shape than its `errors` tell.
    """
    if not isinstance(graph, Graph):
        got = repr(graph) if isinstance(graph, str) else f"a {type(graph).__name__}"
        raise ValueError(
            f"{name}: expected a Graph, as graphs.read(path) or the graph of a solution, got {got}"
        )
    known = REGISTRY if factors is None else factors
    if not isinstance(known, Mapping):
        got = type(known).__name__
        raise ValueError(f"{name}: expected factors as a dict by table, got a {got}")
    for each in known.values():
        _check_made(name, each, Factor, "graphs.RelativePose()")
    out = {}
    for key in sorted(graph.tables):
        found = known.get(key, known.get(key.split("/")[0]))
        if found is None:
            raise ValueError(
                f"{name}: table {key!r} has no factor; there are: {', '.join(known) or 'none'}"
            )
        if (got := _residual_shape(found, np.shape(graph.points)[-1])) != (len(found.errors),):
            raise ValueError(
                f"{name}: the factor {found.name!r} of table {key!r}: expected a residual of shape "
                f"({len(found.errors)},), as its errors tell ({', '.join(found.errors)}), got {got}"
            )
        out[key] = found
    if not out:
        raise ValueError(f"{name}: the graph has no tables")
    return out


def _check_made(name: str, value: object, kind: type, example: str) -> None:
    """Raise ValueError unless a value is of a kind, e.g. on the class of one."""
    if not isinstance(value, kind):
        got = f"the class {value.__name__}" if isinstance(value, type) else repr(value)
        raise ValueError(f"{name}: expected a {kind.__name__}, as {example}, got {got}")


def _residual_shape(factor: Factor, point_size: int) -> object:
    """The shape of a factor's residual, or the name of its type if it is not an array."""
    sizes, number = {"pose": 3, "point": point_size}, jnp.result_type(float)
    involved = tuple(jax.ShapeDtypeStruct((sizes[kind],), number) for kind in factor.variables)
    z = jax.ShapeDtypeStruct((len(factor.measurements),), number)
    found = jax.eval_shape(_residual, factor, involved, z)
    return getattr(found, "shape", type(found).__name__)


@partial(jax.jit, inline=True)
def _residual(factor: Factor, variables: tuple[jax.Array, ...], z: jax.Array) -> PyTree:
    """The residual, jitted so that its shape is found by one trace for all factors of a kind."""
    return factor.residual(variables, z)
