"""Excitations: known test signals added to the controller's reference angle or to its output.

`Excitation.value(t)` is pure: the value at `t` seconds after the start, in rad on a reference angle, and on the
controller's output in the unit of that (rad/s of precession rate, V). Each one starts and ends at zero, smoothly, and
stays within +-`peak`.

- sweep: logarithmic chirp, sin(2 pi f0 T / ln(f1/f0) * ((f1/f0)^(t/T) - 1)): equal time for every octave, since the
  gravity stiffness shows at the low end and the inertia at the high one.
- sine: of one frequency.
- square: +1 and -1, half a period each, with short rounded edges.
- doublet: +1, then -1, `width` seconds each; again every ten widths, mirrored each time so that nothing drifts.
- sine_stream: one frequency after the other, each for whole periods and for about the same time.
- multisine: `lines` cosines of one amplitude at whole multiples of 1/duration, with Schroeder's phases
  -pi k (k-1) / lines, which keep the peak low (Schroeder, IEEE Trans. Inf. Theory 16, 1970; Pintelon and Schoukens,
  System Identification, 2nd ed., section 5.3); or those of a `spectrum`.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass
from itertools import accumulate
from math import cos, expm1, log, pi, sin, sqrt

import numpy as np
from numpy.typing import NDArray

from upright.telemetry.errors import UprightError
from upright.vehicles.sections import ExperimentSection, is_reference

LONGEST_RAMP = 1.0
"""s over which a signal is faded in and out, or a tenth of its duration if that is shorter."""
SAMPLES_PER_PERIOD = 8.0
"""Minimum number of control cycles per period of the highest frequency: with fewer the signal is distorted."""

Array = NDArray[np.float64]
Waveform = Callable[[float], float]
"""A signal within -1..1 over time in seconds."""


class ExcitationError(UprightError):
    """An experiment section that describes an impossible signal. `key` is the key at fault."""

    def __init__(self, key: str, message: str, *, remedy: str) -> None:
        super().__init__(f"{key}: {message}.", remedy=remedy)
        self.key = key


@dataclass(frozen=True, slots=True)
class Excitation:
    """A signal of `duration` seconds and at most +-`peak` at an injection point, faded in and out over `ramp` seconds.

    The step is one that happens before the vehicle is upright (the kind's `Handling` generates it, `peak` being its
    amplitude), so its value here is zero.
    """

    at: str
    peak: float
    duration: float
    ramp: float
    waveform: Waveform

    @property
    def on_reference(self) -> bool:
        """Whether it is added to the controller's reference, and not to its output."""
        return is_reference(self.at)

    def value(self, t: float) -> float:
        """The value at `t` seconds; zero before the start and after the end."""
        left = self.duration - t
        if t <= 0.0 or left <= 0.0:
            return 0.0
        value = self.peak * self.waveform(t)
        edge = t if t < left else left
        if edge < self.ramp:
            value *= 0.5 - 0.5 * cos(pi * edge / self.ramp)
        return value

    @property
    def crest_factor(self) -> float:
        """Peak over root mean square of the waveform, fades left out; infinite for a signal that is zero."""
        values = np.array([self.waveform(t) for t in np.linspace(0.0, self.duration, 20_001)])
        rms = sqrt(float(np.mean(values**2)))
        return float(np.max(np.abs(values))) / rms if rms else float("inf")


@dataclass(frozen=True, slots=True)
class Nothing:
    """No signal."""

    def __call__(self, t: float) -> float:
        return 0.0


@dataclass(frozen=True, slots=True)
class Sweep:
    """Logarithmic chirp from `start` to `stop` Hz in `duration` s."""

    start: float
    stop: float
    duration: float

    def __call__(self, t: float) -> float:
        rate = log(self.stop / self.start) / self.duration
        return sin(2.0 * pi * self.start / rate * expm1(rate * t))


@dataclass(frozen=True, slots=True)
class Sine:
    """Sine of `frequency` Hz."""

    frequency: float

    def __call__(self, t: float) -> float:
        return sin(2.0 * pi * self.frequency * t)


@dataclass(frozen=True, slots=True)
class Square:
    """Square wave of `frequency` Hz; an edge takes a twentieth of a period."""

    frequency: float

    def __call__(self, t: float) -> float:
        phase = (t * self.frequency) % 1.0
        sign = 1.0
        if phase >= 0.5:
            phase -= 0.5
            sign = -1.0
        edge = phase if phase < 0.25 else 0.5 - phase
        return sign * (sin(20.0 * pi * edge) if edge < 0.025 else 1.0)


@dataclass(frozen=True, slots=True)
class Doublet:
    """+1 and -1 for `width` s each, from `width` s on, again every ten widths with the other sign first."""

    width: float

    def __call__(self, t: float) -> float:
        turn, place = divmod(t / self.width, 10.0)
        if not 1.0 <= place < 3.0:
            return 0.0
        within = (place - 1.0) % 1.0
        edge = within if within < 0.5 else 1.0 - within
        value = sin(5.0 * pi * edge) if edge < 0.1 else 1.0
        return value if (place < 2.0) == (turn % 2.0 == 0.0) else -value


