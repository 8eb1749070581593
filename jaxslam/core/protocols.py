"""The records of pure functions that make up a SLAM method.

Every method, and field that is a function, is pure and traceable and acts on *one* pose, landmark
or scan; the caller vmaps. The numbers of a motion model or a sensor are the leaves of a record.

Shapes: pose (3,); robot (3 + E,) the pose, then E further numbers of a motion model's state, E = 0
of most; u (U,) control; w (W,) process noise; z (Z,) measurement; l (L,) landmark parameters;
s (K,) landmark parameters that z does not determine (K = 0 if none).
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int, PyTree

from jaxslam.core._names import unfit_signature
from jaxslam.core._record import Function, check_field, field, is_record, record, static
from jaxslam.core.claims import Argument, Claim, Gaussian, Points, ValuesOf
from jaxslam.core.noise import Constant, NoiseCov
from jaxslam.core.slots import Joint
from jaxslam.core.types import Estimate, Info, JaxOrNumPy, Log, Scan, Trace
from jaxslam.core.validation import (
    Check,
    InvalidField,
    covariance,
    instance_of,
    mounting_pose,
    names,
    or_none,
    refusals_of,
    require,
)
from jaxslam.math import se2
from jaxslam.math._arrays import (
    Control,
    Landmark,
    Measurement,
    Point,
    Pose,
    ProcessNoise,
    Robot,
    Unmeasured,
)
from jaxslam.math.angles import wrap

__all__ = [
    "NOTHING_FREE",
    "POSE",
    "Associate",
    "Association",
    "Basis",
    "Candidate",
    "Chart",
    "Component",
    "Differentiable",
    "Estimator",
    "Filter",
    "Free",
    "Life",
    "LinearizationPoint",
    "Linearizer",
    "Model",
    "Motion",
    "Pairs",
    "Prediction",
    "Reduced",
    "Resample",
    "Sensor",
    "Wrapper",
    "motion_of_pose",
    "sensor_of_robot",
]


def _lower(cls: type) -> str:
    """The name of a class in lower case, words divided by underscores."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", cls.__name__).lower()


class Component:
    """The base of models, rules and filters: a name, and a check of a subclass's methods."""

    name: str
    """lower case, for tables, files and messages; by default that of the class"""
    kind: str = ""
    """what `verify` calls it in a report"""
    __dataclass_fields__: ClassVar[dict[str, Any]]

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        if "name" not in cls.__dict__ and not isinstance(getattr(cls, "name", None), property):
            cls.name = _lower(cls)

    def __init__(self, *_: object, **__: object) -> None:  # a record has a constructor of its own
        reason = "expected @record above the class, of jaxslam.core.record"
        raise InvalidField("", reason, owner=type(self).__name__)

    def claims(self) -> tuple[Claim, ...]:
        """What `verify` compares: its functions with their Jacobians; here nothing."""
        return ()

    def _check(self, base: type, methods: Mapping[str, str]) -> None:
        """Check that a subclass of `base` defines methods of these parameters.

        methods: the parameters of each by its name, "" where `verify` reports other ones.
        """
        for name, parameters in methods.items():
            if getattr(type(self), name) is getattr(base, name):
                raise InvalidField(name, "expected a method, got none")
            if not parameters:
                continue
            signature = unfit_signature(getattr(self, name), parameters.count(",") + 1)
            if signature is not None:
                reason = f"expected a method of ({parameters}), got one of {signature}"
                raise InvalidField(name, reason)

    def _check_names(self, *fields: str) -> None:
        """Check that fields are tuples of names."""
        for name in fields:
            check_field(self, name, names)


@record
class _CovarianceFunction(Function):
    """A plain function that returns a covariance, which is checked where its numbers are known."""

    model: str = static()
    """the class of the model"""
    size: int = static()

    def __call__(self, *arguments: Array) -> Array:
        with refusals_of(self.model):
            cov = require("noise_cov", self.function(*arguments), covariance(self.size))
        return jnp.asarray(cov, arguments[0].dtype)


