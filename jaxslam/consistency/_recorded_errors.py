"""The errors of a recorded estimate: the truth at its times, its claims, and the common frame."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxslam.consistency._correlated import correlation_length, long_run
from jaxslam.consistency._measures.nees import DOF
from jaxslam.consistency.metrics._paths import alignment
from jaxslam.core.logs._streams import geodesic_poses, known_poses
from jaxslam.math._definite import is_asymmetric, is_invertible
from jaxslam.math.numpy_poses import compose, inverse, wrapped

AXES = {"pose": slice(0, 3), "position": slice(0, 2), "heading": slice(2, 3)}
"""The rows of the error of each block of `DOF`."""

LARGEST = 1e4
"""A variance above it [m², rad²] stands for an unknown coordinate: 1e6 and 99999 are usual."""

STEPS, SHORTEST = 10, 1e-7
"""Gauss-Newton steps at most, to the best motion or the lag, and the step [m, rad, s] that ends
them."""

_HALF = 0.1
"""Half of the time over which the velocity of the truth is taken [s], at least: the noise of a
motion capture at 100 Hz, 1 mm, is then 7 mm/s, and a robot's velocity hardly changes."""


class Rows(NamedTuple):
    """The times and poses of an estimate, and the path of the truth with its times."""

    time: Float[np.ndarray, "n"]
    pose: Float[np.ndarray, "n 3"]
    clock: Float[np.ndarray, "m"]
    path: Float[np.ndarray, "m 3"]
    longest_gap: float | None

    def truth(self, shift: float = 0.0) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, "n"]]:
        """The truth at the times of the estimate less a shift [s], and where it is known; elsewhere
        the estimate, so that sums over masked rows stay finite."""
        at = self.time - shift
        path, is_known = known_poses(self.clock, self.path, at, self.longest_gap, geodesic_poses)
        return np.where(is_known[:, None], path, self.pose), is_known

    def velocity(self, shift: float) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, "n"]]:
        """The velocity of the truth at the times less a shift, in its own axes: of the estimate's
        its noise would be a part."""
        half = max(_HALF, float(np.median(np.diff(self.clock))) if len(self.clock) > 1 else _HALF)
        before, in_time = self.truth(shift + half)
        after, still_in_time = self.truth(shift - half)
        moved = np.column_stack([after[:, :2] - before[:, :2], wrapped(after[:, 2] - before[:, 2])])
        return in_axes(self.truth(shift)[0], moved) / (2 * half), in_time & still_in_time


