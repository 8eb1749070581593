"""The checker of shapes is at work in the package, and lets pass what is as it says."""

# ruff: noqa: F722, F821

import numpy as np
import pytest
import shapes
from jaxtyping import Array, Bool, Float

from jaxslam.math import angles, linalg


@shapes.checked
def weighed(
    x: Float[Array, "n"], both: tuple[Float[Array, "n m"], Bool[Array, "m"]] | None = None, *, p=3
) -> Float[Array, "n"]:
    return x if both is None else both[0] @ both[1]


N, M = np.ones(2), np.ones((2, 3))


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ((N[None],), r"weighed: x is no .*Float.*: float64\(1, 2\)"),
        ((N.astype(int),), "weighed: x is no"),
        ((N, (M, np.ones(3))), r"both is no .*: \(float64\(2, 3\), float64\(3,\)\)"),
        ((N, (M.T, np.ones(2, bool))), "both is no"),  # n is 2 already
    ],
)
def test_an_array_is_as_its_annotation_says(arguments, told):
    with pytest.raises(TypeError, match=told):
        weighed(*arguments)
    weighed(N)
    weighed(N, both=(M, np.ones(3, bool)), p=4)


def test_a_result_is_as_its_annotation_says():
    @shapes.checked
    def transposed(x: Float[Array, "n m"]) -> Float[Array, "n m"]:
        return x.T

    with pytest.raises(TypeError, match="transposed: returns no"):
        transposed(M)
    transposed(np.ones((2, 2)))


def test_the_package_is_checked():
    with pytest.raises(TypeError, match=r"cholesky: matrix is no .*: float64\(3,\)"):
        linalg.cholesky(np.ones(3))
    assert angles.horner.__code__.co_filename == angles.__file__  # no array enters by name
