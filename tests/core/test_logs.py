"""Logs: what `log_of` refuses, and naming the row; `Log.from_records`; the counts of `Info`."""

from types import SimpleNamespace

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import refused
from reference.plane import compose
from worlds import narrow

from jaxslam import run
from jaxslam.core._validation import log_of
from jaxslam.core.logs import _streams as streams
from jaxslam.core.types import Estimate, Info, Log, Scan, Status, Trace, Truth
from jaxslam.core.validation import require
from jaxslam.filters import DeadReckoning, EkfSlam
from jaxslam.motion import PoseIncrement, Unicycle
from jaxslam.sensors import Compass, Part, RangeBearing, Suite


def good_log(steps=4, places=3):
    tag = np.tile([0, 1, -1], (steps, 1))
    valid = np.ones((steps, places), bool)
    scan = Scan(z=np.ones((steps, places, 2)), tag=tag, valid=valid)
    return Log(control=np.zeros((steps, 3)), scan=scan)


def check(log):
    return require("log", log, log_of(3, 2))


def changed(field, row, value):
    """The good log with one row of one field replaced."""
    log = good_log()
    table = getattr(log if field == "control" else log.scan, field).copy()
    table[row] = value
    return replaced(**{field: table})


def replaced(**fields):
    """The good log with other fields, of its own or of its scan."""
    log, own = (
        good_log(),
        {name: fields.pop(name) for name in ("control", "scan") if name in fields},
    )
    return log._replace(scan=log.scan._replace(**fields))._replace(**own)


def test_a_good_log_passes():
    check(good_log())
    check(jax.tree.map(jnp.asarray, good_log()))
    check(narrow(good_log()))


NO_Z = "log.scan.z: a valid measurement is"
BAD_VALUES = {
    "control nan": (
        changed("control", (2, 1), np.nan),
        r"log.control: a control is not finite \(row 2\): correct or omit",
    ),
    "control inf": (
        changed("control", (3, 0), np.inf),
        r"log.control: a control is not finite \(row 3\)",
    ),
    "z nan": (changed("z", (1, 2, 0), np.nan), rf"{NO_Z} not finite \(row 1, slot 2\)"),
    "z inf": (changed("z", (0, 0, 1), -np.inf), rf"{NO_Z} not finite \(row 0, slot 0\)"),
    "control beyond": (changed("control", (2, 0), -5e61), r"control is beyond ±4.5e\+61 \(row 2\)"),
    "z beyond": (changed("z", (1, 2, 0), 1e70), rf"{NO_Z} beyond ±4.5e\+61 \(row 1, slot 2\)"),
    "tag -2": (changed("tag", (3, 1), -2), r"log.scan.tag: a tag is below -1 \(row 3, slot 1\)"),
    "tag 2**32": (
        replaced(tag=good_log().scan.tag.astype(np.int64) + 2**32),
        r"log.scan.tag: a tag is beyond int32 \(row 0, slot 0\)",
    ),
    "repeated": (
        changed("tag", 2, [5, 6, 5]),
        r"log.scan.tag: a tag repeats within the scan \(row 2\)",
    ),
}


@pytest.mark.parametrize("case", BAD_VALUES)
def test_bad_values_are_refused_with_their_row(case):
    log, message = BAD_VALUES[case]
    with pytest.raises(ValueError, match=message):
        check(log)


def test_ranges_below_0_are_told_and_run(recwarn):
    """Noise makes some of near landmarks; padding and traced ones are not looked at."""
    log = good_log()
    log.scan.z[2, 1, 0] = -0.1
    log.scan.z[3, 0] = -5.0, 0.1
    drive, start = DeadReckoning(DRIVE, EYE), (np.zeros(3), np.eye(3), jax.random.key(0))
    with pytest.warns(UserWarning, match=r"run: 2 valid measurements have a range below 0 \(first in row 2, slot 1\): set"):  # fmt: skip
        told = run(drive, log, *start)
    bearing = changed("z", (0, 0, 1), -3.0)
    hidden = log._replace(scan=log.scan._replace(valid=log.scan.z[..., 0] > 0))
    for good in (bearing, hidden):
        chex.assert_trees_all_equal(run(drive, good, *start).estimate, told.estimate)
    jax.jit(lambda log: run(drive, log, *start))(log)
    assert not recwarn.list


