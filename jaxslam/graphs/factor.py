"""Factors: the residual of a measurement between variables of a graph."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax

from jaxslam.math import se2
from jaxslam.protocols import Sensor

Array = jax.Array


@dataclass(frozen=True, eq=False)
class Factor:
    """A kind of measurement between K variables of a graph, as a pure function."""

    name: str
    variables: tuple[str, ...]
    """the kind of each variable, "pose" or "point", in the order of `Table.who`; its length is K"""
    measurements: tuple[str, ...]
    """what z holds, with units; its length is Z"""
    errors: tuple[str, ...]
    """what the residual holds, with units; its length is R"""
    residual: Callable[[tuple[Array, ...], Array], Array]
    """(variables, z) -> e (R,), angles wrapped, on one row: each pose (3,), each point (L,)"""
    jacobians: Callable[[tuple[Array, ...], Array], tuple[Array, ...]] | None = None
    """(variables, z) -> by the coordinates of each variable, (R, 3) or (R, L); hand-derived, to
    verify against"""


POSE = ("x [m]", "y [m]", "theta [rad]")


def relative_pose() -> Factor:
    """The factor of a relative pose: e = Z⁻¹ ∘ (Xᵢ⁻¹ ∘ Xⱼ) as (x, y, θ wrapped), no logarithm.

    Kümmerle et al. 2011, "g2o: A general framework for graph optimization", ICRA: the error of
    its `EDGE_SE2`.
    """

    def residual(variables: tuple[Array, ...], z: Array) -> Array:
        first, second = variables
        return se2.between(z, se2.between(first, second))

    return Factor("relative_pose", ("pose", "pose"), POSE, POSE, residual)


def prior() -> Factor:
    """The factor of a prior of a pose: e = Z⁻¹ ∘ X as (x, y, θ wrapped)."""

    def residual(variables: tuple[Array, ...], z: Array) -> Array:
        return se2.between(z, variables[0])

    return Factor("prior", ("pose",), POSE, POSE, residual)


def from_sensor(sensor: Sensor) -> Factor:
    """The factor of a sensor: e = z ⊖ h(x, l), `sensor.residual(z, sensor.observe(x, l))`.

    With an absolute sensor (L = 0) the pose is the only variable.
    """
    absolute = not sensor.landmark

    def residual(variables: tuple[Array, ...], z: Array) -> Array:
        landmark: Any = variables[1] if not absolute else z[:0]
        return sensor.residual(z, sensor.observe(variables[0], landmark))

    who = ("pose",) if absolute else ("pose", "point")
    return Factor(sensor.name, who, sensor.measurements, sensor.measurements, residual)
