"""The model that the tables of a model file describe: a shipped one with other values, or the user's own equations.

The user's equations are checked here, so that each error is reported with file and key: duplicate or unknown names,
dangling references, values outside their bounds. Effects are added afterwards (models.file.model_file).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import MISSING, fields, replace
from typing import Any, TypeVar

from upright.models import library
from upright.models.file.sections import JointSection, ModelSection, ParameterSection, Section, one_of
from upright.models.model import Model
from upright.models.parts import (
    Actuator,
    Disturbance,
    Filter,
    Hold,
    Input,
    Joint,
    ModelError,
    NarrowBand,
    Output,
    Parameter,
    Sensor,
    State,
)
from upright.models.random.part import MOST_DAMPED
from upright.models.text.expressions import check, length, name_problem, names_in

Build = TypeVar("Build")

LARGEST = 20_000
"""Terms and operations of an equation with all definitions substituted; beyond it, generating code takes minutes."""


EQUATIONS = ("states", "inputs", "outputs", "joints", "actuators", "sensors", "definitions")
"""Tables that only a file without a base has."""


def base_model(tables: ModelSection, file: str, name: str) -> Model:
    """The model called `name` that `tables` describe, without effects. Raises ModelError."""
    own = [key for key in EQUATIONS if getattr(tables, key) and (key != "joints" or tables.base is None)]
    if tables.base is None:
        if not own:
            remedy = f"give base = one of {', '.join(library.MODELS)}, or states and outputs of your own."
            raise ModelError(f"{file}: base", "is missing, and there are no equations either", remedy=remedy)
        return _own_equations(tables, file, name)
    if own:
        remedy = f"remove `base`, or {', '.join(own)}."
        raise ModelError(f"{file}: {own[0]}", f"the base {tables.base} has equations already", remedy=remedy)
    if tables.base not in library.MODELS:
        what = f"there is no shipped model {tables.base!r}"
        raise ModelError(f"{file}: base", what, remedy=one_of(tables.base, library.MODELS))
    base = library.MODELS[tables.base]
    return replace(
        base,
        name=name,
        title=base.title if tables.title is None else tables.title,
        source=base.source if tables.source is None else tables.source,
        settling=base.settling if tables.settling is None else tables.settling,
        joints=_with_disturbances(base.joints, tables.joints, file),
        base_parameters=given(base.base_parameters, tables.parameters, f"{file}: parameters"),
    )


def _with_disturbances(joints: tuple[Joint, ...], entries: Mapping[str, JointSection], file: str) -> tuple[Joint, ...]:
    """The `joints` of a base, with the disturbances that a file states."""
    names = [joint.name for joint in joints]
    for name, entry in entries.items():
        if name not in names:
            raise ModelError(f"{file}: joints.{name}", "the base has no such joint", remedy=one_of(name, names))
        more = [key for key in entry.model_fields_set if key != "disturbance"]
        if more:
            what = "is defined by the base"
            remedy = "remove it: a file with a base states only the disturbance of a joint."
            raise ModelError(f"{file}: joints.{name}.{more[0]}", what, remedy=remedy)
    return tuple(
        replace(joint, disturbance=_disturbance(entries[joint.name], f"{file}: joints.{joint.name}"))
        if joint.name in entries
        else joint
        for joint in joints
    )


def _disturbance(entry: JointSection, where: str) -> Disturbance | None:
    """The disturbance at a joint as a file states it; None for none."""
    if entry.disturbance is None:
        return Disturbance()
    if entry.disturbance is False:
        return None
    stated, where = entry.disturbance, f"{where}.disturbance"
    narrow = None if stated.narrow_band is None else NarrowBand(**stated.narrow_band.model_dump())
    found = Disturbance(**{**stated.model_dump(), "narrow_band": narrow})
    if narrow and narrow.damping_ratio > MOST_DAMPED:
        what = f"{narrow.damping_ratio:.3g} is too large: what decays within a period has no frequency of its own"
        remedy = f"give {MOST_DAMPED:.2g} at most, or leave out `narrow_band`."
        raise ModelError(f"{where}.narrow_band.damping_ratio", what, remedy=remedy)
    if not found.shortest < found.longest:
        what = f"its bounds cross: shortest is {found.shortest:.6g} s, longest is {found.longest:.6g} s"
        raise ModelError(where, what, remedy="make shortest the smaller one.")
    if found.known and not (found.std and found.correlation_time):
        what = "is known, but its std or its correlation_time is missing"
        raise ModelError(where, what, remedy="give both, or leave out `known`.")
    if found.correlation_time and not found.shortest <= found.correlation_time <= found.longest:
        what = f"{found.correlation_time:.6g} s is outside its bounds, {found.shortest:.6g} to {found.longest:.6g} s"
        raise ModelError(f"{where}.correlation_time", what, remedy="correct it, or the bounds.")
    return found


def given(
    parameters: tuple[Parameter, ...],
    entries: Mapping[str, ParameterSection],
    where: str,
    local: Callable[[str], str] = str,
) -> tuple[Parameter, ...]:
    """`parameters` with the entries that a file gives for their `local` names. Raises ModelError."""
    names = [local(parameter.name) for parameter in parameters]
    for name in entries:
        if name not in names:
            raise ModelError(f"{where}.{name}", "there is no such parameter", remedy=one_of(name, names))
    return tuple(
        _with(parameter, entries[name], f"{where}.{name}") if name in entries else parameter
        for name, parameter in zip(names, parameters, strict=True)
    )


def _with(parameter: Parameter, entry: ParameterSection, where: str) -> Parameter:
    if entry.unit is not None and entry.unit != parameter.unit:
        what = f"{entry.unit!r} is not the unit of this parameter"
        raise ModelError(f"{where}.unit", what, remedy=f"give the value in {parameter.unit!r}.")
    return _in_bounds(replace(parameter, **entry.model_dump(exclude_none=True)), where)


def _in_bounds(parameter: Parameter, where: str) -> Parameter:
    lower, value, upper = parameter.lower, parameter.value, parameter.upper
    if not lower < upper:
        what = f"its bounds cross: lower is {lower:.6g}, upper is {upper:.6g}"
        raise ModelError(where, what, remedy="make lower the smaller one.")
    if not lower <= value <= upper:
        what = f"{value:.6g} {parameter.unit} is outside its bounds, {lower:.6g} to {upper:.6g}"
        raise ModelError(f"{where}.value", what, remedy="correct the value, or give lower and upper with it.")
    return parameter


def _own_equations(tables: ModelSection, file: str, name: str) -> Model:
    for key in ("states", "outputs"):
        if not getattr(tables, key):
            remedy = f"add a table [{key}.NAME]; a model needs at least one state and one output."
            raise ModelError(f"{file}: {key}", "there are none", remedy=remedy)
    for key in ("value", "unit"):
        for each, entry in tables.parameters.items():
            if getattr(entry, key) is None:
                what = "is missing, and there is no base that defines it"
                raise ModelError(f"{file}: parameters.{each}.{key}", what, remedy="add it.")
    _own_joints(tables.joints, file)
    _check_names(tables, file)
    _check_references(tables, file)
    _check_expressions(tables, file)

    def built(
        kind: Callable[..., Build], entries: Mapping[str, Section], **more: Callable[[Any], Any]
    ) -> tuple[Build, ...]:
        plain = [(each, entry.model_dump(exclude_none=True)) for each, entry in entries.items()]
        return tuple(
            kind(name=each, **(values | {key: make(values[key]) for key, make in more.items() if key in values}))
            for each, values in plain
        )

    parameters = built(Parameter, tables.parameters)
    return Model(
        name=name,
        title=tables.title or name,
        source=tables.source or "",
        settling=tables.settling or 0.0,
        base_states=built(State, tables.states),
        inputs=built(Input, tables.inputs, hold=Hold, delays=tuple),
        outputs=built(Output, tables.outputs),
        base_parameters=tuple(_in_bounds(each, f"{file}: parameters.{each.name}") for each in parameters),
        joints=_own_joints(tables.joints, file),
        actuators=built(Actuator, tables.actuators, also=tuple),
        sensors=built(Sensor, tables.sensors, filter=lambda each: Filter(**each)),
        definitions=dict(tables.definitions),
    )


def _own_joints(entries: Mapping[str, JointSection], file: str) -> tuple[Joint, ...]:
    """The joints of the user's own equations."""
    found = []
    for name, entry in entries.items():
        values = entry.model_dump(exclude={"disturbance"}, exclude_none=True)
        for each in fields(Joint):
            if each.default is MISSING and each.name not in {"name", *values}:
                what = f"is missing in [joints.{name}]"
                raise ModelError(f"{file}: joints.{name}.{each.name}", what, remedy=f"add {each.name} = ... to it.")
        found.append(Joint(name=name, **values, disturbance=_disturbance(entry, f"{file}: joints.{name}")))
    return tuple(found)


