"""Functions that end in one precision, in one mode of differentiation, or never."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import swept
from own_models import changed
from verified import by_name, failed

from jaxslam import motion, sensors
from jaxslam.verify import verify_jacobians
from jaxslam.verify._loops import ROUNDS, limit_loops, with_loop_end

SOME = (0.1 + 0.5 * np.random.default_rng(1).uniform(size=(8, 2)),)


def until_equal(step, start, tolerance, floor=0.0):
    """The fixed point of a step, until a change or the floor is at most the tolerance."""

    def more(pair):
        return jnp.maximum(jnp.max(jnp.abs(pair[1] - pair[0])), floor) > tolerance

    return jax.lax.while_loop(more, lambda pair: (pair[1], step(pair[1])), (start, step(start)))[1]


def undistorted(point):
    """r = point / (1 + r²/10) to a tolerance that float32 does not reach where x > 0.35."""
    floor = jnp.where(jnp.real(point[0]) > 0.35, jnp.finfo(point.dtype).eps, 0.0)
    return until_equal(lambda r: point / (1 + 0.1 * (r @ r)), point, 1e-14, floor)


def undistorted_jacobian(point):
    r = undistorted(point)
    return jnp.linalg.inv((1 + 0.1 * (r @ r)) * jnp.eye(2) + 0.2 * jnp.outer(r, r))


def test_a_loop_that_ends_in_float64_alone_is_verified_in_float64():
    report = verify_jacobians(undistorted, undistorted_jacobian, states=SOME)
    assert report.passed, str(report)
    (finding,) = report.findings
    assert finding.methods == ("jacfwd", "hand", "differences")
    assert finding.float32 < 1e-5
    without_reverse, single = report.notes
    assert without_reverse.startswith("undistorted has no jacrev")
    count = np.sum(SOME[0][:, 0] > 0.35)
    assert 0 < count < 8 and f"after {ROUNDS:,} rounds at {count} of 8 states" in single
    wrong = verify_jacobians(undistorted, lambda x: 1.01 * undistorted_jacobian(x), states=SOME)
    assert failed(wrong) == ["undistorted by point"]


def test_a_loop_that_never_ends_is_told_with_the_states():
    def falls(point):  # ends where y is negative
        down = jnp.where(point[1] < 0, 1.0, 0.0).astype(point.dtype) * jnp.array(
            [1, 0], point.dtype
        )
        return jax.lax.while_loop(lambda x: x[0] > 0, lambda x: x - down, jnp.abs(point))

    states = (np.array([[2.5, 1.0], [1.5, -1.0], [0.5, -2.0], [3.5, 2.0]]),)
    report = verify_jacobians(falls, states=states)
    assert failed(report) == ["the loops of falls end"]
    assert "at 2 of 4 states; given: point = (2.5, 1)" in by_name(report, *failed(report)).detail
    assert report.findings[0].samples == 2
    everywhere = verify_jacobians(falls, states=(states[0][:1],))
    assert failed(everywhere) == ["the loops of falls end"] and not everywhere.findings


def test_the_loops_of_a_sensor_are_limited_in_every_check():
    camera = sensors.RelativePosition(0.01 * np.eye(2))
    looping = changed(
        camera,
        invert=lambda pose, z, s: camera.invert(pose, until_equal(jnp.cos, z, 1e-14), s),
        invert_jacobians=None,
    )
    report = verify_jacobians(looping, count=2)
    assert "observe undoes invert, whatever is free" in failed(report)  # cos is no distortion
    assert any(note.startswith("invert has no jacrev") for note in report.notes)


@pytest.mark.parametrize("model", [sensors.RelativePosition, motion.Increment])
def test_a_noise_whose_loop_never_ends_is_no_covariance(model):
    def noise(*arguments):
        never = jax.lax.while_loop(lambda x: x[0] > -2, jnp.cos, arguments[-1])
        return 0.01 * jnp.eye(2, dtype=never.dtype) + 0 * never[0]

    report = verify_jacobians(model(noise), count=2)
    assert failed(report) == ["noise covariance"]
    assert "NaN" in by_name(report, "noise covariance").detail


def test_a_function_with_its_own_vector_jacobian_product_has_no_forward_mode():
    @jax.custom_vjp
    def distance(point):
        return jnp.sqrt(point @ point)[None]

    distance.defvjp(
        lambda point: (distance(point), point),
        lambda point, g: (g[0] * point / jnp.sqrt(point @ point),),
    )
    report = verify_jacobians(distance, lambda x: (x / jnp.sqrt(x @ x))[None], states=SOME)
    assert report.passed, str(report)
    assert report.findings[0].methods == ("jacrev", "hand", "differences")
    (note,) = report.notes
    assert note.startswith("distance has no jacfwd, which filters use")


def test_what_calls_numpy_is_reported():
    def sine(pose):
        return jax.pure_callback(np.sin, jax.ShapeDtypeStruct((3,), pose.dtype), pose)

    report = verify_jacobians(sine, lambda pose: jnp.diag(jnp.cos(pose)), count=2)
    assert failed(report) == ["sine can be differentiated", "sine works under vmap"]
    assert report.findings[0].methods == ("hand", "differences")

    def fails(pose):
        if pose[0] > 0:
            raise RuntimeError("not here")
        return pose

    def calls(pose):
        shape = jax.ShapeDtypeStruct((3,), pose.dtype)
        return jax.pure_callback(fails, shape, pose, vmap_method="sequential")

    assert "calls can be evaluated at every state" in failed(verify_jacobians(calls, count=4))


def test_a_function_of_float64_alone_is_compared_there():
    def counted(point):  # carries float64, whatever the argument is
        return jax.lax.fori_loop(0, 3, lambda _, x: x + np.ones(2), point)

    report = verify_jacobians(counted, lambda point: jnp.eye(2), states=SOME)
    assert report.passed and report.findings[0].float32 is None
    assert "counted is compared in float64 alone" in report.notes[0]


def nested(x, n):
    """Loops in loops, scans, branches, calls and a derivative rule."""

    @jax.custom_jvp
    def cosine(y):
        return until_equal(jnp.cos, y[None], 1e-14)[0]

    cosine.defjvp(lambda y, dy: (cosine(*y), 2.0 * dy[0]))

    def step(total, t):
        return total + cosine(t * total), jax.lax.cond(t > 1, cosine, jnp.sin, t)

    total, parts = jax.lax.scan(step, x, jnp.arange(3, dtype=x.dtype), reverse=True)
    outer = jax.lax.while_loop(lambda y: y < n, lambda y: y + jax.jit(cosine)(y), x)
    return total + parts.sum() + jax.checkpoint(cosine)(x) + outer


@pytest.mark.parametrize("x", swept((0.3, 0.7), 0.3))
def test_loops_that_end_give_the_same_numbers(x):
    x, n = jnp.asarray(x), jnp.asarray(3.0)
    for function in (nested, jax.jacfwd(nested), jax.jacfwd(limit_loops(nested))):
        wanted = (nested if function is nested else jax.jacfwd(nested))(x, n)
        found, ended = jax.vmap(with_loop_end(function), in_axes=(0, None))(x[None], n)
        assert ended.all()
        np.testing.assert_allclose(found[0], wanted, rtol=1e-14)


def test_the_rounds_of_nested_loops_are_counted_together():
    def never(x):
        def inner(y):
            return jax.lax.while_loop(lambda y: y > x - 10, lambda y: y + 1, y)

        return jax.lax.while_loop(lambda y: y > -1, inner, x)

    value, ended = jax.jit(jax.vmap(with_loop_end(never)))(jnp.arange(2.0))
    np.testing.assert_array_equal(value, ROUNDS + np.arange(2.0))
    assert not ended.any()
    assert np.isnan(limit_loops(never)(1.0))
