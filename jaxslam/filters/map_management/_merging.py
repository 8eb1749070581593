"""Duplicate landmarks, detected by a joint chi-square test and merged by an exact constraint.

`Managed` is the base of all map managers: the check of the filter's state, and the step after each
update.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxslam.core import slots
from jaxslam.core._record import field, record, static
from jaxslam.core._validation import state_and_info
from jaxslam.core.protocols import Chart, Filter, Wrapper
from jaxslam.core.slots import Joint
from jaxslam.core.types import Info, Scan, Status
from jaxslam.core.validation import InvalidField, in_range, positive, refusals_of, require
from jaxslam.filters._ekf.linear_system import LinearizedSteps, LinearSystem
from jaxslam.filters._ekf.map_coordinates import retract_map
from jaxslam.filters._reporting import with_extra
from jaxslam.math import _linalg as linalg
from jaxslam.math._arrays import Number
from jaxslam.math._gaussians import gaussian_terms
from jaxslam.math._xla import change_where
from jaxslam.math.stats import chi2_quantile


class Managed(Wrapper):
    """A filter on a `slots.Joint`, each of whose updates is followed by `manage`.

    It returns its linear system (`Monitored`) if the filter does, without the change by `manage`. A
    subclass defines `manage`, and may extend `init`.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check(Managed, {"manage": "joint, scan, info"})

    def manage(self, joint: Joint, scan: Scan, info: Info) -> tuple[Joint, Info]:
        """The map and the info after a scan."""
        raise NotImplementedError

    def init(self, pose: Float[Array, "3"], pose_cov: Float[Array, "3 3"]) -> Joint:
        joint = self.filter.init(pose, pose_cov)
        if not isinstance(joint, Joint):
            raise InvalidField(
                "filter",
                f"expected one whose state is a slots.Joint, as of EkfSlam, got {self.filter.name}",
                owner=type(self).__name__,
            )
        return joint

    def update(self, state: Joint, scan: Scan, key: Array) -> tuple[Joint, Info]:
        return self._manage(state, scan, self.filter.update(state, scan, key))

    @property
    def linearized(self) -> LinearizedSteps | None:
        steps = self.filter.linearized
        if steps is None:
            return None

        def update(joint: Joint, scan: Scan, key: Array) -> tuple[Joint, Info, LinearSystem]:
            after, info, system = steps.update(joint, scan, key)
            return *self._manage(joint, scan, (after, info)), system

        return LinearizedSteps(steps.predict, update)

    def _manage(self, joint: Joint, scan: Scan, result: PyTree) -> tuple[Joint, Info]:
        with refusals_of(f"{type(self).__name__}: {self.filter.name}"):
            joint, info = state_and_info(joint, scan, result)
        return self.manage(joint, scan, info)


class Merged(NamedTuple):
    """The pair of landmarks merged; `info.extra["merging"]`."""

    pair: Int[Array, "2"]
    """the slot of the landmark kept and the slot freed, or -1, -1 where none were merged"""

    def counts(self) -> dict[str, Array]:
        """The counts of a campaign."""
        return {"merged": self.pair[..., 0] >= 0}


@record
class Merging(Managed):
    """The filter, which after each scan merges the pair of landmarks most likely to be duplicates.

    Two landmarks may be duplicates if they are within reach, the joint test of their difference
    passes (`closest_pair`), and no scan of one sensor measured both: a landmark gives a sensor one
    measurement a scan. The pairs that were measured together are `Joint.co_observed`;
    `info.extra["merging"]` is a `Merged`.

    Raises ValueError on no filter, a reach not above 0, a probability outside 0 to 1, landmarks
    whose parameters are not unique (an inverse depth) or no place (a line); from `init`, on another
    state.
    """

    filter: Filter
    """a filter whose state is a `slots.Joint`"""
    reach: Number = field(check=positive)
    """[m] less than the distance of any two true landmarks. The test alone cannot separate two
    landmarks whose difference is less certain than their distance"""
    probability: float = static(default=0.95, check=in_range(0.0, 1.0, open=True))
    """probability that two estimates of one landmark pass the test"""

    def __post_init__(self) -> None:
        super().__post_init__()
        names = self.filter.landmark
        unique = len(names) > 1 and all(name.endswith("[m]") for name in names[:2])
        if not unique or "rho [1/m]" in names:
            raise InvalidField(
                "filter",
                f"landmarks of {self.filter.name} with parameters {names} cannot be "
                "merged: equal parameters do not mean equal positions",
            )

    def init(self, pose: Float[Array, "3"], pose_cov: Float[Array, "3 3"]) -> Joint:
        joint = super().init(pose, pose_cov)
        capacity = joint.alive.shape[0]
        return joint._replace(co_observed=jnp.zeros((capacity, capacity), bool))

    def manage(self, joint: Joint, scan: Scan, info: Info) -> tuple[Joint, Info]:
        chart, square_root = self.chart, self.square_root
        together = co_observed(joint, info, self.places)
        joint = joint._replace(co_observed=together)
        kept, freed, distance = closest_pair(
            joint, chart, self.reach, ~together, square_root=square_root
        )
        same = distance <= chi2_quantile(self.probability, len(self.landmark))
        joint = change_where(
            same,
            lambda joint: merge_landmarks(joint, chart, kept, freed, square_root=square_root),
            joint,
        )
        pair = jnp.where(same, jnp.stack([kept, freed]), -1).astype(jnp.int32)
        return joint, with_extra(info, "merging", Merged(pair))


