"""The linearity index: closed forms, brute force, units, and the guide's claim on inverse depth."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import refused, swept

import jaxslam
from jaxslam import motion, sensors
from jaxslam.verify.linearity import motion_linearity, sensor_linearity

DTYPES = [np.float32, np.float64]


def curved(x):
    """An ellipse's worth of bend in two inputs, and a straight output."""
    return jnp.stack([jnp.sin(x[0]) * jnp.exp(x[1] / 2), x[0] - 3 * x[1], x[0] * x[1]])


def linearity_index(f, x, cov, **options):
    """Compiled, which is quicker than op by op."""

    def go(x, cov):
        return jaxslam.linearity_index(f, x, cov, **options)

    return jax.jit(go)(x, jnp.asarray(cov))


X, COV = np.array([0.4, -0.3]), np.array([[0.04, 0.01], [0.01, 0.09]])


def test_a_linear_function_has_index_zero():
    out = linearity_index(lambda x: jnp.stack([2 * x[0] - x[1], x[1] + 5]), X, COV)
    assert out.hessian == 0
    assert out.sampled < 1e-14


@pytest.mark.parametrize("sigmas", [1.0, 3.0])
def test_a_parabola_has_its_closed_form(sigmas):
    """f = x²: bend n²σ², reach 2|x|nσ."""
    x, sigma = 1.5, 0.2
    out = linearity_index(lambda x: x**2, np.array([x]), np.array([[sigma**2]]), sigmas=sigmas)
    for value in (out.hessian, out.sampled, out.hessian_rows[0], out.sampled_rows[0]):
        np.testing.assert_allclose(value, sigmas * sigma / (2 * x), rtol=1e-12)


def test_noise_that_hides_the_bend_lowers_it():
    x, sigma, noise = 1.5, 0.2, 0.7
    out = linearity_index(
        lambda x: x**2, np.array([x]), np.array([[sigma**2]]), noise_cov=[[noise**2]]
    )
    reach = 3 * np.hypot(2 * x * sigma, noise)
    np.testing.assert_allclose([out.hessian, out.sampled], 9 * sigma**2 / reach, rtol=1e-12)


def test_against_brute_force():
    """Every direction and radius of the region, in NumPy."""

    def f(x):
        return np.stack([np.sin(x[:, 0]) * np.exp(x[:, 1] / 2), x[:, 0] * x[:, 1]], axis=1)

    a, b = X
    e = np.exp(b / 2)
    slope = np.array([[np.cos(a) * e, np.sin(a) * e / 2], [b, a]])
    around = np.linspace(0, 2 * np.pi, 721)
    circle = np.stack([np.cos(around), np.sin(around)], axis=1)
    for sigmas in (1.0, 0.01):
        worst = np.zeros(2)
        for radius in np.linspace(0, sigmas, 41):
            delta = radius * circle @ np.linalg.cholesky(COV).T
            bend = np.abs(f(X + delta) - f(X[None]) - delta @ slope.T)
            worst = np.maximum(worst, bend.max(axis=0))
        reach = sigmas * np.sqrt(np.einsum("ij,jk,ik->i", slope, COV, slope))
        out = linearity_index(curved, X, COV, sigmas=sigmas)
        rows = np.array([0, 2])
        # The points tried are inside the region, and among them is nearly the worst one.
        assert np.all(out.sampled_rows[rows] <= worst / reach * 1.001)
        np.testing.assert_allclose(out.sampled_rows[rows], worst / reach, rtol=0.02)
    # In the small region the Hessian is all there is.
    np.testing.assert_allclose(out.hessian_rows[rows], worst / reach, rtol=2e-3)
    assert out.hessian == out.hessian_rows.max()


def test_units_do_not_matter():
    scale = np.array([1000.0, 0.01])

    def rescaled(y):
        return curved(y / scale)

    one = linearity_index(curved, X, COV)
    other = linearity_index(rescaled, X * scale, COV * np.outer(scale, scale))
    np.testing.assert_allclose(other.hessian_rows, one.hessian_rows, rtol=1e-10, atol=1e-13)


def test_a_known_input_does_not_count():
    out = linearity_index(curved, X, np.diag([0.04, 0.0]))
    alone = linearity_index(lambda a: curved(jnp.stack([a[0], X[1]])), X[:1], [[0.04]])
    np.testing.assert_allclose(out.hessian_rows, alone.hessian_rows, rtol=1e-12)
    nothing = linearity_index(curved, X, np.zeros((2, 2)))
    assert nothing.hessian == nothing.sampled == 0


def test_where_there_is_a_bend_and_no_slope():
    def distance(x):
        return jnp.stack([x[0] ** 2 + x[1] ** 2])

    out = linearity_index(distance, np.zeros(2), np.eye(2))
    assert np.isinf(out.hessian)
    assert np.isinf(out.sampled)


