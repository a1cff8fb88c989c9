"""Which physical effect a model lacks: the whole way from recordings to a verdict.

gate -> fit of the model alone -> one effect after the other (diagnosis.step), each looked for again beside the others
(diagnosis.exchange) -> is anything left that has no name?

Nothing here is forced: a record that cannot tell gets `insufficient_data`, and what no candidate explains is `unknown`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple, TypeVar

from diagnosis.contenders import look, still
from diagnosis.evidence import beyond_chance
from diagnosis.exchange import asked, exchange, made_of, one_by_one, put_together, taken_apart, two_at_once
from diagnosis.explain import explained_by_none, together
from diagnosis.findings import Diagnosis as Diagnosis
from diagnosis.findings import Finding as Finding
from diagnosis.findings import Verdict as Verdict
from diagnosis.fits.held_out import hidden
from diagnosis.fits.random_parts import RANDOM, absorbed, promised
from diagnosis.fits.refit import FURTHER_FITS, FullFit, full, gained, settled
from diagnosis.lack_of_fit.adequacy import Adequacy, adequacy, over_floor
from diagnosis.lack_of_fit.events import Event, events, pieces
from diagnosis.prediction.closed_loop_error import Loop
from diagnosis.prediction.limit import prediction_limit
from diagnosis.prediction.relevance import relevances
from diagnosis.prepare.ready import ready, unready
from diagnosis.prepare.usable import check
from diagnosis.prepare.workspace import Workspace
from diagnosis.score.score_test import Screen
from diagnosis.step import find, retold, reworded, surprising, unseen_at_zero
from diagnosis.trial import FAILURES, tried
from estimators.budget import Budget, OutOfTime
from estimators.contract import ParameterEstimate, Status
from estimators.data.segments import DataError, after_settling
from estimators.data.time_scale import time_scale
from estimators.disturbance_estimate import in_words
from estimators.fit.disturbance import disturbances
from estimators.fit.released import freed
from estimators.fit.sensor_errors import sensor_errors
from estimators.methods.prediction_error import result
from models.effect import Effect
from models.model import Model
from telemetry.recording import Recording

SEARCH = 0.75
"""Share of the time of a diagnosis that the search may take: the rest is for what has no name, and for telling it."""

HALF = 0.5
"""Of that time, for each of two searches: without a random part that seems to explain most, and beside it."""

ONCE = 0.75
"""Share of the progress bar that is over when work is done that may have to be done again; for the bar alone."""

Progress = Callable[[str, float], None]
Answer = TypeVar("Answer")


def diagnose(
    model: Model,
    recordings: Sequence[Recording],
    *,
    support: float | None = None,
    candidates: Iterable[str | Effect] | None = None,
    most: int = 3,
    masked: Collection[str] = (),
    unasked: Collection[str] = (),
    budget: float | None = None,
    loops: Sequence[Loop | str] = (),
    progress: Progress | None = None,
) -> Diagnosis:
    """What `model` lacks to explain `recordings`.

    A recording that begins on a support is looked at from where the model has settled (`Model.settling`).
    `support` rad: the vehicle is free where its roll is less. `candidates`: effects to look for, the whole catalogue by
    default. `most`: effects that are added at most, one after the other. `masked`: effects that parameters of
    the model can take the place of, so that the screen alone does not decide about them (diagnosis.fits.masked).
    `unasked`: parameters that the recordings need not tell. `budget` s: by then the search ends with what it has, and
    says what it left untried; by default it takes as long as it takes. `loops` tell what closed the loop on each
    recording, or why that is not known (diagnosis.prediction.relevance). `progress` is told what is being done and the
    share of it that is over, 0 to 1.
    Raises ModelError and EstimationError for a model or names that cannot be; data that cannot be used give a verdict.
    """
    tell = _forward(progress)
    bound = Budget.of(budget)
    tell("reading the data", 0.0)
    known, model = model, ready(model, recordings)
    chosen = None if candidates is None else tuple(candidates)

    def whole(
        given: Sequence[Recording], tell: Progress, before: Diagnosis | None = None
    ) -> tuple[Diagnosis, list[Event]]:
        try:
            recordings = after_settling(model, given, support)
            check(model, recordings, support)
            workspace = Workspace.of(model, recordings, support, chosen)
        except DataError as error:
            return Diagnosis(Verdict.INSUFFICIENT_DATA, str(error)), []
        begun = [_begun_at(loop, *both) for loop, *both in zip(loops, given, recordings, strict=False)]
        return _whole(replace(workspace, budget=bound), model, most, masked, unasked, begun, tell, before)

    found, happened = whole(recordings, partial(_part, tell, 0.0, ONCE))
    if happened and bound.left:
        tell("leaving out what happened once", ONCE)
        scale = time_scale(model, found.steps[-1].fit.problem.segments)
        kept = [hidden(model, each, pieces(happened, each.source, scale)) for each in recordings]
        rest, _ = whole(kept, partial(_part, tell, ONCE, 1.0 - ONCE), found)
        if rest.verdict is not Verdict.INSUFFICIENT_DATA and not _cut_short(rest.untried, rest.findings):
            found = replace(rest, reason=f"{rest.reason} {' '.join(map(str, happened))}", events=tuple(happened))
    return found if found.repaired is None else replace(found, repaired=unready(known, found.repaired))


def _whole(
    workspace: Workspace,
    model: Model,
    most: int,
    masked: Collection[str],
    unasked: Collection[str],
    loops: Sequence[Loop | str],
    tell: Progress,
    wider: Diagnosis | None = None,
) -> tuple[Diagnosis, list[Event]]:
    """The diagnosis of `model` on the rows of `workspace`, and where on these the disturbance changes. `wider`: that
    on these rows and others."""
    unhurried = workspace.unhurried
    tell("fitting the model as it is", 0.05)
    try:
        base = settled(model, unhurried)
    except FAILURES as error:
        return Diagnosis(Verdict.UNKNOWN, f"the model alone has no fit: {error}", left_out=workspace.left_out), []
    if (with_more := tried(partial(freed, model, base.fit)) or model) is not model:
        base = tried(partial(settled, with_more, unhurried)) or base
    lacking = unidentified(base, unasked)
    if lacking:
        return Diagnosis(Verdict.INSUFFICIENT_DATA, lacking, left_out=workspace.left_out), []
    part = partial(_part, tell, 0.1, 0.85)
    searched = _beside_random_parts(base, workspace.within(SEARCH), most, masked, part, wider)
    base, bare, findings, fits, screens, last = searched
    tell("looking for what has no name", 0.95)
    rest = adequacy(bare.fit, last.fit, last.log_likelihood - bare.log_likelihood)
    steps = [base, *fits]
    before = rest.before if bare is base else over_floor(base.fit, last.fit)
    # `last` may have one without a name.
    after = rest.after if steps[-1] is last else over_floor(steps[-1].fit, last.fit)
    findings = _by_relevance(findings, steps, last, workspace.owners, loops)
    found = _verdict(steps, findings, screens, rest, (before, after), workspace)
    shown = found.steps[-1].fit
    found = replace(
        found,
        disturbance=disturbances(shown),
        sensor_errors=sensor_errors(shown),
        prediction_limit=prediction_limit(shown),
        untried=_untried(workspace, findings),
        rounds=tuple(workspace.rounds),
    )
    return found, events(last.fit)


class Searched(NamedTuple):
    """What a search found beside the model alone, whose fit is `base`, and `bare` that without parts that strike each
    other; the others are what `_search` gives."""

    base: FullFit
    bare: FullFit
    findings: list[Finding]
    fits: list[FullFit]
    screens: list[Screen]
    last: FullFit


class Known(NamedTuple):
    """Findings, and the fits with the first of them, with the first two, and so on."""

    findings: Sequence[Finding] = ()
    fits: Sequence[FullFit] = ()


NOTHING = Known()


def _beside_random_parts(
    base: FullFit,
    workspace: Workspace,
    most: int,
    masked: Collection[str],
    tell: Progress,
    before: Diagnosis | None,
) -> Searched:
    """The effects that are found beside the random parts that the record asks for; these are looked for beside the
    effects, and the effects again beside each, as long as all of them together gain evidence. The search goes on from
    the findings of the diagnosis `before`, where there is one and they stand on these rows."""
    stands = None if before is None else _in_time(partial(_standing, base, before, workspace), RANDOM, workspace)
    base, known = stands or (base, NOTHING)
    begun = ONCE
    # Where a random part explains more than any effect seems to, the search without it leaves it half of the time.
    limited = workspace.within(HALF) if not known.findings and _outdone(base, workspace) else workspace
    found = _searched(base, limited, most, masked, partial(_part, tell, 0.0, begun), known)
    while True:
        looked = _in_time(partial(absorbed, found.base, found.last, workspace), RANDOM, workspace)
        if looked is None:
            return found
        own = replace(workspace, untried=[])
        again = _searched(looked, own, most, masked, partial(_part, tell, begun, ONCE * (1.0 - begun)))
        begun += ONCE * (1.0 - begun)
        for each in own.untried:
            workspace.leave(each)
        if found.findings and _cut_short(own.untried, again.findings):
            return found
        if again.last.evidence <= found.last.evidence:
            return found
        found = again


def _standing(base: FullFit, before: Diagnosis, workspace: Workspace) -> tuple[FullFit, Known]:
    """The fit of `base` with the random parts that its rows ask for beside the findings of `before`, and these; none of
    them where one is no more than chance on these rows."""
    if not before.findings:
        return absorbed(base, base, workspace) or base, NOTHING
    effects = before.steps[-1].fitted.effects
    while True:
        whole = full(replace(base.model, effects=effects), workspace, longer=FURTHER_FITS)
        looked = absorbed(base, whole, workspace)
        if looked is None:
            break
        base = looked
    for each in before.findings:
        without = full(whole.model.remove(each.effect), workspace, longer=FURTHER_FITS)
        if not beyond_chance(*gained(whole, without), len(workspace.candidates)):
            return base, NOTHING
    return base, Known(before.findings, one_by_one(before.findings, whole, workspace))


def _cut_short(untried: Sequence[str], findings: Sequence[Finding]) -> bool:
    """Whether a search left something `untried` and found nothing: it is no better than the one before it."""
    return bool(untried) and not findings


def _outdone(base: FullFit, workspace: Workspace) -> bool:
    """Whether a random part seems to explain more than any effect does, neither of them fitted."""
    gain = promised(base)
    looked = _in_time(partial(look, base, workspace), "the search for effects", workspace) if gain else None
    return looked is not None and gain > max((score.gain for score in looked.scores), default=0.0)


def _searched(
    base: FullFit, workspace: Workspace, most: int, masked: Collection[str], tell: Progress, known: Known = NOTHING
) -> Searched:
    bare = _without_blows(base, workspace.unhurried)
    of_blows = max(0.0, base.log_likelihood - bare.log_likelihood)
    return Searched(base, bare, *_search(base, workspace, most, masked, of_blows, tell, known))


def _begun_at(loop: Loop | str, whole: Recording, part: Recording) -> Loop | str:
    """`loop` of the recording `whole`, in the time of `part`, whose first row may be a later one."""
    later = float(part.timestamp_ns[0] - whole.timestamp_ns[0]) * 1e-9
    return loop if isinstance(loop, str) else loop.of_part(later)


def _by_relevance(
    findings: Sequence[Finding],
    steps: Sequence[FullFit],
    last: FullFit,
    owners: Sequence[int],
    loops: Sequence[Loop | str],
) -> list[Finding]:
    """`findings`, which `steps` were made with, with their relevance; those that are negligible below the others."""
    shares = relevances([each.fit for each in steps], last.fit, owners, loops)
    known = [reworded(replace(each, relevance=share)) for each, share in zip(findings, shares, strict=True)]
    return sorted(known, key=lambda each: each.negligible)


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
    base: FullFit,
    workspace: Workspace,
    most: int,
    masked: Collection[str],
    of_blows: float,
    tell: Progress,
    known: Known,
) -> tuple[list[Finding], list[FullFit], list[Screen], FullFit]:
    """Effect after effect, at most `most`, and the fit with each; the screens before each and after the last. Those
    that are `known` come first.

    Then the fit of all that was found, which may be one effect more: one that explains too little for a name, but no
    more is unknown than what it bends. `of_blows`: log likelihood that effects of the model gain whose parts strike.
    """
    findings, fits, screens, whole = list(known.findings), list(known.fits), list[Screen](), base
    if fits:
        whole = fits[-1]
        screens.append(tried(partial(look, base, workspace.unhurried)) or Screen((), {}))
    for step in range(len(findings), most + 1):
        part = partial(_part, tell, step / (most + 1.0), 1.0 / (most + 1.0))
        part("screening all effects" + (f", with {findings[-1].effect} in the model" if findings else ""), 0.0)
        what = "further effects" if findings else "the search for effects"
        looked = _in_time(partial(look, whole, workspace if step else workspace.unhurried), what, workspace)
        screens.append(looked or Screen((), {}))
        if looked is None or len(findings) == most:
            break
        seen = surprising(screens[-1])
        found = None
        # In a fit of the model alone a disturbance may have grown to what is missing, beside which nothing shows.
        if seen or (not findings and (masked or still(whole, workspace) is not None)):
            # Beside an effect that does not quite fit, a lag bends what is left: there the screen has to see it.
            more = unseen_at_zero(workspace) if seen and not findings else []
            searched = partial(find, whole, screens[-1], workspace, {*masked, *more}, part)
            found = _in_time(searched, what, workspace)
        before = findings
        if found is not None:
            if found.finding.log_likelihood_gain < asked(found.finding, findings, of_blows):
                whole = found.fit
                break
            before = [*findings, found.finding]
            findings, whole = _revised(before, found.fit, workspace, masked, most, part)
        else:
            at_once = partial(two_at_once, whole, screens[-1], workspace, masked, part)
            two = _in_time(at_once, "two effects at once", workspace) if not findings and most > 1 else None
            if two is None:
                break
            findings, whole = _revised(*two, workspace, masked, most, part, again=False)
        same = [each.effect for each in findings] == [each.effect for each in before]
        each_alone = None if same else tried(partial(one_by_one, findings, whole, workspace.unhurried))
        fits = [*fits, whole] if each_alone is None else each_alone
    findings = [
        replace(
            each,
            made_of=_in_time(
                partial(made_of, each, findings, fits[-1], workspace),
                f"{each.effect} as the two that it is made of",
                workspace,
            ),
        )
        for each in findings
    ]
    return [tried(partial(retold, each, fits[-1])) or each for each in findings], fits, screens, whole


def _in_time(work: Callable[[], Answer | None], what: str, workspace: Workspace) -> Answer | None:
    """What `work` gives; None where it fails or the time is over, and then `what` is noted as left untried."""
    try:
        return tried(work)
    except OutOfTime:
        workspace.leave(what)
        return None


def _revised(
    findings: Sequence[Finding],
    whole: FullFit,
    workspace: Workspace,
    masked: Collection[str],
    most: int,
    tell: Progress,
    *,
    again: bool = True,
) -> tuple[list[Finding], FullFit]:
    """`findings` as they are beside each other: each looked for again, one of two taken apart, two put together, as far
    as the time goes."""
    steps: list[tuple[str, Callable[[Sequence[Finding], FullFit], tuple[list[Finding], FullFit]]]] = []
    if again:
        steps.append(("each effect again", lambda now, fit: exchange(now, fit, workspace, masked, tell)))
    if len(findings) < most:
        steps.append(("two in place of one", lambda now, fit: taken_apart(now, fit, workspace, masked, tell)))
    steps.append(("one in place of two", lambda now, fit: put_together(now, fit, workspace, tell)))
    found = list(findings)
    for what, step in steps:
        try:
            found, whole = step(found, whole)
        except OutOfTime:
            workspace.leave(f"{what}, beside {' and '.join(each.effect for each in found)}")
    return found, whole


def _forward(progress: Progress | None) -> Progress:
    """`progress` of a bar that never goes back, though work may be done again."""
    over = 0.0

    def tell(text: str, share: float) -> None:
        nonlocal over
        over = max(over, share)
        if progress is not None:
            progress(text, over)

    return tell


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


def _untried(workspace: Workspace, findings: Sequence[Finding]) -> tuple[str, ...]:
    """What was left for want of time, and not found later on."""
    named = {each.effect for each in findings}
    return tuple(each for each in workspace.untried if each not in named)


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
        reason = f"something is missing that {explained_by_none(_untried(workspace, findings))}. {rest.reason}"
        names = " and ".join(finding.effect for finding in findings)
        if findings and not rest.named:
            reason += f" Nearest comes {names}; most of it is left."
            findings, steps, after = [], steps[:1], before
        elif findings:
            verb = "is" if len(findings) == 1 else "are"
            reason = f"{names} {verb} missing, and {reason}{_left(before, after)}"
    elif findings:
        verdict = Verdict.MISSING_EFFECT
        reason = together(findings) + _left_by_blows(rest)
    else:
        verdict = Verdict.ADEQUATE
        effect = "no effect tried so far" if _untried(workspace, findings) else "no known effect"
        reason = f"{effect}, and nothing without a name, would make the innovations smaller than chance does"
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
