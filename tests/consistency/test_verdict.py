"""The verdict: its false alarms and its power on an exactly linear problem, and what it says."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.stats

from benchmarks.verdict import averages, problem, rejected, verdicts
from jaxslam import Scenario, motion, sensors, stats
from jaxslam.consistency import Average, _intervals, _verdict, judge
from jaxslam.consistency.campaign import monte_carlo
from jaxslam.consistency.campaign._candidates import check_noise

pytestmark = pytest.mark.decision

SENSOR = sensors.RangeBearing(np.eye(2))

COUNTS = {"runs": 20, "not_finite": 0, "divergent": 0}


@pytest.fixture(scope="module", params=[False, True], ids=["no compass", "compass"])
def honest(request):
    return averages(problem(request.param), 40_000, seed=3)


@pytest.mark.parametrize("runs", [8, 20, 100])
def test_an_honest_filter_is_rejected_in_five_campaigns_of_a_hundred(honest, runs):
    """5 ± 1 %, and three standard errors of a share among so many campaigns: 0.9, 1.5 and 3.3 %."""
    found = verdicts(*honest, runs)
    slack = 3 * np.sqrt(0.05 * 0.95 / len(found))
    assert 0.04 - slack < rejected(found) < 0.06 + slack
    for test in ("nees_pose", "nis_per_dof"):
        assert 0.01 - slack / 2 < rejected(found, test) < 0.035 + slack / 2
    alone = verdicts(honest[0], None, runs)  # the same test, with the same level
    assert rejected(alone) == rejected(alone, "nees_pose") == rejected(found, "nees_pose")


def test_what_is_said_to_be_noticed_is_noticed(honest):
    """At least nine times in ten, three standard errors of 2,000 campaigns granted."""
    nees, _ = honest
    most = np.median([found.noticed["nees_pose"][1] for found in verdicts(nees, None, 20)])
    assert 3.5 < most < 5.5
    found = verdicts(most / 3 * nees, None, 20)
    assert np.mean([v.word == "optimistic" for v in found]) > 0.9 - 3 * np.sqrt(0.09 / 2000)


@pytest.mark.parametrize("compass", [False, True])
def test_r_understated_by_a_fifth_is_noticed_by_the_nis(compass):
    """20 runs of 30 steps; with one landmark, two or three numbers a step."""
    found = verdicts(*averages(problem(compass, landmarks=1), 6000, 4, claimed_r=0.8), 20)
    assert np.mean([v.word == "optimistic" for v in found]) > 0.95
    assert rejected(found, "nees_pose") < 0.5
    assert rejected(found, "nis_per_dof") > 0.95


def test_an_interval_is_positive_scales_and_holds_its_mean():
    rng = np.random.default_rng(5)
    for values in (rng.chisquare(1, 8), np.exp(3 * rng.normal(size=20)), [1.0, 1e9], [2.0, 2.0]):
        interval = _intervals.positive_interval(values)
        assert 0 < interval.low <= interval.value <= interval.high
        np.testing.assert_allclose(
            _intervals.positive_interval(7 * np.asarray(values)), 7 * np.array(interval)
        )
    assert _intervals.positive_interval([3.0]) == (3.0, 0.0, np.inf)
    assert _intervals.positive_interval([np.nan]) is None
    assert _intervals.positive_interval([0.0, 0.0]) == (0, 0, 0)
    interval = _intervals.spread([2.0, 4.0, 6.0, 8.0], level=0.9, skewed=False)
    u = scipy.stats.sem([2, 4, 6, 8]) / 5
    q = scipy.stats.t.ppf(0.95, 3)
    np.testing.assert_allclose(5 / interval.low, 1 + q * u - u**2 / 2)


def test_many_runs_have_the_interval_of_the_normal():
    values = np.random.default_rng(6).chisquare(3, 100_000)
    interval = _intervals.positive_interval(values)
    half = scipy.stats.norm.ppf(0.5 + 0.95**0.5 / 2) * scipy.stats.sem(values)
    np.testing.assert_allclose(
        interval[1:], [interval.value - half, interval.value + half], rtol=1e-3
    )
    assert not _intervals.is_lopsided(interval)


@pytest.mark.parametrize(
    "nees",
    [
        17.9 * np.random.default_rng(9).lognormal(-1.5, 2.2, 20),  # as an EKF: 73 ± 106
        np.r_[np.full(99, 3.0), 1e9],
        np.r_[np.full(19, 20.0), 1000.0],
    ],
)
def test_a_heavy_tail_is_optimistic(nees):
    """A t interval reaches below zero here, and decides nothing."""
    assert np.mean(nees) - 2 * scipy.stats.sem(nees) < 3
    assert judge({"nees_pose": nees}, COUNTS).word == "optimistic"


@pytest.mark.parametrize(
    ("nees", "nis", "word", "by"),
    [
        (3.0, 1.0, "consistent", ()),
        (3.0, 1.2, "optimistic", ("nis_per_dof",)),
        (3.0, 0.8, "pessimistic", ("nis_per_dof",)),
        (6.0, 1.0, "optimistic", ("nees_pose",)),
        (6.0, 1.2, "optimistic", ("nees_pose", "nis_per_dof")),
        (6.0, 0.8, "optimistic", ("nees_pose", "nis_per_dof")),  # the NEES decides
        (1.5, 1.2, "pessimistic", ("nees_pose", "nis_per_dof")),
        (None, 1.2, "optimistic", ("nis_per_dof",)),
        (None, 1.0, "undecided", ()),
    ],
)
def test_either_test_rejects_and_the_one_that_spoke_is_named(nees, nis, word, by):
    around = np.linspace(0.5, 1.5, 20)
    each = {"nis_per_dof": nis * (0.9 + 0.1 * around)}
    each |= {"nees_pose": np.full(20, np.nan) if nees is None else nees * around}
    found = judge(each, COUNTS)
    assert (found.word, found.by) == (word, by)


def test_few_runs_say_what_they_would_have_noticed():
    nees = 3 * np.linspace(0.5, 1.5, 20)
    verdict = judge({"nees_pose": nees}, COUNTS)
    low, high = verdict.noticed["nees_pose"]
    assert 1 < low < 3 < high < 5
    said = _verdict.power_of(verdict.noticed)
    assert said == f"90 % power to reject a pose NEES above {high:.3g} or below {low:.3g}"
    noticed = judge({"nees_pose": np.repeat(nees, 25)}, COUNTS).noticed["nees_pose"]
    assert low < noticed[0] < 3 < noticed[1] < high
    wide = judge({"nees_pose": np.array([1.0, 5.0, 3.0])}, COUNTS)
    assert wide.word == "undecided"
    assert wide.noticed["nees_pose"][1] > 6
    assert _verdict.power_of({"nees_pose": (0.0, np.inf)}) == ""


def test_what_lies_within_a_hundredth_is_honest():
    """Tens of thousands of runs would reject any nonlinear filter."""
    around = np.linspace(0.99, 1.01, 1000)
    for nees, word in ((3.02, "consistent"), (2.98, "consistent"), (3.06, "optimistic")):
        assert judge({"nees_pose": nees * around}, COUNTS).word == word


def test_a_gate_makes_honest_innovations_small():
    """χ²_2 within the gate at 99 % has mean 0.953 of its dof: honest; the same ungated is not."""
    rng = np.random.default_rng(8)
    all_of = rng.chisquare(2, (100, 400))
    gated = np.where(all_of < 9.21, all_of, np.nan)
    nis = np.nanmean(gated, axis=1) / 2
    each = {"nees_pose": 3 * np.linspace(0.5, 1.5, 100), "nis_per_dof": nis}
    fused = int(np.isfinite(gated).sum())
    dropped = COUNTS | {"fused": fused, "rejected": all_of.size - fused}
    assert judge(each, dropped, 2.0 * fused).word == "consistent"
    assert judge(each, COUNTS | {"fused": fused}, 2.0 * fused).word == "pessimistic"
    too_small = each | {"nis_per_dof": 0.9 * nis}
    assert judge(too_small, dropped, 2.0 * fused).word == "pessimistic"


@pytest.mark.parametrize("dof", [1, 2, 5])
def test_the_truncated_mean_is_the_integral(dof):
    gate = scipy.stats.chi2.ppf(0.97, dof)
    whole = scipy.integrate.quad(lambda x: x * scipy.stats.chi2.pdf(x, dof), 0, gate)[0]
    np.testing.assert_allclose(stats.truncated_chi2_mean(0.03, dof), whole / 0.97 / dof, rtol=1e-6)
    assert stats.truncated_chi2_mean(0.0, dof) == 1
    with pytest.raises(ValueError, match="share"):
        stats.truncated_chi2_mean(1.0, dof)


def test_doubts_are_said():
    each = {"nees_pose": 3 * np.linspace(0.5, 1.5, 20)}
    mostly = COUNTS | {"fused": 40, "born": 8, "singular": 400, "rejected": 56}
    found = judge(each, mostly)
    assert found.word == "incomplete"
    assert found.doubts == ("456 of 504 measurements were dropped: 56 rejected, 400 singular",)
    # What a filter drops does not excuse what it claims.
    assert judge({"nees_pose": 5 * each["nees_pose"]}, mostly).word == "optimistic"
    two = judge(each | {"unobservable": np.full(20, 2.0)}, COUNTS)
    assert two.word == "consistent"
    assert two.doubts[0].startswith("unobservable directions 2 instead of 3")
    assert not judge(each | {"unobservable": np.full(20, 3.0)}, COUNTS).doubts


SOUND = COUNTS | {"steps": 2000, "measured": 4000, "fused": 3900, "born": 100, "singular_steps": 20}


@pytest.mark.parametrize(
    ("counts", "word", "doubt"),
    [
        ({}, "consistent", None),
        (
            {"not_finite": 1},
            "consistent",
            "not finite (NaN or ∞) in 1 of 21 runs: averages of the 20",
        ),
        ({"not_finite": 2}, "incomplete", "in 2 of 22 runs: averages of the 20 finite runs"),
        ({"not_finite": 21}, "diverged", "in 21 of 41 runs"),
        ({"divergent": 1, "inaccurate": 1}, "consistent", "divergent in 1 of 20 runs"),
        ({"divergent": 11, "inaccurate": 11}, "diverged", "divergent in 11 of 20 runs"),
        ({"inaccurate": 10}, "consistent", None),
        ({"inaccurate": 11}, "consistent", "inaccurate in 11 of 20 runs"),
        ({"asymmetric_steps": 1}, "consistent", "not symmetric in 1 of 2,000 steps"),
        ({"asymmetric_steps": 101}, "incomplete", "not symmetric in 101 of 2,000 steps"),
        ({"indefinite_steps": 1}, "consistent", "not positive definite in 1 of 2,000 steps"),
        ({"indefinite_steps": 101}, "incomplete", "not positive definite in 101 of 2,000"),
        ({"indefinite_steps": 1, "faulty_ends": 1}, "consistent", "not positive definite in 1 of"),
        ({"indefinite_steps": 2, "faulty_ends": 2}, "incomplete", "not positive definite in 2 of"),
        ({"asymmetric_steps": 2, "faulty_ends": 2}, "incomplete", "not symmetric in 2 of 2,000"),
        ({"constant": 1}, "consistent", "never change in 1 of 20 runs"),
        ({"constant": 2}, "incomplete", "never change in 2 of 20 runs"),
        ({"singular_steps": 1001}, "consistent", "singular in 1,001 of 2,000 steps"),
        (
            {"singular_steps": 21, "singular_ends": 1},
            "consistent",
            "singular in 21 of 2,000 steps and at the end of 1 of 20 runs",
        ),
        ({"missed": 1}, "consistent", "1 landmarks in view, beside 4,000 measured ones"),
        ({"missed": 4001}, "incomplete", "4,001 landmarks in view"),
        ({"measured": 0, "fused": 0, "born": 0}, "incomplete", "nothing was measured in any run"),
        ({"measured": 4010}, "consistent", "10 of 4,010 measurements have no status"),
        (
            {"measured": 8001},
            "incomplete",
            "4,001 of 8,001 measurements were not used: 4,001 without",
        ),
        ({"fused": 0, "born": 0, "unmatched": 4000}, "consistent", "takes none of the 4,000"),
        (
            {"fused": 0, "born": 0},
            "consistent",
            "takes none of the 4,000 measurements (by its Info)",
        ),
        ({"overflow": 1}, "consistent", "1 measurements of new landmarks found the map full"),
    ],
)
def test_what_is_wrong_is_counted_from_the_first_and_decides_from_a_share(counts, word, doubt):
    """5 % of runs or steps, half of the measurements; the averages are those of a good filter."""
    around = np.linspace(0.5, 1.5, 20)
    found = judge(
        {"nees_pose": 3 * around, "nis_per_dof": 0.95 + 0.05 * around}, SOUND | counts, 8e3
    )
    assert found.word == word
    assert len(found.doubts) == (doubt is not None)
    assert doubt is None or doubt in found.doubts[0]


def test_runs_that_are_lost_do_not_excuse_what_the_others_claim():
    """Those that are left may be those of small errors: pessimistic says nothing, optimistic does."""
    around, lost = np.linspace(0.9, 1.1, 20), SOUND | {"not_finite": 5}
    assert judge({"nees_pose": 6 * around}, lost, 8e3).word == "optimistic"
    assert judge({"nees_pose": 1 * around}, lost, 8e3).word == "incomplete"
    assert judge({"nees_pose": 1 * around}, SOUND, 8e3).word == "pessimistic"


def test_without_degrees_of_freedom_there_is_no_nis_and_it_is_said():
    (doubt,) = judge({"nees_pose": 3 * np.linspace(0.5, 1.5, 20)}, SOUND, 0.0).doubts
    assert doubt.startswith("3,900 fused measurements have no degrees of freedom in Info: no NIS")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sensor": sensors.RangeBearing(lambda z: -0.1 * jnp.eye(2))}, "range_bearing.*negative"),
        ({"sensor": sensors.Compass(lambda z: jnp.array([[jnp.nan]]))}, "compass.*NaN"),
        ({"motion": motion.Increment(lambda pose, u: jnp.array([[1.0, 3], [3, 1]]))}, "increment"),
    ],
)
def test_a_noise_that_is_no_covariance_is_refused_before_anything_runs(change, message):
    fields = {"name": "bad", "motion": motion.Increment(np.eye(2)), "sensor": SENSOR}
    fields |= change
    size = len(fields["sensor"].landmark)
    world = Scenario(**fields, landmarks=np.ones((2, size)), controls=np.ones((3, 2)))
    with pytest.raises(ValueError, match=f"monte_carlo: noise_cov of {message}") as refused:
        monte_carlo(world, {"any": lambda truth: None}, 2, jax.random.key(0))
    assert "\n" not in str(refused.value)


def test_a_noise_that_zero_has_none_of_is_taken_where_it_is():
    """σ ∝ 1/range, and a σ² that is negative at z = 0."""
    for noise in (lambda z: jnp.eye(2) / z[0], lambda z: jnp.eye(2) * (z[0] - 0.5)):
        world = Scenario(
            name="odd",
            motion=motion.Increment(np.eye(2)),
            sensor=sensors.RangeBearing(noise),
            landmarks=np.ones((2, 2)),
            controls=np.ones((3, 2)),
        )
        check_noise(world)


def test_lopsided_is_what_plus_minus_would_hide():
    assert _intervals.is_lopsided(Average(3.0, 2.0, 5.0))
    assert _intervals.is_lopsided(Average(3.0, 2.0, np.inf))
    assert not _intervals.is_lopsided(Average(3.0, 2.0, 4.1))
    assert not _intervals.is_lopsided(Average(3.0, 3.0, 3.0))
