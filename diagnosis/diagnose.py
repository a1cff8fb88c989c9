"""Which physical effect a model lacks: the whole way from recordings to a verdict.

data (prepare) -> fit of the model alone (fits) -> search for effects, and for random parts beside them (search) -> what
no effect explains (lack_of_fit) -> verdict

Nothing here is forced: a record that cannot tell gets `insufficient_data`, and what no candidate explains is `unknown`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial

from diagnosis.findings import Diagnosis as Diagnosis
from diagnosis.findings import Finding as Finding
from diagnosis.findings import Verdict as Verdict
from diagnosis.fits.refit import FullFit, settled
from diagnosis.lack_of_fit.adequacy import adequacy
from diagnosis.lack_of_fit.events import Event, events, pieces
from diagnosis.prediction.closed_loop_error import Loop
from diagnosis.prediction.limit import prediction_limit
from diagnosis.prediction.relevance import relevances
from diagnosis.prepare.pieces import hidden
from diagnosis.prepare.ready import ready, unready
from diagnosis.prepare.usable import check
from diagnosis.prepare.workspace import Workspace
from diagnosis.search.explanation import Explanation, Search, part_of
from diagnosis.search.one_more import reworded
from diagnosis.search.search import ONCE, Found, search
from diagnosis.trial import FAILURES, tried
from diagnosis.verdict import unidentified, untried, verdict
from estimators.budget import Budget
from estimators.data.segments import DataError, after_settling
from estimators.data.time_scale import time_scale
from estimators.fit.disturbance import disturbances
from estimators.fit.released import released
from estimators.fit.sensor_errors import sensor_errors
from models.effect import Effect
from models.model import Model
from telemetry.recording import Recording

SEARCH = 0.75
"""Share of the time of a diagnosis that the search may take: the rest is for what has no name, and for telling it."""

Progress = Callable[[str, float], None]


@dataclass(frozen=True, slots=True)
class _Question:
    """What `diagnose` is asked, of whichever samples."""

    model: Model
    support: float | None
    candidates: tuple[str | Effect, ...] | None
    most: int
    confounded: Collection[str]
    unasked: Collection[str]
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
    unasked: Collection[str] = (),
    budget: float | None = None,
    loops: Sequence[Loop | str] = (),
    progress: Progress | None = None,
) -> Diagnosis:
    """What `model` lacks to explain `recordings`.

    A recording that begins on a support is looked at from where the model has settled (`Model.settling`).
    `support` rad: the vehicle is free where its roll is less. `candidates`: effects to look for, the whole catalogue by
    default. `most`: effects that are added at most, one after the other. `confounded`: effects that
    parameters of the model can imitate, so that the score test does not decide about them (diagnosis.fits.confounded).
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
    asked = _Question(model, support, chosen, most, confounded, unasked, bound, loops)
    found, happened = _answer(asked, recordings, partial(part_of, tell, 0.0, ONCE))
    if happened and bound.left:
        tell("leaving out what happened once", ONCE)
        scale = time_scale(model, found.steps[-1].fit.problem.segments)
        kept = [hidden(model, each, pieces(happened, each.source, scale)) for each in recordings]
        rest, _ = _answer(asked, kept, partial(part_of, tell, ONCE, 1.0 - ONCE), found)
        cut_short = rest.untried and not rest.findings
        if rest.verdict is not Verdict.INSUFFICIENT_DATA and not cut_short:
            found = replace(rest, reason=f"{rest.reason} {' '.join(map(str, happened))}", events=tuple(happened))
    return found if found.revised is None else replace(found, revised=unready(known, found.revised))


def _answer(
    asked: _Question, given: Sequence[Recording], tell: Progress, before: Diagnosis | None = None
) -> tuple[Diagnosis, list[Event]]:
    """The diagnosis of the recordings `given`, and where on these the disturbance changes. `before`: that of these
    samples and others."""
    model = asked.model
    try:
        recordings = after_settling(model, given, asked.support)
        check(model, recordings, asked.support)
        workspace = Workspace.of(model, recordings, asked.support, asked.candidates)
    except DataError as error:
        return Diagnosis(Verdict.INSUFFICIENT_DATA, str(error)), []
    workspace = replace(workspace, budget=asked.budget)

    tell("fitting the model as it is", 0.05)
    try:
        base = _fit_alone(model, workspace.unhurried)
    except FAILURES as error:
        return Diagnosis(Verdict.UNKNOWN, f"the model alone has no fit: {error}", left_out=workspace.left_out), []
    if lacking := unidentified(base, asked.unasked):
        return Diagnosis(Verdict.INSUFFICIENT_DATA, lacking, left_out=workspace.left_out), []

    how = Search(workspace.within(SEARCH), asked.confounded, asked.most, tell=tell).part(0.1, 0.85)
    known = Explanation(before.findings, before.steps[-1]) if before else None
    found = search(base, how, known)

    tell("looking for what has no name", 0.95)
    last, bare = found.last, found.bare
    rest = adequacy(bare.fit, last.fit, last.log_likelihood - bare.log_likelihood)

    loops = [_begun_at(loop, *both) for loop, *both in zip(asked.loops, given, recordings, strict=False)]
    found = replace(found, findings=_by_relevance(found, workspace.owners, loops))
    told = verdict(found, rest, workspace)
    shown = told.steps[-1].fit
    told = replace(
        told,
        disturbance=disturbances(shown),
        sensor_errors=sensor_errors(shown),
        prediction_limit=prediction_limit(shown),
        untried=untried(workspace, found.findings),
        rounds=tuple(workspace.rounds),
    )
    return told, events(last.fit)


def _fit_alone(model: Model, workspace: Workspace) -> FullFit:
    """The fit of `model`, with what has to be released in it estimated, too (estimators.fit.released)."""
    base = settled(model, workspace)
    wider = tried(partial(released, model, base.fit)) or model
    return base if wider is model else tried(partial(settled, wider, workspace)) or base


def _begun_at(loop: Loop | str, whole: Recording, part: Recording) -> Loop | str:
    """`loop` of the recording `whole`, in the time of `part`, whose first row may be a later one."""
    later = float(part.timestamp_ns[0] - whole.timestamp_ns[0]) * 1e-9
    return loop if isinstance(loop, str) else loop.of_part(later)


def _by_relevance(found: Found, owners: Sequence[int], loops: Sequence[Loop | str]) -> tuple[Finding, ...]:
    """The findings with their relevance, those that are negligible below the others."""
    shares = relevances([each.fit for each in (found.base, *found.fits)], found.last.fit, owners, loops)
    known = [reworded(replace(each, relevance=share)) for each, share in zip(found.findings, shares, strict=True)]
    return tuple(sorted(known, key=lambda each: each.negligible))


def _forward(progress: Progress | None) -> Progress:
    """`progress` of a bar that never goes back, though work may be done again."""
    over = 0.0

    def tell(text: str, share: float) -> None:
        nonlocal over
        over = max(over, share)
        if progress is not None:
            progress(text, over)

    return tell
