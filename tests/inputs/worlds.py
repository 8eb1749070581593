"""Small worlds and deliberately wrong filters that several tests share."""

import contextlib
import copy
import dataclasses
import pickle

import jax
import jax.numpy as jnp
import numpy as np
from own_models import changed

from jaxslam import Scenario, filters, linearize, motion, sensors, simulate
from jaxslam.consistency.campaign import monte_carlo
from jaxslam.core.record import record
from jaxslam.core.types import Status
from jaxslam.math.stats import t_quantile


def ring(steps: int = 100, seed: int = 3) -> Scenario:
    """A robot turns twice inside six landmarks; noise so low that an EKF is honest."""
    rng = np.random.default_rng(seed)
    around = 2 * np.pi * np.arange(6) / 6
    radius = 3.0 + rng.uniform(-0.5, 0.5, 6)
    points = np.stack([radius * np.cos(around), 1.0 + radius * np.sin(around)], axis=1)
    return Scenario(
        name="ring",
        motion=motion.Increment(np.diag([0.01, 0.01]) ** 2),
        sensor=sensors.RangeBearing(np.diag([0.05, 0.02]) ** 2, mount=(0.1, -0.05, 0.3)),
        landmarks=points,
        controls=np.tile([0.125, 4 * np.pi / steps], (steps, 1)),
    )


def gyroscope(steps: int = 20) -> Scenario:
    """The ring with odometry whose bias and scale are not known, and wander."""
    there = ring(steps)
    density = np.array([0.05, 0.02, 0.01, 0.01])
    return dataclasses.replace(
        there,
        name="gyroscope",
        motion=motion.BiasedOdometry(motion.NoiseDensity(density)),
        controls=np.tile([0.6, 0.4, 0.2], (steps, 1)),
        pose=(0.0, 0.0, 0.0, 0.05, 1.0),
        pose_cov=np.diag([0.1, 0.1, 0.05, 0.1, 0.05]) ** 2,
    )


def scaled(scale: float, steps: int = 20) -> Scenario:
    """The ring with other noises, mount, map, controls and start: every number times the scale."""
    there = ring(steps)
    return dataclasses.replace(
        there,
        motion=motion.Increment(np.diag([0.01, 0.01]) ** 2 * scale),
        sensor=sensors.RangeBearing(
            np.diag([0.05, 0.02]) ** 2 * scale, mount=(0.1 * scale, -0.05, 0.3)
        ),
        landmarks=np.asarray(there.landmarks) * scale,
        controls=np.asarray(there.controls) * scale,
        pose=(0.1 * scale, 0.2, 0.3),
        pose_cov=np.diag([0.1, 0.1, 0.01]) * scale,
    )


def three_parameters():
    """A world whose landmarks are (x, y, signature)."""
    world = ring(steps=5)
    landmarks = np.concatenate([world.landmarks, np.ones((6, 1))], axis=1)
    sensor = sensors.RangeBearingSignature(np.eye(3) * 0.01)
    return dataclasses.replace(world, sensor=sensor, landmarks=landmarks)


def campaign(scenario, candidates, runs):
    """In blocks of four, on one device, with the bound: by the programs of `test_monte_carlo`, where
    the scenario is the ring of 100 steps."""
    options = {"block": 4, "devices": jax.devices()[:1], "bound": True}
    return monte_carlo(scenario, candidates, runs, key(), **options)


@contextlib.contextmanager
def compilations():
    """How many programs XLA has compiled, or read from the disk, so far: as a function."""
    count = [0]

    def listen(event, seconds, **_):
        count[0] += event == "/jax/core/compile/backend_compile_duration"

    jax.monitoring.register_event_duration_secs_listener(listen)
    yield lambda: count[0]
    jax.monitoring.unregister_event_duration_listener(listen)


@contextlib.contextmanager
def nothing_compiled(traced=()):
    """Within it no program may be compiled, or read from the disk, and nothing put into a list."""
    before = len(traced)
    with compilations() as count:
        yield
        assert (count(), len(traced)) == (0, before)


def ekf(scenario, **options):
    return filters.EkfSlam(scenario.motion, scenario.sensor, len(scenario.landmarks), **options)


@record
class Transposed(linearize.AtEstimate):
    """Returns Fᵀ in place of F."""

    def motion(self, motion, u, point):
        moved, by_pose, noise, memory = super().motion(motion, u, point)
        return moved, by_pose.T, noise, memory


def transposed_motion(scenario):
    """Propagates Fᵀ P F (the slip in the Notes' EKF)."""
    return ekf(scenario, linearize=Transposed())


def process_noise_as_measurement_noise(scenario):
    """Uses Q where R belongs."""
    u = jnp.asarray(scenario.controls[0])
    q = np.asarray(scenario.motion.noise_cov(jnp.zeros(3), u))
    sensor = dataclasses.replace(scenario.sensor, noise_cov=lambda z: jnp.asarray(q, z.dtype))
    return filters.EkfSlam(scenario.motion, sensor, len(scenario.landmarks))


@record
class NoCrossCovariance(filters.Wrapper):
    """Starts a landmark with the right covariance, but uncorrelated with the map."""

    filter: filters.Filter

    def update(self, joint, scan, key):
        after, info = self.filter.update(joint, scan, key)
        size = len(self.landmark)
        born = jnp.repeat(after.alive & ~joint.alive, size)
        mask = jnp.concatenate([jnp.zeros(3, bool), born])
        slot = jnp.concatenate([jnp.full(3, -1), jnp.repeat(jnp.arange(len(joint.alive)), size)])
        foreign = slot[:, None] != slot[None, :]
        cut = (mask[:, None] | mask[None, :]) & foreign
        return after._replace(cov=jnp.where(cut, 0.0, after.cov)), info


