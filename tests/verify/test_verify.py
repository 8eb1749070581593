"""`verify_jacobians` of functions: the method that is wrong, and faults that are reported, not raised."""

import json
import re
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import refused
from own_models import changed
from verified import by_name, failed

from jaxslam import sensors
from jaxslam.verify import _differences, _inputs, build, verify_jacobians


def observe(pose, landmark):
    dx, dy = landmark - pose[:2]
    return jnp.stack([jnp.hypot(dx, dy), jnp.arctan2(dy, dx) - pose[2]])


OUTPUTS = ("range [m]", "bearing [rad]")


def test_a_right_claim_passes_however_it_is_returned():
    def parts(pose, landmark):
        return jax.jacfwd(observe, argnums=(0, 1))(pose, landmark)

    def side_by_side(pose, landmark):
        return jnp.concatenate(parts(pose, landmark), axis=1)

    def first(pose, landmark):
        return parts(pose, landmark)[0]

    def second(pose, landmark):
        return None, parts(pose, landmark)[1]

    def in_numpy(pose, landmark):
        (dx, dy), r = landmark - pose[:2], np.hypot(*(landmark - pose[:2]))
        return [[-dx / r, -dy / r, 0], [dy / r**2, -dx / r**2, -1]]

    claims = ((parts, 2), (side_by_side, 2), (first, 1), (second, 1), (in_numpy, 1))
    for claim, claimed in claims:
        report = verify_jacobians(observe, claim, outputs=OUTPUTS)
        assert report.passed, str(report)
        assert sum("hand" in f.methods for f in report.findings) == claimed


def test_a_wrong_derivative_rule_is_the_autodiffs_fault():
    @jax.custom_jvp
    def square(x):
        return x**2

    @square.defjvp
    def _(primals, tangents):
        return square(primals[0]), 3 * primals[0] * tangents[0]

    def f(point):
        return jnp.stack([square(point[0]), point[1]])

    def claim(point):
        return jnp.array([[2 * point[0], 0], [0, 1]])

    report = verify_jacobians(f, claim)
    (wrong,) = report.findings[0].wrong_entries
    assert (wrong.row, wrong.column) == ("f[0]", "x [m]")
    assert wrong.dissent == ("jacfwd", "jacrev")  # the differences side with the claim


def test_an_entry_wrong_in_float32_only_is_found():
    def claim(point):
        slip = 1e-3 if point.dtype == jnp.float32 else 0.0
        return jnp.array([[2 * point[0] * (1 + slip), 0.0]], point.dtype)

    report = verify_jacobians(lambda point: point[:1] ** 2, claim)
    (wrong,) = report.findings[0].wrong_entries
    assert wrong.precision == "float32"
    assert wrong.dissent == ("hand",)


def test_a_heading_is_compared_on_the_circle():
    """Neither wrapped nor unwrapped angles are an error, where the output says that it is one."""

    def unwrapped(pose):
        return pose[2:] * 2 + 7

    def wrapped(pose):
        return jnp.arctan2(jnp.sin(2 * pose[2:]), jnp.cos(2 * pose[2:]))

    for f in (unwrapped, wrapped):
        assert verify_jacobians(f, outputs=("heading [rad]",)).passed


def test_own_states_are_used_and_named():
    def f(v):
        return jnp.sqrt(v)

    states = [np.array([[1.0], [4.0]])]
    report = verify_jacobians(
        f, lambda v: 0.5 / jnp.sqrt(v)[:, None], arguments={"v": 1}, states=states
    )
    assert report.passed
    assert report.findings[0].samples == 2
    assert verify_jacobians(f, arguments={"v": ("area [m^2]",)}).passed is False  # √ of negatives


# --- functions that misbehave ----------------------------------------------------------------------


def test_a_branch_on_a_tracer_is_named_and_the_claim_still_checked():
    def f(point):
        if point[0] > 0:
            return point * 2
        return point * 3

    def claim(point):
        return (2.0 if point[0] > 0 else 4.0) * jnp.eye(2)

    report = verify_jacobians(f, claim)
    here = "test_verify.py:"
    traceable = by_name(report, "f is traceable")
    assert not traceable.passed
    assert here in traceable.detail
    assert "jnp.where" in traceable.detail
    assert {(e.row, e.column) for e in report.findings[0].wrong_entries} == {
        ("f[0]", "x [m]"),
        ("f[1]", "y [m]"),
    }
    assert all(e.dissent for e in report.findings[0].wrong_entries)
    assert "jacfwd" not in report.findings[0].methods


