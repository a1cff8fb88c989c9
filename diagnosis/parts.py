"""A vehicle diagnosed part by part: the chain from setpoint to motion is measured in between, so each link has a model.

The vehicle's own model is driven by the measured motion of its actuators, and does not see what a command meets on its
way; a model of the actuators alone sees nothing else. Both are diagnosed, and the findings are one list, the one with
most evidence first. No effect is a candidate in both.

An actuator's speed loop is not known beforehand. Of several models the one is taken that explains a part of the record
best, alone or with an effect that takes the place of its order: a lag and a further lag look like a loop of second
order. Nor is the ramp known with which the drives follow: where it is at work for longer than a row, the one is taken
that explains most. Where no loop is adequate nothing is said of the command, and the whole is not adequate either.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import minimize_scalar

from diagnosis import masked
from diagnosis.diagnose import Diagnosis, Progress, Verdict, diagnose
from diagnosis.floor import sensor_noise
from diagnosis.refit import FullFit, full
from diagnosis.step import WORTH, retold
from diagnosis.workspace import Workspace
from estimators.segments import SUPPORT_MARGIN, DataError, channels_of
from models.effect import Effect, Place
from models.effects import CATALOGUE, find
from models.model import Model
from telemetry.recording import Recording

LAG = "speed_loop_lag"
AGE = "drive_age"
"""Channel, s."""
MASKED = ("input_delay", "actuator_lag")
"""Effects that the lag of a speed loop takes the place of."""
AWAY = 2.0
"""s after the vehicle has left its support from which on its actuators are no longer at their limits."""
LOOKED_AT = 8.0
"""s of a record that tell which speed loop it is."""
NEAR = 1.5
"""Times its sensor's noise that the innovations of a speed loop have where nothing large is missing in it.

The right loop had 1.07 to 1.41 on eleven clean records of the virtual vehicle (seven of multisine, one each of sweep,
square, step and rest), and the next one 1.62 and more. With all parameters free it had 1.05 to 1.18."""
FITS = 2.0
"""The same with what was found, beyond which the speed loop is none that is known.

It was 1.32 beside a delay of 24 ms, with which the vehicle swings, and 3 and more with play."""
ENOUGH = 20.0
"""s of each recording that the actuators are diagnosed from: their sensors hardly have noise."""
MOST = 2
"""Effects of a command, at most."""
FORMULA = 0.06
"""Share of its own lag to which the formula of a speed loop holds: a further lag that is less is part of it.

On the same eleven records a further lag came out as 0 to 0.038 of the speed loop's."""
LONGER = 0.01
"""Share of the rows in which the drives' ramp takes longer than the row from which on its shape counts."""
SLOWER = 3.0
"""Times that a ramp may be slower than the fastest that takes longer than a row."""
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
    actuators = [_at_samples(each) for each in actuators]
    free = looked_at(actuators[0], recordings, support)
    try:
        model, hidden = speed_loop(actuators, free, candidates)
    except DataError as error:
        return Diagnosis(Verdict.INSUFFICIENT_DATA, str(error))
    except ArithmeticError as error:
        return Diagnosis(Verdict.UNKNOWN, str(error))
    most = min(most, MOST)
    found = diagnose(
        model, free, candidates=candidates, most=most, masked=hidden, unasked=model.values, progress=progress
    )
    if 0 < len(found.findings) < most:
        found = _further(found, free, candidates)
    return quiet(beyond_formula(model, found))


def quiet(found: Diagnosis) -> Diagnosis:
    """`found`, but unknown where process noise explains innovations that are not near the sensor's own.

    Where they are near it, what was found is what is missing: no formula of a speed loop is exact at all frequencies.
    """
    if not found.steps:
        return found
    over = _over_noise(found.steps[-1])
    if over < FITS:
        if not found.findings:
            return found
        reason = "; ".join(each.explanation for each in found.findings)
        return replace(found, verdict=Verdict.MISSING_EFFECT, reason=reason)
    if found.verdict is Verdict.UNKNOWN:
        return found
    reason = f"the innovations of the actuators' rate are {over:.2g} times its sensor's noise"
    return replace(found, verdict=Verdict.UNKNOWN, reason=reason)


