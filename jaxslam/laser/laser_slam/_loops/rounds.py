"""Loop closing in rounds: candidates, matches, the loops that agree, the optimum.

A candidate is a keyframe in a submap; it is accepted or refused by correlation and lines.
"""

import ctypes
import os
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from jaxslam import graphs
from jaxslam.graphs import Graph, Table
from jaxslam.graphs._graph import LOOPS
from jaxslam.laser.laser_slam import _end_covariances as end_covariances
from jaxslam.laser.laser_slam._assembly import ROOM, graph_of, relative_covs, table_of
from jaxslam.laser.laser_slam._loops.loop_candidates import (
    CANDIDATES,
    MOST,
    PLACES,
    REACH,
    Candidates,
    by_appearance,
    by_place,
    descriptors,
    near,
    thinned,
)
from jaxslam.laser.laser_slam._loops.pairwise import clique, consistent
from jaxslam.laser.laser_slam._odometry.reference import (
    Reference,
    match,
    reference_of,
    rows_of,
    window_search,
)
from jaxslam.laser.laser_slam._odometry.tracking import LOOP_INLIERS, Odometry
from jaxslam.laser.laser_slam._records import LoopOutcome, Loops, Settings
from jaxslam.laser.laser_slam._scan_points import ROWS, Scans
from jaxslam.math.stats import chi2_quantile


def give_back() -> None:
    """Give the system what this process has freed, where the C library can (glibc).

    XLA compiles in several threads, and glibc keeps what these free, some hundred MB after each
    compilation, for the same thread alone.
    """
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(ctypes.c_size_t(0))


_NARROW, _WIDE = (0.8, float(np.deg2rad(14.0))), (4.0, float(np.deg2rad(40.0)))
"""Windows of the search, [m] and [rad] to either side."""
_SEARCHES = [window_search(*window, np.deg2rad(2.0)) for window in (_NARROW, _WIDE)]
_WINDOW = np.diag(1 / np.square([_WIDE[0], *_WIDE]))
"""Information of the window, which bounds directions that the walls do not determine."""

_CONSISTENCY = 0.999
"""Probability below which two loops agree."""


class Matches(NamedTuple):
    """Candidates that were matched."""

    z: Float[np.ndarray, "M 3"]
    cov: Float[np.ndarray, "M 3 3"]
    """of the end of z"""
    score: Float[np.ndarray, "M"]
    outcome: Int[np.ndarray, "M"]
    """KEPT, POOR or AMBIGUOUS"""


def matched(
    scans: Scans,
    keyframe: Int[np.ndarray, "N"],
    path: Float[np.ndarray, "N 3"],
    candidates: Candidates,
    settings: Settings,
    progress: Callable[[], object],
) -> Matches:
    """The match of each candidate, submap by submap, on every core."""
    count = len(candidates.first)
    z, cov = np.zeros((count, 3)), np.zeros((count, 3, 3))
    score, outcome = np.zeros(count), np.zeros(count, int)

    def of_submap(middle: np.integer) -> int:
        """The candidates of one submap; how many."""
        submap = _submap(scans, keyframe, path, int(middle), settings)
        rows = np.flatnonzero(candidates.first == middle)
        for row in rows:
            fit = match(
                _SEARCHES[int(candidates.wide[row])],
                submap,
                rows_of(scans.points, keyframe[candidates.second[row]]),
                candidates.z[row],
                None,
                _WINDOW,
                settings,
            )
            z[row], cov[row], score[row] = fit.pose, fit.cov, fit.inliers
            if fit.inliers < LOOP_INLIERS:
                outcome[row] = LoopOutcome.POOR
            elif fit.ambiguous:
                outcome[row] = LoopOutcome.AMBIGUOUS
        return len(rows)

    submaps = np.unique(candidates.first)
    for _ in range(of_submap(submaps[0]) if count else 0):  # compiles what the others share
        progress()
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        try:
            for results in pool.map(of_submap, submaps[1:]):
                for _ in range(results):
                    progress()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return Matches(z, cov, score, outcome)


