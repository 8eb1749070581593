"""The distance field against SciPy's exact one; interpolation, resampling, cropping, correlation."""

import jax
import numpy as np
import pytest
from cases import refused
from scipy import ndimage

from jaxslam import grids, se2
from jaxslam.laser.grids._distance import near_distances, squared_distances


def grid_of(log_odds, origin=(0.0, 0.0, 0.0), resolution=0.1):
    return grids.Grid(
        np.asarray(log_odds, float), np.asarray(origin, float), np.float64(resolution)
    )


def occupied(kind, rng, shape=(40, 57)):
    cells = np.zeros(shape, bool)
    if kind == "sparse":
        cells[3, 50] = cells[33, 4] = True
    elif kind == "row":
        cells[7] = True
    elif kind == "column":
        cells[:, 11] = True
    else:
        cells = rng.random(shape) < {"dense": 0.3, "thin": 0.01}[kind]
    return cells


@pytest.mark.parametrize("kind", ["sparse", "row", "column", "dense", "thin"])
def test_distances_are_those_of_scipy(kind):
    cells = occupied(kind, np.random.default_rng(1))
    field = grids.distance_field(grid_of(np.where(cells, 2.0, -1.0)))
    exact = 0.1 * ndimage.distance_transform_edt(~cells)
    np.testing.assert_allclose(field.values, exact, rtol=0, atol=1e-9)
    cut = grids.distance_field(grid_of(np.where(cells, 2.0, -1.0)), truncate=0.35)
    np.testing.assert_allclose(cut.values, np.minimum(exact, 0.35), rtol=0, atol=1e-9)


def test_a_map_without_obstacles_has_a_finite_distance_and_float32_is_close():
    field = grids.distance_field(grid_of(np.zeros((3, 4))))
    np.testing.assert_allclose(field.values, 0.5)
    cells = occupied("thin", np.random.default_rng(2))
    single = jax.tree.map(np.float32, grid_of(np.where(cells, 2.0, -1.0)))
    exact = 0.1 * ndimage.distance_transform_edt(~cells)
    np.testing.assert_allclose(grids.distance_field(single).values, exact, rtol=1e-5, atol=1e-5)


def test_squared_distances_are_integers_exact_on_maps_too_long_for_float32(float32_alone):
    cells = np.random.default_rng(0).random((3, 9000)) < 0.0004
    exact = ndimage.distance_transform_edt(~cells) ** 2
    np.testing.assert_array_equal(squared_distances(cells), np.round(exact))


def test_the_gradient_of_a_wall_points_away_from_it():
    field = grids.distance_field(grid_of(np.pad([[3.0]] * 9, [(0, 0), (4, 4)]), (1, 2, 0.5)))
    slope = np.asarray(grids.gradient(field))[:, [1, 7]]
    e = np.array([np.cos(0.5), np.sin(0.5)])
    np.testing.assert_allclose(slope[:, 1], np.tile(e, (9, 1)), atol=1e-12)
    np.testing.assert_allclose(slope[:, 0], np.tile(-e, (9, 1)), atol=1e-12)


def reference_bilinear(values, x, y):
    """At column x and row y, counted from the first centre; clamped."""
    height, width = values.shape
    x, y = min(max(x, 0), width - 1), min(max(y, 0), height - 1)
    j, i = min(int(x), width - 2), min(int(y), height - 2)
    u, v = x - j, y - i
    return (
        values[i, j] * (1 - u) * (1 - v)
        + values[i, j + 1] * u * (1 - v)
        + values[i + 1, j] * (1 - u) * v
        + values[i + 1, j + 1] * u * v
    )


def test_interpolation_is_bilinear_and_its_gradient_finite_everywhere(differences):
    rng = np.random.default_rng(3)
    values, origin, resolution = rng.normal(size=(5, 7)), np.array([1.0, -2.0, 0.7]), 0.2
    local = np.concatenate([rng.uniform(-2, 9, (60, 2)), [[0.5, 0.5], [3.5, 2.5], [7, 5], [0, 0]]])
    points = np.stack([se2.from_frame(origin, resolution * p) for p in local])
    field = grids.Field(values, origin, np.float64(resolution))
    one = jax.jit(jax.vmap(lambda p: jax.value_and_grad(grids.interpolate, argnums=1)(field, p)))
    found, slopes = one(points)
    np.testing.assert_allclose(
        found, [reference_bilinear(values, x - 0.5, y - 0.5) for x, y in local], atol=1e-9
    )
    assert np.all(np.isfinite(slopes))
    by_differences = differences(lambda p: one(p)[0], (points[:60],), 0, 1e-6)
    np.testing.assert_allclose(slopes[:60], by_differences, atol=1e-6)


def test_resampling_keeps_the_integral_and_the_unknown():
    rng = np.random.default_rng(4)
    log_odds = rng.normal(size=(8, 12))
    log_odds[:4, :6] = 0.0
    grid = grid_of(log_odds, (1, 2, 0.3), 0.1)
    halved = grids.resample(grid, 0.2)
    blocks = log_odds.reshape(4, 2, 6, 2).mean(axis=(1, 3))
    np.testing.assert_allclose(halved.log_odds, blocks, atol=1e-12)
    assert not np.any(np.asarray(halved.observed)[:2, :3])
    assert grids.resample(jax.tree.map(np.float32, grid), 0.2).log_odds.dtype == np.float32
    odd = grids.resample(grid, 0.13)
    assert odd.log_odds.shape == (7, 10)
    np.testing.assert_allclose(odd.log_odds.sum() * 0.13**2, log_odds.sum() * 0.1**2)
    doubled = grids.resample(grid, 0.05)
    np.testing.assert_allclose(doubled.log_odds, np.kron(log_odds, np.ones((2, 2))), atol=1e-12)