def _noise_of(model: type, size: int) -> Check:
    """The check of a model's noise_cov (size, size), which it makes a record that can be called."""

    def check(value: NoiseCov) -> object:
        if is_record(value):
            return value
        if callable(value):
            return _CovarianceFunction(value, model.__name__, size)
        return Constant(covariance(size)(value))

    return check


class Model(Component):
    """What motion models and sensors share: noise, and equations as text."""

    equations: str = ""
    """The model as lines of Python, for the README of `consistency.write_draws`; "" where only the
    docstring describes it. Names are those of entries, as v of "v [m/s]", and of fields. Motion:
    the pose x, y, theta before and x1, y1, theta1 after, the noise w_v of an entry v. Sensor: its
    pose x_s, y_s, theta_s in the map, the landmark l_x, l_y, the noise n_range of an entry
    range. Functions: those of `math`, wrap(a) in (-π, π], sinc(a) = sin(a)/a with sinc(0) = 1."""

    def _check_model(self, base: type, methods: tuple[str, ...], named: tuple[str, ...]) -> None:
        """Check a subclass of `base`, and make its noise_cov a record that can be called.

        named: the fields that are names of numbers; the last one names those that have noise.
        """
        self._check(base, dict.fromkeys(methods, ""))
        self._check_names(*named)
        if not hasattr(self, "noise_cov"):
            raise InvalidField("noise_cov", "expected a field or a method")
        if "noise_cov" in self.__dict__:
            size = len(getattr(self, named[-1]))
            check_field(self, "noise_cov", _noise_of(type(self), size))


POSE = ("x [m]", "y [m]", "theta [rad]")
"""The numbers of a pose, with which every `Motion.state` begins."""


def _check_state(value: Any) -> Any:
    """The check of a `Motion.state`: the pose, then different names with units."""
    names(value)
    if value[:3] != POSE or len(set(value)) < len(value):
        raise ValueError(f"expected the pose {POSE}, then other names, got {value}")
    for name in value[3:]:
        if re.fullmatch(r"[^\[\]]+ \[[^\[\]]+\]", name) is None:
            raise ValueError(
                f'expected a unit of each number, as "v [m/s]" or "k [1]", got {name!r}'
            )
    return value


