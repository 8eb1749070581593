"""A descriptor of a scan that does not change when the robot turns on the spot."""

import numpy as np
from jaxtyping import Bool, Float

RINGS, SECTORS = 12, 60


def descriptors(
    points: Float[np.ndarray, "n B 2"], valid: Bool[np.ndarray, "n B"], *, reach: float = 12.0
) -> Float[np.ndarray, "n D"]:
    """The descriptors of n scans, of length one (zero for a scan without points).

    Points are counted in rings and sectors about the robot, and a turn of the robot shifts the
    sectors: the sizes of the Fourier coefficients along them stay, up to the size of a sector. The
    table is that of Kim & Kim 2018, "Scan context", IROS, which compares shifts instead.
    """
    far = np.hypot(points[..., 0], points[..., 1])
    turn = np.arctan2(points[..., 1], points[..., 0]) / (2 * np.pi) % 1.0
    ring = np.minimum((RINGS * np.sqrt(far / reach)).astype(int), RINGS - 1)
    sector = np.minimum((SECTORS * turn).astype(int), SECTORS - 1)
    table = np.zeros((len(points), RINGS, SECTORS))
    which = np.broadcast_to(np.arange(len(points))[:, None], valid.shape)
    np.add.at(table, (which[valid], ring[valid], sector[valid]), 1.0)
    sizes = np.abs(np.fft.rfft(np.sqrt(table), axis=2))[:, :, : SECTORS // 4]
    sizes[:, :, 0] *= 0.5
    flat = sizes.reshape(len(points), -1)
    length = np.linalg.norm(flat, axis=1, keepdims=True)
    return np.divide(flat, length, out=np.zeros_like(flat), where=length > 0)
