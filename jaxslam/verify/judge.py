"""Which entry of which Jacobian is wrong, and which of the four ways of computing it says so."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxslam.verify.differences import Quotient
from jaxslam.verify.jacobians import Evaluated, Evaluation
from jaxslam.verify.record import Finding, WrongEntry
from jaxslam.verify.samples import Samples

Values = NDArray[np.float64]

DIFFERENCES_TOLERANCE = 1e-6
"""of the quotients, relative, beyond ten times their own estimate of their error"""
_CONVERGED = 1e-3
"""relative error up to which a quotient counts as a derivative"""
_NOTHING = 1e-9
"""error up to which it does so in any case: a row may be zero everywhere"""
_NOMINAL = ("random", "given")


def judge(evaluated: Evaluated, tolerance: float, float32_tolerance: float) -> list[Finding]:
    """Compare the methods entry by entry: one finding an argument that was evaluated.

    A state at which the function itself has no finite value has no Jacobian; it is left to the
    check of finite values.
    """
    if evaluated.values is None:
        return []
    finite = np.all(np.isfinite(evaluated.values), axis=1)
    evaluated = _only(evaluated, np.flatnonzero(finite))
    return [
        _finding(evaluated, k, tolerance, float32_tolerance)
        for k, evaluation in enumerate(evaluated.by_argument)
        if evaluation.methods and len(evaluation.methods) + (evaluation.quotient is not None) > 1
    ]


def _only(evaluated: Evaluated, rows: NDArray[np.intp]) -> Evaluated:
    samples = evaluated.samples
    by_argument = tuple(
        Evaluation(
            {how: jacobian[rows] for how, jacobian in evaluation.methods.items()},
            {how: jacobian[rows] for how, jacobian in evaluation.single.items()},
            evaluation.single_error[rows] if evaluation.single_error.ndim else np.zeros(()),
            evaluation.quotient and _rows_of(evaluation.quotient, rows),
            evaluation.how,
        )
        for evaluation in evaluated.by_argument
    )
    kept = Samples(tuple(a[rows] for a in samples.values), tuple(samples.labels[i] for i in rows))
    return evaluated._replace(samples=kept, by_argument=by_argument)


def _rows_of(quotient: Quotient, rows: NDArray[np.intp]) -> Quotient:
    return Quotient(quotient.value[rows], quotient.error[rows], quotient.kink[rows])


class _Compared(NamedTuple):
    """All entries against each other, (S, m, n) each but scale (S, m, 1)."""

    gap: Values
    relative: Values
    relative32: Values
    away: Values
    """from the quotients, relative, where they converge"""
    scale: Values
    excess: Values
    """the worst of the three over its tolerance; above 1 is wrong"""
    in_float32: NDArray[np.bool_]
    """whether float32 is what is worst"""
    no_derivative: int


def _compare(evaluation: Evaluation, tolerance: float, float32_tolerance: float) -> _Compared:
    (gap, scale), (gap32, scale32) = _spread(evaluation.methods), _spread(evaluation.single)
    away: Values = np.zeros_like(gap)
    excess_away, lost = np.zeros_like(gap), 0
    if evaluation.quotient is not None:
        value, error, kink = evaluation.quotient
        away = np.stack([np.abs(m - value) for m in evaluation.methods.values()]).max(axis=0)
        own = np.abs(value).max(axis=2, keepdims=True, initial=0.0)
        trusted = ((error <= _CONVERGED * own) | (error <= _NOTHING)) & ~kink
        away = np.where(trusted, np.where(np.isfinite(away), away, np.inf), 0.0)
        excess_away = _over(away, DIFFERENCES_TOLERANCE * scale + 10 * error)
        # At a kink any slope between those of the two sides will do. Elsewhere, if the quotients do
        # not converge, rounding may decide what autodiff returns; where its two modes differ,
        # nobody can be held against them.
        odd = ~trusted.all(axis=(1, 2), keepdims=True)
        lost = int(odd.sum())
        for g, methods, size, limit in (
            (gap, evaluation.methods, scale, tolerance),
            (gap32, evaluation.single, scale32, float32_tolerance),
        ):
            if g.size:
                g[kink | (odd & _modes_differ(methods, size, limit))] = 0.0
        if gap.size and lost == len(gap):
            excess_away = np.full_like(gap, np.inf)  # no state holds anything: not a pass
    relative, relative32 = _over(gap, scale), _over(gap32, scale32)
    in_double = np.maximum(relative / tolerance, excess_away)
    # By hand need not be more exact in float32 than autodiff is.
    in_single = _over(gap32, float32_tolerance * scale32 + 2 * evaluation.single_error)
    return _Compared(
        gap,
        relative,
        relative32,
        _over(away, scale),
        scale,
        np.maximum(in_double, in_single),
        in_single > in_double,
        lost,
    )


def _finding(
    evaluated: Evaluated, which: int, tolerance: float, float32_tolerance: float
) -> Finding:
    function, samples = evaluated.function, evaluated.samples
    evaluation, argument = evaluated.by_argument[which], function.arguments[which]
    compared = _compare(evaluation, tolerance, float32_tolerance)
    wrong = compared.excess > 1
    often = wrong.sum(axis=0)

    def entry(s: int, i: int, j: int) -> WrongEntry:
        in_single = bool(compared.in_float32[s, i, j])
        shown = evaluation.single if in_single else evaluation.methods
        values = {how: float(m[s, i, j]) for how, m in shown.items()}
        size = float(compared.scale[s, i, 0])
        room = (float32_tolerance if in_single else tolerance) * size
        near = room
        if evaluation.quotient is not None:
            values["differences"] = float(evaluation.quotient.value[s, i, j])
            near += DIFFERENCES_TOLERANCE * size + 10 * float(evaluation.quotient.error[s, i, j])
        return WrongEntry(
            row=function.outputs[i],
            column=argument.entries[j],
            states=int(often[i, j]),
            precision="float32" if in_single else "float64",
            label=samples.labels[s],
            state={
                a.name: [float(v) for v in x[s]]
                for a, x in zip(function.arguments, samples.values, strict=True)
            },
            values=values,
            dissent=_dissent(values, room, near),
        )

    nominal = np.array([label in _NOMINAL for label in samples.labels])
    entries = []
    for i, j in np.argwhere(often):
        # Shown at its worst, of the usual states if it is wrong at one of them.
        usual = wrong[:, i, j] & nominal
        excess = np.where(usual if usual.any() else wrong[:, i, j], compared.excess[:, i, j], -1)
        entries.append(entry(int(np.argmax(excess)), int(i), int(j)))
    entries.sort(key=lambda e: -e.states)
    has_quotient = evaluation.quotient is not None
    return Finding(
        function=function.name,
        argument=argument.name,
        passed=not entries and len(samples.labels) > 0,
        methods=(*evaluation.methods, *(("differences",) if has_quotient else ())),
        absolute=float(np.max(compared.gap, initial=0.0)),
        relative=float(np.max(compared.relative, initial=0.0)),
        tolerance=tolerance,
        float32=float(np.max(compared.relative32, initial=0.0)) if evaluation.single else None,
        float32_tolerance=float32_tolerance,
        differences=float(np.max(compared.away, initial=0.0)) if has_quotient else None,
        differences_tolerance=DIFFERENCES_TOLERANCE,
        quotient=evaluation.how,
        samples=len(samples.labels),
        no_derivative=compared.no_derivative,
        worst_state=_worst_state(compared, evaluated, which),
        wrong_entries=tuple(entries),
    )


def _worst_state(compared: _Compared, evaluated: Evaluated, which: int) -> dict[str, Any]:
    """Where the largest excess over a tolerance occurs, wrong or not."""
    if not compared.excess.size:
        return {}
    s, i, j = (int(k) for k in np.unravel_index(np.argmax(compared.excess), compared.excess.shape))
    function, samples = evaluated.function, evaluated.samples
    state: dict[str, Any] = {
        a.name: [float(v) for v in x[s]]
        for a, x in zip(function.arguments, samples.values, strict=True)
    }
    entry = (function.outputs[i], function.arguments[which].entries[j])
    return {"label": samples.labels[s], "entry": entry, "state": state}


def _spread(methods: dict[str, Values]) -> tuple[Values, Values]:
    """Largest difference between two methods (S, m, n), and the size of each row (S, m, 1).

    The size is that of the row's largest entry, so that units do not mix; a row that vanishes at
    one state is measured by a thousandth of what it usually is.
    """
    if not methods:
        return np.zeros((0, 0, 0)), np.zeros((0, 0, 0))
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


def _modes_differ(methods: dict[str, Values], scale: Values, tolerance: float) -> Any:
    """Whether forward and reverse mode disagree at a state, (S, 1, 1) bool."""
    both = {name: m for name, m in methods.items() if name.startswith("jac")}
    if len(both) < 2:
        return np.zeros((len(scale), 1, 1), bool)
    return (_over(_spread(both)[0], scale) > tolerance).any(axis=(1, 2), keepdims=True)


def _over(gap: Values, scale: Values) -> Values:
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(gap == 0, 0.0, gap / scale)


def _dissent(values: dict[str, float], room: float, near: float) -> tuple[str, ...]:
    """Who is outvoted. The methods fall into camps that agree; the largest camp is right, and of
    two equal ones that of the differences, which see the function alone."""

    def agree(a: str, b: str) -> bool:
        allowed = near if "differences" in (a, b) else room
        return abs(values[a] - values[b]) <= allowed

    alone = {"differences": frozenset(["differences"])} if "differences" in values else {}
    camps = {
        a: frozenset(b for b in values if a == b or agree(a, b))
        for a in values
        if a != "differences"  # to their tolerance they would agree with a claim just off, too
    } | alone
    best = max(camps.values(), key=lambda camp: (len(camp), "differences" in camp))
    return tuple(name for name in values if name not in best)
