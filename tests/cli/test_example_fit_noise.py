"""`examples/fit_noise.py`: noise is recovered from runs by the gradient of the filter's likelihood."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from jaxslam.calibration import fit_noise

EXAMPLE = Path(__file__).parents[2] / "examples" / "fit_noise.py"
MRCLAM = Path(__file__).parents[3] / "shared" / "data" / "mrclam1"


@pytest.fixture(scope="module")
def example():
    spec = importlib.util.spec_from_file_location("fit_noise", EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_true_noise_is_recovered_from_a_factor_five_off(example):
    """Within two standard errors each, and one of them all together."""
    start = example.TRUE * example.OFF
    assert set(np.round(np.abs(np.log(start / example.TRUE)), 6)) == {round(np.log(5), 6)}
    info = example.simulated(runs=4, steps=120, seed=1)
    found = fit_noise(info, start, names=example.SIMULATED)
    error = found.error / found.parameters
    z = np.log(found.parameters / example.TRUE) / error
    assert np.all(np.abs(z) < 2), z
    assert np.sqrt(np.mean(z**2)) < 1.5
    assert np.all(error < 0.1)  # and they say something
    assert found.converged
    assert found.log_likelihood[1] > found.log_likelihood[0] + 100
    text = example.table(found, example.TRUE, "true")
    assert all(name in text for name in example.SIMULATED)


@pytest.mark.sweep
@pytest.mark.skipif(not MRCLAM.is_dir(), reason="no ../shared/data/mrclam1")
def test_a_robots_own_noise_is_fitted(example):
    """On the first rows of a real log: uphill, to an optimum, and to a likelier noise."""
    data = example.mrclam(MRCLAM, 1)
    assert data.log.control.shape[0] > 2000
    start = np.array([0.01, 0.05, *np.sqrt(np.diag(data.sensor.noise_cov(np.zeros(2))))])
    found = fit_noise(example.recorded(data, 2000), start * example.OFF)
    assert found.converged
    assert np.all(np.isfinite(found.error)) and np.all(found.parameters > 0)
    assert found.log_likelihood[1] > found.log_likelihood[0]


@pytest.mark.parametrize(
    "arguments", [["--runs", "0"], ["--steps", "-1"], ["--mrclam", "no such folder"]]
)
def test_bad_input_is_refused(example, arguments, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["fit_noise", *arguments])
    assert example.main() == 2
    assert capsys.readouterr().err.startswith("fit_noise: ")
