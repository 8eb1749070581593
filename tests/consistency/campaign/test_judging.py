"""Estimators from elsewhere: our own EKF as a stranger has its own numbers; faults are counted."""

import dataclasses

import jax
import numpy as np
import pytest
import worlds
from cases import refused, swept
from estimates import as_a_stranger

from jaxslam import catalog, scenarios, sensors
from jaxslam.consistency import Innovations, RunEstimate, judge_estimator
from jaxslam.consistency.campaign import monte_carlo
from jaxslam.simulation._worlds import world_of_run
from jaxslam.simulation.spurious import Spurious

RUNS, STEPS = 6, 20
KEY = worlds.key(2)
ONE = {"block": 8, "devices": jax.devices()[:1]}


def columns_alone(world, sensor):
    """The world with a third of the cloister's columns, seen by another sensor."""
    return dataclasses.replace(
        world, sensor=sensor, landmarks=np.asarray(world.landmarks)[::4], filter_options={}
    )


CLOISTER = scenarios.cloister(STEPS)
WORLDS = {
    "circle": scenarios.circle(STEPS),
    "cloister": dataclasses.replace(CLOISTER, landmarks=np.asarray(CLOISTER.landmarks)[::4]),
    "bearings": columns_alone(CLOISTER, sensors.BearingOnly([[0.02**2]], free=([4.0], [[1.5**2]]))),
    "ranges": columns_alone(CLOISTER, sensors.RangeOnly([[0.1**2]], free=([0.0], [[0.5**2]]))),
    "further states": worlds.gyroscope(STEPS),
}


@pytest.fixture(scope="module")
def ring():
    return worlds.ring(steps=10)


def same(a, b, without=()):
    """All numbers of two summaries that either has an input for."""
    assert (a.verdict, a.by) == (b.verdict, b.by)
    assert a.measures.keys() == b.measures.keys() - set(without)
    for name, average in a.measures.items():
        np.testing.assert_allclose(average, b.measures[name], rtol=1e-9, err_msg=name)
    for name, curve in a.curves.items():
        np.testing.assert_allclose(curve, b.curves[name], rtol=1e-9, atol=1e-12, err_msg=name)
    for name in a.per_run.keys() & b.per_run.keys():
        np.testing.assert_allclose(a.per_run[name], b.per_run[name], rtol=1e-9, err_msg=name)
    for name in a.noticed:
        np.testing.assert_allclose(a.noticed[name], b.noticed[name], rtol=1e-9)
    np.testing.assert_allclose(a.autocorrelation, b.autocorrelation, rtol=1e-9, atol=1e-12)
    for name in ("runs", "steps", "fused", "rejected", "singular_steps", "divergent"):
        assert a.counts[name] == b.counts[name]


@pytest.mark.parametrize("name", swept(WORLDS, "circle", "ranges", "further states"))
def test_our_ekf_as_a_stranger_has_every_number_of_the_campaign(name):
    world = WORLDS[name]
    ekf = catalog.FILTERS["ekf"](world)
    judged = judge_estimator(
        world, as_a_stranger(world, ekf), RUNS, KEY, filters={"ekf": ekf}, name="mine", **ONE
    )
    campaign = monte_carlo(world, {"ekf": ekf}, RUNS, KEY, **ONE)
    assert list(judged.filters) == ["mine", "ekf"]
    same(judged.filters["ekf"], campaign.filters["ekf"])
    same(judged.filters["mine"], campaign.filters["ekf"], without={"nees_own"})
    assert judged.divergence_limit == campaign.divergence_limit
    assert judged.runs == RUNS and set(judged.run_seconds) == {"mine"}
    assert "wall time of a run [s]" in str(judged)


