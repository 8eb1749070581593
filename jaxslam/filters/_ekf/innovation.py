"""The innovations of m measurements, their covariance S, their gate, and V = L⁻¹ H P.

`innovate` linearizes, forms S = H P Hᵀ + R, gates, factors S = L Lᵀ and whitens by L⁻¹, with
one function for each step. Its result, an `Innovation`, serves all forms of the update (`update`).
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxslam.core import slots
from jaxslam.core.protocols import LinearizationPoint
from jaxslam.core.slots import Joint
from jaxslam.filters._ekf.ekf_settings import EkfSettings
from jaxslam.filters._ekf.linear_system import basis_of_each
from jaxslam.filters._ekf.map_coordinates import at_slot
from jaxslam.filters._ekf.predicted_measurements import in_chart, projected_cov
from jaxslam.filters._ekf.whitening import InnovationFactor, factor_of, whiten, whitened_by
from jaxslam.linearize._first_order import predicted_noise
from jaxslam.math import _linalg as linalg
from jaxslam.math._gaussians import log_density, log_det_of_pivots
from jaxslam.math._xla import materialize, no_inline


class Correction(NamedTuple):
    """The results of `correct` for its m measurements; the numbers are finite for all of them."""

    z_hat: Float[Array, "m Z"]
    """the predicted measurement ẑ, from the prior"""
    innovation: Float[Array, "m Z"]
    """against the prior"""
    innovation_cov: Float[Array, "m Z Z"]
    nis: Float[Array, "m"]
    log_likelihood: Float[Array, "m"]
    inside: Bool[Array, "m"]
    """passed the gate"""
    positive: Bool[Array, "m"]
    """its innovation covariance is positive definite"""
    jacobian: Float[Array, "m Z 3+L"]
    """H by coordinates, against the prior"""
    basis: Float[Array, "m 3+L 3+L"] | None
    """the coordinates by the errors in the chart; None is the identity"""


class _View(NamedTuple):
    """The rows of P, or of its square root, that m measurements involve."""

    robot: Float[Array, "3 D"]
    """rows of the robot"""
    landmark: Float[Array, "m L D"]
    """rows of the landmarks seen"""
    local: Float[Array, "m 3+L 3+L"]
    """P of the robot and the landmark"""


class Innovation(NamedTuple):
    """The whitened innovations and gain factors of m measurements, for all forms of the update."""

    xi: Float[Array, "D"]
    """the correction in the chart"""
    v: Float[Array, "m*Z D"]
    """V = L⁻¹ H P"""
    whitened: Float[Array, "m*Z"]
    """L⁻¹ ν"""
    factor: Float[Array, "m*Z m*Z"]
    """L, with rows of zeros for measurements that are not fused"""
    s: Float[Array, "m Z m Z"]
    """S, the identity where not fused"""
    hp: Float[Array, "m*Z D"]
    """H P"""
    hx: Float[Array, "m Z D"]
    """H X of a square-root filter, else H P"""
    noise: Float[Array, "m Z Z"]
    """R(ẑ) with the linearizer's addition"""
    jacobians: tuple[Float[Array, "m Z 3"], Float[Array, "m Z L"]]
    """H by the errors of pose and landmark"""
    fuse: Bool[Array, "m"]
    """known, inside the gate, and with a positive definite S_ii"""
    correction: Correction


class _Linearized(NamedTuple):
    """The linearization of m measurements as affine functions of the errors."""

    rows: Float[Array, "m Z 3+L+1"]
    """H by the errors of pose and landmark, and ν beside them"""
    z_hat: Float[Array, "m Z"]
    rest: Float[Array, "m Z Z"]
    """the linearizer's addition to R"""
    seen: tuple[Float[Array, "m Z 3"], Float[Array, "m Z L"]]
    """H by coordinates"""


class _Gated(NamedTuple):
    """The gate of each measurement separately, against the prior."""

    innovation: Float[Array, "m Z"]
    cov: Float[Array, "m Z Z"]
    distance: Float[Array, "m"]
    """ν_iᵀ S_ii⁻¹ ν_i"""
    inside: Bool[Array, "m"]
    positive: Bool[Array, "m"]
    fuse: Bool[Array, "m"]


