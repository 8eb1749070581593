"""Sphinx extension: writes the pages of the API reference from the package.

The public names of a module are its `__all__`. A name is shown under its shortest path: the package
that lists it, else the module that does.
"""

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
    "jaxslam.core.claims": "What a model claims",
    "jaxslam.core.slots": "The table of landmarks",
    "jaxslam.core.validation": "Checks, and the errors of bad input",
}
"""Title of each page, in the order of the contents; a module that is not listed comes after."""


class Name(NamedTuple):
    """A public name under the path that a reader uses."""

    module: str
    name: str
    kind: str
    """the autodoc directive: function, class, exception or data"""


def modules() -> list[ModuleType]:
    """All public modules of the package: those without an underscore in their path."""
    import jaxslam

    found = [jaxslam]
    for info in pkgutil.walk_packages(jaxslam.__path__, "jaxslam."):
        if "._" not in info.name:
            found.append(importlib.import_module(info.name))
    return found


def public_names() -> dict[str, list[Name]]:
    """The public names of each module that has some; a name stands once."""
    listed: set[tuple[int, str]] = set()
    pages: dict[str, list[Name]] = {}
    for module in modules():
        pages[module.__name__] = []
        for name in getattr(module, "__all__", []):
            value = getattr(module, name)
            if not inspect.ismodule(value) and (key := key_of(name, value)) not in listed:
                listed.add(key)
                pages[module.__name__].append(Name(module.__name__, name, kind_of(value)))
    return pages


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


def read_private_sources() -> None:
    """Let Sphinx find the docstrings of fields, which it reads from the file of `__module__`: the
    source of a public name is in the file of `__source_module__` (`jaxslam/_public.py`)."""
    from sphinx.pycode import ModuleAnalyzer

    analyze = ModuleAnalyzer.analyze

    def analyze_with_sources(self: ModuleAnalyzer) -> None:
        if self._analyzed:
            return
        analyze(self)
        module = sys.modules.get(self.modname)
        values = [getattr(module, name) for name in getattr(module, "__all__", ())]
        sources = {
            value.__source_module__
            for value in values
            if "__source_module__" in getattr(value, "__dict__", {})
            and value.__module__ == self.modname
        }
        for source in sorted(sources):
            private = ModuleAnalyzer.for_module(source)
            private.analyze()
            for table in ("attr_docs", "annotations", "tags", "tagorder", "overloads"):
                setattr(self, table, {**getattr(private, table), **getattr(self, table)})

    ModuleAnalyzer.analyze = analyze_with_sources


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
    read_private_sources()
    app.connect("builder-inited", write_pages)
    app.connect("autodoc-process-docstring", as_markup)
    app.connect("build-finished", missing)
    return {"parallel_read_safe": True}
