"""One table from gate to status, for every family of filters."""

import functools
import itertools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import swept
from own_models import changed

from jaxslam import filters, motion, sensors
from jaxslam.core.types import Scan, Status
from jaxslam.filters import Hypotheses, StoredMeasurements, info_of, status_of

MASKS = (
    "valid", "matched", "positive", "inside",
    "new", "repeated", "granted", "deferred", "stored", "singular",
)  # fmt: skip


def expected(**of):
    """The table of the docstring, row by row."""
    table = [
        (not of["valid"], Status.EMPTY),
        (of["matched"] and not of["positive"], Status.SINGULAR),
        (of["matched"] and not of["inside"], Status.REJECTED),
        (of["matched"], Status.FUSED),
        (of["new"] and of["repeated"], Status.REPEATED),
        (of["new"] and of["granted"], Status.BORN),
        (of["new"] and of["deferred"], Status.DEFERRED),
        (of["new"] and of["stored"], Status.SIGHTED),
        (of["new"] and of["singular"], Status.SINGULAR),
        (of["new"], Status.OVERFLOW),
        (True, Status.UNMATCHED),
    ]
    return next(status for holds, status in table if holds)


def test_every_combination_of_masks_has_the_status_of_the_table():
    rows = np.array(list(itertools.product([False, True], repeat=len(MASKS))))
    columns = dict(zip(MASKS, rows.T, strict=True))
    valid = jnp.asarray(columns.pop("valid"))
    got = status_of(valid, **{name: jnp.asarray(mask) for name, mask in columns.items()})
    wanted = [expected(**dict(zip(MASKS, row, strict=True))) for row in rows]
    np.testing.assert_array_equal(got, wanted)
    assert got.dtype == jnp.int32


def test_masks_that_are_left_out_hold_nowhere_and_the_rest_is_unmatched():
    valid, yes = jnp.asarray([False, True]), jnp.ones(2, bool)
    assert list(status_of(valid)) == [Status.EMPTY, Status.UNMATCHED]
    assert list(status_of(valid, matched=yes)) == [Status.EMPTY, Status.FUSED]
    assert list(status_of(valid, new=yes)) == [Status.EMPTY, Status.OVERFLOW]


def test_numbers_of_places_without_a_comparison_are_zero():
    status = np.array([Status.FUSED, Status.REJECTED, Status.SINGULAR, Status.BORN, 0], np.int32)
    matched = np.array([True, True, True, False, False])
    info = jax.device_get(
        jax.jit(functools.partial(info_of, size=2))(
            status,
            matched,
            slot=np.arange(5),
            born=np.arange(5) + 10,
            nis=np.full(5, 7.0),
            innovation=np.ones((5, 2)),
            innovation_cov=np.ones((5, 2, 2)),
            log_likelihood=np.zeros(()),
        )
    )
    assert list(info.nis) == [7, 7, 0, 0, 0]
    assert list(info.dof) == [2, 0, 0, 0, 0]
    assert list(info.slot) == [0, -1, -1, 13, -1]
    assert list(info.innovation[:, 0]) == list(info.innovation_cov[:, 0, 1]) == [1, 1, 1, 0, 0]


def test_a_scan_left_alone_is_unmatched_where_there_is_one():
    reckoning = filters.DeadReckoning(motion.Increment(np.eye(2)), sensors.RangeBearing(np.eye(2)))
    state = reckoning.init(jnp.zeros(3), jnp.eye(3))
    scan = Scan(jnp.ones((2, 2)), jnp.zeros(2, int), jnp.asarray([True, False]))
    _, info = reckoning.update(state, scan, jax.random.key(0))
    assert list(info.status) == [Status.UNMATCHED, Status.EMPTY]
    assert not info.nis.any() and not info.innovation.any() and list(info.slot) == [-1, -1]


# One world for every family: three landmarks that a first scan starts, in a map with room for five.
LANDMARKS = np.array([[4.0, 0.0], [4.0, 3.0], [4.0, -3.0], [2.0, 2.0], [2.0, -2.0]])
GATE = 0.99995
MOVED = np.array([0.1, 0.0, 0.0])
"""the motion between the scans; what Mapping takes for the second pose"""

