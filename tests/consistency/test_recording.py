"""The covariance of a recorded robot, against plain NumPy and Monte Carlo."""

import numpy as np
import pytest
from cases import refused

from jaxslam.consistency import judge_recording
from jaxslam.math import numpy_poses as poses
from jaxslam.math.stats import chi2_quantile

STEP = 0.1
DEVIATIONS = np.array([0.05, 0.03, 0.02])


def drive(count):
    """A path with changing speed: times and poses."""
    time = 1.7e9 + STEP * np.arange(count)
    v = 0.5 + 0.4 * np.sin(0.5 * np.arange(count) * STEP)
    omega = 0.3 + 0.3 * np.sin(0.31 * np.arange(count) * STEP)
    steps = STEP * np.column_stack([v, np.zeros(count), omega])
    return time, poses.chain(np.array([1.0, -2.0, 3.0]), steps[:-1])


def walk(rng, count, length, draws=()):
    """Three series with variance 1, the correlation exp(-|k|/length) over k rows."""
    factor = np.exp(-1 / length) if length else 0.0
    normals = rng.standard_normal((count, *draws, 3))
    series = np.empty(normals.shape)
    series[0] = normals[0]
    for k in range(1, count):
        series[k] = factor * series[k - 1] + np.sqrt(1 - factor**2) * normals[k]
    return series


def turned(cov, heading):
    """A covariance of along, across and heading in the axes of the world."""
    c, s = np.cos(heading), np.sin(heading)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return turn @ cov @ turn.T


def recorded(rng, count=600, length=0, scale=1.0):
    """The estimate of an honest estimator, its σ claimed `scale` times as large, and the truth.

    The covariance changes over time, with a correlation of along and heading.
    """
    time, path = drive(count)
    size = 1 + 0.5 * np.sin(0.02 * np.arange(count))
    normal = np.eye(3)
    normal[0, 2] = normal[2, 0] = 0.5
    cov = normal * DEVIATIONS[:, None] * DEVIATIONS * size[:, None, None] ** 2
    error = (np.linalg.cholesky(cov) @ walk(rng, count, length)[..., None])[..., 0]
    heading = path[:, 2] - error[:, 2]
    c, s = np.cos(heading), np.sin(heading)
    position = path[:, :2] - np.column_stack(
        [c * error[:, 0] - s * error[:, 1], s * error[:, 0] + c * error[:, 1]]
    )
    pose = np.column_stack([position, poses.wrapped(heading)])
    cov = np.array([turned(each, angle) for each, angle in zip(cov, heading, strict=True)])
    return (time, pose, scale**2 * cov), (time, path), error


def test_numbers_against_plain_loops():
    estimate, truth, error = recorded(np.random.default_rng(1))
    scores = judge_recording(estimate, truth)
    np.testing.assert_allclose(scores.errors.error, error, atol=1e-9)
    squares = {"pose": [], "position": [], "heading": []}
    for pose, cov, true in zip(estimate[1], estimate[2], truth[1], strict=True):
        off = true - pose
        off[2] = (off[2] + np.pi) % (2 * np.pi) - np.pi
        squares["pose"].append(off @ np.linalg.inv(cov) @ off)
        squares["position"].append(off[:2] @ np.linalg.inv(cov[:2, :2]) @ off[:2])
        squares["heading"].append(off[2] ** 2 / cov[2, 2])
    for (name, square), dof in zip(squares.items(), (3, 2, 1), strict=True):
        block = scores.blocks[name]
        assert block.poses == 600
        assert block.honest == (dof, dof)
        np.testing.assert_allclose(block.nees.value, np.mean(square), rtol=1e-9)
        for level, share in block.coverage.items():
            inside = np.mean(np.array(square) <= chi2_quantile(level, dof))
            np.testing.assert_allclose(share.value, inside)
            assert share.low <= share.value <= share.high
            np.testing.assert_allclose(block.honest_coverage[level], level)
    for k, name in enumerate(("along", "across", "heading")):
        np.testing.assert_allclose(scores.rmse[name], np.sqrt(np.mean(error[:, k] ** 2)))
        np.testing.assert_allclose(scores.mean[name].value, error[:, k].mean(), atol=1e-12)
    assert scores.verdict == "consistent"