class Motion(Model):
    """A motion model, one class for simulator and filters; w = 0 is the nominal motion.

    A subclass is a record (`core.record`) that declares controls and noises, has a field noise_cov,
    or a method of that name, and defines `step`. It may declare a `state` of more than the pose:
    robot (3 + E,) then takes the place of the pose in all its methods, and 3 + E that of 3.
    Raises ValueError, at construction, on a bad covariance, names other than a tuple of strings, a
    state without units, or a missing method.
    """

    kind = "motion"
    state: tuple[str, ...] = POSE
    """What robot holds, with units: the pose, then E further numbers, as "v [m/s]" or a bias. Those
    in [rad] are angles, wrapped by `step`."""
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
        self._check_model(Motion, ("step",), ("controls", "noises"))
        check_field(self, "state", _check_state)

    def step(self, pose: Robot, u: Control, w: ProcessNoise) -> Robot:
        """The pose after a control, or the robot after it; θ wrapped."""
        raise NotImplementedError

    def claims(self) -> tuple[Claim, ...]:
        """The claim of `step`."""

        def cov(pose: Robot, u: Control, w: ProcessNoise) -> Array:
            noise_cov: Array = self.noise_cov(pose, u)
            return noise_cov

        def perturbed(pose: Robot, u: Control, w: ProcessNoise) -> Robot:
            return self.step(pose, self.perturb(u, w), jnp.zeros_like(w))

        arguments = (
            Argument("pose", self.state),
            Argument("control", self.controls, exact=True),
            Argument("noise", self.noises, scale=0.1, cov=cov),
        )
        equation = "step(pose, u, w) = step(pose, perturb(u, w), 0)"
        equal = {} if self.perturb is None else {equation: perturbed}
        return (
            Claim(
                "step",
                self.step,
                arguments,
                self.state,
                self.jacobians,
                equal,
                wrapped=True,
                everywhere=True,
            ),
        )


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
    field `mount`, and then observes from `frame(pose)`. One that measures more than the pose, as a
    velocity, declares these numbers as `robot`. Raises ValueError, at construction, on a bad
    covariance or mount, names other than a tuple of strings, or a missing method.

    An absolute sensor (a compass, a satellite receiver) has no landmark: l is (0,), invert and
    embed return (0,), position unused zeros, and K = 0. Each of its measurements
    corrects the robot, whatever the tag.
    """

    kind = "sensor"
    measurements: tuple[str, ...]
    """What z holds, with units; its length is Z."""
    support: Mapping[str, tuple[float, float]] = MappingProxyType({})
    """The open interval in which an entry of z lies, by its name, as {"range [m]": (0, np.inf)};
    others are not limited. The verifier tries `invert` at no other measurement."""
    landmark: tuple[str, ...] = ("x [m]", "y [m]")
    """What l holds, with units; its length is L, 0 for an absolute sensor."""
    robot: tuple[str, ...] = ()
    """The k numbers of the robot that it needs beside the pose, by their names in `Motion.state`:
    `observe` and `invert`, and their Jacobians, get the pose followed by these, (3 + k,), in place
    of the pose, for any other numbers of the state, in any order. The rest takes the pose."""
    noise_cov: Any
    """(z) -> (Z, Z), R where the exact measurement is z. Given as a covariance, a record with
    `__call__`, or a function. Worlds call it at the exact measurement, filters at the predicted
    one, ẑ, and at the measured one where there is no ẑ: for new landmarks, and in empty slots."""
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
        self._check_model(Sensor, ("observe", "invert"), ("robot", "landmark", "measurements"))
        check_field(self, "support", self._check_support)
        if not isinstance(getattr(type(self), "free", None), property):
            check_field(self, "free", instance_of(Free))
        if "mount" in self.__dict__:
            check_field(self, "mount", or_none(mounting_pose))

    def _check_support(self, support: Mapping[str, tuple[float, float]]) -> Mapping[str, Any]:
        for entry, limits in support.items():
            low, high = limits if np.shape(limits) == (2,) else (np.nan, np.nan)
            if entry not in self.measurements or not low < high:
                raise ValueError(
                    f"expected {{entry: (low, high)}} of {', '.join(self.measurements)}, got "
                    f"{entry!r}: {limits!r}"
                )
        return support

    def observe(self, pose: Robot, landmark: Landmark) -> Measurement:
        """The measurement z of a landmark."""
        raise NotImplementedError

    def invert(self, pose: Robot, z: Measurement, s: Unmeasured) -> Landmark:
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
        """The landmark at a point, measured first from pose. By default zeros follow the point."""
        rest = max(len(self.landmark) - 2, 0)
        return jnp.concatenate([point, jnp.zeros(rest, point.dtype)]) if rest else point

    def frame(self, pose: Robot) -> Pose:
        """The pose of the sensor, pose ∘ mount; what follows the pose is not used."""
        pose = pose[:3] if self.robot else pose
        return pose if self.mount is None else se2.compose(pose, self._mount(pose))

    def frame_jacobian(self, pose: Robot) -> Float[Array, "3 3"]:
        """The derivative of `frame` by the pose."""
        pose = pose[:3] if self.robot else pose
        if self.mount is None:
            return jnp.eye(3, dtype=pose.dtype)
        return se2.compose_jacobians(pose, self._mount(pose))[0]

    def _mount(self, pose: Pose) -> Pose:
        return jnp.asarray(self.mount, pose.dtype)

    def claims(self) -> tuple[Claim, ...]:
        """The claims of `observe` and of its inverse, `invert`."""
        pose = Argument("pose", (*POSE, *self.robot))
        places = Points(self.embed, self.position, self.frame)
        measured = ValuesOf("observe", self.support)
        free = tuple(f"s[{k}]" for k in range(len(self.free.mean)))
        return (
            Claim(
                "observe",
                self.observe,
                (pose, Argument("landmark", self.landmark, places)),
                self.measurements,
                self.observe_jacobians,
                everywhere=True,
                residual=self.residual,
                noise_cov=lambda pose, landmark: self.noise_cov(self.observe(pose, landmark)),
            ),
            Claim(
                "invert",
                self.invert,
                (
                    pose,
                    Argument("measurement", self.measurements, measured),
                    Argument("free", free, Gaussian(*self.free)),
                ),
                self.landmark,
                self.invert_jacobians,
                everywhere=True,
            ),
        )

    def scans(self, scan: Scan) -> "list[tuple[Sensor | None, Scan]]":
        """The sensors of a suite in order, each with its scan; here this sensor with the scan.

        Those of a suite are of landmarks of one size; None measures other robots. Raises ValueError
        unless the scan has as many slots as the sensors together.
        """
        return [(self, scan)]

    @property
    def absolute(self) -> bool:
        """Whether it measures the robot and no landmark (L = 0), as a compass."""
        return not self.landmark

    @property
    def of_points(self) -> bool:
        """Whether a landmark is a point (x, y), as some methods need."""
        return len(self.landmark) == 2 and self.carry is None

    def move_landmark(self, frame: Pose, landmark: Landmark) -> Landmark:
        """A landmark given in a frame, in the coordinates that the frame's pose is in."""
        if self.carry is not None:
            moved: Array = self.carry(frame, landmark)
            return moved
        if len(self.landmark) < 2:
            return landmark
        turns = np.array([name.endswith("[rad]") for name in self.landmark[2:]], bool)
        rest = jnp.where(turns, wrap(landmark[2:] + frame[2]), landmark[2:])
        return jnp.concatenate([se2.from_frame(frame, landmark[:2]), rest])


