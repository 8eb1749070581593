"""Map managers around one filter, in any order."""

import itertools

import chex
import jax
import numpy as np
import pytest

from jaxslam import charts, motion, sensors
from jaxslam.core.types import Scan
from jaxslam.filters import EkfSlam
from jaxslam.filters.map_management.closing import Closing
from jaxslam.filters.map_management.merging import Merging
from jaxslam.life import Existence, Recency

MANAGERS = {
    "merging": lambda filter: Merging(filter, 0.5),
    "closing": lambda filter: Closing(filter, reach=1.0),
}
ORDERS = [
    (life, order)
    for life in (None, Recency())
    for count in range(3)
    for order in itertools.permutations(MANAGERS, count)
    if life is not None or "closing" not in order
]
MODELS = motion.PoseIncrement(np.eye(3)), sensors.RelativePosition(np.eye(2))


@pytest.mark.parametrize(("life", "order"), ORDERS)
def test_managers_compose_in_any_order(life, order):
    """Each keeps the state's structure, reports under its own name, and leaves the rest alone."""
    plain = filter = EkfSlam(*MODELS, 4, chart=charts.RightInvariant(), life=life)
    for name in order:
        filter = MANAGERS[name](filter)
    assert filter.name == " ".join((*order[::-1], "ekf_slam"))
    assert (filter.chart, filter.landmark) == (plain.chart, plain.landmark)
    state = filter.init(np.zeros(3), np.eye(3))
    assert (state.life is not None) == (life is not None)
    assert (state.co_observed is not None) == ("merging" in order)
    scan = Scan(np.zeros((2, 2)), np.full(2, -1), np.ones(2, bool))
    after, info = jax.eval_shape(filter.update, state, scan, jax.random.key(0))
    chex.assert_trees_all_equal_shapes_and_dtypes(after, state)
    assert set(info.extra or {}) == set(order) | ({"pruning"} if life is not None else set())


def test_closing_takes_times():
    for life in (None, Existence(lambda pose, landmark: True)):
        with pytest.raises(ValueError, match=r"^Closing: expected a filter that keeps times"):
            Closing(EkfSlam(*MODELS, 4, life=life)).init(np.zeros(3), np.eye(3))


@pytest.mark.parametrize("name", MANAGERS)
def test_a_class_is_no_filter(name):
    with pytest.raises(
        ValueError, match=rf"^{name.title()}: expected a filter, got the class EkfSlam: call it"
    ):
        MANAGERS[name](EkfSlam)
