"""`verify_jacobians` of models: faults of sensors, motion models and noise are found by name."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import refused
from own_models import changed, sensor_of
from verified import failed

from jaxslam import _cli as cli
from jaxslam import charts, core, graphs, motion, sensors
from jaxslam.core.record import record
from jaxslam.laser.grids import beam_models
from jaxslam.math import se2
from jaxslam.math.angles import wrap
from jaxslam.verify import Check, Report, _inputs, _jacobians, _properties, build, verify_jacobians

LASER = build(sensors.RangeBearing)
CAMERA = build(sensors.BearingOnly)
INCREMENT = build(motion.Increment)
UNMOUNTED = sensors.RangeBearing(0.01 * np.eye(2))

DIFFERENCE = "the residual is a difference, wrapped on the circle"
OBSERVED = "invert undoes observe, within what is free"
INVERTED = "observe undoes invert, whatever is free"

NOISE = "noise covariance"

# A model, a fault that no Jacobian shows, and the checks that must fail, no others.
BESIDE_JACOBIANS = {
    "residual with the wrong sign": (
        LASER,
        {"residual": lambda z, z_hat: LASER.residual(z_hat, z)},
        [DIFFERENCE],
    ),
    "bearing without a unit": (
        LASER,
        {"measurements": ("range [m]", "bearing")},
        ["angles have [rad] in their names"],
    ),
    "residual not wrapped": (LASER, {"residual": lambda z, z_hat: z - z_hat}, [DIFFERENCE]),
    "residual with an offset": (
        LASER,
        {"residual": lambda z, z_hat: LASER.residual(z, z_hat) + 0.1},
        ["the residual is zero at equality", "the residual is antisymmetric", DIFFERENCE],
    ),
    "inverse that ignores the prior": (
        CAMERA,
        {
            "invert": lambda pose, z, s: CAMERA.invert(pose, z, 3 + 0 * s),
            "invert_jacobians": None,
        },
        [OBSERVED],
    ),
    "negative variance": (
        LASER,
        {"noise_cov": lambda z: jnp.diag(jnp.stack([z[1], z[1] ** 2]))},
        [NOISE],
    ),
    "covariance of another size": (LASER, {"noise_cov": lambda z: jnp.eye(3)}, [NOISE]),
    "residual of another size": (
        LASER,
        {"residual": lambda z, z_hat: z[0] - z_hat[0]},
        ["the residual has the size of z"],
    ),
    "asymmetric covariance": (
        INCREMENT,
        {"noise_cov": lambda pose, u: jnp.array([[1.0, 0.5], [0, 1]])},
        [NOISE],
    ),
    "perturb with the wrong sign": (
        INCREMENT,
        {"step": INCREMENT.step, "perturb": lambda u, w: u - w},
        ["step(pose, u, w) = step(pose, perturb(u, w), 0)"],
    ),
    "heading out of range": (
        INCREMENT,
        {"step": lambda *a: INCREMENT.step(*a) + jnp.array([0, 0, 2 * jnp.pi])},
        ["the heading is wrapped to (-π, π]"],
    ),
}
# A fault of a function, through the front door: the checks that must fail.
OF_FUNCTIONS = {
    # The guide's slip (64): the point is taken in the robot's frame, not the sensor's.
    "inverse in the wrong frame": (
        LASER,
        {"invert": UNMOUNTED.invert, "invert_jacobians": UNMOUNTED.invert_jacobians},
        [OBSERVED, INVERTED],
    ),
    "dtype": (
        INCREMENT,
        {"step": lambda *a: INCREMENT.step(*a) + np.zeros(3)},
        ["step keeps the dtype"],
    ),
}


def drawn(model, count=24):
    """The claims of a model with samples and values, and no Jacobian."""
    seen = []
    for claim in model.claims():
        samples = _inputs.samples.claim_samples(
            claim, count, 0, [_inputs.samples.Seen(*e[:3]) for e in seen]
        )
        values = np.asarray(jax.jit(jax.vmap(claim.function))(*samples.values))
        seen.append(_jacobians.Evaluated(claim, samples, values))
    return seen


def checks_beside(evaluated):
    """The checks of claims beside their Jacobians, by name."""
    with np.errstate(all="ignore"):
        checks = [c for e in evaluated for c in _properties.claim_checks(e, evaluated)]
    return {check.name: check for check in checks}


def failures(evaluated):
    """The names of those that failed."""
    return [name for name, check in checks_beside(evaluated).items() if not check.passed]


@pytest.fixture(scope="module")
def states():
    """Of the models, as `verify_jacobians` draws them, with their values."""
    return {model.name: drawn(model) for model in (INCREMENT, LASER, CAMERA)}


@pytest.mark.parametrize("fault", BESIDE_JACOBIANS)
def test_a_fault_beside_the_jacobians_is_found(fault, states):
    model, changes, names = BESIDE_JACOBIANS[fault]
    claims = changed(model, **changes).claims()
    evaluated = [e._replace(claim=c) for c, e in zip(claims, states[model.name], strict=True)]
    if "step" in changes:  # else the values are as before
        evaluated = [
            e._replace(values=np.asarray(jax.vmap(e.claim.function)(*e.samples.values)))
            for e in evaluated
        ]
    assert failures(evaluated) == names


@pytest.mark.parametrize("fault", OF_FUNCTIONS)
def test_a_fault_of_a_function_is_found(fault):
    model, changes, names = OF_FUNCTIONS[fault]
    found = failed(verify_jacobians(changed(model, **changes)))
    assert set(names) <= set(found) if fault == "dtype" else found == names


def test_a_claim_that_loses_digits_far_from_the_origin_is_told_apart():
    def observe(pose, landmark):
        return (landmark - pose[:2])[:1] * (1 + pose[2])

    def claim(pose, landmark):
        turned = 1 + pose[2]
        one = 3 * (pose[0] + 1 / 3 - pose[0])  # but for rounding
        by_pose = jnp.stack([-one * turned, 0 * one, landmark[0] - pose[0]])
        return by_pose[None], jnp.stack([turned, 0 * one])[None]

    entries = {"pose": ("x [m]", "y [m]", "theta [rad]"), "landmark": ("x [m]", "y [m]")}
    report = verify_jacobians(observe, claim, arguments=entries, outputs=("ahead [m]",))
    (wrong,) = report.findings[0].wrong_entries
    assert wrong.far_alone and "right at all other states" in str(report)


@pytest.mark.sweep
def test_a_squared_range_is_tried_only_where_it_can_be_measured():
    """A sensor whose `invert` takes a root: no measurement is invented that it could not have made."""

    def squared(z):
        return jnp.stack([z[0] ** 2, z[1]])

    def root(z):
        there = z[0] > 0
        return jnp.stack([jnp.where(there, jnp.sqrt(jnp.where(there, z[0], 1.0)), 0.0), z[1]])

    sensor = changed(
        LASER,
        measurements=("r2 [m2]", "bearing [rad]"),
        observe=lambda pose, landmark: squared(LASER.observe(pose, landmark)),
        invert=lambda pose, z, s: LASER.invert(pose, root(z), s),
        observe_jacobians=None,
        invert_jacobians=None,
    )
    report = verify_jacobians(sensor)
    assert report.passed, str(report)


@pytest.mark.sweep
def test_a_sensor_whose_embed_fails_is_still_looked_at():
    def embed(pose, point):
        raise NotImplementedError("later")

    report = verify_jacobians(changed(LASER, embed=embed))
    assert [f for f in report.findings if f.function == "observe"]
    assert "later" in str(report)
    assert not report.passed


@refused(
    (lambda: verify_jacobians(sensors.RangeBearing), "model: expected .*, got the class RangeB"),
    (lambda: verify_jacobians(charts.Euclidean()), "model: expected one with claims, got .*Euc"),
)
def test_what_claims_nothing_is_refused(call):
    call()


def test_a_model_may_claim_more():
    """A function of the user's beside those of the base, with a slip in its Jacobian."""

    class Marked(sensors.RangeBearing):
        def claims(self):
            arguments = (core.claims.Argument("landmark", self.landmark),)
            slip = core.claims.Claim(
                "square", lambda at: at**2, arguments, ("x [m2]", "y [m2]"), jnp.diag
            )
            return (*super().claims(), slip)

    report = verify_jacobians(record(Marked)(0.01 * np.eye(2)), count=2)
    assert failed(report) == ["square by landmark"] and report.kind == "sensor"


