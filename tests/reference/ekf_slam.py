"""EKF-SLAM as plain as it gets: NumPy, matrices that grow, hand Jacobians, dense textbook products.

Written from the equations of the guide (Solà 9, 10, 19-23, 31-38) and its list of errata, sharing
no line with the package; slow and obvious on purpose. A model is a function that returns its value
and its Jacobians.
"""

import numpy as np
import scipy.linalg


def wrap(a):
    return np.arctan2(np.sin(a), np.cos(a))


def increment(pose, u):
    x, y, th = pose
    d, turn = u
    c, s = np.cos(th), np.sin(th)
    f = np.array([x + d * c, y + d * s, wrap(th + turn)])
    F = np.array([[1, 0, -d * s], [0, 1, d * c], [0, 0, 1]])
    W = np.array([[c, 0], [s, 0], [0, 1]])
    return f, F, W


def unicycle(pose, u):
    v, w, dt = u
    f, F, W = increment(pose, (v * dt, w * dt))
    return f, F, W * dt


def range_bearing(pose, lm):
    x, y, th = pose
    dx, dy = lm[0] - x, lm[1] - y
    r = np.sqrt(dx * dx + dy * dy)
    h = np.array([r, wrap(np.arctan2(dy, dx) - th)])
    Hx = np.array([[-dx / r, -dy / r, 0], [dy / r**2, -dx / r**2, -1]])
    Hl = np.array([[dx / r, dy / r], [-dy / r**2, dx / r**2]])
    return h, Hx, Hl


def range_bearing_inverse(pose, z):
    x, y, th = pose
    r, b = z
    c, s = np.cos(th + b), np.sin(th + b)
    lm = np.array([x + r * c, y + r * s])
    Gx = np.array([[1, 0, -r * s], [0, 1, r * c]])
    Gz = np.array([[c, -r * s], [s, r * c]])
    return lm, Gx, Gz


def relative_position(pose, lm):
    x, y, th = pose
    dx, dy = lm[0] - x, lm[1] - y
    c, s = np.cos(th), np.sin(th)
    h = np.array([c * dx + s * dy, -s * dx + c * dy])
    Hx = np.array([[-c, -s, -s * dx + c * dy], [s, -c, -c * dx - s * dy]])
    Hl = np.array([[c, s], [-s, c]])
    return h, Hx, Hl


def relative_position_inverse(pose, z):
    x, y, th = pose
    c, s = np.cos(th), np.sin(th)
    lm = np.array([x + c * z[0] - s * z[1], y + s * z[0] + c * z[1]])
    Gx = np.array([[1, 0, -s * z[0] - c * z[1]], [0, 1, c * z[0] - s * z[1]]])
    Gz = np.array([[c, -s], [s, c]])
    return lm, Gx, Gz


def run(
    pose,
    pose_cov,
    controls,
    scans,
    *,
    motion,
    observe,
    invert,
    Q,
    R,
    bearing=None,
    joint=False,
    gate=np.inf,
    births=None,
):
    """Filter a log; scans[t] is a list of (tag, z). Yields (x, P, tags in order of birth) a step.

    R: a covariance, or a function of the predicted measurement; of z for a new landmark.
    bearing: which entry of z is an angle.
    """
    x, P, tags = np.array(pose, float), np.array(pose_cov, float), []
    noise = R if callable(R) else lambda z: R

    def residual(z, h):
        nu = z - h
        if bearing is not None:
            nu[bearing] = wrap(nu[bearing])
        return nu

    def rows(x, P, tag, z):
        at = 3 + 2 * tags.index(tag)
        h, Hx, Hl = observe(x[:3], x[at : at + 2])
        H = np.zeros((len(z), len(x)))
        H[:, :3], H[:, at : at + 2] = Hx, Hl
        return residual(z, h), H, noise(h)

    def update(x, P, nu, H, R):
        S = H @ P @ H.T + R
        K = P @ H.T @ np.linalg.inv(S)
        x = x + K @ nu
        x[2] = wrap(x[2])
        P = P - K @ S @ K.T
        return x, (P + P.T) / 2

    for u, scan in zip(controls, scans, strict=True):
        f, F, W = motion(x[:3], u)
        big_F, big_W = np.eye(len(x)), np.zeros((len(x), W.shape[1]))
        big_F[:3, :3], big_W[:3] = F, W
        x = np.concatenate([f, x[3:]])
        P = big_F @ P @ big_F.T + big_W @ Q @ big_W.T

        known = [(tag, z) for tag, z in scan if tag in tags]
        if joint:
            accepted = []
            for tag, z in known:
                nu, H, R_hat = rows(x, P, tag, z)
                if nu @ np.linalg.inv(H @ P @ H.T + R_hat) @ nu <= gate:
                    accepted.append((nu, H, R_hat))
            if accepted:
                nu, H = (np.concatenate([row[k] for row in accepted]) for k in (0, 1))
                x, P = update(x, P, nu, H, scipy.linalg.block_diag(*(R for *_, R in accepted)))
        else:
            for tag, z in known:
                nu, H, R_hat = rows(x, P, tag, z)
                if nu @ np.linalg.inv(H @ P @ H.T + R_hat) @ nu <= gate:
                    x, P = update(x, P, nu, H, R_hat)

        new = [(tag, z) for tag, z in scan if tag not in tags]
        for tag, z in new[:births]:
            lm, Gx, Gz = invert(x[:3], z)
            n = len(x)
            big = np.zeros((n + 2, n + 2))
            big[:n, :n] = P
            big[n:, :n] = Gx @ P[:3]
            big[:n, n:] = big[n:, :n].T
            big[n:, n:] = Gx @ P[:3, :3] @ Gx.T + Gz @ noise(z) @ Gz.T
            x, P = np.concatenate([x, lm]), big
            tags.append(tag)
        yield x.copy(), P.copy(), list(tags)
