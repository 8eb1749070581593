"""Sensor faults beyond noise: clutter, missed detections, outliers and wrong tags."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxslam.core._numbers import is_concrete
from jaxslam.core._record import field, record, static
from jaxslam.core.protocols import Sensor
from jaxslam.core.types import Scan
from jaxslam.core.validation import InvalidField, in_range, not_negative
from jaxslam.math._arrays import Number
from jaxslam.math._linalg import root_psd

__all__ = ["Spurious"]


@record
class Spurious:
    """The rates of sensor faults.

    A false measurement is the measurement of a point drawn uniformly from a square of half-width
    `reach` around the robot. Raises ValueError on a probability outside 0 to 1, a negative clutter,
    or false measurements without a reach.
    """

    clutter: float = static(default=0.0, check=not_negative)
    """false measurements a scan, on average: binomial, over 2·clutter further slots, rounded up"""
    missed: Number = field(default=0.0, check=in_range(0.0, 1.0))
    """probability that a landmark in view is not measured"""
    outliers: Number = field(default=0.0, check=in_range(0.0, 1.0))
    """probability that a measurement is false, though its tag is right"""
    mislabelled: Number = field(default=0.0, check=in_range(0.0, 1.0))
    """probability that a tag is wrong: the wrong ones of a scan are permuted in a cycle (a single
    one keeps its own)"""
    reach: Number = field(default=0.0, check=not_negative)
    """[m]"""

    def __post_init__(self) -> None:
        needs_reach = self.clutter > 0 or not is_concrete(self.outliers) or self.outliers > 0
        if is_concrete(self.reach) and self.reach == 0 and needs_reach:
            raise InvalidField(
                "reach", f"expected a number above 0 with false measurements, got {self.reach}"
            )

    @property
    def places(self) -> int:
        """The number of measurement slots that clutter adds to a scan."""
        return int(np.ceil(2 * self.clutter))

    def spoil(
        self, sensor: Sensor, pose: Float[Array, "3"], scan: Scan, key: Array
    ) -> tuple[Scan, Int[Array, "M"]]:
        """A scan made at a pose with sensor faults put in, and the true origin of each measurement.

        Returns:
            A scan with `places` further slots, clutter last and with tag -1; and the tag
            of the landmark that was truly measured in each, -1 for none.
        """
        scan = jax.tree.map(jnp.asarray, scan)
        m = scan.tag.shape[0]
        key_missed, key_outlier, key_label, key_clutter, key_false = jax.random.split(key, 5)
        valid = scan.valid & ~jax.random.bernoulli(key_missed, self.missed, (m,))
        outlier = valid & jax.random.bernoulli(key_outlier, self.outliers, (m,))
        mislabelled = valid & jax.random.bernoulli(key_label, self.mislabelled, (m,))
        false = self._false_measurements(sensor, pose, m + self.places, key_false)
        z = jnp.where(outlier[:, None], false[:m], scan.z)
        origin = jnp.where(valid & ~outlier, scan.tag, -1)
        share = self.clutter / max(self.places, 1)
        occurs = jax.random.bernoulli(key_clutter, share, (self.places,))
        no_tag = jnp.full(self.places, -1, scan.tag.dtype)
        # A wrong tag is that of the next wrong slot.
        wrong_first = jnp.argsort(~mislabelled, stable=True)
        following = jnp.cumsum(mislabelled) % jnp.maximum(mislabelled.sum(), 1)
        tag = jnp.where(mislabelled, scan.tag[wrong_first[following]], scan.tag)
        spoilt = Scan(
            z=jnp.concatenate(
                [jnp.where(valid[:, None], z, 0.0), jnp.where(occurs[:, None], false[m:], 0.0)]
            ),
            tag=jnp.concatenate([jnp.where(valid, tag, -1), no_tag]),
            valid=jnp.concatenate([valid, occurs]),
        )
        return spoilt, jnp.concatenate([origin, no_tag])

    def _false_measurements(
        self, sensor: Sensor, pose: Float[Array, "3"], count: int, key: Array
    ) -> Float[Array, "count Z"]:
        """Measurements of random points around the robot."""
        key_point, key_noise = jax.random.split(key)
        points = jax.random.uniform(
            key_point, (count, 2), pose.dtype, minval=-self.reach, maxval=self.reach
        )
        normals = jax.random.normal(key_noise, (count, len(sensor.measurements)), pose.dtype)

        def measure(point: Array, normal: Array) -> Array:
            exact = sensor.observe(pose, sensor.embed(pose, pose[:2] + point))
            noisy = exact + root_psd(sensor.noise_cov(exact)) @ normal
            return sensor.residual(noisy, jnp.zeros_like(noisy))

        return jax.vmap(measure)(points, normals)
