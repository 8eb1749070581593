"""The estimators of examples/judge: EKFs of others have our EKF's NEES, GTSAM our batch optimum.

Each reads the tables of a run alone. What is not installed is skipped.
"""

import dataclasses
import importlib.util
import shutil
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from jaxslam import datasets, run, scenarios
from jaxslam.consistency import write_draws
from jaxslam.filters import EkfSlam
from jaxslam.graphs.smoothing import BatchMap

EXAMPLES = Path(__file__).parents[2] / "examples" / "judge"
STEPS, KEY = 40, jax.random.key(3)
WORLDS = {"circle": scenarios.circle(STEPS), "loop": scenarios.loop(STEPS)}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Draws of both worlds, one run each."""
    path = tmp_path_factory.mktemp("judge")
    for name, world in WORLDS.items():
        write_draws(world, 1, KEY, path / name)
    return path


@pytest.fixture(scope="module")
def words(tmp_path_factory):
    """The function of a program's name that returns its words, before RUN and ESTIMATE."""

    def installed(program):
        if (path := shutil.which(program)) is None:
            pytest.skip(f"{program} is not installed")
        return path

    def with_library(library, file, *options):
        if importlib.util.find_spec(library) is None:
            pytest.skip(f"{library} is not installed")
        return [sys.executable, str(EXAMPLES / file), *options]

    def of(name):
        match name:
            case "cpp":
                binary = tmp_path_factory.mktemp("cpp") / "ekf_slam"
                options = "-std=c++17", "-O2", "-Wall", "-Wextra", "-Werror", "-pedantic"
                source = EXAMPLES / "ekf_slam.cpp"
                subprocess.run([installed("c++"), *options, "-o", binary, source], check=True)
                return [str(binary)]
            case "octave":
                return [installed("octave-cli"), "--norc", "-q", str(EXAMPLES / "ekf_slam.m")]
            case "filterpy":
                return with_library("filterpy", "filterpy_ekf.py")
            case "isam2":
                return with_library("gtsam", "gtsam_slam.py")
            case _:
                return with_library("gtsam", "gtsam_slam.py", "--batch")

    return of


def data_of(folder, world):
    """The data set in the tables without the pose at the start, and the true path."""
    data = datasets.table(folder / world / "runs" / "0000")
    assert data.time[0] == 0.0 and not data.log.control[0].any()
    truth = np.loadtxt(folder / world / "truth/0000/truth.csv", delimiter=",", skiprows=1)
    log = jax.tree.map(lambda leaf: np.asarray(leaf)[1:], data.log)
    return dataclasses.replace(data, log=log, time=data.time[1:]), truth[:, 1:]


def estimate_of(words, run_folder, estimate):
    """Times, poses and covariances that a program writes."""
    estimate.mkdir()
    subprocess.run([*words, run_folder, estimate], check=True)
    rows = np.loadtxt(estimate / "trajectory.csv", delimiter=",", skiprows=1)
    cov = np.zeros((len(rows), 3, 3))
    upper = np.triu_indices(3)
    cov[:, upper[0], upper[1]] = cov[:, upper[1], upper[0]] = rows[:, 4:]
    return rows[:, 0], rows[:, 1:4], cov


def nees(truth, pose, cov):
    """The pose NEES of each step from the second, where P is regular, in NumPy."""
    error = truth[1:] - pose[1:]
    error[:, 2] = np.angle(np.exp(1j * error[:, 2]))
    return np.einsum("ti,tij,tj->t", error, np.linalg.inv(cov[1:]), error)


def test_the_program_in_cpp_is_short():
    lines = (EXAMPLES / "ekf_slam.cpp").read_text().splitlines()
    assert len(lines) <= 150 and max(map(len, lines)) <= 110


