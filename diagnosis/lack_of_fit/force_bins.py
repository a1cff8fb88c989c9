"""The mean missing force, overall and by bins of a coordinate: a regression of the innovations on responses to forces.

    innovations = sum over bins of  force in the bin * response to a unit force while inside the bin  + noise,

with the initial states and the nuisances projected out. For the bins, what other values of the model's own estimated
parameters could do is projected out too, so that what is left is a shape that no refit explains. A sample belongs to
the bin of its predicted state, which is independent of the sample's own noise. Standard deviations are the larger of
the floor's and of those from the scatter between blocks of time, which are robust to coloured noise; the latter come
with Student's t, whose degrees of freedom depend on how evenly the blocks contribute information. Source: the sandwich
of White, Econometrica 48 (1980) 817-838, by blocks as in Liang and Zeger, Biometrika 73 (1986) 13-22.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from upright.diagnosis.lack_of_fit.floor import Innovations
from upright.diagnosis.lack_of_fit.force_probe import Coordinate, Probe
from upright.estimators.data.time_scale import time_scale
from upright.estimators.data.white_noise import white_variance
from upright.estimators.fit.gauss_newton import Block, eliminate
from upright.estimators.tails import t_sf

Array = NDArray[np.float64]

BINS = 8
"""Bins of a coordinate, with the same number of samples each."""
BLOCK = 1.25
"""Time scales (estimators.data.time_scale) of a block, 0.5 s of the MONOCAB: longer than the memory of the predictor,
short compared with the record."""
RESOLVED = 4.0
"""Least width of a bin, in standard deviations of the coordinate's own error."""
KEPT = 1e-3
"""Least eigenvalue of the regressors' correlation that counts: below it a direction is indistinguishable from what was
projected out, whose derivatives agree with the linear responses to about a thousandth."""


@dataclass(frozen=True, slots=True)
class Term:
    """A mean force over some samples, in the unit of the joint, with its standard deviation and two-sided p-value."""

    force: float
    std: float
    p_value: float

    @property
    def t(self) -> float:
        return self.force / self.std


@dataclass(frozen=True, slots=True)
class Binned:
    """The missing force at `joint` by a coordinate: `edges` (m + 1,) and a term per bin, None if it is not
    identifiable.

    `explained` is the share of the innovations' energy above the noise that the bins account for, 0 to 1.
    """

    joint: str
    unit: str
    coordinate: Coordinate
    edges: Array
    terms: tuple[Term | None, ...]
    explained: float


def mean_forces(found: Innovations, probed: Probe) -> list[Term | None]:
    """The mean missing force at each joint, with the model's parameters as they are."""
    design = _Design(found, probed, also=())
    return [
        design.fit(joint, [np.ones((len(part), 1)) for part in found.errors])[0][0]
        for joint in range(len(probed.joints))
    ]


def binned_forces(found: Innovations, probed: Probe) -> list[Binned]:
    """The missing force at each joint by each coordinate that moves by more than its own uncertainty."""
    estimated = tuple(place for place, parameter in enumerate(found.problem.model.parameters) if parameter.estimated)
    design = _Design(found, probed, also=tuple(place for place in estimated if place not in found.problem.free))
    results = []
    for coordinate in probed.coordinates:
        edges = _edges(coordinate)
        if len(edges) < 3:
            continue
        members = [_members(part, edges) for part in coordinate.values]
        for place, joint in enumerate(probed.joints):
            terms, explained = design.fit(place, members)
            results.append(Binned(joint.name, joint.force_unit, coordinate, edges, terms, explained))
    return results


def _edges(coordinate: Coordinate) -> Array:
    """Edges with equal numbers of samples between neighbours, no two closer than the coordinate is known."""
    whole = np.concatenate(coordinate.values)
    edges = np.unique(np.quantile(whole, np.linspace(0.0, 1.0, BINS + 1)))
    wide = [float(edges[0])]
    for edge in edges[1:]:
        if edge - wide[-1] > RESOLVED * coordinate.std:
            wide.append(float(edge))
    wide[-1] = max(wide[-1], float(edges[-1]))
    return np.array(wide)


def _members(values: Array, edges: Array) -> Array:
    """1 where a sample is in a bin, (n, m)."""
    return np.eye(len(edges) - 1)[np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)]


