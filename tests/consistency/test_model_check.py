"""Logs beside their twins: p-values, statistics by plain NumPy, and faults that are found."""

import dataclasses
from functools import cache

import drawn_logs
import jax
import numpy as np
import pytest
from cases import refused
from scipy import stats

from jaxslam import catalog, sensors
from jaxslam.consistency import CheckedStatistic, ModelCheck, check_models
from jaxslam.consistency import _log_statistics as log_statistics
from jaxslam.consistency import _model_check as model_check
from jaxslam.consistency import _planted_faults as planted_faults
from jaxslam.core.types import Info, Status
from jaxslam.results import plot
from jaxslam.simulation import twin

KEY = jax.random.key(2)
RNG = np.random.default_rng(4)
STEPS, TWINS, LOGS = 100, 40, 24


def checked(data, key=KEY, twins=TWINS):
    world = twin(data)
    return check_models(world, catalog.FILTERS["ekf"](world), data.log, twins=twins, key=key)


@cache
def honest():
    """Checks of logs that are drawn from the models."""
    world = drawn_logs.yard(STEPS)
    return [checked(drawn_logs.drawn(world, seed), jax.random.key(seed)) for seed in range(LOGS)]


def test_p_values_of_logs_of_the_models_are_uniform():
    """Of a few logs here, of 200 in `python -m benchmarks --only twins`."""
    names = {each.statistic.name for each in honest()[0].statistics}
    assert len(names) > 35
    for name in names:
        p = [
            each.p for check in honest() for each in check.statistics if each.statistic.name == name
        ]
        assert stats.kstest(p, "uniform").pvalue > 1e-4, name
    assert sum(bool(check.findings) for check in honest()) <= 5  # of 24 by chance 1 in 10^4
    quiet = next(check for check in honest() if not check.findings)
    assert "nothing in these statistics contradicts the models" in str(quiet)


def test_a_delay_is_found_and_named():
    """The odometry of the log is that of 0.15 s later."""
    data = drawn_logs.drawn(drawn_logs.yard(STEPS, noise=(0.03, 0.02)))
    control = np.array(data.log.control)
    late = 0.15 / drawn_logs.DT
    control[:-1] = (1 - late) * control[:-1] + late * control[1:]
    check = checked(dataclasses.replace(data, log=data.log._replace(control=control)))
    (found,) = [each for each in check.statistics if each.statistic.name == "fault, delay"]
    assert found.contradicts and abs(found.statistic.value - 0.15) < 0.05
    assert any("stamped" in line and "--calibrate delay" in line for line in check.findings)
    assert "late" in str(check)


def test_outliers_are_found_in_the_tails():
    data = drawn_logs.drawn(drawn_logs.yard(STEPS))
    z = np.array(data.log.scan.z)
    wrong = RNG.random(z.shape[:2]) < 0.05
    z[wrong] += RNG.normal(size=(wrong.sum(), 2)) * [0.4, 0.16]
    check = checked(drawn_logs.with_scan(data, z=z))
    worst = check.statistics[0]
    assert worst.statistic.family in ("kurtosis", "tail") and worst.contradicts
    assert "[filter] gate" in worst.finding


def test_the_figure_has_a_panel_for_each_statistic():
    check = honest()[0]
    figure = plot.check_figure(check)
    assert len([a for a in figure.axes if a.axison]) == len(check.statistics)


# --- by plain NumPy ---------------------------------------------------------------------------------


def made_up(rows=400, seed=0):
    """The info and the scans of a filter of two landmarks, with innovations that are drawn."""
    rng = np.random.default_rng(seed)
    cov = np.array([[0.04, 0.006], [0.006, 0.01]])
    nu = rng.normal(size=(rows, 2, 2)) @ np.linalg.cholesky(cov).T
    fused = rng.random((rows, 2)) < 0.7
    nis = np.einsum("tmi,ij,tmj->tm", nu, np.linalg.inv(cov), nu)
    slot = np.tile([0, 1], (rows, 1))
    status = np.where(fused, Status.FUSED, Status.EMPTY)
    status[5, 0] = Status.REJECTED
    covs = np.broadcast_to(cov, (rows, 2, 2, 2))
    likelihood = -0.5 * np.where(fused, nis, 0).sum(axis=1)
    info = Info(nis, 2 * fused, nu, covs, slot, status, likelihood)
    z = rng.uniform([2.0, -1.0], [6.0, 1.0], (rows, 2, 2)) + nu
    return info, z, status != Status.EMPTY


