"""Laws that hold for whatever numbers: increments of SE(2), and a change of map frame."""

import functools

import hypothesis.strategies as st
import jax
import numpy as np
import pytest
from cases import swept
from hypothesis import given, settings

from jaxslam import motion, se2, sensors
from jaxslam.verify import build

law = settings(max_examples=60, deadline=None, derandomize=True)


def number(low, high):
    return st.floats(low, high, allow_subnormal=False)


def vector(*ranges):
    return st.tuples(*(number(low, high) for low, high in ranges)).map(np.array)


METRES, ANGLE = (-100.0, 100.0), (-np.pi, np.pi)
SERIES = [0.0, 1e-9, -1e-4, 0.499, -0.501, 0.999, np.pi, 1e-9 - np.pi]  # seam, ends of series
headings = number(*ANGLE) | st.sampled_from(SERIES)
poses = st.tuples(number(*METRES), number(*METRES), headings).map(np.array)
points = vector(METRES, METRES)
twists = vector((-10, 10), (-10, 10), (-3.1, 3.1))


@functools.cache
def compiled(function):
    return jax.jit(function)


def call(function, *arguments):
    return np.asarray(compiled(function)(*arguments))


def assert_close(a, b, angular=(), atol=1e-9):
    """Coordinates to 1e-9, of up to a few hundred metres; angles on the circle."""
    off = np.asarray(a) - np.asarray(b)
    for k in angular:
        off[k] -= 2 * np.pi * np.round(off[k] / (2 * np.pi))
    assert np.abs(off).max(initial=0) < atol, (a, b)


def assert_same_pose(a, b, atol=1e-9):
    assert_close(a, b, angular=[2], atol=atol)


# --- SE(2) --------------------------------------------------------------------------------------


@functools.cache
def in_one(law):
    """A law's functions as one program, in NumPy."""
    program = jax.jit(law)
    return lambda *arguments: jax.device_get(program(*arguments))


def increments(a, b, tau):
    moved = se2.exp(se2.adjoint(a) @ tau)
    return {
        "log exp": se2.log(se2.exp(tau)),
        "exp log": se2.exp(se2.log(a)),
        "right": se2.compose(a, se2.exp(tau)),
        "left": se2.compose(moved, a),
        "b ⊞ (a ⊖ b)": se2.boxplus(b, se2.boxminus(a, b)),
        "(a ⊞ τ) ⊖ a": se2.boxminus(se2.boxplus(a, tau), a),
    }


@law
@given(poses, poses, twists)
def test_exp_log_boxes_and_adjoint(a, b, tau):
    found = in_one(increments)(a, b, tau)
    assert_close(found["log exp"], tau)
    assert_same_pose(found["exp log"], a, 1e-8)
    assert_same_pose(found["right"], found["left"], 1e-8)
    assert_same_pose(found["b ⊞ (a ⊖ b)"], a, 1e-8)
    assert_close(found["(a ⊞ τ) ⊖ a"], tau, atol=1e-8)


SENSORS = {name: build(factory) for name, factory in sensors.REGISTRY.items()}
MOTIONS = {name: build(factory) for name, factory in motion.REGISTRY.items()}


def drawn(names, scale=1.0):
    """A strategy for a vector by the units of its entries."""
    ranges = {"[rad]": ANGLE, "[s]": (0.0, 5.0), "[1/m]": (0.01, 1.0)}

    def one(name):
        low, high = ranges.get(name.split(" ")[-1], (-10.0, 10.0))
        if "steering" in name:
            low, high = -0.8, 0.8
        return low * scale, high * scale

    return vector(*(one(name) for name in names))


def angular(names):
    return [k for k, name in enumerate(names) if name.endswith("[rad]")]


# --- a change of map frame --------------------------------------------------------------------------


@pytest.mark.parametrize("name", swept(motion.REGISTRY, "velocity"))
@law
@given(carried=poses, pose=poses, data=st.data())
def test_motion_is_the_same_in_every_map_frame(name, carried, pose, data):
    model = MOTIONS[name]
    u, w = data.draw(drawn(model.controls)), data.draw(drawn(model.noises, 0.1))
    further = data.draw(drawn(model.state[3:])) if model.state[3:] else np.zeros(0)
    there = np.concatenate([call(se2.compose, carried, pose), further])
    moved, after = call(model.step, there, u, w), call(model.step, np.r_[pose, further], u, w)
    assert_same_pose(moved[:3], call(se2.compose, carried, after[:3]), 1e-8)
    np.testing.assert_array_equal(moved[3:], after[3:])


@pytest.mark.parametrize("name", swept(sensors.REGISTRY, "range_bearing", "line"))
@law
@given(carried=poses, pose=poses, offset=points, data=st.data())
def test_observations_are_the_same_in_every_map_frame(name, carried, pose, offset, data):
    """And what is seen of the robot itself moves with the frame."""
    sensor = SENSORS[name]
    landmark = data.draw(drawn(sensor.landmark))
    further = data.draw(drawn(sensor.robot)) if sensor.robot else np.zeros(0)
    there, pose = np.r_[call(se2.compose, carried, pose), further], np.r_[pose, further]
    seen = angular(sensor.measurements)
    if sensor.robot and not sensor.landmark:  # a rate, of no frame
        assert_close(call(sensor.observe, there, landmark), call(sensor.observe, pose, landmark))
        return
    if not sensor.landmark:
        z = call(sensor.observe, pose, landmark)
        expected = {1: lambda: z + carried[2], 2: lambda: call(se2.from_frame, carried, z)}[
            len(z)
        ]()
        assert_close(call(sensor.observe, there, landmark), expected, seen, 1e-8)
        return
    if sensor.carry is None:  # a place
        landmark[:2] = pose[:2] + offset + np.where(np.abs(offset).max() < 2, 3.0, 0.0)
    if "rho [1/m]" in sensor.landmark:  # away from where the line of sight vanishes
        landmark[3] = 0.5 / (1 + np.linalg.norm(offset))
    moved = call(sensor.move_landmark, carried, landmark)
    z = call(sensor.observe, pose, landmark)
    assert_close(call(sensor.observe, there, moved), z, seen, 1e-8)
    s = np.asarray(sensor.free.mean)
    new = call(sensor.move_landmark, carried, call(sensor.invert, pose, z, s))
    assert_close(call(sensor.invert, there, z, s), new, angular(sensor.landmark), 1e-7)
