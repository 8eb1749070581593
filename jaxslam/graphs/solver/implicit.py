"""Derivatives of the optimum of a graph by what it depends on: implicit differentiation."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxslam.graphs.graph import Graph
from jaxslam.graphs.solver.batch import over_batch, with_batch
from jaxslam.graphs.solver.linearized import (
    chi2_of,
    data_of,
    half_hessian,
    linearize,
    retract,
    row_weights,
    variables_of,
)
from jaxslam.graphs.solver.model import Model
from jaxslam.graphs.solver.plan import Plan
from jaxslam.graphs.solver.search import Solution
from jaxslam.graphs.sparse.cholesky import factorize, substitute


def followed(model: Model, plan: Plan, graph: Graph, found: Solution) -> Solution:
    """The solution as a function of graph and model: the same numbers, with derivatives.

    At the optimum F(δ; θ) = ½ ∂χ²/∂δ = 0, so that dδ = -(∂F/∂δ)⁻¹ (∂F/∂θ) dθ: a Newton step from
    the optimum, of which only F is differentiated. ∂F/∂δ is half the Hessian of χ² with its second
    derivatives of the residuals, not Gauss-Newton's. θ are the measurements, the information,
    the variables that are fixed, and the numbers of factors and kernels.
    """
    still = jax.lax.stop_gradient((found.graph.poses, found.graph.points))
    poses = jnp.where(graph.fixed_pose[:, None], graph.poses, still[0])
    points = jnp.where(graph.fixed_point[:, None], graph.points, still[1])
    there = with_batch(graph._replace(poses=poses, points=points))
    variables, data = variables_of(there), data_of(there, plan.column)
    blocks = half_hessian(*jax.lax.stop_gradient((model, plan, variables, data)))
    gradient = linearize(model, plan, variables, data).gradient
    step = _solved(plan, blocks[..., 0], gradient[..., 0])
    end = retract(variables, -step[..., None], plan)
    return jax.lax.stop_gradient(found)._replace(
        graph=graph._replace(poses=end.poses[..., 0], points=end.points[..., 0]),
        chi2=chi2_of(model, plan.who, variables, data)[0],
        weights={
            name: weight[..., 0] for name, weight in row_weights(model, plan.who, end, data).items()
        },
    )


def _solved(
    plan: Plan, blocks: Float[Array, "M d d"], rhs: Float[Array, "n d"]
) -> Float[Array, "n d"]:
    """The solution A⁻¹ b, with derivatives by b."""

    def times(x: Float[Array, "n d"]) -> Float[Array, "n d"]:
        below = jnp.einsum("mij,mj->mi", blocks, x[plan.block_column])
        above = jnp.einsum("mji,mj->mi", blocks, x[plan.block_row])
        above = jnp.where(plan.on_diagonal[:, None], 0.0, above)
        y = jnp.zeros_like(x).at[plan.block_row].add(below)
        return y.at[plan.block_column].add(above)

    def solve(_: object, b: Float[Array, "n d"]) -> Float[Array, "n d"]:
        return _by_factor((plan,), (blocks, b))

    out: Array = jax.lax.custom_linear_solve(times, rhs, solve, symmetric=True)
    return out


def _factor_and_solve(plan: Plan, system: tuple[Array, Array]) -> Array:
    blocks, rhs = system
    return substitute(plan.cholesky, factorize(plan.cholesky, blocks), rhs)


_by_factor = over_batch("graphs.optimize", _factor_and_solve)
