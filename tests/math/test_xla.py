"""What XLA is told: the same numbers, and a program that is as told."""

import functools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.math._xla import (
    anywhere,
    hot_jit,
    hot_options,
    materialize,
    no_inline,
    one_kernel,
    quick_jit,
    scan_in_groups,
    where_any,
)


def test_settle_is_the_identity_under_every_transformation():
    def cubed(x):
        once, tree = materialize((x**2, {"x": x}))
        return jnp.sum(once * tree["x"])

    x = np.array([[1.0, 2.0], [3.0, -1.0]])
    value, slope = jax.jit(jax.vmap(jax.value_and_grad(cubed)))(x)
    np.testing.assert_allclose(value, (x**3).sum(axis=1))
    np.testing.assert_allclose(slope, 3 * x**2)
    np.testing.assert_allclose(jax.vmap(jax.jacfwd(cubed))(x), 3 * x**2)


def test_apart_is_the_function_under_every_transformation():
    def f(x, y):
        return no_inline(lambda a, b: (a * b, jnp.sin(a)), x, y)

    x, y = np.array([0.3, 2.0]), np.array([1.5, -1.0])
    product, sine = jax.jit(jax.vmap(f))(x, y)
    np.testing.assert_allclose(product, x * y)
    np.testing.assert_allclose(sine, np.sin(x))
    slope = jax.vmap(jax.grad(lambda x, y: sum(f(x, y))))(x, y)
    np.testing.assert_allclose(slope, y + np.cos(x))


@pytest.mark.parametrize("m", [5, 0])
def test_a_scan_in_groups_is_a_loop_over_the_groups_with_a_set_row(m):
    """Rows of the mask: in both runs, in one of them, in none; the last group is not full."""
    x = np.array([[2.0, 3.0, 5.0, 7.0, 11.0], [13.0, 17.0, 19.0, 23.0, 29.0]])[:, :m]
    mask = np.array([[1, 0, 0, 0, 1], [0, 0, 0, 0, 1]], bool)[:, :m]

    def work(total, x, mask):
        return total + jnp.where(mask, x, 0.0).sum(), jnp.where(mask, total * x, 0.0)

    def by_twos(x, mask):
        return scan_in_groups(work, lambda: jnp.zeros(2), jnp.asarray(1.0), (x, mask), 2)

    totals, products = jax.jit(jax.vmap(by_twos))(x, mask)
    assert products.shape == (2, m)
    for run in range(2):
        total, expected = 1.0, np.zeros(m)
        for first in range(0, m, 2):
            group = slice(first, first + 2)
            expected[group] = mask[run, group] * total * x[run, group]
            total += (mask[run, group] * x[run, group]).sum()
        assert totals[run] == total
        np.testing.assert_array_equal(products[run], expected)


def halvings(table, x):
    """The number of halvings of x down to the entry of a table."""

    def step(state):
        x, count = state
        above = x > table.reshape(-1).at[count % table.size].get(mode="promise_in_bounds")
        return jnp.where(above, x / 2, 0.0), count + above

    return jax.lax.while_loop(lambda s: (s[0] > 0).any(), step, (x, jnp.zeros(x.shape, int)))[1]


@pytest.mark.parametrize("given", ["argument", "constant", "all constant", "in a loop", "vmap"])
def test_a_loop_in_one_kernel_is_the_loop(given):
    """XLA before 0.12 aborts the process where an argument of the kernel is not used, which is what
    it makes of a constant one."""
    table, x = np.ones((200, 100)), np.array([1.5, 9.0, 100.0])
    f = {
        "argument": lambda t, x: one_kernel(halvings, t, x),
        "constant": lambda t, x: one_kernel(halvings, table, x),
        "all constant": lambda t, _: one_kernel(halvings, table, np.array([1.5, 9.0, 100.0])),
        "in a loop": lambda t, x: jax.lax.map(lambda y: one_kernel(halvings, table, y[None]), x),
        "vmap": lambda t, x: jax.vmap(lambda y: one_kernel(halvings, t, y[None]))(x),
    }[given]
    program = jax.jit(f).lower(table, x).compile()
    np.testing.assert_array_equal(np.ravel(program(table, x)), [1, 4, 7])
    if given == "argument" and jax.default_backend() == "cpu":
        assert re.search(r"call\(.*xla_cpu_small_call=\"true\"", program.as_text())


