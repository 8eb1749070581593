"""Records: what is a leaf, what JAX and the standard library make of them, what is refused."""

import copy
import dataclasses
import pickle
from pathlib import Path

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import worlds
from cases import refused, swept
from layouts import kept_programs, wrong_layouts
from own_models import motion_of, sensor_of

import jaxslam
from jaxslam import World, catalog, filters, linearize, motion, run, sensors, simulate, smoothing
from jaxslam.core._record import is_record
from jaxslam.core.protocols import Filter, Motion
from jaxslam.core.record import field, function_of, record, static
from jaxslam.core.types import Log, Scan, Status
from jaxslam.core.validation import (
    InvalidField,
    InvalidFile,
    at_least,
    finite,
    is_concrete,
    not_negative,
    one_of,
    or_none,
    positive,
    refusals_of,
    require,
)
from jaxslam.motion import OdometryNoise

KEY = jax.random.key(0)
R = np.diag([0.04, 0.01])
MOUNT = np.array([0.3, 0.0, 0.1])


@record
class Pair:
    """Two fields of data, and one of the program."""

    first: object
    second: object = None
    count: object = static(default=1)


def test_numbers_are_leaves_and_static_fields_are_structure():
    assert jax.tree.leaves(Pair(2.0, (np.ones(3), Pair(1))))[0] == 2.0
    assert len(jax.tree.leaves(Pair(2.0, (np.ones(3), Pair(1))))) == 3
    assert jax.tree.structure(Pair(2.0)) == jax.tree.structure(Pair(3.0))
    assert jax.tree.structure(Pair(2.0)) != jax.tree.structure(Pair(2.0, 1.0))
    assert jax.tree.structure(Pair(2.0)) != jax.tree.structure(Pair(2.0, count=2))
    paths = [
        jax.tree_util.keystr(path) for path, _ in jax.tree.leaves_with_path(Pair(Pair(1.0), 2))
    ]
    assert paths == [".first.first", ".second"]
    assert is_record(Pair(1)) and not is_record(np.ones(2)) and not is_record(lambda z: z)


def test_models_of_the_package_hold_their_numbers_as_leaves():
    suite = sensors.Suite(
        [(sensors.RangeBearing(R, MOUNT), 2), sensors.Part(sensors.Compass([[0.1]]), 1)]
    )
    assert [np.shape(leaf) for leaf in jax.tree.leaves(suite)] == [(2, 2), (3,), (1, 1)]
    drive = motion.Odometry(OdometryNoise((0.1, 0.2, 0.3, 0.4)))
    np.testing.assert_array_equal(jax.tree.leaves(drive), [[0.1, 0.2, 0.3, 0.4]])
    assert jax.tree.leaves(sensors.RangeBearing(lambda z: jnp.eye(2))) == []


def test_what_transformations_return_is_of_the_class():
    sensor = sensors.RangeBearing(R, MOUNT)
    slope = jax.grad(lambda s: jnp.sum(s.observe(jnp.zeros(3), jnp.ones(2)) ** 2))(sensor)
    assert type(slope) is sensors.RangeBearing
    # Of a range alone, 2 r ∂r/∂mount = -2 (l - mount), by hand; the bearing is atan2(1, 0.7) - 0.1.
    away, bearing = np.array([0.7, 1.0]), np.arctan2(1, 0.7) - 0.1
    by_mount = -2 * away + 2 * bearing * np.array([away[1], -away[0]]) / (away @ away)
    np.testing.assert_allclose(slope.mount, [*by_mount, -2 * bearing])
    many = jax.vmap(lambda scale: jax.tree.map(lambda leaf: scale * leaf, sensor))(jnp.arange(3.0))
    assert type(many) is sensors.RangeBearing and many.mount.shape == (3, 3)
    noises = jax.jit(jax.vmap(lambda s: s.noise_cov(jnp.zeros(2))))(many)
    np.testing.assert_allclose(noises, np.arange(3.0)[:, None, None] * R)


def test_copies_and_pickles_have_the_structure_and_the_numbers():
    sensor = sensors.BearingInverseDepth([[0.01]], MOUNT, to_point=0.1)
    changed = dataclasses.replace(sensor, mount=2 * MOUNT)
    worlds.assert_record(sensor, jax.tree.leaves(sensor))
    assert jax.tree.structure(changed) == jax.tree.structure(sensor)
    np.testing.assert_array_equal(changed.noise_cov(jnp.zeros(1)), [[0.01]])
    np.testing.assert_array_equal(changed.mount, 2 * MOUNT)
    assert repr(Pair(1.0, count=3)) == "Pair(first=1.0, second=None, count=3)"
    with pytest.raises(dataclasses.FrozenInstanceError):
        sensor.mount = MOUNT


