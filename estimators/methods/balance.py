"""The balance of generalised forces at a joint of a grey-box model, as a regression that is linear in its parameters.

    inertia * acceleration - load - effects = 0    becomes    known(t) = sum_j parameter_j * regressor_j(t)

SymPy splits the model's own equations. Terms without an estimated parameter are known and anchor the scale (the angular
momentum of the gyroscopes, the force of a motor); the others form one regressor per parameter. All are evaluated on the
measured channels. Between two samples a measurement is linear and a command is held, so that every term has a value at
either end of each interval; the acceleration is the slope of the measured rate. If only a position is measured, rate
and acceleration come from a first, wide filter through which all channels go.

The delay of an input is a regressor, too: the time derivative of the input's terms, at the model's values. Otherwise a
fraction of a sample between drives and IMU would cause a bias.

Source: Isermann and Muenchhof, Identification of Dynamic Systems, chapter 15; Griese et al., equation (6).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any

import numpy as np
import sympy
from numpy.typing import NDArray

from upright.estimators.contract import EstimationError
from upright.models import library
from upright.models.compiler.equations import Equations, Magnitude, Signum, compose
from upright.models.model import Model
from upright.models.parts import Hold, Joint
from upright.models.segment import Segment
from upright.models.text.expressions import parse

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Balance:
    """known = sum of parameter * regressor: expressions in the channels' symbols alone, with held parameters at their
    values.

    `free` are the parameters of `regressors`, `shifts` those of `shifted`, whose time derivative is the regressor of a
    delay in excess of its value; `absent` are estimated parameters that do not occur in this balance. `anchors` are
    parameters assumed known that have a standard deviation; the derivative of the balance with respect to one is
    known[anchor] + sum_j parameter_j * anchored[anchor, j]. `position` names the measured channel if the rate is not
    measured, otherwise it is "".
    """

    model: Model
    joint: Joint
    free: tuple[str, ...]
    shifts: tuple[str, ...]
    absent: tuple[str, ...]
    known: sympy.Expr
    regressors: tuple[sympy.Expr, ...]
    shifted: tuple[sympy.Expr, ...]
    anchors: tuple[str, ...]
    anchored: tuple[tuple[int, int, sympy.Expr], ...]
    """(index in anchors, index in free or -1 for terms without a free parameter, expression)."""
    motion: tuple[sympy.Expr, sympy.Expr, sympy.Expr]
    """Coordinate, rate and acceleration in terms of the channels' symbols."""
    position: str
    delays: tuple[tuple[str, ...], ...]
    """Parameters of the delay of each input of the model."""

    @property
    def names(self) -> tuple[str, ...]:
        """The parameters of the regression, delays last."""
        return self.free + self.shifts


@dataclass(frozen=True, slots=True)
class Signals:
    """Channels over m intervals between the instants `time` (m + 1,): values at either end of each, by symbol."""

    time: Array
    left: dict[str, Array]
    right: dict[str, Array]

    def add(self, name: str, slope: str, left: Array, right: Array) -> None:
        """Add a channel and its slope; the channel is linear within an interval."""
        self.left[name], self.right[name] = left, right
        self.left[slope] = self.right[slope] = (right - left) / np.diff(self.time)


@dataclass(frozen=True, slots=True)
class Pieces:
    """Terms over m intervals between the instants `time` (m + 1,): values at either end of each, (m, terms)."""

    time: Array
    left: Array
    right: Array


def split(model: Model | str, joint: str = "", estimate: Iterable[str] | None = None) -> Balance:
    """The balance at `joint` of `model`, by default its first; `estimate` names the estimated parameters.

    Raises EstimationError if there is no such joint, its balance is not linear in the estimated parameters or has none
    of them, or it needs a state that is not measured; the error names the parameters or the state.
    """
    model = library.get(model) if isinstance(model, str) else model
    model = model.change(estimated=estimate) if estimate is not None else model
    place = next((each for each in model.joints if joint in ("", each.name)), None)
    if place is None:
        there = ", ".join(each.name for each in model.joints) or "none"
        raise EstimationError(f"joint {joint}".strip(), f"model {model.name} has none", remedy=f"its joints: {there}.")
    equations = compose(model)
    by_name = dict(zip((p.name for p in model.parameters), equations.parameters, strict=True))
    estimated = [p for p in model.parameters if p.estimated]
    fixed = {by_name[p.name]: sympy.Float(p.value) for p in model.parameters if not p.estimated}
    residual, acceleration = _residual(model, place, equations)
    measured, motion, position = _measured(model, place, equations, residual, fixed)
    residual = sympy.expand(residual.xreplace({**measured, acceleration: motion[2]}))
    _refuse_lags(model, equations, residual)

    delays = {name for names in equations.delays for name in names}
    free = [p.name for p in estimated if residual.has(by_name[p.name])]
    others = [p.name for p in estimated if p.name not in free]
    shifts, absent = [n for n in others if n in delays], [n for n in others if n not in delays]
    coefficients = [residual.diff(by_name[name]) for name in free]
    _require_linear(place, free, coefficients, by_name)
    if not free:
        what = "its balance has no estimated parameter"
        raise EstimationError(f"joint {place.name}", what, remedy="estimate at least one parameter of the joint.")

    rest = residual.subs({by_name[name]: 0 for name in free})
    anchors = [p.name for p in model.parameters if not p.estimated and p.std > 0.0 and residual.has(by_name[p.name])]
    changes = [[part.diff(by_name[n]).xreplace(fixed) for part in (rest, *coefficients)] for n in anchors]
    anchored = [(n, place, e) for n, each in enumerate(changes) for place, e in enumerate(each, start=-1) if e != 0]
    at_value = {**fixed, **{by_name[p.name]: sympy.Float(p.value) for p in estimated}}
    return Balance(
        model=model,
        joint=place,
        free=tuple(free),
        shifts=tuple(shifts),
        absent=tuple(absent),
        known=-rest.xreplace(fixed),
        regressors=tuple(each.xreplace(fixed) for each in coefficients),
        shifted=tuple(-_input_terms(model, equations, residual.xreplace(at_value), name) for name in shifts),
        anchors=tuple(anchors),
        anchored=tuple(anchored),
        motion=motion,
        position=position,
        delays=equations.delays,
    )


