"""The records of pure functions that make up a SLAM method.

Every method, and field that is a function, is pure and traceable and acts on *one* pose, landmark
or scan; the caller vmaps. The numbers of a motion model or a sensor are the leaves of a record.

Shapes: pose (3,); u (U,) control; w (W,) process noise; z (Z,) measurement; l (L,) landmark
parameters; s (K,) landmark parameters that z does not determine (K = 0 if none).
"""

import inspect
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, PyTree

from jaxslam.core.numbers import check_mount, held_array
from jaxslam.core.record import set_field
from jaxslam.math import se2
from jaxslam.math.angles import wrap
from jaxslam.math.arrays import (
    Control,
    Landmark,
    Measurement,
    Point,
    Pose,
    ProcessNoise,
    Unmeasured,
)
from jaxslam.noise import hold_noise
from jaxslam.slots import Joint
from jaxslam.types import Estimate, Info, JaxOrNumPy, Log, Scan, Trace, Truth

Array = jax.Array


def unfit_signature(function: Callable[..., object], count: int) -> str | None:
    """The parameters of a function that does not take `count` arguments; None of one that does."""
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):  # a builtin has none
        return None
    try:
        signature.bind(*[None] * count)
    except TypeError:
        return f"({', '.join(signature.parameters)})"
    return None


def _check_fields(
    record: PyTree,
    functions: Iterable[str] | Mapping[str, str],
    names: tuple[str, ...] = (),
    optional: tuple[str, ...] = (),
) -> None:
    """Raise ValueError unless functions are functions, of the parameters that a mapping gives, and
    names tuples of str.

    Those of models are not of fixed parameters here: the verifier reports them.
    """
    what = f"{type(record).__name__} {record.name!r}"
    if not isinstance(record.name, str):
        raise ValueError(f"{what}: expected a name, got {type(record.name).__name__}")
    for field in names:
        value = getattr(record, field)
        if not isinstance(value, tuple) or not all(isinstance(name, str) for name in value):
            raise ValueError(
                f'{what}: expected {field} to be a tuple of names as ("x [m]",), got {value!r}'
            )
    for field in (*functions, *optional):
        value = getattr(record, field)
        if not callable(value) and not (value is None and field in optional):
            got, wanted = type(value).__name__, "a function"
            if hasattr(value, "shape"):
                got, wanted = f"an array of shape {value.shape}", "a function that returns one"
            raise ValueError(f"{what}: expected {field} to be {wanted}, got {got}")
    for field, taken in functions.items() if isinstance(functions, Mapping) else ():
        unfit = unfit_signature(getattr(record, field), taken.count(",") + 1)
        if unfit is not None:
            raise ValueError(f"{what}: expected {field} to take ({taken}), got {unfit}")


class Model:
    """What motion models and sensors share: a name, and noise."""

    name: str
    """lower case, for tables, files and messages; by default that of the class"""
    __dataclass_fields__: ClassVar[dict[str, Any]]

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        if "name" not in cls.__dict__:
            cls.name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", cls.__name__).lower()

    def __init__(self, *_: object, **__: object) -> None:  # a record has its own
        raise ValueError(f"{type(self).__name__}: expected @record above the class, of core.record")

    def _check(
        self, base: type, functions: tuple[str, ...], names: tuple[str, ...], noises: str
    ) -> None:
        """Check what a subclass of `base` declares, and make its noise_cov what can be called."""
        what = type(self).__name__
        if "__dataclass_fields__" not in type(self).__dict__:
            Model.__init__(self)
        for name in functions:
            if getattr(type(self), name) is getattr(base, name):
                raise ValueError(f"{what}: expected a method {name}")
        for name in names:
            value = getattr(self, name, None)
            if not isinstance(value, tuple) or not all(isinstance(one, str) for one in value):
                raise ValueError(
                    f'{what}: expected {name} to be a tuple of names as ("x [m]",), got {value!r}'
                )
        if not hasattr(self, "noise_cov"):
            raise ValueError(f"{what}: expected a field or a method noise_cov")
        if "noise_cov" in self.__dict__:
            hold_noise(self, len(getattr(self, noises)))


