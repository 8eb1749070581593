"""Draws of a campaign, as arrays and as folders of tables that an estimator in any language reads."""

import dataclasses
import json
import math
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import worlds

import jaxslam
from jaxslam import consistency, datasets, motion, scenarios, sensors
from jaxslam.association import Nearest
from jaxslam.consistency import _draw_tables as draw_tables
from jaxslam.consistency import block_nees, draws, pose_error, write_draws
from jaxslam.core.record import record
from jaxslam.filters import EkfSlam
from jaxslam.simulation._worlds import world_of_run

KEY = jax.random.key(5)
SHORT = {"webmap": 3, "office_lines": 3, "square_lines": 3}
"""Steps of a world of the catalog; of others 8."""


def of_catalog(name):
    return scenarios.SCENARIOS[name](SHORT.get(name, 8))


def folder_of(path, number=0):
    """(run, truth): the data set in the tables of a run, and its truth.csv."""
    name = f"{number:04d}"
    truth = np.loadtxt(path / "truth" / name / "truth.csv", delimiter=",", skiprows=1, ndmin=2)
    return datasets.table(path / "runs" / name), truth


CIRCLE = scenarios.circle(8)
SKEWED = np.diag([0.04, 0.04, 0.01]) + 0.01 * (np.ones((3, 3)) - np.eye(3))
WORLDS = {
    "circle": CIRCLE,
    "cloister": scenarios.cloister(6),
    "bearing_only": dataclasses.replace(
        CIRCLE, sensor=sensors.BearingOnly([[0.02**2]], free=([3.0], [[1.0]])), pose_cov=SKEWED
    ),
    "range_only": dataclasses.replace(
        CIRCLE,
        sensor=sensors.RangeOnly([[0.1**2]], mount=(0.2, 0.1, 0.3), free=([0.5], [[0.3]])),
    ),
    "unknown_tags": dataclasses.replace(
        scenarios.cloister(6), filter_options={"associate": Nearest(0.99, 0.999)}
    ),
    "loop_bearing": of_catalog("loop_bearing"),
    "webmap": of_catalog("webmap"),
    "gyroscope": worlds.gyroscope(8),
    "tyre": dataclasses.replace(
        CIRCLE,
        motion=motion.Augmented(motion.Corrected(CIRCLE.motion), ("scale", "heading"), 0.02),
        pose=(0.1, 0.2, 0.0, 1.0, 1.0, 0.1),
        pose_cov=scipy.linalg.block_diag(SKEWED, np.diag([0.05, 0.02, 0.1]) ** 2),
        noise_on="robot",
    ),
    "radar": jaxslam.Scenario(
        name="radar",
        motion=motion.ConstantVelocity(np.diag([0.3, 0.1]) ** 2),
        sensor=sensors.RangeRate(np.diag([0.1, 0.03, 0.05]) ** 2, mount=(0.3, 0.1, 0.2)),
        landmarks=CIRCLE.landmarks,
        controls=np.full((8, 1), 0.2),
        pose=(0.0, 0.0, 0.0, 0.8, 0.2),
        pose_cov=np.diag([0.0, 0.0, 0.0, 0.3, 0.1]) ** 2,
    ),
}


def test_draws_are_the_worlds_of_a_campaign():
    for world, runs in ((CIRCLE, 18), (scenarios.cloister(6), 2)):
        histories = list(draws(world, runs, KEY))
        assert len(histories) == runs
        for number in (0, runs - 1):
            for leaf, drawn in zip(
                jax.tree.leaves(histories[number]),
                jax.tree.leaves(world_of_run(world, KEY, number)),
                strict=True,
            ):
                assert isinstance(leaf, np.ndarray)
                np.testing.assert_allclose(leaf, drawn, rtol=1e-13, atol=1e-13)


def test_draws_refuse_at_once_what_a_campaign_refuses():
    for arguments in ((CIRCLE, 0, KEY), (CIRCLE, 2, 3), ("circle", 2, KEY)):
        with pytest.raises(ValueError, match=r"^draws: "):
            draws(*arguments)
    truth, log = next(draws(CIRCLE, 1, KEY))
    recorded = jaxslam.recorded_world(
        CIRCLE.motion, CIRCLE.sensor, [log], [truth.pose], truth.landmarks
    )
    assert np.array_equal(next(draws(recorded, 1, KEY))[0].pose, truth.pose)
    with pytest.raises(ValueError, match="draws: runs: expected at most 1, the recorded runs"):
        draws(recorded, 2, KEY)


