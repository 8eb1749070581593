"""Control of XLA: what to compute once, what to skip for a whole batch, compiler options."""

import functools
from collections.abc import Callable
from typing import TypeVar, cast

import jax
import jax.numpy as jnp
from jax.experimental.xla_metadata import set_xla_metadata
from jaxtyping import Array, Bool, Int, PyTree

CACHED = 128
"""Up to this many rows P stays in the cache next to a core, and a pass over it is cheap."""

_T = TypeVar("_T")
_U = TypeVar("_U")
_F = TypeVar("_F", bound=Callable[..., PyTree])


def traced_once(function: _F) -> _F:
    """The function, traced once for the shapes of its arguments and not at each call.

    For functions of arrays alone that a filter calls often. XLA inlines them.
    """
    return cast(_F, jax.jit(function))


def no_inline(function: Callable[..., _T], *arguments: PyTree) -> _T:
    """The result of function(*arguments), compiled as a computation that XLA does not inline.

    XLA on CPU fuses a cheap producer into each of its consumers and computes it again there: a gain
    of D entries would be computed again for each of the D² entries of the covariance it updates. It
    does not fuse across a call that may not be inlined. (An `optimization_barrier` is removed
    before fusion.)
    """

    @functools.wraps(function)
    def body(*arguments: PyTree) -> _T:
        with set_xla_metadata(inlineable="true"):  # functions that it calls
            return function(*arguments)

    with set_xla_metadata(inlineable="false"):
        return cast(_T, jax.jit(body)(*arguments))


def one_kernel(function: Callable[..., _T], *arguments: PyTree) -> _T:
    """The result of function(*arguments), on a CPU compiled as one kernel, its loops included.

    For loops whose iterations do little: elsewhere XLA on CPU drives a `while` from outside the
    compiled code, with one kernel for its condition and one for each fusion of its body, and
    launching these took seven times as long as a step of 32 rays. The call carries the mark that
    XLA gives to loops it finds small (`SmallWhileLoopHoistingPass`); jaxlib 0.12 finds the loop of
    the rays small, 0.8 to 0.11 do not.

    The kernel runs in one thread. The function must use each argument and must not sort, scatter or
    call a library (LAPACK, FFT): XLA cannot compile that in one kernel, and may abort the process.
    """
    if jax.default_backend() != "cpu":
        return function(*jax.tree.map(jnp.asarray, arguments))

    @functools.wraps(function)
    def body(*arguments: PyTree) -> _T:
        with set_xla_metadata(inlineable="true", xla_cpu_small_call="false"):  # functions it calls
            return function(*arguments)

    # A constant would be moved into the function, and leave an argument that is not used.
    arguments = jax.lax.optimization_barrier(arguments)
    with set_xla_metadata(inlineable="false", xla_cpu_small_call="true"):
        return cast(_T, jax.jit(body)(*arguments))


def quick_options(platform: str) -> dict[str, int] | None:
    """Compiler options that shorten the compilation of loop-free programs; None if there are none.

    For programs that run only once, or spend their time in long passes over arrays and not in loops
    over small ones. On a CPU they are compiled without most of LLVM's optimizations.
    """
    return {"xla_backend_optimization_level": 1} if platform == "cpu" else None


def hot_options(platform: str) -> dict[str, int] | None:
    """Compiler options that speed up long-running programs; None if there are none.

    By default XLA vectorizes CPU code for 256 bits. Where the processor has AVX-512, 512 bits made
    32 runs of EKF-SLAM 1.1 times as fast in float64 and float32.
    """
    return _wide_vectors() if platform == "cpu" else None


@functools.cache
def _wide_vectors() -> dict[str, int] | None:
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            flags = next((line for line in file if line.startswith("flags")), "")
    except OSError:  # not Linux
        return None
    if "avx512f" not in flags.split():
        return None
    options: dict[str, int] = {"xla_cpu_prefer_vector_width": 512}
    try:
        jax.jit(lambda: 0).lower().compile(options)
    except jax.errors.JaxRuntimeError as error:
        if "No such compile option" not in str(error):
            raise
        return None
    return options


def quick_jit(function: Callable[..., _T]) -> Callable[..., _T]:
    """The jitted function, for a program that runs only once; see `quick_options`."""
    options = quick_options(jax.default_backend())
    return cast(Callable[..., _T], jax.jit(function, compiler_options=options))


def materialize(values: _T) -> _T:
    """The arrays, computed once and stored; for large ones, `no_inline` avoids a copy."""
    return cast(_T, no_inline(jax.lax.optimization_barrier, values))


