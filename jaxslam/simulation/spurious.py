"""What sensors get wrong beyond noise: clutter, misses, outliers, wrong labels."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.math.linalg import is_concrete, root_psd
from jaxslam.protocols import Sensor
from jaxslam.types import Scan

Array = jax.Array


@dataclass(frozen=True)
class Spurious:
    """How often a scan is wrong; Williams, "sensors aren't perfect".

    A false measurement is that of a point drawn uniformly from a square of half-width `reach`
    around the robot. Raises ValueError on a probability outside 0 to 1, a negative clutter, or
    false measurements without a reach.
    """

    clutter: float = 0.0
    """false measurements a scan, on average: binomial, over 2·clutter further places, rounded up"""
    missed: float = 0.0
    """probability that a landmark in view is not measured"""
    outliers: float = 0.0
    """probability that a measurement is false, though its tag is right"""
    mislabelled: float = 0.0
    """probability that a tag is wrong: those of a scan that are, trade tags in a circle (one alone
    keeps its own)"""
    reach: float = 0.0
    """[m]"""

    def __post_init__(self) -> None:
        for name in ("missed", "outliers", "mislabelled"):
            value = getattr(self, name)
            if is_concrete(value) and not 0 <= value <= 1:
                raise ValueError(f"Spurious: expected {name} from 0 to 1, got {value}")
        if not (self.clutter >= 0 and np.isfinite(self.clutter)):
            raise ValueError(f"Spurious: expected clutter of at least 0, got {self.clutter}")
        needs_reach = self.clutter > 0 or not is_concrete(self.outliers) or self.outliers > 0
        if not np.isfinite(self.reach) or self.reach < 0 or (self.reach == 0 and needs_reach):
            raise ValueError(f"Spurious: false measurements need a reach above 0, got {self.reach}")

    @property
    def places(self) -> int:
        """Further places of a scan, for clutter."""
        return int(np.ceil(2 * self.clutter))


def spoil(
    spurious: Spurious, sensor: Sensor, pose: Array, scan: Scan, key: Array
) -> tuple[Scan, Array]:
    """A scan of M places made at a pose, with things gone wrong, and what each place truly is of.

    Returns:
        A scan of M + spurious.places places, clutter last and with tag -1; and the tag (M + …,)
        of the landmark each was truly measured of, -1 for none.
    """
    scan = jax.tree.map(jnp.asarray, scan)
    m = scan.tag.shape[0]
    keys = jax.random.split(key, 5)
    key_missed, key_outlier, key_label, key_clutter, key_false = keys
    valid = scan.valid & ~jax.random.bernoulli(key_missed, spurious.missed, (m,))
    outlier = valid & jax.random.bernoulli(key_outlier, spurious.outliers, (m,))
    mistaken = valid & jax.random.bernoulli(key_label, spurious.mislabelled, (m,))
    false = _false_measurements(spurious, sensor, pose, m + spurious.places, key_false)
    z = jnp.where(outlier[:, None], false[:m], scan.z)
    origin = jnp.where(valid & ~outlier, scan.tag, -1)
    share = spurious.clutter / max(spurious.places, 1)
    there = jax.random.bernoulli(key_clutter, share, (spurious.places,))
    nobody = jnp.full(spurious.places, -1, scan.tag.dtype)
    spoilt = Scan(
        z=jnp.concatenate([jnp.where(valid[:, None], z, 0.0), _only(false[m:], there)]),
        tag=jnp.concatenate([jnp.where(valid, _traded(scan.tag, mistaken), -1), nobody]),
        valid=jnp.concatenate([valid, there]),
    )
    return spoilt, jnp.concatenate([origin, nobody])


def _only(z: Array, there: Array) -> Array:
    return jnp.where(there[:, None], z, 0.0)


def _false_measurements(
    spurious: Spurious, sensor: Sensor, pose: Array, count: int, key: Array
) -> Array:
    key_point, key_noise = jax.random.split(key)
    points = jax.random.uniform(
        key_point, (count, 2), pose.dtype, minval=-spurious.reach, maxval=spurious.reach
    )
    normals = jax.random.normal(key_noise, (count, len(sensor.measurements)), pose.dtype)

    def one(point: Array, normal: Array) -> Array:
        exact = sensor.observe(pose, sensor.embed(pose, pose[:2] + point))
        noisy = exact + root_psd(sensor.noise_cov(exact)) @ normal
        return sensor.residual(noisy, jnp.zeros_like(noisy))

    return jax.vmap(one)(points, normals)


def _traded(tag: Array, mistaken: Array) -> Array:
    """Each mistaken place has the tag of the next one."""
    places = jnp.argsort(~mistaken, stable=True)  # those mistaken, first
    following = jnp.cumsum(mistaken) % jnp.maximum(mistaken.sum(), 1)
    return jnp.where(mistaken, tag[places[following]], tag)
