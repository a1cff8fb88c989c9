"""A vehicle diagnosed part by part: the chain from setpoint to motion is measured in between, so each link has a model.

The vehicle's own model is driven by the measured motion of its actuators, and does not see what a command meets on its
way; a model of the actuators alone sees nothing else. Both are diagnosed, and the findings are one list, the one with
most evidence first. No effect is a candidate in both.

An actuator's speed loop is not known beforehand. Of several models the one is taken that explains a part of the record
best, alone or with an effect that takes the place of its order: a lag and a further lag look like a loop of second
order. Where none of them is adequate, nothing is said of the command, and the verdict is that on the vehicle.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from diagnosis import masked
from diagnosis.diagnose import WORTH, Diagnosis, Progress, Verdict, diagnose
from diagnosis.floor import sensor_noise
from diagnosis.refit import FullFit, full
from diagnosis.workspace import Workspace
from estimators.segments import SUPPORT_MARGIN, DataError, channels_of
from models.effect import Effect, Place
from models.effects import CATALOGUE, find
from models.model import Model
from telemetry.recording import Recording

LAG = "speed_loop_lag"
MASKED = ("input_delay", "actuator_lag")
"""Effects that the lag of a speed loop takes the place of."""
AWAY = 2.0
"""s after the vehicle has left its support from which on its actuators are no longer at their limits."""
LOOKED_AT = 8.0
"""s of a record that tell which speed loop it is."""
NEAR = 1.75
"""Times its sensor's noise that the innovations of a speed loop have where nothing large is missing in it."""
ENOUGH = 20.0
"""s of each recording that the actuators are diagnosed from: their sensors hardly have noise."""
MOST = 2
"""Effects of a command, at most."""
FORMULA = 0.1
"""Share of its own lag to which the formula of a speed loop holds: a further lag that is less is part of it."""
SHARE = 0.6
"""Of the time that both diagnoses take, for the vehicle's own."""


def diagnose_parts(
    vehicle: Model,
    actuators: Sequence[Model],
    recordings: Sequence[Recording],
    *,
    support: float | None = None,
    candidates: Iterable[str | Effect] | None = None,
    most: int = 3,
    progress: Progress | None = None,
) -> Diagnosis:
    """What `vehicle`, driven by measured motion, and the one of `actuators` that fits lack to explain `recordings`.

    As diagnosis.diagnose.diagnose. The result is that of the vehicle, with the findings and detectable sizes of both;
    its `parts` are the two alone. Where the actuators' effect comes first, the innovation ratios are theirs.
    """
    tell = progress or (lambda text, share: None)
    looked_for = [find(each) if isinstance(each, str) else each for each in (candidates or CATALOGUE)]
    own = diagnose(
        vehicle,
        recordings,
        support=support,
        candidates=candidates,
        most=most,
        progress=lambda text, share: tell(text, SHARE * share),
    )
    commanded = [each for each in looked_for if each.place is Place.ACTUATOR]
    if not commanded or own.verdict is Verdict.INSUFFICIENT_DATA:
        return own
    other = diagnose_actuators(
        actuators,
        recordings,
        support=support,
        candidates=commanded,
        most=most,
        progress=lambda text, share: tell(f"actuators: {text}", SHARE + (1.0 - SHARE) * share),
    )
    return merged(own, other, commanded)


def diagnose_actuators(
    actuators: Sequence[Model],
    recordings: Sequence[Recording],
    *,
    support: float | None = None,
    candidates: Sequence[Effect],
    most: int = MOST,
    progress: Progress | None = None,
) -> Diagnosis:
    """What the one of `actuators` that fits `recordings` lacks of `candidates`."""
    if progress is not None:
        progress("choosing the speed loop", 0.0)
    free = looked_at(actuators[0], recordings, support)
    try:
        model, hidden = speed_loop(actuators, free, candidates)
    except (DataError, ArithmeticError) as error:
        return Diagnosis(Verdict.INSUFFICIENT_DATA, str(error))
    found = diagnose(
        model,
        free,
        candidates=candidates,
        most=min(most, MOST),
        masked=hidden,
        unasked=model.values,
        progress=progress,
    )
    return beyond_formula(model, found)


def looked_at(model: Model, recordings: Sequence[Recording], support: float | None) -> list[Recording]:
    """What of `recordings` the diagnosis of an actuator's `model` rests on."""
    return [middle(away_from_support(each, model, support), model, ENOUGH) for each in recordings]


def away_from_support(recording: Recording, model: Model, support: float | None) -> Recording:
    """`recording` with the model's outputs known only where the vehicle has been free for AWAY s."""
    if support is None or "roll" not in recording.values:
        return recording
    carried = ~(np.abs(recording["roll"]) < support - SUPPORT_MARGIN)
    time = recording.time
    last = np.maximum.accumulate(np.where(carried, time, -np.inf))
    away = time - last > AWAY
    there = [each.name for each in model.outputs if each.name in recording.values]
    hidden = {name: np.where(away, recording[name], np.nan) for name in there}
    return replace(recording, values={**recording.values, **hidden})