def _residual(model: Model, joint: Joint, equations: Equations) -> tuple[sympy.Expr, sympy.Symbol]:
    """inertia * acceleration - forces, and the symbol of the acceleration."""
    names = [state.name for state in model.states]
    if joint.rate not in names or joint.coordinate not in names:
        what = f"its coordinate {joint.coordinate!r} or rate {joint.rate!r} is not a state of model {model.name}"
        raise EstimationError(f"joint {joint.name}", what, remedy="use prediction_error, which needs no balance.")
    every = (equations.time, *equations.states, *equations.inputs, *equations.slopes, *equations.parameters)
    symbols: dict[str, sympy.Expr] = {each.name: each for each in every}
    for name, text in model.definitions.items():
        symbols[name] = parse(text, symbols, f"definition {name}")
    inertia = parse(joint.inertia, symbols, f"joint {joint.name}, inertia")
    acceleration = sympy.Symbol(f"{joint.rate} derivative", real=True)
    return sympy.expand(inertia * acceleration - inertia * equations.derivatives[names.index(joint.rate)]), acceleration


def channel(name: str, derivative: int = 0) -> sympy.Symbol:
    """The symbol of a measured output or of its first or second time derivative."""
    return sympy.Symbol(f"{name} measured" + "'" * derivative, real=True)


def _measured(
    model: Model, joint: Joint, equations: Equations, residual: sympy.Expr, fixed: Mapping[sympy.Symbol, sympy.Expr]
) -> tuple[dict[sympy.Symbol, sympy.Expr], tuple[sympy.Expr, sympy.Expr, sympy.Expr], str]:
    """States in terms of channels; coordinate, rate and acceleration in these terms; the position that is measured in
    place of a rate.

    A sensor error that is a state of its own (that of the roll filter) is not part of the motion and counts as zero.
    """
    by_name = dict(zip((state.name for state in model.states), equations.states, strict=True))
    shown = {o.name: e.xreplace(fixed) for o, e in zip(model.outputs, equations.outputs, strict=True)}
    motion = (by_name[joint.coordinate], by_name[joint.rate])
    wanted = [x for x in equations.states if residual.has(x) or x in motion]
    read: dict[sympy.Symbol, sympy.Expr] = {}
    for state in wanted:
        candidates = sorted((name for name, e in shown.items() if e.has(state)), key=lambda name: name != state.name)
        for name in candidates:
            slope = shown[name].diff(state)
            if not slope.has(*equations.states) and (name == state.name or state not in motion):
                offset = sympy.expand(shown[name] - slope * state)
                read[state] = (channel(name) - offset.subs({x: 0 for x in equations.states if x not in wanted})) / slope
                break
    coordinate, rate = motion
    position = ""
    if rate not in read and coordinate in read:
        position = joint.coordinate
        gain = read[coordinate].diff(channel(position))
        read[rate] = gain * channel(position, 1)
    lacking = [state.name for state in wanted if state not in read]
    if lacking:
        remedy = "use prediction_error, which estimates states, or a model whose inputs are measured instead."
        raise EstimationError(
            f"joint {joint.name}", f"its balance needs {lacking[0]}, which no output measures", remedy=remedy
        )
    for _ in wanted:
        read = {state: sympy.expand(expression.xreplace(read)) for state, expression in read.items()}
    if any(expression.has(*equations.states) for expression in read.values()):
        remedy = "use prediction_error."
        raise EstimationError(f"joint {joint.name}", "its outputs cannot be solved for the motion", remedy=remedy)
    if position:
        acceleration = gain * channel(position, 2)
    else:
        channels = [name for name in shown if read[rate].has(channel(name))]
        acceleration = sympy.Add(*(read[rate].diff(channel(name)) * channel(name, 1) for name in channels))
    return read, (read[coordinate], read[rate], acceleration), position


