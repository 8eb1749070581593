"""Helpers of the commands: shared options, devices, compilation time, summaries, films."""

import argparse
import contextlib
import glob
import json
import sys
import threading
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias, TypeVar

import jax

from jaxslam.consistency._measures.counts import count_label
from jaxslam.consistency.campaign._pieces import cores
from jaxslam.consistency.campaign._progress import Progress
from jaxslam.core._names import closest_name
from jaxslam.core._optional import loading
from jaxslam.core._table import Row, Table, text_of
from jaxslam.results._campaign_files import FORMATS, RESULT
from jaxslam.results._files import Files, check_writable, write_files
from jaxslam.verify._user_errors import describe_error

if TYPE_CHECKING:  # Matplotlib is slow to load
    from jaxslam.results.plot import Film

_T = TypeVar("_T")

FAILED = 1
"""Exit status where models or filters are wrong, runs are missing, or a figure cannot be drawn."""
INTERRUPTED = 130
"""Exit status after Ctrl-C."""

SUMMARY = "summary.json"
"""Name of the file with the summary of a command."""

COUNT = "measurements "
"""Prefix of the rows of a summary that count measurements by status."""

FILMS = ("film.gif", "film.mp4", "film.html", "film-*.gif", "film-*.mp4", "film-*.html")
"""Patterns of the names of films; films of an earlier command are deleted."""

OUT = Path("out")
"""Default folder of results."""


def pick(option: str, name: str, registry: Mapping[str, _T], hint: str = "") -> _T:
    """The entry of a registry under the name in an option, as `filters`.

    Raises ValueError with the names of the registry and the hint.
    """
    if name not in registry:
        unknown = f"unknown {option.removesuffix('s')} {name!r}{closest_name(name, registry)}"
        raise ValueError(f"--{option}: {unknown}; known: {', '.join(registry)}{hint}")
    return registry[name]


def as_folders(options: argparse.Namespace) -> None:
    """Convert the options that name folders to paths.

    Raises ValueError on an empty name, which `Path` takes for the current folder.
    """
    for name in ("out", "resume", "cache"):
        text = getattr(options, name, None)
        if text is None:
            continue
        if not text.strip():
            raise ValueError(f"--{name}: expected a folder, got {text!r}")
        setattr(options, name, Path(text))


def add_out(parser: argparse.ArgumentParser) -> None:
    """Add the option of the folder of results."""
    parser.add_argument(
        "--out",
        metavar="DIR",
        default=str(OUT),
        help=f"folder for results; earlier ones of the same command are replaced (default: {OUT})",
    )


def check_out(folder: Path, name: str, *, draws: bool = True) -> None:
    """Check before any work that a command, as "run", can write its results to a folder.

    Raises OSError if no file can be written, ValueError if no figure can be drawn or the folder
    holds the results of another command, since some files have the same names.
    """
    check_writable(folder)
    if draws:
        with loading("figures", "matplotlib"):
            from jaxslam.results.plot._style import check_font
        check_font()
    for file in (RESULT, SUMMARY):
        try:
            command = str(json.loads((folder / file).read_text(encoding="utf-8"))["command"])
        except (OSError, ValueError, LookupError, TypeError):
            continue
        if (earlier := " ".join(command.split()[:2])) not in ("", f"jaxslam {name}"):
            raise ValueError(
                f"--out: {folder} holds the results of {earlier}: choose another folder for those "
                f"of jaxslam {name}"
            )


Drawings: TypeAlias = dict[str, Callable[[], Files]]
"""Figures and films by name: functions that draw one, and return its files."""


