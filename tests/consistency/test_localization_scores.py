"""Scores of particle sets: levels of honest and overconfident samples, energy, runs found."""

import jax
import numpy as np
import pytest
from scipy import stats

from jaxslam import consistency
from jaxslam.consistency import LocalizationScores
from jaxslam.consistency._localization_scores import energy_score, seed_spread

RUNS = 600
level = jax.jit(jax.vmap(consistency.covering_level))
rng = np.random.default_rng(0)
SCALE = np.array([0.1, 0.3, 0.02])


def drawn(spread, centre=0.0):
    """RUNS samples of two groups and a truth of each; spread 1 is honest."""
    side = rng.choice([-5.0, 5.0], (RUNS, 100))
    draws = spread * SCALE * rng.normal(size=(RUNS, 99, 3))
    draws[..., 0] += side[:, 1:]
    truth = SCALE * rng.normal(size=(RUNS, 3)) + centre
    truth[:, 0] += side[:, 0]
    turn = np.array([0.0, 0.0, np.pi])  # on the seam
    return [
        np.concatenate([x[..., :2], np.angle(np.exp(1j * (x + turn)[..., 2:]))], -1)
        for x in (draws, truth)
    ]


def test_the_level_of_an_honest_sample_is_uniform_also_of_two_groups():
    found = np.asarray(level(*drawn(1.0)))
    assert stats.kstest(found, "uniform").pvalue > 1e-3
    assert abs((found <= 0.95).mean() - 0.95) < 4 * np.sqrt(0.95 * 0.05 / RUNS)
    assert (np.asarray(level(*drawn(0.3))) <= 0.95).mean() < 0.8  # overconfident


def test_copies_of_a_draw_are_not_taken_for_density():
    draws, truth = drawn(1.0)
    copies = np.repeat(draws[:, :33], 3, axis=1)
    found = np.asarray(level(copies, truth))
    assert abs((found <= 0.95).mean() - 0.95) < 0.05
    assert np.all(np.asarray(level(np.zeros_like(draws), truth + 1.0)) == 1)  # one point, elsewhere


def test_the_energy_score_is_that_of_the_definition():
    draws, truth = rng.normal(size=(20, 2)), np.array([0.3, -0.2])
    error = np.linalg.norm(draws - truth, axis=1).mean()
    apart = np.linalg.norm(draws[:, None] - draws[None], axis=-1)
    expected = error - 0.5 * apart[~np.eye(20, dtype=bool)].mean()
    assert float(jax.jit(energy_score)(draws, truth)) == pytest.approx(expected)


def scores(error):
    """Of runs with these position errors (R, T), claimed to be of 0.1 m."""
    runs, steps = error.shape
    truth = np.zeros((runs, steps, 3))
    pose = truth + np.stack([error, 0 * error, 0 * error], axis=-1)
    cov = np.broadcast_to(np.diag([0.1, 0.1, 0.1]) ** 2, (runs, steps, 3, 3))
    level = np.where(error < 0.2, 0.5, 1.0)
    whole = np.ones_like(error)
    return LocalizationScores(
        truth, pose, cov, level, 0.5 * error, error < 1.0, 50 * whole, whole.astype(int)
    )


def test_the_summary_averages_runs_and_says_which_are_lost():
    error = np.array([[3.0, 0.1, 0.1, 0.1], [3.0, 3.0, 0.3, 0.1], [0.1, 0.1, 0.1, 2.0]])
    found = consistency.summarize_localization(scores(error), skip=1)
    np.testing.assert_array_equal(found.converged_at, [1, 2, np.inf])
    assert found.lost == pytest.approx(1 / 3)
    assert found.coverage.value == pytest.approx(np.mean([1, 1 / 3, 2 / 3]))
    assert found.nees.value == pytest.approx(np.mean([1, (9 + 1) / 2, 1]))
    assert found.unimodal == pytest.approx(7 / 9)
    with pytest.raises(
        ValueError, match="summarize_localization: skip: expected a number from 0 to 3"
    ):
        consistency.summarize_localization(scores(error), skip=4)


def test_a_run_that_is_not_finite_is_covered_by_nothing_lost_and_counted():
    error = np.full((4, 4), 0.1)
    sound = consistency.summarize_localization(scores(error))
    assert (sound.doubts, sound.not_finite, sound.lost) == ((), 0, 0.0)
    with_nan = scores(error)
    with_nan.pose[3, 2:] = np.nan
    found = consistency.summarize_localization(with_nan)
    assert found.coverage.value == pytest.approx(np.mean([1, 1, 1, 0.5]))
    assert found.lost == 0.25 and found.converged_at[3] == np.inf
    assert found.rmse.value == pytest.approx(0.1)
    assert found.doubts == (
        "not finite (NaN or ∞) in 1 of 4 runs: the energy score and the RMSE are of the others",
    )


def test_the_spread_over_seeds_is_in_units_of_the_claim():
    error = 0.1 * rng.normal(size=(4000, 2))
    found = seed_spread(scores(error))
    np.testing.assert_allclose(found, 1 / 3, rtol=0.1)  # of three coordinates one differs
