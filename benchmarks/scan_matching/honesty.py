"""NEES of every matcher with every covariance, in four exact worlds."""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import PyTree

from benchmarks.scan_matching.pairs import START, Known, drawn, known
from jaxslam import matching
from jaxslam.consistency import pose_error
from jaxslam.core.record import record
from jaxslam.graphs import Cauchy
from jaxslam.laser.matching import MatchStatus
from jaxslam.laser.matching import covariance as ways
from jaxslam.math.stats import chi2_band, chi2_quantile

WORLDS = ("square", "corridor", "circular_room", "office")
SIGMA, CELL = 0.03, 0.05
SAMPLES = 30
RECOMMENDED = "point_to_line, Cauchy", "implicit"
"""What the documentation recommends: PL-ICP with the noise through (Censi 2007)."""
MATCHERS = {
    "point_to_point": matching.PointToPoint(),
    "point_to_line": matching.PointToLine(),
    "point_to_line, Cauchy": matching.PointToLine(
        matching.IcpSettings(kernel=Cauchy(), scale=0.05)
    ),
    "field": matching.FieldMatcher(),
    "correlative": matching.Correlative(
        cell=CELL, window=0.15, turn_window=0.1, turn=0.01, sigma=0.05, block=4, ambiguous=None
    ),
}
START_COV = np.diag(START**2)
COVARIANCES = {
    "hessian": ways.Hessian(),
    "implicit": ways.Implicit(SIGMA),
    "along_normals": ways.AlongNormals(SIGMA),
    "lattice": ways.Lattice(SIGMA),
    "unscented": ways.Unscented(SIGMA, START_COV),
    "sampling": ways.Sampling(SIGMA, START_COV, SAMPLES),
}


def left_out(matcher: str, way: str) -> bool:
    """along_normals takes pairs of points; sampling the search costs 50 searches a run."""
    return (matcher, way) == ("correlative", "sampling") or (
        way == "along_normals" and MATCHERS[matcher].of_grid
    )


@record
class Prepared(matching.Matcher):
    """A matcher with what it needs of one reference."""

    matcher: matching.Matcher
    prepared: PyTree

    def prepare(self, reference):
        return self.prepared

    def match(self, prepared, points, start, prior=None):
        return self.matcher.match(prepared, points, start, prior)

    def cost(self, prepared, points, pose, match):
        return self.matcher.cost(prepared, points, pose, match)


class Row(NamedTuple):
    """A matcher with a covariance in a world."""

    world: str
    matcher: str
    way: str
    nees: float
    """mean over the runs, over its degrees of freedom: of what the scans determine"""
    low: float
    high: float
    """the 95 % band of an honest one"""
    covered: float
    """share of the runs in the 95 % ellipsoid"""
    free: float
    """mean squared error over variance along what the scans do not determine; NaN where they do"""


class Error(NamedTuple):
    """A matcher in a world."""

    world: str
    matcher: str
    deviation: np.ndarray
    """root mean square error (x [m], y [m], θ [rad])"""
    over_bound: float
    """mean squared error over the Cramér-Rao bound, by its degrees of freedom"""
    statuses: dict[str, int]


def programs(names):
    """By matcher: (reference, scan, start, key) of many runs -> Match, covariances by name."""

    def of(name, matcher):
        wanted = {way: c for way, c in COVARIANCES.items() if not left_out(name, way)}

        def one(row):
            points, scan, start, key = row
            reference, own = points, matcher
            if matcher.of_grid:
                reference = matching.raster(points, CELL, 6.0)
                once = matcher.prepare(reference)  # for all the covariances
                own = Prepared(matcher, once)
            found = own.match(own.prepare(reference), scan, start)
            scans = ways.MatchedScans(reference, scan, found, start, key)
            return found, {way: c.of(own, scans) for way, c in wanted.items()}

        return jax.jit(lambda rows: jax.lax.map(one, rows))

    return {name: of(name, MATCHERS[name]) for name in names}


def judged(compiled, names: tuple[str, ...], runs: int, seed: int) -> tuple[list[Row], list[Error]]:
    """These matchers on the draws of a seed, in every world."""
    rows, errors = [], []
    for world in WORLDS:
        pairs = drawn(world, runs, sigma=SIGMA, seed=seed)
        told = known(pairs)
        keys = jax.random.split(jax.random.key(seed + 9), runs)
        for name in names:
            given = pairs.reference, pairs.scan, pairs.start, keys
            found, covs = jax.device_get(compiled[name](given))
            error, usable = error_of(found, np.asarray(pairs.truth))
            errors.append(summary(world, name, found, error, usable, told))
            rows += [
                scored(world, name, way, error[usable], cov[usable], told, usable)
                for way, cov in covs.items()
            ]
    return rows, errors


def error_of(found: matching.Match, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Error of the pose, and which of the runs have a usable one."""
    return pose_error(found.pose, truth), found.status <= MatchStatus.DEGENERATE


def scored(world, matcher, way, error, cov, told: Known, usable) -> Row:
    seen, free = told.seen[usable], told.free[usable]
    dof = seen.shape[2]
    nees = squares(error, cov, seen)
    low, high = (b / dof for b in chi2_band(dof, len(error)))
    along = np.nan
    if free.shape[2]:
        unit = free / (free**2).sum(axis=1, keepdims=True)
        along = float(squares(error, cov, unit).mean())
    return Row(
        world, matcher, way, float(nees.mean()) / dof, low, high,
        float((nees < chi2_quantile(0.95, dof)).mean()), along,
    )  # fmt: skip


def summary(world, matcher, found, error, usable, told: Known) -> Error:
    names = {
        status.name.lower(): int((found.status == status).sum())
        for status in MatchStatus
        if (found.status == status).any()
    }
    over = squares(error[usable], told.bound[usable], told.seen[usable]).mean()
    deviation = np.sqrt((error[usable] ** 2).mean(axis=0))
    return Error(world, matcher, deviation, over / told.seen.shape[2], names)


def squares(error, cov, functionals) -> np.ndarray:
    """(Bᵀe)ᵀ (Bᵀ P B)⁻¹ Bᵀe of each run."""
    e = np.einsum("rid,ri->rd", functionals, error)
    p = np.einsum("rid,rij,rje->rde", functionals, cov, functionals)
    p = p + 1e-16 * np.eye(p.shape[-1])  # a lattice may see a single pose
    return np.einsum("rd,rd->r", e, np.linalg.solve(p, e[..., None])[..., 0])
