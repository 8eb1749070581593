"""Laws that hold for whatever numbers: angles, SE(2), errors, and a change of map frame."""

import functools

import hypothesis.strategies as st
import jax
import numpy as np
import pytest
from hypothesis import given, settings

from jaxslam import charts, motion, se2, sensors
from jaxslam.math import angles
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
many_turns = number(-1e4, 1e4)


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


# --- angles -------------------------------------------------------------------------------------


@law
@given(many_turns, st.integers(-1000, 1000))
def test_wrap_is_periodic_and_idempotent(angle, turns):
    once = call(angles.wrap, angle)
    assert -np.pi < once <= np.pi
    assert call(angles.wrap, once) == once
    assert_close([call(angles.wrap, angle + 2 * np.pi * turns)], [once], angular=[0])
    assert_close([once], [angle], angular=[0])


@law
@given(many_turns, many_turns)
def test_wrap_is_additive_on_the_circle(a, b):
    inside = call(angles.wrap, call(angles.wrap, a) + call(angles.wrap, b))
    assert_close([inside], [call(angles.wrap, a + b)], angular=[0])


@law
@given(number(-50, 50))
def test_sinc_is_even_and_its_slope_odd(x):
    assert call(angles.sinc, x) == call(angles.sinc, -x)
    assert call(angles.sinc_slope, x) == -call(angles.sinc_slope, -x)
    assert abs(call(angles.sinc, x) * x - np.sin(x)) < 1e-14
    assert abs(call(angles.sinc_slope, x) * x + call(angles.sinc, x) - np.cos(x)) < 1e-14


# --- SE(2) --------------------------------------------------------------------------------------


@functools.cache
def in_one(law):
    """A law's functions as one program, in NumPy."""
    program = jax.jit(law)
    return lambda *arguments: jax.device_get(program(*arguments))


def group(a, b, c):
    compose, nothing = se2.compose, np.zeros(3)
    return {
        "a(bc)": compose(a, compose(b, c)),
        "(ab)c": compose(compose(a, b), c),
        "a·1": compose(a, nothing),
        "1·a": compose(nothing, a),
        "a a⁻¹": compose(a, se2.inverse(a)),
        "a⁻¹a": compose(se2.inverse(a), a),
        "a(a⁻¹b)": compose(a, se2.between(a, b)),
    }


@law
@given(poses, poses, poses)
def test_se2_is_a_group(a, b, c):
    found = in_one(group)(a, b, c)
    assert_same_pose(found["(ab)c"], found["a(bc)"])
    for name, expected in (
        *(("a·1", a), ("1·a", a), ("a(a⁻¹b)", b)),
        *(("a a⁻¹", np.zeros(3)), ("a⁻¹a", np.zeros(3))),
    ):
        assert_same_pose(found[name], expected)


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


def frames(frame, point):
    return (
        se2.to_frame(frame, se2.from_frame(frame, point)),
        se2.from_frame(frame, se2.to_frame(frame, point)),
        se2.rectangular(se2.polar(point)),
    )


@law
@given(poses, points)
def test_frames_and_polar_coordinates_undo_each_other(frame, point):
    for back in in_one(frames)(frame, point):
        assert_close(back, point)


def carried_and_found(carried, cloud):
    return se2.align(cloud, jax.vmap(se2.from_frame, (None, 0))(carried, cloud))


@law
@given(poses, st.lists(points, min_size=2, max_size=2))
def test_align_finds_the_motion(carried, pair):
    cloud = np.array([*pair, pair[0] + [3.0, 0.0], pair[0] + [0.0, 4.0]])
    assert_same_pose(in_one(carried_and_found)(carried, cloud), carried, 1e-8)


# --- ⊞ and ⊖ on every type ------------------------------------------------------------------------


@pytest.mark.parametrize("name", charts.REGISTRY)
@law
@given(pose=poses, other=poses, point=points, other_point=points, dx=twists, dl=points)
def test_charts_undo_themselves(name, pose, other, point, other_point, dx, dl):
    chart = CHARTS[name]
    moved = compiled(chart.retract)(pose, point, dx, dl)
    back, back_l = compiled(chart.local)(pose, point, *moved)
    assert_close(back, dx, atol=1e-8)
    assert_close(back_l, dl, atol=1e-8)
    error = compiled(chart.local)(pose, point, other, other_point)
    there, there_l = compiled(chart.retract)(pose, point, *error)
    assert_same_pose(there, other, 1e-7)
    assert_close(there_l, other_point, atol=1e-7)


CHARTS = {name: make() for name, make in charts.REGISTRY.items()}
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


@pytest.mark.parametrize("name", sensors.REGISTRY)
@law
@given(data=st.data())
def test_residual_takes_back_what_was_added(name, data):
    sensor = SENSORS[name]
    z, d = (data.draw(drawn(sensor.measurements, scale)) for scale in (1.0, 0.99))
    assert_close(call(sensor.residual, z + d, z), d)


# --- a change of map frame --------------------------------------------------------------------------


@pytest.mark.parametrize("name", motion.REGISTRY)
@law
@given(carried=poses, pose=poses, data=st.data())
def test_motion_is_the_same_in_every_map_frame(name, carried, pose, data):
    model = MOTIONS[name]
    u, w = data.draw(drawn(model.controls)), data.draw(drawn(model.noises, 0.1))
    moved = call(model.step, call(se2.compose, carried, pose), u, w)
    assert_same_pose(moved, call(se2.compose, carried, call(model.step, pose, u, w)), 1e-8)


@pytest.mark.parametrize("name", sensors.REGISTRY)
@law
@given(carried=poses, pose=poses, offset=points, data=st.data())
def test_observations_are_the_same_in_every_map_frame(name, carried, pose, offset, data):
    """And what is seen of the robot itself moves with the frame."""
    sensor = SENSORS[name]
    landmark = data.draw(drawn(sensor.landmark))
    there = call(se2.compose, carried, pose)
    seen = angular(sensor.measurements)
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
    moved = call(sensor.carried, carried, landmark)
    z = call(sensor.observe, pose, landmark)
    assert_close(call(sensor.observe, there, moved), z, seen, 1e-8)
    s = np.asarray(sensor.free.mean)
    new = call(sensor.carried, carried, call(sensor.invert, pose, z, s))
    assert_close(call(sensor.invert, there, z, s), new, angular(sensor.landmark), 1e-7)
