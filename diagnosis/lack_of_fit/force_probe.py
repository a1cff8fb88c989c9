"""A model with a force as an input at each joint and every coordinate as an output.

    x~+ = (A - A K C) x~ + B w,    e = C x~ + D w + v,    v white, of the covariance S of the noise floor

is the response of the predictor's error x~ and of its innovations e to a force w that the model does not know. It is
linear and stable, even if the plant is unstable. B and D are differentiated where A and C are
(estimators.fit.innovations).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from upright.diagnosis.lack_of_fit.floor import Floor, Innovations
from upright.estimators.fit.problem import typical_motion
from upright.models.compiler.kernel import Kernel, Progress, compile_model
from upright.models.model import Model
from upright.models.parts import Hold, Input, Joint, Output
from upright.models.segment import Segment
from upright.models.text.expressions import names_in

Array = NDArray[np.float64]

PREFIX = "missing_force_"
SMALL = 1e-2
"""Step, as a share of a joint's typical force, with which the response to a force is differentiated."""


@dataclass(frozen=True, slots=True)
class Coordinate:
    """A quantity on which a missing force may depend: `values` by segment, each (n,), before the sample's own
    correction.

    `std` is the standard deviation of the filter's error if it is estimated, 0 if it is measured.
    """

    name: str
    unit: str
    values: tuple[Array, ...]
    std: float


@dataclass(frozen=True, slots=True)
class Response:
    """Response to a force at each of nj joints: B (nx, nj), D (ny, nj) per unit of force; all else is the floor's."""

    drive: Array
    direct: Array
    floor: Floor

    def impulse(self, joint: int, rows: int) -> Array:
        """Innovations after one sample of unit force at `joint`, (rows, ny)."""
        pushes = np.zeros((rows, len(self.drive)))
        pushes[1:2] = self.drive[:, joint]
        out = recurrence(self.floor.predictor, pushes) @ self.floor.output.T
        out[0] += self.direct[:, joint]
        return out


@dataclass(frozen=True, slots=True)
class Probe:
    """A model with a force as an input at each joint and every coordinate as an output, evaluated on a record."""

    joints: tuple[Joint, ...]
    response: Response
    coordinates: tuple[Coordinate, ...]


def probe(found: Innovations, *, progress: Progress | None = None) -> Probe:
    """The response to a force at each joint, and the coordinates by sample, of the model that left `found`."""
    task, fit = found.problem, found.fit
    model, names = _opened(task.model)
    kernel = compile_model(model, progress=progress)
    kernel = replace(kernel, defaults=fit.values)
    gain = np.zeros((len(kernel.states), len(kernel.outputs)))
    gain[:, : len(task.model.outputs)] = fit.gain
    rows = []
    for segment, start in zip(task.segments, fit.starts, strict=True):
        opened = _extended(segment, len(task.model.joints), len(names))
        run = kernel.run(opened, fit.values, start, gain=gain, substeps=task.substeps)
        rows.append(run.predicted[:, len(task.model.outputs) :])
    drive, direct = _driven(kernel, task.model, found)
    shows = [place for place in range(len(task.model.joints)) if np.any(drive[:, place]) or np.any(direct[:, place])]
    response = Response(drive[:, shows], direct[:, shows], found.floor)
    joints = tuple(task.model.joints[place] for place in shows)
    return Probe(joints, response, tuple(_coordinates(task.model, names, rows, task.segments, found.floor)))


def recurrence(matrix: Array, pushes: Array) -> Array:
    """x of x(k) = matrix x(k - 1) + pushes(k), both (n, nx), for a stable matrix, by doubling the length of the sum."""
    states, power, reach = pushes.copy(), matrix, 1
    while reach < len(states) and np.max(np.abs(power)) > 0.0:
        states[reach:] += states[:-reach] @ power.T
        power, reach = power @ power, 2 * reach
    return states


