"""linalg: factors and solves against NumPy, what singular matrices give, and refusals."""

import re
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import refused, swept

from jaxslam.core import validation
from jaxslam.math import _definite as definite
from jaxslam.math import _gaussians as gaussians
from jaxslam.math import _linalg as linalg

pytestmark = pytest.mark.decision

UNROLLED, LAPACK = [1, 2, 3, 6, 8], [9, 20]  # 8 is the largest that is unrolled
ROWS = 20


def random_covariances(n, count=20, seed=0):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(count, n, n + 2))
    scale = 10.0 ** rng.uniform(-2, 2, size=(count, n))  # metres next to radians
    return (root @ root.transpose(0, 2, 1)) * scale[:, :, None] * scale[:, None, :]


def outer(*rows):
    """Σ v vᵀ of integer vectors: exactly semi-definite, without a rounding error."""
    return sum(np.outer(v, v).astype(float) for v in rows)


def semi_definite(n):
    """Exactly singular (n, n) matrices: zero, a zero in the middle, rank one, a repeated row."""
    cases = [np.zeros((n, n)), np.diag(np.arange(n).astype(float))]
    if n > 1:
        cases.append(outer(2 ** np.arange(n)))
        cases.append(np.eye(n))
        cases[-1][:2, :2] = 4.0
        cases.append(np.diag([1.0] * (n - 1) + [0.0]))
    return np.array(cases)


@cache
def used(n):
    """(a, b) -> factor, its flag, half and whole solution, their flag; of (n, n) and (n, 2)."""

    def use(a, b):
        factor, positive = linalg.cholesky(a)
        solution, solvable = linalg.solve_psd(a, b)
        return factor, positive, linalg.solve_lower(factor, b), solution, solvable

    return over_rows(use)


@cache
def whitened(n):
    return over_rows(linalg.whitener)


def over_rows(function):
    """The function over up to ROWS rows of its arguments, as one program for any number."""
    program = jax.jit(jax.vmap(function))

    def padded(*arguments):
        wide = [np.concatenate([x, np.ones((ROWS - len(x), *x.shape[1:]))]) for x in arguments]
        return [np.asarray(part)[: len(arguments[0])] for part in program(*wide)]

    return padded


@pytest.mark.parametrize("n", swept(UNROLLED + LAPACK, 3, 9))
def test_factor_and_solves_equal_numpy(n):
    a = random_covariances(n)
    b = np.random.default_rng(1).normal(size=(len(a), n, 2))
    factor, positive, half, solution, solvable = used(n)(a, b)
    flags = positive & solvable
    expected = np.linalg.cholesky(a)
    unit = np.sqrt(np.einsum("cii->ci", a))[:, :, None]
    np.testing.assert_allclose(factor / unit, expected / unit, rtol=0, atol=1e-10)
    assert flags.all()
    np.testing.assert_allclose(expected @ half, b, atol=1e-9)
    np.testing.assert_allclose(unit * solution, unit * np.linalg.solve(a, b), atol=1e-7)


@pytest.mark.parametrize("n", [3, 9])
def test_a_vector_or_a_matrix_the_lower_triangle_alone_and_the_slope_of_the_log_determinant(n):
    """∂ log|A| = A⁻¹; the factor reads the lower triangle only, so the slope lives there."""
    a = random_covariances(n)
    spoiled = np.where(np.triu(np.ones((n, n)), 1) > 0, np.nan, a)
    b = np.random.default_rng(1).normal(size=(len(a), n, 2))

    def several(a, b, spoiled):
        def log_det(a):
            return 2 * jnp.log(jnp.diagonal(linalg.cholesky(a)[0])).sum()

        vectors = linalg.solve_lower(a, b[:, 0]), linalg.solve_psd(a, b[:, 0])[0]
        matrices = linalg.solve_lower(a, b), linalg.solve_psd(a, b)[0]
        return vectors, matrices, linalg.cholesky(spoiled), jax.grad(log_det)(a)

    program = jax.device_get(jax.jit(jax.vmap(several))(a, b, spoiled))
    vectors, matrices, (factor, positive), slope = program
    for vector, matrix in zip(vectors, matrices, strict=True):
        np.testing.assert_allclose(vector, matrix[:, :, 0], rtol=1e-12)
    assert positive.all()
    unit = np.sqrt(np.einsum("cii->ci", a))
    np.testing.assert_allclose(
        factor / unit[:, :, None], np.linalg.cholesky(a) / unit[:, :, None], rtol=0, atol=1e-10
    )
    np.testing.assert_array_equal(slope, np.tril(slope))
    unit = unit[:, :, None] * unit[:, None, :]
    slope = (slope + slope.transpose(0, 2, 1)) / 2
    np.testing.assert_allclose(slope * unit, np.linalg.inv(a) * unit, rtol=1e-7)


