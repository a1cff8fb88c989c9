"""The effects of a model in the linear model for which a controller is designed: for its margins and its worst case.

The effects change the linear model by what they change in the equations of the model that has them, for typical
motions: where an expression is not linear, the slope of the secant between plus and minus the typical size of a joint
or command (models.parts) is taken. Dry friction is then a damping, and a deadband a smaller gain. A secant says whether
motions of that size grow; what dry friction and backlash do to smaller ones, the predicted experiments show.

A delay is a Padé approximation of second order, a lag a state. Effects on the way of a setpoint are those in the model
of the actuators alone, where there is one. Effects on sensors change what the controller sees of the states. States of
an effect become states of the linear model, if their equations are linear; a memory that is not linear, as that of
hysteresis or backlash, has no linear model, and the effect is left out.

Source: Gelb, Vander Velde, Multiple-Input Describing Functions and Nonlinear System Design (1968), for the idea.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import sympy
from numpy.typing import NDArray

from upright.models.compiler.equations import Equations, compose
from upright.models.control_design.lqi import Matrix, StateSpace
from upright.models.model import Model
from upright.models.parts import Output, Parameter, State
from upright.models.sensing import delayed

Array = NDArray[np.float64]
Row = Mapping[str, float]
"""Slopes by the name of a state, of an input, or of the slope of an input."""


class LinearEffects:
    """The effects of a model, whose states and inputs have the names that the linear model has for them.

    `parameters` are those on which the linear model depends, and `names` their effects: a constant torque has none.
    `left_out`: effects without a linear model.
    """

    def __init__(self, model: Model) -> None:
        """Raises ModelError if an expression of the model is invalid."""
        self.left_out = _without_linear_model(model)
        model = replace(model, effects=tuple(each for each in model.effects if each.name not in self.left_out))
        self._model = model
        self._with, self._without = _Secants.of(model), _Secants.of(replace(model, effects=()))
        needed = _linear_parameters(model)
        depends = [(each.name, p) for each in model.effects for p in each.parameters if p.name in needed and p.value]
        self.parameters: tuple[Parameter, ...] = tuple(parameter for _, parameter in depends)
        self.names = tuple(dict.fromkeys(effect for effect, _ in depends))

    def on(self, plant: StateSpace, factors: Mapping[str, float]) -> StateSpace:
        """`plant` with the effects; parameters of the model are at `factors` of their values."""
        values = {name: factors.get(name, 1.0) * value for name, value in self._model.values.items()}
        full, plain = self._with.at(values), self._without.at(values)
        own = tuple(name for name in self._with.states if name not in self._without.states)
        states = plant.states + own
        A, B = np.zeros((len(states), len(states))), np.zeros((len(states), len(plant.inputs)))
        count = len(plant.states)
        A[:count, :count], B[:count] = plant.A, plant.B
        described = [name for name in states if name in full]
        for name in described:
            row = states.index(name)
            for variable, slope in _change(full[name], plain.get(name, {})).items():
                a, b = _as_states(variable, states, plant)
                A[row, : len(a)] += slope * a
                B[row] += slope * b
        seen = np.eye(count, len(states))
        for output in self._model.outputs:
            if output.name in plant.states:
                change = _change(full[_shown(output.name)], plain[_shown(output.name)])
                for variable, slope in change.items():
                    if variable in states:
                        seen[plant.states.index(output.name), states.index(variable)] += slope
        rows = [states.index(name) for name in described]
        for variable, delay, lag in _shifts(self._model, self._with, values):
            for shift in filter(None, (_pade(delay), _lag(lag))):
                A, B = _shifted(A, B, rows, _as_states(variable, states, plant), shift)
        seen = np.pad(seen, ((0, 0), (0, len(A) - len(states))))
        shown = seen if plant.measured is None else plant.measured @ seen
        return replace(plant, A=A, B=B, C=plant.C @ seen, measured=shown)


class CommandEffects:
    """The effects on the way of a setpoint, in a model of the actuators alone, as LinearEffects has those of a vehicle.

    A parameter has the actuator's name before its own: the vehicle's model may have the same effect.
    """

    def __init__(self, model: Model) -> None:
        """Raises ModelError if an expression of the model is invalid."""
        path = _command_path(model)
        self.left_out: tuple[str, ...] = ()  # nothing on the way of a command has a state
        self._path, self._secants = path, _Secants.of(path)
        needed = _linear_parameters(path)
        depends = [(each.name, p) for each in path.effects for p in each.parameters if p.name in needed and p.value]
        self.parameters = tuple(replace(parameter, name=self._named(parameter.name)) for _, parameter in depends)
        self.names = tuple(dict.fromkeys(effect for effect, _ in depends))

    def _named(self, parameter: str) -> str:
        return f"{self._path.actuators[0].name}.{parameter}"

    def on(self, plant: StateSpace, factors: Mapping[str, float]) -> StateSpace:
        """`plant` with the effects on its input of that name; their parameters are at `factors` of their values."""
        command = self._path.inputs[0].name
        if command not in plant.inputs:
            return plant
        values = {name: factors.get(self._named(name), 1.0) * value for name, value in self._path.values.items()}
        A, B = plant.A, plant.B.copy()
        B[:, plant.inputs.index(command)] *= self._secants.at(values)[_ACTING][command]
        rows = range(len(A))
        for variable, delay, lag in _shifts(self._path, self._secants, values):
            for shift in filter(None, (_pade(delay), _lag(lag))):
                A, B = _shifted(A, B, rows, _as_states(variable, plant.states, plant), shift)
        more = ((0, 0), (0, len(A) - len(plant.A)))
        seen = np.eye(len(plant.states)) if plant.measured is None else plant.measured
        return replace(plant, A=A, B=B, C=np.pad(plant.C, more), measured=np.pad(seen, more))


@dataclass(frozen=True, slots=True)
class Together:
    """Several effects, one after the other."""

    parts: tuple[LinearEffects | CommandEffects, ...]

    @classmethod
    def of(cls, model: Model) -> Together:
        """Those of a model and of its actuators' model. Raises ModelError if an expression of theirs is invalid."""
        parts: list[LinearEffects | CommandEffects] = [LinearEffects(model)] if model.effects else []
        if model.actuators_model is not None and model.actuators_model.effects:
            parts.append(CommandEffects(model.actuators_model))
        return cls(tuple(parts))

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(name for part in self.parts for name in part.names)

    @property
    def left_out(self) -> tuple[str, ...]:
        return tuple(name for part in self.parts for name in part.left_out)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(each for part in self.parts for each in part.parameters)

    def on(self, plant: StateSpace, factors: Mapping[str, float]) -> StateSpace:
        """`plant` with all of them."""
        for part in self.parts:
            plant = part.on(plant, factors)
        return plant


