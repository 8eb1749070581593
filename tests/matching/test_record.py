"""The figure of the benchmark is drawn of the recorded tables: they are read as printed."""

from benchmarks.results import recorded
from benchmarks.scan_matching import __main__ as benchmark
from benchmarks.scan_matching import draw, record


def test_the_recorded_tables_are_read_to_the_digit():
    rows, errors = record.tables()
    section = recorded()["scan_matching"].replace("*", "")
    assert benchmark.nees_table(rows).replace("*", "") in section
    assert benchmark.error_table(errors) in section
    bands = {f"{row.low:.4g} to {row.high:.4g}" for row in rows if row.world == "square"}
    assert "0.9097 to 1.094" in bands and "| 0.9097 to 1.094 |" in section


def test_every_recorded_number_has_a_mark():
    rows, errors = record.tables()
    panels = draw.nees(rows, errors).axes
    marks = [line for panel in panels for line in panel.lines if line.get_marker() != "None"]
    assert len(marks) == len(rows) + len(errors)
