"""Loop edges in a table of their own, so that they can have a robust kernel."""

import numpy as np

from jaxslam.graphs.graph import Graph, Table

LOOPS = "relative_pose/loops"


def with_loops_apart(graph: Graph) -> Graph:
    """The graph with its loop edges in the table "relative_pose/loops".

    They are the rows of `relative_pose` between poses whose indices do not follow each other; those
    of the odometry stay. `graphs.optimize(graph, kernel={"relative_pose/loops": graphs.dcs()})`
    then doubts the loops alone. Concrete graphs only; a table without rows is left out.
    """
    tables: dict[str, Table] = {}
    for key, table in graph.tables.items():
        if key != "relative_pose":
            tables[key] = table
            continue
        who = np.asarray(table.who)
        along = np.abs(who[:, 1] - who[:, 0]) == 1
        for name, rows in ((key, along), (LOOPS, ~along)):
            if rows.any():
                tables[name] = Table(*(part[rows] for part in table))
    return graph._replace(tables=tables)
