"""What a step of every estimator costs and gives, on the same draws of `cloister`.

Position RMSE and pose NEES of each beside the wall time of a step. `jaxslam consistency --scenario
cloister --filters all` says the same, and more. Times are for comparison within one run.
"""

import jax

from benchmarks.gate import Metric, show
from jaxslam import catalog, monte_carlo
from jaxslam.simulation.scenarios import cloister


def measure(quick: bool = False) -> list[Metric]:
    world, runs, rows = cloister(), 8 if quick else 16, {}
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
