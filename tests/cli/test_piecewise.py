"""A log in pieces of one program, and the looks between them; by a toy filter."""

import itertools

import jax.numpy as jnp
import numpy as np
from worlds import unmatched

from jaxslam import charts
from jaxslam._cli.campaigns import piecewise
from jaxslam.core.protocols import Filter
from jaxslam.core.record import record
from jaxslam.core.types import Estimate, Log, Scan

STEPS = 11


def toy(traced):
    """A filter whose pose is the sum of its controls."""

    @record
    class Toy(Filter):
        controls = ("x", "y", "theta")
        measurements = ("x", "y")
        chart = charts.Euclidean()

        def init(self, pose, pose_cov):
            return pose

        def predict(self, pose, u, key):
            traced.append(1)
            return pose + u

        def update(self, pose, scan, key):
            return pose, unmatched(scan)._replace(log_likelihood=pose[0])

        def estimate(self, pose):
            return Estimate(
                pose=pose,
                pose_cov=jnp.outer(pose, pose),
                points=jnp.zeros((1, 2)),
                point_covs=jnp.zeros((1, 2, 2)),
                alive=jnp.zeros(1, bool),
                tag=jnp.full(1, -1),
            )

    return Toy()


def log_of(steps=STEPS):
    control = np.arange(3.0 * steps).reshape(steps, 3)
    valid = np.arange(2 * steps).reshape(steps, 2) % 3 == 0
    scan = Scan(np.zeros((steps, 2, 2)), np.full((steps, 2), -1), valid)
    return Log(control, scan)


def test_a_log_in_pieces_is_the_whole_log(monkeypatch):
    monkeypatch.setattr(piecewise, "MAX_STEPS", 4)
    monkeypatch.setattr(piecewise, "PIECES", 2)
    looked = [4, 8, 11]
    traced, shown, seen = [], [], []
    done = piecewise.run_in_pieces(
        toy(traced),
        log_of(),
        np.ones(3),
        np.zeros((3, 3)),
        check=lambda pose: seen.append(np.asarray(pose)) or float(pose[0]) > 20,
        progress=lambda done, total: shown.append((done, total)),
    )
    wanted = 1 + np.cumsum(log_of().control, axis=0)
    np.testing.assert_array_equal(done.path.pose, wanted)
    np.testing.assert_array_equal(done.path.pose_cov[:, 0, 1], wanted[:, 0] * wanted[:, 1])
    np.testing.assert_array_equal(done.log_likelihood, wanted[:, 0])
    np.testing.assert_array_equal(done.status, np.where(log_of().scan.valid, 8, 0))
    np.testing.assert_array_equal(done.last.pose, wanted[-1])
    assert done.checked == looked
    assert done.passed == [bool(wanted[step - 1, 0] > 20) for step in looked]
    for step, pose in zip(looked, seen, strict=True):
        np.testing.assert_array_equal(pose, wanted[step - 1])
    assert shown[-1] == (STEPS, STEPS) and all(
        a < b for (a, _), (b, _) in itertools.pairwise(shown)
    )
    assert len(traced) <= 2  # its shapes and its program, however many pieces there are


def test_what_a_film_shows_is_kept_of_the_steps_to_watch_alone(monkeypatch):
    monkeypatch.setattr(piecewise, "PIECES", 3)
    at = np.array([0, 3, 4, 4, 10])
    start = np.ones(3), np.zeros((3, 3))
    done = piecewise.run_in_pieces(
        toy([]),
        log_of(),
        *start,
        progress=lambda done, total: None,
        at=at,
        watch=lambda pose: {"twice": 2 * pose},
    )
    np.testing.assert_array_equal(done.estimates.pose, done.path.pose[at])
    np.testing.assert_array_equal(done.watched["twice"], 2 * done.path.pose[at])
    assert done.estimates.points.shape == (5, 1, 2) and done.slot.shape == (STEPS, 2)