def test_a_claim_that_branches_is_still_compared():
    def claim(point):
        return 2 * jnp.eye(2) if point[0] > 0 else 2.5 * jnp.eye(2)

    report = verify_jacobians(lambda point: 2 * point, claim, name="double")
    assert len(report.findings[0].wrong_entries) == 2
    assert failed(report) == ["double by point"]
    check = by_name(report, "the Jacobian claimed for double is called state by state")
    assert "test_verify.py:" in check.detail


def raising(point):
    raise RuntimeError("no such thing")


CALLS = []


def impure(point):
    CALLS.append(1)
    return point * len(CALLS)


@pytest.mark.parametrize(
    ("function", "told"),
    [
        (lambda point: point[0], r"is expected"),
        (lambda point: (point, point), r"is expected"),
        (lambda point: 1.0, r"is expected"),
        (raising, r"test_verify\.py:.*no such thing"),
        (lambda point: sys.exit(0), r"SystemExit"),
        (lambda point: point * 1j, r"complex"),
        (impure, r"is pure"),
        (
            lambda point: jnp.sqrt(point[:1]),
            r"and its derivatives are finite: test_verify\.py:\d+: a value is not.*point = \(",
        ),
    ],
)
def test_a_fault_of_a_function_is_reported(function, told):
    report = verify_jacobians(function)
    assert not report.passed
    assert re.search(told, str(report))


def test_a_function_of_another_shape_than_its_outputs_is_reported():
    report = verify_jacobians(observe, outputs=("range [m]",))
    assert "(2,) where an array of shape (1,)" in str(report)


def test_a_gradient_that_is_nan_is_reported():
    report = verify_jacobians(
        lambda point: jnp.sqrt(point[:1] ** 2 + point[1:] ** 2),
        states=[np.array([[0.0, 0], [1, 1]])],
    )
    (name,) = [n for n in failed(report) if "finite" in n]
    assert "jacfwd by point is not" in by_name(report, name).detail


@pytest.mark.parametrize(
    ("claim", "why"),
    [
        (lambda point: jnp.eye(3), r"\(3, 3\) by point; expected \(2, 2\)"),
        (lambda point: (jnp.eye(2), jnp.eye(2)), "2 Jacobians where the function has 1"),
        (lambda point: 1 / 0, "ZeroDivisionError"),
        (lambda point: None, "is a `return` missing"),
        (lambda point: sys.exit(0), "SystemExit"),
    ],
)
def test_an_unusable_claim_is_reported_and_the_rest_goes_on(claim, why):
    report = verify_jacobians(lambda point: 2 * point, claim)
    (name,) = failed(report)
    assert "can be used" in name
    assert re.search(why, by_name(report, name).detail)
    assert report.findings[0].passed


def test_a_kink_is_nobodys_fault():
    """Any slope between the two sides will do; next to it, only the right one."""

    def claim(point):
        return jnp.where(point[0] >= 0, 1.0, -1.0).reshape(1, 1) * jnp.array([[1.0, 0.0]])

    def f(point):
        return jnp.abs(point[:1])

    report = verify_jacobians(f, claim)
    assert report.passed, str(report)
    assert report.findings[0].no_derivative > 0
    assert not verify_jacobians(f, lambda point: -claim(point)).passed


def test_a_claim_just_off_is_the_claims_fault():
    report = verify_jacobians(
        lambda point: jnp.sin(point[:1]),
        lambda point: jnp.stack([jnp.cos(point[0]) * (1 + 3e-8), 0.0])[None],
    )
    (wrong,) = report.findings[0].wrong_entries
    assert wrong.dissent == ("hand",)


