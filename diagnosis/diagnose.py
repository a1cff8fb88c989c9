"""Which physical effect a model lacks: the whole way from recordings to a verdict.

gate -> fit of the model alone -> screen of all candidates -> quick fits -> full fits and their evidence -> held-out
check -> next effect, with the best one in the model -> is anything left that has no name?

Nothing here is forced: a record that cannot tell gets `insufficient_data`, and what no candidate explains is `unknown`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diagnosis.adequacy import Adequacy, adequacy
from diagnosis.candidates import Candidate
from diagnosis.explain import explain
from diagnosis.gate import check
from diagnosis.masked import fits as fits_of_masked
from diagnosis.masked import surprise
from diagnosis.refit import FullFit, QuickFit, full, quick, surety, with_effect
from diagnosis.screen import Screen, screen
from diagnosis.ties import SIMPLER, TIED, alike, tied
from diagnosis.unseen import Fold, Unseen, folds, judge
from diagnosis.whitened import Whitened
from diagnosis.workspace import Workspace, attached
from estimators.as_recorded import as_recorded
from estimators.contract import EstimationError, ParameterEstimate, Status
from estimators.methods.prediction_error import Fit, result
from estimators.problem import Problem
from estimators.segments import DataError
from models.effect import Effect, Place
from models.model import Model
from telemetry.recording import Recording

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]

LEVEL = 0.01
"""Probability of naming an effect where nothing is missing."""
FURTHER = 0.05
"""Share of what was gained so far that a further effect has to gain: no formula is exact, and a long record tells."""
FURTHER_ALIKE = 0.1
"""The same for an effect that is easily confused with one that was found: it bends its formula."""
WORTH_A_FIT = 1e-3
"""p-value, of one candidate alone, below which it gets a quick fit."""
WORTH = -float(np.log(TIED))
"""Logarithm of the odds to "none" that an effect has to have."""
CONTENDERS = 6
"""Full fits a step, at most."""
CONTENDING = 0.5
"""Share of the best quick fit's gain with which an effect gets a full one: the noise of both is still another's."""


SURE = 2.0
"""Standard deviations from zero of an amplitude that a part of the data tells. One that does not tell cannot judge."""
NOT_TOLD = (Status.TOO_LITTLE_EXCITATION, Status.UNIDENTIFIABLE)
CHECKED = 3
"""Effects, the likeliest first, that are tried on unseen data before none is named."""


class Verdict(StrEnum):
    """What a diagnosis ends with."""

    ADEQUATE = "adequate"
    MISSING_EFFECT = "missing_effect"
    UNKNOWN = "unknown"
    INSUFFICIENT_DATA = "insufficient_data"


@dataclass(frozen=True, slots=True)
class Finding:
    """An effect that the model lacks.

    `probability` among all candidates and none; `p_value` with all candidates looked at; `log_likelihood_gain` over the
    model before; `held_out_gain` (value, std) the same on data that the fit had not seen, None where there are none;
    `odds` of every effect that got a full fit, relative to this one.
    """

    effect: str
    family: str
    parameters: Mapping[str, ParameterEstimate]
    probability: float
    p_value: float
    held_out_error_closed_percent: float | None
    tied_with: tuple[str, ...]
    explanation: str
    log_likelihood_gain: float
    held_out_gain: tuple[float, float] | None
    odds: Mapping[str, float]

    def to_json(self) -> dict[str, Any]:
        """One of `findings` in `diagnose --json`."""
        return {
            "effect": self.effect,
            "family": self.family,
            "parameters": {
                name: {"value": each.value, "std": each.std, "unit": each.unit, "identifiable": each.identifiable}
                for name, each in self.parameters.items()
            },
            "probability": self.probability,
            "p_value": self.p_value,
            "held_out_error_closed_percent": self.held_out_error_closed_percent,
            "tied_with": list(self.tied_with),
            "explanation": self.explanation,
        }


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """The verdict with its `reason`, what was found, and `repaired`, the model with it; `screens` of each step.

    `steps`: the fit of the model alone, then that after each of `findings`. `parts`: those of a vehicle and of its
    actuators that this one is made of (diagnosis.parts), none where it is of one model.
    """

    verdict: Verdict
    reason: str
    findings: tuple[Finding, ...] = ()
    minimum_detectable: Mapping[str, float] | None = None
    suggested_experiment: Mapping[str, Any] | None = None
    innovation_ratio_before: float | None = None
    innovation_ratio_after: float | None = None
    repaired: Model | None = None
    left_out: Mapping[str, str] | None = None
    screens: tuple[Screen, ...] = ()
    steps: tuple[FullFit, ...] = ()
    unexplained: Adequacy | None = None
    parts: tuple[Diagnosis, ...] = ()

    @property
    def adequate(self) -> bool:
        return self.verdict is Verdict.ADEQUATE

    def to_json(self) -> dict[str, Any]:
        """`diagnose --json`."""
        return {
            "adequate": self.adequate,
            "verdict": self.verdict.value,
            "reason": self.reason,
            "findings": [finding.to_json() for finding in self.findings],
            "minimum_detectable": dict(self.minimum_detectable or {}),
            "suggested_experiment": dict(self.suggested_experiment) if self.suggested_experiment else None,
            "innovation_ratio_before": self.innovation_ratio_before,
            "innovation_ratio_after": self.innovation_ratio_after,
            "not_candidates": dict(self.left_out or {}),
        }


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

    `support` rad: the vehicle is free where its roll is less. `candidates`: effects to look for, the whole catalogue by
    default. `most`: effects that are added at most, one after the other. `masked`: effects that parameters of
    the model can take the place of, so that the screen alone does not decide about them (diagnosis.masked). `unasked`:
    parameters that the recordings need not tell. `progress` is told what is being done and
    the share of it that is over, 0 to 1.
    Raises ModelError and EstimationError for a model or names that cannot be; data that cannot be used give a verdict.
    """
    tell = progress or (lambda text, share: None)
    tell("reading the data", 0.0)
    model = as_recorded(model, recordings)
    try:
        check(model, recordings, support)
        workspace = Workspace.of(model, recordings, support, None if candidates is None else tuple(candidates))
    except DataError as error:
        return Diagnosis(Verdict.INSUFFICIENT_DATA, str(error))
    tell("fitting the model as it is", 0.05)
    base = full(model, workspace)
    lacking = unidentified(base, unasked)
    if lacking:
        return Diagnosis(Verdict.INSUFFICIENT_DATA, lacking, left_out=workspace.left_out)
    steps = [base]
    last = base
    findings: list[Finding] = []
    screens: list[Screen] = []
    for step in range(most + 1):
        share = 0.1 + 0.85 * step / (most + 1.0)
        tell("screening all effects" + (f", with {findings[-1].effect} in the model" if findings else ""), share)
        screens.append(_screen(base, workspace))
        surprising = any(score.p_value < LEVEL for score in screens[-1].scores)
        if step == most or not (surprising or (masked and not findings)):
            break
        # Beside an effect that does not quite fit, a lag bends what is left: there the screen has to see it.
        more = unseen_at_zero(workspace) if surprising and not findings else []
        hidden = fits_of_masked(base.model, workspace, {*masked, *more})
        found = _step(base, screens[-1], workspace, hidden, partial(_part, tell, share, 0.85 / (most + 1.0)))
        if found is None:
            break
        finding, fitted = found
        if findings and finding.log_likelihood_gain < _asked(fitted, findings, steps):
            # Too little for a name, but no more unknown than what it bends.
            last = fitted
            break
        last = base = fitted
        findings.append(finding)
        steps.append(base)
    tell("looking for what has no name", 0.95)
    rest = adequacy(steps[0].fit, last.fit, last.log_likelihood - steps[0].log_likelihood)
    return _verdict(steps, findings, screens, rest, workspace)