@pytest.mark.parametrize("case", BAD_VALUES)
def test_values_are_not_looked_at_where_they_are_traced(case):
    def traced(log):
        check(log)
        return log

    jax.eval_shape(traced, BAD_VALUES[case][0])


def test_padding_may_hold_anything_and_unknown_tags_may_repeat():
    for field, row, value in (("z", (1, 2, 0), np.nan), ("tag", (1, 2), -7), ("tag", (1, 2), 0)):
        log = changed(field, row, value)
        valid = log.scan.valid.copy()
        valid[1, 2] = False
        check(log._replace(scan=log.scan._replace(valid=valid)))
    check(changed("tag", 1, [-1, -1, -1]))


BAD_SHAPES = {
    "control size": ({"control": np.zeros((4, 2))}, r"control: expected shape \(T, 3\), got \(4, 2\)"),
    "control rank": ({"control": np.zeros(3)}, r"control: expected shape \(T, 3\), got \(3,\)"),
    "control kind": ({"control": np.zeros((4, 3), int)}, "control: expected floating values, got int64"),
    "float16": (
        {"control": np.zeros((4, 3), np.float16), "z": np.ones((4, 3, 2), np.float16)},
        "float32 or float64, got float16",
    ),
    "z size": ({"z": np.ones((4, 3, 1))}, r"scan.z: expected shape \(4, 3, 2\), got \(4, 3, 1\)"),
    "z kind": ({"z": np.ones((4, 3, 2), bool)}, "scan.z: expected floating values, got bool"),
    "steps": ({"scan": good_log(5).scan}, r"scan.z: expected shape \(4, 3, 2\), got \(5, 3, 2\)"),
    "tag rank": ({"tag": np.zeros(4, int)}, r"scan.tag: expected shape \(4, M\), got \(4,\)"),
    "no scan": ({"scan": None}, r"expected a Scan\(z, tag, valid\), got NoneType"),
    "no array": ({"valid": None}, r"scan.valid: expected shape \(4, 3\), got None"),
    "tag kind": ({"tag": np.zeros((4, 3))}, "scan.tag: expected integer values, got float64"),
    "valid kind": ({"valid": np.ones((4, 3), int)}, "scan.valid: expected bool.* values, got int64"),
    "valid places": ({"valid": np.ones((4, 2), bool)}, r"valid: expected shape \(4, 3\), got \(4, 2\)"),
}  # fmt: skip


@pytest.mark.parametrize("traced", [False, True], ids=["concrete", "traced"])
@pytest.mark.parametrize("case", BAD_SHAPES)
def test_bad_shapes_and_kinds_are_refused_traced_or_not(case, traced):
    fields, message = BAD_SHAPES[case]
    log = replaced(**fields)
    with pytest.raises(ValueError, match=message):
        if traced:
            jax.eval_shape(check, log)
        else:
            check(log)


def test_info_counts_statuses_of_a_step_and_of_a_trace():
    codes = np.array([[Status.EMPTY, Status.FUSED, Status.FUSED], [Status.OVERFLOW] * 3])
    nothing = np.zeros(0)
    info = Info(nothing, nothing, nothing, nothing, nothing, jnp.asarray(codes), nothing)
    np.testing.assert_array_equal(info.tally(Status.FUSED), [2, 0])
    np.testing.assert_array_equal(info.tally(Status.OVERFLOW), [0, 3])
    np.testing.assert_array_equal(info.overflow, [False, True])
    step = info._replace(status=jnp.asarray(codes[1]))
    assert step.overflow
    assert step.tally(Status.OVERFLOW) == 3


