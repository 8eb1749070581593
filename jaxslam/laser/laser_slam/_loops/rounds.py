"""Loop closing in rounds: candidates, matches, the loops that agree, the optimum.

A candidate is a keyframe in a submap; it is accepted or refused by correlation and lines.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple, TypeVar

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxslam import graphs
from jaxslam.graphs import Graph
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
    nearby_pairs,
    thin,
)
from jaxslam.laser.laser_slam._loops.pairwise import clique, pairwise_consistency
from jaxslam.laser.laser_slam._odometry.reference import (
    match,
    reference_of,
    rows_of,
    window_search,
)
from jaxslam.laser.laser_slam._odometry.tracking import LOOP_INLIERS, Odometry
from jaxslam.laser.laser_slam._records import LoopOutcome, Loops, Settings
from jaxslam.laser.laser_slam._scan_points import ROWS, Scans
from jaxslam.math.stats import chi2_quantile

_NARROW, _WIDE = (0.8, float(np.deg2rad(14.0))), (4.0, float(np.deg2rad(40.0)))
"""Windows of the search, [m] and [rad] to either side; chosen, as `Settings`, on four logs."""
_SEARCHES = [window_search(*window, np.deg2rad(2.0)) for window in (_NARROW, _WIDE)]
"""Narrow and wide, so that `Candidates.wide` is the index."""
_WINDOW = np.diag(1 / np.square([_WIDE[0], *_WIDE]))
"""Information of the window, which bounds directions that the walls do not determine."""

_CONSISTENCY = 0.999
"""Probability of χ² up to which two loops agree, and up to which the optimum agrees with a loop."""
_KERNEL = {LOOPS: graphs.Cauchy()}
"""A single object, so that the optimum is traced only once."""

_Columns = TypeVar("_Columns", Candidates, "Matches")


class Matches(NamedTuple):
    """The matches of M candidates."""

    z: Float[np.ndarray, "M 3"]
    """pose of the keyframe in the frame of the submap"""
    cov: Float[np.ndarray, "M 3 3"]
    """covariance of the end of z"""
    score: Float[np.ndarray, "M"]
    """share of the points on walls of the submap"""
    outcome: Int[np.ndarray, "M"]
    """KEPT, POOR or AMBIGUOUS"""


_NO_CANDIDATES = Candidates(
    np.zeros(0, int), np.zeros(0, int), np.zeros((0, 3)), np.zeros(0, bool), np.zeros(0, bool)
)
_NO_MATCHES = Matches(np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0), np.zeros(0, int))


def close_loops(
    scans: Scans,
    odometry: Odometry,
    settings: Settings,
    progress: Callable[[int, int], object] | None = None,
) -> tuple[Graph, Loops, int]:
    """The optimal graph, its loops, and how many keyframes and candidates were left out.

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
    looks = np.concatenate([descriptors(ends_at[part], valid[part]) for part in parts])
    graph = graph_of(at, keyframe, chain)
    solution: graphs.Solution | None = None
    candidates, matches = _NO_CANDIDATES, _NO_MATCHES
    loops, kept = _judge(candidates, matches, at, total)
    tried: set[tuple[int, int, bool]] = set()
    closed: set[tuple[int, int]] = set()
    left_out = max(int(usable.sum()) - MOST, 0)
    for iteration in range(settings.rounds if len(keyframe) > settings.loop_gap else 0):
        path = np.asarray(graph.poses, np.float64)
        # By the graph few places, since each pair whose covariance is computed fills its
        # factor; after a first optimum the nearest ones fit a window.
        most = PLACES if iteration == 0 else CANDIDATES
        pairs = nearby_pairs(
            path, middle, usable, closed, most, REACH + _WIDE[0], settings.loop_gap
        )
        cov = (
            end_covariances.relative_cov(total, at, pairs[:, 0], pairs[:, 1])
            if solution is None or not len(pairs)
            else relative_covs(solution, pairs)
        )
        new = by_place(path, pairs, cov, tried, _NARROW, _WIDE)
        if iteration == 0:
            new = _concatenate(new, by_appearance(looks, middle, usable, settings.loop_gap, new))
        new, dropped = thin(new)
        left_out += dropped
        if not len(new.first):
            break
        tried |= set(zip(new.first.tolist(), new.second.tolist(), new.wide.tolist(), strict=True))
        candidates = _concatenate(candidates, new)
        matches = _concatenate(
            matches, match_candidates(scans, keyframe, path, new, settings, progress)
        )
        loops, kept = _judge(candidates, matches, at, total)
        closed |= set(zip(loops.first[kept].tolist(), loops.second[kept].tolist(), strict=True))
        edges = table_of(loops.first[kept], loops.second[kept], loops.z[kept], loops.cov[kept])
        graph = graph_of(path, keyframe, chain, edges)
        kernel = _KERNEL if kept.any() else None
        solution = graphs.optimize(graph, kernel=kernel, room=ROOM)
        graph = jax.tree.map(np.asarray, solution.graph)

    # From here on matches in doubt have their wider covariances.
    tables = {
        **graph.tables,
        "relative_pose": table_of(index[:-1], index[1:], steps, odometry.cov[keyframe[1:]]),
    }
    if kept.any():
        squared = np.asarray(graphs.squared_residuals(graph, room=ROOM)[LOOPS])
        doubted = squared > chi2_quantile(_CONSISTENCY, 3)
        loops.outcome[np.flatnonzero(kept)[doubted]] = LoopOutcome.DOUBTED
        tables[LOOPS] = tables[LOOPS]._replace(valid=~doubted)
    graph = graph._replace(tables=tables)
    if kept.any():
        graph = jax.tree.map(np.asarray, graphs.optimize(graph, room=ROOM).graph)
    loops = loops._replace(first=keyframe[loops.first], second=keyframe[loops.second])
    return graph, loops, left_out


