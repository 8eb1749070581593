"""What a user gets wrong is one line that says what was expected, before anything is traced."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import refused
from own_models import changed, motion_of, sensor_of
from worlds import unmatched

import jaxslam
from jaxslam import (
    association,
    charts,
    filters,
    grids,
    life,
    linearize,
    motion,
    protocols,
    sensors,
    smoothing,
    team,
)
from jaxslam.core._validation import check_models, checked_estimate, state_and_info
from jaxslam.core.protocols import Free
from jaxslam.core.record import record
from jaxslam.core.types import Estimate, Log, Scan
from jaxslam.filters import Closing

MOVE = motion.PoseIncrement(np.diag([1e-4, 1e-4, 1e-6]))
SEES = sensors.RangeBearing(np.diag([1e-2, 1e-4]))
BEARING = sensors.BearingOnly(np.diag([1e-4]))
POINTS = np.array([[1.0, 2.0]])

KINDS = {
    "EkfSlam": lambda m, s, **o: filters.EkfSlam(m, s, 3, **o),
    "Localization": lambda m, s, **o: filters.Localization(m, s, POINTS, **o),
    "ParticleLocalization": lambda m, s, **o: filters.ParticleLocalization(m, s, POINTS, 4, **o),
    "FastSlam": lambda m, s, **o: filters.FastSlam(m, s, 3, 4, **o),
    "EifSlam": lambda m, s, **o: filters.EifSlam(m, s, 3, **o),
    "Seif": lambda m, s, **o: filters.Seif(m, s, 3, active=2, links=2, **o),
    "DelayedSlam": lambda m, s, **o: filters.DelayedSlam(m, s, 3, **o),
    "DeadReckoning": lambda m, s, **o: filters.DeadReckoning(m, s, **o),
    "Smoother": lambda m, s, **o: smoothing.Smoother(m, s, 3, np.zeros(3), np.eye(3), **o),
    "BatchMap": lambda m, s, **o: smoothing.BatchMap(m, s, 3, np.zeros(3), np.eye(3), **o),
    "FixedLag": lambda m, s, **o: smoothing.FixedLag(m, s, 3, 3, **o),
}


@pytest.mark.parametrize("name", KINDS)
def test_swapped_models_are_told_by_the_class_that_got_them(name):
    sensor = BEARING if name == "DelayedSlam" else SEES
    with pytest.raises(
        ValueError, match=f"^{name}: .*expected a Motion.*(swapped|a motion comes first)"
    ):
        KINDS[name](sensor, MOVE)


@pytest.mark.parametrize("name", KINDS)
def test_a_model_that_was_not_called_or_is_none_is_told(name):
    with pytest.raises(ValueError, match=rf"^{name}: motion: expected a Motion.*call it, Velo"):
        KINDS[name](motion.Velocity, SEES)
    with pytest.raises(ValueError, match=rf"^{name}: sensor: expected a Sensor, got 3"):
        KINDS[name](MOVE, 3)


@pytest.mark.parametrize(
    ("make", "owner"),
    [
        (lambda v: life.Existence(lambda pose, at: True, detected=v), "Existence: detected: "),
        (lambda v: life.Existence(lambda pose, at: True, confirm=v), "Existence: confirm: "),
        (lambda v: jaxslam.scenarios.BetweenRanges(v, 5.0), "BetweenRanges: nearest: "),
        (lambda v: filters.Localization(MOVE, SEES, v), "Localization: landmarks: "),
        (lambda v: KINDS["ParticleLocalization"](MOVE, SEES, box=v), "ParticleLocalization: box: "),
        (lambda v: smoothing.BatchMap(MOVE, SEES, 3, v, np.eye(3)), "BatchMap: pose: "),
        (lambda v: grids.LikelihoodField(max_range=5.0, hit=v), "LikelihoodField: hit: "),
        (lambda v: filters.EkfSlam(MOVE, SEES, v), "EkfSlam: capacity: "),
    ],
)
@pytest.mark.parametrize("value", [object(), filters.EkfSlam, lambda: 1.0])
def test_what_cannot_be_compared_is_refused_by_its_field(make, owner, value):
    with pytest.raises(ValueError, match=f"^{owner}expected [^\n]*$"):
        make(value)


def test_a_refusal_of_an_array_has_one_line():
    with pytest.raises(ValueError, match=r"^EkfSlam: capacity: expected [^\n]*$"):
        filters.EkfSlam(MOVE, SEES, np.eye(2))
    with pytest.raises(ValueError, match=r"^BearingOnly: free: expected \(mean, cov[^\n]*$"):
        sensors.BearingOnly(np.eye(1), free=-np.eye(3))
    with pytest.raises(
        ValueError, match=r"^Localization: landmarks: expected real numbers, got 1j"
    ):
        filters.Localization(MOVE, SEES, 1j)


def test_mapping_and_teams_look_at_their_models_too():
    with pytest.raises(ValueError, match=r"^Mapping: sensor: expected a Sensor.*call it"):
        filters.Mapping(sensors.RangeBearing, 3)
    wrong = changed(SEES, observe=lambda pose, at: pose)
    robot = team.Robot(MOVE, sensors.Suite(((wrong, 2),)))
    with pytest.raises(ValueError, match=r"^TeamSlam: sensor: expected range_bearing.observe"):
        filters.TeamSlam([robot], 3)


@pytest.mark.parametrize("name", ["EkfSlam", "Localization", "DeadReckoning"])
def test_a_chart_or_linearizer_that_was_not_called_is_told(name):
    make = KINDS[name]
    with pytest.raises(ValueError, match=rf"^{name}: chart: expected a Chart.*RightInvariant\("):
        make(MOVE, SEES, chart=charts.RightInvariant)
    with pytest.raises(
        ValueError, match=rf"^{name}: linearize: expected a Linearizer.*call it, FirstEstimate\("
    ):
        make(MOVE, SEES, linearize=linearize.FirstEstimate)
    with pytest.raises(ValueError, match=rf"^{name}: chart: expected a Chart, got 'euclidean'"):
        make(MOVE, SEES, chart="euclidean")


@pytest.mark.parametrize("name", sorted(set(KINDS) - {"DeadReckoning", "EifSlam", "Seif"}))
def test_an_association_that_was_not_called_or_is_none_is_told(name):
    sensor = BEARING if name == "DelayedSlam" else SEES
    for wrong, told in (
        (association.Known, r"got the class Known: call it"),
        (association.Nearest, r"got the class Nearest: call it"),
        (lambda prediction: None, r"got one of \(prediction\)"),
        ("known", "got 'known'"),
    ):
        with pytest.raises(ValueError, match=f"^{name}: associate: expected a function.*{told}"):
            KINDS[name](MOVE, sensor, associate=wrong)


def own_sensor(**other):
    """A user's sensor of points, by hand."""
    functions = {
        "observe": lambda pose, at: at - pose[:2],
        "residual": lambda z, z_hat: z - z_hat,
        "noise_cov": lambda z: jnp.eye(2),
        "invert": lambda pose, z, s: pose[:2] + z,
        "position": lambda at: at,
        "embed": lambda pose, point: point,
    }
    free = Free(jnp.zeros(0), jnp.zeros((0, 0)))
    fields = {"measurements": ("x [m]", "y [m]"), "landmark": ("x [m]", "y [m]"), "free": free}
    return sensor_of(name="own", **(fields | functions | other))


