"""The verdict on a model, in words, from the findings and the remaining lack of fit; and whether a record is sufficient
for a verdict."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from upright.diagnosis.explain import explained_by_none, together
from upright.diagnosis.findings import Diagnosis, Finding, Verdict
from upright.diagnosis.fits.refit import FullFit
from upright.diagnosis.lack_of_fit.adequacy import Adequacy, over_floor
from upright.diagnosis.prepare.workspace import Workspace
from upright.diagnosis.search.search import Found
from upright.estimators.contract import ParameterEstimate, Status
from upright.estimators.disturbance_estimate import in_words
from upright.estimators.fit.random.disturbance import disturbances
from upright.estimators.methods.prediction_error import result


def verdict(found: Found, rest: Adequacy, workspace: Workspace) -> Diagnosis:
    """The verdict on a model for which effects were `found`, and in which the `rest` remains."""
    findings, steps = found.findings, (found.base, *found.fits)
    before = rest.before if found.bare is found.base else over_floor(found.base.fit, found.last.fit)
    # The last fit may have one effect without a name.
    after = rest.after if steps[-1] is found.last else over_floor(steps[-1].fit, found.last.fit)
    left = untried(workspace, findings)
    if not rest.adequate:
        kind = Verdict.UNKNOWN
        reason = f"something is missing that {explained_by_none(left)}. {rest.reason}"
        names = " and ".join(finding.effect for finding in findings)
        if findings and not rest.named:
            reason += f" The nearest is {names}, but most of the error remains."
            findings, steps, after = (), steps[:1], before
        elif findings:
            verb = "is" if len(findings) == 1 else "are"
            reason = f"{names} {verb} missing, and {reason}{_left(before, after)}"
    elif findings:
        kind = Verdict.MISSING_EFFECT
        reason = together(findings) + _left_by_impacts(rest)
    else:
        kind = Verdict.ADEQUATE
        effect = "no effect tried so far" if left else "no known effect"
        reason = f"{effect} and no force of free form would make the innovations smaller than chance does"
        reason += f".{_left_by_impacts(rest)}" if rest.impacts else ""
    return Diagnosis(
        verdict=kind,
        reason=reason,
        findings=findings,
        minimum_detectable={score.candidate.name: score.detectable for score in found.score_tests[0].scores},
        innovation_ratio_before=before,
        innovation_ratio_after=after,
        revised=steps[-1].fitted,
        left_out={**workspace.left_out, **_failed(workspace, findings)},
        score_tests=found.score_tests,
        steps=steps,
        unexplained=rest,
    )


def unidentified(base: FullFit, not_required: Collection[str] = ()) -> str:
    """Why the record does not even determine the model's own parameters; empty if it does.

    A single parameter that it does not determine keeps its prior value; at least half of them have to be determined. A
    parameter that is confounded with others is as good as its combination with them. A parameter at its bound, or a fit
    that does not converge, is how a model with a missing effect looks, which is for the diagnosis to find out.
    """
    estimates = result(base.fit, 0.0).parameters
    nuisances = {name for each in base.model.inputs for name in each.delays}.union(not_required)
    own = {name: each for name, each in estimates.items() if name not in nuisances}
    undetermined = [name for name, each in own.items() if each.status is Status.TOO_LITTLE_EXCITATION]
    if 2 * len(undetermined) <= len(own):
        return ""
    remedy = _what_would_do([own[name] for name in undetermined], base)
    return f"{undetermined[0]}: {own[undetermined[0]].reason}{remedy}"


def _what_would_do(undetermined: Sequence[ParameterEstimate], base: FullFit) -> str:
    """How long a record, or how large an excitation, would determine the `undetermined` parameters beside the
    disturbance, in words.

    Standard deviations fall with the square root of the length, and with the amplitude.
    """
    shown = [each for each in disturbances(base.fit) if each.acts]
    least = min((each.coverage_percent for each in undetermined), default=0.0)
    if not shown or least <= 0.0:
        return ""
    times, span = 100.0 / least, base.fit.problem.span
    return (
        f" With this disturbance ({in_words(shown)}), {span * times**2:.0f} s of the same excitation would be enough,"
        f" or an excitation that is {times:.2g} times as large."
    )


def _failed(workspace: Workspace, findings: Sequence[Finding]) -> dict[str, str]:
    """Candidates whose fits failed, and why; without those that are named, which were found before they failed."""
    named = {each.effect for each in findings}
    return {name: why for name, why in workspace.failed.items() if name not in named}


def untried(workspace: Workspace, findings: Sequence[Finding]) -> tuple[str, ...]:
    """What was left for lack of time, and not found later on."""
    named = {each.effect for each in findings}
    return tuple(each for each in workspace.untried if each not in named)


def _left(before: float, after: float) -> str:
    """How much of what was missing is left, in words; empty if noise of the model's own accounted for it."""
    if before <= 1.0:
        return ""
    share = 100.0 * max(0.0, after - 1.0) / (before - 1.0)
    return f" Of the energy that exceeded the noise, {share:.2g} % is left."


def _left_by_impacts(rest: Adequacy) -> str:
    """What is left in a model whose parts collide, in words."""
    left = _left(rest.before, rest.after) if rest.impacts else ""
    return f"{left} Impacts that come a sample early or late may account for it." if left else ""
