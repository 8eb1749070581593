"""Noise that grows with the range: R is that of the predicted measurement, in filters and fits."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special
import scipy.stats
from cases import swept
from reference import ekf_slam as plain

from jaxslam import Scenario, charts, filters, monte_carlo, motion, run, sensors, simulate
from jaxslam.association import MaximumLikelihood, Nearest
from jaxslam.calibration import fit_noise
from jaxslam.consistency._bound import jacobians_at_truth
from jaxslam.core.types import Scan, Status
from jaxslam.graphs.smoothing import BatchMap, FixedLag

KEY = jax.random.key(0)
POINTS = np.array([[3.0, 1.0], [-1.0, 4.0], [-3.0, -1.0], [2.0, -3.0]])
BEARING = 0.02


def sensor(share):
    """σ of the range: 2 cm, and a share of it."""
    return sensors.RangeBearing(sensors.RangeBearingNoise(0.02, BEARING, share=share))


def world(share, steps=60):
    return Scenario(
        name="four",
        motion=motion.Increment(np.diag([0.02, 0.01]) ** 2),
        sensor=sensor(share),
        landmarks=POINTS,
        controls=np.tile([0.1, 0.06], (steps, 1)),
    )


def localization(of, **options):
    return filters.Localization(of.motion, of.sensor, POINTS, **options)


def noise_at(z, share):
    """R by the equation, (2, 2)."""
    return np.diag([0.02**2 + (share * z[0]) ** 2, BEARING**2])


@jax.jit
def updated(filter, state, scan):
    return filter.update(state, scan, KEY)


# --- consistency --------------------------------------------------------------------------------

SHARES = np.array([0.05, 0.1, 0.2])


@functools.cache
def innovations(*names):
    """NIS, degrees of freedom and pose NEES, by filter and share, of 40 runs."""

    def of_run(share, key):
        there = world(share)
        truth, log = simulate(there, key)
        found, some = [], families(there)
        some["fastslam"] = dataclasses.replace(some["fastslam"], particles=64)
        for filter in map(some.get, names):
            trace = run(filter, log, there.pose, there.pose_cov, key)
            off = trace.estimate.pose - truth.pose
            off = off.at[:, 2].set(jnp.arctan2(jnp.sin(off[:, 2]), jnp.cos(off[:, 2])))
            white = jnp.linalg.solve(trace.estimate.pose_cov, off[..., None])[..., 0]
            nees = (off * white).sum(axis=1)[10:].mean()  # P of the first poses is singular
            found.append((trace.info.nis.sum(), trace.info.dof.sum(), nees))
        return jax.tree.map(lambda *leaves: jnp.stack(leaves), *found)

    runs = jax.vmap(jax.vmap(of_run, (None, 0)), (0, None))
    found = jax.jit(runs)(SHARES, jax.random.split(jax.random.key(7), 40))
    return [np.asarray(part).swapaxes(1, 2) for part in found]


@pytest.mark.parametrize("name", ["localization", "ekf"])
@pytest.mark.parametrize("i", range(len(SHARES)))
def test_innovations_are_as_large_as_they_claim(i, name):
    """R at z gives 1.06 and 1.3 in the known map at 10 and 20 %, and a NEES of 20 without it."""
    both = "localization", "ekf"
    nis, dof, nees = (part[i, both.index(name)] for part in innovations(*both))
    assert_right(nis, dof)
    spread = nees.std() / np.sqrt(len(nees))
    assert nees.mean() - 3.5 * spread < 3


def assert_right(nis, dof):
    """NIS of several runs is within its band."""
    assert dof.sum() > 10_000
    assert abs(nis.sum() / dof.sum() - 1) < 3.5 * np.sqrt(2 / dof.sum())


@pytest.mark.sweep
@pytest.mark.parametrize("name", ["seif", "fastslam", "fixed lag"])
def test_innovations_of_other_families_are_as_large_as_they_claim(name):
    for nis, dof in zip(*innovations(name)[:2], strict=True):
        assert_right(nis[0], dof[0])


@pytest.mark.sweep
def test_the_batch_has_residuals_of_the_size_of_the_noise_and_a_map_of_the_right_size():
    """From a known start, at the optimum that `graphs.of_log` has, too."""

    def of_run(share, key):
        there = world(share)
        truth, log = simulate(there, key)
        batch = BatchMap(there.motion, there.sensor, 4, there.pose, there.pose_cov)
        joint = (final := batch(log, key).final).joint
        far, wanted = (
            jnp.linalg.norm(x, axis=1) for x in (joint.landmarks, jnp.asarray(POINTS)[joint.tag])
        )
        return 2 * final.cost, (far / wanted).mean() - 1

    runs = jax.vmap(jax.vmap(of_run, (None, 0)), (0, None))
    chi2, scale = map(np.asarray, jax.jit(runs)(SHARES, jax.random.split(jax.random.key(7), 40)))
    dof = 40 * (2 * 4 * 60 - 2 * 4)
    np.testing.assert_allclose(chi2.sum(axis=1) / dof, 1, atol=3.5 * np.sqrt(2 / dof))
    assert (np.abs(scale.mean(axis=1)) < 3.5 * scale.std(axis=1) / np.sqrt(40)).all()


@pytest.mark.sweep
def test_a_landmark_placed_by_the_noise_of_its_measurement_surprises_the_next_ones():
    """From known poses. In NumPy, over 2,000 runs: 1.19 of the second measurement, with R at the
    true range of the first 1.03; of the seventh to twentieth 1.015, and 1.001 of those after."""
    there = world(0.2)
    filter = filters.Mapping(there.sensor, 4)

    def of_run(key):
        truth, log = simulate(there, key)
        log = log._replace(control=truth.pose)
        info = run(filter, log, there.pose, np.zeros((3, 3)), key).info
        return info.nis.sum(axis=1), info.dof.sum(axis=1)

    keys = jax.random.split(jax.random.key(3), 300)
    nis, dof = (np.asarray(part).sum(axis=0) for part in jax.jit(jax.vmap(of_run))(keys))
    assert dof[0] == 0
    for steps, wanted in ((slice(1, 2), 1.19), (slice(6, 20), 1.015), (slice(20, None), 1.001)):
        total = dof[steps].sum()
        # NIS of the second measurement has a longer tail than χ².
        spread = np.sqrt(2 / total) * (1.5 if wanted > 1.1 else 1.0)
        assert abs(nis[steps].sum() / total - wanted) < 3.5 * spread


@pytest.mark.sweep
@pytest.mark.parametrize("share", SHARES)
def test_the_verdict_is_consistent(share):
    there = world(share, 100)
    slam = filters.EkfSlam(there.motion, there.sensor, 4, chart=charts.RightInvariant())
    candidates = {"known": localization(there), "slam": slam}
    campaign = monte_carlo(there, candidates, runs=100, key=KEY)
    for summary in campaign.filters.values():
        assert summary.verdict == "consistent"
        assert summary.measures["nis_per_dof"].value < 1.02


@pytest.mark.parametrize(
    ("share", "count", "steps"), swept([(0.2, 12, 60), (0.1, 60, 100)], (0.2, 12, 60))
)
def test_the_fit_of_the_share_has_no_bias(share, count, steps):
    """With R at z it finds 0.105 of 0.10 and 0.25 of 0.20."""
    there = world(share, steps)
    keys = jax.random.split(jax.random.key(1), count)
    logs = jax.jit(jax.vmap(lambda key: simulate(there, key)[1]))(keys)

    def info(p, logs):
        filter = filters.Localization(there.motion, sensor(p[0]), POINTS)
        drive = lambda log: run(filter, log, there.pose, there.pose_cov, KEY).info  # noqa: E731
        return jax.vmap(drive)(logs)

    fit = fit_noise(info, np.array([0.15]), logs)
    assert abs(fit.parameters[0] - share) < 3 * fit.error[0]
    assert fit.error[0] < 0.03 * share


@pytest.mark.sweep
@pytest.mark.parametrize("name", ["localization", "right-invariant"])
def test_fits_of_many_logs_scatter_about_the_share(name):
    """The maximum of each log's likelihood, between the shares at which it is evaluated."""
    count, steps = 60, np.linspace(-0.3, 0.3, 13)

    def likelihoods(share, key):
        there = world(share)
        log = simulate(there, key)[1]

        def likelihood(step):
            models = there.motion, sensor(share * jnp.exp(step))
            invariant = filters.EkfSlam(*models, 4, chart=charts.RightInvariant())
            known = filters.Localization(*models, POINTS)
            filter = known if name == "localization" else invariant
            return run(filter, log, there.pose, there.pose_cov, KEY).info.log_likelihood.sum()

        return jax.vmap(likelihood)(steps)

    over_logs = jax.vmap(jax.vmap(likelihoods, (None, 0)), (0, None))
    found = np.asarray(jax.jit(over_logs)(SHARES, jax.random.split(jax.random.key(1), count)))
    best = np.clip(found.argmax(axis=2), 1, len(steps) - 2)
    left, middle, right = (
        np.take_along_axis(found, best[..., None] + k, axis=2)[..., 0] for k in (-1, 0, 1)
    )
    # The parabola through three points of log σ.
    off = steps[best] + 0.5 * (steps[1] - steps[0]) * (left - right) / (left - 2 * middle + right)
    spread = off.std(axis=1) / np.sqrt(count)
    assert (spread < 0.01).all()
    assert (np.abs(off.mean(axis=1)) < 3 * spread).all()