@pytest.mark.parametrize("n", swept([1, 2, 3, 6, 9, 20], 3, 9))
def test_semi_definite_matrices_are_flagged_and_nothing_is_nan(n):
    a = semi_definite(n)
    factor, positive, half, solution, solvable = used(n)(a, np.ones((len(a), n, 2)))
    assert not (positive | solvable).any()
    for part in (factor, solution, half):
        assert np.isfinite(part).all()
    # A zero pivot has a zero column in the factor, and a zero row in the solution.
    dead = np.einsum("cii->ci", factor) == 0
    assert dead.any(axis=1).all()
    assert not factor.transpose(0, 2, 1)[dead].any()
    assert not half[dead].any()
    if n <= 8:  # … so that a usable square root remains.
        rebuilt = factor @ factor.transpose(0, 2, 1)
        np.testing.assert_allclose(rebuilt, a, rtol=1e-14)


@pytest.mark.parametrize("n", swept([2, 3, 9], 3))
def test_gradients_through_semi_definite_matrices_are_finite(n):
    def total(a, b):
        solution, _ = linalg.solve_psd(a, b)
        factor, _ = linalg.cholesky(a)
        return jnp.sum(factor) + jnp.sum(solution) + jnp.sum(linalg.solve_lower(factor, b))

    a = semi_definite(n)
    slopes = jax.jit(jax.vmap(jax.grad(total, argnums=(0, 1))))(a, np.ones((len(a), n)))
    for slope in slopes:
        assert np.isfinite(slope).all()
    assert any(np.any(slope) for slope in slopes) == (n < 9)  # 9: all masked


@pytest.mark.parametrize("n", swept([1, 2, 3, 6], 3))
def test_whitener_is_the_inverse_of_the_factor(n):
    a = random_covariances(n)
    whiten, flags = whitened(n)(a)
    assert flags.all()
    assert not np.triu(whiten, 1).any()
    np.testing.assert_allclose(
        whiten @ np.linalg.cholesky(a), np.tile(np.eye(n), (20, 1, 1)), atol=1e-9
    )


