"""An independent plant for the tests of the roll controller, and its three procedures: get up, balance, get down.

The vehicle has the size given in the source papers (apparent inertia 1795 kg m^2, gravity stiffness 14.5 kN m/rad),
which is 24 % and 15 % off the CAD values of the controller design. The plant has sin(roll), stiff one-sided supports, a
first-order speed loop, transport delay, drive values that are one cycle old, sensor noise and encoder steps.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache

from upright.vehicles.experiment.excitation import Excitation
from upright.vehicles.file import VehicleFile, load
from upright.vehicles.monocab.control.controller import RollController, design
from upright.vehicles.monocab.control.rise import Lowering, RiseFromRest, rise_rate
from upright.vehicles.monocab.control.roll_design import RollDesign

RATES = (100, 250, 500)
SUBSTEP = 0.001
SETTLE = 3.0


def vehicle_at(rate: int) -> VehicleFile:
    vehicle = load("monocab")
    return vehicle.model_copy(update={"control": vehicle.control.model_copy(update={"rate": rate})})


@cache
def designed(rate: int) -> RollDesign:
    return design(vehicle_at(rate))


@dataclass
class Plant:
    """Roll, gimbals, supports; `step` sends one setpoint, which acts `delay` cycles later."""

    period: float
    delay: int = 1
    side: float = 1.0
    inertia: float = 1795.0
    gravity_stiffness: float = 14500.0
    angular_momentum: float = 3300.0
    lag: float = 0.04
    support: float = math.radians(4.0)
    load: Callable[[float], float] = lambda t: 0.0
    held_down: Callable[[float], float] = lambda roll: 0.0
    gimbal_coupling: bool = False
    time: float = 0.0
    roll: float = field(init=False)
    roll_rate: float = 0.0
    precession: float = 0.0
    precession_rate: float = 0.0
    carried: bool = True
    random: random.Random = field(default_factory=lambda: random.Random(20))

    def __post_init__(self) -> None:
        self.roll = self.side * self.support
        self._in_transit = [0.0] * self.delay
        self._old = (0.0, 0.0)
        for _ in range(round(1.0 / self.period)):
            self.step(0.0)
        self.time = 0.0

    def step(self, setpoint: float) -> None:
        self._in_transit.append(setpoint)
        setpoint = self._in_transit.pop(0)
        self._old = (self.precession, self.precession_rate)
        substeps = round(self.period / SUBSTEP)
        h = self.period / substeps
        for _ in range(substeps):
            torque = self.gravity_stiffness * math.sin(self.roll) + self.load(self.time)
            grip = math.cos(self.precession) if self.gimbal_coupling else 1.0
            torque += self.angular_momentum * grip * self.precession_rate + self.side * self.held_down(abs(self.roll))
            depth = abs(self.roll) - self.support
            self.carried = depth > 0.0
            if self.carried:
                outward = math.copysign(1.0, self.roll)
                torque -= outward * max(0.0, 2e6 * depth + 4e4 * outward * self.roll_rate)
            self.roll_rate += h * torque / self.inertia
            self.roll += h * self.roll_rate
            self.precession_rate += h * (setpoint - self.precession_rate) / self.lag
            self.precession += h * self.precession_rate
            self.time += h

    def measure(self) -> tuple[float, float, float, float]:
        """(roll, roll rate, precession rate, precession), with noise, encoder steps and drive values one cycle old."""
        precession, precession_rate = self._old
        return (
            self.roll + self.random.gauss(0.0, 1.5e-4),
            self.roll_rate + self.random.gauss(0.0, 5.6e-4 * math.sqrt(0.002 / self.period)),
            round(precession_rate / 7.7e-7) * 7.7e-7,
            round(precession / 9.6e-7) * 9.6e-7,
        )


@dataclass
class Log:
    """Course of the plant, by phase; angles in deg."""

    roll: dict[str, list[float]] = field(default_factory=dict)
    precession: dict[str, list[float]] = field(default_factory=dict)
    setpoint: dict[str, list[float]] = field(default_factory=dict)

    def add(self, phase: str, plant: Plant, setpoint: float) -> None:
        self.roll.setdefault(phase, []).append(math.degrees(plant.roll))
        self.precession.setdefault(phase, []).append(math.degrees(plant.precession))
        self.setpoint.setdefault(phase, []).append(setpoint)

    def largest_precession(self) -> float:
        return max(abs(value) for values in self.precession.values() for value in values)


def get_up(
    vehicle: VehicleFile, plant: Plant, log: Log, rate: float | None = None
) -> tuple[RiseFromRest, RollController]:
    roll_design = designed(vehicle.control.rate)
    controller = RollController.from_design(roll_design, vehicle)
    rise = RiseFromRest(
        rate or rise_rate(roll_design.parameters, vehicle.support), acceleration=vehicle.limits.precession_acceleration
    )
    while not rise.done and not rise.failure:
        roll, roll_rate, _, _ = plant.measure()
        setpoint = rise.step(vehicle.period, roll, roll_rate)
        if not rise.done:
            plant.step(setpoint)
            log.add("rise", plant, setpoint)
    controller.reset(rise.setpoint)
    return rise, controller


def balance(
    vehicle: VehicleFile,
    plant: Plant,
    log: Log,
    controller: RollController,
    phase: str,
    seconds: float,
    excitation: Excitation | None = None,
) -> None:
    on_reference = excitation is not None and excitation.on_reference
    for cycle in range(round(seconds / vehicle.period)):
        roll, roll_rate, precession_rate, precession = plant.measure()
        value = excitation.value(cycle * vehicle.period) if excitation else 0.0
        reference, output = (value, 0.0) if on_reference else (0.0, value)
        setpoint = controller.step(roll, roll_rate, precession_rate, precession, reference, vehicle.period, output)
        plant.step(setpoint)
        log.add(phase, plant, setpoint)


def get_down(vehicle: VehicleFile, plant: Plant, log: Log, controller: RollController, side: float) -> None:
    lowering = Lowering(side * vehicle.support, controller)
    while not lowering.done:
        roll, roll_rate, precession_rate, precession = plant.measure()
        setpoint = lowering.step(vehicle.period, roll, roll_rate, precession_rate, precession)
        plant.step(setpoint)
        log.add("lower", plant, setpoint)
    for _ in range(round(1.0 / vehicle.period)):
        plant.step(0.0)
        log.add("rest", plant, 0.0)


def peak(values: list[float]) -> float:
    return max(abs(value) for value in values)
