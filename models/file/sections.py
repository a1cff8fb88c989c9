"""The tables of a model file, their keys and types checked by pydantic. Units are SI.

A file either has a `base`, the name of a shipped model, or equations of its own: states, inputs, outputs, parameters,
joints, actuators, sensors and definitions, each a table named by what it describes.
"""

from __future__ import annotations

import datetime
import difflib
import math
from collections.abc import Iterable, Mapping
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from upright.models.parts import ModelError

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Bound = Annotated[float, Field(allow_inf_nan=True)]
Equation = Annotated[str, Field(min_length=1)]


class Section(BaseModel):
    """A table of a model file."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, use_attribute_docstrings=True)


class StateSection(Section):
    """As models.parts.State; each of the other sections likewise corresponds to the class of its name."""

    unit: str
    derivative: Equation
    initial: Equation = "0"
    initial_std: NotNegative = 0.0
    process_noise: NotNegative = 0.0
    noise_known: bool = False
    noise_of: str = ""
    error_of: str = ""
    noise_spread: Positive = 1.0
    correlation_time: str = ""
    frequency: str = ""
    driven_by: str = ""
    meaning: str = ""


class InputSection(Section):
    unit: str
    hold: Literal["zero_order", "cubic"] = "cubic"
    age: str = ""
    delays: list[str] = []
    lag: str = ""
    ramp_of: str = ""
    ramp: NotNegative = 0.0
    usual: Finite | None = None
    meaning: str = ""


class OutputSection(Section):
    unit: str
    expression: Equation
    noise: Positive
    age: str = ""
    noise_known: bool = False
    meaning: str = ""
    counted: bool = False


class ParameterSection(Section):
    """A key that is missing is taken from the base, the effect, or the defaults of models.parts.Parameter."""

    value: Finite | None = None
    std: NotNegative | None = None
    lower: Bound | None = None
    upper: Bound | None = None
    estimated: bool | None = None
    scale: NotNegative | None = None
    unit: str | None = None
    meaning: str | None = None


class NarrowBandSection(Section):
    """As models.parts.NarrowBand."""

    frequency: Positive
    damping_ratio: NotNegative = 0.0
    std: NotNegative = 0.0


class DisturbanceSection(Section):
    """As models.parts.Disturbance."""

    std: NotNegative = 0.0
    correlation_time: NotNegative = 0.0
    known: bool = False
    shortest: NotNegative = 0.0
    longest: Annotated[float, Field(gt=0, allow_inf_nan=True)] = math.inf
    narrow_band: NarrowBandSection | None = None


class JointSection(Section):
    """All keys except `disturbance` are required in the user's own equations, or come from the base if it exists."""

    coordinate: Equation | None = None
    rate: Equation | None = None
    inertia: Equation | None = None
    load: Equation | None = None
    force_unit: str | None = None
    coordinate_unit: str | None = None
    force_scale: Positive | None = None
    coordinate_scale: Positive | None = None
    rate_scale: Positive | None = None
    smooth_rate: Positive | None = None
    disturbance: DisturbanceSection | Literal[False] | None = None


class ActuatorSection(Section):
    command: str
    joint: str
    rate: str = ""
    angle: str = ""
    gain: str = ""
    inertia: str = ""
    rate_unit: str = "rad/s"
    angle_unit: str = "rad"
    command_scale: Positive = 1.0
    angle_scale: Positive = 1.0
    commanded: bool = True
    also: list[str] = []
    lag: str = ""


class FilterSection(Section):
    proportional: Positive
    integral: NotNegative | Equation = 0.0
    smoothing: Positive = 1.0
    lever: Finite = 0.0


class SensorSection(Section):
    angle: str = ""
    rate: str = ""
    actuator: str = ""
    angle_unit: str = "rad"
    rate_unit: str = "rad/s"
    angle_scale: Positive = 1.0
    rate_scale: Positive = 1.0
    filter: FilterSection | None = None


class EffectSection(Section):
    name: str = ""
    at: str = ""
    file: str = ""
    """Path of a user's own effect, from the model file's folder."""
    parameters: dict[str, ParameterSection] = {}


class ValueSection(Section):
    """A parameter before or after a fit."""

    value: Finite
    std: NotNegative


class HistorySection(Section):
    """What was done when. Other keys than these are kept as they are."""

    model_config = ConfigDict(extra="allow")

    action: str
    effect: str | None = None
    date: datetime.datetime | datetime.date | str | None = None
    recording: str | list[str] | None = None
    error_before: Finite | dict[str, Finite] | None = None
    error_after: Finite | dict[str, Finite] | None = None
    sha256: str | list[str] | None = None
    effect_sha256: str | None = None
    horizon: Positive | None = None
    held_out: str | list[str] | None = None
    held_out_sha256: str | list[str] | None = None
    held_out_error_before: dict[str, Finite] | None = None
    held_out_error_after: dict[str, Finite] | None = None
    values_before: dict[str, ValueSection] | None = None
    values_after: dict[str, ValueSection] | None = None