def _check_names(tables: ModelSection, file: str) -> None:
    """Checks that every name can be used in an equation and has one meaning."""
    taken = {f"{each}_slope": f"the slope of input {each}" for each in tables.inputs}
    taken |= {f"{each}_force": f"the force at joint {each}" for each in tables.joints}
    for key in ("states", "inputs", "parameters", "definitions", "outputs", "joints", "actuators", "sensors"):
        for name in getattr(tables, key):
            problem = name_problem(name)
            if problem:
                remedy = "choose another name."
                if key in ("inputs", "outputs"):
                    remedy = f'choose another name, and say which column it is: [columns] NAME = "{name}".'
                raise ModelError(f"{file}: {key}.{name}", f"{name!r} {problem}", remedy=remedy)
            if key in ("states", "inputs", "parameters", "definitions"):
                if name in taken:
                    what = f"{name!r} is {taken[name]} already"
                    raise ModelError(f"{file}: {key}.{name}", what, remedy="give each its own name.")
                taken[name] = f"in {key}"


def _check_references(tables: ModelSection, file: str) -> None:
    """Checks that every input, output, joint or parameter that is referred to exists."""
    references = [(f"states.{name}.noise_of", state.noise_of, "outputs") for name, state in tables.states.items()]
    references += [(f"states.{name}.error_of", state.error_of, "outputs") for name, state in tables.states.items()]
    references += [
        (f"states.{name}.{key}", getattr(state, key), "parameters")
        for name, state in tables.states.items()
        for key in ("correlation_time", "frequency")
    ]
    references += [(f"states.{name}.driven_by", state.driven_by, "states") for name, state in tables.states.items()]
    for name, each in tables.inputs.items():
        references += [(f"inputs.{name}.delays", delay, "parameters") for delay in each.delays]
        references += [(f"inputs.{name}.lag", each.lag, "parameters")]
    for name, actuator in tables.actuators.items():
        references += [(f"actuators.{name}.command", actuator.command or "''", "inputs")]
        references += [(f"actuators.{name}.also", each, "inputs") for each in actuator.also]
        references += [(f"actuators.{name}.lag", actuator.lag, "parameters")]
        # In a model without joints, an actuator has none.
        references += [(f"actuators.{name}.joint", actuator.joint or ("''" if tables.joints else ""), "joints")]
    for name, sensor in tables.sensors.items():
        references += [(f"sensors.{name}.angle", sensor.angle, "outputs")]
        references += [(f"sensors.{name}.rate", sensor.rate, "outputs")]
        references += [(f"sensors.{name}.actuator", sensor.actuator, "actuators")]
        if not (sensor.angle or sensor.rate):
            remedy = f"name the output that it measures: {', '.join(tables.outputs)}."
            raise ModelError(f"{file}: sensors.{name}", "has neither angle nor rate", remedy=remedy)
    for where, name, key in references:
        if name and name not in getattr(tables, key):
            what = f"there is no {name!r} in {key}"
            raise ModelError(f"{file}: {where}", what, remedy=one_of(name, getattr(tables, key)))
    for name, sensor in tables.sensors.items():
        joint = tables.actuators[sensor.actuator].joint if sensor.actuator else ""
        unit = tables.joints[joint].coordinate_unit if joint else sensor.angle_unit
        if sensor.angle and unit != sensor.angle_unit:
            what = f"is {sensor.angle_unit!r}, but the joint of its actuator moves in {unit!r}"
            remedy = "give both the same unit, or leave out `actuator`."
            raise ModelError(f"{file}: sensors.{name}.angle_unit", what, remedy=remedy)


