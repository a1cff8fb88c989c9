"""Frequency response from the known force at a joint to its coordinate, by Welch's method, with standard deviations.

    direct:  G = S_uy / S_uu          joint:  G = S_ry / S_ru

u is the known force (of the gyroscopes and the trim mass, of a motor), y the coordinate, r the injected excitation, and
S_xy averages conj(X) Y over Hann windows. The direct form is the paper's (8). It is biased in closed loop: by the
controller's response to disturbances, u and y are related by -1 / controller, whatever the vehicle is. The weaker the
excitation, the larger is this bias. The joint form has no such bias, but needs r. Standard deviations are those of
Bendat and Piersol,

    std |G| / |G| = std arg G = sqrt((1 - coherence) / (2 averages coherence)),

in the joint form with the part of y - G u that r does not explain. Leakage, which a sweep or a motion at the ends of
the record causes and coherence does not show, is added. It falls as 1 / window, so it is as large as the change when
windows of half the length are used. A constant that is not removed (`detrend`) is additional.

Sources: Welch 1967; Bendat and Piersol, Random Data, 4th ed., sections 9.1 and 9.2; Ljung, System Identification,
section 13.5 (closed loop); Griese et al., equation (8).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
import sympy
from numpy.typing import NDArray

from upright.estimators.contract import EstimationError, Status
from upright.estimators.data.segments import DataError, segments
from upright.estimators.methods.balance import Balance, Pieces, channel_signals, evaluator, split
from upright.models.model import Model
from upright.models.parts import Hold
from upright.models.segment import Segment
from upright.telemetry.recording import Recording

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

LONGEST_WINDOW = 20.0
"""s."""
WINDOWS = 4.0
"""Default length of the record in windows, without overlap."""
STEPS = 4
"""Steps per window length from one window to the next: with half overlap, edge effects of a sweep do not cancel."""
DETRENDED = 2
"""Lowest bins that are left out after detrending, which removes power there."""
SHORTEST = 50
"""Fewest samples of a window."""
HIGHEST = 0.1
"""Highest frequency, relative to the sampling rate: above it, the signal between two samples matters."""
OF_BINS = (1.0, (2.0 / 3.0) ** 2, (1.0 / 6.0) ** 2)
"""Correlation of the errors in the same, the next, and the next but one bin of a Hann window."""
DIRECT = "direct: biased in closed loop by the controller's response to disturbances"
JOINT = "joint input-output through the excitation: not biased by the closed loop"


class Detrend(StrEnum):
    """What is removed from each window before it is transformed."""

    NONE = "none"
    MEAN = "mean"
    LINEAR = "linear"


@dataclass(frozen=True, slots=True)
class FrequencyResponse:
    """A measured response at m frequencies, all (m,): `frequency` Hz, `response` output unit / input unit, complex.

    `coherence`: the share of the output's power that is coherent with the input (joint: the smaller of the shares of
    output and input that are coherent with the excitation). `magnitude_std` in the response's unit and `phase_std` rad,
    infinite where nothing is known. `power`: mean square of the input at each frequency. `averages`: number of
    independent windows. `form` says which estimate it is and what that implies.
    """

    frequency: Array
    response: ComplexArray
    coherence: Array
    magnitude_std: Array
    phase_std: Array
    power: Array
    averages: float
    form: str


@dataclass(frozen=True, slots=True)
class CrossSpectra:
    """`matrix` (m, k, k): mean of conj(x_a) x_b at `frequency` Hz (m,), over `averages` independent windows.

    Its sum over the frequencies is the mean product of the signals, with a constant counted twice.
    """

    frequency: Array
    matrix: ComplexArray
    averages: float
    samples: int
    span: float
    half: CrossSpectra | None = None
    """The spectra from windows of half the length."""


def frequency_response(
    model: Model | str,
    recordings: Sequence[Recording],
    *,
    excitation: str = "",
    support: float | None = None,
    window: float | None = None,
    detrend: Detrend | str = Detrend.NONE,
    joint: str = "",
) -> FrequencyResponse:
    """The response at `joint` (by default the first), in the joint form if a channel `excitation` is named, otherwise
    in the direct form.

    `window` is the length of the windows in s, by default a quarter of the record, at most LONGEST_WINDOW. Raises
    DataError if the data cannot be used, EstimationError if the joint has no known force.
    """
    balance = split(model, joint)
    spectra = force_spectra(balance, recordings, excitation=excitation, support=support, window=window, detrend=detrend)
    return response(spectra, 0, 1, reference=2 if excitation else None)


def known_force(balance: Balance) -> sympy.Expr:
    """The part of the known force that does not depend on the joint's own motion."""
    own = set().union(*(each.free_symbols for each in balance.motion))
    force = balance.known.xreplace({symbol: sympy.Integer(0) for symbol in own})
    if not force.free_symbols:
        remedy = "frequency methods need a measured or commanded input at the joint."
        raise EstimationError(f"joint {balance.joint.name}", "has no known force", remedy=remedy)
    return force


