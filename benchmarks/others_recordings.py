"""Does the diagnosis name the right effect in recordings of a MONOCAB of another simulator?

`python benchmarks/others_recordings.py --noise 5` simulates a vehicle that is not our virtual one, writes a table for
each effect, and runs `upright diagnose TABLE --vehicle monocab`. The amplitudes are realistic, many times the minimum
detectable ones. Roll is measured by an encoder with white noise, and the gyro is as noisy as cheap ones are. The
controller is a plain PD whose setpoint acts without delay, and the gimbals are one first-order lag: the drives respond
to the noise of a sample before the next sample. The simulator is independent of `simulation` and `models`; it uses the
midpoint rule with steps of 0.1 ms.

`--disturbance 8,0.3` adds a random torque of 8 N m RMS with a correlation time of 0.3 s. `--sensor` gives the sensors
one error that real ones have beside white noise (SENSORS); the controller gets it, too.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.stats import binomtest

Array = NDArray[np.float64]

STEP = 1e-4
INERTIA, STIFFNESS, MOMENTUM, LAG = 1560.0, 13400.0, 3300.0, 0.04
FREQUENCIES = np.array([0.13, 0.31, 0.53, 0.89, 1.31, 1.9, 2.7, 3.9])
ROLL_NOISE, RATE_NOISE, GIMBAL_NOISE = 2e-5, 3e-4, 1e-4
"""RMS per sample in rad, rad/s and rad/s, times `noise`."""
CHANNELS = (
    "time",
    "roll",
    "roll_rate",
    "precession",
    "precession_rate",
    "precession_rate_setpoint",
    "trim_position",
    "trim_rate",
    "trim_rate_setpoint",
)


@dataclass(frozen=True, slots=True)
class Moment:
    """The quantities that an effect may depend on: s, rad, rad/s, and its own states."""

    time: float
    roll: float
    roll_rate: float
    precession: float
    precession_rate: float
    own: Sequence[float]


Torque = Callable[[Moment], float]


@dataclass(frozen=True, slots=True)
class Sensors:
    """Errors beside white noise. `step` (rad) of an encoder for roll; `jitter` (s) RMS of the time stamps; `vibration`
    of the gyro: RMS (rad/s), frequency (Hz), damping ratio; `wander` of the gyro: RMS (rad/s), correlation time (s);
    a camera for roll: `frames` per second, each held until the next one, RMS error `blur` (rad) of a frame."""

    step: float = 0.0
    jitter: float = 0.0
    vibration: tuple[float, float, float] = (0.0, 1.0, 0.5)
    wander: tuple[float, float] = (0.0, 1.0)
    frames: float = 0.0
    blur: float = 0.0


SENSORS: dict[str, Sensors] = {
    "white": Sensors(),
    "encoder": Sensors(step=5e-4),
    "jitter": Sensors(jitter=5e-4),
    "vibration": Sensors(vibration=(5e-3, 25.0, 0.05)),
    "slow_vibration": Sensors(vibration=(5e-3, 8.0, 0.1)),
    "wander": Sensors(wander=(3e-3, 0.05)),
    "camera": Sensors(frames=60.0, blur=1e-4),
}
"""The choices of `--sensor`."""


@dataclass
class Coloured:
    """A random signal of `rms` and the correlation time `time` (s), stepped exactly by `step` s."""

    rms: float
    time: float
    step: float
    random: np.random.Generator
    _value: float = field(init=False)

    def __post_init__(self) -> None:
        self._value = self.rms * self.random.standard_normal()

    def next(self) -> float:
        """Return the current value and advance by a step."""
        now, fading = self._value, math.exp(-self.step / self.time)
        self._value = now * fading + self.rms * math.sqrt(1.0 - fading**2) * self.random.standard_normal()
        return now


@dataclass
class Mode:
    """Rate of a mode driven by white noise, of `rms`, about `frequency` (Hz), stepped exactly by `step` s."""

    rms: float
    frequency: float
    damping: float
    step: float
    random: np.random.Generator
    _state: Array = field(init=False)

    def __post_init__(self) -> None:
        turn = 2.0 * math.pi * self.frequency
        self._moved = expm(self.step * turn * np.array([[0.0, 1.0], [-1.0, -2.0 * self.damping]]))
        # The stationary covariance of both states is the identity.
        self._root = np.linalg.cholesky(np.eye(2) - self._moved @ self._moved.T)
        self._state = self.random.standard_normal(2)

    def next(self) -> float:
        """Return the current value and advance by a step."""
        now = self.rms * float(self._state[1])
        self._state = self._moved @ self._state + self._root @ self.random.standard_normal(2)
        return now


@dataclass
class Readings:
    """Readings of roll and its rate by `sensors`, a sample every `row` s; `random` generates their errors."""

    sensors: Sensors
    row: float
    random: np.random.Generator
    _errors: list[Coloured | Mode] = field(init=False)
    _frame: tuple[int, float] = (-1, 0.0)

    def __post_init__(self) -> None:
        self._errors = [
            Mode(*self.sensors.vibration, self.row, self.random),
            Coloured(*self.sensors.wander, self.row, self.random),
        ]

    def __call__(self, time: float, roll: float, roll_rate: float) -> tuple[float, float, float]:
        """The time stamp and both readings, from the true values plus white noise."""
        sensors = self.sensors
        if sensors.step:
            roll = sensors.step * round(roll / sensors.step)
        if sensors.frames:
            frame = math.floor(time * sensors.frames)
            if frame != self._frame[0]:
                self._frame = frame, roll + sensors.blur * self.random.standard_normal()
            roll = self._frame[1]
        stamp = time + sensors.jitter * float(np.clip(self.random.standard_normal(), -3.0, 3.0))
        return stamp, roll, roll_rate + sum(each.next() for each in self._errors)


@dataclass
class OthersVehicle:
    """The model lacks `torque` (N m), with `own` states that start at zero and have the derivatives `slopes`. `command`
    distorts the setpoint in the drives; `delay` in samples and `further_lag` in s act on it, too. `sensed` distorts the
    measured roll and its rate, which are `late` samples late."""

    torque: Torque = lambda now: 0.0
    slopes: Callable[[Moment], tuple[float, ...]] = lambda now: ()
    own: int = 0
    command: Callable[[float], float] = float
    delay: int = 0
    further_lag: float = 0.0
    sensed: Callable[[float, float], tuple[float, float]] = lambda roll, roll_rate: (roll, roll_rate)
    late: int = 0
    rate: int = 200
    noise: float = 5.0
    sweep: bool = False
    seed: int = 0
    sensors: Sensors = SENSORS["white"]
    disturbance: tuple[float, float] = (0.0, 1.0)
    """N m RMS, and s."""
    state: list[float] = field(init=False)
    """Roll, its rate, precession, its rate, the setpoint after the further lag, and `own` states."""
    _shake: float = 0.0

    def __post_init__(self) -> None:
        self.state = [0.002, 0.0, 0.0, 0.0, 0.0, *[0.0] * self.own]
        self._shaking = Coloured(*self.disturbance, STEP, np.random.default_rng((self.seed, 1)))

    def write(self, path: Path, seconds: float = 40.0) -> Path:
        """Write a table of the channels that the manual requires."""
        random = np.random.default_rng(self.seed)
        phases = random.uniform(0.0, 2.0 * np.pi, FREQUENCIES.size)
        rows: list[list[float]] = []
        shown: list[tuple[float, float]] = []
        read = Readings(self.sensors, 1.0 / self.rate, np.random.default_rng((self.seed, 2)))
        for row in range(round(seconds * self.rate)):
            time = row / self.rate
            roll, roll_rate = self.sensed(self.state[0], self.state[1])
            stamp, *readings = read(
                time,
                roll + self.noise * ROLL_NOISE * random.standard_normal(),
                roll_rate + self.noise * RATE_NOISE * random.standard_normal(),
            )
            shown.append((readings[0], readings[1]))
            roll, roll_rate = shown[max(0, row - self.late)]
            gimbal_rate = self.state[3] + self.noise * GIMBAL_NOISE * random.standard_normal()
            lean = 0.012 * self.state[2]
            excitation = self._excitation(time, seconds, phases)
            setpoint = float(np.clip(-18.0 * (roll + lean) - 5.2 * roll_rate + excitation, -1.0, 1.0))
            rows.append([stamp, roll, roll_rate, self.state[2], gimbal_rate, setpoint, 0.0, 0.0, 0.0])
            self._advance(time, self.command(rows[max(0, row - self.delay)][5]))
        np.savetxt(path, np.array(rows), delimiter=",", header=",".join(CHANNELS), comments="", fmt="%.8g")
        return path

    def _excitation(self, time: float, seconds: float, phases: Array) -> float:
        if self.sweep:  # 0.1 to 2.5 Hz
            return 0.15 * math.sin(2.0 * math.pi * (0.1 + 1.2 * time / seconds) * time)
        return 0.06 * float(np.sum(np.sin(2.0 * np.pi * FREQUENCIES * time + phases)))

    def _advance(self, time: float, setpoint: float) -> None:
        for step in range(round(1.0 / self.rate / STEP)):
            now = time + step * STEP
            self._shake = self._shaking.next()
            half = self._moved(0.5 * STEP, self._slopes(now, setpoint, self.state))
            self.state = self._moved(STEP, self._slopes(now + 0.5 * STEP, setpoint, half))

    def _moved(self, by: float, slopes: Sequence[float]) -> list[float]:
        return [value + by * slope for value, slope in zip(self.state, slopes, strict=True)]

    def _slopes(self, time: float, setpoint: float, state: Sequence[float]) -> list[float]:
        roll, roll_rate, precession, precession_rate, late, *own = state
        now = Moment(time, roll, roll_rate, precession, precession_rate, own)
        torque = STIFFNESS * math.sin(roll) + MOMENTUM * precession_rate + self.torque(now) + self._shake
        acting = late if self.further_lag else setpoint
        return [
            roll_rate,
            torque / INERTIA,
            precession_rate,
            (acting - precession_rate) / LAG,
            (setpoint - late) / self.further_lag if self.further_lag else 0.0,
            *self.slopes(now),
        ]


def sign(rate: float) -> float:
    """The sign of the rate, less smoothed than in any model."""
    return math.tanh(rate / 2e-4)


def deadband(setpoint: float) -> float:
    return math.copysign(max(abs(setpoint) - 0.02, 0.0), setpoint)


def yields(now: Moment) -> tuple[float, ...]:
    """Derivative of a hysteresis loop with rounder corners than the catalogue's: Bouc-Wen with an exponent of 1."""
    z = now.own[0]
    return ((now.roll_rate - 0.5 * (abs(now.roll_rate) * z + now.roll_rate * abs(z))) / 2e-3,)


