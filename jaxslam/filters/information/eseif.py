"""The exactly sparse extended information filter: sparse because the robot is relocated."""

import jax
import jax.numpy as jnp

from jaxslam.filters.information import canonical
from jaxslam.filters.information.mean_recovery import owed_of, relaxed, solved, swept
from jaxslam.filters.information.sparse_filter import (
    Asked,
    allotted,
    asked,
    check_sparse,
    closed,
    in_area,
    sparse_filter,
)
from jaxslam.filters.information.sparse_state import Sparse
from jaxslam.filters.information.sparsification import activated, departed, retired
from jaxslam.math import linalg
from jaxslam.math.xla import where_any
from jaxslam.protocols import Filter, Motion, Sensor
from jaxslam.types import Info, Scan


def eseif(
    motion: Motion,
    sensor: Sensor,
    capacity: int,
    *,
    active: int,
    links: int,
    passive: int = 10,
    sweeps: int = 1,
    conservative: bool = False,
    whole: bool = False,
    gate: float | None = None,
    floor: float = 1e-4,
    turn: float = 0.1,
    wait: bool = True,
) -> Filter:
    """Exactly sparse extended information filter (Walter, Eustice & Leonard 2007, "Exactly sparse
    extended information filters for feature-based SLAM", IJRR 26(4)).

    The map, motion update, new landmarks, mean recovery, options and limits of `seif`; no link is
    set to zero, though. Places of the area are given away where the landmark has no link to the
    robot; before such places run out the robot is relocated. With z_β the scan's measurements of
    landmarks in the area:

        Ω_m ← Ω_mm - Ω_mx Ω_xx⁻¹ Ω_xm, ρ_m ← ρ_m - Ω_mx Ω_xx⁻¹ ρ_x   the pose marginalized out,
        Ω ← Ω + H_βᵀ R⁻¹ H_β, ρ ← ρ + H_βᵀ R⁻¹ ν_β                   and found again from z_β alone.

    The robot then has links to the landmarks of z_β, and exactly none to the others, which may
    leave the area. What is given up is what odometry said between map and z_β: for the same
    linearization Ω ⪯ Ω of the full filter, so the covariance is at least the full filter's. In
    other scans nothing is given up. All of z_β relocates, none of it is spent on the old pose.

    Then follow the measurements of landmarks that came into the area, then new ones. z_β must give
    the whole pose (`fixes_pose`: two landmarks by range and bearing). Where it does not, relocation
    waits, and what finds no place meanwhile is `Status.DEFERRED`, new landmarks before known ones.
    So a reserve is kept, of as many places as a scan has or half of what the area has beyond a
    scan, but no more than there are landmarks beyond the area: with active = capacity it is
    `eif_slam`. Where scans are of one or two landmarks only, so much is deferred that the map fails
    (Victoria Park as GTSAM has it); with wait = False links are cut as by `seif` instead,
    overconfidently, and `Counts` says so.

    `Counts.relocated` says how often, `Counts.cut` how many links to the robot went, and
    `Counts.cut_nats` how much the entropy of the area grew by it, or what `seif` counts. What is
    left of overconfidence is what `seif` has, too: linearization, lists of links that are full,
    covariances of blankets.

    Args:
        motion, sensor, capacity, active, links, passive, sweeps, conservative, whole, gate, floor:
            as `seif`.
        turn: most standard deviation of the heading [rad] that z_β may leave, landmarks given.
        wait: False: where relocation would have to wait, sparsification takes its place.
    Raises:
        ValueError: as `seif`; on a turn not above 0.
    """
    check_sparse(
        "eseif",
        motion,
        sensor,
        capacity,
        gate,
        floor,
        active=active,
        links=links,
        passive=passive,
        sweeps=sweeps,
    )
    if not turn > 0:
        raise ValueError(f"eseif: expected a turn above 0, got {turn}")
    count, share = min(active, capacity), min(passive, capacity)

    def update(state: Sparse, scan: Scan, key: jax.Array) -> tuple[Sparse, Info]:
        state = relaxed(state, share)
        of = asked(state, scan)
        inside = of.match.any(axis=1)
        needs = of.wanted & ~inside
        state, first, sound = _measured(state, scan, of, needs)

        # Places for the others: empty ones first, then those not measured for longest.
        free = state.slot >= capacity
        ties, held = tied(state.omega), of.match.any(axis=0)
        open_ = free | ~(ties | held)
        most = jnp.iinfo(jnp.int32).max
        last = jnp.where(open_, state.seen, jnp.where(held, most, most // 2 + state.seen))
        late = needs & of.known
        order = jnp.where(late, jnp.cumsum(late), late.sum() + jnp.cumsum(needs & ~late)) - 1
        fits = needs & sound
        if wait:
            fits = fits & (order < open_.sum())
        place, taken = allotted(jnp.where(free, -1, last), order, fits, of.match)
        leave = departed if wait else retired
        state = leave(state, taken & ~free, min(scan.tag.shape[0], count), conservative)
        state = activated(state, place, of.slot, fits)

        second = canonical.weigh(
            state.omega, state.pose, in_area(state), scan, place, late & fits, sensor, gate
        )
        omega, owed = canonical.informed(state.omega, owed_of(state), second)
        state, good = solved(state, omega, owed, second.sound)
        sound = sound & good
        state = swept(state, omega, sound, share, sweeps - 1)
        placed = of.wanted & (inside | fits)
        room = placed & of.new & sound
        omega, points, granted = canonical.born(omega, state.pose, scan.z, place, room, sensor)
        state = closed(state, of, place, placed, omega, points, granted, sound, scan.valid.any())

        weighed = _joined(first, canonical.judged(second, good), late & fits)
        # What found no place waits; where the area is lost, all do nothing.
        left = late & ~fits
        weighed = weighed._replace(
            positive=jnp.where(left, sound, weighed.positive), inside=weighed.inside | left
        )
        info = canonical.reported(
            weighed,
            scan,
            of.slot,
            matched=of.known,
            postponed=left,
            new=of.new,
            repeated=of.repeated,
            granted=granted,
            deferred=of.wanted & ~placed & sound,
            singular=of.wanted,
        )
        return state, info

    def _measured(
        state: Sparse, scan: Scan, of: Asked, needs: jax.Array
    ) -> tuple[Sparse, canonical.Weighed, jax.Array]:
        """Measurements of landmarks in the area fused, by an old pose or a relocated one."""
        held = of.match.any(axis=0)
        beta = of.known & of.match.any(axis=1)
        place = jnp.argmax(of.match, axis=1)
        weighed = canonical.weigh(
            state.omega, state.pose, in_area(state), scan, place, beta, sensor, gate
        )
        ties = tied(state.omega)
        room = ((state.slot >= capacity) | ~(ties | held)).sum()
        beyond = count - min(scan.tag.shape[0], count)
        reserve = max(min(scan.tag.shape[0], beyond), beyond // 2)
        reserve = min(reserve, capacity - count)  # no more can ever be asked for
        short = (needs.sum() > room - reserve) & (ties & ~held).any()
        relocate = short & fixes_pose(weighed.rows[:, :3], turn)
        owed = owed_of(state)
        without, owed_without = without_pose(state.omega, owed)
        full, _ = canonical.informed(state.omega, owed, weighed)
        omega = jnp.where(relocate, without, state.omega)
        owed = jnp.where(relocate, owed_without, owed)
        omega, owed = canonical.informed(omega, owed, weighed)
        state, sound = solved(state, omega, owed, weighed.sound)
        done = relocate & sound
        nats = where_any(
            relocate,
            lambda pair: jnp.maximum(0.5 * (_log_det(pair[0]) - _log_det(pair[1])), 0.0),
            lambda pair: jnp.zeros((), pair[0].dtype),
            (full, omega),
        )
        counts = state.counts._replace(
            relocated=state.counts.relocated + done.astype(jnp.int32),
            cut=state.counts.cut + (done & ties & ~tied(omega)).sum(dtype=jnp.int32),
            cut_nats=state.counts.cut_nats + jnp.where(done, nats, 0.0),
        )
        state = state._replace(omega=jnp.where(sound, omega, state.omega), counts=counts)
        return state, canonical.judged(weighed, sound), sound

    return sparse_filter(
        "eseif",
        motion,
        sensor,
        capacity,
        update,
        active=active,
        links=links,
        whole=whole,
        floor=floor,
    )


def without_pose(omega: jax.Array, owed: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Ω (D, D) and ρ (D,) after the robot's pose is marginalized out, its rows then zero."""
    factor = linalg.cholesky(omega[:3, :3])[0]
    half = linalg.solve_lower(factor, omega[:3])
    rest = jnp.arange(len(owed)) >= 3
    less = linalg.symmetrize(omega - half.T @ half)
    moved = owed - half.T @ linalg.solve_lower(factor, owed[:3])
    return jnp.where(rest[:, None] & rest[None, :], less, 0.0), jnp.where(rest, moved, 0.0)


def tied(omega: jax.Array) -> jax.Array:
    """(A,) bool: whether a place of the area has a link to the robot."""
    ties: jax.Array = (omega[:3, 3:] != 0).any(axis=0).reshape(-1, 2).any(axis=1)
    return ties


def fixes_pose(rows: jax.Array, turn: float) -> jax.Array:
    """Whether measurements give the whole pose where landmarks are given, () bool.

    rows (m, 3): their whitened derivatives by the pose, J = rowsᵀ rows. All of J's pivots at unit
    diagonal are above √eps, and the heading's standard deviation, of J⁻¹, is at most turn [rad].
    """
    information = rows.T @ rows
    size = jnp.diagonal(information)
    there = (size > 0).all()
    scale = jnp.where(there, jnp.sqrt(jnp.where(size > 0, size, 1.0)), 1.0)
    unit = jnp.where(there, information / scale[:, None] / scale[None, :], jnp.eye(3))
    factor, positive = linalg.cholesky(unit)
    pivot = jnp.diagonal(factor)
    rank = (pivot**2 > float(jnp.finfo(rows.dtype).eps) ** 0.5).all()
    # The heading comes last: the square of its pivot is its information, the position unknown.
    spread = 1.0 / (jnp.where(rank, pivot[2], 1.0) * scale[2])
    fixed: jax.Array = there & positive & rank & (spread <= turn)
    return fixed


def _log_det(omega: jax.Array) -> jax.Array:
    """log |Ω|, 0 where not positive definite."""
    factor, positive = linalg.cholesky(omega)
    pivots = jnp.where(positive, jnp.diagonal(factor), 1.0)
    return 2 * jnp.log(jnp.where(pivots > 0, pivots, 1.0)).sum()


def _joined(
    first: canonical.Weighed, second: canonical.Weighed, late: jax.Array
) -> canonical.Weighed:
    """What two passes over a scan found: the second of the places late (M,), the first of others;
    the rows are the first's, of both passes none is left to use."""
    names = ("known", "positive", "inside", "fused", "nu", "s", "nis", "log_likelihood")

    def pick(a: jax.Array, b: jax.Array) -> jax.Array:
        return jnp.where(late.reshape(-1, *[1] * (a.ndim - 1)), b, a)

    return first._replace(
        **{name: pick(getattr(first, name), getattr(second, name)) for name in names}
    )