def nees_of(filter, log, start, truth, rows=slice(None)):
    """The NEES of the pose at some rows (T,), and where it is regular; of a robot with further
    numbers theirs is added."""
    estimate = jaxslam.run(filter, log, *start, KEY).estimate
    pose, cov = (np.asarray(a)[rows] for a in (estimate.pose, estimate.pose_cov))
    error = pose_error(truth[:, :3], pose)
    nees = block_nees(pose, error, error, cov)["pose"]
    if truth.shape[1] > 3:
        e = truth[:, 3:] - np.asarray(estimate.further)[rows]
        P = np.asarray(estimate.further_cov)[rows]
        square = (e * np.linalg.solve(P, e[..., None])[..., 0]).sum(axis=1)
        nees = nees._replace(value=nees.value + square)
    return nees


@pytest.mark.parametrize("name", WORLDS)
def test_a_filter_on_the_tables_has_the_nees_of_the_campaign(name, tmp_path):
    world = WORLDS[name]
    write_draws(world, 2, KEY, tmp_path / "draws")
    data, true = folder_of(tmp_path / "draws", 1)
    truth, log = list(draws(world, 2, KEY))[1]
    np.testing.assert_array_equal(true[:, 1:], truth.robot)
    table_ekf = EkfSlam(data.motion, data.sensor, data.capacity, **data.filter_options)
    rows = np.searchsorted(data.time, true[:, 0])
    np.testing.assert_array_equal(data.time[rows], true[:, 0])
    read = nees_of(table_ekf, data.log, (data.pose, data.pose_cov), truth.robot, rows)
    ekf = jaxslam.catalog.FILTERS["ekf"](world)
    expected = nees_of(ekf, log, (world.pose, world.pose_cov), truth.robot)
    np.testing.assert_array_equal(read.regular, expected.regular)
    assert expected.regular.sum() >= 2
    np.testing.assert_allclose(read.value, expected.value, rtol=1e-9, atol=1e-9)
    assert data.dropped == {"measurements outside the odometry": 0}
    has_tags = name != "unknown_tags"
    assert (np.asarray(data.log.scan.tag).max() >= 0) == has_tags
    assert ("data association" in (tmp_path / "draws/README.md").read_text()) != has_tags


def test_the_mean_over_the_runs_is_the_campaigns(tmp_path):
    """Through the files, in the numbers that `monte_carlo` sums up itself."""
    write_draws(CIRCLE, 2, KEY, tmp_path / "draws")
    means = []
    for number in (0, 1):
        data, true = folder_of(tmp_path / "draws", number)
        ekf = EkfSlam(data.motion, data.sensor, data.capacity, **data.filter_options)
        rows = np.searchsorted(data.time, true[:, 0])
        nees = nees_of(ekf, data.log, (data.pose, data.pose_cov), true[:, 1:], rows)
        means.append(nees.value[nees.regular].mean())
    filters = {"ekf": jaxslam.catalog.FILTERS["ekf"](CIRCLE)}
    campaign = jaxslam.monte_carlo(CIRCLE, filters, 2, KEY, progress=False)
    value = campaign.filters["ekf"].measures["nees_pose"].value
    np.testing.assert_allclose(np.mean(means), value, rtol=1e-9)


