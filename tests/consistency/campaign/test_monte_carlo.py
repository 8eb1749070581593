"""Campaigns: blocks, workers and loops agree; draws are shared; wrong filters are found out."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import worlds
from cases import refused, swept

import jaxslam
from jaxslam import Scenario, catalog, filters, grids, motion, run, sensors, simulate, store
from jaxslam.consistency.campaign import (
    Interrupted,
    _block_programs,
    _candidates,
    _pieces,
    _work,
    monte_carlo,
)
from jaxslam.core.record import record
from jaxslam.core.types import Status, Truth
from jaxslam.simulation.laser import scan_world
from jaxslam.simulation.scenarios import BetweenRanges, square

WORLD = worlds.ring()
BESIDE = dataclasses.replace(WORLD, sensor=sensors.RelativePosition(np.eye(2)))
EKF = worlds.ekf(WORLD)


def known_map(landmarks):
    return filters.Localization(WORLD.motion, WORLD.sensor, landmarks)


@pytest.fixture(scope="module")
def in_fours():
    """Runs 0 to 3, 4 to 7, 8 and 9; one device, one worker."""
    return campaign_of({"ekf": EKF, "again": worlds.ekf(WORLD)}, workers=1)


def campaign_of(candidates=None, *, devices=1, block=4, bound=True, **options):
    candidates = candidates or {"ekf": EKF}
    options |= {"devices": jax.devices()[:devices], "block": block, "bound": bound}
    return monte_carlo(WORLD, candidates, 10, worlds.key(), **options)


def same(a, b, rtol=1e-9):
    assert a.counts == b.counts
    for name in a.measures.keys() & b.measures.keys():  # a bound is taken in some
        np.testing.assert_allclose(a.measures[name], b.measures[name], rtol=rtol)
    for name in a.curves.keys() & b.curves.keys():
        np.testing.assert_allclose(a.curves[name], b.curves[name], rtol=rtol)


def test_blocks_follow_the_memory_of_an_accelerator():
    def fits(platform, memory):
        stats = None if memory is None else {"bytes_limit": memory}
        device = SimpleNamespace(platform=platform, memory_stats=lambda: stats)
        return _block_programs.fitting_block(WORLD, {"ekf": worlds.ekf(WORLD)}, device)

    assert fits("cpu", None) == 16
    assert fits("gpu", None) == 1024
    assert fits("gpu", 10**6) == 32
    assert 32 < fits("gpu", 10**8) < 4096
    assert fits("gpu", 2 * 10**8) == 2 * fits("gpu", 10**8)
    assert fits("gpu", 10**11) == 4096


@pytest.mark.parametrize(("devices", "workers"), swept([(1, 2), (2, 3)], (1, 2)))
def test_workers_do_not_change_a_bit_and_devices_what_rounding_does(in_fours, devices, workers):
    heard = []
    campaign = campaign_of(
        devices=devices,
        workers=workers,
        progress=lambda done, total: heard.append((done, total)),
    )
    agree = worlds.assert_identical if devices == 1 else same
    agree(campaign.filters["ekf"], in_fours.filters["ekf"])
    assert [total for _, total in heard] == [10] * -(-10 // (4 * devices))
    assert sorted(done for done, _ in heard)[-1] == 10


@pytest.mark.sweep
@pytest.mark.parametrize("block", [3, 100])
def test_other_blocks_change_what_rounding_does(in_fours, block):
    same(campaign_of(block=block).filters["ekf"], in_fours.filters["ekf"])


def test_pieces_lie_within_the_blocks_of_their_numbers():
    assert _pieces.missing_pieces([], 10, 4) == [(0, 4), (4, 4), (8, 2)]
    assert _pieces.missing_pieces([(0, 3), (6, 1)], 10, 4) == [(3, 1), (4, 2), (7, 1), (8, 2)]
    assert _pieces.missing_pieces([(0, 20)], 10, 4) == []
    assert _pieces.missing_pieces([(0, 10)], 13, 8) == [(10, 3)]


class Spy:
    """A keep that writes down what is saved, and may fail."""

    def __init__(self, store, fails=()):
        self.store, self.saved, self.fails = store, [], list(fails)

    def claim(self, identity):
        self.store.claim(identity)

    def save(self, first, arrays, runs):
        if self.fails and self.fails.pop(0):
            raise OSError(28, "no space left")
        self.saved.append((first, runs))
        return self.store.save(first, arrays, runs)

    def blocks(self):
        return self.store.blocks()


def test_a_stopped_campaign_goes_on_and_no_run_comes_twice(tmp_path, in_fours):
    kept = store.open(tmp_path, {"seed": 0})
    first = Spy(kept)

    def stop(done, total):
        if done >= 4:
            raise KeyboardInterrupt

    with pytest.raises(Interrupted, match="of 10 runs done") as stopped:
        campaign_of(workers=1, keep=first, progress=stop)
    so_far = stopped.value.campaign
    assert so_far.runs == sum(runs for _, runs in first.saved) < 10
    assert so_far.filters["ekf"].counts["runs"] == so_far.runs

    second = Spy(store.resume(tmp_path), fails=[True])
    with pytest.raises(OSError, match="no space"):
        campaign_of(workers=1, keep=second)

    third = Spy(store.resume(tmp_path))
    campaign = campaign_of(keep=third)
    same(campaign.filters["ekf"], in_fours.filters["ekf"])
    pieces = sorted(first.saved + second.saved + third.saved)
    assert [run for at, runs in pieces for run in range(at, at + runs)] == list(range(10))

    finished = Spy(store.resume(tmp_path))
    began = campaign_of(keep=finished)
    assert finished.saved == []
    assert began.compile_seconds == 0
    assert began.divergence_limit == in_fours.divergence_limit
    worlds.assert_identical(began.filters["ekf"], campaign.filters["ekf"])


def test_an_interrupt_before_any_block_has_no_campaign(monkeypatch):
    def interrupted(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(_work, "BlockRunner", interrupted)
    with pytest.raises(Interrupted, match="0 of 10") as stopped:
        campaign_of()
    assert stopped.value.campaign is None


def test_out_of_memory_tries_smaller_blocks(monkeypatch, in_fours):
    tried = []
    runner = _work.BlockRunner

    def little_memory(plan):
        tried.append(plan.wide)
        if plan.wide > 4:
            raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 1 byte")
        return runner(plan)

    monkeypatch.setattr(_work, "BlockRunner", little_memory)
    with pytest.warns(UserWarning, match="continuing with block=") as warned:
        campaign = campaign_of(block=18)
    assert (tried, len(warned)) == ([18, 9, 4], 2)
    same(campaign.filters["ekf"], in_fours.filters["ekf"])


def test_out_of_memory_for_one_run_says_so(monkeypatch):
    def no_memory(*arguments):
        raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory")

    monkeypatch.setattr(_work, "BlockRunner", no_memory)
    with pytest.raises(MemoryError, match="block=1"):
        campaign_of(block=1)


def test_other_errors_of_the_runtime_are_not_taken_for_memory(monkeypatch):
    def broken(*arguments):
        raise jax.errors.JaxRuntimeError("INTERNAL: something else")

    monkeypatch.setattr(_work, "BlockRunner", broken)
    with pytest.raises(jax.errors.JaxRuntimeError, match="something else"):
        campaign_of()


def test_a_traceback_in_a_filter_has_few_frames_of_the_package():
    @record
    class Faulty(filters.EkfSlam):
        def update(self, state, scan, key):
            raise KeyError("landmark")

    with pytest.raises(KeyError) as failed:
        campaign_of({"ekf": Faulty(WORLD.motion, WORLD.sensor, 6)})
    package = Path(jaxslam.__file__).parent
    frames = [at for at in failed.traceback if Path(at.path).is_relative_to(package)]
    assert [at.name for at in frames][-4:] == ["drive_run", "run", "_drive", "step"]
    assert len(frames) <= 7


def test_a_model_that_cannot_be_traced_stops_the_campaign_whatever_waits_for_it():
    def broken(truth):
        raise ValueError("no filter for this truth")

    with pytest.raises(ValueError, match="no filter for this truth"):
        campaign_of({"ekf": EKF, "broken": broken}, workers=2)


def test_every_filter_gets_the_same_draws(in_fours):
    same(in_fours.filters["ekf"], in_fours.filters["again"], rtol=0)


def test_a_campaign_is_the_loop_over_its_runs(in_fours):
    square, nees = [], []
    for i in range(10):
        key_world, key_filter = jax.random.split(jax.random.fold_in(worlds.key(), i))
        truth, log = simulate(WORLD, key_world)
        trace = run(EKF, log, WORLD.pose, WORLD.pose_cov, key_filter)
        error = np.asarray(truth.pose) - np.asarray(trace.estimate.pose)
        error[:, 2] = np.angle(np.exp(1j * error[:, 2]))
        square.append((error[:, :2] ** 2).sum(1).mean())
        cov = np.asarray(trace.estimate.pose_cov)[1:]  # after one step P is singular
        nees.append(
            np.mean([e @ np.linalg.solve(p, e) for e, p in zip(error[1:], cov, strict=True)])
        )
    measures = in_fours.filters["ekf"].measures
    np.testing.assert_allclose(measures["rmse_position"].value, np.sqrt(np.mean(square)), rtol=1e-9)
    np.testing.assert_allclose(measures["nees_pose"].value, np.mean(nees), rtol=1e-6)


def test_a_name_that_is_not_there_is_told_with_those_that_are(in_fours):
    with pytest.raises(KeyError, match=r"expected one of .*nees_pose.*got 'pose_nees'"):
        in_fours.filters["ekf"].measures["pose_nees"]
    with pytest.raises(KeyError, match=r"expected one of ekf, .*got 'ekg' \(did you mean ekf\?\)"):
        in_fours.filters["ekg"]


def test_another_seed_is_another_campaign(in_fours):
    options = {"block": 4, "bound": True, "devices": jax.devices()[:1]}
    other = monte_carlo(WORLD, {"ekf": EKF}, 10, worlds.key(1), **options)
    ours = in_fours.filters["ekf"].measures["rmse_position"].value
    assert abs(other.filters["ekf"].measures["rmse_position"].value / ours - 1) > 1e-3


def test_another_key_noise_map_or_more_runs_compile_nothing():
    def campaign(there, runs, seed):
        tried = {"ekf": worlds.ekf(there), "ideal": catalog.ideal(there)}
        more = {"block": 4, "bound": True, "devices": jax.devices()[:1]}
        return monte_carlo(there, tried, runs, jax.random.key(seed), **more)

    same, other = worlds.scaled(1.0, WORLD.steps), worlds.scaled(1.07, WORLD.steps)
    first = campaign(same, 3, 0)
    with worlds.nothing_compiled():
        for there, runs, seed in ((same, 3, 1), (same, 9, 0), (other, 3, 0)):
            found = campaign(there, runs, seed)
            assert found.runs == runs
            assert found.filters["ekf"].measures != first.filters["ekf"].measures


def test_functions_of_the_truth_and_estimators_run_too(in_fours):
    def estimator(truth):
        return lambda log, key: run(EKF, log, WORLD.pose, WORLD.pose_cov, key)

    candidates = {"ideal": catalog.ideal(WORLD), "estimator": estimator}
    campaign = campaign_of(candidates)
    same(campaign.filters["estimator"], in_fours.filters["ekf"])
    assert campaign.filters["ideal"].measures["nees_pose"].value > 0


@pytest.mark.sweep
def test_float32_sees_the_worlds_of_float64(in_fours):
    campaign = campaign_of({"ekf": EKF}, dtype=jnp.float32, bound=False)
    assert (campaign.dtype, in_fours.dtype) == ("float32", "float64")
    single, double = campaign.filters["ekf"].per_run, in_fours.filters["ekf"].per_run
    np.testing.assert_allclose(single["square_position"], double["square_position"], rtol=0.02)
    with pytest.raises(ValueError, match="float16"):
        campaign_of(dtype=jnp.float16)


@pytest.mark.sweep
def test_drops_and_losses_are_counted_and_leave_the_others_valid(in_fours):
    reckoning = filters.DeadReckoning(WORLD.motion, WORLD.sensor)

    @record
    class Poisoned(filters.Wrapper):
        def update(self, joint, scan, key):
            joint, info = self.filter.update(joint, scan, key)
            # A scan that starts with a long range in about half of the runs.
            bad = scan.z[0, 0] > 3.68
            return joint._replace(pose=jnp.where(bad, jnp.nan, joint.pose)), info

    @record
    class Lost(filters.Wrapper):
        def predict(self, joint, u, key):
            return joint._replace(pose=joint.pose * jnp.nan)

    candidates = {
        "ekf": EKF,
        "poisoned": Poisoned(reckoning),
        "small": filters.EkfSlam(WORLD.motion, WORLD.sensor, 4),
        "always lost": Lost(reckoning),
    }
    campaign = campaign_of(candidates)
    same(campaign.filters["ekf"], in_fours.filters["ekf"])
    poisoned = campaign.filters["poisoned"]
    assert poisoned.counts["runs"] + poisoned.counts["not_finite"] == 10
    assert 0 < poisoned.counts["not_finite"] < 10
    assert all(np.isfinite(m.value) for m in poisoned.measures.values())
    assert f"averages of the {poisoned.counts['runs']} finite runs" in poisoned.doubts[0]
    assert poisoned.verdict in ("incomplete", "optimistic", "diverged")
    assert campaign.filters["small"].counts["overflow"] == 10 * WORLD.steps * 2
    lost = campaign.filters["always lost"]
    assert lost.verdict == "diverged"
    assert lost.counts["not_finite"] == 10


@pytest.mark.sweep
def test_a_filter_of_beams_without_innovations_runs_in_a_world_that_draws_a_log_of_beams():
    """Dead reckoning that says of beams what `grids.GridLocalization` does: there is nothing to whiten."""
    room = square(beams=3)

    @record
    class OfBeams(Scenario):
        def draw(self, key):
            log = scan_world(room, key)
            nothing = jnp.zeros(len(log.pose), jnp.int32)
            start = jnp.asarray(room.pose, log.pose.dtype)
            truth = Truth(log.pose, jnp.zeros((1, 2)), nothing, start)
            return truth, grids.beam_log(log.control, log.beams)

    world = OfBeams("beams", room.motion, WORLD.sensor, np.zeros((1, 2)), room.controls, room.pose)
    reckoning = filters.DeadReckoning(room.motion, WORLD.sensor)

    @record
    class Silent(filters.Wrapper):
        def update(self, joint, scan, key):
            beams = len(scan.valid)
            info = filters.info_of(
                filters.status_of(scan.valid, matched=scan.valid, inside=scan.z[:, 0] > 0),
                scan.valid,
                size=0,
                slot=jnp.full(beams, -1),
                nis=jnp.zeros(beams),
                innovation=jnp.zeros((beams, 0)),
                innovation_cov=jnp.zeros((beams, 0, 0)),
                log_likelihood=jnp.zeros(()),
            )
            return joint, info

    summary = worlds.campaign(world, {"silent": Silent(reckoning)}, 3).filters["silent"]
    assert summary.counts["fused"] > 0 and summary.counts["not_finite"] == 0
    assert all(np.isfinite(m.value) for m in summary.measures.values())


def test_a_world_without_noise_does_not_diverge():
    still = dataclasses.replace(
        WORLD,
        motion=motion.Increment(np.zeros((2, 2))),
    )
    campaign = worlds.campaign(still, {"ekf": worlds.ekf(still)}, 3)
    assert campaign.filters["ekf"].verdict == "undecided"
    assert campaign.filters["ekf"].counts["divergent"] == 0


def test_a_sensor_without_noise_is_told_where_it_left_nothing_to_judge():
    """Nothing is wrong with it in dead reckoning, which takes no measurements."""
    exact = sensors.RangeBearing(np.diag([0.1, 0.0]), mount=(0.1, -0.05, 0.3))
    still = dataclasses.replace(WORLD, sensor=exact)  # drawn by the program of WORLD
    reckoning = filters.DeadReckoning(still.motion, exact)

    @record
    class Singular(filters.Wrapper):
        def update(self, joint, scan, key):
            info = worlds.unmatched(scan)
            return joint, info._replace(status=jnp.full_like(info.status, Status.SINGULAR))

    candidates = {"a": reckoning, "b": Singular(reckoning)}
    campaign = worlds.campaign(still, candidates, 2)
    a, b = (campaign.filters[name].doubts for name in candidates)
    assert not any("without noise" in doubt for doubt in a)
    assert "bearing [rad] of range_bearing without noise" in b[-1]
    assert f"{2 * still.steps * len(still.landmarks):,} measurements were dropped and" in b[-1]


@pytest.mark.parametrize("name", swept(catalog.ALL, "ekf", "dead_reckoning"))
def test_every_filter_accounts_for_every_measurement(name):
    """A status in its Info for each that the logs hold."""
    counts = worlds.campaign(WORLD, {"it": catalog.ALL[name](WORLD)}, 2).filters["it"].counts
    assert counts["measured"] == 2 * WORLD.steps * len(WORLD.landmarks)
    assert counts["measured"] == sum(
        counts[status.name.lower()] for status in Status if status != Status.EMPTY
    )


@pytest.mark.parametrize(
    ("change", "word", "told"),
    [
        ({"visible": BetweenRanges(0.0, 0.01)}, "incomplete", "nothing was measured in any run"),
        ({"places": 1}, "incomplete", "landmarks in view, beside 600 measured ones, had no place"),
        ({"places": 5}, None, "600 landmarks in view, beside 3,000 measured ones, had no place"),
    ],
)
def test_a_world_that_gives_its_filter_little_is_told(change, word, told):
    world = dataclasses.replace(WORLD, **change)
    reckoning = filters.DeadReckoning(WORLD.motion, WORLD.sensor)
    found = worlds.campaign(world, {"ekf": EKF, "blind": reckoning}, 6).filters
    assert any(told in doubt for doubt in found["ekf"].doubts)
    assert found["ekf"].verdict == word or word is None
    # Dead reckoning takes none, and says so.
    assert any(told in doubt for doubt in found["blind"].doubts)
    assert "takes none of the" in found["blind"].doubts[-1] or change.get("visible")


@pytest.mark.parametrize(
    ("noise", "names"),
    [
        (np.diag([0.1, 1e-9]), ""),
        (np.zeros((2, 2)), "range [m], bearing [rad] of range_bearing"),
        (np.full((2, 2), 0.1), "a combination of range [m], bearing [rad] of range_bearing"),
        (lambda z: jnp.diag(jnp.stack([z[0], 1.0])) ** 2, ""),  # grows with the range
        (lambda z: jnp.diag(z * jnp.array([1.0, 0.0])), "bearing [rad] of range_bearing"),
    ],
)
def test_measurements_without_noise_are_named(noise, names):
    world = dataclasses.replace(WORLD, sensor=sensors.RangeBearing(noise))
    assert _candidates.without_noise(world) == names
    eyes = sensors.Suite(((sensors.Compass(np.eye(1)), 1), (world.sensor, 6)))
    assert _candidates.without_noise(dataclasses.replace(WORLD, sensor=eyes)) == names


HONEST = {
    "ekf": worlds.ekf,
    "right_invariant": catalog.FILTERS["right_invariant"],
    "ideal": catalog.ideal,
}


def of_hundred(make):
    """What a hundred runs say of a filter."""
    return worlds.campaign(WORLD, {"it": make(WORLD)}, 100).filters["it"]


@pytest.mark.parametrize("name", swept(HONEST, "ekf"))
def test_honest_filters_are_found_consistent(name):
    found = of_hundred(HONEST[name])
    assert found.verdict == "consistent"
    low, high = found.nis_band
    assert low < found.measures["nis_per_dof"].value < high


@pytest.mark.parametrize("name", swept(worlds.WRONG, "transposed_motion"))
def test_wrong_filters_are_found_out(name):
    found = of_hundred(worlds.WRONG[name])
    assert found.verdict in ("optimistic", "diverged")
    assert found.measures["nees_pose"].low > 3


@refused(
    ({"runs": 0}, "runs"),
    ({"runs": 2.5}, "runs"),
    ({"block": 0}, "block"),
    ({"workers": 0}, "workers"),
    ({"devices": []}, "device"),
    ({"key": 0}, "monte_carlo: key: expected a PRNG key, as jax.random.key(0), got 0"),
    ({"filters": {}}, "at least one, got none"),
    (
        {"filters": worlds.ekf(WORLD)},
        "monte_carlo: filters: expected {name: filter}, at least one, got an EkfSlam",
    ),
    (
        {"filters": {"x": 3}},
        "monte_carlo: filter x: expected a Filter, got 3; a function of the truth",
    ),
    ({"filters": {1: EKF}}, "filters: expected a name for each, as 'ekf', got 1"),
    ({"filters": {None: EKF}}, "expected a name for each, as 'ekf', got None"),
    ({"filters": {b"ekf": EKF}}, "expected a name for each, as 'ekf', got b'ekf'"),
    ({"filters": {" ": EKF}}, "expected a name for each, as 'ekf', got ' '"),
    ({"filters": {"a\nb": EKF}}, "expected a name for each, as 'ekf', got 'a\\nb'"),
    ({"filters": {"x": lambda log, key: None}}, "lambda truth"),
    (
        {"filters": {"x": filters.EkfSlam}},
        "monte_carlo: filter x: expected a Filter, got the class EkfSlam: call it,",
    ),
    ({"filters": {"x": filters.DeadReckoning}}, "got the class DeadReckoning: call it"),
    (
        {"filters": catalog.FILTERS},
        "monte_carlo: filter ekf: it is a factory of (scenario, …): call it",
    ),
    (
        {"filters": {"fej": catalog.FILTERS["fej"]}},
        "monte_carlo: filter fej: it is a factory of (world, …): call it",
    ),
    (
        {"filters": {"x": filters.EkfSlam(motion.Unicycle(np.eye(2)), WORLD.sensor, 2)}},
        "takes controls (v [m/s], omega [rad/s], dt [s]), the scenario ring gives (forward [m], ",
    ),
    (
        {"filters": {"x": lambda a, b, key: None}},
        "monte_carlo: filter x: it is a factory of (a, b, key): call it",
    ),
    (
        {"filters": {"x": lambda truth: 3}},
        "monte_carlo: x: filters: expected a function of the truth to return a",
    ),
    (
        {"filters": {"x": worlds.ekf(BESIDE)}},
        "monte_carlo: filter x: it takes measurements (ahead [m], left [m]), the",
    ),
    (
        {"filters": {"x": lambda truth: worlds.ekf(BESIDE)}},
        "monte_carlo: x: filter ekf_slam: it takes measurements (ahead [m], left",
    ),
    (
        {"filters": {"x": known_map(np.asarray(WORLD.landmarks)[:4])}},
        "monte_carlo: filter x: it has a map of 4 landmarks, the scenario ring has",
    ),
    (
        {"filters": {"x": lambda truth: known_map(jnp.concatenate([truth.landmarks] * 2))}},
        "monte_carlo: x: filter localization: it has a map of 12 landmarks, the",
    ),
    escaped=True,
)
def test_bad_arguments_are_refused(change):
    arguments = {"filters": {"ekf": worlds.ekf(WORLD)}, "runs": 2, "key": worlds.key()} | change
    monte_carlo(WORLD, **arguments)
