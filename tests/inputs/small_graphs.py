"""A small graph with every kind of table, drawn from a truth, for several tests."""

import numpy as np
from reference import plane

from jaxslam.graphs import Graph, Table

POSES, POINTS = 8, 3


def drawn(noise=0.0, seed=0, **change):
    """A graph of 8 poses on a circle and 3 points, at its truth; measurements with some noise."""
    random = np.random.default_rng(seed)
    around = 2 * np.pi * np.arange(POSES) / POSES
    poses = np.stack([3 * np.cos(around), 3 * np.sin(around), plane.wrap(around + 1.2)], axis=1)
    points = np.array([[0.5, 0.25], [-5.0, 1.0], [2.0, -4.0]])
    pairs = [(i, i + 1) for i in range(POSES - 1)] + [(7, 0), (2, 6), (5, 1)]
    seen = [(i, (i + k) % POINTS) for i in range(POSES) for k in (0, 1)]

    def table(who, truth):
        z = np.array([truth(*pair) for pair in who])
        size = z.shape[1]
        root = random.normal(size=(len(who), size, size)) + 2 * np.eye(size)
        information = root @ np.swapaxes(root, 1, 2)
        z = z + noise * random.normal(size=z.shape)
        return Table(np.array(who, np.int32), z, information, np.ones(len(who), bool))

    def at(i, k):
        return plane.between(poses[i], [*points[k], 0.0])[:2]

    graph = Graph(
        poses=poses,
        points=points,
        tables={
            "relative_pose": table(pairs, lambda i, j: plane.between(poses[i], poses[j])),
            "relative_position": table(seen, at),
            "bearing": table(seen[:5], lambda i, k: [np.arctan2(*at(i, k)[::-1])]),
            "prior": table([(3,)], lambda i: poses[i]),
        },
        fixed_pose=np.arange(POSES) == 0,
        fixed_point=np.zeros(POINTS, bool),
        pose_id=np.arange(10, 10 + POSES, dtype=np.int32),
        point_id=np.arange(POINTS, dtype=np.int32),
    )
    return graph._replace(**change)


def only(graph, *keys):
    """The graph with some of its tables."""
    return graph._replace(tables={key: graph.tables[key] for key in keys})