@dataclass(frozen=True, slots=True)
class SineStream:
    """Sines one after the other: `frequencies` Hz, each until the time of the same place in `ends` s."""

    frequencies: tuple[float, ...]
    ends: tuple[float, ...]

    def __call__(self, t: float) -> float:
        place = min(bisect_right(self.ends, t), len(self.ends) - 1)
        start = self.ends[place - 1] if place else 0.0
        return sin(2.0 * pi * self.frequencies[place] * (t - start))


@dataclass(frozen=True, slots=True)
class Multisine:
    """Cosines, added; each line is (angular frequency in rad/s, phase, amplitude), `scale` makes the peak 1."""

    lines: tuple[tuple[float, float, float], ...]
    scale: float

    def __call__(self, t: float) -> float:
        value = 0.0
        for omega, phase, amplitude in self.lines:
            value += amplitude * cos(omega * t + phase)
        return value * self.scale


def make_excitation(section: ExperimentSection, rate: float) -> Excitation:
    """The excitation of an experiment, for a control loop of `rate` Hz.

    Raises:
        ExcitationError: the frequencies are out of order, too high for `rate`, or too low or too many for the
            duration, or the duration is too short for the signal; the error names the key.
    """
    duration = section.duration
    waveform: Waveform = Nothing()
    fade = True
    if section.spectrum is not None:
        table = np.array(section.spectrum)
        _require_frequencies(tuple(table[:, 0].tolist()), "spectrum", duration, rate)
        waveform = _added(2.0 * pi * table[:, 0], np.radians(table[:, 2]), table[:, 1], duration)
    elif section.excitation in ("sweep", "multisine"):
        assert section.start_frequency is not None
        assert section.stop_frequency is not None
        start, stop = section.start_frequency, section.stop_frequency
        if start >= stop:
            raise ExcitationError(
                "stop_frequency", f"{stop:g} Hz is not above start_frequency {start:g} Hz", remedy="swap them."
            )
        _require_frequencies((start, stop), "stop_frequency", duration, rate)
        if section.excitation == "sweep":
            waveform = Sweep(start, stop, duration)
        else:
            assert section.lines is not None
            waveform = _multisine(start, stop, section.lines, duration)
    elif section.excitation in ("sine", "square"):
        assert section.frequency is not None
        _require_frequencies((section.frequency,), "frequency", duration, rate)
        waveform = Sine(section.frequency) if section.excitation == "sine" else Square(section.frequency)
    elif section.excitation == "doublet":
        assert section.width is not None
        if duration < 4.0 * section.width:
            raise ExcitationError(
                "duration",
                f"{duration:g} s is too short for a doublet of twice {section.width:g} s and a pause around it",
                remedy=f"give it {4.0 * section.width:g} s or more.",
            )
        _require_frequencies((0.5 / section.width,), "width", duration, rate)
        waveform, fade = Doublet(section.width), False
    elif section.excitation == "sine_stream":
        frequencies = tuple(section.frequencies or ())
        if not frequencies:
            raise ExcitationError("frequencies", "is empty", remedy="name at least one frequency in Hz.")
        share = duration / len(frequencies)
        _require_frequencies(frequencies, "frequencies", share, rate)
        waveform = SineStream(frequencies, tuple(accumulate(int(share * f + 1e-9) / f for f in frequencies)))
        duration = waveform.ends[-1]
    ramp = min(LONGEST_RAMP, duration / 10.0) if fade else 0.0
    return Excitation(section.at, section.amplitude_si, duration, ramp, waveform)


def _require_frequencies(frequencies: tuple[float, ...], key: str, duration: float, rate: float) -> None:
    highest, lowest = max(frequencies), min(frequencies)
    if highest * SAMPLES_PER_PERIOD > rate:
        raise ExcitationError(
            key,
            f"{highest:g} Hz is too fast for a control loop of {rate:g} Hz",
            remedy=f"stay below {rate / SAMPLES_PER_PERIOD:g} Hz, or raise [control] rate.",
        )
    if lowest * duration < 1.0 - 1e-9:
        raise ExcitationError(
            "duration",
            f"not one period of {lowest:g} Hz fits into {duration:g} s",
            remedy=f"give it {1.0 / lowest:g} s or more.",
        )


def _multisine(start: float, stop: float, count: int, duration: float) -> Multisine:
    harmonics = np.unique(np.round(np.linspace(start, stop, count) * duration))
    if len(harmonics) < count:
        raise ExcitationError(
            "lines",
            f"{count} lines do not fit between {start:g} and {stop:g} Hz at multiples of 1/{duration:g} Hz",
            remedy=f"use {len(harmonics)} lines, or a longer duration.",
        )
    omega = 2.0 * pi * harmonics / duration
    k = np.arange(1, count + 1)
    return _added(omega, -pi * k * (k - 1) / count, np.ones(count), duration)


def _added(omega: Array, phases: Array, amplitudes: Array, duration: float) -> Multisine:
    """The multisine of lines at `omega` rad/s, its peak 1."""
    times = np.arange(0.0, duration, 2.0 * pi / (64.0 * float(np.max(omega))))
    highest = float(np.max(np.abs(np.cos(np.outer(times, omega) + phases) @ amplitudes)))
    # Between samples h apart a band-limited signal rises by at most 1 / cos(omega h / 2).
    peak = highest / cos(pi / 64.0)
    return Multisine(tuple(zip(omega.tolist(), phases.tolist(), amplitudes.tolist(), strict=True)), 1.0 / peak)
