"""Optima of public pose graphs from four starts.

The files are looked for in the folder JAXSLAM_DATA, by default ../shared/data beside the checkout,
and left out where absent. χ² has two forms: e = Z⁻¹ ∘ Xᵢ⁻¹ ∘ Xⱼ as (x, y, θ), which g2o has, and
its logarithm, which GTSAM 4.3 has, whose optima from several starts are the known values.

Of the lowest optimum of each file in g2o's form follow its certificate, and, where the true poses
are known, whether its covariances are honest.
"""

import numpy as np

from benchmarks.gate import Metric, show
from benchmarks.real_data import DATA
from jaxslam import datasets, graphs
from jaxslam.consistency import pose_error
from jaxslam.graphs import Ending, Solution, starts

FOLDER = DATA / "graphs"

KNOWN = {
    "ring": 11.16310,
    "CSAIL": 40.55088,
    "MIT": 41.20695,
    "intel": 45.00423,
    "input_M3500_g2o": 137.91488,
    "manhattanOlson3500": 146.07873,
    "manhattan": 3549.0411,
    "city10000": 511.98745,
    "input_M3500b_g2o": np.nan,
}
"""χ² of the logarithm by GTSAM 4.3; of the last one it finds 35,006 from the file's start."""

TRUE = {
    "ring": lambda: datasets.read_graph(FOLDER / "ring_groundTruth.g2o").poses,
    "manhattanOlson3500": lambda: np.loadtxt(FOLDER / "manhattanOlson3500_nodes_groundTruth.dat"),
}
"""True poses, (N, 3), in the order of the file and in the frame of its first pose."""

NOT_FROM = {("MIT", "given")}
"""Files and starts from which the known optimum is not reached."""

ERRORS = {"log": graphs.RelativePoseLog(), "pose": graphs.RelativePose()}
ITERATIONS = 1000


def measure(quick: bool = False) -> list[Metric]:
    metrics, best, rows = [], {}, {}
    for name, known in KNOWN.items():
        path = FOLDER / f"{name}.g2o"
        if not path.exists():
            continue
        read = graphs.with_gauge(datasets.read_graph(path))
        for error, factor in ERRORS.items():
            solutions = {}
            for start, place in starts.STARTS.items():
                found = graphs.optimize(
                    place(read), {"relative_pose": factor}, iterations=ITERATIONS
                )
                solutions[start] = found
                rows[f"{name}, {error}, {start}"] = {
                    "χ² at the start": f"{float(found.chi2_start):.7g}",
                    "χ² at the end": f"{float(found.chi2):.9g}",
                    "steps": int(found.iterations),
                    "gradient / start's": f"{float(found.gradient / found.gradient_start):.1e}",
                    "status": Ending(int(found.status)).name.lower(),
                }
                gated = error == "log" and start in ("given", "chordal") and np.isfinite(known)
                if gated and (name, start) not in NOT_FROM:
                    off = abs(float(found.chi2) / known - 1)
                    metrics.append(Metric(f"χ² of {name} from {start}, off", off, high=1e-6))
            best[name, error] = min(solutions.values(), key=lambda found: float(found.chi2))
            slope = float(best[name, error].gradient / solutions["given"].gradient_start)
            what = f"gradient of {name}, {error}, over that of the file"
            metrics.append(Metric(what, slope, high=1e-6))
    optima = {name: found for (name, error), found in best.items() if error == "pose"}
    show("every start", rows)
    show("lowest optimum: is the chordal one next to it global?", certificates(optima))
    return metrics + judge({name: optima[name] for name in TRUE if name in optima})


def certificates(optima: dict[str, Solution]) -> dict[str, dict[str, float | str]]:
    """What is proved of the optima, e = pose, as by `jaxslam optimize`."""
    rows = {}
    for name, found in optima.items():
        proof = graphs.certificate(found.graph)
        rows[name] = {
            "poses": len(found.graph.poses),
            "χ²": f"{float(found.chi2):.9g}",
            "chordal χ²": f"{float(proof.chi2):.9g}",
            "lower by at most": f"{float(proof.gap):.2g}",
            "apart [m]": f"{float(proof.position):.2g}",
            "apart [rad]": f"{float(proof.heading):.2g}",
            "certified": "yes" if proof.certified else "no",
        }
    return rows


def judge(optima: dict[str, Solution]) -> list[Metric]:
    """Errors to the true poses beside what the marginals claim, without gates: a file is one draw.

    NEES: mean of (truth - estimate)ᵀ P⁻¹ (truth - estimate) over all poses but the fixed one, 3 if
    honest. Scaled: with P times χ² / dof, as if the noise of the file were known but for a factor.
    """
    metrics = []
    for name, found in optima.items():
        graph = found.graph
        error = pose_error(TRUE[name](), np.asarray(graph.poses))[1:]
        cov = np.asarray(graphs.marginals(found).poses)[1:]
        whitened = np.linalg.solve(cov, error[..., None])[..., 0]
        nees = float((error * whitened).sum(axis=1).mean())
        rmse = float(np.sqrt((error[:, :2] ** 2).sum(axis=1).mean()))
        claimed = float(np.sqrt(np.trace(cov[:, :2, :2], axis1=1, axis2=2).mean()))
        ratio = float(graphs.chi2(graph)) / graphs.degrees_of_freedom(graph)
        metrics += [
            Metric(f"{name}: position RMSE to the truth [m]", rmse),
            Metric(f"{name}: position RMSE that the marginals claim [m]", claimed),
            Metric(f"{name}: mean pose NEES (3 is honest)", nees),
            Metric(f"{name}: χ² / dof", ratio, note=f"dof {graphs.degrees_of_freedom(graph)}"),
            Metric(f"{name}: mean pose NEES, covariances × χ² / dof", nees / ratio),
        ]
    return metrics
