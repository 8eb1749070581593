"""Free space between walls in plain NumPy, by angles rather than by the package's crossings."""

import numpy as np


def is_free(walls, points):
    """Whether an odd number of walls encloses each point (…, 2).

    A chain of segments turns by ±2π about a point inside it, and by 0 about a point outside: the sum
    over all chains is an odd number of turns where an odd number of chains is around the point.
    """
    points = np.asarray(points, float)
    angle = np.zeros(points.shape[:-1])
    for start, end in np.asarray(walls.segments):
        a, b = start - points, end - points
        cross = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
        angle += np.arctan2(cross, (a * b).sum(axis=-1))
    walls_around = np.round(angle / (2 * np.pi)).astype(int)
    for x, y, radius in np.asarray(walls.circles):
        walls_around += ((points - [x, y]) ** 2).sum(axis=-1) < radius**2
    return walls_around % 2 == 1
