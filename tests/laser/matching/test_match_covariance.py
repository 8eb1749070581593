"""Covariances of a match: the noise through by differences, the truth by many runs, bad input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import refused
from reference.plane import from_frame
from scanned_rooms import BEAMS, pairs

from jaxslam import matching, verify_jacobians
from jaxslam.core.record import record
from jaxslam.laser.grids import Field
from jaxslam.laser.matching import IcpSettings, MatchStatus, Prior, covariance
from jaxslam.laser.matching._field import field_residuals
from jaxslam.math.stats import chi2_band

SIGMA, RUNS = 0.03, 60
START_COV = np.diag([0.05, 0.05, 0.03]) ** 2
LINES = matching.PointToLine(IcpSettings(span=2, gap=0.8))
POINTS = matching.PointToPoint(IcpSettings(span=2, gap=0.8, least_score=0.2))
WAYS = {
    "hessian": covariance.Hessian(),
    "implicit": covariance.Implicit(SIGMA),
    "along_normals": covariance.AlongNormals(SIGMA, span=2, gap=0.8),
    "lattice": covariance.Lattice(SIGMA, steps=9),
    "unscented": covariance.Unscented(SIGMA, START_COV),
    "sampling": covariance.Sampling(SIGMA, START_COV, 4),
}
REFERENCES, SCANS, TRUTH, STARTS = pairs(RUNS, sigma=SIGMA)


def all_of(matcher, ways):
    def one(reference, scan, start, key):
        fit = matcher.match(matcher.prepare(reference), scan, start)
        scans = covariance.MatchedScans(reference, scan, fit, start, key)
        return fit, {name: WAYS[name].of(matcher, scans) for name in ways}

    keys = jax.random.split(jax.random.key(0), RUNS)
    return jax.device_get(jax.jit(jax.vmap(one))(REFERENCES, SCANS, STARTS, keys))


@pytest.fixture(scope="module")
def by_lines():
    return all_of(LINES, ("implicit", "lattice"))


def nees(found, cov):
    error = found.pose - TRUTH
    return np.mean(np.einsum("ri,rij,rj->r", error, np.linalg.inv(cov), error))


def test_the_noise_through_lines_is_honest_and_others_are_not(by_lines):
    fits, covs = by_lines
    assert np.all(fits.status == MatchStatus.CONVERGED)
    low, high = chi2_band(3, RUNS, 0.999)
    assert low < nees(fits, covs["implicit"]) < high
    # A single variance σ² for residuals that have that of two scans.
    assert nees(fits, covs["lattice"]) > high
    for cov in covs.values():
        assert np.all(np.linalg.eigvalsh(cov) > 0)


@pytest.mark.sweep
def test_so_is_the_noise_through_the_unscented_transform_and_all_are_positive_definite():
    fits, covs = all_of(LINES, WAYS)
    low, high = chi2_band(3, RUNS, 0.999)
    assert low < nees(fits, covs["unscented"]) < high
    for cov in covs.values():
        assert np.all(np.linalg.eigvalsh(cov) > 0)


@pytest.mark.sweep
def test_a_prior_tells_what_a_corridor_does_not():
    """What two walls do not tell is known by the prior, and the covariance says so.

    The prior along them is worth 0.01²/0.1² = 0.01, as realistic odometry is: less than the noise of
    60 normals feigns.
    """
    references, scans, truth, _ = pairs(RUNS, seed=5, sigma=0.01, half=(1e3, 1.0))
    for of in (references, scans):
        of.valid[:] = np.abs(of.position).max(axis=2) < 4.5
    cov = np.diag([0.1, 0.1, 0.03]) ** 2
    expected = truth + np.random.default_rng(6).multivariate_normal(np.zeros(3), cov, RUNS)
    information = np.tile(0.01**2 * np.linalg.inv(cov), (RUNS, 1, 1))
    prior = Prior(expected, information)
    fit = matching.match(LINES, references, scans, expected, prior)
    claimed = covariance.covariance(
        covariance.Implicit(0.01), LINES, references, scans, fit, expected, jax.random.key(0)
    )
    error, claimed = np.asarray(fit.pose) - truth, np.asarray(claimed)
    low, high = chi2_band(3, RUNS, 0.999)
    assert low < np.einsum("ri,rij,rj->", error, np.linalg.inv(claimed), error) / RUNS < high
    along = np.sqrt(np.linalg.eigvalsh(claimed[:, :2, :2])[:, 1])
    np.testing.assert_allclose(along, 0.1, rtol=0.01)


@pytest.mark.sweep
def test_points_with_their_partners_kept_feign_information():
    fits, covs = all_of(POINTS, ("implicit", "along_normals"))
    assert nees(fits, covs["implicit"]) > 30
    assert nees(fits, covs["along_normals"]) < 0.1 * nees(fits, covs["implicit"])


def least(reference, scan, pair, used):
    """The pose of the least Σ (n·(T p - m))², lines fitted to each point and its neighbours; pairs
    kept. By Gauss and Newton, in NumPy."""
    neighbours = found_neighbours[pair[used]]
    own = reference[neighbours]
    middle = own.mean(axis=1)
    moments = np.einsum("nka,nkb->nab", own - middle[:, None], own - middle[:, None])
    normal = np.linalg.eigh(moments)[1][:, :, 0]
    pose = np.zeros(3)
    for _ in range(20):
        arm = from_frame([0, 0, pose[2]], scan[used])
        e = (normal * (arm + pose[:2] - middle)).sum(axis=1)
        jacobian = np.column_stack([normal, normal[:, 1] * arm[:, 0] - normal[:, 0] * arm[:, 1]])
        pose = pose - np.linalg.solve(jacobian.T @ jacobian, jacobian.T @ e)
    return pose


def whole_run(found):
    """A run all of whose lines have five points."""
    for k in range(RUNS):
        j = found.pair[k][found.pair[k] >= 0]
        steps = np.linalg.norm(np.diff(REFERENCES.position[k], axis=0), axis=1)
        if np.all((j > 1) & (j < BEAMS - 2)) and np.all(steps < 0.8):
            return k
    return pytest.fail("no run whose lines are whole")


found_neighbours = (np.arange(BEAMS)[:, None] + np.arange(-2, 3)[None]) % BEAMS


@record
class Certain(covariance.MatchCovariance):
    """The covariance of one who knows no doubt."""

    sigma: float

    def of_usable(self, matcher, scans):
        return jnp.zeros((3, 3))


def test_a_match_that_failed_is_known_by_its_prior_or_not_at_all(by_lines):
    way = Certain(SIGMA)
    first = jax.tree.map(lambda leaf: leaf[0], by_lines[0])
    known = np.diag([0.01, 0.01, 0.001])
    prior = Prior(np.zeros(3), SIGMA**2 * np.linalg.inv(known))
    for status, given, expected in (
        (MatchStatus.DEGENERATE, None, np.zeros((3, 3))),
        (MatchStatus.UNLIKE, None, 1e6 * np.eye(3)),
        (MatchStatus.TOO_FEW, prior, known),
    ):
        found = first._replace(status=np.int32(status), prior=given)
        of = covariance.MatchedScans(None, None, found, STARTS[0], None)
        np.testing.assert_allclose(way.of(LINES, of), expected, rtol=1e-6)


def test_the_noise_through_is_that_of_differences(by_lines):
    """dx/dz of each range of both scans, the minimum computed again with the pairs kept."""
    fits, covs = by_lines
    k = whole_run(fits)
    used = fits.weight[k] > 0
    p, q = REFERENCES.position[k], SCANS.position[k]
    np.testing.assert_allclose(least(p, q, fits.pair[k], used), fits.pose[k], atol=1e-6)
    gain, h = [], 1e-5
    for which in range(2):
        for beam in range(BEAMS):
            ends = []
            for sign in (1, -1):
                parts = [p.copy(), q.copy()]
                ray = (REFERENCES, SCANS)[which].ray[k, beam]
                parts[which][beam] += sign * h * ray
                ends.append(least(*parts, fits.pair[k], used))
            gain.append((ends[0] - ends[1]) / (2 * h))
    gain = np.array(gain)
    np.testing.assert_allclose(covs["implicit"][k], SIGMA**2 * gain.T @ gain, rtol=1e-3, atol=1e-10)


def test_the_lattice_of_a_quadratic_cost_is_its_inverse(by_lines):
    fits, covs = by_lines
    prior = np.eye(3) * 0.3**-2
    k = whole_run(fits)
    used = fits.weight[k] > 0
    arm = from_frame(fits.pose[k], SCANS.position[k])[used] - fits.pose[k, :2]
    own = REFERENCES.position[k][found_neighbours[fits.pair[k][used]]]
    apart = own - own.mean(axis=1, keepdims=True)
    n = np.linalg.eigh(np.einsum("nka,nkb->nab", apart, apart))[1][:, :, 0]
    jacobian = np.column_stack([n, n[:, 1] * arm[:, 0] - n[:, 0] * arm[:, 1]])
    expected = np.linalg.inv(jacobian.T @ jacobian / SIGMA**2 + prior)
    # The turn of the scan is not quadratic, and nine poses from -4 σ to 4 σ sum to 1e-4.
    np.testing.assert_allclose(covs["lattice"][k], expected, rtol=0.02, atol=3e-7)


def test_the_jacobian_of_the_field_is_that_of_autodiff():
    rng = np.random.default_rng(0)
    field = Field(rng.uniform(0, 1, (9, 9)), np.array([-2.0, -2.0, 0.3]), np.float64(0.7))
    position = rng.uniform(-1, 1, (3, 2))
    scan = matching.Points(position, np.ones((3, 2)), np.ones(3, bool))
    report = verify_jacobians(
        lambda pose: field_residuals(field, scan, pose)[0],
        lambda pose: field_residuals(field, scan, pose)[1],
        arguments={"pose": ("x [m]", "y [m]", "theta [rad]")},
        states=[rng.uniform(-0.5, 0.5, (6, 3))],
        name="field_residuals",
    )
    assert report.passed, str(report)


@refused(
    (lambda: covariance.Implicit(0.0), "Implicit: sigma: expected a number above 0"),
    (lambda: covariance.Lattice(0.1, steps=1), "Lattice: steps: expected an integer >= 3"),
    (lambda: covariance.Unscented(0.1, np.eye(2)), "Unscented: start_cov: expected a covariance"),
    (lambda: covariance.Sampling(0.1, np.eye(3), 0), "Sampling: samples: expected"),
)
def test_bad_input_is_refused(call):
    call()
