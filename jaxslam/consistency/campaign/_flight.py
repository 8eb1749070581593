"""The blocks of a campaign that are being computed, in threads or on the workers of an executor."""

import contextlib
import time
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Future, wait
from dataclasses import dataclass, field
from typing import Any

import jax

from jaxslam.consistency.campaign._block import BlockResult
from jaxslam.consistency.campaign._result import Incomplete

Piece = tuple[int, int]
"""(first, runs) of a block"""

TRIES = 3
"""Largest number of times that a block is computed on an executor."""

_LATE = 60.0
"""A block is late after this time [s], and after ten times the longest of those before it."""


def out_of_memory(error: BaseException) -> bool:
    """Whether an error says that a block needs more memory than there is."""
    exhausted = isinstance(error, jax.errors.JaxRuntimeError) and "RESOURCE_EXHAUSTED" in str(error)
    return exhausted or isinstance(error, MemoryError)


def _fails_everywhere(error: BaseException) -> bool:
    """Whether an error is of the code that is run, so that every worker would raise it."""
    return isinstance(error, ValueError | TypeError | ImportError) or out_of_memory(error)


def _one_line(error: BaseException) -> str:
    """An error in one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())


@dataclass
class _Block:
    futures: list[tuple[Any, float]] = field(default_factory=list)
    """futures in flight, with the time when each began"""
    tries: int = 0


@dataclass
class Flight:
    """The blocks in flight."""

    submit: Callable[[int, int], Any]
    """function (first, runs) -> future of that block"""
    tries: int = 1
    """largest number of times that a block is begun, where it fails or is late"""
    _blocks: dict[Piece, _Block] = field(default_factory=dict)
    _longest: float = 0.0
    """time from the beginning of a block to its end"""
    _ends: bool = False

    def __len__(self) -> int:
        return len(self._blocks)

    def start(self, piece: Piece) -> None:
        """Begin a block, or begin it once more.

        Raises Incomplete if the executor takes no more.
        """
        try:
            future = self.submit(*piece)
        except Exception as error:
            raise self._final_error(error) from error
        block = self._blocks.setdefault(piece, _Block())
        block.futures.append((future, time.monotonic()))
        block.tries += 1

    def cancel(self) -> None:
        """Cancel the blocks that have not begun, and begin none once more."""
        self._ends = True
        for block in self._blocks.values():
            for future, _ in block.futures:
                with contextlib.suppress(AttributeError):  # not every engine has it
                    future.cancel()

    def collect(self) -> Iterator[tuple[Piece, BlockResult | BaseException]]:
        """The results of the blocks that have ended since, or the error of one that failed.

        Waits until a block ends, for a second at most.
        """
        self._wait()
        for piece, block in list(self._blocks.items()):
            result = self._result(block)
            if isinstance(result, BaseException):
                if self._restart(piece, block, result):
                    continue
                result = self._final_error(result)
            if result is not None:
                del self._blocks[piece]
                yield piece, result

    def _final_error(self, error: BaseException) -> BaseException:
        """The error of a block that is not computed again; `Incomplete` for one of an executor."""
        if self.tries == 1 or not isinstance(error, Exception) or _fails_everywhere(error):
            return error
        broken = isinstance(error, BrokenExecutor) and self._longest == 0
        hint = "; does the script begin under `if __name__ == '__main__':`?" * broken
        incomplete = Incomplete(f"{_one_line(error)}{hint}")
        incomplete.__cause__ = error
        return incomplete

    def _wait(self) -> None:
        futures = [future for block in self._blocks.values() for future, _ in block.futures]
        if all(isinstance(future, Future) for future in futures):
            wait(futures, 1.0, FIRST_COMPLETED)
        elif not any(future.done() for future in futures):
            time.sleep(0.1)

    def _result(self, block: _Block) -> BlockResult | BaseException | None:
        """The result of a block, its error once no future is left, or None."""
        error: BaseException | None = None
        for future, began in [pair for pair in block.futures if pair[0].done()]:
            block.futures.remove((future, began))
            try:
                error = future.exception()
            except CancelledError as cancelled:
                error = cancelled
            if error is None:
                self._longest = max(self._longest, time.monotonic() - began)
                result: BlockResult = future.result()
                return result
        if not block.futures:
            return error
        late = max(_LATE, 10 * self._longest)
        # Before the first result the workers compile, which takes as long as it takes.
        has_limit = self.tries > 1 and self._longest > 0
        if has_limit and time.monotonic() - block.futures[-1][1] > late:
            return TimeoutError(f"no result after {late:.0f} s")
        return None

    def _restart(self, piece: Piece, block: _Block, error: BaseException) -> bool:
        """Begin a block again, with a warning, unless that is in vain; whether it was begun."""
        in_vain = self._ends or block.tries >= self.tries
        if in_vain or not isinstance(error, Exception) or _fails_everywhere(error):
            return False
        try:
            self.start(piece)
        except Exception:  # an executor that has been given up
            return False
        warnings.warn(
            f"monte_carlo: runs {piece[0]} to {sum(piece) - 1} are computed once more "
            f"({_one_line(error)})",
            stacklevel=2,
        )
        return True
