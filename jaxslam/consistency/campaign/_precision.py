"""Doubts on a campaign whose precision decides: its first runs again, in float64.

Where the rounding of covariances or coordinates comes near the noise (`Rounding`), the first runs
of a float32 campaign are filtered in both precisions, over the same logs: what differs is rounding.
In float64 there is nothing to compare with, nor of a filter that draws random numbers, which differ
between precisions; there the size of the rounding is the doubt.
"""

from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import NamedSharding
from jaxtyping import Float, Int, PyTree

from jaxslam._rounding import SAME, rounding_of
from jaxslam.consistency._measures.nees import block_nees, pose_error
from jaxslam.consistency._tally import Tally
from jaxslam.consistency.campaign._block import CampaignPlan
from jaxslam.consistency.campaign._block_programs import (
    Draws,
    FilterResults,
    mesh_of,
    programs,
    spec,
)
from jaxslam.consistency.campaign._candidates import least_noise
from jaxslam.core._record import as_record
from jaxslam.core.protocols import Candidate
from jaxslam.core.types import Status
from jaxslam.math._arrays import float64

RUNS = 16
"""Largest number of runs that are filtered again: a block on a CPU, whose programs are there."""


def precision_doubts(
    plan: CampaignPlan, tallies: Mapping[str, Tally], dtype: np.dtype, compare: bool = True
) -> dict[str, str]:
    """Sentences, by filter, on the precision of its runs, where that decides.

    dtype: of the runs. compare: whether runs may be filtered again.
    """
    scenario, doubts = plan.scenario, {}
    least = least_noise(scenario)
    start = np.asarray(scenario.pose, np.float64)[None, :2]
    points = np.asarray(scenario.landmarks, np.float64)[:, :2]
    places = np.concatenate([start, np.pad(points, [(0, 0), (0, 2 - points.shape[1])])])
    start_cov = np.asarray(scenario.pose_cov, np.float64)[None, :3, :3]
    for name, candidate in plan.filters.items():
        tally = tallies[name]
        covs = np.concatenate([start_cov, tally.snapshots()[1].reshape(-1, 3, 3)])
        rounding = rounding_of(candidate, dtype, covs, places, least)
        singular = int(tally.sums["singular"])
        suspect = rounding.may_decide or singular or not tally.flags("finite").all()
        doubt = rounding.doubt
        comparable = dtype == np.float32 and rounding.of_position < 0.1
        if compare and comparable and suspect:
            difference = _difference(plan, candidate, tally.numbers())
            if difference == "" and singular and least > 0:
                difference = f"{singular:,} innovation covariances were singular in float32"
            if difference is not None:
                doubt = difference and f"precision decides: {difference}: {rounding.remedy}"
        if doubt:
            doubts[name] = doubt
    return doubts


class _Runs(NamedTuple):
    """R runs of a filter in one precision, on the host, by step first."""

    pose: Float[np.ndarray, "T R 3"]
    pose_cov: Float[np.ndarray, "T R 3 3"]
    chart_error: Float[np.ndarray, "T R 3"]
    status: Int[np.ndarray, "T R M"]
    nis: Float[np.ndarray, "T R M"]
    dof: Int[np.ndarray, "T R M"]


def _difference(plan: CampaignPlan, candidate: Candidate, numbers: np.ndarray) -> str | None:
    """The run of a filter that differs most between float32 and float64, as a sentence; "" where
    none does by more than `SAME`, None where they cannot be compared: a filter that draws random
    numbers, or computes in one precision alone."""
    size = min(RUNS, plan.block)
    compared = numbers[:size]
    filled = np.resize(compared, size)  # a block, for which there are programs, repeats its runs
    devices = tuple(plan.devices[:1])
    everywhere = NamedSharding(mesh_of(devices), spec(None))

    def filter_again(draws: Draws, key: jax.Array) -> _Runs:
        """The runs in the precision that is set where this is called."""
        fixed = plan.scenario, as_record(candidate), key
        results: FilterResults = programs(devices, plan.dtype).drive(
            *jax.device_put(fixed, everywhere), filled.astype(jnp.result_type(int)), *draws
        )
        estimate, info = results.estimate, results.info
        of_estimate = estimate.pose, estimate.pose_cov, results.chart_error
        parts: PyTree = (*of_estimate, info.status, info.nis, info.dof)
        return _Runs(*jax.device_get(parts))

    world, key = jax.device_put((plan.scenario, plan.key), everywhere)
    draws = programs(devices, plan.dtype).draw(world, key, filled.astype(jnp.result_type(int)))
    single = filter_again(draws, plan.key)
    draws = jax.device_get(draws)
    try:
        with float64():
            wide = jax.tree.map(
                lambda leaf: leaf.astype(float) if leaf.dtype == np.float32 else leaf, draws
            )
            double = filter_again(wide, plan.key)
            scores = _scores((single, double), np.asarray(draws[0].pose))
            gaps = np.stack([_gap(*pair) for pair in scores.values()])[:, : len(compared)]
            if not gaps.max() > SAME:
                return ""
            # With another key only a filter that draws random numbers computes something else.
            another = filter_again(wide, jax.random.fold_in(plan.key, 0))
    except Exception:  # a user's filter that computes in float32 alone
        return None
    if not np.array_equal(double.pose, another.pose, equal_nan=True):
        return None
    run = int(gaps.max(axis=0).argmax())
    pairs = [
        f"{name} {a[run]:,.4g} and {b[run]:,.4g}"
        for name, (a, b) in scores.items()
        if np.isfinite([a[run], b[run]]).any()
    ]
    return f"run {compared[run]} has, in float32 and in float64, {', '.join(pairs)}"


def _scores(
    both: tuple[_Runs, _Runs], truth: Float[np.ndarray, "R T 3"]
) -> dict[str, list[Float[np.ndarray, "R"]]]:
    """Numbers of each run, in either precision: the average NEES over the steps at which both have
    one, NIS/dof, and how many measurements were used."""
    path = np.swapaxes(truth, 0, 1)
    nees = [
        block_nees(runs.pose, pose_error(path, runs.pose), runs.chart_error, runs.pose_cov)["pose"]
        for runs in both
    ]
    regular = nees[0].regular & nees[1].regular
    scores: dict[str, list[np.ndarray]] = {"pose NEES": [], "NIS/dof": [], "measurements used": []}
    with np.errstate(all="ignore"):  # without a step, or a measurement, the number is NaN
        for runs, (value, _) in zip(both, nees, strict=True):
            used = runs.status == Status.FUSED
            nis = np.where(used, runs.nis, 0.0).sum(axis=(0, 2), dtype=np.float64)
            average = np.where(regular, value, 0.0).sum(axis=0) / regular.sum(axis=0)
            scores["pose NEES"].append(average)
            scores["NIS/dof"].append(nis / runs.dof.sum(axis=(0, 2)))
            scores["measurements used"].append(used.sum(axis=(0, 2)).astype(np.float64))
    return scores


def _gap(a: Float[np.ndarray, "R"], b: Float[np.ndarray, "R"]) -> Float[np.ndarray, "R"]:
    """|a/b - 1|; ∞ where one alone is a number."""
    with np.errstate(all="ignore"):
        gap = np.where(a == b, 0.0, np.abs(a / b - 1))
    lone = np.isfinite(a) != np.isfinite(b)
    return np.where(lone, np.inf, np.nan_to_num(gap, nan=0.0, posinf=np.inf))