def test_a_crop_has_the_same_cells_at_the_same_places():
    grid = grid_of(np.arange(48.0).reshape(6, 8), (1, 2, 0.3), 0.5)
    part = grids.crop(grid, (0.6, 1.0), (2.0, 9.0))
    np.testing.assert_array_equal(part.log_odds, grid.log_odds[2:, 1:4])
    np.testing.assert_allclose(
        grids.centers(part), np.asarray(grids.centers(grid))[2:, 1:4], atol=1e-12
    )


def test_correlation_of_maps():
    rng = np.random.default_rng(5)
    log_odds = np.where(rng.random((9, 11)) < 0.3, 2.0, -2.0)
    log_odds[0] = 0.0
    a = grid_of(log_odds, (1, 2, 0.3), 0.5)
    value = jax.jit(grids.correlation)
    np.testing.assert_allclose(value(a, a), 1.0, atol=1e-9)
    np.testing.assert_allclose(value(a, a._replace(log_odds=-log_odds)), -1.0, atol=1e-9)
    other = np.where(rng.random((9, 11)) < 0.5, 1.0, -1.0)
    both = (log_odds != 0) & (other != 0)
    p = [1 / (1 + np.exp(-m[both])) for m in (log_odds, other)]
    np.testing.assert_allclose(
        value(a, a._replace(log_odds=other)), np.corrcoef(*p)[0, 1], atol=1e-9
    )
    assert value(a, a._replace(origin=np.array([50.0, 0, 0]))) == 0  # nothing in common
    slope = jax.jit(jax.grad(lambda origin: grids.correlation(a, a._replace(origin=origin))))
    for shift in (0.0, 0.1, 50.0):
        assert np.all(np.isfinite(slope(a.origin + shift)))


@refused(
    (lambda g: grids.distance_field(g, truncate=0.0), "distance_field: truncate: expected"),
    (
        lambda g: grids.distance_field(g, threshold=np.nan),
        "threshold: expected a finite number, got nan",
    ),
    (lambda g: grids.distance_field(3), "distance_field: grid: expected a Grid"),
    (
        lambda g: grids.distance_field(g._replace(log_odds=[[1.0, -1.0]])),
        "distance_field: grid.log_odds: expected an array, got a list",
    ),
    (
        lambda g: grids.distance_field(g._replace(log_odds=np.array([[1, -1]]))),
        "grid.log_odds: expected floating values, got int64",
    ),
    (
        lambda g: grids.interpolate(g, np.zeros(2)),
        "interpolate: field: expected a Field, got a Grid",
    ),
    (
        lambda g: grids.interpolate(grids.Field(*g), np.zeros(3)),
        r"interpolate: points: expected \(x, y\), got shape \(3,\)",
    ),
    (lambda g: grids.resample(g, 0.0), "resample: resolution: expected a number above 0"),
    (lambda g: grids.resample(g._replace(resolution=-1.0), 1.0), "resample: .*above 0"),
    (lambda g: grids.crop(g, (9, 9), (10, 10)), "crop: the box .* has no cell"),
    (lambda g: grids.crop(g, (0, 0, 0), (1, 1, 1)), "crop: expected two corners"),
    (
        lambda g: grids.correlation(g, g._replace(origin=np.zeros(4))),
        r"correlation: b.origin: expected finite numbers of shape \(3,\)",
    ),
)
def test_bad_input_is_refused(call):
    call(grid_of(np.zeros((3, 4))))


NEAR = jax.jit(near_distances, static_argnums=1)


@pytest.mark.parametrize("reach", [3, 120])
def test_near_distances_are_the_exact_ones_up_to_their_reach(reach):
    """By 16 bits and by 32."""
    for kind in ("sparse", "row", "dense", "thin"):
        cells = occupied(kind, np.random.default_rng(5))
        exact = np.rint(ndimage.distance_transform_edt(~cells) ** 2)
        np.testing.assert_array_equal(squared_distances(cells), exact)
        found = np.asarray(NEAR(cells, reach))
        assert found.dtype == (np.int16 if reach == 3 else np.int32)
        np.testing.assert_array_equal(found, np.minimum(exact, (reach + 1) ** 2))


@pytest.mark.parametrize("reach", [0, 3, 120])
def test_near_distances_without_an_occupied_cell_and_of_a_single_one(reach):
    beyond = (reach + 1) ** 2
    cells = np.zeros((40, 57), bool)
    np.testing.assert_array_equal(NEAR(cells, reach), beyond)
    cells[4, 50] = True
    exact = (np.arange(40)[:, None] - 4) ** 2 + (np.arange(57) - 50) ** 2
    np.testing.assert_array_equal(NEAR(cells, reach), np.minimum(exact, beyond))