class Motion(Model):
    """A motion model, one class for simulator and filters; w = 0 is the nominal motion.

    A subclass is a record (`core.record`) that declares controls and noises, has a field noise_cov,
    or a method of that name, and defines `step`. Raises ValueError, at construction, on a
    covariance that is none, names that are no tuple of strings, or a missing method.
    """

    controls: tuple[str, ...]
    """What u holds, with units; its length is U."""
    noises: tuple[str, ...]
    """What w holds, with units; its length is W."""
    noise_cov: Any
    """(pose, u) -> (W, W). Given as a covariance, a record with `__call__`, or a function."""
    perturb: Any = None
    """(u, w) -> u with step(pose, u, w) = step(pose, perturb(u, w), 0), where noise is of that
    kind; needed by worlds that add noise to the odometry instead of the robot's motion."""
    jacobians: Any = None
    """(pose, u, w) -> by pose (3, 3), by u (3, U), by w (3, W); hand-derived, to verify against."""

    def __post_init__(self) -> None:
        self._check(Motion, ("step",), ("controls", "noises"), "noises")

    def step(self, pose: Pose, u: Control, w: ProcessNoise) -> Pose:
        """The pose after a control, θ wrapped."""
        raise NotImplementedError


class Free(NamedTuple):
    """The Gaussian prior of the unmeasured landmark parameters (Solà 39)."""

    mean: Float[JaxOrNumPy, "K"]
    cov: Float[JaxOrNumPy, "K K"]


NOTHING_FREE = Free(np.zeros(0), np.zeros((0, 0)))
"""of a measurement that determines its landmark"""


class Reduced(NamedTuple):
    """A permanent reduction of a landmark's L parameters to its position (x, y)."""

    sensor: PyTree
    """a Sensor with the same z, whose landmarks are points"""
    ready: Callable[[Array, Array, Array], Array]
    """(pose, l, cov (L, L)) -> () bool"""


