"""What a log says of its own errors: a real robot among 17 posts, and its true path.

`examples/lost_in_the_woods.py` writes the file as tables. As recorded (the variances of the file,
every measurement, no correction) EKF-SLAM and the right-invariant EKF are compared with the true
path of the cameras. Then `datasets.fit` finds noises and systematic errors by the likelihood of the
log alone, and the same filters run again, with what the uncertainty of the constants adds. Errors
of the laser last for seconds; the spacing is the least at which innovations of a landmark
are correlated by less than 0.2, see the table. JAXSLAM_DATA is the folder of the data.
"""

import tempfile
import time
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np

import jaxslam
from benchmarks.gate import Metric, save, show
from benchmarks.real_data import DATA
from examples.lost_in_the_woods import write_tables
from jaxslam import charts, datasets, metrics
from jaxslam.consistency import block_nees, pose_error
from jaxslam.core.types import Status
from jaxslam.datasets._noise_fit import autocorrelation
from jaxslam.filters import EkfSlam
from jaxslam.math.stats import chi2_quantile
from jaxslam.results.plot import COLORS, FAINT, INK, PAGE, SHADE, caption, panels_of, titled
from jaxslam.results.plot._landmarks import ellipses

MAT = DATA / "lost_in_the_woods" / "dataset2.mat"
SPACINGS = 0.0, 0.5, 1.0, 2.0, 3.0, 5.0
CALIBRATED = ("heading", "scale", "range", "delay")
MAGNIFIED = 5
"""By which errors of the map are drawn larger."""
CHARTS = {"EKF": charts.Euclidean(), "right-invariant EKF": charts.RightInvariant()}


def tables(folder, spacing, recorded=False):
    """recorded: with all that the file has, also the largest range, and bearings of one noise."""
    data = write_tables(MAT, folder, spacing)
    if recorded:
        settings = (data / "dataset.toml").read_text().split("\n")
        kept = [line for line in settings if not line.startswith(("across", "max_range"))]
        (data / "dataset.toml").write_text("\n".join(kept))
    return datasets.table(data)


def filtered(data, chart):
    """The trace, errors of the pose where the truth is known, and a row of numbers."""

    def filter_of(motion, sensor):
        return EkfSlam(motion, sensor, data.capacity, **data.filter_options, chart=chart)

    filter = filter_of(data.motion, data.sensor)
    log = jax.tree.map(np.asarray, data.log)
    trace = jax.device_get(jaxslam.run(filter, log, data.pose, data.pose_cov, jax.random.key(0)))
    added = datasets.consider_constants(data, filter_of)
    cov = trace.estimate.pose_cov + (0.0 if added is None else added.pose)
    error = pose_error(data.true_path, trace.estimate.pose)
    nees, regular = block_nees(trace.estimate.pose, error, error, cov)["pose"]
    known = data.true_at & regular
    fused = trace.info.status == Status.FUSED
    path = metrics.ate(data.true_path[known], trace.estimate.pose[known], align=False)
    row = {
        "measurements": f"{data.measurements:,}",
        "ATE [m]": metrics.statistics(path.translation).rmse,
        "heading [deg]": np.rad2deg(np.sqrt((error[known, 2] ** 2).mean())),
        "NEES, median": float(np.median(nees[known])),
        "NIS/dof": float(trace.info.nis[fused].sum() / trace.info.dof[fused].sum()),
        "autocorrelation": autocorrelation(trace.info)[0],
    }
    return trace, np.where(known[:, None], error, np.nan), np.where(known, nees, np.nan), row


def ranges_by_the_truth(data):
    """(scale, offset [m]) of the recorded ranges against the true distances, by least squares."""
    row, slot = np.nonzero(data.log.scan.valid & data.true_at[:, None])
    pose = data.true_path[row]
    ahead = data.adjustable.values[
        [p.name for p in data.adjustable.parameters].index("mount x [m]")
    ]
    laser = pose[:, :2] + ahead * np.stack([np.cos(pose[:, 2]), np.sin(pose[:, 2])], axis=1)
    gap = data.landmarks[data.log.scan.tag[row, slot]] - laser
    return np.polyfit(np.hypot(*gap.T), data.log.scan.z[row, slot, 0], 1)


