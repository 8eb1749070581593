"""Films: the numbers that artists have in each frame, what is refused, and that frames differ."""

import sys

import drawn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import worlds

import jaxslam
from jaxslam import catalog, filters, motion, plot, sensors
from jaxslam.core.types import Info, Log, Scan, Status, Trace
from jaxslam.results.plot import _grid_figures, _run_film

STEPS = 3
# Landmark 2 is new in the last step; a measurement of landmark 1 fails the gate there.
STATUS = np.array(
    [[Status.BORN, Status.BORN], [Status.FUSED, Status.EMPTY], [Status.BORN, Status.REJECTED]]
)
SLOT = np.array([[0, 1], [1, -1], [2, -1]])
TAG = np.array([[0, 1], [1, -1], [2, 1]])
ALIVE = np.array([[1, 1, 0], [1, 1, 0], [1, 1, 1]], bool)


def run_of(steps=STEPS, seen=None):
    """(trace, log, truth) of a drive round a circle, seen in `STATUS`."""
    truth, estimate = drawn.run_of("ekf", steps)
    rows = np.arange(steps) % STEPS
    grown = estimate._replace(
        alive=ALIVE[rows],
        tag=np.where(ALIVE[rows], np.arange(3), -1),
        point_covs=estimate.point_covs * (1.0 + np.arange(steps))[:, None, None, None],
    )
    info = Info(*[None] * len(Info._fields))._replace(status=STATUS[rows], slot=SLOT[rows])
    scan = Scan(np.zeros((steps, 2, 2)), TAG[rows], STATUS[rows] > 0)
    return Trace(grown, info, None, seen), Log(np.zeros((steps, 2)), scan), truth


def film_of(steps=STEPS, seen=None, frames=_run_film.MOST, **options):
    trace, log, truth = run_of(steps, seen)
    true = {"true_points": truth.landmarks, "true_path": truth.pose} | options
    return (
        _run_film.run_film(_run_film.history_of(trace, log, frames), **true),
        trace.estimate,
        truth,
    )


def line(axes, label):
    (found,) = [each for each in axes.lines if each.get_label() == label]
    return found.get_xydata()


def beams(axes, outcome):
    return line(axes, f"measured, {outcome}").reshape(-1, 3, 2)[:, :2]


def triangles(axes):
    return [patch.get_xy()[:3] for patch in axes.patches]


def test_a_frame_has_the_robot_the_path_so_far_and_the_truth():
    film, estimate, truth = film_of()
    (axes, _), draw = film.figure.axes, film.update
    np.testing.assert_array_equal(line(axes, "true landmarks"), truth.landmarks)
    for k in (0, 2, 1):  # in any order
        draw(k)
        np.testing.assert_array_equal(
            line(axes, "estimate: path, robot"), estimate.pose[: k + 1, :2]
        )
        np.testing.assert_array_equal(line(axes, "truth: path, robot"), truth.pose[: k + 1, :2])
        for corners, (x, y, heading) in zip(
            triangles(axes), (truth.pose[k], estimate.pose[k]), strict=True
        ):
            tip = corners[0] - [x, y]
            np.testing.assert_allclose(np.arctan2(*tip[::-1]), np.angle(np.exp(1j * heading)))
            assert np.hypot(*tip) > 1.2 * np.hypot(*(corners[1] - [x, y]))


def test_landmarks_have_ellipses_of_three_sigma_that_grow():
    film, estimate, _ = film_of()
    (axes, _), draw = film.figure.axes, film.update
    for k in range(STEPS):
        draw(k)
        rings = line(axes, "landmark, 3 σ").reshape(int(ALIVE[k].sum()), -1, 2)[:, :-1]
        for ring, mean in zip(rings, estimate.points[k][ALIVE[k]], strict=True):
            away = np.hypot(*(ring - mean).T)
            np.testing.assert_allclose(away, 3 * np.sqrt(0.02 * (k + 1)))
    ring = ring_of_robot(axes)
    np.testing.assert_allclose(np.hypot(*(ring - estimate.pose[2, :2]).T), 0.3)


def ring_of_robot(axes):
    """The ellipse of the robot on the map, which has no entry in the legend."""
    rings = [each.get_xydata() for each in axes.lines if each.get_color() == plot.COLORS[0]]
    return next(ring[:-1] for ring in rings if len(ring) == 50)


