"""A model's text equations, with all its effects merged in, as SymPy expressions.

Effects on actuators replace the command. Effects at joints add to the joint's force, and their twist to the readings of
sensors on the joint's actuator. Effects on sensors replace the readings, last; a term that they add to a rate passes
through the filter that computes an angle from it. For an effect that uses `load` (the force that accelerates the
joint), `load` includes the forces of all effects that do not use it.
Only code generation, printing and tests need this module: a cached kernel is loaded without SymPy.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import sympy

from upright.models.effect import AttachedEffect
from upright.models.model import Model
from upright.models.parts import Actuator, Hold, Joint, ModelError, Place, Sensor
from upright.models.place import VOCABULARY
from upright.models.sensing import FILTERED, delayed, integrated
from upright.models.text.expressions import names_in, parse

Symbols = Mapping[str, sympy.Expr]


class Signum(sympy.Function):  # type: ignore[misc]
    """sign(x) whose derivative is 0 everywhere, even if SymPy does not know that x is real."""

    nargs = 1

    def fdiff(self, argindex: int = 1) -> sympy.Expr:
        return sympy.Integer(0)


class Magnitude(sympy.Function):  # type: ignore[misc]
    """abs(x) with the derivative Signum(x)."""

    nargs = 1

    def fdiff(self, argindex: int = 1) -> sympy.Expr:
        return Signum(self.args[0])


@dataclass(frozen=True, slots=True)
class Equations:
    """state' = derivatives, output = outputs, in the order of the model's states and outputs.

    `slopes` belong to `inputs`. `delays` and `lags` are, by input, the parameters that shift it in time.
    `forces` are the terms that effects add, by joint: (effect, expression).
    """

    time: sympy.Symbol
    states: tuple[sympy.Symbol, ...]
    inputs: tuple[sympy.Symbol, ...]
    slopes: tuple[sympy.Symbol, ...]
    parameters: tuple[sympy.Symbol, ...]
    derivatives: tuple[sympy.Expr, ...]
    outputs: tuple[sympy.Expr, ...]
    delays: tuple[tuple[str, ...], ...]
    lags: tuple[str, ...]
    forces: Mapping[str, tuple[tuple[str, sympy.Expr], ...]]


def compose(model: Model) -> Equations:
    """The equations of `model`. Raises ModelError if an expression uses an unknown name."""
    time = _symbol("time")
    symbols: dict[str, sympy.Expr] = {"time": time}
    for state in model.states:
        symbols[state.name] = _symbol(state.name)
    for each in model.inputs:
        symbols[each.name] = _symbol(each.name)
        symbols[f"{each.name}_slope"] = _symbol(f"{each.name}_slope")
    for parameter in model.parameters:
        symbols[parameter.name] = _symbol(parameter.name)
    inputs = tuple(symbols[each.name] for each in model.inputs)
    slopes = tuple(symbols[f"{each.name}_slope"] for each in model.inputs)
    states = tuple(symbols[state.name] for state in model.states)
    parameters = tuple(symbols[parameter.name] for parameter in model.parameters)

    for actuator in model.actuators:
        symbols |= {name: _command(model, actuator, name, symbols) for name in actuator.commands}
    for name, text in model.definitions.items():
        symbols[name] = _real(parse(text, symbols, f"definition {name}"))
    forces: dict[str, tuple[tuple[str, sympy.Expr], ...]] = {}
    plain = dict(symbols)
    memories: dict[str, sympy.Expr] = {}
    twists: dict[str, sympy.Expr] = {}
    for joint in model.joints:
        load = _real(parse(joint.load, symbols, f"joint {joint.name}, load"))
        plain[f"{joint.name}_force"] = load
        terms, twists[joint.name] = _joint_terms(model, joint, load, symbols, memories)
        forces[joint.name] = terms
        symbols[f"{joint.name}_force"] = sympy.Add(load, *(term for _, term in terms))
    for attached in model.effects:
        if attached.effect.place is Place.ACTUATOR:
            for state in attached.states:
                remedy = "attach it to a joint or a sensor."
                raise ModelError(f"effect {attached.name}", f"state {state.name} is on an actuator", remedy=remedy)
    derivatives, nominal = [], []
    for state in model.base_states:
        where = f"state {state.name}"
        derivatives.append(_real(parse(state.derivative, symbols, where)))
        nominal.append(_real(parse(state.derivative, plain, where)))
    for state in model.states[len(model.base_states) :]:
        # A sensor's states do not act on the motion, and their derivatives are known only with its readings.
        derivatives.append(memories.get(state.name, sympy.Integer(0)))
        nominal.append(derivatives[-1])
    outputs = {each.name: _real(parse(each.expression, symbols, f"output {each.name}")) for each in model.outputs}
    moving = _Flow(states, inputs, slopes, [each.hold is Hold.CUBIC for each in model.inputs], time)
    joint_of = {actuator.name: actuator.joint for actuator in model.actuators}
    for sensor in model.sensors:
        twist = twists.get(joint_of.get(sensor.actuator, ""), sympy.Integer(0))
        if sensor.angle:
            outputs[sensor.angle] += twist
        if sensor.rate:
            outputs[sensor.rate] += moving.rate(twist, derivatives)
    for sensor in model.sensors:
        _read(model, sensor, outputs, symbols, moving, derivatives, nominal, memories)
    derivatives = [memories.get(state.name, each) for state, each in zip(model.states, derivatives, strict=True)]
    delays, lags = [], []
    for each in model.inputs:
        shifting = [effect for effect in model.effects if _acts_on(model, effect, each.channel)]
        extra = tuple(a.qualified(a.effect.delay) for a in model.effects if each.name in delayed(model, a))
        delays.append(each.delays + extra)
        lag = [effect.qualified(effect.effect.lag) for effect in shifting if effect.effect.lag]
        if len(lag) + bool(each.lag) > 1:
            raise ModelError(f"input {each.name}", "has more than one lag", remedy="remove one of the effects.")
        lags.append(each.lag or (lag[0] if lag else ""))
    return Equations(
        time=time,
        states=states,
        inputs=inputs,
        slopes=slopes,
        parameters=parameters,
        derivatives=tuple(derivatives),
        outputs=tuple(outputs[each.name] for each in model.outputs),
        delays=tuple(delays),
        lags=tuple(lags),
        forces=forces,
    )


def _symbol(name: str) -> sympy.Symbol:
    return sympy.Symbol(name, real=True)


def _real(expression: sympy.Expr) -> sympy.Expr:
    """`expression` with functions whose derivatives are known everywhere."""
    if not expression.has(sympy.Abs, sympy.sign):
        return expression
    return expression.replace(sympy.Abs, Magnitude).replace(sympy.sign, Signum)


def _acts_on(model: Model, attached: AttachedEffect, name: str) -> bool:
    return attached.effect.place is Place.ACTUATOR and any(
        actuator.name == attached.at and name in actuator.commands for actuator in model.actuators
    )


def _local(attached: AttachedEffect, symbols: Symbols, names: Mapping[str, sympy.Expr]) -> dict[str, sympy.Expr]:
    """What an effect's expressions may use: the names of its place and its own parameters and states."""
    own = [parameter.name for parameter in attached.effect.parameters] + [s.name for s in attached.effect.states]
    known = {**names, "time": symbols["time"], "time_scale": sympy.Float(attached.time_scale)}
    return {**known, **{name: symbols[attached.qualified(name)] for name in own}}


