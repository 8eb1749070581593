"""The iterative closest point methods: one step in NumPy, accuracy, outliers, bad scans."""

from functools import cache

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import refused, swept
from reference.plane import from_frame
from scanned_rooms import BEAMS, by_polynomial, line_cost, pairs, points_at, stacked
from worlds import narrow

from jaxslam import matching
from jaxslam.core.types import Beams
from jaxslam.graphs import Huber
from jaxslam.laser.matching import IcpSettings, MatchStatus, Points, Prior, _point_sets
from jaxslam.laser.matching._closed_form import add, minimizer, of_lines, of_points, of_prior

COUNT, GOOD = 8, 4
SPAN, GAP, REACH = 2, 0.8, 0.5
OPTIONS = {"span": SPAN, "gap": GAP, "reach": REACH}


def batch():
    """Four pairs; then a scan, and a reference, without points; other places; a corridor."""
    rng = np.random.default_rng(7)
    references, scans, truth, starts = (
        [Points(*(np.array(part[k]) for part in of)) for k in range(COUNT)]
        if isinstance(of, Points)
        else of
        for of in pairs(COUNT, off=(0.04, 0.04, 0.02))
    )
    scans[4].valid[:] = False
    references[5].valid[:] = False
    scans[6] = points_at(np.array([0.0, 0.0, 0.4]), rng, half=(2.7, 3.5))
    for of in (references, scans):
        of[7] = points_at(np.zeros(3), rng, half=(1e3, 1.0))
        of[7].valid[:] = np.abs(of[7].position).max(axis=1) < 5.0
    truth[7], starts[7] = 0.0, [0.1, 0.02, 0.01]
    return stacked(references), stacked(scans), truth, starts


REFERENCES, SCANS, TRUTH, STARTS = batch()


@cache
def found(name, **options):
    make = {"points": matching.PointToPoint, "lines": matching.PointToLine}[name]
    matcher = make(IcpSettings(**OPTIONS, **options))
    return jax.device_get(matching.match(matcher, REFERENCES, SCANS, STARTS))


