"""Sphinx extension: writes the pages of the API reference from the package.

The public names of a module are those that `OPEN` lists, else its `__all__`, else, directly below
`jaxslam` and in `INTRODUCED`, all that it defines without an underscore. A name is shown under its
shortest path: the package that lists it, else the module that defines it.
"""

import ast
import importlib
import inspect
import pkgutil
import re
import sys
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

FOLDER = Path(__file__).parents[1] / "reference" / "api"

INTRODUCED = {
    "jaxslam": "The driver, the harness and the verifier",
    "jaxslam.core": "Records, and checks of numbers",
    "jaxslam.core.types": "Records of data",
    "jaxslam.core.protocols": "Protocols",
    "jaxslam.motion": "Motion models",
    "jaxslam.sensors": "Sensors",
    "jaxslam.filters": "Filters",
    "jaxslam.charts": "Charts of the error",
    "jaxslam.linearize": "Where Jacobians are taken",
    "jaxslam.association": "Data association",
    "jaxslam.life": "Which landmarks exist",
    "jaxslam.resampling": "Resampling",
    "jaxslam.graphs.smoothing": "Smoothing and batch estimation",
    "jaxslam.graphs": "Graphs of poses and points",
    "jaxslam.laser.grids": "Occupancy grids and rays",
    "jaxslam.laser.laser_slam": "Laser SLAM",
    "jaxslam.laser.matching": "Scan matching",
    "jaxslam.laser.features": "Features of scans",
    "jaxslam.laser.topology": "Topological maps",
    "jaxslam.filters.multi_robot.team": "Several robots",
    "jaxslam.simulation": "Simulated worlds",
    "jaxslam.consistency.campaign": "Monte-Carlo campaigns",
    "jaxslam.consistency": "Measures of consistency",
    "jaxslam.consistency.metrics": "Errors of paths and maps",
    "jaxslam.verify": "Verification of Jacobians",
    "jaxslam.catalog": "The filters of a campaign by name",
    "jaxslam.datasets": "Data sets",
    "jaxslam.core.logs": "Logs from tables and streams",
    "jaxslam.calibration": "Calibration and noises",
    "jaxslam.results": "Reports, figures and files",
    "jaxslam.math": "Mathematics",
    "jaxslam.core.noise": "Noise models",
    "jaxslam.core.slots": "The table of landmarks",
    "jaxslam.core.validation": "What is refused",
}
"""Title of each page, in the order of the contents; a module that is not listed comes after."""


OPEN = {
    "jaxslam.charts": "Euclidean LeftInvariant RightInvariant",
    "jaxslam.catalog": "ALL FILTERS ideal variant",
    "jaxslam.consistency": (
        "Average LocalizationScores LocalizationSummary Measure RunStatistics Score "
        "Summary Verdict conditional_bound covering_level credibility judge "
        "judge_localization posterior_bound register score summarize_localization"
    ),
    "jaxslam.consistency.campaign": "Keep Processes",
    "jaxslam.consistency.metrics": (
        "Errors MeanAndStd PathErrors Relations Statistics align_map alignment ate "
        "benchmark_figures given map_entropy relation_errors relations revisits rpe "
        "statistics summary"
    ),
    "jaxslam.core.logs.streams": "Rows Rule divide hold relative",
    "jaxslam.core.logs.tables": "Aligned",
    "jaxslam.core.noise": "Constant NoiseCov",
    "jaxslam.core.numbers": "check_array check_positive",
    "jaxslam.core.protocols": (
        "Associate Association Basis Candidate Chart Estimator Free Here Life Linearizer "
        "Model Motion Pairs Prediction Reduced Resample Sensor"
    ),
    "jaxslam.core.record": "record set_field static",
    "jaxslam.core.slots": "Joint allocate empty find remove scatter",
    "jaxslam.core.types": "Beams Estimate Info Log Scan Status Trace Truth",
    "jaxslam.core.validation": "check_count check_covariance check_gate check_record is_concrete",
    "jaxslam.datasets": (
        "MRCLAM_CALIBRATION Added Adjustable BagContents Dataset DatasetFit LaserLog Parameter "
        "RobotCalibration StampedRelations bonn carmen considered fit mrclam mrclam_team "
        "plaza relation_file rosbag rosbag_contents table victoria_park"
    ),
    "jaxslam.datasets.evaluation": "Evaluation MapTest evaluate",
    "jaxslam.filters.map_management.relocalization": (
        "lost points_of_map relocalize relocated seen_points"
    ),
    "jaxslam.filters.multi_robot.team": "Robot pose_cross_cov poses",
    "jaxslam.filters.reporting": "Mask Pruned info_of status_of with_extra",
    "jaxslam.linearize.first_order": "invert_jacobians motion_jacobians observe_jacobians",
    "jaxslam.math.angles": "sinc wrap",
    "jaxslam.math.gaussians": "GaussianTerms gaussian_terms",
    "jaxslam.math.linalg": "cholesky inverse root_psd solve_lower solve_psd symmetrize",
    "jaxslam.math.se2": (
        "adjoint align between boxminus boxplus compose exp from_frame "
        "from_frame_jacobians inverse log polar polar_in_frame polar_jacobians "
        "rectangular rectangular_jacobians rotation to_frame to_frame_jacobians"
    ),
    "jaxslam.math.stats": "chi2_band chi2_quantile sigma_gate",
    "jaxslam.math.uncertain_poses": (
        "Frame bhattacharyya compound mahalanobis_squared merge reverse"
    ),
    "jaxslam.results.page": "",
    "jaxslam.results.plot": (
        "COLORS COLUMN PAGE Figure Film Layer Panel Scene animate animate_world "
        "cost_figure coverage_figure ellipse errors_figure gained_figure graph_figure "
        "grid_figure loops_figure map_figure maps_before_after nees_figure probe "
        "rmse_figure topology_figure walls_figure whiteness_figure"
    ),
    "jaxslam.results.plot.style": (
        "FAINT INK SHADE TEXT band caption curve every_handle panels_of titled"
    ),
    "jaxslam.results.report": "map_csv trajectory_csv trajectory_tum",
    "jaxslam.results.store": "open resume",
    "jaxslam.driver": "",
    "jaxslam.simulation.laser": (
        "Laser LaserHistory LaserWorld Observability scan scan_information scan_world true_ranges"
    ),
    "jaxslam.simulation.scenarios.rooms": "from_start",
    "jaxslam.simulation.walls": "Walls make_walls rasterize",
    "jaxslam.simulation.worlds": "World",
    "jaxslam.verify": "Check Finding Report",
}
"""Names, of modules whose other names only the package uses, that user code may call."""