def _opened(model: Model) -> tuple[Model, Mapping[str, tuple[str, str]]]:
    """`model` with a force as an input at each joint, and the expressions and units of the coordinates as outputs."""
    # States of an effect at another place than its first have names that no equation can contain.
    # A disturbance depends on nothing.
    shown = {
        state.name: (state.name, state.unit)
        for state in model.states
        if "@" not in state.name and not state.correlation_time
    }
    for actuator in model.actuators:
        if actuator.angle and actuator.angle not in {*shown, *(each.name for each in model.inputs)}:
            shown[f"{actuator.name} angle"] = (actuator.angle, actuator.angle_unit)
    forces = tuple(Input(f"{PREFIX}{joint.name}", joint.force_unit, Hold.ZERO_ORDER) for joint in model.joints)
    outputs = tuple(
        Output(f"coordinate_{number}", unit, text, noise=1.0) for number, (text, unit) in enumerate(shown.values())
    )
    joints = tuple(replace(joint, load=f"{joint.load} + {PREFIX}{joint.name}") for joint in model.joints)
    return replace(model, inputs=model.inputs + forces, outputs=model.outputs + outputs, joints=joints), shown


def _extended(segment: Segment, forces: int, outputs: int) -> Segment:
    """`segment` with zero force, and with unknown coordinates."""
    time = np.concatenate((np.repeat(segment.time[0], segment.earlier), segment.time))
    return replace(
        segment,
        knots=np.hstack((segment.knots, np.repeat(time[:, None], forces, axis=1))),
        inputs=np.hstack((segment.inputs, np.zeros((len(time), forces)))),
        measured=np.hstack((segment.measured, np.full((len(segment), outputs), np.nan))),
    )


def _driven(kernel: Kernel, model: Model, found: Innovations) -> tuple[Array, Array]:
    """B (nx, nj) and D (ny, nj)."""
    first, outputs, inputs = found.problem.segments[0], len(model.outputs), len(model.inputs)
    time = float(first.time[0]) + found.floor.spacing * np.arange(2.0)
    held = np.zeros((2, len(kernel.inputs)))
    held[:, :inputs] = first.inputs.mean(axis=0)
    knots = np.repeat((time - 1.0)[:, None], len(kernel.inputs), axis=1)
    unknown = np.full((2, len(kernel.outputs)), np.nan)
    motion = typical_motion(model, found.problem.segments)
    drive, direct = [], []
    for place, joint in enumerate(model.joints):
        ends = []
        for sign in (1.0, -1.0):
            pushed = held.copy()
            pushed[:, inputs + place] = sign * SMALL * joint.force_scale
            run = kernel.run(Segment(time, knots, pushed, unknown), found.fit.values, motion)
            ends.append((run.final, run.predicted[0, :outputs]))
        size = 2.0 * SMALL * joint.force_scale
        drive.append((ends[0][0] - ends[1][0]) / size)
        direct.append((ends[0][1] - ends[1][1]) / size)
    return np.array(drive).reshape(-1, len(kernel.states)).T, np.array(direct).reshape(-1, outputs).T


def _coordinates(
    model: Model,
    shown: Mapping[str, tuple[str, str]],
    rows: list[Array],
    segments: tuple[Segment, ...],
    floor: Floor,
) -> list[Coordinate]:
    """States, inputs and the actuators' angles, without those that never move or have no part in the motion."""
    deviations = np.sqrt(np.maximum(np.diag(floor.state_covariance), 0.0)).tolist()
    std = dict(zip([state.name for state in model.states], deviations, strict=True))
    moving = _moving(model)
    found = [
        Coordinate(
            name,
            unit,
            tuple(part[:, place] for part in rows),
            std.get(name, 0.0),
        )
        for place, (name, (_, unit)) in enumerate(shown.items())
        if name in moving or name not in std
    ]
    found += [
        Coordinate(each.name, each.unit, tuple(segment.row_inputs[:, place] for segment in segments), 0.0)
        for place, each in enumerate(model.inputs)
        if each.name not in shown
    ]
    return [each for each in found if np.ptp(np.concatenate(each.values)) > 0.0]


def _moving(model: Model) -> set[str]:
    """States that have a part in the motion of a joint; the others are errors of sensors and filters."""
    derivatives = {state.name: state.derivative for state in model.base_states} | dict(model.definitions)
    derivatives |= {f"{joint.name}_force": joint.load for joint in model.joints}
    open_names = [name for joint in model.joints for text in (joint.coordinate, joint.rate) for name in names_in(text)]
    found = {state.name for attached in model.effects for state in attached.states}
    while open_names:
        name = open_names.pop()
        if name not in found:
            found.add(name)
            open_names += names_in(derivatives[name]) if name in derivatives else ()
    return found
