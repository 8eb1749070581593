"""Association by tags, nearest neighbours or likelihood: the pairs, the rules and their gates."""

import dataclasses
from collections.abc import Callable
from typing import Literal

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxslam.core import slots
from jaxslam.core._numbers import gate_quantile
from jaxslam.core._record import field, function_of, record, static
from jaxslam.core._reprs import describe
from jaxslam.core.protocols import Associate, Association, Pairs, Prediction, Sensor
from jaxslam.core.types import Scan
from jaxslam.core.validation import InvalidField, one_of, or_none, positive, probability
from jaxslam.math._arrays import Number, is_concrete
from jaxslam.math._assignment import assign
from jaxslam.math._gaussians import gaussian_terms, is_inside


def gate_probability(value: Number | None) -> Number | None:
    """The check of a gate, a probability or None."""
    if isinstance(value, Prediction | Scan):  # the class was given as the method, and is called
        raise ValueError(
            f"expected a probability, got {describe(value)}: as associate, give a rule "
            "with its gate, not its class"
        )
    gate: Number | None = or_none(probability)(value)
    return gate


def check_new_gate(gate: Number | None, new_gate: Number | None) -> None:
    """Raise InvalidField on a new_gate that is not at least the gate."""
    if new_gate is None:
        return
    if gate is None:
        raise InvalidField("new_gate", f"expected None without a gate, got {new_gate}")
    if is_concrete((gate, new_gate)) and not new_gate >= gate:
        raise InvalidField("new_gate", f"expected at least gate = {gate}, got {new_gate}")


def within_gate(pairs: Pairs, gate: Number | None) -> Bool[Array, "M N"]:
    """Mask of the possible pairs within the gate; without one, of finite d²."""
    gamma = gate_quantile(gate, pairs.innovation.shape[2])
    near = is_inside(pairs.distance, gamma)
    return pairs.possible & near


def far_from_all(
    pairs: Pairs, scan: Scan, gate: Number | None, new_gate: Number | None
) -> Bool[Array, "M"]:
    """Whether a measurement lies beyond the gate for new landmarks, by default the other one, of
    every landmark of the map."""
    near = within_gate(pairs, gate if new_gate is None else new_gate)
    return scan.valid & ~near.any(axis=1)


def mutual(score: Float[Array, "M N"], allowed: Bool[Array, "M N"]) -> Int[Array, "M"]:
    """The slot of each measurement whose scores are mutually lowest, else -1."""
    if 0 in score.shape:
        return jnp.full(score.shape[0], -1, jnp.int32)
    score = jnp.where(allowed, score, jnp.inf)
    slot = jnp.argmin(score, axis=1).astype(jnp.int32)
    best = jnp.argmin(score, axis=0)[slot] == jnp.arange(score.shape[0])
    return jnp.where(allowed.any(axis=1) & best, slot, -1)


@record
class Known:
    """Association by tags: a measurement has the landmark of its tag; a new tag starts one.

    A measurement of unknown identity (tag -1) is neither, and becomes `Status.UNMATCHED`.
    """

    def __call__(self, prediction: Prediction, scan: Scan) -> Association:
        slot, in_map = slots.find(prediction.tag, prediction.alive, scan.tag)
        tagged = scan.valid & (scan.tag >= 0)
        in_map = in_map & tagged
        return Association(jnp.where(in_map, slot, -1), tagged & ~in_map)


@record
class Nearest:
    """Individual compatibility nearest neighbour (ICNN; Neira & Tardós 2001, section II).

    A pair is compatible if d² = νᵀ S⁻¹ ν <= χ²(Z, gate), the quantile of Z degrees of freedom for a
    measurement of Z numbers. A measurement is associated with the landmark of its least d² if it is
    also the nearest of that landmark's measurements. One with no landmark within new_gate is new;
    one between the gates, or whose landmark has a nearer measurement, is ignored (the two gates of
    Bailey, "Mobile robot localisation and mapping in extensive outdoor environments", 2002, section
    2.3). Tags are not used.

    Raises ValueError on a gate that is no probability, a new_gate below it, or an unknown policy.
    """

    gate: Number | None = field(check=gate_probability)
    """probability that a measurement is compatible with its own landmark, above 0 and below 1;
    None: all pairs are compatible"""
    new_gate: Number | None = field(default=None, check=gate_probability)
    """probability of the gate of new landmarks, at least the gate; default the gate"""
    ambiguous: Literal["nearest", "leave"] = static(
        default="nearest", kw_only=True, check=one_of("nearest", "leave")
    )
    """"leave" ignores a measurement that is compatible with several landmarks, and several that are
    compatible with one"""

    def __post_init__(self) -> None:
        check_new_gate(self.gate, self.new_gate)

    def __call__(self, prediction: Prediction, scan: Scan) -> Association:
        pairs = prediction.pairs(scan)
        allowed = compatible = within_gate(pairs, self.gate)
        if self.ambiguous == "leave":
            allowed = compatible & (compatible.sum(axis=1) == 1)[:, None]
            allowed = allowed & (compatible.sum(axis=0) == 1)[None, :]
        slot = mutual(pairs.distance, allowed)
        return Association(slot, far_from_all(pairs, scan, self.gate, self.new_gate) & (slot < 0))


