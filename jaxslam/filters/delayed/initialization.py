"""A landmark as many sightings of it place it at once, and what they say beyond that of the map."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxslam.filters.delayed.hypotheses import blocks_of, relative_spread, safe_root
from jaxslam.filters.delayed.state import SIZE
from jaxslam.filters.delayed.triangulation import Meeting
from jaxslam.math import linalg
from jaxslam.math.angles import wrap
from jaxslam.math.xla import settle
from jaxslam.slots import Joint

Array = jax.Array

# Gauss-Newton steps from a hypothesis, which is near already.
_DESCENTS = 4


class InitialEstimate(NamedTuple):
    """A landmark as m sightings place it, every Jacobian taken there."""

    point: Array
    """(2,) x*"""
    by_sight: Array
    """(m, 3) G_s"""
    turn: Array
    """(m, m) Qᵀ L⁻¹"""
    value: Array
    """(m,) Qᵀ L⁻¹ e"""
    undo: Array
    """(2, 2) -R⁻¹"""
    nis: Array
    """() what the sightings disagree by: chi-square with m - 2 degrees of freedom"""
    spread: Array
    """() the largest standard deviation of the place, relative to where the first sighting was
    taken, over the distance"""
    regular: Array
    """() bool: the sightings locate it"""


def initial_estimate(
    joint: Joint, meeting: Meeting, start: Array, sightings: Array, use: Array
) -> InitialEstimate:
    """Where m sightings place a landmark, and how well they agree.

    Each sighting of the landmark says g(s_k, x) = 0, to first order e + G_s δs + G_x δx = 0. With
    M = G_s P_ss G_sᵀ = L Lᵀ, x* is where eᵀ M⁻¹ e is least. A rotation Qᵀ of the rows L⁻¹ (·) that
    makes those of G_x upper triangular, two Householder reflections, parts them; both parts have
    unit covariance, and none with one another:

    - the first two, R δx = -(e₁ + G₁ δs), give the landmark: P_x· = -R⁻¹ G₁ P_s·, P_xx = (RᵀR)⁻¹;
    - the others, in which x does not occur, measure e₂ = -G₂ δs, and correct the whole map.

    So each sighting counts once, and no prior of the landmark is needed. (What is done with feature
    tracks by A. I. Mourikis, S. I. Roumeliotis, "A multi-state constraint Kalman filter for
    vision-aided inertial navigation", ICRA 2007, who keep the second part alone.) A hypothesis only
    says which sightings belong together: corrected by one after the other, each at another place,
    it holds Jacobians that contradict each other, and a robot corrected through it would take the
    difference for information.

    Args:
        start: (2,) where to begin.
        sightings: (m,) slots, those to use first.
        use: (m,) bool.
    """
    m = len(sightings)
    seen = joint.landmarks[sightings]
    blocks = blocks_of(joint)[sightings][:, :, sightings]
    both, unit = use[:, None] & use[None, :], jnp.eye(m, dtype=seen.dtype)

    def rows(point: Array) -> tuple[Array, Array, Array, Array, Array]:
        value = jnp.where(use, jax.vmap(meeting.miss, (0, None))(seen, point), 0.0)
        by_sight, by_point = jax.vmap(jax.jacfwd(meeting.miss, argnums=(0, 1)), (0, None))(
            seen, point
        )
        by_sight = jnp.where(use[:, None], by_sight, 0.0)
        own = jnp.einsum("mi,minj,nj->mn", by_sight, blocks, by_sight)
        whiten, positive = linalg.whitener_by_rows(jnp.where(both, own, unit))
        by_point = whiten @ jnp.where(use[:, None], by_point, 0.0)
        return whiten @ value, by_sight, by_point, whiten, positive

    def descend(before: Any, _: None) -> tuple[Any, None]:
        point = before[0]
        found = rows(point)
        value, _by_sight, by_point, _whiten, positive = found
        step, regular = linalg.solve_psd(by_point.T @ by_point, by_point.T @ value)
        return (point - jnp.where(regular & positive, step, 0.0), point, found), None

    # The rows at the end of the last descent are those of one more, whose end is not used.
    nothing = jnp.zeros((m, 3 + SIZE + m), seen.dtype)
    none = nothing[:, 0], nothing[:, :SIZE], nothing[:, :2], nothing[:, 6:], jnp.asarray(True)
    _, point, found = jax.lax.scan(descend, (start, start, none), None, length=_DESCENTS + 1)[0]
    value, by_sight, by_point, whiten, positive = found
    turn = settle(_triangular(by_point))
    triangle, value, turn = (turn @ by_point)[:2], turn @ value, turn @ whiten
    regular = (use.sum() >= 2) & (jnp.abs(triangle[0, 0] * triangle[1, 1]) > 0)
    safe = jnp.where(regular, triangle, jnp.eye(2, dtype=triangle.dtype))
    undo = -linalg.inverse(safe.at[1, 0].set(0.0))
    point = point + undo @ value[:2]
    cross = undo @ (turn @ jnp.einsum("mi,mij->mj", by_sight, blocks[:, :, 0, :2]))[:2]
    apart = linalg.symmetrize(undo @ undo.T - cross - cross.T + blocks[0, :2, 0, :2])
    return InitialEstimate(
        point=point,
        by_sight=by_sight,
        turn=turn,
        value=value,
        undo=undo,
        nis=(value[2:] ** 2).sum(),
        spread=relative_spread(point - seen[0, :2], apart),
        regular=regular & positive,
    )


def add_landmark(joint: Joint, found: InitialEstimate, slot: Array, sightings: Array) -> Joint:
    """The map with the landmark in a dead slot (), corrected by what its sightings say beyond it.

    sightings: those of `fit`.
    """
    capacity = joint.landmarks.shape[0]
    table = joint.cov[3:].reshape(capacity, SIZE, -1)
    hp = settle(found.turn @ jnp.einsum("mi,mid->md", found.by_sight, table[sightings]))
    mine = 3 + SIZE * slot + jnp.arange(2)
    half = (found.undo @ hp[:2]).at[:, mine].add(0.5 * found.undo @ found.undo.T)
    # Padding's unit variance goes first, to an exact zero.
    cov = joint.cov.at[mine, mine].add(-1.0)
    cov = cov.at[mine].add(half).at[:, mine].add(half.T)
    # Of unit covariance, and none with the landmark: S = I, and S⁻¹ costs nothing.
    v, white = hp[2:], found.value[2:]
    moved = -linalg.gram(v, white[:, None])[:, 0]
    pose = joint.pose + moved[:3]
    here = (jnp.arange(capacity) == slot)[:, None]
    placed = jnp.where(here, jnp.pad(found.point, [(0, SIZE - 2)])[None], joint.landmarks)
    return joint._replace(
        pose=jnp.concatenate([pose[:2], wrap(pose[2:])]),
        landmarks=placed + moved[3:].reshape(capacity, SIZE),
        cov=cov - linalg.gram(v, v),
        alive=joint.alive | here[:, 0],
    )


def _triangular(matrix: Array) -> Array:
    """Orthogonal Qᵀ (m, m) with Qᵀ A upper triangular, of A (m, 2); rows of zeros stay."""
    m = matrix.shape[0]
    turn = jnp.eye(m, dtype=matrix.dtype)
    for k in range(2):
        column = jnp.where(jnp.arange(m) >= k, (turn @ matrix)[:, k], 0.0)
        sign = jnp.where(column[k] >= 0, 1.0, -1.0)
        axis = column.at[k].add(sign * safe_root((column**2).sum()))
        square = (axis**2).sum()
        scale = jnp.where(square > 0, 2 / jnp.where(square > 0, square, 1.0), 0.0)
        turn = turn - scale * axis[:, None] * (axis @ turn)[None, :]
    return turn