def co_observed(joint: Joint, info: Info, places: tuple[int, ...] = ()) -> Bool[Array, "N N"]:
    """Mask of the pairs of landmarks that one sensor measured in one scan, up to this one.

    places: number of measurement slots of each sensor; () of a single sensor.
    """
    capacity = joint.alive.shape[0]
    before = joint.co_observed
    pairs = jnp.zeros((capacity, capacity), bool) if before is None else before
    measured = (info.status == Status.FUSED) | (info.status == Status.BORN)
    end = 0
    for count in places or info.status.shape:
        begin, end = end, end + count
        mask = slots.slot_mask(info.slot[begin:end], measured[begin:end], capacity)
        pairs = pairs | (mask[:, None] & mask[None, :])
    return pairs


def closest_pair(
    joint: Joint,
    chart: Chart,
    reach: Number,
    allowed: Array | None = None,
    *,
    square_root: bool = False,
) -> tuple[Int[Array, ""], Int[Array, ""], Float[Array, ""]]:
    """Slots i < j of the pair most likely to be duplicates, and their squared distance.

    d² = δᵀ C⁻¹ δ with δ = l_i - l_j and C = cov(δ), including the correlation of the two: for
    landmarks with large covariances but a certain difference d² is large. i = j = 0 and d² infinite
    where no pair (i, j) is allowed (N, N) and within reach [m]. square_root: as in
    `merge_landmarks`.

    Raises ValueError on a reach not above 0, or allowed of another shape.
    """
    capacity, size = joint.landmarks.shape
    with refusals_of("closest_pair"):
        require("reach", reach, positive)
        if allowed is not None and jnp.shape(allowed) != (capacity, capacity):
            raise InvalidField(
                "allowed", f"expected shape {(capacity, capacity)}, got {jnp.shape(allowed)}"
            )
    delta = joint.landmarks[:, None] - joint.landmarks[None, :]
    by_robot, by_landmark = _derivatives(joint, chart)
    p = joint.cov @ joint.cov.T if square_root else joint.cov
    robot = p[:3, :3]
    cross = p[:3, 3:].reshape(3, capacity, size)
    blocks = p[3:, 3:].reshape(capacity, size, capacity, size)
    # Errors of coordinates are A_i dx + B_i dl_i, so cov(l_i, l_j) has four terms; axes are
    # (landmark i, landmark j, parameter of i, parameter of j).
    with_robot = jnp.einsum("nij,jmk,mlk->nmil", by_robot, cross, by_landmark)
    of_landmarks = jnp.einsum("nij,njmk,mlk->nmil", by_landmark, blocks, by_landmark)
    # The term of landmark i and the pose of j is that of the pose of i and landmark j, mirrored.
    cov = of_landmarks + with_robot + with_robot.transpose(1, 0, 3, 2)
    cov = cov + jnp.einsum("nij,jk,mlk->nmil", by_robot, robot, by_robot)
    diagonal = cov[jnp.arange(capacity), jnp.arange(capacity)]
    # C_ii + C_jj - C_ij - C_ji, of all pairs: O(N²), as P itself.
    delta_covs = diagonal[:, None] + diagonal[None, :] - cov - cov.transpose(1, 0, 2, 3)
    pairs = joint.alive[:, None] & joint.alive[None, :]
    pairs = pairs & (jnp.arange(capacity)[:, None] < jnp.arange(capacity)[None, :])
    pairs = pairs & ((delta**2).sum(axis=2) <= reach**2)
    if allowed is not None:
        pairs = pairs & allowed
    d2 = jnp.where(pairs, jax.vmap(jax.vmap(squared_distance))(delta, delta_covs), jnp.inf)
    best = jnp.argmin(d2)
    i, j = jnp.unravel_index(best, d2.shape)
    return i, j, d2.reshape(-1)[best]