@pytest.mark.parametrize("name", scenarios.SCENARIOS)
def test_every_world_of_points_is_written(name, tmp_path):
    world, folder = of_catalog(name), tmp_path / "draws"
    if not world.sensor.of_points:
        with pytest.raises(ValueError, match=r"expected landmarks that are points, .* got \(r"):
            write_draws(world, 1, KEY, folder)
        assert not folder.exists()
        return
    (run,) = write_draws(world, 1, KEY, folder)
    data, _ = folder_of(folder)
    ((truth, log),) = draws(world, 1, KEY)
    assert sorted(path.name for path in run.iterdir()) == [
        "dataset.toml",
        "measurements.csv",
        "odometry.csv",
    ]
    # The same models, and the same log but for the padding and the numbers of the landmarks.
    z = np.asarray(log.scan.z)[log.scan.valid]
    np.testing.assert_array_equal(np.asarray(data.log.scan.z)[data.log.scan.valid], z)
    tags = np.asarray(data.tags)[np.asarray(data.log.scan.tag)[data.log.scan.valid]]
    np.testing.assert_array_equal(tags, log.scan.tag[log.scan.valid])
    single = draw_tables.single_motion(world)
    control = np.reshape(log.control, (-1, len(single.controls)))
    np.testing.assert_allclose(data.log.control[-len(control) :], control, rtol=1e-12, atol=1e-12)
    pose = np.array([0.3, -0.2, 0.4])
    for of_file, own in (
        (data.motion.noise_cov(pose, control[-1]), single.noise_cov(pose, control[-1])),
        (data.sensor.noise_cov(z[0]), world.sensor.noise_cov(z[0])),
        (
            data.sensor.observe(pose, truth.landmarks[0]),
            world.sensor.observe(pose, truth.landmarks[0]),
        ),
        (data.pose, world.pose),
        (data.pose_cov, world.pose_cov),
    ):
        np.testing.assert_allclose(of_file, own, rtol=1e-12, atol=1e-15)
    assert data.filter_options["correction"] == world.filter_options.get("correction", "sequential")
    assert data.filter_options.get("births") == world.filter_options.get("births")
    assert not [line for line in data.assumed if not line.startswith("[filter] gate: none")]
    surveyed = np.loadtxt(folder / "truth/0000/landmarks.csv", delimiter=",", skiprows=1, ndmin=2)
    np.testing.assert_array_equal(surveyed[:, 1:], truth.landmarks)


@pytest.mark.parametrize(
    ("sensor", "landmarks"),
    [
        (sensors.Compass([[0.01]]), np.zeros((1, 0))),
        (sensors.PositionFix(np.eye(2), mount=(0.3, 0.1, 0.0)), np.zeros((1, 0))),
        (sensors.RangeBearingSignature(0.01 * np.eye(3)), [[3.0, 4.0, 0.5], [1.0, -2.0, 0.2]]),
        (sensors.BearingInverseDepth([[0.01]], min_distance=0.5), [[0.0, 0.0, 0.3, 0.25]]),
    ],
    ids=lambda value: getattr(value, "name", ""),
)
def test_sensors_of_the_robot_itself_and_of_other_landmarks(sensor, landmarks, tmp_path):
    world = jaxslam.Scenario("few", CIRCLE.motion, sensor, landmarks, CIRCLE.controls[:3])
    write_draws(world, 1, KEY, tmp_path / "draws")
    data, true = folder_of(tmp_path / "draws")
    ((truth, log),) = draws(world, 1, KEY)
    np.testing.assert_array_equal(true[:, 1:], truth.pose)
    np.testing.assert_array_equal(data.log.scan.z[1:], log.scan.z)
    assert type(data.sensor) is type(sensor)
    np.testing.assert_allclose(
        data.sensor.noise_cov(log.scan.z[0, 0]), sensor.noise_cov(log.scan.z[0, 0])
    )
    survey = tmp_path / "draws/truth/0000/landmarks.csv"
    assert survey.exists() == bool(sensor.landmark)
    if sensor.landmark:
        points = np.loadtxt(survey, delimiter=",", skiprows=1, ndmin=2)[:, 1:]
        expected = [sensor.position(jnp.asarray(landmark)) for landmark in truth.landmarks]
        np.testing.assert_allclose(points, expected, rtol=1e-12)
    assert "## Measurements" in (tmp_path / "draws/README.md").read_text()


