"""Text files line by line: numbers, identities, and errors that say where."""

import gzip

import pytest
from recordings import assert_error

from jaxslam.datasets._lines import TextFile, read_bytes, stored_file


def text_file(path, text, *options):
    path.write_text(text, encoding="utf-8")
    return TextFile(path, *options)


def test_lines_are_numbered_from_one_and_blanks_and_comments_passed_over(tmp_path):
    file = text_file(tmp_path / "f", "# a\n\n 1\t2 \r\n#b\n \t\n3", "#")
    assert list(file) == [(3, ["1", "2"]), (6, ["3"])]


def test_without_a_comment_sign_every_line_counts(tmp_path):
    assert list(text_file(tmp_path / "f", "# 1\n")) == [(1, ["#", "1"])]


@pytest.mark.parametrize("bad", ["x", "nan", "inf", "-inf", "1_0", "1e999", "0x1", "1,5", "--1"])
def test_what_is_not_a_finite_number_is_named(tmp_path, bad):
    file = text_file(tmp_path / "f", f"\n1 {bad}\n")
    [(line, fields)] = file
    reason = f"b is not a finite number: '{bad}'"
    assert_error(tmp_path / "f", 2, reason, lambda: file.numbers(line, fields, ("a", "b")))


@pytest.mark.parametrize("bad", ["-1", "1.0", "1e3", "+1", "x", "²"])
def test_what_is_not_an_identity_is_named(tmp_path, bad):
    file = text_file(tmp_path / "f", bad)
    reason = "id is not a whole number >= 0"
    assert_error(tmp_path / "f", 1, reason, lambda: file.identity(1, bad, "id"))


@pytest.mark.parametrize("text", ["1 2 3", "1"])
def test_a_wrong_number_of_fields_is_counted(tmp_path, text):
    file = text_file(tmp_path / "f", text)
    [(line, fields)] = file
    reason = f"expected 2 fields (a b), got {len(fields)}"
    assert_error(tmp_path / "f", 1, reason, lambda: file.numbers(line, fields, ("a", "b")))


def test_a_file_that_is_not_text_is_refused(tmp_path):
    (tmp_path / "f").write_bytes(b"1 2\n3 \xff\n")
    assert_error(tmp_path / "f", 2, "this is not text", lambda: TextFile(tmp_path / "f"))


def test_a_file_that_cannot_be_read_is_named(tmp_path):
    with pytest.raises(ValueError, match=f"{tmp_path}/f: cannot be read: No such file"):
        TextFile(tmp_path / "f")
    with pytest.raises(ValueError, match="cannot be read"):
        TextFile(tmp_path)


def test_a_packed_file_is_read_as_it_is_and_errors_name_it(tmp_path):
    (tmp_path / "f.gz").write_bytes(gzip.compress(b"1 2\n3 x\n"))
    assert stored_file(tmp_path / "f") == tmp_path / "f.gz"
    for name in ("f", "f.gz"):
        file = TextFile(tmp_path / name)
        assert list(file) == [(1, ["1", "2"]), (2, ["3", "x"])]
        reason = "b is not a finite number: 'x'"
        read = lambda file=file: file.numbers(2, ["3", "x"], ("a", "b"))  # noqa: E731
        assert_error(tmp_path / "f.gz", 2, reason, read)
    (tmp_path / "f").write_bytes(b"plain")
    assert read_bytes(tmp_path / "f") == (tmp_path / "f", b"plain")
    assert stored_file(tmp_path / "g") is None


PACKED = gzip.compress(b"1 2\n" * 100, mtime=0)  # workers must collect the same names


@pytest.mark.parametrize(
    "damaged", [b"1 2\n", PACKED[:-9], PACKED[:20], b"\x1f\x8b\x08" + b"\xff" * 30]
)
def test_a_packed_file_that_is_damaged_is_named(tmp_path, damaged):
    (tmp_path / "f.gz").write_bytes(damaged)
    with pytest.raises(ValueError, match=f"{tmp_path}/f.gz: cannot be read: expected a gzip file"):
        TextFile(tmp_path / "f")
