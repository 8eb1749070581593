"""Campaigns and runs made up for drawing: no filter runs."""

import dataclasses

import numpy as np

from jaxslam.consistency import Average, Summary, _measures, _run_scores
from jaxslam.consistency.campaign import Campaign
from jaxslam.core.types import Estimate, Truth

STEPS, RUNS = 200, 32
DOF, LEVELS, LAGS = _measures.nees.DOF, _measures.coverage.LEVELS, _run_scores.LAGS
"""The blocks of NEES, the levels of coverage and the lags of innovations that a `Summary` has."""
LANDMARKS = np.array([[4.0, 1.0], [0.0, 5.0], [-4.0, 0.0]])
SLOW = {"fastslam1": 2e3, "dead_reckoning": 2.0}
WORSE = {"fastslam1": 1e27, "fastslam2": 1e3, "ekf": 4.0, "seif": 12.0, "iterated": 3.8}
FARTHER = {"dead_reckoning": 40.0, "localization": 0.1}


def summary(name, seed=0, steps=STEPS):
    """A filter whose NEES grows to WORSE times dof and whose errors are FARTHER times 1 m."""
    rng = np.random.default_rng(seed)
    grows = np.linspace(0, 1, steps) if steps > 1 else np.ones(1)
    worse, far = WORSE.get(name, 1.1), FARTHER.get(name, 1.0 + 0.05 * seed)
    reckons = name == "dead_reckoning"
    curves = {}
    for block, dof in DOF.items():
        noise = rng.chisquare(RUNS * dof, steps) / RUNS
        curves[f"nees_{block}"] = noise * np.exp(np.log(worse) * grows)
        curves[f"nees_{block}_low"] = np.full(steps, 0.7 * dof)
        curves[f"nees_{block}_high"] = np.full(steps, 1.3 * dof)
    curves |= {"rmse_position": far * grows, "rmse_heading_deg": 2 * far * grows}
    curves |= {"bound_position": 0.8 * grows, "bound_heading_deg": 1.6 * grows}
    if name not in ("dead_reckoning", "localization", "fastslam1", "fastslam2"):
        gained = 50 * grows if worse > 1.1 else np.zeros(steps)
        curves["rotation_information"] = gained
    values = {"nees_pose": 3 * worse, "rmse_position": 0.5 * far}
    return Summary(
        verdict="optimistic" if worse > 1.3 else "consistent",
        measures={key: Average(value, 0.8 * value, np.inf) for key, value in values.items()},
        nis_band=None,
        inside={},
        curves=curves,
        coverage={block: np.asarray(LEVELS) ** worse for block in DOF},
        autocorrelation=np.full(LAGS, np.nan) if reckons else rng.normal(0, 0.01, LAGS),
        autocorrelation_band=np.full(LAGS, np.inf if reckons else 0.02),
        counts={"runs": RUNS, "fused": 0 if reckons else 900},
        per_run={},
        not_finite_runs=[],
    )


def run_of(name, steps=STEPS):
    """(truth, estimate) of a drive round a circle: off to the right by FARTHER times 0.1 m."""
    turn = np.linspace(0, 2 * np.pi, steps)
    pose = np.stack([2 * np.cos(turn), 2 * np.sin(turn), turn], axis=1)
    off = pose + np.array([0.1, 0.0, 0.0]) * FARTHER.get(name, 1.0)
    alive = name not in ("dead_reckoning", "localization")
    estimate = Estimate(
        pose=off,
        pose_cov=np.tile(np.diag([0.01, 0.01, 0.001]), (steps, 1, 1)),
        points=np.tile(LANDMARKS + 0.1, (steps, 1, 1)),
        point_covs=np.tile(0.02 * np.eye(2), (steps, len(LANDMARKS), 1, 1)),
        alive=np.full((steps, len(LANDMARKS)), alive),
        tag=np.tile(np.arange(len(LANDMARKS)), (steps, 1)),
    )
    return Truth(pose, LANDMARKS, np.zeros((steps, 1), bool), pose[0]), estimate


def campaign(names, steps=STEPS, **changes):
    """A campaign of made-up filters by these names, with run 0 of each."""
    names = list(names)
    fields = {field.name: 0 for field in dataclasses.fields(Campaign)}
    fields |= {"scenario": "cloister", "steps": steps, "runs": RUNS}
    fields["filters"] = {name: summary(name, i, steps) for i, name in enumerate(names)}
    fields["step_seconds"] = {name: 1e-6 * SLOW.get(name, 90.0 + 2 * len(name)) for name in names}
    fields["first"] = {name: run_of(name, steps) for name in names}
    fields |= {"run_seconds": {}, "notes": (), "reference": ""}
    return Campaign(**(fields | changes))