def figure_of(runs, data):
    """Posts of the map, the error of the position and the NEES of three runs."""
    figure, (a, b, c) = panels_of(PAGE, 2.9, 1, 3, share=(False, False), widths=(1.5, 1, 1))
    true = data["calibrated, invariant"].landmarks
    a.plot(*true.T, "+", color=INK, ms=6, label="surveyed post")
    low, high = (float(chi2_quantile(p, 3)) for p in (0.025, 0.975))
    c.axhspan(low, high, fc=(SHADE, 0.35), ec=FAINT, lw=0.4, label="95 % of an honest NEES")
    for color, (name, (trace, error, nees, _)) in zip(COLORS, runs.items(), strict=False):
        points, covs = trace.estimate.points[-1], trace.estimate.point_covs[-1]
        at = true[trace.estimate.tag[-1]]
        ends = at + MAGNIFIED * (points - at)
        a.plot(*np.stack([at, ends], axis=1).transpose(2, 1, 0), color=color, lw=0.8)
        a.plot(*ellipses(ends, MAGNIFIED**2 * covs).transpose(2, 1, 0), color=color, lw=0.5)
        minutes = data[name].time / 60
        b.plot(minutes, np.hypot(*error[:, :2].T), color=color, lw=0.7, label=name)
        c.semilogy(minutes, np.clip(nees, 0.02, None), color=color, lw=0.5)
    titled(a, f"posts [m]: errors and 3 σ, {MAGNIFIED} times")
    a.set_aspect("equal")
    titled(b, "error of the position [m]")
    titled(c, "NEES of the pose")
    for axes in (b, c):
        axes.set_xlabel("time [min]")
    handles = [*a.get_legend_handles_labels()[0], *b.get_legend_handles_labels()[0]]
    caption(figure, "Lost in the woods: a real robot among 17 posts, Vicon truth", handles)
    return figure


def measure(quick: bool = False) -> list[Metric]:
    if not MAT.is_file():
        print(f"no file {MAT}: nothing is measured")
        return []
    with tempfile.TemporaryDirectory() as home:
        recorded = tables(Path(home) / "recorded", 0.0, recorded=True)
        data = tables(Path(home) / "spaced", 3.0)
        began = time.perf_counter()
        fitted = datasets.fit(data, calibrate=CALIBRATED, fixed=("range scale",))
        took = time.perf_counter() - began
        found = fitted.noise_fit
        shown = zip(found.names, found.parameters, found.error, found.robust_error, strict=True)
        show(
            f"What the log tells ({took:.0f} s)",
            {n: {"value": v, "std. error": e, "robust": r} for n, v, e, r in shown},
        )
        from jaxslam.datasets._landmark_logs.table_settings import fitted_text

        text = fitted_text(fitted.parameters, fitted.cov)
        calibrated = {}
        for spacing in (*SPACINGS,) if not quick else (3.0,):
            folder = write_tables(MAT, Path(home) / f"{spacing}", spacing)
            (folder / "fit.toml").write_text(text)
            calibrated[spacing] = datasets.table(folder)
    runs = {f"as recorded, {name}": filtered(recorded, chart) for name, chart in CHARTS.items()}
    runs |= {
        f"calibrated, {name}": filtered(calibrated[3.0], chart) for name, chart in CHARTS.items()
    }
    show("Filters", {name: row for name, (*_, row) in runs.items()})
    invariant = CHARTS["right-invariant EKF"]
    spaced = {f"{s:g} s": filtered(replace(each), invariant)[3] for s, each in calibrated.items()}
    show("Spacing, with these constants (invariant)", spaced)
    row = runs["calibrated, right-invariant EKF"][3]
    scale, offset = ranges_by_the_truth(calibrated[3.0])
    print(f"\nby the truth, ranges are {scale:.4f} times the distance and {offset:.4f} m")
    if not quick:
        chosen = {
            "as recorded, EKF": runs["as recorded, EKF"],
            "as recorded, invariant": runs["as recorded, right-invariant EKF"],
            "calibrated, invariant": runs["calibrated, right-invariant EKF"],
        }
        of = {name: recorded if "recorded" in name else calibrated[3.0] for name in chosen}
        save(figure_of(chosen, of), "woods")
    return [
        Metric("NIS/dof, right-invariant EKF", row["NIS/dof"], 0.9, 1.1),
        Metric("autocorrelation of innovations", row["autocorrelation"], high=0.3),
        Metric("median pose NEES, right-invariant EKF", row["NEES, median"], high=6.0),
        Metric("ATE [m], right-invariant EKF", row["ATE [m]"], high=0.07),
    ]