@jax.custom_batching.custom_vmap
def anywhere(flag: jax.Array) -> jax.Array:
    """Whether the flag () is set in any run of the batch under `vmap`; not batched itself.

    Under `vmap` a `lax.cond` with a separate predicate for each run becomes a `select`, and both
    branches are computed. One predicate for the whole batch stays a branch.
    """
    return flag


@anywhere.def_vmap
def _over_batch(_: int, batched: PyTree, flag: jax.Array) -> tuple[jax.Array, bool]:
    return anywhere(flag.any(axis=0)), False


def where_any(
    flag: jax.Array, work: Callable[[_T], _U], otherwise: Callable[[_T], _U], state: _T
) -> _U:
    """The result of work(state) if the flag is set in any run of a batch, else otherwise(state).

    For a run whose flag is not set, both must give the same numbers.
    """
    return cast(_U, jax.lax.cond(anywhere(flag), work, otherwise, state))


def change_where(flag: jax.Array, change: Callable[[_T], _T], state: _T) -> _T:
    """The state changed by change(state) in a run whose flag () is set, else the same state.

    Computed only where the flag is set in any run of the batch.
    """

    def change_flagged(state: _T) -> _T:
        return cast(_T, jax.tree.map(lambda a, b: jnp.where(flag, a, b), change(state), state))

    return where_any(flag, change_flagged, lambda state: state, state)


def scan_in_groups(
    work: Callable[..., tuple[_T, _U]],
    skip: Callable[[], _U],
    state: _T,
    rows: tuple[Array, ...],
    size: int,
) -> tuple[_T, _U]:
    """The state after work(state, *group) on each group of `size` rows in turn, and all results.

    rows: arrays (m, …), of which the last is a mask; the last group is padded with zeros. Results
    have a leading axis (size,), those returned (m,). In a group without a set row of the mask in
    any run of a batch, the state stays and the result is skip(), which costs nothing; for a run
    without one, both must give the same numbers.
    """
    m = len(rows[-1])
    groups = -(-m // size)  # ⌈m/size⌉

    def pad(values: Array) -> Array:
        """The values in groups, (⌈m/size⌉, size, …)."""
        padded = jnp.pad(values, [(0, groups * size - m), *[(0, 0)] * (values.ndim - 1)])
        return padded.reshape(groups, size, *values.shape[1:])

    def step(state: _T, group: tuple[Array, ...]) -> tuple[_T, _U]:
        mask, skipped = group[-1], skip()
        return where_any(mask.any(), lambda s: work(s, *group), lambda s: (s, skipped), state)

    state, results = jax.lax.scan(step, state, tuple(pad(values) for values in rows))

    def join(values: Array) -> Array:
        return values.reshape(groups * size, *values.shape[2:])[:m]

    return state, cast(_U, jax.tree.map(join, results))


def hot_jit(
    function: Callable[..., _T], *, static_argnames: tuple[str, ...] = ()
) -> Callable[..., _T]:
    """The jitted function, for long passes over arrays called from the host; see `hot_options`.

    JAX takes options only for a whole program, so within a trace it is a plain jitted function.
    """
    within = jax.jit(function, static_argnames=static_argnames, inline=True)

    @functools.cache  # at the first call, since to ask for the backend starts it
    def compile_alone() -> Callable[..., _T]:
        options = hot_options(jax.default_backend())
        compiled = jax.jit(function, static_argnames=static_argnames, compiler_options=options)
        return cast(Callable[..., _T], compiled)

    @functools.wraps(function)
    def call(*arguments: PyTree) -> _T:
        # A new array is a tracer where a trace is active, also where all arguments are constants.
        leaves = jax.tree.leaves((jnp.asarray(0.0), arguments))
        traced = any(isinstance(leaf, jax.core.Tracer) for leaf in leaves)
        return cast(_T, (within if traced else compile_alone())(*arguments))

    return call


def last_true_column(match: Bool[Array, "M N"]) -> tuple[Int[Array, "M"], Bool[Array, "M"]]:
    """The last column (M,) int32 in which each row (M, N) bool is set, 0 without one, and a mask of
    the rows with one (M,). One pass, instead of two by `argmax` and `any`.
    """
    # Over the leading axis XLA takes maxima of whole rows.
    at = jnp.where(match.T, jnp.arange(match.shape[1], dtype=jnp.int32)[:, None], -1)
    at = at.max(axis=0, initial=-1)
    return jnp.maximum(at, 0), at >= 0
