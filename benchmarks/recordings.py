"""How often the intervals of `consistency.judge_recording` hold, in simulated recordings.

A robot drives for some minutes with changing speed, and localizes itself by an EKF in a known map;
its estimates with their covariances, and the true path as a motion capture would have it, are a
recording. The EKF is honest, so the truth of every interval is known: NEES 3, 2 and 1, coverage as
its level, factors 1, lag 0. Then σ is halved, so that the factors are 2, and the stamps of the
estimate are 50 ms late.
"""

from functools import partial
from typing import NamedTuple

import jax
import numpy as np

from benchmarks.gate import Metric, save, show
from jaxslam import run, simulate
from jaxslam.consistency import RecordingScores, judge_recording
from jaxslam.consistency.metrics._paths import transform
from jaxslam.filters import Localization
from jaxslam.motion import Unicycle
from jaxslam.results import plot
from jaxslam.sensors import RangeBearing
from jaxslam.simulation.scenarios import BetweenRanges, Scenario

INTERVAL, LAG = 0.1, 0.05
"""Time between two poses, and the lag that is to be found [s]."""

HOLDS = 0.90, 0.98
"""Gate of the share of intervals of level 95 % that hold the truth."""
RARE = 0.99
"""Upper gate of the coverage at 0.99: few independent errors of a recording lie outside, and its
interval is wider than it need be."""


class Recordings(NamedTuple):
    """R recordings of T poses."""

    pose: np.ndarray
    """(R, T, 3) estimates"""
    cov: np.ndarray
    truth: np.ndarray


def world(steps: int = 1800) -> Scenario:
    """Three minutes at 10 Hz: loops at 0 to 1 m/s among few landmarks, measured to 15 cm and 3°.

    The errors of x and y are correlated over some 3 s.
    """
    time = INTERVAL * np.arange(steps)
    v = np.maximum(0.5 + 0.6 * np.sin(2 * np.pi * time / 17), 0.0)
    omega = 0.35 + 0.3 * np.sin(2 * np.pi * time / 23)
    posts = np.meshgrid(np.arange(-15.0, 15.1, 3.0), np.arange(-6.0, 36.1, 3.0))
    return Scenario(
        name="recorded robot",
        motion=Unicycle(np.diag([0.02, 0.02]) ** 2),
        sensor=RangeBearing(np.diag([0.15, 0.05]) ** 2),
        landmarks=np.stack(posts, axis=-1).reshape(-1, 2),
        controls=np.stack([v, omega, np.full(steps, INTERVAL)], axis=1),
        pose_cov=np.diag([0.02, 0.02, 0.02]) ** 2,
        visible=BetweenRanges(0.8, 4.0),
        places=9,
    )


def recordings(world: Scenario, count: int) -> Recordings:
    """Recordings of an EKF that localizes the robot."""
    filter = Localization(world.motion, world.sensor, world.landmarks)

    def record(key: jax.Array) -> tuple[jax.Array, ...]:
        truth, log = simulate(world, key)
        estimate = run(filter, log, world.pose, world.pose_cov, key).estimate
        return estimate.pose, estimate.pose_cov, truth.pose

    batched = jax.jit(partial(jax.lax.map, record, batch_size=20))
    return Recordings(*map(np.asarray, batched(jax.random.split(jax.random.key(61), count))))


def judged(drawn: Recordings, scale: float = 1.0, lag: float = 0.0, **options: str):
    """The scores of each recording, with σ scaled and the stamps of the estimate late."""
    time = INTERVAL * np.arange(drawn.pose.shape[1])
    return [
        judge_recording((time + lag, pose, scale**2 * cov), (time, truth), **options)
        for pose, cov, truth in zip(*drawn, strict=True)
    ]


def holds(intervals, truth) -> float:
    """The share of the intervals that hold the truth, a number or a range for each."""
    low, high = np.broadcast_to(
        np.reshape(truth, (-1, 1) if np.ndim(truth) == 0 else (-1, 2)), (len(intervals), 2)
    ).T
    ends = np.array([(each.low, each.high) for each in intervals])
    return float(np.mean((ends[:, 0] <= high) & (ends[:, 1] >= low)))


