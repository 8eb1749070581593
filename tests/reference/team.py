"""EKF-SLAM of several robots as plain as it gets: NumPy, one vector that grows, dense products.

All robots move by an increment and carry range-bearing sensors. Names index the state: ("robot", b)
for three numbers and ("landmark", tag) for two. Jacobians by hand; shares no line with the package.
"""

import numpy as np

from reference.ekf_slam import increment, range_bearing, wrap


def compose(a, b):
    c, s = np.cos(a[2]), np.sin(a[2])
    x = np.array([a[0] + c * b[0] - s * b[1], a[1] + s * b[0] + c * b[1], wrap(a[2] + b[2])])
    A = np.array(
        [[1, 0, -s * b[0] - c * b[1]], [0, 1, c * b[0] - s * b[1]], [0, 0, 1.0]], dtype=float
    )
    B = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    return x, A, B


def observe(pose, mount, point):
    frame, by_pose, _ = compose(pose, mount)
    h, by_frame, by_point = range_bearing(frame, point)
    return h, by_frame @ by_pose, by_point


def as_point(mount, z, R):
    """The measurement as a point in the robot's frame, with its covariance and Jacobian."""
    c, s = np.cos(mount[2] + z[1]), np.sin(mount[2] + z[1])
    J = np.array([[c, -z[0] * s], [s, z[0] * c]])
    return np.array([mount[0] + z[0] * c, mount[1] + z[0] * s]), J @ R @ J.T


def invert(pose, mount, z):
    frame, by_pose, _ = compose(pose, mount)
    c, s = np.cos(frame[2] + z[1]), np.sin(frame[2] + z[1])
    point = frame[:2] + z[0] * np.array([c, s])
    by_frame = np.array([[1, 0, -z[0] * s], [0, 1, z[0] * c]])
    return point, by_frame @ by_pose, np.array([[c, -z[0] * s], [s, z[0] * c]])


