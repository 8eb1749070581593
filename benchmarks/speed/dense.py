"""A peer: EKF-SLAM as a textbook writes it in NumPy, dense H and P, one landmark at a time."""

import numpy as np


def dense_ekf(log, pose, noise_u, noise_z, gate=9.0):
    """The final pose along a log of `cloister`: control (T, 2), z (T, M, 2), tag (T, M)."""
    x, cov, at = np.array(pose, float), np.zeros((3, 3)), {}
    for (forward, turn), z, tags in zip(*log, strict=True):
        size = len(x)
        c, s = np.cos(x[2]), np.sin(x[2])
        by_x, by_u = np.eye(size), np.zeros((size, 2))
        by_x[:2, 2] = [-forward * s, forward * c]
        by_u[:3] = [[c, 0], [s, 0], [0, 1]]
        x[:3] += [forward * c, forward * s, turn]
        cov = by_x @ cov @ by_x.T + by_u @ noise_u @ by_u.T
        for tag, seen in zip(tags, z, strict=True):
            if tag not in at:
                continue
            i = at[tag]
            dx, dy = x[i : i + 2] - x[:2]
            r2 = dx * dx + dy * dy
            r = np.sqrt(r2)
            h = np.zeros((2, size))
            h[:, :3] = [[-dx / r, -dy / r, 0], [dy / r2, -dx / r2, -1]]
            h[:, i : i + 2] = [[dx / r, dy / r], [-dy / r2, dx / r2]]
            nu = seen - [r, np.arctan2(dy, dx) - x[2]]
            nu[1] = np.angle(np.exp(1j * nu[1]))
            inverse = np.linalg.inv(h @ cov @ h.T + noise_z)
            if nu @ inverse @ nu > gate:
                continue
            gain = cov @ h.T @ inverse
            x = x + gain @ nu
            cov = (np.eye(size) - gain @ h) @ cov
        new = [k for k, tag in enumerate(tags) if tag not in at][:1]
        for k in new:
            r, bearing = z[k, 0], z[k, 1] + x[2]
            c, s = np.cos(bearing), np.sin(bearing)
            by_x = np.zeros((2, size))
            by_x[:, :3] = [[1, 0, -r * s], [0, 1, r * c]]
            by_z = np.array([[c, -r * s], [s, r * c]])
            cross = by_x @ cov
            own = cross @ by_x.T + by_z @ noise_z @ by_z.T
            cov = np.block([[cov, cross.T], [cross, own]])
            at[tags[k]] = size
            x = np.concatenate([x, x[:2] + r * np.array([c, s])])
    return np.array([x[0], x[1], np.angle(np.exp(1j * x[2]))])
