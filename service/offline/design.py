"""Design of the vehicle's controllers for a result of the identification, and what to expect of them.

Each controller is checked wherever the parameters may be: in the corners of the 95 % region of their joint estimate,
and at 1,000 draws from it (models.control_design.robustness), each time with the effects that were added to the model
that the result belongs to (models.control_design.linear_effects). Then the experiments are predicted with that model,
and with the controllers as designed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError

from upright.diagnosis.prediction.closed_loop import Course, Experiment, causal, simulate
from upright.models.control_design.linear_effects import Together
from upright.models.control_design.robustness import CheckedDesign, Known
from upright.models.file.model_file import load_model
from upright.models.model import Model
from upright.models.parts import Parameter
from upright.service.offline.models import identified_model
from upright.service.offline.next_experiment import require_predictable
from upright.telemetry.documents import from_json
from upright.telemetry.errors import UprightError
from upright.vehicles import registry
from upright.vehicles.experiment.excitation import ExcitationError
from upright.vehicles.experiment.load import loaded
from upright.vehicles.file import VehicleFile
from upright.vehicles.sections import REST

INDEPENDENT = "a model file, as if they were independent"
METHODS = "the method {0}, with the correlation of its estimates"


class Estimated(BaseModel):
    """A parameter in a result, SI; None if it was not determined."""

    model_config = ConfigDict(allow_inf_nan=False)

    value: float | None = None
    std: float | None = None


_ESTIMATES = TypeAdapter(dict[str, Estimated])


class ResultError(UprightError):
    """A file holds no result for a design."""


@dataclass(frozen=True, slots=True)
class Result:
    """A result of the identification: `values` and `deviations` of the vehicle's parameters by name, SI, the
    `correlation` of their errors by pair, and the `model` that it belongs to. `how` says where they come from."""

    source: str
    sha256: str
    values: Mapping[str, float]
    deviations: Mapping[str, float]
    correlation: Mapping[tuple[str, str], float]
    model: Model
    how: str

    @property
    def request(self) -> dict[str, Any]:
        """As the daemon takes it."""
        return {
            "verb": "design",
            "source": self.source,
            "sha256": self.sha256,
            "values": dict(self.values),
            "deviations": dict(self.deviations),
        }


@dataclass(frozen=True, slots=True)
class Expected:
    """An experiment as predicted: the largest magnitude of each channel that has a limit, as (channel, value, limit,
    unit); `broken` is the limit that it comes too close to, or why it cannot be predicted."""

    name: str
    controller: str
    largest: tuple[tuple[str, float, float, str], ...] = ()
    broken: str = ""

    def to_json(self) -> dict[str, Any]:
        return {
            "name": self.name,
            "controller": self.controller,
            "largest": {
                channel: {"value": value, "limit": limit, "unit": unit} for channel, value, limit, unit in self.largest
            },
            "broken": self.broken,
        }


@dataclass(frozen=True, slots=True)
class Designed:
    """The controllers of `vehicle`, with the parameters of the result, and the `expected` experiments."""

    vehicle: VehicleFile
    designs: Mapping[str, CheckedDesign]
    expected: tuple[Expected, ...] = field(default_factory=tuple)

    def words(self) -> list[str]:
        """The designs as lines of text."""
        several = len(self.designs) > 1
        return [line for name, each in self.designs.items() for line in each.words(name if several else "")]

    def to_json(self) -> dict[str, Any]:
        return {
            "controllers": {name: each.findings() for name, each in self.designs.items()},
            "expected": [each.to_json() for each in self.expected],
        }


def read_result(path: Path, vehicle: VehicleFile, method: str | None = None, model: str | None = None) -> Result:
    """A result from the output of `upright identify --json`, by its best method unless `method` names another, or from
    a model file. `model` is the one that was given to `identify`, by default the vehicle's own.

    Raises ResultError if there is none, ModelError for an invalid model.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ResultError(f"{path}: {error.strerror}.", remedy="Give a file that exists.") from error
    digest = sha256(content).hexdigest()
    if path.suffix == ".toml":
        known = load_model(str(path))
        own = [each for each in known.parameters if each.name in vehicle.parameters.values]
        values, deviations = ({each.name: number(each) for each in own} for number in (_value, _std))
        _refuse_impossible(path, vehicle, values, deviations)
        return Result(path.name, digest, values, deviations, {}, known, INDEPENDENT)
    try:
        document = from_json(content)
        best = method or document["best"]
        found = dict(document["methods"][best]["parameters"]) | _of_drives(document)
        table = document["methods"][best].get("correlation") or {}
        entries = {name: each for name, each in _ESTIMATES.validate_python(found).items() if each.value is not None}
        correlation = {(one, other): float(r) for one, row in table.items() for other, r in row.items()}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        what = f"has no result of {method}" if method else "recommends no method"
        raise ResultError(
            f"{path} {what} ({error}).", remedy="Write one with `upright identify RECORDINGS --json > FILE.json`."
        ) from error
    names = [name for name, each in entries.items() if name in vehicle.parameters.values and each.std is not None]
    if not names:
        remedy = "Identify the vehicle from longer recordings."
        raise ResultError(f"{path} estimates no parameter of the vehicle.", remedy=remedy)
    values, deviations = ({name: getattr(entries[name], key) for name in names} for key in ("value", "std"))
    _refuse_impossible(path, vehicle, values, deviations)
    known = identified_model(model, vehicle)
    theirs = {name: each for name, each in entries.items() if name in known.values}
    known = known.change(
        {name: each.value for name, each in theirs.items() if each.value is not None},
        deviations={name: each.std for name, each in theirs.items() if each.std is not None},
    )
    return Result(path.name, digest, values, deviations, correlation, known, METHODS.format(best))