# --- the density of a measurement ---------------------------------------------------------------


def families(there):
    """Filters, whose likelihood of a scan is the density of its measurement."""
    models = there.motion, there.sensor
    return {
        "localization": localization(there),
        "iterated": localization(there, iterations=2),
        "ekf": filters.EkfSlam(*models, 4),
        "joseph": filters.EkfSlam(*models, 4, correction="joint", covariance="joseph"),
        "square root": filters.EkfSlam(*models, 4, covariance="square_root"),
        "eif": filters.EifSlam(*models, 4),
        "seif": filters.Seif(*models, 4, active=4, links=4),
        "fastslam": filters.FastSlam(*models, 4, particles=8),
        "particles": filters.ParticleLocalization(*models, POINTS, particles=8, start="gaussian"),
        "fixed lag": FixedLag(*models, 4, 4, window=2),
    }


@pytest.mark.parametrize(
    "name", swept(families(world(0.2)), "localization", "ekf", "eif", "fastslam", "particles")
)
def test_the_likelihood_is_a_density(name):
    """Its integral over all measurements of a landmark is 1, from the state after some scans."""
    there = world(0.2, 6)
    filter, slot = families(there)[name], 1
    log = simulate(there, KEY)[1]

    # 8 σ of S and more, with steps below the σ of a particle's bearing.
    nodes, sigma = np.linspace(-8.0, 8.0, 129), np.array([1.2, 0.1])
    grid = np.stack(np.meshgrid(*np.outer(sigma, nodes), indexing="ij"), axis=-1)
    z = np.asarray(log.scan.z[-1, slot]) + grid

    def integral(log, z):
        state = run(filter, log, there.pose, 0.01 * jnp.eye(3), KEY).final
        state = filter.predict(state, log.control[0], KEY)
        every = jnp.arange(4, dtype=jnp.int32)

        def density(z):
            scan = Scan(jnp.zeros((4, 2)).at[slot].set(z), every, every == slot)
            return jnp.exp(filter.update(state, scan, KEY)[1].log_likelihood)

        each = jax.lax.map(jax.vmap(density), z)
        return each.sum() * np.prod(sigma * (nodes[1] - nodes[0]))

    assert abs(jax.jit(integral)(log, z) - 1) < 2e-3