def test_status_codes_are_distinct_and_empty_is_zero():
    assert Status.EMPTY == 0
    assert len({int(s) for s in Status}) == len(Status)


# --- `Log.from_records` and the alignment of streams below it: by hand, every kind of table, bad --


DRIVE, EYE = Unicycle(np.eye(2)), RangeBearing(np.eye(2))
ODOMETRY = [[1.0, 0.5, 0.1], [2.0, 1.0, 0.0], [3.0, 0.0, 0.0]]
SEEN = [
    (0.5, 7, 1.0, 0.0),
    (1.5, 7, 2.0, 0.25),
    (1.5, 3, 3.0, -0.5),
    (3.0, -1, 4.0, 0.5),
    (9.0, 7, 1.0, 0),
]


def columns(rows, *names):
    return {name: [row[i] for row in rows] for i, name in enumerate(names)}


def frame(rows, *names):
    """What a data frame shows: columns, and each by its name."""
    table = columns(rows, *names)

    class Frame:
        def __init__(self):
            self.columns = list(table)

        def __getitem__(self, name):
            return np.array(table[name])

    return Frame()


STRUCTURED = np.array(ODOMETRY, float).view([("t", float), ("v", float), ("omega", float)])[:, 0]


@pytest.mark.parametrize(
    ("odometry", "seen"),
    [
        (ODOMETRY, SEEN),
        (np.array(ODOMETRY), np.array(SEEN, float)),
        (STRUCTURED, columns(SEEN, "t", "tag", "range", "bearing")),
        (
            frame(ODOMETRY, "t [s]", "v [m/s]", "omega [rad/s]"),
            frame(SEEN, "t", "tag", "range [m]", "bearing"),
        ),
        (
            columns([(w, x, v, 1e3 * t) for (t, v, w), x in zip(ODOMETRY, "abc", strict=True)],
                    "omega", "left out", "v", "t [ms]"),
            columns([(t, k, r, np.rad2deg(b)) for t, k, r, b in SEEN], "t", "tag", "range", "bearing [deg]"),
        ),
    ],
    ids=["lists", "arrays", "columns", "frames", "units"],
)  # fmt: skip
def test_a_log_from_records_by_hand(odometry, seen):
    log, time, tags, dropped = Log.from_records(odometry, seen, DRIVE, EYE)
    np.testing.assert_allclose(time, [1.0, 1.5, 2.0, 3.0], rtol=1e-15)
    np.testing.assert_allclose(
        log.control, [[0, 0, 0], [0.5, 0.1, 0.5], [0.5, 0.1, 0.5], [1, 0, 1]], atol=1e-15
    )
    assert tags == (3, 7)
    np.testing.assert_array_equal(log.scan.tag, [[-1, -1], [1, 0], [-1, -1], [-1, -1]])
    np.testing.assert_array_equal(log.scan.valid, [[0, 0], [1, 1], [0, 0], [1, 0]])
    np.testing.assert_allclose(log.scan.z[1], [[2, 0.25], [3, -0.5]], rtol=1e-15)
    assert dropped == {"measurements outside the odometry": 2}


def test_a_landmark_whose_measurements_are_all_outside_the_odometry_has_no_tag():
    seen = [(-1.0, 5, 1, 0), (1.0, 7, 1, 0), (9.0, 5, 1, 0)]
    log, _, tags, dropped = Log.from_records(ODOMETRY, seen, DRIVE, EYE)
    assert tags == (7,) and log.scan.tag.max() == 0
    assert dropped == {"measurements outside the odometry": 2}


def test_a_measurement_with_a_range_below_0_is_dropped_and_counted():
    seen = [(1.0, 7, -1.0, 0.5), (1.0, 5, 2.0, 0.5), (2.0, 5, 0.0, 0.5)]
    log, _, tags, dropped = Log.from_records(ODOMETRY, seen, DRIVE, EYE)
    assert log.scan.valid.sum() == 2 and (log.scan.z >= 0).all()
    assert dropped["measurements with a range below 0"] == 1 and tags == (5, 7)


