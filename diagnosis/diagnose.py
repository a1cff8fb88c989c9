"""Which physical effect a model lacks: the whole way from recordings to a verdict.

gate -> fit of the model alone -> one effect after the other (diagnosis.step), each looked for again beside the others
(diagnosis.exchange) -> is anything left that has no name?

Nothing here is forced: a record that cannot tell gets `insufficient_data`, and what no candidate explains is `unknown`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import replace
from functools import partial

from diagnosis.adequacy import Adequacy, adequacy, over_floor
from diagnosis.exchange import asked, exchange, made_of, one_by_one, put_together, taken_apart, two_at_once
from diagnosis.findings import Diagnosis as Diagnosis
from diagnosis.findings import Finding as Finding
from diagnosis.findings import Verdict as Verdict
from diagnosis.freed import freed
from diagnosis.gate import check
from diagnosis.ready import ready, unready
from diagnosis.refit import FullFit, settled
from diagnosis.screen import Screen
from diagnosis.step import find, look, retold, surprising, unseen_at_zero
from diagnosis.trial import FAILURES, tried
from diagnosis.workspace import Workspace
from estimators.contract import Status
from estimators.methods.prediction_error import result
from estimators.segments import DataError, after_settling
from models.effect import Effect
from models.model import Model
from telemetry.recording import Recording

Progress = Callable[[str, float], None]


def diagnose(
    model: Model,
    recordings: Sequence[Recording],
    *,
    support: float | None = None,
    candidates: Iterable[str | Effect] | None = None,
    most: int = 3,
    masked: Collection[str] = (),
    unasked: Collection[str] = (),
    progress: Progress | None = None,
) -> Diagnosis:
    """What `model` lacks to explain `recordings`.

    A recording that begins on a support is looked at from where the model has settled (`Model.settling`).
    `support` rad: the vehicle is free where its roll is less. `candidates`: effects to look for, the whole catalogue by
    default. `most`: effects that are added at most, one after the other. `masked`: effects that parameters of
    the model can take the place of, so that the screen alone does not decide about them (diagnosis.masked). `unasked`:
    parameters that the recordings need not tell. `progress` is told what is being done and
    the share of it that is over, 0 to 1.
    Raises ModelError and EstimationError for a model or names that cannot be; data that cannot be used give a verdict.
    """
    tell = progress or (lambda text, share: None)
    tell("reading the data", 0.0)
    known, model = model, ready(model, recordings)
    try:
        recordings = after_settling(model, recordings, support)
        check(model, recordings, support)
        workspace = Workspace.of(model, recordings, support, None if candidates is None else tuple(candidates))
    except DataError as error:
        return Diagnosis(Verdict.INSUFFICIENT_DATA, str(error))
    tell("fitting the model as it is", 0.05)
    try:
        base = settled(model, workspace)
    except FAILURES as error:
        return Diagnosis(Verdict.UNKNOWN, f"the model alone has no fit: {error}", left_out=workspace.left_out)
    if (with_more := tried(partial(freed, model, base.fit)) or model) is not model:
        base = tried(partial(settled, with_more, workspace)) or base
    lacking = unidentified(base, unasked)
    if lacking:
        return Diagnosis(Verdict.INSUFFICIENT_DATA, lacking, left_out=workspace.left_out)
    bare = _without_blows(base, workspace)
    of_blows = max(0.0, base.log_likelihood - bare.log_likelihood)
    findings, fits, screens, last = _search(base, workspace, most, masked, of_blows, partial(_part, tell, 0.1, 0.85))
    tell("looking for what has no name", 0.95)
    rest = adequacy(bare.fit, last.fit, last.log_likelihood - bare.log_likelihood)
    steps = [base, *fits]
    before = rest.before if bare is base else over_floor(base.fit, last.fit)
    # `last` may have one without a name.
    after = rest.after if steps[-1] is last else over_floor(steps[-1].fit, last.fit)
    found = _verdict(steps, findings, screens, rest, (before, after), workspace)
    return found if found.repaired is None else replace(found, repaired=unready(known, found.repaired))


def _without_blows(base: FullFit, workspace: Workspace) -> FullFit:
    """The fit of the model without those of its effects whose parts strike each other; `base` where it has none, or
    runs away without them.

    What is left of these, once they are in the model, is a share of what they explain.
    """
    model = base.model
    for each in base.model.effects:
        if each.effect.strikes:
            model = model.remove(each.name)
    try:
        return base if model is base.model else settled(model, workspace)
    except FAILURES:
        return base


def _search(
    base: FullFit, workspace: Workspace, most: int, masked: Collection[str], of_blows: float, tell: Progress
) -> tuple[list[Finding], list[FullFit], list[Screen], FullFit]:
    """Effect after effect, at most `most`, and the fit with each; the screens before each and after the last.

    Then the fit of all that was found, which may be one effect more: one that explains too little for a name, but no
    more is unknown than what it bends. `of_blows`: log likelihood that effects of the model gain whose parts strike.
    """
    findings: list[Finding] = []
    fits: list[FullFit] = []
    screens: list[Screen] = []
    whole = base
    for step in range(most + 1):
        part = partial(_part, tell, step / (most + 1.0), 1.0 / (most + 1.0))
        part("screening all effects" + (f", with {findings[-1].effect} in the model" if findings else ""), 0.0)
        looked = tried(partial(look, whole, workspace))
        screens.append(looked or Screen((), {}))
        if looked is None or len(findings) == most:
            break
        seen = surprising(screens[-1])
        found = None
        if seen or (masked and not findings):
            # Beside an effect that does not quite fit, a lag bends what is left: there the screen has to see it.
            more = unseen_at_zero(workspace) if seen and not findings else []
            found = tried(partial(find, whole, screens[-1], workspace, {*masked, *more}, part))
        before = findings
        if found is not None:
            if found.finding.log_likelihood_gain < asked(found.finding, findings, of_blows):
                whole = found.fit
                break
            before = [*findings, found.finding]
            start = found.fit
            others = tried(partial(exchange, before, start, workspace, masked, part))
            findings, whole = others or (before, start)
        else:
            at_once = partial(two_at_once, whole, screens[-1], workspace, masked, part)
            two = tried(at_once) if not findings and most > 1 else None
            if two is None:
                break
            findings, whole = two
        if len(findings) < most:
            apart = tried(partial(taken_apart, findings, whole, workspace, masked, part))
            findings, whole = apart or (findings, whole)
        together = tried(partial(put_together, findings, whole, workspace, part))
        findings, whole = together or (findings, whole)
        same = [each.effect for each in findings] == [each.effect for each in before]
        each_alone = None if same else tried(partial(one_by_one, findings, whole, workspace))
        fits = [*fits, whole] if each_alone is None else each_alone
    findings = [
        replace(each, made_of=tried(partial(made_of, each, findings, fits[-1], workspace))) for each in findings
    ]
    return [tried(partial(retold, each, fits[-1])) or each for each in findings], fits, screens, whole


def _part(tell: Progress, begin: float, width: float, text: str, share: float) -> None:
    """`share` of one step, which began at `begin` and is `width` of the whole."""
    tell(text, begin + width * share)


def unidentified(base: FullFit, unasked: Collection[str] = ()) -> str:
    """Why the record does not even tell the model's own parameters; empty where it does.

    One alone that it does not tell stays what was known before: most of them have to be told. One that others stand
    in for is as good as its combination with them is. One at its bound, or a fit that does not settle, is what a model
    looks like that lacks something: that is to be found out."""
    told = result(base.fit, 0.0)
    nuisances = {name for each in base.model.inputs for name in each.delays}.union(unasked)
    own = {name: each for name, each in told.parameters.items() if name not in nuisances}
    silent = [name for name, each in own.items() if each.status is Status.TOO_LITTLE_EXCITATION]
    return f"{silent[0]}: {own[silent[0]].reason}" if 2 * len(silent) > len(own) else ""


def _failed(workspace: Workspace, findings: Sequence[Finding]) -> dict[str, str]:
    """Candidates that were tried and failed, and why; one that has a name was found before it failed."""
    named = {each.effect for each in findings}
    return {name: why for name, why in workspace.failed.items() if name not in named}


def _left(before: float, after: float) -> str:
    """How much of what was missing is left, in words; empty where noise of the model's own stood in for it."""
    if before <= 1.0:
        return ""
    share = 100.0 * max(0.0, after - 1.0) / (before - 1.0)
    return f" What is left is {share:.2g} % of the energy that exceeded the noise."


