"""Two filters on the same draws: `Campaign.compare` is a paired t test, and holds its level."""

import dataclasses

import drawn
import numpy as np
import pytest
import scipy.stats
import worlds

from jaxslam.consistency import Measure
from jaxslam.results import _report

WORLD = worlds.ring()
RUNS = 12


@pytest.fixture(scope="module")
def campaign():
    """Two filters over 12 runs of the ring."""
    candidates = {"ekf": worlds.ekf(WORLD), "other": worlds.no_cross_covariance(WORLD)}
    return worlds.campaign(WORLD, candidates, RUNS)


def made_up(columns, runs, **changes):
    """A campaign of filters by name with these numbers of each run, and changes of summaries."""
    summaries = {
        name: dataclasses.replace(
            drawn.summary(name, steps=1), per_run=per_run, **changes.get(name, {})
        )
        for name, per_run in columns.items()
    }
    return drawn.campaign(
        columns, 1, filters=summaries, runs=runs, run_numbers=np.arange(runs), published={}
    )


def per_run_of_one_sensor(rng, shape, steps=20, q=0.1, r=0.5):
    """A robot on a line, and for each of two equal sensors the Kalman filter that has it alone: the
    numbers (…) of each run by the columns of `Summary.per_run`, in NumPy. Linear and Gaussian, so
    both are honest and equally good; they share the noise of the motion."""
    x, x_hat, P = np.zeros(shape), np.zeros((2, *shape)), 1.0
    x = x + rng.normal(size=shape)
    sums = dict.fromkeys(("nees_pose", "nis_per_dof", "square_position", "log_likelihood"), 0.0)
    for _ in range(steps):
        x, P = x + q * rng.normal(size=shape), P + q**2
        nu = x + r * rng.normal(size=(2, *shape)) - x_hat
        S = P + r**2
        x_hat, P = x_hat + P / S * nu, P * r**2 / S
        square = (x - x_hat) ** 2
        sums["nees_pose"] += square / P / steps
        sums["nis_per_dof"] += nu**2 / S / steps
        sums["square_position"] += square / steps
        sums["log_likelihood"] += -0.5 * (nu**2 / S + np.log(2 * np.pi * S))
    sums["square_final"] = square
    return [{name: total[i] for name, total in sums.items()} for i in range(2)]


def test_without_a_difference_the_interval_leaves_zero_out_in_5_percent_of_campaigns():
    campaigns, runs = 400, 20
    first, second = per_run_of_one_sensor(np.random.default_rng(0), (campaigns, runs))
    left_out, narrower = [], []
    for i in range(campaigns):
        columns = {"a": {k: v[i] for k, v in first.items()}}
        columns |= {"b": {k: v[i] for k, v in second.items()}}
        pairs = made_up(columns, runs).compare("a", "b").measures
        left_out.append([not p.difference.low <= 0 <= p.difference.high for p in pairs.values()])
        narrower.append([p.narrower for p in pairs.values()])
    assert list(pairs) == ["nees_pose", "nis_per_dof", "rmse_position", "rmse_final"] + [
        "log_likelihood"
    ]
    share = np.mean(left_out, axis=0)
    assert ((share >= 0.03) & (share <= 0.07)).all(), share
    assert np.median(narrower, axis=0)[0] > 1  # the noise of the motion is in both


def test_differences_are_those_of_a_paired_t_test(campaign):
    comparison = campaign.compare("other", "ekf")
    first, second = (campaign.filters[name].per_run for name in ("other", "ekf"))
    assert (comparison.runs, comparison.lost) == (RUNS, {"other": [], "ekf": []})
    columns = {
        "nees_pose": "nees_pose",
        "nis_per_dof": "nis_per_dof",
        "rmse_position": "square_position",
        "rmse_heading_deg": "square_heading",
        "rmse_final": "square_final",
        "rmse_landmarks": "square_landmarks",
        "log_likelihood": "log_likelihood",
    }
    assert set(comparison.measures) == set(columns)
    for key, column in columns.items():
        a, b = first[column], second[column]
        pair = comparison.measures[key]
        is_better = a > b if key == "log_likelihood" else a < b
        if key.startswith("rmse"):
            scale = np.rad2deg(1.0) if key.endswith("deg") else 1.0
            roots = [scale * np.sqrt(np.mean(squares)) for squares in (a, b)]
            np.testing.assert_allclose([pair.first, pair.second], roots)
            # The jackknife: RUNS times the RMSE less RUNS - 1 times that without a run.
            a, b = (
                np.array(
                    [
                        RUNS * root - (RUNS - 1) * scale * np.sqrt(np.mean(np.delete(squares, i)))
                        for i in range(RUNS)
                    ]
                )
                for squares, root in zip((a, b), roots, strict=True)
            )
            center = roots[0] - roots[1]
        else:
            np.testing.assert_allclose([pair.first, pair.second], [a.mean(), b.mean()])
            center = a.mean() - b.mean()
        plain = scipy.stats.ttest_rel(a, b).confidence_interval(0.95)
        half = (plain.high - plain.low) / 2
        np.testing.assert_allclose(pair.difference, (center, center - half, center + half))
        apart = np.sqrt((a.var(ddof=1) + b.var(ddof=1)) / (a - b).var(ddof=1))
        np.testing.assert_allclose(pair.narrower, apart)
        assert pair.share == (None if key.startswith("n") else np.mean(is_better))
    averages = campaign.filters["other"].measures
    for key in ("nees_pose", "rmse_position", "rmse_landmarks", "rmse_final", "log_likelihood"):
        np.testing.assert_allclose(comparison.measures[key].first, averages[key].value)