def test_tags_may_be_text_and_unknown():
    seen = [(1.0, "tree", 1, 0), (1.0, 12, 1, 0), (2.0, "", 1, 0), (2.0, None, 1, 0)]
    log, _, tags, _ = Log.from_records(ODOMETRY, seen, DRIVE, EYE)
    assert tags == (12, "tree")
    np.testing.assert_array_equal(log.scan.tag, [[1, 0], [-1, -1], [-1, -1]])
    assert log.scan.valid.sum() == 4


class _Missing:
    """As pandas' <NA>: comparisons give it again, and it is neither true nor false."""

    def __eq__(self, other):
        return self

    __ne__ = __eq__
    __hash__ = None

    def __bool__(self):
        raise TypeError("boolean value of NA is ambiguous")

    def __repr__(self):
        return "<NA>"


NA = _Missing()
TAGS = {
    "nullable integers": [7, NA, 7],
    "nullable text": ["a", NA, "a"],
    "masked": np.ma.masked_array([7, 5, 7], [False, True, False]),
    "floats": np.array([7.0, np.nan, 7.0]),
    "objects": np.array([7, None, 7], object),
    "JAX": jnp.array([7, -1, 7]),
    "JAX floats": jnp.array([7.0, np.nan, 7.0]),
    "scalars of JAX": [jnp.int32(7), jnp.float32(np.nan), jnp.float32(7)],
    "arrays without axes": [np.array(7), np.array(-1), np.float32(7)],
}


@pytest.mark.parametrize("kind", TAGS)
def test_missing_identities_of_columns_are_unknown(kind):
    seen = {"t": [1.0, 1.0, 2.0], "tag": TAGS[kind], "range": [1, 2, 3], "bearing": [0, 0, 0]}
    log, _, tags, _ = Log.from_records(ODOMETRY, seen, DRIVE, EYE)
    assert tags == (("a",) if kind == "nullable text" else (7,))
    assert type(tags[0]) in (int, str)
    np.testing.assert_array_equal(log.scan.tag, [[0, -1], [0, -1], [-1, -1]])
    assert log.scan.valid.sum() == 3


def test_columns_of_pandas():
    """The same of pandas itself, where it is installed."""
    pandas = pytest.importorskip("pandas", reason="pandas is not a dependency")
    base = {"t": [1.0, 1.0, 2.0], "range": [1.0, 2.0, 3.0], "bearing": [0.1, 0.2, 0.3]}
    for dtype, values in (("Int64", [7, None, 7]), ("string", ["a", None, "a"])):
        frame = pandas.DataFrame(base | {"tag": pandas.array(values, dtype=dtype)})
        log, *_ = Log.from_records(ODOMETRY, frame, DRIVE, EYE)
        np.testing.assert_array_equal(log.scan.tag, [[0, -1], [0, -1], [-1, -1]])


def test_arrays_of_jax_are_tables_columns_rows_and_numbers():
    seen = [(1.5, 7, 2.0, 0.25), (3.0, 7, 4.0, 0.5)]
    plain = Log.from_records(ODOMETRY, seen, DRIVE, EYE)
    names = "t", "tag", "range", "bearing"
    for odometry, given in (
        (jnp.array(ODOMETRY), jnp.array(seen)),
        ([jnp.array(row) for row in ODOMETRY], [jnp.array(row) for row in seen]),
        (ODOMETRY, {name: jnp.array(c) for name, c in columns(seen, *names).items()}),
        (ODOMETRY, [(t, k, jnp.float32(r), jnp.array(b)) for t, k, r, b in seen]),
    ):
        chex.assert_trees_all_close(
            Log.from_records(odometry, given, DRIVE, EYE)[:2], plain[:2], rtol=1e-6
        )