@pytest.mark.parametrize(
    ("field", "wrong", "told"),
    [
        ("observe", lambda pose, at: pose, r"own.observe\(pose \(3,\), l \(2,\)\) to return shape \(2,\), got shape \(3,\)"),
        ("observe", lambda pose, at: jnp.arange(2), r"own.observe.* to return real numbers, got int"),
        ("observe", lambda pose, at: (at, at), r"to return shape \(2,\), got a tuple"),
        ("residual", lambda z: z, r"expected own.residual to take \(z, z_hat\), got \(z\)"),
        ("noise_cov", lambda z: jnp.ones(2), r"own.noise_cov\(z \(2,\)\) to return shape \(2, 2\)"),
        ("invert", lambda pose, z: z, r"expected own.invert to take \(pose, z, s\), got \(pose, z\)"),
        ("invert", lambda pose, z, s: pose, r"own.invert.* to return shape \(2,\), got shape \(3,\)"),
        ("position", lambda at: at[:1], r"own.position\(l \(2,\)\) to return shape \(2,\)"),
        ("free", Free(jnp.zeros(1), jnp.zeros((2, 2))), r"own.free of shapes \(K,\) and \(K, K\)"),
    ],
)  # fmt: skip
def test_a_model_of_ones_own_is_evaluated_on_shapes(field, wrong, told):
    check_models(MOVE, own_sensor())
    with pytest.raises(ValueError, match=f"^sensor: .*{told}"):
        check_models(MOVE, own_sensor(**{field: wrong}))
    with pytest.raises(ValueError, match=f"^sensor: .*{told}"):  # in a suite too
        check_models(MOVE, sensors.Suite(((SEES, 2), (own_sensor(**{field: wrong}), 1))))