class _Design:
    """The whitened innovations with everything else projected out, ready for responses to be fitted to them."""

    def __init__(self, found: Innovations, probed: Probe, also: Sequence[int]) -> None:
        self.found, self.probed = found, probed
        self.blocks = found.blocks(also)
        left = [eliminate(block) for block in self.blocks]
        columns = np.vstack([common for _, common in left])
        sizes = np.linalg.norm(columns, axis=0)
        columns = columns[:, sizes > 0.0] / sizes[sizes > 0.0]
        basis, singular, _ = np.linalg.svd(columns, full_matrices=False)
        self.basis = basis[:, singular > 1e-6 * np.max(singular, initial=0.0)]
        self.residual = self._without(np.concatenate([residual for residual, _ in left]))
        self.numbers = self._numbers()
        chosen = found.floor.informative
        level = white_variance(found.normalised)[0][chosen]
        self.noise = float(np.sum(level) * sum(map(len, found.errors)))

    def _without(self, columns: Array) -> Array:
        return np.asarray(columns - self.basis @ (self.basis.T @ columns))

    def _numbers(self) -> NDArray[np.int64]:
        """Number of the block of time to which each whitened innovation belongs; the prior of an initial state belongs
        to the first block of its segment."""
        numbers, last = [], 0
        task = self.found.problem
        length = BLOCK * time_scale(task.model, task.segments)
        for segment, block in zip(task.segments, self.blocks, strict=True):
            at = ((segment.time - segment.time[0]) // length).astype(np.int64) + last
            inside = at.repeat(segment.measured.shape[1])
            numbers += [inside, np.full(len(block.residual) - len(inside), last)]
            last = int(at[-1]) + 1
        return np.concatenate(numbers)

    def fit(self, joint: int, members: Sequence[Array]) -> tuple[tuple[Term | None, ...], float]:
        """The mean force at `joint` for each column of `members`, by segment (n, m), and the share explained."""
        from scipy.signal import fftconvolve  # half a second of imports, which not every command needs

        response, whitener = self.probed.response, self.found.floor.whitener
        parts = []
        for block, inside in zip(self.blocks, members, strict=True):
            impulse = response.impulse(joint, len(inside)) @ whitener.T
            shown = np.stack([fftconvolve(inside, each[:, None], axes=0)[: len(inside)] for each in impulse.T], axis=1)
            column = np.zeros((len(block.residual), inside.shape[1]))
            column[: shown[..., 0].size] = shown.reshape(-1, inside.shape[1])
            parts.append(eliminate(Block(block.residual, column, block.own))[1])
        whole = np.vstack(parts)
        before = np.linalg.norm(whole, axis=0)
        columns = self._without(whole)
        size = np.linalg.norm(columns, axis=0)
        determined = size > KEPT * np.max(before, initial=1e-300)
        terms: list[Term | None] = [None] * len(size)
        explained = 0.0
        if determined.any():
            found, explained = self._terms(columns[:, determined] / size[determined])
            for place, term in zip(np.flatnonzero(determined).tolist(), found, strict=True):
                terms[place] = Term(term.force / size[place], term.std / size[place], term.p_value)
        return tuple(terms), explained

    def _terms(self, columns: Array) -> tuple[list[Term], float]:
        """Coefficients of unit columns (N, m), and the share of the energy above the noise that they explain."""
        values, vectors = np.linalg.eigh(columns.T @ columns)
        kept = values > KEPT * values[-1]
        inverse = (vectors[:, kept] / values[kept]) @ vectors[:, kept].T
        influence = columns @ inverse
        forces = influence.T @ self.residual
        rest = self.residual - columns @ forces
        count = int(np.max(self.numbers)) + 1
        scores, leverages = np.zeros((2, count, columns.shape[1]))
        np.add.at(scores, self.numbers, influence * rest[:, None])
        np.add.at(leverages, self.numbers, influence**2)
        informed = np.sum(leverages, axis=0)
        freedom = informed**2 / np.maximum(np.sum(leverages**2, axis=0), 1e-300)
        spare = max(count - int(np.sum(kept)), 1)
        deviations = np.sqrt(np.maximum(informed, np.sum(scores**2, axis=0) * count / spare))
        p_values = 2.0 * t_sf(np.abs(forces) / deviations, freedom)
        energy = float(self.residual @ self.residual)
        over = energy - self.noise
        explained = min(max((energy - float(rest @ rest)) / over, 0.0), 1.0) if over > 0.0 else 0.0
        return [Term(*map(float, each)) for each in zip(forces, deviations, p_values, strict=True)], explained
