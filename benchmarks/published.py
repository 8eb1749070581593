"""Published consistency experiments: UKF-M's circle, a car among landmarks, a robot at rest.

`circle`: UKF-M's program printed one average over 100 runs for each measure. From the spread
between our runs follows the central 99 % of such averages; a published figure outside it is a
disagreement. NEES is not divided by its dof; UKF-M divides the position's by 2.

`webmap` (Bailey et al. 2006): the map is ours, in the style of theirs; what is reproduced is the
course. The standard EKF is consistent at first and grows optimistic with the heading's uncertainty,
the ideal EKF stays consistent.

`stationary` (Julier & Uhlmann 2001): a robot that stands still and measures one landmark has a
heading σ of 5° and nothing to learn it from. What a filter learns is what its own linearized system
gains along a turn of the whole frame, over the prior's information.
"""

import math

import jax
import numpy as np

from benchmarks.gate import Metric
from jaxslam import Scenario
from jaxslam.catalog import FILTERS
from jaxslam.consistency import Average
from jaxslam.consistency.campaign import Campaign, monte_carlo
from jaxslam.math.stats import normal_quantile, t_quantile
from jaxslam.simulation import scenarios

PUBLISHED_RUNS = 100
LOOPS = 3
"""of the car"""
PRIOR = math.radians(5.0)
"""σ of the heading of the robot at rest, at the start [rad]"""
NOTHING = 1e-6
"""of the prior's information"""
HONEST = ("ideal", "fej", "oc", "right_invariant", "ukf_right")


def campaign_of(scenario: Scenario, names, runs: int, watch: bool = False) -> Campaign:
    """A campaign of filters of the catalog, with its table printed."""
    filters = {name: FILTERS[name](scenario, watch=watch) for name in names}
    campaign = monte_carlo(scenario, filters, runs, jax.random.key(0))
    print(campaign, flush=True)
    return campaign


def circle(quick: bool = False) -> list[Metric]:
    """A metric for each published figure, whose gate is ours."""
    scenario, runs = scenarios.circle(), 200 if quick else 1000
    campaign = campaign_of(scenario, scenario.published, runs)
    metrics = []
    for name, figures in scenario.published.items():
        for key, published in figures.items():
            ours = campaign.filters[name].measures[key]
            note = f"ours {ours.value:.4g}; central 99 % of 100-run averages"
            ends = central(key, ours, runs)
            metrics.append(Metric(f"circle {name} {key}, published", published, *ends, note))
    return metrics


def central(key: str, found: Average, runs: int) -> tuple[float, float]:
    """The central 99 % of averages over PUBLISHED_RUNS runs, from the interval over `runs`."""
    # The interval of a root mean square is that of the mean square, where averages live.
    power = 2 if key.startswith("rmse") else 1
    value, low, high = np.power([max(x, 0.0) for x in found], power)
    of_all = (high - low) / (2 * t_quantile(0.975, runs - 1))
    spread = normal_quantile(0.995) * of_all * np.sqrt(runs / PUBLISHED_RUNS)
    low, high = np.power([max(value - spread, 0.0), value + spread], 1 / power)
    return float(low), float(high)


def webmap(quick: bool = False) -> list[Metric]:
    """The ideal EKF is honest, the EKF less so; prints the NEES of each loop."""
    world = scenarios.webmap(loops=LOOPS)
    campaign = campaign_of(world, ("ekf", "ideal", "right_invariant"), 10 if quick else 100)
    for name, summary in campaign.filters.items():
        parts = np.array_split(summary.curves["nees_pose"], LOOPS)
        print(f"{name}, NEES by loop: " + ", ".join(f"{np.nanmean(part):.2f}" for part in parts))
    ideal, ekf = (campaign.filters[n].measures["nees_pose"].value for n in ("ideal", "ekf"))
    return [
        Metric("webmap, ideal EKF, pose NEES", ideal, 2.4, 3.6),
        Metric("webmap, EKF over ideal, pose NEES", ekf / ideal, low=1.0),
    ]


def stationary(quick: bool = False) -> list[Metric]:
    """What each filter learns of the heading."""
    campaign = campaign_of(scenarios.stationary(), FILTERS, 20 if quick else 200, watch=True)
    metrics = []
    for name, summary in campaign.filters.items():
        learnt = summary.measures["rotation_information"].value * PRIOR**2
        gate = {"high": NOTHING} if name in HONEST else {"low": 1e-3}
        metrics.append(Metric(f"stationary, {name}, learnt of the heading / prior", learnt, **gate))
    return metrics