def no_cross_covariance(scenario):
    return NoCrossCovariance(ekf(scenario))


def no_wrap(scenario):
    """Subtracts bearings without wrapping the difference."""
    sensor = changed(scenario.sensor, residual=lambda z, z_hat: z - z_hat)
    return filters.EkfSlam(scenario.motion, sensor, len(scenario.landmarks))


@record
class IteratedOnItsPosterior(filters.Wrapper):
    """Feeds each scan three times, the posterior of one pass being the prior of the next."""

    filter: filters.Filter

    def update(self, joint, scan, key):
        joint, info = self.filter.update(joint, scan, key)
        again = lambda _, joint: self.filter.update(joint, scan, key)[0]  # noqa: E731
        return jax.lax.fori_loop(0, 2, again, joint), info


WRONG = {
    "transposed_motion": transposed_motion,
    "process_noise_as_measurement_noise": process_noise_as_measurement_noise,
    "no_cross_covariance": no_cross_covariance,
    "no_wrap": no_wrap,
    "iterated_on_its_posterior": lambda scenario: IteratedOnItsPosterior(ekf(scenario)),
}


def key(seed: int = 0):
    return jax.random.key(seed)


def narrow(tree):
    """The same in float32."""
    return jax.tree.map(
        lambda leaf: leaf.astype(np.float32) if leaf.dtype == np.float64 else leaf, tree
    )


def nameless(log):
    """The log with tags of nobody."""
    return log._replace(scan=log.scan._replace(tag=np.full_like(log.scan.tag, -1)))


def unmatched(scan):
    """The `Info` of a scan that a filter ignores."""
    places, size = scan.z.shape
    return filters.info_of(
        filters.status_of(scan.valid),
        jnp.zeros_like(scan.valid),
        size=0,
        slot=jnp.full(places, -1),
        nis=jnp.zeros(places, scan.z.dtype),
        innovation=jnp.zeros_like(scan.z),
        innovation_cov=jnp.zeros((places, size, size), scan.z.dtype),
        log_likelihood=jnp.zeros((), scan.z.dtype),
        exhausted=jnp.asarray(False),
    )


def draw(scenario, seed=1):
    """A truth and a log of the scenario, in NumPy."""
    return jax.device_get(simulate(scenario, jax.random.key(seed)))


@np.errstate(invalid="ignore")  # of a filter without a map
def judged(truth, estimate, info):
    """What a campaign says of many runs (runs, T, …): {measure: (mean, low, high)}, in NumPy.

    NEES of the pose (3) and of a landmark (2), NIS by its degrees of freedom, and the position's
    error; averaged over each run, with the 95 % interval of the mean over runs.
    """
    truth, estimate, info = jax.tree.map(np.asarray, (truth, estimate, info))
    error = truth.pose - estimate.pose
    error[..., 2] = np.angle(np.exp(1j * error[..., 2]))
    own = np.take_along_axis(truth.landmarks[:, None], np.maximum(estimate.tag, 0)[..., None], 2)
    square = nees(own[..., :2] - estimate.points, estimate.point_covs)
    fused = info.status == Status.FUSED
    each = {
        "nees_pose": np.nanmean(nees(error, estimate.pose_cov), axis=1),
        "nees_landmarks": np.where(estimate.alive, square, 0.0).sum(axis=(1, 2))
        / estimate.alive.sum(axis=(1, 2)),
        "nis_per_dof": np.where(fused, info.nis, 0.0).sum(axis=(1, 2)) / info.dof.sum(axis=(1, 2)),
        "error_position": np.hypot(error[..., 0], error[..., 1]).mean(axis=1),
        "error_landmarks": np.sqrt(
            (
                np.where(estimate.alive, ((own[..., :2] - estimate.points) ** 2).sum(-1), 0.0)[
                    :, -1
                ]
            ).sum(-1)
            / estimate.alive[:, -1].sum(-1)
        ),
    }
    found = {}
    for name, values in each.items():
        half = t_quantile(0.975, len(values) - 1) * values.std(ddof=1) / len(values) ** 0.5
        found[name] = values.mean(), values.mean() - half, values.mean() + half
    return found


def nees(error, cov):
    """eᵀ P⁻¹ e over any leading axes; NaN where P is singular, as at a start with P0 = 0."""
    regular = np.linalg.cond(cov) < 1e12
    cov = np.where(regular[..., None, None], cov, np.eye(cov.shape[-1]))
    square = (error * np.linalg.solve(cov, error[..., None])[..., 0]).sum(axis=-1)
    return np.where(regular, square, np.nan)


def assert_identical(a, b):
    """Two summaries to the last bit, run by run and in their sums."""
    assert (a.counts, a.measures) == (b.counts, b.measures)
    for part in ("per_run", "curves", "coverage"):
        ours, theirs = getattr(a, part), getattr(b, part)
        assert ours.keys() == theirs.keys()
        for name in ours:
            assert ours[name].tobytes() == theirs[name].tobytes(), name


def assert_same_bits(a, b):
    """Two campaigns of the same runs and filters to the last bit."""
    np.testing.assert_array_equal(a.run_numbers, b.run_numbers)
    assert (a.runs, a.divergence_limit, list(a.filters)) == (
        b.runs,
        b.divergence_limit,
        list(b.filters),
    )
    for name, summary in a.filters.items():
        assert_identical(summary, b.filters[name])


def assert_record(made, numbers):
    """Its leaves are these numbers, in order; a copy and a pickle are of the same class and numbers."""
    for one in (made, copy.deepcopy(made), pickle.loads(pickle.dumps(made))):
        assert type(one) is type(made) and jax.tree.structure(one) == jax.tree.structure(made)
        for leaf, number in zip(jax.tree.leaves(one), numbers, strict=True):
            np.testing.assert_array_equal(leaf, number)