def motion_of_pose(motion: Motion) -> Motion:
    """The check of a motion model whose state is the pose, without further numbers."""
    if further := motion.state[3:]:
        raise ValueError(
            f"expected a model whose state is the pose, got {motion.name} with {', '.join(further)}"
        )
    return motion


def sensor_of_robot(state: tuple[str, ...]) -> Check:
    """The check of a sensor, or a suite, of a robot whose state has the numbers it asks for."""

    def check(value: Sensor) -> Sensor:
        for sensor in [part.sensor for part in getattr(value, "parts", ())] or [value]:
            if missing := [name for name in sensor.robot if name not in state]:
                raise ValueError(
                    f"{sensor.name} asks for {', '.join(missing)}, the state of the motion has "
                    f"{', '.join(state)}"
                )
        return value

    return check


class Basis(NamedTuple):
    """The derivative of a chart's `retract` at zero, block lower triangular."""

    pose: Float[Array, "3 3"]
    """∂pose/∂dx."""
    cross: Float[Array, "L 3"]
    """∂l/∂dx."""
    landmark: Array | None
    """(L, L) ∂l/∂dl; None is the identity, without products."""


class Chart(Component):
    """Error coordinates of the covariance, on a pair of the pose and one landmark.

    A subclass is a record (`core.record`) that defines `retract` and `local`. The pose's retraction
    must not depend on a landmark, nor one landmark's on another.
    """

    basis: Any = None
    """(pose, l) -> the derivative of retract at zero; None is the identity, without products."""
    landmark_size: int | None = None
    """numbers L of the landmarks it acts on; None where any."""

    def __post_init__(self) -> None:
        self._check(Chart, {"retract": "pose, l, dx, dl", "local": "pose0, l0, pose, l"})

    def retract(
        self, pose: Pose, landmark: Landmark, dx: Pose, dl: Landmark
    ) -> tuple[Pose, Landmark]:
        """Pose and landmark moved by errors dx (3,) and dl (L,)."""
        raise NotImplementedError

    def local(
        self, pose0: Pose, landmark0: Landmark, pose: Pose, landmark: Landmark
    ) -> tuple[Pose, Landmark]:
        """The errors (dx, dl) with retract(pose0, l0, dx, dl) = (pose, l)."""
        raise NotImplementedError

    def retract_pose(self, pose: Robot, dx: Robot) -> Robot:
        """(3,) pose moved by errors dx (3,), which no landmark changes."""
        ground = self._ground(pose)
        return self.retract(pose, ground, dx, ground)[0]

    def local_pose(self, pose0: Robot, pose: Robot) -> Robot:
        """The errors dx (3,) with retract_pose(pose0, dx) = pose."""
        ground = self._ground(pose)
        return self.local(pose0, ground, pose, ground)[0]

    def pose_basis(self, pose: Robot) -> Float[Array, "R R"]:
        """The derivative of `retract_pose` at zero, of a chart with a `basis`."""
        basis: Basis = self.basis(pose, self._ground(pose))
        return basis.pose

    def _ground(self, pose: Robot) -> Array:
        """A landmark of zeros."""
        size = 2 if self.landmark_size is None else self.landmark_size
        return jnp.zeros(size, pose.dtype)


