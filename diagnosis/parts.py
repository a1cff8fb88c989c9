"""Diagnoses a vehicle in two parts: the chain from setpoint to motion is measured in between, so each link has a model.

The vehicle's own model is driven by the measured motion of its actuators, and does not see what happens to a command on
its way to them; a model of the actuators alone sees nothing else. Both are diagnosed, and the findings form one list,
the one with most evidence first. Effects of an input are candidates in both: of the setpoint in the actuators' model,
and of the measured motion in the vehicle's, if they act between the motor, at which the motion is measured, and the
vehicle.

An actuator's speed loop is not known beforehand (diagnosis.fits.speed_loop_choice). If no known speed loop is adequate,
nothing is said of the command, and the whole is not adequate either.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

from upright.diagnosis.diagnose import Diagnosis, Finding, Progress, Verdict, diagnose
from upright.diagnosis.explain import together
from upright.diagnosis.fits.speed_loop_choice import lag_error, over_noise, small, speed_loop
from upright.diagnosis.prediction.closed_loop_error import Loop
from upright.diagnosis.prepare.actuator_samples import as_recorded_rows, at_samples, looked_at, on_time
from upright.diagnosis.search.one_more import with_explanation
from upright.diagnosis.trial import FAILURES
from upright.estimators.data.segments import DataError
from upright.estimators.stopwatch import stopwatch
from upright.models.effect import Effect
from upright.models.effects.catalogue import CATALOGUE, find
from upright.models.model import Model
from upright.models.parts import Place
from upright.telemetry.recording import Recording

FITS = 2.0
"""Ratio of the innovations of the actuators' rate, with the findings in the model, to its sensor's noise above which no
known speed loop fits.

It was 1.32 with a delay of 24 ms, with which the vehicle swings, and 3 and more with backlash.
"""
MOST = 2
"""Effects of a command, at most."""
SHARE = 0.6
"""Share of the time of both diagnoses for the vehicle's own."""


def diagnose_parts(
    vehicle: Model,
    actuators: Sequence[Model],
    recordings: Sequence[Recording],
    *,
    support: float | None = None,
    candidates: Iterable[str | Effect] | None = None,
    most: int = 3,
    budget: float | None = None,
    loops: Sequence[Loop | str] = (),
    progress: Progress | None = None,
) -> Diagnosis:
    """What `vehicle`, driven by measured motion, and the one of `actuators` that fits lack to explain `recordings`.

    Arguments as of diagnosis.diagnose.diagnose. The result is that of the vehicle, with the findings and the minimum
    detectable effects of both; its `parts` are the two alone. If the actuators' effect comes first, the innovation
    ratios are theirs.
    """
    began, report = stopwatch(), progress or (lambda text, share: None)
    looked_for = [find(each) if isinstance(each, str) else each for each in (candidates or CATALOGUE)]
    own = diagnose(
        vehicle,
        recordings,
        support=support,
        candidates=candidates,
        most=most,
        budget=None if budget is None else SHARE * budget,
        loops=loops,
        progress=lambda text, share: report(text, SHARE * share),
    )
    commanded = [each for each in looked_for if each.place is Place.ACTUATOR]
    if not commanded or own.verdict is Verdict.INSUFFICIENT_DATA:
        return own
    left = None if budget is None else max((1.0 - SHARE) * budget, budget - (stopwatch() - began))
    other = diagnose_actuators(
        actuators,
        recordings if own.revised is None else on_time(recordings, own.revised),
        support=support,
        candidates=commanded,
        most=most,
        budget=left,
        progress=lambda text, share: report(f"actuators: {text}", SHARE + (1.0 - SHARE) * share),
    )
    return merged(own, other, commanded)


def diagnose_actuators(
    actuators: Sequence[Model],
    recordings: Sequence[Recording],
    *,
    support: float | None = None,
    candidates: Sequence[Effect],
    most: int = MOST,
    budget: float | None = None,
    progress: Progress | None = None,
) -> Diagnosis:
    """Which of `candidates` the one of `actuators` that fits lacks to explain `recordings`."""
    began = stopwatch()
    if progress is not None:
        progress("choosing the speed loop", 0.0)
    known, actuators = actuators, [at_samples(each) for each in actuators]
    free = looked_at(actuators[0], recordings, support)
    try:
        model, hidden = speed_loop(actuators, free, candidates)
    except DataError as error:
        return Diagnosis(Verdict.INSUFFICIENT_DATA, str(error))
    except FAILURES as error:
        return Diagnosis(Verdict.UNKNOWN, str(error))
    left = None if budget is None else max(0.0, budget - (stopwatch() - began))
    found = diagnose(
        model,
        free,
        candidates=candidates,
        most=min(most, MOST),
        confounded=hidden,
        not_required=model.values,
        budget=left,
        progress=progress,
    )
    found = quiet(beyond_formula(model, found))
    if found.revised is None:
        return found
    shipped = next(each for each in known if each.name == found.revised.name)
    return replace(found, revised=as_recorded_rows(shipped, found.revised))


