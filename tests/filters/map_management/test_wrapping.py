"""Map managers around one filter, in any order."""

import itertools

import chex
import jax
import numpy as np
import pytest

from jaxslam import charts, motion, sensors
from jaxslam.filters import ekf_slam
from jaxslam.filters.map_management.closing import closing
from jaxslam.filters.map_management.merging import merging
from jaxslam.filters.map_management.pruning import pruning
from jaxslam.life import recency
from jaxslam.types import Scan

MANAGERS = {
    "pruning": lambda filter: pruning(filter, recency()),
    "merging": lambda filter: merging(filter, 0.5),
    "closing": lambda filter: closing(filter, reach=1.0),
}
ORDERS = [
    order
    for count in (0, 1, 3)
    for order in itertools.permutations(MANAGERS, count)
    if "closing" not in order or "pruning" in order[: order.index("closing")]
]


@pytest.mark.parametrize("order", ORDERS)
def test_managers_compose_in_any_order(order):
    """Each keeps the state's structure, reports under its own name, and leaves the rest alone."""
    models = motion.PoseIncrement(np.eye(3)), sensors.RelativePosition(np.eye(2))
    plain = filter = ekf_slam(*models, 4, chart=charts.right_invariant())
    for name in order:
        filter = MANAGERS[name](filter)
    assert filter.name == " ".join((*order[::-1], "ekf_slam"))
    assert (filter.chart, filter.landmark) == (plain.chart, plain.landmark)
    state = filter.init(np.zeros(3), np.eye(3))
    assert (state.life is not None) == ("pruning" in order)
    assert (state.co_observed is not None) == ("merging" in order)
    scan = Scan(np.zeros((2, 2)), np.full(2, -1), np.ones(2, bool))
    after, info = jax.eval_shape(filter.update, state, scan, jax.random.key(0))
    chex.assert_trees_all_equal_shapes_and_dtypes(after, state)
    told = {"pruning"} if "closing" in order else set()
    assert set(info.extra or {}) == told | set(order)


def test_closing_takes_times():
    models = motion.PoseIncrement(np.eye(3)), sensors.RelativePosition(np.eye(2))
    for filter in (
        closing(ekf_slam(*models, 4)),
        MANAGERS["pruning"](closing(ekf_slam(*models, 4))),
    ):
        with pytest.raises(ValueError, match=r"closing: expected a filter that keeps times"):
            filter.init(np.zeros(3), np.eye(3))


@pytest.mark.parametrize("name", MANAGERS)
def test_a_filter_that_was_not_made_is_told(name):
    with pytest.raises(ValueError, match=rf"^{name}: expected filter to be a Filter.*call it, ekf"):
        MANAGERS[name](ekf_slam)