def test_beams_go_to_the_landmarks_measured_in_the_step():
    film, estimate, _ = film_of()
    (axes, _), draw = film.figure.axes, film.update
    expected = {0: {"new": [0, 1]}, 1: {"fused": [1]}, 2: {"new": [2], "dropped": [1]}}
    for k, kinds in expected.items():
        draw(k)
        for outcome in ("fused", "new", "dropped"):
            ends = beams(axes, outcome)
            to = kinds.get(outcome, [])
            np.testing.assert_array_equal(ends[:, 0], np.tile(estimate.pose[k, :2], (len(to), 1)))
            np.testing.assert_array_equal(ends[:, 1], estimate.points[k][to])
    assert [film.caption(k) for k in range(STEPS)] == [
        "step 1 of 3 · 2 measurements: 0 fused, 2 new, 0 dropped",
        "step 2 of 3 · 1 measurement: 1 fused, 0 new, 0 dropped",
        "step 3 of 3 · 2 measurements: 0 fused, 1 new, 1 dropped",
    ]
    styles = {
        tuple(map(str, np.atleast_1d(each._unscaled_dash_pattern[1])))
        for each in axes.lines
        if str(each.get_label()).startswith("measured")
    }
    assert len(styles) == 3  # told apart without colour


def test_a_frame_of_many_steps_has_all_their_beams():
    """9 steps in 3 frames: steps 0; 1 … 4; 5 … 8."""
    film, estimate, _ = film_of(9, frames=3)
    assert film.note == "3 of 9 steps are shown, evenly in time"
    (axes, _), draw = film.figure.axes, film.update
    draw(1)
    # Of step 2 landmark 2, of step 3 landmarks 0 and 1; in frame 1, of step 4, landmark 2 is gone.
    np.testing.assert_array_equal(beams(axes, "new")[:, 0], estimate.pose[[3, 3], :2])
    np.testing.assert_array_equal(beams(axes, "new")[:, 1], estimate.points[4][:2])
    np.testing.assert_array_equal(beams(axes, "fused")[:, 0], estimate.pose[[1, 4], :2])
    assert film.caption(1) == "step 5 of 9 · 6 measurements: 2 fused, 3 new, 1 dropped"
    every = film_of(9)[0]
    assert every.note == "" and every.frames == 9


def test_the_robot_is_shown_from_near_with_the_truth_on_a_fixed_scale():
    film, estimate, truth = film_of()
    (_, axes), draw = film.figure.axes, film.update
    low, high = film.figure.axes[1].get_xlim()
    assert -low == high == pytest.approx(1.08 * 0.3)
    for k in range(STEPS):
        draw(k)
        np.testing.assert_allclose(
            line(axes, "true position"), truth.pose[[k], :2] - estimate.pose[[k], :2]
        )
        np.testing.assert_allclose(np.hypot(*line(axes, "robot, 3 σ")[:-1].T), 0.3)
    # An error far beyond the ellipse does not set the scale; it is marked at the edge.
    away = truth.pose + [5.0, 0.0, 0.0]
    far, _, _ = film_of(true_path=away)
    (_, axes), draw = far.figure.axes, far.update
    draw(0)
    edge = far.figure.axes[1].get_xlim()[1]
    assert edge == pytest.approx(1.08 * 0.9)
    assert line(axes, "true position beyond")[0, 0] == edge and not len(line(axes, "true position"))
    beside = film_of(true_path=None)[0].figure.axes[1]
    assert beside.get_title(loc="left") == "about the estimated position"


def test_limits_are_those_of_the_truth_unless_the_estimate_is_near():
    film, estimate, truth = film_of()
    shown = np.concatenate([truth.landmarks, truth.pose[:, :2], estimate.points[2]])
    main = film.figure.axes[0]
    for (low, high), values in zip((main.get_xlim(), main.get_ylim()), shown.T, strict=True):
        assert low < values.min() and values.max() < high
    trace, log, truth = run_of()
    lost = trace._replace(estimate=trace.estimate._replace(pose=trace.estimate.pose * 100))
    history = _run_film.history_of(lost, log)
    true = {"true_points": truth.landmarks, "true_path": truth.pose}
    for more, low, high in ((true, 0, 12), ({}, 200, np.inf)):
        main = _run_film.run_film(history, **more).figure.axes[0]
        assert low < np.ptp(main.get_xlim()) < high


