"""Path and map that are most likely given a log: what its twins are made of."""

from functools import partial
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxslam.association._rules import Known
from jaxslam.core.protocols import Motion, Sensor
from jaxslam.core.types import Estimate, Log, Status
from jaxslam.core.validation import InvalidField
from jaxslam.graphs._chain.problem import Iterate, Problem, linearize_at, optimize_chain
from jaxslam.graphs._solver.search import Ending
from jaxslam.graphs.smoothing._batch_map import BatchMap
from jaxslam.linearize._first_order import nominal_path
from jaxslam.math import _linalg as linalg
from jaxslam.math._arrays import float64
from jaxslam.sensors._suite import Suite, of_robot
from jaxslam.simulation.spurious import Spurious

_ITERATIONS = 100
"""Largest number of Gauss-Newton steps."""

_NEAR = 0.01
"""A next step, in posterior standard deviations, that makes no difference."""

_CANDIDATES = 48
"""Places, along each axis, where a landmark may begin of which a measurement leaves a part free."""

_MARGIN = 0.5
"""Part of the extent of the path by which those places reach beyond it, where nothing says how far
a landmark is."""


class RecordedLog(Protocol):
    """What `twin` takes of a `datasets.Dataset`: a log with models, and options to filter it."""

    @property
    def name(self) -> str: ...
    @property
    def log(self) -> Log: ...
    @property
    def time(self) -> Float[np.ndarray, "T"]: ...
    @property
    def motion(self) -> Motion: ...
    @property
    def sensor(self) -> Sensor: ...
    @property
    def tags(self) -> tuple[int | str, ...]: ...
    @property
    def pose(self) -> Float[np.ndarray, "R"]: ...
    @property
    def pose_cov(self) -> Float[np.ndarray, "R R"]: ...
    @property
    def capacity(self) -> int: ...
    @property
    def filter_options(self) -> dict[str, Any]: ...
    @property
    def robots(self) -> tuple[Any, ...]: ...
    @property
    def default_noises(self) -> tuple[str, ...]: ...
    @property
    def spurious(self) -> Spurious | None: ...
    @property
    def source(self) -> str: ...


class SmoothedLog(NamedTuple):
    """The most likely noises and landmarks of a log."""

    noise: Float[np.ndarray, "T W"]
    """ŵ of the motions"""
    landmarks: Float[np.ndarray, "N L"]
    tag: Int[np.ndarray, "N"]
    """of the landmarks in the log, -1 where unknown"""
    seen: Int[np.ndarray, "T M"]
    """the landmark that each used measurement is of, -1 of others"""
    fused: bool
    """whether a measurement corrected the map"""
    still: bool
    """whether no motion has a noise"""
    further: Float[np.ndarray, "T E"]
    """the most likely numbers of the robot beside its pose, before each motion"""
    converged: bool
    """whether a further step of the search makes no difference"""
    steps: int
    """of the search"""


def associates(options: dict[str, Any]) -> bool:
    """Whether filters with these options associate measurements themselves."""
    rule = options.get("associate")
    return rule is not None and not isinstance(rule, Known)


def smooth(data: RecordedLog) -> SmoothedLog:
    """The smoothed log; InvalidField where the search for it does not converge.

    `BatchMap` from the path of an EKF, with the association, gate and births of the data set. Where
    a measurement leaves a part of its landmark free, from the path of the odometry and the places
    that agree best with it.
    """
    sensor = data.sensor
    is_single = not isinstance(sensor, Suite)
    by_odometry = is_single and sensor.of_points and sensor.free.mean.shape[0] > 0
    with float64():  # in single precision a long log does not converge
        if by_odometry and not associates(data.filter_options):
            smoothed = _from_odometry(data)
        else:
            smoothed = _from_filter(data)
    is_finite = np.isfinite(smoothed.noise).all() and np.isfinite(smoothed.landmarks).all()
    if not (smoothed.converged and is_finite):
        raise InvalidField(
            "dataset",
            f"the smoothing of {data.name} did not converge in {smoothed.steps} steps: look at the "
            "path of jaxslam run, fit the noises (jaxslam fit FOLDER --write), or set a gate "
            "against wrong measurements",
        )
    return smoothed


