"""Programs are compiled once for a structure: another number or key compiles nothing."""

import re
from pathlib import Path

import chex
import jax
import numpy as np
import pytest
import worlds
from layouts import kept_programs, wrong_layouts

import jaxslam
from jaxslam import catalog, filters, run, simulate, smoothing
from jaxslam.core.record import record
from jaxslam.core.types import Status


@pytest.fixture
def compilations():
    with worlds.compilations() as count:
        yield count


def test_a_world_of_other_numbers_is_drawn_by_what_is_there(compilations):
    first = simulate(worlds.scaled(1.0), jax.random.key(0))[0]
    before = compilations()
    second = simulate(worlds.scaled(1.07), jax.random.key(1))[0]
    assert compilations() == before
    assert not np.allclose(first.pose, second.pose)


def test_other_numbers_run_what_is_there_place_by_place(compilations):
    """As `test_family` has it of all filters, corrected jointly."""

    def trace(scale, seed):
        there = worlds.scaled(scale)
        _, log = simulate(there, jax.random.key(seed))
        method = catalog.FILTERS["square_root"](there, gate=9.0 * scale)
        return run(method, log, there.pose, there.pose_cov, jax.random.key(seed))

    kept = kept_programs()
    first = trace(1.0, 0)
    before = compilations()
    second = trace(1.07, 1)
    assert compilations() == before
    assert wrong_layouts(kept) == []
    assert np.isfinite(np.asarray(second.estimate.pose)).all()
    assert not np.allclose(first.estimate.pose, second.estimate.pose)


def test_a_program_gives_what_the_function_does():
    """The numbers of records are arguments: the same trace as with constants, to rounding."""
    there = worlds.scaled(1.0)
    ekf = worlds.ekf(there, gate=5.991, correction="joint")
    key = jax.random.key(0)
    truth, log = simulate(there, key)
    plain = jax.jit(lambda log: run(ekf, log, there.pose, there.pose_cov, key))(log)
    ours = run(ekf, log, there.pose, there.pose_cov, key)
    chex.assert_trees_all_close(plain, ours, rtol=1e-9, atol=1e-12)
    drawn = jax.jit(lambda key: simulate(there, key))(key)
    chex.assert_trees_all_close(drawn, (truth, log), rtol=1e-9, atol=1e-12)
    none = run(
        worlds.ekf(there, gate=1e-6, correction="joint"), log, there.pose, there.pose_cov, key
    )
    assert int(none.info.tally(Status.REJECTED).sum()) > int(ours.info.tally(Status.REJECTED).sum())


def test_a_smoother_with_other_numbers(compilations):
    """As `test_catalog` has it of all that the catalog has, `batch_map` and `fixed_lag` among them."""

    def trace(scale):
        there = worlds.scaled(scale, steps=4)
        _, log = simulate(there, jax.random.key(0))
        estimator = smoothing.Smoother(there.motion, there.sensor, 6, there.pose, there.pose_cov)
        return estimator(log, jax.random.key(0))

    first = trace(1.0)
    before = compilations()
    assert not np.allclose(trace(1.07).estimate.pose, first.estimate.pose)
    assert compilations() == before


def test_nothing_imports_private_jax_or_asks_for_its_version():
    private = re.compile(r"jax\._src|jax\.extend|jaxlib\.|jax\.__version|version\(.jax.\) [<>=]")
    package = Path(jaxslam.__file__).parent
    found = [p for p in package.rglob("*.py") if private.search(p.read_text(encoding="utf-8"))]
    assert [str(p.relative_to(package)) for p in found] == ["cli/__init__.py"]  # --version


def test_an_error_of_the_function_comes_as_it_is():
    ring = worlds.ring(3)
    ekf = filters.EkfSlam(ring.motion, ring.sensor, 6)
    _, log = simulate(ring, jax.random.key(0))
    with pytest.raises(ValueError, match="expected shape"):
        run(
            ekf,
            log._replace(control=log.control[:, :1]),
            ring.pose,
            ring.pose_cov,
            jax.random.key(0),
        )


def test_an_update_without_info_and_a_key_that_is_none_are_refused():
    ring = worlds.ring(3)
    ekf = filters.EkfSlam(ring.motion, ring.sensor, 6)
    _, log = simulate(ring, jax.random.key(0))

    @record
    class Bare(filters.Wrapper):
        def update(self, joint, scan, key):
            return self.filter.update(joint, scan, key)[0]

    with pytest.raises(ValueError, match=r"expected update to return \(state, Info\), got Joint"):
        run(Bare(ekf), log, ring.pose, ring.pose_cov, jax.random.key(0))
    with pytest.raises(ValueError, match="run: expected a PRNG key"):
        run(ekf, log, ring.pose, ring.pose_cov, 0)
    with pytest.raises(ValueError, match="simulate: expected a PRNG key"):
        simulate(ring, 0)