def test_particles_are_drawn_by_weight():
    rng = np.random.default_rng(0)
    seen = _run_film.Cloud(
        rng.normal(size=(STEPS, 4, 3)), np.tile([0.5, 0.25, 0.25, 0.0], (STEPS, 1))
    )
    film, estimate, _ = film_of(seen=seen)
    film.update(1)
    for axes, origin in zip(film.figure.axes, (0.0, estimate.pose[1, :2]), strict=True):
        (dots,) = [collection for collection in axes.collections if len(collection.get_offsets())]
        np.testing.assert_allclose(dots.get_offsets(), seen.pose[1, :3, :2] - origin)
        np.testing.assert_allclose(dots.get_sizes(), [8.0, 4.0, 4.0])


def test_links_appear_and_are_cut():
    strength = np.zeros((STEPS, 4, 4))
    strength[0, 0, 1] = strength[1, 0, 1] = strength[1, 1, 2] = 0.25
    strength[2, 1, 2] = 1.0
    film, estimate, _ = film_of(seen=_run_film.Links(strength + np.swapaxes(strength, 1, 2)))
    (axes, _), draw = film.figure.axes, film.update
    between, robot = (
        next(collection for collection in axes.collections if collection.get_label() == label)
        for label in ("link of landmarks", "link to the robot")
    )
    shown = {text.get_text() for text in film.figure.axes[1].get_legend().get_texts()}
    assert {"link of landmarks", "link to the robot", "link cut"} <= shown
    handles = film.figure.axes[1].get_legend().legend_handles
    assert len({str(handle.get_color()) for handle in handles[:4]}) > 2
    for k, (of_robot, of_landmarks, cut) in enumerate([(1, 0, 0), (1, 1, 0), (0, 1, 1)]):
        draw(k)
        position, points = estimate.pose[k, :2], estimate.points[k]
        np.testing.assert_array_equal(robot.get_segments(), [[position, points[0]]] * of_robot)
        np.testing.assert_array_equal(
            between.get_segments(), [[points[0], points[1]]] * of_landmarks
        )
        assert len(line(axes, "link cut")) == 3 * cut
    assert between.get_linewidth()[0] == 3.0


def test_hypotheses_are_drawn_until_they_are_landmarks():
    points = np.arange(STEPS * 4.0).reshape(STEPS, 2, 2)
    covs = np.tile(0.04 * np.eye(2), (STEPS, 2, 1, 1))
    seen = _run_film.Hypotheses(points, covs, np.array([[0.0, 0.0], [1.0, 3.0], [0.0, 1.5]]))
    film, *_ = film_of(seen=seen)
    (axes, _), draw = film.figure.axes, film.update
    (marked,) = [artist for artist in axes.lines if artist.get_marker() == "D"]
    for k, shown in enumerate([[], [0, 1], [1]]):
        draw(k)
        np.testing.assert_array_equal(marked.get_xydata(), points[k, shown])
        rings = line(axes, "hypothesis, 3 σ").reshape(len(shown), 50, 2)[:, :-1]
        away = np.linalg.norm(rings - points[k, shown][:, None], axis=2)
        np.testing.assert_allclose(away, 0.6)
    counts = [film.caption(k).rpartition(" · ")[2] for k in range(STEPS)]
    assert counts == ["0 hypotheses", "2 hypotheses", "1 hypothesis"]


# --- frames -------------------------------------------------------------------------------------


def pictures(film):
    """The pixels of each frame."""
    return [film.picture(k) for k in range(film.frames)]


def test_frames_differ_and_need_no_display(monkeypatch, tmp_path):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)  # an import would fail
    trace, log, truth = run_of()
    done = []
    film = plot.animate(trace, log, truth, title="ring")
    film.save(tmp_path / "a.gif", progress_callback=lambda k, n: done.append((k, n)))
    assert done == [(0, 3), (1, 3), (2, 3)] and film.title == "ring"
    assert len({picture.tobytes() for picture in pictures(film)}) == 3


def test_another_film_is_another_update():
    figure, (axes, _) = plot.stage((0, 1), (0, 1), width=4.0)
    image = axes.imshow(np.zeros((2, 2)), cmap="gray", vmin=0, vmax=1, extent=(0, 1, 0, 1))
    axes.plot(0.5, 0.5, ".", color="white")
    film = plot.Film(figure, lambda k: image.set_data(np.full((2, 2), k / 2)), 3, fps=4)
    middle = [picture[110, 100, 0] for picture in pictures(film)]
    assert [film.caption(k) for k in range(3)] == ["frame 1", "frame 2", "frame 3"]
    np.testing.assert_allclose(middle, [0, 128, 255], atol=20)