def _left_by_blows(rest: Adequacy) -> str:
    """What is left where parts strike each other, in words."""
    left = _left(rest.before, rest.after) if rest.struck else ""
    return f"{left} Blows that come a row early or late may leave it." if left else ""


def _verdict(
    steps: list[FullFit],
    findings: list[Finding],
    screens: list[Screen],
    rest: Adequacy,
    ratios: tuple[float, float],
    workspace: Workspace,
) -> Diagnosis:
    before, after = ratios
    if not rest.adequate:
        verdict = Verdict.UNKNOWN
        reason = f"something is missing that no known effect explains. {rest.reason}"
        names = " and ".join(finding.effect for finding in findings)
        if findings and not rest.named:
            reason += f" Nearest comes {names}; most of it is left."
            findings, steps, after = [], steps[:1], before
        elif findings:
            verb = "is" if len(findings) == 1 else "are"
            reason = f"{names} {verb} missing, and {reason}{_left(before, after)}"
    elif findings:
        verdict = Verdict.MISSING_EFFECT
        reason = "; ".join(finding.explanation for finding in findings)
        reason += _left_by_blows(rest)
    else:
        verdict = Verdict.ADEQUATE
        reason = "no known effect, and nothing without a name, would make the innovations smaller than chance does"
        reason += f".{_left_by_blows(rest)}" if rest.struck else ""
    return Diagnosis(
        verdict=verdict,
        reason=reason,
        findings=tuple(findings),
        minimum_detectable={score.candidate.name: score.detectable for score in screens[0].scores},
        innovation_ratio_before=before,
        innovation_ratio_after=after,
        repaired=steps[-1].fitted,
        left_out={**workspace.left_out, **_failed(workspace, findings)},
        screens=tuple(screens),
        steps=tuple(steps),
        unexplained=rest,
    )
