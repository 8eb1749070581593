"""Errors of paths and maps, against values by hand and homogeneous matrices."""

import broken
import numpy as np
import pytest
from cases import refused
from reference.plane import compose, from_frame

from jaxslam import grids, metrics
from jaxslam.core.types import Estimate

SQUARE = np.array(
    [[0, 0, 0], [1, 0, np.pi / 2], [1, 1, np.pi], [0, 1, -np.pi / 2], [0, 0, 0]], float
)
"""Once around a square of 1 m."""


def random_paths(seed=0, count=40):
    """A path, and the same with errors in another frame."""
    rng = np.random.default_rng(seed)
    path = np.cumsum(rng.normal(size=(count, 3)) * [0.5, 0.5, 0.7], axis=0)
    path[:, 2] = np.arctan2(np.sin(path[:, 2]), np.cos(path[:, 2]))
    moved = compose([3.0, -2.0, 2.5], path + rng.normal(size=path.shape) * 0.05)
    return path, moved


def matrices(path):
    c, s = np.cos(path[:, 2]), np.sin(path[:, 2])
    out = np.tile(np.eye(4), (len(path), 1, 1))
    out[:, :2, :2] = np.stack([np.stack([c, -s], 1), np.stack([s, c], 1)], axis=1)
    out[:, :2, 3] = path[:, :2]
    return out


# --- absolute errors ----------------------------------------------------------------------------


def test_absolute_errors_by_hand():
    off = SQUARE + [0.3, 0.4, 0.0]
    off[2, 2] = -np.pi + 0.1
    found = metrics.ate(SQUARE, off, align=False)
    np.testing.assert_allclose(found.translation, 0.5)
    np.testing.assert_allclose(found.rotation, [0, 0, 0.1, 0, 0], atol=1e-15)
    np.testing.assert_array_equal(found.frame, np.zeros(3))


def test_alignment_takes_out_a_rigid_motion_alone():
    frame = np.array([5.0, -1.0, -2.9])
    errors = metrics.ate(SQUARE, compose(frame, SQUARE))
    np.testing.assert_allclose(errors.translation, 0, atol=1e-14)
    np.testing.assert_allclose(errors.rotation, 0, atol=1e-14)
    np.testing.assert_allclose(
        compose(errors.frame, compose(frame, SQUARE))[:, :2],
        SQUARE[:, :2],
        atol=1e-14,
    )
    # Corners of a square 10 % too large are all 0.1/√2 off.
    grown = metrics.ate(SQUARE[:4], SQUARE[:4] * [1.1, 1.1, 1.0])
    np.testing.assert_allclose(grown.translation, 0.1 / np.sqrt(2))


def test_the_alignment_is_the_best_of_its_neighbours():
    path, moved = random_paths()
    best = metrics.alignment(moved[:, :2], path[:, :2])

    def cost(frame):
        return ((compose(frame, moved[:, :2]) - path[:, :2]) ** 2).sum()

    for step in np.vstack([np.eye(3), -np.eye(3)]) * 1e-4:
        assert cost(best) < cost(best + step)
    np.testing.assert_allclose(metrics.alignment([[1.0, 2.0]], [[4.0, -2.0]]), [3, -4, 0])


# --- relations ----------------------------------------------------------------------------------


def test_relative_errors_by_hand():
    """The second leg is 0.2 m too long and ends 0.1 rad off; the frame is another one."""
    bad = SQUARE.copy()
    bad[2:, 1] += 0.2
    bad[2, 2] += 0.1
    bad = compose([7.0, 8.0, 1.0], bad)
    errors = metrics.rpe(SQUARE, bad, rows=1)
    # The turn of 0.1 rad swings the third leg by 2 sin 0.05.
    np.testing.assert_allclose(errors.translation, [0, 0.2, 2 * np.sin(0.05), 0], atol=1e-14)
    np.testing.assert_allclose(errors.rotation, [0, 0.1, 0.1, 0], atol=1e-14)
    np.testing.assert_allclose(metrics.rpe(SQUARE, bad, metres=4.0).translation, 0.2, atol=1e-14)