# --- bad input ----------------------------------------------------------------------------------


def test_arrays_that_do_not_belong_together_are_refused():
    trace, log, truth = run_of()
    _, longer, _ = run_of(4)
    for arguments, more, message in (
        ((trace, longer), {}, r"of 3 steps and measurements \(3, 2\), got 4 steps"),
        ((trace, log, truth._replace(pose=truth.pose[:2])), {}, r"path of shape \(3, 3\), got"),
        ((trace, log), {"true_path": np.zeros((3, 2))}, r"path of shape \(3, 3\), got \(3, 2\)"),
        ((trace, log), {"true_points": np.zeros(2)}, r"points of shape \(N, 2\), got \(2,\)"),
        ((trace, log), {"frames": 0}, "frames: expected an integer >= 1, got 0"),
        ((trace.estimate, log), {}, "animate: .*expected a.* Trace"),
        ((trace, truth), {}, "animate: .*expected a.* Log"),
        ((trace, log, log), {}, "animate: .*expected a.* Truth"),
    ):
        with pytest.raises(ValueError, match=message):
            plot.animate(*arguments, **more)
    nothing = jax.tree.map(lambda leaf: leaf[:0], (trace, log))
    with pytest.raises(ValueError, match="animate: steps: expected an integer >= 1, got 0"):
        plot.animate(*nothing)
    batch = jax.tree.map(lambda leaf: leaf[None], trace)
    with pytest.raises(
        ValueError, match=r"trace: expected that of one run, poses \(T, 3\), got \(1, 3, 3\)"
    ):
        plot.animate(batch, log)
    figure, _ = plot.stage((0, 1), (0, 1))
    for make, message in (
        (lambda: plot.Film(figure, print, 1, fps=0), "Film: fps: expected a number above 0"),
        (lambda: plot.Film(figure, print, 0), "Film: frames: expected an integer >= 1"),
        (lambda: plot.stage((0, 1), (0, 1), width=-1.0), "stage: width: expected a number above 0"),
    ):
        with pytest.raises(ValueError, match=message):
            make()


def test_a_run_that_is_not_finite_is_drawn_as_far_as_it_goes_and_says_so():
    trace, log, truth = run_of()
    pose, covs = trace.estimate.pose.copy(), trace.estimate.point_covs.copy()
    pose[2], covs[1, 0] = np.nan, -np.eye(2)
    broken = trace._replace(estimate=trace.estimate._replace(pose=pose, point_covs=covs))
    film = plot.animate(broken, log, truth)
    said = film.caption
    assert said(1).endswith("1 without ellipse") and said(2).endswith("pose not finite")
    assert len(pictures(film)) == 3


# --- what is seen of a filter's state -----------------------------------------------------------


MODELS = motion.Increment(np.eye(2)), sensors.RangeBearing(np.eye(2))


def test_of_particles_their_poses_and_weights_are_seen():
    filter = filters.FastSlam(*MODELS, capacity=2, particles=4)
    seen = jax.jit(lambda: plot.probe(filter.init(jnp.ones(3), jnp.zeros((3, 3)))))()
    np.testing.assert_array_equal(seen.pose, np.ones((4, 3)))
    np.testing.assert_allclose(seen.weight, 0.25)
    assert plot.probe(np.zeros(3)) is None