def write_results(
    folder: Path, files: Files, drawings: Drawings, replaces: Sequence[str] = ()
) -> int:
    """Write the numbers, then draw and write each figure; returns the exit status.

    Prints the names of the files. A figure that fails is named in one line, with the status
    `FAILED`; nothing else is lost. Figures of an earlier command are deleted, as are files whose
    names match a pattern of `replaces`.
    """
    earlier = [f"{glob.escape(name)}.{kind}" for name in drawings for kind in FORMATS]
    written = write_files(folder, files, replaces=(*replaces, *earlier))
    status, failures = 0, []
    for name, draw in drawings.items():
        try:
            written += write_files(folder, draw())
        except KeyboardInterrupt:
            raise KeyboardInterrupt(f"wrote {', '.join(map(str, written))}") from None
        except Exception as error:
            failures.append(f"jaxslam: {name} was not drawn: {describe_error(error)}")
            status = FAILED
    if written:
        print("\nwrote " + ", ".join(map(str, written)))
    print(*failures, sep="\n", end="\n" * bool(failures), file=sys.stderr)
    return status


def add_dtype(parser: argparse.ArgumentParser, of: str = "") -> None:
    """Add the option of the floating-point type; `of` completes the help, as " of the filters"."""
    parser.add_argument(
        "--dtype",
        default="float64",
        choices=["float32", "float64"],
        help=f"floating-point type{of} (default: float64)",
    )


def add_figures(parser: argparse.ArgumentParser, formats: Collection[str], note: str = "") -> None:
    """Add the option of the formats of figures; the note follows the default in the help."""
    parser.add_argument(
        "--figures",
        metavar="FORMATS",
        default="png",
        help=f"formats of figures, of {', '.join(formats)}; comma-separated (default: png{note})",
    )


def summary_table(columns: Mapping[str, Mapping[str, object]]) -> str:
    """Summaries side by side, one row per entry; several have their names above them."""
    rows = []
    for key in dict.fromkeys(key for column in columns.values() for key in column):
        missing = 0 if key.startswith(COUNT) else "-"
        cells = [_cell_text(column.get(key, missing)) for column in columns.values()]
        rows.append(Row(key, cells))
    heads = ["", *columns] if len(columns) > 1 else []
    return text_of(Table(heads, rows), align="<")


def _cell_text(value: object) -> str:
    """A value of the summary as it is printed."""
    if isinstance(value, dict):
        return ", ".join(f"{count_label(key)} {count:,}" for key, count in value.items()) or "-"
    if isinstance(value, list):
        lines = all(isinstance(part, str) for part in value)
        return ("\n" if lines else "; ").join(_cell_text(part) for part in value) or "-"
    return f"{value:.6g}" if isinstance(value, float) else str(value) or "-"


def film_files(films: Mapping[str, "Film"], *, suffixed: bool) -> Files:
    """The functions that write each film as MP4, or GIF without ffmpeg, and as a page, by name.

    Prints one line: the number of steps shown, and the reason why there is no MP4.

    Args:
        films: by the name of the filter.
        suffixed: whether file names contain the name of the filter.
    """
    from jaxslam.results.plot._film import mp4_problem  # matplotlib is slow to load

    notes = dict.fromkeys(film.note for film in films.values() if film.note)
    problem = mp4_problem()
    kind = "gif" if problem else "mp4"
    if problem:
        notes[f"{problem}: GIF instead of MP4"] = None
    if notes:
        print("\nfilm: " + "; ".join(notes))
    files: Files = {}
    for name, film in films.items():
        stem = f"film-{name}" if suffixed else "film"
        files |= {f"{stem}.{kind}": _with_progress(film, name), f"{stem}.html": film.save}
    return files


def _with_progress(film: "Film", name: str) -> Callable[[Path], object]:
    """The function that saves a film with a progress bar over its frames."""

    def save(path: Path) -> None:
        with Progress(f"{name}: film", "frames") as progress:
            film.save(path, progress_callback=lambda k, of: progress(k + 1, of))

    return save


def add_animate(parser: argparse.ArgumentParser, of: str) -> None:
    """Add the option of films."""
    parser.add_argument(
        "--animate",
        action="store_true",
        help=f"also write a film {of}: film.html to step and play, and film.mp4, or film.gif where "
        "ffmpeg is missing",
    )