def test_a_particle_has_the_weight_of_the_density_at_its_own_prediction():
    """With the log-determinant: particles near the landmark expect less noise than those afar."""
    share, poses = 0.2, np.array([[0.0, 0, 0], [1.5, 0.5, 0.1], [-2.0, -0.7, -0.1], [0.3, 0, 0]])
    there = world(share)
    filter = filters.ParticleLocalization(there.motion, there.sensor, POINTS, 4, least=4)
    state = filter.init(jnp.zeros(3), jnp.zeros((3, 3)))
    state = filter.predict(state, jnp.zeros(2), KEY)._replace(pose=jnp.asarray(poses))
    z = np.array([[3.4, 0.3], [9.0, 9.0], [3.0, 1.7], [0.0, 0.0]])
    tag, valid = np.array([0, 7, 1, -1], np.int32), np.array([True, True, True, False])
    after, info = updated(filter, state, Scan(z, tag, valid))
    wanted = []
    for pose in poses:
        terms = []
        for i in (0, 2):  # of tag 7 there is no landmark
            z_hat = plain.range_bearing(pose, POINTS[tag[i]])[0]
            nu = [z[i, 0] - z_hat[0], plain.wrap(z[i, 1] - z_hat[1])]
            terms.append(scipy.stats.multivariate_normal.logpdf(nu, cov=noise_at(z_hat, share)))
        wanted.append(sum(terms))
    wanted = np.array(wanted)
    np.testing.assert_allclose(
        after.log_weight, wanted - scipy.special.logsumexp(wanted), rtol=1e-12, atol=1e-12
    )
    np.testing.assert_allclose(info.log_likelihood, scipy.special.logsumexp(wanted) - np.log(4))


def test_an_iterated_correction_holds_the_noise_of_the_first_prediction():
    """The iterated EKF of the textbook in NumPy, with R at the prior's ẑ in all three passes."""
    share, pose, cov = 0.2, np.array([0.1, -0.2, 0.3]), np.diag([0.5, 0.4, 0.1]) ** 2
    there, z = world(share), np.array([3.9, -0.1])
    filter = localization(there, iterations=3)
    state = filter.init(jnp.asarray(pose), jnp.asarray(cov))
    scan = Scan(z[None], np.zeros(1, np.int32), np.ones(1, bool))
    after, info = updated(filter, state, scan)
    x, noise = pose, None
    for _ in range(3):
        z_hat, by_pose, _ = plain.range_bearing(x, POINTS[0])
        noise = noise_at(z_hat, share) if noise is None else noise
        s = by_pose @ cov @ by_pose.T + noise
        gain = cov @ by_pose.T @ np.linalg.inv(s)
        nu = np.array([z[0] - z_hat[0], plain.wrap(z[1] - z_hat[1])])
        x = pose + gain @ (nu - by_pose @ (pose - x))
    np.testing.assert_allclose(after.pose, x, rtol=1e-10)
    np.testing.assert_allclose(after.cov, cov - gain @ s @ gain.T, atol=1e-12)
    z_hat, by_pose, _ = plain.range_bearing(pose, POINTS[0])
    wanted = by_pose @ cov @ by_pose.T + noise_at(z_hat, share)
    np.testing.assert_allclose(info.innovation_cov[0], wanted, rtol=1e-10)