def _further(found: Diagnosis, recordings: Sequence[Recording], candidates: Sequence[Effect]) -> Diagnosis:
    """`found` and one effect more, where there is one that chance does not explain.

    Of a vehicle a further effect has to gain a share of what the first did, for no formula is exact. That of a speed
    loop is: beside delays that gained 5000 to 7000 nothing else had more than 0.5 to gain, and a dead band of 0.1
    mrad/s had 10.
    """
    model = found.repaired
    assert model is not None
    there = {each.effect.name for each in model.effects}
    others = [each for each in candidates if each.name not in there]
    more = diagnose(model, recordings, candidates=others, most=1, unasked=model.values)
    if not more.findings:
        return found
    steps = (*found.steps, more.steps[-1])
    findings = tuple(retold(each, steps[-1]) for each in (*found.findings, *more.findings))
    named = Verdict.MISSING_EFFECT in (found.verdict, more.verdict)
    return replace(
        more,
        verdict=Verdict.MISSING_EFFECT if named else Verdict.UNKNOWN,
        reason="; ".join(each.explanation for each in findings) if named else more.reason,
        findings=findings,
        minimum_detectable=found.minimum_detectable,
        innovation_ratio_before=found.innovation_ratio_before,
        left_out=found.left_out,
        screens=(*found.screens, *more.screens),
        steps=steps,
    )


def looked_at(model: Model, recordings: Sequence[Recording], support: float | None) -> list[Recording]:
    """What of `recordings` the diagnosis of an actuator's `model` rests on, its setpoints later by the drives' age."""
    return [_setpoints_later(middle(away_from_support(each, model, support), model, ENOUGH)) for each in recordings]


def _at_samples(model: Model) -> Model:
    """`model` with a row where the drives are sampled, and its setpoints as much later as the samples are older.

    Read between two samples by a straight line, a rate would lose what is fastest in it: that passed for a further lag
    of 2 ms, and for a noise that is not white.
    """
    inputs = tuple(replace(each, age=AGE) for each in model.inputs)
    return replace(model, inputs=inputs, outputs=tuple(replace(each, age="") for each in model.outputs))


def _setpoints_later(recording: Recording) -> Recording:
    """`recording` with ages that are those of the setpoints, as seen from the drives' samples: negative."""
    if AGE not in recording.values:
        return recording
    return replace(recording, values={**recording.values, AGE: -recording[AGE]})


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
    """The model that explains LOOKED_AT s best, with the ramp that does, and which of MASKED may be missing there.

    Raises DataError where the recordings cannot be used, ArithmeticError where no model can be fitted to them.
    """
    few = [middle(recordings[0], actuators[0], LOOKED_AT)]
    best, hidden = _nearest(actuators, few, effects)
    model = actuators[[each.name for each in actuators].index(best.model.name)]
    ramp = own_ramp(best, few)
    return _all_free(model if ramp is None else _with_ramp(model, ramp)), hidden


def _all_free(model: Model) -> Model:
    """`model` with all parameters estimated that are not exactly known: few tell loops apart, all are what one is."""
    return model.change(estimated=[each.name for each in model.parameters if each.std > 0.0])


def _nearest(
    actuators: Sequence[Model], few: Sequence[Recording], effects: Sequence[Effect]
) -> tuple[FullFit, tuple[str, ...]]:
    """The likeliest fit, maybe with an effect of MASKED, and all of these that may be missing in its model."""
    bases = []
    for model in actuators:
        workspace = Workspace.of(model, few, None, effects)
        try:
            bases.append((full(model, workspace), workspace))
        except ArithmeticError:
            continue
    if not bases:
        raise ArithmeticError("no model of the actuators can be fitted")
    nearest = min(bases, key=lambda each: _over_noise(each[0]))
    chosen = [nearest] if _over_noise(nearest[0]) < NEAR else bases
    tried = [_tried(alone, workspace, effects) for alone, workspace in chosen]
    return max(tried, key=lambda each: each[0])[1:]


