"""Would a force of any shape still improve the fit? A test for lack of fit that needs no formula.

A missing force at a joint may depend on one coordinate after the other in any way: a piecewise linear function of it,
the same times rate or coordinate, sinusoids of it, and coefficients that oscillate or drift in time. These may have any
shape and pay for it with degrees of freedom. The first terms of Taylor's series are tried, too: every smooth function
looks like one of them. The effect of each on the innovations is its linear response
(diagnosis.lack_of_fit.force_probe), with everything projected out that parameters, noise and initial states could do,
including those of the effects in the model. So no other values of these would explain what is found here.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from upright.diagnosis.lack_of_fit.floor import Innovations
from upright.diagnosis.lack_of_fit.force_probe import Probe, recurrence
from upright.diagnosis.score.whitened import Whitened, project, whitening
from upright.estimators.data.time_scale import time_scale
from upright.estimators.tails import chi2_sf

Array = NDArray[np.float64]

KNOTS = 8
"""Knots of a piecewise linear function, with equal numbers of samples between neighbours."""
HARMONICS = 12
"""Harmonics of the range of a coordinate that are tried."""
SLOWEST, FASTEST, BANDS = 0.04, 2.0, 60
"""Frequencies over the time scale (estimators.data.time_scale; 0.1 and 5 Hz of the MONOCAB) between which a coefficient
may oscillate in time, and the number of bands of which the strongest line is tried."""
CUBES = ("{0} cubed", "{0} squared times {1}", "{0} times {1} squared", "{1} cubed")
OVERSAMPLED = 4
"""Lines per resolved bandwidth, which is one over the length of a record: between two of them nothing is missed."""
LEAST = 1e-6
"""Share of a column's own energy that has to be left after what is fitted anyway has been projected out."""


@dataclass(frozen=True, slots=True)
class Shape:
    """Rise of the log-likelihood by a force of one kind of shape, beyond what chance gives, and its significance.

    `name` is what the force at `joint` depends on. `log_ratio` is the rise, `std` its standard deviation. `p_value`
    accounts for all kinds that were tried. `share` is the share of the innovations' energy that the force explains. The
    rise is evaluated at the noise of the fit, which had to absorb what is missing: if little else is left, the share
    says more.
    """

    joint: str
    name: str
    log_ratio: float
    p_value: float
    share: float = 0.0
    std: float = 0.0


def shapes(found: Innovations, probed: Probe) -> list[Shape]:
    """All kinds at all joints, the largest rise first. `found` has the fit itself, with its own gain."""
    white = Whitened.of(found.fit)
    tried: list[tuple[str, str, _Rise, int]] = []
    for place, joint in enumerate(probed.joints):
        design = Design(white, found, probed, place)
        for name, width, members in _kinds(found, probed, place):
            columns = design.columns(members)
            pieces = [columns[:, first : first + width] for first in range(0, columns.shape[1], width)]
            best = max(map(design.gain, pieces), key=lambda each: each.beyond)
            tried.append((joint.name, name, best, len(pieces)))
        for name, slope in _slopes(probed, place):
            frequencies, lines = design.strongest(slope)
            swings = [_lines(segment.time, frequencies) for segment in found.problem.segments]
            columns = design.columns(_times(swings, slope))
            pieces = [columns[:, first : first + 2] for first in range(0, columns.shape[1], 2)]
            best = max(map(design.gain, pieces), key=lambda each: each.beyond)
            tried.append((joint.name, f"{name} times a sinusoid in time", best, lines))
    kinds = max(len(tried), 1)
    ranked = [
        Shape(joint, name, best.beyond, min(1.0, kinds * pieces * best.by_chance), best.share, best.std)
        for joint, name, best, pieces in tried
        if best.rank
    ]
    return sorted(ranked, key=lambda each: -each.log_ratio)