def match_candidates(
    scans: Scans,
    keyframe: Int[np.ndarray, "N"],
    path: Float[np.ndarray, "N 3"],
    candidates: Candidates,
    settings: Settings,
    progress: Callable[[int, int], object] | None,
) -> Matches:
    """The match of each candidate, submap by submap, on every core."""
    count = len(candidates.first)
    z, cov = np.zeros((count, 3)), np.zeros((count, 3, 3))
    score, outcome = np.zeros(count), np.zeros(count, int)

    def match_submap(middle: int) -> int:
        """Match the candidates of a submap; returns how many."""
        around = np.arange(
            max(middle - settings.submap, 0), min(middle + settings.submap + 1, len(keyframe))
        )
        submap = reference_of(
            scans, keyframe[around], path[around], path[middle], settings.scans_of_reference
        )
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

    finished = 0

    def advance(matched: int) -> None:
        nonlocal finished
        for _ in range(matched):
            finished += 1
            if progress is not None:
                progress(finished, count)

    submaps = np.unique(candidates.first).tolist()
    # The first submap alone: it compiles the programs that the others share.
    advance(sum(map(match_submap, submaps[:1])))
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        try:
            for matched in pool.map(match_submap, submaps[1:]):
                advance(matched)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return Matches(z, cov, score, outcome)


def _judge(
    candidates: Candidates,
    matches: Matches,
    at: Float[np.ndarray, "N 3"],
    total: Float[np.ndarray, "N 3 3"],
) -> tuple[Loops, Bool[np.ndarray, "M"]]:
    """The candidates with their outcome, and the mask of the clique that agrees.

    `Loops.first` and `second` are rows of the graph.

    Args:
        at, total: poses by odometry, and the sums of their covariances (`end_covariances.along`).
    """
    outcome = matches.outcome.copy()
    good = np.flatnonzero(outcome == LoopOutcome.KEPT)
    first, second = candidates.first[good], candidates.second[good]
    agree = pairwise_consistency(
        at, total, first, second, matches.z[good], matches.cov[good], _CONSISTENCY
    )
    outcome[good[~clique(agree, matches.score[good])]] = LoopOutcome.INCONSISTENT
    loops = Loops(
        first=candidates.first,
        second=candidates.second,
        z=matches.z,
        cov=matches.cov,
        score=matches.score,
        appearance=candidates.appearance.astype(int),
        outcome=outcome,
    )
    return loops, outcome == LoopOutcome.KEPT


def _concatenate(a: _Columns, b: _Columns) -> _Columns:
    """The rows of two tables of the same columns."""
    return type(a)(*(np.concatenate(columns) for columns in zip(a, b, strict=True)))
