"""Comparison of Jacobians by several methods: the wrong entries, and the wrong method."""

from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float

from jaxslam.verify._differences import Quotient
from jaxslam.verify._findings import Finding, WorstState, WrongEntry
from jaxslam.verify._inputs.samples import LARGE, NOMINAL, Samples
from jaxslam.verify._jacobians import Evaluated, Jacobians

Values: TypeAlias = Float[np.ndarray, "_ _ _"]
"""Jacobians (S, m, n)."""

_DIFFERENCES_TOLERANCE = 1e-6
"""relative tolerance of the quotients, beyond ten times their estimated error"""
_CONVERGED = 1e-3
"""largest relative error of a quotient that counts as converged"""
_NOTHING = 1e-9
"""absolute error at which it counts as converged in any case: a row may be zero everywhere"""


def compare_methods(
    evaluated: Evaluated, tolerance: float, float32_tolerance: float
) -> list[Finding]:
    """A finding for each argument: the methods compared entry by entry.

    States at which the function has no finite value are left out; another check reports them.
    A Jacobian without entries, as by a landmark of no numbers, has no finding.
    """
    if evaluated.values is None:
        return []
    rows = np.flatnonzero(np.all(np.isfinite(evaluated.values), axis=1))

    def kept(methods: dict[str, Values]) -> dict[str, Values]:
        return {how: jacobian[rows] for how, jacobian in methods.items()}

    by_argument = tuple(
        Jacobians(
            kept(e.methods),
            kept(e.single),
            e.single_error[rows] if e.single_error.ndim else e.single_error,
            Quotient(*(part[rows] for part in e.quotient)),
        )
        for e in evaluated.by_argument
    )
    values, labels = evaluated.samples
    samples = Samples(tuple(value[rows] for value in values), tuple(labels[i] for i in rows))
    evaluated = evaluated._replace(samples=samples, by_argument=by_argument)
    return [
        _finding(evaluated, k, tolerance, float32_tolerance)
        for k, evaluation in enumerate(evaluated.by_argument)
        if evaluated.claim.outputs and evaluated.claim.arguments[k].entries
        if evaluation.methods
    ]


class _Compared(NamedTuple):
    """Differences between the methods at every entry of a Jacobian."""

    gap: Values
    """largest difference among jacfwd, jacrev and hand in float64"""
    relative: Values
    """the gap over `scale`, as it is compared with the tolerance"""
    relative32: Values
    """the relative gap in float32"""
    from_quotient: Values
    """the relative distance from the quotients, where they converge"""
    scale: Float[np.ndarray, "S m 1"]
    """the size of the row"""
    excess: Values
    """the largest of the three over its tolerance; above 1 the entry is wrong"""
    in_float32: Bool[np.ndarray, "S m n"]
    """mask of the entries where float32 exceeds its tolerance most"""
    no_derivative: int
    """number of states at which the quotients do not converge"""