class Name(NamedTuple):
    """A public name under the path that a reader uses."""

    module: str
    name: str
    kind: str
    """the autodoc directive: function, class, exception or data"""


def modules() -> list[ModuleType]:
    """All public modules of the package but the command line's."""
    import jaxslam

    found = [jaxslam]
    for info in pkgutil.walk_packages(jaxslam.__path__, "jaxslam."):
        parts = info.name.split(".")[1:]
        if parts[0] != "cli" and not any(part.startswith("_") for part in parts):
            found.append(importlib.import_module(info.name))
    return found


def public_names() -> dict[str, list[Name]]:
    """The public names of each module that has some; a name stands once."""
    walked = [m for m in modules() if listed_names(m) is not None or is_open(m.__name__)]
    listed: dict[tuple[int, str], Name] = {}
    pages: dict[str, list[Name]] = {module.__name__: [] for module in walked}
    for module in walked:
        for name in listed_names(module) or []:
            value = getattr(module, name)
            if not inspect.ismodule(value) and (key := key_of(name, value)) not in listed:
                listed[key] = Name(module.__name__, name, kind_of(value))
                pages[module.__name__].append(listed[key])
    for module in walked:
        if listed_names(module) is not None:
            continue
        constants = assigned(module)
        for name, value in vars(module).items():
            if name.startswith("_") or inspect.ismodule(value) or key_of(name, value) in listed:
                continue
            kind = kind_of(value)
            foreign = inspect.isclass(value) and kind == "data" and not of_arrays(value)
            own = name in constants if kind == "data" else value.__module__ == module.__name__
            if own and not foreign:
                pages[module.__name__].append(Name(module.__name__, name, kind))
    return pages


def listed_names(module: ModuleType) -> list[str] | None:
    """The names of a module by `OPEN` or `__all__`; None without either."""
    if module.__name__ in OPEN:
        return OPEN[module.__name__].split()
    return getattr(module, "__all__", None)


def is_open(module: str) -> bool:
    """Whether all names of a module without an underscore are public."""
    return module.count(".") < 2 or module in INTRODUCED


def key_of(name: str, value: Any) -> tuple[int, str]:
    """What two paths to one value share; of plain constants, which equal ones share, the name."""
    return id(value), name if isinstance(value, int | float | str) else ""


def kind_of(value: Any) -> str:
    """The autodoc directive of a value."""
    if inspect.isclass(value) and value.__module__.startswith("jaxslam"):
        return "exception" if issubclass(value, BaseException) else "class"
    is_function = callable(value) and getattr(value, "__module__", "").startswith("jaxslam")
    return "function" if is_function and hasattr(value, "__name__") else "data"


def of_arrays(value: Any) -> bool:
    """Whether a value is a type of arrays, as `Float[Array, "3"]`; `Array` alone is JAX's."""
    return inspect.isclass(value) and value.__module__.startswith("jaxtyping")


