"""Every method on several recordings: the output of `upright identify`, as in the paper's figure 3.

Each method gives a joint estimate over all recordings that it takes (estimators.identify.table says which) and one for
each single recording: the runs, whose scatter shows the precision of a single recording. A method that fails, or takes
none of the recordings, reports this and does not stop the others.

The fit is measured in the same way for all methods, over all recordings: all outputs, predicted from the filtered state
over a horizon that follows from the model's time scale (estimators.identify.common_fit), or as the kind of vehicle
defines it. A method that does not give all values keeps its own measure. estimators.identify.choice uses the fit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any

from upright import estimators
from upright.estimators.contract import Estimate, EstimationError, Estimator, Status
from upright.estimators.data.segments import DataError
from upright.estimators.fit.logarithms import is_known_roughly
from upright.estimators.identify.document import FAILED, Results, document, nothing
from upright.estimators.identify.fits import measure
from upright.estimators.identify.subject import NOTHING_OWN, OwnMethods, Subject
from upright.estimators.identify.table import METHODS, Domain, Method, experiment_of, unsuited
from upright.estimators.stopwatch import stopwatch
from upright.models.compiler.kernel import compile_model
from upright.models.model import Model
from upright.telemetry.channels import ChannelTable
from upright.telemetry.errors import RecordingError, UprightError
from upright.telemetry.recording import Recording

RECURSIVE_FITS = ("recursive_output_error", "recursive_prediction_error")
REGRESSIONS = ("least_squares", "instrumental_variables")
COMPILED = ("output_error", "output_error_simplex", "prediction_error", *RECURSIVE_FITS)
Progress = Callable[[str, str, int, int], None]
"""Called with the method, the recording, the number of fits done and their total number."""


@dataclass(frozen=True, slots=True)
class Task:
    """One fit: a method, and the indices of its recordings. `label` names these for a person."""

    method: Method
    recordings: tuple[int, ...]
    label: str


def with_values(model: Model, parameters: Mapping[str, float], deviations: Mapping[str, float]) -> Model:
    """`model` with those values and standard deviations for which it has a parameter."""
    names = {parameter.name for parameter in model.parameters}
    return model.change(
        {name: value for name, value in parameters.items() if name in names},
        deviations={name: std for name, std in deviations.items() if name in names},
    )


def identify(
    recordings: Sequence[Recording],
    parameters: Mapping[str, float],
    support: float | None,
    methods: Sequence[str] = (),
    *,
    deviations: Mapping[str, float] | None = None,
    model: Model,
    own: OwnMethods = NOTHING_OWN,
    every: bool = False,
    bandwidth: float | None = None,
    progress: Progress = lambda method, label, done, total: None,
) -> dict[str, Any]:
    """The document of `identify --json`: by method its parameters, fit, status, reason, seconds, runs and their mean.

    `parameters` and `deviations` are the vehicle file's; `support` is in rad. `methods` are names of
    estimators.identify.table, by default all. `model` comes with its own values. `own` are the methods of the kind of
    vehicle (`vehicles.registry.of(kind).identification()`). With `every`, each method takes all recordings; `bandwidth`
    rad/s is that of the filter of least_squares and instrumental_variables. `progress` is called when a fit begins.
    KeyboardInterrupt ends the identification early: missing fits are then "cancelled". Raises EstimationError for an
    unknown method.
    """
    subject = Subject(model, parameters, deviations or {}, support, bandwidth, own)
    chosen = _chosen(methods, subject)
    experiments = [experiment_of(recording) for recording in recordings]
    left_out = {name: [""] * len(recordings) if every else unsuited(METHODS[name], experiments) for name in chosen}
    tasks = plan(recordings, left_out)
    found: Results = {}
    try:
        if any(task.method.name in COMPILED for task in tasks):
            progress("compiling", model.name, 0, len(tasks))
            compile_model(model)
        for done, task in enumerate(tasks):
            name = task.method.name
            progress(name, task.label, done, len(tasks))
            found[name, task.recordings] = run(task, subject, recordings)
    except KeyboardInterrupt:
        pass
    taken = {name: tuple(place for place, why in enumerate(reasons) if not why) for name, reasons in left_out.items()}
    joint = {name: found[name, places] for name, places in taken.items() if (name, places) in found}
    horizon = measure(
        {name: each for name, each in joint.items() if METHODS[name].rank is not None}, subject, recordings
    )
    return document(
        recordings,
        experiments,
        left_out,
        found,
        before=_before(subject),
        own=own,
        vehicle={name: (value, subject.deviations.get(name, 0.0)) for name, value in parameters.items()},
        horizon=horizon,
        cancelled=len(found) < len(tasks),
    )


def _chosen(methods: Sequence[str], subject: Subject) -> list[str]:
    for name in methods:
        if name not in METHODS:
            raise EstimationError(
                f"method {name}", "there is no such method", remedy=f"choose among {', '.join(METHODS)}."
            )
    own, apart = (*subject.own.regressions, *subject.own.asked), (Domain.RECURSIVE, Domain.DRIVES)
    if not methods and any(is_known_roughly(each) for each in subject.model.parameters if each.estimated):
        return ["prediction_error"]  # only products of such numbers are identifiable: no balance is linear in them
    return list(methods or (name for name, method in METHODS.items() if name in own or method.domain not in apart))


def plan(recordings: Sequence[Recording], left_out: Mapping[str, Sequence[str]]) -> list[Task]:
    """The fits to do, first the joint ones of all methods. `left_out`: by method, for each recording, why it is not
    used, or ""."""
    joint, single = [], []
    for name, reasons in left_out.items():
        taken = tuple(place for place, reason in enumerate(reasons) if not reason)
        if not taken:
            continue
        label = recordings[taken[0]].source if len(taken) == 1 else f"{len(taken)} recordings"
        joint.append(Task(METHODS[name], taken, label))
        if len(taken) > 1:
            single += [Task(METHODS[name], (place,), recordings[place].source) for place in taken]
    return joint + single


def run(task: Task, subject: Subject, recordings: Sequence[Recording]) -> dict[str, Any]:
    """The result of the fit, JSON-ready; a failure is reported and not raised."""
    began = stopwatch()
    chosen = [recordings[place] for place in task.recordings]
    try:
        return replace(_estimate(task.method, subject, chosen), seconds=stopwatch() - began).to_json()
    except (ArithmeticError, ValueError, UprightError) as error:
        status = FAILED
        if isinstance(error, DataError):
            status = error.status.value
        elif isinstance(error, RecordingError) and error.key:
            status = Status.MISSING_CHANNEL.value
        reason = str(error) if isinstance(error, UprightError) else f"{type(error).__name__}: {error}"
        return {**nothing(status, reason), "seconds": stopwatch() - began}


def _estimate(method: Method, subject: Subject, recordings: Sequence[Recording]) -> Estimate:
    if method.domain is Domain.RECURSIVE:
        estimator, channels = _recursive(method.name, subject, recordings[0].channels)
        for recording in recordings:
            for frame in recording.frames(channels):
                estimator.update(frame)
        return estimator.result()
    fit: Callable[..., Estimate] = getattr(estimators, method.name)
    settings = dict(subject.own.settings.get(method.name, {}))
    if method.domain is Domain.DRIVES:
        if not settings:
            raise _not_of_this_kind(method.name)
        return fit(recordings, **settings)
    if method.name in REGRESSIONS:
        settings["bandwidth"] = subject.bandwidth
    return fit(subject.model, recordings, support=subject.support, **settings)


def _recursive(name: str, subject: Subject, recorded: ChannelTable) -> tuple[Estimator, ChannelTable]:
    """A recursive estimator and its channels."""
    if name not in RECURSIVE_FITS:
        regression = subject.own.regressions.get(name)
        if regression is None:
            raise _not_of_this_kind(name)
        support = math.inf if subject.support is None else subject.support
        return regression.make(subject.values, subject.deviations, support, regression.channels), regression.channels
    module = import_module("upright.estimators.recursive.prediction_error")
    form = module.Method(name)
    made = module.RecursivePredictionError(subject.model, support=subject.support, channels=recorded, method=form)
    return made, recorded


def _not_of_this_kind(method: str) -> EstimationError:
    remedy = "choose another, or say which vehicle it is."
    return EstimationError(f"method {method}", "this kind of vehicle has none", remedy=remedy)


def _before(subject: Subject) -> dict[str, dict[str, Any]]:
    """Prior value, standard deviation and unit of the estimated parameters, from the vehicle file or the model.

    A value of 0 is not a prior, nor is the start value of an effect without a standard deviation.
    """
    estimated = [parameter for parameter in subject.model.parameters if parameter.estimated]
    values = {p.name: subject.parameters.get(p.name, p.value) for p in estimated}
    stds = {p.name: subject.deviations.get(p.name, p.std) for p in estimated}
    own = {parameter.name for parameter in subject.model.base_parameters}
    known = [p for p in estimated if values[p.name] and (p.name in own or stds[p.name])]
    return {p.name: {"value": values[p.name], "std": stds[p.name], "unit": p.unit} for p in known}