def _compare(evaluation: Jacobians, tolerance: float, float32_tolerance: float) -> _Compared:
    """The differences between the methods, relative to their tolerances."""
    gap, scale = _largest_gap(evaluation.methods)
    # Without float32 float64 takes its place, which is held to a smaller tolerance anyway.
    single = evaluation.single or evaluation.methods
    gap32, scale32 = _largest_gap(single)
    value, error, kink = evaluation.quotient
    away = np.abs(np.stack(list(evaluation.methods.values())) - value).max(axis=0)
    magnitude = np.abs(value).max(axis=2, keepdims=True, initial=0.0)
    trusted = ((error <= _CONVERGED * magnitude) | (error <= _NOTHING)) & ~kink
    away = np.where(trusted, np.where(np.isfinite(away), away, np.inf), 0.0)
    # At a kink any value between the one-sided derivatives is accepted. Elsewhere, if the quotients
    # do not converge, the result of autodiff may depend on rounding; where its two modes differ,
    # the entries are not compared.
    odd = ~trusted.all(axis=(1, 2), keepdims=True)
    lost = int(odd.sum())
    for g, methods, size, limit in (
        (gap, evaluation.methods, scale, tolerance),
        (gap32, single, scale32, float32_tolerance),
    ):
        g[kink | (odd & _modes_differ(methods, size, limit))] = 0.0
    nothing_compared = bool(gap.size) and lost == len(gap)  # so nothing passes
    # Cancellation rounds by more than the size suggests: in float64 by 2⁻²⁹ of float32's error, and
    # in float32 the hand-derived Jacobian need not be more accurate than autodiff.
    relative = _beyond(gap, 2.0**-28 * evaluation.single_error, scale, tolerance)
    relative32 = _beyond(gap32, 2 * evaluation.single_error, scale32, float32_tolerance)
    from_quotient = _beyond(away, 10 * error, scale, _DIFFERENCES_TOLERANCE)
    in_double = np.maximum(relative / tolerance, from_quotient / _DIFFERENCES_TOLERANCE)
    in_double = np.where(nothing_compared, np.inf, in_double)
    in_single = relative32 / float32_tolerance
    return _Compared(
        gap,
        relative,
        relative32,
        from_quotient,
        scale,
        np.maximum(in_double, in_single),
        in_single > in_double,
        lost,
    )


def _beyond(gap: Values, rounding: np.ndarray, scale: np.ndarray, tolerance: float) -> Values:
    """The relative difference, or the rest beyond rounding where that is within the tolerance."""
    relative = _relative(gap, scale)
    with np.errstate(invalid="ignore"):  # ∞ - ∞
        rest = _relative(np.where(np.isinf(gap), gap, np.maximum(gap - rounding, 0.0)), scale)
    return np.where((relative > tolerance) & (rest <= tolerance), rest, relative)


def _finding(evaluated: Evaluated, k: int, tolerance: float, float32_tolerance: float) -> Finding:
    claim, samples = evaluated.claim, evaluated.samples
    evaluation, argument = evaluated.by_argument[k], claim.arguments[k]
    compared = _compare(evaluation, tolerance, float32_tolerance)
    wrong = compared.excess > 1
    often = wrong.sum(axis=0)
    far = np.array([label == LARGE for label in samples.labels])

    def entry(s: int, i: int, j: int) -> WrongEntry:
        in_single = bool(compared.in_float32[s, i, j])
        shown = evaluation.single if in_single else evaluation.methods
        values = {how: float(m[s, i, j]) for how, m in shown.items()}
        size = float(compared.scale[s, i, 0])
        room = (float32_tolerance if in_single else tolerance) * size
        values["differences"] = float(evaluation.quotient.value[s, i, j])
        error = float(evaluation.quotient.error[s, i, j])
        near = room + _DIFFERENCES_TOLERANCE * size + 10 * error
        return WrongEntry(
            row=claim.outputs[i],
            column=argument.entries[j],
            states=int(often[i, j]),
            precision="float32" if in_single else "float64",
            label=samples.labels[s],
            state=_state(evaluated, s),
            values=values,
            dissent=_dissent(values, room, near),
            far_alone=bool(far[wrong[:, i, j]].all()),
        )

    nominal = np.array([label in NOMINAL for label in samples.labels])
    entries = []
    for i, j in np.argwhere(often):
        # Shown at the worst state, preferably a random or given one.
        usual = wrong[:, i, j] & nominal
        excess = np.where(usual if usual.any() else wrong[:, i, j], compared.excess[:, i, j], -1)
        entries.append(entry(int(np.argmax(excess)), int(i), int(j)))
    entries.sort(key=lambda e: -e.states)
    # Without a finite derivative by any method, their differences mean nothing.
    lost = bool(wrong[~np.isfinite(list(evaluation.methods.values())).any(axis=0)].any())
    return Finding(
        function=claim.name,
        argument=argument.name,
        passed=not entries and len(samples.labels) > 0,
        methods=(*evaluation.methods, "differences"),
        absolute=np.inf if lost else float(compared.gap.max(initial=0.0)),
        relative=np.inf if lost else float(compared.relative.max(initial=0.0)),
        tolerance=tolerance,
        float32=float(compared.relative32.max(initial=0.0)) if evaluation.single else None,
        float32_tolerance=float32_tolerance,
        differences=float(compared.from_quotient.max(initial=0.0)),
        differences_tolerance=_DIFFERENCES_TOLERANCE,
        samples=len(samples.labels),
        no_derivative=compared.no_derivative,
        worst_state=_worst_state(compared, evaluated, k),
        wrong_entries=tuple(entries),
    )


