"""Predict the vehicle's own experiments, and choose which of them to run next.

This connects the control loop (controller, excitation, limits of the vehicle file) with `diagnosis.next_experiment`,
which is independent of vehicles. The prediction of the loop is in the package of each kind of vehicle.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from upright.diagnosis.diagnose import Diagnosis, Verdict
from upright.diagnosis.next_experiment import Choice, Progress, expected_log_odds, suggest
from upright.diagnosis.prediction.closed_loop import Experiment, simulate
from upright.diagnosis.rivals import NOTHING_MORE, Rival, fitted, fitted_rivals, with_named
from upright.diagnosis.trial import FAILURES
from upright.estimators.budget import UNLIMITED, Budget, OutOfTime
from upright.models.model import Model
from upright.models.parts import ModelError
from upright.telemetry.errors import UprightError
from upright.telemetry.recording import Recording
from upright.vehicles import registry
from upright.vehicles.experiment.excitation import ExcitationError
from upright.vehicles.sections import REST, VehicleFile

SMALL = 0.03
"""Share of its typical size with which an effect is simulated to find its minimum detectable size."""
MOST_RIVALS = 4
MOST_UNDETECTABLE = 3
"""Number of possibly missed effects that are considered."""
DETECTABLE = 10.8
"""Expected rise of the log-likelihood, nats, of the smallest effect that is found with 99 % probability at 1 % false
alarms: (2 x 2.33)^2 / 2."""


def experiments_of(vehicle: VehicleFile) -> tuple[list[Experiment], dict[str, str]]:
    """The experiments of a vehicle file that can be predicted, and the reasons against the others by name."""
    prediction = registry.of(vehicle.vehicle.kind).prediction()
    predict = prediction.of(vehicle)
    found, left_out = [], {}
    for name, section in vehicle.experiments.items():
        if section.excitation == "none":
            left_out[name] = "has no excitation"
        elif section.at == REST or not section.gets_up:
            left_out[name] = "starts on a support, which the models do not include"
        else:
            try:
                found.append(predict(name))
            except ExcitationError as error:
                left_out[name] = str(error)
    return found, left_out


def suggest_for(
    vehicle: VehicleFile,
    diagnosis: Diagnosis,
    model: Model,
    recordings: Sequence[Recording],
    progress: Progress | None = None,
    budget: Budget = UNLIMITED,
) -> Mapping[str, Any] | None:
    """The experiment after a `diagnosis` of `model` from `recordings`, as `Diagnosis.suggested_experiment`.

    It shall separate tied effects. If no effect was found, it shall show the largest that may have been missed. If the
    recordings could not be used, it shall separate dry and viscous friction. None if there is no open question, if no
    experiment of the vehicle answers it, or if the vehicle's loop cannot be predicted with this model.
    Raises OutOfTime after `budget`.
    """

    def report(text: str, share: float) -> None:
        budget.check()
        if progress is not None:
            progress(text, share)

    try:
        return _suggestion(vehicle, diagnosis, model, recordings, report, budget)
    except OutOfTime:
        raise
    except (UprightError, *FAILURES):
        # A diagnosis is useful even without a suggestion.
        return None


def _suggestion(
    vehicle: VehicleFile,
    diagnosis: Diagnosis,
    model: Model,
    recordings: Sequence[Recording],
    progress: Progress,
    budget: Budget,
) -> Mapping[str, Any] | None:
    if diagnosis.verdict is Verdict.INSUFFICIENT_DATA:
        return _as_json(
            separating(
                vehicle, model, registry.of(vehicle.vehicle.kind).prediction().hardest_to_separate, progress=progress
            )
        )
    revised = diagnosis.revised
    if revised is None:
        return None
    experiments = _predictable(vehicle, revised)
    if diagnosis.findings:
        tied = next((finding for finding in diagnosis.findings if finding.tied_with), None)
        if tied is None:
            return None
        names = [tied.effect, *sorted(tied.tied_with, key=lambda name: -tied.odds[name])][:MOST_RIVALS]
        rivals = fitted_rivals(revised.remove(tied.effect), recordings, vehicle.support, names, budget)
        return _as_json(suggest(rivals, experiments, progress)) if len(rivals) > 1 else None
    if diagnosis.verdict is Verdict.ADEQUATE:
        bare = fitted(revised, recordings, vehicle.support, budget)
        for effect, size in _undetectable(revised, diagnosis.minimum_detectable or {})[:MOST_UNDETECTABLE]:
            missed = replace(bare, name=effect, model=_with(bare.model, effect, size))
            found = suggest((missed, bare), experiments, progress)
            if found.best is not None:
                return found.best.to_json()
    return None


def separating(
    vehicle: VehicleFile,
    model: Model,
    effects: Sequence[str],
    recordings: Sequence[Recording] = (),
    progress: Progress | None = None,
) -> Choice:
    """The experiment that separates `effects`, with sizes from `recordings`, or else with minimum detectable sizes.

    Raises ModelError for an effect that the model cannot have, and DataError for recordings that cannot be used.
    """
    bare, experiments = model, _predictable(vehicle, model)
    for name in effects:
        if any(attached.name == name for attached in bare.effects):
            bare = bare.remove(name)
    if recordings:
        return suggest(fitted_rivals(bare, recordings, vehicle.support, effects), experiments, progress)
    bare = registry.of(vehicle.vehicle.kind).prediction().assumed(bare)
    alone = Rival.assumed(NOTHING_MORE, bare)
    rivals = [_just_visible(bare, name, alone, experiments) for name in effects]
    return suggest(rivals, experiments, progress)


def _as_json(choice: Choice) -> Mapping[str, Any] | None:
    return choice.best.to_json() if choice.best is not None else None


def _predictable(vehicle: VehicleFile, model: Model) -> list[Experiment]:
    """The experiments of a vehicle. Raises ModelError if its controller and `model` do not fit together."""
    require_predictable(vehicle, model)
    return experiments_of(vehicle)[0]


def require_predictable(vehicle: VehicleFile, model: Model) -> None:
    """Raises ModelError if the vehicle's controller and `model` do not fit together."""
    prediction = registry.of(vehicle.vehicle.kind).prediction()
    lacking = prediction.needs - {each.name for each in model.outputs}
    lacking |= {each.name for each in model.inputs if each.usual is None} - prediction.gives
    if lacking:
        what = f"the loop with the vehicle's controller cannot be closed: {', '.join(sorted(lacking))}"
        raise ModelError(f"model {model.name}", what, remedy="use one of the vehicle's own models.")


