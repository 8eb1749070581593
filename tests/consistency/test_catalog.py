"""The family: what each variant must keep invisible, what it must equal, what it refuses."""

import dataclasses
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import worlds
from cases import refused, swept
from layouts import kept_programs, wrong_layouts

from jaxslam import catalog, charts, linearize, motion, run, sensors, simulate
from jaxslam.core.protocols import Filter, LinearizationPoint
from jaxslam.core.types import Status
from jaxslam.filters import EkfSlam
from jaxslam.graphs.smoothing import BatchMap, Smoother
from jaxslam.simulation.scenarios import SCENARIOS, loop, stationary

KEY = jax.random.key(0)
CURES = ["ideal", "fej", "oc", "right_invariant", "ukf_right"]
VICTIMS = ["ekf", "iterated", "left_invariant", "ukf", "square_root"]
KEPT = "ekf", "fej"
"""Of filters that share their steps one is kept of each kind; the others belong to the sweep."""


def draw(world):
    """A scenario with a truth and a log of it."""
    return world, *worlds.draw(world)


def drive(drawn, name, probe=None, **options):
    """One run of a variant: its trace."""
    world, truth, log = drawn
    candidate = catalog.ALL[name](world, **options)
    filter = candidate
    if not isinstance(candidate, Filter | BatchMap | Smoother):
        filter = candidate(jax.tree.map(jnp.asarray, truth))
    if not isinstance(filter, Filter):  # an estimator of the whole log
        return jax.device_get(filter(log, KEY))
    return jax.device_get(run(filter, log, world.pose, world.pose_cov, KEY, probe=probe))


def test_the_family_is_known_to_these_tests():
    assert sorted(CURES + VICTIMS) == sorted(catalog.FILTERS)


def test_what_draws_instead_of_linearizing_fits_a_scenario_of_bearings():
    """Built and traced, not run: what comes out has the shapes that the harness judges. Scenarios of
    ranges and bearings: below."""
    world = SCENARIOS["loop_bearing"](3)
    truth, log = jax.eval_shape(partial(simulate, world), jax.random.key(0))

    def go(name, truth, log):
        candidate = catalog.ALL[name](world, watch=True)
        filter = candidate if isinstance(candidate, Filter) else candidate(truth)
        return run(filter, log, world.pose, world.pose_cov, KEY)

    for name in catalog.KINDS["particles"]:
        assert_shapes_of_particles(jax.eval_shape(partial(go, name), truth, log), world, 3)


def assert_shapes_of_particles(trace, world, steps):
    assert trace.estimate.pose.shape == (steps, 3)
    assert trace.info.extra["particles"].invalid.shape == (steps,)
    assert trace.estimate.tag.shape == (steps, len(world.landmarks))


# --- one program for a world that is driven through and one that is stood still in -----------------


@cache
def around(noise=1.0):
    """`loop`, with ranges and bearings of eight of its landmarks; with a truth and a log of it."""
    world = loop(80)
    near = np.argsort(np.linalg.norm(world.landmarks, axis=1))[:8]
    return draw(
        dataclasses.replace(
            world,
            motion=motion.Unicycle(np.diag([0.01, 0.03]) ** 2 * noise),
            sensor=sensors.RangeBearing(np.diag([0.1, 0.02]) ** 2 * noise),
            landmarks=world.landmarks[near],
            pose_cov=np.diag([0.01, 0.01, 0.003]) * noise,
        )
    )


@cache
def still():
    """`stationary`, in as many slots, places and steps, so that one program runs both."""
    like, world = around()[0], stationary(80)
    unseen = np.full((7, 2), 1e3)
    return draw(
        dataclasses.replace(
            world,
            landmarks=np.concatenate([world.landmarks, unseen]),
            visible=lambda pose, landmark: landmark[0] < 100,
            places=like.places,
            filter_options=like.filter_options,
        )
    )