def _check_expressions(tables: ModelSection, file: str) -> None:
    """Checks that every equation uses names that are known where it is evaluated, and has a reasonable size."""
    names = {"time", *tables.states, *tables.inputs, *tables.parameters}
    names |= {f"{each}_slope" for each in tables.inputs}
    later = {*tables.definitions, *(f"{each}_force" for each in tables.joints)}
    lengths: dict[str, int] = {}

    def looked_at(text: str, where: str, allowed: Iterable[str] = names) -> int:
        where = f"{file}: {where}"
        early = names_in(text, where) & later - set(allowed)
        if early:
            what = f"uses {min(early)!r}, which is not known here yet"
            remedy = "move that definition up; forces at joints follow the definitions, in the order of the joints."
            raise ModelError(where, what, remedy=remedy)
        check(text, allowed, where)
        size = length(text, lengths, where)
        if size > LARGEST:
            what = f"has {size} terms with the definitions substituted, more than {LARGEST}"
            raise ModelError(where, what, remedy="simplify it.")
        return size

    for name, sensor in tables.sensors.items():
        if sensor.filter is not None and isinstance(sensor.filter.integral, str):
            looked_at(sensor.filter.integral, f"sensors.{name}.filter.integral", tables.inputs)
    for name, actuator in tables.actuators.items():
        for key in ("rate", "angle", "gain"):
            if getattr(actuator, key):
                looked_at(getattr(actuator, key), f"actuators.{name}.{key}")
        if actuator.inertia:
            looked_at(actuator.inertia, f"actuators.{name}.inertia", tables.parameters)
    for name, text in tables.definitions.items():
        lengths[name] = looked_at(text, f"definitions.{name}")
        names.add(name)
    for name, joint in tables.joints.items():
        for key in ("coordinate", "rate", "inertia", "load"):
            lengths[f"{name}_force"] = looked_at(str(getattr(joint, key)), f"joints.{name}.{key}")
        names.add(f"{name}_force")
    for name, state in tables.states.items():
        looked_at(state.derivative, f"states.{name}.derivative")
        looked_at(state.initial, f"states.{name}.initial", {*tables.outputs, *tables.parameters})
    for name, output in tables.outputs.items():
        looked_at(output.expression, f"outputs.{name}.expression")
