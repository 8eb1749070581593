"""The command `jaxslam consistency`: a Monte-Carlo campaign, its table and its files."""

import argparse
import shutil
import sys
import threading
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax

from jaxslam.catalog import ALL
from jaxslam.cli import devices, library
from jaxslam.cli.campaign_folder import (
    BLOCKS,
    RESULT,
    TIMES,
    check_same_campaign,
    earlier_results,
    open_store,
)
from jaxslam.cli.common import INTERRUPTED, Progress, pick
from jaxslam.monte_carlo import Campaign, Interrupted, monte_carlo
from jaxslam.monte_carlo.candidates import rounded
from jaxslam.protocols import Candidate, Filter
from jaxslam.results import report, store
from jaxslam.results.files import check_writable, versions, write_files
from jaxslam.run import run
from jaxslam.simulation.scenarios import SCENARIOS
from jaxslam.simulation.worlds import Scenario, simulate
from jaxslam.types import Estimate, Truth
from jaxslam.validation.numbers import check_count

if TYPE_CHECKING:  # Matplotlib is slow to load
    from jaxslam.results.plot import Figure

OUT = Path("out")
"""Default folder of results."""

FILES = (
    "report.html",
    RESULT,
    "consistency.csv",
    *(f"{name}.png" for name in ("nees", "bound", "cost", "coverage", "whiteness", "gained")),
    *("errors.png", "map.png"),
)
"""The files that a campaign writes."""

DEFAULTS: dict[str, Any] = {
    "scenario": "circle",
    "filters": "dead_reckoning,ekf",
    "runs": 100,
    "steps": None,
    "seed": 0,
    "bound": False,
    "dtype": "float64",
}
"""Default values of the options that define a campaign."""


def consistency(options: argparse.Namespace, command: str) -> int:
    """Run a campaign, print its table and write its files; returns the exit status."""
    asked, block = _asked(options)
    out = options.resume or options.out or OUT
    # Worlds are drawn in float64 whatever the filters compute in, so both precisions see the same.
    jax.config.update("jax_enable_x64", True)
    devices.join(options)
    scenario = _scenario(asked["scenario"], asked["steps"])
    filters = _filters(asked["filters"], scenario)
    if not 0 <= asked["seed"] < 2**32:
        raise ValueError(f"expected a seed between 0 and 2³²-1, got {asked['seed']}")
    check_count("runs", asked["runs"])
    if options.block is not None:
        check_count("block", options.block)
    check_writable(out)
    here = devices.chosen(options.devices)
    keep = open_store(options, out, asked, block)
    identity = library.identity(asked, here[0].platform)
    earlier = earlier_results(out, keep)
    written = earlier is not None and all((out / name).exists() for name in FILES)
    if not written:
        # Matplotlib is loaded while filters run. Not in a daemon thread: such a thread crashes in
        # compiled code when the interpreter exits.
        threading.Thread(target=_prepare_drawing).start()
    try:
        with (
            Progress(f"{scenario.name}, {len(filters)} filter(s)") as progress,
            library.program_folder(identity) as kept,
        ):
            campaign = monte_carlo(
                scenario,
                filters,
                asked["runs"],
                jax.random.key(asked["seed"]),
                block=options.block,
                devices=here,
                bound=asked["bound"],
                dtype=asked["dtype"],
                keep=keep,
                identity=identity,
                library=kept,
                progress=progress,
                glimpse=progress.glimpse,
            )
    except Interrupted as stop:
        if stop.campaign is None:
            if not keep.spans():  # other processes may have saved some
                shutil.rmtree(keep.folder, ignore_errors=True)
            raise
        print(report.campaign_table(stop.campaign))
        print(f"\njaxslam: interrupted, {stop}; --resume {out} goes on", file=sys.stderr)
        return INTERRUPTED
    for sentence in keep.set_aside:
        print(f"jaxslam: {sentence}", file=sys.stderr)
    if jax.process_index() > 0:
        return 0
    took = campaign.seconds
    ran = took - campaign.compile_seconds if campaign.compile_seconds else 0.0
    if earlier is not None and not keep.set_aside:  # else some runs were computed again
        times = {name: earlier[name] for name in TIMES}
        campaign, command = replace(campaign, **times), earlier["command"]
    else:
        written = False
    print(report.campaign_table(campaign))
    if written:
        print(
            f"\n{out} holds this campaign, finished: nothing was run and nothing written; "
            f"--runs above {campaign.runs} extends it"
        )
        return 0
    files = _campaign_files(campaign, scenario, asked["seed"], asked["bound"], command)
    print("\nwrote " + ", ".join(str(path) for path in write_files(out, files)))
    print(
        f"results after {took:.1f} s"
        + f"; once every program was there, the runs took {ran:.1f} s of them" * (ran > 0)
    )
    return 0


