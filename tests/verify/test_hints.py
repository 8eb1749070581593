"""What `verify` adds to its verdict: lengths deduced from shapes, angles not named, and cures."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from verified import by_name, failed

from jaxslam import sensors
from jaxslam.verify import build, verify_jacobians
from jaxslam.verify.derivatives.jacobians import Evaluated
from jaxslam.verify.derivatives.jumps import Jump
from jaxslam.verify.derivatives.singular import CURES, singular_operation
from jaxslam.verify.inputs.functions import plain_function, sensor_functions
from jaxslam.verify.inputs.samples import Samples
from jaxslam.verify.verifier import notes_of

# --- lengths of arguments -------------------------------------------------------------------------


def move(pose, u, scale):
    return pose[:2] * scale[0] + u[0] * jnp.stack([jnp.cos(pose[2]), jnp.sin(pose[2])])


def parts(pose, u, scale):
    """The Jacobians of `move`, without use of its lengths."""
    c, s = jnp.cos(pose[2]), jnp.sin(pose[2])
    by_pose = jnp.stack([jnp.stack([scale[0], 0.0, -u[0] * s]), jnp.stack([0, scale[0], u[0] * c])])
    return by_pose, jnp.stack([c, s])[:, None], pose[:2, None]


def lengths(*arguments, **options):
    function = plain_function(*arguments, **options)
    return {a.name: len(a.entries) for a in function.arguments if a.deduced}


def unpacked(point, u):
    v, omega, dt = u
    return jnp.stack([v * dt, omega * dt, point[0]])


def branching(u):
    return u * 2 if u[0] > 0 else u


@pytest.mark.parametrize(
    ("function", "claim", "expected"),
    [
        (move, parts, {"u": 1, "scale": 1}),
        # One array by the first argument: its own length is told, and those that must be unpacked.
        (lambda u: 3 * u[:2], lambda u: 3 * jnp.eye(2, 4), {"u": 4}),
        (unpacked, lambda point, u: jnp.eye(3)[:, 1:], {"u": 3}),
        (unpacked, None, {"u": 3}),
        # All by side: the columns less those that are known.
        (
            lambda point, u: point * u[0],
            lambda point, u: jnp.stack(
                [jnp.stack([u[0], 0, point[0]]), jnp.stack([0, u[0], point[1]])]
            ),
            {"u": 1},
        ),
        (branching, lambda u: np.eye(3), {"u": 3}),  # not traceable
        (lambda u: jnp.sqrt(u), lambda u: 0.5 / jnp.sqrt(u)[:, None], {"u": 1}),
        # A claim of a wrong shape is reported; the function tells the length.
        (unpacked, lambda point, u: (None, jnp.eye(2)), {"u": 3}),
    ],
)
def test_lengths_are_deduced_where_one_alone_fits(function, claim, expected):
    assert lengths(function, claim) == expected


def test_lengths_are_those_of_the_states():
    states = (np.ones((4, 2)), np.ones((4, 5)))
    assert lengths(lambda a, b: a * b[:2], None, states=states) == {"a": 2, "b": 5}


def test_a_deduced_length_is_noted_and_verified():
    report = verify_jacobians(lambda u: u**2, lambda u: 2 * u[:, None], name="f")
    assert report.passed, str(report)
    (note,) = report.notes
    assert note.startswith("u: 1 entry, deduced from shapes")
    assert 'f_arguments = {"u": ("u0 [unit]",)} in the file' in note
    (note,) = verify_jacobians(lambda state: jnp.stack([state @ jnp.ones(3)])).notes
    assert 'arguments={"state": ("x [m]", "y [m]", "theta [rad]")} in Python' in note
    assert "<lambda>" not in note and "define a function" in note


@pytest.mark.parametrize(
    ("function", "claim", "whys"),
    [
        (lambda u: u, None, ["length of 'u'", "f accepts more than one"]),
        (lambda u: u, lambda u: jnp.eye(len(u)), ["f and its Jacobian accept more than one"]),
        # Only the argument that is not determined is asked for.
        (lambda a, b: a[0] * b, lambda a, b: (b[:, None], None), ["length of 'b' is"]),
        (
            lambda a, b: (a * 2).reshape(2) + b[0],
            None,
            ["length of 'b' is", 'f_arguments = {"b": ("v [m/s]", "omega [rad/s]")}'],
        ),
        (lambda u: u.reshape(20), None, ["f fails with 1 to 12 entries", "reshape"]),
        (lambda u: (u, u), None, ["it returns shapes [(12,), (12,)], expected (m,)"]),
        (lambda a, b, c, d: a, None, ["at most 3 are deduced"]),
    ],
)
def test_lengths_that_are_not_determined_are_asked_for(function, claim, whys):
    with pytest.raises(ValueError, match=r"the length of .* is not known") as error:
        lengths(function, claim, name="f")
    message = str(error.value)
    assert "\n" not in message
    for why in whys:
        assert why in message


def test_a_function_of_other_arguments_is_told():
    sensor = dataclasses.replace(build(sensors.bearing_only), invert=lambda pose, z: z)
    assert "invert can be called: invert takes (pose, z, s), got a function of (pose, z)" in str(
        verify_jacobians(sensor)
    )


def test_a_derivative_that_is_not_finite_is_no_difference_of_0():
    """Though all methods agree on NaN, and a function without a value has none to compare."""
    for function, said in (
        (lambda point: jnp.sqrt(0 * point), "a derivative is not finite"),
        (lambda point: jnp.nan * point, "no value is finite"),
    ):
        report = verify_jacobians(function, lambda point: jnp.full((2, 2), jnp.nan), name="f")
        assert f"FAIL  f by point (hand-derived): {said}; " in str(report)


# --- angles that are not named --------------------------------------------------------------------


def bearing(pose, landmark):
    dx, dy = landmark - pose[:2]
    return jnp.stack([dx, jnp.arctan2(dy, dx) - pose[2]])


def test_an_output_that_jumps_by_a_turn_is_noted_unless_named():
    report = verify_jacobians(bearing)
    assert report.passed
    note, _ = report.notes
    assert note.startswith("bearing[1] jumps by 2π at pose = (")
    assert "note  bearing[1] jumps" in str(report)
    (note,) = verify_jacobians(bearing, outputs=("x [m]", "bearing [rad]")).notes
    assert "is not finite with the landmark at the pose" in note


def test_only_jumps_by_a_turn_are_noted():
    def f(point):
        steep = 3 * jnp.tanh(1e4 * point[0])
        return jnp.stack([jnp.sign(point[0]), steep, 1e3 * point[1], 180 / jnp.pi * jnp.angle(z)])

    z = jnp.exp(1j)
    assert not verify_jacobians(f).notes

    def degrees(pose):
        return 180 / jnp.pi * jnp.arctan2(jnp.sin(pose[2:]), jnp.cos(pose[2:]))

    (note,) = verify_jacobians(degrees).notes
    assert "jumps by 360" in note
    assert "[deg]" in note


def test_of_a_sensor_the_measurements_are_named():
    sensor = dataclasses.replace(build(sensors.bearing_only), measurements=("bearing",))
    function = sensor_functions(sensor)[0]
    jump = Jump(0, "[rad]", (np.zeros(3), np.ones(2)))
    evaluated = Evaluated(function, Samples((), ()), None, (), (), (jump,))
    (note,) = notes_of(evaluated, "sensor")
    assert note.startswith("bearing jumps by 2π at pose = (0, 0, 0), landmark = (1, 1).")
    assert "end its name in measurements with [rad]" in note
    assert not list(notes_of(evaluated, "motion"))  # whose outputs are x, y, theta


# --- cures ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("function", "state", "kind"),
    [
        (lambda p: jnp.linalg.norm(p), (0, 0), "a square root of 0"),
        (lambda p: jnp.abs(p) ** 0.5, (0, 1), "a square root of 0"),
        (lambda p: jnp.sqrt(p), (-1, 1), "a square root of a negative number"),
        (lambda p: jnp.where(p[0] > 0, jnp.arctan2(*p), 0), (0, 0), "arctan2(0, 0)"),
        (lambda p: jnp.where(p[0] != 0, p[1] / p[0], 1), (0, 1), "a division by 0"),
        (lambda p: jax.jit(jnp.reciprocal)(p), (0, 1), "a division by 0"),
        (lambda p: p**-0.5, (1, 0), "a division by 0"),
        (lambda p: jnp.log(p), (1, 0), "a logarithm of 0 or less"),
        (lambda p: jnp.arccos(p), (1, 0), "an arcsine or arccosine at ±1"),
        (lambda p: jnp.arcsin(2 * p), (1, 0), "an arcsine or arccosine beyond ±1"),
        (lambda p: jax.lax.fori_loop(0, 3, lambda _, x: x / 2, p), (0, 0), ""),
        (lambda p: jnp.hypot(*p) + p**3 + p**2.0, (-3, 4), ""),
        (lambda p: float(p[0]), (0, 0), ""),  # not traceable
    ],
)
def test_a_singular_operation_is_named(function, state, kind):
    assert singular_operation(function, (np.array(state, float),)) == kind


def test_a_singular_place_comes_with_its_cure():
    states = [np.array([[0.0, 0.0], [3.0, 4.0]])]
    report = verify_jacobians(lambda point: jnp.linalg.norm(point)[None], name="f", states=states)
    check = by_name(report, "f and its derivatives are finite")
    assert check.cure[1:] == CURES["a square root of 0"][1:]
    assert "safe = jnp.where(r2 > 0, r2, 1.0)" in str(report)
    assert report.as_dict()["checks"][-2]["cure"]


def test_functions_of_places_are_noted_where_these_coincide():
    """The places are not among the states of the checks, since a claim need not be defined there."""

    def distance(pose, landmark):
        offset = landmark - pose[:2]  # without `hypot`, whose derivative jax 0.10 has there
        return jnp.sqrt(offset @ offset)[None]

    report = verify_jacobians(distance)
    (note,) = report.notes
    assert report.passed
    assert "derivative by pose and landmark is not finite with the landmark at the pose: " in note
    assert "a square root of 0" in note
    assert str(report).endswith("\n        " + CURES["a square root of 0"][-1])
    safe = verify_jacobians(lambda point: jnp.sqrt(1 + point @ point)[None], name="safe")
    assert safe.passed and not safe.notes
    (note,) = verify_jacobians(lambda point: jnp.log(point[:1] ** 2), name="f").notes
    assert note.count("the value is not finite with the point at the origin: point = (0, 0)") == 1


def test_the_cures_cure():
    """The lines that are printed, run as they stand: finite with their derivatives."""
    wheres = {
        "a square root of 0": ("r", lambda v: {"r2": v[0] ** 2 + v[1] ** 2}),
        "arctan2(0, 0)": ("angle", lambda v: {"dx": v[0], "dy": v[1]}),
        "a division by 0": ("out", lambda v: {"x": v[0], "y": v[1], "limit": 1.0}),
    }
    for kind, (result, names) in wheres.items():

        def cured(point, kind=kind, result=result, names=names):
            scope = {"jnp": jnp, **names(point)}
            exec("\n".join(CURES[kind][1:]), scope)
            return scope[result][None]

        states = [np.array([[0.0, 0.0], [3.0, 4.0]])]
        assert not failed(verify_jacobians(cured, states=states)), kind