def _screen(base: FullFit, workspace: Workspace) -> Screen:
    def attach(group: Sequence[Candidate]) -> Problem:
        return workspace.problem(attached(base.model, group))

    return screen(Whitened.of(base.fit), attach, workspace.others(base.model))


def _part(tell: Progress, begin: float, width: float, text: str, share: float) -> None:
    """`share` of one step, which began at `begin` and is `width` of the whole."""
    tell(text, begin + width * share)


def unidentified(base: FullFit, unasked: Collection[str] = ()) -> str:
    """Why the record does not even tell the model's own parameters; empty where it does."""
    told = result(base.fit, 0.0)
    nuisances = {name for each in base.model.inputs for name in each.delays}.union(unasked)
    for name, each in told.parameters.items():
        if name not in nuisances and not each.identifiable:
            return f"{name}: {each.reason}"
    return ""


def _step(
    base: FullFit, screened: Screen, workspace: Workspace, hidden: Sequence[FullFit], tell: Progress
) -> tuple[Finding, FullFit] | None:
    """The effect that explains most, in the model; None where none stands up to a full fit and to unseen data.

    `hidden`: fits with effects that the screen does not see.
    """
    fits = _contenders(base, screened, workspace, hidden, tell)
    # What the screen saw in a neighbour is this effect's, too: the strongest is tested, the best fitting is named.
    names = {each.candidate.name for each in fits if each.candidate}
    p_value = min((each.p_value for each in screened.scores if each.candidate.name in names), default=1.0)
    tries = len(screened.scores)
    p_value = min([p_value, *(tries * surprise(base, each) for each in hidden if each.name in names)])
    if p_value >= LEVEL:
        return None
    for attempt in range(CHECKED):
        if not fits:
            return None
        best = _simplest(fits, base)
        tell(f"checking {best.name} on data that the fit has not seen", 0.9 + 0.03 * attempt)
        unseen = _on_unseen(base, best, workspace)
        if unseen is None or unseen.stands:
            return _finding(base, best, fits, screened, p_value, unseen, workspace), best
        fits = [each for each in fits if each is not best]
    return None