def squared_distance(error: Float[Array, "n"], cov: Float[Array, "n n"]) -> Float[Array, ""]:
    """The squared distance errorᵀ cov⁻¹ error; infinite where cov is not positive definite."""
    terms = gaussian_terms(error, cov)
    return jnp.where(terms.positive, terms.distance, jnp.inf)


def merge_landmarks(
    joint: Joint, chart: Chart, i: Array, j: Array, *, square_root: bool = False
) -> Joint:
    """The map conditioned on equal landmarks in slots i and j; slot i is kept.

    The constraint l_i = l_j is a measurement of δ = l_i - l_j = 0 without noise: with
    S = cov(δ) = L Lᵀ and V = L⁻¹ cov(δ, ·), x ← x ⊞ -Vᵀ L⁻¹ δ and P ← P - Vᵀ V, for points exact.
    Slot j, now the same, is removed. Nothing happens where i = j or S is singular. square_root: the
    state holds a root of P, as in a filter with covariance="square_root".
    """
    size = joint.landmarks.shape[1]
    by_robot, by_landmark = (part[jnp.stack([i, j])] for part in _derivatives(joint, chart))
    rows = joint.cov @ joint.cov.T if square_root else joint.cov
    rows_of = [jax.lax.dynamic_slice_in_dim(rows, 3 + slot * size, size) for slot in (i, j)]
    # cov(δ, ·), δ = l_i - l_j, of which each coordinate depends on pose and landmark.
    with_all = (by_robot[0] - by_robot[1]) @ rows[:3]
    with_all = with_all + by_landmark[0] @ rows_of[0] - by_landmark[1] @ rows_of[1]
    columns_of = [
        jax.lax.dynamic_slice_in_dim(with_all, 3 + slot * size, size, axis=1) for slot in (i, j)
    ]
    s = with_all[:, :3] @ (by_robot[0] - by_robot[1]).T
    s = s + columns_of[0] @ by_landmark[0].T - columns_of[1] @ by_landmark[1].T
    factor, positive = linalg.cholesky(linalg.symmetrize(s))
    ok = positive & (i != j)
    # A factor of zero gives V = 0, which changes nothing.
    factor = jnp.where(ok, factor, 0.0)
    v = linalg.solve_lower(factor, with_all)
    # L⁻¹ (0 - δ): what is measured is δ = 0.
    white = linalg.solve_lower(factor, joint.landmarks[j] - joint.landmarks[i])
    xi = linalg.gram(v, white[:, None])[:, 0]
    moved = retract_map(chart, joint, xi)
    cov = rows - linalg.gram(v, v)
    if square_root:
        cov = linalg.root_psd(cov)
    together = joint.co_observed
    if together is not None:  # the landmark kept takes over the co-observations of both
        row = together[i] | (ok & (together[i] | together[j]))
        together = together.at[i].set(row).at[:, i].set(row)
    merged = moved._replace(
        cov=jnp.where(ok, cov, joint.cov),
        co_observed=together,
    )
    return slots.remove(
        merged, ok & (jnp.arange(joint.alive.shape[0]) == j), square_root=square_root
    )


def _derivatives(joint: Joint, chart: Chart) -> tuple[Float[Array, "N L 3"], Float[Array, "N L L"]]:
    """The derivatives of each landmark's coordinates by errors of the pose and of the landmark."""
    capacity, size = joint.landmarks.shape
    still = jnp.broadcast_to(jnp.eye(size, dtype=joint.cov.dtype), (capacity, size, size))
    if chart.basis is None:
        return jnp.zeros((capacity, size, 3), joint.cov.dtype), still
    basis = jax.vmap(chart.basis, in_axes=(None, 0))(joint.pose, joint.landmarks)
    return basis.cross, still if basis.landmark is None else basis.landmark