def test_the_worst_that_is_printed_is_what_is_compared():
    """Of a difference that loses digits, far from the origin, in autodiff as in the claim."""
    offset = 1e4 * (1 + np.random.default_rng(0).uniform(size=(6, 2)))
    states = (offset, offset + np.random.default_rng(1).uniform(1, 3, size=(6, 2)))

    def squared(point, other):
        return ((other - point) ** 2).sum()[None]

    def claim(point, other):  # multiplied out, so rounded otherwise
        return (2 * point - 2 * other)[None], (2 * other - 2 * point)[None]

    for limit in (1e-5, 1e-9):
        report = verify_jacobians(
            squared, claim, arguments={"other": 2}, states=states, float32_tolerance=limit
        )
        for finding in report.findings:
            parts = (
                (finding.relative, finding.tolerance),
                (finding.float32, finding.float32_tolerance),
                (finding.differences, finding.differences_tolerance),
            )
            assert finding.passed == all(worst <= tolerance for worst, tolerance in parts)


# --- house --------------------------------------------------------------------------------------


def test_float64_is_used_and_given_back(float32_alone):
    report = verify_jacobians(observe, outputs=OUTPUTS)
    assert jnp.zeros(1).dtype == jnp.float32
    assert report.findings[0].relative < 1e-12
    assert report.findings[0].differences < 1e-6


def test_the_report_is_json_and_text():
    report = verify_jacobians(observe, lambda pose, landmark: jnp.zeros((2, 3)), outputs=OUTPUTS)
    content = json.loads(json.dumps(report.as_dict(), allow_nan=False))
    assert content["passed"] is False
    wrong = content["jacobians"][0]["wrong_entries"]
    assert {"row": "range [m]", "column": "x [m]"}.items() <= wrong[0].items()
    assert "observe by pose" in str(report)


@refused(
    (lambda: verify_jacobians(lambda speed: speed), "the length of 'speed' is not known"),
    (
        lambda: verify_jacobians(observe, arguments={"landmarks": 2}),
        "observe: arguments: expected those of pose, landmark, got landmarks",
    ),
    (lambda: verify_jacobians(lambda: jnp.ones(2)), "a parameter to differentiate by"),
    (
        lambda: verify_jacobians(observe, count=1),
        "verify_jacobians: count: expected an integer >= 2, got 1",
    ),
    (lambda: verify_jacobians(observe, tolerance=0.0), "above 0"),
    (
        lambda: verify_jacobians(observe, states=[np.zeros((4, 3))]),
        r"verify_jacobians: states: expected shapes \(S, 3\), \(S, 2\), got \[\(4, 3\)\]",
    ),
    (
        lambda: verify_jacobians(lambda point: point, states=[np.zeros((4, 3))]),
        'the name point fixes 2 entries, which arguments={"point": 3} changes',
    ),
    (lambda: verify_jacobians(observe, arguments={"pose": "xyz"}), "a tuple of names"),
    (lambda: verify_jacobians(observe, arguments={"pose": 3.0}), "a tuple of names or their"),
    (lambda: verify_jacobians(observe, arguments={"pose": -1}), "expected a number of entries"),
    (lambda: verify_jacobians(observe, arguments=("pose", "l")), "name: entries"),
    (
        lambda: verify_jacobians(observe, outputs="x [m]"),
        r"observe: outputs: expected a tuple of names, got 'x \[m\]'",
    ),
    (
        lambda: verify_jacobians(observe, seed=-1),
        "verify_jacobians: seed: expected a number between 0 and 2³²-1, got -1",
    ),
)
def test_bad_requests_are_refused(call):
    call()


# --- Lengths that must be given, and what is not finite -------------------------------------------


def test_lengths_are_those_of_the_states():
    states = (np.ones((4, 2)), np.ones((4, 5)))
    claim = _inputs.functions.function_claim(lambda a, b: a * b[:2], None, states=states)
    assert {a.name: len(a.entries) for a in claim.arguments} == {"a": 2, "b": 5}
    # A size from the shape of an array.
    sized = _inputs.functions.function_claim(lambda u: u, None, {"u": np.int64(2)})
    assert sized.arguments[0].entries == ("u[0]", "u[1]")


@pytest.mark.parametrize(
    ("name", "place"),
    [
        ("f", 'f_arguments = {"b": ("v [m/s]", "omega [rad/s]")} in the file'),
        ("<lambda>", 'arguments={"b": ("v [m/s]", "omega [rad/s]")} in Python; in a file define a'),
    ],
)
def test_a_length_that_is_not_known_is_asked_for(name, place):
    with pytest.raises(ValueError, match=r"the length of 'b' is not known") as error:
        _inputs.functions.function_claim(lambda pose, b: b, None, name=name)
    message = str(error.value)
    assert "\n" not in message and place in message


