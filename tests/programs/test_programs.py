"""Programs are compiled once for a structure: another number, object or key compiles nothing."""

import threading

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import worlds
from layouts import wrong_layouts

from jaxslam import catalog, filters, programs, run, simulate, smoothing
from jaxslam.core.record import record
from jaxslam.programs import cache
from jaxslam.types import Status


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

    programs.clear()
    first = trace(1.0, 0)
    before = compilations()
    second = trace(1.07, 1)
    assert compilations() == before
    assert wrong_layouts() == []
    assert np.isfinite(np.asarray(second.estimate.pose)).all()
    assert not np.allclose(first.estimate.pose, second.estimate.pose)


def test_a_program_gives_what_the_function_does():
    """Hoisted numbers stand where they stood: the same trace as under `jax.jit`, to rounding."""
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


@record
class Scale:
    factor: float


def test_records_of_one_structure_are_not_traced_again():
    traced = []

    def scaled(scale, x):
        traced.append(scale)
        return x * scale.factor

    x = jnp.arange(3.0)
    for factor in (3.7, 3.9):  # another number is another argument
        found = programs.call(scaled, (Scale(factor),), x)
        np.testing.assert_allclose(found, factor * np.arange(3))
    assert len(traced) == 1
    programs.call(scaled, (Scale(3.7),), x[:2])
    assert len(traced) == 2
    programs.clear()
    programs.call(scaled, (Scale(3.7),), x)
    assert len(traced) == 3


def ones(rows):
    """(rows, 2) at an address from which JAX on a CPU may share memory: a multiple of 64."""
    room = np.ones(2 * rows + 8)
    return room[-room.ctypes.data % 64 // 8 :][: 2 * rows].reshape(rows, 2)


def test_arrays_of_numpy_need_no_program_of_their_own_and_are_copied(compilations):
    rows = ones(4099)

    def scaled(x, y):
        return x * rows, y + 1

    programs.call(jnp.sin, (), 0.5)  # a first program asks which options the compiler has
    x, y = ones(4099), np.ones(4099)
    before = compilations()
    first, _ = programs.call(scaled, (), x, y)
    assert compilations() == before + 1
    first.block_until_ready()
    rows[:], x[:] = 7.0, 3.0
    second, _ = programs.call(scaled, (), x, y)
    assert (np.asarray(first) == 1.0).all()
    assert (np.asarray(second) == 3.0).all()


def test_an_option_is_part_of_the_structure():
    def powers(twice, count, x):
        return [x**k for k in range(count)] if twice else x

    assert len(programs.call(powers, (True, 3), np.ones(2))) == 3
    assert len(programs.call(powers, (True, 5), np.ones(2))) == 5
    assert programs.call(powers, (False, 3), np.ones(2)).shape == (2,)


def test_within_a_trace_it_is_the_function():
    def cubed(x):
        return x**3

    x = jnp.asarray([1.0, 2.0])

    def through(x):
        return programs.call(cubed, (), x).sum()

    np.testing.assert_allclose(jax.grad(through)(x), 3 * x**2)
    np.testing.assert_allclose(jax.jit(jax.vmap(through))(x), x**3)

    def of_noise(scale):
        """The arguments are concrete; what the function closes over is not."""
        return programs.call(lambda x: scale * x, (), x).sum()

    assert jax.grad(of_noise)(2.0) == 3.0
    with jax.disable_jit():
        np.testing.assert_allclose(programs.call(cubed, (), x), x**3)


def test_every_kind_of_number_becomes_an_input():
    """Constants and literals in calls, loops, branches and rules: the same structure for all."""

    def make(s):
        rows, offset = np.array([[1.5, 0.3], [0.2, 1.3]]) * s, jnp.array([0.3, 0.4]) * s

        @jax.jit
        def inner(x):
            return x @ rows * (0.7 * s) + offset[0]

        @jax.custom_jvp
        def curve(x):
            return jnp.tanh(x * (0.9 * s))

        curve.defjvp(lambda p, t: (curve(p[0]), t[0]))

        @jax.custom_batching.custom_vmap
        def batch(x):
            return x + 0.11 * s

        batch.def_vmap(lambda size, batched, x: (batch(x), batched[0]))

        @jax.checkpoint
        def body(x, row):
            x = inner(x) * row
            x = jax.lax.cond(
                x[0] > 0.21 * s, lambda x: inner(x) - 0.31 * s, lambda x: x + offset * 0.41 * s, x
            )
            x = jax.lax.while_loop(
                lambda x: x[0] > 1.23 * s, lambda x: x * jnp.array([0.51, 0.61]) * s, x
            )
            return batch(curve(x)), x.sum()

        return lambda x: jax.lax.scan(body, x, jnp.array([1.7, 0.71, 1.3]) * s)

    x = jnp.array([0.6, 0.8])
    texts = set()
    for s in (1.01, 0.97):
        traced = programs.trace(make(s), x)
        ours = jax.tree.unflatten(traced.out, jax.jit(traced.call)(traced.numbers, x))
        chex.assert_trees_all_close(ours, make(s)(x), rtol=1e-14)
        texts.add(jax.jit(traced.call).lower(traced.numbers, x).as_text())
    assert len(texts) == 1


def test_what_says_how_large_something_is_stays():
    texts = {
        jax.jit(traced.call).lower(traced.numbers, 1.0).as_text()
        for traced in (programs.trace(lambda x, n=n: jnp.zeros(n) + x, 1.0) for n in (2, 3))
    }
    assert len(texts) == 2


def test_the_least_recently_used_is_dropped():
    kept, made = cache.Kept(2), []

    def get(key):
        return kept.get(key, lambda: made.append(key) or key)

    for key in (1, 2, 1, 3, 1):
        assert get(key) == key
    assert made == [1, 2, 3]
    assert len(kept) == 2
    get(2)
    assert made == [1, 2, 3, 2]


def test_the_older_half_is_dropped_where_memory_maps_run_out(monkeypatch):
    kept, made = cache.Kept(8), []
    for name in "abcde":
        kept.get(name, lambda: 0)
    monkeypatch.setattr(cache, "_share_of_maps", lambda: 0.6)
    monkeypatch.setattr(cache, "_ALL", {kept})
    programs.call(jnp.cosh, (), jnp.zeros(7))
    for name in "cdeab":
        kept.get(name, lambda: made.append(0))
    assert len(made) == 2
    assert 0 <= cache._share_of_maps() < 1


def test_who_comes_second_waits_and_an_error_is_not_kept():
    kept, began, go = cache.Kept(2), threading.Event(), threading.Event()
    made, found = [], []

    def slow():
        began.set()
        go.wait(10)
        made.append(1)
        return "made"

    threads = [threading.Thread(target=lambda: found.append(kept.get(0, slow))) for _ in range(3)]
    threads[0].start()
    began.wait(10)
    for thread in threads[1:]:
        thread.start()
    go.set()
    for thread in threads:
        thread.join(10)
    assert (made, found) == ([1], ["made"] * 3)

    def bad():
        raise ValueError("bad")

    with pytest.raises(ValueError, match="bad"):
        kept.get(1, bad)
    assert kept.get(1, lambda: "good") == "good"


def test_float32_and_float64_are_two_programs():
    def double(x):
        return x * 2.3

    assert programs.call(double, (), jnp.ones(2, jnp.float32)).dtype == jnp.float32
    assert programs.call(double, (), np.ones(2)).dtype == jnp.float64


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
