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


@pytest.mark.sweep
def test_a_map_of_verdicts_shows_where_each_filter_is_honest(full_optimization):
    page = run_page("tutorials/map_of_verdicts")
    maps, runs = page["maps"], 60
    words = {name: np.vectorize(lambda s: s.verdict)(found) for name, found in maps.items()}
    nees = {
        name: np.vectorize(lambda s: s.measures["nees_pose"].value)(found)
        for name, found in maps.items()
    }
    honest = {name: word == "consistent" for name, word in words.items()}
    assert honest["EKF"][:2].all()
    assert honest["invariant EKF"][:2].all()
    assert honest["invariant EKF"].sum() > honest["EKF"].sum()
    assert not honest["EKF"][-2:].any()
    assert (nees["invariant EKF"] < nees["EKF"])[nees["EKF"] > 4].all()
    assert (words["EKF, fading"][:2] == "pessimistic").any()
    assert (words["EKF, fading"][-2:] == "optimistic").all()
    # Other draws, averaged in NumPy, at a world where the EKF is honest and at one where it is not.
    draw = jax.jit(jax.vmap(page["jaxslam"].simulate, (None, 0)))
    go = jax.vmap(page["jaxslam"].run, (None, 0, None, None, None))
    for (i, j), low, high in (((1, 3), 2.4, 3.6), ((4, 1), 6.0, np.inf)):
        world = page["world_of"](page["sigmas"][i], page["reaches"][j])
        truth, log = draw(world, jax.random.split(jax.random.key(5), runs))
        filter = page["makers"]["EKF"](world)
        found = go(filter, log, world.pose, world.pose_cov, page["key"]).estimate
        error = np.asarray(truth.pose) - np.asarray(found.pose)
        error[..., 2] = np.arctan2(np.sin(error[..., 2]), np.cos(error[..., 2]))
        error, cov = error[:, 3:, :, None], np.asarray(found.pose_cov)[:, 3:]
        mean = (error * np.linalg.solve(cov, error)).sum(axis=(2, 3)).mean()
        assert low < mean < high


@pytest.mark.sweep
def test_which_noise_matters_and_where_beacons_help(full_optimization):
    page = run_page("tutorials/sensitivity")
    # All σ times c: the gain is the same, P and S grow by c².
    np.testing.assert_allclose(page["elasticity"].sum(axis=1), -2.0, atol=1e-8)
    program, h = jax.jit(lambda q, *runs: page["averages"](q, *runs)[0]), 1e-4
    for i in (1, 2):
        ends = [program(page["TRUE"] + s * h * np.eye(4)[i], *page["runs"]) for s in (1, -1)]
        np.testing.assert_allclose((ends[0] - ends[1]) / (2 * h), page["slope"][:, i], rtol=1e-4)
    pose, position, heading, nis = np.abs(page["elasticity"])
    assert heading.argmax() == 1
    assert heading[0] < 0.1
    assert nis[2:].sum() > 1.6
    assert pose.min() > 0.2
    assert position[0] > heading[0]

    route, weight = np.asarray(page["route"]), np.diag([0.5**-2, np.deg2rad(3.0) ** -2])
    for name, s in page["layouts"].items():
        layout = np.asarray(page["on_walls"](s))
        on = (layout % [12, 8] < 1e-9) | (np.abs(layout - [12, 8]) < 1e-9)
        assert on.any(axis=1).all()
        variance = []
        for x, y, _ in route:
            dx, dy = (layout - [x, y]).T
            d = np.hypot(dx, dy)
            rows = np.array([[-dx / d, -dy / d, 0 * d], [dy / d**2, -dx / d**2, 0 * d - 1]])
            information = np.einsum("zim,zy,yjm->ij", rows, weight, rows)
            variance.append(np.trace(np.linalg.inv(information)[:2, :2]))
        np.testing.assert_allclose(page["rows"][name][0], np.mean(variance) ** 0.5, rtol=1e-8)
    rmse = {name: row[1].measures["rmse_position"] for name, row in page["rows"].items()}
    nees = {name: row[1].measures["nees_pose"].value for name, row in page["rows"].items()}
    assert rmse["moved from one wall"].high < rmse["every ten metres"].low
    assert rmse["every ten metres"].high < rmse["one wall"].low
    assert rmse["best of 20 starts"].low < rmse["moved from one wall"].high
    assert page["rows"]["best of 20 starts"][0] < page["rows"]["moved from one wall"][0]
    assert all(2.8 < value < 3.3 for value in nees.values())
