"""A small campaign in a store, and blocks to put into it."""

import numpy as np

SETTINGS = {
    "scenario": "ring",
    "filters": ("ekf", "σ"),
    "seed": 3,
    "lags": {1: 0.5},
    "versions": {"jax": "0.10.1"},
}


def assert_same(found, expected):
    assert list(found) == list(expected)
    for name, array in expected.items():
        assert (found[name].dtype, found[name].shape) == (array.dtype, array.shape)
        assert found[name].tobytes() == array.tobytes()


def fill(made, *firsts, runs=32):
    return [made.save(first, {"x": np.arange(first, first + runs) / 3}, runs) for first in firsts]


def spans(made):
    return [(block.first, block.runs) for block in made.blocks()]


def files(made):
    return sorted(path.name for path in made.folder.iterdir())