def in_axes(
    pose: Float[np.ndarray, "n 3"], vector: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """Vectors (x, y, θ) of the world in the axes of poses: along, across, heading."""
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    x, y, turn = vector.T
    return np.column_stack([c * x + s * y, c * y - s * x, turn])


def pose_errors(
    pose: Float[np.ndarray, "n 3"], truth: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """Truth minus estimate, along, across and in heading."""
    gap = truth - pose
    return in_axes(pose, np.column_stack([gap[:, :2], wrapped(gap[:, 2])]))


class Claims(NamedTuple):
    """The claimed covariances in the axes of the estimate, and which of them can be judged."""

    cov: Float[np.ndarray, "n 3 3"]
    """unit matrices where not valid"""
    valid: dict[str, Bool[np.ndarray, "n"]]
    """by block of `DOF`"""
    faults: dict[str, Bool[np.ndarray, "n"]]
    """poses by what is wrong with their covariance"""
    turn: Float[np.ndarray, "n 3 3"]
    """matrices that turn (x, y, θ) of the world into the axes of the estimate"""

    @classmethod
    def of(
        cls,
        cov: Float[np.ndarray, "n 3 3"] | None,
        pose: Float[np.ndarray, "n 3"],
        frame: str,
    ) -> "Claims":
        """The claims of covariances, None for none, in the axes of the frame."""
        count = len(pose)
        turn = np.stack([in_axes(pose, np.tile(axis, (count, 1))) for axis in np.eye(3)], axis=2)
        unit = np.tile(np.eye(3), (count, 1, 1))
        if cov is None:
            return cls(unit, {name: np.zeros(count, bool) for name in DOF}, {}, turn)
        is_unknown = cov[:, 0, 0] == -1
        faults_by_block: dict[str, dict[str, np.ndarray]] = {}
        valid = {}
        for name, axes in AXES.items():
            block = cov[:, axes, axes]
            finite = np.isfinite(block).all(axis=(1, 2))
            safe = np.where(finite[:, None, None], block, 0.0)
            variance = np.diagonal(safe, axis1=1, axis2=2)
            tests = {
                "-1 first, unknown": is_unknown,
                "not finite": ~finite,
                "zero": (safe == 0).all(axis=(1, 2)),
                f"above {LARGEST:g}": (variance > LARGEST).any(axis=1),
                "not symmetric": is_asymmetric(safe, 1e-6),  # of float32
                "singular, or not positive definite": ~is_invertible(safe),
            }
            # A pose has one fault: of several the first.
            sound = np.ones(count, bool)
            faults_by_block[name] = {}
            for fault, fails in tests.items():
                faults_by_block[name][fault] = sound & fails
                sound = sound & ~fails
            rest = block[sound]
            is_constant = len(rest) > 1 and bool((rest == rest[:1]).all())
            faults_by_block[name]["constant from beginning to end"] = sound & is_constant
            valid[name] = sound & (not is_constant)
        valid["pose"] &= valid["position"] & valid["heading"]
        faults = {}
        for fault, position in faults_by_block["position"].items():
            heading = faults_by_block["heading"][fault]
            both = position & heading
            faults[f"covariance {fault}"] = both
            faults[f"covariance of the position {fault}"] = position & ~both
            faults[f"variance of the heading {fault}"] = heading & ~both
        apart = valid["position"] & valid["heading"] & ~valid["pose"]
        faults["covariance of position and heading singular together"] = apart
        usable = valid["position"] | valid["heading"]
        safe = np.where(usable[:, None, None], np.nan_to_num(cov), unit)
        safe = (safe + np.swapaxes(safe, 1, 2)) / 2
        if frame == "world":
            safe = turn @ safe @ np.swapaxes(turn, 1, 2)
        # A block without the other: nothing of the other enters.
        safe[~valid["position"], :2] = safe[~valid["position"], :, :2] = 0.0
        safe[~valid["heading"], 2] = safe[~valid["heading"], :, 2] = 0.0
        for name in ("position", "heading"):
            for k in range(3)[AXES[name]]:
                safe[~valid[name], k, k] = 1.0
        return cls(safe, valid, faults, turn)

    def sigma(self) -> Float[np.ndarray, "n 3"]:
        """The claimed standard deviations; NaN without a valid covariance."""
        is_valid = np.zeros((len(self.cov), 3), bool)
        for name in ("position", "heading"):
            is_valid[:, AXES[name]] = self.valid[name][:, None]
        variance = np.diagonal(self.cov, axis1=1, axis2=2)
        return np.where(is_valid, np.sqrt(variance), np.nan)

    def weight(self, part: str | int, valid: Bool[np.ndarray, "n"]) -> Float[np.ndarray, "n 3 3"]:
        """M of eᵀ M e, the square of a block of the error, or of component k; 0 if not valid."""
        axes = AXES[part] if isinstance(part, str) else slice(part, part + 1)
        weight = np.zeros_like(self.cov)
        weight[:, axes, axes] = np.linalg.inv(self.cov[:, axes, axes])
        return np.where(valid[:, None, None], weight, 0.0)


class Alignment(NamedTuple):
    """The truth in the frame of the estimate, and what carrying it there does to honest NEES."""

    truth: Float[np.ndarray, "n 3"]
    notes: tuple[str, ...]
    claims: Claims
    lever: Float[np.ndarray, "n 3 3"]
    """J: change of each error by a small motion of the truth"""
    start_cov: Float[np.ndarray, "3 3"]
    """covariance of that motion by the first error; zeros unless aligned there"""
    weight: Float[np.ndarray, "n 3 3"]
    """P⁻¹ of the poses that have determined the best motion, else zeros"""
    error: Float[np.ndarray, "n 3"]

    @classmethod
    def of(
        cls,
        align: str,
        claims: Claims,
        pose: Float[np.ndarray, "n 3"],
        truth: Float[np.ndarray, "n 3"],
        is_known: Bool[np.ndarray, "n"],
    ) -> "Alignment":
        """The truth carried as `align` says, by the poses at which it is known."""
        turn = claims.turn
        frame, centre = np.zeros(3), np.zeros(3)
        notes: tuple[str, ...] = ()
        start_cov, weight = np.zeros((3, 3)), np.zeros_like(turn)
        start = int(np.argmax(is_known))
        if align == "first":
            frame, centre = compose(pose[start], inverse(truth[start])), pose[start]
            notes = ("aligned at the first pose: its error is in all of the others",)
            if claims.valid["pose"][start]:
                start_cov = turn[start].T @ claims.cov[start] @ turn[start]
            elif claims.valid["pose"].any() and not claims.faults["covariance zero"][start]:
                notes += ("the first pose has no valid covariance: honest values leave it out",)
        elif align == "best":
            usable = is_known & claims.valid["pose"]
            if usable.any():
                weight = claims.weight("pose", usable)
                fit = weight
            else:
                usable = is_known
                fit = np.where(usable[:, None, None], np.eye(3), 0.0)
            frame = compose(pose[start], inverse(truth[start]))
            if np.ptp(truth[usable, :2], axis=0).any():  # else positions show no turn
                frame = alignment(truth[usable, :2], pose[usable, :2])
            for _ in range(STEPS):
                carried = compose(frame, truth)
                centre = carried[usable].mean(axis=0)
                lever = lever_of(turn, carried, centre)
                curvature, gradient = normal_equations(lever, fit, pose_errors(pose, carried))
                x, y, angle = -np.linalg.solve(curvature, gradient.sum(axis=0))
                moved = np.array([centre[0] + x, centre[1] + y, angle])
                about = np.array([-centre[0], -centre[1], 0.0])
                frame = compose(moved, compose(about, frame))
                if max(abs(x), abs(y), abs(angle)) < SHORTEST:
                    break
            notes = (
                "aligned by the best rigid motion, which takes 3 degrees of freedom: an error that "
                "all poses have in common cannot be seen",
            )
        carried = compose(frame, truth)
        lever = lever_of(turn, carried, centre)
        return cls(carried, notes, claims, lever, start_cov, weight, pose_errors(pose, carried))

    def honest(self, part: str | int, valid: Bool[np.ndarray, "n"]) -> tuple[float, float]:
        """The range of an honest mean of eᵀ M e, of a block or a component k; see
        `judge_recording`."""
        dof = float(DOF[part]) if isinstance(part, str) else 1.0
        if self.start_cov.any():
            weight = self.claims.weight(part, valid)
            carried = self.lever @ self.start_cov @ np.swapaxes(self.lever, 1, 2)
            added = float(np.einsum("nij,nji->", weight, carried)) / max(valid.sum(), 1)
            return max(dof - added, 0.0), dof + added
        if not self.weight.any():
            return dof, dof
        # The errors before the motion are e + J a, a = A⁻¹ Σ Jᵀ W e. Their sum of squares has the
        # expectation E Σ eᵀ M e + 2 E uᵀ a - E aᵀ B a, with u = Σ Jᵀ M (e + J a), B = Σ Jᵀ M J.
        weight = self.claims.weight(part, valid)
        curvature, s = normal_equations(self.lever, self.weight, self.error)
        block_curvature, u = normal_equations(self.lever, weight, self.error)
        used = self.weight.any(axis=(1, 2))
        error = np.einsum("nji,nj->ni", self.claims.turn, self.error)  # in the axes of the world
        error = np.where(used[:, None], error, 0.0)
        size = np.sqrt((error**2).mean(axis=0))
        length = correlation_length(error / np.where(size > 0, size, 1.0))
        # What is left has no mean, which takes a share 2K/n of its long-run covariance.
        remains = max(1 - (2 * length - 1) / used.sum(), 0.5)
        root = np.linalg.inv(curvature)
        shared = root @ long_run(s, s, length) @ root
        removed = 2 * np.trace(long_run(u, s, length) @ root) - np.trace(block_curvature @ shared)
        removed /= remains
        left = float(np.einsum("ni,nij,nj->", self.error, weight, self.error))
        share = float(np.clip(removed / (left + removed), 0.0, 1.0)) if removed > 0 else 0.0
        # What it takes is random, as it is of a few errors: from nothing to twice its expectation.
        return dof * max(1 - 2 * share, 0.0), dof


def lever_of(
    turn: Float[np.ndarray, "n 3 3"],
    truth: Float[np.ndarray, "n 3"],
    centre: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "n 3 3"]:
    """J: the change of each error by a motion (x, y, θ) of the truth about a centre."""
    motion = np.tile(np.eye(3), (len(truth), 1, 1))
    motion[:, 0, 2], motion[:, 1, 2] = -(truth[:, 1] - centre[1]), truth[:, 0] - centre[0]
    return turn @ motion


def normal_equations(
    lever: Float[np.ndarray, "n 3 3"],
    weight: Float[np.ndarray, "n 3 3"],
    error: Float[np.ndarray, "n 3"],
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "n 3"]]:
    """Σ Jᵀ W J, and Jᵀ W e of each pose."""
    weighted = np.swapaxes(lever, 1, 2) @ weight
    return (weighted @ lever).sum(axis=0), np.einsum("nij,nj->ni", weighted, error)
