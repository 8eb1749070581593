"""Bearings alone: a prior on the range, or on its inverse (Solà 2.3.5, 2.3.6).

`cloister` and `circle` with a camera instead of their sensors: the same worlds, one bearing of 1° a
landmark. Filters on the same draws:

- `naive`: landmarks (x, y) from a Gaussian prior of the range, an EKF;
- `inverse_depth`: rays from the first sighting with the customary prior of the inverse distance,
  1/2 ± 1/4 of 1/d_min, d_min = 1 m, an EKF;
- `rays_invariant`: the same in the right-invariant chart of rays, with sigma points and rays that
  become points at a linearity index of 0.1;
- `rays_matched`: that with the prior 1/4 ± 1/4 1/m, as the inverse distances of these worlds are:
  0.31 ± 0.24 in `cloister`, 0.2 at the first sight of most in `circle`. Prior and world must agree:
  36 landmarks that are twice as far as the prior expects are 36 wrong votes on one scale.

The yardstick is 3, the pose NEES of an honest filter; the contract is its 95 % band over so many
runs and 30 % more, for the customary prior. (Jacobians at the truth make no ideal filter of the
naive one: its estimate starts metres off, where they are not those of its own innovations.)

`linearity` draws why: a landmark is seen first from the origin, straight ahead, with a Gaussian on
the guide's interval of inverse distance, 0 to 1/d_min (Solà (47)): 1/(2 d_min) ± 1/(4 d_min), or
the same as a range, to first order. How far does the second bearing, from a robot that went a
baseline sideways, bend within 3 σ of that prior?
"""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.gate import Metric, save
from jaxslam import monte_carlo, sensors
from jaxslam.charts import RightInvariant
from jaxslam.filters import EkfSlam
from jaxslam.linearize import Unscented
from jaxslam.math.stats import chi2_band
from jaxslam.results.plot import COLUMN, INK, TEXT, caption, look, panels_of
from jaxslam.simulation.scenarios import circle, cloister
from jaxslam.verify.linearity import sensor_linearity

SIGMA = np.deg2rad(1.0)
# The range 5 m ± 2.5 m, and the inverse distance from d_min = 1 m: both hold all distances that
# occur, 1 to 7 m.
RANGE = (np.array([5.0]), np.array([[2.5**2]]))
MIN_DISTANCE = 1.0
MATCHED = ((0.25,), ((0.25**2,),))
TO_POINT = 0.1
RHO, RHO_SIGMA = 0.5 / MIN_DISTANCE, 0.25 / MIN_DISTANCE


def worlds():
    cov = np.array([[SIGMA**2]])
    camera = sensors.BearingOnly(cov, free=RANGE)
    rays = sensors.BearingInverseDepth(cov, min_distance=MIN_DISTANCE)
    to_points = sensors.BearingInverseDepth(cov, min_distance=MIN_DISTANCE, to_point=TO_POINT)
    matched = sensors.BearingInverseDepth(cov, inverse_distance=MATCHED, to_point=TO_POINT)
    for world in (cloister(), circle()):
        scenario = dataclasses.replace(
            world, name=f"{world.name}, bearings", sensor=camera, filter_options={}, published={}
        )
        ekf = partial(
            EkfSlam, scenario.motion, capacity=len(scenario.landmarks), correction="joint"
        )
        better = {"chart": RightInvariant(rays=True), "linearize": Unscented()}
        filters = {
            "naive": ekf(camera),
            "inverse_depth": ekf(rays),
            "rays_invariant": ekf(to_points, **better),
            "rays_matched": ekf(matched, **better),
        }
        yield scenario, filters


def measure(quick: bool = False) -> list[Metric]:
    metrics, runs = [], 20 if quick else 100
    for scenario, filters in worlds():
        campaign = monte_carlo(scenario, filters, runs, jax.random.key(0))
        print(campaign, flush=True)
        nees = campaign.filters["rays_invariant"].measures["nees_pose"].value
        lost = campaign.filters["naive"].counts["divergent"] / runs
        high = 1.3 * chi2_band(3, runs)[1]
        metrics.append(Metric(f"{scenario.name}: rays_invariant, pose NEES", nees, high=high))
        metrics.append(Metric(f"{scenario.name}: naive, share divergent", lost, low=0.1))
    return metrics


def indices(sensor, landmark, column: int, sigma: float, baselines):
    """By the Hessian and by sampling, (B,) each, with one uncertain coordinate of the landmark."""
    cov = np.zeros((3 + len(landmark), 3 + len(landmark)))
    cov[3 + column, 3 + column] = sigma**2

    def one(baseline):
        pose = jnp.stack([0.0, baseline, 0.0])
        return sensor_linearity(sensor, pose, landmark, cov)

    out = jax.jit(jax.vmap(one))(baselines)
    return np.asarray(out.hessian), np.asarray(out.sampled)


def linearity(quick: bool = False) -> list[Metric]:
    """Draw the linearity index; no metrics."""
    shares = np.geomspace(0.01, 3, 60)
    by_range = sensors.BearingOnly([[1e-4]])
    rays = sensors.BearingInverseDepth([[1e-4]], min_distance=MIN_DISTANCE)
    ask = partial(indices, baselines=shares * MIN_DISTANCE)
    curves = {
        "range d": ask(by_range, np.array([1 / RHO, 0.0]), 0, RHO_SIGMA / RHO**2),
        "inverse depth ρ": ask(rays, np.array([0.0, 0.0, 0.0, RHO]), 3, RHO_SIGMA),
    }
    figure, (axes,) = panels_of(COLUMN, 2.6, 1)
    for i, (name, (hessian, sampled)) in enumerate(curves.items()):
        line = look(i)
        axes.loglog(shares, hessian, color=line["color"], ls=line["ls"], label=f"{name}, Hessian")
        line["ls"] = "none"
        axes.loglog(shares[::4], sampled[::4], ms=3.6, label=f"{name}, sampled", **line)
    axes.axhline(1.0, color=INK, lw=0.8)
    axes.text(shares[0], 0.8, "above: bends farther than it rises", fontsize=TEXT, va="top")
    axes.set_xlabel("baseline / nearest distance")
    caption(figure, "Linearity index of the bearing (3 σ)")
    save(figure, "linearity")
    return []