def test_angles_in_degrees_and_stamps_in_milliseconds_are_told():
    """A reading of bearings in degrees, and one by their name, which has no sign of it."""
    rows = {"t": [1.0, 1.5], "tag": [1, 2], "range": [1.0, 2.0]}
    with pytest.warns(UserWarning, match=r"row 1, column bearing: 1 of 2 numbers are beyond 2π, up to 90: .* \[deg\]"):  # fmt: skip
        Log.from_records(ODOMETRY, {**rows, "bearing": [3.0, 90.0]}, DRIVE, EYE)
    Log.from_records(ODOMETRY, {**rows, "bearing [deg]": [3.0, 90.0]}, DRIVE, EYE)
    late = [(1.7e12 + 1000 * t, *rest) for t, *rest in ODOMETRY]
    stamps = {**rows, "t": [late[0][0]] * 2, "bearing": [0.1, 0.2]}
    with pytest.warns(UserWarning, match=r"since 1970: .* \[ms\]") as told:
        Log.from_records(late, stamps, DRIVE, EYE)
    assert len(told) == 2


def test_a_path_that_is_set_to_zero_makes_no_step():
    """The robot drives on by the step before."""
    x = [0.1 * k if k < 30 else 0.1 * (k - 30) for k in range(60)]
    path = {"t": np.arange(60) * 0.2, "x": np.array(x) + 4.0 * (np.arange(60) < 30), "y": np.zeros(60), "theta": np.zeros(60)}  # fmt: skip
    motion = PoseIncrement(np.eye(3))
    seen = [(1.0, 7, 1.0, 0.0)]
    with pytest.warns(UserWarning, match=r"odometry, row 30, column x: a jump of the odometry by 6.9 m .* is no motion"):  # fmt: skip
        log = Log.from_records(path, seen, motion, EYE).log
    np.testing.assert_allclose(log.control[1:, 0], 0.1, rtol=1e-12)
    degrees = path | {"x": np.cos(0.2 * path["t"]), "y": np.sin(0.2 * path["t"]), "theta": 90 + np.rad2deg(0.2 * path["t"])}  # fmt: skip
    with pytest.warns(UserWarning, match=r"theta: .* which fit it as degrees: write \[deg\] in the column's name"):  # fmt: skip
        Log.from_records(degrees, seen, motion, EYE)


def test_whole_numbers_of_nanoseconds_are_divided_as_such():
    """Of 19 digits float64 holds 16: a quotient by 1e9 would be 128 ns off before it is rounded."""
    stamps = [1_700_000_000_123_456_789 + 200_000_000 * k for k in range(3)]
    for kind in (list, np.array):
        drive = {"t [ns]": kind(stamps), "v": [1, 1, 1], "omega": [0, 0, 0]}
        _, time, *_ = Log.from_records(drive, [(stamps[1] / 10**9, 7, 1, 0)], DRIVE, EYE)
        np.testing.assert_array_equal(time, [n / 10**9 for n in stamps])


def test_measurements_in_a_gap_between_poses_are_dropped_and_counted():
    """Over ten times the median interval; velocities hold over one."""
    path = [(t, t, 0.0, 0.0) for t in (0, 1, 2, 3, 20, 21)]
    seen = [(2.5, 7, 1, 0), (10.0, 7, 1, 0), (19.0, 8, 1, 0), (20.0, 7, 1, 0)]
    poses = columns(path, "t", "x", "y", "theta")
    log, time, tags, dropped = Log.from_records(poses, seen, PoseIncrement(np.eye(3)), EYE)
    np.testing.assert_array_equal(time, [0, 1, 2, 2.5, 3, 20, 21])
    assert tags == (7,) and log.scan.valid.sum() == 2
    assert dropped == {
        "measurements outside the odometry": 0,
        "measurements in a gap of the odometry": 2,
    }
    drive = [(t, 1.0, 0.0) for t, *_ in path]
    assert Log.from_records(drive, seen, DRIVE, EYE)[3] == {"measurements outside the odometry": 0}