def test_statistics_are_those_of_their_names():
    info, z, valid = made_up()
    rates = log_statistics.Rates(RNG.random(400), RNG.normal(size=400))
    sensor = sensors.RangeBearing(np.eye(2))
    time = np.arange(400.0)
    found = log_statistics.statistics_of(info, z, valid, sensor, rates, time, ([], []))
    value = {each.name: each.value for each in found}
    fused = info.status == Status.FUSED
    nu, nis, cov = info.innovation[fused], info.nis[fused], info.innovation_cov[0, 0]
    row = np.nonzero(fused)[0]
    unit = nu / np.sqrt(np.diag(cov))
    white = nu @ np.linalg.inv(np.linalg.cholesky(cov)).T
    ranges = (z[fused] - nu)[:, 0]
    assert value["NIS / dof"] == pytest.approx(nis.mean() / 2)
    assert value["size, bearing"] == pytest.approx((unit[:, 1] ** 2).mean())
    assert value["mean, range"] == pytest.approx(nu[:, 0].mean())
    order = np.argsort(ranges, kind="stable")
    last = np.array_split(order, 3)[2]
    assert value["NIS / dof by range, upper third"] == pytest.approx(nis[last].mean() / 2)
    expected = np.corrcoef(unit[:, 1], rates.turn[row])[0, 1]
    assert value["correlation, bearing with turn rate"] == pytest.approx(expected)
    assert value["NIS trend"] == pytest.approx(np.corrcoef(nis, time[row])[0, 1])
    moments = stats.kurtosis(unit[:, 0], fisher=False)  # about the mean, which is small
    assert value["kurtosis, range"] == pytest.approx(moments, rel=0.02)
    beyond = (2 * nis / nis.mean() > stats.chi2.ppf(0.99, 2)).sum()
    assert beyond - 1 < len(nis) * value["tail, above the 99 % quantile"] <= beyond
    assert value["rejected by the gate"] == pytest.approx(1 / valid.sum())
    products, squares = 0.0, np.zeros(2)
    for slot in (0, 1):
        of = white[info.slot[fused] == slot]
        products += (of[3:] * of[:-3]).sum()
        squares += (of[3:] ** 2).sum(), (of[:-3] ** 2).sum()
    assert value["autocorrelation, lag 3"] == pytest.approx(products / np.sqrt(squares.prod()))


def test_a_filter_that_is_lost_on_its_own_twins_is_doubted():
    def check(nis):
        size = log_statistics.Statistic("NIS / dof", "", nis, np.log(nis))
        row = CheckedStatistic(size, np.full(20, nis), 10, 1.0, 1.0, 0.0, "")
        return ModelCheck("yard", "ekf", 20, (row,))

    assert not check(1.1).doubt and "lost" not in str(check(1.1))
    assert "NIS / dof 320: what fits says little" in str(check(320.0)) and check(0.5).doubt


def test_the_count_of_a_tail_falls_by_one_at_each_value():
    values, limits = np.array([1.0, 2.0, 2.0, 5.0]), np.array([1.5, 2.0, 3.5, 5.0, 10.0])
    counts = [log_statistics.tail_count(values, limit) for limit in limits]
    np.testing.assert_allclose(counts, [2.5, 1.0, 0.5, 0.0, -0.5])
    assert (
        log_statistics.tail_count(values[:0], 1.0) == log_statistics.tail_count(values, 1e30) == -1
    )
    fine = [log_statistics.tail_count(values, limit) for limit in np.linspace(0.1, 9, 500)]
    assert (np.diff(fine) <= 0).all()