def _mover(actuator: Actuator, symbols: Symbols) -> dict[str, sympy.Expr]:
    """The names for an actuator's motion, as far as the model knows it."""
    where = f"actuator {actuator.name}"
    return {name: _real(parse(text, symbols, where)) for name, text in actuator.moved.items()}


def _command(model: Model, actuator: Actuator, name: str, symbols: Symbols) -> sympy.Expr:
    """The command `name` as it acts, after the effects on `actuator`."""
    command = symbols[name]
    for attached in model.effects:
        if attached.at == actuator.name and attached.effect.place is Place.ACTUATOR and attached.effect.command:
            names = _local(attached, symbols, {**_mover(actuator, symbols), "command": command})
            command = _real(parse(attached.effect.command, names, f"effect {attached.name}, command"))
    return command


def _joint_terms(
    model: Model, joint: Joint, load: sympy.Expr, symbols: Symbols, memories: dict[str, sympy.Expr]
) -> tuple[tuple[tuple[str, sympy.Expr], ...], sympy.Expr]:
    """The force of each effect at `joint`, and their total twist; their states' derivatives go into `memories`."""
    place = {
        "coordinate": _real(parse(joint.coordinate, symbols, f"joint {joint.name}, coordinate")),
        "rate": _real(parse(joint.rate, symbols, f"joint {joint.name}, rate")),
        "inertia": _real(parse(joint.inertia, symbols, f"joint {joint.name}, inertia")),
        "smooth_rate": sympy.Float(joint.smooth_rate),
    }
    for actuator in model.actuators:
        if actuator.joint == joint.name:
            place = {**place, **_mover(actuator, symbols)}
            break
    here = [a for a in model.effects if a.effect.place is Place.JOINT and a.at == joint.name]
    using_load = [a for a in here if _uses_load(a)]
    terms, twist = [], sympy.Integer(0)
    for attached in [a for a in here if a not in using_load] + using_load:
        names = _local(attached, symbols, {**place, "load": load})
        where = f"effect {attached.name}"
        force = _real(parse(attached.effect.force or "0", names, f"{where}, force"))
        for state, own in zip(attached.states, attached.effect.states, strict=True):
            memories[state.name] = _real(parse(own.derivative, {**names, "force": force}, f"{where}, {own.name}"))
        terms.append((attached.name, force))
        twist += _real(parse(attached.effect.twist or "0", names, f"{where}, twist"))
        load = load + force
    return tuple(terms), twist