SPRUNG_INERTIA, SPRUNG, DAMPING = 0.1 * INERTIA, (2.0 * math.pi * 5.0) ** 2, 2.0 * 0.03 * 2.0 * math.pi * 5.0


def spring(now: Moment) -> float:
    return SPRUNG * (now.own[0] - now.roll) + DAMPING * (now.own[1] - now.roll_rate)


EFFECTS: dict[str, dict[str, Any]] = {
    "static_torque": {"torque": lambda now: 40.0},
    "viscous_friction": {"torque": lambda now: -400.0 * now.roll_rate},
    "coulomb_friction": {"torque": lambda now: -25.0 * sign(now.roll_rate)},
    "stribeck_friction": {
        "torque": lambda now: -(12.0 + 28.0 * math.exp(-((now.roll_rate / 0.008) ** 2))) * sign(now.roll_rate)
    },
    "asymmetric_friction": {
        "torque": lambda now: -(35.0 if now.roll_rate > 0.0 else 10.0) * sign(now.roll_rate),
    },
    "quadratic_drag": {"torque": lambda now: -12e3 * now.roll_rate * abs(now.roll_rate)},
    "cubic_stiffness": {"torque": lambda now: -3e6 * now.roll**3},
    "end_stop": {"torque": lambda now: -2e4 * math.copysign(max(abs(now.roll) - 8e-3, 0.0), now.roll)},
    "hysteresis": {"torque": lambda now: -40.0 * now.own[0], "slopes": yields, "own": 1},
    "load_dependent_friction": {
        "torque": lambda now: -0.03 * abs(MOMENTUM * now.precession_rate) * sign(now.roll_rate)
    },
    "periodic_disturbance": {"torque": lambda now: 25.0 * math.sin(2.0 * math.pi * 1.7 * now.time + 0.4)},
    "position_cogging": {"torque": lambda now: 30.0 * math.sin(2.0 * math.pi * now.roll / 4e-3)},
    "torque_step": {"torque": lambda now: 60.0 if now.time > 20.0 else 0.0},
    "torque_drift": {"torque": lambda now: 80.0 * (1.0 - math.exp(-now.time / 15.0))},
    "gimbal_imbalance": {"torque": lambda now: 60.0 * math.sin(now.precession)},
    "gimbal_angle_coupling": {"torque": lambda now: MOMENTUM * now.precession_rate * (math.cos(now.precession) - 1.0)},
    "flexible_mode": {
        "torque": lambda now: SPRUNG_INERTIA * spring(now),
        "slopes": lambda now: (now.own[1], -spring(now)),
        "own": 2,
    },
    "sensor_offset": {"sensed": lambda roll, roll_rate: (roll + 0.01, roll_rate)},
    "sensor_scale": {"sensed": lambda roll, roll_rate: (roll, 1.1 * roll_rate)},
    "sensor_delay": {"late": 6},
    "input_delay": {"delay": 4},
    "input_gain": {"command": lambda setpoint: 0.85 * setpoint},
    "input_deadband": {"command": deadband},
    "input_asymmetry": {"command": lambda setpoint: setpoint + 0.1 * abs(setpoint)},
    "actuator_lag": {"further_lag": 0.05},
}
UNLISTED: dict[str, dict[str, Any]] = {
    "cubic drag": {"torque": lambda now: -4e5 * now.roll_rate**3},
    "drag with the root of the rate": {
        "torque": lambda now: -math.copysign(120.0 * math.sqrt(abs(now.roll_rate)), now.roll_rate)
    },
    "a stiffness that swings": {"torque": lambda now: 2500.0 * math.sin(2.0 * math.pi * 0.9 * now.time) * now.roll},
}
CLEAN = "nothing"