@record
class MaximumLikelihood:
    """Maximum-likelihood association: as `Nearest`, by the least d² + log |S|.

    d² + log |S| is -2 log N(ν; 0, S) up to a constant. The determinant matters: a landmark of large
    covariance has small d² to all measurements, but a low likelihood (Thrun, Burgard &
    Fox, Probabilistic Robotics, Table 7.3). The gates are as those of `Nearest`.

    Raises:
        ValueError: on a gate that is no probability, or a new_gate below it.
    """

    gate: Number | None = field(check=gate_probability)
    new_gate: Number | None = field(default=None, check=gate_probability)

    def __post_init__(self) -> None:
        check_new_gate(self.gate, self.new_gate)

    def __call__(self, prediction: Prediction, scan: Scan) -> Association:
        pairs = prediction.pairs(scan)
        compatible = within_gate(pairs, self.gate)
        slot = mutual(pairs.distance + pairs.log_det, compatible)
        return Association(slot, far_from_all(pairs, scan, self.gate, self.new_gate) & (slot < 0))


@record
class GlobalNearest:
    """Global nearest neighbour: the assignment that minimizes Σ d² over its pairs, with the
    quantile of the gate as the cost of a measurement without a landmark.

    Only compatible pairs are used; without a gate, the largest number of possible pairs. Solved
    exactly (`assignment.assign`). Blackman & Popoli, "Design and analysis of modern tracking
    systems", 1999, section 6.4. The gates are as those of `Nearest`.

    Raises:
        ValueError: on a gate that is no probability, or a new_gate below it.
    """

    gate: Number | None = field(check=gate_probability)
    new_gate: Number | None = field(default=None, check=gate_probability)

    def __post_init__(self) -> None:
        check_new_gate(self.gate, self.new_gate)

    def __call__(self, prediction: Prediction, scan: Scan) -> Association:
        pairs = prediction.pairs(scan)
        m, n, size_z = pairs.innovation.shape
        compatible = within_gate(pairs, self.gate)
        # Without a gate, more than all distances together: every possible pair is worth making.
        alone = 1 + jnp.where(compatible, pairs.distance, 0.0).sum()
        gamma = gate_quantile(self.gate, size_z)
        if gamma is not None:
            alone = jnp.minimum(gamma, alone)
        # A pair that is not compatible costs more than two measurements without a landmark, so it
        # is never part of the minimum.
        cost = jnp.where(compatible, pairs.distance, 2 * alone + 1)
        # One more column for each measurement, for no landmark.
        cost = jnp.concatenate([cost, jnp.broadcast_to(alone, (m, m))], axis=1)
        column = assign(cost)
        slot = jnp.where(column < n, column, -1)
        return Association(slot, far_from_all(pairs, scan, self.gate, self.new_gate) & (slot < 0))


@record
class Certain:
    """An association method restricted to landmarks with √(tr S/Z) <= spread.

    S is the covariance of the innovation. After a long loop S of the first landmarks exceeds the
    distances between landmarks, and single measurements may be associated wrongly. Landmarks
    measured there become new ones at first; `filters.Closing` then associates them
    jointly with the old ones.

    Raises ValueError on a spread not above 0.
    """

    associate: Associate = field(check=function_of("prediction", "scan"))
    """the method; one that uses tags alone, as `Known`, is not restricted"""
    spread: Number = field(check=positive)
    """in units of the measurement, which should all be of one kind"""

    def __call__(self, prediction: Prediction, scan: Scan) -> Association:
        def certain_pairs(scan: Scan) -> Pairs:
            pairs = prediction.pairs(scan)
            variance = jnp.trace(pairs.cov, axis1=2, axis2=3) / pairs.cov.shape[-1]
            return pairs._replace(possible=pairs.possible & (variance <= self.spread**2))

        certain = dataclasses.replace(prediction, pairs=certain_pairs)
        return Association(*self.associate(certain, scan))


def prediction_from(
    sensor: Sensor,
    tag: Int[Array, "N"],
    alive: Bool[Array, "N"],
    measurements: Callable[[], tuple[Float[Array, "N Z"], Float[Array, "N Z Z"] | None]],
    cross: Callable[[], Float[Array, "N Z N Z"]],
) -> Prediction:
    """The `Prediction` of N landmarks, from predicted measurements and their covariances.

    ν_ij = z_i ⊖ ẑ_j, S_ij = H_j P H_jᵀ + R(ẑ_j). What a method does not call is not computed.

    Args:
        tag, alive: of the slots.
        measurements: () -> ẑ and H_j P H_jᵀ; None instead of the latter where pose and map have no
            error: then S_ij = R(ẑ_j), which is factored once a landmark.
        cross: () -> H_i P H_jᵀ.
    """

    def pairs(scan: Scan) -> Pairs:
        expected, landmark_cov = measurements()
        noise = jax.vmap(sensor.noise_cov)(expected)
        over_slots = jax.vmap(sensor.residual, in_axes=(None, 0))
        innovation = jax.vmap(over_slots, in_axes=(0, None))(scan.z, expected)
        s = noise if landmark_cov is None else landmark_cov + noise
        # S has no axis of measurements: it is factored once a landmark.
        terms = jax.vmap(jax.vmap(gaussian_terms), in_axes=(0, None))(innovation, s)
        cov = jnp.broadcast_to(s, (*innovation.shape, innovation.shape[2]))
        possible = scan.valid[:, None] & alive[None, :] & terms.positive
        return Pairs(innovation, cov, terms.distance, terms.log_det, possible)

    return Prediction(tag, alive, pairs, cross)
