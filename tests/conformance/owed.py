"""What the suites over registries share: covariances that no factory takes, and functions of rows."""

import jax
import numpy as np

DTYPES = [np.float32, np.float64]


def random_covariance(n, seed):
    root = np.random.default_rng(seed).normal(size=(n, n)) * 0.1
    return root @ root.T


def of_rows(function):
    """The function of one row as one of a batch, in NumPy."""
    program = jax.jit(jax.vmap(function))
    return lambda *rows: jax.device_get(program(*rows))


def bad_covariances(n):
    skew, broken = np.eye(n), np.eye(n)
    skew[0, -1] += 0.5
    broken[0, 0] = np.nan
    return {
        "shape": np.eye(n + 1),
        "vector": np.ones(n),
        "scalar": 0.1,
        "asymmetric": skew if n > 1 else np.array([[np.nan]]),
        "negative": np.diag([1.0] * (n - 1) + [-0.1]),
        "nan": broken,
    }