def test_relations_at_stated_spacings():
    by_metres = metrics.relations(SQUARE, metres=(1.0, 2.5))
    np.testing.assert_array_equal(by_metres.first, [0, 1, 2, 3, 0, 1])
    np.testing.assert_array_equal(by_metres.second, [1, 2, 3, 4, 3, 4])
    np.testing.assert_allclose(by_metres.pose[0], [1, 0, np.pi / 2], atol=1e-15)
    np.testing.assert_allclose(by_metres.pose[1], [1, 0, np.pi / 2], atol=1e-15)
    time = 1.4e9 + np.array([0.0, 1.0, 1.5, 3.0, 3.5])
    by_time = metrics.relations(SQUARE, seconds=1.5, time=time)
    np.testing.assert_array_equal(by_time.second, [2, 3, 3])
    assert len(metrics.relations(SQUARE, rows=5).first) == 0
    assert len(by_metres.pose) + len(by_time.pose) == 9


def test_no_relation_is_across_a_gap_of_the_stamps():
    """A step of over ten medians that is longer than the spacing; a shorter one is spanned."""
    time = np.concatenate([np.arange(11) / 10, np.arange(30, 51) / 10, np.arange(65, 76) / 10])
    path = np.stack([time, 0 * time, 0 * time], axis=1)
    found = metrics.relations(path, seconds=(0.5, 1.8), time=time)
    np.testing.assert_allclose(found.pose[:, 0], time[found.second] - time[found.first])
    near = found.pose[:, 0] < 1.5
    # Of each part all rows but its last five; of 1.8 s only the gap of 1.5 s may be spanned.
    assert near.sum() == (11 - 5) + (21 - 5) + (11 - 5)
    np.testing.assert_allclose(found.pose[near, 0], 0.5)
    assert (found.pose[~near, 0] < 1.8 + 1.5).all()
    assert time[found.first[~near]].min() == 3.0


def test_revisits_are_near_in_space_and_far_along_the_path():
    found = metrics.revisits(SQUARE, radius=0.5, apart=3.0)
    np.testing.assert_array_equal([found.first, found.second], [[0], [4]])
    np.testing.assert_allclose(found.pose, 0, atol=1e-15)
    assert len(metrics.revisits(SQUARE, radius=0.5, apart=4.5).first) == 0


def test_given_relations_take_the_nearest_rows_and_count_what_is_dropped():
    time = np.arange(5.0)
    pose = np.array([[1, 0, np.pi / 2], [0, 0, 0], [0, 0, 0]])
    found, dropped = metrics.relations_at_stamps(
        time, [0.1, 4.4, 0], [1.2, 0, 9.0], pose, tolerance=0.3
    )
    assert dropped == 2
    np.testing.assert_array_equal([found.first, found.second], [[0], [1]])
    np.testing.assert_allclose(metrics.relation_errors(found, SQUARE).translation, 0, atol=1e-15)


def test_given_relations_join_a_path_whose_stamps_go_back():
    time = 1e9 + np.array([0.0, 2.0, 1.0, 1.0, 3.0])
    pose, ends = np.zeros((4, 3)), 1e9 + np.array([[1, 2, 3.1, 3.1], [2, 0, 0, 9]])
    found, dropped = metrics.relations_at_stamps(time, *ends, pose, tolerance=0.2)
    assert dropped == 1
    np.testing.assert_array_equal([found.first, found.second], [[2, 1, 4], [1, 0, 0]])
    found, dropped = metrics.relations_at_stamps([7, 7], [7], [7.1], pose[:1], tolerance=0.1 + 1e-9)
    assert (found.first, found.second, dropped) == (0, 0, 0)


