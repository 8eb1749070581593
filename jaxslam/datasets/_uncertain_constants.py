"""The covariance that uncertain calibrated constants add to the results of a filter."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxslam._driver import run
from jaxslam.calibration import consider_cov
from jaxslam.core.protocols import Filter, Motion, Sensor
from jaxslam.datasets._dataset import Dataset


class AddedCov(NamedTuple):
    """Covariances to add to the covariances of a filter."""

    pose: Float[np.ndarray, "T 3 3"]
    """covariance added to each pose of the path"""
    points: Float[np.ndarray, "N 2 N 2"]
    """covariance added to all landmarks of the last map together, by slots"""


def consider_constants(
    data: Dataset, filter_of: Callable[[Motion, Sensor], Filter]
) -> AddedCov | None:
    """The covariance that uncertain constants add; None if `data.adjustable.cov` has none.

    J C Jᵀ by `calibration.consider_cov`, with J through the run of the filter over the log.

    Args:
        filter_of: builds the filter for models with traced constants.
    """
    models = data.adjustable
    if models is None or models.cov is None or not models.cov.any():
        return None
    uncertain = np.flatnonzero(np.diag(models.cov))
    values = models.values

    def results(p: jax.Array) -> dict[str, jax.Array]:
        log, motion, sensor = models.at(jnp.asarray(values, p.dtype).at[uncertain].set(p))
        filter = filter_of(motion, sensor)
        estimate = run(filter, log, data.pose, data.pose_cov, jax.random.key(0)).estimate
        last_points = jnp.asarray(estimate.points[-1])
        return {"pose": jnp.asarray(estimate.pose), "points": last_points.reshape(-1)}

    cov = models.cov[np.ix_(uncertain, uncertain)]
    added = consider_cov(results, values[uncertain], cov)
    count = len(added["points"]) // 2
    return AddedCov(added["pose"], added["points"].reshape(count, 2, count, 2))
