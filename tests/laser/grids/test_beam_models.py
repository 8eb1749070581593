"""Beam models: densities against SciPy, their integrals, gradients, fits, and bad scans."""

import itertools

import jax
import numpy as np
import pytest
from cases import refused
from reference.plane import from_frame
from scipy import integrate, stats

from jaxslam import grids
from jaxslam.core.types import Beams
from jaxslam.laser.grids.beam_models import (
    LikelihoodField,
    Mixture,
    RayCast,
    fit,
    log_likelihood,
    mixture_log_density,
)
from jaxslam.simulation.walls import make_walls, rasterize

MIXTURE = Mixture(0.6, 0.2, 0.05, 0.15, 0.15, 0.8)
FAR = 4.0
log_density = jax.jit(lambda mixture, z, star: mixture_log_density(mixture, z, star, FAR))


@pytest.fixture(scope="module")
def room():
    return rasterize(make_walls([[0, 0], [5, 0], [5, 3], [0, 3]]), 0.05)


def beams(count=24, seed=0):
    rng = np.random.default_rng(seed)
    ranges = rng.uniform(0.2, 3.8, count)
    ranges[:4] = [np.nan, np.inf, FAR, -1.0]
    return Beams(ranges, np.linspace(-3, 3, count), rng.random(count) < 0.9)


def test_the_density_is_the_mixture_of_four_and_sums_to_one():
    for star in (0.05, 1.3, 3.95, FAR):
        z = np.linspace(0.0, FAR, 400)[:-1]
        hit, short, maximum, random, sigma, rate = MIXTURE
        normal = stats.truncnorm(-star / sigma, (FAR - star) / sigma, star, sigma).pdf(z)
        early = stats.truncexpon(min(star, FAR) * rate, scale=1 / rate).pdf(z)
        expected = hit * normal * (star < FAR) + short * early + random / FAR
        density = np.exp(log_density(MIXTURE, z, np.full_like(z, star)))
        np.testing.assert_allclose(density, expected, rtol=1e-9)
        mass = float(np.exp(log_density(MIXTURE, np.array(FAR), np.array(star))))
        assert mass == pytest.approx(maximum + hit * (star >= FAR))
        pieces = np.unique(np.clip([0, star - 0.5, star, star + 0.5, FAR], 0, FAR))
        total = mass + sum(
            integrate.simpson(np.exp(log_density(MIXTURE, x, np.full_like(x, star))), x=x)
            for x in (np.linspace(a + 1e-9, b - 1e-9, 801) for a, b in itertools.pairwise(pieces))
        )
        assert total == pytest.approx(1.0, abs=1e-5)


def test_the_likelihood_field_by_hand(room):
    model = LikelihoodField(0.2, max_range=FAR, hit=0.7, random=0.2, maximum=0.1, mount=(0.1, 0, 0))
    field = model.prepare(room)
    pose, scan = np.array([2.0, 1.2, 0.4]), beams()
    use = scan.valid & (scan.range >= 0)
    h = 0.4 + scan.angle
    eye = pose[:2] + 0.1 * np.array([np.cos(0.4), np.sin(0.4)])
    near = use & (scan.range < FAR)
    ends = eye + np.where(near, scan.range, 0.0)[:, None] * np.stack([np.cos(h), np.sin(h)], axis=1)
    d = np.asarray(grids.interpolate(field, ends))
    expected = np.log(0.7 * stats.norm(0, 0.2).pdf(d) + 0.2 / FAR)[near].sum()
    expected += np.log(0.1) * (use & (scan.range >= FAR)).sum()
    found = jax.jit(lambda e: log_likelihood(model, field, pose, scan, exponent=e))
    assert float(found(1.0)) == pytest.approx(expected)
    assert float(found(0.25)) == pytest.approx(0.25 * expected)


