"""Strictness of the whole suite (never of the package), and the oracles that many tests share."""

import gc
import importlib.metadata
import os
import sys
from pathlib import Path

import numpy as np
import pytest

# A suite compiles much and runs little: XLA optimizes as little as it can, in half the time, and a
# program once compiled is kept in the checkout for all workers, for the processes that tests start
# and for the next run. `full_optimization` is for what depends on the optimizer.
os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
os.environ.setdefault(
    "JAX_COMPILATION_CACHE_DIR",
    str(Path(__file__).parents[1] / ".cache" / f"jax-{importlib.metadata.version('jax')}"),
)
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")
os.environ.setdefault("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "0")  # a fifth of the time of lowering

import jax
import shapes

shapes.install("jaxslam")  # before the package is first imported, `spending` included

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", 4)
jax.config.update("jax_numpy_rank_promotion", "raise")
gc.set_threshold(100_000, 20, 50)  # tracing allocates much and frees little: a tenth of the suite

PROGRAMS = Path(__file__).parents[1] / ".cache"
KEPT = 2**29
"""Bytes of compiled programs that stay in the checkout after a run."""


def pytest_addoption(parser):
    parser.addoption(
        "--portion",
        action="store_true",
        help="of the sweeps, those that CI runs for this commit: python .ci/portion.py",
    )


def pytest_collection_modifyitems(config, items):
    """With --portion without the sweeps of the other two thirds."""
    if not config.getoption("--portion"):
        return
    sys.path.insert(0, str(config.rootpath / ".ci"))
    import portion

    kept, others = [], []
    for item in items:
        file, _, function = item.nodeid.partition("::")
        touched = str(Path(file).parent) in portion.rooms()
        name = f"{file}::{function.partition('[')[0]}"
        is_sweep = item.get_closest_marker("sweep") is not None
        (others if is_sweep and not portion.chosen(name, touched) else kept).append(item)
    items[:] = kept
    config.hook.pytest_deselected(items=others)


def pytest_configure(config):
    from spending import Spending

    config.pluginmanager.register(Spending(config))


def pytest_unconfigure(config):
    """Those longest unused go first; once, not in each worker."""
    if hasattr(config, "workerinput"):
        return
    files = [(path, path.stat()) for path in PROGRAMS.rglob("*") if path.is_file()]
    files.sort(key=lambda item: -max(item[1].st_atime, item[1].st_mtime))
    total = 0
    for path, stat in files:
        total += stat.st_size
        if total > KEPT:
            path.unlink(missing_ok=True)


# Angles where something can go wrong: the seam, the series around zero turn and where they end
# (0.5, and 1 for functions of the half angle).
HARD_ANGLES = np.array(
    [0.0, 1e-9, -1e-9, 1e-4, -1e-4, 0.499, 0.501, -0.499, -0.501, 0.999, 1.001, -0.999, -1.001]
    + [np.pi, np.pi - 1e-9, -np.pi + 1e-9, np.pi / 2, -np.pi / 2, 3.0]
)


def central_differences(function, arguments, argnum, step=1e-5):
    """∂function/∂arguments[argnum] (C, …, n) over a batch: every array has the leading axis C.

    A jump by a whole turn between the two sides is an angle that crossed its seam, and is undone.
    """
    x = np.asarray(arguments[argnum], np.float64)
    columns = []
    for i in range(x.shape[1]):
        shift = np.zeros_like(x)
        shift[:, i] = step
        ends = []
        for moved in (x + shift, x - shift):
            moved_arguments = list(arguments)
            moved_arguments[argnum] = moved
            ends.append(np.asarray(function(*moved_arguments), np.float64))
        rise = ends[0] - ends[1]
        rise = rise - 2 * np.pi * np.round(rise / (2 * np.pi))
        columns.append(rise / (2 * step))
    size = np.asarray(function(*arguments)).shape
    return np.stack(columns, axis=-1) if columns else np.zeros((*size, 0))


@pytest.fixture(scope="session")
def differences():
    return central_differences


@pytest.fixture(scope="session")
def hard_angles():
    return HARD_ANGLES


@pytest.fixture(scope="session")
def assert_jacobians(differences):
    """Hold hand-derived Jacobians of every argument against jacfwd and central differences."""

    def check(function, hand, arguments, atol=1e-6, exact=1e-12):
        arguments = tuple(np.asarray(a, np.float64) for a in arguments)
        over = tuple(range(len(arguments)))
        both = jax.jit(jax.vmap(lambda *a: (hand(*a), jax.jacfwd(function, argnums=over)(*a))))
        batched = jax.jit(jax.vmap(function))
        by_hand, by_autodiff = both(*arguments)
        assert len(by_hand) == len(arguments)
        for k in over:
            by_differences = differences(batched, arguments, k)
            assert by_hand[k].shape == by_differences.shape
            scale = 1 + np.max(np.abs(by_differences), initial=0.0)
            np.testing.assert_allclose(by_hand[k], by_autodiff[k], rtol=0, atol=exact * scale)
            np.testing.assert_allclose(by_hand[k], by_differences, rtol=0, atol=atol * scale)

    return check


@pytest.fixture
def float32_alone():
    """JAX as it is without x64."""
    with jax.enable_x64(False):
        yield


@pytest.fixture
def full_optimization():
    """For what depends on XLA's optimizer, or runs long enough to be worth its time."""
    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", False)
    yield
    jax.config.update("jax_disable_most_optimizations", before)