def _kinds(found: Innovations, probed: Probe, place: int) -> Iterator[tuple[str, int, list[Array]]]:
    """Name, number of columns of one shape, and by segment (n, m) the values: m / columns shapes of a kind."""
    joint = probed.joints[place]
    inner = {state.name for each in found.problem.model.effects for state in each.states}
    values = {each.name: each.values for each in probed.coordinates if each.name not in inner}
    time = tuple(segment.time for segment in found.problem.segments)
    slopes = dict(_slopes(probed, place))
    angle, rate = slopes.get(joint.coordinate), slopes.get(joint.rate)
    hats = {name: _hats(each) for name, each in values.items()}
    clock = _hats(time)
    for name in values:
        yield name, hats[name][0].shape[1], hats[name]
    yield "time", clock[0].shape[1], clock
    for word, slope in slopes.items():
        for name in values:
            if name == joint.coordinate and word == joint.rate:
                continue  # the same as the other way round
            yield f"{word} times {name}", 1, _times([each[:, None] for each in values[name]], slope)
        for name in values:
            if name != word:
                yield f"{word} times a function of {name}", hats[name][0].shape[1], _times(hats[name], slope)
        yield f"{word} times a function of time", clock[0].shape[1], _times(clock, slope)
    if angle is not None and rate is not None:
        for power, name in enumerate(CUBES):
            yield (
                name.format(joint.coordinate, joint.rate),
                1,
                [(one ** (3 - power) * other**power)[:, None] for one, other in zip(angle, rate, strict=True)],
            )
    if angle is not None:
        whole = np.concatenate(angle)
        span = float(np.quantile(whole, 0.999) - np.quantile(whole, 0.001))
        waves = [_lines(each, np.arange(1, HARMONICS + 1) / span) for each in angle]
        yield f"a sinusoid of {joint.coordinate}", 2, waves
        if rate is not None:
            yield f"{joint.rate} times a sinusoid of {joint.coordinate}", 2, _times(waves, rate)


def _slopes(probed: Probe, place: int) -> list[tuple[str, tuple[Array, ...]]]:
    """Coordinate and rate of a joint, if they move, with their values by segment."""
    joint, values = probed.joints[place], {each.name: each.values for each in probed.coordinates}
    return [(name, values[name]) for name in (joint.coordinate, joint.rate) if name in values]


def _hats(values: Sequence[Array]) -> list[Array]:
    """Basis of the piecewise linear functions of a coordinate, (n, KNOTS)."""
    knots = np.unique(np.quantile(np.concatenate(values), np.linspace(0.0, 1.0, KNOTS)))
    return [np.stack([np.interp(each, knots, row) for row in np.eye(len(knots))], axis=1) for each in values]


def _times(columns: Sequence[Array], factor: Sequence[Array]) -> list[Array]:
    return [each * by[:, None] for each, by in zip(columns, factor, strict=True)]


def _lines(values: Array, frequencies: Array) -> Array:
    """Sine and cosine of each frequency in turn, (n, 2 m)."""
    turns = 2.0 * np.pi * values[:, None] * frequencies
    return np.stack([np.sin(turns), np.cos(turns)], axis=2).reshape(len(values), -1)


@dataclass(frozen=True, slots=True)
class _Rise:
    """Energy `explained` by `rank` columns, out of the whole `energy` of the whitened innovations; these scatter
    `inflation` times as much as if they were independent of each other."""

    explained: float
    energy: float
    rank: int
    inflation: float

    @property
    def beyond(self) -> float:
        """Rise of the log-likelihood beyond what chance gives."""
        return 0.5 * (self.explained / self.inflation - self.rank)

    @property
    def std(self) -> float:
        """Standard deviation of `beyond`: the explained energy is noncentral chi-squared."""
        return 0.5 * math.sqrt(2.0 * self.rank + 8.0 * max(self.beyond, 0.0))

    @property
    def share(self) -> float:
        return self.explained / max(self.energy, self.explained, 1e-300)

    @property
    def by_chance(self) -> float:
        return float(chi2_sf(self.explained / self.inflation, self.rank))