@pytest.mark.parametrize("rule", [Nearest, MaximumLikelihood])
def test_association_expects_the_noise_of_each_landmark(rule):
    """A range of 5.5 m is 4.2 σ beyond a landmark at 3 m, and 2.3 σ before one at 10 m; with the σ
    of 5.5 m for both it would be the first."""
    far = np.array([[3.0, 0.0], [10.0, 0.0]])
    filter = filters.Localization(world(0.2).motion, sensor(0.2), far, associate=rule(0.9997))
    state = filter.init(jnp.zeros(3), jnp.zeros((3, 3)))
    scan = Scan(np.array([[5.5, 0.0]]), np.full(1, -1, np.int32), np.ones(1, bool))
    _, info = updated(filter, state, scan)
    assert info.status == Status.FUSED
    assert info.slot == 1
    np.testing.assert_allclose(info.nis[0], 4.5**2 / noise_at([10.0], 0.2)[0, 0])


# --- where there is nothing to predict ----------------------------------------------------------


@pytest.mark.parametrize("name", swept(families(world(0.2)), "ekf", "particles", "fastslam"))
def test_gradients_are_finite_in_empty_slots_and_at_a_landmark(name):
    """A share alone is no noise at the landmark itself, and the square root has no derivative."""

    def noise(z):
        return jnp.diag(jnp.stack([jnp.square(0.1 * z[0]), 1e-4 + 0 * z[0]]))

    there = dataclasses.replace(world(0.1, 3), sensor=sensors.RangeBearing(noise))
    at = np.concatenate([POINTS[:3], [[0.1, 0.0]]])  # where the first control leads
    z = np.array([[3.0, 0.3], [0.0, 0.0], [0.0, 0.0], [0.0, 0.0]])
    valid = np.array([True, False, False, True])
    scan = Scan(*map(jnp.asarray, (z, np.array([0, -1, -1, 3], np.int32), valid)))
    there = dataclasses.replace(there, landmarks=at)
    filter = families(there)[name]
    if hasattr(filter, "landmarks"):
        filter = dataclasses.replace(filter, landmarks=at)

    def end(pose):
        state = filter.init(pose, 0.01 * jnp.eye(3))
        for _ in range(2):
            state = filter.predict(state, jnp.array([0.1, 0.0]), KEY)
            state, info = filter.update(state, scan, KEY)
        return filter.estimate(state).pose.sum() + info.log_likelihood

    value, slope = jax.jit(jax.value_and_grad(end))(jnp.zeros(3))
    assert np.isfinite(value)
    assert np.isfinite(slope).all()


def test_a_noise_that_is_no_number_at_the_prediction_is_counted():
    """The square root of a range below 3 m less 3 m: the measurement is singular, and no other."""

    def noise(z):
        return jnp.diag(jnp.stack([jnp.sqrt(z[0] - 3.1), 1e-4 + 0 * z[0]]))

    model = sensors.RangeBearing(noise)
    filter = filters.Localization(world(0.1).motion, model, np.array([[3.0, 0.0], [4.0, 0.0]]))
    state = filter.init(jnp.zeros(3), 0.01 * jnp.eye(3))
    z = np.array([[3.5, 0.0], [4.2, 0.0]])
    scan = Scan(z, np.arange(2, dtype=np.int32), np.ones(2, bool))
    for each in (filter, dataclasses.replace(filter, correction="joint")):
        after, info = updated(each, state, scan)
        assert list(info.status) == [Status.SINGULAR, Status.FUSED]
        assert np.isfinite(after.pose).all()
        assert np.isfinite(after.cov).all()


def test_bounds_take_the_noise_of_the_exact_measurement():
    there = world(0.2, 5)
    truth, log = simulate(there, KEY)
    found = jacobians_at_truth(there, truth, log).sensors[0].noise_cov
    exact = jax.vmap(jax.vmap(there.sensor.observe, (None, 0)), (0, None))(truth.pose, POINTS)
    wanted = [[noise_at(z, 0.2) for z in scan] for scan in np.asarray(exact)]
    np.testing.assert_allclose(found, wanted, rtol=1e-12)
