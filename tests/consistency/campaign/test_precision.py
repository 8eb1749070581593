"""What precision decides is said, and where the map's origin is does not matter."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxslam
from jaxslam import (
    Scenario,
    _origin,
    catalog,
    charts,
    filters,
    motion,
    sensors,
    simulate,
    simulation,
)
from jaxslam.core.protocols import Sensor
from jaxslam.core.record import record
from jaxslam.core.types import Status
from jaxslam.graphs.smoothing import FixedLag

KEY = jax.random.key(0)
UTM = np.array([5e5, 5e6])
POINTS = np.array([[3.0, 2.0], [3.0, -2.0], [-1.0, 3.0], [5.0, 0.5]])


def world_of(sigma, origin=(0.0, 0.0), **changes):
    """Twenty steps among four landmarks, from a start with this σ of x and y."""
    world = Scenario(
        name="four landmarks",
        motion=motion.Increment(np.diag([0.02, 0.01]) ** 2),
        sensor=sensors.RangeBearing(np.diag([0.05, 0.02]) ** 2),
        landmarks=POINTS + origin,
        controls=np.tile([0.1, 0.06], (20, 1)),
        pose=np.array([*origin, 0.0]),
        pose_cov=np.diag([sigma, sigma, 0.0]) ** 2,
    )
    return dataclasses.replace(world, **changes)


NEAR, FAR, VAGUE = world_of(0.1), world_of(0.1, UTM), world_of(30.0)
EKF = filters.EkfSlam(
    NEAR.motion, NEAR.sensor, 4, correction="joint", chart=charts.RightInvariant()
)
ROOT = dataclasses.replace(EKF, chart=charts.Euclidean(), covariance="square_root")


def campaign_of(world, candidates=None, dtype="float32"):
    candidates = candidates or {"ekf": EKF, "root": ROOT}
    options = {"block": 4, "devices": jax.devices()[:1], "dtype": dtype}
    return jaxslam.monte_carlo(world, candidates, 4, KEY, **options)


def test_a_vague_start_in_float32_is_doubted_with_the_numbers_of_both_precisions():
    single, double = (campaign_of(VAGUE, dtype=dtype) for dtype in ("float32", "float64"))
    assert double.filters["ekf"].doubts == double.filters["root"].doubts == ()
    (doubt,) = single.filters["ekf"].doubts
    assert "in float32 and in float64, pose NEES" in doubt
    assert 'set jax_enable_x64, or give the filter covariance="square_root"' in doubt
    assert doubt in " ".join(str(single).split())
    # The number said of float64 is that of the campaign in float64.
    run = int(doubt.split("run ")[1].split()[0])
    said = float(doubt.split("NIS/dof ")[1].split(",")[0].split()[-1])
    np.testing.assert_allclose(said, double.filters["ekf"].per_run["nis_per_dof"][run], rtol=1e-3)
    # The square root holds: every measurement but the first of each landmark is used.
    assert single.filters["root"].doubts == ()
    assert single.filters["root"].counts["fused"] == 4 * (20 - 1) * 4
    for name in ("nees_pose", "nis_per_dof"):
        values = (each.filters["root"].per_run[name] for each in (single, double))
        np.testing.assert_allclose(*values, rtol=0.02)


def families(world):
    """Methods other than EKF-SLAM."""
    models = world.motion, world.sensor
    return {
        "mapping": catalog.ALL["mapping"](world),
        "eif": filters.EifSlam(*models, 4),
        "seif": filters.Seif(*models, 4, active=4, links=4),
        "fixed lag": FixedLag(*models, 4, 4, window=3),
        "fastslam": filters.FastSlam(*models, 4, particles=20),
    }


@pytest.mark.sweep
@pytest.mark.parametrize("origin", [0.0, 5e6])
@pytest.mark.parametrize("name", families(NEAR))
def test_a_start_known_to_a_kilometre_has_the_verdict_of_float64_or_a_doubt(name, origin):
    """The filter of float64 at origin 0; and no advice that a filter cannot follow."""
    near, far = world_of(1000.0), world_of(1000.0, (origin, origin))
    options = {"block": 8, "devices": jax.devices()[:1]}
    double, single = (
        jaxslam.monte_carlo(world, {name: families(world)[name]}, 16, KEY, dtype=dtype, **options)
        for world, dtype in ((near, "float64"), (far, "float32"))
    )
    summary = single.filters[name]
    doubts = [doubt for doubt in summary.doubts if "float32" in doubt]
    assert doubts or summary.verdict == double.filters[name].verdict
    assert not any("square_root" in doubt for doubt in doubts)


@pytest.mark.parametrize(("dtype", "rtol"), [("float32", 1e-5), ("float64", 1e-6)])
def test_a_campaign_does_not_depend_on_where_the_origin_is(dtype, rtol):
    near, far = (campaign_of(world, dtype=dtype) for world in (NEAR, FAR))
    for name in near.filters:
        assert (
            near.filters[name].verdict == far.filters[name].verdict
            and far.filters[name].doubts == ()
        )
        for measure in ("nees_pose", "nis_per_dof", "square_position"):
            values = far.filters[name].per_run[measure], near.filters[name].per_run[measure]
            np.testing.assert_allclose(*values, rtol=rtol)
        (truth, estimate), (truth_0, estimate_0) = far.first[name], near.first[name]
        for ours, theirs in ((truth, truth_0), (estimate, estimate_0)):
            np.testing.assert_allclose(ours.pose[:, :2] - UTM, theirs.pose[:, :2], atol=1e-5)
        np.testing.assert_allclose(truth.landmarks, POINTS + UTM, rtol=1e-12)
        np.testing.assert_allclose(estimate.points[-1] - UTM, estimate_0.points[-1], atol=1e-5)


@record
class Own(filters.Wrapper):
    """A filter of a user's class."""

    filter: filters.Filter


