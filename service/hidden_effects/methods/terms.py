"""The library of the baselines: each torque of the catalogue as a function of the measured coordinates.

A term is an effect's force with one amplitude at 1 and the others at 0, for each start value of its shape parameters in
the catalogue. Only effects without memory whose force is proportional to its amplitudes have terms. In addition there
are the columns of the nominal model itself, which any regression needs: the derivative of its load with respect to each
parameter that is not exactly known, and the load's time derivative, which is the signature of a misalignment of command
and measurement in time.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from upright.models.attach import starts
from upright.models.effect import AttachedEffect
from upright.models.effects.catalogue import CATALOGUE
from upright.models.model import Model
from upright.models.parts import ModelError, Place
from upright.models.segment import Segment
from upright.models.text.syntax import CONSTANTS, OPERATIONS, fold, validated

Array = NDArray[np.float64]

_FUNCTIONS = {
    name: getattr(np, name)
    for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh", "exp", "log", "sqrt", "abs", "sign")
} | {"min": np.minimum, "max": np.maximum, "asin": np.arcsin, "acos": np.arccos, "atan": np.arctan}


@dataclass(frozen=True, slots=True)
class Term:
    """`columns` (n, amplitudes), N m for an amplitude of 1, of one effect at one shape."""

    effect: str
    columns: Array


@dataclass(frozen=True, slots=True)
class Regression:
    """The regressors of a baseline: `nominal` (n, m) columns, which are always used, and the terms of the effects."""

    nominal: Array
    terms: tuple[Term, ...]


def evaluated(text: str, names: Mapping[str, Array | float]) -> Array:
    """`text`, an expression of a model, along arrays (n,). Raises ModelError."""
    value = fold(
        validated(text, frozenset(names), "term"),
        leaf=float,
        name=lambda name: CONSTANTS[name] if name in CONSTANTS and name not in names else names[name],
        binary=lambda operator, a, b: OPERATIONS[operator](a, b),
        negative=lambda a: -a,
        call=lambda name, arguments: _FUNCTIONS[name](*arguments),
    )
    return np.asarray(value, dtype=np.float64)


def measured(model: Model, segment: Segment) -> dict[str, Array | float]:
    """Parameter values, and measured inputs, their slopes, outputs and time, (n,), by name."""
    names: dict[str, Array | float] = {**model.values, "time": segment.time}
    for place, each in enumerate(model.inputs):
        names[each.name] = segment.row_inputs[:, place]
        names[f"{each.name}_slope"] = np.gradient(segment.row_inputs[:, place], segment.time)
    for place, output in enumerate(model.outputs):
        names[output.name] = segment.measured[:, place]
    return names


def regression(model: Model, names: Mapping[str, Array | float]) -> Regression:
    """The library at the first joint of `model` for `names`, as returned by `measured`. Raises ModelError."""
    joint = model.joints[0]
    load = evaluated(joint.load, names)
    nominal = [load, np.gradient(load, np.asarray(names["time"]))]
    for parameter in model.base_parameters:
        if parameter.std > 0.0 or parameter.estimated:
            # The load is linear in each of its parameters.
            moved = {**names, parameter.name: parameter.value + parameter.typical}
            slope = (evaluated(joint.load, moved) - load) / parameter.typical
            if np.any(slope != 0.0):
                nominal.append(slope)
    terms = []
    for effect in CATALOGUE.values():
        if effect.place is Place.JOINT and not effect.states:
            try:
                terms += list(_terms(model, model.add(effect).effects[-1], names))
            except ModelError:
                continue  # this model cannot have the effect, or already has it
    return Regression(np.column_stack(nominal), tuple(terms))


def _terms(model: Model, attached: AttachedEffect, names: Mapping[str, Array | float]) -> Iterator[Term]:
    """A term for each start value of an effect's shape parameters, one of which is varied at a time."""
    joint = model.joints[0]
    actuator = next((each for each in model.actuators if each.joint == joint.name), None)
    here = {"coordinate": joint.coordinate, "rate": joint.rate, "inertia": joint.inertia, "load": joint.load}
    if actuator is not None:
        moved = {"actuator_rate": actuator.rate, "actuator_angle": actuator.angle, "gain": actuator.gain}
        here |= {name: text for name, text in moved.items() if text}
    places: dict[str, Array | float] = {name: evaluated(text, names) for name, text in here.items()}
    places |= {"smooth_rate": joint.smooth_rate, "time": names["time"]}
    shapes = [p.name for p in attached.effect.parameters if not p.amplitude]
    values = {name: starts(model, attached, name) for name in shapes}
    first = {name: each[0] for name, each in values.items()}
    rows = len(np.asarray(names["time"]))
    for shape in (first, *({**first, name: value} for name in shapes for value in values[name][1:])):

        def along(size: Mapping[str, float], shape: Mapping[str, float] = shape) -> Array:
            return np.broadcast_to(evaluated(attached.effect.force, {**places, **shape, **size}), (rows,))

        columns = []
        for amplitude in attached.effect.amplitudes:
            alone = {name: float(name == amplitude) for name in attached.effect.amplitudes}
            column = along(alone)
            if not np.allclose(along({name: 2.0 * size for name, size in alone.items()}), 2.0 * column):
                return  # not proportional to its amplitude
            columns.append(column)
        yield Term(attached.effect.name, np.column_stack(columns))


def residual(column: Array, nominal: Array) -> Array:
    """`column` (n,) or (n, m) without the part explained by `nominal` (n, k)."""
    scaled = nominal / np.maximum(np.linalg.norm(nominal, axis=0), 1e-300)
    return np.asarray(column - scaled @ np.linalg.lstsq(scaled, column, rcond=None)[0])