def _uses_load(attached: AttachedEffect) -> bool:
    return any("load" in names_in(text) for text in attached.effect.expressions.values())


@dataclass(frozen=True, slots=True)
class _Flow:
    """Time derivatives of expressions of states and inputs."""

    states: Sequence[sympy.Symbol]
    inputs: Sequence[sympy.Symbol]
    slopes: Sequence[sympy.Symbol]
    moving: Sequence[bool]
    time: sympy.Symbol

    def rate(self, expression: sympy.Expr, derivatives: Sequence[sympy.Expr]) -> sympy.Expr:
        """Time derivative along `derivatives`; held inputs are constant."""
        terms = [expression.diff(x) * f for x, f in zip(self.states, derivatives, strict=True)]
        terms += [expression.diff(u) * s for u, s, m in zip(self.inputs, self.slopes, self.moving, strict=True) if m]
        return sympy.Add(*terms, expression.diff(self.time))


def _read(
    model: Model,
    sensor: Sensor,
    outputs: dict[str, sympy.Expr],
    symbols: Symbols,
    flow: _Flow,
    derivatives: Sequence[sympy.Expr],
    nominal: Sequence[sympy.Expr],
    memories: dict[str, sympy.Expr],
) -> None:
    """Apply the effects on `sensor` to its outputs; the derivatives of their states go into `memories`.

    A term added to the rate alone passes through the sensor's filter into the angle. Time derivatives of readings are
    those without the sensor's effects, the second of them in the model without any effects: they occur only in terms
    that are small already.
    """
    here = [a for a in model.effects if a.effect.place is Place.SENSOR and a.at == sensor.name]
    effects = [a for a in here if not delayed(model, a)]
    if not effects:
        return
    moving: dict[str, sympy.Expr] = {}
    for local, output in (("angle", sensor.angle), ("rate", sensor.rate)):
        if output:
            moving[f"{local}_1"] = flow.rate(outputs[output], derivatives)
            moving[f"{local}_2"] = flow.rate(flow.rate(outputs[output], nominal), nominal)
    for attached in effects:
        shown = {"angle": sensor.angle, "rate": sensor.rate}
        names = {**moving, **{local: outputs[output] for local, output in shown.items() if output}}
        local_names = _local(attached, symbols, names)
        # A state that depends on a reading that is not measured stays at rest.
        absent = dict.fromkeys(VOCABULARY[Place.SENSOR] - set(local_names), sympy.Integer(0))
        for own in attached.effect.states:
            where = f"effect {attached.name}, {own.name}"
            memories[attached.qualified(own.name)] = _real(parse(own.derivative, {**absent, **local_names}, where))
        readings = {sensor.angle: attached.effect.angle_reading, sensor.rate: attached.effect.rate_reading}
        before = dict(outputs)
        for output, text in readings.items():
            if text and output:
                outputs[output] = _real(parse(text, local_names, f"effect {attached.name}, reading"))
        if sensor.filter is not None and integrated(sensor, attached.effect):
            error = outputs[sensor.rate] - before[sensor.rate]
            own_states = {name: symbols[attached.qualified(name)] for name in FILTERED}
            where = f"sensor {sensor.name}, filter"
            gains = {key: _real(parse(str(value), symbols, where)) for key, value in asdict(sensor.filter).items()}
            for name, text in FILTERED.items():
                memories[attached.qualified(name)] = parse(text, {**own_states, **gains, "error": error}, name)
            outputs[sensor.angle] += own_states["angle_error"]
            outputs[sensor.rate] -= own_states["bias_error"]