def drive_monitored(drawn, name, **options):
    """`drive`, with what it was told of a turn of everything; by default the gate rejects nothing."""
    return drive(drawn, name, monitor_of, **({"gate": 1 - 1e-12, "watch": True} | options))


@cache
def around_and_still(name):
    """Both worlds by one of all filters; how many programs the second took, and where the layouts
    of what was compiled are wrong."""
    moving, standing = around(), still()
    before = kept_programs()
    first = drive_monitored(moving, name)
    with worlds.compilations() as count:
        second = drive_monitored(standing, name, gate=1 - 2e-12)
        return first, second, count(), wrong_layouts(before)


def monitor_of(state):
    return getattr(state, "monitor", ())


@pytest.mark.parametrize("name", swept(catalog.ALL, *KEPT))
def test_other_numbers_run_what_is_there(name):
    first, second, compiled, wrong_layouts = around_and_still(name)
    assert (compiled, wrong_layouts) == (0, [])
    assert np.isfinite(second.estimate.pose).all()
    assert not np.allclose(first.estimate.pose, second.estimate.pose)
    if name in catalog.KINDS["particles"]:
        assert_shapes_of_particles(first, around()[0], 80)
        assert_shapes_of_particles(second, still()[0], 80)


@pytest.mark.sweep
@pytest.mark.parametrize("chart", list(charts.REGISTRY))
def test_with_points_close_together_it_is_the_ekf_of_the_same_chart(chart):
    """Slopes are then derivatives; what stays is the mean's second order, which is of size P."""
    calm = around(noise=0.01)
    options = {"chart": charts.REGISTRY[chart]()}
    first = drive_monitored(calm, "ekf", **options)
    options |= {"linearize": linearize.Unscented(1e-3)}
    fitted = drive_monitored(calm, "ekf", **options)  # by a program of the catalog, where one is
    np.testing.assert_allclose(fitted.estimate.pose, first.estimate.pose, atol=2e-3)
    np.testing.assert_allclose(
        fitted.estimate.pose_cov, first.estimate.pose_cov, rtol=0.02, atol=1e-7
    )
    assert np.abs(fitted.estimate.pose - first.estimate.pose).max() > 1e-9


@pytest.mark.sweep
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_sigma_points_take_a_pose_known_exactly_in_both_precisions(dtype):
    world, truth, log = around(noise=0.01)
    world = dataclasses.replace(world, pose_cov=np.zeros((3, 3)))
    usual = drive_monitored((world, truth, log), "ekf")
    log = jax.tree.map(lambda a: a.astype(dtype) if a.dtype == float else a, log)
    trace = drive_monitored((world, truth, log), "ukf", watch=dtype == np.float64)
    assert trace.estimate.pose.dtype == dtype
    assert np.isfinite(trace.estimate.pose_cov).all()
    np.testing.assert_allclose(trace.estimate.pose, usual.estimate.pose, atol=5e-3)


# --- observability: a turn of everything must stay invisible -------------------------------------


@pytest.mark.parametrize("name", swept(CURES + VICTIMS, *KEPT))
def test_cures_keep_three_directions_unobservable_and_the_others_two(name):
    """Huang et al. 2010: the standard EKF's linearized system has rank deficit 2 instead of 3."""
    trace = around_and_still(name)[0]
    monitor = trace.final.monitor
    scale = np.sqrt(np.asarray(monitor.scale))
    size = np.linalg.eigvalsh(np.asarray(monitor.information) / scale / scale[:, None])
    assert np.all(size[:2] < 1e-15)  # translations
    turn = np.einsum("tij,i,j->t", np.asarray(trace.probe.information), monitor.turn, monitor.turn)
    assert np.all(np.diff(turn) >= 0)
    if name in CURES:
        assert size[2] < 1e-15
        assert turn[-1] < 1e-12
    else:
        assert size[2] > 1e-7
        assert turn[-1] > 1.0  # a standard deviation below 1 rad, out of nothing