def _from_filter(data: RecordedLog) -> SmoothedLog:
    """The smoothed log by `BatchMap`, from the path of an EKF."""
    options = data.filter_options
    chosen = {name: options[name] for name in ("associate", "gate", "births") if name in options}
    start = np.asarray(data.pose, np.float64)
    try:
        smoother = BatchMap(
            data.motion,
            data.sensor,
            data.capacity,
            start,
            np.asarray(data.pose_cov, np.float64),
            iterations=_ITERATIONS,
            **chosen,
        )
    except InvalidField as problem:
        raise InvalidField("dataset", f"{problem.field}: {problem.reason}") from problem
    trace = smoother(jax.tree.map(np.asarray, data.log), jax.random.key(0))
    solved, status, slot = jax.device_get((trace.final, trace.info.status, trace.info.slot))
    # Q is evaluated at the filter's path, where the smoother takes it.
    before = np.concatenate([start[None], _robots(solved.filtered)[:-1]])
    control = np.asarray(data.log.control, np.float64)
    roots = np.asarray(jax.device_get(_noise_roots(data.motion, before, control)))

    # Landmarks by tag, where the log has tags, else by slot; and of each measurement its landmark.
    used = (status == Status.FUSED) | (status == Status.BORN)
    slots = np.flatnonzero(solved.joint.alive)
    tags = np.asarray(solved.joint.tag)[slots]
    if not associates(options):
        slots, tags = slots[np.argsort(tags)], np.sort(tags)
    row = np.full(len(solved.joint.alive), -1)
    row[slots] = np.arange(len(slots))
    robots = np.concatenate([solved.start[None], _robots(jax.device_get(trace.estimate))])
    return SmoothedLog(
        noise=np.einsum("tij,tj->ti", roots, solved.noise),
        landmarks=np.asarray(solved.joint.landmarks)[slots],
        tag=tags,
        seen=np.where(used, row[np.where(used, slot, 0)], -1),
        fused=bool((status == Status.FUSED).any()),
        still=not roots.any(),
        further=robots[:-1, 3:],
        converged=bool(solved.ending == Ending.CONVERGED or solved.step < _NEAR),
        steps=int(solved.iterations),
    )


def _robots(estimate: Estimate) -> Float[np.ndarray, "T R"]:
    """The poses of estimates, with what they have beside these."""
    parts = [estimate.pose] if estimate.further is None else [estimate.pose, estimate.further]
    return np.concatenate(list(map(np.asarray, parts)), axis=1)


def _from_odometry(data: RecordedLog) -> SmoothedLog:
    """The smoothed log by the same search, from the path of the odometry, with known tags."""
    log: Log = jax.tree.map(np.asarray, data.log)
    start = np.asarray(data.pose, np.float64)
    control = np.asarray(log.control, np.float64)
    path = np.asarray(jax.device_get(nominal_path(data.motion, start, control)))

    # Each landmark begins where it agrees best with its measurements from that path.
    valid = np.asarray(log.scan.valid) & (np.asarray(log.scan.tag) >= 0)
    tags = np.unique(np.asarray(log.scan.tag)[valid])
    slot = np.where(valid, np.searchsorted(tags, log.scan.tag), 0)
    z = np.where(valid[..., None], log.scan.z, 0.0)
    sensor = of_robot(data.sensor, data.motion.state)
    points = np.stack(
        [
            _likeliest_place(sensor, path[np.nonzero(of)[0]], z[of], path)
            for of in (valid & (slot == k) for k in range(len(tags)))
        ]
    )

    before = np.concatenate([start[None], path[:-1]])
    roots = _noise_roots(data.motion, before, control)
    cov = np.asarray(data.pose_cov, np.float64)
    arguments = start, cov, control, roots, z, slot, valid, path, points
    noise, landmarks, solved, ending, decrement, count = jax.device_get(
        _solve(data.motion, sensor, *arguments)
    )
    return SmoothedLog(
        noise=np.einsum("tij,tj->ti", np.asarray(roots), noise),
        landmarks=landmarks,
        tag=tags,
        seen=np.where(valid, slot, -1),
        fused=True,
        still=not np.asarray(roots).any(),
        further=np.asarray(solved)[:-1, 3:],
        converged=bool(ending == Ending.CONVERGED or np.sqrt(max(decrement, 0.0)) < _NEAR),
        steps=int(count),
    )