def speed_loop(
    actuators: Sequence[Model], recordings: Sequence[Recording], effects: Sequence[Effect]
) -> tuple[Model, tuple[str, ...]]:
    """The model that explains LOOKED_AT s best, and which of MASKED may be missing there.

    Raises DataError where the recordings cannot be used, ArithmeticError where no model can be fitted to them.
    """
    few = [middle(recordings[0], actuators[0], LOOKED_AT)]
    bases = []
    for model in actuators:
        workspace = Workspace.of(model, few, None, effects)
        try:
            bases.append((full(model, workspace), workspace))
        except ArithmeticError:
            continue
    if not bases:
        raise ArithmeticError("no model of the actuators can be fitted")
    nearest = min((alone for alone, _ in bases), key=_over_noise)
    if _over_noise(nearest) < NEAR:
        return nearest.model, ()
    tried = [_tried(alone, workspace, effects) for alone, workspace in bases]
    return max(tried, key=lambda each: each[0])[1:]


def _tried(alone: FullFit, workspace: Workspace, effects: Sequence[Effect]) -> tuple[float, Model, tuple[str, ...]]:
    """The evidence for a model with the effects that suit it best, the model, and which of MASKED are among them."""
    fits = masked.fits(alone.model, workspace, [each.name for each in effects if each.name in MASKED])
    worth = tuple(each.name for each in fits if each.evidence > alone.evidence + WORTH and not _small(each.fitted))
    fits += masked.together(alone.model, workspace, [each.name for each in effects if each.name not in MASKED])
    return max(each.evidence for each in (alone, *fits)) - _order(alone), alone.model, worth


def _over_noise(alone: FullFit) -> float:
    """The innovations' standard deviation over the sensor's, of the last output: the actuators' own motion."""
    return float(np.sqrt(alone.fit.covariance[-1, -1]) / sensor_noise(alone.fit.problem)[0][-1])


def _order(alone: FullFit) -> float:
    """What a model's own parameters have to gain."""
    rows = sum(map(len, alone.fit.problem.segments))
    return 0.5 * len(alone.fit.problem.free) * float(np.log(rows))


def middle(recording: Recording, model: Model, span: float) -> Recording:
    """`recording` with the model's outputs known for `span` s in the middle of what is."""
    there = [each for each in channels_of(model) if each in recording.values]
    known = np.all([np.isfinite(recording[each]) for each in there], axis=0)
    if len(there) < len(channels_of(model)) or not known.any():
        return recording
    centre = float(np.median(recording.time[known]))
    inside = np.abs(recording.time - centre) <= 0.5 * span
    hidden = {each.name: np.where(inside, recording[each.name], np.nan) for each in model.outputs}
    return replace(recording, values={**recording.values, **hidden})


def beyond_formula(model: Model, found: Diagnosis) -> Diagnosis:
    """`found` but for what is no more than the formula's own error: a lag below FORMULA of that of the speed loop.

    A delay shows beyond what bus and drive may take anyway: the bound of the setpoint's own offset.
    """
    if found.minimum_detectable is None:
        return found
    allowed = max(model.parameter(name).upper for each in model.inputs for name in each.delays)
    sizes = dict(found.minimum_detectable)
    effects = {score.candidate.name: score.candidate.effect for each in found.screens for score in each.scores}
    for name in sizes.keys() & effects.keys():
        if effects[name].delay:
            sizes[name] = allowed
        if effects[name].lag:
            sizes[name] = max(sizes[name], FORMULA * model.parameter(LAG).value)
    small = found.repaired is not None and _small(found.repaired)
    findings = tuple(
        each for each in found.findings if not (small and each.effect in effects and effects[each.effect].lag)
    )
    verdict = found.verdict
    if verdict is Verdict.MISSING_EFFECT and not findings:
        verdict = Verdict.ADEQUATE
    return replace(found, minimum_detectable=sizes, findings=findings, verdict=verdict)


def _small(fitted: Model) -> bool:
    """Whether a further lag in `fitted` is less than the formula's own error; False where there is none."""
    lags = [each.qualified(each.effect.lag) for each in fitted.effects if each.effect.lag]
    return any(fitted.parameter(name).value < FORMULA * fitted.parameter(LAG).value for name in lags)


def merged(vehicle: Diagnosis, actuators: Diagnosis, effects: Sequence[Effect]) -> Diagnosis:
    """One diagnosis of two parts. `effects`: those of the actuators."""
    left_out = {name: why for name, why in (vehicle.left_out or {}).items() if name not in {e.name for e in effects}}
    left_out |= actuators.left_out or {}
    if actuators.verdict in (Verdict.UNKNOWN, Verdict.INSUFFICIENT_DATA):
        why = f"the actuators' speed loop is none that is known: {actuators.reason}"
        left_out |= {each.name: why for each in effects}
        return replace(vehicle, left_out=left_out, parts=(vehicle, actuators))
    findings = sorted((*vehicle.findings, *actuators.findings), key=lambda each: -each.log_likelihood_gain)
    first = actuators if findings and findings[0] in actuators.findings else vehicle
    verdict, reason = vehicle.verdict, vehicle.reason
    if actuators.findings:
        verdict = Verdict.MISSING_EFFECT if verdict is Verdict.ADEQUATE else verdict
        told = [each.explanation for each in findings]
        reason = "; ".join([reason, *told] if vehicle.verdict is Verdict.UNKNOWN else told)
    return replace(
        vehicle,
        verdict=verdict,
        reason=reason,
        findings=tuple(findings),
        minimum_detectable={**(vehicle.minimum_detectable or {}), **(actuators.minimum_detectable or {})},
        innovation_ratio_before=first.innovation_ratio_before,
        innovation_ratio_after=first.innovation_ratio_after,
        left_out=left_out,
        parts=(vehicle, actuators),
    )
