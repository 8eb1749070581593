"""Factors: the residual of a measurement between variables of a graph.

Some have chordal residuals besides, where a heading is cosine and sine, not an angle.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxslam.core._record import check_field, field, record, static
from jaxslam.core.claims import Argument, Claim
from jaxslam.core.protocols import POSE, Component, Motion, Sensor, motion_of_pose, sensor_of_robot
from jaxslam.core.validation import InvalidField, instance_of
from jaxslam.math import _linalg as linalg
from jaxslam.math import se2
from jaxslam.math.angles import sin_cos, wrap

Rows = list[list[list[Array]]]
"""∂r/∂(p, u) of each variable as lists [variable][residual][number] of arrays (E, B)."""


class Chordal(NamedTuple):
    """The chordal residual r of a measurement, linear in the positions p and u = (cos θ, sin θ)."""

    residual: Callable[[tuple[Array, ...], Array], Array]
    """(variables, z) -> r (S,), on one row"""
    size: int
    """S: two residuals of the position, then two or none of the heading"""
    rows: Callable[[Array], Rows] | None
    """(z) -> ∂r/∂(p, u) of each variable; None of a prior, which is left out of the cost"""


def _chordal_pose(variables: tuple[Array, ...], z: Array) -> Array:
    """The error of position in the frame of z, and exp(iθ) - 1 of its angle θ."""
    e = se2.between(z, se2.between(*variables))
    return jnp.stack([e[0], e[1], jnp.cos(e[2]) - 1.0, jnp.sin(e[2])])


def _chordal_point(variables: tuple[Array, ...], z: Array) -> Array:
    """The error of position in the frame of the pose."""
    return se2.to_frame(variables[0], variables[1][:2]) - z


def _chordal_prior(variables: tuple[Array, ...], z: Array) -> Array:
    """Zero: the chordal cost is without priors."""
    return jnp.zeros(1, z.dtype)


def _pose_rows(z: Array) -> Rows:
    """The derivatives ∂r/∂(p, u) of both poses, r = (p_j - p_i - t u_i, u_j - exp(iφ) u_i).

    Products are of complex numbers: t = x + iy of z, φ its angle.
    """
    o, i = jnp.zeros_like(z[:, 0]), jnp.ones_like(z[:, 0])
    x, y, c, s = z[:, 0], z[:, 1], jnp.cos(z[:, 2]), jnp.sin(z[:, 2])
    # The product t u is [x, -y; y, x] times u as a vector, exp(iφ) u is [c, -s; s, c] times it.
    by_first = [[-i, o, -x, y], [o, -i, -y, -x], [o, o, -c, s], [o, o, -s, -c]]
    by_second = [[i, o, o, o], [o, i, o, o], [o, o, i, o], [o, o, o, i]]
    return [by_first, by_second]


def _point_rows(z: Array) -> Rows:
    """The derivatives ∂r/∂(p, u) of a pose and ∂r/∂p of a point, r = p_j - p_i - t u_i."""
    return [rows[:2] for rows in _pose_rows(jnp.concatenate([z, jnp.zeros_like(z[:, :1])], axis=1))]


_RELATIVE_POSE = Chordal(_chordal_pose, 4, _pose_rows)
_RELATIVE_POSITION = Chordal(_chordal_point, 2, _point_rows)
PRIOR = Chordal(_chordal_prior, 1, None)


class Factor(Component):
    """A kind of measurement between K variables of a graph.

    A subclass is a record (`core.record`) that declares variables, measurements and errors, and
    defines `residual`. Raises ValueError, at construction, where one of these is missing, on names
    other than a tuple of strings, and on an unknown kind of variable.
    """

    kind = "factor"
    variables: tuple[str, ...]
    """the kind of each variable, "pose" or "point", in the order of `Table.who`; its length is K"""
    measurements: tuple[str, ...]
    """the entries of z, with units; its length is Z"""
    errors: tuple[str, ...]
    """the entries of the residual, with units; its length is R"""
    jacobians: Any = None
    """(variables, z) -> by the coordinates of each variable, (R, 3) or (R, L); hand-derived, to
    verify against"""
    predict: Any = None
    """(first variable, z) -> the second, where the residual is zero, for `starts`; None where z
    does not determine it"""
    whiten: Any = None
    """(variables, z) -> W (R, R), for noise that depends on the variables: taken at each iterate,
    and held while its step is computed and judged. The information of the table is then the inverse
    covariance of W e; None where it is the inverse covariance of e"""
    chordal: Chordal | None = None
    """the residual where a heading is cosine and sine, by which `certificate` bounds the cost; None
    where there is none"""

    def __post_init__(self) -> None:
        self._check(Factor, {"residual": ""})
        self._check_names("variables", "measurements", "errors")
        if lost := [kind for kind in self.variables if kind not in ("pose", "point")]:
            raise InvalidField("variables", f"expected 'pose' and 'point', got {lost[0]!r}")

    def residual(self, variables: tuple[Array, ...], z: Array) -> Array:
        """The error e (R,) of one row, angles wrapped: each pose (3,), each point (L,)."""
        raise NotImplementedError

    def claims(self) -> tuple[Claim, ...]:
        """The claim of `residual`, by its variables and its measurement; a point is (x, y)."""
        arguments = [
            Argument(
                kind if self.variables.count(kind) == 1 else f"{kind} {k + 1}",
                POSE if kind == "pose" else POSE[:2],
            )
            for k, kind in enumerate(self.variables)
        ]

        def residual(*values: Array) -> Array:
            return self.residual(values[:-1], values[-1])

        def jacobian(*values: Array) -> tuple[Array | None, ...]:
            return (*self.jacobians(values[:-1], values[-1]), None)

        measured = Argument("measurement", self.measurements)
        claim = None if self.jacobians is None else jacobian
        return (Claim("residual", residual, (*arguments, measured), self.errors, claim),)


def _between(a: Array, b: Array) -> Array:
    """`se2.between`, with the sine and cosine that are fast over many rows."""
    s, c = sin_cos(a[2])
    dx, dy = b[0] - a[0], b[1] - a[1]
    return jnp.stack([c * dx + s * dy, c * dy - s * dx, wrap(b[2] - a[2])])


class BetweenPoses(Factor):
    """The base of factors of a relative pose: z is the second pose in the frame of the first."""

    variables = ("pose", "pose")
    measurements = errors = POSE
    chordal = _RELATIVE_POSE

    def predict(self, pose: Array, z: Array) -> Array:
        return se2.compose(pose, z)


@record
class RelativePose(BetweenPoses):
    """The factor of a relative pose: e = Z⁻¹ ∘ (Xᵢ⁻¹ ∘ Xⱼ) as (x, y, θ wrapped), no logarithm.

    Kümmerle et al. 2011, "g2o: A general framework for graph optimization", ICRA: the error of
    its `EDGE_SE2`.
    """

    def residual(self, variables: tuple[Array, ...], z: Array) -> Array:
        first, second = variables
        return _between(z, _between(first, second))

    def jacobians(self, variables: tuple[Array, ...], z: Array) -> tuple[Array, ...]:
        first, second = variables
        by_relative = se2.between_jacobians(z, se2.between(first, second))[1]
        by_first, by_second = se2.between_jacobians(first, second)
        return by_relative @ by_first, by_relative @ by_second


@record
class RelativePoseLog(BetweenPoses):
    """The factor of a relative pose by its logarithm: e = log(Z⁻¹ ∘ (Xᵢ⁻¹ ∘ Xⱼ)), a twist.

    The error of GTSAM's `BetweenFactorPose2` (4.3). Its θ is that of `RelativePose`, its (x, y)
    turned by -θ/2 and shorter by (θ/2)/tan(θ/2): optima differ by the square of the residuals. To
    take it for a file, give `optimize` {"relative_pose": RelativePoseLog()}.
    """

    def residual(self, variables: tuple[Array, ...], z: Array) -> Array:
        first, second = variables
        return se2.log(_between(z, _between(first, second)))


@record
class Prior(Factor):
    """The factor of a prior of a pose: e = Z⁻¹ ∘ X as (x, y, θ wrapped)."""

    variables = ("pose",)
    measurements = errors = POSE
    chordal = PRIOR

    def residual(self, variables: tuple[Array, ...], z: Array) -> Array:
        return se2.between(z, variables[0])

    def jacobians(self, variables: tuple[Array, ...], z: Array) -> tuple[Array, ...]:
        return (se2.between_jacobians(z, variables[0])[1],)


@record
class RelativePosition(Factor):
    """The factor of a point in the frame of a pose: e = z - R(θ)ᵀ(l - t), g2o's `EDGE_SE2_XY`."""

    variables = ("pose", "point")
    measurements = errors = ("ahead [m]", "left [m]")
    chordal = _RELATIVE_POSITION

    def residual(self, variables: tuple[Array, ...], z: Array) -> Array:
        return z - se2.to_frame(*variables)

    def predict(self, pose: Array, z: Array) -> Array:
        return se2.from_frame(pose, z)


