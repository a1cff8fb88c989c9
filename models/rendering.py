"""A model's equations for people (text), papers (LaTeX) and programs (JSON), with its effects merged in by name.

Nothing is substituted: each line is shown as it was written, and an effect's force appears in the joint's equation
under the effect's name. A quantity that an effect replaces (a command, a reading) is marked with :=, in the order in
which the effects act.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any

from upright.models.effect import AttachedEffect
from upright.models.model import Model
from upright.models.parts import Actuator, Filter, Joint, Place, Sensor
from upright.models.sensing import FILTERED, delayed, integrated
from upright.models.text.expressions import names_in, parse, renamed


class Kind(StrEnum):
    """What a line states about its `name`."""

    DELAY = "delay"
    """Input `name` is delayed by `expression`, s."""
    LAG = "lag"
    """Input `name` passes a first-order lag of `expression`, s."""
    COMMAND = "command"
    """An effect replaces the command `name` by `expression`."""
    DEFINITION = "definition"
    FORCE = "force"
    """The force at a joint, or its part without effects."""
    EFFECT = "effect"
    """The force that the effect `name` adds."""
    TWIST = "twist"
    """`name` is how far an effect lets an actuator be ahead of its joint, `name@1` how much faster it is."""
    DERIVATIVE = "derivative"
    """`expression` is the time derivative of `name`."""
    OUTPUT = "output"
    READING = "reading"
    """An effect replaces the reading `name_measured` of the output `name` by `expression`, in which `name_measured@1`
    and `name_measured@2` are its time derivatives."""


@dataclass(frozen=True, slots=True)
class Line:
    """One equation. `effect` is the effect that it comes from, "" for the model's own."""

    kind: Kind
    name: str
    expression: str
    effect: str = ""


def equations(model: Model) -> tuple[Line, ...]:
    """The equations of `model` in the order in which they are evaluated. Raises ModelError."""
    return (
        *_shifts(model),
        *_commands(model),
        *(Line(Kind.DEFINITION, name, _tidy(text)) for name, text in model.definitions.items()),
        *(line for joint in model.joints for line in _forces(model, joint)),
        *(Line(Kind.DERIVATIVE, state.name, _tidy(state.derivative)) for state in model.base_states),
        *(line for attached in model.effects for line in _memories(model, attached)),
        *(Line(Kind.OUTPUT, output.name, _tidy(output.expression)) for output in model.outputs),
        *_twists(model),
        *_readings(model),
    )


def text(model: Model) -> str:
    """The equations as plain text, one per line; a line that comes from an effect ends with the effect's name."""
    rows = []
    for line in equations(model):
        shown = line.kind in (Kind.READING, Kind.DERIVATIVE)
        right = line.expression.replace("@1", "'").replace("@2", "''") if shown else line.expression
        match line.kind:
            case Kind.DELAY:
                rows.append((line.name, f"is delayed by {right}", ""))
            case Kind.LAG:
                rows.append((line.name, f"passes a first-order lag of {right}", line.effect))
            case Kind.COMMAND:
                rows.append((line.name, f":= {right}", line.effect))
            case Kind.READING:
                rows.append((_measured(line.name), f":= {right}", line.effect))
            case Kind.DERIVATIVE:
                rows.append((f"{line.name}'", f"= {right}", line.effect))
            case Kind.OUTPUT:
                rows.append((_measured(line.name), f"= {right}", ""))
            case _:
                rows.append((line.name, f"= {right}", ""))
    width = max(len(left) for left, _, _ in rows)
    return "\n".join(f"{left:<{width}} {right}" + (f"   [{effect}]" if effect else "") for left, right, effect in rows)


def latex(model: Model) -> str:
    """The equations as a LaTeX align* environment (needs amsmath)."""
    import sympy

    rows = []
    for line in equations(model):
        readable = line.expression.replace("@1", ".dot").replace("@2", ".ddot").replace("@", "_at_")
        symbols = {name: sympy.Symbol(name, real=True) for name in names_in(readable)}
        right = sympy.latex(
            parse(readable, symbols, line.name),
            symbol_names={symbol: _latex_name(name) for name, symbol in symbols.items()},
            mul_symbol=r" \, ",
            order="none",
        )
        shown = _measured(line.name) if line.kind in (Kind.OUTPUT, Kind.READING) else line.name
        left = _latex_name(shown.replace("@", "_at_"))
        match line.kind:
            case Kind.DELAY:
                rows.append(rf"{left}(t) &\leftarrow {left}\left(t - ({right})\right)")
            case Kind.LAG:
                rows.append(rf"{left} &\leftarrow \frac{{1}}{{1 + {right} \, s}} \, {left}")
            case Kind.COMMAND | Kind.READING:
                rows.append(rf"{left} &\leftarrow {right}")
            case Kind.DERIVATIVE:
                rows.append(rf"\dot{{{left}}} &= {right}")
            case _:
                rows.append(f"{left} &= {right}")
    return "\\begin{align*}\n  " + " \\\\\n  ".join(rows) + "\n\\end{align*}"