def test_the_report_says_which_jacobians_have_no_claim():
    """A wrong row of a claim that is not there is never seen: "verified" alone would hide that."""

    def head(model):
        return str(verify_jacobians(model, count=2)).splitlines()[0]

    by_pose = changed(
        UNMOUNTED, observe_jacobians=lambda pose, point: UNMOUNTED.observe_jacobians(pose, point)[0]
    )
    verified = "sensor range_bearing: verified"
    assert head(by_pose) == f"{verified}; no hand-derived claim of observe by landmark"
    assert head(UNMOUNTED) == verified
    none = verify_jacobians(lambda v: 2 * v, arguments={"v": 1}, name="f", count=2)
    assert "f by v (no hand-derived claim)" in str(none)
    noted = dataclasses.replace(none, notes=("an angle",))
    assert str(noted).startswith("function f: verified, with 1 note; no hand-derived claim\n")


def test_nothing_compared_is_not_verified():
    assert not verify_jacobians(
        lambda v: v[:0], lambda v: jnp.zeros((0, 1)), arguments={"v": 1}
    ).passed
    assert not Report("f", "function", checks=(Check("is pure", True),)).passed


def test_a_scalar_observation_is_one_failure():
    scalar = changed(CAMERA, observe=lambda pose, point: CAMERA.observe(pose, point)[0])
    assert failed(verify_jacobians(scalar, count=2)) == ["observe returns its shape"]


