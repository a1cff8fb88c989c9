"""One case from the record to its line in the results: the answer of each method, its time, its revised model."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from upright.models.effect import Effect
from upright.models.effects.catalogue import CATALOGUE
from upright.models.library import get
from upright.models.model import Model
from upright.service.hidden_effects.cases import Case, Kind
from upright.service.hidden_effects.disturbances import Disturbances, sensor_floor
from upright.service.hidden_effects.methods.answers import Answer, Method, diagnosis
from upright.service.hidden_effects.revision import Yardstick, closed, fitted
from upright.service.hidden_effects.sizes import SAME_EQUATION, NotDetectableError, levels, plant_sizes, right_model
from upright.service.hidden_effects.unlisted import UNLISTED_EFFECTS
from upright.service.hidden_effects.vehicles import Vehicle, drawn
from upright.simulation.config import EVENT_TIME, ImuNode, SimulationConfig
from upright.simulation.physics.disturbance import Disturbance
from upright.telemetry.errors import UprightError
from upright.telemetry.recording import Recording
from upright.vehicles.file import load

Record = Callable[[str, Mapping[str, float], float, float, int, Vehicle, Disturbance | None], Recording]
"""Makes a record from excitation, levels of the hidden effects, noise, duration in s, seed, vehicle and random
disturbance."""
Line = dict[str, Any]
"""The entry of a case in the results file."""

SUBJECT = "upright"
"""The method under test: its minimum detectable effects on the clean record define the sizes of the cases."""
DETECTABLE = "detectable"
WITHIN_95 = 1.959964
"""Standard deviations on either side of a 95 % interval."""


def virtual(
    excitation: str,
    hidden: Mapping[str, float],
    noise: float,
    duration: float,
    seed: int,
    vehicle: Vehicle,
    disturbance: Disturbance | None = None,
) -> Recording:
    """A record of the virtual MONOCAB; its IMU has `noise` times the noise of the data sheet."""
    from upright.service.virtual.run import record

    def configured(configuration: SimulationConfig) -> SimulationConfig:
        louder = noisy(configuration.imu, noise)
        return vehicle.configured(replace(configuration, imu=louder))

    # Levels have six digits, as the plant gets them.
    hide = [f"{name}={level:.6g}" for name, level in hidden.items()]
    if disturbance is not None:
        hide.append(f"disturbance={disturbance.rms:.6g},{disturbance.correlation_time:.6g}")
    return record(vehicle.file, excitation, hide=hide, seed=seed, duration=duration, configure=configured)


def noisy(imu: ImuNode, noise: float) -> ImuNode:
    """`imu` with `noise` times its white noise."""
    return replace(
        imu, angular_rate_density=noise * imu.angular_rate_density, acceleration_std=noise * imu.acceleration_std
    )


@dataclass(frozen=True, slots=True)
class Bench:
    """The setting for all cases: `methods` by name, including SUBJECT, on records of `duration` s."""

    methods: Mapping[str, Method] = field(default_factory=lambda: {SUBJECT: diagnosis})
    duration: float = 30.0
    record: Record = virtual
    model: str = "monocab_roll"
    """A model that lacks nothing if nothing is hidden. `monocab_reduced` has a single lag for the gimbals' speed loops,
    which are more than that, so that for it something is missing even in a clean record."""
    disturbances: Disturbances | None = None
    """The disturbances of the records; None: no disturbance."""

    @property
    def conditions(self) -> str:
        """The conditions that must be the same for all lines of a file."""
        common = f"{self.model}, {self.duration:g} s, vehicles as far off as their file says"
        if self.disturbances is None:
            return common
        return f"{common}, {self.disturbances.conditions}, sizes of what each shows beside its own"

    @property
    def nominal(self) -> Model:
        """The model that lacks the hidden effects, with the vehicle file's values."""
        from upright.estimators.identify.run import with_values

        parameters = load("monocab").parameters
        return with_values(get(self.model), parameters.values, parameters.deviations)


def held_out(excitation: str) -> str:
    """The experiment of the record on which a revised model is evaluated."""
    return "multisine" if excitation == "sweep" else "sweep"