def test_the_ray_cast_model_of_a_laser_off_the_centre_by_hand():
    """In a room of 5 m by 3 m whose walls are borders between cells: ranges without rounding."""
    log_odds = np.full((34, 54), 2.0)
    log_odds[2:-2, 2:-2] = -2.0
    empty = grids.Grid(log_odds, np.array([-0.2, -0.2, 0.0]), np.float64(0.1))
    model = RayCast(MIXTURE, max_range=FAR, mount=(0.3, -0.2, 0.7))
    prepared, pose = model.prepare(empty), np.array([2.0, 1.2, 0.4])
    angles = np.delete(np.linspace(-3, 3, 12), 8)  # the ninth ends in a corner, which is rounded
    eye = from_frame(pose, [0.3, -0.2])
    e = np.stack([np.cos(0.4 + 0.7 + angles), np.sin(0.4 + 0.7 + angles)], axis=1)
    star = ((np.where(e > 0, [5.0, 3.0], 0.0) - eye) / e).min(axis=1)
    z = star + np.array([0.1, -0.2, -0.05, 0.3, -0.9, 0.05, -1.5, 0.6, -0.1, 0.2, 5.0])
    hit, short, maximum, random, sigma, rate = MIXTURE
    normal = stats.truncnorm(-star / sigma, (FAR - star) / sigma, star, sigma).pdf(z)
    early = stats.truncexpon(star * rate, scale=1 / rate).pdf(z)
    density = np.where(z < FAR, hit * normal + short * early + random / FAR, maximum)
    scan = Beams(z, angles, np.ones(11, bool))
    found = jax.jit(lambda p: log_likelihood(model, prepared, p, scan))(pose)
    assert float(found) == pytest.approx(np.log(density).sum(), rel=1e-9)


@pytest.mark.parametrize("make", [LikelihoodField, RayCast])
def test_gradients_are_finite_at_walls_in_obstacles_and_off_the_map(room, make):
    model = make(max_range=FAR)
    prepared = model.prepare(room)
    poses = np.array([[2, 1, 0.3], [0, 1, 0], [0, 0, 0], [-0.3, 1, 0], [50, 50, 1], [2.0125, 1, 0]])
    scan = beams()
    both = jax.jit(jax.vmap(jax.value_and_grad(lambda p: log_likelihood(model, prepared, p, scan))))
    values, slopes = both(poses)
    assert np.all(np.isfinite(values)) and np.all(np.isfinite(slopes))
    half = jax.jit(lambda p: log_likelihood(model, prepared, p, scan, stride=2))(poses[0])
    taken = Beams(*(np.asarray(part)[::2] for part in scan))
    whole = jax.jit(lambda p: log_likelihood(model, prepared, p, taken))(poses[0])
    assert float(half) == pytest.approx(float(whole))


@pytest.mark.parametrize("make", [LikelihoodField, RayCast])
def test_the_true_pose_is_the_most_likely_one(room, make):
    model = make(max_range=8.0)
    prepared = model.prepare(room)
    true, angles = np.array([2.0, 1.2, 0.4]), np.linspace(-3, 3, 60)
    ranges = np.asarray(grids.cast(grids.ray_map(room), true, angles, 8.0))
    scan = Beams(ranges, angles, np.ones(60, bool))
    off = np.concatenate([np.zeros((1, 3)), np.diag([0.1, 0.1, 0.1]), -np.diag([0.1, 0.1, 0.1])])
    values = jax.jit(jax.vmap(lambda p: log_likelihood(model, prepared, p, scan)))(true + off)
    assert np.argmax(values) == 0


def test_a_pose_may_be_a_list_of_whole_numbers(room):
    model = LikelihoodField(max_range=FAR, mount=(0.3, 0, 0))
    field = model.prepare(room)
    found = [log_likelihood(model, field, p, beams()) for p in ([2, 1, 0], np.array([2.0, 1, 0]))]
    assert float(found[0]) == float(found[1])


def test_a_beam_that_is_not_valid_may_have_any_angle(room):
    model = LikelihoodField(max_range=FAR, mount=(0.3, 0, 0))
    field, pose, valid = model.prepare(room), np.array([2.0, 1, 0]), beams().valid & True
    valid[0] = False
    angle = np.where(valid, beams().angle, np.nan)
    found = [
        log_likelihood(model, field, pose, beams()._replace(angle=a, valid=valid))
        for a in (beams().angle, angle)
    ]
    assert float(found[0]) == float(found[1])


def drawn(count, seed=0):
    """Ranges of the mixture for ranges expected between 1 and 3.5 m."""
    rng = np.random.default_rng(seed)
    hit, short, maximum, random, sigma, rate = MIXTURE
    star = rng.uniform(1.0, 3.5, count)
    kind = rng.choice(4, count, p=[hit, short, maximum, random])
    normal = stats.truncnorm(-star / sigma, (FAR - star) / sigma, star, sigma).rvs(random_state=rng)
    early = -np.log1p(rng.random(count) * np.expm1(-rate * star)) / rate
    return np.choose(kind, [normal, early, np.full(count, FAR), rng.uniform(0, FAR, count)]), star


