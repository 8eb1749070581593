"""Factors: the residual of a measurement between variables of a graph."""

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from jaxslam import sensors
from jaxslam.graphs.solution.chordal import PRIOR, RELATIVE_POSE, RELATIVE_POSITION, Chordal
from jaxslam.math import se2
from jaxslam.math.angles import sin_cos, wrap
from jaxslam.protocols import Motion, Sensor

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
    predict: Callable[[Array, Array], Array] | None = None
    """(first variable, z) -> the second of two, where the residual is zero: what `starts` places
    variables with; None where z does not tell it"""
    chordal: Chordal | None = None
    """the residual where a heading is cosine and sine, by which `certificate` bounds the cost; None
    where there is none"""

    def __post_init__(self) -> None:
        """Raise ValueError on a kind of variable that graphs do not have."""
        if lost := [kind for kind in self.variables if kind not in ("pose", "point")]:
            raise ValueError(
                f"graphs.Factor: {self.name}: expected variables 'pose' and 'point', "
                f"got {lost[0]!r}"
            )


POSE = ("x [m]", "y [m]", "theta [rad]")


def _between(a: Array, b: Array) -> Array:
    """`se2.between`, with the sine and cosine that are fast over many rows."""
    s, c = sin_cos(a[2])
    dx, dy = b[0] - a[0], b[1] - a[1]
    return jnp.stack([c * dx + s * dy, c * dy - s * dx, wrap(b[2] - a[2])])


def relative_pose() -> Factor:
    """The factor of a relative pose: e = Z⁻¹ ∘ (Xᵢ⁻¹ ∘ Xⱼ) as (x, y, θ wrapped), no logarithm.

    Kümmerle et al. 2011, "g2o: A general framework for graph optimization", ICRA: the error of
    its `EDGE_SE2`.
    """

    def residual(variables: tuple[Array, ...], z: Array) -> Array:
        first, second = variables
        return _between(z, _between(first, second))

    def jacobians(variables: tuple[Array, ...], z: Array) -> tuple[Array, ...]:
        first, second = variables
        by_relative = se2.between_jacobians(z, se2.between(first, second))[1]
        by_first, by_second = se2.between_jacobians(first, second)
        return by_relative @ by_first, by_relative @ by_second

    return Factor(
        "relative_pose",
        ("pose", "pose"),
        POSE,
        POSE,
        residual,
        jacobians,
        predict=se2.compose,
        chordal=RELATIVE_POSE,
    )


def relative_pose_log() -> Factor:
    """The factor of a relative pose by its logarithm: e = log(Z⁻¹ ∘ (Xᵢ⁻¹ ∘ Xⱼ)), a twist.

    The error of GTSAM's `BetweenFactorPose2` (4.3). Its θ is that of `relative_pose`, its (x, y)
    turned by -θ/2 and shorter by (θ/2)/tan(θ/2): optima differ by the square of the residuals. To
    take it for a file, give `optimize` {"relative_pose": relative_pose_log()}.
    """

    def residual(variables: tuple[Array, ...], z: Array) -> Array:
        first, second = variables
        return se2.log(_between(z, _between(first, second)))

    poses = ("pose", "pose")
    return Factor(
        "relative_pose_log",
        poses,
        POSE,
        POSE,
        residual,
        predict=se2.compose,
        chordal=RELATIVE_POSE,
    )


def prior() -> Factor:
    """The factor of a prior of a pose: e = Z⁻¹ ∘ X as (x, y, θ wrapped)."""

    def residual(variables: tuple[Array, ...], z: Array) -> Array:
        return se2.between(z, variables[0])

    def jacobians(variables: tuple[Array, ...], z: Array) -> tuple[Array, ...]:
        return (se2.between_jacobians(z, variables[0])[1],)

    return Factor("prior", ("pose",), POSE, POSE, residual, jacobians, chordal=PRIOR)


def relative_position() -> Factor:
    """The factor of a point in the frame of a pose: e = z - R(θ)ᵀ(l - t), g2o's `EDGE_SE2_XY`."""
    return replace(from_sensor(sensors.RelativePosition(np.eye(2))), chordal=RELATIVE_POSITION)


def bearing() -> Factor:
    """The factor of the bearing of a point: e = z - (atan2(l - t) - θ), wrapped.

    g2o's `EDGE_BEARING_SE2_XY`. `predict` places the point 10 m away.
    """
    return from_sensor(sensors.BearingOnly(np.eye(1)))


