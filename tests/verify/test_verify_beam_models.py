"""Beam models under `verify`: both pass, a wrong derivative does not, and a file may define one."""

import dataclasses
from functools import partial

import jax.numpy as jnp
import pytest

from jaxslam import cli
from jaxslam.grids import beam_models
from jaxslam.verify import build, verify_jacobians
from jaxslam.verify.inputs.user_files import UnusableFile, load, verify_file


@pytest.mark.parametrize("make", beam_models.REGISTRY.values(), ids=beam_models.REGISTRY)
def test_beam_models_are_verified(make):
    report = verify_jacobians(build(make), count=4)
    assert report.passed, str(report)
    assert report.kind == "beam model"


def test_a_wrong_derivative_by_the_heading_is_found():
    right = build(beam_models.likelihood_field)

    def wrong(prepared, pose, beams):
        return right.jacobian(prepared, pose, beams) * jnp.array([[1.0, 1.0, -1.0]])

    report = verify_jacobians(dataclasses.replace(right, jacobian=wrong), count=4)
    assert not report.passed
    assert "theta" in str(report) and "hand disagrees" in str(report), str(report)


def test_a_file_may_define_a_beam_model_whose_jacobian_is_held(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text(
        "import dataclasses\nfrom jaxslam.grids import likelihood_field\n"
        "mine = likelihood_field(0.2, max_range=40.0)\n"
        "wrong = dataclasses.replace(mine, jacobian=lambda *at: -mine.jacobian(*at))\n",
        encoding="utf-8",
    )
    right, wrong = verify_file(str(path), partial(verify_jacobians, count=4))
    assert (right.model, right.kind, right.passed) == ("mine", "beam model", True), str(right)
    assert not wrong.passed
    assert "hand disagrees" in str(wrong)
    with pytest.raises(UnusableFile, match=r"expected dataclasses to be .* a BeamModel, or"):
        load(f"{path}:dataclasses")
    (target,) = (a for a in cli._parser()._actions if isinstance(a.choices, dict))
    assert "grids.BeamModel" in target.choices["verify"].format_help()