def _asked(options: argparse.Namespace) -> tuple[dict[str, Any], int | None]:
    """The options that define the campaign, and the size of blocks that it began with.

    They come from the command, the resumed campaign and the defaults, in this order. The options of
    a resumed campaign get its size of blocks unless another is given.
    """
    asked = {name: value for name, value in vars(options).items() if name in DEFAULTS}
    block: int | None = options.block
    if options.resume is not None:
        there = store.resume(options.resume / BLOCKS)
        check_same_campaign(options, there, asked)
        asked = there.settings["asked"] | {"runs": there.runs} | asked
        block = there.settings.get("block")  # blocks of another size would round differently
        options.block = block if options.block is None else options.block
    return DEFAULTS | asked, block


def _filters(asked: str, scenario: Scenario) -> dict[str, Candidate]:
    """The filters of a comma-separated list, or all, by name."""
    names = [name.strip() for name in asked.split(",")]
    if names == ["all"]:
        names = list(ALL)
    if "" in names:
        raise ValueError(
            f"--filters: expected names of filters with commas between them, or all, got {asked!r}"
        )
    if len(set(names)) < len(names):
        raise ValueError(f"expected each filter once, got {asked!r}")
    return {name: _filter(name, scenario) for name in names}


def _prepare_drawing() -> None:
    """Load what draws the figures."""
    from jaxslam.results import page, plot  # noqa: F401

    plot.warm_up()


def _campaign_files(
    campaign: Campaign, scenario: Scenario, seed: int, bound: bool, command: str
) -> dict[str, str | Callable[[Path], object]]:
    """The files of a campaign; errors and maps are those of run 0.

    Where this process did not run it, it is run again for the first filter with a map.
    """
    from jaxslam.results import page, plot  # matplotlib is slow to load

    title = f"{scenario.name}, run 0 of seed {seed}"
    if not campaign.first:
        mapping = [n for n, found in campaign.filters.items() if "rmse_landmarks" in found.measures]
        name = next(iter(mapping or campaign.filters))
        first = {name: _run_zero(campaign, scenario, name, seed)}
        campaign, title = replace(campaign, first=first), f"{title}, {name}"
    figures = {
        "nees": ("NEES against time, with its 95 % band", plot.nees_figure(campaign)),
        "bound": (
            "RMSE, and the conditional Cramér-Rao bound" if bound else "RMSE",
            plot.bound_figure(campaign),
        ),
        "cost": ("Error and NEES against the time of a step", plot.cost_figure(campaign)),
        "coverage": ("Coverage of the ellipsoids", plot.coverage_figure(campaign)),
        "whiteness": ("Autocorrelation of innovations", plot.whiteness_figure(campaign)),
        "gained": ("Information wrongly gained of a turn", plot.gained_figure(campaign)),
        "errors": (f"Errors: {title}", plot.run_errors_figure(campaign, title=title)),
        "map": (f"Maps: {title}", plot.run_map_figure(campaign, title=title)),
    }
    draw = cache(plot.png)

    def saved(figure: "Figure") -> Callable[[Path], object]:
        return lambda path: path.write_bytes(draw(figure))

    return {
        "report.html": page.page(
            campaign,
            report.ROWS,
            command,
            seed,
            versions(),
            dict(figures.values()),
            draw,
        ),
        RESULT: report.as_json(campaign, command, seed),
        "consistency.csv": report.as_csv(campaign),
    } | {f"{name}.png": saved(figure) for name, (_, figure) in figures.items()}


def _run_zero(
    campaign: Campaign, scenario: Scenario, name: str, seed: int
) -> tuple[Truth, Estimate]:
    """Run 0 of a filter, computed again where another process or an earlier command computed it."""
    key = jax.random.fold_in(jax.random.key(seed), 0)
    key_world, key_filter = jax.random.split(key)
    truth, log = rounded(simulate(scenario, key_world), campaign.dtype)
    candidate = ALL[name](scenario)
    method = candidate if isinstance(candidate, Filter) else candidate(truth)
    assert isinstance(method, Filter)
    trace = run(method, log, scenario.pose, scenario.pose_cov, key_filter)
    found: tuple[Truth, Estimate] = jax.device_get((truth, trace.estimate))
    return found


def _scenario(name: str, steps: int | None) -> Scenario:
    """A scenario by name, with its own number of steps unless given."""
    make = pick("scenario", name, SCENARIOS)
    return make() if steps is None else make(steps)


def _filter(name: str, scenario: Scenario) -> Candidate:
    """A filter of the catalog; raises ValueError with its name if it cannot run the scenario."""
    make = pick("filter", name, ALL)
    try:
        return make(scenario, watch=True)
    except ValueError as error:
        raise ValueError(
            f"filter {name!r} cannot run scenario {scenario.name!r}: {error}"
        ) from error
