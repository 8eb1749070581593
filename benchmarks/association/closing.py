"""A long loop with a large drift: who finds the first landmarks again, who takes others for them.

A robot drives round a ring of 72 random landmarks, 60 m across, and a third of a round more. By the
end of the round it is off by metres, more than the landmarks are apart.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import jaxslam
from jaxslam import Scenario, association, charts, motion, sensors, simulate
from jaxslam.consistency._measures.associations import identities
from jaxslam.core.types import Status
from jaxslam.filters import Closing, EkfSlam, LoopSettings
from jaxslam.life import Recency
from jaxslam.math.angles import wrap
from jaxslam.results.plot import COLORS, INK, PAGE, SHADE, caption, panels_of, titled
from jaxslam.simulation.scenarios import BetweenRanges
from jaxslam.simulation.spurious import Spurious

RUNS, BLOCK = 50, 10
RADIUS, COUNT, CAPACITY = 30.0, 72, 120
ROUND, MORE, STEP = 240, 80, 2 * np.pi * RADIUS / 240
GATE = 0.99
SEARCH = LoopSettings(window=30, cluster=10, sightings=2, least=5, candidates=32)
SHOWN = 5
"""the run of the figure"""


def world(seed=0):
    """Landmarks 1.5 to 7 m inside or outside the path, no two closer than 2 m."""
    draw, points = np.random.default_rng(seed), []
    while len(points) < COUNT:
        around, side = draw.uniform(0, 2 * np.pi), draw.choice([-1.0, 1.0])
        radius = RADIUS + side * draw.uniform(1.5, 7.0)
        point = np.array([radius * np.sin(around), RADIUS - radius * np.cos(around)])
        if all(np.hypot(*(point - other)) > 2.0 for other in points):
            points.append(point)
    points = np.asarray(points)
    heading = 2 * np.pi * np.arange(ROUND) / ROUND
    path = RADIUS * np.stack([np.sin(heading), 1 - np.cos(heading)], axis=1)
    places = int((np.hypot(*(path[:, None] - points).transpose(2, 0, 1)) < 9.5).sum(axis=1).max())
    return Scenario(
        name="closing",
        motion=motion.Increment(np.diag([0.08, np.deg2rad(1.0)]) ** 2),
        sensor=sensors.RelativePosition(0.1**2 * np.eye(2)),
        landmarks=points,
        controls=np.tile([STEP, 2 * np.pi / ROUND], (ROUND + MORE, 1)),
        visible=BetweenRanges(0.5, 9.0),
        places=places,
        spurious=Spurious(),
    )


def methods(scenario):
    """By name, all in the right-invariant chart, whose covariance is honest about the heading."""
    make = partial(
        EkfSlam,
        scenario.motion,
        scenario.sensor,
        CAPACITY,
        chart=charts.RightInvariant(),
        correction="joint",
    )
    near = association.Certain(association.Nearest(GATE), 0.6)
    return {
        "known": make(),
        "nearest": make(associate=association.Nearest(GATE)),
        "joint": make(associate=association.JointCompatibility(0.99, budget=500)),
        "cluster": Closing(
            make(associate=near, life=Recency()), period=4, reach=2.0, settings=SEARCH
        ),
    }


def one(scenario, filter, key):
    """Figures of one run: what of the second round is right, and the pose at the end."""
    truth, log = simulate(scenario, key)
    trace = jaxslam.run(filter, log, scenario.pose, scenario.pose_cov, key)
    info, held = trace.info, identities(trace, truth.origin)
    before = jnp.pad(held[:-1], [(1, 0), (0, 0)], constant_values=-1)
    mine = jnp.take_along_axis(before, jnp.maximum(info.slot, 0), axis=1)
    fused = info.status == Status.FUSED
    second = jnp.arange(scenario.steps)[:, None] >= ROUND
    # First landmarks: of the first third of the round, measured again in the second round.
    tags = jnp.arange(COUNT)
    was = (truth.origin[: ROUND // 3, :, None] == tags).any(axis=(0, 1))
    again = second[..., None] & (truth.origin[..., None] == tags)
    first = was & again.any(axis=(0, 1))
    # Found again: in the end the landmark has one slot, born in the first third, and measurements
    # of the second round have gone to it.
    last = held[-1]
    slots = (last[:, None] == tags[None]) & trace.estimate.alive[-1][:, None]
    early = (held[ROUND // 3][:, None] == tags[None]) & slots
    right = (again & (fused & (mine == truth.origin))[..., None]).any(axis=(0, 1))
    found = first & (slots.sum(axis=0) == 1) & early.any(axis=0) & right
    error = trace.estimate.pose[-1] - truth.pose[-1]
    error = error.at[2].set(wrap(error[2]))
    nees = error @ jnp.linalg.solve(trace.estimate.pose_cov[-1], error)
    drift = trace.estimate.pose[ROUND - 1, :2] - truth.pose[ROUND - 1, :2]
    out = {
        "first": first.sum(),
        "found": found.sum(),
        "fused": (fused & second).sum(),
        "wrong": (fused & second & (mine != truth.origin)).sum(),
        "error": (error[:2] ** 2).sum(),
        "nees": nees,
        "drift": (drift**2).sum(),
    }
    picture = trace.estimate.pose[:, :2], truth.pose[:, :2], trace.estimate.points[-1]
    return out, (*picture, trace.estimate.alive[-1])


def measure():
    """{method: figures}, and what the runs looked like."""
    scenario, table, pictures = world(), {}, {}
    keys = jax.random.split(jax.random.key(0), RUNS)
    for name, filter in methods(scenario).items():
        go = jax.jit(jax.vmap(partial(one, scenario, filter)))
        parts = [jax.device_get(go(keys[i : i + BLOCK])) for i in range(0, RUNS, BLOCK)]
        each, pictures[name] = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
        total = {key: value.sum() for key, value in each.items()}
        table[name] = {
            "re-found [%]": 100 * total["found"] / total["first"],
            "wrong [%]": 100 * total["wrong"] / max(total["fused"], 1),
            "RMSE [m]": np.sqrt(each["error"].mean()),
            "median NEES": float(np.median(each["nees"])),
            "drift [m]": np.sqrt(each["drift"].mean()),
        }
    return table, pictures


def draw(pictures, run):
    """One run, a panel a method: the true path, the estimated one, and the final map."""
    figure, panels = panels_of(PAGE, 2.5, 1, len(pictures), share=(True, True))
    blue, red, *_ = COLORS
    true_map = world().landmarks
    for axes, (name, (path, true, points, alive)) in zip(panels, pictures.items(), strict=True):
        axes.plot(*true[run].T, color=SHADE, lw=2.2, label="true path")
        axes.plot(*true_map.T, "x", color=INK, ms=2.5, mew=0.6, label="true landmarks")
        axes.plot(*path[run].T, color=blue, lw=0.9, label="estimated path, as it was driven")
        axes.plot(*points[run][alive[run]].T, ".", color=red, ms=3, label="map at the end")
        axes.plot(*path[run][-1], "o", mfc="none", color=blue, ms=6, label="end")
        axes.set(xlabel="x [m]", aspect="equal")
        titled(axes, name)
    panels[0].set(ylabel="y [m]")
    caption(figure, "")
    return figure
