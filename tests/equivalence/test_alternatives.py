"""Localization by other libraries gives the same estimates; each is skipped where it is absent."""

import pytest

from benchmarks import alternatives


@pytest.fixture(scope="module")
def task():
    return alternatives.task(steps=40)


@pytest.mark.parametrize("name", alternatives.OTHERS)
def test_another_library_gives_the_same_localization(name, task):
    if not alternatives.installed(name):
        pytest.skip(f"{name} is not installed")
    ours = alternatives.PEER.get(name, alternatives.with_jaxslam)(*task)
    pose, cov = alternatives.difference(alternatives.OTHERS[name](*task), ours)
    assert pose < 1e-6 and cov < 1e-4


def test_the_reset_of_gtsam_is_what_differs(task):
    pytest.importorskip("gtsam", reason="GTSAM is not installed")
    ours = alternatives.left_invariant(*task)
    assert alternatives.difference(alternatives.with_gtsam(*task, reset=False), ours)[0] < 1e-12
    assert alternatives.difference(alternatives.with_gtsam(*task, reset=True), ours)[0] > 1e-5
