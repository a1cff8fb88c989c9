"""Pictures of effects: what each one adds while its place is moved to and fro, at its usual values.

The picture is drawn from the expressions that models are compiled from. All scales of the place are 1, and so is the
natural time; the motion is a sine whose amplitude grows, so that what depends on it shows. At a joint the force is
drawn, on an actuator the change of the command, and on a sensor the error of the reading: over time, over the
coordinate that the effect depends on, and over that coordinate's rate.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import sympy
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from upright.diagnosis.report.figures.drawing import AFTER, MEASURED, styled, svg
from upright.models.effect import Effect
from upright.models.parts import Place
from upright.models.place import SCALES
from upright.models.text.expressions import names_in, number, parse

Array = NDArray[np.float64]

LASTS, SAMPLES = 4.0 * np.pi, 1500
"""Two periods, in natural times, and samples of it."""
SMOOTH_RATE = 0.01
"""Below which a sign is approximated by a slope, in typical rates."""
LEAD = 1.0
"""rad by which an actuator is ahead of its joint: in phase, nobody could tell which of the two an effect depends on."""


def _motion(time: float | Array, lead: float = 0.0) -> tuple[Array, Array, Array]:
    """(0.4 + 0.6 time / LASTS) sin(time + lead), and its first two derivatives."""
    grows = 0.6 / LASTS
    size, sine, cosine = 0.4 + grows * np.asarray(time), np.sin(time + lead), np.cos(time + lead)
    return size * sine, size * cosine + grows * sine, 2.0 * grows * cosine - size * sine


@styled
def picture(effect: Effect) -> str:
    """The picture of an effect of the catalogue, as SVG."""
    time = np.linspace(0.0, LASTS, SAMPLES)
    moved, lead = _moved(effect)
    force = np.broadcast_to(added(effect, time), time.shape)
    angle, rate, _ = _motion(time, lead)
    figure = Figure(figsize=(5.4, 1.5), layout="constrained")
    over_time, over_angle, over_rate = figure.subplots(1, 3, sharey=True)
    over_time.plot(time, angle * np.abs(force).max(), color=MEASURED, linewidth=0.8)
    for axes, x, label in ((over_time, time, "time"), (over_angle, angle, moved), (over_rate, rate, "its rate")):
        axes.plot(x, force, **AFTER.line)
        axes.set(xlabel=label, xticks=[], yticks=[0.0], yticklabels=[])
    over_time.set_ylabel(_WHAT[effect.place])
    return svg(figure, effect.name, f"{effect.name}: {_WHAT[effect.place]} over time, {moved} and its rate")


_WHAT = {Place.JOINT: "force", Place.ACTUATOR: "change of command", Place.SENSOR: "error of reading"}


def _moved(effect: Effect) -> tuple[str, float]:
    """What the effect depends on, and its lead: an actuator's motion only if that of the joint does nothing."""
    match effect.place:
        case Place.ACTUATOR:
            return "command", 0.0
        case Place.SENSOR:
            return "angle", 0.0
        case Place.JOINT:
            used = set().union(*map(names_in, effect.expressions.values()))
            by_actuator = "actuator_angle" in used and not used & {"coordinate", "rate"}
            return ("actuator's angle", LEAD) if by_actuator else ("coordinate", 0.0)


def added(effect: Effect, time: Array) -> Array:
    """What the effect adds to force, command or reading, at each `time` (n,)."""
    values, names = _parameters(effect), _names(time)
    if effect.lag:
        late = _integrated(lambda t, state: (_names(t)["command"] - state) / values[effect.lag], [0.0], time)
        return np.asarray(late[0] - names["command"])
    if effect.delay and not effect.expressions:
        return np.asarray(_names(time - values[effect.delay])["command"] - names["command"])
    compute = _function(effect, values)
    first = [float(_names(0.0)[state.initial]) if state.initial else 0.0 for state in effect.states]
    past = _integrated(lambda t, states: compute(_names(t), states)[1:], first, time) if first else np.empty((0, 1))
    return np.asarray(compute(names, past)[0])


def _integrated(slope: Callable[[float, Array], Any], first: list[float], time: Array) -> Array:
    found = solve_ivp(slope, (0.0, LASTS), first, method="LSODA", t_eval=time, max_step=LASTS / SAMPLES, rtol=1e-6)
    return np.asarray(found.y)


def _parameters(effect: Effect) -> dict[str, float]:
    """Its parameters where all scales are 1: usual values, and amplitudes of a typical size, each after the first half
    as large as the one before, so that they can be told apart."""
    scales = dict.fromkeys(SCALES[effect.place], 1.0) | {"smooth_rate": SMOOTH_RATE}
    usual = {each.name: number(each.scale if each.amplitude else each.value, scales) for each in effect.parameters}
    return usual | {name: usual[name] / 2.0**place for place, name in enumerate(effect.amplitudes)}


def _names(time: float | Array) -> Mapping[str, Array]:
    """The names that a place offers, along the motion."""
    angle, rate, acceleration = _motion(time)
    ahead, ahead_rate, _ = _motion(time, LEAD)
    one = np.asarray(1.0)
    return {
        "time": np.asarray(time), "time_scale": one, "smooth_rate": np.asarray(SMOOTH_RATE),
        "coordinate": angle, "rate": rate, "inertia": one, "load": acceleration,
        "actuator_angle": ahead, "actuator_rate": ahead_rate, "gain": one, "actuator_inertia": 0.5 * one,
        "command": angle, "angle": angle, "angle_1": rate, "angle_2": acceleration,
        "rate_1": acceleration, "rate_2": -rate,
    }  # fmt: skip


def _function(effect: Effect, values: Mapping[str, float]) -> Callable[[Mapping[str, Array], Array], Sequence[Any]]:
    """From names and states: what the effect adds, then the derivatives of its states."""
    order = list({**_names(0.0), **dict.fromkeys(effect.own_names)})  # a parameter hides a name of the place
    symbols = {name: sympy.Symbol(name, real=True) for name in order}
    states = [state.name for state in effect.states]
    match effect.place:
        case Place.JOINT:
            added = symbols["force"] = parse(effect.force, symbols)
        case Place.ACTUATOR:
            added = parse(effect.command, symbols) - symbols["command"]
        case Place.SENSOR:
            name = "angle" if effect.angle_reading else "rate"
            added = parse(getattr(effect, f"{name}_reading"), symbols) - symbols[name]
    slopes = [parse(state.derivative, symbols) for state in effect.states]
    compiled = sympy.lambdify(order, [added, *slopes], "numpy", cse=True)

    return lambda names, at: compiled(**{**names, **values, **dict(zip(states, at, strict=True))})
