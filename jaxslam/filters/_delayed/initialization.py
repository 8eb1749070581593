"""Initialization of a landmark from all its stored measurements, which also correct the map."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int, PyTree

from jaxslam.core.slots import Joint
from jaxslam.filters._delayed.hypotheses import (
    StoredNoise,
    UncertainPoints,
    relative_spread,
    safe_root,
)
from jaxslam.filters._delayed.state import SIZE, covariance_blocks, covariance_rows
from jaxslam.filters._delayed.triangulation import Triangulation
from jaxslam.math import _linalg as linalg
from jaxslam.math._xla import materialize
from jaxslam.math.angles import wrap

_STEPS = 4
"""Gauss-Newton steps: few, because the hypothesis is a good initial value."""


class InitialEstimate(NamedTuple):
    """The estimate of a landmark from m stored measurements, and the Jacobians at it."""

    point: Float[Array, "2"]
    """x*"""
    by_stored: Float[Array, "m 3"]
    """G_s"""
    transform: Float[Array, "m m"]
    """Qᵀ L⁻¹"""
    value: Float[Array, "m"]
    """Qᵀ L⁻¹ e"""
    minus_r_inv: Float[Array, "2 2"]
    """-R⁻¹"""
    nis: Float[Array, ""]
    """squared residual of the measurements: chi-square with m - 2 degrees of freedom"""
    spread: Float[Array, ""]
    """largest standard deviation of the point relative to the position of the first measurement,
    over their distance"""
    regular: Bool[Array, ""]
    """the measurements determine the point"""


def initial_estimate(
    joint: Joint,
    triangulation: Triangulation,
    noise: StoredNoise,
    start: Float[Array, "2"],
    stored: Int[Array, "m"],
    use: Bool[Array, "m"],
) -> InitialEstimate:
    """The least-squares estimate of a landmark from m stored measurements, and its residual.

    Each stored measurement of the landmark is a constraint g(s_k, x) = 0, to first order
    e + G_s δs + G_x δx = 0. With M = G_s P_ss G_sᵀ = L Lᵀ, x* is where eᵀ M⁻¹ e is least; where R
    varies, with R(ẑ) of each iterate in M, held (as `graphs.FromSensor` does). The orthogonal Qᵀ
    (two Householder reflections) that makes L⁻¹ G_x upper triangular divides the rows
    Qᵀ L⁻¹ (e + G_s δs + G_x δx) = 0 into two parts of unit covariance, uncorrelated:

    - the first two, R δx = -(e₁ + G₁ δs), give the landmark: P_x· = -R⁻¹ G₁ P_s·, P_xx = (RᵀR)⁻¹;
    - the others, in which x does not occur, measure e₂ = -G₂ δs, and correct the whole map.

    So each measurement is used once, and no prior of the landmark is needed. (A. I. Mourikis, S. I.
    Roumeliotis, "A multi-state constraint Kalman filter for vision-aided inertial navigation", ICRA
    2007, treat feature tracks in this way, and keep only the second part.) A hypothesis only groups
    the measurements: it was corrected by them in turn, each linearized at another point, and these
    inconsistent Jacobians would give the robot spurious information.

    Args:
        noise: of the stored measurements.
        start: initial value of Gauss-Newton.
        stored: slots of the measurements, those to use first.
        use: mask of the measurements to use.
    """
    m = len(stored)
    s = joint.landmarks[stored]
    residual = triangulation.residual
    blocks = covariance_blocks(joint)[stored][:, :, stored]
    both, unit = use[:, None] & use[None, :], jnp.eye(m, dtype=s.dtype)

    def whiten_residuals(
        point: Float[Array, "2"],
    ) -> tuple[
        Float[Array, "m"], Float[Array, "m 3"], Float[Array, "m 2"], Float[Array, "m m"], Array
    ]:
        """The whitened residual L⁻¹ e, G_s, L⁻¹ G_x, L⁻¹, and whether M is positive definite."""
        value = jnp.where(use, jax.vmap(residual, (0, None))(s, point), 0.0)
        by_stored, by_point = jax.vmap(jax.jacfwd(residual, argnums=(0, 1)), (0, None))(s, point)
        by_stored = jnp.where(use[:, None], by_stored, 0.0)
        cov = jnp.einsum("mi,minj,nj->mn", by_stored, blocks, by_stored)
        # ∂g/∂q = 1.
        cov = cov + jnp.diag(noise.change(value))
        inverse_root, positive = linalg.whitener_by_rows(jnp.where(both, cov, unit))
        by_point = inverse_root @ jnp.where(use[:, None], by_point, 0.0)
        return inverse_root @ value, by_stored, by_point, inverse_root, positive

    def gauss_newton(before: PyTree, _: None) -> tuple[PyTree, None]:
        point = before[0]
        terms = whiten_residuals(point)
        value, _by_stored, by_point, _inverse_root, positive = terms
        step, regular = linalg.solve_psd(by_point.T @ by_point, by_point.T @ value)
        return (point - jnp.where(regular & positive, step, 0.0), point, terms), None

    # The terms after the last step are those of one more step, whose result is not used.
    zeros = jnp.zeros((m, 3 + SIZE + m), s.dtype)
    none = zeros[:, 0], zeros[:, :SIZE], zeros[:, :2], zeros[:, 6:], jnp.asarray(True)
    _, point, terms = jax.lax.scan(gauss_newton, (start, start, none), None, length=_STEPS + 1)[0]
    value, by_stored, by_point, inverse_root, positive = terms
    q = materialize(_reflections(by_point))
    r, value, transform = (q @ by_point)[:2], q @ value, q @ inverse_root
    # A product of m terms leaves m eps of a pivot of 0, as of parallel rays; 8 is a margin.
    least = 8 * m * float(jnp.finfo(r.dtype).eps) * (r**2).sum()
    regular = (use.sum() >= 2) & (jnp.abs(r[0, 0] * r[1, 1]) > least)
    safe = jnp.where(regular, r, jnp.eye(2, dtype=r.dtype))
    minus_r_inv = -linalg.inverse(safe.at[1, 0].set(0.0))
    point = point + minus_r_inv @ value[:2]
    # The covariance of the point relative to the position of the first measurement.
    with_first = transform @ jnp.einsum("mi,mij->mj", by_stored, blocks[:, :, 0, :2])
    cross = minus_r_inv @ with_first[:2]
    landmark_cov = minus_r_inv @ minus_r_inv.T
    relative = linalg.symmetrize(landmark_cov - cross - cross.T + blocks[0, :2, 0, :2])
    return InitialEstimate(
        point=point,
        by_stored=by_stored,
        transform=transform,
        value=value,
        minus_r_inv=minus_r_inv,
        nis=(value[2:] ** 2).sum(),
        spread=relative_spread(UncertainPoints(point - s[0, :2], relative)),
        regular=regular & positive,
    )


def add_landmark(
    joint: Joint, estimate: InitialEstimate, slot: Int[Array, ""], stored: Int[Array, "m"]
) -> Joint:
    """The joint with the landmark in a dead slot, corrected by its redundant measurements.

    Args:
        estimate: the `initial_estimate` from the measurements in the slots `stored`.
    """
    capacity = joint.landmarks.shape[0]
    rows = covariance_rows(joint)[stored]
    hp = materialize(estimate.transform @ jnp.einsum("mi,mid->md", estimate.by_stored, rows))
    landmark_rows = 3 + SIZE * slot + jnp.arange(2)
    # Added to rows and, transposed, to columns: half of P_xx each.
    half_cov = 0.5 * estimate.minus_r_inv @ estimate.minus_r_inv.T
    half = (estimate.minus_r_inv @ hp[:2]).at[:, landmark_rows].add(half_cov)
    # Padding's unit variance goes first, to an exact zero.
    cov = joint.cov.at[landmark_rows, landmark_rows].add(-1.0)
    cov = cov.at[landmark_rows].add(half).at[:, landmark_rows].add(half.T)
    # The redundant rows have unit covariance, uncorrelated with the landmark: S = I.
    v, value = hp[2:], estimate.value[2:]
    moved = -linalg.gram(v, value[:, None])[:, 0]
    pose = joint.pose + moved[:3]
    is_slot = (jnp.arange(capacity) == slot)[:, None]
    placed = jnp.where(is_slot, jnp.pad(estimate.point, [(0, SIZE - 2)])[None], joint.landmarks)
    return joint._replace(
        pose=jnp.concatenate([pose[:2], wrap(pose[2:])]),
        landmarks=placed + moved[3:].reshape(capacity, SIZE),
        cov=cov - linalg.gram(v, v),
        alive=joint.alive | is_slot[:, 0],
    )


def _reflections(matrix: Float[Array, "m 2"]) -> Float[Array, "m m"]:
    """The orthogonal Qᵀ, two Householder reflections, with Qᵀ A upper triangular; a zero row of A
    stays zero."""
    m = matrix.shape[0]
    q = jnp.eye(m, dtype=matrix.dtype)
    for k in range(2):
        column = jnp.where(jnp.arange(m) >= k, (q @ matrix)[:, k], 0.0)
        sign = jnp.where(column[k] >= 0, 1.0, -1.0)  # no cancellation in the axis
        axis = column.at[k].add(sign * safe_root((column**2).sum()))
        square = (axis**2).sum()
        scale = jnp.where(square > 0, 2 / jnp.where(square > 0, square, 1.0), 0.0)
        q = q - scale * axis[:, None] * (axis @ q)[None, :]
    return q