class Sensor(Model):
    """A measurement model of one landmark, or with L = 0 of the robot itself (an absolute sensor).

    A subclass is a record (`core.record`) that declares measurements, has a field noise_cov, or a
    method of that name, and defines `observe` and `invert`; the rest has a default. It may have a
    field `mount`, and then observes from `frame(pose)`. Raises ValueError, at construction, on a
    covariance or a mount that is none, names that are no tuple of strings, or a missing method.

    An absolute sensor (a compass, a satellite receiver) has no landmark: l is (0,), invert and
    embed return (0,), position unused zeros, and K = 0. Each of its measurements
    corrects the robot, whatever the tag.
    """

    measurements: tuple[str, ...]
    """What z holds, with units; its length is Z."""
    landmark: tuple[str, ...] = ("x [m]", "y [m]")
    """What l holds, with units; its length is L, 0 for an absolute sensor."""
    noise_cov: Any
    """(z) -> (Z, Z). Given as a covariance, a record with `__call__`, or a function."""
    mount: Any = None
    """(3,) pose of the sensor on the robot, Solà's S; None where it is the robot's."""
    free: Free = NOTHING_FREE
    """the prior of s. Default that of a full measurement."""
    carry: Any = None
    """(frame (3,), l) -> l of a landmark given in a frame, in the coordinates that the frame's pose
    is in. Default, of a landmark whose first two numbers are a place (x, y): the place moves,
    entries in [rad] turn, and the others stay."""
    observe_jacobians: Any = None
    """(pose, l) -> by pose (Z, 3), by l (Z, L); hand-derived, to verify against."""
    invert_jacobians: Any = None
    """(pose, z, s) -> by pose (L, 3), by z (L, Z), by s (L, K); hand-derived."""
    reduced: Reduced | None = None
    """the points that landmarks may turn into; None where they never do"""

    def __post_init__(self) -> None:
        self._check(Sensor, ("observe", "invert"), ("measurements", "landmark"), "measurements")
        free = self.__dict__.get("free", type(self).free)
        if not isinstance(free, Free | property):
            what = f"{type(self).__name__}: expected free to be a Free(mean, cov)"
            raise ValueError(f"{what}, got {type(free).__name__}")
        if self.mount is not None and "mount" in self.__dict__:
            check_mount(type(self).__name__, self.mount)
            set_field(self, "mount", held_array(self.mount))

    def observe(self, pose: Pose, landmark: Landmark) -> Measurement:
        """The measurement z of a landmark."""
        raise NotImplementedError

    def invert(self, pose: Pose, z: Measurement, s: Unmeasured) -> Landmark:
        """The landmark with observe(pose, invert(pose, z, s)) = z; a range is not negative."""
        raise NotImplementedError

    def residual(self, z: Measurement, z_hat: Measurement) -> Measurement:
        """z ⊖ z_hat, entries in [rad] wrapped; residual(z, 0) is z with its angles wrapped."""
        turns = np.array([name.endswith("[rad]") for name in self.measurements])
        return jnp.where(turns, wrap(z - z_hat), z - z_hat)

    def position(self, landmark: Landmark) -> Point:
        """(2,) position of a landmark. By default its first two numbers."""
        return landmark[:2]

    def embed(self, pose: Pose, point: Point) -> Landmark:
        """The landmark at a point, measured first from pose. By default zeros beside the point."""
        rest = max(len(self.landmark) - 2, 0)
        return jnp.concatenate([point, jnp.zeros(rest, point.dtype)]) if rest else point

    def frame(self, pose: Pose) -> Pose:
        """The pose of the sensor, pose ∘ mount."""
        return pose if self.mount is None else se2.compose(pose, self._mount(pose))

    def frame_jacobian(self, pose: Pose) -> Float[Array, "3 3"]:
        """The derivative of `frame` by the pose."""
        if self.mount is None:
            return jnp.eye(3, dtype=pose.dtype)
        return se2.compose_jacobians(pose, self._mount(pose))[0]

    def _mount(self, pose: Pose) -> Pose:
        return jnp.asarray(self.mount, pose.dtype)

    @property
    def of_points(self) -> bool:
        """Whether a landmark is a point (x, y), as some methods need."""
        return len(self.landmark) == 2 and self.carry is None

    def carried(self, frame: Pose, landmark: Landmark) -> Landmark:
        """A landmark given in a frame, in the coordinates that the frame's pose is in."""
        if self.carry is not None:
            carried: Array = self.carry(frame, landmark)
            return carried
        if len(self.landmark) < 2:
            return landmark
        turns = np.array([name.endswith("[rad]") for name in self.landmark[2:]], bool)
        rest = jnp.where(turns, wrap(landmark[2:] + frame[2]), landmark[2:])
        return jnp.concatenate([se2.from_frame(frame, landmark[:2]), rest])


class Basis(NamedTuple):
    """The derivative of a chart's `retract` at zero, block lower triangular."""

    pose: Float[Array, "3 3"]
    """∂pose/∂dx."""
    cross: Float[Array, "L 3"]
    """∂l/∂dx."""
    landmark: Array | None
    """(L, L) ∂l/∂dl; None says identity, without products."""


