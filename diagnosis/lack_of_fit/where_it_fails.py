"""Where a model fails: by time, by frequency, by state and by equation, each with its significance.

* time: energy of the innovations over the floor in windows of 5 time scales (estimators.data.time_scale; 2 s of the
  MONOCAB), sample by sample and averaged over a quarter of a time scale, since missing effects are slow and the noise
  is not.
* frequency: the same by octaves, from the periodogram, up to where a force shows (diagnosis.lack_of_fit.reach).
* state: the mean missing force by bins of each coordinate, beyond what other parameter values would explain, with a
  false discovery rate over all bins (diagnosis.lack_of_fit.force_bins).
* equation: mean and energy of the missing force at each joint, with the parameters as they are
  (diagnosis.lack_of_fit.missing_force).

The reference is white innovations with the floor's covariance. The tests account for how well the record determines
that covariance: energies have an F distribution. A model is adequate if no view finds anything; each view may reject a
correct model with a quarter of LEVEL. Source: Benjamini and Hochberg, Journal of the Royal Statistical Society B 57
(1995).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from upright.diagnosis.lack_of_fit.floor import Innovations
from upright.diagnosis.lack_of_fit.force_bins import Binned, Term, binned_forces, mean_forces
from upright.diagnosis.lack_of_fit.force_probe import probe
from upright.diagnosis.lack_of_fit.missing_force import MissingForce, missing_force
from upright.estimators.data.time_scale import time_scale
from upright.estimators.numbers import with_error
from upright.estimators.tails import adjusted, chi2_sf, f_sf
from upright.models.compiler.kernel import Progress

Array = NDArray[np.float64]
Entry = dict[str, Any]

LEVEL = 0.01
"""Probability with which a correct model is called not adequate, over all views."""
VIEWS = ("time", "frequency", "state", "equation")
WINDOW = 5.0
"""Time scales of a window of the view by time."""
AVERAGE = 0.25
"""Time scales over which innovations are averaged, in addition to the test sample by sample."""
LINES = 8
"""Lines of the periodogram that the lowest octave has at least."""


@dataclass(frozen=True, slots=True)
class Energy:
    """Energy over the floor in a part of a record, 1 if there is nothing but noise, and its p-value."""

    recording: str
    channel: str
    low: float
    high: float
    ratio: float
    p_value: float


@dataclass(frozen=True, slots=True)
class Views:
    """The four views of a model on a record; `fails` (by VIEWS) has the parts that noise does not explain."""

    by_time: Sequence[Energy]
    by_frequency: Sequence[Energy]
    binned: Sequence[Binned]
    forces: Sequence[MissingForce]
    means: Sequence[Term | None]
    fails: Mapping[str, Sequence[Entry]]

    @property
    def adequate(self) -> bool:
        return not any(self.fails.values())


def views(found: Innovations, *, progress: Progress | None = None) -> Views:
    """All four views of the innovations that a model leaves. `progress` is called when code has to be compiled."""
    probed = probe(found, progress=progress)
    by_time, by_frequency = energies_by_time(found), energies_by_frequency(found)
    reach = dict(zip(found.problem.kernel.outputs, found.floor.reach.tolist(), strict=True))
    binned, forces, means = binned_forces(found, probed), missing_force(found, probed), mean_forces(found, probed)
    fails = {
        "time": _time_entries(by_time),
        "frequency": _frequency_entries([each for each in by_frequency if each.low < reach[each.channel]]),
        "state": _state_entries(binned),
        "equation": _equation_entries(forces, means),
    }
    return Views(by_time, by_frequency, binned, forces, means, fails)


def _tested(found: Innovations) -> list[tuple[int, str]]:
    """The outputs whose noise the record shows: a noise that is only stated would be tested, not the model."""
    return [(place, found.problem.kernel.outputs[place]) for place in found.floor.informative]


def energies_by_time(found: Innovations) -> list[Energy]:
    """Each window of each channel, s from the first sample: by sample or averaged, whichever is less likely."""
    results = []
    scale = time_scale(found.problem.model, found.problem.segments)
    averaged = max(1, round(AVERAGE * scale / found.floor.spacing))
    for segment, errors in zip(found.problem.segments, found.normalised, strict=True):
        count = max(1, round(segment.duration / (WINDOW * scale)))
        for rows in np.array_split(np.arange(len(segment)), count):
            for place, channel in _tested(found):
                part = errors[rows, place]
                means = part[: len(part) // averaged * averaged].reshape(-1, averaged).sum(axis=1) / np.sqrt(averaged)
                freedom = float(found.floor.freedom[place])
                tried = [_excess(each, freedom) for each in ((part, means) if averaged > 1 else (part,)) if len(each)]
                ratio, p_value = min(tried, key=lambda each: each[1])
                low, high = float(segment.time[rows[0]]), float(segment.time[rows[-1]])
                results.append(Energy(segment.source, channel, low, high, ratio, min(1.0, len(tried) * p_value)))
    return results


def energies_by_frequency(found: Innovations) -> list[Energy]:
    """Each octave of each channel, of all segments together, Hz."""
    spacing, results = found.floor.spacing, []
    longest = max(len(part) for part in found.errors) * spacing
    edges = [0.5 / spacing]
    while 0.5 * edges[-1] * longest > 2 * LINES:
        edges.append(0.5 * edges[-1])
    edges = [0.0, *edges[:0:-1], 0.5 / spacing * (1.0 + 1e-9)]
    for place, channel in _tested(found):
        lines, powers = [], []
        for part in found.normalised:
            lines.append(np.fft.rfftfreq(len(part), spacing)[1:])
            powers.append(np.abs(np.fft.rfft(part[:, place])[1:]) ** 2 / len(part))
        line, power = np.concatenate(lines), np.concatenate(powers)
        for low, high in pairwise(edges):
            inside = (line >= low) & (line < high)
            if inside.any():
                # The power of a line has two degrees of freedom.
                halves = np.repeat(np.sqrt(power[inside]), 2)
                ratio, p_value = _excess(halves, float(found.floor.freedom[place]))
                results.append(Energy("", channel, low, min(high, 0.5 / spacing), ratio, p_value))
    return results


def _excess(normalised: Array, freedom: float) -> tuple[float, float]:
    """Mean square of samples that have unit variance if the model is correct, and the probability of so much."""
    count = len(normalised)
    ratio = float(np.mean(normalised**2))
    if np.isinf(freedom):
        return ratio, float(chi2_sf(count * ratio, count))
    return ratio, float(f_sf(ratio, count, freedom))


def _time_entries(energies: Sequence[Energy]) -> list[Entry]:
    """The windows that fail, worst first."""
    return [
        {
            "recording": each.recording,
            "channel": each.channel,
            "from": each.low,
            "to": each.high,
            "energy_over_floor": each.ratio,
            "p_value": each.p_value,
        }
        for each in _beyond(energies)
    ]


def _frequency_entries(energies: Sequence[Energy]) -> list[Entry]:
    """The octaves that fail, worst first."""
    return [
        {
            "channel": each.channel,
            "from_hz": each.low,
            "to_hz": each.high,
            "power_over_floor": each.ratio,
            "p_value": each.p_value,
        }
        for each in _beyond(energies)
    ]


def _beyond(energies: Sequence[Energy]) -> list[Energy]:
    limit = LEVEL / len(VIEWS) / max(len(energies), 1)
    return sorted((each for each in energies if each.p_value < limit), key=lambda each: -each.ratio)


def _state_entries(binned: Sequence[Binned]) -> list[Entry]:
    """The bins whose mean missing force noise does not explain, the most significant first."""
    determined = [(each, place, term) for each in binned for place, term in enumerate(each.terms) if term is not None]
    if not determined:
        return []
    p_values = adjusted([term.p_value for _, _, term in determined])
    found: list[tuple[Term, Entry]] = []
    for (each, place, term), p_value in zip(determined, p_values, strict=True):
        if p_value < LEVEL / len(VIEWS):
            entry = {
                "joint": each.joint,
                "coordinate": each.coordinate.name,
                "from": float(each.edges[place]),
                "to": float(each.edges[place + 1]),
                "coordinate_unit": each.coordinate.unit,
                "missing_force": term.force,
                "std": term.std,
                "unit": each.unit,
                "p_value": float(p_value),
                "explained_percent": 100.0 * each.explained,
            }
            found.append((term, entry))
    return [entry for _, entry in sorted(found, key=lambda pair: -abs(pair[0].t))]


def _equation_entries(forces: Sequence[MissingForce], means: Sequence[Term | None]) -> list[Entry]:
    """The joints whose missing force has a mean or an energy that noise does not explain, in the model's order."""
    limit = LEVEL / len(VIEWS) / max(2 * len(forces), 1)
    found = []
    for force, mean in zip(forces, means, strict=True):
        p_value = min(force.p_value, 1.0 if mean is None else mean.p_value)
        if p_value < limit:
            found.append({
                "equation": force.joint,
                "mean": None if mean is None else mean.force,
                "mean_std": None if mean is None else mean.std,
                "rms": force.rms,
                "std": force.std,
                "floor": force.floor,
                "unit": force.unit,
                "p_value": p_value,
            })  # fmt: skip
    return found