@record
class Drawn(Own):
    """Adds random numbers, which are others in float64."""

    def predict(self, state, u, key):
        state = self.filter.predict(state, u, key)
        noise = 0.01 * jax.random.normal(key, (3,), state.pose.dtype)
        return state._replace(pose=state.pose + noise)


@record
class Rounded(Own):
    """Rounds poses as those a hundred kilometres away are."""

    def estimate(self, state):
        estimate = self.filter.estimate(state)
        unit = 1e5 * jnp.finfo(estimate.pose.dtype).eps
        return estimate._replace(pose=unit * jnp.round(estimate.pose / unit))


@record
class Single(Own):
    """Computes in float32 alone."""

    def init(self, pose, pose_cov):
        return self.filter.init(pose.astype(jnp.float32), pose_cov.astype(jnp.float32))


def test_a_users_filter_is_compared_where_it_can_be_and_its_world_stays_where_it_is():
    reckoning = filters.DeadReckoning(NEAR.motion, NEAR.sensor)
    kinds = {"drawn": Drawn, "rounded": Rounded, "single": Single}
    of = {name: kind(reckoning) for name, kind in kinds.items()}
    near = campaign_of(NEAR, of)
    doubts = {name: summary.doubts[1:] for name, summary in near.filters.items()}
    assert all("takes none of" in s.doubts[0] for s in near.filters.values())
    assert doubts["drawn"] == doubts["single"] == ()
    assert "in float32 and in float64, pose NEES" in doubts["rounded"][0]
    far = campaign_of(FAR, {"own": Own(reckoning), "reckoning": reckoning})
    for summary in far.filters.values():
        assert "coordinates up to 5e+06 m are rounded by 0.6 m in float32" in summary.doubts[-1]


@record
class Beacon(Sensor):
    """The range to a fixed place of the map."""

    noise_cov: object
    measurements = ("range [m]",)
    landmark = ()

    def observe(self, pose, landmark):
        return jnp.hypot(pose[:1] - UTM[0], pose[1:2] - UTM[1] - 3.0)

    def invert(self, pose, z, s):
        return jnp.zeros(0, pose.dtype)

    def position(self, landmark):
        return jnp.zeros(2, landmark.dtype)