def test_of_information_the_links_are_seen_dense_and_sparse():
    rng = np.random.default_rng(1)
    root = rng.normal(size=(9, 9))
    omega = root @ root.T
    omega[:3, 7:] = omega[7:, :3] = 0.0  # the robot has no link to landmark 2
    expected = np.zeros((4, 4))
    rows = [slice(0, 2), slice(3, 5), slice(5, 7), slice(7, 9)]
    size = np.array([[np.linalg.norm(omega[a, b]) for b in rows] for a in rows])
    expected = size / np.sqrt(np.outer(np.diag(size), np.diag(size)))
    np.fill_diagonal(expected, 0.0)
    start = jnp.zeros(3), jnp.eye(3)
    dense = filters.EifSlam(*MODELS, capacity=3).init(*start)
    dense = dense._replace(omega=omega, alive=np.ones(3, bool), tag=np.arange(3))
    find = jax.jit(plot.probe)
    np.testing.assert_allclose(find(dense).strength, expected, rtol=1e-5)
    # Landmarks 0 and 1 are active; 2 is passive, and linked by its list.
    seif = filters.Seif(*MODELS, capacity=3, active=2, links=2)
    sparse = seif.init(*start)._replace(
        alive=np.ones(3, bool),
        active=np.array([0, 1]),
        omega=omega[:7, :7],
        diagonal=np.stack([np.eye(2), np.eye(2), omega[7:, 7:]]),
        neighbours=np.array([[2, 3], [2, 3], [0, 1]]),
        links=np.stack(
            [
                [omega[3:5, 7:], np.zeros((2, 2))],
                [omega[5:7, 7:], np.zeros((2, 2))],
                [omega[7:, 3:5], omega[7:, 5:7]],
            ]
        ),
    )
    np.testing.assert_allclose(find(sparse).strength, expected, rtol=1e-5)


def test_of_delayed_initialization_the_hypotheses_are_seen():
    filter = filters.DelayedSlam(
        MODELS[0],
        sensors.BearingOnly(np.eye(1)),
        capacity=2,
        stored=filters.StoredMeasurements(capacity=4),
        hypotheses=filters.Hypotheses(capacity=3),
    )
    state = filter.init(jnp.zeros(3), jnp.zeros((3, 3)))
    rng = np.random.default_rng(2)
    cov = np.cov(rng.normal(size=(30, 60)))
    table = rng.normal(size=state.joint.landmarks.shape)
    alive = np.array([1, 1, 1, 0, 1, 1, 1, 0, 0], bool)
    joint = state.joint._replace(landmarks=table, cov=cov, alive=alive)
    seen = jax.jit(plot.probe)(state._replace(joint=joint, persistence=jnp.array([1.0, 5.0, 2.5])))
    np.testing.assert_array_equal(seen.persistence, [1.0, 0.0, 2.5])
    np.testing.assert_allclose(seen.points, table[2:5, :2])
    for slot, block in zip((2, 3, 4), seen.covs, strict=True):
        rows = slice(3 + 3 * slot, 5 + 3 * slot)
        np.testing.assert_allclose(block, cov[rows, rows])


def test_a_filter_is_filmed_in_a_world_by_itself():
    world = worlds.ring(4)
    film = plot.animate_world(world, catalog.ALL["dead_reckoning"](world), jax.random.key(0))
    assert len({picture.tobytes() for picture in pictures(film)}) == 4
    assert film.title == "ring"
    assert film.caption(0) == "step 1 of 4 · 6 measurements: 0 fused, 0 new, 6 dropped"


def test_mapping_from_a_known_path_is_filmed():
    """The state is one particle, without a cloud to show; poses are exact, without an ellipse."""
    world = worlds.ring(4)
    truth, log = jaxslam.simulate(world, jax.random.key(0))
    log, start = log._replace(control=truth.pose), (np.zeros(3), np.zeros((3, 3)))
    mapping = filters.Mapping(world.sensor, 6)
    trace = jaxslam.run(mapping, log, *start, jax.random.key(1), probe=plot.probe)
    film = plot.animate(trace, log, truth)
    assert film.caption(0) == "step 1 of 4 · 6 measurements: 0 fused, 6 new, 0 dropped"
    assert film.caption(3) == "step 4 of 4 · 6 measurements: 6 fused, 0 new, 0 dropped"
    assert len({picture.tobytes() for picture in pictures(film)}) == 4


def test_a_map_film_has_as_many_paths_as_maps():
    origin, path = np.zeros(3), np.zeros((2, 3))
    maps = [np.zeros((2, 3)), np.ones((2, 3))]
    film = _grid_figures.map_film(maps, origin, 0.5, [path, path], ["one", "two"])
    assert film.frames == 2 and film.caption(1) == "two"
    main = film.figure.axes[0]
    assert main.get_xlim() == (0.0, 1.5) and main.get_ylim() == (0.0, 1.0)
    for wrong, message in (
        ((maps, origin, 0.5, [path], ["one", "two"]), "as many paths"),
        (([], origin, 0.5, [], []), "as many paths"),
        ((maps, np.ones(3), 0.5, [path, path], ["one", "two"]), "without yaw"),
    ):
        with pytest.raises(ValueError, match=message):
            _grid_figures.map_film(*wrong)