def test_a_relation_error_is_that_of_the_composed_matrices():
    path, moved = random_paths(1)
    made = metrics.relations(path, metres=(0.5, 3.0))
    true, found = matrices(path), matrices(moved)
    off = metrics.relation_errors(made, moved)
    for k, (i, j) in enumerate(zip(made.first, made.second, strict=True)):
        delta = np.linalg.inv(true[i]) @ true[j], np.linalg.inv(found[i]) @ found[j]
        gap = np.linalg.inv(delta[0]) @ delta[1]
        np.testing.assert_allclose(off.translation[k], np.hypot(*gap[:2, 3]), atol=1e-12)
        angle = abs(np.arctan2(gap[1, 0], gap[0, 0]))
        np.testing.assert_allclose(off.rotation[k], angle, atol=1e-12)


def test_statistics_by_hand():
    figures = metrics.statistics([1.0, 2.0, 6.0])
    expected = (3, 3.0, np.sqrt(14 / 3), np.sqrt(41 / 3), 2.0, 1.0, 6.0)
    np.testing.assert_allclose(figures, expected)
    told = metrics.summary(metrics.Errors(np.array([1.0, 2.0, 6.0]), np.deg2rad([1.0, 2.0, 6.0])))
    assert told["translation RMSE [m]"] == pytest.approx(np.sqrt(41 / 3))
    assert told["rotation mean [deg]"] == pytest.approx(3.0)


def test_the_figures_of_the_benchmark_by_hand():
    found = metrics.benchmark_figures(
        metrics.Errors(np.array([1.0, 2.0, 6.0]), np.deg2rad([1.0, 3.0, 2.0]))
    )
    expected = {
        "translation [m]": (3, np.sqrt(14 / 3)),
        "translation² [m²]": (41 / 3, np.std([1, 4, 36])),
        "rotation [deg]": (2, np.sqrt(2 / 3)),
        "rotation² [deg²]": (14 / 3, np.std([1, 9, 4])),
    }
    assert list(found) == list(expected)
    for name, figures in expected.items():
        np.testing.assert_allclose(found[name], figures)


# --- maps ---------------------------------------------------------------------------------------


def test_a_map_is_compared_after_the_motion_that_fits_best():
    survey = np.array([[0.0, 0.0], [4.0, 0.0], [0.0, 3.0], [9.0, 9.0]])
    tag = np.array([2, 0, -1, 1])
    points = from_frame([1.0, 2.0, 0.7], survey[tag])
    estimate = Estimate((), (), points, (), tag >= 0, tag)
    pose, rmse = metrics.align_map(estimate, survey)
    assert rmse < 1e-14
    np.testing.assert_allclose(from_frame(pose, points[:1])[0], survey[2], atol=1e-14)
    with pytest.raises(ValueError, match="no tagged landmark"):
        metrics.align_map(estimate._replace(tag=-np.ones(4, int)), survey)


def test_the_entropy_of_a_map_is_that_of_its_known_cells():
    log_odds = np.array([[np.log(3.0), 0.0], [-np.log(3.0), 0.0]])
    grid = grids.Grid(log_odds, np.zeros(3), np.array(0.1))
    expected = -(0.25 * np.log2(0.25) + 0.75 * np.log2(0.75))
    assert metrics.map_entropy(grid) == pytest.approx(expected, abs=1e-12)
    with pytest.raises(ValueError, match="map_entropy: grid: it has no known cell"):
        metrics.map_entropy(grid._replace(log_odds=0 * log_odds))


# --- bad input ----------------------------------------------------------------------------------