class LinearizationPoint(NamedTuple):
    """The state at which a model is linearized, the input of a linearizer."""

    joint: Joint
    """the filter's state; `joint.lin` is the memory of the linearizer"""
    chart: Chart
    pose: Float[Array, "R"]
    """estimate of the robot: R = 3, its pose, or the R = 3 + E numbers of `Motion.state`"""
    cov: Array
    """P in the chart: of the robot (R, R); for `observe` of robot and landmark (R+L, R+L), or of
    the robot alone where the landmark is known without an error"""
    slot: PyTree = None
    """() of the landmark, for `observe`"""
    landmark: PyTree = None
    """(L,) its estimate, for `observe`"""


class Linearizer(Component):
    """An affine approximation, with added noise, of the models near a Gaussian.

    A subclass is a record (`core.record`) that defines `motion`, `observe` and `invert`.
    First-order linearizers evaluate Jacobians at a point; statistical ones fit over the covariance.
    Each may keep a memory inside the filter's state, `joint.lin`. Derivatives are by the
    *coordinates* of pose and landmark, whatever the chart. Of a motion model with further numbers
    in its state, the pose is that of `LinearizationPoint`, and 3 + E takes the place of 3.
    """

    euclidean: bool = False
    """whether it works only in the Euclidean chart with landmarks that are points (x, y)."""
    iterates: bool = True
    """whether a correction may linearize again at its result; a fit to a covariance may not."""
    own_landmarks: bool = False
    """whether it linearizes at landmarks other than the estimates; not for known maps then."""

    def __post_init__(self) -> None:
        self._check(
            Linearizer,
            {
                "motion": "motion, u, point",
                "observe": "sensor, point",
                "invert": "sensor, z, tag, point",
            },
        )

    def init(self, pose: Robot, landmarks: Float[Array, "N L"]) -> PyTree:
        """The first memory, of a start with landmarks (N, L) zeros: arrays of fixed shape."""
        return ()

    def motion(
        self, motion: Motion, u: Control, point: LinearizationPoint
    ) -> tuple[Array, Array, Array, PyTree]:
        """The new pose, its derivative by the old one (3, 3), the covariance that the noise adds to
        it (3, 3), and the memory."""
        raise NotImplementedError

    def observe(
        self, sensor: Sensor, point: LinearizationPoint
    ) -> tuple[Array, Array, Array, Array]:
        """The predicted z, its derivatives by pose (Z, 3) and by l (Z, L), and a covariance (Z, Z)
        to add to that of the measurement noise."""
        raise NotImplementedError

    def invert(
        self, sensor: Sensor, z: Measurement, tag: Int[Array, ""], point: LinearizationPoint
    ) -> tuple[Array, Array, Array]:
        """The new l, its derivative by the pose (L, 3), its covariance for a known pose (L, L)."""
        raise NotImplementedError

    def remember(self, joint: Joint, new: Bool[Array, "N"]) -> PyTree:
        """The memory after the landmarks of the slots `new` entered the map."""
        return joint.lin


