"""Size and power of the verdict.

An exactly linear SLAM problem: the errors of a planar robot (x, y, θ) and of landmarks about a
known path, whose motion and relative-position measurements are linear in them, with or without a
compass. The Kalman filter of it is honest, so what `judge` rejects of it is a false alarm; one told
of other noises than there are is not, and should be noticed. The covariances do not depend on what
is measured, so gains are computed once and all runs of all campaigns are products of matrices.
"""

from typing import NamedTuple

import numpy as np

from benchmarks.gate import Metric
from jaxslam.consistency import Verdict, judge

SIZES = (8, 20, 100)
"""runs of a campaign"""

TURN = np.array([[0.0, -1.0], [1.0, 0.0]])


class Problem(NamedTuple):
    """Errors e_t = F_t e_{t-1} + G_t w_t, w ~ N(0, Q), seen as z_t = H_t e_t + v_t, v ~ N(0, R).

    The first three are those of the pose, which starts without any.
    """

    f: np.ndarray
    """(T, n, n)"""
    g: np.ndarray
    """(T, n, 3)"""
    h: np.ndarray
    """(T, m, n)"""
    q: np.ndarray
    """(3,) standard deviations"""
    r: np.ndarray
    """(m,) standard deviations"""
    start: np.ndarray
    """(n,) standard deviations"""


def problem(compass: bool, steps: int = 30, landmarks: int = 4) -> Problem:
    """A quarter of a circle of 3 m; σ_w = (2 cm, 2 cm, 0.01) a step, σ_z = 10 cm, compass 0.02."""
    rng = np.random.default_rng(0)
    angle = 0.5 * np.pi * np.arange(steps + 1) / steps
    path = 3 * np.stack([np.sin(angle), 1 - np.cos(angle)], axis=1)
    points = rng.uniform(-4, 4, (landmarks, 2)) + [0, 3]
    n = 3 + 2 * landmarks
    f, g = np.tile(np.eye(n), (steps, 1, 1)), np.zeros((steps, n, 3))
    h = np.zeros((steps, 2 * landmarks + compass, n))
    for t in range(steps):
        rows = _rotation(angle[t + 1]).T
        f[t, :2, 2] = TURN @ (path[t + 1] - path[t])
        g[t, :2, :2], g[t, 2, 2] = _rotation(angle[t]), 1
        for i in range(landmarks):
            h[t, 2 * i : 2 * i + 2, :2] = -rows
            h[t, 2 * i : 2 * i + 2, 2] = -rows @ TURN @ (points[i] - path[t + 1])
            h[t, 2 * i : 2 * i + 2, 3 + 2 * i : 5 + 2 * i] = rows
        h[t, 2 * landmarks :, 2] = 1
    r = np.array([0.1] * 2 * landmarks + [0.02] * compass)
    start = np.concatenate([np.zeros(3), np.ones(2 * landmarks)])
    return Problem(f, g, h, np.array([0.02, 0.02, 0.01]), r, start)


def averages(
    world: Problem, runs: int, seed: int, claimed_q: float = 1.0, claimed_r: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """(runs,) each run's average pose NEES, and its NIS/dof.

    claimed: by what the filter multiplies the true covariances of motion and measurement.
    """
    rng = np.random.default_rng(seed)
    cov = np.diag(world.start**2)
    error = rng.standard_normal((runs, len(cov))) * world.start
    nees, nis = np.zeros((2, runs))
    for f, g, h in zip(world.f, world.g, world.h, strict=True):
        cov = f @ cov @ f.T + claimed_q * (g * world.q**2) @ g.T
        s = h @ cov @ h.T + claimed_r * np.diag(world.r**2)
        gain = np.linalg.solve(s, h @ cov).T
        cov = cov - gain @ s @ gain.T
        error = error @ f.T + (rng.standard_normal((runs, 3)) * world.q) @ g.T
        innovation = error @ h.T + rng.standard_normal((runs, len(s))) * world.r
        error = error - innovation @ gain.T
        nees += _squares(error[:, :3], cov[:3, :3])
        nis += _squares(innovation, s)
    steps, size = world.h.shape[:2]
    return nees / steps, nis / (steps * size)


def verdicts(nees: np.ndarray, nis: np.ndarray | None, runs: int) -> list[Verdict]:
    """Those on campaigns of so many runs, as many as the averages make; nis: None is absent."""
    counts = {"runs": runs, "not_finite": 0, "divergent": 0}
    out = []
    for i in range(0, len(nees) - runs + 1, runs):
        each = {"nees_pose": nees[i : i + runs]}
        out.append(
            judge(each if nis is None else each | {"nis_per_dof": nis[i : i + runs]}, counts)
        )
    return out


def rejected(found: list[Verdict], by: str = "") -> float:
    """The share that was rejected, by either test or by the one named."""
    return float(np.mean([by in v.by if by else bool(v.by) for v in found]))


def measure(quick: bool = False) -> list[Metric]:
    """False alarms are to be 5 ± 1 %, of the NEES alone 2.5 ± 1 %, and two standard errors of a
    share among so many are granted; an R that is understated by 20 % is to be noticed."""
    metrics, campaigns = [], 1000 if quick else 4000
    slack = 2 * np.sqrt(0.05 * 0.95 / campaigns)
    ends = 0.04 - slack, 0.06 + slack, "5 ± 1 %"
    of_one = 0.015 - slack, 0.035 + slack, "2.5 ± 1 %"

    def power(compass: bool, landmarks: int, seed: int) -> float:
        world = problem(compass, landmarks=landmarks)
        return rejected(verdicts(*averages(world, campaigns * 5, seed, claimed_r=0.8), 20))

    for compass in (False, True):
        said = f"{'with' if compass else 'without'} a compass"
        honest = averages(problem(compass), campaigns * max(SIZES), 1)
        for runs in SIZES:
            nees, nis = (each[: campaigns * runs] for each in honest)
            for tests, given in (("", nis), (", NEES alone", None)):
                alarms = rejected(verdicts(nees, given, runs))
                name = f"false alarms, {said}, {runs} runs{tests}"
                metrics.append(Metric(name, alarms, *(ends if given is not None else of_one)))
        what = f"R understated by 20 %, {said}, 20 runs, noticed"
        metrics.append(Metric(what, power(compass, 4, 2), 0.9))
    what = "R understated by 20 %, one landmark, noticed"
    return [*metrics, Metric(what, power(False, 1, 3), 0.9)]


def _rotation(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


def _squares(error: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """(runs,) eᵀ P⁻¹ e."""
    return ((error @ np.linalg.inv(np.linalg.cholesky(cov)).T) ** 2).sum(axis=1)