class Bare(Motion):
    """A motion model that is no record."""

    controls = noises = ("dx [m]",)

    def step(self, pose, u, w):
        return pose

    def noise_cov(self, pose, u):
        return jnp.eye(1)


class Later(sensors.RangeBearing):
    """A class of a record that is none."""


@record
class Still(World):
    """A world that draws nothing."""


@record
class OfMeasurements(linearize.AtEstimate):
    """A linearizer whose new landmarks are functions of measurements alone."""

    def invert(self, z):
        return z


@refused(
    (lambda: Pair("near"), "Pair: first: expected a number, an array or a record .* got 'near'"),
    (lambda: Pair([1.0, 2.0]), "Pair: first: expected an array, as of numpy.asarray, got a list"),
    (lambda: Pair((1.0, jnp.sin)), r"Pair: first\[1\]: expected a number, .* static\(\) field"),
    (lambda: Pair(np.array(["a"])), "Pair: first: expected a number, .* got an ndarray"),
    (lambda: Pair(1, count=R), "Pair: count: expected a value that is compared by ==, got an"),
    (lambda: sensors.RangeBearing(np.eye(3)), r"RangeBearing: noise_cov: .* \(2, 2\), got \(3, 3\)"),
    (lambda: sensors.RangeBearing(-R), "RangeBearing: noise_cov: .* not positive semi-definite"),
    (lambda: sensors.RangeBearing("R"), "RangeBearing: noise_cov: expected a covariance"),
    (lambda: motion.Unicycle(None), "Unicycle: noise_cov: expected a covariance .* got None"),
    (lambda: sensors.RangeBearing(R, MOUNT[:2]), r"RangeBearing: .* of shape \(3,\), got \(2,\)"),
    (lambda: sensors.RangeBearing(R, np.nan * MOUNT), "RangeBearing: .* not finite"),
    (lambda: sensor_of(noise_cov=R, measurements=("x [m]",)), "Own: observe: expected a method, got none"),
    (lambda: motion_of(step=min, controls=("x",), noises="w"), "Own: noises: expected a tuple of names .* got 'w'"),
    (lambda: sensors.Suite(sensors.RangeBearing(R)), "Suite: parts: expected a list or a tuple, got a Ra"),
    (lambda: sensors.Suite([sensors.RangeBearing(R)]), "Suite: parts: expected a Part or .* got a RangeB"),
    (Bare, "Bare: expected @record above the class"),
    (lambda: Later(R), "Later: expected @record above the class"),
    (Still, "Still: draw: expected a method, got none"),
    (OfMeasurements, r"OfMeasurements: invert: expected a method of \(sensor, z, tag, point\), got one of \(z\)"),
    told="^",
)  # fmt: skip
def test_bad_input_is_one_line_that_names_the_class(make):
    make()


@record
class Checked:
    """A record whose checks stand beside its fields."""

    width: object = field(check=positive)
    count: object = static(default=1, check=at_least(1))
    mount: object = field(default=None, check=or_none(finite(3)))
    rule: object = field(default=None, check=or_none(function_of("z", "tag")))
    kind: object = static(default="plain", check=one_of("plain", "robust"))
    spread: object = field(default=0.0, check=not_negative)

    def __post_init__(self):
        if is_concrete(self.width) and self.count > self.width:  # numbers, by their checks
            raise InvalidField("", "expected count <= width")


@record
class Below(Checked):
    """A record that declares a field again, with another default."""

    width: object = 7.0
    extra: object = None

    def __post_init__(self):
        super().__post_init__()
        if self.extra == 3:
            raise InvalidField("extra", "expected no 3")


