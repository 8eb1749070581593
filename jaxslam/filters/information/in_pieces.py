"""A filter that takes a scan in pieces, for filters with room for few measurements at once."""

import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from jaxslam.core.record import record, static
from jaxslam.protocols import Filter, Wrapper
from jaxslam.types import Info, Scan


@record
class InPieces(Wrapper):
    """A filter applied in turn to pieces of a scan, each of `size` measurement slots.

    Slot i is in piece i mod their number. Numbers that an `Info` has for a whole scan are summed
    over the pieces, and flags are true where one of a piece is.
    """

    filter: Filter
    size: int = static()

    @property
    def name(self) -> str:  # type: ignore[override]
        return self.filter.name

    def update(self, state: PyTree, scan: Scan, key: jax.Array) -> tuple[PyTree, Info]:
        m, size = scan.tag.shape[0], self.size
        if m <= size:
            return self.filter.update(state, scan, key)
        pieces = -(-m // size)

        def dealt(leaf: jax.Array) -> jax.Array:
            wide = jnp.pad(leaf, [(0, pieces * size - m), *[(0, 0)] * (leaf.ndim - 1)])
            return wide.reshape(size, pieces, *leaf.shape[1:]).swapaxes(0, 1)

        def one(state: PyTree, piece: tuple[Scan, jax.Array]) -> tuple[PyTree, Info]:
            return self.filter.update(state, *piece)

        each = jax.tree.map(dealt, scan), jax.random.split(key, pieces)
        state, infos = jax.lax.scan(one, state, each)

        def whole(leaf: jax.Array) -> jax.Array:
            if leaf.ndim == 1:  # of a scan, not of its measurement slots
                return leaf.any() if leaf.dtype == bool else leaf.sum()
            return leaf.swapaxes(0, 1).reshape(size * pieces, *leaf.shape[2:])[:m]

        info: Info = jax.tree.map(whole, infos)
        return state, info
