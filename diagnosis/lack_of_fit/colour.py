"""Which random signal may have coloured the innovations: a force or a sensor's error, and around which frequency?

A random signal of power density phi(f) at a joint or an output adds phi h h* to the white innovations, where h (ny,) is
the response of the innovations to a unit signal there. With the whitened periodogram z(f), a = |h|^2 and b = |h* z|^2,
the log-likelihood rises by

    Delta ln L = sum over f of  phi b / (1 + phi a) - ln(1 + phi a)    (Whittle)

and b / a has an exponential distribution of mean 1 if there is no such signal. Blocks of 1, 2, 4, ... spectral lines of
b / a are tested, which also locates the frequencies. The most likely parameters of each signal follow from a and b
alone, without a fit.
Source: Whittle, Arkiv foer Matematik 2 (1953) 423-434.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from upright.diagnosis.lack_of_fit.floor import sensor_noise
from upright.diagnosis.lack_of_fit.reach import reach
from upright.diagnosis.lack_of_fit.where_it_fails import LEVEL
from upright.diagnosis.score.whitened import PEAKS, SLOWEST, whitening
from upright.estimators.data.time_scale import time_scale
from upright.estimators.fit.innovations import NoiseModel
from upright.estimators.fit.maximum_likelihood import Fit
from upright.estimators.tails import chi2_sf
from upright.models.random.disturbance import at_joints, narrow_at_joints
from upright.models.random.part import LEAST_ROWS, LEAST_TIMES, PERIODS
from upright.models.random.sensor_error import at_outputs

Array = NDArray[np.float64]

SIZES = np.geomspace(0.03, 30.0, 7)
"""Factors of the RMS that the spectrum suggests, from which the search for the most likely one starts."""


@dataclass(frozen=True, slots=True)
class Signal:
    """A random force at the joint, or error of the output, called `at`: around `frequency` (Hz), or of first order if
    that is None. `rms` (in the unit in which the model states its noise there) and correlation `time` (s) are estimated
    from the spectrum; `gain` is the rise of the log-likelihood that they predict."""

    at: str
    of_sensor: bool
    frequency: float | None
    rms: float
    time: float
    gain: float

    @property
    def count(self) -> int:
        """Number of its parameters."""
        return 2 if self.frequency is None else 3


@dataclass(frozen=True, slots=True)
class _Place:
    """The joint or output called `at`, sampled every `spacing` s: a and b (m,) as above at `turn` (m,), rad per sample.
    A correlation time is searched for between `shortest` and `longest`, s."""

    at: str
    of_sensor: bool
    spacing: float
    turn: Array
    a: Array
    b: Array
    shortest: float
    longest: float


def same(one: Signal, other: Signal) -> bool:
    """Whether two signals are one: at the same place, and closer in frequency than the sum of their half widths (at
    half power the half width is 1 / (2 pi time))."""
    if (one.at, one.of_sensor) != (other.at, other.of_sensor) or one.frequency is None or other.frequency is None:
        return False
    width = (1.0 / one.time + 1.0 / other.time) / (2.0 * math.pi)
    return abs(one.frequency - other.frequency) < width


def signals(fitted: Fit) -> list[Signal]:
    """The most likely signals, the one with most evidence first; none if all blocks are consistent with white
    innovations. At each place: one of first order (sensors only), and those around the frequencies of significant
    blocks."""
    places = list(_places(fitted))
    blocks = [(*block, place) for place in places for block in _blocks(place.b / place.a)]
    level = LEVEL / max(1, len(blocks))
    found: list[Signal] = []
    for place in places:
        significant = sorted((chance, low, high) for chance, low, high, of in blocks if of is place and chance < level)
        about = [0.5 * (place.turn[low] + place.turn[high]) for low, high in _apart(significant)]
        if significant and place.of_sensor:
            found += _likeliest(place, None)
        for each in about[:PEAKS]:
            found += _likeliest(place, float(each))
    rows = fitted.problem.rows
    return sorted(found, key=lambda each: 0.5 * each.count * math.log(rows) - each.gain)


def _places(fitted: Fit) -> Iterator[_Place]:
    task, noise = fitted.problem, NoiseModel.of(fitted.problem)
    model, spacing, outputs = task.model, noise.spacing, len(task.model.outputs)
    longest = int(np.argmax([len(each) for each in task.segments]))
    whitener, rows = whitening(fitted), np.nan_to_num(fitted.innovations()[longest])
    lines = np.fft.rfft(rows @ whitener.T, axis=0)[1:-1] / math.sqrt(len(rows))
    turn = 2.0 * math.pi * np.arange(1, len(lines) + 1) / len(rows)
    kept = turn >= 2.0 * math.pi * spacing * SLOWEST / time_scale(model, task.segments)
    logarithms = fitted.minimum.common[len(task.free) :]
    transition, output = noise.covariances(fitted.values, logarithms)[:2]
    ahead = transition @ fitted.gain
    closed = transition - ahead @ output
    resolvent = np.linalg.inv(np.exp(1j * turn)[:, None, None] * np.eye(len(closed)) - closed)
    through = whitener @ output @ resolvent
    most = float(task.segments[longest].duration) / LEAST_TIMES

    def place(at: str, of_sensor: bool, response: NDArray[Any], fastest: float) -> _Place:
        chosen = kept & (turn <= 2.0 * math.pi * spacing * fastest)
        size = np.sum(np.abs(response) ** 2, axis=1)[chosen]
        seen = np.abs(np.sum(np.conj(response) * lines, axis=1))[chosen] ** 2
        return _Place(at, of_sensor, spacing, turn[chosen], size, seen, LEAST_ROWS * spacing, most)

    fastest = float(np.max(reach(task, fitted.values, sensor_noise(task)[0])))
    narrow = {joint.name for joint, _ in narrow_at_joints(model)}
    for joint, number in at_joints(model):
        if joint.name not in narrow:
            # Within a sample it acts as the disturbance that is already there does.
            pushed = transition[:, number].copy()
            pushed[number] = 0.0
            yield place(joint.name, False, through @ pushed, fastest)
    wrong = {each.name for each, _ in at_outputs(model)}
    for number, each in enumerate(model.outputs):
        # A stated noise is stated too large, so that no power above it is left. A counted output errs by its counting.
        if each.name not in wrong and not (each.noise_known or each.counted):
            direct = np.eye(outputs)[number]
            entered = spacing * noise.integrated[:, number] - ahead @ direct
            yield place(each.name, True, whitener @ direct + through @ entered, 0.5 / spacing)


def _blocks(powers: Array) -> Iterator[tuple[float, int, int]]:
    """Probability of so much power by chance, first and last line of each block; `powers` (n,) of mean 1."""
    lines = 1
    while 2 * lines <= len(powers):
        sums = powers[: len(powers) // lines * lines].reshape(-1, lines).sum(axis=1)
        # Twice the power of a line is chi-squared with two degrees of freedom.
        for place, chance in enumerate(chi2_sf(2.0 * sums, 2 * lines).tolist()):
            yield chance, place * lines, (place + 1) * lines - 1
        lines *= 2


def _apart(blocks: Sequence[tuple[float, int, int]]) -> list[tuple[int, int]]:
    """Those of `blocks`, the most significant first, that share no line with a more significant one."""
    found: list[tuple[int, int]] = []
    for _, low, high in blocks:
        if all(high < other_low or low > other_high for other_low, other_high in found):
            found.append((low, high))
    return found


def _likeliest(place: _Place, turn: float | None) -> list[Signal]:
    """The most likely signal at `place`, around `turn` rad per sample or of first order; none if it explains
    nothing."""
    shortest = place.shortest if turn is None else PERIODS * 2.0 * math.pi * place.spacing / turn
    longest = max(place.longest, 2.0 * shortest)
    # As large as its share of the innovations, were it all in one line or in all.
    size = float(np.sqrt(np.mean(place.b) / np.mean(place.a**2) * np.mean(place.a)))

    def loss(unknowns: Array) -> float:
        size, time = np.exp(unknowns[:2])
        about = None if turn is None else turn * math.exp(unknowns[2])
        if not (shortest <= time <= longest) or (about is not None and not 0.0 < about < math.pi):
            return math.inf
        density = _density(place.turn, size, math.exp(-place.spacing / time), about)
        more = density * place.a
        return -float(np.sum(density * place.b / (1.0 + more) - np.log1p(more)))

    free = 2 if turn is None else 3
    times = (math.sqrt(shortest * longest), min(2.0 * shortest, longest))
    starts = [np.array([math.log(each * size), math.log(time), 0.0][:free]) for each in SIZES for time in times]
    begin = min(starts, key=loss)
    ended = minimize(loss, begin, method="Nelder-Mead", options={"xatol": 1e-2, "fatol": 1e-2})
    if not (np.isfinite(ended.fun) and ended.fun < 0.0):
        return []
    rms, time = np.exp(ended.x[:2]).tolist()
    frequency = None if turn is None else turn * math.exp(ended.x[2]) / (2.0 * math.pi * place.spacing)
    return [Signal(place.at, place.of_sensor, frequency, rms, time, -float(ended.fun))]


def _density(turn: Array, rms: float, fading: float, about: float | None) -> Array:
    """Power density per sample at `turn` (m,) of samples whose autocorrelation decays by the factor `fading` per sample
    and oscillates at `about` rad per sample."""

    def one(centre: float) -> Array:
        return np.asarray((1.0 - fading**2) / (1.0 - 2.0 * fading * np.cos(turn - centre) + fading**2))

    return rms**2 * (one(0.0) if about is None else 0.5 * (one(about) + one(-about)))