@refused(
    ("step", lambda pose, u: pose, r"expected pose_increment.step to take \(pose, u, w\), got \(pose, u\)"),
    ("step", lambda pose, u, w: pose[:2], r"to return shape \(3,\), got shape \(2,\)"),
    ("noise_cov", lambda pose, u: jnp.eye(2), r"noise_cov: expected a covariance of shape \(3, 3\), got \(2, 2\)"),
    told="^motion: .*",
)  # fmt: skip
def test_a_motion_of_ones_own_is_evaluated_on_shapes(field, wrong):
    check_models(changed(MOVE, **{field: wrong}), SEES)


def test_what_has_been_found_sound_is_not_looked_at_again():
    asked = []
    sensor = own_sensor(observe=lambda pose, at: asked.append(1) or at)
    check_models(MOVE, sensor)
    check_models(MOVE, sensor)
    assert len(asked) == 1


def test_names_are_tuples_of_strings():
    for wrong in (2, "range [m]", ["x", "y"], (1, 2)):
        with pytest.raises(ValueError, match=r"measurements: expected a tuple of names"):
            own_sensor(measurements=wrong)
        with pytest.raises(ValueError, match=r"controls: expected a tuple of names"):
            changed(MOVE, controls=wrong)
    with pytest.raises(ValueError, match=r"free: expected a Free, got None"):
        own_sensor(free=None)


def test_charts_linearizers_and_filters_define_their_methods():
    @record
    class Chart(protocols.Chart):
        def retract(self, pose, dx):
            return pose

    @record
    class Filter(protocols.Filter):
        controls = ("x [m]",)
        measurements = ("x [m]",)

        def init(self, pose, pose_cov):
            return pose

        def predict(self, s, u):
            return s

    @record
    class Linearizer(protocols.Linearizer):
        pass

    for made, told in (
        (
            Chart,
            r"^Chart: retract: expected a method of \(pose, l, dx, dl\), got one of \(pose, dx\)$",
        ),
        (Filter, r"^Filter: predict: expected a method of \(state, u, key\), got one of \(s, u\)$"),
        (Linearizer, "^Linearizer: motion: expected a method, got none$"),
    ):
        with pytest.raises(ValueError, match=told):
            made()


ONE = Scan(jnp.zeros((1, 2)), jnp.zeros(1, int), jnp.ones(1, bool))
INFO, STATE = unmatched(ONE), jnp.zeros(3)
BELIEVED = Estimate(*(jnp.zeros(shape) for shape in [(3,), (3, 3), (2, 2), (2, 2, 2), (2,), (2,)]))


@refused(
    ("state", "expected update to return.*got a str"),
    ((STATE.tolist(), 1), r"expected update to return.*got \(list, int\)"),
    ((STATE, INFO, 1), r"expected update to return.*got \(ArrayImpl, Info, int\)"),
    (INFO, "expected update to return.*got an Info"),
    ((jnp.zeros(2), INFO), r"update: state: expected float\d+ \(3,\), got float\d+ \(2,\)"),
    (({"pose": STATE}, INFO), r"update: expected a state as before, .*, got dict of \['pose'\]"),
    (
        (STATE, INFO._replace(nis=jnp.zeros(2))),
        r"update: Info.nis: expected shape \(1,\), got \(2,\)",
    ),
    (
        (STATE, INFO._replace(nis=jnp.zeros(1, jnp.float16))),
        r"update: Info.nis: expected float\d\d values, got float16",
    ),
    (
        (STATE, INFO._replace(status=jnp.zeros(1))),
        "update: Info.status: expected integer values, got float",
    ),
    told="^",
)
def test_what_an_update_of_ones_own_returns_is_told(returned):
    assert state_and_info(STATE, ONE, (STATE, INFO)) == (STATE, INFO)
    state_and_info(STATE, ONE, returned)


@refused(
    (
        BELIEVED._replace(points=jnp.zeros((2, 3))),
        r"Estimate.points: expected shape \(2, 2\), got \(2, 3\)",
    ),
    (
        BELIEVED._replace(points=jnp.zeros((2, 2), jnp.float16)),
        r"Estimate.points: expected float\d\d values, got float16",
    ),
    (STATE, "expected estimate to return an Estimate, got"),
    told="^",
)
def test_what_an_estimate_of_ones_own_returns_is_told(returned):
    real = jnp.zeros(0).dtype
    assert checked_estimate(BELIEVED, real) is BELIEVED
    checked_estimate(returned, real)


KEY = jax.random.key(0)
WORLD = jaxslam.scenarios.circle(steps=3)
EKF = filters.EkfSlam(WORLD.motion, WORLD.sensor, 2)
LOG = Log(np.zeros((3, 3)), Scan(np.zeros((3, 1, 2)), np.zeros((3, 1), int), np.ones((3, 1), bool)))
SMOOTH = smoothing.Smoother(WORLD.motion, WORLD.sensor, 2, np.zeros(3), np.eye(3))