def test_whitener_as_a_loop_is_the_same_matrix():
    some = random_covariances(6)[: ROWS - 6]
    a = np.concatenate([some, semi_definite(6), np.full((1, 6, 6), np.nan)])
    rows, flags = jax.jit(jax.vmap(linalg.whitener_by_rows))(a)
    whiten, same = whitened(6)(a)
    np.testing.assert_array_equal(flags, same)
    np.testing.assert_allclose(rows[:-1], whiten[:-1], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("n", swept([2, 3, 6], 3))
def test_whitener_of_a_semi_definite_matrix_leaves_out_what_the_factor_leaves_out(n):
    a = semi_definite(n)
    whiten, flags = whitened(n)(a)
    half = used(n)(a, np.ones((len(a), n, 2)))[2]
    assert not flags.any()
    np.testing.assert_allclose(whiten @ np.ones((n, 2)), half, rtol=1e-12, atol=1e-12)
    slopes = jax.jit(jax.vmap(jax.grad(lambda a: jnp.sum(linalg.whitener(a)[0]))))(a)
    assert np.isfinite(slopes).all()


@pytest.mark.parametrize("n", [4, 12])
def test_indefinite_and_non_finite_matrices_are_flagged(n):
    good = random_covariances(n, 1)[0]
    cases = np.repeat(good[None], 5, axis=0)
    cases[1] -= 2 * np.linalg.eigvalsh(good)[0] * np.eye(n)
    cases[2][0, 0] = np.nan
    cases[3][n - 1, 1] = np.nan
    cases[4][1, 1] = np.inf
    flags = jax.jit(jax.vmap(lambda a: linalg.cholesky(a)[1]))(cases)
    np.testing.assert_array_equal(flags, [True, False, False, False, False])


def products(n, rank, terms, seed, units=3):
    """H P Hᵀ of random H (n, terms) of a rank and random P, in units that are 10^±units apart."""
    rng, count = np.random.default_rng(seed), 300
    h = rng.normal(size=(count, n, rank)) @ rng.normal(size=(count, rank, terms))
    h = h * 10.0 ** rng.uniform(-units, units, size=(count, n, 1))
    root = rng.normal(size=(count, terms, terms))
    return h, root @ root.transpose(0, 2, 1)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize(
    ("n", "terms"), swept([(2, 3), (3, 5), (4, 30), (6, 8), (10, 30)], (3, 5), (4, 30), (10, 30))
)
def test_a_product_of_less_rank_is_singular_and_of_full_rank_regular(n, terms, dtype):
    """With the rounding of all terms; by the entry on the diagonal alone a fifth is taken for regular.

    Regular in float32 are those of condition below 1e3, scaled to a unit diagonal.
    """
    flag = jax.jit(jax.vmap(lambda a: linalg.cholesky(a)[1]))
    loop = jax.jit(jax.vmap(lambda a: linalg.whitener_by_rows(a)[1]))
    white = flag if n > 8 else jax.jit(jax.vmap(lambda a: linalg.whitener(a)[1]))
    for rank in (n - 1, n):
        for seed in (0, 1):
            h, p = (x.astype(dtype) for x in products(n, rank, terms, seed))
            s = h @ p @ h.transpose(0, 2, 1)
            s = (s + s.transpose(0, 2, 1)) / 2
            unit = 1 / np.sqrt(np.diagonal(s, axis1=1, axis2=2).astype(float))
            least = np.linalg.eigvalsh(s * unit[:, :, None] * unit[:, None, :])[:, 0]
            clear = least > 1e-3 if rank == n else np.ones(len(s), bool)
            assert clear.sum() > 100
            for flags in (flag(s), loop(s), white(s)):
                assert (np.asarray(flags)[clear] == (rank == n)).mean() > 0.995


@pytest.mark.parametrize("n", [1, 2, 4])
def test_inverse_equals_numpy(n):
    a = np.random.default_rng(2).normal(size=(20, n, n))  # not symmetric
    out = jax.jit(jax.vmap(linalg.inverse))(a)
    np.testing.assert_allclose(out @ a, np.broadcast_to(np.eye(n), a.shape), atol=1e-10)


def test_symmetrize():
    a = np.random.default_rng(3).normal(size=(4, 3, 3))
    np.testing.assert_array_equal(jax.jit(linalg.symmetrize)(a), (a + a.transpose(0, 2, 1)) / 2)


def test_total_is_the_sum():
    terms = np.array([1.0, 2.0]), np.array([10.0, 20.0]), np.array([100.0, 200.0])
    np.testing.assert_array_equal(linalg.total(iter(terms)), [111, 222])


# --- Mahalanobis --------------------------------------------------------------------------------

distance = jax.jit(jax.vmap(gaussians.mahalanobis_squared))


@pytest.mark.parametrize("n", [1, 3, 10])
def test_mahalanobis_equals_numpy_at_any_scale(n):
    rng = np.random.default_rng(4)
    root = np.tril(rng.normal(size=(30, n, n)), -1) * 0.3 + np.eye(n)
    white = rng.normal(size=(30, n))
    for exponents in (np.zeros(n), rng.uniform(-12, 8, n), np.full(n, -15.0)):
        scale = 10.0**exponents
        cov = root @ root.transpose(0, 2, 1) * np.outer(scale, scale)
        error = np.einsum("cij,cj->ci", root, white) * scale
        out, regular = distance(error, cov)
        assert regular.all()
        np.testing.assert_allclose(out, (white**2).sum(axis=1), rtol=1e-9)


def test_mahalanobis_masks_directions_that_are_known_exactly():
    error = np.ones((6, 3))
    turned = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0]
    cov = np.stack(
        [
            np.zeros((3, 3)),
            np.diag([1.0, 0.0, 1.0]),
            np.ones((3, 3)),
            turned @ np.diag([1.0, 2.0, 1e-17]) @ turned.T,
            np.eye(3),
            np.diag([1e-30, 1e-30, 1.0]),
        ]
    )
    error[4, 1] = np.nan
    out, regular = distance(error, cov)
    np.testing.assert_array_equal(regular, [False] * 5 + [True])
    np.testing.assert_array_equal(out[:5], np.zeros(5))
    np.testing.assert_allclose(out[5], 2e30 + 1, rtol=1e-12)
    slopes = jax.grad(lambda e, p: gaussians.mahalanobis_squared(e, p)[0], (0, 1))
    by_error, by_cov = jax.jit(jax.vmap(slopes))(error[:4], cov[:4])
    assert not by_error.any()
    assert not by_cov.any()