def test_both_fits_find_the_parameters():
    z, star = drawn(20_000)
    by_gradient = np.array(fit(z, star, FAR))
    # Of 20,000: shares to 0.004, σ to 0.001, λ of 4,000 cut off at 1 to 3.5 m to 0.05, mixed up.
    off = np.abs(by_gradient - MIXTURE)
    assert np.all(off < [0.02, 0.03, 0.008, 0.03, 0.006, 0.2]), off
    by_em = np.array(fit(z, star, FAR, method="em"))
    off = np.abs(by_em - MIXTURE)
    assert np.all(off[[0, 2, 4]] < [0.05, 0.01, 0.02]), off
    assert by_em[5] > MIXTURE.rate  # the limit that its formula neglects
    score = [
        float(np.mean(log_density(Mixture(*x), z, star))) for x in (by_gradient, by_em, MIXTURE)
    ]
    assert score[0] >= max(score) - 1e-9


def likelihood(scan=None, pose=(0.0, 0.0, 0.0), prepared=grids.Field, **options):
    field = prepared(np.zeros((2, 2)), np.zeros(3), np.float64(1))
    scan = beams() if scan is None else scan
    return log_likelihood(LikelihoodField(max_range=FAR), field, np.array(pose), scan, **options)


def cast(*mixture, **options):
    return RayCast(*([Mixture(*mixture)] if mixture else []), **({"max_range": 1.0} | options))


ONES = np.ones(3)


@refused(
    (
        lambda: likelihood(beams()._replace(valid=np.zeros(24, bool))),
        "the scan of 24 beams has no valid beam",
    ),
    (
        lambda: likelihood(beams()._replace(angle=np.zeros(5))),
        r"as many ranges, angles and masks, got \(24,\), \(5,\), \(24,\)",
    ),
    (lambda: likelihood("scan"), "log_likelihood: beams: expected Beams, got 'scan'"),
    (lambda: likelihood(stride=0), "stride: expected an integer"),
    (
        lambda: likelihood(pose=(0.0, 0.0)),
        r"log_likelihood: pose: expected finite numbers of shape \(3,\), got an array",
    ),
    (
        lambda: likelihood(exponent=-1.0),
        r"log_likelihood: exponent: expected a number >= 0, got -1\.0",
    ),
    (lambda: likelihood(prepared=grids.Grid), "expected what model.prepare makes of the grid"),
    (
        lambda: LikelihoodField(max_range=1.0, truncate=-1.0),
        r"LikelihoodField: truncate: expected a number above 0, got -1\.0",
    ),
    (
        lambda: LikelihoodField(max_range=1.0, mount=(0, 0)),
        r"LikelihoodField: mount: expected a mounting pose of shape \(3,\), got \(2,\)",
    ),
    (
        lambda: LikelihoodField(0.0, max_range=1.0),
        r"LikelihoodField: sigma: expected a number above 0, got 0\.0",
    ),
    (lambda: LikelihoodField(max_range=1.0, hit=0.5), "LikelihoodField: expected shares"),
    (lambda: cast(mount=(0, 0, np.nan)), "RayCast: mount: the mounting pose is not finite"),
    (lambda: cast(max_range=0.0), r"RayCast: max_range: expected a number above 0, got 0\.0"),
    (
        lambda: cast(0.7, 0.1, 0.1, 0.1, 0, 1),
        r"RayCast: mixture\.sigma: expected a number above 0, got 0",
    ),
    (
        lambda: cast(0.7, 0.1, 0.1, 0.1, 1, -1),
        r"RayCast: mixture\.rate: expected a number above 0, got -1",
    ),
    (
        lambda: cast(1.2, -0.2, 0, 0, 1, 1),
        r"RayCast: mixture: expected shares >= 0 of sum 1, got hit 1\.2, short -0\.2,",
    ),
    (lambda: cast(method="lut"), 'RayCast: method: expected "surface" or'),
    (lambda: fit(ONES, ONES, 0.0), r"fit: max_range: expected a number above 0, got 0\.0"),
    (
        lambda: fit(ONES, -ONES, FAR),
        "fit: expected: expected ranges that are finite and not below 0",
    ),
    (lambda: fit(ONES, np.ones(4), FAR), "and as many as expected ones"),
    (
        lambda: fit(ONES[:0], ONES[:0], FAR),
        "fit: z: expected at least one range, and as many as expected ones, got",
    ),
    (lambda: fit(ONES, ONES, FAR, start=Mixture(0, 0, 0, 0, 1, 1)), "fit: start: expected shares"),
    (lambda: fit(ONES * np.nan, ONES, FAR), "fit: z: none of 3 ranges is above 0"),
    (lambda: fit(ONES, ONES, FAR, method="mcmc"), 'fit: method: expected "gradient" or'),
)
def test_bad_input_is_refused(call):
    call()