def beginning(case: Case, bench: Bench) -> Line:
    """The first part of the line of a case, whatever its status."""
    return {
        "key": case.key,
        "kind": case.kind.value,
        "effects": list(case.effects),
        "size": case.size,
        "noise": case.noise,
        "excitation": case.excitation,
        "number": case.number,
        "seed": case.seed(),
        "conditions": bench.conditions,
    }


def run(case: Case, bench: Bench, detectable: Mapping[str, float]) -> Line:
    """The line of `case`. `detectable`: the minimum detectable sizes by effect from the reference case. With a
    disturbance they are taken from the same record with nothing hidden instead, since they depend on its size.

    A failure of the case is reported in the line; only programming errors raise exceptions.
    """
    line = beginning(case, bench)
    try:
        vehicle = drawn(case.seed("vehicle"))
        disturbance, line["disturbance"] = disturbance_of(case, bench, vehicle)
        if disturbance is not None and case.effects and SUBJECT in bench.methods:
            clean = bench.record(case.excitation, {}, case.noise, bench.duration, case.seed(), vehicle, disturbance)
            detectable = _detectable(bench, clean)
        hidden = levels(case, detectable)
        line |= {"levels": hidden, "sizes": plant_sizes(hidden)}
        recording = bench.record(case.excitation, hidden, case.noise, bench.duration, case.seed(), vehicle, disturbance)
        other = None
        if case.kind is not Kind.NOTHING:
            seed = case.seed("held out")
            excitation = held_out(case.excitation)
            other = bench.record(excitation, hidden, case.noise, bench.duration, seed, vehicle, disturbance)
    except NotDetectableError as error:
        return {**line, "status": "not_detectable", "reason": str(error), "methods": {}}
    except UprightError as error:
        return {**line, "status": "not_recorded", "reason": str(error), "methods": {}}
    return {**line, "status": "ok", "reason": "", **_answered(case, bench, hidden, recording, other, disturbance)}


def _detectable(bench: Bench, clean: Recording) -> Mapping[str, float]:
    """The minimum detectable sizes by effect in the record `clean`, for effects of the catalogue and outside it."""
    candidates: list[str | Effect] = [*CATALOGUE, *UNLISTED_EFFECTS.values()]
    return bench.methods[SUBJECT](bench.nominal, [clean], load("monocab").support, candidates=candidates).detectable


def disturbance_of(case: Case, bench: Bench, vehicle: Vehicle) -> tuple[Disturbance | None, Line | None]:
    """The disturbance in the records of `case`, and its entry in the line.

    The reference case represents all cases: its disturbance is the middle of the range, so that the sizes do not depend
    on a single draw.
    """
    if bench.disturbances is None:
        return None, None
    floor = partial(sensor_floor, vehicle.plant, noisy(ImuNode(), case.noise))
    found = bench.disturbances.of(None if case == case.reference else case.seed("disturbance"), floor)
    over_floor = found.rms / floor(found.correlation_time)
    return found, {"rms": found.rms, "correlation_time": found.correlation_time, "over_floor": over_floor}


def _answered(
    case: Case,
    bench: Bench,
    hidden: Mapping[str, float],
    recording: Recording,
    other: Recording | None,
    disturbance: Disturbance | None,
) -> Line:
    model, support = bench.nominal, load("monocab").support
    judge = _Judge(model, recording, other, support, hidden, disturbance)
    methods: dict[str, Line] = {}
    extra: Line = {}
    for name, method in bench.methods.items():
        began = time.perf_counter()
        try:
            answer = method(model, [recording], support)
            seconds = time.perf_counter() - began
            methods[name] = {"seconds": seconds, **judge.of(answer), "error": ""}
        except Exception as error:  # the failure of a method is its result, and does not affect the others
            methods[name] = {"seconds": time.perf_counter() - began, "error": f"{type(error).__name__}: {error}"}
            continue
        if name == SUBJECT and case == case.reference:
            whole = _detectable(bench, recording)
            unlisted = {name: size for name, size in whole.items() if name in UNLISTED_EFFECTS}
            extra[DETECTABLE] = {**answer.detectable, **unlisted}
    return {"methods": methods, **extra}