def test_a_singular_covariance_of_many_inputs():
    """Beyond 8 inputs too, a direction that is known counts for nothing, and the others do count."""
    n, rank = 12, 5
    spread = np.random.default_rng(0).normal(size=(n, rank))

    def f(x):
        return jnp.stack([(x**2).sum(), x[0] * x[11]])

    x = np.arange(1.0, n + 1) / n
    out = linearity_index(f, x, spread @ spread.T)
    # The same in coordinates of the range alone: x + spread y, y ~ N(0, I).
    alone = linearity_index(lambda y: f(x + spread @ y), np.zeros(rank), np.eye(rank))
    assert alone.hessian > 0.1
    np.testing.assert_allclose(out.hessian_rows, alone.hessian_rows, rtol=1e-9)

    def worst(scale):
        return linearity_index(f, x, scale * spread @ spread.T).hessian

    assert np.isfinite(jax.jit(jax.grad(worst))(1.0))


@pytest.mark.parametrize("far", [1e3, 1e5, 1e7])
def test_far_from_the_origin_a_linear_function_is_linear_in_float32(far):
    x = np.array([far, -far, 1.0], "f4")
    cov = np.diag([0.1, 0.1, 0.1]).astype("f4")
    out = linearity_index(lambda x: jnp.stack([x[0] + x[1], 3 * x[2]]), x, cov)
    assert out.hessian == out.sampled == 0


def test_no_slope_to_compare_with_is_inf_not_nan():
    """The other outputs keep their own figures."""

    def f(x):
        return jnp.stack([jnp.sqrt(x[0] ** 2 + x[1] ** 2), x[0] - x[1], x[0] + x[0] ** 2])

    out = linearity_index(f, np.zeros(2), 0.01 * np.eye(2))
    assert np.isinf(out.hessian_rows[0])
    assert np.isinf(out.sampled_rows[0])
    for rows in (out.hessian_rows, out.sampled_rows):
        np.testing.assert_allclose(rows[1:], [0.0, 0.3], rtol=1e-9, atol=1e-15)
    assert np.isinf(
        linearity_index(jnp.log, np.array([0.2]), [[0.04]]).sampled
    )  # 0.2 - 3 * 0.2 < 0


@pytest.mark.sweep
def test_whole_numbers_are_as_good_as_any():
    """A pose of integers does not round the control, the landmark or the noise."""
    robot, u, cov = motion.Velocity(np.diag([0.1, 0.05, 0.05]) ** 2), [1.5, 0.3, 0.5], np.eye(3) / 9
    laser, wide = sensors.RangeBearing(np.diag([0.1, 0.05]) ** 2), np.eye(5) / 100

    @jax.jit
    def both(pose):
        moved = motion_linearity(robot, pose, u, cov).hessian_rows
        return moved, sensor_linearity(laser, pose, [2.5, 0.5], wide).hessian_rows

    chex.assert_trees_all_equal(both(np.array([1, 2, 0])), both(np.array([1.0, 2.0, 0.0])))


@pytest.mark.parametrize("dtype", swept(DTYPES, np.float64))
def test_jit_vmap_dtype_and_gradient(dtype):
    states = np.array([X, [1.0, 2.0], [0.0, 0.0]], dtype)
    cov = COV.astype(dtype)
    batch = jax.jit(jax.vmap(lambda x: linearity_index(curved, x, cov)))(states)
    for leaf in batch:
        assert leaf.dtype == dtype
    alone = jax.jit(lambda x: jax.lax.map(lambda x: jaxslam.linearity_index(curved, x, COV), x))(
        states.astype(np.float64)
    )
    for i in range(len(states)):
        one = jax.tree.map(lambda leaf, i=i: leaf[i], alone)
        rtol = 1e-4 if dtype == np.float32 else 1e-10
        np.testing.assert_allclose(batch.hessian[i], one.hessian, rtol=rtol)
        np.testing.assert_allclose(batch.sampled[i], one.sampled, rtol=rtol)

    def worst(cov):
        out = linearity_index(curved, states[0], cov)
        return out.hessian + out.sampled

    slopes = jax.jit(jax.vmap(jax.grad(worst)))(np.stack([COV, np.diag([0.04, 0.0])]).astype(dtype))
    assert np.isfinite(slopes).all()


@pytest.mark.parametrize("sigma", [1e-3, 1e-6])
def test_rounding_is_no_bend(sigma):
    """In float32 a region may be too small for the bend of f to show."""

    def distance(x):
        return jnp.hypot(x[0], x[1])[None]

    out = linearity_index(distance, np.array([3.0, 4.0], "f4"), np.eye(2, dtype="f4") * sigma**2)
    assert out.sampled < 1.5 * out.hessian