@pytest.mark.parametrize(
    ("make", "owner", "name", "reason"),
    [
        (lambda: Checked(-1.0), "Checked", "width", "expected a number above 0, got -1.0"),
        (lambda: Checked("a"), "Checked", "width", "expected a number above 0, got 'a'"),
        (lambda: Checked(None), "Checked", "width", "expected a number above 0, got None"),
        (lambda: Checked(R), "Checked", "width", "expected a number above 0, got an array of shape (2, 2)"),
        (lambda: Checked(2.0, True), "Checked", "count", "expected an integer >= 1, got True"),
        (lambda: Checked(2.0, R), "Checked", "count", "expected a value that is compared by ==, got an array"),
        (lambda: Checked(2.0, mount=(1, 2)), "Checked", "mount", "expected finite numbers of shape (3,), got a tuple of shape (2,)"),
        (lambda: Checked(2.0, mount=(1, 2, np.inf)), "Checked", "mount", "expected finite numbers of shape (3,), got [ 1. 2. inf]"),
        (lambda: Checked(2.0, rule=lambda z: z), "Checked", "rule", "expected a function of (z, tag), got one of (z)"),
        (lambda: Checked(2.0, rule=Pair), "Checked", "rule", "expected a function of (z, tag), got the class Pair: call it, Pair(…)"),
        (lambda: Checked(2.0, kind=R[0]), "Checked", "kind", "expected a value that is compared by ==, got an array"),
        (lambda: Checked(2.0, kind=0), "Checked", "kind", 'expected "plain" or "robust", got 0'),
        (lambda: Checked(2.0, spread=-1), "Checked", "spread", "expected a finite number >= 0, got -1"),
        (lambda: Checked(2.0, spread=np.inf), "Checked", "spread", "expected a finite number >= 0, got inf"),
        (lambda: Checked(2.0, spread=R[0]), "Checked", "spread", "expected a finite number >= 0, got an array of shape (2,)"),
        (lambda: Checked(2.0, 3), "Checked", "", "expected count <= width"),
        (lambda: Below(-1.0), "Below", "width", "expected a number above 0, got -1.0"),
        (lambda: Below(extra=3), "Below", "extra", "expected no 3"),
        (lambda: dataclasses.replace(Below(), count=0), "Below", "count", "expected an integer >= 1, got 0"),
        (lambda: filters.Wrapper(sensors.Compass([[1.0]])), "Wrapper", "filter", "expected a Filter, got a Compass"),
        (lambda: filters.Wrapper(filters.EkfSlam), "Wrapper", "filter", "expected a Filter, got the class EkfSlam: call it, EkfSlam(…)"),
    ],
)  # fmt: skip
def test_a_refusal_says_owner_field_and_reason(make, owner, name, reason):
    with pytest.raises(InvalidField) as caught:
        make()
    error = caught.value
    assert (error.owner, error.field, error.reason) == (owner, name, reason)
    assert str(error) == ": ".join(part for part in (owner, name, reason) if part)
    assert str(pickle.loads(pickle.dumps(error))) == str(error)


def test_a_check_converts_and_is_not_run_where_jax_rebuilds():
    made = Checked(2.0, mount=[1, 2, 3], rule=lambda z, tag: z, spread=1)
    assert type(made.spread) is int
    assert made.mount.dtype == np.float64 and is_record(made.rule) and made.rule(1, 2) == 1
    again = dataclasses.replace(made, width=3.0)
    assert again.mount is made.mount and again.rule is made.rule
    assert jax.tree.map(lambda leaf: -leaf, made).width == -2.0
    assert jax.jit(lambda width: Checked(width, count=1).width)(2.0) == 2.0


def test_a_function_owns_what_its_checks_refuse():
    """Of nested ones the inner; a record within keeps its own, and no frame is added."""

    def length(value):
        require("length", value, positive)

    for value, owner, name in ((Checked, "Checked", "width"), (length, "inner", "of.length")):
        with pytest.raises(InvalidField) as caught, refusals_of("outer"), refusals_of("inner"):
            require("of", -1.0, value)
        assert (caught.value.owner, caught.value.field) == (owner, name)
        assert str(pickle.loads(pickle.dumps(caught.value))).startswith(f"{owner}: {name}: ")
        files = [Path(str(entry.path)) for entry in caught.traceback]
        assert files[0] == Path(__file__) and "contextlib.py" not in {file.name for file in files}
    with pytest.raises(ValueError, match=r"^plain$"), refusals_of("outer"):
        raise ValueError("plain")


def test_an_error_of_a_file_says_the_place():
    error = InvalidFile("log.csv", "expected a number, got 'x'", 3, "v [m/s]")
    assert (error.path, error.line, error.column) == ("log.csv", 3, "v [m/s]")
    assert str(pickle.loads(pickle.dumps(error))) == (
        "log.csv:3: v [m/s]: expected a number, got 'x'"
    )
    assert str(InvalidFile("log.csv", "cannot be read")) == "log.csv: cannot be read"