def _tried(alone: FullFit, workspace: Workspace, effects: Sequence[Effect]) -> tuple[float, FullFit, tuple[str, ...]]:
    """The evidence for a model with the effects that suit it best, its likeliest fit with at most one of MASKED, and
    which of these may be missing in it."""
    fits = masked.fits(alone.model, workspace, [each.name for each in effects if each.name in MASKED])
    worth = [each for each in fits if each.evidence > alone.evidence + WORTH and not _small(each.fitted)]
    wider = masked.together(alone.model, workspace, [each.name for each in effects if each.name not in MASKED])
    evidence = max(each.evidence for each in (alone, *fits, *wider)) - _order(alone)
    return evidence, max((alone, *worth), key=lambda each: each.evidence), tuple(each.name for each in worth)


def own_ramp(found: FullFit, recordings: Sequence[Recording]) -> float | None:
    """The ramp, unit/s^2, with which the model of `found` explains `recordings` best; None where it is none of theirs.

    A ramp that is over within its row does what any other does, times a number. One that takes longer has a shape.
    """
    ramped = [each for each in found.model.inputs if each.ramp_of]
    changes = [np.abs(np.diff(each[ramped[0].channel])) / np.diff(each.time) for each in recordings if ramped]
    if not changes:
        return None
    fastest, usual = float(np.nanmax(np.concatenate(changes))), ramped[0].ramp
    if np.mean(np.concatenate(changes) > usual) < LONGER:
        return None
    start = found.fitted

    def cost(logarithm: float) -> float:
        model = _with_ramp(start, float(np.exp(logarithm)))
        try:
            return -full(model, Workspace.of(model, recordings, None, ())).log_likelihood
        except ArithmeticError:
            return np.inf

    # Steep on both sides within a tenth of the right one, and near nothing far from it: so it is looked for closely.
    bounds = (float(np.log(min(usual, fastest) / SLOWER)), float(np.log(fastest)))
    return float(np.exp(minimize_scalar(cost, bounds=bounds, method="bounded", options={"xatol": 2e-3}).x))


def _with_ramp(model: Model, ramp: float) -> Model:
    return replace(model, inputs=tuple(replace(each, ramp=ramp) if each.ramp_of else each for each in model.inputs))


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
    """One diagnosis of two parts. `effects`: those of the actuators.

    Where these follow no known speed loop the whole is not adequate.
    """
    left_out = {name: why for name, why in (vehicle.left_out or {}).items() if name not in {e.name for e in effects}}
    left_out |= actuators.left_out or {}
    verdict, reason = vehicle.verdict, vehicle.reason
    if actuators.verdict in (Verdict.UNKNOWN, Verdict.INSUFFICIENT_DATA):
        why = f"the actuators' speed loop is none that is known: {actuators.reason}"
        left_out |= {each.name: why for each in effects}
        if actuators.verdict is Verdict.UNKNOWN:
            # What was found in the vehicle's motion needs no command; but nothing else is said to be all right.
            reason = why if verdict is Verdict.ADEQUATE else f"{reason}; {why}"
            verdict = Verdict.UNKNOWN if verdict is Verdict.ADEQUATE else verdict
        return replace(vehicle, verdict=verdict, reason=reason, left_out=left_out, parts=(vehicle, actuators))
    findings = sorted((*vehicle.findings, *actuators.findings), key=lambda each: -each.log_likelihood_gain)
    first = actuators if findings and findings[0] in actuators.findings else vehicle
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