def to_json(model: Model) -> dict[str, Any]:
    """Everything about `model`, as plain data; a missing bound is infinite."""
    return {
        "name": model.name,
        "title": model.title,
        "source": model.source,
        "states": [asdict(state) for state in model.states],
        "inputs": [asdict(each) for each in model.inputs],
        "outputs": [asdict(output) for output in model.outputs],
        "equations": [asdict(line) for line in equations(model)],
        "parameters": {
            parameter.name: {key: value for key, value in asdict(parameter).items() if key != "name"}
            for parameter in model.parameters
        },
        "effects": [
            {
                "name": attached.name,
                "at": attached.at,
                "place": attached.effect.place.value,
                "family": attached.effect.family.value,
                "title": attached.effect.title,
                "equation": attached.effect.equation,
                "parameters": [parameter.name for parameter in attached.parameters],
            }
            for attached in model.effects
        ],
        "actuators_model": None if model.actuators_model is None else to_json(model.actuators_model),
    }


def _shifts(model: Model) -> Iterator[Line]:
    for each in model.inputs:
        shifting = [(a, a.effect) for a in _acting(model, Place.ACTUATOR) if each.name in _actuator(model, a).commands]
        late = [a.qualified(a.effect.delay) for a in model.effects if each.name in delayed(model, a)]
        delays = [*each.delays, *late]
        if delays:
            yield Line(Kind.DELAY, each.name, " + ".join(delays))
        if each.lag:
            yield Line(Kind.LAG, each.name, each.lag)
        for a, effect in shifting:
            if effect.lag:
                yield Line(Kind.LAG, each.name, a.qualified(effect.lag), a.name)


def _commands(model: Model) -> Iterator[Line]:
    for attached in _acting(model, Place.ACTUATOR):
        actuator = _actuator(model, attached)
        for name in actuator.commands if attached.effect.command else ():
            names = {**actuator.moved, "command": name, **_own(attached)}
            yield Line(Kind.COMMAND, name, renamed(attached.effect.command, names), attached.name)


def _forces(model: Model, joint: Joint) -> Iterator[Line]:
    """Effects that use `load` come last: for each, `load` is the sum of all forces before it."""
    total = f"{joint.name}_force"
    here = [a for a in _acting(model, Place.JOINT) if a.at == joint.name]
    if not here:
        yield Line(Kind.FORCE, total, _tidy(joint.load))
        return
    load = _free(model, f"{joint.name}_load")
    yield Line(Kind.FORCE, load, _tidy(joint.load))
    for attached in sorted(here, key=_uses_load):
        names = {**_at_joint(model, joint), "load": load, **_own(attached)}
        symbol = _free(model, attached.name)
        yield Line(Kind.EFFECT, symbol, renamed(attached.effect.force or "0", names), attached.name)
        load = f"{load} + {symbol}"
    yield Line(Kind.FORCE, total, load)


def _before(model: Model, joint: Joint, attached: AttachedEffect) -> str:
    """The sum of all forces at `joint` before the effect."""
    *parts, _ = _forces(model, joint)
    return " + ".join([line.name for line in parts][: [line.effect for line in parts].index(attached.name)])


def _memories(model: Model, attached: AttachedEffect) -> Iterator[Line]:
    """The derivatives of the states of an effect at a joint."""
    if attached.effect.place is not Place.JOINT:
        return
    joint = next(each for each in model.joints if each.name == attached.at)
    force = _free(model, attached.name)
    names = {**_at_joint(model, joint), "load": _before(model, joint, attached), "force": force, **_own(attached)}
    for state, own in zip(attached.states, attached.effect.states, strict=True):
        yield Line(Kind.DERIVATIVE, state.name, renamed(own.derivative, names), attached.name)


def _twists(model: Model) -> Iterator[Line]:
    """What sensors on an actuator show in addition to the motion of its joint."""
    for attached in _acting(model, Place.JOINT):
        actuators = [each.name for each in model.actuators if each.joint == attached.at]
        showing = [each for each in model.sensors if each.actuator in actuators]
        if not attached.effect.twist or not showing:
            continue
        joint = next(each for each in model.joints if each.name == attached.at)
        twist = _free(model, f"{attached.name}_twist")
        names = {**_at_joint(model, joint), "load": _before(model, joint, attached), **_own(attached)}
        yield Line(Kind.TWIST, twist, renamed(attached.effect.twist, names), attached.name)
        for sensor in showing:
            for output, more in ((sensor.angle, twist), (sensor.rate, f"{twist}@1")):
                if output:
                    yield Line(Kind.READING, output, f"{_measured(output)} + {more}", attached.name)