@pytest.mark.parametrize("length", [0, 5])
def test_the_number_of_independent_errors_is_that_of_monte_carlo(length):
    """var q̄ = 2 d²/(d n_eff) of the mean of q = zᵀz over recordings."""
    rng = np.random.default_rng(2)
    means = (walk(rng, 600, length, (2000,)) ** 2).sum(axis=2).mean(axis=0)
    expected = 2 * 3 / np.var(means)
    # n (1 - a²)/(1 + a²) of an AR(1) with a = exp(-1/length)
    a = np.exp(-1 / length) if length else 0.0
    np.testing.assert_allclose(expected, 600 * (1 - a**2) / (1 + a**2), rtol=0.15)
    numbers = [
        judge_recording(*recorded(rng, 600, length)[:2]).blocks["pose"].independent
        for _ in range(30)
    ]
    np.testing.assert_allclose(np.median(numbers), expected, rtol=0.15)


def test_intervals_hold_the_truth_of_correlated_errors():
    rng = np.random.default_rng(3)
    held = {"nees": [], "factor": [], "mean": [], "lag": [], "coverage": []}
    for _ in range(60):
        scores = judge_recording(*recorded(rng, 600, 10)[:2])
        held["nees"].append(scores.blocks["pose"].nees.low <= 3 <= scores.blocks["pose"].nees.high)
        held["factor"].append(scores.factors["across"].low <= 1 <= scores.factors["across"].high)
        held["mean"].append(scores.mean["along"].low <= 0 <= scores.mean["along"].high)
        held["lag"].append(scores.lag.seconds.low <= 0 <= scores.lag.seconds.high)
        share = scores.blocks["pose"].coverage[0.9]
        held["coverage"].append(share.low <= 0.9 <= share.high)
    for name, within in held.items():
        assert np.mean(within) >= 0.85, name  # 60 of 95 %: σ 2.8 %


def test_a_sigma_that_is_halved_is_too_small_by_two():
    honest = judge_recording(*recorded(np.random.default_rng(4))[:2])
    halved = judge_recording(*recorded(np.random.default_rng(4), scale=0.5)[:2])
    for name, factor in honest.factors.items():
        np.testing.assert_allclose(halved.factors[name], 2 * np.array(factor), rtol=1e-9)
        assert factor.low <= 1 <= factor.high
    assert halved.verdict == "optimistic"
    doubled = judge_recording(*recorded(np.random.default_rng(4), scale=2.0)[:2])
    assert doubled.verdict == "pessimistic"
    short = judge_recording(*recorded(np.random.default_rng(4), 30, 300)[:2])
    assert short.verdict == "undecided"


def test_covariances_in_the_axes_of_the_robot():
    (time, pose, cov), truth, _ = recorded(np.random.default_rng(5))
    body = np.array([turned(each, -angle) for each, angle in zip(cov, pose[:, 2], strict=True)])
    world = judge_recording((time, pose, cov), truth)
    in_body = judge_recording((time, pose, body), truth, covariance_frame="body")
    np.testing.assert_allclose(in_body.errors.sigma, world.errors.sigma, rtol=1e-9)
    for name, block in world.blocks.items():
        np.testing.assert_allclose(in_body.blocks[name].nees, block.nees, rtol=1e-9)