def texts(folder):
    return {
        str(path.relative_to(folder)): path.read_text()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def test_an_interrupted_call_leaves_complete_runs_and_is_continued(tmp_path):
    folder = tmp_path / "draws"
    write_draws(CIRCLE, 3, KEY, tmp_path / "complete")

    def stop(finished, runs):
        assert runs == 3
        if finished == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_draws(CIRCLE, 3, KEY, folder, progress=stop)
    assert sorted(path.name for path in (folder / "runs").iterdir()) == ["0000", "0001"]
    kept = (folder / "runs/0000/odometry.csv").stat().st_mtime_ns
    (folder / ".unfinished-killed").mkdir()
    (folder / "truth/0002").mkdir()  # killed before the run was moved
    counts = []
    write_draws(CIRCLE, 3, KEY, folder, progress=lambda *count: counts.append(count))
    assert counts == [(2, 3), (3, 3)] or counts == [(3, 3)]
    assert texts(folder) == texts(tmp_path / "complete")
    assert (folder / "runs/0000/odometry.csv").stat().st_mtime_ns == kept
    assert not list(folder.glob(".*"))

    # Checksums are of the files; fewer runs, other draws and changed files are refused.
    write_draws(CIRCLE, 4, KEY, folder)
    stored = json.loads((folder / "draws.json").read_text())
    assert (stored["scenario"], stored["runs"], stored["steps"]) == ("circle", 4, 8)
    assert stored["key"] == {"kind": "threefry2x32", "numbers": [0, 5]}
    assert len(stored["checksums"]) == 4 * 5
    with pytest.raises(ValueError, match="holds 4 runs: expected at least as many, got 3"):
        write_draws(CIRCLE, 3, KEY, folder)
    with pytest.raises(
        ValueError,
        match="holds other draws: key is threefry2x32 0:5 there, threefry2x32 0:6 here: ",
    ):
        write_draws(CIRCLE, 4, jax.random.key(6), folder)
    with pytest.raises(
        ValueError, match=r"scenario is circle there, cloister here; .*another sensor"
    ):
        write_draws(scenarios.cloister(6), 4, KEY, folder)
    (folder / "runs/0001/odometry.csv").write_text("t [s]\n")
    with pytest.raises(ValueError, match=r"odometry.csv was changed"):
        write_draws(CIRCLE, 4, KEY, folder)


def test_a_folder_of_other_files_is_refused(tmp_path):
    (tmp_path / "thesis.tex").write_text("")
    with pytest.raises(ValueError, match="holds files that are no draws: choose another folder"):
        write_draws(CIRCLE, 1, KEY, tmp_path)
    (tmp_path / "draws.json").write_text("[]")
    with pytest.raises(ValueError, match="is no record of draws"):
        write_draws(CIRCLE, 1, KEY, tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"thesis.tex", "draws.json"}


def test_worlds_that_no_table_holds_are_refused_in_a_line(tmp_path):
    compass = sensors.Compass([[0.01]])
    suite = sensors.Suite([(CIRCLE.sensor, 3), (compass, 1)])
    both = dataclasses.replace(CIRCLE, sensor=suite, places=None)
    with pytest.raises(
        ValueError, match=r"expected one sensor, .* got a suite of relative_position"
    ):
        write_draws(both, 1, KEY, tmp_path / "draws")
    robot = jaxslam.team.Robot(CIRCLE.motion, sensors.Suite([(CIRCLE.sensor, 3)]))
    team = jaxslam.TeamWorld(
        name="team", robots=(robot,), landmarks=CIRCLE.landmarks, controls=CIRCLE.controls
    )
    with pytest.raises(ValueError, match="robots: expected one robot"):
        write_draws(team, 1, KEY, tmp_path / "draws")
    uneven = np.array(CIRCLE.controls)
    uneven[3, 2] = 0.0
    with pytest.raises(ValueError, match="row 3: expected intervals above 0"):
        write_draws(dataclasses.replace(CIRCLE, controls=uneven), 1, KEY, tmp_path / "draws")
    assert not (tmp_path / "draws").exists()


@record
class Drifting(jaxslam.protocols.Motion):
    """A balloon in a steady wind: x ← x + wind + w."""

    noise_cov: object
    wind: float = 0.5
    controls = ("up [1]",)
    noises = ("x [m]",)

    def step(self, pose, u, w):
        return pose + np.array([1.0, 0.0, 0.0]) * (self.wind + w[0])


def test_a_model_of_ones_own_is_written_and_named_where_settings_cannot_say_it(tmp_path):
    own = dataclasses.replace(
        CIRCLE, motion=Drifting([[0.01]]), controls=np.ones((4, 1)), noise_on="robot"
    )
    (run,) = write_draws(own, 1, KEY, tmp_path / "draws")
    readme = (tmp_path / "draws/README.md").read_text()
    assert "A balloon in a steady wind" in readme and "wind = 0.5" in readme
    assert "`dataset.toml` cannot say [motion] model" in readme
    assert (run / "odometry.csv").read_text().startswith("t [s],up [1]\n1.0,1.0\n2.0,1.0\n")
    with pytest.raises(
        ValueError, match=r"\[motion\] model: expected .ackermann. or .* got 'drifting: see"
    ):
        datasets.table(run)

    # Noise that standard deviations do not say; a rule with more options than the settings have.
    correlated = motion.Unicycle([[1e-4, 5e-5], [5e-5, 1e-4]])
    rule = {"associate": Nearest(0.99, ambiguous="leave"), "iterations": 2}
    world = dataclasses.replace(CIRCLE, motion=correlated, filter_options=rule)
    (run,) = write_draws(world, 1, KEY, tmp_path / "other")
    readme = (tmp_path / "other/README.md").read_text()
    assert "cannot say [motion] noise, [filter] associate" in readme
    assert "options that it does not say: iterations" in readme
    assert "[0.0001, 5e-05]" in readme
    with pytest.raises(ValueError, match=r"\[motion\] noise: expected 2 numbers"):
        datasets.table(run)


def test_states_that_settings_cannot_say_are_named(tmp_path):
    world = worlds.gyroscope(3)
    tied = np.array(world.pose_cov)
    tied[3, 4] = tied[4, 3] = 1e-4
    both = dataclasses.replace(
        world,
        motion=motion.Augmented(motion.Corrected(world.motion), "heading", noise=0.01),
        pose=(*world.pose, 0.0),
        pose_cov=np.diag([*np.diag(tied), 0.01]),
    )
    for name, changed, unsaid, reason in (
        ("tied", dataclasses.replace(world, pose_cov=tied), "[state] start_noise", "expected 2"),
        ("both", both, "[motion] model", "expected .ackermann. or"),
    ):
        (run,) = write_draws(changed, 1, KEY, tmp_path / name)
        readme = (tmp_path / name / "README.md").read_text()
        assert f"`dataset.toml` cannot say {unsaid}, so" in readme
        with pytest.raises(ValueError, match=re.escape(f"{unsaid}: ") + reason):
            datasets.table(run)


def test_noises_and_errors_that_settings_can_say(tmp_path):
    white = motion.Unicycle(motion.WhiteNoise(0.02, 0.03))
    uneven = np.array(CIRCLE.controls)
    uneven[1::2, 2] = 0.5
    shifted = sensors.Corrected(
        sensors.RangeBearing(sensors.RangeBearingNoise(0.1, 0.02, 0.05, 0.03), (0.1, 0.0, 0.2)),
        range=(1.02, 0.1),
    )
    robot = motion.Corrected(white, scale=(1.1, 0.9), wheels=(0.01, 0.02), heading=0.05)
    world = dataclasses.replace(
        CIRCLE, motion=robot, sensor=shifted, controls=uneven, noise_on="robot"
    )
    write_draws(world, 1, KEY, tmp_path / "draws")
    data, _ = folder_of(tmp_path / "draws")
    pose, landmark = np.array([0.3, -0.2, 0.4]), np.array([3.0, 2.0])
    for u in uneven[:2]:
        np.testing.assert_allclose(
            data.motion.noise_cov(pose, u), robot.noise_cov(pose, u), rtol=1e-12
        )
        w = np.array([0.1, -0.2])
        np.testing.assert_allclose(data.motion.step(pose, u, w), robot.step(pose, u, w), rtol=1e-12)
    z = shifted.observe(pose, landmark)
    np.testing.assert_allclose(data.sensor.observe(pose, landmark), z, rtol=1e-12)
    np.testing.assert_allclose(data.sensor.noise_cov(z), shifted.noise_cov(z), rtol=1e-12)


def test_a_recorded_log_may_begin_at_a_scan(tmp_path):
    ((truth, log),) = draws(CIRCLE, 1, KEY)
    control = np.array(log.control)
    control[0] = 0.0
    world = jaxslam.recorded_world(
        CIRCLE.motion,
        CIRCLE.sensor,
        [log._replace(control=control)],
        [truth.pose],
        truth.landmarks,
    )
    write_draws(world, 1, KEY, tmp_path / "draws")
    data, true = folder_of(tmp_path / "draws")
    np.testing.assert_array_equal(data.log.control, control)
    np.testing.assert_array_equal(true[:, 0], data.time)


# --- equations ------------------------------------------------------------------------------------

FUNCTIONS = {name: getattr(math, name) for name in ("sin", "cos", "tan", "sqrt", "atan2")} | {
    "wrap": lambda a: math.pi - (math.pi - a) % (2 * math.pi),
    "sinc": lambda a: math.sin(a) / a if a else 1.0,
}


def bare(name):
    return name.partition(" [")[0].replace(" ", "_")


def solved(model, names):
    """The names after the equations of a model, with its fields."""
    scope = FUNCTIONS | names
    inner = model
    while inner is not None:
        fields = (field.name for field in dataclasses.fields(inner))
        scope |= {name: getattr(inner, name) for name in fields if name not in scope}
        inner = getattr(inner, "motion", getattr(inner, "sensor", None))
        inner = (
            inner
            if isinstance(inner, jaxslam.protocols.Motion | jaxslam.protocols.Sensor)
            else None
        )
    exec(model.equations, scope)
    return scope


def no_noise(*_):
    raise AssertionError


MOTIONS = [build(no_noise) for build in motion.REGISTRY.values()]
MOTIONS.append(
    motion.Corrected(motion.PoseIncrement(no_noise), (1.1, 0.9), (0.01, 0.02), heading=0.3)
)
MOTIONS.append(motion.Augmented(MOTIONS[-1], ("wheels", "heading"), noise=0.1))
SENSORS = [build(no_noise) for build in sensors.REGISTRY.values()]
SENSORS.append(sensors.Corrected(sensors.RangeBearing(no_noise), (1.1, 0.2), axis=0.1))


@pytest.mark.parametrize("model", MOTIONS, ids=lambda model: type(model).__name__ + model.name)
def test_the_equations_of_a_motion_model_are_its_step(model):
    rng = np.random.default_rng(0)
    for size in (0.5, 0.0):
        pose, w = rng.normal(size=len(model.state)), size * rng.normal(size=len(model.noises))
        u = size * rng.normal(size=len(model.controls))
        names = dict(zip(map(bare, model.state), pose, strict=True))
        names |= dict(zip(map(bare, model.controls), u, strict=True))
        names |= {f"w_{bare(n)}": value for n, value in zip(model.noises, w, strict=True)}
        scope = solved(model, names)
        moved = [scope[f"{bare(name)}1"] for name in model.state]
        np.testing.assert_allclose(moved, model.step(pose, u, w), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("model", SENSORS, ids=lambda model: type(model).__name__ + model.name)
def test_the_equations_of_a_sensor_are_its_measurement(model):
    rng = np.random.default_rng(1)
    pose, landmark = rng.normal(size=3 + len(model.robot)), 2.0 + rng.random(len(model.landmark))
    robot = ("x_s", "y_s", "theta_s", *map(bare, model.robot))
    names = dict(zip(robot, pose, strict=True))
    names |= {f"l_{bare(n)}": value for n, value in zip(model.landmark, landmark, strict=True)}
    names |= {f"n_{bare(n)}": 0.0 for n in model.measurements}
    scope = solved(model, names)
    z = [scope[bare(name)] for name in model.measurements]
    expected = model.observe(jnp.asarray(pose), jnp.asarray(landmark))
    np.testing.assert_allclose(z, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    ("cov", "model"),
    [
        (motion.WhiteNoise(0.1, 0.2, 0.3), motion.Unicycle),
        (motion.VelocityNoise([0.1, 0.2, 0.3, 0.4, 0.5, 0.6]), motion.Velocity),
        (motion.OdometryNoise([0.1, 0.2, 0.3, 0.4]), motion.Odometry),
        (sensors.RangeBearingNoise(0.1, 0.2, 0.3, 0.4), sensors.RangeBearing),
    ],
)
def test_the_equations_of_a_noise_are_its_variances(cov, model):
    u = np.array([0.5, 0.4, 0.7])
    is_motion = issubclass(model, jaxslam.protocols.Motion)
    names, symbol = (model.noises, "w") if is_motion else (model.measurements, "n")
    entries = zip(map(bare, model.controls), u, strict=True) if is_motion else {"r": u[0]}.items()
    scope = FUNCTIONS | {f.name: getattr(cov, f.name) for f in dataclasses.fields(cov)}
    scope |= dict(entries)
    exec(cov.equations, scope)
    expected = cov(np.zeros(3), u) if is_motion else cov(u[:2])
    variances = [scope[f"variance_of_{symbol}_{bare(name)}"] for name in names]
    np.testing.assert_allclose(np.diag(variances), expected, rtol=1e-12)


def nearly_exact(model):
    """The model with next to no noise."""
    if isinstance(model, motion.Substeps | motion.Corrected | motion.Augmented):
        small = {"noise": 1e-12} if isinstance(model, motion.Augmented) else {}
        return dataclasses.replace(model, motion=nearly_exact(model.motion), **small)
    cov = model.noise_cov
    if isinstance(cov, motion.NoiseDensity):
        return dataclasses.replace(model, noise_cov=motion.NoiseDensity(cov.sigma * 1e-10))
    return dataclasses.replace(model, noise_cov=np.asarray(cov.cov) * 1e-20)


@pytest.mark.parametrize(
    "name", ["circle", "cloister", "webmap", "range_only", "gyroscope", "tyre", "radar"]
)
def test_the_readme_suffices_to_reckon_a_run_and_to_predict_its_scans(name, tmp_path):
    """The code of the README, run over the files of a world whose noise is next to none."""
    world = WORLDS[name]
    models = {}
    for kind in ("motion", "sensor"):
        models[kind] = nearly_exact(getattr(world, kind))
    state = list(map(bare, world.motion.state))
    world = dataclasses.replace(world, **models, pose_cov=np.zeros((len(state),) * 2))
    write_draws(world, 1, KEY, tmp_path)
    readme = (tmp_path / "README.md").read_text()
    move, frame, measure = re.findall(r"```python\n(.*?)```", readme, re.DOTALL)
    start = re.search(rf"{', '.join(state)} = (\[.*\])", readme)[0]

    def rows(path):
        head, *lines = (tmp_path / path).read_text().splitlines()
        return [bare(n) for n in head.split(",")], [line.split(",") for line in lines]

    scope = dict(FUNCTIONS)
    exec(start, scope)
    columns, lines = rows("runs/0000/odometry.csv")
    holds = "hold from t" in readme
    times = [float(line[0]) for line in lines]
    path = {times[0]: [scope[name] for name in state]} if holds else {}
    scope |= {f"w_{bare(n)}": 0.0 for n in draw_tables.single_motion(world).noises}
    for k, line in enumerate(lines[:-1] if holds else lines):
        scope |= dict(zip(columns, map(float, line), strict=True))
        scope["dt"] = times[k + 1] - times[k] if holds else 1.0
        exec(move, scope)
        scope |= {name: scope[f"{name}1"] for name in state}
        path[times[k + 1] if holds else times[k]] = [scope[name] for name in state]
    for line in rows("truth/0000/truth.csv")[1]:
        t, *robot = map(float, line)
        np.testing.assert_allclose(path[t], robot, atol=1e-7)
    points = {tag: (float(x), float(y)) for tag, x, y in rows("truth/0000/landmarks.csv")[1]}
    columns, lines = rows("runs/0000/measurements.csv")
    scope |= {f"n_{name}": 0.0 for name in columns[2:]}
    for line in lines[:20]:
        scope |= dict(zip(state, path[float(line[0])], strict=True))
        scope |= dict(zip(("l_x", "l_y"), points[line[1]], strict=True))
        exec(frame, scope)
        exec(measure, scope)
        z = [scope[name] for name in columns[2:]]
        np.testing.assert_allclose(z, list(map(float, line[2:])), atol=1e-6)
    assert "data association" not in readme


def test_the_readme_says_what_the_catalog_has(tmp_path):
    assert consistency.draws is draws
    for name in ("loop_bearing", "stationary"):
        write_draws(of_catalog(name), 1, KEY, tmp_path / name)
    loop = (tmp_path / "loop_bearing/README.md").read_text()
    assert "share = 0.1" in loop and "P0 =" in loop and "0.5 m to 5 m" in loop
    assert "t,tag,nu_1,nu_2,s_11,s_12,s_22" in loop
    spoilt = dataclasses.replace(
        CIRCLE, spurious=jaxslam.spurious.Spurious(clutter=0.5, missed=0.1, reach=4.0)
    )
    write_draws(spoilt, 1, KEY, tmp_path / "spoilt")
    readme = (tmp_path / "spoilt/README.md").read_text()
    assert "0.5 false measurements a scan" in readme and "within 4 m" in readme