def diagnosis_of(path: Path, vehicle: str = "monocab") -> dict[str, Any]:
    """The document of `upright diagnose --json` for a table."""
    command = [str(Path(sys.executable).with_name("upright")), "diagnose", str(path), "--vehicle", vehicle, "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    try:
        return dict(json.loads(done.stdout))
    except ValueError:
        return {"verdict": "error", "findings": [], "reason": done.stderr[-300:]}


def right(hidden: str, found: dict[str, Any]) -> bool:
    """Whether the hidden effect is named first, alone or tied with one. Outside the catalogue `unknown` is right, with
    nothing hidden `adequate`."""
    if hidden == CLEAN:
        return bool(found["verdict"] == "adequate")
    if hidden in UNLISTED:
        return bool(found["verdict"] == "unknown")
    first = found["findings"][0] if found["findings"] else {"effect": "", "tied_with": []}
    return hidden in (first["effect"], *first["tied_with"]) and len(first["tied_with"]) <= 1


def random_parts(found: dict[str, Any]) -> Iterable[str]:
    """The disturbance and the sensor errors that a diagnosis reports, a line each, SI units."""
    for kind in ("disturbance", "sensor_errors"):
        for at, numbers in found.get(kind, {}).items():
            texts = {key: f"{value:.4g}" if isinstance(value, float) else value for key, value in numbers.items()}
            yield f"{kind} of {at}: {', '.join(f'{key} {value}' for key, value in texts.items())}"


def verdicts(names: Sequence[str], answers: Iterable[dict[str, Any]], groups: dict[str, dict[str, Any]]) -> None:
    """Print each answer, and how many of each of `groups` are right, with their 95 % interval (Wilson)."""
    results: list[tuple[str, bool]] = []
    for name, found in zip(names, answers, strict=True):
        results.append((name, right(name, found)))
        text = "; ".join(" = ".join((each["effect"], *each["tied_with"])) for each in found["findings"])
        print(f"{'right' if results[-1][1] else 'WRONG':6}{name:32}{found['verdict']:16}{text}", flush=True)
        for each in random_parts(found):
            print(f"{'':6}{each}", flush=True)
    for title, group in groups.items():
        given = [correct for name, correct in results if name in group]
        if given:
            interval = binomtest(sum(given), len(given)).proportion_ci(0.95, method="wilson")
            share = f"{100 * interval.low:.0f} to {100 * interval.high:.0f} %"
            print(f"{title}: right in {sum(given)} of {len(given)} ({share})")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--noise", type=float, default=5.0, help="in multiples of 1e-3 deg of roll and 0.017 deg/s")
    parser.add_argument("--rate", type=int, default=200, help="samples per second")
    parser.add_argument("--sweep", action="store_true", help="a sine sweep; default: a sum of eight sines")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--sensor", choices=SENSORS, default="white", help="sensor error beside white noise")
    parser.add_argument("--disturbance", default="0,1", help="random torque: N m RMS, and its correlation time in s")
    parser.add_argument("--effect", action="append", help="may be given several times; default: all")
    parser.add_argument("--processes", type=int, default=2)
    arguments = parser.parse_args()
    everything = {CLEAN: {}, **EFFECTS, **UNLISTED}
    names = arguments.effect or list(everything)
    rms, correlation_time = map(float, arguments.disturbance.split(","))
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(arguments.processes) as pool:

        def tried(number: int) -> dict[str, Any]:
            vehicle = OthersVehicle(
                rate=arguments.rate,
                noise=arguments.noise,
                sweep=arguments.sweep,
                seed=arguments.seed + number,
                sensors=SENSORS[arguments.sensor],
                disturbance=(rms, correlation_time),
                **everything[names[number]],
            )
            return diagnosis_of(vehicle.write(Path(folder) / f"{number}.csv"))

        groups: dict[str, dict[str, Any]] = {"in the catalogue": EFFECTS, "outside it": UNLISTED, "clean": {CLEAN: {}}}
        verdicts(names, pool.map(tried, range(len(names))), groups)


if __name__ == "__main__":
    main()