class Pairs(NamedTuple):
    """The innovations of all pairs of M measurements and N slots."""

    innovation: Float[Array, "M N Z"]
    """ν_ij = z_i ⊖ ẑ_j."""
    cov: Float[Array, "M N Z Z"]
    """S_ij = H_j P H_jᵀ + R(ẑ_j)."""
    distance: Float[Array, "M N"]
    """ν_ijᵀ S_ij⁻¹ ν_ij."""
    log_det: Float[Array, "M N"]
    """log |S_ij|."""
    possible: Bool[Array, "M N"]
    """measurement and landmark exist, and S_ij is positive definite."""


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
    """-1 without a landmark; no slot twice."""
    is_new: Bool[Array, "M"]
    """starts a landmark. A valid measurement that is neither is ignored, and counted."""
    exhausted: Array | bool = False
    """() bool: a search ended at its budget, with the best it had found."""


Associate = Callable[[Prediction, Scan], Association]
"""Association methods, records with `__call__` or functions. They are not differentiated: what they
return are integers."""


Resample = Callable[[Array, Array], Array]
"""(log-weights (P,) of any scale, key) -> the ancestor (P,) int of each of the P particles that go
on; the expected number of copies of j is P w_j. Not differentiated."""

Differentiable = Callable[[Array, Array], tuple[Array, Array]]
"""As `Resample`, with the log-weight (P,) of each as well, Σ exp = 1, through which gradients reach
the weights before. Do not normalize it again: the gradient of its sum may be part of the method."""


class Life(Component):
    """A rule that decides after each scan which landmarks stay in the map, an argument of filters.

    A subclass is a record (`core.record`) that defines `init` and `after`.
    """

    make_room: Any = None
    """(joint, needed () int, measured (N,) bool) -> slots (N,) bool to remove before new landmarks
    enter a map that lacks so many slots, none of those this scan measured; None if nothing is
    removed from a full map."""

    def __post_init__(self) -> None:
        self._check(Life, {"init": "pose, landmarks", "after": "joint, info, estimate"})

    def init(self, pose: Pose, landmarks: Float[Array, "N L"]) -> PyTree:
        """The first memory, of a start with landmarks (N, L) zeros: arrays of fixed shape."""
        raise NotImplementedError

    def after(
        self, joint: Joint, info: Info, estimate: Callable[[], Estimate]
    ) -> tuple[PyTree, Bool[Array, "N"]]:
        """The memory after a scan, and the slots to remove.

        joint.life is the memory so far, estimate() the moments in map coordinates.
        """
        raise NotImplementedError


