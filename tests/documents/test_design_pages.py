"""What the pages on planning, honesty and design claim, against computations of their own."""

import re

import jax
import numpy as np
import pytest
from test_docs import PAGES, executed


def run_page(name):
    """The names that the cells of a page bind."""
    code = re.sub(r"^[%!].*$", "", executed().code_of(PAGES[f"docs/{name}.md"]), flags=re.MULTILINE)
    found = {}
    with jax.numpy_rank_promotion("allow"):
        exec(compile(code, name, "exec"), found)
    return found


def localized(path, controls, posts, q, r):
    """The covariances (T, 3, 3) of an EKF that knows its map, along a path: textbook, in NumPy."""
    cov, out, theta = np.zeros((3, 3)), [], 0.0
    for (x, y, after), (forward, _) in zip(path, controls, strict=True):
        c, s = np.cos(theta), np.sin(theta)
        f = np.array([[1, 0, -forward * s], [0, 1, forward * c], [0, 0, 1]])
        w = np.array([[c, 0], [s, 0], [0, 1]])
        cov = f @ cov @ f.T + w @ q @ w.T
        dx, dy = posts.T - np.array([[x], [y]])
        d = np.hypot(dx, dy)
        rows = [[-dx / d, -dy / d, 0 * d], [dy / d**2, -dx / d**2, 0 * d - 1]]
        h = np.moveaxis(np.array(rows), 2, 0)
        information = np.einsum("mij,ik,mkl->jl", h, np.linalg.inv(r), h)
        cov = cov @ np.linalg.inv(np.eye(3) + information @ cov)
        out.append(cov)
        theta = after
    return np.array(out)


@pytest.mark.sweep
def test_a_planned_path_is_known_better_and_keeps_off_walls(full_optimization):
    page = run_page("tutorials/plan_to_know")
    plans, rows, world = page["plans"], page["rows"], page["world"]
    for name, (_, promised, path) in rows.items():
        controls = np.asarray(plans[name])
        assert (controls >= [0.0, -0.3]).all()
        assert (controls <= [0.4, 0.3]).all()
        assert np.hypot(*(path[-1, :2] - page["goal"])) < 0.1
        q, r = np.diag([0.05, 0.04]) ** 2, np.diag([0.5, np.deg2rad(3.0)]) ** 2
        covs = localized(np.asarray(path), controls, page["posts"], q, r)
        variance = np.trace(covs[:, :2, :2], axis1=1, axis2=2).mean()
        np.testing.assert_allclose(promised, variance**0.5, rtol=1e-8)
        tables = np.asarray(page["room"].circles)
        path = np.asarray(path)
        away = np.hypot(*(path[:, None, :2] - tables[:, :2]).transpose(2, 0, 1)) - tables[:, 2]
        assert away.min() > 0.3
        assert ((path[:, :2] > 0.3) & (path[:, :2] < [11.7, 7.7])).all()
    rmse = {name: row[0].measures["rmse_position"] for name, row in rows.items()}
    nees = {name: row[0].measures["nees_pose"] for name, row in rows.items()}
    assert rmse["planned"].high < rmse["planned, 0.8 m off posts"].low
    assert rmse["planned, 0.8 m off posts"].high < rmse["straight"].low
    assert rmse["straight"].high < rmse["random"].low
    assert nees["straight"].low < 3 < nees["straight"].high
    assert nees["planned"].low > 3
    assert nees["planned"].value > nees["planned, 0.8 m off posts"].value
    assert world.steps == 50