def heading_deviation(name):
    """Standard deviation of the heading (T,) on `stationary`."""
    return np.sqrt(around_and_still(name)[1].estimate.pose_cov[:, 2, 2])


@pytest.mark.parametrize("name", swept(CURES, *KEPT))
def test_a_robot_that_stands_still_learns_no_heading(name):
    np.testing.assert_allclose(heading_deviation(name), np.deg2rad(5.0), rtol=1e-6)


@pytest.mark.parametrize("name", swept(VICTIMS, *KEPT))
def test_the_others_do_and_are_mistaken(name):
    """Julier & Uhlmann 2001."""
    assert heading_deviation(name)[-1] < np.deg2rad(4.9)


@pytest.mark.sweep
@pytest.mark.parametrize("name", ["fixed_lag", "fixed_lag_fej"])
def test_a_window_learns_no_heading_with_first_estimates(name):
    """Dong-Si & Mourikis 2011: marginalization at old estimates makes the heading observable."""
    deviation = np.rad2deg(heading_deviation(name))
    if name == "fixed_lag_fej":
        np.testing.assert_allclose(deviation, 5.0, rtol=1e-6)
    else:
        assert deviation[-1] < 4.99


# --- each linearizer does what it says ----------------------------------------------------------


def test_first_estimates_stay_where_they_were():
    trace = around_and_still("fej")[0]
    first = trace.final.state.lin.landmarks
    alive = np.asarray(trace.estimate.alive)
    for slot in np.flatnonzero(alive[-1]):
        born = int(np.argmax(alive[:, slot]))
        np.testing.assert_array_equal(first[slot], trace.estimate.points[born, slot])
        assert np.abs(first[slot] - trace.estimate.points[-1, slot]).max() > 1e-6


def test_linearization_points_solve_the_constrained_least_squares():
    """Against a general solver of min |p* - p̂|² + Σ|l*_i - l̂_i|², l*_i - p* = d_i."""
    world, rng = loop(steps=2), np.random.default_rng(0)
    oc = linearize.Observability()
    init = jax.jit(catalog.FILTERS["oc"](world).init)
    joint = jax.device_get(init(np.array([1.0, 2.0, 0.3]), np.eye(3) * 0.01))
    alive = np.arange(20) < 3
    landmarks = np.where(alive[:, None], rng.normal(size=(20, 2)) * 3, 0.0)
    arms = np.where(alive[:, None], landmarks + rng.normal(size=(20, 2)) * 0.3, 0.0)
    lin = joint.lin._replace(robot=np.array([0.9, 2.2]), landmarks=arms)
    joint = joint._replace(landmarks=landmarks, alive=alive, lin=lin)
    u = np.array([0.25, 0.025, 1.0])
    moved, by_pose, _, after = jax.jit(
        lambda joint: oc.motion(
            world.motion, u, LinearizationPoint(joint, charts.Euclidean(), joint.pose, jnp.eye(3))
        )
    )(joint)
    # Unknown p*; l*_i = p* + d_i: stacked, each coordinate is a mean of p̂ and the l̂_i - d_i.
    d = (arms - np.array([0.9, 2.2]))[alive]
    rows = np.kron(np.ones((4, 1)), np.eye(2))
    target = np.concatenate([[1.0, 2.0], (landmarks[alive] - d).ravel()])
    p_star = np.linalg.lstsq(rows, target, rcond=None)[0]
    step = np.asarray(moved)[:2] - p_star
    np.testing.assert_allclose(np.asarray(by_pose)[:2, 2], [-step[1], step[0]], atol=1e-12)
    np.testing.assert_allclose(after.robot, np.array([0.9, 2.2]) + step, atol=1e-12)


