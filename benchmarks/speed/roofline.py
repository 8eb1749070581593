"""What this core can do at most, measured, and what a workload asks of it, counted."""

import jax
import jax.numpy as jnp

from benchmarks.speed.timing import best


def ceilings(dtype) -> tuple[float, float]:
    """Peak multiply-adds in flop/s, and bytes/s to and from memory, of what XLA makes for one core.

    Peak: x ← a x + b over a vector that stays in the first cache, eight times a pass.
    """
    small, large = jnp.ones(1024, dtype), jnp.ones(2**24, dtype)

    @jax.jit
    def chew(x):
        def body(_, parts):
            for _ in range(8):
                parts = [part * 0.999 + 0.001 for part in parts]
            return parts

        return jax.lax.fori_loop(0, 4000, body, [x, x + 1, x + 2, x + 3])

    @jax.jit
    def stream(x, y):
        return 0.5 * x + y

    jax.block_until_ready(chew(small))
    peak = 4000 * 8 * 4 * 2 * small.size / best(lambda: jax.block_until_ready(chew(small)))
    jax.block_until_ready(stream(large, large))
    seconds = best(lambda: jax.block_until_ready(stream(large, large)))
    return peak, 3 * large.nbytes / seconds


def corrections(landmarks: int, steps: int, group: int = 3) -> tuple[int, float, float]:
    """Of `cloister` a run: rank-2 corrections, their flops, and bytes of P read and written.

    One landmark enters a step and all of the map are measured, so step t corrects min(t, N).
    """
    size = 3 + 2 * landmarks
    seen = [min(step, landmarks) for step in range(steps)]
    passes = sum(-(-count // group) for count in seen)
    return sum(seen), sum(seen) * 4.0 * size**2, passes * 2.0 * size**2