@pytest.mark.parametrize("align", ["none", "first", "best"])
def test_a_lag_is_found_and_removed(align):
    (time, pose, cov), (clock, path), _ = recorded(np.random.default_rng(6), 1200)
    frame = np.zeros(3) if align == "none" else np.array([4.0, -1.0, 2.5])
    moved = poses.compose(frame, path)
    late = judge_recording((time + 0.08, pose, cov), (clock, moved), align=align)
    lag = late.lag
    assert lag.error < 0.01
    assert abs(lag.seconds.value - 0.08) < 3 * lag.error
    if align == "first":  # one error, at the first pose, decides
        return
    exact = judge_recording((time, pose, cov), (clock, moved), align=align)
    assert abs(lag.nees["pose"].value - exact.blocks["pose"].nees.value) < 0.1
    assert late.blocks["pose"].nees.value > 1.2 * exact.blocks["pose"].nees.value
    assert any("behind the truth" in doubt for doubt in late.doubts)


def test_a_constant_velocity_has_no_lag():
    time = np.arange(200.0)
    path = np.column_stack([0.5 * time, np.zeros(200), np.zeros(200)])
    rng = np.random.default_rng(7)
    cov = np.tile(0.01 * np.eye(3), (200, 1, 1)) * rng.uniform(0.9, 1.1, 200)[:, None, None]
    scores = judge_recording((time, path + 0.1 * rng.standard_normal((200, 3)), cov), (time, path))
    assert scores.lag is None
    assert any("velocity is constant" in doubt for doubt in scores.doubts)
    assert "lag" not in "".join(row[0] for row in scores.rows())


def test_the_truth_is_interpolated_on_se2_but_not_over_a_gap():
    time, path = drive(400)
    between = time[:-1] + 0.5 * STEP
    middle = poses.compose(
        path[:-1], poses.part(poses.between(path[:-1], path[1:]), np.full(399, 0.5))
    )
    cov = np.tile(np.eye(3), (399, 1, 1)) * np.linspace(1, 2, 399)[:, None, None]
    scores = judge_recording((between, middle, cov), (time, path))
    np.testing.assert_allclose(scores.errors.error, 0, atol=1e-6)  # times of ten digits
    kept = np.r_[0:100, 150:380]
    gapped = judge_recording((between, middle, cov), (time[kept], path[kept]))
    assert gapped.dropped == {
        "before the first or after the last time of the truth": 20,
        "in a gap of the truth": 51,
    }
    assert len(gapped.errors.time) == 328
    wide = judge_recording((between, middle, cov), (time[kept], path[kept]), longest_gap=6.0)
    assert "in a gap of the truth" not in wide.dropped


FAULTS = {
    "covariance zero": lambda cov: 0 * cov,
    "covariance not finite": lambda cov: np.nan * cov,
    "covariance constant from beginning to end": lambda cov: np.tile(cov[0], (len(cov), 1, 1)),
    "covariance -1 first, unknown": lambda cov: np.where(np.eye(3) == [1, 0, 0], -1.0, cov),
    "covariance above 10000": lambda cov: 1e9 * cov,
    "covariance of the position singular, or not positive definite": lambda cov: (
        np.diag([1.0, 0, 1]) @ cov @ np.diag([1.0, 0, 1])
    ),
    "covariance of the position not symmetric": lambda cov: cov + [[0, 0.5, 0], [0, 0, 0], [0] * 3],
    "variance of the heading above 10000": lambda cov: cov + np.diag([0, 0, 1e6]),
    "variance of the heading zero": lambda cov: np.diag([1.0, 1, 0]) @ cov @ np.diag([1.0, 1, 0]),
}


@pytest.mark.parametrize("reason", FAULTS)
def test_a_covariance_that_is_none_is_named_and_not_judged(reason):
    (time, pose, cov), truth, error = recorded(np.random.default_rng(8), 200)
    scores = judge_recording((time, pose, FAULTS[reason](cov)), truth)
    assert scores.dropped[reason] == 200
    parts = {"covariance of the position": {"heading"}, "variance of the heading": {"position"}}
    left = next((kept for words, kept in parts.items() if reason.startswith(words)), set())
    assert set(scores.blocks) == left
    assert scores.verdict == ("consistent" if left else "incomplete")
    np.testing.assert_allclose(scores.errors.error, error, atol=1e-9)
    assert reason in str(scores)
    honest = judge_recording((time, pose, cov), truth)
    for name in left:
        np.testing.assert_allclose(scores.blocks[name].nees, honest.blocks[name].nees, rtol=1e-9)


