"""Beam models under `verify`: both pass, a wrong derivative does not, and a file may define one."""

from functools import partial

import jax.numpy as jnp
import pytest

from jaxslam import cli
from jaxslam.core.record import record
from jaxslam.laser.grids import beam_models
from jaxslam.verify import build, verify_jacobians
from jaxslam.verify.inputs.user_files import UnusableFile, load, verify_file


@pytest.mark.parametrize("make", beam_models.REGISTRY.values(), ids=beam_models.REGISTRY)
def test_beam_models_are_verified(make):
    report = verify_jacobians(build(make), count=4)
    assert report.passed, str(report)
    assert report.kind == "beam model"


def test_a_wrong_derivative_by_the_heading_is_found():
    @record
    class Wrong(beam_models.LikelihoodField):
        def jacobian(self, prepared, pose, beams):
            return super().jacobian(prepared, pose, beams) * jnp.array([[1.0, 1.0, -1.0]])

    report = verify_jacobians(build(Wrong), count=4)
    assert not report.passed
    assert "theta" in str(report) and "hand disagrees" in str(report), str(report)


def test_a_file_may_define_a_beam_model_whose_jacobian_is_held(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text(
        "import dataclasses\nfrom jaxslam.core.record import record\n"
        "from jaxslam.laser.grids import LikelihoodField\n"
        "@record\nclass Wrong(LikelihoodField):\n"
        "    def jacobian(self, *at):\n        return -super(Wrong, self).jacobian(*at)\n"
        "mine = LikelihoodField(0.2, max_range=40.0)\nwrong = Wrong(0.2, max_range=40.0)\n",
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
