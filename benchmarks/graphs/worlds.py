"""Graphs with true poses, their noisy measurements, and false loop closures."""

from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.real_data import DATA
from jaxslam import graphs
from jaxslam.graphs import Graph, Table
from jaxslam.graphs.graph import LOOPS
from jaxslam.math import se2

MANHATTAN = Path(DATA) / "graphs" / "manhattanOlson3500.g2o"
TRUTH = Path(DATA) / "graphs" / "manhattanOlson3500_nodes_groundTruth.dat"


def manhattan(poses=None):
    """The Manhattan world at its true poses: the first `poses` of them, and what joins these."""
    graph = graphs.read(MANHATTAN)
    truth = np.loadtxt(TRUTH)[: len(graph.poses)]
    count = len(truth) if poses is None else poses
    (name, table), *_ = graph.tables.items()
    inside = (np.asarray(table.who) < count).all(axis=1)
    cut = Table(*(np.asarray(leaf)[inside] for leaf in table))
    return at(truth[:count], {name: cut})


def ring(poses=100, closures=20, seed=0):
    """A robot drives round a square of `poses` poses twice; the second round closes loops."""
    rng = np.random.default_rng(seed)
    per_round = poses // 2
    side = max(per_round // 4, 1)
    truth = np.zeros((poses, 3))
    for k in range(1, poses):
        x, y, heading = truth[k - 1]
        turn = np.pi / 2 if k % side == 0 else 0.0
        truth[k] = x + np.cos(heading), y + np.sin(heading), heading + turn
    truth[:, 2] = np.angle(np.exp(1j * truth[:, 2]))
    chain = np.stack([np.arange(poses - 1), np.arange(1, poses)], axis=1)
    first = rng.choice(poses - 4 * side, closures, replace=False)
    loops = np.stack([first, first + 4 * side], axis=1)
    who = np.concatenate([chain, loops])
    information = np.tile(np.diag([400.0, 400.0, 2500.0]), (len(who), 1, 1))
    table = Table(who, np.zeros((len(who), 3)), information, np.ones(len(who), bool))
    return at(truth, {"relative_pose": table})


def at(truth, tables):
    """A graph at its true poses, whose first is known."""
    fixed = np.arange(len(truth)) == 0
    nothing = np.zeros((0, 2))
    return Graph(
        truth, nothing, tables, fixed, np.zeros(0, bool), np.arange(len(truth)), np.zeros(0, int)
    )


def measured(graph, key, scale=1.0):
    """The graph with relative poses drawn around its own: e ~ N(0, scale² Ω⁻¹), Ω as the file has
    it over scale²."""
    (name, table), *_ = graph.tables.items()
    who, information = jnp.asarray(table.who), jnp.asarray(table.information)
    root = jnp.linalg.cholesky(jnp.linalg.inv(information))
    noise = jax.random.normal(key, (len(who), 3))
    error = scale * jnp.einsum("eij,ej->ei", root, noise)
    poses = jnp.asarray(graph.poses)
    true = jax.vmap(se2.between)(poses[who[:, 0]], poses[who[:, 1]])
    z = jax.vmap(lambda t, e: se2.compose(t, se2.inverse(e)))(true, error)
    drawn = table._replace(z=z, information=information / scale**2)
    return graph._replace(tables=graph.tables | {name: drawn})


class Mixed(NamedTuple):
    """A graph in two tables, odometry and loops, some of which are false."""

    graph: Graph
    loops: str
    """the table of loops"""
    false: np.ndarray
    """(E,) which of them are"""


def with_false_closures(graph, share, seed=0):
    """The graph with false loops, a `share` of all loops (`with_false_loops`)."""
    apart = graphs.with_loops_apart(graph)
    count = len(apart.tables[LOOPS].who)
    wanted = int(share / (1 - share) * count)
    mixed = with_false_loops(apart, wanted, seed)
    return Mixed(mixed, LOOPS, np.arange(count + wanted) >= count)


def with_false_loops(apart, wanted, seed=0):
    """The graph, with its loops apart, and so many false ones: between poses drawn at random, at
    the relative pose of a true loop."""
    rng = np.random.default_rng(seed)
    loops, poses = Table(*map(np.asarray, apart.tables[LOOPS])), len(apart.poses)
    source, first = rng.integers(len(loops.who), size=wanted), rng.integers(poses, size=wanted)
    second = (first + rng.integers(5, poses - 5, size=wanted)) % poses
    both = Table(
        np.concatenate([loops.who, np.stack([first, second], axis=1)]),
        np.concatenate([loops.z, loops.z[source]]),
        np.concatenate([loops.information, loops.information[source]]),
        np.ones(len(loops.who) + wanted, bool),
    )
    return apart._replace(tables=apart.tables | {LOOPS: both})