def test_some_covariances_that_are_none_make_a_recording_incomplete():
    (time, pose, cov), truth, _ = recorded(np.random.default_rng(9))
    cov[::10] = 0
    scores = judge_recording((time, pose, cov), truth)
    assert (scores.verdict, scores.dropped["covariance zero"]) == ("incomplete", 60)
    assert scores.blocks["pose"].poses == 540
    assert np.isnan(scores.errors.sigma[::10]).all()
    assert judge_recording((time, pose, cov / 4), truth).verdict == "optimistic"


def test_errors_alone_without_covariances():
    (time, pose, _), truth, error = recorded(np.random.default_rng(10))
    scores = judge_recording((time, pose, None), truth)
    assert (scores.verdict, scores.blocks, scores.factors) == ("incomplete", {}, {})
    np.testing.assert_allclose(scores.rmse["along"], np.sqrt(np.mean(error[:, 0] ** 2)))
    assert scores.lag is not None
    assert "no covariance" in scores.doubts[0]


def test_a_truth_in_another_frame_is_noticed():
    estimate, (time, path), _ = recorded(np.random.default_rng(3), 300)
    moved = poses.compose(np.array([30.0, -20.0, 0.5]), path)
    (doubt,) = (d for d in judge_recording(estimate, (time, moved)).doubts if "rigid" in d)
    assert "if the two are in different frames, align best" in doubt
    before = np.sqrt(((moved - estimate[1])[:, :2] ** 2).sum(axis=1).mean())
    assert f"from {before:.3g} m" in doubt
    for align, truth in (("none", path), ("best", moved)):
        scores = judge_recording(estimate, (time, truth), align=align)
        assert not any("frames" in doubt for doubt in scores.doubts)


def test_the_best_alignment_is_undone_whatever_the_frame():
    """And it minimizes Σ eᵀ P⁻¹ e: a small motion of the frame makes it no smaller."""
    (time, pose, cov), (clock, path), _ = recorded(np.random.default_rng(11), 300, 5)
    near = judge_recording((time, pose, cov), (clock, path), align="best")
    frame = np.array([30.0, -20.0, 2.0])
    far = judge_recording((time, pose, cov), (clock, poses.compose(frame, path)), align="best")
    np.testing.assert_allclose(far.errors.error, near.errors.error, atol=1e-7)
    least = near.blocks["pose"].nees.value
    assert least < judge_recording((time, pose, cov), (clock, path)).blocks["pose"].nees.value
    for motion in 1e-4 * np.vstack([np.eye(3), -np.eye(3)]):
        moved = poses.compose(motion, near.errors.truth)
        assert judge_recording((time, pose, cov), (time, moved)).blocks["pose"].nees.value > least


@pytest.mark.parametrize("length", [0, 12])
def test_what_the_best_alignment_takes_is_in_the_honest_nees(length):
    rng = np.random.default_rng(12)
    nees, honest = ({"pose": [], "position": [], "heading": []} for _ in range(2))
    for _ in range(40):
        scores = judge_recording(*recorded(rng, 150, length)[:2], align="best")
        for name, block in scores.blocks.items():
            assert (
                block.honest[0] <= block.honest[1] == {"pose": 3, "position": 2, "heading": 1}[name]
            )
            nees[name].append(block.nees.value)
            honest[name].append(np.mean(block.honest))
    for name, dof in (("pose", 3), ("position", 2), ("heading", 1)):
        taken_away = dof - np.mean(nees[name])
        accounted = dof - np.mean(honest[name])
        error = np.std(nees[name]) / np.sqrt(40)
        assert abs(taken_away - accounted) < 3 * error + 0.3 * taken_away, name
    if not length:  # one of 150 independent errors
        np.testing.assert_allclose(np.mean(honest["pose"]), 3 * (1 - 1 / 150), atol=0.02)


