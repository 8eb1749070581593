"""Robocentric EKF-SLAM as Castellanos et al. 2007 write it, plain: predict, update, compose.

The state is (b, m_1, …): the world's origin and the landmarks seen from the robot. A step appends
the motion (x, y, θ) as a variable of its own, updates everything by a scan of relative positions
seen from where the motion leads, then composes all with it and forgets it. Jacobians are central
differences of the functions as they stand.
"""

import numpy as np


def inverse(a):
    c, s = np.cos(a[2]), np.sin(a[2])
    return np.array([-c * a[0] - s * a[1], s * a[0] - c * a[1], -a[2]])


def compose(a, b):
    c, s = np.cos(a[2]), np.sin(a[2])
    return np.array([a[0] + c * b[0] - s * b[1], a[1] + s * b[0] + c * b[1], a[2] + b[2]])


def to_frame(frame, point):
    d, c, s = point - frame[:2], np.cos(frame[2]), np.sin(frame[2])
    return np.array([c * d[0] + s * d[1], -s * d[0] + c * d[1]])


def differences(f, x, step=1e-6):
    columns = []
    for k in range(len(x)):
        h = step * np.eye(len(x))[k]
        columns.append((f(x + h) - f(x - h)) / (2 * step))
    return np.array(columns).T


class Robocentric:
    """A filter for controls (v, ω, Δt), Euler steps, and relative positions with noise R."""

    def __init__(self, pose, pose_cov, q, r):
        self.x = inverse(pose)
        by = differences(inverse, pose)
        self.p, self.q, self.r, self.tags = by @ pose_cov @ by.T, q, r, []

    def step(self, u, z, tags):
        v, omega, dt = u
        motion = np.array([v * dt, 0.0, omega * dt])
        by_noise = np.array([[dt, 0.0], [0.0, 0.0], [0.0, dt]])
        n = len(self.x)
        x = np.concatenate([self.x, motion])
        p = np.zeros((n + 3, n + 3))
        p[:n, :n], p[n:, n:] = self.p, by_noise @ self.q @ by_noise.T
        known = [i for i, tag in enumerate(tags) if tag in self.tags]
        if known:
            at = [3 + 2 * self.tags.index(tags[i]) for i in known]

            def h(x):
                return np.concatenate([to_frame(x[n:], x[k : k + 2]) for k in at])

            by = differences(h, x)
            s = by @ p @ by.T + np.kron(np.eye(len(known)), self.r)
            gain = np.linalg.solve(s, by @ p).T
            x = x + gain @ (np.concatenate([z[i] for i in known]) - h(x))
            p = p - gain @ s @ gain.T

        def composed(x):
            parts = [compose(inverse(x[n:]), x[:3])]
            parts += [to_frame(x[n:], x[k : k + 2]) for k in range(3, n, 2)]
            return np.concatenate(parts)

        by = differences(composed, x)
        self.x, self.p = composed(x), by @ p @ by.T
        for i, tag in enumerate(tags):
            if tag not in self.tags:
                self.tags.append(tag)
                self.x = np.concatenate([self.x, z[i]])
                size = len(self.p)
                self.p = np.block([[self.p, np.zeros((size, 2))], [np.zeros((2, size)), self.r]])

    def pose(self):
        return inverse(self.x[:3])

    def pose_cov(self):
        by = differences(inverse, self.x[:3])
        return by @ self.p[:3, :3] @ by.T

    def points(self):
        pose = self.pose()
        return {
            tag: compose(pose, np.append(self.x[3 + 2 * i : 5 + 2 * i], 0.0))[:2]
            for i, tag in enumerate(self.tags)
        }
