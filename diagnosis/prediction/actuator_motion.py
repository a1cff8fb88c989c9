"""The motion of an actuator, sample by sample, in a closed loop that is simulated, by a model of the actuators alone.

A model whose input is the motion of the actuators knows nothing of what happens to a command before that. The model of
the actuators does (models.model.Model.actuators_model), with the effects on the way of the command: it is simulated
beside the other, without noise. What it shows besides the motion of the actuators, as the rate of the vehicle that
turns them, it gets from there.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from upright.diagnosis.prediction.closed_loop import causal
from upright.estimators.data.ramp import RampLimiter
from upright.estimators.fit.problem import substeps_of, typical_motion
from upright.models.compiler.kernel import compile_model
from upright.models.model import Model
from upright.models.segment import Segment


class ActuatorMotion:
    """`step` takes the command that is sent at a sample and what is seen there, and returns the motion at the next one,
    `period` s later, by the name of its output. A command is sent `sent` s after its sample; all before the first were
    `command`, and the actuators at rest.

    There are at most `samples` of them: a delayed command is looked up among those before it.
    """

    def __init__(self, model: Model, period: float, samples: int, command: float, sent: float = 0.0) -> None:
        """Raises ModelError for a model that cannot be compiled."""
        model, count = causal(model), samples + 2  # with one before the first, and one after the last
        time = period * np.arange(-1.0, count - 1.0)
        knots = time[:, None] + np.array([sent if each.age else 0.0 for each in model.inputs])
        values = np.array([0.0 if each.ramp_of else command for each in model.inputs])
        rows = Segment(time, knots, np.tile(values, (count, 1)), np.zeros((count, len(model.outputs))))
        kernel, states = compile_model(model), [each.name for each in model.states]
        memory = kernel.memory(np.zeros(len(states)))
        memory.lag[:] = values
        substeps = substeps_of(kernel, kernel.vector(), [rows], typical_motion(model, [rows]))
        nothing = np.empty((*rows.measured.shape, 0))
        self._move = kernel.ready(rows, kernel.vector(), memory, None, (), rows.measured, nothing, substeps=substeps)
        self._inputs, self._outputs, self._state = rows.inputs, rows.measured, memory.x
        self._limiters = [RampLimiter(each.ramp, command) if each.ramp_of else None for each in model.inputs]
        self._names, self._period, self._row = kernel.outputs, period, 0
        self._kept = [(states.index(name), name) for name in kernel.outputs if name in states]
        self._move(0, 1, False)

    def step(self, command: float, seen: Mapping[str, float]) -> dict[str, float]:
        """The motion at the next sample. Raises ModelError after `samples` of them."""
        self._row += 1
        for place, limiter in enumerate(self._limiters):
            value = command if limiter is None else limiter.step(command, self._period)
            self._inputs[self._row, place] = value
        for place, name in self._kept:
            if name in seen:
                self._state[place] = seen[name]
        self._move(self._row, self._row + 1, True)
        return dict(zip(self._names, self._outputs[self._row + 1].tolist(), strict=True))


def motion_of(model: Model, channel: str) -> Model | None:
    """The model of the actuators of `model` whose command is `channel`; None if there is none."""
    actuators = model.actuators_model
    return actuators if actuators is not None and channel in actuators.actuators[0].commands else None
