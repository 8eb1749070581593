"""Runs a program once for each run of a folder of draws, several at once."""

import contextlib
import hashlib
import os
import re
import shlex
import shutil
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from pathlib import Path

from jaxslam.consistency.campaign._progress import Progress
from jaxslam.consistency.campaign._run_estimates import RunFault
from jaxslam.datasets._judged_folders import (
    PROGRAM,
    RUNS,
    TRAJECTORY,
    DrawsFolder,
    origin_of,
    run_name,
)
from jaxslam.datasets._lines import stored_file
from jaxslam.results._files import check_writable, json_text

PLACES = ("{run}", "{estimate}")
"""What a command has for the folder of a run, and for the folder of its estimate."""

_SHOWN = 2000
"""Characters that are shown of what a program wrote, the last ones."""


class Programs:
    """A program that is started once for each run of a folder of draws.

    What it writes for a run appears in the folder of estimates, as 0007, when the program has ended
    with status 0: so a folder there is complete, and is not computed again. It notes the command,
    the contents of the files that the command names, and those of the run.
    """

    def __init__(
        self, command: str, draws: DrawsFolder, estimates: Path, limit: float | None
    ) -> None:
        self._command, self._draws, self._estimates = command, draws, estimates
        self._limit = limit
        try:
            self._words = shlex.split(command)
        except ValueError as error:
            raise ValueError(f"--estimator: {command!r}: {error}") from error
        for place in PLACES:
            if not any(place in word for word in self._words):
                raise ValueError(
                    f"--estimator: expected a command with {PLACES[0]} and {PLACES[1]}, as "
                    f"'./my_filter {{run}} {{estimate}}', got {command!r}"
                )
        if shutil.which(self._words[0]) is None:
            raise ValueError(f"--estimator: {self._words[0]}: there is no such program")
        # The SHA-256 of each file that the command names, as its program or a script of it.
        self._files = {}
        paths = {word: word for word in self._words[1:]}
        for word, path in {self._words[0]: shutil.which(self._words[0]) or "", **paths}.items():
            if Path(path).is_file():
                with open(path, "rb") as file:
                    self._files[word] = hashlib.file_digest(file, "sha256").hexdigest()
        self._running: set[subprocess.Popen[bytes]] = set()
        self._lock = threading.Lock()
        self._stops = False

    def run(self, numbers: Sequence[int], workers: int) -> dict[int, RunFault]:
        """Compute the missing estimates of some runs; why there is none of the others, by number.

        Raises ValueError where the folder holds estimates of another command, of a program that
        has changed since, or of other draws, or the program cannot be started, and
        KeyboardInterrupt on Ctrl-C, with what is finished in place.
        """
        check_writable(self._estimates)
        missing = [number for number in numbers if not self._is_finished(number)]
        self._estimates.mkdir(parents=True, exist_ok=True)
        for stale in self._estimates.glob(".unfinished-*"):
            shutil.rmtree(stale, ignore_errors=True)
        faults: dict[int, RunFault] = {}
        pool = ThreadPoolExecutor(workers)
        futures: dict[Future[RunFault | None], int] = {}
        try:
            futures = {pool.submit(self._run_once, number): number for number in missing}
            with Progress(Path(self._words[0]).name) as progress:
                for finished, future in enumerate(as_completed(futures), 1):
                    if (fault := future.result()) is not None:
                        faults[futures[future]] = fault
                    progress(finished, len(missing))
        except BaseException as stop:
            self._stop()
            if isinstance(stop, KeyboardInterrupt):
                pool.shutdown(cancel_futures=True)
                finished = sum(map(self._is_finished, numbers))
                raise KeyboardInterrupt(
                    f"{self._estimates} has {finished:,} of {len(numbers):,} runs; the same "
                    "command goes on"
                ) from None
            raise
        finally:
            pool.shutdown(cancel_futures=True)
        return dict(sorted(faults.items()))

    def _is_finished(self, number: int) -> bool:
        folder = self._estimates / run_name(number)
        if not folder.exists():
            return False
        origin = origin_of(folder)
        files = origin.get("files")
        earlier = files if isinstance(files, dict) else {}
        changed = [name for name, digest in self._files.items() if earlier.get(name) != digest]
        if (command := origin.get("command")) != self._command:
            of = "no command" if command is None else f"the command {command!r}"
        elif changed:
            of = f"another {', '.join(changed)}, which changed since"
        elif origin.get("log") != self._draws.log_checksum(folder.name):
            of = f"other draws than {self._draws.path}"
        else:
            return True
        raise ValueError(
            f"--estimator: {folder} holds an estimate of {of}: choose another folder of "
            "estimates, or remove this one"
        )

    def _run_once(self, number: int) -> RunFault | None:
        """Run the program for one run; why there is no estimate, if there is none."""
        name = run_name(number)
        with tempfile.TemporaryDirectory(dir=self._estimates, prefix=".unfinished-") as hidden:
            estimate, said = Path(hidden).absolute() / name, Path(hidden) / "said"
            estimate.mkdir()
            folders = (self._draws.path / RUNS / name).absolute(), estimate
            place = dict(zip(PLACES, map(str, folders), strict=True))
            pattern = "|".join(map(re.escape, PLACES))
            words = [re.sub(pattern, lambda m: place[m[0]], word) for word in self._words]
            began = time.perf_counter()
            with said.open("wb") as file, self._start(words, file.fileno()) as process:
                try:
                    status = process.wait(self._limit)
                except subprocess.TimeoutExpired:
                    status = None
                    _kill(process)
            seconds = time.perf_counter() - began
            with said.open("rb") as end:  # a character has at most 4 bytes
                end.seek(max(said.stat().st_size - 4 * _SHOWN, 0))
                text = end.read().decode("utf-8", "replace").strip()[-_SHOWN:]
            if status is None:
                assert self._limit is not None
                return RunFault(f"over the time limit of {self._limit:g} s", "", text)
            if status != 0:
                how = f"exit status {status}" if status > 0 else f"killed by signal {-status}"
                return RunFault(how, text.splitlines()[-1] if text else "", text)
            if stored_file(estimate / TRAJECTORY) is None:
                return RunFault(f"wrote no {TRAJECTORY}", "exit status 0", text)
            note = {
                "command": self._command,
                "files": self._files,
                "log": self._draws.log_checksum(name),
                "seconds": seconds,
            }
            (estimate / PROGRAM).write_text(json_text(note), encoding="utf-8")
            os.replace(estimate, self._estimates / name)
        return None

    @contextlib.contextmanager
    def _start(self, words: Sequence[str], said: int) -> Iterator[subprocess.Popen[bytes]]:
        """A program that writes to the file `said`; it has ended when the context is left."""
        with self._lock:  # none is started once all are stopped
            if self._stops:
                raise KeyboardInterrupt
            try:
                process = subprocess.Popen(
                    words,
                    stdin=subprocess.DEVNULL,
                    stdout=said,
                    stderr=said,
                    start_new_session=True,  # so that its children are killed with it
                )
            except OSError as error:
                reason = error.strerror or str(error)
                raise ValueError(f"--estimator: {words[0]} cannot be run: {reason}") from error
            self._running.add(process)
        try:
            yield process
        finally:
            _kill(process)
            process.wait()
            with self._lock:
                self._running.discard(process)

    def _stop(self) -> None:
        with self._lock:
            self._stops = True
            for process in self._running:
                _kill(process)


def _kill(process: "subprocess.Popen[bytes]") -> None:
    """Kill a program that runs, and what it has started."""
    if process.poll() is None:
        with contextlib.suppress(OSError):
            if hasattr(os, "killpg"):
                os.killpg(process.pid, signal.SIGKILL)
            else:
                process.kill()
