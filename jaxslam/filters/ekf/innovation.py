"""What measurements say of all errors of a `Joint`: innovations, their covariances, and gains."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxslam import slots
from jaxslam.filters.ekf.predicted_measurements import in_chart, innovation_cov
from jaxslam.filters.ekf.to_points import at_slot
from jaxslam.math import linalg
from jaxslam.math.xla import apart, settle
from jaxslam.protocols import Chart, Here, Linearizer, Sensor
from jaxslam.slots import Joint


class Correction(NamedTuple):
    """What `correct` did with its m measurements; the numbers are finite for all of them."""

    innovation: jax.Array
    """(m, Z) against the prior"""
    innovation_cov: jax.Array
    """(m, Z, Z)"""
    nis: jax.Array
    """(m,)"""
    log_likelihood: jax.Array
    """(m,)"""
    inside: jax.Array
    """(m,) bool: passed the gate"""
    positive: jax.Array
    """(m,) bool: its innovation covariance is positive definite"""


class View(NamedTuple):
    """What m measurements see of P, or, of a square-root filter, of its root."""

    robot: jax.Array
    """(3, D) rows of the robot"""
    own: jax.Array
    """(m, L, D) rows of the landmarks seen"""
    local: jax.Array
    """(m, 3+L, 3+L) P of the robot and the landmark"""


class Weighed(NamedTuple):
    """What m measurements say of all errors, and what the forms of the update are made of."""

    xi: jax.Array
    """(D,) the correction in the chart"""
    v: jax.Array
    """(m·Z, D) V = L⁻¹ H P"""
    whitened: jax.Array
    """(m·Z,) L⁻¹ ν"""
    factor: jax.Array
    """(m·Z, m·Z) L, with rows of zeros for what is not fused"""
    s: jax.Array
    """(m, Z, m, Z) S"""
    hp: jax.Array
    """(m·Z, D) H P"""
    hx: jax.Array
    """(m, Z, D) H X of a square-root filter, else H P"""
    noise: jax.Array
    """(m, Z, Z) R with what the linearizer added"""
    own_noise: jax.Array
    """(m, Z, Z) R"""
    slopes: tuple[jax.Array, jax.Array]
    """H by the errors of pose (m, Z, 3) and landmark (m, Z, L)"""
    seen: tuple[jax.Array, jax.Array]
    """the same by coordinates, at the prior"""
    fuse: jax.Array
    """(m,) bool: known, inside the gate and regular alone"""
    correction: Correction


def view_of(joint: Joint, slot: jax.Array, square_root: bool = False) -> View:
    """What measurements of the landmarks in slot (m,) see."""
    own = jax.vmap(slots.gather, in_axes=(None, 0))(joint, slot)[1]
    local = jax.vmap(partial(slots.local_cov, joint, square_root=square_root))(slot)
    return View(joint.cov[:3], own, local)


def weigh(
    joint: Joint,
    slot: jax.Array,
    view: View,
    z: jax.Array,
    known: jax.Array,
    memory: tuple[Joint, jax.Array],
    *,
    sensor: Sensor,
    chart: Chart,
    linearize: Linearizer,
    gate: float | None = None,
    iterations: int = 1,
    square_root: bool = False,
) -> Weighed:
    """Solà (26)-(29) for m measurements at once, from the view they have of P.

    memory: the state that the linearizer remembers by, and the landmarks' slots (m,) there. P may
    have further columns, which count as other errors.
    """
    whole, slot_in_whole = memory
    m, size_z = z.shape
    capacity, size_l = joint.landmarks.shape
    width = 3 + capacity * size_l
    prior_l = joint.landmarks[slot]
    own_noise = jax.vmap(sensor.noise_cov)(z)
    same = jnp.eye(m, dtype=z.dtype)[:, None, :, None]
    over_landmarks = jax.vmap(chart.retract, in_axes=(None, 0, None, 0))
    pose, landmark = joint.pose, prior_l
    xi = jnp.zeros(view.robot.shape[1], z.dtype)
    for iteration in range(iterations):
        expected, by_pose, by_landmark, rest = jax.vmap(
            lambda at, landmark, cov, pose=pose: linearize.observe(
                at_slot(sensor, whole, at), Here(whole, chart, pose, cov, at, landmark)
            )
        )(slot_in_whole, landmark, view.local)
        noise = own_noise + rest
        nu = jax.vmap(sensor.residual)(z, expected)
        if iteration == 0:
            seen = by_pose, by_landmark
        xi_l = xi[3:width].reshape(capacity, size_l)[slot]
        if chart.basis is not None:
            moved = None if iteration == 0 else (xi[:3], xi_l)
            by_pose, by_landmark = in_chart(chart, joint.pose, prior_l, by_pose, by_landmark, moved)
        if iteration > 0:
            nu = nu + jnp.einsum("mzi,i->mz", by_pose, xi[:3])
            nu = nu + jnp.einsum("mzi,mi->mz", by_landmark, xi_l)
        # One array, and so one kernel and not three.
        found = settle(jnp.concatenate([by_pose, by_landmark, nu[:, :, None]], axis=2))
        by_pose, by_landmark, nu = found[:, :, :3], found[:, :, 3:-1], found[:, :, -1]
        hp = hx = apart(_seen_rows, found, view.robot, view.own)
        if square_root:
            hp = settle((hx.reshape(m * size_z, -1) @ joint.cov.T).reshape(hx.shape))
        s = innovation_cov(hp, by_pose, by_landmark, slot, capacity) + same * noise[:, :, None]
        marginal = s[jnp.arange(m), :, jnp.arange(m)]
        own, definite = apart(jax.vmap(linalg.whitener), marginal)
        if iteration == 0:
            innovation, alone, positive = nu, marginal, definite
            distance = (_product(own, nu[:, :, None]) ** 2).sum(axis=(1, 2))
            # A finite measurement so far off that its d² is not is outside any gate.
            inside = jnp.isfinite(distance) if gate is None else distance <= gate
            fuse = known & inside & positive
        hp = hp.reshape(m * size_z, -1)
        both = fuse[:, None, None, None] & fuse[None, None, :, None]
        s = jnp.where(both, s, same * jnp.eye(size_z, dtype=z.dtype)[None, :, None])
        s = settle(s)
        factor = settle(linalg.cholesky(s.reshape(m * size_z, m * size_z))[0])
        pivots = jnp.diagonal(factor).reshape(m, size_z)
        # Measurements that are regular one by one can still be singular together.
        regular = definite if m == 1 else (pivots > 0).all(axis=1)
        # A row without a pivot says nothing, and costs no mask of what it would say.
        factor = jnp.where(jnp.repeat(fuse & regular, size_z)[:, None], factor, 0.0)
        if m == 1:  # it has been factored already, alone
            whiten = jnp.where((fuse & regular)[:, None, None], own, 0.0)
            v, whitened = apart(_whitened, whiten, hp, nu)
            pivots = jnp.diagonal(own, axis1=1, axis2=2)
        else:
            # As a vector, the factor has one layout: LAPACK wants columns, and XLA (jaxlib 0.12)
            # may pass rows to a computation that was compiled for columns.
            v, whitened = apart(_solved, factor.reshape(-1), hp, nu.reshape(-1))
        xi = linalg.gram(v, whitened[:, None])[:, 0]
        if iteration == 0:
            positive = positive & regular
            log_det = 2 * jnp.log(jnp.where(pivots > 0, pivots, 1.0)).sum(axis=1)
            log_det = -log_det if m == 1 else log_det  # of L⁻¹, of L
            nis = (whitened.reshape(m, size_z) ** 2).sum(axis=1)
        if iteration + 1 < iterations:
            xi_l = xi[3:width].reshape(capacity, size_l)[slot]
            poses, landmark = over_landmarks(joint.pose, prior_l, xi[:3], xi_l)
            pose = poses[0]

    log_likelihood = -0.5 * (nis + log_det + size_z * jnp.log(2 * jnp.pi))
    return Weighed(
        xi=xi,
        v=v,
        whitened=whitened,
        factor=factor,
        s=s,
        hp=hp,
        hx=hx,
        noise=noise,
        own_noise=own_noise,
        slopes=(by_pose, by_landmark),
        seen=seen,
        fuse=fuse,
        correction=Correction(
            innovation=innovation,
            innovation_cov=alone,
            nis=jnp.where(fuse, nis, distance),
            log_likelihood=jnp.where(fuse & positive, log_likelihood, 0.0),
            inside=inside,
            positive=positive,
        ),
    )


@linalg.kept_whole
def _seen_rows(found: jax.Array, robot: jax.Array, own: jax.Array) -> jax.Array:
    """H P (m, Z, D) of H by pose and landmark, first in found (m, Z, 3+L+1), rows (3, D) and
    (m, L, D).
    """
    terms = [found[:, :, k, None] * robot[None, None, k] for k in range(3)]
    terms += [found[:, :, 3 + k, None] * own[:, None, k] for k in range(own.shape[1])]
    return linalg.total(terms)


def _solved(factor: jax.Array, hp: jax.Array, nu: jax.Array) -> tuple[jax.Array, jax.Array]:
    factor = factor.reshape(len(nu), len(nu))
    both = linalg.solve_lower(factor, jnp.concatenate([hp, nu[:, None]], axis=1))
    return both[:, :-1], both[:, -1]


def _whitened(whiten: jax.Array, hp: jax.Array, nu: jax.Array) -> tuple[jax.Array, jax.Array]:
    return _product(whiten, hp[None])[0], _product(whiten, nu[:, :, None]).reshape(-1)


@linalg.kept_whole
def _product(whiten: jax.Array, rhs: jax.Array) -> jax.Array:
    """W B (m, Z, k) of W (m, Z, Z) and B (m, Z, k)."""
    each = range(whiten.shape[1])
    return linalg.total(whiten[:, :, k, None] * rhs[:, k, None] for k in each)