@refused(
    (lambda: metrics.ate(SQUARE, SQUARE[:3]), "ate: .* same length, got 5 and 3"),
    (lambda: metrics.ate(SQUARE[:, :2], SQUARE[:, :2]), r"ate: .* got shape \(5, 2\)"),
    (
        lambda: metrics.ate(SQUARE, SQUARE * np.nan),
        "ate: estimate: expected finite .* row 0 is not",
    ),
    (
        lambda: metrics.ate(np.zeros((0, 3)), np.zeros((0, 3))),
        r"ate: reference: expected at least one of poses \(x, y, θ\), got shape \(0, 3\)",
    ),
    (
        lambda: metrics.ate([["a", 1, 2]], SQUARE[:1]),
        r"ate: reference: expected a table of poses \(x, y, θ\)",
    ),
    (lambda: metrics.relations(SQUARE), "relations: expected exactly one"),
    (lambda: metrics.relations(SQUARE, rows=1, metres=1.0), "relations: expected exactly one"),
    (lambda: metrics.relations(SQUARE, seconds=1.0), "relations: expected the stamps"),
    (lambda: metrics.relations(SQUARE, metres=0.0), "relations: expected finite spacings above 0"),
    (
        lambda: metrics.relations(SQUARE, rows=1.5),
        r"relations: rows: expected a whole number, got 1\.5",
    ),
    (
        lambda: metrics.relations(SQUARE, seconds=1.0, time=[0, 1, 0.5, 2, 3]),
        r"relations: time: expected stamps that do not go back, got 0\.5 in row 2",
    ),
    (
        lambda: metrics.revisits(SQUARE, radius=0, apart=1),
        "revisits: radius: expected a number above 0, got 0",
    ),
    (
        lambda: metrics.relation_errors(metrics.relations(SQUARE, rows=4), SQUARE[:3]),
        "relation_errors: of: of rows up to 4, and the path has 3",
    ),
    (
        lambda: metrics.relations_at_stamps([0, 1], [0], [1, 2], SQUARE[:1], tolerance=1),
        r"relations_at_stamps: second: expected 1 stamps, got \(2,\)",
    ),
    (
        lambda: metrics.relations_at_stamps([3, 0, 1], [7, 0], [8, 9], SQUARE[:2], tolerance=0.5),
        r"relations_at_stamps: none of 2 relations, from 0\.0+ s to 9\.0+ s, joins the path, from 0\.0+ s to "
        r"3\.0+ s, within 0\.5 s",
    ),
    (
        lambda: metrics.relations_at_stamps([0, 1], [0], [np.nan], SQUARE[:1], tolerance=1),
        "relations_at_stamps: second: expected finite stamps, got nan in row 0",
    ),
    (
        lambda: metrics.relations_at_stamps([0, np.inf], [0], [1], SQUARE[:1], tolerance=1),
        r"relations_at_stamps: time: expected finite stamps \(K,\), got \(2,\)",
    ),
    (
        lambda: metrics.relations_at_stamps([0, 1], [0], [1], SQUARE[:1], tolerance=-1),
        "relations_at_stamps: tolerance: expected at least 0 s, got -1",
    ),
    (
        lambda: metrics.statistics([]),
        r"statistics: values: expected finite errors \(at least 1,\), got \(0,\)",
    ),
    (
        lambda: metrics.benchmark_figures(metrics.Errors(np.zeros(0), np.zeros(0))),
        r"statistics: values: expected finite errors \(at least 1,\), got \(0,\)",
    ),
)
def test_bad_input_is_refused_by_name(call):
    call()


# --- evo ----------------------------------------------------------------------------------------


def test_the_errors_are_those_of_evo():
    broken.optional("evo")
    from evo.core import metrics as theirs
    from evo.core.trajectory import PosePath3D

    path, moved = random_paths(2)
    true, found = (PosePath3D(poses_se3=list(matrices(each))) for each in (path, moved))
    relation = theirs.PoseRelation
    for kind, field in (
        (relation.translation_part, "translation"),
        (relation.rotation_angle_rad, "rotation"),
    ):
        step = theirs.RPE(kind, delta=3, delta_unit=theirs.Unit.frames, all_pairs=True)
        step.process_data((true, found))
        ours = getattr(metrics.rpe(path, moved, rows=3), field)
        np.testing.assert_allclose(ours, step.error, atol=1e-8)
    aligned = PosePath3D(poses_se3=list(matrices(moved)))
    aligned.align(true)
    whole = theirs.APE(relation.translation_part)
    whole.process_data((true, aligned))
    ours = metrics.ate(path, moved)
    np.testing.assert_allclose(ours.translation, whole.error, atol=1e-9)
    figures = metrics.statistics(ours.translation)
    for name in ("rmse", "mean", "median", "std", "min", "max"):
        expected = whole.get_statistic(theirs.StatisticsType(name))
        np.testing.assert_allclose(getattr(figures, name), expected, atol=1e-9)