def quiet(found: Diagnosis) -> Diagnosis:
    """`found`, but unknown if process noise explains innovations that are not near the sensor's own noise.

    If they are near it, the findings are what is missing: no formula of a speed loop is exact at all frequencies.
    """
    if not found.steps:
        return found
    over = over_noise(found.steps[-1])
    if over < FITS:
        if not found.findings:
            return found
        return replace(found, verdict=Verdict.MISSING_EFFECT, reason=together(found.findings))
    if found.verdict is Verdict.UNKNOWN:
        return found
    reason = f"the innovations of the actuators' rate are {over:.2g} times its sensor's noise"
    return replace(found, verdict=Verdict.UNKNOWN, reason=reason)


def beyond_formula(model: Model, found: Diagnosis) -> Diagnosis:
    """`found` without what is no more than the formula's own error: a lag below that share of the speed loop's.

    A lag may be off by that much beyond what its fit says, at two standard deviations. A delay shows only beyond what
    bus and drive may take anyway: the bound of the setpoint's own offset.
    """
    if found.minimum_detectable is None:
        return found
    allowed = max(model.parameter(name).upper for each in model.inputs for name in each.delays)
    sizes = dict(found.minimum_detectable)
    effects = {score.candidate.name: score.candidate.effect for each in found.score_tests for score in each.scores}
    for name in sizes.keys() & effects.keys():
        if effects[name].delay:
            sizes[name] = allowed
        if effects[name].lag:
            sizes[name] = max(sizes[name], lag_error(model))
    below = found.revised is not None and small(found.revised)
    lags = {name for name, effect in effects.items() if effect.lag}
    with_possible_noise = 0.5 * lag_error(model)
    findings = tuple(
        _less_certain(each, with_possible_noise) if each.effect in lags else each
        for each in found.findings
        if not (below and each.effect in lags)
    )
    verdict = found.verdict
    if verdict is Verdict.MISSING_EFFECT and not findings:
        verdict = Verdict.ADEQUATE
    return replace(found, minimum_detectable=sizes, findings=findings, verdict=verdict)


def _less_certain(finding: Finding, std: float) -> Finding:
    """`finding` with a further error, of standard deviation `std`, of its amplitudes."""
    parameters = {
        name: each if each.std is None else replace(each, std=math.hypot(each.std, std))
        for name, each in finding.parameters.items()
    }
    return with_explanation(replace(finding, parameters=parameters))


def merged(vehicle: Diagnosis, actuators: Diagnosis, effects: Sequence[Effect]) -> Diagnosis:
    """One diagnosis of two parts. `effects`: those of the actuators.

    If the actuators follow no known speed loop, the whole is not adequate.
    """
    left_out = {name: why for name, why in (vehicle.left_out or {}).items() if name not in {e.name for e in effects}}
    left_out |= actuators.left_out or {}
    untried = (*vehicle.untried, *(f"actuators: {each}" for each in actuators.untried))
    contradicted = (*vehicle.contradicted, *actuators.contradicted)
    parts = (vehicle, actuators)
    vehicle = replace(vehicle, left_out=left_out, untried=untried, contradicted=contradicted, parts=parts)
    verdict, reason = vehicle.verdict, vehicle.reason
    if actuators.verdict in (Verdict.UNKNOWN, Verdict.INSUFFICIENT_DATA):
        why = f"the actuators follow no known speed loop: {actuators.reason}"
        vehicle = replace(vehicle, left_out=left_out | {each.name: why for each in effects})
        if actuators.verdict is Verdict.UNKNOWN:
            # The findings in the vehicle's motion need no command; but the rest is not called adequate.
            reason = why if verdict is Verdict.ADEQUATE else f"{reason}; {why}"
            verdict = Verdict.UNKNOWN if verdict is Verdict.ADEQUATE else verdict
        return replace(vehicle, verdict=verdict, reason=reason)
    both = (*vehicle.findings, *actuators.findings)
    findings = sorted(both, key=lambda each: (each.negligible, -each.log_likelihood_gain))
    first = actuators if findings and findings[0] in actuators.findings else vehicle
    if actuators.findings:
        verdict = Verdict.MISSING_EFFECT if verdict is Verdict.ADEQUATE else verdict
        text = together(findings)
        reason = f"{reason}; {text}" if vehicle.verdict is Verdict.UNKNOWN else text
    return replace(
        vehicle,
        verdict=verdict,
        reason=reason,
        findings=tuple(findings),
        minimum_detectable={**(vehicle.minimum_detectable or {}), **(actuators.minimum_detectable or {})},
        innovation_ratio_before=first.innovation_ratio_before,
        innovation_ratio_after=first.innovation_ratio_after,
    )
