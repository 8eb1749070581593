"""A factor of a graph is verified as models are."""

import pytest
from own_models import changed
from verified import failed

from jaxslam import graphs, verify_jacobians
from jaxslam.verify.inputs import user_files


def test_a_wrong_entry_of_a_factor_is_named():
    right = graphs.RelativePose()

    def jacobians(variables, z):
        by_first, by_second = right.jacobians(variables, z)
        return by_first, by_second.at[1, 0].multiply(-1.0)

    report = verify_jacobians(changed(right, jacobians=jacobians), count=4)
    assert report.kind == "factor"
    assert failed(report) == ["residual by pose 2"]
    assert [f.name for f in report.findings] == [
        f"residual by {name}" for name in ("pose 1", "pose 2", "measurement")
    ]
    assert "entry (y [m], x [m]): hand disagrees" in str(report)


def test_factors_of_a_file_are_found(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text("from jaxslam import graphs\nmine = graphs.Prior()\n")
    assert [(t.name, t.model.name) for t in user_files.load(str(path))] == [("mine", "prior")]


def test_a_factory_of_a_factor_is_one(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text(
        "from jaxslam import graphs\n\n\ndef mine() -> graphs.Factor:\n    return graphs.Prior()\n"
    )
    assert [(t.name, t.model.name) for t in user_files.load(str(path))] == [("mine", "prior")]


def test_a_class_of_a_factor_without_fields_is_one(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text(
        "from jaxslam import graphs\nfrom jaxslam.core.record import record\n\n\n"
        "@record\nclass Mine(graphs.Prior):\n    pass\n"
    )
    assert [(t.name, t.model.name) for t in user_files.load(str(path))] == [("Mine", "mine")]


def test_a_class_in_the_place_of_a_factor_is_to_be_called():
    with pytest.raises(ValueError, match=r"got the class Prior of one: call it, as in Prior\(\)"):
        verify_jacobians(graphs.Prior)
