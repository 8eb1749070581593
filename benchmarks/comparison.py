"""Every estimator of the family on the same draws: `python -m benchmarks.comparison [--runs 40]`.

What a step costs, and what it gives: position RMSE and pose NEES of each beside the wall time of a
step. `jaxslam consistency --scenario cloister --filters all` says the same, and more; this is the
figure of it, `figures/comparison.png`. Times are for comparison within one run.
"""

from pathlib import Path

import jax

from benchmarks.gate import Metric, alone
from jaxslam import catalog, monte_carlo, plot
from jaxslam.simulation.scenarios import SCENARIOS

FIGURE = Path(__file__).parent / "figures" / "comparison.png"


def measure(runs: int = 16, scenario: str = "cloister", out: Path | None = None) -> list[Metric]:
    world = SCENARIOS[scenario]()
    filters = {each: make(world) for each, make in catalog.ALL.items()}
    campaign = monte_carlo(world, filters, runs, jax.random.key(0), workers=1)
    print(f"{world.name}, {runs} runs of {world.steps} steps")
    print(f"{'':24}{'µs a step':>12}{'RMSE [m]':>12}{'pose NEES':>12}  verdict")
    for each, summary in campaign.filters.items():
        seconds, nees = campaign.step_seconds[each], summary.measures.get("nees_pose")
        error = summary.measures["rmse_position"].value
        shown = f"{nees.value:12.4g}" if nees else f"{'-':>12}"  # a path that is given has none
        print(f"{each:24}{1e6 * seconds:12.3g}{error:12.4g}{shown}  {summary.verdict}")
    if out is not None:
        out.write_bytes(plot.png(plot.cost_figure(campaign)))
    rmse = {each: s.measures["rmse_position"].value for each, s in campaign.filters.items()}
    return [
        Metric(
            "localization in the true map: RMSE over the ideal EKF's",
            rmse["localization"] / rmse["ideal"],
            high=1.0,
        ),
        Metric(
            "dead reckoning: RMSE over the ideal EKF's",
            rmse["dead_reckoning"] / rmse["ideal"],
            low=1.0,
        ),
    ]


if __name__ == "__main__":
    raise SystemExit(
        alone(
            "comparison",
            measure,
            runs={"type": int, "default": 16},
            scenario={"choices": list(SCENARIOS), "default": "cloister"},
            out={"type": Path, "default": FIGURE},
        )
    )