def _submap(
    scans: Scans, keyframe: np.ndarray, path: np.ndarray, middle: int, settings: Settings
) -> Reference:
    """The keyframes around one, in its frame."""
    low = max(middle - settings.submap, 0)
    around = np.arange(low, min(middle + settings.submap + 1, len(keyframe)))
    size = settings.scans_of_reference
    return reference_of(scans, keyframe[around], path[around], path[middle], size)


_KERNEL = {LOOPS: graphs.Cauchy()}
"""One object, so that the optimum is traced once."""


class _Closed(NamedTuple):
    """The graph of keyframes with its loops."""

    graph: Graph
    loops: Loops
    left_out: int
    """keyframes that were not tried, and candidates that were not matched, being too many"""


def closed(
    scans: Scans,
    odometry: Odometry,
    settings: Settings,
    progress: Callable[[int, int], object] | None = None,
) -> _Closed:
    """The graph after all rounds.

    In each round candidates are found by the marginals of the graph so far, matched, and added to
    those of the rounds before; of all that match, the largest set that agrees pairwise is kept, and
    the graph is optimized with Cauchy's kernel on them. In the end loops whose squared residual is
    above the quantile of `_CONSISTENCY` are left out, and the graph is optimized without a
    kernel.

    A keyframe whose match is in doubt begins and ends no loop. Until the last optimum the steps of
    odometry have `Odometry.cov_if_right`, there `Odometry.cov`: with the wider covariances places
    that look alike, metres away, would agree.
    """
    keyframe = odometry.keyframe
    at = odometry.poses[keyframe]
    steps, covs = odometry.z[keyframe[1:]], odometry.cov_if_right[keyframe[1:]]
    index = np.arange(len(keyframe))
    chain = table_of(index[:-1], index[1:], steps, covs)
    total = end_covariances.along(at, covs)
    middle = index[:: settings.submap_every]
    usable = scans.usable[keyframe] & ~odometry.doubted[keyframe]
    ends_at, valid = np.asarray(scans.points.position), np.asarray(scans.points.valid)
    parts = np.split(keyframe, range(ROWS, len(keyframe), ROWS))
    looks = np.concatenate([descriptors(ends_at[some], valid[some]) for some in parts])
    graph = graph_of(at, keyframe, chain)
    solution: graphs.Solution | None = None
    tried: list[Candidates] = []
    found: list[Matches] = []
    pairs_tried: set[tuple[int, int, bool]] = set()
    ends: set[tuple[int, int]] = set()
    loops, kept = _agreeing(tried, found, at, total, settings)
    left_out = max(int(usable.sum()) - MOST, 0)
    for turn in range(settings.rounds if len(keyframe) > settings.loop_gap else 0):
        path = np.asarray(graph.poses, np.float64)
        # By the graph few places, since each pair whose covariance is computed fills its
        # factor; after a first optimum the nearest ones fit a window.
        most = PLACES if turn == 0 else CANDIDATES
        reach = REACH + _WIDE[0]
        pairs = near(path, middle, usable, ends, most, reach, settings.loop_gap)
        cov = (
            end_covariances.relative_cov(total, at, pairs[:, 0], pairs[:, 1])
            if solution is None or not len(pairs)
            else relative_covs(solution, pairs)
        )
        new = by_place(path, pairs, cov, pairs_tried, settings, _NARROW, _WIDE)
        if turn == 0:
            new = _with(new, by_appearance(looks, middle, usable, settings))
        new, out = thinned(new)
        left_out += out
        pairs_tried |= set(
            zip(new.first.tolist(), new.second.tolist(), new.wide.tolist(), strict=True)
        )
        if not len(new.first):
            break
        count = 0

        def tell(size: int = len(new.first)) -> None:
            nonlocal count
            count += 1
            if progress is not None:
                progress(count, size)

        tried.append(new)
        found.append(matched(scans, keyframe, path, new, settings, tell))
        give_back()
        loops, kept = _agreeing(tried, found, at, total, settings)
        ends |= set(zip(loops.first[kept].tolist(), loops.second[kept].tolist(), strict=True))
        edges = table_of(loops.first[kept], loops.second[kept], loops.z[kept], loops.cov[kept])
        graph = graph_of(path, keyframe, chain, edges)
        kernel = _KERNEL if kept.any() else None
        solution = graphs.optimize(graph, kernel=kernel, room=ROOM)
        graph = _host(solution.graph)
        give_back()
    doubtful = table_of(index[:-1], index[1:], steps, odometry.cov[keyframe[1:]])
    return _final(graph, doubtful, loops, kept, keyframe, settings)._replace(left_out=left_out)