def _undetectable(model: Model, sizes: Mapping[str, float]) -> list[tuple[str, float]]:
    """Effects with the size up to which they may have been missed, in descending order relative to the typical size."""
    found = []
    for name, size in sizes.items():
        attached = with_named(model, name).effects[-1]
        first = next(p for p in attached.parameters if p.name == attached.amplitudes[0])
        if size <= max(abs(first.lower), abs(first.upper)):
            found.append((size / first.typical, name, size))
    return [(name, size) for _, name, size in sorted(found, reverse=True)]


def _with(model: Model, effect: str, size: float) -> Model:
    """`model` with `effect`, its first amplitude at `size`, all of them estimated."""
    wider = with_named(model, effect)
    return wider.change({wider.effects[-1].amplitudes[0]: size})


def _just_visible(model: Model, effect: str, alone: Rival, experiments: Sequence[Experiment]) -> Rival:
    """`model` with `effect` at its minimum detectable size in the best of `experiments`; nats grow with its square."""
    attached = with_named(model, effect).effects[-1]
    size = SMALL * next(p for p in attached.parameters if p.name == attached.amplitudes[0]).typical
    tried = Rival.assumed(effect, _with(model, effect, size))
    courses = {experiment.name: simulate(tried.model, experiment) for experiment in experiments}
    nats = [expected_log_odds(tried, course.rows, alone) for course in courses.values() if not course.broken]
    if not nats or max(nats) <= 0.0:
        refused = [f"{name}: {course.broken}" for name, course in courses.items() if course.broken]
        reasons = "; ".join(["no safe experiment shows it", *refused])
        raise ModelError(f"effect {effect}", reasons, remedy="give recordings of it.")
    return Rival.assumed(effect, _with(model, effect, size * (DETECTABLE / max(nats)) ** 0.5))
