"""The filter against the plain NumPy reference, mean and covariance at every step, to 1e-9."""

import dataclasses
import functools

import jax
import numpy as np
import pytest
import scipy.stats
from cases import swept
from reference import ekf_slam as plain
from worlds import draw

from jaxslam import run, sensors
from jaxslam.core.types import Status
from jaxslam.filters import EkfSlam
from jaxslam.simulation.scenarios import circle, cloister

MODELS = {
    "cloister": {
        "motion": plain.increment,
        "observe": plain.range_bearing,
        "invert": plain.range_bearing_inverse,
        "Q": np.diag([0.01, 0.02]) ** 2,
        "R": np.diag([0.1, np.deg2rad(1.0)]) ** 2,
        "bearing": 1,
    },
    "circle": {
        "motion": plain.unicycle,
        "observe": plain.relative_position,
        "invert": plain.relative_position_inverse,
        "Q": np.diag([0.05 * 0.25 / np.sqrt(2), 0.05 * 0.25 * 2 * np.sqrt(2)]) ** 2,
        "R": 0.1**2 * np.eye(2),
    },
}
MODELS["growing"] = MODELS["cloister"] | {
    "R": lambda z: np.diag([0.05**2 + (0.1 * z[0]) ** 2, 0.01**2 + 0.02**2 / (z[0] ** 2 + 0.02**2)])
}


def scans_of(log):
    """Per step the valid (tag, z), in the order of their places."""
    z, tag, valid = (np.asarray(part) for part in log.scan)
    return [
        [(int(tag[t, i]), z[t, i]) for i in np.flatnonzero(valid[t])] for t in range(len(valid))
    ]


def assert_equal_at_every_step(states, steps):
    """states: Joint with leading T; steps: the reference's (x, P, tags), T of them."""
    pose, landmarks, cov, alive, tag = (np.asarray(part) for part in states[:5])
    assert len(steps) == len(pose)
    largest = 0
    for t, (x, p, tags) in enumerate(steps):
        slot_of = {int(g): i for i, g in enumerate(tag[t]) if alive[t, i]}
        assert set(slot_of) == set(tags), f"step {t}"
        slots = [slot_of[g] for g in tags]
        rows = np.array([0, 1, 2] + [3 + 2 * i + k for i in slots for k in (0, 1)])
        mean = np.concatenate([pose[t], landmarks[t][slots].ravel()])
        error = mean - x
        error[2] = plain.wrap(error[2])
        np.testing.assert_allclose(error, 0, atol=1e-9, err_msg=f"mean at step {t}")
        own = cov[t][np.ix_(rows, rows)]
        np.testing.assert_allclose(own, p, rtol=0, atol=1e-9, err_msg=f"covariance at step {t}")
        largest = max(largest, np.abs(p).max())
    assert largest > 1e-4  # 1e-9 is small beside what is compared


def growing(steps):
    """The cloister with noise that depends on the range."""
    noise = sensors.RangeBearingNoise(0.05, 0.01, share=0.1, across=0.02)
    return dataclasses.replace(
        cloister(steps), name="growing", sensor=sensors.RangeBearing(noise), filter_options={}
    )


CASES = {
    "cloister": (cloister(60), {"correction": "sequential", "gate": 0.99, "births": 1}),
    "circle": (circle(150), {"correction": "joint"}),
    "cloister joint with gate": (
        dataclasses.replace(cloister(60), noise_on="odometry"),
        {"correction": "joint", "gate": 0.9, "births": 3},
    ),
    "growing": (growing(60), {"correction": "sequential", "gate": 0.95, "births": 1}),
    "growing joint": (growing(60), {"correction": "joint", "gate": 0.95, "births": 3}),
}


@functools.cache
def filtered(case):
    """Log and trace."""
    scenario, options = CASES[case]
    size = len(scenario.landmarks)
    filter = EkfSlam(scenario.motion, scenario.sensor, size, **options)
    _, log = draw(scenario, 0)
    start = scenario.pose, scenario.pose_cov, jax.random.key(0)
    return log, jax.device_get(run(filter, log, *start, probe=lambda state: state))


def reference(case, log, steps=None, **changes):
    scenario, options = CASES[case]
    return plain.run(
        scenario.pose,
        scenario.pose_cov,
        np.asarray(log.control)[:steps],
        scans_of(log)[:steps],
        joint=options["correction"] == "joint",
        gate=scipy.stats.chi2.ppf(options.get("gate", 1.0), 2),
        births=options.get("births"),
        **(MODELS[scenario.name] | changes),
    )


@pytest.mark.parametrize("case", swept(CASES, "circle", "cloister joint with gate", "growing"))
def test_filter_equals_the_reference_at_every_step(case):
    log, trace = filtered(case)
    assert_equal_at_every_step(trace.probe, list(reference(case, log)))
    # The gate and the quota were put to work where there is one.
    options = CASES[case][1]
    counts = {s: int(trace.info.tally(s).sum()) for s in Status}
    assert counts[Status.FUSED] > 300
    assert (counts[Status.REJECTED] > 10) == ("gate" in options)
    assert (counts[Status.DEFERRED] > 0) == ("births" in options)
    assert counts[Status.BORN] >= 10


@pytest.mark.parametrize("what", ["Q", "R"])
def test_the_comparison_notices_one_per_cent_more_noise(what):
    log, trace = filtered("circle")
    changes = {what: 1.01 * MODELS["circle"][what]}
    states = jax.tree.map(lambda a: a[:60], trace.probe)
    with pytest.raises(AssertionError, match="at step"):
        assert_equal_at_every_step(states, list(reference("circle", log, 60, **changes)))