class _Judge:
    """Compares the answers for one record with the truth. Fits are cached: several methods may name the same effect."""

    def __init__(
        self,
        model: Model,
        recording: Recording,
        other: Recording | None,
        support: float,
        hidden: Mapping[str, float],
        disturbance: Disturbance | None,
    ) -> None:
        self._model = model
        self._data = [recording]
        self._other = other
        self._support = support
        self._hidden = hidden
        self._disturbance = disturbance
        self._fits: dict[tuple[str, ...], Model] = {}
        self._yardstick: Yardstick | None = None

    def of(self, answer: Answer) -> Line:
        found = [
            {
                "effect": each.effect,
                "tied_with": list(each.tied_with),
                "parameters": dict(each.parameters),
                "negligible": each.negligible,
            }
            for each in answer.found
        ]
        line: Line = {"verdict": answer.verdict, "found": found, "covered": self._covered(answer)}
        line |= {"disturbance": dict(answer.disturbance), "disturbance_covered": self._disturbance_covered(answer)}
        return line | self._revise(answer)

    def _covered(self, answer: Answer) -> dict[str, bool]:
        """For each effect that was found, whether the 95 % interval of its size contains the plant's."""
        sizes = plant_sizes(self._hidden)
        covered = {}
        for each in answer.found:
            local = SAME_EQUATION.get(each.effect, "")
            estimate = each.parameters.get(local) or each.parameters.get(f"{each.effect}.{local}")
            if each.effect in sizes and estimate is not None:
                value, deviation = estimate
                covered[each.effect] = abs(value - sizes[each.effect]) <= WITHIN_95 * deviation
        return covered

    def _disturbance_covered(self, answer: Answer) -> dict[str, bool]:
        """Whether the 95 % intervals of the disturbance's numbers, on a logarithmic scale, contain the plant's."""
        if self._disturbance is None:
            return {}
        truth = {"rms": self._disturbance.rms, "correlation_time": self._disturbance.correlation_time}
        return {
            name: abs(math.log(value / truth[name])) <= WITHIN_95 * deviation / value
            for name, (value, deviation) in answer.disturbance.items()
        }

    def _revise(self, answer: Answer) -> Line:
        """The error of the revised model; None, with the reason, if it cannot be calculated."""
        nothing: Line = {"held_out_closed": None, "energy_over_floor": None}
        try:
            right = self._right()
            assert self._yardstick is not None
            revised = self._revised(answer)
            floor = self._yardstick.energy(right, self._data, self._support)
            line: Line = {
                "held_out_closed": None,
                "energy_over_floor": self._yardstick.energy(revised, self._data, self._support) / floor,
            }
            if self._other is not None:
                energies = [
                    self._yardstick.energy(each, [self._other], self._support)
                    for each in (self._nominal(), revised, right)
                ]
                line["held_out_closed"] = closed(*energies)
        except (UprightError, ArithmeticError, np.linalg.LinAlgError) as error:
            return {**nothing, "repair_error": str(error)}
        return line

    def _right(self) -> Model:
        if self._yardstick is None:
            model = right_model(self._model, self._hidden, _event(self._data[0]))
            self._fits[("right",)], self._yardstick = fitted(model, self._data, self._support)
        return self._fits[("right",)]

    def _nominal(self) -> Model:
        if () not in self._fits:
            self._fits[()] = fitted(self._model, self._data, self._support)[0]
        return self._fits[()]

    def _revised(self, answer: Answer) -> Model:
        if not answer.found:
            return self._nominal()
        if answer.revised is not None:
            return answer.revised
        names = tuple(sorted(each.effect for each in answer.found))
        if names not in self._fits:
            model = self._model
            for name in names:
                model = model.add(name)
            self._fits[names] = fitted(model, self._data, self._support)[0]
        return self._fits[names]


def _event(recording: Recording) -> float:
    """Time of the plant's torque step, s from the first sample on; it is fixed relative to the first SYNC."""
    from upright.service.virtual.run import BOOT_TIME
    from upright.simulation.vehicle import START_NS

    begin = (int(recording.metadata.get("start_ns", START_NS)) - START_NS) * 1e-9
    return BOOT_TIME + EVENT_TIME - begin