# --- decisions about matrices on the host ---------------------------------------------------------


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("n", [2, 3, 6])
def test_a_matrix_is_singular_regular_or_indefinite_in_any_unit(n, dtype):
    """Products of less rank; of full rank with a condition below 1e3; and with an eigenvalue changed.

    In float32 the latter is -1e-2 of a unit diagonal, next to rounding of 1e-4; in float64 -1e-6.
    """
    units = 1 if dtype == np.float32 else 3
    for rank in (n - 1, n):
        h, p = (x.astype(dtype) for x in products(n, rank, n + 3, 3, units))
        s = h @ p @ h.transpose(0, 2, 1)
        s = (s + s.transpose(0, 2, 1)) / 2
        unit = np.sqrt(np.diagonal(s, axis1=1, axis2=2).astype(float))
        values, vectors = np.linalg.eigh(s / (unit[:, :, None] * unit[:, None, :]))
        clear = values[:, 0] > 1e-3 if rank == n else np.ones(len(s), bool)
        assert clear.sum() > 60
        s, values, vectors, unit = s[clear], values[clear], vectors[clear], unit[clear]
        assert not definite.is_indefinite(s).any() and not definite.is_asymmetric(s).any()
        assert (definite.is_invertible(s) == (rank == n)).all()
        values[:, 0] = -1e-2 if dtype == np.float32 else -1e-6
        other = np.einsum("cij,cj,ckj->cik", vectors, values, vectors)
        other = (other * unit[:, :, None] * unit[:, None, :]).astype(dtype)
        other = (other + other.transpose(0, 2, 1)) / 2
        assert definite.is_indefinite(other).all() and not definite.is_invertible(other).any()
        turned = s.copy()
        turned[:, 0, 1] += np.asarray(1e-2 * unit[:, 0] * unit[:, 1], dtype)
        assert definite.is_asymmetric(turned, 1e-6).all()


def test_a_variance_of_rounding_is_zero_and_a_negative_one_is_not():
    near = np.diag([4.0, -1e-16])
    near[0, 1] = near[1, 0] = 3e-16
    assert not definite.is_indefinite(near) and not definite.is_invertible(near)
    validation.require("thing", near, validation.covariance(2))
    assert definite.is_indefinite(np.diag([4.0, -1e-12]))
    assert not definite.is_indefinite(np.zeros((2, 2)))
    # Metres beside radians: an indefinite part hides behind no large entry.
    mixed = np.diag([1e6, 1e-4, 1e-4])
    mixed[1, 2] = mixed[2, 1] = 2e-4
    with pytest.raises(ValueError, match=r"thing: the covariance is not positive semi-definite"):
        validation.require("thing", mixed, validation.covariance(3))