def test_what_depends_on_its_place_is_not_moved():
    seen_from_anywhere = simulation.scenarios.BetweenRanges(0.0, np.inf)
    worlds = {
        "relative": (dataclasses.replace(FAR, visible=seen_from_anywhere), True),
        "in sight north of a line": (dataclasses.replace(FAR, visible=north), False),
    }
    models = {"compass": sensors.Compass, "fix": sensors.PositionFix, "beacon": Beacon}
    of_models = {
        name: (filters.EkfSlam(FAR.motion, model(np.eye(2 if name == "fix" else 1)), 1), moves)
        for (name, model), moves in zip(models.items(), (True, False, False), strict=True)
    }
    state = EKF.init(jnp.asarray(FAR.pose), jnp.asarray(FAR.pose_cov))
    others = {
        "a user's class": (Own(EKF), False),
        "a state": (filters.StartingAt(EKF, state), False),
    }
    for name, (what, moves) in (worlds | of_models | others).items():
        assert (_origin.move_near_origin(what, UTM) is not None) == moves, name
    known = filters.Localization(FAR.motion, FAR.sensor, FAR.landmarks)
    np.testing.assert_allclose(_origin.move_near_origin(known, UTM).landmarks, POINTS, atol=1e-8)


def north(pose, landmark):
    return landmark[1] > UTM[1]


def nees(truth, trace):
    error = np.asarray(truth.pose) - np.asarray(trace.estimate.pose)
    weights = np.linalg.inv(np.asarray(trace.estimate.pose_cov, np.float64))
    return np.einsum("ti,tij,tj->t", error, weights, error)[1:].mean()


def test_simulate_and_run_in_float32_do_not_depend_on_where_the_origin_is():
    with jax.enable_x64(False):
        found = []
        for world in (NEAR, FAR):
            truth, log = simulate(world, KEY)
            assert log.scan.z.dtype == np.float32
            trace = jaxslam.run(EKF, log, world.pose, world.pose_cov, KEY)
            found.append((nees(truth, trace), float(trace.info.nis.sum()), trace, truth))
    (nees_0, nis_0, _, _), (nees_far, nis_far, trace, truth) = found
    np.testing.assert_allclose([nees_far, nis_far], [nees_0, nis_0], rtol=1e-3)
    assert trace.estimate.pose.dtype == truth.pose.dtype == np.float64
    assert np.abs(trace.estimate.pose[:, :2] - UTM).max() < 10
    np.testing.assert_allclose(trace.estimate.points[-1] - UTM, POINTS, atol=0.5)
    assert np.abs(trace.final.pose[:2]).max() < 10  # relative to the start


def test_a_run_that_precision_decides_warns_with_numbers_and_one_within_a_trace_does_not():
    vague = world_of(100.0)
    _, log = simulate(vague, KEY)
    log = jax.tree.map(lambda leaf: leaf.astype("f4") if leaf.dtype == float else leaf, log)
    start = vague.pose, vague.pose_cov
    with pytest.warns(UserWarning, match=r"ekf_slam: precision decides: in float32 .* 76 measure"):
        trace = jaxslam.run(EKF, log, *start, KEY)
    assert trace.estimate.pose.dtype == np.float32
    used = jax.jit(lambda log: jaxslam.run(EKF, log, *start, KEY).info.tally(Status.FUSED))(log)
    assert used.sum() < 76
    # The square root holds, and nothing is said.
    assert jaxslam.run(ROOT, log, *start, KEY).info.tally(Status.FUSED).sum() == 76
    # Far away, with a probe, it is not moved.
    with pytest.warns(UserWarning, match="coordinates up to 5e\\+06 m are rounded by 0.6 m"):
        jaxslam.run(EKF, log, FAR.pose, FAR.pose_cov, KEY, probe=lambda state: state.pose)


def test_in_float64_the_size_of_rounding_is_the_doubt():
    campaign = campaign_of(world_of(1e6), dtype="float64")
    assert (
        "variances up to 1e+12 m² are rounded by 0.00022 m² in float64"
        in campaign.filters["ekf"].doubts[-1]
    )
    assert not any("float64" in doubt for doubt in campaign.filters["root"].doubts)
    world = world_of(1e6)
    _, log = simulate(world, KEY)
    with pytest.warns(UserWarning, match="variances up to 1e\\+12 m² are rounded"):
        jaxslam.run(EKF, log, world.pose, world.pose_cov, KEY)