def test_the_logs_are_those_of_the_campaign(ring):
    logs = []

    def watch(log):
        logs.append(log)
        log.control[:] = np.nan  # its own copy
        return np.zeros((10, 3)), np.tile(np.eye(3), (10, 1, 1))

    judge_estimator(ring, watch, 2, KEY, **ONE)
    for number, log in enumerate(logs):
        truth, drawn = world_of_run(ring, KEY, number)
        np.testing.assert_allclose(log.scan.z, drawn.scan.z, rtol=1e-12, atol=1e-12)
        assert isinstance(log.scan.z, np.ndarray) and log.scan.tag.dtype.kind == "i"


def near_truth(world, number, key=KEY):
    """Poses that err by draws of their covariance, and the error."""
    truth, _ = world_of_run(world, key, number)
    sigma = np.array([0.1, 0.2, 0.05])
    error = np.random.default_rng(number).standard_normal((world.steps, 3)) * sigma
    return np.asarray(truth.pose) - error, np.tile(np.diag(sigma**2), (world.steps, 1, 1)), error


def by_number(world, change):
    """A stranger that knows the truth: `change` of number, poses and covs is what it returns."""
    numbers = iter(range(1000))

    def estimate(log):
        number = next(numbers)
        poses, covs, _ = near_truth(world, number)
        return change(number, poses, covs)

    return estimate


def test_without_maps_and_innovations_their_measures_have_no_row(ring):
    campaign = judge_estimator(ring, by_number(ring, lambda n, *pair: pair), 30, KEY, **ONE)
    summary = campaign.filters["estimator"]
    errors = np.stack([near_truth(ring, number)[2] for number in range(30)])
    sigma = np.array([0.1, 0.2, 0.05])
    nees = ((errors / sigma) ** 2).sum(axis=2).mean()
    np.testing.assert_allclose(summary.measures["nees_pose"].value, nees, rtol=1e-9)
    rmse = np.sqrt((errors[..., :2] ** 2).sum(axis=2).mean())
    np.testing.assert_allclose(summary.measures["rmse_position"].value, rmse, rtol=1e-9)
    assert summary.verdict == "consistent" and not summary.faults
    (doubt,) = summary.doubts  # of accuracy alone, not of measurements
    assert doubt.startswith("inaccurate in 24 of 30 runs")
    absent = {"nis_per_dof", "nees_own", "nees_landmarks", "rmse_landmarks", "autocorrelation"}
    assert not summary.measures.keys() & (absent | {"log_likelihood"})
    assert "measured" not in summary.counts and summary.nis_band is None
    table = str(campaign).split("\n\n")[1]
    assert not any(word in table for word in ("landmark", "NIS", "autocorrelation"))


def test_what_is_wrong_with_a_run_is_counted_and_named(ring, tmp_path):
    def spoil(number, poses, covs):
        if number == 1:
            raise ZeroDivisionError("no\nway")
        if number == 2:
            return poses[:7], covs[:7]
        if number == 3:
            poses[4, 1] = np.inf
        if number == 4:
            poses[:, 2] = np.rad2deg(poses[:, 2])
        if number == 5:
            poses[:, 2] += 2 * np.pi  # unwrapped
        if number == 6:
            covs[3] *= -1
        if number == 7:
            covs[3, 0, 1] = 0.01
        return poses, covs

    campaign = judge_estimator(ring, by_number(ring, spoil), 40, KEY, name="mine", **ONE)
    summary = campaign.filters["mine"]
    assert summary.faults == {
        "raises ZeroDivisionError": (1,),
        "ends early": (2,),
        "not finite": (3,),
        "heading in degrees": (4,),
    }
    assert summary.not_finite_runs == [1, 2, 3, 4]
    assert (summary.counts["runs"], summary.counts["not_finite"]) == (36, 4)
    assert summary.verdict == "incomplete"  # 4 of 40 runs
    first, *others = summary.doubts
    assert first == (
        "4 of 40 runs are not judged: 1 raises ZeroDivisionError (run 1: no), 1 ends early (run 2: "
        f"7 of 10 rows), 1 not finite (run 3: poses, first at row 4), {first[first.index('1 head') :]}"
    )
    assert "1 heading in degrees (run 4: up to " in first
    assert first.endswith("averages of the 36 judged runs")
    assert "its covariance is not positive definite in run 6" in others
    assert "its covariance is not symmetric in run 7" in others
    assert summary.counts["indefinite_steps"] == summary.counts["asymmetric_steps"] == 1
    (note,) = campaign.notes
    assert note.startswith("mine, run 1, the first that failed:\nTraceback")
    assert note.endswith("ZeroDivisionError: no\nway") and "campaign/_judging.py" not in note
    for text in (str(campaign), campaign._repr_html_()):
        assert "is not judged in some runs: raises ZeroDivisionError in run 1; ends early" in text
        assert "in spoil" in text