def _readings(model: Model) -> Iterator[Line]:
    for sensor in model.sensors:
        for attached in _acting(model, Place.SENSOR):
            if attached.at != sensor.name or delayed(model, attached):
                continue
            names: dict[str, str] = {}
            for local, output in (("angle", sensor.angle), ("rate", sensor.rate)):
                shown = _measured(output)
                names |= {local: shown, f"{local}_1": f"{shown}@1", f"{local}_2": f"{shown}@2"}
            names |= _own(attached)
            for own in attached.effect.states:
                measured = {local for local, output in (("angle", sensor.angle), ("rate", sensor.rate)) if output}
                if names_in(own.derivative) & {"angle", "rate"} <= measured:
                    state = attached.qualified(own.name)
                    yield Line(Kind.DERIVATIVE, state, renamed(own.derivative, names), attached.name)
            if sensor.filter is not None and integrated(sensor, attached.effect):
                yield from _filtered(sensor, sensor.filter, attached, renamed(attached.effect.rate_reading, names))
                continue
            readings = ((attached.effect.angle_reading, sensor.angle), (attached.effect.rate_reading, sensor.rate))
            for reading, output in readings:
                if reading and output:
                    yield Line(Kind.READING, output, renamed(reading, names), attached.name)


def _filtered(sensor: Sensor, filtered: Filter, attached: AttachedEffect, reading: str) -> Iterator[Line]:
    """The readings of a rate that an effect changes, and of the angle that a filter computes from it."""
    names = {name: attached.qualified(name) for name in FILTERED}
    given = {key: str(value) for key, value in asdict(filtered).items()}
    rate, angle = _measured(sensor.rate), _measured(sensor.angle)
    for name, text in FILTERED.items():
        expression = renamed(text, {**names, **given, "error": f"{reading} - {rate}"})
        yield Line(Kind.DERIVATIVE, names[name], expression, attached.name)
    yield Line(Kind.READING, sensor.angle, f"{angle} + {names['angle_error']}", attached.name)
    yield Line(Kind.READING, sensor.rate, f"{reading} - {names['bias_error']}", attached.name)


def _acting(model: Model, place: Place) -> list[AttachedEffect]:
    return [attached for attached in model.effects if attached.effect.place is place]


def _actuator(model: Model, attached: AttachedEffect) -> Actuator:
    return next(actuator for actuator in model.actuators if actuator.name == attached.at)


def _own(attached: AttachedEffect) -> dict[str, str]:
    """An effect's own names, with the names that they have in the model."""
    own = {name: attached.qualified(name) for name in attached.effect.own_names}
    return {**own, "time_scale": repr(attached.time_scale)}


def _at_joint(model: Model, joint: Joint) -> dict[str, str]:
    """What an effect's names mean at `joint`."""
    actuator = next((each for each in model.actuators if each.joint == joint.name), None)
    here = {"coordinate": joint.coordinate, "rate": joint.rate, "inertia": joint.inertia}
    return {**here, "smooth_rate": repr(joint.smooth_rate), **(actuator.moved if actuator is not None else {})}


def _uses_load(attached: AttachedEffect) -> bool:
    return any("load" in names_in(text) for text in attached.effect.expressions.values())


def _measured(output: str) -> str:
    """The reading of an output, which may differ from the state of the same name."""
    return f"{output}_measured"


def _free(model: Model, name: str) -> str:
    """`name`, or a similar name that the model does not use yet."""
    taken = {state.name for state in model.base_states} | {each.name for each in model.inputs} | {*model.definitions}
    while name in taken | {parameter.name for parameter in model.base_parameters}:
        name += "_"
    return name


def _tidy(expression: str) -> str:
    return " ".join(expression.split())


def _latex_name(name: str) -> str:
    """roll_rate -> roll with the subscript rate; friction.torque -> torque with the subscript friction; t' as a dot."""
    if name == "time":
        return "t"
    *owner, local = name.split(".")
    if local in ("dot", "ddot") and owner:
        return rf"\{local}{{{_latex_name('.'.join(owner))}}}"
    first, *rest = [word for word in re.split("_+", local) if word] or ["_"]
    subscripts = [_upright(rest)] if rest else []
    subscripts += [_upright([word for part in owner for word in re.split("_+", part)])] if owner else []
    return _upright([first]) + (f"_{{{', '.join(subscripts)}}}" if subscripts else "")


def _upright(words: list[str]) -> str:
    """A single letter in italics, as usual; words upright."""
    single = len(words) == 1 and len(words[0]) == 1
    return words[0] if single else r"\mathrm{" + r"\,".join(words) + "}"