def test_no_program_imports_this_package():
    for path in EXAMPLES.glob("*.py"):
        assert "jaxslam" not in path.read_text()


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("program", ["cpp", "octave", "filterpy"])
def test_an_ekf_of_others_has_our_nees(program, world, words, folder, tmp_path):
    command = words(program)
    data, truth = data_of(folder, world)
    ekf = EkfSlam(data.motion, data.sensor, len(data.tags), correction="joint")
    trace = jax.device_get(run(ekf, data.log, data.pose, data.pose_cov, KEY))
    expected = nees(truth, trace.estimate.pose, trace.estimate.pose_cov)
    estimate = tmp_path / "0000"
    time, pose, cov = estimate_of(command, folder / world / "runs/0000", estimate)
    np.testing.assert_array_equal(time, data.time)
    np.testing.assert_allclose(pose, trace.estimate.pose, atol=1e-9)
    np.testing.assert_allclose(nees(truth, pose, cov), expected, atol=1e-6)

    innovations = np.loadtxt(estimate / "innovations.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(innovations[:, 7].sum(), trace.info.nis.sum(), atol=1e-6)
    likelihood = trace.info.log_likelihood.sum()
    np.testing.assert_allclose(innovations[:, 8].sum(), likelihood, atol=1e-6)
    landmarks = np.loadtxt(estimate / "map.csv", delimiter=",", skiprows=1, ndmin=2)
    final = jax.tree.map(lambda leaf: leaf[-1], trace.estimate)
    slot = {int(data.tags[final.tag[i]]): i for i in np.flatnonzero(final.alive)}
    assert sorted(landmarks[:, 0]) == sorted(slot)
    order = [slot[int(tag)] for tag in landmarks[:, 0]]
    np.testing.assert_allclose(landmarks[:, 1:3], final.points[order], atol=1e-9)
    upper = final.point_covs[order][:, [0, 0, 1], [0, 1, 1]]
    np.testing.assert_allclose(landmarks[:, 3:], upper, atol=1e-9)


@pytest.mark.parametrize("world", WORLDS)
def test_the_batch_of_gtsam_is_our_batch(world, words, folder, tmp_path):
    command = words("batch")
    data, _ = data_of(folder, world)
    batch = BatchMap(data.motion, data.sensor, len(data.tags), data.pose, data.pose_cov)
    expected = jax.device_get(batch(data.log, KEY)).estimate
    estimate = tmp_path / "0000"
    _, pose, cov = estimate_of(command, folder / world / "runs/0000", estimate)
    np.testing.assert_allclose(pose, expected.pose, atol=1e-6)
    np.testing.assert_allclose(cov, expected.pose_cov, atol=1e-7)
    landmarks = np.loadtxt(estimate / "map.csv", delimiter=",", skiprows=1, ndmin=2)
    order = np.argsort([int(data.tags[tag]) for tag in expected.tag[-1] if tag >= 0])
    np.testing.assert_allclose(landmarks[:, 1:3], expected.points[-1][order], atol=1e-6)


@pytest.mark.parametrize("world", WORLDS)
def test_isam2_starts_as_the_ekf_and_ends_at_the_batch(world, words, folder, tmp_path):
    command = words("isam2")
    data, truth = data_of(folder, world)
    ekf = EkfSlam(data.motion, data.sensor, len(data.tags), correction="joint")
    filtered = jax.device_get(run(ekf, data.log, data.pose, data.pose_cov, KEY)).estimate
    batch = BatchMap(data.motion, data.sensor, len(data.tags), data.pose, data.pose_cov)
    smoothed = jax.device_get(batch(data.log, KEY)).estimate
    _, pose, cov = estimate_of(command, folder / world / "runs/0000", tmp_path / "0000")
    # One motion: P = G Q Gᵀ + F P0 Fᵀ in the axes of the map; the start is known to 1 µm at best.
    np.testing.assert_allclose(pose[0], filtered.pose[0], atol=1e-6)
    np.testing.assert_allclose(cov[0], filtered.pose_cov[0], atol=1e-8)
    # A heading of 1 rad and more: a covariance in the frame of the robot would be far off.
    sigma = np.sqrt(np.diagonal(smoothed.pose_cov[-1]))
    assert abs(truth[-1, 2]) > 0.9
    assert (np.abs(pose[-1] - smoothed.pose[-1]) < 0.2 * sigma).all()
    ratio = np.diagonal(cov[-1]) / sigma**2
    assert (np.abs(ratio - 1) < 0.2).all()
