"""Small data sets written to files, the recorded ones of shared/data, and the EKF run over them."""

import os
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest

import jaxslam
from jaxslam import datasets, se2
from jaxslam.core.types import Status
from jaxslam.filters import EkfSlam

DATA = Path(os.environ.get("JAXSLAM_DATA", Path(__file__).parents[3] / "shared" / "data"))

COV = "0.01 0 0 0.04 0.001 0.09"
VICTORIA = {
    "victoria_park.txt": f"""ODOMETRY 0 1 0.5 0.1 -0.2 {COV}
LANDMARK 1 7 2.5 -3 0.4 0.1 0.3

ODOMETRY 1 2 1 0 0 {COV}
LANDMARK 4 5 -1 2 0.4 0.1 0.3
ODOMETRY 2 4 0 0 3.5 {COV}
LANDMARK 4 7 3 4 0.4 0.1 0.3
"""
}

BONN = {
    "world.dat": "4 1.5 -2\n2 0 3\n",
    "sensor_data.dat": """ODOMETRY 0.1 2 -0.3
SENSOR 4 1.5 0.25
SENSOR 2 2.5 -3

ODOMETRY 0 -1 0
ODOMETRY 0 0 4
SENSOR 2 0.5 1
SENSOR 4 -0.25 1
""",
}

EPOCH = 1248272272.0
MRCLAM = {
    "Barcodes.dat": "# Subject  Barcode\n  1 \t 5\n 8 \t 70\n 6 \t 72\n",
    "Landmark_Groundtruth.dat": "# Subject x y\n 8 1.5 -2 1e-4 1e-4\n 6 0 3 1e-4 1e-4\n",
    "Robot2_Odometry.dat": """# Time v omega
1248272272.500 0.5 0.125
1248272273.000 1.0 0.000
1248272273.000 2.0 0.250
1248272274.000 0.0 0.000
""",
    "Robot2_Measurement.dat": """# Time barcode range bearing
1248272272.250 72 1.50 0.25
1248272273.500 70 2.50 -0.5
1248272273.500 5 1.00 0.0
1248272273.500 72 3.50 0.5
1248272273.500 70 2.75 -0.5
1248272274.000 99 1.00 0.0

1248272274.000 72 4.50 1.0
1248272275.000 5 1.00 0.0
""",
}

TEAM = MRCLAM | {
    "Barcodes.dat": "# Subject Barcode\n 1 5\n 2 8\n 3 11\n 8 70\n 6 72\n",
    "Robot1_Odometry.dat": "1248272273.000 1.5 0.5\n1248272273.250 0 0\n",
    "Robot1_Measurement.dat": """1248272273.500 8 1.25 0.125
1248272273.500 72 4.00 0.75
1248272273.500 99 4.00 0.75
""",
}


def write(path, files, name=None, text=None):
    """Write a small data set to a folder, one file with another text; returns the folder."""
    for file, usual in files.items():
        (path / file).write_text(text if file == name else usual, encoding="utf-8")
    return path


def folder(name):
    """The folder of a recorded data set; skips the test where it is not there."""
    if not (DATA / name).is_dir():
        pytest.skip(f"no folder {DATA / name}; set JAXSLAM_DATA to where the data sets are")
    return DATA / name


@cache
def mrclam(robot):
    return datasets.mrclam(folder("mrclam1"), robot)


@cache
def mrclam_team():
    return datasets.mrclam_team(folder("mrclam1"))


def assert_log(data, control, z, tag, valid):
    """Hold the log against values by hand, exactly, and its arrays against their dtypes."""
    log = data.log
    np.testing.assert_allclose(log.control, control, rtol=0, atol=1e-15)
    for found, expected in zip(log.scan, (z, tag, valid), strict=True):
        np.testing.assert_array_equal(found, expected)
    kinds = [log.control.dtype, log.scan.z.dtype, log.scan.tag.dtype, log.scan.valid.dtype]
    assert kinds == [np.float64, np.float64, np.int32, np.bool_]
    assert all(isinstance(leaf, np.ndarray) for leaf in jax.tree.leaves(log))


def assert_error(path, line, reason, read):
    """Hold the message of a ValueError against file, line and reason."""
    with pytest.raises(ValueError) as caught:  # noqa: PT011 the message is compared in full below
        read()
    assert str(caught.value).startswith(f"{path}:{line}: ")
    assert reason in str(caught.value)


def assert_spoiled(path, files, name, old, new, line, reason, read):
    """Hold the error of a small data set against file, line and reason.

    In one file the last `old` is replaced by `new`, all of it where old is None.
    """
    text = files[name]
    assert old is None or text.count(old) in (1, 2)
    write(path, files, name, new if old is None else new.join(text.rsplit(old, 1)))
    assert_error(path / name, line, reason, lambda: read(path))


def assert_noises(data, odometry_cov, measurement_cov):
    """Hold the noise of both models, at any state, against these covariances."""
    np.testing.assert_array_equal(data.motion.noise_cov(np.zeros(3), np.ones(3)), odometry_cov)
    np.testing.assert_array_equal(data.sensor.noise_cov(np.zeros(2)), measurement_cov)


def mapped(data, probe=None):
    """A run of a data set's EKF, whose path must be finite.

    It has info, final, probe, nis_per_dof and, where there is a survey, rmse of the aligned map.
    """
    ekf = EkfSlam(data.motion, data.sensor, data.capacity, **data.filter_options)

    @jax.jit
    def go(log):
        trace = jaxslam.run(ekf, log, data.pose, data.pose_cov, jax.random.key(0), probe=probe)
        return trace.info, trace.estimate.pose, ekf.estimate(trace.final), trace.probe

    info, path, final, probe = jax.device_get(go(data.log))
    assert np.all(np.isfinite(path))
    found = SimpleNamespace(info=info, final=final, probe=probe)
    found.nis_per_dof = np.where(info.status == Status.FUSED, info.nis, 0.0).sum() / info.dof.sum()
    if data.landmarks is not None:
        survey = np.asarray(data.landmarks)[final.tag]
        found.rmse = np.sqrt(((aligned(final.points, survey) - survey) ** 2).sum(axis=1).mean())
    return found


@jax.jit
def aligned(points, survey):
    return jax.vmap(se2.from_frame, (None, 0))(se2.align(points, survey), points)
