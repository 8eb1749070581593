"""How the processes of a campaign divide the runs, and gather each other's tallies."""

from collections.abc import Sequence

import jax
import numpy as np
from jax.experimental import multihost_utils

from jaxslam.consistency import Tally


def share(pieces: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    """This process's part of the pieces, which must be the same in every process.

    Raises ValueError where they are not: blocks were kept where only some processes see them.
    """
    count = jax.process_count()
    if count > 1 and len(set(_everyones(repr(list(pieces)).encode()))) > 1:
        raise ValueError(
            "monte_carlo: the processes see different blocks: expected keep in a folder that all "
            "of them share"
        )
    return list(pieces[jax.process_index() :: count])


def gathered_tallies(tallies: dict[str, Tally]) -> dict[str, Tally]:
    """The tallies with what every process has in its own; each gets the same."""
    if jax.process_count() == 1:
        return tallies
    out = {}
    for name, tally in tallies.items():
        out[name] = Tally()
        for content in _everyones(tally.packed()):
            out[name].merge(Tally.unpack(content))
    return out


def _everyones(content: bytes) -> list[bytes]:
    """The content of each process, in their order; of any length."""
    sizes = multihost_utils.process_allgather(np.asarray(len(content)))
    wide = np.zeros(int(sizes.max()), np.uint8)
    wide[: len(content)] = np.frombuffer(content, np.uint8)
    rows = multihost_utils.process_allgather(wide)
    return [bytes(row[:size]) for row, size in zip(rows, sizes, strict=True)]