@dataclass(frozen=True, slots=True)
class _Secants:
    """The equations of a model and their slopes. `lags` by input: the parameter by which it lags, or ""; `middle` and
    `sizes` of the variables (states, inputs, slopes of inputs): typical motions are from -size to size about it."""

    states: tuple[str, ...]
    outputs: tuple[str, ...]
    lags: tuple[str, ...]
    variables: tuple[str, ...]
    middle: Array
    sizes: Array
    parameters: tuple[str, ...]
    evaluate: Callable[..., Sequence[float]]

    @classmethod
    def of(cls, model: Model) -> _Secants:
        equations = compose(model)
        symbols = (*equations.states, *equations.inputs, *equations.slopes)
        everything = [*equations.derivatives, *equations.outputs]
        arguments = [*symbols, *equations.parameters, equations.time]
        functions = {"Signum": np.sign, "Magnitude": abs}
        sizes, usual = _typical(model), {each.name: each.usual for each in model.inputs if each.usual is not None}
        return cls(
            tuple(map(str, equations.states)),
            tuple(each.name for each in model.outputs),
            equations.lags,
            tuple(map(str, symbols)),
            np.array([usual.get(str(each), 0.0) for each in symbols]),
            np.array([sizes.get(str(each), 1.0) for each in symbols]),
            tuple(map(str, equations.parameters)),
            sympy.lambdify(arguments, everything, [functions, "numpy"], cse=True),
        )

    def at(self, values: Mapping[str, float]) -> dict[str, Row]:
        """Slopes of the derivative of each state, and of each output under its `_shown` name."""
        given = [*(values[name] for name in self.parameters), 0.0]
        steps = np.diag(self.sizes)
        above, below = (
            np.array([self.evaluate(*point, *given) for point in self.middle + sign * steps]) for sign in (1.0, -1.0)
        )
        slopes = (above - below) / (2.0 * self.sizes[:, None])
        names = (*self.states, *map(_shown, self.outputs))
        return {
            name: dict(zip(self.variables, row.tolist(), strict=True))
            for name, row in zip(names, slopes.T, strict=True)
        }


def _without_linear_model(model: Model) -> tuple[str, ...]:
    """The effects that have a state whose derivative is not linear in the motion."""
    equations = compose(model)
    settings, moving = _settings(model, equations)
    curved = {
        str(state)
        for state, derivative in zip(equations.states, equations.derivatives, strict=True)
        if any(derivative.subs(settings).diff(each).free_symbols & moving for each in moving)
    }
    return tuple(each.name for each in model.effects if curved & {state.name for state in each.states})


def _linear_parameters(model: Model) -> frozenset[str]:
    """The parameters on which the response to motion depends: not those of a constant torque or offset."""
    equations = compose(model)
    settings, moving = _settings(model, equations)
    everything = [each.subs(settings) for each in (*equations.derivatives, *equations.outputs)]
    found = {p for p in equations.parameters if any(each.diff(p).free_symbols & moving for each in everything)}
    return frozenset({*map(str, found), *equations.lags, *(name for each in equations.delays for name in each)})


