"""The published `circle` figures against ours: `python -m benchmarks.circle [--runs 1000]`.

UKF-M's program printed one average over 100 runs for each measure. From the spread between our runs
follows the central 99 % of such averages; a published figure outside it would be a disagreement.
"""

import argparse

import jax
import numpy as np

from benchmarks.gate import Metric, report
from jaxslam.monte_carlo import monte_carlo
from jaxslam.scenarios import FILTERS, circle
from jaxslam.stats import t_quantile

PUBLISHED_RUNS = 100
NORMAL_99 = 2.5758


def main() -> list[Metric]:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    return measure(options.runs, options.seed)


def measure(runs: int = 1000, seed: int = 0) -> list[Metric]:
    scenario = circle()
    campaign = monte_carlo(scenario, {"ekf": FILTERS["ekf"](scenario)}, runs, jax.random.key(seed))
    found = campaign.filters["ekf"].measures
    print(
        f"circle, EKF, {runs} runs × {campaign.steps} steps, seed {seed}, {campaign.seconds:.0f} s"
    )
    metrics = []
    for name, published in scenario.published.items():
        # The interval of a root mean square is that of the mean square, where averages live.
        power = 2 if name.startswith("rmse") else 1
        value, low, high = np.power([max(x, 0.0) for x in found[name]], power)
        of_all = (high - low) / (2 * t_quantile(0.975, runs - 1))
        spread = NORMAL_99 * of_all * np.sqrt(runs / PUBLISHED_RUNS)
        edges = np.power([max(value - spread, 0.0), value + spread], 1 / power)
        metrics.append(
            Metric(
                name=f"circle {name}, published",
                value=published,
                low=float(edges[0]),
                high=float(edges[1]),
                note=f"ours {found[name].value:.4g}; central 99 % of {PUBLISHED_RUNS}-run averages",
            )
        )
    return metrics


if __name__ == "__main__":
    raise SystemExit(report(main()))
