"""What the model lacks while the vehicle moves: its one-step errors with their noise floor, and the missing force.

    inertia * rate' = load + missing force,   e = X force + Y start + v,   v white, of covariance S

e are the innovations of a segment of half a second. The missing force at a joint, N m or N, is constant in each fifth
of it, and is estimated by least squares, together with the error of the initial state, which has the model's prior. X
and Y are exact derivatives of the prediction; a force that begins later has the same response, later. S is the
covariance of the innovations that a correct model leaves (diagnosis.lack_of_fit.floor): with the process noise that the
model states, and the sensors' noise of the last four seconds. So a random disturbance of the vehicle is a missing
force, too.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from upright.diagnosis.lack_of_fit.floor import sensor_noise
from upright.diagnosis.lack_of_fit.missing_force import OWN
from upright.estimators.fit.innovations import NoiseModel
from upright.estimators.fit.problem import Problem
from upright.models.model import Model
from upright.models.parts import Joint, Parameter
from upright.models.segment import Segment

Array = NDArray[np.float64]

PREFIX = "missing_force_"
LATEST = 8
"""Segments from which the noise of the sensors is estimated: four seconds, which give it to 5 % of its deviation."""
PARTS = 5
"""Parts of a segment in which the missing force is constant: 0.1 s, a fifth of the period of the fastest motion that a
balancing vehicle makes."""


@dataclass(frozen=True, slots=True)
class Gap:
    """Of one segment: the `innovations` (n, ny); by channel, their RMS `error` in each part (PARTS,), and the RMS
    `floor` that noise alone makes; and by joint, the missing `force` with its standard deviation, both (PARTS,)."""

    innovations: Array
    error: Mapping[str, Array]
    floor: Mapping[str, float]
    force: Mapping[str, tuple[Array, Array]]
    units: Mapping[str, str]

    def to_json(self, begin: float, span: float) -> dict[str, Any]:
        """JSON-ready, without the innovations, for a segment of `span` s from `begin` s on."""
        return {
            "t0": round(begin + 0.5 * span / PARTS, 6),
            "dt": float(f"{span / PARTS:.6g}"),
            "error": {name: _short(values) for name, values in self.error.items()},
            "floor": {name: float(f"{value:.6g}") for name, value in self.floor.items()},
            "missing_force": {
                joint: {"values": _short(values), "std": _short(std), "unit": self.units[joint]}
                for joint, (values, std) in self.force.items()
            },
        }


def opened(model: Model) -> Model:
    """`model` with a constant force of zero at each joint, as a parameter."""

    def pushed(joint: Joint) -> Joint:
        return replace(joint, load=f"{joint.load} + {PREFIX}{joint.name}")

    forces = tuple(Parameter(f"{PREFIX}{each.name}", each.force_unit, 0.0, estimated=False) for each in model.joints)
    joints = tuple(map(pushed, model.joints))
    return replace(model, joints=joints, base_parameters=(*model.base_parameters, *forces))


class LiveGap:
    """The gap of an `opened` model, segment by segment. `problem` is that model's, without data."""

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self._noise = NoiseModel.of(problem)
        self._recent: deque[Segment] = deque(maxlen=LATEST)
        kernel, self._joints = problem.kernel, problem.model.joints
        forces = [kernel.index(f"{PREFIX}{joint.name}") for joint in self._joints]
        starts = [len(kernel.parameters) + place for place in problem.own]
        self._active = (*forces, *starts)

    def of(self, segment: Segment, first: int, last: int, initial: Array, values: Array) -> Gap | None:
        """The gap of samples `first` to `last`, from the measured state `initial` (nx,) at `first`, at parameter values
        (np,); None if no predictor with these values is stable."""
        problem = self._problem
        self._recent.append(segment)
        sensors, freedom = sensor_noise(replace(problem, segments=tuple(self._recent)))
        noise, known = replace(self._noise, sensor=sensors), np.zeros(self._noise.size)
        gain = noise.gain(values, known)
        covariance = noise.innovation(values, known, gain)
        if gain is None or covariance is None:
            return None
        predicted = np.empty_like(segment.measured)
        slopes = np.empty((*segment.measured.shape, len(self._active)))
        problem.kernel.proceed(
            segment,
            values,
            problem.kernel.memory(initial, self._active),
            gain,
            self._active,
            predicted,
            slopes,
            first=first,
            last=last,
            substeps=problem.substeps,
        )
        rows = slice(first, last + 1)
        errors = segment.measured[rows] - predicted[rows]
        force = self._forces(errors, slopes[rows], np.linalg.inv(np.linalg.cholesky(covariance)))
        shown = np.flatnonzero(np.isfinite(freedom)).tolist() or range(len(freedom))  # as Floor.informative
        names, floor = problem.kernel.outputs, np.sqrt(np.diag(covariance))
        rms = np.array([np.sqrt(np.mean(part**2, axis=0)) for part in np.array_split(errors, PARTS)])
        return Gap(
            innovations=errors,
            error={names[place]: rms[:, place] for place in shown},
            floor={names[place]: float(floor[place]) for place in shown},
            force={self._joints[place].name: size for place, size in force.items()},
            units={joint.name: joint.force_unit for joint in self._joints},
        )

    def _forces(self, errors: Array, slopes: Array, whitener: Array) -> dict[int, tuple[Array, Array]]:
        """The force at each joint where one shows, with its standard deviation, both (PARTS,), from `errors` (n, ny)
        and derivatives (n, ny, na).

        If a joint's response is a combination of those before it, its force is estimated as if all acted there.
        """
        count = len(self._joints)
        residual = (errors @ whitener.T).ravel()
        white = whitener @ slopes
        # Each initial state in its own unit, so that the prior is 1.
        start = (white[:, :, count:] * self._problem.spread).reshape(errors.size, -1)
        forces = _by_part(white[:, :, :count]).reshape(errors.size, -1)
        outer = np.linalg.solve(start.T @ start + np.eye(start.shape[1]), start.T)
        across = forces.T @ start
        information = (forces.T @ forces - across @ (outer @ forces)).reshape(count, PARTS, count, PARTS)
        score = (forces.T @ residual - across @ (outer @ residual)).reshape(count, PARTS)
        steady = information.sum(axis=(1, 3))
        shown = np.flatnonzero(np.diag(steady) > 0.0).tolist()
        together = _independent(steady, shown)
        found: dict[int, tuple[Array, Array]] = {}
        for group in (together, *([place] for place in shown if place not in together)):
            size = len(group) * PARTS
            spread = np.linalg.inv(information[np.ix_(group, range(PARTS), group, range(PARTS))].reshape(size, size))
            values, std = spread @ score[group].ravel(), np.sqrt(np.diag(spread))
            found |= {place: (values[part], std[part]) for place, part in zip(group, _blocks(len(group)), strict=True)}
        return dict(sorted(found.items()))


def _by_part(response: Array) -> Array:
    """From the `response` (n, ny, nj) to a force that begins with the segment, that to one in each part,
    (n, ny, nj, PARTS)."""
    edges = [len(part) for part in np.array_split(np.arange(len(response)), PARTS)]
    begins = np.concatenate(([0], np.cumsum(edges)))
    later = np.zeros((PARTS + 1, *response.shape))
    for each, begin in zip(later, begins, strict=True):
        each[begin:] = response[: len(response) - begin]
    return np.moveaxis(later[:-1] - later[1:], 0, -1)


def _independent(information: Array, places: Iterable[int]) -> list[int]:
    """Those of the joints at `places` whose response is no combination of those before them."""
    together: list[int] = []
    for place in places:
        own, across = information[place, place], information[together, place]
        left = own - across @ np.linalg.solve(information[np.ix_(together, together)], across) if together else own
        if left > OWN**2 * own:
            together.append(place)
    return together


def _blocks(count: int) -> list[slice]:
    return [slice(place * PARTS, (place + 1) * PARTS) for place in range(count)]


def _short(values: Array) -> list[float]:
    return [float(f"{value:.6g}") for value in values]