def _contenders(
    base: FullFit, screened: Screen, workspace: Workspace, hidden: Sequence[FullFit], tell: Progress
) -> list[FullFit]:
    """Full fits with the effects that explain most, each better than none, the one with most evidence first."""
    worth = [score for score in screened.scores if score.p_single < WORTH_A_FIT]
    quicks: list[QuickFit] = []
    for number, score in enumerate(worth):
        tell(f"trying {score.candidate.effect.title}", 0.6 * number / len(worth))
        quicks.append(quick(base.fit, base.model, score, workspace))
    quicks = [each for each in quicks if np.isfinite(each.gain) and each.gain > 0.0]
    quicks.sort(key=lambda each: -each.gain)
    chosen = [each for each in quicks if each.gain >= CONTENDING * quicks[0].gain][:CONTENDERS]
    fits = list(hidden)
    chosen = [each for each in chosen if each.candidate.name not in {fit.name for fit in hidden}]
    for number, each in enumerate(chosen):
        tell(f"fitting {each.candidate.effect.title}", 0.6 + 0.3 * number / len(chosen))
        try:
            fits.append(full(with_effect(base.model, each.candidate, each.values), workspace, each.candidate))
        except ArithmeticError:
            continue
    fits = [
        each
        for each in fits
        if each.fit.minimum.converged and each.evidence > base.evidence + WORTH and surety(each) > SURE
    ]
    return sorted(fits, key=lambda each: -each.evidence)


def _finding(
    base: FullFit,
    best: FullFit,
    fits: Sequence[FullFit],
    screened: Screen,
    p_value: float,
    unseen: Unseen | None,
    workspace: Workspace,
) -> Finding:
    assert best.candidate is not None
    odds = {each.name: float(np.exp(np.clip(each.evidence - best.evidence, -700.0, 0.0))) for each in fits}
    none = float(np.exp(max(base.evidence - best.evidence, -700.0)))
    told = result(best.fit, 0.0).parameters
    finding = Finding(
        effect=best.name,
        family=best.candidate.effect.family.value,
        parameters={name: told[name] for name in told if name.startswith(f"{best.name}.")},
        probability=1.0 / (sum(odds.values()) + none),
        p_value=p_value,
        held_out_error_closed_percent=unseen.closed_percent if unseen else None,
        tied_with=tied(best, fits, base, workspace),
        explanation="",
        log_likelihood_gain=best.log_likelihood - base.log_likelihood,
        held_out_gain=(unseen.gain, unseen.std) if unseen else None,
        odds=odds,
    )
    return replace(finding, explanation=explain(finding, best.candidate, screened.score(best.name), screened))