SCAN = {  # tag, z, and what becomes of it
    "as expected": (0, LANDMARKS[0] + [0.02, 0.01], Status.FUSED),
    "outside the gate": (1, LANDMARKS[1] + [0.0, 9.0], Status.REJECTED),
    "singular, and far outside in what is regular": (
        2,
        LANDMARKS[2] + [99.0, 9.0],
        Status.SINGULAR,
    ),
    "new": (7, LANDMARKS[3], Status.BORN),
    "the same again": (7, LANDMARKS[3], Status.REPEATED),
    "new too": (8, LANDMARKS[4], Status.BORN),
    "new without room": (9, [1.0, 1.0], Status.OVERFLOW),
    "of nothing": (-1, [1.0, 1.0], Status.UNMATCHED),
    "no measurement": (0, [np.nan, np.inf], Status.EMPTY),
}


def seen_in_the_map():
    """A sensor of positions in the robot's frame, whose claimed noise is no covariance where the
    third landmark is predicted for the second scan."""

    def noise(z):
        honest = jnp.diag(jnp.full(2, 0.01))
        wild = (z[0] < 3.95) & (z[1] < -2.5)
        return jnp.where(wild, jnp.diag(jnp.asarray([0.01, -1e4])), honest)

    return sensors.RelativePosition(noise)


MOVE = motion.PoseIncrement(np.diag([1e-4, 1e-4, 1e-6]))
KNOWN = np.concatenate([LANDMARKS[:3], np.full((2, 2), 77.0)])
FAMILIES = {
    "ekf_slam": lambda s: filters.EkfSlam(MOVE, s, 5, gate=GATE),
    "ekf_slam, at once": lambda s: filters.EkfSlam(MOVE, s, 5, gate=GATE, correction="joint"),
    "compressed_ekf_slam": lambda s: filters.CompressedEkfSlam(
        filters.EkfSlam(MOVE, s, 5, gate=GATE), area=9
    ),
    "eif_slam": lambda s: filters.EifSlam(MOVE, s, 5, gate=GATE),
    "fastslam": lambda s: filters.FastSlam(MOVE, s, 5, 3, gate=GATE),
    "mapping": lambda s: filters.Mapping(s, 5, gate=GATE),
    "localization": lambda s: filters.Localization(MOVE, s, LANDMARKS[:3], gate=GATE),
    "particle_localization": lambda s: filters.ParticleLocalization(
        MOVE, s, LANDMARKS[:3], 3, gate=GATE
    ),
}
SPARSE = {
    "seif": lambda s: filters.Seif(MOVE, s, 5, active=9, links=4, gate=GATE),
}


START = np.zeros(3), np.diag([1e-4, 1e-4, 1e-6])


@functools.cache
def programs_of(family):
    """The filter of a family, and as programs its start and a step, for all tests of it."""
    filter = (FAMILIES | SPARSE)[family](seen_in_the_map())

    @jax.jit
    def step(state, scan, u=START[0]):
        key = jax.random.key(0)
        return filter.update(filter.predict(state, u, key), scan, key)

    return filter, jax.jit(filter.init), step


def after_two_scans(family, tags):
    """The info of SCAN, after a scan that started the first three landmarks."""
    z = np.array([where for _, where, _ in SCAN.values()])
    valid = np.array([status != Status.EMPTY for *_, status in SCAN.values()])
    first = Scan(
        np.concatenate([LANDMARKS[:3], np.zeros((len(z) - 3, 2))]),
        np.array([0, 1, 2, *[-1] * (len(z) - 3)]),
        np.arange(len(z)) < 3,
    )
    second = Scan(z, np.array(tags), valid)

    _, init, step = programs_of(family)
    state, _ = step(init(*START), first)
    return jax.device_get(step(state, second, MOVED)[1])


@pytest.mark.parametrize("family", swept([*FAMILIES, *SPARSE], "ekf_slam", "localization"))
def test_every_family_reports_a_scan_by_the_table(family):
    tags = [tag for tag, *_ in SCAN.values()]
    wanted = [status for *_, status in SCAN.values()]
    if family in SPARSE:  # a landmark's slot is its tag
        tags = [{7: 3, 8: 4}.get(tag, tag) for tag in tags]
    if "localization" in family:  # nothing is new in a map that is known
        born = (Status.BORN, Status.REPEATED, Status.OVERFLOW)
        wanted = [Status.UNMATCHED if status in born else status for status in wanted]
    info = after_two_scans(family, tags)
    got = [Status(int(status)).name for status in info.status]
    assert dict(zip(SCAN, got, strict=True)) == {
        name: status.name for name, status in zip(SCAN, wanted, strict=True)
    }
    compared = np.isin(info.status, [Status.FUSED, Status.REJECTED])
    assert (np.asarray(info.nis)[compared] > 0).all()
    assert not np.asarray(info.nis)[~compared].any()
    np.testing.assert_array_equal(info.dof, np.where(info.status == Status.FUSED, 2, 0))
    assert np.isfinite(info.log_likelihood)