@partial(jax.jit, inline=True)
def _noise_roots(
    motion: Motion, before: Float[Array, "T R"], control: Float[Array, "T U"]
) -> Float[Array, "T W W"]:
    """The square root of Q of each row."""
    return jax.vmap(linalg.root_psd)(jax.vmap(motion.noise_cov)(before, control))


def _likeliest_place(
    sensor: Sensor,
    poses: Float[np.ndarray, "K R"],
    z: Float[np.ndarray, "K Z"],
    path: Float[np.ndarray, "T R"],
) -> Float[np.ndarray, "2"]:
    """The point of a grid about the path that agrees best with the measurements of a landmark."""
    low, high = path[:, :2].min(axis=0), path[:, :2].max(axis=0)
    ranges = [name.startswith("range") for name in sensor.measurements]
    reach = z[:, ranges].max() if any(ranges) else _MARGIN * (high - low).max()
    x, y = (np.linspace(a - reach, b + reach, _CANDIDATES) for a, b in zip(low, high, strict=True))
    candidates = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    # A power of two, so that landmarks share a few programs.
    size = 2 ** int(np.ceil(np.log2(len(poses))))
    spare = [(0, size - len(poses)), (0, 0)]
    counted = np.arange(size) < len(poses)
    misfit = _misfit(sensor, np.pad(poses, spare), np.pad(z, spare), counted, candidates)
    best: np.ndarray = candidates[int(np.argmin(jax.device_get(misfit)))]
    return best


@partial(jax.jit, inline=True)
def _misfit(
    sensor: Sensor,
    poses: Float[Array, "K R"],
    z: Float[Array, "K Z"],
    counted: Bool[Array, "K"],
    candidates: Float[Array, "C 2"],
) -> Float[Array, "C"]:
    """The sum of the residuals' sizes at each candidate: the odometry errs, so no squares."""

    def of_candidate(point: Array) -> Array:
        z_hat = jax.vmap(sensor.observe, (0, None))(poses, point)
        size = jnp.abs(jax.vmap(sensor.residual)(z, z_hat)).sum(axis=1)
        return jnp.where(counted, size, 0.0).sum()

    misfit: Array = jax.lax.map(of_candidate, candidates)
    return misfit


@partial(jax.jit, inline=True)
def _solve(
    motion: Motion,
    sensor: Sensor,
    start: Float[Array, "R"],
    cov: Float[Array, "R R"],
    control: Float[Array, "T U"],
    roots: Float[Array, "T W W"],
    z: Float[Array, "T M Z"],
    slot: Int[Array, "T M"],
    used: Bool[Array, "T M"],
    path: Float[Array, "T R"],
    points: Float[Array, "N 2"],
) -> tuple[Array, Array, Array, Array, Array, Array]:
    """Noises of the motions in deviations, points, path, ending, decrement and steps of the
    search."""
    problem = Problem(start, linalg.root_psd(cov), control, roots, z, slot, used)
    poses = jnp.concatenate([start[None], path])
    at = Iterate(jnp.zeros_like(start), jnp.zeros(roots.shape[:2], z.dtype), poses, points)
    chain = linearize_at(motion, sensor, problem, at)
    alive = jnp.ones(len(points), bool)
    search = optimize_chain(
        motion, sensor, problem, at, chain, alive, iterations=_ITERATIONS, tolerance=1e-6
    )
    return (
        search.at.noise,
        search.at.landmarks,
        search.at.path,
        search.ending,
        search.policy.decrement,
        search.steps,
    )
