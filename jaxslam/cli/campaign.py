"""`jaxslam consistency`: a campaign, its table and its files."""

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path

import jax

from jaxslam import page, plot, report
from jaxslam.cli.asking import Progress, pick
from jaxslam.family import FILTERS
from jaxslam.monte_carlo import Campaign, monte_carlo
from jaxslam.protocols import Candidate, Filter
from jaxslam.run import run
from jaxslam.scenarios import SCENARIOS
from jaxslam.simulate import Scenario, simulate


def consistency(options: argparse.Namespace, command: str) -> int:
    """Run the campaign that was asked for, print its table, write its files; exit status."""
    scenario = _scenario(options.scenario, options.steps)
    names = [name.strip() for name in options.filters.split(",")]
    if names == ["all"]:
        names = list(FILTERS)
    if len(set(names)) < len(names):
        raise ValueError(f"expected each filter once, got {options.filters!r}")
    filters = {name: _filter(name, scenario) for name in names}
    if not 0 <= options.seed < 2**32:
        raise ValueError(f"expected a seed between 0 and 2³²-1, got {options.seed}")
    report.check_writable(options.out)
    key = jax.random.key(options.seed)
    with Progress(f"{scenario.name}, {len(filters)} filter(s)") as progress:
        campaign = monte_carlo(
            scenario,
            filters,
            options.runs,
            key,
            block=options.block,
            bound=options.bound,
            progress=progress,
        )
    print(report.table(campaign))
    written = report.write_files(options.out, _campaign_files(campaign, scenario, options, command))
    print(f"\ncampaign {campaign.seconds:.1f} s; wrote " + ", ".join(str(path) for path in written))
    return 0


def _campaign_files(
    campaign: Campaign, scenario: Scenario, options: argparse.Namespace, command: str
) -> dict[str, str | Callable[[Path], object]]:
    """The campaign, and pictures of its first run under its first filter."""
    name = next(iter(campaign.filters))
    key_world, key_filter = jax.random.split(jax.random.fold_in(jax.random.key(options.seed), 0))
    truth, log = jax.jit(partial(simulate, scenario))(key_world)
    candidate = FILTERS[name](scenario)
    filter = candidate if isinstance(candidate, Filter) else candidate(truth)
    assert isinstance(filter, Filter)
    trace = run(filter, log, scenario.pose, scenario.pose_cov, key_filter)
    title = f"{scenario.name}, {name}, run 0 of seed {options.seed}"
    figures = {
        "nees": ("NEES against time, with its 95 % band", plot.nees_figure(campaign)),
        "bound": (
            "RMSE, and the Cramér-Rao bound" if options.bound else "RMSE",
            plot.bound_figure(campaign),
        ),
        "coverage": ("Coverage of the ellipsoids", plot.coverage_figure(campaign)),
        "whiteness": ("Autocorrelation of innovations", plot.whiteness_figure(campaign)),
        "gained": ("Information wrongly gained of a turn", plot.gained_figure(campaign)),
        "errors": (f"Errors: {title}", plot.errors_figure(trace.estimate, truth, title=title)),
        "map": (f"Map: {title}", plot.map_figure(trace.estimate, truth=truth, title=title)),
    }
    return {
        "report.html": page.page(
            campaign,
            report.ROWS,
            command,
            options.seed,
            report.versions(),
            dict(figures.values()),
        ),
        "consistency.json": report.as_json(campaign, command, options.seed),
        "consistency.csv": report.as_csv(campaign),
    } | {f"{name}.png": figure.savefig for name, (_, figure) in figures.items()}


def _scenario(name: str, steps: int | None) -> Scenario:
    make = pick("scenario", name, SCENARIOS)
    return make() if steps is None else make(steps)


def _filter(name: str, scenario: Scenario) -> Candidate:
    """A filter of the family for a scenario, or ValueError by name if it cannot run there."""
    make = pick("filter", name, FILTERS)
    try:
        return make(scenario, watch=True)
    except ValueError as error:
        raise ValueError(
            f"filter {name!r} cannot run scenario {scenario.name!r}: {error}"
        ) from error
