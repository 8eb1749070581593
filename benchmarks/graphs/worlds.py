"""Graphs with true poses, their noisy measurements, and false loop closures."""

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.real_data import DATA
from jaxslam import datasets, graphs
from jaxslam.graphs import Graph, Table
from jaxslam.graphs._graph import LOOPS
from jaxslam.math import se2

MANHATTAN = DATA / "graphs" / "manhattanOlson3500.g2o"
TRUTH = DATA / "graphs" / "manhattanOlson3500_nodes_groundTruth.dat"


def manhattan():
    """The Manhattan world at its true poses."""
    graph = datasets.read_graph(MANHATTAN)
    return at(np.loadtxt(TRUTH)[: len(graph.poses)], jax.tree.map(np.asarray, graph.tables))


def ring(poses=100, closures=20):
    """A robot drives round a square of `poses` poses twice; the second round closes loops."""
    rng = np.random.default_rng(0)
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


def with_false_closures(graph, share):
    """The graph with its loops apart and false ones among them, a `share` of all, and which (E,)
    these are (`with_false_loops`)."""
    apart = graphs.with_loops_apart(graph)
    count = len(apart.tables[LOOPS].who)
    wanted = int(share / (1 - share) * count)
    return with_false_loops(apart, wanted), np.arange(count + wanted) >= count


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