def _worst_state(compared: _Compared, evaluated: Evaluated, k: int) -> WorstState:
    """The state and entry with the largest excess over a tolerance, wrong or not."""
    if not compared.excess.size:
        return {}
    s, i, j = (int(k) for k in np.unravel_index(np.argmax(compared.excess), compared.excess.shape))
    claim = evaluated.claim
    entry = (claim.outputs[i], claim.arguments[k].entries[j])
    return {
        "label": evaluated.samples.labels[s],
        "entry": entry,
        "state": _state(evaluated, s),
    }


def _state(evaluated: Evaluated, s: int) -> dict[str, list[float]]:
    """The arguments at a state by name."""
    pairs = zip(evaluated.claim.arguments, evaluated.samples.values, strict=True)
    return {argument.name: [float(v) for v in table[s]] for argument, table in pairs}


def _largest_gap(
    methods: dict[str, Values],
) -> tuple[Float[np.ndarray, "S m n"], Float[np.ndarray, "S m _"]]:
    """The largest difference between two methods, and the size of each row.

    The size is the row's largest entry, since rows have different units, but at least a
    thousandth of its median over the states.
    """
    stack = np.stack(list(methods.values()))
    with np.errstate(invalid="ignore"):
        gap = stack.max(axis=0) - stack.min(axis=0)
    broken = ~np.isfinite(stack).all(axis=0)
    same = np.isnan(stack).all(axis=0)
    gap = np.where(broken & ~same, np.inf, np.where(same, 0.0, gap))
    sizes = np.where(np.isfinite(stack[0]), np.abs(stack[0]), 0.0)
    scale = sizes.max(axis=2, keepdims=True, initial=0.0)
    usual = np.median(scale, axis=0, keepdims=True) if len(scale) else 0.0
    return gap, np.maximum(scale, 1e-3 * usual)


def _modes_differ(
    methods: dict[str, Values], scale: np.ndarray, tolerance: float
) -> Bool[np.ndarray, "S 1 1"]:
    """Whether forward and reverse mode disagree at each state."""
    both = {name: m for name, m in methods.items() if name.startswith("jac")}
    if len(both) < 2:
        return np.zeros((len(scale), 1, 1), bool)
    return (_relative(_largest_gap(both)[0], scale) > tolerance).any(axis=(1, 2), keepdims=True)


def _relative(gap: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """The ratio gap / scale, with 0/0 = 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(gap == 0, 0.0, gap / scale)


def _dissent(values: dict[str, float], room: float, near: float) -> tuple[str, ...]:
    """The methods outside the largest group that agrees.

    Of two equal groups the one with the differences counts, which depend on the function's values
    alone. room, near: largest difference between two methods, and between one and the differences.
    """

    def agree(a: str, b: str) -> bool:
        allowed = near if "differences" in (a, b) else room
        return abs(values[a] - values[b]) <= allowed

    alone = {"differences": frozenset(["differences"])} if "differences" in values else {}
    groups = {
        a: frozenset(b for b in values if a == b or agree(a, b))
        for a in values
        if a != "differences"  # their tolerance is wide enough for a slightly wrong claim
    } | alone
    best = max(groups.values(), key=lambda group: (len(group), "differences" in group))
    return tuple(name for name in values if name not in best)