def blind(scenario):
    return filters.DeadReckoning(scenario.motion, scenario.sensor)


def run_from(pose, pose_cov=WORLD.pose_cov):
    return jaxslam.run(EKF, LOG, pose, pose_cov, KEY)


@refused(
    (lambda: jaxslam.simulate(jaxslam.scenarios.circle, KEY), "call it, circle"),
    (lambda: jaxslam.simulate(KEY, WORLD), "scenario: expected a World"),
    (lambda: jaxslam.run(WORLD, LOG, np.zeros(3), np.eye(3), KEY), "filter: expected a Filter"),
    (
        lambda: jaxslam.run(EKF, WORLD, np.zeros(3), np.eye(3), KEY),
        "log: expected a Log, got a Scen",
    ),
    (
        lambda: jaxslam.monte_carlo(jaxslam.scenarios.circle, {"ekf": EKF}, 2, KEY),
        "call it, circle",
    ),
    (
        lambda: jaxslam.monte_carlo(WORLD, {"ekf": EKF}, 2, KEY, devices=99),
        r"devices: expected a sequence, as jax.local_devices\(\), got 99",
    ),
    (
        lambda: jaxslam.monte_carlo(WORLD, {"ekf": EKF}, 2, KEY, keep="kk"),
        r"^monte_carlo: keep: expected jaxslam.store.open\(folder\).*got 'kk'",
    ),
    (
        lambda: jaxslam.verify_jacobians(3),
        "^verify_jacobians: model: expected a Motion, a Sensor, a Factor, a BeamModel or a function of "
        "vectors, got 3",
    ),
    (lambda: jaxslam.verify_jacobians(np.sin, 3), "jacobian: expected a function, got 3"),
    (
        lambda: jaxslam.monte_carlo(WORLD, {"mine": blind}, 2, KEY),
        r"blind was called with the truth .* has no attribute 'motion'; of a function of the "
        r"scenario give what it returns, blind\(scenario\)",
    ),
    (lambda: run_from(None), r"^run: pose: expected finite numbers of shape \(3,\), got None"),
    (lambda: run_from("a"), r"^run: pose: expected .*, got 'a'"),
    (lambda: run_from(LOG.scan), r"^run: pose: expected .*, got a Scan"),
    (lambda: run_from(["a", "b", "c"]), r"^run: pose: expected .*, got a list"),
    (lambda: run_from([0, 0, np.nan]), r"^run: pose: expected finite .*, got .*nan\]"),
    (lambda: run_from(KEY), r"^run: pose: expected .*, got PRNG keys of shape \(\)"),
    (lambda: jaxslam.run(EKF, LOG, np.zeros(3), np.eye(3), 0), "run: key: expected a PRNG key"),
    (lambda: jaxslam.simulate(WORLD, 0), "simulate: key: expected a PRNG key"),
    (
        lambda: run_from(np.zeros(3), None),
        r"^run: pose_cov: expected a covariance of shape \(3, 3\), got None",
    ),
    (
        lambda: SMOOTH(LOG._replace(control=np.zeros((3, 2))), KEY),
        r"^smoother: log.control: expected shape \(T, 3\), got \(3, 2\)",
    ),
)
def test_what_drives_a_filter_says_what_it_expected(call):
    call()


def compressed(**options):
    return filters.CompressedEkfSlam(filters.EkfSlam(MOVE, SEES, 3, **options), area=2)


@refused(
    (lambda: filters.Localization(MOVE, SEES, POINTS, gate=0.0), "^Localization: "),
    (lambda: filters.Localization(MOVE, SEES, POINTS, iterations=0), "^Localization: "),
    (lambda: filters.Localization(MOVE, SEES, POINTS, correction="at once"), "^Localization: "),
    (
        lambda: compressed(life=life.Recency()),
        "^CompressedEkfSlam: filter: a life is not supported",
    ),
    (
        lambda: filters.Merging(compressed(), 1.0),
        "^Merging: filter: landmarks of compressed_ekf_slam",
    ),
    (
        lambda: Closing(filters.EkfSlam(MOVE, SEES, 3), settings={"least": 3}),
        "^Closing: settings: expected LoopSettings",
    ),
    (
        lambda: motion_of(step=lambda pose, u, w: pose, controls=(), noises=()),
        "^Own: noise_cov: expected a field or a method",
    ),
)
def test_options_are_refused_by_the_class_that_got_them(make):
    make()