def lines(p):
    """Mean, normal, and whether there is a line, of each point with its two neighbours a side."""
    middle, normal, variance, straight = [], [], [], []
    for k in range(len(p)):
        near = [k]
        for side in (-1, 1):
            for step in range(1, SPAN + 1):
                at = k + side * step
                if not 0 <= at < len(p) or np.linalg.norm(p[at] - p[at - side]) >= GAP:
                    break
                near.append(at)
        own = p[near]
        middle.append(own.mean(axis=0))
        values, vectors = np.linalg.eigh((own - middle[-1]).T @ (own - middle[-1]))
        normal.append(vectors[:, 0])
        variance.append(values[0] / max(len(near) - 2, 1))
        straight.append(len(near) >= 3 and values[0] < 0.1 * values[1])
    variance, many = np.array(variance), np.array(straight)
    usual = np.sort(variance)[(len(p) - 1) // 2]
    return np.array(middle), np.array(normal), many & (variance < 4 * usual + 1e-6)


def partners(k):
    """The scan of a pair at its start, its nearest reference points, and which are within reach."""
    there = from_frame(STARTS[k], SCANS.position[k])
    apart = np.linalg.norm(there[:, None] - REFERENCES.position[k][None], axis=2)
    j = apart.argmin(axis=1)
    return there, j, apart[np.arange(BEAMS), j] < REACH


def composed(step, pose):
    c = from_frame(step, pose[None, :2])[0]
    return np.array([*c, pose[2] + step[2]])


@pytest.mark.sweep
@pytest.mark.parametrize("k", range(2))
def test_one_step_is_that_of_numpy(k):
    there, j, near = partners(k)
    q = REFERENCES.position[k][j]
    s0, t0 = there[near].mean(axis=0), q[near].mean(axis=0)
    u, _, v = np.linalg.svd((there[near] - s0).T @ (q[near] - t0))
    turn = v.T @ u.T
    step = np.array([*(t0 - turn @ s0), np.arctan2(turn[1, 0], turn[0, 0])])
    np.testing.assert_allclose(
        found("points", iterations=1).pose[k], composed(step, STARTS[k]), atol=1e-9
    )
    middle, normal, straight = lines(REFERENCES.position[k])
    near = near & straight[j]
    _, step = by_polynomial(there, middle[j], normal[j], near.astype(float))
    np.testing.assert_allclose(
        found("lines", iterations=1).pose[k], composed(step, STARTS[k]), atol=1e-6
    )


def test_the_ends_are_near_the_truth_and_lines_nearer():
    error = {
        name: np.abs(found(name).pose - TRUTH)[:GOOD].max(axis=0) for name in ("points", "lines")
    }
    # Of 60 beams, 30 a direction: 14 mm/√30 = 2.6 mm, over 1.7 m: four times that.
    assert np.all(error["lines"] < [0.0104, 0.0104, 0.006])
    assert np.all(error["points"] < 0.1) and error["points"].sum() > error["lines"].sum()
    assert np.all(found("lines").status[:GOOD] == MatchStatus.CONVERGED)
    assert np.all(found("lines").residual[:GOOD] < 0.03)


@pytest.mark.sweep
def test_numbers_of_other_types_are_those_of_the_scans():
    """A start of integers or of float32, and a prior of float32, beside scans in float64."""
    one = jax.tree.map(lambda part: part[0], (REFERENCES, SCANS))
    whole = matching.Prior(np.zeros(3, np.float32), np.zeros((3, 3), np.float32))
    matcher = matching.PointToLine()
    ends = [
        matching.match(matcher, *one, start, prior).pose
        for start, prior in (([0, 0, 0], whole), (np.zeros(3, np.float32), whole))
    ]
    assert ends[0].dtype == np.asarray(one[1].position).dtype
    np.testing.assert_array_equal(*ends)


def test_bad_scans_have_a_status():
    for name in ("points", "lines"):
        end = found(name)
        assert list(end.status[4:6]) == [MatchStatus.TOO_FEW] * 2
        assert end.status[6] == MatchStatus.UNLIKE
        chex.assert_tree_all_finite(end)
        np.testing.assert_allclose(end.pose[4:6], STARTS[4:6])
        assert np.all(end.pair[4:6] == -1) and np.all(end.inliers[4:6] == 0)


def test_a_corridor_is_degenerate_along_itself():
    for name in ("points", "lines"):
        end = found(name)
        assert end.status[7] == MatchStatus.DEGENERATE
        direction = end.weakest[7] / np.linalg.norm(end.weakest[7])
        assert abs(direction[0]) > 0.999
    assert abs(found("lines").pose[7, 1]) < 0.01


@pytest.mark.sweep
@pytest.mark.parametrize(
    "make",
    swept(
        [matching.PointToLine, matching.PointToPoint, matching.FieldMatcher], matching.PointToLine
    ),
)
@pytest.mark.parametrize("sigma", swept([0.0, 0.02], 0.02))
def test_in_a_corridor_the_prior_decides_whatever_it_is_worth(make, sigma):
    """Walls at y = ±1, both scans from one place: the scans do not depend on x.

    Of so many directions of the corridor, since a rotation of all must change nothing.
    """
    worth = np.array([1e-3, 1e-2, 1.0, 10.0, 1e3])
    angle = np.linspace(-np.pi, np.pi, 180, endpoint=False) + 0.003
    turn = np.array([0.0, 0.0, 0.5, 0.0, -2.0])
    rng = np.random.default_rng(0)

    def seen():
        ranges = 1 / np.abs(np.sin(angle)) + sigma * rng.normal(size=180)
        ray = np.stack([np.cos(angle + turn[:, None]), np.sin(angle + turn[:, None])], axis=-1)
        near = np.tile(ranges < 6, (5, 1))
        return Points(np.where(near[..., None], ranges[:, None] * ray, 0.0), ray, near)

    reference, scan = seen(), seen()
    matcher = make()
    if matcher.of_grid:
        reference = jax.vmap(lambda of: matching.raster(of, 0.05, 8.0))(reference)
    along = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    prior = Prior(np.c_[0.35 * along, np.zeros(5)], worth[:, None, None] * np.eye(3))
    fit = jax.device_get(matching.match(matcher, reference, scan, np.zeros((5, 3)), prior))
    assert np.all(fit.status == MatchStatus.DEGENERATE)
    np.testing.assert_allclose((fit.pose[:, :2] * along).sum(axis=1), 0.35, atol=2e-3)
    np.testing.assert_allclose(fit.determined[0], np.diag([0, 1, 1]), atol=0.02)
    alone = matching.match(matcher, reference, scan, np.zeros((5, 3)))
    np.testing.assert_allclose((alone.pose[:, :2] * along).sum(axis=1), 0, atol=2e-3)


@pytest.mark.sweep
@pytest.mark.parametrize(
    "make", swept([matching.PointToPoint, matching.PointToLine], matching.PointToLine)
)
def test_a_prior_holds_what_the_scans_do_not_determine(make):
    """At the end the slope of the cost is zero; in the corridor x is that of the prior."""
    matcher = make(IcpSettings(**OPTIONS, tolerance=1e-9, kernel=Huber(), scale=0.05))
    information = np.diag([0.5, 0.5, 0.5]) + 0.2
    prior = Prior(STARTS + [0.03, -0.02, 0.01], np.tile(information, (COUNT, 1, 1)))
    fit = jax.device_get(matching.match(matcher, REFERENCES, SCANS, STARTS, prior))

    @jax.jit
    @jax.vmap
    def slope(of, scan, end):
        return jax.grad(lambda pose: matcher.cost(matcher.prepare(of), scan, pose, end))(end.pose)

    np.testing.assert_allclose(slope(REFERENCES, SCANS, fit)[:GOOD], 0, atol=1e-5)
    np.testing.assert_array_equal(fit.determined[0], np.eye(3))
    # In the corridor the slope of the scans' cost counts across it alone.
    whole, of_prior = slope(REFERENCES, SCANS, fit)[7], information @ (fit.pose - prior.pose)[7]
    left = fit.determined[7].T @ (whole - of_prior) + of_prior
    np.testing.assert_allclose(left, 0, atol=2e-5)
    assert np.linalg.matrix_rank(fit.determined[7], tol=1e-6) == 2


@pytest.mark.sweep
def test_trimming_and_a_kernel_bear_outliers_and_forward_derivatives_are_finite():
    """Every sixth beam is 30 cm short; in float32 the same to 1 mm."""
    position = np.array(SCANS.position[:GOOD])
    position[:, ::6] -= 0.3 * SCANS.ray[:GOOD, ::6]
    scans = Points(position, SCANS.ray[:GOOD], SCANS.valid[:GOOD])
    references = Points(*(part[:GOOD] for part in REFERENCES))
    error = {}
    for name, options in {
        "plain": {}, "trimmed": {"trim": 0.75}, "kernel": {"kernel": Huber(), "scale": 0.02}
    }.items():  # fmt: skip
        end = matching.match(
            matching.PointToLine(IcpSettings(**OPTIONS, least_score=0.1, **options)),
            references, scans, STARTS[:GOOD],
        )  # fmt: skip
        error[name] = np.abs(np.asarray(end.pose) - TRUTH[:GOOD])[:, :2].mean()
    assert error["trimmed"] < 0.5 * error["plain"] and error["kernel"] < 0.7 * error["plain"]

    matcher = matching.PointToLine(IcpSettings(**OPTIONS))
    of, scan = (Points(*(part[0] for part in p)) for p in (REFERENCES, SCANS))
    pose, slope = jax.jit(
        lambda by: jax.jvp(
            lambda d: matcher.match(
                matcher.prepare(of), _point_sets.move_along_rays(scan, d), STARTS[0]
            ).pose,
            (0 * by,), (by,),
        )
    )(jnp.ones(BEAMS))  # fmt: skip
    assert np.all(np.isfinite(slope))
    end = matching.match(matcher, *narrow((of, scan, STARTS[0])))
    assert end.pose.dtype == np.float32
    np.testing.assert_allclose(end.pose, pose, atol=1e-3)


@refused(
    (lambda m, p: matching.match("icp", p, p, np.zeros(3)), "expected a Matcher"),
    (lambda m, p: matching.match(m, "map", p, np.zeros(3)), "match: reference: expected Points, got 'map'; point_to_line takes Points"),
    (lambda m, p: matching.match(m, p, p, np.zeros(2)), r"match: start: expected poses \(x, y, θ\), got \(2,\)"),
    (lambda m, p: matching.match(m, p, p, np.full(3, np.nan)), r"match: start: expected finite numbers, got \[nan nan nan\]"),
    (lambda m, p: matching.match(m, p, p._replace(valid=np.ones(3, bool)), np.zeros(3)),
     "expected N positions, rays and masks"),
    (lambda m, p: matching.match(m, p._replace(position=np.nan * p.position), p, np.zeros(3)),
     "expected finite points"),
    (lambda m, p: matching.match(m, Points(*(part[:0] for part in p)), p, np.zeros(3)),
     "match: reference: expected at least one point, valid or not"),
    (lambda m, p: matching.match(m, p, p, np.zeros(3), np.eye(3)), "expected a Prior"),
    (lambda m, p: matching.points(Beams(np.ones(4), np.ones(3), np.ones(4, bool)), 5.0),
     r"of one scan, got \(4,\), \(3,\), \(4,\)"),
    (lambda m, p: matching.points(Beams(*np.ones((3, 4))), np.nan), "points: max_range: expected a number above 0, got nan"),
    (lambda m, p: matching.match(m, p, p, np.zeros(3), Prior(np.zeros(2), np.eye(3))),
     r"match: prior: expected a pose 3 and an information 3 x 3, got \(2,\) and \(3,"),
    (lambda m, p: matching.match(m, p, p, np.zeros(3), Prior(np.zeros(3), -np.eye(3))),
     "positive semi-definite"),
    (lambda m, p: matching.match(m, p, p, np.zeros(3), Prior(np.full(3, np.nan), np.eye(3))),
     "match: prior: expected finite numbers"),
    (lambda m, p: IcpSettings(reach=0), "IcpSettings: reach: expected a number above 0, got 0"),
    (lambda m, p: IcpSettings(span=0), "IcpSettings: span: expected an integer >= 1, got 0"),
    (lambda m, p: matching.FieldMatcher(scale=-1), "FieldMatcher: scale: expected a number above 0, got -1"),
    (lambda m, p: matching.Correlative(block=0), "Correlative: block: expected an integer >= 2, got 0"),
    (lambda m, p: matching.raster(p, 0.0, 1.0), r"raster: resolution: expected a number above 0, got 0\.0"),
)  # fmt: skip
def test_bad_input_is_refused(call):
    p = points_at(np.zeros(3), np.random.default_rng(0))
    call(matching.PointToLine(), p)


# --- The steps of the ICPs against NumPy: the roots of Censi's polynomial, and a fit by SVD -------


DRAWS = np.random.default_rng(4)
POINTS, CASES = 12, 6


def clouds():
    source = DRAWS.uniform(-3, 3, (CASES, POINTS, 2))
    target = source + DRAWS.normal(0, 0.3, source.shape)
    normal = DRAWS.normal(size=source.shape)
    normal /= np.linalg.norm(normal, axis=2, keepdims=True)
    weight = DRAWS.uniform(0, 1, (CASES, POINTS))
    weight[:, :3] = 0
    return source, target, normal, weight


def align_to_lines(*given):
    return minimizer(of_lines(*given))


def align_points(*given):
    return minimizer(of_points(*given))


def test_a_prior_is_a_term_of_the_cost():
    """Of all motions, by the shift that is best for each of 2,000 headings, in NumPy."""
    source, target, normal, weight = (part[0] for part in clouds())
    pose, middle = np.array([0.4, -0.2, 0.3]), np.array([0.1, 0.5])
    root = DRAWS.normal(size=(3, 3))
    prior = Prior(pose + [0.3, 0.2, -0.1], root @ root.T)

    @jax.jit
    def found(prior):
        both = add(of_lines(source, target, normal, weight), of_prior(prior, pose, middle))
        return minimizer(both)

    arm = pose[:2] - middle
    best = np.inf, None
    for angle in np.linspace(-np.pi, np.pi, 2001):
        c, s = np.cos(angle), np.sin(angle)
        turn = np.array([[c, -s], [s, c]])
        # Residuals of a shift t: rows of n t + b, weighted.
        rows = np.concatenate([np.sqrt(weight)[:, None] * normal, root.T[:, :2]])
        off = np.array([*(turn @ arm + middle - prior.pose[:2]), 0.1 * c + s])
        rest = np.sqrt(weight) * (normal * (source @ turn.T - target)).sum(axis=1)
        rest = np.concatenate([rest, root.T @ off])
        shift = -np.linalg.lstsq(rows, rest, rcond=None)[0]
        value = ((rows @ shift + rest) ** 2).sum()
        best = min(best, (value, (*shift, angle)))
    np.testing.assert_allclose(found(prior), best[1], atol=4e-3)


def test_the_step_to_lines_is_the_least_root_of_the_polynomial():
    source, target, normal, weight = clouds()
    found = np.asarray(jax.jit(jax.vmap(align_to_lines))(source, target, normal, weight))
    for k in range(CASES):
        value, pose = by_polynomial(source[k], target[k], normal[k], weight[k])
        np.testing.assert_allclose(found[k], pose, atol=1e-8)
        assert line_cost(found[k], source[k], target[k], normal[k], weight[k]) <= value + 1e-9


def test_what_lines_do_not_determine_stays():
    """All normals along y: x stays at 0, whatever the partners."""
    source, target, _, weight = (part[0] for part in clouds())
    normal = np.tile([0.0, 1.0], (POINTS, 1))
    pose = np.asarray(jax.jit(align_to_lines)(source, target, normal, weight))
    assert abs(pose[0]) < 1e-6 and np.all(np.isfinite(pose))
    nothing = jax.jit(align_to_lines)(source, target, normal, 0 * weight)
    np.testing.assert_allclose(nothing, 0, atol=1e-12)


def test_the_step_to_points_is_the_weighted_fit():
    source, target, _, weight = clouds()
    found = np.asarray(jax.jit(jax.vmap(align_points))(source, target, weight))
    for k in range(CASES):
        w = weight[k] / weight[k].sum()
        s0, t0 = w @ source[k], w @ target[k]
        u, _, v = np.linalg.svd(((source[k] - s0) * w[:, None]).T @ (target[k] - t0))
        turn = v.T @ np.diag([1, np.linalg.det(v.T @ u.T)]) @ u.T
        shift = t0 - turn @ s0
        np.testing.assert_allclose(
            found[k], [*shift, np.arctan2(turn[1, 0], turn[0, 0])], atol=1e-10
        )