def test_all_variants_have_the_process_noise_of_the_standard_filter():
    world = loop(steps=2)
    u = jnp.array([0.26, 0.02, 1.0])
    noises = []
    for make in (linearize.AtEstimate, linearize.FirstEstimate, linearize.Observability):
        linearizer = make()
        filter = EkfSlam(world.motion, world.sensor, 3, linearize=linearizer)

        def noise(pose, filter=filter, linearizer=linearizer):
            joint = filter.init(pose, jnp.eye(3) * 0.01)
            point = LinearizationPoint(joint, charts.Euclidean(), joint.pose, jnp.eye(3))
            return linearizer.motion(world.motion, u, point)[2]

        noises.append(jax.jit(noise)(np.array([1.0, 2.0, 0.3])))
    np.testing.assert_array_equal(noises[0], noises[1])
    np.testing.assert_array_equal(noises[0], noises[2])


@pytest.mark.sweep
@pytest.mark.parametrize(
    ("name", "options"),
    [("oc", {"covariance": "square_root"}), ("ukf_right", {})],
    ids=["oc and square_root", "ukf_right"],
)
def test_gradients_are_finite_from_a_start_that_is_known_exactly(name, options):
    """By both noises, through predictions, corrections and births, P0 = 0.

    In reverse; sigma points forward, since in reverse they compile for more than a minute. One step,
    which corrects by one landmark and starts the other.
    """
    world = worlds.ring(steps=6)  # drawn by a program of other tests, as are those of 40 steps
    row = jax.tree.map(lambda rows: rows[0], worlds.draw(world)[1])
    row = row._replace(scan=jax.tree.map(lambda places: places[:2], row.scan))
    world = dataclasses.replace(world, landmarks=world.landmarks[:2])
    mapped = np.array([world.landmarks[0] + 0.05, np.zeros(2)])
    root = np.diag([0.0, 0, 0, 0.1, 0.2, 0, 0])

    def cost(sigma, row):
        models = {
            "motion": motion.Increment(jnp.diag(sigma[:2]) ** 2),
            "sensor": sensors.RangeBearing(sigma[2] ** 2 * jnp.eye(2)),
        }
        there = dataclasses.replace(world, **models)
        filter = catalog.FILTERS[name](there, correction="joint", **options)
        joint = filter.init(jnp.asarray(world.pose, float), jnp.zeros((3, 3)))
        lin = joint.lin._replace(landmarks=jnp.asarray(mapped)) if name == "oc" else joint.lin
        joint = joint._replace(
            landmarks=jnp.asarray(mapped),
            cov=jnp.asarray(root if options else root @ root),
            alive=jnp.array([True, False]),
            tag=jnp.array([0, -1], joint.tag.dtype),
            lin=lin,
        )
        joint, info = filter.update(filter.predict(joint, row.control, KEY), row.scan, KEY)
        cost = info.log_likelihood.sum() + filter.estimate(joint).pose_cov.sum()
        return cost + filter.estimate(joint).point_covs.sum(), info.status

    at = np.array([0.01, 0.04, 0.05])
    if name == "ukf_right":
        along = jax.jit(
            lambda way, row: jax.jvp(lambda at: cost(at, row), (at,), (way,), has_aux=True)[1:]
        )
        slopes, (status, *_) = zip(*(along(way, row) for way in np.eye(3)), strict=True)
        slope = np.array(slopes)
    else:
        slope, status = jax.jit(jax.grad(cost, has_aux=True))(at, row)
    np.testing.assert_array_equal(status, [Status.FUSED, Status.BORN])
    assert np.isfinite(slope).all()
    assert np.all(slope != 0)


