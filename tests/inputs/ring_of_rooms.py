"""A robot that drives twice round a square corridor with a laser, in NumPy: a small log with loops."""

import numpy as np

from jaxslam.core.types import Beams
from jaxslam.laser.laser_slam import ScanLog, Settings, _odometry, _scan_points
from jaxslam.math import numpy_poses as poses

SETTINGS = Settings(
    beams=60,
    fewest=10,
    loop_gap=12,
    submap=2,
    submap_every=1,
    reference=4,
    resolution=0.1,
    sigma=0.01,
)
SIDE, STEP, FAR = 6.0, 1.0, 8.0
_OUTER = [(-1, -1), (7, -1), (7, 2.5), (7.4, 2.5), (7.4, 3.2), (7, 3.2), (7, 7), (-1, 7)]
_INNER = [(1, 1), (5, 1), (5, 3.8), (5, 5), (2.2, 5), (2.2, 4.6), (1, 4.6)]
_NICHE = [(3.0, -0.4), (3.6, -0.4), (3.6, -1.0), (3.0, -1.0)]


def walls():
    """(K, 2, 2) the ends of the segments."""
    chains = [np.array(chain, float) for chain in (_OUTER, _INNER, _NICHE)]
    return np.concatenate([np.stack([c, np.roll(c, -1, axis=0)], axis=1) for c in chains])


def ranges_of(pose, angles, segments):
    """Exact ranges by the crossing of each beam with each segment."""
    e = np.stack([np.cos(pose[2] + angles), np.sin(pose[2] + angles)], axis=1)[:, None]
    a, along = segments[None, :, 0] - pose[:2], (segments[:, 1] - segments[:, 0])[None]
    cross = e[..., 0] * along[..., 1] - e[..., 1] * along[..., 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        r = (a[..., 0] * along[..., 1] - a[..., 1] * along[..., 0]) / cross
        share = (a[..., 0] * e[..., 1] - a[..., 1] * e[..., 0]) / cross
    met = (np.abs(cross) > 1e-12) & (r > 0) & (share >= 0) & (share <= 1)
    return np.minimum(np.where(met, r, FAR).min(axis=1), FAR)


def driven(scans=40, beams=60, seed=0, drift=(0.03, 0.03, 0.03), mount=(0.0, 0.0, 0.0), scale=1.0):
    """(true poses, log): steps of a metre, a quarter turn at each corner on the way.

    mount: pose of the laser on the robot. scale: of the walls and steps.
    """
    random = np.random.default_rng(seed)
    step = scale * STEP
    side = [[step, 0.0, 0.0]] * 5 + [[step, 0.0, np.pi / 2]]
    steps = np.array((side * 12)[: scans - 1])
    true = poses.chain(np.zeros(3), steps)
    raw = poses.chain(np.zeros(3), steps + random.normal(size=steps.shape) * drift)
    angles = np.linspace(-np.pi, np.pi, beams, endpoint=False)
    laser = poses.compose(true, np.array(mount, float))
    found = np.array([ranges_of(pose, angles, scale * walls()) for pose in laser])
    noisy = np.where(found < FAR, found + 0.01 * random.normal(size=found.shape), FAR)
    shape = found.shape
    beams_of = Beams(noisy, np.broadcast_to(angles, shape), np.ones(shape, bool))
    return true, ScanLog(np.arange(float(scans)), beams_of, raw, FAR, mount)


def errors(estimate, true):
    """(position [m], heading [rad]) of each pose, both from the same first pose."""
    off = poses.between(true, estimate)
    return np.hypot(off[:, 0], off[:, 1]), np.abs(off[:, 2])


# --- the steps of `laser_slam.solve`, with the settings of the ring -------------------------------


def scans_of(log):
    """The scans of a log as points in the robot's frame."""
    return _scan_points.scans_of(log, SETTINGS)


def steps_of(raw, *parts, settings=SETTINGS):
    """The steps of raw odometry (T, 3); parts: time, changed, known, as far as the log has them."""
    return _odometry.raw.steps_of(raw, settings, *parts)


def odometry_of(scans, steps, first, *progress):
    """The laser odometry of scans and raw steps, from the first pose on."""
    return _odometry.log_odometry.laser_odometry(scans, steps, SETTINGS, first, *progress)