def test_the_final_error_is_that_of_the_last_step(campaign):
    for name, (truth, estimate) in campaign.first.items():
        off = truth.pose[-1, :2] - estimate.pose[-1, :2]
        final = campaign.filters[name].per_run["square_final"]
        np.testing.assert_allclose(final[0], off @ off)
        assert final.shape == (RUNS,)


def test_the_other_way_round_has_the_other_sign(campaign):
    there, back = campaign.compare("ekf", "other"), campaign.compare("other", "ekf")
    for key, pair in there.measures.items():
        mirrored = back.measures[key]
        value, low, high = mirrored.difference
        np.testing.assert_allclose(pair.difference, (-value, -high, -low), atol=1e-12)
        np.testing.assert_allclose(pair.narrower, mirrored.narrower)
        if pair.share is not None:
            np.testing.assert_allclose(pair.share + mirrored.share, 1)


def test_a_filter_and_its_copy_have_no_difference(campaign):
    ekf = campaign.filters["ekf"]
    twice = dataclasses.replace(campaign, filters={"a": ekf, "b": ekf}).compare("a", "b")
    for pair in twice.measures.values():
        assert pair.difference == (0, 0, 0) and pair.narrower == np.inf
        assert pair.share in (None, 0.5)
    assert "∞ ×" in str(twice)


def test_lost_runs_are_left_out_and_counted():
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=(2, 30))
    a[3], b[3], b[7] = np.nan, np.nan, np.nan
    b[9] = np.nan  # a run that is finite, without this number
    columns = {"a": {"log_likelihood": a}, "b": {"log_likelihood": b}}
    lost = {"a": {"not_finite_runs": [3]}, "b": {"not_finite_runs": [3, 7]}}
    comparison = made_up(columns, 30, **lost).compare("a", "b")
    kept = np.isfinite(a + b)
    (pair,) = comparison.measures.values()
    assert (comparison.runs, pair.runs) == (28, 27) and comparison.lost == {"a": [3], "b": [3, 7]}
    plain = scipy.stats.ttest_rel(a[kept], b[kept]).confidence_interval(0.95)
    np.testing.assert_allclose(pair.difference[1:], plain)
    text = " ".join(str(comparison).split())
    assert "2 of 30 runs are left out: a has no numbers in 1, b in 2" in text
    assert "log-likelihood: of the 27 runs in which both have a number" in text


def test_what_makes_an_interval_doubtful_is_said(campaign):
    rng = np.random.default_rng(2)
    few = rng.normal(size=(2, 5))
    many = rng.normal(size=(2, 40))
    many[0, 11] = 1e3
    for values, sentence in (
        (few, "5 runs are few"),
        (many, "log-likelihood: a single run has over half of the squared deviations"),
    ):
        columns = {name: {"log_likelihood": row} for name, row in zip("ab", values, strict=True)}
        (doubt,) = made_up(columns, values.shape[1]).compare("a", "b").doubts
        assert doubt.startswith(sentence)
    counts = {"a": {"counts": {"fused": 7}}, "b": {"counts": {"fused": 1200}}}
    columns = {
        name: {"log_likelihood": row} for name, row in zip("ab", few.repeat(5, 1), strict=True)
    }
    (doubt,) = made_up(columns, 25, **counts).compare("a", "b").doubts
    assert doubt.startswith("log-likelihood: a fused 7 measurements and b 1,200; comparable only")
    assert [doubt[:15] for doubt in campaign.compare("ekf", "other").doubts] == ["12 runs are few"]


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (("ekv", "other"), r"expected one of ekf, other, got 'ekv' \(did you mean ekf\?\)"),
        (("ekf", "others"), r"expected one of ekf, other, got 'others' \(did you mean other\?\)"),
        (("ekf", ["ekf"]), r"expected one of ekf, other, got \['ekf'\] \(did you mean ekf\?\)"),
        (("ekf", "ekf"), "expected two filters, got 'ekf' twice"),
    ],
)
def test_names_that_are_none_are_refused(campaign, names, message):
    with pytest.raises(ValueError, match=f"^Campaign.compare: {message}$"):
        campaign.compare(*names)


def test_a_single_run_is_refused_and_in_the_table_has_no_differences():
    columns = {name: {"log_likelihood": np.array([1.0])} for name in ("a", "b")}
    single = made_up(columns, 1)
    with pytest.raises(
        ValueError, match=r"at least 2 runs that both a and b finished, got 1 of 1$"
    ):
        single.compare("a", "b")
    compared = _report.campaign_table(dataclasses.replace(single, reference="b"))
    assert "a - b: there are no differences, since under two runs are left" in compared
    with pytest.raises(ValueError, match=r"^Campaign: reference: expected one of a, b, got 'c'"):
        dataclasses.replace(single, reference="c")


def test_every_other_filter_of_a_sweep_is_compared_with_the_reference(campaign):
    ekf, other = campaign.filters.values()
    swept = dataclasses.replace(
        campaign, filters={"1": ekf, "2": other, "4": other}, reference="1", published={}
    )
    assert [(pair.first, pair.second) for pair in swept.comparisons] == [("2", "1"), ("4", "1")]
    text = str(swept)
    assert text.count(f"{RUNS} runs in pairs") == 2
    assert campaign.comparisons == [] and "in pairs" not in str(campaign)
    pair = swept.comparisons[1].measures["rmse_position"]
    assert text.count(f"{pair.difference.value:.4g} ± ") == 2


def test_a_measure_says_which_of_two_is_better():
    with pytest.raises(ValueError, match=r"^measure mine: better: expected one of"):
        Measure("mine", "mine", better="lower")
