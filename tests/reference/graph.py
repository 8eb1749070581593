"""χ² of a graph, row by row, and its optimum by SciPy: plain NumPy, written from the equations."""

import numpy as np
import scipy.optimize

from reference.plane import between, wrap


def error(kind, variables, z):
    """e of one row of a table of files."""
    if kind == "relative_pose":
        return between(z, between(*variables))
    if kind == "prior":
        return between(z, variables[0])
    seen = between(variables[0], [*variables[1], 0.0])[:2]
    if kind == "relative_position":
        return seen - z
    assert kind == "bearing"
    return wrap(np.arctan2(seen[1:], seen[:1]) - z)


KINDS = {"prior": ["pose"], "relative_pose": ["pose", "pose"]}


def rows(graph):
    """(kind, kinds of variables, who, z, Ω) of every valid row."""
    for kind, table in graph.tables.items():
        for who, z, information, valid in zip(*table, strict=True):
            if valid:
                yield kind, KINDS.get(kind, ["pose", "point"]), who, z, information


def chi2(graph):
    """Σ eᵀ Ω e."""
    total = 0.0
    for kind, kinds, who, z, information in rows(graph):
        values = [
            (graph.poses if of == "pose" else graph.points)[at]
            for of, at in zip(kinds, who, strict=True)
        ]
        e = error(kind, values, z)
        total += e @ information @ e
    return total


def whitened(graph, error=error, kinds=rows):
    """A function of all free numbers that returns all residuals with |residuals|² = χ², and the
    free numbers of the graph."""
    free_pose, free_point = ~np.asarray(graph.fixed_pose), ~np.asarray(graph.fixed_point)
    every = [(*row[:4], np.linalg.cholesky(row[4]).T) for row in kinds(graph)]

    def placed(x):
        poses, points = np.array(graph.poses), np.array(graph.points)
        poses[free_pose] = x[: 3 * free_pose.sum()].reshape(-1, 3)
        points[free_point] = x[3 * free_pose.sum() :].reshape(-1, points.shape[1])
        return poses, points

    def residuals(x):
        poses, points = placed(x)
        out = []
        for kind, of, who, z, root in every:
            values = [(poses if o == "pose" else points)[at] for o, at in zip(of, who, strict=True)]
            out.append(root @ error(kind, values, z))
        return np.concatenate(out)

    start = np.concatenate([graph.poses[free_pose].ravel(), graph.points[free_point].ravel()])
    return residuals, start, placed


def optimum(graph):
    """Poses, points and χ² at SciPy's least squares from the graph's own values."""
    residuals, start, placed = whitened(graph)
    found = scipy.optimize.least_squares(residuals, start, xtol=1e-15, ftol=1e-15, gtol=1e-13)
    return (*placed(found.x), 2 * found.cost)