class Filter(Component):
    """A recursive estimator, as `run` and `monte_carlo` take it.

    A subclass is a record (`core.record`) that defines `init`, `predict`, `update` and `estimate`,
    whose state is a pytree of arrays of fixed shapes, and has a field motion and a field sensor, or
    declares controls and measurements.

    Raises ValueError, at construction, on a missing method, or one of other arguments.
    """

    chart: Chart
    """the error coordinates of its covariance"""
    square_root: bool = False
    """whether its state is a `slots.Joint` with a root of the covariance."""
    landmark: tuple[str, ...] = ()
    """the entries of a landmark of its `slots.Joint`, with units, as `Sensor.landmark`; () for
    another state."""
    linearized: Any = None
    """the `LinearizedSteps` of a filter whose steps return the linear system they use."""
    map_size: int | None = None
    """N of a filter in a known map of all landmarks, whose tags are 0 … N-1; None of another."""
    further: bool = False
    """whether it estimates further numbers of the robot beside the pose, where `Motion.state` has
    any; one that does not refuses such a model. `init` then gets robot (3 + E,) and its covariance,
    and its estimates have `Estimate.further`."""

    def __post_init__(self) -> None:
        self._check(
            Filter,
            {
                "init": "pose, pose_cov",
                "predict": "state, u, key",
                "update": "state, scan, key",
                "estimate": "state",
            },
        )
        self._check_names("controls", "measurements")
        if not self.further and (beside := self.robot_state[3:]):
            reason = (
                f"it estimates a pose alone, and the state of the motion has {', '.join(beside)}"
            )
            raise InvalidField("", reason)
        if isinstance(sensor := getattr(self, "sensor", None), Sensor):
            require("sensor", sensor, sensor_of_robot(self.robot_state))

    @property
    def robot_state(self) -> tuple[str, ...]:
        """What the robot's state holds, with units: the pose, and further numbers."""
        return getattr(getattr(self, "motion", None), "state", POSE)

    @property
    def controls(self) -> tuple[str, ...]:
        """What u holds, with units."""
        motion: Motion = self.motion  # type: ignore[attr-defined]
        return motion.controls

    @property
    def measurements(self) -> tuple[str, ...]:
        """What z holds, with units."""
        sensor: Sensor = self.sensor  # type: ignore[attr-defined]
        return sensor.measurements

    @property
    def places(self) -> tuple[int, ...]:
        """The measurement slots of each sensor of a suite, in order; () of a single sensor."""
        return getattr(getattr(self, "sensor", None), "places", ())

    def init(self, pose: Robot, pose_cov: Float[Array, "R R"]) -> PyTree:
        """The state at the start."""
        raise NotImplementedError

    def predict(self, state: PyTree, u: Control, key: Array) -> PyTree:
        """The state after a control."""
        raise NotImplementedError

    def update(self, state: PyTree, scan: Scan, key: Array) -> tuple[PyTree, Info]:
        """The state after a scan, and what became of its measurements."""
        raise NotImplementedError

    def estimate(self, state: PyTree) -> Estimate:
        """The moments of a state in map coordinates."""
        raise NotImplementedError


@record
class Wrapper(Filter):
    """A filter that holds another, and does as that one does unless it defines a method itself."""

    filter: Filter = field(check=instance_of(Filter))

    @property
    def name(self) -> str:  # type: ignore[override]
        return f"{_lower(type(self))} {self.filter.name}"

    @property
    def robot_state(self) -> tuple[str, ...]:
        return self.filter.robot_state

    @property
    def controls(self) -> tuple[str, ...]:
        return self.filter.controls

    @property
    def measurements(self) -> tuple[str, ...]:
        return self.filter.measurements

    @property
    def places(self) -> tuple[int, ...]:
        return self.filter.places

    @property
    def chart(self) -> Chart:  # type: ignore[override]
        return self.filter.chart

    @property
    def square_root(self) -> bool:  # type: ignore[override]
        return self.filter.square_root

    @property
    def landmark(self) -> tuple[str, ...]:  # type: ignore[override]
        return self.filter.landmark

    @property
    def map_size(self) -> int | None:  # type: ignore[override]
        return self.filter.map_size

    def init(self, pose: Robot, pose_cov: Float[Array, "R R"]) -> PyTree:
        return self.filter.init(pose, pose_cov)

    def predict(self, state: PyTree, u: Control, key: Array) -> PyTree:
        return self.filter.predict(state, u, key)

    def update(self, state: PyTree, scan: Scan, key: Array) -> tuple[PyTree, Info]:
        return self.filter.update(state, scan, key)

    def estimate(self, state: PyTree) -> Estimate:
        return self.filter.estimate(state)


Estimator = Callable[[Log, Array], Trace]
"""(log, key) -> trace: `partial(run, filter, …)`, or a batch method."""

Candidate = Filter | Callable[..., Any]
"""An entry of a campaign: a filter, a smoother, or a function of the run's truth that returns a
filter or an estimator."""