# --- checks -------------------------------------------------------------------------------------


@refused(
    (np.eye(3), r"expected a covariance of shape \(2, 2\), got \(3, 3\)"),
    ([1.0, 1.0], r"expected a covariance of shape \(2, 2\), got \(2,\)"),
    ([[1.0, np.nan], [np.nan, 1.0]], "the covariance has a NaN or an infinity"),
    ([[np.inf, 0.0], [0.0, 1.0]], "the covariance has a NaN or an infinity"),
    ([[1.0, 0.1], [0.0, 1.0]], "the covariance is not symmetric"),
    ([[1.0, 0.0], [0.0, -0.1]], "the covariance is not positive semi-definite"),
    ([[1e6, 0.0], [0.0, -0.5]], ".* positive semi-definite"),
    ([[1.0, 2.0], [2.0, 1.0]], "the covariance is not positive semi-definite"),
    ([[1j, 0.0], [0.0, 1.0]], "expected real numbers"),
    ([[True, False], [False, True]], "expected real numbers"),
    ([["a", "b"], ["b", "a"]], "expected real numbers"),
    told="thing: ",
)
def test_check_covariance_refuses(value):
    validation.require("thing", value, validation.covariance(2))


@pytest.mark.parametrize(
    "value",
    [
        np.zeros((2, 2)),
        [[1, 0], [0, 2]],
        outer([1, 1]),
        np.float32([[0.1, 0.05], [0.05, 0.1]]) ** 2,
    ],
    ids=["zero", "integers", "singular", "float32"],
)
def test_check_covariance_accepts(value):
    validation.require("thing", value, validation.covariance(2))


def test_check_covariance_sees_the_shape_of_a_tracer_and_no_more():
    def traced(cov, size):
        validation.require("thing", cov, validation.covariance(size))
        return cov

    assert jax.eval_shape(lambda c: traced(c, 2), -np.eye(2)).shape == (2, 2)
    with pytest.raises(ValueError, match="shape"):
        jax.eval_shape(lambda c: traced(c, 3), np.eye(2))


def test_is_concrete():
    seen = []
    jax.eval_shape(lambda x: seen.append(validation.is_concrete([1.0, {"x": x}])), np.zeros(2))
    assert seen == [False]
    assert validation.is_concrete([np.zeros(2), jnp.zeros(2), 1.0])


def everything(a, b):
    """Every function of linalg that has a library beneath it, of one matrix, as one vector."""
    factor, positive = linalg.cholesky(a)
    parts = factor, linalg.solve_lower(factor, b), linalg.solve_psd(a, b)[0], linalg.inverse(a)
    return jnp.concatenate([part.ravel() for part in parts]), positive


@pytest.mark.parametrize("n", [3, 9])
def test_a_batch_gives_what_each_of_its_matrices_gives_alone(n):
    a, b = random_covariances(n, count=2), np.random.default_rng(2).normal(size=(2, n, 3))

    def weighed(a, b):
        values, _ = everything(a, b)
        return jnp.sum(jnp.cos(jnp.arange(values.size)) * values)

    def both(a, b):
        return everything(a, b), jax.grad(weighed, (0, 1))(a, b)

    alone = jax.device_get(list(map(jax.jit(both), a, b)))
    together = jax.device_get(jax.jit(jax.vmap(both))(a, b))
    for i, one in enumerate(alone):
        for x, y in zip(jax.tree.leaves(one), jax.tree.leaves(together), strict=True):
            scale = np.abs(x.astype(float)).max()
            np.testing.assert_allclose(y[i], x, atol=1e-7 * scale)


