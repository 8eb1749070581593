"""Every Jacobian of every registered model, four ways, and proof that the verifier would notice."""

from types import SimpleNamespace

import numpy as np
import pytest
from cases import swept

from jaxslam import motion, sensors
from jaxslam.core.protocols import Motion
from jaxslam.verify import _comparison, _properties, _verifier, build

MODELS = motion.REGISTRY | sensors.REGISTRY


@pytest.fixture(
    scope="module",
    params=swept(MODELS, "unicycle", "range_bearing", "line"),
)
def verified(request):
    """A registered model, all that was computed about it, and what that was judged to be."""
    model = build(MODELS[request.param])
    evaluated = _verifier.evaluate_claims(model.claims())
    findings = [
        finding
        for claim in evaluated
        for finding in _comparison.compare_methods(
            claim, _verifier.TOLERANCE, _verifier.FLOAT32_TOLERANCE
        )
    ]
    return SimpleNamespace(
        model=model,
        findings=findings,
        checks=list(_properties.all_checks(evaluated, of_model=True)),
        evaluated=evaluated,
        labels=[claim.samples.labels for claim in evaluated],
    )


# What is asked of a model beside its Jacobians: the suites of sensors and motion models rely on it.
OF_EACH = "{} is pure", "{} keeps the dtype", "{} and its derivatives are finite"
OF_A_MOTION = "noise covariance", "the heading is wrapped to (-π, π]"
OF_A_SENSOR = (
    "noise covariance",
    "the residual is zero at equality",
    "the residual is antisymmetric",
)
DIFFERENCE = "the residual is a difference{}"
OF_A_LANDMARK = (
    "observe undoes invert, whatever is free",
    "invert undoes observe, within what is free",
)


def test_everything_is_verified(verified):
    assert [str(f.wrong_entries) for f in verified.findings if not f.passed] == []
    assert [(c.name, c.detail) for c in verified.checks if not c.passed] == []
    required = {
        check.format(examined.claim.name) for examined in verified.evaluated for check in OF_EACH
    }
    if isinstance(verified.model, Motion):
        required |= set(OF_A_MOTION)
        if verified.model.perturb is not None:
            required.add("step(pose, u, w) = step(pose, perturb(u, w), 0)")
    else:
        required |= {*OF_A_SENSOR, *(OF_A_LANDMARK if verified.model.landmark else ())}
        circular = any(name.endswith("[rad]") for name in verified.model.measurements)
        required.add(DIFFERENCE.format(", wrapped on the circle" * circular))
    assert required <= {check.name for check in verified.checks}


def test_hand_is_autodiff_at_every_sample(verified):
    """To 1e-12 in float64 and 1e-5 in float32, relative to the row; every argument is claimed.

    A line 1e5 m from the map's origin is known to 1e5 m times the rounding of its angle.
    """
    far = getattr(verified.model, "carry", None) is not None
    double, single = (1e5 * 2**-53, 1e5 * 2**-24) if far else (1e-12, 1e-5)
    claims = [e.claim for e in verified.evaluated if e.claim.outputs]
    assert len(verified.findings) == sum(bool(a.entries) for c in claims for a in c.arguments)
    for finding in verified.findings:
        assert finding.methods == ("jacfwd", "jacrev", "hand", "differences")
        assert finding.relative <= double
        assert finding.float32 <= single
        assert finding.samples >= 30
        # A state without a derivative is a landmark at the robot or the sensor, nothing else.
        assert finding.no_derivative <= 8


def test_hard_states_are_among_the_samples(verified):
    labels = {label for group in verified.labels for label in group}
    for part in ("random", "pose theta = 3.142", "pose theta = -3.142", "large coordinates"):
        assert part in labels
    if isinstance(verified.model, Motion):
        assert "zero control" in labels
        assert "zero control and noise" in labels
        rates = [c.split(" ")[0] for c in verified.model.controls if c.endswith("[rad/s]")]
        assert all(f"control {rate} = 0" in labels for rate in rates)
    elif verified.model.landmark:
        at = ("close to the robot", "close to the sensor", "at the robot", "behind, on the seam")
        assert all(f"landmark {where}" in labels for where in at)
        if "rho [1/m]" in verified.model.landmark:
            assert {"landmark rho = 0", "landmark rho = -0.5"} <= labels


def mutations(jacobian):
    """(row, column, mutant) of every entry of (S, m, n): sign flipped, and 1 % off.

    An entry that is zero everywhere has neither; it is given a hundredth of its row instead.
    """
    for i in range(jacobian.shape[1]):
        row = np.abs(jacobian[:, i]).max(axis=1, initial=0)
        for j in range(jacobian.shape[2]):
            entry = jacobian[:, i, j]
            wrong = [-entry, 1.01 * entry] if entry.any() else [np.where(row > 0, row, 1) / 100]
            for values in wrong:
                mutant = jacobian.copy()
                mutant[:, i, j] = values
                yield i, j, mutant


def test_every_wrong_entry_is_caught_and_named(verified):
    tried = 0
    for evaluated in verified.evaluated:
        claim = evaluated.claim
        for k, evaluation in enumerate(evaluated.by_argument):
            for i, j, mutant in mutations(evaluation.methods["hand"]):
                changed = evaluation._replace(methods=evaluation.methods | {"hand": mutant})
                by_argument = list(evaluated.by_argument)
                by_argument[k] = changed
                findings = _comparison.compare_methods(
                    evaluated._replace(by_argument=tuple(by_argument)),
                    _verifier.TOLERANCE,
                    _verifier.FLOAT32_TOLERANCE,
                )
                assert [f.passed for f in findings] == [n != k for n in range(len(findings))]
                (wrong,) = findings[k].wrong_entries
                name = (claim.outputs[i], claim.arguments[k].entries[j])
                assert (wrong.row, wrong.column) == name
                assert wrong.dissent == ("hand",)
                tried += 1
    assert tried >= 4
