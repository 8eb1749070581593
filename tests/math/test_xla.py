"""What XLA is told: the same numbers, and a program that is as told."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.math.xla import anywhere, hot_options, materialize, no_inline, quick_jit, where_any


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