def test_angles_are_compared_on_the_circle():
    """A heading next to the seam bends no more than one far from it."""
    robot = motion.Velocity(np.diag([0.1, 0.05, 0.05]) ** 2)
    u, cov = np.array([1.0, 0.3, 0.5]), np.diag([0.1, 0.1, 0.2]) ** 2
    of = jax.jit(jax.vmap(lambda pose: motion_linearity(robot, pose, u, cov)))
    assert (
        of(np.array([[1.0, 2.0, 0.5], [1.0, 2.0, np.pi - 1e-3]])).sampled_rows[:, 2] < 1e-12
    ).all()

    laser = sensors.RangeBearing(np.diag([0.1, 0.05]) ** 2)
    pose, cov = np.zeros(3), np.diag([0.01, 0.01, 0.1, 0.01, 0.01]) ** 2

    @jax.jit
    @jax.vmap
    def seen(point):
        with_noise = sensor_linearity(laser, pose, point, cov, with_noise=True)
        return sensor_linearity(laser, pose, point, cov), with_noise.hessian

    out, with_noise = seen(np.array([[-3.0, 1e-9], [3.0, 1e-9]]))  # behind and ahead
    np.testing.assert_allclose(out.sampled[0], out.sampled[1], rtol=0.05)
    assert with_noise[1] < out.hessian[1]


# --- Solà 2.3.6: inverse depth is near-linear where range is not ---------------------------------

NEAREST = 2.0


RHO, SIGMA = 0.5 / NEAREST, 0.25 / NEAREST


@jax.jit
def from_the_side(baseline):
    """Indices of the bearing from a robot that went sideways, by inverse depth and by range.

    The landmark was first seen straight ahead from the origin. Its inverse distance has the guide's
    prior, 1/(2 d_min) ± 1/(4 d_min); its range, the same to first order.
    """
    pose = jnp.stack([0.0, baseline, 0.0])
    inverse = sensors.BearingInverseDepth([[1e-4]], min_distance=NEAREST)
    by_inverse = sensor_linearity(
        inverse, pose, np.array([0.0, 0, 0, RHO]), np.diag([0, 0, 0, 0, 0, 0, SIGMA**2])
    )
    cov = np.diag([0, 0, 0, (SIGMA / RHO**2) ** 2, 0])
    point = np.array([1 / RHO, 0.0])
    return by_inverse, sensor_linearity(sensors.BearingOnly([[1e-4]]), pose, point, cov)


@pytest.mark.parametrize("share", swept([0.02, 0.1, 0.25], 0.1))
def test_inverse_depth_is_near_linear_where_range_is_not(share):
    """f(ρ) = -atan(ρ b) has |f''/f'| = 2ρb²/(1 + ρ²b²), f(d) = -atan(b/d) has 2d/(d² + b²)."""
    prior = sensors.BearingInverseDepth([[1e-4]], min_distance=NEAREST).free
    np.testing.assert_allclose([prior.mean[0], prior.cov[0, 0]], [RHO, SIGMA**2])
    b, d, sigma_d = share * NEAREST, 1 / RHO, SIGMA / RHO**2
    by_inverse, by_range = from_the_side(b)
    closed_inverse = 3 * SIGMA * RHO * b**2 / (1 + (RHO * b) ** 2)
    closed_range = 3 * sigma_d * d / (d**2 + b**2)
    np.testing.assert_allclose(by_inverse.hessian, closed_inverse, rtol=1e-9)
    np.testing.assert_allclose(by_range.hessian, closed_range, rtol=1e-9)
    assert by_inverse.hessian < 0.03
    assert by_range.hessian > 1.4  # it bends as far as it rises
    assert by_inverse.sampled < 0.04
    assert by_range.sampled > 1.4


# --- bad input ----------------------------------------------------------------------------------


@refused(
    ({"x": np.eye(2)}, r"linearity_index: x: expected shape \(n,\), got \(2, 2\)"),
    ({"cov": np.eye(3)}, r"shape \(2, 2\)"),
    ({"cov": -np.eye(2)}, "negative variance"),
    ({"cov": np.diag([1.0, np.nan])}, "NaN"),
    ({"sigmas": 0.0}, "above 0"),
    ({"x": np.array([np.nan, 1])}, "not finite"),
    ({"f": lambda x: x[0]}, r"return \(m,\)"),
    ({"noise_cov": np.eye(2)}, r"shape \(3, 3\)"),
)
def test_bad_input_is_refused(change):
    arguments = {"f": curved, "x": X, "cov": COV} | change
    if "noise_cov" in change:  # by its shape alone
        jax.eval_shape(lambda: jaxslam.linearity_index(**arguments))
    jaxslam.linearity_index(**arguments)


@pytest.mark.parametrize(
    ("pose", "other", "why"),
    [
        (np.zeros(2), np.ones(3), r"pose: expected shape \(3,\)"),
        (np.zeros(3), np.ones(5), r"(u|landmark): expected shape"),
        (np.zeros((1, 3)), np.ones(3), r"pose: expected shape"),
    ],
)
def test_bad_shapes_of_a_models_input_are_refused(pose, other, why):
    with pytest.raises(ValueError, match=why):
        motion_linearity(motion.Velocity(np.eye(3)), pose, other, np.eye(3))
    with pytest.raises(ValueError, match=why):
        sensor_linearity(sensors.RangeBearing(np.eye(2)), pose, other, np.eye(5))