def test_an_estimator_that_always_fails_is_counted_too(ring):
    def fails(log):
        raise RuntimeError("never")

    summary = judge_estimator(ring, fails, 3, KEY, **ONE).filters["estimator"]
    assert summary.verdict == "diverged" and summary.faults == {"raises RuntimeError": (0, 1, 2)}
    assert summary.doubts[0].endswith(
        "(run 0: never; run 1: never; run 2: never): there are no averages"
    )


def test_a_pose_beyond_all_measure_is_one_run_that_is_not_finite(ring):
    far = by_number(ring, lambda n, poses, covs: (poses + 1e200 * (n == 1), covs))
    summary = judge_estimator(ring, far, 3, KEY, **ONE).filters["estimator"]  # without a warning
    assert dict(summary.faults) == {"not finite": (1,)}


def test_fewer_rows_are_judged_where_they_are_and_so_are_filters():
    world = WORLDS["cloister"]
    ekf = catalog.FILTERS["ekf"](world)
    stranger = as_a_stranger(world, ekf)

    def seldom(log):
        estimate = stranger(log)
        return estimate._replace(
            poses=estimate.poses[4::5],
            covs=estimate.covs[4::5],
            maps=tuple(part[4::5] for part in estimate.maps),
        )

    options = {"filters": {"ekf": ekf}, "stride": 5, **ONE}
    few = judge_estimator(world, seldom, RUNS, KEY, **options)
    full = judge_estimator(world, stranger, RUNS, KEY, **options)
    whole = monte_carlo(world, {"ekf": ekf}, RUNS, KEY, **ONE).filters["ekf"]
    for campaign in (few, full):
        same(campaign.filters["estimator"], campaign.filters["ekf"], without={"nees_own"})
    ours = few.filters["ekf"]
    assert few.steps == 4 and ours.curves["nees_pose"].shape == (4,)
    for name in ("nees_pose", "nees_heading", "rmse_position"):
        np.testing.assert_allclose(ours.curves[name], whole.curves[name][4::5], rtol=1e-9)
    for name in ("nis_per_dof", "log_likelihood", "autocorrelation", "rmse_landmarks"):
        np.testing.assert_allclose(ours.measures[name], whole.measures[name], rtol=1e-9)
    assert "judged at 4 of 20 steps" in few.notes[0]
    assert few.first["estimator"][0].pose.shape == few.first["ekf"][1].pose.shape == (4, 3)


def test_a_final_map_alone_has_an_error_and_a_nees_of_the_last_step(ring):
    ekf = worlds.ekf(ring)
    stranger = as_a_stranger(ring, ekf)

    def final_map(log):
        estimate = stranger(log)
        return estimate._replace(maps=tuple(part[-1] for part in estimate.maps), innovations=None)

    with_final = judge_estimator(ring, final_map, RUNS, KEY, **ONE)
    every_step = judge_estimator(ring, stranger, RUNS, KEY, **ONE)
    a, b = (c.filters["estimator"].measures for c in (with_final, every_step))
    np.testing.assert_allclose(a["rmse_landmarks"], b["rmse_landmarks"], rtol=1e-9)
    last = judge_estimator(ring, stranger, RUNS, KEY, stride=10, **ONE).filters["estimator"]
    np.testing.assert_allclose(a["nees_landmarks"], last.measures["nees_landmarks"], rtol=1e-9)
    assert "nis_per_dof" not in a
    assert "the landmark NEES is of its final maps" in with_final.notes[0]