@pytest.mark.parametrize(
    "family",
    swept(["compressed_ekf_slam", "ekf_slam", "ekf_slam, at once", "eif_slam", "seif"], "ekf_slam"),
)
def test_scans_without_places_and_measurements_beyond_all_numbers(family):
    """A scan of none is none; a d² that overflows is outside any gate, and moves nothing."""
    filter, init, step = programs_of(family)
    places = len(SCAN)

    def scan_of(z, valid=True):
        rows = np.concatenate([[z], np.zeros((places - 1, 2))])
        tag = np.array([0, *[-1] * (places - 1)])
        return Scan(rows, tag, (np.arange(places) < 1) & valid)

    def driven(*scans):
        state, status = init(*START), []
        for scan in scans:
            state, info = step(state, scan)
            status.append(int(info.status[0]))
        return state, status

    here, beyond = LANDMARKS[0], np.array([LANDMARKS[0, 0], 1e200])
    far, status = driven(scan_of(here), scan_of(beyond), scan_of(here))
    left, _ = driven(scan_of(here), scan_of(beyond, False), scan_of(here))
    nothing = Scan(np.zeros((0, 2)), np.zeros(0, np.int32), np.zeros(0, bool))

    @jax.jit
    def of_nothing(state):
        after, info = filter.update(state, nothing, jax.random.key(0))
        assert info.status.shape == (0,)
        return after

    far, after, left = map(jax.jit(filter.estimate), (far, of_nothing(far), left))
    assert status == [Status.BORN, Status.REJECTED, Status.FUSED]
    chex.assert_trees_all_close(far, left, rtol=0, atol=1e-12)
    chex.assert_trees_all_close(far, after, rtol=0, atol=1e-12)


@pytest.mark.sweep
def test_a_delayed_filter_reports_bearings_by_the_table():
    def noise(z):
        return jnp.where(jnp.abs(z[0] - np.pi / 2) < 0.1, -1e4, 1e-4)[None, None]

    sensor = changed(sensors.BearingOnly(noise), residual=lambda z, zh: z - zh)
    filter = filters.DelayedSlam(
        MOVE,
        sensor,
        3,
        gate=GATE,
        stored=StoredMeasurements(capacity=4),
        hypotheses=Hypotheses(capacity=2),
    )
    state = jax.jit(filter.init)(np.zeros(3), 1e-4 * np.eye(3))
    landmarks, alive, tag = (
        np.array(getattr(state.joint, k)) for k in ("landmarks", "alive", "tag")
    )
    landmarks[:2, :2], alive[:2], tag[:2] = [[4.0, 0.0], [0.0, 4.0]], True, [0, 5]
    joint = state.joint._replace(landmarks=landmarks, alive=alive, tag=tag)
    cases = (  # tag, bearing, valid; each in a scan of its own but the last two
        (0, 0.0, True, Status.FUSED),
        (0, 2.5, True, Status.REJECTED),
        (5, 1.5, True, Status.SINGULAR),
        (1, 0.5, True, Status.SIGHTED),
        (-1, 0.5, True, Status.UNMATCHED),
        (1, 0.5, False, Status.EMPTY),
    )
    scans = Scan(
        np.array([[[z], [z]] for _, z, *_ in cases]),
        np.array([[tag, tag] for tag, *_ in cases]),
        np.array([[valid, False] for *_, valid, _ in cases]),
    )
    # One more: the same new tag twice in a scan.
    twice = Scan(np.full((1, 2, 1), 0.5), np.ones((1, 2), int), np.ones((1, 2), bool))
    scans = jax.tree.map(lambda a, b: np.concatenate([a, b]), scans, twice)
    update = jax.jit(
        jax.vmap(lambda scan: filter.update(state._replace(joint=joint), scan, None)[1])
    )
    status = np.asarray(update(scans).status)
    assert list(status[:-1, 0]) == [wanted for *_, wanted in cases]
    assert list(status[-1]) == [Status.SIGHTED, Status.REPEATED]