def test_slopes_of_slopes_equal_differences():
    n = 9
    a = random_covariances(n, count=1)[0]
    unit = np.sqrt(np.diagonal(a))
    a = a / unit / unit[:, None] + np.eye(n)
    rng = np.random.default_rng(3)
    b, weights = rng.normal(size=(n, 2)), rng.normal(size=3 * n * n)
    directions = [(rng.normal(size=(n, n)), rng.normal(size=(n, 2))) for _ in range(2)]

    def weighed(x, y, first, second):
        """Of a + x D1 + y D2, a weighted sum, its slopes, and the slopes of these."""

        def total(xy):
            (da, db), (ea, eb) = first, second
            at = a + xy[0] * (da + da.T) + xy[1] * (ea + ea.T)
            values = everything(at, b + xy[0] * db + xy[1] * eb)[0]
            return values @ jnp.resize(weights, values.shape)

        xy = jnp.stack([x, y])
        return total(xy), jax.grad(total)(xy), jax.jacfwd(jax.grad(total))(xy)

    step = 1e-5
    grid = np.array([[0, 0], [step, 0], [-step, 0], [0, step], [0, -step]])
    over = jax.jit(jax.vmap(weighed, (0, 0, None, None)))
    value, slope, bend = jax.device_get(over(*grid.T, *directions))
    for k in (0, 1):
        up, down = 1 + 2 * k, 2 + 2 * k
        rise = (value[up] - value[down]) / (2 * step)
        np.testing.assert_allclose(slope[0, k], rise, rtol=1e-4, atol=1e-4)
        turn = (slope[up] - slope[down]) / (2 * step)
        np.testing.assert_allclose(bend[0][:, k], turn, rtol=1e-4, atol=1e-4)


def test_no_batch_reaches_the_librarys_kernels_on_a_cpu():
    # There they wait for threads that they hold themselves: see `linalg.batched`.
    a, b = random_covariances(20, count=4), np.ones((4, 20, 3))
    slope = jax.grad(lambda a, b: everything(a, b)[0].sum(), (0, 1))
    for f in (everything, slope):
        program = jax.jit(jax.vmap(f)).lower(a, b).compile().as_text()
        calls = [
            line for line in program.splitlines() if "lapack" in line and "custom-call(" in line
        ]
        batched = [line for line in calls if re.search(r"f64\[4,\d+,?\d*\]", line)]
        assert not batched
    alone = jax.jit(everything).lower(a[0], b[0]).compile().as_text()
    assert jax.default_backend() != "cpu" or ("lapack_dpotrf" in alone and "lapack_dtrsm" in alone)


@pytest.mark.parametrize("rows", [0, 2, 40])
def test_a_square_and_its_slopes_are_those_of_the_product(rows):
    rng = np.random.default_rng(rows)
    a, by_a = rng.normal(size=(2, rows, 5))
    weight = rng.normal(size=(5, 5))
    np.testing.assert_allclose(linalg.self_gram(a), a.T @ a, atol=1e-12)
    _, slope = jax.jvp(linalg.self_gram, (a,), (by_a,))
    np.testing.assert_allclose(slope, by_a.T @ a + a.T @ by_a, atol=1e-12)
    back = jax.grad(lambda a: jnp.sum(weight * linalg.self_gram(a)))(a)
    np.testing.assert_allclose(back, a @ (weight + weight.T), atol=1e-12)


def test_a_key_is_one_prng_key():
    single = jax.random.key(0)
    for key in (single, jax.random.PRNGKey(0), np.asarray(jax.random.PRNGKey(0))):
        validation.require("it", key, validation.prng_key)
    jax.eval_shape(lambda key: validation.require("it", key, validation.prng_key), single)
    for key, shown in (
        (0, "got 0"),
        (None, "got None"),
        (np.zeros(2), r"an array of float64 of shape \(2,\)"),
        (jax.random.split(single, 3), r"one PRNG key, got keys of shape \(3,\)"),
    ):
        with pytest.raises(ValueError, match=f"it: expected .*{shown}"):
            validation.require("it", key, validation.prng_key)
