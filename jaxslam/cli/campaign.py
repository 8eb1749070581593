"""`jaxslam consistency`: a campaign, its table and its files."""

import argparse
import json
import shutil
import sys
import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import jax

from jaxslam.catalog import ALL
from jaxslam.cli import devices, library
from jaxslam.cli.asking import INTERRUPTED, Progress, pick
from jaxslam.math.linalg import check_count
from jaxslam.monte_carlo import Campaign, Interrupted, missing, monte_carlo
from jaxslam.monte_carlo.candidates import rounded
from jaxslam.protocols import Candidate, Filter
from jaxslam.results import report, store
from jaxslam.run import run
from jaxslam.simulation.scenarios import SCENARIOS
from jaxslam.simulation.worlds import Scenario, simulate
from jaxslam.types import Estimate, Truth

BLOCKS = "blocks"
"""The folder of a campaign's finished blocks, beside its results."""

OUT = Path("out")
"""The folder of results, unless said otherwise."""

RESULT = "consistency.json"
"""The file of results that tells of a campaign."""

FILES = (
    "report.html",
    RESULT,
    "consistency.csv",
    *(f"{name}.png" for name in ("nees", "bound", "cost", "coverage", "whiteness", "gained")),
    *("errors.png", "map.png"),
)
"""What a campaign writes."""

_TIMES = ("seconds", "compile_seconds", "step_seconds")
"""Of the results, what is known only when they are made."""

DEFAULTS: dict[str, Any] = {
    "scenario": "circle",
    "filters": "dead_reckoning,ekf",
    "runs": 100,
    "steps": None,
    "seed": 0,
    "bound": False,
    "dtype": "float64",
}
"""What a campaign is asked for by, unless said or resumed otherwise."""


def consistency(options: argparse.Namespace, command: str) -> int:
    """Run the campaign that was asked for, print its table, write its files; exit status."""
    asked = {name: value for name, value in vars(options).items() if name in DEFAULTS}
    block: int | None = options.block
    if options.resume is not None:
        there = store.resume(options.resume / BLOCKS)
        _check_same(options, there, asked)
        asked = there.settings["asked"] | {"runs": there.runs} | asked
        block = there.settings.get("block")  # other blocks would round differently
        options.block = block if options.block is None else options.block
    asked = DEFAULTS | asked
    out = options.resume or options.out or OUT
    # Worlds are drawn in float64 whatever filters compute in: both precisions see the same.
    jax.config.update("jax_enable_x64", True)
    devices.join(options)
    scenario = _scenario(asked["scenario"], asked["steps"])
    names = [name.strip() for name in asked["filters"].split(",")]
    if names == ["all"]:
        names = list(ALL)
    if "" in names:
        raise ValueError(
            "--filters: expected names of filters with commas between them, or all, "
            f"got {asked['filters']!r}"
        )
    if len(set(names)) < len(names):
        raise ValueError(f"expected each filter once, got {asked['filters']!r}")
    filters = {name: _filter(name, scenario) for name in names}
    if not 0 <= asked["seed"] < 2**32:
        raise ValueError(f"expected a seed between 0 and 2³²-1, got {asked['seed']}")
    check_count("runs", asked["runs"])
    if options.block is not None:
        check_count("block", options.block)
    report.check_writable(out)
    here = devices.chosen(options.devices)
    keep = _keep(options, out, asked, block)
    known = library.identity(asked, here[0].platform)
    earlier = _earlier(out, keep)
    written = earlier is not None and all((out / name).exists() for name in FILES)
    if not written:
        # What draws is imported while filters run, and needed when they have. No daemon: the end of
        # the interpreter would pull Matplotlib's compiled code from under it.
        threading.Thread(target=_prepare_drawing).start()
    try:
        with (
            Progress(f"{scenario.name}, {len(filters)} filter(s)") as progress,
            library.of_this_command(known) as kept,
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
                identity=known,
                library=kept,
                progress=progress,
                glimpse=progress.glimpse,
            )
    except Interrupted as stop:
        if stop.campaign is None:
            if not keep.spans():  # other processes may have some
                shutil.rmtree(keep.folder, ignore_errors=True)
            raise
        print(report.table(stop.campaign))
        print(f"\njaxslam: interrupted, {stop}; --resume {out} goes on", file=sys.stderr)
        return INTERRUPTED
    for sentence in keep.set_aside:
        print(f"jaxslam: {sentence}", file=sys.stderr)
    if jax.process_index() > 0:
        return 0
    took = campaign.seconds
    ran = took - campaign.compile_seconds if campaign.compile_seconds else 0.0
    if earlier is not None and not keep.set_aside:  # else some runs were run again
        times = {name: earlier[name] for name in _TIMES}
        campaign, command = replace(campaign, **times), earlier["command"]
        if written:
            print(report.table(campaign))
            print(
                f"\n{out} holds this campaign, finished: nothing was run and nothing written; "
                f"--runs above {campaign.runs} extends it"
            )
            return 0
    print(report.table(campaign))
    files = _campaign_files(campaign, scenario, asked["seed"], asked["bound"], command)
    print("\nwrote " + ", ".join(str(path) for path in report.write_files(out, files)))
    print(
        f"results after {took:.1f} s"
        + f"; once every program was there, the runs took {ran:.1f} s of them" * (ran > 0)
    )
    return 0