def test_a_missing_field_is_named():
    with pytest.raises(TypeError, match=r"^RangeBearing.__init__\(\) missing .* 'noise_cov'$"):
        sensors.RangeBearing()


def test_placeholders_and_tracers_do_not_raise():
    for model in (sensors.RangeBearing(R, MOUNT), motion.Odometry(OdometryNoise((1, 2, 3, 4)))):
        leaves, structure = jax.tree.flatten(model)
        for filler in (object(), None, np.zeros(7), jax.ShapeDtypeStruct((2,), "f4")):
            made = jax.tree.unflatten(structure, [filler] * len(leaves))
            assert type(made) is type(model)
    both = jax.jit(lambda cov, mount: sensors.RangeBearing(cov, mount).frame(mount))(-R, MOUNT)
    assert both.shape == (3,)


TRACED = []


@record
class Counted(motion.Increment):
    """A motion model that counts how often it is traced."""

    def step(self, pose, u, w):
        TRACED.append(1)
        return super().step(pose, u, w)


def standing(steps=3):
    """The log of a robot that stands at the origin and measures six landmarks around it."""
    rng, around = np.random.default_rng(0), np.linspace(-2.5, 2.5, 6)
    z = np.stack([3.0 + 0.1 * around, around], axis=1) + 0.05 * rng.normal(size=(steps, 6, 2))
    tags = np.tile(np.arange(6, dtype=np.int32), (steps, 1))
    return Log(np.zeros((steps, 2)), Scan(z, tags, np.ones((steps, 6), bool)))


LOG, START = standing(), (np.zeros(3), np.diag([0.1, 0.1, 0.01]) ** 2, jax.random.key(0))


def toy_filter(noise=1.0):
    model = Counted(noise * np.diag([0.01, 0.01]) ** 2)
    return filters.EkfSlam(
        model, sensors.RangeBearing(R, MOUNT), 6, gate=1 - 1e-11 * noise, correction="joint"
    )


def driven(filter):
    """Outside a trace, one program for all tests below."""
    return run(filter, LOG, *START)


def likelihood(filter):
    return driven(filter).info.log_likelihood.sum()


@pytest.mark.sweep
def test_the_gradient_of_a_filter_is_one():
    filter = toy_filter()
    slope = jax.jit(jax.grad(likelihood))(filter)
    assert type(slope) is filters.EkfSlam
    assert jax.tree.structure(slope) == jax.tree.structure(filter)
    chex.assert_tree_all_finite(slope)
    step = 1e-4 * R[0, 0] * np.array([[1.0, 0.0], [0.0, 0.0]])
    ends = [
        likelihood(dataclasses.replace(filter, sensor=sensors.RangeBearing(cov, MOUNT)))
        for cov in (R + step, R - step)
    ]
    by_differences = (ends[0] - ends[1]) / (2 * step[0, 0])
    assert by_differences != 0
    np.testing.assert_allclose(slope.sensor.noise_cov.cov[0, 0], by_differences, rtol=1e-6)


def test_a_batch_of_filters_is_the_loop_over_them():
    each = [toy_filter(noise) for noise in (0.5, 1.0, 2.0)]
    stack = jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)
    batched = jax.jit(jax.vmap(run, in_axes=(0, None, None, None, None)))
    many = batched(stack, LOG, *START)
    loop = jax.tree.map(lambda *leaves: np.stack(leaves), *map(driven, each))
    chex.assert_trees_all_close(many, loop, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda one: pickle.loads(pickle.dumps(one))])
def test_a_copy_of_a_filter_gives_the_same(copied):
    filter = toy_filter()
    again = copied(filter)
    assert jax.tree.structure(again) == jax.tree.structure(filter)
    chex.assert_trees_all_equal(driven(again), driven(filter))


def test_other_numbers_cost_no_trace_and_no_program():
    first = driven(toy_filter())
    other = toy_filter(3.0)
    with worlds.nothing_compiled(TRACED):
        second = driven(other)
    assert not np.allclose(first.final.cov, second.final.cov)


