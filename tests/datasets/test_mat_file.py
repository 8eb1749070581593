"""Matrices from MAT-files: those that SciPy writes, and what is damaged or no such file."""

import struct

import numpy as np
import pytest
import scipy.io

from jaxslam.datasets._landmark_logs.plaza_reader import read_matrices


@pytest.mark.parametrize("compressed", [False, True])
def test_what_scipy_writes_comes_back(tmp_path, compressed):
    kinds = ["i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f4", "f8"]
    wanted = {f"a_{kind}": np.arange(6).reshape(2, 3).astype(kind) for kind in kinds}
    wanted |= {"single": np.array([[7.5]]), "none": np.zeros((0, 3)), "long_name" * 3: np.eye(2)}
    others = {"text": "abc", "cell": np.array([[1, "a"]], object), "i": np.array([[1j]])}
    path = tmp_path / "a.mat"
    scipy.io.savemat(path, wanted | others, do_compression=compressed)
    found = read_matrices(path)
    assert found.keys() == wanted.keys()
    for name, array in wanted.items():
        assert found[name].dtype == array.dtype
        np.testing.assert_array_equal(found[name], array)


def test_the_other_order_of_bytes(tmp_path):
    def element(kind, data):
        return struct.pack(">II", kind, len(data)) + data + bytes(-len(data) % 8)

    numbers = struct.pack(">4H", 1, 2, 3, 400)  # a matrix of double, stored in less
    parts = [(6, struct.pack(">II", 6, 0)), (5, struct.pack(">ii", 2, 2)), (1, b"DR"), (4, numbers)]
    matrix = element(14, b"".join(element(*part) for part in parts))
    path = tmp_path / "b.mat"
    path.write_bytes(bytes(124) + b"\1\0MI" + matrix)
    np.testing.assert_array_equal(read_matrices(path)["DR"], [[1, 3], [2, 400]])
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(
        ValueError, match=r"b.mat: damaged at byte 128: expected [0-9]+ bytes of data"
    ):
        read_matrices(path)


def test_a_damaged_stream_is_named(tmp_path):
    path = tmp_path / "c.mat"
    scipy.io.savemat(path, {"a": np.eye(3), "b": np.eye(4)}, do_compression=True)
    content = bytearray(path.read_bytes())
    content[150] ^= 255
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"c.mat: damaged at byte 128: "):
        read_matrices(path)