def assigned(module: ModuleType) -> set[str]:
    """Names of the constants and types that a module itself assigns."""
    names = set()
    for node in ast.parse(inspect.getsource(module)).body:
        if isinstance(node, ast.Assign | ast.AnnAssign):
            target = node.target if isinstance(node, ast.AnnAssign) else node.targets[0]
            names |= {each.id for each in ast.walk(target) if isinstance(each, ast.Name)}
    return names


def page_of(module: str) -> str:
    """The page that a module stands on: that of the nearest package in INTRODUCED, or its own."""
    parts = module.split(".")
    above = (".".join(parts[:n]) for n in range(len(parts), 1, -1))
    return next((name for name in above if name in INTRODUCED), ".".join(parts[:2]))


def write_pages(app: Any = None) -> None:
    """Write a page for each top-level module; a page that is as it was is left alone."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    sections: dict[str, list[str]] = {}
    for module, names in public_names().items():
        page = page_of(module)
        if names or module == page:
            sections.setdefault(page, []).append(section(module, names, top=module == page))
    order = [*INTRODUCED, *sorted(set(sections) - set(INTRODUCED))]
    written = set()
    for page in (page for page in order if page in sections):
        title = f"{INTRODUCED.get(page, page)}: {page}" if page in INTRODUCED else page
        text = f"{title}\n{'=' * len(title)}\n\n" + "\n".join(sections[page])
        target = FOLDER / f"{page}.rst"
        written.add(target)
        if not target.exists() or target.read_text(encoding="utf-8") != text:
            target.write_text(text, encoding="utf-8")
    for path in set(FOLDER.glob("*.rst")) - written:
        path.unlink()


def section(module: str, names: list[Name], top: bool) -> str:
    """The text of one module: its docstring, then its names in order."""
    lines = [] if top else [module, "-" * len(module), ""]
    lines += [f".. automodule:: {module}", "   :no-members:", ""]
    for name in names:
        lines += [f".. auto{name.kind}:: {name.module}::{name.name}"]
        if name.kind == "data":
            value = getattr(sys.modules[name.module], name.name)
            shape = f"annotation: = {value.__name__}" if of_arrays(value) else "no-value:"
            lines += [f"   :{shape}"]
        lines += [""]
    return "\n".join(lines)


def as_markup(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Docstrings are plain text with `code` and the sections Args and Raises; the word errata is a
    link.

    What reStructuredText would take for markup is escaped. A constant without a docstring of its
    own has its type's, which is left out, and so is what Python says of a field.
    """
    from sphinx.ext import napoleon  # the suite imports this file without Sphinx

    text = "\n".join(lines)
    of = obj if inspect.isclass(obj) else type(obj)
    first = text.strip().partition("\n")[0]
    borrowed = first.startswith(f"{of.__name__}(") or first in (inspect.getdoc(of) or "")
    borrowed = borrowed or first.startswith("Alias for field number")  # of a named tuple
    if what in ("data", "attribute") and borrowed:
        lines.clear()
        return
    pieces = re.split(r"(`[^`]*`)", text)
    for k in range(0, len(pieces), 2):
        pieces[k] = re.sub(r"([*|\\])", r"\\\1", pieces[k])
        pieces[k] = re.sub(r"(\w)_(?!\w)", r"\1\\_", pieces[k])
        pieces[k] = re.sub(r":\n\n(?= )", "::\n\n", pieces[k])  # a diagram
        pieces[k] = re.sub(r"\berrata\b(?!:)", ":doc:`errata </background/errata>`", pieces[k])
    for k in range(1, len(pieces), 2):
        pieces[k] += "\\ " if re.match(r"[\w(]", pieces[k + 1]) else ""
    plain = "".join(pieces).split("\n")
    settings = napoleon.Config(napoleon_use_rtype=False)
    # As of a module: napoleon would take an attribute's text up to a colon for its type.
    kind = what if what in ("class", "function", "method") else "module"
    lines[:] = napoleon.GoogleDocstring(plain, settings, app, kind, name, obj).lines()


def missing(app: Any, exception: Exception | None) -> None:
    """After the build: a public name that no page shows is an error."""
    if exception is not None or app.builder.name != "html":
        return
    shown = set(app.env.domaindata["py"]["objects"])
    wanted = {f"{n.module}.{n.name}" for names in public_names().values() for n in names}
    if lost := sorted(wanted - shown):
        raise RuntimeError(f"the reference misses {len(lost)} public names: {', '.join(lost)}")


def setup(app: Any) -> dict[str, bool]:
    """Connect to Sphinx."""
    app.connect("builder-inited", write_pages)
    app.connect("autodoc-process-docstring", as_markup)
    app.connect("build-finished", missing)
    return {"parallel_read_safe": True}
