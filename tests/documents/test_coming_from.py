"""The names that the page for users of filterpy and GTSAM sets side by side."""

import importlib
import re

import broken
import jax
import numpy as np
import pytest
from test_docs import PAGES, executed

import jaxslam

PAGE = "docs/guide/coming_from.md"
ROBOT = jaxslam.filters.Localization(
    jaxslam.motion.Unicycle(np.eye(2)), jaxslam.sensors.RangeBearing(np.eye(2)), np.ones((1, 2))
)
HERE = {
    "jaxslam": jaxslam,
    "filter": ROBOT,
    "motion": ROBOT.motion,
    "sensor": ROBOT.sensor,
    "estimate": jaxslam.types.Estimate,
    "info": jaxslam.types.Info,
    "solution": jaxslam.graphs.Solution,
    "graphs": jaxslam.graphs,
    "smoothing": jaxslam.smoothing,
    "se2": jaxslam.se2,
}
"""what the first word of a name stands for in the text"""
WORDS = {"information": jaxslam.graphs.Table, "fixed_pose": jaxslam.graphs.Graph}
WORDS |= dict.fromkeys(["poses", "points", "pose_id", "point_id"], jaxslam.graphs.Graph)


def rows(heading: str) -> list[list[str]]:
    """The cells of the first table below a heading, without its head."""
    below = PAGES[PAGE].split(f"\n## {heading}\n")[1]
    table = re.search(r"^\|.*?(?=^[^|]|\n\n)", below, re.DOTALL | re.MULTILINE)[0]
    lines = table.strip().splitlines()[2:]
    return [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines]


def reached(root, path: str):
    for name in path.split("."):
        root = getattr(root, name)
    return root


def test_every_name_of_ours_exists():
    """Links into the reference are tested by test_docs."""
    lost, seen = [], 0
    for _, ours, _ in rows("filterpy") + rows("GTSAM"):
        for text in re.findall(r"(?<!\})`([^`]+)`", ours):
            for name in re.findall(r"\b[a-z]\w*(?:\.[a-z_A-Z]\w*)+", text):
                head, _, rest = name.partition(".")
                seen += 1
                try:
                    reached(HERE[head], rest) if head != "np" else reached(np, rest)
                except (AttributeError, KeyError):
                    lost.append(name)
            if re.fullmatch(r"\w+", text) and text in WORDS:
                seen += 1
                if not hasattr(WORDS[text], text):
                    lost.append(text)
    assert lost == []
    assert seen > 20


def test_measures_and_tables_that_it_names_exist():
    assert "nees_pose" in PAGES[PAGE]
    world = jaxslam.scenarios.circle(steps=5)
    filters = {"ekf": jaxslam.catalog.FILTERS["ekf"](world)}
    campaign = jaxslam.monte_carlo(world, filters, runs=2, key=jax.random.key(0))
    assert "nees_pose" in campaign.filters["ekf"].measures
    for name in re.findall(r"table `(\w+)`", PAGES[PAGE]):
        assert name in jaxslam.graphs.REGISTRY, name


def test_every_name_of_filterpy_exists():
    kalman = broken.optional("filterpy.kalman")
    modules = [kalman, *(importlib.import_module(f"filterpy.{n}") for n in THEIRS)]
    holders = {name: getattr(kalman, name)(2, 1) for name in FILTERS}
    found = 0
    for theirs, _, _ in rows("filterpy"):
        for name in re.findall(r"`([\w.]+)`", theirs):
            head, _, rest = name.partition(".")
            if rest and head in holders:
                reached(holders[head], rest)
            elif name not in ("HJacobian", "Hx", "residual", "filterpy.stats"):
                assert any(hasattr(module, name) for module in modules), name
            found += 1
    assert found > 20
    arguments = kalman.ExtendedKalmanFilter.update.__code__.co_varnames
    assert {"HJacobian", "Hx", "residual"} <= set(arguments)


THEIRS = ("stats", "common", "monte_carlo")
FILTERS = ("KalmanFilter", "ExtendedKalmanFilter")


def test_every_name_of_gtsam_exists():
    gtsam = broken.optional("gtsam")
    unstable = broken.optional("gtsam_unstable")
    names = [n for theirs, _, _ in rows("GTSAM") for n in re.findall(r"`([\w.]+)`", theirs)]
    for name in names:
        # Until GTSAM 4.3 some names are in its second module.
        reached(gtsam if hasattr(gtsam, name.split(".")[0]) else unstable, name)
    assert len(names) > 25


@pytest.mark.sweep
def test_its_cells_run():
    """They end where the libraries differ; `make docs` runs them too."""
    broken.optional("filterpy")
    broken.optional("gtsam")
    code = executed().code_of(PAGES[PAGE])
    assert code.count("assert_allclose") > 10
    exec(compile(code, PAGE, "exec"), {"__name__": "cells"})