def test_a_fault_below_0_is_said_by_its_own_words():
    faults, _ = planted_faults.faults_of(twin(drawn_logs.drawn(drawn_logs.yard())))
    by_name = {fault.name: fault for fault in faults}
    for name, amount, text in (
        ("delay", 0.05, "measurements are stamped 0.05 s (twins ± 0.01) late"),
        ("delay", -0.05, "measurements are stamped 0.05 s (twins ± 0.01) early"),
        (
            "longer",
            -0.02,
            "distances are measured 2 % (twins ± 1) too short, or travel is recorded"
            " that much too long",
        ),
        (
            "bending",
            -0.1,
            "the odometry records a turn of -0.1 rad/m (twins ± 0.01) of travel that is none",
        ),
    ):
        assert by_name[name].says(amount, 0.01) == text


def test_the_amount_of_a_fault_is_that_of_weighted_least_squares():
    info, _, _ = made_up(rows=50)
    fused = info.status == Status.FUSED
    change = RNG.normal(size=(50, 2, 2)) * fused[..., None]
    covs = np.where(fused[..., None, None], info.innovation_cov, 0.0)
    (fault, *_), _ = planted_faults.faults_of(twin(drawn_logs.drawn(drawn_logs.yard())))
    pair = np.stack([0 * change, fault.amount * change])
    ((shape,), slips) = planted_faults.shapes_of([fault], False, pair, covs)
    inverse = np.linalg.inv(info.innovation_cov[0, 0])
    top = np.einsum("kz,zy,ky->", change[fused], inverse, info.innovation[fused])
    bottom = np.einsum("kz,zy,ky->", change[fused], inverse, change[fused])
    nu = np.where(fused[..., None], info.innovation, 0.0)
    assert shape.amount(nu) == pytest.approx(top / bottom) and not slips


def test_ranks_are_uniform_and_go_on_beyond_the_twins():
    draws = RNG.normal(size=(4000, 100))
    p = np.array([model_check.two_sided(row[0], row[1:])[1] for row in draws])
    for level in (0.02, 0.1, 0.5):
        assert abs((p <= level).mean() - level) < 4 * np.sqrt(level / 4000) + 0.01
    assert (p < 1e-3).mean() < 4e-3
    rank, p, distance = model_check.two_sided(10.0, draws[0])
    assert rank == 100 and p < 1e-8 and distance > 5
    assert model_check.two_sided(0.0, np.zeros(20), 1.0)[1] == 1
    assert model_check.two_sided(1.0, np.zeros(20), 1.0)[1] > 0.01


def test_holm_is_that_of_its_definition():
    p, same = np.array([0.01, 0.04, 0.03, 0.005]), np.ones(4)
    np.testing.assert_allclose(model_check.holm(p, same), [0.03, 0.06, 0.06, 0.02])
    np.testing.assert_allclose(model_check.holm(np.array([0.9, 0.8]), same[:2]), [1, 1])
    # Half of the level for the first: 0.01 · 2 is the least, then the others as if alone.
    weights = np.array([3.0, 1.0, 1.0, 1.0])
    expected = [0.02, 0.06, 0.06, 0.02]
    np.testing.assert_allclose(model_check.holm(p, weights), expected)


@refused(
    (lambda: {"twins": 3}, "twins: expected an integer >= 20, got 3"),
    (lambda: {"world": drawn_logs.yard()}, "world: expected a Twin"),
    (
        lambda: {"filter": catalog.ALL["dead_reckoning"](drawn_logs.yard(STEPS))},
        "filter: .*innovations",
    ),
    (
        lambda: {"log": drawn_logs.drawn(drawn_logs.yard(60)).log},
        "log: expected .*measurement slots",
    ),
    told="check_models: ",
)
def test_refused(changed):
    data = drawn_logs.drawn(drawn_logs.yard(STEPS))
    world = twin(data)
    given = {"world": world, "filter": catalog.FILTERS["ekf"](world), "log": data.log}
    check_models(**(given | {"twins": TWINS, "key": KEY} | changed()))
