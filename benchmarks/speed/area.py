"""The compressed filter on a trajectory that stays within one part of a map of N landmarks."""

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.speed.timing import best
from jaxslam.core.slots import Joint
from jaxslam.filters import CompressedEkfSlam, EkfSlam
from jaxslam.filters.ekf.compressed_ekf_slam import opened

AREA = 40
"""landmarks K worked on"""


def map_of(count, scenario):
    """A robot in a map of N landmarks, all correlated: the scenario's, and others further off."""
    rng = np.random.default_rng(0)
    landmarks = np.concatenate([scenario.landmarks, rng.uniform(10, 100, size=(1000, 2))])
    landmarks = landmarks[:count] + 0.01 * rng.normal(size=(count, 2))
    root = 0.1 * rng.normal(size=(3, 3 + 2 * count))
    return Joint(
        pose=jnp.asarray(scenario.pose, float),
        landmarks=jnp.asarray(landmarks),
        cov=jnp.asarray(root.T @ root + 0.01 * np.eye(3 + 2 * count)),
        alive=jnp.ones(count, bool),
        tag=jnp.arange(count, dtype=jnp.int32),
        lin=(),
    )


def seconds_a_step(filter, state, log):
    """Of predict and update along the log, from a state at hand."""
    key = jax.random.key(0)

    @jax.jit
    def go(state, log):
        def step(state, row):
            state = filter.predict(state, row.control, key)
            state, info = filter.update(state, row.scan, key)
            return state, (filter.estimate(state).pose, info.nis)

        return jax.lax.scan(step, state, log)[1]

    jax.block_until_ready(go(state, log))
    return best(lambda: jax.block_until_ready(go(state, log)), 3) / len(log.control)


def compressed(scenario, log, sizes):
    """Seconds a step by N, and of the ordinary filter at the largest N."""
    options = scenario.filter_options | {"births": None}
    by_landmarks = []
    for count in sizes:
        joint = map_of(count, scenario)
        parts = scenario.motion, scenario.sensor, count
        filter = CompressedEkfSlam(EkfSlam(*parts, **options), area=AREA)
        by_landmarks.append(seconds_a_step(filter, opened(joint, AREA), log))
    return by_landmarks, seconds_a_step(EkfSlam(*parts, **options), joint, log)
