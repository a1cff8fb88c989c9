"""The response of a model in an experiment that was not run: the closed loop of the compiled model and its controller.

At each sample the controller computes the inputs from the outputs of the model, and the model goes on: without noise,
from rest, or settled from there. The controller is a plain callable, so that the vehicle's own can be used here. A
command is held from its sample on; an input that is a measurement (the gimbals' motion, say) is given for the next
sample, to which it leads.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from math import inf
from typing import Any

import numpy as np
from numpy.typing import NDArray

from upright.estimators.fit.problem import Problem, problem
from upright.models.compiler.kernel import Memory
from upright.models.model import Model
from upright.models.parts import Hold
from upright.models.segment import Segment

Array = NDArray[np.float64]

ROOM = 0.8
"""Share of a limit that a prediction may reach: the rest is a margin for noise and model errors."""

Controller = Callable[[float, Mapping[str, float]], Mapping[str, float]]
"""From the time, s, and the outputs by name to the inputs by name, and further channels that have a limit."""


@dataclass(frozen=True, slots=True)
class Limit:
    """The largest magnitude of a channel; `unit` and `factor` to show it in, `meaning` says why."""

    channel: str
    largest: float
    unit: str
    meaning: str
    factor: float = 1.0


@dataclass(frozen=True, slots=True)
class Experiment:
    """An excitation of the vehicle that could be run.

    `parameters` as in the vehicle file; `duration` s; `period` s of the control loop; `controller(model)` makes a new
    controller with the excitation in it, and with the actuators of a model that has none of its own. `shorter(s)` is
    the same experiment in less time, None if that is not possible. The controller runs for `settling` s before it, at
    times below zero.
    """

    name: str
    parameters: Mapping[str, Any]
    duration: float
    period: float
    controller: Callable[[Model], Controller] = field(repr=False)
    limits: tuple[Limit, ...] = ()
    settling: float = 0.0
    shorter: Callable[[float], Experiment | None] = field(default=lambda duration: None, repr=False)


@dataclass(frozen=True, slots=True)
class Course:
    """`rows` of the experiment as the model predicts them. `broken`: the limit that it comes too close to, or ""."""

    rows: Segment
    broken: str


def causal(model: Model) -> Model:
    """`model` without negative input delays, which a fit of clock offsets may give."""
    early = {name for each in model.inputs for name in each.delays if model.parameter(name).value < 0.0}
    return model.change(dict.fromkeys(early, 0.0))


def simulate(model: Model, experiment: Experiment) -> Course:
    """The closed loop of `model` (see `causal`) and the controller, up to the sample at which a limit is broken."""
    first = round(experiment.settling / experiment.period)
    count = first + round(experiment.duration / experiment.period) + 1
    time = experiment.period * np.arange(-first, count - first, dtype=np.float64)
    inputs, outputs = len(model.inputs), len(model.outputs)
    knots = np.ascontiguousarray(np.repeat(time[:, None], inputs, axis=1))
    usual = np.repeat([[0.0 if each.usual is None else each.usual for each in model.inputs]], count, axis=0)
    rows = Segment(time, knots, usual, np.zeros((count, outputs)), experiment.name)
    task = problem(model, (), rows=[rows])
    start = task.kernel.memory(np.zeros(len(task.kernel.states)))
    course = Segment(time[first:], knots[first:], usual[first:], rows.measured[first:], experiment.name)
    bounds = [(each, each.channel, ROOM * each.largest) for each in experiment.limits]
    for row, seen, given in steps(task, task.kernel.vector(), rows, start, experiment.controller(model)):
        for limit, channel, bound in bounds:
            value = abs(given[channel] if channel in given else seen[channel])
            # Until it has settled, the model is in states in which the vehicle never was.
            if not value <= (bound if row >= first else inf):
                return Course(course, _broken(limit, value, float(time[row])))
    return Course(course, "")


def steps(
    task: Problem,
    values: Array,
    rows: Segment,
    memory: Memory,
    controller: Controller,
    *,
    first: int = 0,
    shocks: tuple[Array, Array] | None = None,
) -> Iterator[tuple[int, Mapping[str, float], Mapping[str, float]]]:
    """Close the loop from sample `first` on: each sample with what the controller saw there and the inputs it gave.

    Outputs are written to `rows.measured`, the inputs that the controller gives to `rows.inputs`; other inputs stay.
    `memory` is the model's at sample `first`, whose outputs are in `rows` unless it is the first of all. `shocks` (m,
    ny) and (m, nx), one row per sample from `first` on, are noise that is added to the measurements and to the state.
    """
    kernel = task.kernel
    move = kernel.ready(
        rows, values, memory, None, (), rows.measured, np.empty((*rows.measured.shape, 0)), substeps=task.substeps
    )
    # Tens of thousands of samples, each a few microseconds of mathematics: plain numbers, and views made once.
    instants = rows.time.tolist()
    measured: Any = rows.measured.data  # typeshed does not know views of more than one dimension
    inputs: Any = rows.row_inputs.data
    last, channels = len(instants) - 1, range(len(kernel.outputs))
    holds = {each.name: each.hold for each in task.model.inputs}
    held = [(place, name) for place, name in enumerate(kernel.inputs) if holds[name] is not Hold.CUBIC]
    curves = [(place, name) for place, name in enumerate(kernel.inputs) if holds[name] is Hold.CUBIC]
    noise, kicks = ((), ()) if shocks is None else (each.tolist() for each in shocks)
    before, known = memory.copy(), False
    here, there = memory.views(), before.views()
    state: Any = memory.x.data
    if first == 0:
        move(0, 0, False)
    for row in range(first, last):
        seen = {name: measured[row, place] for place, name in enumerate(kernel.outputs)}
        if noise:
            for name, error in zip(kernel.outputs, noise[row - first], strict=True):
                seen[name] += error
        given = controller(instants[row], seen)
        yield row, seen, given
        for place, name in held:
            if name in given:
                inputs[row, place] = given[name]
        curved = False
        for place, name in curves:
            if name in given:
                curved = True
                # The curve to the next sample depends on the one after, which is not known yet: extrapolate linearly.
                chord = given[name] - inputs[row, place]
                inputs[row + 1, place] = given[name]
                if row + 2 <= last:
                    inputs[row + 2, place] = given[name] + chord
        if curved and known:  # only now the curve to this sample is known
            for mine, other in zip(here, there, strict=True):
                mine[:] = other
            move(row - 1, row, True)
        if noise:
            for place in channels:
                measured[row, place] += noise[row - first][place]
            for place, kick in enumerate(kicks[row - first]):
                state[place] += kick
        if curved:
            for mine, other in zip(here, there, strict=True):
                other[:] = mine
        known = curved
        move(row, row + 1, True)


def _broken(limit: Limit, value: float, time: float) -> str:
    if not np.isfinite(value):
        return f"the model diverges {time:.1f} s after the start" if time >= 0.0 else "the model does not settle"
    return (
        f"{limit.channel} would reach {limit.factor * value:.3g} {limit.unit} after {time:.1f} s, more than"
        f" {100.0 * ROOM:g} % of the {limit.factor * limit.largest:.3g} {limit.unit} {limit.meaning}"
    )
