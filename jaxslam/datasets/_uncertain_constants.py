"""What the uncertainty of calibrated constants adds to the results of a filter on a data set."""

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


class Added(NamedTuple):
    """Covariances to add to those of a filter."""

    pose: Float[np.ndarray, "T 3 3"]
    """of the poses along the path"""
    points: Float[np.ndarray, "N 2 N 2"]
    """of all landmarks of the last map together, by slots"""


def considered(data: Dataset, filter_of: Callable[[Motion, Sensor], Filter]) -> Added | None:
    """The covariance that the constants of `data.adjustable.cov` add; None if there is none.

    J C Jᵀ by `calibration.consider_cov`, through the whole run of the filter.

    Args:
        filter_of: the filter of models with the constants, which are traced.
    """
    models = data.adjustable
    if models is None or models.cov is None or not models.cov.any():
        return None
    uncertain = np.flatnonzero(np.diag(models.cov))
    values = models.values

    def results(p: jax.Array) -> dict[str, jax.Array]:
        log, motion, sensor = models.at(jnp.asarray(values, p.dtype).at[uncertain].set(p))
        filter = filter_of(motion, sensor)
        trace = run(filter, log, data.pose, data.pose_cov, jax.random.key(0))
        pose, points = map(jnp.asarray, (trace.estimate.pose, trace.estimate.points[-1]))
        return {"pose": pose, "points": points.reshape(-1)}

    cov = models.cov[np.ix_(uncertain, uncertain)]
    added = consider_cov(results, values[uncertain], cov)
    count = len(added["points"]) // 2
    return Added(added["pose"], added["points"].reshape(count, 2, count, 2))