def _earlier(out: Path, keep: store.Store) -> dict[str, Any] | None:
    """What the results in a folder say, where all runs are there and the results are of them."""
    assert keep.runs is not None
    if missing(keep.spans(), keep.runs, keep.runs):
        return None
    try:
        found = json.loads((out / RESULT).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    whole = isinstance(found, dict) and found.get("runs") == keep.runs
    return found if whole and {*_TIMES, "command"} <= found.keys() else None


def _said(value: Any) -> str:
    """An option's value, as its user would say it."""
    if isinstance(value, bool):
        return "on" if value else "off"
    return "not given" if value is None else str(value)


def _check_same(options: argparse.Namespace, there: store.Store, asked: Mapping[str, Any]) -> None:
    """Raise ValueError unless what was asked for fits the campaign that is to be resumed."""
    folder = options.resume
    if options.out is not None and options.out.resolve() != folder.resolve():
        raise ValueError(
            f"--resume {folder} writes its results there: expected no --out, got {options.out}"
        )
    if "asked" not in there.settings:
        raise ValueError(f"{folder} holds a campaign that no command began")
    told = there.settings["asked"]
    differences = [
        f"--{name} is {_said(told[name])} there, {_said(value)} here"
        for name, value in asked.items()
        if name in told and told[name] != value
    ]
    if differences:
        raise ValueError(f"{folder} holds another campaign: {'; '.join(differences)}")


def _prepare_drawing() -> None:
    from jaxslam.results import page, plot  # noqa: F401

    plot.warm_up()


def _keep(
    options: argparse.Namespace, out: Path, asked: dict[str, Any], block: int | None
) -> store.Store:
    """Where this campaign's blocks are kept: a new folder, or that of the campaign resumed.

    block: the size of blocks that the campaign was begun with.
    """
    folder, runs = out / BLOCKS, asked["runs"]
    told = {name: value for name, value in asked.items() if name != "runs"}
    settings = {"asked": told, "block": block}
    if options.resume is None and jax.process_index() == 0:
        _make_room(options, out, settings, runs)
        store.create(folder, settings, runs)
    devices.wait_for_all("campaign folder")
    return store.resume(folder, settings, runs)


def _make_room(options: argparse.Namespace, out: Path, settings: dict[str, Any], runs: int) -> None:
    """Remove the blocks of a campaign that is to be given up; ValueError where it is not to be."""
    folder = out / BLOCKS
    if not (folder / store.MANIFEST).exists():
        if folder.exists() and any(folder.iterdir()):
            raise ValueError(f"{folder} holds files that are no campaign's; choose another --out")
        if (out / RESULT).exists() and not options.overwrite:
            raise ValueError(f"{out} holds the results of a campaign: --overwrite gives them up")
        return
    store.read_manifest(folder)  # or it is not ours to remove
    if not options.overwrite:
        there = store.resume(folder)
        done, whole = there.done(), there.runs or 0
        left = bool(missing(there.spans(), whole, max(whole, 1)))
        if left and done:
            raise ValueError(
                f"{out} holds an unfinished campaign, with {done} of {whole} runs done: --resume "
                f"{out} goes on with it, --overwrite gives it up; or choose another --out"
            )
        same = options.again and (there.settings, whole) == (settings, runs)
        if done and not same:
            raise ValueError(
                f"{out} holds a finished campaign of {done} runs: --overwrite gives it up, "
                f"--resume {out} prints it, or extends it to more --runs; or choose another --out"
            )
    shutil.rmtree(folder)


def _campaign_files(
    campaign: Campaign, scenario: Scenario, seed: int, bound: bool, command: str
) -> dict[str, str | Callable[[Path], object]]:
    """The campaign, and pictures of its first run under the first filter that makes a map."""
    from jaxslam.results import page, plot  # matplotlib only once there is a result to draw

    mapping = [n for n, found in campaign.filters.items() if "rmse_landmarks" in found.measures]
    name = next(iter(mapping or campaign.filters))

    truth, estimate = campaign.first.get(name) or _first_run(campaign, scenario, name, seed)
    title = f"{scenario.name}, {name}, run 0 of seed {seed}"
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
        "errors": (f"Errors: {title}", plot.errors_figure(estimate, truth, title=title)),
        "map": (f"Map: {title}", plot.map_figure(estimate, truth=truth, title=title)),
    }
    draw = cache(plot.png)

    def saved(figure: Any) -> Callable[[Path], object]:
        return lambda path: path.write_bytes(draw(figure))

    return {
        "report.html": page.page(
            campaign,
            report.ROWS,
            command,
            seed,
            report.versions(),
            dict(figures.values()),
            draw,
        ),
        RESULT: report.as_json(campaign, command, seed),
        "consistency.csv": report.as_csv(campaign),
    } | {f"{name}.png": saved(figure) for name, (_, figure) in figures.items()}


def _first_run(
    campaign: Campaign, scenario: Scenario, name: str, seed: int
) -> tuple[Truth, Estimate]:
    """Run 0 of a filter, which another process or an earlier command has run."""
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
    make = pick("scenario", name, SCENARIOS)
    return make() if steps is None else make(steps)


def _filter(name: str, scenario: Scenario) -> Candidate:
    """A filter of the family for a scenario, or ValueError by name if it cannot run there."""
    make = pick("filter", name, ALL)
    try:
        return make(scenario, watch=True)
    except ValueError as error:
        raise ValueError(
            f"filter {name!r} cannot run scenario {scenario.name!r}: {error}"
        ) from error