def unseen_at_zero(workspace: Workspace) -> list[str]:
    """Effects on sensors whose amplitude has starts of its own: near zero the record may ask for less of them."""
    return [
        each.effect.name
        for each in workspace.candidates
        if each.effect.place is Place.SENSOR and any(p.amplitude and p.starts for p in each.effect.parameters)
    ]


def _asked(found: FullFit, before: Sequence[Finding], steps: Sequence[FullFit]) -> float:
    """Gain in log likelihood that a further effect has to bring, after those of `steps`."""
    total = sum(each.log_likelihood_gain for each in before)
    assert found.candidate is not None
    one = found.candidate.effect
    neighbours = any(alike(one, each.candidate.effect) for each in steps if each.candidate is not None)
    return total * (FURTHER_ALIKE if neighbours else FURTHER)


def _simplest(fits: Sequence[FullFit], base: FullFit) -> FullFit:
    """The first of `fits`, or one with fewer parameters that explains almost as much."""
    best = fits[0]
    gain = best.log_likelihood - base.log_likelihood
    simple = [
        each for each in fits if each.cost < best.cost and each.log_likelihood - base.log_likelihood >= SIMPLER * gain
    ]
    return min(simple, key=lambda each: (each.cost, -each.log_likelihood)) if simple else best


def _on_unseen(base: FullFit, best: FullFit, workspace: Workspace) -> Unseen | None:
    """What fits of a part of the data say of the rest; None where no part tells the effects that `best` has more."""
    there = {each.name for each in base.model.effects}
    amplitudes = [name for each in best.model.effects if each.name not in there for name in each.amplitudes]
    instants = [p.name for each in best.model.effects if each.name not in there for p in each.parameters
                if p.unit == "s" and p.name not in each.amplitudes]  # fmt: skip
    others = [each.effect for each in workspace.others(base.model)]

    def fits(part: Fold) -> tuple[Fit, Fit] | None:
        few = Workspace.of(base.model, part.seen, workspace.support, others)
        with_it = full(best.model, few).fit
        told = result(with_it, 0.0).parameters
        sure = (
            each.value is not None and each.std is not None and abs(each.value) > SURE * each.std
            for each in told.values()
        )
        known = dict(zip(told, sure, strict=True))
        # What happens once, at an instant outside the part, is nothing that the part could foretell.
        happened = all(told[name].status not in NOT_TOLD for name in instants)
        return (full(base.model, few).fit, with_it) if happened and any(known[name] for name in amplitudes) else None

    try:
        return judge(folds(base.model, workspace.recordings, workspace.support), fits, workspace.support)
    except (EstimationError, ArithmeticError):
        return None


def _verdict(
    steps: list[FullFit],
    findings: list[Finding],
    screens: list[Screen],
    rest: Adequacy,
    workspace: Workspace,
) -> Diagnosis:
    after = rest.after
    if not rest.adequate:
        verdict = Verdict.UNKNOWN
        reason = f"something is missing that no known effect explains. {rest.reason}"
        if findings and not rest.named:
            names = " and ".join(finding.effect for finding in findings)
            reason += f" Nearest comes {names}, which leaves most of it."
            findings, steps, after = [], steps[:1], rest.before
    elif findings:
        verdict = Verdict.MISSING_EFFECT
        reason = "; ".join(finding.explanation for finding in findings)
    else:
        verdict = Verdict.ADEQUATE
        reason = "no known effect, and nothing without a name, would make the innovations smaller than chance does"
    return Diagnosis(
        verdict=verdict,
        reason=reason,
        findings=tuple(findings),
        minimum_detectable={score.candidate.name: score.detectable for score in screens[0].scores},
        innovation_ratio_before=rest.before,
        innovation_ratio_after=after,
        repaired=steps[-1].fitted,
        left_out=workspace.left_out,
        screens=tuple(screens),
        steps=tuple(steps),
        unexplained=rest,
    )