def test_what_aligning_at_the_first_pose_does_is_in_the_honest_nees():
    """Independent errors add the first one to all others; of odometry they contain it."""
    rng = np.random.default_rng(13)
    forgotten, contained = [], []
    for _ in range(60):
        estimate, truth, _ = recorded(rng, 60)
        block = judge_recording(estimate, truth, align="first").blocks["pose"]
        forgotten.append((block.nees.value, *block.honest))
        # Odometry: poses chained by noisy steps, from a start that is known to P0.
        path = truth[1]
        steps = poses.between(path[:-1], path[1:])
        steps = steps + rng.standard_normal(steps.shape) * [0.01, 0.01, 0.005]
        start_cov = np.diag([0.05, 0.05, 0.01]) ** 2
        start = poses.compose(path[0], rng.standard_normal(3) * np.sqrt(np.diag(start_cov)))
        pose = poses.chain(start, steps)
        covs = [turned(start_cov, path[0, 2])]
        for k in range(len(steps)):
            lever = np.eye(3)
            lever[:2, 2] = [-(pose[k + 1, 1] - pose[k, 1]), pose[k + 1, 0] - pose[k, 0]]
            noise = turned(np.diag([0.01, 0.01, 0.005]) ** 2, pose[k, 2])
            covs.append(lever @ covs[-1] @ lever.T + noise)
        block = judge_recording((truth[0], pose, np.array(covs)), truth, align="first").blocks[
            "pose"
        ]
        contained.append((block.nees.value, *block.honest))
    nees, low, high = np.mean(forgotten, axis=0)
    np.testing.assert_allclose(nees, high, rtol=0.25)
    assert low < 3 < high
    nees, low, high = np.mean(contained, axis=0)
    np.testing.assert_allclose(nees, low, rtol=0.25)


def test_the_table_and_the_record():
    scores = judge_recording(*recorded(np.random.default_rng(14), scale=0.5)[:2])
    text = str(scores)
    assert "optimistic" in text
    for words in ("NEES, pose", "within the 95 % set, heading", "σ too small by, along", "lag"):
        assert words in text
    assert len({len(row) for row in scores.rows()}) == 1
    assert "verdict" in repr(scores)


TIME, PATH = drive(20)
COV = np.tile(np.eye(3), (20, 1, 1))


@refused(
    ((TIME, PATH[:5], None), (TIME, PATH), {}, r"estimate: expected times \(n,\) and poses"),
    (
        (TIME, PATH * [1, 1, 180 / np.pi], None),
        (TIME, PATH),
        {},
        "estimate: expected headings in radians, got some that fit the positions in degrees",
    ),
    (
        (TIME[::-1], PATH, None),
        (TIME, PATH),
        {},
        "estimate: expected times that rise, got .* in row 1",
    ),
    (
        (TIME, PATH, COV[:, :2]),
        (TIME, PATH),
        {},
        r"estimate: covariances: expected shape \(20, 3, 3\)",
    ),
    ((TIME, PATH, COV), (TIME, PATH * np.nan), {}, "truth: expected finite times and poses, row 0"),
    (
        (TIME, PATH, COV),
        (TIME + 100, PATH),
        {},
        "expected at least two times .* at which the truth is known, .* got 0",
    ),
    (
        (TIME, PATH, COV),
        (TIME, PATH),
        {"align": "worst"},
        'align: expected "none" or "first" or "best"',
    ),
    (
        (TIME, PATH, COV),
        (TIME, PATH),
        {"covariance_frame": "map"},
        'covariance_frame: expected "world" or "body"',
    ),
    (
        (TIME, PATH, COV),
        (TIME, PATH),
        {"longest_gap": 0.0},
        "longest_gap: expected a number above 0",
    ),
    told="judge_recording: ",
)
def test_what_is_no_recording_is_refused(estimate, truth, options):
    judge_recording(estimate, truth, **options)
