"""The joint NEES of a map against a survey: its distribution, its frame, and what it needs."""

import jax
import numpy as np
import pytest
import worlds

from jaxslam import charts, filters
from jaxslam.datasets._evaluation import joint_map_cov, judge_map
from jaxslam.math.stats import chi2_band, chi2_quantile

RNG = np.random.default_rng(7)
COUNT, DRAWS = 5, 400
SURVEY = RNG.uniform(-10, 10, (COUNT, 2))
ROOT = 0.01 * RNG.normal(size=(2 * COUNT, 2 * COUNT)) + 0.05 * np.ones((2 * COUNT, 1))
JOINT = (ROOT @ ROOT.T).reshape(COUNT, 2, COUNT, 2)
OWN = JOINT[np.arange(COUNT), :, np.arange(COUNT)]


def moved(points, pose):
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return points @ np.array([[c, s], [-s, c]]) + pose[:2]


def judged(joint, frame=None, scale=1.0):
    """Of maps with errors from N(0, scale² P), in a frame of their own or not."""
    out = []
    for _ in range(DRAWS):
        error = scale * (ROOT @ RNG.normal(size=2 * COUNT)).reshape(COUNT, 2)
        points = (SURVEY if frame is None else moved(SURVEY, frame)) + error
        out.append(judge_map(points, SURVEY, OWN, JOINT if joint else None, frame is None))
    return out


@pytest.mark.parametrize("frame", [None, (30.0, -50.0, 2.5)])
def test_the_joint_nees_of_honest_maps_is_chi_squared(frame):
    """Strongly correlated errors; the mean of 400, and how many are outside their band."""
    found = judged(True, frame)
    dof = 2 * COUNT - 3 * (frame is not None)
    assert {one.dof for one in found} == {dof}
    assert found[0].band == chi2_band(dof, 1)
    low, high = chi2_band(dof, DRAWS, 0.999)
    assert low < np.mean([one.nees for one in found]) < high
    rejected = sum(one.verdict != "consistent" for one in found)
    assert 5 <= rejected <= 38  # 20 ± 4.1 standard deviations
    assert {one.verdict for one in judged(True, frame, 10.0)} == {"optimistic"}
    assert {one.verdict for one in judged(True, frame, 0.1)} == {"pessimistic"}


def test_without_the_correlations_the_largest_nees_is_judged():
    """It rejects at most 5 % of honest maps, by 3 standard deviations, and finds optimistic ones."""
    found = judged(False)
    assert sum(one.verdict == "optimistic" for one in found) < 0.05 * DRAWS + 3 * 4.4
    assert not any(one.verdict == "pessimistic" for one in found)
    assert found[0].band == (0, chi2_quantile(1 - 0.05 / COUNT, 2))
    assert not found[0].joint and found[0].rows()["map NEES of"] == "the worst landmark"
    far = judged(False, scale=8.0)
    assert sum(one.verdict == "optimistic" for one in far) > 0.7 * DRAWS


def test_a_map_without_a_regular_covariance_or_a_frame_is_not_judged():
    assert judge_map(SURVEY, SURVEY, 0 * OWN, None, True) is None
    assert judge_map(SURVEY[:1], SURVEY[:1], OWN[:1], None, False) is None
    flat = np.ones((10, 10)).reshape(JOINT.shape)
    assert judge_map(SURVEY, SURVEY, OWN, flat, True) is None


@pytest.mark.parametrize("chart", [charts.Euclidean(), charts.RightInvariant()])
def test_the_joint_covariance_has_the_filters_own_blocks(chart):
    world = worlds.ring(5)
    ekf = filters.EkfSlam(world.motion, world.sensor, COUNT, chart=chart)
    state = ekf.init(np.array([1.0, 2.0, 0.5]), np.zeros((3, 3)))
    root = RNG.normal(size=(3 + 2 * COUNT,) * 2)
    state = state._replace(landmarks=SURVEY, cov=root @ root.T, alive=np.ones(COUNT, bool))
    cov = joint_map_cov(ekf, jax.tree.map(jax.numpy.asarray, state))
    blocks = cov[np.arange(COUNT), :, np.arange(COUNT)]
    np.testing.assert_allclose(blocks, jax.jit(ekf.estimate)(state).point_covs, atol=1e-12)
    whole = cov.reshape(2 * COUNT, 2 * COUNT)
    np.testing.assert_allclose(whole, whole.T, atol=1e-12)
    assert joint_map_cov(ekf, (state,)) is None
