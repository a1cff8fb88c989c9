"""The speed loop of a servo drive: the rate in response to steps of the setpoint and to the load on the axis.

Tuned by the symmetric optimum, with small time constant tau and prefilter, an axis that carries a flywheel has

    rate = [ setpoint - reaction (s + tau s^2) roll_rate ] / (1 + 4 tau s + 8 tau^2 s^2 + 8 tau^3 s^3)

where lag = 4 tau and reaction = 8 tau^2 angular_momentum / inertia of the axis, both s. Loop.FIRST_ORDER is
[ setpoint - reaction s roll_rate ] / (1 + lag s). All responses are exact for setpoints that are held (zero-order hold)
and a roll rate that is linear between samples (first-order hold). Source: Griese et al., section II; Kessler, Das
symmetrische Optimum, Regelungstechnik 6 (1958).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from upright.estimators.data.segments import LONGEST_GAP
from upright.telemetry.recording import Recording

RUN_IN = 1.0
"""s of motion before a sample from which its rate is computed; even at the longest lag, earlier motion has decayed."""
WINDOW = 0.5
"""s of samples that are computed at once: exp((RUN_IN + WINDOW) * pace / SHORTEST) does not overflow."""
SHORTEST, LONGEST = 0.005, 0.2
"""s, range of lags for which RUN_IN and WINDOW are valid."""
AFTER_A_STEP = 0.25
"""s after a change of the setpoint during which samples are used."""

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]


@dataclass(frozen=True, slots=True)
class Modes:
    """Step responses 1 + Re sum_m weight_m exp(-speed_m x) at x = pace * t / lag, to setpoint and acceleration."""

    pace: float
    speed: Complex
    setpoint: Complex
    load: Complex


class Loop(Enum):
    """How the speed loop is tuned."""

    SYMMETRIC_OPTIMUM = "symmetric_optimum"
    FIRST_ORDER = "first_order"


def _complex(*numbers: complex) -> Complex:
    return np.array(numbers, dtype=np.complex128)


_PAIR = 0.5 - 0.5j * 3.0**0.5
_SWING = 2.0j / 3.0**0.5
MODES = {
    Loop.SYMMETRIC_OPTIMUM: Modes(
        pace=2.0,
        speed=_complex(1.0, _PAIR),
        setpoint=_complex(-1.0, _SWING),
        load=_complex(-0.5, _SWING * (1.0 - 0.5 * _PAIR)),
    ),
    Loop.FIRST_ORDER: Modes(pace=1.0, speed=_complex(1.0), setpoint=_complex(-1.0), load=_complex(-1.0)),
}


@dataclass(frozen=True, slots=True)
class Window:
    """Samples to be predicted: the rate (n,) at `time` (n,), from steps of the setpoint and of the roll acceleration.

    `begins` is the setpoint before all of its steps. Times are s from the beginning of the run-in. `number` (n,) is the
    index of each sample, counted over all recordings.
    """

    number: NDArray[np.intp]
    time: Array
    rate: Array
    begins: float
    setpoint_time: Array
    setpoint_jump: Array
    load_time: Array
    load_jump: Array


def windows_of(recording: Recording, channels: Sequence[str], moves: float, first: int = 0) -> list[Window]:
    """The samples that follow a change of the setpoint by more than `moves`, after a RUN_IN without a gap. Samples that
    are late are no gap: a setpoint acts from when it was sent.

    `channels`: setpoint, rate, age of the rate (s) and, if the axis has a load, the roll rate. `first` is the index of
    the recording's first sample. A setpoint was sent `setpoint_age` before its sample or, without that channel, at it.
    """
    time, columns = recording.time, [recording[name] for name in channels]
    sent = time - recording["setpoint_age"] if "setpoint_age" in recording.values else time
    known: NDArray[np.bool_] = np.all(np.isfinite(np.column_stack([*columns, sent])), axis=1)
    period = float(np.median(np.diff(time))) if len(time) > 1 else 1.0
    broken = np.flatnonzero((np.diff(time) > LONGEST_GAP * period) | ~known[1:]) + 1
    begins = np.zeros(len(time), dtype=np.int64)
    begins[broken] = broken
    begins = np.maximum.accumulate(begins)
    setpoint = columns[0]
    largest, smallest = setpoint, setpoint
    for back in range(1, min(max(1, round(AFTER_A_STEP / period)), len(time) - 1) + 1):
        earlier = np.concatenate((setpoint[:back], setpoint[:-back]))
        largest, smallest = np.fmax(largest, earlier), np.fmin(smallest, earlier)
    chosen = known & (largest - smallest > moves) & (time - time[begins] > RUN_IN + 2.0 * period)
    places = np.flatnonzero(chosen)
    windows = []
    for run in np.split(places, np.flatnonzero(np.diff(places) > 1) + 1):
        for part in np.array_split(run, max(1, int(np.ceil(len(run) * period / WINDOW)))):
            if len(part):
                past = int(np.searchsorted(time, time[part[0]] - RUN_IN))
                windows.append(_window(slice(past, part[-1] + 1), part, time, sent, columns, first))
    return windows


def _window(
    past: slice, rows: NDArray[np.intp], time: Array, sent: Array, columns: Sequence[Array], first: int
) -> Window:
    setpoint, rate, age = columns[:3]
    instants = time[past] - time[past.start]
    acceleration = np.zeros(len(instants) - 1)
    if len(columns) > 3:
        acceleration = np.diff(columns[3][past]) / np.diff(instants)
    return Window(
        number=rows + first,
        time=time[rows] - age[rows] - time[past.start],
        rate=rate[rows],
        begins=float(setpoint[past.start]),
        setpoint_time=sent[past][1:] - time[past.start],
        setpoint_jump=np.diff(setpoint[past]),
        load_time=instants[:-1],
        load_jump=np.diff(acceleration, prepend=0.0),
    )


def predict(windows: Sequence[Window], modes: Modes, values: Array) -> tuple[Array, Array]:
    """Predicted minus measured rate (n,), and its derivatives (n, p) with respect to `values` (p,): lag, offset and, if
    p = 3, reaction.

    The offset is the delay from the sample of a setpoint until it begins to act. All are in s.
    """
    lag, offset = values[0], values[1]
    reaction = values[2] if len(values) > 2 else 0.0
    speed = modes.pace / lag * modes.speed
    errors, slopes = [], []
    for window in windows:
        rate, by_speed, by_delay = respond(
            window.time - offset, window.setpoint_time, window.setpoint_jump, speed, modes.setpoint
        )
        load, load_by_speed, _ = respond(window.time, window.load_time, window.load_jump, speed, modes.load)
        errors.append(window.begins + rate - reaction * load - window.rate)
        columns = (-(by_speed - reaction * load_by_speed) / lag, by_delay, -load)
        slopes.append(np.column_stack(columns[: len(values)]))
    return np.concatenate(errors), np.concatenate(slopes)


def respond(time: Array, jump_time: Array, jump: Array, speed: Complex, weight: Complex) -> tuple[Array, Array, Array]:
    """Response (n,) at `time` to steps, with step response 1 + Re sum weight exp(-speed t), and two derivatives.

    The derivatives are with respect to the logarithm of a common factor of all speeds, and to a common delay of the
    steps. Exact, in O(n): the exponential of a time difference is a product, so that the sum over earlier steps is a
    cumulative sum.
    """
    place = np.searchsorted(jump_time, time, side="right")
    total = np.concatenate(([0.0], np.cumsum(jump)))[place]
    by_speed, by_delay = np.zeros(len(time)), np.zeros(len(time))
    for mode, share in zip(speed, weight, strict=True):
        grown = jump * np.exp(mode * jump_time)
        decay = np.exp(-mode * time)
        zero = decay * np.concatenate(([0.0], np.cumsum(grown)))[place]
        one = time * zero - decay * np.concatenate(([0.0], np.cumsum(grown * jump_time)))[place]
        total = total + (share * zero).real
        by_speed -= (share * mode * one).real
        by_delay += (share * mode * zero).real
    return total, by_speed, by_delay