def force_spectra(
    balance: Balance,
    recordings: Sequence[Recording],
    *,
    excitation: str = "",
    support: float | None = None,
    window: float | None = None,
    detrend: Detrend | str = Detrend.NONE,
) -> CrossSpectra:
    """Spectra of the known force, the coordinate, the excitation if it is named, and the change of the force by each
    anchor's standard deviation, in this order. Raises DataError, EstimationError."""
    if detrend not in tuple(Detrend):
        raise EstimationError(f"detrend {detrend}", "is not an option", remedy=f"use one of: {', '.join(Detrend)}.")
    deviations = [balance.model.parameter(name).std for name in balance.anchors]
    changes = [sympy.Integer(0)] * len(balance.anchors)
    own = set().union(*(each.free_symbols for each in balance.motion))
    for anchor, place, expression in balance.anchored:
        if place < 0:
            without = expression.xreplace({symbol: sympy.Integer(0) for symbol in own})
            changes[anchor] -= deviations[anchor] * without
    evaluate = evaluator((known_force(balance), balance.motion[0], *changes))
    tables, span = [], 0.0
    spacing = 0.0
    for recording in recordings:
        for segment in segments(balance.model, [recording], support=support):
            spacing = spacing or float(np.median(np.diff(segment.time)))
            span += segment.duration
            pieces = evaluate(channel_signals(balance, segment))
            time, values = evenly(pieces, spacing)
            if excitation:
                injected = np.interp(time, segment.time, _injection(recording, segment, excitation))
                values = np.concatenate((values[:, :2], injected[:, None], values[:, 2:]), axis=1)
            tables.append(values)
    if not tables:
        raise DataError(Status.TOO_FEW_SAMPLES, "recordings", "none is given", remedy="give at least one.")
    window = window if window is not None else min(LONGEST_WINDOW, span / WINDOWS)
    used = known_force(balance).free_symbols
    inputs = [each for each in balance.model.inputs if {each.name, f"{each.name}_slope"} & {s.name for s in used}]
    held = bool(inputs) and all(each.hold is Hold.ZERO_ORDER for each in inputs)
    length = round(0.5 * window / spacing)
    half, whole = (cross_spectra(tables, spacing, n, Detrend(detrend), held=held) for n in (length, 2 * length))
    return replace(whole, half=half)


def _injection(recording: Recording, segment: Segment, excitation: str) -> Array:
    remedy = "use the direct form, and note its bias."
    if excitation not in recording.values:
        what = f"channel {excitation} is missing, which the joint form needs"
        raise DataError(Status.MISSING_CHANNEL, recording.source, what, remedy=remedy)
    values = recording[excitation][np.searchsorted(recording.time, segment.time)]
    if not np.all(np.isfinite(values)):
        what = f"channel {excitation} is unknown in {int(np.sum(~np.isfinite(values)))} samples"
        raise DataError(Status.MISSING_CHANNEL, recording.source, what, remedy=remedy)
    return values


def evenly(pieces: Pieces, spacing: float) -> tuple[Array, Array]:
    """Terms at equidistant instants, `spacing` s apart: time (n,), values (n, terms). A jump has the mean of its
    sides."""
    values = np.concatenate((pieces.left, pieces.right[-1:]))
    values[1:-1] = 0.5 * (pieces.left[1:] + pieces.right[:-1])
    time = np.arange(pieces.time[0], pieces.time[-1], spacing)
    return time, np.stack([np.interp(time, pieces.time, column) for column in values.T], axis=1)