class ModelSection(Section):
    """A whole model file."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,64}$")] | None = None
    title: str | None = None
    source: str | None = None
    settling: NotNegative | None = None
    base: str | None = None
    actuators_model: Annotated[str, Field(pattern=r"\.toml$")] | None = None
    """Path of the file of the actuators' model, from this file's folder."""
    states: dict[str, StateSection] = {}
    inputs: dict[str, InputSection] = {}
    outputs: dict[str, OutputSection] = {}
    parameters: dict[str, ParameterSection] = {}
    joints: dict[str, JointSection] = {}
    actuators: dict[str, ActuatorSection] = {}
    sensors: dict[str, SensorSection] = {}
    definitions: dict[str, Equation] = {}
    columns: dict[str, Equation] = {}
    """By channel, or `time`: the column of a table that it is read from, as `COLUMN` or `COLUMN:UNIT`."""
    effects: list[EffectSection] = []
    history: list[HistorySection] = []


def sections(table: Mapping[str, Any], file: str) -> ModelSection:
    """The tables of `file`, their keys and types checked. Raises ModelError for the first that is wrong."""
    try:
        checked = ModelSection.model_validate(table)
    except ValidationError as error:
        raise _model_error(error, table, file) from error
    for place, entry in enumerate(checked.history):
        for key in entry.model_extra or ():
            near = difflib.get_close_matches(key, HistorySection.model_fields, n=1, cutoff=0.8)
            if near:
                where = f"{file}: history.{place}.{key}"
                raise ModelError(where, "is almost a known key", remedy=f"write {near[0]!r}, or a key of your own.")
    return checked


def one_of(name: str, known: Iterable[str]) -> str:
    """A remedy for a name that is not among the `known` ones."""
    names = list(known)
    near = difflib.get_close_matches(name, names, n=1)
    guess = f"did you mean {near[0]!r}? If not, " if near else ""
    return f"{guess}use one of: {', '.join(names)}." if names else "remove it; there are none."


def _model_error(error: ValidationError, table: Mapping[str, Any], file: str) -> ModelError:
    """The first error that pydantic found, as a ModelError."""
    first = error.errors()[0]
    path = _path(first["loc"], table)
    where, key, found = f"{file}: {'.'.join(path)}", path[-1], first.get("input")
    kind = first["type"]
    if kind == "extra_forbidden":
        message, known = "is not a key of a model file", _known_keys(first["loc"])
        remedy = one_of(key, known)
    elif kind == "missing":
        message = f"is missing in [{'.'.join(path[:-1])}]"
        remedy = f'add {key} = "...", an equation.' if key == "derivative" else f"add {key} = ... to it."
    elif kind == "string_type":
        message, remedy = f"is not text (found {found!r})", f'write it in quotes: {key} = "{found}".'
    elif kind in ("float_type", "int_type", "finite_number"):
        message, remedy = f"is not a finite number (found {found!r})", "write a number, without quotes."
    elif kind in ("model_type", "dict_type"):
        message, remedy = (
            f"is not a table (found {found!r})",
            f"write it as {key} = {{ ... }}, or under [{'.'.join(path)}].",
        )
    elif kind == "list_type":
        message, remedy = f"is not a list (found {found!r})", f"write it as [[{key}]], or as {key} = [ ... ]."
    elif kind == "string_too_short":
        message, remedy = "is empty", "write an equation."
    else:
        message, remedy = f"{first['msg'].lower()} (found {found!r})", "correct it."
    more = len(error.errors()) - 1
    return ModelError(where, message, remedy=remedy + (f" ({more} more to correct after it.)" if more else ""))


def _path(location: tuple[int | str, ...], table: Mapping[str, Any]) -> list[str]:
    """`location` as far as it exists in the file, with a missing key; the rest is pydantic's name of a type."""
    path: list[str] = []
    inside: Any = table
    for part in location:
        path.append(str(part))
        if isinstance(inside, dict):
            inside = inside.get(str(part))
        elif isinstance(inside, list) and isinstance(part, int):
            inside = inside[part]
        else:
            return path[:-1]
    return path


def _known_keys(location: tuple[int | str, ...]) -> list[str]:
    """The keys of the table that `location` is in."""
    model: type[BaseModel] = ModelSection
    for part in location[:-1]:
        if isinstance(part, str) and part in model.model_fields:
            inner = getattr(model.model_fields[part].annotation, "__args__", ())
            model = next((each for each in inner if isinstance(each, type) and issubclass(each, BaseModel)), model)
    return list(model.model_fields)