def mast_camera(invert_sign=1.0):
    """A camera 1.5 m above the ground: bearing, and depression in (0, π/2]."""

    def observe(pose, landmark):
        distance, bearing = se2.polar_in_frame(pose, landmark)
        return jnp.stack([bearing, jnp.arctan2(1.5, distance)])

    def invert(pose, z, s):
        polar = jnp.stack([1.5 / jnp.tan(z[1]), invert_sign * z[0]])
        return se2.from_frame(pose, se2.rectangular(polar))

    return sensor_of(
        name="mast_camera",
        measurements=("bearing [rad]", "depression [rad]"),
        observe=observe,
        residual=lambda z, z_hat: wrap(z - z_hat),
        noise_cov=lambda z: 0.01 * jnp.eye(2, dtype=z.dtype),
        invert=invert,
    )


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_the_states_of_a_sensor_are_those_of_its_inverse_too():
    """And a measurement that no state gives is not tried."""
    rng = np.random.default_rng(0)
    states = (rng.normal(size=(10, 3)), 5 + rng.normal(size=(10, 2)))
    report = verify_jacobians(mast_camera(), states=states)
    assert report.passed, report
    assert [f.samples for f in report.findings] == [10] * 4
    assert np.isfinite(report.linearity)
    assert failures(drawn(mast_camera())) == []


def stereo(support):
    """Bearing and inverse range, which is positive, of landmarks up to 1 km."""

    def observe(pose, landmark):
        r, bearing = se2.polar_in_frame(pose, landmark)
        return jnp.stack([bearing, 1 / jnp.maximum(r, 1e-3)])

    def invert(pose, z, s):
        return se2.from_frame(pose, se2.rectangular(jnp.stack([1 / z[1], z[0]])))

    return sensor_of(
        name="stereo",
        measurements=("bearing [rad]", "inverse range [1/m]"),
        support=support,
        observe=observe,
        invert=invert,
        noise_cov=lambda z: 1e-4 * jnp.eye(2, dtype=z.dtype),
    )


def test_a_measurement_outside_its_support_is_not_tried():
    unlimited, limited = stereo({}), stereo({"inverse range [1/m]": (0.0, np.inf)})
    assert "invert and its derivatives are finite" in failed(verify_jacobians(unlimited, count=4))
    report = verify_jacobians(limited, count=4)
    assert report.passed, report
    all_of, some_of = drawn(unlimited, 4), drawn(limited, 4)
    # Of `observe` all remain.
    np.testing.assert_equal(some_of[0].samples.values, all_of[0].samples.values)
    z = some_of[1].samples.values[1]
    assert (z[:, 1] > 0).all() and (z[:, 0] == 0).any() and (np.abs(z[:, 0]) > 3.14159).any()


def test_a_free_range_is_not_negative():
    """Of 10 m, known to 5 m: else `invert` would put the landmark behind the camera."""
    free = drawn(CAMERA, 1000)[1].samples.values[2]
    assert free.min() >= 0 and free.std() > 4


@refused(
    ({"range [m]": (0, 1)}, "support: expected .* of bearing .*, got 'range"),
    ({"bearing [rad]": (1, 0)}, "got 'bearing .*: .1, 0."),
    ({"bearing [rad]": 3.0}, "got 'bearing .*: 3.0"),
)
def test_a_support_that_is_none_is_refused(support):
    stereo(support)