def shares(scores: list[RecordingScores], factor: float, lag: float) -> dict[str, float]:
    """The shares of the intervals that hold the truth, by what they are of."""
    table = {}
    first = scores[0]
    for name in first.blocks:
        blocks = [each.blocks[name] for each in scores]
        honest = [tuple(factor**2 * end for end in block.honest) for block in blocks]
        table[f"NEES, {name}"] = holds([block.nees for block in blocks], honest)
        if factor == 1:
            for level in first.blocks[name].coverage:
                table[f"coverage at {level:g}, {name}"] = holds(
                    [block.coverage[level] for block in blocks],
                    [block.honest_coverage[level] for block in blocks],
                )
    for name in first.factors:
        table[f"factor of σ, {name}"] = holds([each.factors[name] for each in scores], factor)
    for name in first.mean:
        table[f"mean error, {name}"] = holds([each.mean[name] for each in scores], 0.0)
    table["lag"] = holds([each.lag.seconds for each in scores if each.lag], lag)
    return table


def measure(quick: bool = False) -> list[Metric]:
    count = 40 if quick else 600
    drawn = recordings(world(), count)
    sets = {
        "honest": (judged(drawn), 1.0, 0.0),
        "σ halved": (judged(drawn, 0.5), 2.0, 0.0),
        "50 ms late": (judged(drawn, lag=LAG), 1.0, LAG),
        "best": (judged(drawn._replace(truth=_moved(drawn.truth)), align="best"), 1.0, 0.0),
    }
    tables = {name: shares(*each) for name, each in sets.items()}
    rows = {
        row: {name: of[row] for name, of in tables.items() if row in of} for row in tables["honest"]
    }
    show(f"share of the 95 % intervals that hold the truth, {count} recordings", rows)
    honest, halved, late = (sets[name][0] for name in ("honest", "σ halved", "50 ms late"))
    lags = np.array([each.lag.seconds.value for each in late])
    errors = np.array([each.lag.error for each in late])
    words = {
        name: {
            word: np.mean([s.verdict == word for s in of])
            for word in ("consistent", "optimistic", "pessimistic", "undecided")
        }
        for name, (of, _, _) in sets.items()
    }
    words["50 ms late, lag removed"] = {
        word: np.mean([s.lag.verdict == word for s in late]) for word in words["honest"]
    }
    show("share of the recordings by verdict", words)
    independent = {
        name: np.median([s.blocks[name].independent for s in honest]) for name in honest[0].blocks
    }
    print(
        "independent errors, median: "
        + ", ".join(f"{name} {n:.0f}" for name, n in independent.items())
    )
    if not quick:
        title = f"an honest EKF with σ halved: {halved[0].verdict}"
        save(plot.recording_figure(halved[0], title=title), "recording")
    pooled = np.mean([s.blocks["pose"].nees.value for s in honest])
    gated = [
        "NEES, pose",
        "NEES, position",
        "NEES, heading",
        *(f"coverage at {p:g}, pose" for p in honest[0].blocks["pose"].coverage),
        *(f"factor of σ, {name}" for name in honest[0].factors),
        *(f"mean error, {name}" for name in honest[0].mean),
        "lag",
    ]
    slack = 0.05 if quick else 0.0  # 40 recordings
    low, high = HOLDS[0] - slack, min(HOLDS[1] + slack, 1.0)
    metrics = [Metric("pose NEES of all recordings, of an honest estimator 3", pooled, 2.9, 3.1)]
    metrics += [
        Metric(
            f"intervals that hold: {name}",
            tables["honest"][name],
            low,
            max(high, RARE) if name == "coverage at 0.99, pose" else high,
        )
        for name in gated
    ]
    metrics += [
        Metric(
            f"σ halved, intervals that hold 2: {name}",
            tables["σ halved"][f"factor of σ, {name}"],
            low,
            high,
        )
        for name in honest[0].factors
    ]
    return metrics + [
        Metric("lag of 50 ms: intervals that hold", tables["50 ms late"]["lag"], low, high),
        Metric("lag of 50 ms: mean [ms]", 1e3 * lags.mean(), 48.0, 52.0),
        Metric(
            "lag of 50 ms: claimed standard error / spread",
            np.sqrt(np.mean(errors**2)) / lags.std(ddof=1),
            0.8,
            1.25,
        ),
        Metric(
            "aligned best, intervals that hold: NEES, pose", tables["best"]["NEES, pose"], low, 1.0
        ),
        Metric(
            "honest, called optimistic or pessimistic",
            words["honest"]["optimistic"] + words["honest"]["pessimistic"],
            high=0.1,
        ),
        Metric("σ halved, called optimistic", words["σ halved"]["optimistic"], low=0.95),
    ]


def _moved(truth: np.ndarray) -> np.ndarray:
    """The truth in a frame elsewhere, another in each recording."""
    frames = np.random.default_rng(0).uniform(-3, 3, (len(truth), 3))
    return np.stack([transform(frame, path) for frame, path in zip(frames, truth, strict=True)])