def set_device_count(devices: str) -> None:
    """Set the number of CPU devices, before JAX first uses them; by default one per core.

    At most the number of cores; `chosen_devices` then refuses a larger request.
    """
    if devices in ("all", "cpu"):
        count = cores()
    elif devices.isdecimal():
        count = int(devices)
    else:
        return
    if count < 1:
        raise ValueError(f"--devices: expected at least 1, got {devices}")
    with contextlib.suppress(RuntimeError):  # JAX is already in use, as in a notebook
        jax.config.update("jax_num_cpu_devices", min(count, cores()))


def chosen_devices(devices: str, most: int | None = None) -> list[jax.Device]:
    """The devices of this process for the option `--devices`: all, a number, or a platform.

    most: largest number for "all".
    """
    if devices == "all":
        return list(jax.local_devices()[:most])
    if devices.isdecimal():
        local = jax.local_devices()
        if int(devices) > len(local):
            kind = "CPU cores" if local[0].platform == "cpu" else local[0].platform
            raise ValueError(
                f"--devices: expected at most {len(local)}, the number of devices here ({kind}), "
                f"got {devices}"
            )
        return list(local[: int(devices)])
    try:
        return list(jax.local_devices(backend=devices))
    except RuntimeError as error:
        platforms = sorted({device.platform for device in jax.local_devices()} | {"cpu"})
        raise ValueError(
            f"--devices: expected all, a number, or one of {', '.join(platforms)}, got {devices!r}"
        ) from error


_COMPILATION = (
    "/jax/core/compile/jaxpr_trace_duration",
    "/jax/core/compile/jaxpr_to_mlir_module_duration",
    "/jax/core/compile/backend_compile_duration",
)
"""Events of JAX with a duration: tracing, lowering and compilation of a program, in that order."""


class CompileClock:
    """A context manager that measures wall time and compilation time, and counts programs.

    A program is traced, lowered, and compiled or loaded from the cache. Several threads compile at
    once while compiled programs run; `compiling` is the time during which at least one of them
    compiled.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._spans: list[tuple[float, float]] = []
        self.programs = 0
        """number of programs compiled or loaded from the cache"""
        self.cached = 0
        """number of programs loaded from the cache"""

    def __enter__(self) -> "CompileClock":
        self._began = time.perf_counter()
        jax.monitoring.register_event_duration_secs_listener(self._record_span)
        jax.monitoring.register_event_listener(self._count_hit)
        return self

    def __exit__(self, *_: object) -> None:
        jax.monitoring.unregister_event_duration_listener(self._record_span)
        jax.monitoring.unregister_event_listener(self._count_hit)

    @property
    def seconds(self) -> float:
        """Wall time since the block was entered [s]."""
        return time.perf_counter() - self._began

    @property
    def compiling(self) -> float:
        """Wall time during which a program was traced, lowered or compiled [s]."""
        # The length of the union of the spans: `until` is the end of what has been counted.
        total, until = 0.0, self._began
        with self._lock:
            spans = sorted(self._spans)
        for begin, end in spans:
            total += max(end - max(begin, until), 0.0)
            until = max(until, end)
        return total

    def __str__(self) -> str:
        programs = f"{self.programs} programs" if self.programs != 1 else "1 program"
        return (
            f"{self.seconds:.1f} s in all, {self.compiling:.1f} s of them to compile or load "
            f"{programs}: {self.programs - self.cached} compiled, "
            f"{self.cached} loaded from the cache"
        )

    def _record_span(self, event: str, duration_secs: float, **_: str | int) -> None:
        if event in _COMPILATION:
            now = time.perf_counter()
            with self._lock:
                self._spans.append((now - duration_secs, now))
                # JAX reports a cached program as compiled, too.
                self.programs += event == _COMPILATION[-1]

    def _count_hit(self, event: str, **_: str | int) -> None:
        if event == "/jax/compilation_cache/cache_hits":
            with self._lock:
                self.cached += 1