class Design:
    """Responses of the whitened innovations to forces at one joint."""

    def __init__(self, white: Whitened, found: Innovations, probed: Probe, place: int) -> None:
        fit, response = white.fit, probed.response
        self.white, self.segments = white, fit.problem.segments
        scale = time_scale(fit.problem.model, self.segments)
        self.slowest, self.fastest = SLOWEST / scale, FASTEST / scale
        floor = found.floor
        predictor = floor.transition - floor.transition @ fit.gain @ floor.output
        pushes = np.zeros((max(map(len, self.segments)), len(predictor)))
        pushes[1:2] = response.drive[:, place]
        impulse = recurrence(predictor, pushes) @ floor.output.T
        impulse[0] += response.direct[:, place]
        self.impulse = impulse @ whitening(fit).T
        order = np.argsort(white.blocks, kind="stable")
        self.order, self.edges = order, np.flatnonzero(np.diff(white.blocks[order], prepend=-1))

    def columns(self, members: Sequence[Array]) -> Array:
        from scipy.signal import fftconvolve  # half a second of imports, which not every command needs

        parts = []
        for segment, basis, inside in zip(self.segments, self.white.starts, members, strict=True):
            shown = np.stack(
                [fftconvolve(inside, each[:, None], axes=0)[: len(inside)] for each in self.impulse[: len(inside)].T],
                axis=1,
            )
            shown = np.where(np.isfinite(segment.measured)[:, :, None], shown, 0.0).reshape(-1, inside.shape[1])
            whole = np.zeros((len(basis), inside.shape[1]))
            whole[: len(shown)] = shown
            parts.append(whole - basis @ (basis.T @ whole))
        stacked = np.concatenate(parts)
        size = np.maximum(np.linalg.norm(stacked, axis=0), 1e-300)
        return project(stacked / size, self.white.nuisance)

    def strongest(self, slope: Sequence[Array]) -> tuple[Array, int]:
        """In each of BANDS the frequency (Hz) at which an oscillating coefficient of `slope` correlates best with what
        is left; then the number of lines that the record resolves. The correlation is evaluated by the adjoint: the
        innovations are filtered backwards and then correlated with the oscillation."""
        from scipy.signal import fftconvolve  # half a second of imports, which not every command needs

        time = np.concatenate([segment.time for segment in self.segments])
        rests = np.split(self.white.residual, np.cumsum([len(each) for each in self.white.starts])[:-1])
        pulled = []
        for segment, rest, inside in zip(self.segments, rests, slope, strict=True):
            known = np.isfinite(segment.measured)
            left = np.where(known, rest[: known.size].reshape(known.shape), 0.0)[::-1]
            back = sum(
                fftconvolve(each, impulse)[: len(left)]
                for each, impulse in zip(left.T, self.impulse[: len(left)].T, strict=True)
            )
            pulled.append(inside * np.asarray(back)[::-1])
        # Gathered into eighths of the shortest period, within which an oscillation hardly changes.
        width = 0.125 / self.fastest
        places, inverse = np.unique(np.floor(time / width), return_inverse=True)
        weights = np.bincount(inverse, weights=np.concatenate(pulled))
        resolved = float(np.ptp(time)) * (self.fastest - self.slowest)
        chosen = []
        for low, high in pairwise(np.linspace(self.slowest, self.fastest, BANDS + 1).tolist()):
            lines = np.linspace(low, high, max(2, math.ceil(OVERSAMPLED * resolved / BANDS)))
            power = np.abs(np.exp(-2.0j * np.pi * width * np.outer(lines, places)) @ weights)
            chosen.append(float(lines[np.argmax(power)]))
        return np.array(chosen), max(BANDS, math.ceil(resolved))

    def gain(self, columns: Array) -> _Rise:
        """Rise by unit columns (n, m); the scatter between blocks counts if it is larger than by chance."""
        values, vectors = np.linalg.eigh(columns.T @ columns)
        kept = values > LEAST
        if not kept.any():
            return _Rise(0.0, 0.0, 0, 1.0)
        basis = columns @ (vectors[:, kept] / np.sqrt(values[kept]))
        residual = self.white.residual
        sizes = basis.T @ residual
        rest = basis * (residual - basis @ sizes)[:, None]
        sums = np.add.reduceat(rest[self.order], self.edges, axis=0)
        inflation = max(1.0, float(np.sum(sums**2)) / len(sizes))
        return _Rise(float(sizes @ sizes), float(residual @ residual), len(sizes), inflation)