def _refuse_impossible(
    path: Path, vehicle: VehicleFile, values: Mapping[str, float], deviations: Mapping[str, float]
) -> None:
    """Raises ResultError if the vehicle cannot have these values."""
    try:
        vehicle.with_values(values, deviations)
    except ValidationError as error:
        first = error.errors()[0]
        where = "".join(f"{each}." for each in first["loc"]).rstrip(".")
        raise ResultError(
            f"{path}: {where}{': ' if where else ''}{first['msg'].removeprefix('Value error, ')}.",
            remedy="Identify the vehicle again, from recordings that determine it.",
        ) from error


def _value(parameter: Parameter) -> float:
    return parameter.value


def _std(parameter: Parameter) -> float:
    return parameter.std


def _of_drives(document: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """The drives' parameters, which have methods of their own and are independent of the others."""
    found: dict[str, dict[str, Any]] = {}
    for each in document["methods"].values():
        if each.get("domain") == "drives":
            found |= {name: dict(entry) for name, entry in each["parameters"].items() if entry.get("value") is not None}
    return found


def designed(vehicle: VehicleFile, result: Result) -> Designed:
    """The controllers of `vehicle` for `result`. What was not estimated is as known as its CAD value.

    Raises ControlDesignError if a controller is not stable wherever the parameters may be, ResultError if the gains of
    this vehicle do not follow from its parameters, ModelError if its loop cannot be closed with the result's model.
    """
    theirs = vehicle.with_values(result.values, result.deviations)
    parameters = theirs.parameters
    effects = Together.of(result.model)
    known = Known(parameters.values, parameters.deviations, result.correlation, effects if effects.parts else None)
    kind = registry.of(vehicle.vehicle.kind)
    designs = kind.designs(theirs, known)
    if not designs:
        raise ResultError(
            f"the gains of {vehicle.vehicle.id} are in its vehicle file: there is nothing to design.",
            remedy="Change [controller] there; `upright config check` checks it.",
        )
    require_predictable(vehicle, result.model)
    prediction = kind.prediction()
    predict, model = prediction.of(theirs), prediction.assumed(result.model)
    return Designed(theirs, designs, tuple(_expected(theirs, model, name, predict) for name in theirs.experiments))


def _expected(vehicle: VehicleFile, model: Model, name: str, predict: Callable[[str], Experiment]) -> Expected:
    section = vehicle.experiments[name]
    controller = section.controller or next(iter(vehicle.CONTROLLERS), "")
    if section.at == REST or not section.gets_up:
        return Expected(name, controller, broken="the vehicle is on its support, which is not predicted")
    try:
        experiment = predict(name)
    except ExcitationError as error:
        return Expected(name, controller, broken=str(error))
    with_it = loaded(model, section.load, section.load.after) if section.load is not None else model
    course = simulate(causal(with_it), experiment)
    return Expected(name, controller, tuple(_largest(with_it, course, experiment)), course.broken)


def _largest(model: Model, course: Course, experiment: Experiment) -> list[tuple[str, float, float, str]]:
    """Of each channel of the model with a limit, in the unit that people read."""
    rows = course.rows
    columns = {each.name: rows.measured[:, place] for place, each in enumerate(model.outputs)}
    columns |= {each.name: rows.row_inputs[:, place] for place, each in enumerate(model.inputs)}
    return [
        (
            each.channel,
            each.factor * float(np.max(np.abs(columns[each.channel]))),
            each.factor * each.largest,
            each.unit,
        )
        for each in experiment.limits
        if each.channel in columns
    ]
