"""Does the diagnosis name the right effect in recordings of a robot of another simulator? `benchmarks/others_robot.py`

Like `benchmarks/others_recordings.py`, for a two-wheeled robot that is not our virtual one: its tilt is measured
directly, with white noise, not estimated by a filter from gyro and accelerometer; voltages act without delay and in
steps of 1 mV; its parameters are up to a third off the vehicle file's; and the tables have no ages of the measurements.
Equations (1) to (22) of the paper for motion straight ahead, coded independently, in steps of 0.1 ms.
"""

from __future__ import annotations

import argparse
import math
import os
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.others_recordings import CLEAN, diagnosis_of, verdicts

STEP, RATE, SECONDS = 1e-4, 200, 24.0
RADIUS, WHEEL, HEIGHT, BODY, TILT_INERTIA = 0.0325, 0.053, 0.05, 0.85, 1.8e-3
GEAR, ROTOR, RESISTANCE, CONSTANT, GEAR_FRICTION, FLOOR_FRICTION = 43.8, 3.2e-6, 4.4, 5.8e-3, 7.3e-6, 6e-4
GRAVITY = 9.81
COUNT = 2.0 * math.pi / 700.0
TILT_NOISE, RATE_NOISE = 2e-4, 2e-3
"""RMS per sample, rad and rad/s."""
WHEELS = tuple(f"{side}_wheel_{what}" for side in ("left", "right") for what in ("angle", "rate"))
CHANNELS = ("time", "tilt", "tilt_rate", "left_voltage", "right_voltage", *WHEELS)


@dataclass(frozen=True)
class OthersRobot:
    """Torques (N m) that a model lacks: `floor` on the wheels, as a function of time (s) and their rolling rate, `body`
    on the body, of time, and `gears` between them, of their relative rate. `command` distorts the motors' voltage,
    `askew` (rad) is the offset of the tilt sensor."""

    floor: Callable[[float, float], float] = lambda time, rate: 0.0
    body: Callable[[float], float] = lambda time: 0.0
    gears: Callable[[float], float] = lambda rate: 0.0
    command: Callable[[float], float] = float
    askew: float = 0.0
    seed: int = 0

    def write(self, path: Path) -> Path:
        """Write a table of the channels that the manual requires."""
        random = np.random.default_rng(self.seed)
        rolled, tilt, rolling, tipping = 0.0, 0.005, 0.0, 0.0
        rows: list[list[float]] = []
        integral, last = 0.0, 0.0
        for row in range(round(SECONDS * RATE)):
            time = row / RATE
            shown = tilt + self.askew + TILT_NOISE * random.standard_normal()
            rate = tipping + RATE_NOISE * random.standard_normal()
            angle = round((rolled - tilt) / COUNT) * COUNT
            # The setpoint of the tilt brings the wheels back to their start.
            error = shown + min(max(0.003 * (angle + rolling), -0.03), 0.03)
            integral += error / RATE
            excitation = 8.0 * math.copysign(1.0, math.sin(5.0 * time)) if time > 3.0 else 0.0
            wanted = math.degrees(10.0 * error + 3.0 * integral + 0.7 * rate) + excitation
            voltage = round(min(max(wanted, -12.0), 12.0), 3)
            rows.append([time, shown, rate, voltage, voltage, *(angle, (angle - last) * RATE) * 2])
            last, acting = angle, self.command(voltage)
            for step in range(round(1.0 / RATE / STEP)):
                now = time + step * STEP
                onward, over = self._accelerations(now, acting, tilt, rolling, tipping)
                rolled += STEP * (rolling + 0.5 * STEP * onward)
                tilt += STEP * (tipping + 0.5 * STEP * over)
                rolling += STEP * onward
                tipping += STEP * over
        np.savetxt(path, np.array(rows), delimiter=",", header=",".join(CHANNELS), comments="", fmt="%.8g")
        return path

    def _accelerations(
        self, time: float, voltage: float, tilt: float, rolling: float, tipping: float
    ) -> tuple[float, float]:
        """Angular accelerations of the wheels relative to the floor and of the body, rad/s^2."""
        between = rolling - tipping
        back_emf, rotors = CONSTANT * GEAR, 2.0 * GEAR**2 * ROTOR
        motors = 2.0 * (back_emf / RESISTANCE * (voltage - back_emf * between) - GEAR_FRICTION * between)
        motors += self.gears(between)
        lean = BODY * HEIGHT * RADIUS
        on_wheels = motors - 2.0 * FLOOR_FRICTION * rolling + self.floor(time, rolling)
        on_wheels += lean * math.sin(tilt) * tipping**2
        on_body = BODY * GRAVITY * HEIGHT * math.sin(tilt) - motors + self.body(time)
        first = (3.0 * WHEEL + BODY) * RADIUS**2 + rotors
        both = lean * math.cos(tilt) - rotors
        second = BODY * HEIGHT**2 + TILT_INERTIA + rotors
        determinant = first * second - both**2
        return (
            (second * on_wheels - both * on_body) / determinant,
            (first * on_body - both * on_wheels) / determinant,
        )


def hill(degrees: float) -> float:
    """Torque on the wheels by a slope, N m."""
    return -(BODY + 2.0 * WHEEL) * GRAVITY * RADIUS * math.sin(math.radians(degrees))


EFFECTS: dict[str, dict[str, Any]] = {
    "static_torque": {"body": lambda time: 0.01},
    "static_torque@travel": {"floor": lambda time, rate: hill(2.0)},
    "coulomb_friction@wheels": {"gears": lambda rate: -0.02 * math.tanh(rate / 0.02)},
    "input_deadband": {"command": lambda volts: math.copysign(max(abs(volts) - 0.6, 0.0), volts)},
    "sensor_offset": {"askew": 8.7e-3},
    "torque_step": {"body": lambda time: 0.012 if time > 12.0 else 0.0},
    "periodic_disturbance": {"body": lambda time: 0.01 * math.sin(2.0 * math.pi * 1.3 * time)},
}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--clean", type=int, default=3, help="number of robots with nothing hidden")
    parser.add_argument("--effect", action="append", help="may be given several times; default: all")
    parser.add_argument("--processes", type=int, default=2)
    arguments = parser.parse_args()
    names = arguments.effect or [*[CLEAN] * arguments.clean, *EFFECTS]
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(arguments.processes) as pool:

        def tried(number: int) -> dict[str, Any]:
            robot = OthersRobot(seed=arguments.seed + number, **EFFECTS.get(names[number], {}))
            return diagnosis_of(robot.write(Path(folder) / f"{number}.csv"), "twsbr")

        verdicts(names, pool.map(tried, range(len(names))), {"in the catalogue": EFFECTS, "clean": {CLEAN: {}}})


if __name__ == "__main__":
    main()