def test_nis_and_likelihood_are_made_of_innovations(ring):
    rng = np.random.default_rng(0)
    S = np.array([[0.04, 0.01], [0.01, 0.02]])
    nu = rng.standard_normal((RUNS, 10, 6, 2)) @ np.linalg.cholesky(S).T

    def change(number, poses, covs):
        rows = np.repeat(np.arange(10), 6)
        tags = np.tile(np.arange(6), 10)
        covs_of_nu = np.tile(S, (60, 1, 1))
        covs_of_nu[0] = -S if number == 0 else S
        innovations = rows, tags, nu[number].reshape(60, 2), covs_of_nu
        return RunEstimate(poses, covs, None, innovations)

    summary = judge_estimator(ring, by_number(ring, change), RUNS, KEY, **ONE).filters["estimator"]
    squares = np.einsum("rtmi,ij,rtmj->rtm", nu, np.linalg.inv(S), nu)
    squares[0, 0, 0] = 0.0
    dof = np.array([118] + [120] * 5)
    ratios = squares.sum(axis=(1, 2)) / dof
    np.testing.assert_allclose(summary.per_run["nis_per_dof"], ratios, rtol=1e-9)
    constant = np.log(np.linalg.det(2 * np.pi * S))
    likely = -0.5 * (squares.sum(axis=(1, 2)) + dof / 2 * constant)
    np.testing.assert_allclose(summary.per_run["log_likelihood"], likely, rtol=1e-9)
    white = np.linalg.solve(np.linalg.cholesky(S), nu[..., None])[..., 0][1:]
    product = (white[:, 1:] * white[:, :-1]).sum(axis=(1, 2, 3))
    energy = (white**2).sum(axis=(2, 3))
    length = np.sqrt(energy[:, 1:].sum(axis=1) * energy[:, :-1].sum(axis=1))
    np.testing.assert_allclose(summary.per_run["autocorrelation"][1:], product / length, rtol=1e-9)
    assert (summary.counts["fused"], summary.counts["singular"]) == (359, 1)
    assert summary.verdict == "consistent"


def test_maps_of_worlds_without_identities_are_not_judged(ring):
    world = dataclasses.replace(ring, spurious=Spurious())
    stranger = as_a_stranger(world, worlds.ekf(world))
    summary = judge_estimator(world, stranger, 2, KEY, **ONE).filters["estimator"]
    assert "nis_per_dof" in summary.measures
    assert not summary.measures.keys() & {"rmse_landmarks", "nees_landmarks", "precision"}


def test_what_is_beside_the_pose_is_judged_where_it_is_handed_over():
    """By NumPy; covariances that are none are counted, and named."""
    world = worlds.gyroscope(STEPS)
    sigma, drawn = np.array([0.02, 0.01]), np.random.default_rng(0).standard_normal((4, STEPS, 2))
    covs = np.tile(np.diag(sigma**2), (STEPS, 1, 1))

    def change(number, poses, pose_covs):
        truth, _ = world_of_run(world, KEY, number)
        further = np.asarray(truth.further) - sigma * drawn[number]
        if number == 1:
            return poses, pose_covs
        own = np.tile([[1e-4, 1e-3], [1e-3, 1e-4]], (STEPS, 1, 1)) if number == 3 else covs
        return RunEstimate(poses, pose_covs, further=further, further_covs=own)

    summary = judge_estimator(world, by_number(world, change), 4, KEY, **ONE).filters["estimator"]
    judged = drawn[[0, 2]] ** 2
    expected = {"nees_of_bias": judged[..., 0], "nees_of_scale": judged[..., 1]}
    expected["nees_further"] = judged.mean(axis=2)
    for name, values in expected.items():
        assert summary.measures[name].value == pytest.approx(values.mean(), rel=1e-9)
    assert summary.faults == {"has no covariance beside the pose": (3,)}
    assert summary.counts["runs"] == 3 and "run 3: first at row 0" in summary.doubts[0]