def summary(fails: Mapping[str, Sequence[Entry]]) -> list[str]:
    """Where the model fails, in words: a sentence for each view that finds something, the worst place first."""
    sentences = []
    for entry in fails["equation"][:2]:
        known = entry["mean"] is not None
        mean = f", with a mean of {with_error(entry['mean'], entry['mean_std'], entry['unit'])}" if known else ""
        size = f"{entry['rms']:.3g} {entry['unit']} RMS (± {entry['std']:.2g} at any instant)"
        sentences.append(f"The equation of {entry['equation']} lacks a force of {size}{mean}.")
    sentences += _by_coordinate(fails["state"])
    if fails["equation"] and not fails["state"]:
        sentences.append("By state, other values of the estimated parameters would explain all that is significant.")
    for entry in fails["frequency"][:1]:
        where = f"{entry['from_hz']:.2g} to {entry['to_hz']:.2g} Hz"
        power = f"{_times(entry['power_over_floor'])} the noise floor"
        sentences.append(f"By frequency: the worst from {where}, {power}.")
    for entry in fails["time"][:1]:
        where = f"{entry['from']:.1f} to {entry['to']:.1f} s, {_times(entry['energy_over_floor'])} the noise floor"
        span = f"{entry['to'] - entry['from']:.2g}"
        sentences.append(f"By time: {len(fails['time'])} windows of {span} s fail, the worst from {where}.")
    return sentences