def test_a_function_of_other_arguments_is_told():
    sensor = changed(build(sensors.BearingOnly), invert=lambda pose, z: z)
    check = by_name(verify_jacobians(sensor), "invert can be called")
    assert check.detail == "invert takes (pose, measurement, free), got a function of (pose, z)"


def test_a_derivative_that_is_not_finite_is_no_difference_of_0():
    """Though all methods agree on NaN, and a function without a value has none to compare."""
    for function, said in (
        (lambda point: jnp.sqrt(0 * point), "a derivative is not finite"),
        (lambda point: jnp.nan * point, "no value is finite"),
    ):
        report = verify_jacobians(function, lambda point: jnp.full((2, 2), jnp.nan), name="f")
        assert f"FAIL  f by point (hand-derived): {said}; " in str(report)


def test_functions_of_places_are_noted_where_these_coincide():
    """The places are not among the states of the checks, since a claim need not be defined there."""

    def distance(pose, landmark):
        offset = landmark - pose[:2]  # without `hypot`, whose derivative jax 0.10 has there
        return jnp.sqrt(offset @ offset)[None]

    report = verify_jacobians(distance)
    (note,) = report.notes
    assert report.passed
    assert "derivative by pose and landmark is not finite with the landmark at the pose: " in note
    safe = verify_jacobians(lambda point: jnp.sqrt(1 + point @ point)[None], name="safe")
    assert safe.passed and not safe.notes
    (note,) = verify_jacobians(lambda point: jnp.log(point[:1] ** 2), name="f").notes
    assert note.count("the value is not finite with the point at the origin: point = (0, 0)") == 1


# --- Difference quotients: their values, estimated errors, kinks, circles --------------------------


def smooth(x):
    return np.stack([np.sin(x[:, 0]) * np.exp(x[:, 1]), x[:, 0] ** 3 / x[:, 1]], axis=1)


def smooth_jacobian(x):
    a, b = x[:, 0], x[:, 1]
    return np.stack(
        [
            np.stack([np.cos(a) * np.exp(b), np.sin(a) * np.exp(b)], axis=1),
            np.stack([3 * a**2 / b, -(a**3) / b**2], axis=1),
        ],
        axis=1,
    )


def test_quotients_and_their_error():
    rng = np.random.default_rng(0)
    x = np.stack([rng.normal(size=50), rng.uniform(1, 2, 50)], axis=1)
    value, error, kink = _differences.quotients(smooth, (x,), 0, np.full(2, np.inf))
    off = np.abs(value - smooth_jacobian(x))
    assert off.max() < 1e-10
    assert error.max() < 1e-8
    assert np.all(off <= 10 * error)
    assert not kink.any()


def test_quotients_know_where_there_is_no_derivative():
    x = np.array([[0.0], [1e-9], [1.0]])

    def root(x):
        return np.sqrt(np.abs(x))

    value, error, kink = _differences.quotients(root, (x,), 0, np.full(1, np.inf))
    assert np.all(~(error[:2, 0, 0] < 1e-3 * np.abs(value[:2, 0, 0])))
    np.testing.assert_allclose(value[2, 0, 0], 0.5, atol=1e-10)


def test_quotients_cross_the_seam_of_a_circle():
    def wrapped(x):
        return np.angle(np.exp(1j * 2 * x))

    x = np.array([[np.pi / 2], [-np.pi / 2 + 1e-9], [0.3]])
    value, _, kink = _differences.quotients(wrapped, (x,), 0, np.array([2 * np.pi]))
    np.testing.assert_allclose(value, 2, atol=1e-9)
    assert not kink.any()


def test_quotients_see_a_kink_where_they_converge():
    def f(x):
        return np.stack([np.abs(x[:, 0]), x[:, 0] * np.abs(x[:, 0])], axis=1)

    value, error, kink = _differences.quotients(
        f, (np.array([[0.0], [1e-3]]),), 0, np.full(2, np.inf)
    )
    np.testing.assert_array_equal(kink[:, :, 0], [[True, False], [False, False]])


def test_a_fast_turn_is_not_aliased():
    def heading(x):
        return np.angle(np.exp(1j * 1000 * x))

    value, _, _ = _differences.quotients(heading, (np.array([[0.3]]),), 0, np.array([2 * np.pi]))
    np.testing.assert_allclose(value, 1000, rtol=1e-7)
