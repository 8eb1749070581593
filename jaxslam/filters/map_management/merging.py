"""Two landmarks of a map that are one: found by a joint chi-square test, merged by a constraint."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxslam import slots
from jaxslam.filters.ekf.coordinates import retracted
from jaxslam.math import linalg
from jaxslam.math.linalg import is_concrete
from jaxslam.math.stats import chi2_quantile
from jaxslam.protocols import Chart
from jaxslam.slots import Joint
from jaxslam.types import Info, Status

Array = jax.Array


class Duplicates(NamedTuple):
    """Which two landmarks `ekf_slam(merge=…)` takes for one; see `duplicates`."""

    reach: float
    probability: float


def duplicates(reach: float, probability: float = 0.95) -> Duplicates:
    """After each scan, merge the pair of landmarks that is most likely one, if it may be one.

    It may where the two are within reach, the joint test passes at this probability, and no scan
    has measured both: a landmark gives one measurement a scan.

    Args:
        reach: [m] true landmarks do not stand as near to one another. A test alone cannot tell two
            landmarks from one where their difference is known worse than that.
        probability: of merging two that are one, by the test.
    Raises:
        ValueError: on a reach not above 0 or a probability outside 0 to 1.
    """
    if not reach > 0:
        raise ValueError(f"duplicates: expected a reach above 0, got {reach}")
    if not 0 < probability < 1:
        raise ValueError(f"duplicates: expected 0 < probability < 1, got {probability}")
    return Duplicates(reach, probability)


def told_apart(joint: Joint, info: Info, places: tuple[int, ...] = ()) -> Array:
    """(N, N) bool: which landmarks one sensor measured together, in this scan or one before.

    places: how many of a scan each sensor has; () where all are of one.
    """
    capacity = joint.alive.shape[0]
    both: Array = joint.apart
    at = 0
    for count in places or info.status.shape[-1:]:
        both = both | _together(info.status[at : at + count], info.slot[at : at + count], capacity)
        at += count
    return both


def _together(status: Array, slot: Array, capacity: int) -> Array:
    """(N, N) bool: both slots were corrected or born."""
    seen = (status == Status.FUSED) | (status == Status.BORN)
    here = slots.concerned(slot, seen, capacity)
    return here[:, None] & here[None, :]


def find_duplicate(
    joint: Joint, chart: Chart, rule: Duplicates, *, square_root: bool = False
) -> tuple[Array, Array, Array]:
    """Slots i < j of two landmarks that are taken for one, and whether there are such."""
    i, j, distance = closest_pair(
        joint, chart, rule.reach, allowed=~joint.apart, square_root=square_root
    )
    return i, j, distance <= chi2_quantile(rule.probability, joint.landmarks.shape[1])


def closest_pair(
    joint: Joint,
    chart: Chart,
    reach: float,
    allowed: Array | None = None,
    *,
    square_root: bool = False,
) -> tuple[Array, Array, Array]:
    """Slots i < j of the two landmarks that are most likely one, and their squared distance.

    d² = δᵀ C⁻¹ δ with δ = l_i - l_j and C = cov(δ), in which the correlation of the two counts:
    of landmarks that are each known badly, but well against one another, d² is large. i = j = 0 and
    d² infinite where no pair is within reach [m] of another and allowed (N, N). square_root: as in
    `merge`.

    Raises ValueError on a reach not above 0, or allowed of another shape.
    """
    capacity, size = joint.landmarks.shape
    if is_concrete(reach) and not reach > 0:
        raise ValueError(f"closest_pair: expected a reach above 0, got {reach}")
    if allowed is not None and jnp.shape(allowed) != (capacity, capacity):
        raise ValueError(
            f"closest_pair: expected allowed of shape {(capacity, capacity)}, "
            f"got {jnp.shape(allowed)}"
        )
    delta = joint.landmarks[:, None] - joint.landmarks[None, :]
    by_robot, by_landmark = _derivatives(joint, chart)
    whole = joint.cov @ joint.cov.T if square_root else joint.cov
    robot = whole[:3, :3]
    cross = whole[:3, 3:].reshape(3, capacity, size)
    blocks = whole[3:, 3:].reshape(capacity, size, capacity, size)
    # Of coordinates: l_i = A_i dx + B_i dl_i, so cov(l_i, l_j) has four terms.
    with_robot = jnp.einsum("nij,jmk,mlk->nmil", by_robot, cross, by_landmark)
    apart = jnp.einsum("nij,njmk,mlk->nmil", by_landmark, blocks, by_landmark)
    cov = apart + with_robot + with_robot.transpose(1, 0, 3, 2)
    cov = cov + jnp.einsum("nij,jk,mlk->nmil", by_robot, robot, by_robot)
    own = cov[jnp.arange(capacity), jnp.arange(capacity)]
    spread = own[:, None] + own[None, :] - cov - cov.transpose(1, 0, 2, 3)

    def distance(delta: Array, cov: Array) -> Array:
        factor, positive = linalg.cholesky(cov)
        return jnp.where(positive, (linalg.solve_lower(factor, delta) ** 2).sum(), jnp.inf)

    pairs = joint.alive[:, None] & joint.alive[None, :]
    pairs = pairs & (jnp.arange(capacity)[:, None] < jnp.arange(capacity)[None, :])
    pairs = pairs & ((delta**2).sum(axis=2) <= reach**2)
    if allowed is not None:
        pairs = pairs & allowed
    each = jnp.where(pairs, jax.vmap(jax.vmap(distance))(delta, spread), jnp.inf)
    best = jnp.argmin(each)
    return best // capacity, best % capacity, each.reshape(-1)[best]


def merge(joint: Joint, chart: Chart, i: Array, j: Array, *, square_root: bool = False) -> Joint:
    """The map given that the landmarks of slots i and j are one, which slot i keeps.

    The constraint l_i = l_j is a measurement of δ = l_i - l_j = 0 without noise: with
    S = cov(δ) = L Lᵀ and V = L⁻¹ cov(δ, ·), x ← x ⊞ -Vᵀ L⁻¹ δ and P ← P - Vᵀ V, for points exact.
    Slot j, now the same, is removed. Nothing happens where i = j or S is singular. square_root: the
    state holds a root of P, as that of a filter with square_root=True does.
    """
    size = joint.landmarks.shape[1]
    by_robot, by_landmark = (part[jnp.stack([i, j])] for part in _derivatives(joint, chart))
    rows = joint.cov @ joint.cov.T if square_root else joint.cov
    own = [jax.lax.dynamic_slice_in_dim(rows, 3 + slot * size, size) for slot in (i, j)]
    with_all = (by_robot[0] - by_robot[1]) @ rows[:3]
    with_all = with_all + by_landmark[0] @ own[0] - by_landmark[1] @ own[1]
    mine = [jax.lax.dynamic_slice_in_dim(with_all, 3 + s * size, size, axis=1) for s in (i, j)]
    s = with_all[:, :3] @ (by_robot[0] - by_robot[1]).T
    s = s + mine[0] @ by_landmark[0].T - mine[1] @ by_landmark[1].T
    factor, positive = linalg.cholesky(linalg.symmetrize(s))
    ok = positive & (i != j)
    factor = jnp.where(ok, factor, 0.0)
    v = linalg.solve_lower(factor, with_all)
    white = linalg.solve_lower(factor, joint.landmarks[j] - joint.landmarks[i])
    xi = linalg.gram(v, white[:, None])[:, 0]
    pose, landmarks = retracted(chart, joint, xi)
    cov = rows - linalg.gram(v, v)
    if square_root:
        cov = linalg.root_psd(cov)
    apart = joint.apart
    if not isinstance(apart, tuple):  # what was measured together with either
        either = ok & (apart[i] | apart[j])
        apart = apart.at[i].set(apart[i] | either).at[:, i].set(apart[i] | either)
    merged = joint._replace(
        pose=pose,
        landmarks=landmarks,
        cov=jnp.where(ok, cov, joint.cov),
        apart=apart,
    )
    return slots.remove(
        merged, ok & (jnp.arange(joint.alive.shape[0]) == j), square_root=square_root
    )


def _derivatives(joint: Joint, chart: Chart) -> tuple[Array, Array]:
    """Of each landmark's coordinates by errors of the pose (N, L, 3) and its own (N, L, L)."""
    capacity, size = joint.landmarks.shape
    still = jnp.broadcast_to(jnp.eye(size, dtype=joint.cov.dtype), (capacity, size, size))
    if chart.basis is None:
        return jnp.zeros((capacity, size, 3), joint.cov.dtype), still
    basis = jax.vmap(chart.basis, in_axes=(None, 0))(joint.pose, joint.landmarks)
    return basis.cross, still if basis.landmark is None else basis.landmark