class Team:
    """robots: list of dicts Q (2, 2), sensors [(mount, R)], start (pose, cov) or None."""

    def __init__(self, robots, tags, pose, pose_cov):
        self.robots, self.tags, self.at = robots, list(tags), {}
        self.x, self.P, self.entered = np.zeros(0), np.zeros((0, 0)), []
        self.put(("robot", 0), np.array(pose, float), np.zeros((3, 0)), np.array(pose_cov, float))
        for b, robot in enumerate(robots[1:], 1):
            if robot["start"] is not None:
                mean, cov = robot["start"]
                new, A, B = compose(self.x[:3], mean)
                own = A @ self.P[:3, :3] @ A.T + B @ cov @ B.T
                self.put(("robot", b), new, A @ self.P[:3], own)

    def put(self, name, mean, rows, cov):
        n, k = len(self.x), len(mean)
        P = np.zeros((n + k, n + k))
        P[:n, :n], P[n:, :n], P[:n, n:], P[n:, n:] = self.P, rows, rows.T, cov
        self.at[name] = np.arange(n, n + k)
        self.x, self.P = np.concatenate([self.x, mean]), P

    def predict(self, controls):
        for b, u in enumerate(controls):
            if ("robot", b) not in self.at:
                continue
            i = self.at["robot", b]
            f, F, W = increment(self.x[i], u)
            A, N = np.eye(len(self.x)), np.zeros((len(self.x), 2))
            A[np.ix_(i, i)], N[i] = F, W
            self.x[i] = f
            self.P = A @ self.P @ A.T + N @ self.robots[b]["Q"] @ N.T

    def correct(self, b, mount, R, name, z):
        i, j = self.at["robot", b], self.at[name][:2]
        h, Hx, Hl = observe(self.x[i], mount, self.x[j])
        H = np.zeros((2, len(self.x)))
        H[:, i], H[:, j] = Hx, Hl
        nu = np.array([z[0] - h[0], wrap(z[1] - h[1])])
        S = H @ self.P @ H.T + R
        K = self.P @ H.T @ np.linalg.inv(S)
        self.x = self.x + K @ nu
        for name, k in self.at.items():
            if name[0] == "robot":
                self.x[k[2]] = wrap(self.x[k[2]])
        self.P = self.P - K @ S @ K.T
        self.P = (self.P + self.P.T) / 2

    def use(self, b, scan):
        """scan: (sensor, tag, z) in the order of their places."""
        if ("robot", b) not in self.at:
            return
        for s, (mount, R) in enumerate(self.robots[b]["sensors"]):
            born = []
            for sensor, tag, z in scan:
                if sensor != s:
                    continue
                if tag in self.tags:
                    other = ("robot", self.tags.index(tag))
                    if other in self.at and other[1] != b:
                        self.correct(b, mount, R, other, z)
                elif ("landmark", tag) in self.at:
                    self.correct(b, mount, R, ("landmark", tag), z)
                else:
                    born.append((tag, z))
            for tag, z in born:
                i = self.at["robot", b]
                point, Gx, Gz = invert(self.x[i], mount, z)
                own = Gx @ self.P[np.ix_(i, i)] @ Gx.T + Gz @ R @ Gz.T
                self.put(("landmark", tag), point, Gx @ self.P[i], own)

    def ways_in(self, b, scans):
        """(heading variance, pose, state indices, Jacobian by them, noise, what it used)."""

        def point(a, entry):
            mount, R = self.robots[a]["sensors"][entry[0]]
            return as_point(mount, entry[2], R)

        for a in range(len(self.robots)):
            there = [e for e in scans[a] if e[1] == self.tags[b]]
            back = [e for e in scans[b] if e[1] == self.tags[a]]
            if a == b or ("robot", a) not in self.at or not there or not back:
                continue
            (v, Cv), (w, Cw) = point(a, there[0]), point(b, back[0])
            far, near = np.hypot(*v), np.hypot(*w)
            var_v, var_w = v @ Cv @ v / far**2, w @ Cw @ w / near**2
            share = var_w / (var_v + var_w)
            r, av, aw = share * far + (1 - share) * near, np.arctan2(*v[::-1]), np.arctan2(*w[::-1])
            rel = np.array([r * np.cos(av), r * np.sin(av), av + np.pi - aw])
            by_r = np.array([np.cos(av), np.sin(av), 0.0])
            by_av = np.array([-r * np.sin(av), r * np.cos(av), 1.0])
            Jv = share * np.outer(by_r, v / far) + np.outer(by_av, [-v[1], v[0]]) / far**2
            Jw = (1 - share) * np.outer(by_r, w / near)
            Jw = Jw - np.outer([0, 0, 1.0], [-w[1], w[0]]) / near**2
            i = self.at["robot", a]
            pose, A, B = compose(self.x[i], rel)
            noise = B @ (Jv @ Cv @ Jv.T + Jw @ Cw @ Jw.T) @ B.T
            yield pose, i, A, noise, [(a, there[0]), (b, back[0])]
        known = [e for e in scans[b] if ("landmark", e[1]) in self.at]
        pairs = [
            (np.hypot(*(point(b, e)[0] - point(b, f)[0])), k, m)
            for k, e in enumerate(known)
            for m, f in enumerate(known)
            if k < m and e[1] != f[1]
        ]
        if pairs:
            _, k, m = max(pairs, key=lambda p: p[0])
            i = np.concatenate([self.at["landmark", known[n][1]] for n in (k, m)])
            l1, l2 = self.x[i[:2]], self.x[i[2:]]
            (q1, C1), (q2, C2) = point(b, known[k]), point(b, known[m])
            d, e = l2 - l1, q2 - q1
            th = wrap(np.arctan2(d[1], d[0]) - np.arctan2(e[1], e[0]))
            c, s = np.cos(th), np.sin(th)
            Rot, turned = np.array([[c, -s], [s, c]]), np.array([[-s, -c], [c, -s]])
            q = (q1 + q2) / 2
            pose = np.array([*((l1 + l2) / 2 - Rot @ q), th])
            by_th = np.array([*(-turned @ q), 1.0])
            th_d = np.array([-d[1], d[0]]) / (d @ d)
            th_e = -np.array([-e[1], e[0]]) / (e @ e)
            half = np.vstack([np.eye(2) / 2, np.zeros((1, 2))])
            G = np.hstack([half - np.outer(by_th, th_d), half + np.outer(by_th, th_d)])
            mean_q = np.vstack([-Rot / 2, np.zeros((1, 2))])
            J1, J2 = mean_q - np.outer(by_th, th_e), mean_q + np.outer(by_th, th_e)
            noise = J1 @ C1 @ J1.T + J2 @ C2 @ J2.T
            yield pose, i, G, noise, [(b, known[k]), (b, known[m])]

    def enter(self, b, scans):
        ways = []
        for pose, i, G, noise, used in self.ways_in(b, scans):
            own = G @ self.P[np.ix_(i, i)] @ G.T + noise
            ways.append((own[2, 2], pose, G @ self.P[i], own, used))
        if ways:
            _, pose, rows, own, used = min(ways, key=lambda way: way[0])
            self.put(("robot", b), pose, rows, own)
            self.entered.append("landmarks" if used[0][0] == used[1][0] else "mutual")
            for a, entry in used:
                scans[a] = [e for e in scans[a] if e is not entry]

    def update(self, scans):
        scans = [list(scan) for scan in scans]
        late = [b for b in range(1, len(self.robots)) if self.robots[b]["start"] is None]
        for b in [b for b in range(len(self.robots)) if b not in late] + late:
            if ("robot", b) not in self.at:
                self.enter(b, scans)
            self.use(b, scans[b])