def _refuse_lags(model: Model, equations: Equations, residual: sympy.Expr) -> None:
    for symbol, slope, lag in zip(equations.inputs, equations.slopes, equations.lags, strict=True):
        if lag and residual.has(symbol, slope) and (model.parameter(lag).estimated or model.parameter(lag).value > 0.0):
            remedy = "use prediction_error or output_error for it."
            raise EstimationError(f"parameter {lag}", "a lag is not linear in the balance", remedy=remedy)


def _require_linear(
    joint: Joint, free: Sequence[str], coefficients: Sequence[sympy.Expr], by_name: Mapping[str, sympy.Symbol]
) -> None:
    nonlinear = [
        n for n, c in zip(free, coefficients, strict=True) if any(sympy.simplify(c.diff(by_name[m])) for m in free)
    ]
    if nonlinear:
        remedy = "hold one or more of them (estimate=...), or use prediction_error."
        what = f"the balance is not linear in {', '.join(nonlinear)}"
        raise EstimationError(f"joint {joint.name}", what, remedy=remedy)


def _input_terms(model: Model, equations: Equations, residual: sympy.Expr, delay: str) -> sympy.Expr:
    """The terms of `residual` that depend only on inputs with the delay `delay`."""
    late = set()
    for symbol, slope, names in zip(equations.inputs, equations.slopes, equations.delays, strict=True):
        if delay in names:
            late |= {symbol, slope}
    terms = sympy.Add.make_args(sympy.expand(residual))
    return sympy.Add(*(each for each in terms if each.free_symbols and each.free_symbols <= late))


def evaluator(expressions: Sequence[sympy.Expr]) -> Callable[[Signals], Pieces]:
    """A function that evaluates `expressions` of the channels' symbols on the signals of a segment."""
    plain = [_plain(sympy.sympify(expression)) for expression in expressions]
    symbols = sorted(set().union(*(each.free_symbols for each in plain)), key=lambda symbol: symbol.name)
    function: Callable[..., Sequence[Any]] = sympy.lambdify(symbols, plain, modules="numpy", cse=True)

    def evaluate(signals: Signals) -> Pieces:
        ends = []
        for end in (signals.left, signals.right):
            values = function(*(end[symbol.name] for symbol in symbols))
            ends.append(np.stack([np.broadcast_to(value, len(signals.time) - 1) for value in values], axis=1))
        return Pieces(signals.time, *ends)

    return evaluate


def _plain(expression: sympy.Expr) -> sympy.Expr:
    """`expression` in functions that NumPy has, for arrays as well as numbers."""

    def larger(*each: sympy.Expr) -> sympy.Expr:
        return reduce(lambda a, b: (a + b + sympy.Abs(a - b)) / 2, each)

    expression = expression.replace(Signum, sympy.sign).replace(Magnitude, sympy.Abs)
    smaller = expression.replace(sympy.Min, lambda *each: -larger(*(-one for one in each)))
    return smaller.replace(sympy.Max, larger)


def channel_signals(balance: Balance, segment: Segment) -> Signals:
    """All channels of `segment`, and their slopes, between the instants at which any of them was sampled.

    Inputs are shifted by the values of their delays. The signals span the time in which all channels are known.
    """
    model = balance.model
    knots = [
        column + sum(model.parameter(name).value for name in names)
        for column, names in zip(segment.knots.T, balance.delays, strict=True)
    ]
    lines = [k for k, each in zip(knots, model.inputs, strict=True) if each.hold is Hold.CUBIC]
    first = max(segment.time[0], *(k[0] for k in knots)) if knots else segment.time[0]
    last = min(segment.time[-1], *(k[-1] for k in lines)) if lines else segment.time[-1]
    time = np.unique(np.concatenate((segment.time, *knots)))
    time = time[(time >= first) & (time <= last)]
    time = time[np.concatenate(([True], np.diff(time) > 1e-9))]
    signals = Signals(time, {"time": time[:-1]}, {"time": time[1:]})
    middle = 0.5 * (time[:-1] + time[1:])
    for output, values in zip(model.outputs, segment.measured.T, strict=True):
        drawn = np.interp(time, segment.time, values)
        signals.add(channel(output.name).name, channel(output.name, 1).name, drawn[:-1], drawn[1:])
    for each, at, values in zip(model.inputs, knots, segment.inputs.T, strict=True):
        if each.hold is Hold.CUBIC:
            drawn = np.interp(time, at, values)
            signals.add(each.name, f"{each.name}_slope", drawn[:-1], drawn[1:])
        else:
            held = values[np.maximum(np.searchsorted(at, middle) - 1, 0)]
            signals.add(each.name, f"{each.name}_slope", held, held)
    return signals