def cross_spectra(
    tables: Sequence[Array], spacing: float, length: int, detrend: Detrend, *, held: bool = False
) -> CrossSpectra:
    """Welch's average over all windows of `length` samples in the signals `tables`, each (n, k), `spacing` s apart.

    `held`: all signals but the second are held from sample to sample, and given as the mean of both sides of their
    jumps. Raises DataError if fewer than two windows fit in.
    """
    step = max(1, length // STEPS)
    frames = [table[first : first + length] for table in tables for first in range(0, len(table) - length + 1, step)]
    if len(frames) < 2 or length < SHORTEST:
        longest = spacing * max((len(table) for table in tables), default=0)
        what = f"a window of {spacing * length:.3g} s does not fit twice into the longest segment of {longest:.3g} s"
        raise DataError(Status.TOO_FEW_SAMPLES, "recording", what, remedy="record for longer, or shorten the window.")
    hann = 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(length) / length)
    stacked = np.stack(frames)
    if detrend is Detrend.MEAN:
        stacked = stacked - stacked.mean(axis=1, keepdims=True)
    elif detrend is Detrend.LINEAR:
        ramp = np.linspace(-1.0, 1.0, length)[:, None]
        stacked = stacked - stacked.mean(axis=1, keepdims=True)
        stacked = stacked - ramp * np.mean(stacked * ramp, axis=1, keepdims=True) / np.mean(ramp**2)
    samples = sum(map(len, tables))
    frequency = np.fft.rfftfreq(length, spacing).astype(np.float64)
    kept = slice(0 if detrend is Detrend.NONE else DETRENDED, int(np.searchsorted(frequency, HIGHEST / spacing)))
    frequency = frequency[kept]
    transformed = np.fft.rfft(stacked * hann[:, None], axis=1)[:, kept]
    if held:
        sides = np.sinc(frequency * spacing) / np.cos(np.pi * frequency * spacing)
        transformed[:, :, [place for place in range(stacked.shape[2]) if place != 1]] *= sides[:, None]
    matrix = np.einsum("wma,wmb->mab", transformed.conj(), transformed)
    matrix *= 2.0 / (len(frames) * length * np.sum(hann**2))
    shared = [
        (1.0 - lag / len(frames)) * (np.sum(hann[lag * step :] * hann[: -lag * step]) / np.sum(hann**2)) ** 2
        for lag in range(1, min(STEPS, len(frames)))
    ]
    averages = len(frames) / (1.0 + 2.0 * sum(shared))
    return CrossSpectra(frequency, matrix, averages, samples, spacing * samples)


def response(
    spectra: CrossSpectra, force: int, coordinate: int, *, reference: int | None = None, change: int | None = None
) -> FrequencyResponse:
    """The response between two signals of `spectra`, by the joint form through `reference` if it is given.

    `change`: the index of a signal that is added to the force first.
    """
    through = force if reference is None else reference
    matrix, found = _ratio(spectra, force, coordinate, through, change)
    with_force, with_coordinate = matrix[:, through, force], matrix[:, through, coordinate]
    power = {place: np.maximum(matrix[:, place, place].real, 1e-300) for place in (force, coordinate, through)}
    shares = [np.abs(with_coordinate) ** 2 / (power[through] * power[coordinate])]
    shares.append(np.abs(with_force) ** 2 / (power[through] * power[force]))
    coherence = np.clip(np.minimum(*shares), 0.0, 1.0)
    # The part of y - G u that is incoherent with the reference, over the part of G u that is coherent with it.
    left = (
        matrix[:, coordinate, coordinate].real
        - 2.0 * (found * matrix[:, coordinate, force]).real
        + np.abs(found) ** 2 * matrix[:, force, force].real
    )
    explained = np.maximum(np.abs(found * with_force) ** 2 / power[through], 1e-300)
    independent = max(spectra.averages - 1.0, 1.0)
    relative = np.sqrt(np.maximum(left, 0.0) / (2.0 * independent * explained))
    if spectra.half is not None:
        _, coarse = _ratio(spectra.half, force, coordinate, through, change)
        # Every second frequency is also one of the half windows; those between are interpolated from their neighbours.
        # A constant, which is in the lowest bins of either, is not leakage.
        first = DETRENDED if spectra.half.frequency[0] == 0.0 else 0
        grid, coarse = spectra.half.frequency[first:], coarse[first:]
        same = np.searchsorted(spectra.frequency, grid - 0.1 * spectra.frequency[-1] / len(spectra.frequency))
        changes = np.interp(spectra.frequency, grid, np.abs(coarse - found[same]))
        relative = np.hypot(relative, changes / np.maximum(np.sqrt(2.0) * np.abs(found), 1e-300))
    known = (np.abs(found) > 0.0) & (relative < 1e3)
    return FrequencyResponse(
        frequency=spectra.frequency,
        response=found,
        coherence=coherence,
        magnitude_std=np.where(known, np.minimum(relative, 1e3) * np.abs(found), np.inf),
        phase_std=np.where(known, relative, np.inf),
        power=matrix[:, force, force].real,
        averages=spectra.averages,
        form=DIRECT if reference is None else JOINT,
    )


def _ratio(
    spectra: CrossSpectra, force: int, coordinate: int, through: int, change: int | None
) -> tuple[ComplexArray, ComplexArray]:
    """The spectra with `change` added to the force, (m, k, k), and the response, (m,), 0 where it is undefined."""
    matrix = spectra.matrix
    if change is not None:
        mix = np.eye(matrix.shape[1])
        mix[change, force] = 1.0
        matrix = mix.T @ matrix @ mix
    with_force = matrix[:, through, force]
    there = np.abs(with_force) > 0.0
    return matrix, np.where(there, matrix[:, through, coordinate] / np.where(there, with_force, 1.0), 0.0)
