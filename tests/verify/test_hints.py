"""Lengths that must be given, and what is not finite."""

import jax.numpy as jnp
import numpy as np
import pytest
from own_models import changed

from jaxslam import sensors
from jaxslam.verify import build, verify_jacobians
from jaxslam.verify.inputs.functions import plain_function


def test_lengths_are_those_of_the_states():
    states = (np.ones((4, 2)), np.ones((4, 5)))
    function = plain_function(lambda a, b: a * b[:2], None, states=states)
    assert {a.name: len(a.entries) for a in function.arguments} == {"a": 2, "b": 5}


@pytest.mark.parametrize(
    ("name", "place"),
    [
        ("f", 'f_arguments = {"b": ("v [m/s]", "omega [rad/s]")} in the file'),
        ("<lambda>", 'arguments={"b": ("v [m/s]", "omega [rad/s]")} in Python; in a file define a'),
    ],
)
def test_a_length_that_is_not_known_is_asked_for(name, place):
    with pytest.raises(ValueError, match=r"the length of 'b' is not known") as error:
        plain_function(lambda pose, b: b, None, name=name)
    message = str(error.value)
    assert "\n" not in message and place in message


def test_a_function_of_other_arguments_is_told():
    sensor = changed(build(sensors.BearingOnly), invert=lambda pose, z: z)
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
