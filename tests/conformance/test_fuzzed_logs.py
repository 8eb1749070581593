"""Every filter of the catalogue on logs of any numbers: finite, or refused by name; nothing is lost.

One program a filter runs many logs at once, as under `jit` or `vmap`, where values are not checked.
`JAXSLAM_FUZZ=20` tries more, and runs the odd shapes, too.
"""

import dataclasses
import os
import zlib

import hypothesis.strategies as st
import jax
import numpy as np
import pytest
import worlds
from cases import swept
from hypothesis import given, settings

from jaxslam import catalog, run
from jaxslam.core import _numbers, _validation
from jaxslam.core.protocols import Filter
from jaxslam.core.types import Log, Scan, Status
from jaxslam.core.validation import require
from jaxslam.graphs.smoothing import BatchMap, Smoother

WIDE = int(os.environ.get("JAXSLAM_FUZZ", "1"))
STEPS, PLACES, LANDMARKS, LOGS = 4, 3, 4, 48
WORLD = dataclasses.replace(worlds.ring(STEPS), landmarks=worlds.ring().landmarks[:LANDMARKS])
MOST = _numbers.largest(np.float64)

NUMBERS = [0.0, -0.0, 1e-300, 1e-160, 1e-30, 1e-9, -1.0, 1e3, 1e6, 1e20, -1e30, 4e61, -4e61]
SIGNALS = [np.nan, np.inf, -np.inf, 5e61, 1e160, -1e300]


def drawn(rng, shape, usual, unusual, share):
    """Usual numbers, a share of them replaced."""
    return np.where(rng.random(shape) < share, rng.choice(unusual, shape), usual)


def logs(rng, count=LOGS, steps=STEPS, places=PLACES, dtype=np.float64, wild=True):
    """Logs whose tags repeat, are unknown, or of no landmark; some without any measurement."""
    shape = count, steps, places
    control = rng.normal(0, 0.2, (count, steps, 2))
    z = np.stack([rng.exponential(3, shape), rng.uniform(-4, 4, shape)], axis=-1)
    if wild:
        control = drawn(rng, control.shape, control, NUMBERS, 0.03)
        z = drawn(rng, z.shape, z, NUMBERS, 0.1)
        z = drawn(rng, z.shape, z, SIGNALS, 0.05)
    valid = rng.random(shape) < rng.choice([0.0, 0.3, 1.0], (count, 1, 1))
    tag = rng.integers(-1, LANDMARKS + 2, shape).astype(np.int32)
    most = _numbers.largest(np.zeros((), dtype))
    with np.errstate(over="ignore"):
        return Log(np.clip(control, -most, most).astype(dtype), Scan(z.astype(dtype), tag, valid))


def made(name, steps=STEPS):
    """A filter of the catalogue, given the true map or path where it needs one."""
    options = {} if WIDE > 1 else TOGETHER.get(name, {})
    candidate = catalog.ALL[name](WORLD, **options)
    if isinstance(candidate, Filter | BatchMap | Smoother):
        return candidate
    truth = worlds.draw(WORLD)[0]
    if name == "mapping":  # the poses are its controls
        truth = truth._replace(pose=truth.pose[:steps])
    return candidate(truth)


def drive(filter):
    """A function of one log."""

    def go(log, key):
        dtype = np.result_type(log.control, log.scan.z)
        start = np.zeros(3, dtype), np.diag([0.01, 0.01, 0.001]).astype(dtype)
        whole = not isinstance(filter, Filter)  # an estimator, which knows its start
        trace = filter(log, key) if whole else run(filter, log, *start, key)
        return trace.estimate, trace.info

    return go


def assert_told(log, estimate, info, tame):
    """What became of every measurement is said, and said truly.

    tame: numbers are such as sensors give; then the covariance is one as well.
    """
    z, valid, status = np.asarray(log.scan.z), np.asarray(log.scan.valid), np.asarray(info.status)
    np.testing.assert_array_equal(status == Status.EMPTY, ~valid)
    assert np.isin(status, list(Status)).all()
    lost = valid & ~(np.abs(z) <= _numbers.largest(z)).all(axis=-1)
    assert (status[lost] == Status.REJECTED).all()
    scores = info.nis, info.innovation, info.innovation_cov, info.log_likelihood
    for leaf in (*jax.tree.leaves(estimate), *scores):
        assert np.isfinite(leaf).all()
    dof = np.where(status == Status.FUSED, z.shape[-1], 0)
    np.testing.assert_array_equal(info.dof, dof)
    assert (info.slot[(status != Status.FUSED) & (status != Status.BORN)] == -1).all()
    assert (np.abs(estimate.pose[..., 2]) <= np.float32(np.pi)).all()
    assert ((estimate.tag >= 0) <= estimate.alive).all()
    if tame:
        for cov in (estimate.pose_cov, estimate.point_covs):
            values = np.linalg.eigvalsh(np.asarray(cov, np.float64))
            assert (values >= -1e-6 * np.abs(values).max(axis=-1, keepdims=True) - 1e-9).all()


