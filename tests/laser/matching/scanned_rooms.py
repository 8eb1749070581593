"""Pairs of scans of a square room in NumPy: exact ranges of a box, noise, and the true pose; and the
best step to lines, by the roots of a polynomial."""

import numpy as np
from numpy.polynomial import Polynomial
from reference.plane import from_frame

from jaxslam.laser.matching import Points

BEAMS = 60
SIGMA = 0.01
HALF = 3.0
"""half the side of the room [m]"""


def box_ranges(pose, angles, half=(HALF, HALF)):
    """Exact ranges to the sides of a box about the origin, seen from within."""
    heading = pose[2] + angles
    unit = np.stack([np.cos(heading), np.sin(heading)], axis=1)
    with np.errstate(divide="ignore"):
        each = (np.sign(unit) * half - pose[:2]) / unit
    return np.where(np.isfinite(each), each, np.inf).min(axis=1)


def points_at(pose, rng, sigma=SIGMA, half=(HALF, HALF), beams=BEAMS):
    """The points of a scan in the frame of the robot."""
    angles = 2 * np.pi * np.arange(beams) / beams - np.pi
    ray = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    ranges = box_ranges(pose, angles, half) + sigma * rng.standard_normal(beams)
    return Points(ranges[:, None] * ray, ray, np.ones(beams, bool))


def stacked(parts):
    return type(parts[0])(*(np.stack(column) for column in zip(*parts, strict=True)))


def pairs(count, seed=0, sigma=SIGMA, half=(HALF, HALF), off=(0.05, 0.05, 0.03), beams=BEAMS):
    """(references of so many beams, scans, true poses of the scans in the references' frames, starts)."""
    rng = np.random.default_rng(seed)
    references, scans, truth, starts = [], [], [], []
    for _ in range(count):
        first = rng.uniform(-1, 1, 3) * [0.8, 0.8, np.pi]
        step = rng.uniform(-1, 1, 3) * [0.2, 0.1, 0.1]
        second = np.append(from_frame(first, step[:2]), first[2] + step[2])
        references.append(points_at(first, rng, sigma, half, beams))
        scans.append(points_at(second, rng, sigma, half))
        truth.append(step)
        starts.append(step + off * rng.standard_normal(3))
    return stacked(references), stacked(scans), np.stack(truth), np.stack(starts)


def by_polynomial(source, target, normal, weight):
    """The least Σ w (n·(R s + t - q))² over all real stationary points, by a quartic in λ."""
    rows = np.concatenate(
        [
            normal,
            (normal * source).sum(axis=1)[:, None],
            (normal[:, 1] * source[:, 0] - normal[:, 0] * source[:, 1])[:, None],
        ],
        axis=1,
    )
    m = (weight[:, None] * rows).T @ rows
    g = -2 * (weight * (normal * target).sum(axis=1)) @ rows
    a, b, d = m[:2, :2], m[:2, 2:], m[2:, 2:]
    s = d - b.T @ np.linalg.solve(a, b)
    h = g[2:] - b.T @ np.linalg.solve(a, g[:2])
    # |adj(2S + 2λ) h|² = det(2S + 2λ)².
    entry = [[Polynomial([2 * s[i, j], 2.0 * (i == j)]) for j in range(2)] for i in range(2)]
    det = entry[0][0] * entry[1][1] - entry[0][1] * entry[1][0]
    u = entry[1][1] * h[0] - entry[0][1] * h[1]
    v = entry[0][0] * h[1] - entry[1][0] * h[0]
    best = None
    for root in (u * u + v * v - det * det).roots():
        if abs(root.imag) < 1e-9:
            r = np.linalg.solve(-2 * (s + root.real * np.eye(2)), h)
            t = np.linalg.solve(a, -g[:2] / 2 - b @ r)
            pose = np.array([*t, np.arctan2(r[1], r[0])])
            value = line_cost(pose, source, target, normal, weight)
            if best is None or value < best[0]:
                best = value, pose
    return best


def line_cost(pose, source, target, normal, weight):
    return (weight * (normal * (from_frame(pose, source) - target)).sum(axis=1) ** 2).sum()