def view_of(joint: Joint, slot: Int[Array, "m"], square_root: bool = False) -> _View:
    """The view of measurements of the landmarks in slot (m,)."""
    landmark_rows = jax.vmap(slots.gather, in_axes=(None, 0))(joint, slot)[1]
    local = jax.vmap(partial(slots.local_cov, joint, square_root=square_root))(slot)
    return _View(joint.cov[:3], landmark_rows, local)


def innovate(
    joint: Joint,
    slot: Int[Array, "m"],
    view: _View,
    z: Float[Array, "m Z"],
    known: Bool[Array, "m"],
    memory: tuple[Joint, Int[Array, "m"]],
    settings: EkfSettings,
) -> Innovation:
    """The innovation of m measurements at once, from their view of P: Solà (26)-(28).

        view of P        H                       H P          S = H P Hᵀ + R
        robot (3, D)     by pose (m, Z, 3)       (m·Z, D)     (m, Z, m, Z) = L Lᵀ
        own (m, L, D)    by landmark (m, Z, L)   V = L⁻¹ H P  ξ = Vᵀ L⁻¹ ν (D,)

    Each iteration linearizes at the prior retracted by the last ξ; gate, reported numbers and
    R(ẑ) are those of the first one. ẑ of a later one depends on the noise of z, as z itself does
    (`predicted_noise`), by the share of the gain.

    memory: the state with the linearizer's memory, and the landmarks' slots (m,) there. P may
    have further columns, of other errors.
    """
    m, size_z = z.shape
    capacity = joint.landmarks.shape[0]
    same = jnp.eye(m, dtype=z.dtype)[:, None, :, None]
    xi: jax.Array | None = None
    for i in range(settings.iterations):
        model = _linearize(joint, slot, view, z, memory, xi, settings)
        by_pose, by_landmark, nu = _split_rows(model.rows)
        if i == 0:
            each = jax.vmap(partial(predicted_noise, settings.sensor))
            noise = each(model.z_hat, z, known) + model.rest
        hx, hp = _project(model.rows, view, joint, settings)
        s = projected_cov(hp, by_pose, by_landmark, slot, capacity)
        s = s + same * noise[:, :, None]
        marginal = s[jnp.arange(m), :, jnp.arange(m)]
        inverse, definite = no_inline(jax.vmap(linalg.whitener), marginal)
        if i == 0:
            gated = _gate(nu, marginal, inverse, definite, known, settings.gamma)
        hp = hp.reshape(m * size_z, -1)
        factored = factor_of(s, same, inverse, definite, gated.fuse)
        v, whitened = whiten(factored, gated.fuse, hp, nu)
        xi = linalg.gram(v, whitened[:, None])[:, 0]
        if i == 0:
            jacobian = jnp.concatenate(model.seen, axis=2)
            basis = basis_of_each(settings.chart, joint.pose, joint.landmarks[slot])
            correction = _report(model.z_hat, gated, factored, whitened, jacobian, basis)
    assert xi is not None
    return Innovation(
        xi=xi,
        v=v,
        whitened=whitened,
        factor=factored.factor,
        s=factored.s,
        hp=hp,
        hx=hx,
        noise=noise,
        jacobians=(by_pose, by_landmark),
        fuse=gated.fuse,
        correction=correction,
    )


def _linearize(
    joint: Joint,
    slot: Int[Array, "m"],
    view: _View,
    z: Float[Array, "m Z"],
    memory: tuple[Joint, Int[Array, "m"]],
    xi: Float[Array, "D"] | None,
    settings: EkfSettings,
) -> _Linearized:
    """The linearization z ≈ ẑ + H (ξ - ξ_i) at the prior retracted by ξ_i; None: at the prior.

    With ν = z - ẑ + H ξ_i, the solution is ξ, relative to the prior.
    """
    whole, slot_in_whole = memory
    chart, sensor = settings.chart, settings.sensor
    prior = joint.landmarks[slot]
    pose, landmark, moved = joint.pose, prior, None
    if xi is not None:
        capacity, size_l = joint.landmarks.shape
        moved = xi[:3], xi[3 : 3 + capacity * size_l].reshape(capacity, size_l)[slot]
        over_landmarks = jax.vmap(chart.retract, in_axes=(None, 0, None, 0))
        poses, landmark = over_landmarks(joint.pose, prior, *moved)
        pose = poses[0]

    def observe(
        at: Int[Array, ""], landmark: Float[Array, "L"], cov: Float[Array, "3+L 3+L"]
    ) -> PyTree:
        point = LinearizationPoint(whole, chart, pose, cov, at, landmark)
        return settings.linearize.observe(at_slot(sensor, whole, at), point)

    z_hat, by_pose, by_landmark, rest = jax.vmap(observe)(slot_in_whole, landmark, view.local)
    nu = jax.vmap(sensor.residual)(z, z_hat)
    seen = by_pose, by_landmark
    if chart.basis is not None:
        by_pose, by_landmark = in_chart(chart, joint.pose, prior, by_pose, by_landmark, moved)
    if moved is not None:
        nu = nu + jnp.einsum("mzi,i->mz", by_pose, moved[0])
        nu = nu + jnp.einsum("mzi,mi->mz", by_landmark, moved[1])
    # One array, and so one kernel and not three.
    rows = materialize(jnp.concatenate([by_pose, by_landmark, nu[:, :, None]], axis=2))
    return _Linearized(rows, z_hat, rest, seen)


