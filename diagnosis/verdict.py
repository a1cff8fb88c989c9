"""The verdict on a model, in words, from what was found and what is left; and whether a record tells enough for one."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from diagnosis.explain import explained_by_none, together
from diagnosis.findings import Diagnosis, Finding, Verdict
from diagnosis.fits.refit import FullFit
from diagnosis.lack_of_fit.adequacy import Adequacy, over_floor
from diagnosis.prepare.workspace import Workspace
from diagnosis.search.search import Found
from estimators.contract import ParameterEstimate, Status
from estimators.disturbance_estimate import in_words
from estimators.fit.disturbance import disturbances
from estimators.methods.prediction_error import result


def verdict(found: Found, rest: Adequacy, workspace: Workspace) -> Diagnosis:
    """What is said of a model beside which something was `found`, and in which the `rest` is left."""
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
            reason += f" Nearest comes {names}; most of it is left."
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
        reason = f"{effect}, and nothing without a name, would make the innovations smaller than chance does"
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


def unidentified(base: FullFit, unasked: Collection[str] = ()) -> str:
    """Why the record does not even tell the model's own parameters; empty where it does.

    One alone that it does not tell stays what was known before: most of them have to be told. One that others stand
    in for is as good as its combination with them is. One at its bound, or a fit that does not settle, is what a model
    looks like that lacks something: that is to be found out."""
    told = result(base.fit, 0.0)
    nuisances = {name for each in base.model.inputs for name in each.delays}.union(unasked)
    own = {name: each for name, each in told.parameters.items() if name not in nuisances}
    silent = [name for name, each in own.items() if each.status is Status.TOO_LITTLE_EXCITATION]
    if 2 * len(silent) <= len(own):
        return ""
    return f"{silent[0]}: {own[silent[0]].reason}{_what_would_do([own[name] for name in silent], base)}"


def _what_would_do(silent: Sequence[ParameterEstimate], base: FullFit) -> str:
    """How long a record, or how large an excitation, tells the `silent` beside the disturbance, in words.

    Standard deviations fall with the root of the length, and with the amplitude.
    """
    shown = [each for each in disturbances(base.fit) if each.acts]
    least = min((each.coverage_percent for each in silent), default=0.0)
    if not shown or least <= 0.0:
        return ""
    times, span = 100.0 / least, base.fit.problem.span
    return (
        f" Beside this disturbance ({in_words(shown)}) {span * times**2:.0f} s of the same excitation would do, or one"
        f" that is {times:.2g} times as large."
    )


def _failed(workspace: Workspace, findings: Sequence[Finding]) -> dict[str, str]:
    """Candidates that were tried and failed, and why; one that has a name was found before it failed."""
    named = {each.effect for each in findings}
    return {name: why for name, why in workspace.failed.items() if name not in named}


def untried(workspace: Workspace, findings: Sequence[Finding]) -> tuple[str, ...]:
    """What was left for want of time, and not found later on."""
    named = {each.effect for each in findings}
    return tuple(each for each in workspace.untried if each not in named)


def _left(before: float, after: float) -> str:
    """How much of what was missing is left, in words; empty where noise of the model's own stood in for it."""
    if before <= 1.0:
        return ""
    share = 100.0 * max(0.0, after - 1.0) / (before - 1.0)
    return f" What is left is {share:.2g} % of the energy that exceeded the noise."


def _left_by_impacts(rest: Adequacy) -> str:
    """What is left where parts strike each other, in words."""
    left = _left(rest.before, rest.after) if rest.impacts else ""
    return f"{left} Impacts that come a sample early or late may leave it." if left else ""