# --- square root --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "options"),
    swept(
        [
            ("ekf", {}),
            ("right_invariant", {}),
            ("left_invariant", {}),
            ("ekf", {"correction": "sequential", "gate": 0.99, "births": 1}),
        ],
        ("ekf", {}),
    ),
    ids=["joint", "right", "left", "sequential"],
)
def test_the_square_root_filter_is_the_filter(name, options):
    plain = square_root = options  # with the monitor, by programs of the catalog, where there are
    if options:
        plain = square_root = options | {"watch": False}
    elif name != "ekf":
        square_root = {"watch": False}
    plain = drive_monitored(around(), name, covariance="plain", **plain)
    root = drive_monitored(around(), name, covariance="square_root", **square_root)
    for field in ("pose", "pose_cov", "points", "point_covs"):
        ours, theirs = getattr(root.estimate, field), getattr(plain.estimate, field)
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(root.estimate.pose, plain.estimate.pose, atol=1e-12)
    np.testing.assert_allclose(root.info.nis, plain.info.nis, rtol=1e-7, atol=1e-9)
    np.testing.assert_array_equal(root.info.status, plain.info.status)
    root, plain = (getattr(end, "state", end).cov for end in (root.final, plain.final))
    np.testing.assert_allclose(root @ root.T, plain, rtol=1e-9, atol=1e-12)


@pytest.mark.sweep
@pytest.mark.filterwarnings("ignore:run. .*precision decides:UserWarning")
def test_in_float32_the_square_root_survives_what_the_covariance_does_not():
    """Sharp measurements of a vague map: P loses its definiteness to rounding, X cannot."""
    sharp = sensors.RangeBearing(np.diag([1e-4, 1e-4]) ** 2)
    world = dataclasses.replace(worlds.ring(steps=40), sensor=sharp, pose_cov=np.eye(3) * 4.0)
    single = worlds.narrow(worlds.draw(world))
    smallest = {}
    for covariance in ("plain", "square_root"):
        options = {"correction": "joint", "covariance": covariance}
        trace = drive((world, *single), "ekf", lambda state: state.cov, **options)
        cov = trace.probe.astype(float)
        cov = cov @ cov.transpose(0, 2, 1) if covariance == "square_root" else cov
        smallest[covariance] = np.linalg.eigvalsh(cov)[:, 0].min()
    assert smallest["plain"] < 0
    assert smallest["square_root"] > 0


# --- canonical form -----------------------------------------------------------------------------


@pytest.mark.sweep
def test_information_filters_stand_beside_the_family():
    """All active, they are the EKF by other numbers; what they do not know of is left out."""
    plain = around_and_still("ekf")[0]
    for name in ("eif_slam", "seif"):
        assert catalog.ALL[name](worlds.ring(steps=2)).name == name
        trace = around_and_still(name)[0]
        np.testing.assert_allclose(trace.estimate.pose, plain.estimate.pose, atol=1e-8)
        np.testing.assert_allclose(trace.estimate.pose_cov, plain.estimate.pose_cov, atol=1e-8)


# --- refusals -----------------------------------------------------------------------------------


@pytest.mark.parametrize("table", ["FILTERS", "SMOOTHERS", "KINDS", "ALL"])
def test_an_unknown_name_is_told_with_the_names_there_are(table):
    known = getattr(catalog, table)
    name = next(iter(known))
    with pytest.raises(KeyError) as told:
        known[f"{name}f"]
    assert (
        str(told.value)
        == f"expected one of {', '.join(known)}, got '{name}f' (did you mean {name}?)"
    )
    assert f"{name}f" not in known
    assert known.get(f"{name}f") is None


@pytest.mark.parametrize("name", ["fej", "oc", "right_invariant", "left_invariant"])
def test_variants_for_points_refuse_other_landmarks(name):
    with pytest.raises(ValueError, match=r"range_bearing_signature"):
        catalog.FILTERS[name](worlds.three_parameters())


@refused(
    ({"linearize": linearize.FirstEstimate(), "chart": charts.RightInvariant()}, "Euclidean"),
    ({"linearize": linearize.Unscented(), "iterations": 2}, "does not iterate"),
    ({"covariance": "root"}, 'or "joseph" or "square_root", got \'root\''),
)
def test_parts_that_do_not_fit_are_refused(options):
    worlds.ekf(worlds.ring(steps=2), **options)
