"""The divergence limit of a campaign, from what an ideal filter would know in run 0."""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxslam.consistency import final_covariance
from jaxslam.monte_carlo.blocks.plan import CampaignPlan, Promises
from jaxslam.types import Log, Truth


def divergence_limit(
    plan: CampaignPlan,
    promises: Promises,
    which: Int[np.ndarray, "B"],
    world: tuple[Truth, Log],
    bound: Mapping[str, Float[np.ndarray, "B T"]] | None = None,
) -> Float[np.ndarray, ""]:
    """The limit of divergence: 5 σ [m] of the ideal spread of run 0's last position.

    In a world without noise it is what rounding can do.

    Args:
        which, world: of the block whose first run is run 0, on the devices.
        bound: its conditional bound, where that is already there.
    """
    scenario = plan.scenario
    if plan.limit_by_bound:
        variances = bound or jax.device_get(promises.bound.result()(plan.key, which, world))
        variance = float(variances["position"][0, -1])
    else:
        one = jax.tree.map(first_run, world)
        found = jax.device_get(promises.jacobians.result()(*one))
        cov = final_covariance(found, np.asarray(scenario.pose_cov))
        variance = float(np.trace(cov[:2, :2]))
    dtype = world[0].pose.dtype
    reach = 1.0 + float(np.max(np.abs(np.asarray(scenario.landmarks)), initial=0.0))
    rounding = 1000 * float(jnp.finfo(dtype).eps) * reach
    return np.asarray(max(5 * max(variance, 0.0) ** 0.5, rounding), dtype)


def first_run(leaf: jax.Array, axis: int = 0) -> np.ndarray:
    """Run 0 of an array on the devices, copied from its shard. axis: that of the runs."""
    shard = next(one for one in leaf.addressable_shards if not one.index[axis].start)
    run: np.ndarray = np.take(np.asarray(shard.data), 0, axis)
    return run.copy()