@pytest.mark.parametrize("platform", ["cpu", "gpu"])
def test_a_quick_program_is_the_function(monkeypatch, platform):
    """Told how to compile on a CPU, and nothing elsewhere."""
    monkeypatch.setattr(jax, "default_backend", lambda: platform)
    told = []
    jit = jax.jit
    monkeypatch.setattr(jax, "jit", lambda f, **options: told.append(options) or jit(f, **options))
    x = np.array([0.3, 2.0])
    np.testing.assert_allclose(quick_jit(jax.vmap(jnp.sin))(x), np.sin(x))
    assert bool(told[-1]["compiler_options"]) == (platform == "cpu")


def test_hot_programs_are_compiled_for_the_processor():
    options = hot_options("cpu")
    if options is not None:
        program = jax.jit(lambda x: 2 * x + 1).lower(np.arange(9.0)).compile(options)
        np.testing.assert_array_equal(program(np.arange(9.0)), 2 * np.arange(9.0) + 1)
    assert hot_options("gpu") is None


def test_a_hot_function_is_a_program_alone_and_part_of_another():
    traced = []

    @functools.partial(hot_jit, static_argnames=("power",))
    def raised(power, x):
        traced.append(power)
        return x**power

    np.testing.assert_array_equal([raised(2, 3.0), raised(2, 4.0), raised(3, 2.0)], [9, 16, 8])
    assert traced == [2, 3]
    assert jax.jit(lambda: raised(2, 5.0))() == 25  # of constants alone
    assert jax.jit(jax.grad(raised, 1), static_argnums=0)(2, 3.0) == 6
    np.testing.assert_array_equal(jax.vmap(lambda x: raised(2, x))(np.arange(3.0)), [0, 1, 4])


@pytest.mark.parametrize("kept", [True, False])
def test_nothing_is_fused_across(kept):
    """A gain is computed in a kernel of its own, not in that of the product it enters."""

    def update(cov, gain):
        v = 3.0 * gain + 1.0
        v = materialize(v) if kept else v
        return cov - v[:, None] * v[None, :]

    program = jax.jit(update).lower(jnp.eye(8), jnp.ones(8)).compile().as_text()
    calls = re.findall(r"= f\d+\[[^ ]* call\(", program)
    assert bool(calls) == kept


def test_anywhere_is_one_answer_for_the_batch():
    flags = jnp.array([[False, True], [False, False]])
    np.testing.assert_array_equal(jax.vmap(anywhere)(flags[0]), [True, True])
    np.testing.assert_array_equal(jax.vmap(anywhere)(flags[1]), [False, False])
    np.testing.assert_array_equal(jax.vmap(jax.vmap(anywhere))(flags), True)


def test_where_any_stays_a_branch_under_vmap_and_has_a_gradient():
    def f(flag, x):
        return where_any(flag, lambda x: jnp.where(flag, x**2, x), lambda x: x, x)

    flags, x = jnp.array([True, False, False]), jnp.array([3.0, 4.0, 5.0])
    np.testing.assert_allclose(jax.vmap(f)(flags, x), [9, 4, 5])
    np.testing.assert_allclose(jax.vmap(jax.grad(f, argnums=1))(flags, x), [6, 1, 1])
    program = str(jax.make_jaxpr(jax.vmap(f))(flags, x))
    assert "cond[" in program
    own = jax.vmap(lambda flag, x: jax.lax.cond(flag, lambda x: x**2, lambda x: x, x))
    assert "cond[" not in str(jax.make_jaxpr(own)(flags, x))