def _final(
    graph: Graph,
    chain: Table,
    loops: Loops,
    kept: np.ndarray,
    keyframe: np.ndarray,
    settings: Settings,
) -> _Closed:
    """The optimum without a kernel, of the loops that the graph does not contradict.

    chain: of the matches with the covariances of those in doubt, which takes the place of that
    which loops were sought with.
    """
    tables = {**graph.tables, "relative_pose": chain}
    if kept.any():
        square = np.asarray(graphs.squared_residuals(graph, room=ROOM)[LOOPS])
        doubted = square > chi2_quantile(_CONSISTENCY, 3)
        loops.outcome[np.flatnonzero(kept)[doubted]] = LoopOutcome.DOUBTED
        tables[LOOPS] = tables[LOOPS]._replace(valid=~doubted)
    graph = graph._replace(tables=tables)
    if kept.any():
        graph = _host(graphs.optimize(graph, room=ROOM).graph)
    loops = loops._replace(first=keyframe[loops.first], second=keyframe[loops.second])
    return _Closed(graph, loops, 0)


def _with(place: Candidates, pairs: np.ndarray) -> Candidates:
    """Candidates by appearance and by position: at the same pose, with the wide window."""
    known = set(zip(place.first.tolist(), place.second.tolist(), strict=True))
    new = np.array([tuple(pair) not in known for pair in pairs.tolist()], bool)
    pairs = pairs[new]
    count = len(pairs)
    more = Candidates(
        pairs[:, 0], pairs[:, 1], np.zeros((count, 3)), np.ones(count, bool), np.ones(count, bool)
    )
    return Candidates(*(np.concatenate(both) for both in zip(place, more, strict=True)))


def _agreeing(
    tried: list[Candidates],
    found: list[Matches],
    at: Float[np.ndarray, "N 3"],
    total: Float[np.ndarray, "N 3 3"],
    settings: Settings,
) -> tuple[Loops, np.ndarray]:
    """All candidates with their outcome, first and second being rows of the graph; and the kept."""
    if not tried:
        none = np.zeros(0, int)
        empty = np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0)
        return Loops(none, none, *empty, none, none), np.zeros(0, bool)
    of = Candidates(*(np.concatenate(part) for part in zip(*tried, strict=True)))
    by = Matches(*(np.concatenate(part) for part in zip(*found, strict=True)))
    outcome = by.outcome.copy()
    good = np.flatnonzero(outcome == LoopOutcome.KEPT)
    parts = of.first[good], of.second[good], by.z[good], by.cov[good]
    agree = consistent(at, total, *parts, _CONSISTENCY)
    out = ~clique(agree, by.score[good])
    outcome[good[out]] = LoopOutcome.INCONSISTENT
    loops = Loops(of.first, of.second, by.z, by.cov, by.score, of.appearance.astype(int), outcome)
    return loops, outcome == LoopOutcome.KEPT


def _host(graph: Graph) -> Graph:
    found: Graph = jax.tree.map(np.asarray, graph)
    return found