def _split_rows(
    rows: Float[Array, "m Z C"],
) -> tuple[Float[Array, "m Z 3"], Float[Array, "m Z L"], Float[Array, "m Z"]]:
    """The Jacobian H by the errors of pose and landmark, and ν."""
    return rows[:, :, :3], rows[:, :, 3:-1], rows[:, :, -1]


def _project(
    rows: Float[Array, "m Z C"], view: _View, joint: Joint, settings: EkfSettings
) -> tuple[Float[Array, "m Z D"], Float[Array, "m Z D"]]:
    """The products H X and H P of a square-root filter; else H P twice."""
    hp = hx = no_inline(_seen_rows, rows, view.robot, view.landmark)
    if settings.square_root:
        m, size_z = rows.shape[:2]
        hp = materialize((hx.reshape(m * size_z, -1) @ joint.cov.T).reshape(hx.shape))
    return hx, hp


def _gate(
    nu: Float[Array, "m Z"],
    cov: Float[Array, "m Z Z"],
    inverse: Float[Array, "m Z Z"],
    definite: Bool[Array, "m"],
    known: Bool[Array, "m"],
    gamma: PyTree,
) -> _Gated:
    """The gate d² <= γ: which measurements are fused. inverse: L⁻¹ of each cov = L Lᵀ."""
    distance = (whitened_by(inverse, nu[:, :, None]) ** 2).sum(axis=(1, 2))
    # A finite measurement whose d² overflows is outside any gate.
    inside = jnp.isfinite(distance) if gamma is None else distance <= gamma
    return _Gated(nu, cov, distance, inside, definite, known & inside & definite)


def _report(
    z_hat: Float[Array, "m Z"],
    gated: _Gated,
    factored: InnovationFactor,
    whitened: Float[Array, "K"],
    jacobian: Float[Array, "m Z W"],
    basis: Float[Array, "m W W"] | None,
) -> Correction:
    """The `Correction`: NIS of fused measurements from their joint S, of others from theirs."""
    m, size_z = gated.innovation.shape
    positive = gated.positive & factored.regular
    log_det = log_det_of_pivots(factored.pivots)
    log_det = -log_det if m == 1 else log_det  # of L⁻¹, of L
    nis = (whitened.reshape(m, size_z) ** 2).sum(axis=1)
    log_likelihood = log_density(nis, log_det, size_z)
    return Correction(
        z_hat=z_hat,
        innovation=gated.innovation,
        innovation_cov=gated.cov,
        nis=jnp.where(gated.fuse, nis, gated.distance),
        log_likelihood=jnp.where(gated.fuse & positive, log_likelihood, 0.0),
        inside=gated.inside,
        positive=positive,
        jacobian=jacobian,
        basis=basis,
    )


@linalg.kept_whole
def _seen_rows(
    rows: Float[Array, "m Z C"], robot: Float[Array, "3 D"], landmark_rows: Float[Array, "m L D"]
) -> Float[Array, "m Z D"]:
    """The product H P from the blocks of H, by rows, and P of the robot and the landmarks seen."""
    terms = [rows[:, :, k, None] * robot[None, None, k] for k in range(3)]
    terms += [
        rows[:, :, 3 + k, None] * landmark_rows[:, None, k] for k in range(landmark_rows.shape[1])
    ]
    return linalg.total(terms)