@dataclass(frozen=True, eq=False)
class Chart:
    """Error coordinates of the covariance, on a pair of the pose and one landmark.

    The pose's retraction must not depend on a landmark, nor one landmark's on another.
    """

    name: str
    retract: Callable[[Array, Array, Array, Array], tuple[Array, Array]]
    """(pose, l, dx (3,), dl (L,)) -> (pose, l)."""
    local: Callable[[Array, Array, Array, Array], tuple[Array, Array]]
    """(pose0, l0, pose, l) -> (dx, dl) with retract(pose0, l0, dx, dl) = (pose, l)."""
    basis: Callable[[Array, Array], Basis] | None = None
    """(pose, l) -> the derivative of retract at zero; None says identity, without products."""
    landmark_size: int | None = None
    """numbers L of the landmarks it acts on; None where any."""

    def __post_init__(self) -> None:
        _check_fields(
            self,
            {"retract": "pose, l, dx, dl", "local": "pose0, l0, pose, l"},
            optional=("basis",),
        )


class Here(NamedTuple):
    """The state at which a model is linearized, the input of a linearizer."""

    joint: Joint
    """the filter's state, `joint.lin` being the linearizer's own memory"""
    chart: Chart
    pose: Float[Array, "3"]
    """estimate of the robot"""
    cov: Array
    """P in the chart: of the robot (3, 3), or for `observe` of robot and landmark (3+L, 3+L)"""
    slot: PyTree = None
    """() of the landmark, for `observe`"""
    landmark: PyTree = None
    """(L,) its estimate, for `observe`"""


@dataclass(frozen=True, eq=False)
class Linearizer:
    """An affine approximation, with added noise, of the models near a Gaussian.

    First-order linearizers evaluate Jacobians at a point; statistical ones fit over the covariance.
    Each may keep a memory inside the filter's state. Derivatives are by the
    *coordinates* of pose and landmark, whatever the chart.
    """

    name: str
    init: Callable[[Array, Array], PyTree]
    """(pose, landmarks (N, L) zeros) -> memory, a pytree of arrays of fixed shape."""
    motion: Callable[[Motion, Array, Here], tuple[Array, Array, Array, PyTree]]
    """(motion, u, here) -> the new pose, its derivative by the old one (3, 3), the covariance that
    the noise adds to it (3, 3), memory."""
    observe: Callable[[Sensor, Here], tuple[Array, Array, Array, Array]]
    """(sensor, here) -> the predicted z, its derivatives by pose (Z, 3) and by l (Z, L), and a
    covariance (Z, Z) to add to that of the measurement noise."""
    invert: Callable[[Sensor, Array, Array, Here], tuple[Array, Array, Array]]
    """(sensor, z, tag (), here) -> the new l, its derivative by the pose (L, 3), its covariance for
    a known pose (L, L)."""
    born: Callable[[Joint, Array], PyTree]
    """(joint, born (N,) bool) -> memory, after new landmarks entered the map."""
    euclidean: bool = False
    """whether it is meant for the Euclidean chart and landmarks that are points (x, y) alone."""
    iterates: bool = True
    """whether a correction may linearize again at its result; a fit to a covariance may not."""
    own_landmarks: bool = False
    """whether it linearizes at landmarks other than the estimates; not for known maps then."""

    def __post_init__(self) -> None:
        _check_fields(
            self,
            {
                "init": "pose, landmarks",
                "motion": "motion, u, here",
                "observe": "sensor, here",
                "invert": "sensor, z, tag, here",
                "born": "joint, born",
            },
        )


