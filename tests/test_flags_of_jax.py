"""Models, filters and campaigns of the library under the flags of JAX that find mistakes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import swept

import jaxslam
from jaxslam import catalog, motion, sensors
from jaxslam.consistency.campaign._block_programs import drive_run
from jaxslam.core.protocols import Sensor
from jaxslam.simulation.scenarios import SCENARIOS
from jaxslam.verify import build

KEY = jax.random.key(0)


@pytest.fixture
def strict():
    """JAX promotes no dtypes, as users have it who look for an accidental float64."""
    with jax.numpy_dtype_promotion("strict"):
        yield


def traced(*functions_and_arguments):
    for function, *arguments in functions_and_arguments:
        if function is not None:
            jax.eval_shape(function, *arguments)


@pytest.mark.parametrize("name", catalog.ALL)
@pytest.mark.parametrize("dtype", swept(("float64", "float32"), "float64"))
def test_no_filter_promotes_dtypes(strict, name, dtype):
    with jax.enable_x64(dtype == "float64"):
        world = SCENARIOS["circle"](3)
        truth, log = jax.eval_shape(lambda key: jaxslam.simulate(world, key), KEY)

        def estimated(truth, log):
            return drive_run(world, catalog.ALL[name](world), KEY, 0, truth, log)

        traced((estimated, truth, log))
        assert truth.pose.dtype == dtype


@pytest.mark.parametrize("name", SCENARIOS)
def test_no_scenario_promotes_dtypes(strict, name):
    traced((lambda key: jaxslam.simulate(SCENARIOS[name](3), key), KEY))


@pytest.mark.parametrize("name", [*sensors.REGISTRY, *motion.REGISTRY])
@pytest.mark.parametrize("dtype", swept((np.float64, np.float32), np.float64))
def test_no_model_promotes_dtypes(strict, name, dtype):
    model = build((sensors.REGISTRY | motion.REGISTRY)[name])
    if isinstance(model, Sensor):
        pose = jnp.ones(3 + len(model.robot), dtype)
        sizes = len(model.landmark), len(model.measurements), len(model.free.mean)
        landmark, z, s = (jnp.ones(size, dtype) for size in sizes)
        traced(
            (jax.jacfwd(model.observe, argnums=(0, 1)), pose, landmark),
            (jax.jacfwd(model.invert, argnums=(0, 1)), pose, z, s),
            (model.residual, z, z),
            (model.noise_cov, z),
            (model.embed, pose[:3], pose[:2]),
            (model.position, landmark),
            (model.move_landmark, pose[:3], landmark),
            (model.observe_jacobians, pose, landmark),
            (model.invert_jacobians, pose, z, s),
        )
    else:
        pose = jnp.ones(len(model.state), dtype)
        u, w = (jnp.ones(len(names), dtype) for names in (model.controls, model.noises))
        traced(
            (jax.jacfwd(model.step, argnums=(0, 1, 2)), pose, u, w),
            (model.noise_cov, pose, u),
            (model.jacobians, pose, u, w),
            (model.perturb, u, w),
        )


def test_a_campaign_runs_without_promotion_and_with_guarded_transfers(strict):
    world = SCENARIOS["circle"](3)
    filters = {name: catalog.ALL[name](world) for name in ("dead_reckoning", "ideal")}
    wanted = jaxslam.monte_carlo(world, filters, 2, KEY, progress=False)
    with jax.transfer_guard("disallow"):
        truth, log = jaxslam.simulate(world, KEY)
        found = jaxslam.monte_carlo(world, filters, 2, KEY, progress=False)
        trace = jaxslam.run(filters["dead_reckoning"], log, truth.start, np.zeros((3, 3)), KEY)
    assert np.isfinite(trace.estimate.pose).all()
    for name, summary in wanted.filters.items():
        assert found.filters[name].measures == summary.measures