def _times(ratio: float) -> str:
    """`10200 times`: a ratio with three digits."""
    return f"{with_error(float(f'{ratio:.3g}'))} times"


def _by_coordinate(entries: Sequence[Entry]) -> Iterator[str]:
    """The coordinate that explains most, with its most significant bin, and what the others would explain."""
    shares = {entry["coordinate"]: entry["explained_percent"] for entry in entries}
    ranked = sorted(shares, key=lambda name: -shares[name])
    if ranked:
        entry = next(each for each in entries if each["coordinate"] == ranked[0])
        low, high, unit = shown_range(entry["from"], entry["to"], entry["coordinate_unit"])
        force = with_error(entry["missing_force"], entry["std"], entry["unit"])
        yield (
            f"The missing force depends on {ranked[0]}, which explains {shares[ranked[0]]:.0f} % of the excess energy:"
            f" {force} at {entry['joint']} while {ranked[0]} is between {low} and {high} {unit}."
        )
    if len(ranked) > 1:
        yield f"Other coordinates explain less: {', '.join(f'{name} {shares[name]:.0f} %' for name in ranked[1:4])}."


def shown_range(low: float, high: float, unit: str) -> tuple[str, str, str]:
    """Angles are shown in degrees."""
    if unit.startswith("rad"):
        return f"{np.degrees(low):.2g}", f"{np.degrees(high):.2g}", unit.replace("rad", "deg", 1)
    return f"{low:.2g}", f"{high:.2g}", unit