def _settings(model: Model, equations: Equations) -> tuple[dict[sympy.Symbol, float], frozenset[sympy.Symbol]]:
    """Inputs with a usual value, with it: they are settings and no motion; and the symbols of the motion."""
    settings = {s: each.usual for s, each in zip(equations.inputs, model.inputs, strict=True) if each.usual is not None}
    return settings, frozenset({*equations.states, *equations.inputs, *equations.slopes} - settings.keys())


def _typical(model: Model) -> dict[str, float]:
    """The size of typical motions, by name of the state or input."""
    sizes: dict[str, float] = {}
    for actuator in model.actuators:
        sizes |= {actuator.angle: actuator.angle_scale, actuator.rate: actuator.command_scale}
        sizes |= dict.fromkeys(actuator.commands, actuator.command_scale)
    for joint in model.joints:
        sizes |= {joint.coordinate: joint.coordinate_scale, joint.rate: joint.rate_scale}
    return sizes


_ACTING = "acting"


def _command_path(model: Model) -> Model:
    """What acts of the command of `model`, with the effects on its way: the derivative of the only state."""
    actuator = model.actuators[0]
    command = next(each for each in model.inputs if each.name == actuator.command)
    return replace(
        model,
        base_states=(State(_ACTING, f"{command.unit} s", command.name),),
        inputs=(replace(command, delays=(), lag=""),),
        outputs=(Output(_ACTING, f"{command.unit} s", _ACTING, noise=1.0),),
        base_parameters=(),
        actuators=(replace(actuator, rate="", angle="", gain="", inertia="", lag=""),),
        joints=(),
        sensors=(),
        definitions={},
        effects=tuple(each for each in model.effects if each.at == actuator.name),
    )


def _shifts(model: Model, secants: _Secants, values: Mapping[str, float]) -> Iterator[tuple[str, float, float]]:
    """(input, delay, lag) in s, by the effects of `model` alone."""
    for each, lag in zip(model.inputs, secants.lags, strict=True):
        delays = (values[a.qualified(a.effect.delay)] for a in model.effects if each.name in delayed(model, a))
        yield each.name, sum(delays), values[lag] if lag and lag != each.lag else 0.0


def _shown(output: str) -> str:
    """An output's key among the slopes, where a state may have the same name."""
    return f"shown {output}"


def _change(row: Row, before: Row) -> Row:
    return {name: slope - before.get(name, 0.0) for name, slope in row.items() if slope != before.get(name, 0.0)}


def _as_states(variable: str, states: Sequence[str], plant: StateSpace) -> tuple[Array, Array]:
    """`variable` as a combination of the states and inputs of `plant`, whose further `states` are those of effects:
    zero if the linear model does not have it, as the trim mass where it is at rest."""
    a, b = np.zeros(len(states)), np.zeros(len(plant.inputs))
    if variable in states:
        a[states.index(variable)] = 1.0
    elif variable in plant.inputs:
        b[plant.inputs.index(variable)] = 1.0
    elif (name := variable.removesuffix("_slope")) in plant.states:
        number = plant.states.index(name)
        a[: len(plant.states)], b = plant.A[number], plant.B[number]
    return a, b


_Shift = tuple[Matrix, Array, Array, float]
"""A, B, C, D of a filter with one input and one output."""


def _pade(delay: float) -> _Shift | None:
    """A delay (s), of second order: 1 - 12 / (T s + 6 + 12 / (T s)) over the same with a plus, in controllable form."""
    if not delay:
        return None
    T = delay
    return np.array([[0.0, 1.0], [-12.0 / T**2, -6.0 / T]]), np.array([0.0, 1.0]), np.array([0.0, -12.0 / T]), 1.0


def _lag(lag: float) -> _Shift | None:
    """A lag (s) of first order."""
    return (np.array([[-1.0 / lag]]), np.array([1.0 / lag]), np.array([1.0]), 0.0) if lag else None


def _shifted(
    A: Matrix, B: Matrix, rows: Sequence[int], signal: tuple[Array, Array], shift: _Shift
) -> tuple[Matrix, Matrix]:
    """x' = A x + B u with `signal`, a state or an input, passing a filter before it acts in `rows`."""
    (a, b), (FA, FB, FC, FD) = signal, shift
    n, order = len(A), len(FA)
    a = np.pad(a, (0, n - len(a)))
    acting = A[rows] @ a + B[rows] @ b  # how strongly the signal acts in each row
    wide = np.zeros((n + order, n + order))
    wide[:n, :n], wide[n:, n:], wide[n:, :n] = A, FA, np.outer(FB, a)
    tall = np.vstack([B, np.outer(FB, b)])
    for row, strength in zip(rows, acting, strict=True):
        wide[row, :n] += (FD - 1.0) * strength * a
        tall[row] += (FD - 1.0) * strength * b
        wide[row, n:] += strength * FC
    return wide, tall