def test_a_path_of_poses_becomes_increments():
    """Composed again they give the path; between two poses it is straight."""
    path = [(0.0, 1.0, 1.0, np.pi / 2), (1.0, 1.0, 3.0, np.pi), (2.0, 0.0, 3.0, -np.pi / 2)]
    poses = columns(path, "t", "x", "y", "theta")
    log, time, *_ = Log.from_records(poses, [(0.5, 1, 1, 0)], PoseIncrement(np.eye(3)), EYE)
    np.testing.assert_array_equal(time, [0, 0.5, 1, 2])
    np.testing.assert_allclose(log.control[[0, 1, 3]], [[0, 0, 0], [1, 0, np.pi / 4], [1, 0, np.pi / 2]], atol=1e-15)  # fmt: skip
    at = np.array(path[0][1:])
    for u in log.control:
        at = compose(at, u)
    np.testing.assert_allclose(at, [0, 3, -0.5 * np.pi], atol=1e-14)


def test_a_sensor_of_no_landmark_needs_no_tag():
    log, _, tags, _ = Log.from_records(ODOMETRY, [(2.0, 0.5)], DRIVE, Compass(np.eye(1)))
    assert tags == ()
    np.testing.assert_array_equal(log.scan.valid[:, 0], [False, True, False])


EYES = Suite(((EYE, 3), (Compass(np.eye(1)), 1)))
NORTH = [(1.5, 0.3), (2.5, 0.2)]


def test_sensors_with_rates_of_their_own_are_one_log():
    """Rows at the times of any; slots by sensor, as the suite has them (Solà 2.4)."""
    log, time, tags, dropped = Log.from_records(ODOMETRY, (SEEN, NORTH), DRIVE, EYES)
    np.testing.assert_allclose(time, [1.0, 1.5, 2.0, 2.5, 3.0])
    np.testing.assert_allclose(log.control[3:], [[1, 0, 0.5], [1, 0, 0.5]])
    assert (tags, dropped) == ((3, 7), {"measurements outside the odometry": 2})
    valid = [[0, 0, 0, 0], [1, 1, 0, 1], [0, 0, 0, 0], [0, 0, 0, 1], [1, 0, 0, 0]]
    np.testing.assert_array_equal(log.scan.valid, valid)
    np.testing.assert_array_equal(log.scan.tag[1], [1, 0, -1, -1])
    np.testing.assert_allclose(log.scan.z[1], [[2, 0.25], [3, -0.5], [0, 0], [0.3, 0]])
    start = np.zeros(3), np.eye(3)
    trace = run(EkfSlam(DRIVE, EYES, 2), log, *start, jax.random.key(0))
    assert int(trace.info.tally(Status.FUSED)[3]) == 1