EYE = np.tile(np.eye(3), (10, 1, 1))
NU = [0], [0], [[0.0, 0.0]], [np.eye(2)]


@refused(
    (None, {}, "judge_estimator: function: expected a function of the log, got None"),
    (lambda log: 3, {}, "estimator, run 0: expected .poses, covs., or an object"),
    (lambda log: (np.zeros((10, 2)), EYE), {}, "run 0: poses: expected shape .K, 3., got .10, 2."),
    (lambda log: (np.zeros((10, 3)), EYE[:9]), {}, "run 0: covs: expected shape .10, 3, 3., got"),
    (lambda log: (np.zeros((11, 3)), np.zeros((11, 3, 3))), {}, "poses: expected 10 rows, got 11"),
    (
        lambda log: (np.zeros((10, 3), complex), EYE),
        {},
        "poses: expected real numbers, got array",
    ),
    (lambda log: (["a"] * 10, EYE), {}, "poses: expected real numbers, got .'a', 'a'"),
    (
        lambda log: RunEstimate(np.zeros((10, 3)), EYE, ([[0, 0]], [np.eye(2)], [6])),
        {},
        "run 0: maps: tags: expected whole numbers from -1 to 5, got 6",
    ),
    (
        lambda log: RunEstimate(np.zeros((10, 3)), EYE, ([[0, 0]] * 2, [np.eye(2)] * 2, [1, 1])),
        {},
        "maps: expected each tag once, got 1 twice",
    ),
    (
        lambda log: RunEstimate(np.zeros((10, 3)), EYE, None, Innovations([10], *NU[1:])),
        {},
        "innovations: rows: expected whole numbers from 0 to 9, got 10",
    ),
    (
        lambda log: RunEstimate(np.zeros((10, 3)), EYE, None, ([0], [0], [[0.0]], [[[1.0]]])),
        {},
        "innovations: expected ν of 2 numbers, as a measurement has, got 1",
    ),
    (
        lambda log: RunEstimate(np.zeros((10, 3)), EYE, further=np.zeros((10, 1))),
        {},
        "further: expected both or none of further and further_covs",
    ),
    (
        lambda log: RunEstimate(np.zeros((10, 3)), EYE, None, None, EYE[:, 0, :1], EYE[:, :1, :1]),
        {},
        "further: expected 0 numbers a row, as the robot has beside its pose, got 1",
    ),
    (len, {"stride": 3}, "judge_estimator: stride: expected a divisor of the 10 steps, got 3"),
    (len, {"name": " "}, "judge_estimator: name: expected a name, as 'mine', got ' '"),
    (len, {"name": "ekf", "filters": {"ekf": 0}}, "name: 'ekf' is the name of a filter"),
    (len, {"filters": ["ekf"]}, "judge_estimator: filters: expected {name: filter}, got a list"),
)
def test_what_is_no_estimate_is_refused(function, options, ring):
    judge_estimator(ring, function, 2, KEY, **ONE, **options)


def test_the_report_is_that_of_a_campaign(ring, tmp_path, monkeypatch):
    campaign = judge_estimator(
        ring, by_number(ring, lambda n, *pair: pair), 3, KEY, filters={"ekf": worlds.ekf(ring)}
    )
    names = {path.name for path in campaign.save(tmp_path / "out")}
    assert {"report.html", "consistency.json", "measures.csv", "nees.png", "map.png"} <= names
