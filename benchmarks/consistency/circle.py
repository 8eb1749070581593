"""UKF-M's 2-D SLAM benchmark: five filters, four measures, published and ours.

UKF-M's program printed one average over 100 runs for each measure. From the spread between our runs
follows the central 99 % of such averages; a published figure outside it is a disagreement.
"""

import jax
import numpy as np

from benchmarks.consistency.markdown import Section, table
from benchmarks.gate import Metric
from jaxslam.catalog import FILTERS
from jaxslam.consistency import Average
from jaxslam.consistency.campaign import monte_carlo
from jaxslam.math.stats import t_quantile
from jaxslam.simulation.scenarios import circle

PUBLISHED_RUNS = 100
NORMAL_99 = 2.5758
LABELS = {
    "rmse_heading_deg": "heading RMSE [°]",
    "rmse_position": "position RMSE [m]",
    "nees_heading": "heading NEES (1)",
    "nees_position": "position NEES (2)",
}


def measure(runs: int = 1000, seed: int = 0) -> tuple[Section, list[Metric]]:
    """The comparison as Markdown, and a metric with its gate for each published figure."""
    scenario = circle()
    filters = {name: FILTERS[name](scenario) for name in scenario.published}
    campaign = monte_carlo(scenario, filters, runs, jax.random.key(seed))
    rows, metrics = [], []
    for name, figures in scenario.published.items():
        found = campaign.filters[name].measures
        for key, published in figures.items():
            low, high = central(key, found[key], runs)
            metrics.append(
                Metric(
                    name=f"circle {name} {key}, published",
                    value=published,
                    low=low,
                    high=high,
                    note=f"ours {found[key].value:.4g}; central 99 % of 100-run averages",
                )
            )
            verdict = "inside" if metrics[-1].passes else "**outside**"
            error = (found[key].high - found[key].low) / (2 * t_quantile(0.975, runs - 1))
            ours = f"{found[key].value:.3f} ± {error:.2g}"
            rows.append(
                [name, LABELS[key], f"{published:.2f}", ours, f"{low:.2f} to {high:.2f}", verdict]
            )
    header = ["filter", "measure", "published", "ours ± standard error", "central 99 %", ""]
    text = (
        f"{runs:,} runs × {campaign.steps} steps, seed {seed}, {campaign.seconds:.0f} s. NEES is "
        "not divided by its dof, which is in brackets; UKF-M divides the position's by 2. The "
        f"central 99 % is that of averages over {PUBLISHED_RUNS} runs, as the published are.\n\n"
        + table(header, rows)
    )
    return Section("circle", "UKF-M's 2-D SLAM benchmark", text), metrics


def central(key: str, found: Average, runs: int) -> tuple[float, float]:
    """The central 99 % of averages over PUBLISHED_RUNS runs, from the interval over `runs`."""
    # The interval of a root mean square is that of the mean square, where averages live.
    power = 2 if key.startswith("rmse") else 1
    value, low, high = np.power([max(x, 0.0) for x in found], power)
    of_all = (high - low) / (2 * t_quantile(0.975, runs - 1))
    spread = NORMAL_99 * of_all * np.sqrt(runs / PUBLISHED_RUNS)
    low, high = np.power([max(value - spread, 0.0), value + spread], 1 / power)
    return float(low), float(high)
