"""Finds which physical effect a model lacks: all steps from recordings to a verdict.

data (prepare) -> fit of the model alone (fits) -> search for effects, and for random parts in addition (search) ->
remaining lack of fit (lack_of_fit) -> verdict

No answer is forced: recordings that cannot distinguish effects give `insufficient_data`, and a lack of fit that no
candidate explains gives `unknown`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial

from upright.diagnosis.findings import Diagnosis as Diagnosis
from upright.diagnosis.findings import Finding as Finding
from upright.diagnosis.findings import Verdict as Verdict
from upright.diagnosis.fits.refit import FullFit, settled
from upright.diagnosis.fits.stated_values import contradictions
from upright.diagnosis.lack_of_fit.adequacy import adequacy
from upright.diagnosis.lack_of_fit.events import Event, events, pieces
from upright.diagnosis.prediction.closed_loop_error import Loop
from upright.diagnosis.prediction.limit import prediction_limit
from upright.diagnosis.prediction.relevance import relevances
from upright.diagnosis.prepare.pieces import hidden
from upright.diagnosis.prepare.ready import ready, unready
from upright.diagnosis.prepare.usable import check
from upright.diagnosis.prepare.workspace import Workspace
from upright.diagnosis.search.explanation import Explanation, Search, part_of
from upright.diagnosis.search.one_more import with_explanation
from upright.diagnosis.search.search import ONCE, Found, search
from upright.diagnosis.trial import FAILURES, tried
from upright.diagnosis.verdict import unidentified, untried, verdict
from upright.estimators.budget import Budget
from upright.estimators.data.segments import DataError, after_settling
from upright.estimators.data.time_scale import time_scale
from upright.estimators.fit.random.disturbance import disturbances
from upright.estimators.fit.random.sensor_errors import sensor_errors
from upright.estimators.fit.released import released
from upright.models.effect import Effect
from upright.models.model import Model
from upright.telemetry.recording import Recording

SEARCH = 0.75
"""Share of a diagnosis' time budget for the search; the rest is for the checks of the remaining lack of fit and for the
report."""

Progress = Callable[[str, float], None]


@dataclass(frozen=True, slots=True)
class _Request:
    """The arguments of `diagnose` other than the recordings. `stated`: the parameters of the model as it was given."""

    model: Model
    stated: frozenset[str]
    support: float | None
    candidates: tuple[str | Effect, ...] | None
    most: int
    confounded: Collection[str]
    not_required: Collection[str]
    budget: Budget
    loops: Sequence[Loop | str]


def diagnose(
    model: Model,
    recordings: Sequence[Recording],
    *,
    support: float | None = None,
    candidates: Iterable[str | Effect] | None = None,
    most: int = 3,
    confounded: Collection[str] = (),
    not_required: Collection[str] = (),
    budget: float | None = None,
    loops: Sequence[Loop | str] = (),
    progress: Progress | None = None,
) -> Diagnosis:
    """Which effects `model` lacks to explain `recordings`.

    A recording that begins on a support is used from the time at which the model has settled (`Model.settling`).
    `support` rad: the vehicle is free while its roll is smaller. `candidates`: effects to look for, by default the
    whole catalogue. `most`: maximum number of effects that are added, one after the other. `confounded`: effects that
    parameters of the model can imitate, so that the score test does not decide about them (diagnosis.fits.confounded).
    `not_required`: parameters that the recordings need not determine. `budget` s: after this time the search ends with
    what it has and reports what it left untried; by default it is unlimited. `loops`: what closed the loop on each
    recording, or why that is not known (diagnosis.prediction.relevance). `progress` is called with the current step and
    the share of the work that is done, 0 to 1.
    Raises ModelError and EstimationError if the model or a name is invalid; data that cannot be used give a verdict
    instead.
    """
    report = _forward(progress)
    bound = Budget.of(budget)
    report("reading the data", 0.0)
    known, model = model, ready(model, recordings)
    chosen = None if candidates is None else tuple(candidates)
    stated = frozenset(each.name for each in known.base_parameters)
    request = _Request(model, stated, support, chosen, most, confounded, not_required, bound, loops)
    found, happened = _answer(request, recordings, partial(part_of, report, 0.0, ONCE))
    if happened and bound.left:
        report("excluding single events", ONCE)
        scale = time_scale(model, found.steps[-1].fit.problem.segments)
        kept = [hidden(model, each, pieces(happened, each.source, scale)) for each in recordings]
        rest, _ = _answer(request, kept, partial(part_of, report, ONCE, 1.0 - ONCE), found)
        cut_short = rest.untried and not rest.findings
        if rest.verdict is not Verdict.INSUFFICIENT_DATA and not cut_short:
            found = replace(rest, reason=f"{rest.reason} {' '.join(map(str, happened))}", events=tuple(happened))
    return found if found.revised is None else replace(found, revised=unready(known, found.revised))


def _answer(
    request: _Request, given: Sequence[Recording], report: Progress, before: Diagnosis | None = None
) -> tuple[Diagnosis, list[Event]]:
    """The diagnosis of the recordings `given`, and the events at which their disturbance changes. `before`: the
    diagnosis of these samples together with others."""
    model = request.model
    try:
        recordings = after_settling(model, given, request.support)
        check(model, recordings, request.support)
        workspace = Workspace.of(model, recordings, request.support, request.candidates)
    except DataError as error:
        return Diagnosis(Verdict.INSUFFICIENT_DATA, str(error)), []
    workspace = replace(workspace, budget=request.budget)

    report("fitting the model as it is", 0.05)
    try:
        base = _fit_alone(model, workspace.unlimited)
    except FAILURES as error:
        return Diagnosis(Verdict.UNKNOWN, f"the model alone cannot be fitted: {error}", left_out=workspace.left_out), []
    if lacking := unidentified(base, request.not_required):
        return Diagnosis(Verdict.INSUFFICIENT_DATA, lacking, left_out=workspace.left_out), []

    how = Search(workspace.within(SEARCH), request.confounded, request.most, progress=report).part(0.1, 0.85)
    known = Explanation(before.findings, before.steps[-1]) if before else None
    found = search(base, how, known)

    report("checking what no effect explains", 0.95)
    last, bare = found.last, found.bare
    rest = adequacy(bare.fit, last.fit, last.log_likelihood - bare.log_likelihood)

    loops = [_begun_at(loop, *both) for loop, *both in zip(request.loops, given, recordings, strict=False)]
    found = replace(found, findings=_by_relevance(found, workspace.owners, loops))
    concluded = verdict(found, rest, workspace)
    shown, explained = concluded.steps[-1].fit, concluded.verdict in (Verdict.ADEQUATE, Verdict.MISSING_EFFECT)
    stated = partial(contradictions, found.base, concluded.steps[-1], request.stated, workspace)
    concluded = replace(
        concluded,
        disturbance=disturbances(shown),
        sensor_errors=sensor_errors(shown),
        prediction_limit=prediction_limit(shown),
        untried=untried(workspace, found.findings),
        rounds=tuple(workspace.rounds),
        contradicted=(tried(stated) if explained else None) or (),
    )
    return concluded, events(last.fit)


def _fit_alone(model: Model, workspace: Workspace) -> FullFit:
    """The fit of `model`, including the held parameters that have to be released (estimators.fit.released)."""
    base = settled(model, workspace)
    wider = tried(partial(released, model, base.fit)) or model
    return base if wider is model else tried(partial(settled, wider, workspace)) or base


def _begun_at(loop: Loop | str, whole: Recording, part: Recording) -> Loop | str:
    """`loop` of the recording `whole`, on the time axis of `part`, which may begin at a later sample."""
    later = float(part.timestamp_ns[0] - whole.timestamp_ns[0]) * 1e-9
    return loop if isinstance(loop, str) else loop.of_part(later)


def _by_relevance(found: Found, owners: Sequence[int], loops: Sequence[Loop | str]) -> tuple[Finding, ...]:
    """The findings with their relevance, the negligible ones last."""
    shares = relevances([each.fit for each in (found.base, *found.fits)], found.last.fit, owners, loops)
    each_with_share = zip(found.findings, shares, strict=True)
    known = [with_explanation(replace(each, relevance=share)) for each, share in each_with_share]
    return tuple(sorted(known, key=lambda each: each.negligible))


def _forward(progress: Progress | None) -> Progress:
    """`progress` for a progress bar that never goes back, even if work is repeated."""
    done = 0.0

    def report(text: str, share: float) -> None:
        nonlocal done
        done = max(done, share)
        if progress is not None:
            progress(text, done)

    return report
