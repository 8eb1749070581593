"""A real robot among posts: what a third of its log says of its errors, against the true path of all."""

import dataclasses
from pathlib import Path

import jax
import numpy as np
import pytest

import jaxslam
from examples.lost_in_the_woods import write_tables
from jaxslam import charts, datasets
from jaxslam.consistency import block_nees, pose_error
from jaxslam.core.types import Status
from jaxslam.datasets._landmark_logs.table_settings import fitted_text
from jaxslam.datasets._noise_fit import autocorrelation

MAT = Path(__file__).parents[3] / "shared" / "data" / "lost_in_the_woods" / "dataset2.mat"
ROWS = 4000


@pytest.mark.sweep
@pytest.mark.skipif(not MAT.is_file(), reason="needs shared/data/lost_in_the_woods")
def test_a_third_of_a_real_log_makes_the_whole_honest(tmp_path):
    folder = write_tables(MAT, tmp_path / "woods")
    data = datasets.table(folder)
    assert data.dropped["measurements of the maximum range"] == 2422
    begin = dataclasses.replace(
        data,
        log=jax.tree.map(lambda leaf: leaf[:ROWS], data.log),
        time=data.time[:ROWS],
        true_path=None,
        true_at=None,
    )
    # The models of the whole, over the first rows of its log.
    begin = dataclasses.replace(
        begin,
        adjustable=data.adjustable._replace(
            at=lambda p: (
                jax.tree.map(lambda leaf: leaf[:ROWS], data.adjustable.at(p)[0]),
                *data.adjustable.at(p)[1:],
            )
        ),
    )
    fitted = datasets.fit(
        begin, calibrate=("heading", "scale", "range", "delay"), fixed=("range scale",)
    )
    assert fitted.noise_fit.converged
    (folder / "fit.toml").write_text(fitted_text(fitted.parameters, fitted.cov))
    data = datasets.table(folder)

    def filter_of(motion, sensor):
        return jaxslam.filters.EkfSlam(
            motion, sensor, data.capacity, **data.filter_options, chart=charts.RightInvariant()
        )

    filter = filter_of(data.motion, data.sensor)
    trace = jax.device_get(
        jaxslam.run(filter, data.log, data.pose, data.pose_cov, jax.random.key(0))
    )
    fused = trace.info.status == Status.FUSED
    assert trace.info.nis[fused].sum() / trace.info.dof[fused].sum() == pytest.approx(1.0, abs=0.1)
    assert autocorrelation(trace.info)[0] < 0.3
    error = pose_error(data.true_path, trace.estimate.pose)
    cov = trace.estimate.pose_cov + datasets.consider_constants(data, filter_of).pose
    nees, regular = block_nees(trace.estimate.pose, error, error, cov)["pose"]
    assert np.median(nees[data.true_at & regular]) < 6
