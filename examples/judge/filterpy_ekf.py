"""EKF-SLAM with filterpy's ExtendedKalmanFilter, for the draws of a robot with velocities and a
sensor of relative positions at its pose, as those of the worlds `circle` and `loop`:

    pip install filterpy
    python filterpy_ekf.py draws/runs/0000 estimates/0000

The state x is the robot's pose (x, y, theta), then (x, y) of each landmark in the order in which
they are first measured. filterpy has a state of one size; here x, P and the identity of its update
grow.
"""

import csv
import itertools
import sys
import tomllib
from pathlib import Path

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter
from scipy.linalg import block_diag, solve_triangular


class UnicycleSlam(ExtendedKalmanFilter):
    """A robot with velocities, and the landmarks that it has measured."""

    def __init__(self, pose, pose_cov, velocity_noise, sensor_noise):
        super().__init__(dim_x=3, dim_z=2)
        self.x, self.P = pose, pose_cov
        self.velocity_noise, self.R = velocity_noise, sensor_noise
        self.place = {}  # in x, of the landmark with a tag

    def predict_x(self, u=0):
        """Move by u = (v, omega, dt), and set F and Q to the Jacobian and the noise of that."""
        v, omega, dt = u
        c, s = np.cos(self.x[2]), np.sin(self.x[2])
        self.F = np.eye(len(self.x))
        self.F[:2, 2] = -v * dt * s, v * dt * c
        G = np.zeros((len(self.x), 2))
        G[:3] = dt * np.array([[c, 0], [s, 0], [0, 1]])
        self.Q = G @ self.velocity_noise @ G.T
        self.x = self.x.copy()
        self.x[:3] += dt * np.array([v * c, v * s, omega])

    def correct(self, tags, z):
        """Update by the measurements z (M, 2) of landmarks in the map at once."""

        def observe(x):
            p = np.array([x[self.place[tag] : self.place[tag] + 2] for tag in tags])
            return ((p - x[:2]) @ rotation(x[2])).ravel()  # R' (l - p), in rows

        def jacobian(x):
            H, back = np.zeros((2 * len(tags), len(x))), rotation(x[2]).T
            for i, (ahead, left) in enumerate(observe(x).reshape(-1, 2)):
                H[2 * i : 2 * i + 2, :2] = -back
                H[2 * i : 2 * i + 2, 2] = left, -ahead
                H[2 * i : 2 * i + 2, self.place[tags[i]] : self.place[tags[i]] + 2] = back
            return H

        self.update(z.ravel(), jacobian, observe, block_diag(*[self.R] * len(tags)))

    def add(self, tag, z):
        """Add the landmark at l = p + R z."""
        n, offset = len(self.x), rotation(self.x[2]) @ z
        J = np.zeros((2, n))
        J[:, :3] = [[1, 0, -offset[1]], [0, 1, offset[0]]]
        noise = rotation(self.x[2]) @ self.R @ rotation(self.x[2]).T
        self.P = np.block([[self.P, self.P @ J.T], [J @ self.P, J @ self.P @ J.T + noise]])
        self.x = np.concatenate([self.x, self.x[:2] + offset])
        self.place[tag] = n
        self.dim_x, self._I = n + 2, np.eye(n + 2)


def rotation(theta):
    c, s = np.cos(theta), np.sin(theta)
    return np.array([[c, -s], [s, c]])


def table(path, header):
    """The numbers of a CSV file with this header."""
    with path.open() as file:
        if file.readline().strip() != header:
            raise SystemExit(f"{path}: expected {header}")
        return np.loadtxt(file, delimiter=",", ndmin=2)


def write(path, header, rows):
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([header.split(","), *rows])  # floats with all digits


def main(run, estimate):
    odometry = table(run / "odometry.csv", "t [s],v [m/s],omega [rad/s]")
    measured = table(run / "measurements.csv", "t [s],tag,ahead [m],left [m]")
    settings = tomllib.loads((run / "dataset.toml").read_text())
    deviations = (
        settings[section][key]
        for section, key in (("filter", "start_noise"), ("motion", "noise"), ("sensor", "noise"))
    )
    slam = UnicycleSlam(
        np.array(settings["filter"]["start"]), *(np.diag(sigma) ** 2 for sigma in deviations)
    )
    trajectory, innovations = [], []
    for before, now in itertools.pairwise(odometry):
        t = now[0]
        slam.predict(np.array([before[1], before[2], t - before[0]]))
        scan = measured[measured[:, 0] == t, 1:]
        is_known = np.array([tag in slam.place for tag in scan[:, 0]], bool)
        if is_known.any():
            tags = scan[is_known, 0]
            slam.correct(tags, scan[is_known, 1:])
            # Of each number given those before it in the scan, so that they add up to the scan's.
            L = np.linalg.cholesky(slam.S)
            squares = solve_triangular(L, slam.y, lower=True) ** 2
            terms = -(squares + np.log(2 * np.pi * np.diag(L) ** 2)) / 2
            for i, tag in enumerate(tags):
                of_i = slice(2 * i, 2 * i + 2)
                S = slam.S[of_i, of_i]
                innovations.append(
                    [
                        t,
                        tag,
                        *slam.y[of_i],
                        S[0, 0],
                        S[0, 1],
                        S[1, 1],
                        squares[of_i].sum(),
                        terms[of_i].sum(),
                    ]
                )
        for tag, *z in scan[~is_known]:
            slam.add(tag, np.array(z))
        slam.x[2] = np.arctan2(np.sin(slam.x[2]), np.cos(slam.x[2]))
        trajectory.append([t, *slam.x[:3], *slam.P[:3, :3][np.triu_indices(3)]])
    landmarks = [
        [tag, *slam.x[at : at + 2], *slam.P[at : at + 2, at : at + 2][np.triu_indices(2)]]
        for tag, at in slam.place.items()
    ]
    write(estimate / "trajectory.csv", "time,x,y,theta,c_xx,c_xy,c_xt,c_yy,c_yt,c_tt", trajectory)
    write(estimate / "map.csv", "landmark,x,y,c_xx,c_xy,c_yy", landmarks)
    write(
        estimate / "innovations.csv",
        "t,tag,nu_1,nu_2,s_11,s_12,s_22,nis,log_likelihood",
        innovations,
    )


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
