"""Monte-Carlo campaigns: many filters on identical draws, in blocks of vmapped runs.

A run is a key; its world is drawn once and every filter runs on it. Blocks are vmapped and only
sums leave them, so memory is that of one block per worker however many runs there are. Each run's
key is derived from its number, so the draws do not depend on the size of the blocks.
"""

import os
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.charts.euclidean import euclidean
from jaxslam.consistency import Score, Summary, Tally, posterior_bound, score, summarize
from jaxslam.linalg import check_count
from jaxslam.protocols import Candidate, Chart, Estimator, Filter
from jaxslam.run import run
from jaxslam.simulate import Scenario, simulate
from jaxslam.types import Log, Truth


@dataclass(frozen=True)
class Campaign:
    """The result: the scenario, what was run, and a `Summary` for each filter by name."""

    scenario: str
    source: str
    published: dict[str, dict[str, float]]
    steps: int
    runs: int
    dtype: str
    divergence_limit: float
    """[m] a run is divergent when its final position error exceeds it: 5 σ of the ideal spread,
    σ² = tr P of the position at the end of an EKF with Jacobians at the truth."""
    filters: dict[str, Summary]
    seconds: float
    """wall time, compilation included."""
    compile_seconds: float


def monte_carlo(
    scenario: Scenario,
    filters: Mapping[str, Candidate],
    runs: int,
    key: jax.Array,
    *,
    block: int = 32,
    workers: int | None = None,
    bound: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Campaign:
    """Run every filter over the same `runs` worlds of a scenario and sum up its consistency.

    Args:
        scenario: what to draw; see `scenarios`.
        filters: by name. A function instead of a filter is called with each run's `Truth`.
        runs: how many worlds; run i has key fold_in(key, i).
        key: a PRNG key.
        block: runs vmapped together; the last block is padded, and the padding not counted.
        bound: also take the posterior Cramér-Rao bound of every run, at the price of one more EKF.
        workers: blocks in flight at once, default the number of CPUs (1 on an accelerator).
        progress: called with (runs done, runs) after each block, in order.
    Returns:
        Campaign.
    Raises:
        ValueError: on runs or block below 1, no filters, or a filter that does not fit the
            scenario; before anything is traced.
    """
    for name, value in (("runs", runs), ("block", block), ("workers", workers)):
        if value is not None:
            check_count(f"monte_carlo: {name}", value)
    if not isinstance(filters, Mapping) or not filters:
        raise ValueError("monte_carlo: expected filters by name, at least one")
    for name, candidate in filters.items():
        _check_fits(name, candidate, scenario)
    began = time.perf_counter()
    runs, block = int(runs), min(int(block), int(runs))
    numbers = np.arange(-(-runs // block) * block).reshape(-1, block)

    def keys_of(which: jax.Array) -> tuple[jax.Array, jax.Array]:
        both = jax.vmap(lambda i: jax.random.split(jax.random.fold_in(key, i)))(which)
        return both[:, 0], both[:, 1]

    def draw(which: jax.Array) -> tuple[Truth, Log]:
        return jax.vmap(partial(simulate, scenario))(keys_of(which)[0])

    def judge(
        candidate: Candidate, world: tuple[Truth, Log], which: jax.Array, limit: jax.Array
    ) -> Score:
        def one(truth: Truth, log: Log, key: jax.Array) -> Score:
            method, chart = _estimator(candidate, truth, scenario)
            return score(method(log, key), truth, scenario.sensor, limit, chart)

        each: Score = jax.vmap(one)(*world, keys_of(which)[1])
        return each._replace(sums=_added(each.sums, which < runs))

    def least(world: tuple[Truth, Log], which: jax.Array) -> tuple[dict[str, jax.Array], jax.Array]:
        one = partial(posterior_bound, scenario)
        cov = jax.vmap(one)(*world, keys_of(which)[1]).pose_cov
        position = jnp.trace(cov[:, :, :2, :2], axis1=2, axis2=3)
        sums = _added({"position": position, "heading": cov[:, :, 2, 2]}, which < runs)
        return sums, jnp.sqrt(position[0, -1])

    if workers is None:
        workers = os.cpu_count() or 1 if jax.default_backend() == "cpu" else 1
    which = jnp.asarray(numbers[0])
    with ThreadPoolExecutor(workers) as pool:
        jobs: dict[str, tuple[Callable[..., Any], tuple[Any, ...]]] = {
            "": (draw, (which,)),
        }
        world = jax.eval_shape(draw, which)
        jobs[" bound"] = (least, (world, which))
        limit_shape = jax.ShapeDtypeStruct((), world[0].pose.dtype)
        for name, candidate in filters.items():
            jobs[f"f {name}"] = (partial(judge, candidate), (world, which, limit_shape))
        compiled = dict(
            zip(
                jobs,
                pool.map(lambda job: jax.jit(job[0]).lower(*job[1]).compile(), jobs.values()),
                strict=True,
            )
        )
        compile_seconds = time.perf_counter() - began
        spread = float(compiled[" bound"](compiled[""](which), which)[1])
        limit = _divergence_limit(scenario, spread, limit_shape.dtype)

        def work(numbers_of_block: np.ndarray) -> tuple[dict[str, Score], dict[str, Any]]:
            which = jnp.asarray(numbers_of_block)
            world = compiled[""](which)
            at = jnp.asarray(limit, limit_shape.dtype)
            scores = {
                name: jax.device_get(compiled[f"f {name}"](world, which, at)) for name in filters
            }
            return scores, jax.device_get(compiled[" bound"](world, which)[0]) if bound else {}

        tallies = {name: Tally() for name in filters}
        bounds: dict[str, np.ndarray] = {}
        pending = [pool.submit(work, part) for part in numbers]
        try:
            for i, future in enumerate(pending):
                scores, bound_sums = future.result()
                here = min(block, runs - i * block)
                for name, tally in tallies.items():
                    tally.add(_first(here, scores[name]))
                for name, total in bound_sums.items():
                    bounds[name] = bounds.get(name, 0.0) + np.asarray(total, np.float64)
                if progress is not None:
                    progress(i * block + here, runs)
        except BaseException:
            for future in pending:
                future.cancel()
            raise
    mean_bound = {name: total / runs for name, total in bounds.items()} or None
    return Campaign(
        scenario=scenario.name,
        source=scenario.source,
        published=scenario.published,
        steps=scenario.steps,
        runs=runs,
        dtype=str(limit_shape.dtype),
        divergence_limit=limit,
        filters={name: summarize(tally, mean_bound) for name, tally in tallies.items()},
        seconds=time.perf_counter() - began,
        compile_seconds=compile_seconds,
    )


def _added(each: dict[str, jax.Array], counts: jax.Array) -> dict[str, jax.Array]:
    """The sums over the leading axis, of what counts."""

    def one(leaf: jax.Array) -> jax.Array:
        mask = counts.reshape(-1, *(1,) * (leaf.ndim - 1))
        return jnp.where(mask, leaf, jnp.zeros_like(leaf)).sum(axis=0)

    return {name: one(leaf) for name, leaf in each.items()}


def _first(runs: int, scores: Score) -> Score:
    """The scores of the first runs of a block, which its sums are already of."""
    per_run: Score = jax.tree.map(lambda leaf: leaf[:runs], scores._replace(sums={}))
    return per_run._replace(sums=scores.sums)


def _estimator(candidate: Candidate, truth: Truth, scenario: Scenario) -> tuple[Estimator, Chart]:
    """What runs, and the chart of its errors."""
    method = candidate if isinstance(candidate, Filter) else candidate(truth)
    if not isinstance(method, Filter):
        return method, euclidean()

    def learnt(state: Any) -> Any:
        watch = getattr(state, "watch", ())
        return watch.information if watch else ()

    def drive(log: Log, key: jax.Array) -> Any:
        return run(method, log, scenario.pose, scenario.pose_cov, key, probe=learnt)

    return drive, method.chart


def _check_fits(name: str, candidate: Candidate, scenario: Scenario) -> None:
    if not isinstance(candidate, Filter):
        if not callable(candidate):
            raise ValueError(f"monte_carlo: {name} is neither a filter nor a function of the truth")
        return
    for what, has, needs in (
        ("control", candidate.control_size, len(scenario.motion.controls)),
        ("measurement", candidate.measurement_size, len(scenario.sensor.measurements)),
    ):
        if has != needs:
            raise ValueError(
                f"monte_carlo: filter {name} takes a {what} of size {has}, "
                f"the scenario {scenario.name} gives {needs}"
            )


def _divergence_limit(scenario: Scenario, spread: float, dtype: Any) -> float:
    """5 σ of the ideal spread, or, in a world without noise, what rounding can do."""
    reach = 1.0 + float(np.max(np.abs(np.asarray(scenario.landmarks)), initial=0.0))
    return max(5 * spread, 1000 * float(jnp.finfo(dtype).eps) * reach)