@record
class Bearing(Factor):
    """The factor of the bearing of a point: e = z - (atan2(l - t) - θ), wrapped.

    g2o's `EDGE_BEARING_SE2_XY`. `predict` places the point 10 m away.
    """

    variables = ("pose", "point")
    measurements = errors = ("bearing [rad]",)

    def residual(self, variables: tuple[Array, ...], z: Array) -> Array:
        return wrap(z - se2.polar_in_frame(*variables)[1:])

    def predict(self, pose: Array, z: Array) -> Array:
        away = jnp.full(1, 10.0, z.dtype)
        return se2.from_frame(pose, se2.rectangular(jnp.concatenate([away, z])))


@record
class FromSensor(Factor):
    """The factor of a sensor: e = z ⊖ h(x, l), `sensor.residual(z, sensor.observe(x, l))`.

    With an absolute sensor (L = 0) the pose is the only variable. `predict` takes parameters of a
    landmark that z does not determine from the mean of `sensor.free`. The name is the sensor's.

    With own_noise the noise of a row is R(ẑ) of the sensor at the prediction ẑ of each iterate,
    held: the optimum is where the sum of Hᵀ R(ẑ)⁻¹ (z ⊖ ẑ) and of the other rows' terms is zero. At
    the truth each has mean zero (a quasi-score: Wedderburn 1974, "Quasi-likelihood functions,
    generalized linear models, and the Gauss-Newton method", Biometrika 61(3)). The least χ² with
    R(ẑ) not held would prefer predictions of large noise, since a density has log |R(ẑ)| besides;
    R(z) prefers measurements that came out small. A row whose R(ẑ) is singular has no weight.
    """

    sensor: Sensor = field(check=lambda sensor: sensor_of_robot(POSE)(instance_of(Sensor)(sensor)))
    own_noise: bool = static(default=False, kw_only=True)
    """the information of the table is for R(ẑ)^{-1/2} e, the identity, and not for e"""

    @property
    def name(self) -> str:  # type: ignore[override]
        return self.sensor.name

    @property
    def variables(self) -> tuple[str, ...]:  # type: ignore[override]
        return ("pose", "point") if self.sensor.landmark else ("pose",)

    @property
    def measurements(self) -> tuple[str, ...]:  # type: ignore[override]
        return self.sensor.measurements

    @property
    def errors(self) -> tuple[str, ...]:  # type: ignore[override]
        return self.sensor.measurements

    def residual(self, variables: tuple[Array, ...], z: Array) -> Array:
        landmark = variables[1] if self.sensor.landmark else z[:0]
        return self.sensor.residual(z, self.sensor.observe(variables[0], landmark))

    @property
    def predict(self) -> Any:
        return self._inverse if self.sensor.landmark else None

    @property
    def whiten(self) -> Any:
        return self._whitener if self.own_noise else None

    def _whitener(self, variables: tuple[Array, ...], z: Array) -> Array:
        landmark = variables[1] if self.sensor.landmark else z[:0]
        noise = self.sensor.noise_cov(self.sensor.observe(variables[0], landmark))
        inverse, positive = linalg.whitener(noise)
        return jnp.where(positive, inverse, 0.0)

    def _inverse(self, pose: Array, z: Array) -> Array:
        return self.sensor.invert(pose, z, jnp.asarray(self.sensor.free.mean, z.dtype))