def test_tables_that_are_not_those_of_the_suite_are_refused():
    for seen, message in (
        (
            SEEN,
            r"a table for each of the 2 sensors of the suite, \(range_bearing, compass\), got a list",
        ),
        (
            (SEEN, [(1.5, 0.3)] * 2),
            r"measurements\[1\] of compass, row 1, .*at most 1 measurement at a",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            Log.from_records(ODOMETRY, seen, DRIVE, EYES)
    team = Suite((Part(EYE, 1, sees="robots"),))
    with pytest.raises(
        ValueError, match=r"of a team make the log of each robot by Log.from_streams"
    ):
        Log.from_records(ODOMETRY, (SEEN,), DRIVE, team)


@refused(
    (ODOMETRY, [(1, 7, 1)], r"measurements, row 0: expected 4 values"),
    (columns(ODOMETRY, "t", "v", "w"), SEEN, r"odometry: expected a column 'omega \["),
    (columns(ODOMETRY, "t", "v", "omega [rpm]"), SEEN, r"expected a unit \[rad/s\] or \[deg/s\], got 'omega"),
    ([*ODOMETRY, (4.0, np.nan, 0.0)], SEEN, r"odometry, row 3, column v: expected a finite"),
    (ODOMETRY, [(1.0, 7, "1.0", 0)], r"column range: expected a finite number, got '1.0'"),
    (ODOMETRY[::-1], SEEN, r"row 1, column t: expected a time above 3.0, got 2"),
    (ODOMETRY[:1] * 2, SEEN, r"odometry, row 1, column t: expected a time above 1.0, got 1"),
    (ODOMETRY, SEEN[::-1], r"measurements, row 1, column t: expected a time of at leas"),
    (ODOMETRY, [(1.0, 7.5, 1, 0)], r"column tag: expected a whole number or text, got 7.5"),
    (ODOMETRY, [(1.0, -2, 1, 0)], r"row 0, column tag: expected a number >= 0"),
    (ODOMETRY, [(1.0, 7, 1, 0)] * 2, r"row 1, column tag: expected a tag once at a time"),
    (ODOMETRY, [], r"measurements: expected at least one row, got none"),
    ({"t": [1], "v": [], "omega": [1]}, SEEN, r"expected columns of one length"),
    (3, SEEN, r"odometry: expected rows or columns, got int"),
    (jnp.array(3.0), SEEN, r"odometry: expected rows or columns, got ndarray"),
    ([jnp.float32(1)], SEEN, r"odometry, row 0: expected 3 values .*, got 1"),
    ({"t": 1.0, "v": [1], "omega": [1]}, SEEN, r"expected a column 't \[s\]', got 1.0"),
    (ODOMETRY, [(1.0, 7, NA, 0)], r"column range: expected a finite number, got <NA>"),
    (ODOMETRY, [(1.0, 7, np.ma.masked, 0)], r"column range: expected a finite number, got masked"),
    (ODOMETRY, [(np.datetime64(1, "ns"), 7, 1, 0)], r"column t: expected a finite number, got np.d"),
    (ODOMETRY, [(1.0, [7, 8], 1, 0)], r"column tag: expected a whole number or text, got \[7"),
    (ODOMETRY, [(1.0, np.arange(2), 1, 0)], r"column tag: expected a whole number or text, got ar"),
    (ODOMETRY, [(1.0, 7, 10**400, 0)], r"column range: expected a finite number, got 1000"),
    told="Log.from_records: .*",
)  # fmt: skip
def test_bad_records_say_where(odometry, seen):
    Log.from_records(odometry, seen, DRIVE, EYE)


def test_increments_cannot_be_divided():
    motion = SimpleNamespace(controls=("forward [m]", "turn [rad]"))
    seen = [(1.5, 7, 1, 0)]
    with pytest.raises(ValueError, match=r"row 0, column t: expected a time of the odometry"):
        Log.from_records(ODOMETRY, seen, motion, EYE)
    log, *_ = Log.from_records(ODOMETRY, [(2.0, 7, 1, 0)], motion, EYE)
    np.testing.assert_array_equal(log.control, np.array(ODOMETRY)[:, 1:])


def test_streams_need_a_row_for_each_measurement():
    stream = np.arange(2.0), np.zeros((2, 1))
    with pytest.raises(
        ValueError, match="align: expected measurements at times of rows, got one a"
    ):
        streams.align_streams(stream, ([0.5], [0], np.ones((1, 2))), streams.as_recorded, [0, 1])
    with pytest.raises(ValueError, match="expected a row at each time of the odometry"):
        streams.align_streams(stream, ([0.5], [0], np.ones((1, 2))), streams.as_recorded)


def made_trace(steps=5, runs=()):
    """A trace of NumPy arrays, whose fields are as those of `run`; of one measurement a step."""
    shape = (*runs, steps)
    status = np.full((*shape, 1), Status.FUSED)
    status[..., 0, 0] = Status.BORN
    info = Info(
        *(np.ones((*shape, 1)), np.ones((*shape, 1), int), np.zeros((*shape, 1, 2))),
        *(np.zeros((*shape, 1, 2, 2)), np.zeros((*shape, 1), int), status, np.zeros(shape)),
    )
    cov = np.broadcast_to(np.diag([1.0, 2.0, 0.1]), (*shape, 3, 3)).copy()
    point_covs, alive = np.zeros((*shape, 4, 2, 2)), np.zeros((*shape, 4), bool)
    points, tag = np.zeros((*shape, 4, 2)), np.full((*shape, 4), -1)
    estimate = Estimate(np.zeros((*shape, 3)), cov, points, point_covs, alive, tag)
    return Trace(estimate, info, None, None)


def test_records_of_arrays_are_shown_by_kind_and_shape():
    log, trace = good_log(steps=2000), made_trace(2000)
    assert repr(log) == (
        "Log(control=float64[2000,3], scan=Scan(z=float64[2000,3,2], tag=int64[2000,3], "
        "valid=bool[2000,3]))"
    )
    truth = Truth(np.zeros((7, 3)), np.zeros((2, 2)), np.zeros(7, int), np.zeros(3))
    assert repr(truth).endswith("missed=int64[7], start=float64[3], origin=None, further=None)")
    assert repr(trace).startswith("Trace(2000 steps: 1,999 fused, 1 born,\n")
    assert "pose_cov=float64[2000,3,3]" in repr(trace) and len(repr(trace)) < 800
    assert repr(made_trace(5, runs=(3,))).startswith("Trace(3 × 5 steps: 12 fused, 3 born,")
    assert "log_likelihood=0.5" in repr(trace.info._replace(log_likelihood=np.float64(0.5)))

    def traced(log, trace):
        shown.extend((repr(log), repr(trace)))
        return log, trace

    shown = []
    given = jax.tree.map(jnp.asarray, (log, trace))
    jax.eval_shape(traced, *given)
    jax.make_jaxpr(jax.vmap(traced))(*jax.tree.map(lambda leaf: leaf[None], given))
    assert shown[0] == shown[2] == repr(log)
    assert shown[1] == shown[3] and shown[1].startswith("Trace(estimate=Estimate(pose=float64[2000")
    shapes = jax.eval_shape(lambda *given: given, *given)
    assert (repr(shapes[0]), repr(shapes[1])) == tuple(shown[:2])
    assert repr(jax.tree.map(lambda _: None, log)).startswith("Log(control=None, scan=Scan(")


def test_a_trace_counts_what_is_wrong_with_its_estimates():
    trace = made_trace(10)
    assert trace.doubts == ()
    cov = trace.estimate.pose_cov
    cov[3, 0, 1], cov[4:6], cov[7, 2, 2] = 0.5, -cov[4:6], 0.0
    trace.estimate.pose[8, 0] = np.nan
    trace.info.nis[9] = np.inf
    assert trace.doubts == (
        "estimate or Info is not finite in 2 of 10 steps",
        "pose_cov is not symmetric in 1 of 10 steps",
        "pose_cov is not positive definite in 2 of 10 steps",
    )
    assert all(doubt in repr(trace) for doubt in trace.doubts)
    assert jax.tree.map(jnp.asarray, trace).doubts == trace.doubts
    status = trace.info.status
    status[2:7] = Status.REJECTED
    assert len(trace.doubts) == 3  # half of them
    status[7] = Status.SINGULAR
    lost = "6 of 10 measurements were not used: 5 rejected, 1 singular"
    assert trace.doubts[3:] == (lost,)
    many = made_trace(10, runs=(2, 4))
    many.info.status[1, 2], many.info.status[0, 3] = status, Status.UNMATCHED
    (doubt,) = many.doubts
    lost = "not used in 2 of 8 runs: 5 rejected, 1 singular, 10 unmatched"
    assert doubt == f"16 of 20 measurements were {lost}"
    of_beams = trace.info._replace(innovation=np.zeros((10, 1, 0)))
    assert len(trace._replace(info=of_beams).doubts) == 3
    with pytest.raises(
        ValueError,
        match=r"Trace: doubts: it needs values: use it outside of jax\.jit and jax\.vmap",
    ):
        jax.eval_shape(lambda trace: trace.doubts and trace, trace)