@pytest.mark.parametrize("name", catalog.ALL)
def test_filters_of_the_catalog_hold_numbers_alone(name):
    def made():
        return catalog.ALL[name](worlds.ring(3))

    one, other = jax.tree.structure(made()), jax.tree.structure(made())
    assert one == other and hash(one) == hash(other)
    leaves = jax.tree.leaves(made())
    assert leaves and all(np.asarray(leaf).dtype.kind in "biuf" for leaf in leaves)


IN_FLOAT32 = [name for name in catalog.ALL if isinstance(catalog.ALL[name](worlds.ring(3)), Filter)]


@pytest.mark.parametrize("name", swept(IN_FLOAT32, "ekf", "fastslam2", "particle_localization"))
def test_numbers_in_float64_leave_a_run_in_float32(name):
    """As `run` gives them to its program."""
    given = jax.tree.map(np.asarray, catalog.ALL[name](worlds.ring(3))), worlds.narrow(LOG)
    trace = jax.eval_shape(lambda one, log: run(one, log, *START), *given)
    assert {leaf.dtype for leaf in jax.tree.leaves(trace)}.isdisjoint({np.dtype("f8")})


def test_a_stack_needs_vmap():
    stack = jax.tree.map(lambda leaf: jnp.stack([jnp.asarray(leaf)] * 2), toy_filter())
    with pytest.raises(ValueError, match=r"got \(2, 2, 2\): a stack .* goes through jax.vmap"):
        driven(stack)


# --- worlds ----------------------------------------------------------------------------------------


def team(scale=1.0):
    seen = sensors.Suite([(sensors.RangeBearing(R * scale), 2)])
    moving = motion.Increment(np.diag([0.01, 0.02]) * scale)
    robots = [
        jaxslam.filters.multi_robot.team.Robot(moving, seen),
        jaxslam.filters.multi_robot.team.Robot(
            moving, seen, start=((1.0, 0.5, 0.1), np.eye(3) * 0.01)
        ),
    ]
    return jaxslam.TeamWorld(robots, np.ones((2, 2)), np.full((3, 4), 0.1 * scale))


def recorded(scale=1.0):
    world = worlds.scaled(scale, 3)
    truth, log = worlds.draw(world)
    return jaxslam.recorded_world(
        world.motion, world.sensor, [log], truth.pose[None], truth.landmarks
    )


WORLDS = {
    "scenario": lambda scale=1.0: worlds.scaled(scale, 3),
    "faults": lambda scale=1.0: dataclasses.replace(
        worlds.scaled(scale, 3),
        spurious=jaxslam.spurious.Spurious(1.0, 0.1 * scale, 0.1, 0.1, reach=5.0 * scale),
        visible=jaxslam.scenarios.BetweenRanges(0.1, 9.0 * scale),
        filter_options={"correction": "joint", "gate": 0.99},
        published={"ekf": {"nees_pose": 3.0}},
    ),
    "team": team,
    "recorded": recorded,
}


@pytest.mark.parametrize("name", WORLDS)
def test_a_world_of_other_numbers_is_drawn_by_the_same_program(name):
    world = WORLDS[name]()
    leaves = jax.tree.leaves(world)
    assert leaves and all(np.asarray(leaf).dtype.kind in "biuf" for leaf in leaves)
    first = simulate(world, KEY)
    with worlds.nothing_compiled():
        second = simulate(WORLDS[name](1.5), KEY)
        again = simulate(pickle.loads(pickle.dumps(world)), KEY)
    assert not np.allclose(first[1].control, second[1].control) or name in ("scenario", "faults")
    assert not np.allclose(first[0].landmarks, second[0].landmarks) or name == "team"
    chex.assert_trees_all_equal(first, again)


def test_a_gradient_of_a_world_is_a_world():
    world = worlds.scaled(1.0, 3)

    def spread(world):
        return (simulate(world, KEY)[0].pose ** 2).sum()

    by_world = jax.grad(spread, allow_int=True)(world)
    assert type(by_world) is type(world)
    noise, h = world.motion.noise_cov.cov, 1e-9
    more = dataclasses.replace(
        world, motion=dataclasses.replace(world.motion, noise_cov=noise + h * np.eye(2))
    )
    slope = (spread(more) - spread(world)) / h
    np.testing.assert_allclose(np.trace(by_world.motion.noise_cov.cov), slope, rtol=1e-4)
    assert np.isfinite(by_world.controls).all() and np.abs(by_world.controls).max() > 0


