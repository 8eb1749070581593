"""Poses and angles of the plane in plain NumPy, by complex numbers and homogeneous matrices."""

import numpy as np


def wrap(angle):
    """To (-π, π], by complex numbers rather than by the package's formula."""
    wrapped = np.angle(np.exp(1j * np.asarray(angle)))
    return np.where(wrapped <= -np.pi, np.pi, wrapped)


def turn(theta):
    """R(θ) (…, 2, 2)."""
    c, s = np.cos(theta), np.sin(theta)
    return np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)


def from_frame(pose, point):
    """The points (…, 2) of the frames `pose` (…, 3), in the map."""
    pose = np.asarray(pose, float)
    return pose[..., :2] + np.einsum("...ij,...j->...i", turn(pose[..., 2]), point)


def to_frame(pose, point):
    """The points (…, 2) of the map, in the frames `pose` (…, 3)."""
    pose = np.asarray(pose, float)
    return np.einsum("...ji,...j->...i", turn(pose[..., 2]), point - pose[..., :2])


def compose(a, b):
    """The pose b (…, 3) of the frame a, in the map."""
    a, b = np.asarray(a, float), np.asarray(b, float)
    return np.concatenate([from_frame(a, b[..., :2]), wrap(a[..., 2:] + b[..., 2:])], axis=-1)


def between(a, b):
    """The pose b (…, 3) of the map, in the frame of a."""
    a, b = np.asarray(a, float), np.asarray(b, float)
    return np.concatenate([to_frame(a, b[..., :2]), wrap(b[..., 2:] - a[..., 2:])], axis=-1)


def mounted(pose, mount):
    """pose ∘ mount (…, 3), the heading not wrapped."""
    at = from_frame(pose, np.asarray(mount)[:2])
    return np.concatenate([at, pose[..., 2:] + mount[2]], axis=-1)


def matrix(pose):
    x, y, theta = np.asarray(pose, float)
    c, s = np.cos(theta), np.sin(theta)
    return np.array([[c, -s, x], [s, c, y], [0, 0, 1]])


def pose_of(frame):
    return np.array([frame[0, 2], frame[1, 2], np.arctan2(frame[1, 0], frame[0, 0])])


def assert_same_poses(actual, expected, atol=1e-12):
    """Positions to atol, relative to the largest; headings on the circle, those of `actual` wrapped."""
    actual, expected = np.asarray(actual), np.asarray(expected)
    scale = 1 + np.abs(expected[..., :2]).max()
    np.testing.assert_allclose(actual[..., :2], expected[..., :2], rtol=0, atol=atol * scale)
    np.testing.assert_allclose(wrap(actual[..., 2] - expected[..., 2]), 0, atol=atol)
    assert np.all(np.abs(actual[..., 2]) <= np.pi)