def from_sensor(sensor: Sensor) -> Factor:
    """The factor of a sensor: e = z ⊖ h(x, l), `sensor.residual(z, sensor.observe(x, l))`.

    With an absolute sensor (L = 0) the pose is the only variable. What z does not determine of a
    landmark, `predict` takes from the mean of `sensor.free`.
    """
    absolute = not sensor.landmark

    def residual(variables: tuple[Array, ...], z: Array) -> Array:
        landmark: PyTree = variables[1] if not absolute else z[:0]
        return sensor.residual(z, sensor.observe(variables[0], landmark))

    def predict(pose: Array, z: Array) -> Array:
        return sensor.invert(pose, z, jnp.asarray(sensor.free.mean, z.dtype))

    who = ("pose",) if absolute else ("pose", "point")
    names = sensor.measurements
    return Factor(sensor.name, who, names, names, residual, predict=None if absolute else predict)


def from_motion(motion: Motion) -> Factor:
    """The factor of a motion model between two poses: the noise w that leads from one to the other.

        e = w with step(x, u, w) = x', z = u

    The cost wᵀ Q⁻¹ w is the one of `smoothing.BatchMap`. The pose error of the nominal motion with
    the covariance G Q Gᵀ, G = ∂step/∂w at w = 0, is the same to first order in w, and exactly
    where step is affine in w; its optimum is another elsewhere. w is found by Newton's method from
    w = 0: ten steps without derivatives, then two with them, whose error is of the fourth order in
    a change of the poses, so derivatives up to the third are those of w. Where ∂step/∂w is
    singular (a robot that stands still, with `Odometry`) a step is not taken.

    Raises ValueError unless the noise has three components, which the two poses determine; see
    `nominal_motion`.
    """
    if len(motion.noises) != 3:
        raise ValueError(
            f"graphs.from_motion: expected a motion whose noise has 3 components, which two poses "
            f"determine, got {motion.name} with {len(motion.noises)}: {', '.join(motion.noises)}"
        )

    def newton(w: Array, first: Array, second: Array, u: Array) -> Array:
        def miss(w: Array) -> Array:
            return se2.between(second, motion.step(first, u, w))

        a, b, c = jax.jacfwd(miss)(w)
        adjugate = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)], axis=1)
        volume = a @ adjugate[:, 0]
        regular = volume != 0
        step = adjugate @ miss(w) / jnp.where(regular, volume, 1.0)
        return jnp.where(regular, w - step, w)

    def residual(variables: tuple[Array, ...], z: Array) -> Array:
        first, second = variables
        still = jax.lax.stop_gradient((first, second, z))
        w = jax.lax.fori_loop(0, 10, lambda _, w: newton(w, *still), jnp.zeros(3, z.dtype))
        w = jax.lax.stop_gradient(w)
        return newton(newton(w, first, second, z), first, second, z)

    def predict(pose: Array, z: Array) -> Array:
        return motion.step(pose, z, jnp.zeros(3, z.dtype))

    poses = ("pose", "pose")
    return Factor(motion.name, poses, motion.controls, motion.noises, residual, predict=predict)


def nominal_motion(motion: Motion) -> Factor:
    """The factor of a motion model between two poses: the error of the motion without noise.

        e = step(x, u, 0)⁻¹ ∘ x', z = u

    Its covariance is G Q Gᵀ to first order in the noise, G = ∂e/∂w, which a table must have as its
    information (`of_log`): exactly where e is affine in w, as for `Unicycle` and `Increment`.
    """

    def residual(variables: tuple[Array, ...], z: Array) -> Array:
        first, second = variables
        return se2.between(predict(first, z), second)

    def predict(pose: Array, z: Array) -> Array:
        return motion.step(pose, z, jnp.zeros(len(motion.noises), z.dtype))

    poses = ("pose", "pose")
    return Factor(motion.name, poses, motion.controls, POSE, residual, predict=predict)


REGISTRY: dict[str, Callable[[], Factor]] = {
    "bearing": bearing,
    "prior": prior,
    "relative_pose": relative_pose,
    "relative_position": relative_position,
}
"""Factories of the factors of files, by the name of their table; none has parameters."""


@functools.cache
def of_files() -> Mapping[str, Factor]:
    """The factors of `REGISTRY`, each made once, so that what is compiled for them is kept."""
    return MappingProxyType({name: make() for name, make in REGISTRY.items()})
