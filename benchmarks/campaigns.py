"""The campaigns that README and the pages quote.

Each is `jaxslam consistency` with the scenario, the filters and the seed that are printed above its
table; every other filter is compared with the first.
"""

from dataclasses import replace

import jax

from benchmarks.gate import Metric, show
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
        chosen = f"--filters {','.join(names)} --compare {names[0]}"
        print(f"--scenario {scenario} {chosen} --runs {runs} --seed {seed}")
        print(replace(campaign, reference=names[0]), end="\n\n")
        metrics += [
            Metric(f"{scenario}: {name}, pose NEES", summary.measures["nees_pose"].value)
            for name, summary in campaign.filters.items()
        ]
        for name in names[1:]:
            pair = campaign.compare(name, names[0]).measures["rmse_position"]
            of = f"{scenario}: {name} - {names[0]}, position RMSE"
            interval = "95 % interval [{1:.3g}, {2:.3g}]".format(*pair.difference)
            metrics += [
                Metric(f"{of} [m]", pair.difference.value, note=interval),
                Metric(f"{of}: interval narrower by", pair.narrower),
            ]
    return metrics


def comparison(quick: bool = False) -> list[Metric]:
    """What a step of every estimator costs and gives, on the same draws of `cloister`.

    Wall time, to be compared within one run, position RMSE and pose NEES.
    """
    world, runs, rows = SCENARIOS["cloister"](), 8 if quick else 16, {}
    filters = {each: make(world) for each, make in catalog.ALL.items()}
    campaign = monte_carlo(world, filters, runs, jax.random.key(0), workers=1)
    for each, summary in campaign.filters.items():
        rows[each] = {
            "µs a step": f"{1e6 * campaign.step_seconds[each]:.3g}",
            "RMSE [m]": summary.measures["rmse_position"].value,
            "verdict": summary.verdict,
        }
        if "nees_pose" in summary.measures:  # a path that is given has none
            rows[each]["pose NEES"] = summary.measures["nees_pose"].value
    show(f"{world.name}, {runs} runs of {world.steps} steps", rows)
    ratio = {each: row["RMSE [m]"] / rows["ideal"]["RMSE [m]"] for each, row in rows.items()}
    what = "RMSE over the ideal EKF's"
    return [
        Metric(f"localization in the true map: {what}", ratio["localization"], high=1.0),
        Metric(f"dead reckoning: {what}", ratio["dead_reckoning"], low=1.0),
    ]