SUITE = [
    *("ekf", "ideal", "oc", "right_invariant", "ukf"),
    *("eif_slam", "seif", "fastslam2", "particle_localization", "localization", "dead_reckoning"),
]
"""Of filters that share their steps one is in the suite; programs are what a test here costs."""

TOGETHER = {"right_invariant": {"covariance": "square_root"}}
"""Options of one filter that stand for another filter of the catalogue, too: `square_root`."""


@pytest.mark.parametrize("name", catalog.ALL if WIDE > 1 else swept(SUITE, "ekf"))
def test_what_becomes_of_every_measurement_is_said(name):
    go = jax.jit(jax.vmap(drive(made(name))))
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    for number in range(4 * WIDE if WIDE > 1 else 2):
        log = logs(rng, wild=number % 2 == 0)
        keys = jax.random.split(jax.random.key(number), LOGS)
        assert_told(log, *jax.device_get(go(log, keys)), tame=number % 2 == 1)


ODD = {
    "no steps": {"steps": 0},
    "no places, float32": {"steps": 1, "places": 0, "dtype": np.float32},
}


@pytest.mark.parametrize("odd", ODD)
@pytest.mark.parametrize(
    "name", catalog.ALL if WIDE > 1 else swept(["ekf", "seif", "fastslam2"], "ekf")
)
def test_logs_of_odd_shapes_are_run(name, odd):
    """In the suite one is traced, and not run."""
    go, log = drive(made(name, ODD[odd]["steps"])), logs(np.random.default_rng(0), **ODD[odd])
    if WIDE == 1:
        log = jax.tree.map(lambda leaf: leaf[0], log)
        estimate, info = jax.eval_shape(go, log, jax.random.key(0))
        assert info.status.shape == log.scan.valid.shape
        assert estimate.pose.dtype == log.control.dtype
    else:
        keys = jax.random.split(jax.random.key(0), LOGS)
        assert_told(log, *jax.device_get(jax.jit(jax.vmap(go))(log, keys)), tame=False)


@pytest.mark.parametrize(
    ("tag", "kinds"),
    [
        (np.int8, (np.float32, np.float64)),
        (np.uint32, (np.float64, np.float16)),
    ],
)
def test_kinds_of_numbers_may_be_mixed(tag, kinds):
    log = jax.tree.map(lambda leaf: leaf[0], logs(np.random.default_rng(0)))
    scan = log.scan._replace(
        z=np.ones_like(log.scan.z, kinds[1]), tag=np.maximum(log.scan.tag, 0).astype(tag)
    )
    mixed = Log(np.ones_like(log.control, kinds[0]), scan)
    estimate, info = jax.eval_shape(drive(made("ekf")), mixed, jax.random.key(0))
    assert estimate.pose.dtype == np.float64
    assert (estimate.tag.dtype, info.status.dtype) == (np.int32, np.int32)


ANY = st.one_of(st.sampled_from(NUMBERS + SIGNALS), st.floats())


@settings(max_examples=100 * WIDE, deadline=None, derandomize=WIDE == 1)
@given(data=st.data())
def test_outside_a_trace_a_log_is_well_formed_or_refused_by_row_and_slot(data):
    steps, places = data.draw(st.integers(0, 3)), data.draw(st.integers(0, 3))

    def array(shape, kind, values):
        flat = data.draw(
            st.lists(values, min_size=int(np.prod(shape)), max_size=int(np.prod(shape)))
        )
        return np.array(flat, kind).reshape(shape)

    kind = data.draw(st.sampled_from([np.float32, np.float64]))
    with np.errstate(over="ignore"):
        control = array((steps, 2), kind, ANY)
        z = array((steps, places, 2), kind, ANY)
    tag = array(
        (steps, places), np.int64, st.one_of(st.integers(-3, 3), st.integers(-(2**40), 2**40))
    )
    valid = array((steps, places), bool, st.booleans())
    most = _numbers.largest(control, z)
    sane = [(np.abs(control) <= most).all(), (np.abs(z[valid]) <= most).all()]
    sane += [((tag[valid] >= -1) & (tag[valid] < 2**31)).all()]
    sane += [
        all(
            len(set(row)) == len(row)
            for row in (t[v & (t >= 0)].tolist() for t, v in zip(tag, valid, strict=True))
        )
    ]
    log = Log(control, Scan(z, tag, valid))
    if all(sane):
        require("log", log, _validation.log_of(2, 2))
        return
    with pytest.raises(ValueError, match=r"^log\.(control|scan\.(z|tag)).* \(row \d+"):
        require("log", log, _validation.log_of(2, 2))