class Pairs(NamedTuple):
    """The innovations of all pairs of M measurements and N slots."""

    innovation: Float[Array, "M N Z"]
    """ν_ij = z_i ⊖ ẑ_j."""
    cov: Float[Array, "M N Z Z"]
    """S_ij = H_j P H_jᵀ + R_i."""
    distance: Float[Array, "M N"]
    """ν_ijᵀ S_ij⁻¹ ν_ij."""
    log_det: Float[Array, "M N"]
    """log |S_ij|."""
    possible: Bool[Array, "M N"]
    """measurement and landmark are there, and S_ij is positive definite."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """The input of association: predicted measurements of the map before the scan's corrections.

    The functions compute what they return when they are called, within the trace.
    """

    tag: Int[Array, "N"]
    """tags of the slots, -1 where dead."""
    alive: Bool[Array, "N"]
    pairs: Callable[[Scan], Pairs]
    """(scan) -> every measurement against every slot."""
    cross: Callable[[], Array]
    """() -> (N, Z, N, Z): H_i P H_jᵀ, the cross-covariances of predicted measurements."""


class Association(NamedTuple):
    """The landmark slot of each measurement of a scan."""

    slot: Int[Array, "M"]
    """-1 where none; no slot twice."""
    is_new: Bool[Array, "M"]
    """starts a landmark. A valid measurement that is neither is ignored, and counted."""
    exhausted: Array | bool = False
    """() bool: a search ended at its budget, with the best it had found."""


Associate = Callable[[Prediction, Scan], Association]
"""Association methods. They are not differentiated: what they return are integers."""


Resample = Callable[[Array, Array], Array]
"""(log-weights (P,) of any scale, key) -> the ancestor (P,) int of each of the P particles that go
on; the expected number of copies of j is P w_j. Not differentiated."""

Differentiable = Callable[[Array, Array], tuple[Array, Array]]
"""As `Resample`, with the log-weight (P,) of each as well, Σ exp = 1, through which gradients reach
the weights before. Do not normalize it again: the gradient of its sum may be part of the method."""


@dataclass(frozen=True, eq=False)
class Life:
    """A rule that decides after each scan which landmarks stay in the map; see `pruning`."""

    name: str
    init: Callable[[Array, Array], PyTree]
    """(pose, landmarks (N, L) zeros) -> memory, a pytree of arrays of fixed shape."""
    after: Callable[[Joint, Info, Callable[[], Estimate]], tuple[PyTree, Array]]
    """(joint, info, estimate) -> memory, slots to remove (N,) bool; called after a scan, with its
    info. `joint.life` is the memory so far, estimate() the moments in map coordinates."""
    make_room: Callable[[Joint, Array, Array], Array] | None = None
    """(joint, needed () int, measured (N,) bool) -> slots (N,) bool to remove before new landmarks
    enter a map that lacks so many slots, none of those this scan measured; None if nothing is
    removed from a full map."""


@dataclass(frozen=True, eq=False)
class Filter:
    """A recursive estimator, as `run` and `monte_carlo` take it."""

    name: str
    controls: tuple[str, ...]
    """What u holds, with units, as `Motion.controls`."""
    measurements: tuple[str, ...]
    """What z holds, with units, as `Sensor.measurements`."""
    init: Callable[[Array, Array], PyTree]
    """(pose, pose_cov (3, 3)) -> S."""
    predict: Callable[[PyTree, Array, Array], PyTree]
    """(S, u, key) -> S."""
    update: Callable[[PyTree, Scan, Array], tuple[PyTree, Info]]
    """(S, scan, key) -> S, info."""
    estimate: Callable[[PyTree], Estimate]
    """(S) -> moments in map coordinates."""
    chart: Chart
    places: tuple[int, ...] = ()
    """number of measurement slots of each sensor, in order; () where all are of one sensor."""
    square_root: bool = False
    """whether its state is a `slots.Joint` with a root of the covariance."""
    landmark: tuple[str, ...] = ()
    """what a landmark of its `slots.Joint` holds, with units, as `Sensor.landmark`; () where its
    state is none."""

    def __post_init__(self) -> None:
        _check_fields(
            self,
            {
                "init": "pose, pose_cov",
                "predict": "S, u, key",
                "update": "S, scan, key",
                "estimate": "S",
            },
            ("controls", "measurements"),
        )


Estimator = Callable[[Log, Array], Trace]
"""(log, key) -> trace: `partial(run, filter, …)`, or a batch method."""

Candidate = Filter | Callable[[Truth], Filter | Estimator]
"""An entry of a campaign: a filter, or a function of the run's truth that returns a filter or an
estimator."""