@refused(
    (
        {"landmarks": np.zeros((2, 3))},
        r"Scenario: landmarks: expected shape \(N, 2\) with N >= 1, a row of .* each, got \(2, 3\)",
    ),
    (
        {"pose_cov": -np.eye(3)},
        r"Scenario: pose_cov: the covariance is not positive semi-definite \(negative",
    ),
    ({"visible": 3.0}, r"Scenario: visible: expected a function of \(pose, l\), got 3.0"),
    ({"filter_options": {"gate": np.ones(2)}}, "filter_options: gate: expected a value"),
    ({"noise_on": "wheels"}, 'noise_on: expected "robot" or'),
)
def test_a_world_names_what_is_wrong_in_it(change):
    dataclasses.replace(worlds.ring(3), **change)


@pytest.mark.parametrize("value", [{"k": 1}, [1], {1}, (1, [2]), Pair(2.0), (np.ones(2),)])
def test_a_static_field_holds_what_cannot_change_and_has_no_numbers(value):
    @record
    class Choice:
        choice: object = static()

    with pytest.raises(ValueError, match="Choice: choice: expected a"):
        Choice(value)


def test_what_cannot_be_traced_is_told_by_method_and_line():
    @record
    class Branching(filters.Wrapper):
        def predict(self, state, u, key):
            return self.filter.predict(state, u, key) if u[0] > 0 else state

    @record
    class Drawn(jaxslam.Scenario):
        def draw(self, key):
            return 3

    @record
    class Counted(jaxslam.Scenario):
        def draw(self, key):
            return float(jax.random.uniform(key))

    world = worlds.ring(3)
    with pytest.raises(ValueError, match=r"records.py:\d+, in predict, needs the") as error:
        driven(Branching(filters.DeadReckoning(world.motion, world.sensor)))
    assert str(error.value).startswith("run: branching dead_reckoning: ")
    assert "\n" not in str(pickle.loads(pickle.dumps(error.value)))  # as a worker sends it
    fields = {field.name: getattr(world, field.name) for field in dataclasses.fields(world)}
    with pytest.raises(ValueError, match=r"ring: draw: expected \(Truth, Log\), got int"):
        simulate(Drawn(**fields), KEY)
    with pytest.raises(ValueError, match=r"ring: draw: test_records.py:\d+, in draw, needs"):
        simulate(Counted(**fields), KEY)
    assert "\n" not in repr(Drawn(**fields))


# --- programs ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "smooths", swept([False, True], False), ids=["square root, in turn", "smoother"]
)
def test_other_numbers_run_what_is_there(smooths):
    """As test_catalog has it of all that the catalog has, corrected jointly."""

    def trace(scale, seed):
        there = worlds.scaled(scale, steps=4 if smooths else 20)
        _, log = simulate(there, jax.random.key(seed))
        start = there.pose, there.pose_cov
        if smooths:
            return smoothing.Smoother(there.motion, there.sensor, 6, *start)(log, KEY)
        method = catalog.FILTERS["square_root"](there, gate=0.9 * scale)
        return run(method, log, *start, jax.random.key(seed))

    kept = kept_programs()
    first = trace(1.0, 0)
    with worlds.nothing_compiled():
        second = trace(1.07, 1)
    assert wrong_layouts(kept) == []
    assert np.isfinite(np.asarray(second.estimate.pose)).all()
    assert not np.allclose(first.estimate.pose, second.estimate.pose)


@pytest.mark.sweep
def test_a_program_gives_what_the_function_does():
    """The numbers of records are arguments: the same trace as with constants, to rounding."""
    there = worlds.scaled(1.0)
    ekf = worlds.ekf(there, gate=0.95, correction="joint")
    key = jax.random.key(0)
    truth, log = simulate(there, key)
    plain = jax.jit(lambda log: run(ekf, log, there.pose, there.pose_cov, key))(log)
    ours = run(ekf, log, there.pose, there.pose_cov, key)
    chex.assert_trees_all_close(plain, ours, rtol=1e-9, atol=1e-12)
    drawn = jax.jit(lambda key: simulate(there, key))(key)
    chex.assert_trees_all_close(drawn, (truth, log), rtol=1e-9, atol=1e-12)
    none = run(
        worlds.ekf(there, gate=1e-6, correction="joint"), log, there.pose, there.pose_cov, key
    )
    assert int(none.info.tally(Status.REJECTED).sum()) > int(ours.info.tally(Status.REJECTED).sum())