class _MotionFactor(Factor):
    """The base of factors of a motion model between two poses: z is the control."""

    variables = ("pose", "pose")
    motion: Motion

    def __post_init__(self) -> None:
        check_field(self, "motion", instance_of(Motion))
        check_field(self, "motion", motion_of_pose)
        super().__post_init__()

    @property
    def name(self) -> str:  # type: ignore[override]
        return self.motion.name

    @property
    def measurements(self) -> tuple[str, ...]:  # type: ignore[override]
        return self.motion.controls

    def predict(self, pose: Array, z: Array) -> Array:
        return self.motion.step(pose, z, jnp.zeros(len(self.motion.noises), z.dtype))


@record
class FromMotion(_MotionFactor):
    """The factor of a motion model between two poses: the noise w that leads from one to the other.

        e = w with step(x, u, w) = x', z = u

    `smoothing.BatchMap` has the same cost wᵀ Q⁻¹ w. The pose error of the nominal motion, with the
    covariance G Q Gᵀ, G = ∂step/∂w at w = 0, is equal to it to first order in w, and exactly where
    step is affine in w; elsewhere its optimum is another. w is found by Newton's method from
    w = 0: ten steps without derivatives, then two with them, whose error is of the fourth order in
    a change of the poses, so derivatives up to the third are exact. Where ∂step/∂w is
    singular (a robot at rest, with `Odometry`) no step is made.

    Raises ValueError unless the noise has three components, which the two poses determine; see
    `NominalMotion`.
    """

    motion: Motion

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.motion.noises) != 3:
            raise InvalidField(
                "motion",
                "expected one whose noise has 3 components, which two poses "
                f"determine, got {self.name} with {len(self.errors)}: {', '.join(self.errors)}",
            )

    @property
    def errors(self) -> tuple[str, ...]:  # type: ignore[override]
        return self.motion.noises

    def residual(self, variables: tuple[Array, ...], z: Array) -> Array:
        first, second = variables
        held, *still = jax.lax.stop_gradient((self, first, second, z))
        # The ten steps have no derivatives, which two further ones from their end have.
        w = jax.lax.fori_loop(0, 10, lambda _, w: held._newton(w, *still), jnp.zeros(3, z.dtype))
        w = jax.lax.stop_gradient(w)
        return self._newton(self._newton(w, first, second, z), first, second, z)

    def _newton(self, w: Array, first: Array, second: Array, u: Array) -> Array:
        """The noise after a step of Newton's method on miss(w) = 0."""

        def miss(w: Array) -> Array:
            return se2.between(second, self.motion.step(first, u, w))

        # M⁻¹ miss by the adjugate of M, whose rows are a, b, c: its determinant is a · (b × c).
        a, b, c = jax.jacfwd(miss)(w)
        adjugate = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)], axis=1)
        volume = a @ adjugate[:, 0]
        regular = volume != 0
        step = adjugate @ miss(w) / jnp.where(regular, volume, 1.0)
        return jnp.where(regular, w - step, w)


@record
class NominalMotion(_MotionFactor):
    """The factor of a motion model between two poses: the error of the motion without noise.

        e = step(x, u, 0)⁻¹ ∘ x', z = u

    Its covariance is G Q Gᵀ to first order in the noise, G = ∂e/∂w, which a table must have as its
    information (`of_log`): exactly where e is affine in w, as for `Unicycle` and `Increment`.
    """

    motion: Motion
    errors = POSE

    def residual(self, variables: tuple[Array, ...], z: Array) -> Array:
        first, second = variables
        return se2.between(self.predict(first, z), second)


REGISTRY: dict[str, Factor] = {
    "bearing": Bearing(),
    "prior": Prior(),
    "relative_pose": RelativePose(),
    "relative_position": RelativePosition(),
}
"""The factors of files, by the name of their table."""
