"""types: what `check_log` refuses, and naming the row; the counts of `Info`."""

import pydoc

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam import graphs
from jaxslam.core.types import Info, Log, Scan, Status, Truth
from jaxslam.core.validation import check_log


def good_log(steps=4, places=3):
    tag = np.tile([0, 1, -1], (steps, 1))
    valid = np.ones((steps, places), bool)
    scan = Scan(z=np.ones((steps, places, 2)), tag=tag, valid=valid)
    return Log(control=np.zeros((steps, 3)), scan=scan)


def check(log):
    return check_log("drive", log, control_size=3, measurement_size=2)


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
    check(jax.tree.map(lambda a: a.astype(np.float32) if a.dtype == float else a, good_log()))


NO_Z = "log.scan.z: a valid measurement is"
BAD_VALUES = {
    "control nan": (
        changed("control", (2, 1), np.nan),
        r"log.control is not finite \(row 2\): correct or leave out",
    ),
    "control inf": (changed("control", (3, 0), np.inf), r"log.control is not finite \(row 3\)"),
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
    with pytest.raises(ValueError, match=f"^drive: .*{message}"):
        check(log)


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
    with pytest.raises(ValueError, match=f"^drive: .*{message}"):
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


def test_help_shows_the_docstrings_of_fields():
    """Of named tuples, whose fields Python calls "Alias for field number 0"."""
    text = pydoc.plain(pydoc.render_doc(graphs.Marginals))
    assert "of (x, y, θ), in world coordinates as the poses themselves" in text
    assert "a variable does not have are zero" in text and "Alias for field" not in text
    assert Truth.origin.__doc__.startswith("the tag of the landmark each measurement is")
