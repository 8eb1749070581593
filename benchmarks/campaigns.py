"""The campaigns that README and the pages quote.

Each is `jaxslam consistency` with the scenario, the filters and the seed that are printed above its
table.
"""

import jax

from benchmarks.gate import Metric
from jaxslam import catalog, monte_carlo
from jaxslam.simulation.scenarios import SCENARIOS

CAMPAIGNS = (
    ("circle", ("ekf", "right_invariant", "ideal"), 0),
    ("circle", ("fixed_lag", "fixed_lag_fej"), 0),
    ("square_lines", ("ekf", "ideal"), 1),
    ("office_lines", ("ekf", "ideal"), 1),
)
"""Scenario, filters by their names in the catalog, seed"""


def measure(quick: bool = False) -> list[Metric]:
    """Prints the table of each campaign; the pose NEES of its filters."""
    metrics, runs = [], 10 if quick else 100
    for scenario, names, seed in CAMPAIGNS:
        world = SCENARIOS[scenario]()
        filters = {name: catalog.ALL[name](world, watch=True) for name in names}
        campaign = monte_carlo(world, filters, runs, jax.random.key(seed), progress=False)
        print(f"--scenario {scenario} --filters {','.join(names)} --runs {runs} --seed {seed}")
        print(campaign, end="\n\n")
        metrics += [
            Metric(f"{scenario}: {name}, pose NEES", summary.measures["nees_pose"].value)
            for name, summary in campaign.filters.items()
        ]
    return metrics