def test_a_failed_round_trip_names_entry_and_state():
    checks = checks_beside(drawn(mast_camera(-1.0)))
    assert checks[INVERTED].detail.startswith("bearing [rad] is off by ")
    assert ", at pose = (" in checks[INVERTED].detail


def test_a_round_trip_off_by_a_turn_says_that_the_unit_is_missing():
    def unwrapped(pose, landmark):
        turn = jnp.where(pose[2] > 0, 2 * jnp.pi, 0.0)
        return UNMOUNTED.observe(pose, landmark) + jnp.stack([0.0, turn])

    names = "range [m]", "bearing"
    unnamed = changed(
        UNMOUNTED, measurements=names, observe=unwrapped, residual=lambda z, z_hat: z - z_hat
    )
    checks = checks_beside(drawn(unnamed))
    assert checks[INVERTED].detail.startswith(
        "bearing is off by 2π (an angle's name ends in [rad])"
    )
    assert checks["the residual is a difference"].passed


# --- Beam models under `verify`: both pass, a wrong derivative does not, and a file may define on--


@pytest.mark.sweep
@pytest.mark.parametrize("name", beam_models.REGISTRY)
def test_beam_models_are_verified(name):
    report = verify_jacobians(build(beam_models.REGISTRY[name]), count=4)
    assert report.passed, str(report)
    assert report.kind == "beam model"


def test_a_wrong_derivative_by_the_heading_is_found():
    @record
    class Wrong(beam_models.LikelihoodField):
        def jacobian(self, prepared, pose, beams):
            return super().jacobian(prepared, pose, beams) * jnp.array([[1.0, 1.0, -1.0]])

    report = verify_jacobians(build(Wrong), count=4)
    assert not report.passed
    assert "theta" in str(report) and "hand disagrees" in str(report), str(report)


def test_a_file_may_define_a_beam_model_whose_jacobian_is_held(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text(
        "import dataclasses\nfrom jaxslam.core.record import record\n"
        "from jaxslam.laser.grids import LikelihoodField\n"
        "@record\nclass Wrong(LikelihoodField):\n"
        "    def jacobian(self, *at):\n        return -super(Wrong, self).jacobian(*at)\n"
        "mine = LikelihoodField(0.2, max_range=40.0)\nwrong = Wrong(0.2, max_range=40.0)\n",
        encoding="utf-8",
    )
    right, wrong = _inputs.user_files.verify_file(str(path), partial(verify_jacobians, count=4))
    assert (right.model, right.kind, right.passed) == ("mine", "beam model", True), str(right)
    assert not wrong.passed
    assert "hand disagrees" in str(wrong)
    with pytest.raises(
        _inputs.user_files.UnusableFile, match=r"expected dataclasses to be .* a BeamModel, or"
    ):
        _inputs.user_files.load(f"{path}:dataclasses")
    (target,) = (a for a in cli._parser()._actions if isinstance(a.choices, dict))
    assert "grids.BeamModel" in target.choices["verify"].format_help()


# --- A factor of a graph is verified as models are ------------------------------------------------


def test_a_wrong_entry_of_a_factor_is_named():
    right = graphs.RelativePose()

    def jacobians(variables, z):
        by_first, by_second = right.jacobians(variables, z)
        return by_first, by_second.at[1, 0].multiply(-1.0)

    report = verify_jacobians(changed(right, jacobians=jacobians), count=4)
    assert report.kind == "factor"
    assert failed(report) == ["residual by pose 2"]
    assert [f.name for f in report.findings] == [
        f"residual by {name}" for name in ("pose 1", "pose 2", "measurement")
    ]
    assert "entry (y [m], x [m]): hand disagrees" in str(report)


@pytest.mark.parametrize(
    ("text", "name", "factor"),
    [
        ("mine = graphs.Prior()\n", "mine", "prior"),
        ("def mine() -> graphs.Factor:\n    return graphs.Prior()\n", "mine", "prior"),
        ("@record\nclass Mine(graphs.Prior):\n    pass\n", "Mine", "mine"),
    ],
)
def test_a_file_has_factors_by_themselves_by_factories_and_classes(tmp_path, text, name, factor):
    path = tmp_path / "mine.py"
    path.write_text(f"from jaxslam import graphs\nfrom jaxslam.core.record import record\n{text}")
    assert [(t.name, t.model.name) for t in _inputs.user_files.load(str(path))] == [(name, factor)]
