"""The interface of every estimator, live and offline: three methods and a human-readable result.

`update(frame)` takes one control cycle, `result()` returns the current estimate, `reset()` forgets everything. An
estimator does no I/O and reads no clock: live, replayed and simulated frames give the same numbers bit for bit. An
unknown value is `None` with a reason in words, never a silent NaN.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from html import escape
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from upright.estimators.disturbance_estimate import DisturbanceEstimate
from upright.estimators.numbers import common
from upright.telemetry.errors import UprightError
from upright.telemetry.samples import Frame

REPORTED_CORRELATION = 0.9
"""Correlations of a larger magnitude are reported."""


class EstimationError(UprightError):
    """An estimator was given something that it cannot use. `what` names it."""

    def __init__(self, what: str, message: str, *, remedy: str = "") -> None:
        super().__init__(f"{what}: {message}.", remedy=remedy)
        self.what = what


class Status(StrEnum):
    """Whether an estimate can be used, and if not, why."""

    OK = "ok"
    TOO_FEW_SAMPLES = "too_few_samples"
    TOO_LITTLE_EXCITATION = "too_little_excitation"
    IMPLAUSIBLE = "implausible"
    MISSING_CHANNEL = "missing_channel"
    UNIDENTIFIABLE = "unidentifiable"
    """In this record the parameter is indistinguishable from others, or does not affect the measurements."""
    AT_BOUND = "at_bound"
    """The best value is physically impossible."""
    BAD_DATA = "bad_data"
    """Gaps, saturation, a stuck channel, or a channel in a wrong unit."""
    NOT_CONVERGED = "not_converged"


@dataclass(frozen=True, slots=True)
class ParameterEstimate:
    """One estimated parameter.

    `value` and its standard deviation `std` are in `unit`. Both are None unless `status` is OK; `reason` then says why.
    `coverage_percent` states how sufficient the excitation is: 100 if the parameter's own term of the equation has
    varied, independently of all other terms, as much as the estimator requires.
    """

    value: float | None
    std: float | None
    unit: str
    status: Status
    coverage_percent: float
    reason: str = ""

    @property
    def identifiable(self) -> bool:
        return self.status is Status.OK


@dataclass(frozen=True, slots=True)
class Estimate:
    """The result of one estimator: its parameters by name, from `samples` samples that span `span` s of valid data.

    `status` is OK if that of every requested parameter is; otherwise it is that of the first that is not, with its
    reason. `correlation` is that of the parameters' errors, in the order of `parameters`, shape (n, n), NaN where it is
    unknown. `fit_percent` states for each channel how well the model with these parameters predicts.
    `disturbance`: the random force at each joint, if the method estimates it.
    `bounds_hit` names parameters whose best value is physically impossible. `seconds` is the computing time. `window`
    (s) is the longest simulation without correction, None for a method that does not simulate.
    """

    method: str
    parameters: Mapping[str, ParameterEstimate]
    status: Status
    reason: str
    samples: int
    span: float
    fit_percent: Mapping[str, float] = field(default_factory=dict)
    disturbance: tuple[DisturbanceEstimate, ...] = ()
    correlation: NDArray[np.float64] | None = None
    bounds_hit: tuple[str, ...] = ()
    seconds: float = 0.0
    window: float | None = None

    @property
    def values(self) -> dict[str, float]:
        """Parameter name to value, of the known parameters."""
        return {name: p.value for name, p in self.parameters.items() if p.value is not None}

    def __str__(self) -> str:
        return _as_text(self)

    def _repr_html_(self) -> str:
        return _as_html(self)

    def to_json(self) -> dict[str, Any]:
        """As JSON-ready values, for MQTT and `identify --json`."""
        return {
            "parameters": {
                name: {
                    "value": parameter.value,
                    "std": parameter.std,
                    "unit": parameter.unit,
                    "identifiable": parameter.identifiable,
                    "status": parameter.status.value,
                    "coverage_percent": round(parameter.coverage_percent, 1),
                    "reason": parameter.reason,
                }
                for name, parameter in self.parameters.items()
            },
            "status": self.status.value,
            "reason": self.reason,
            "samples": self.samples,
            "span": self.span,
            "fit_percent": dict(self.fit_percent),
            "disturbance": {each.joint: each.to_json() for each in self.disturbance},
            "correlation": self._correlation_json(),
            "bounds_hit": list(self.bounds_hit),
            "seconds": self.seconds,
            "window": self.window,
        }

    def _correlation_json(self) -> dict[str, dict[str, float]]:
        if self.correlation is None:
            return {}
        table: dict[str, dict[str, float]] = {}
        names = list(self.parameters)
        for row, first in enumerate(names):
            known = {
                names[c]: float(self.correlation[row, c]) for c in range(row) if np.isfinite(self.correlation[row, c])
            }
            if known:
                table[first] = known
        return table


def _as_text(estimate: Estimate) -> str:
    """Several lines, for a terminal."""
    rows = [_cells(name, estimate) for name in estimate.parameters]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)] if rows else []
    lines = [_headline(estimate)]
    lines += ["  " + "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in rows]
    return "\n".join(line.rstrip() for line in [*lines, *("  " + note for note in _notes(estimate))])


def _as_html(estimate: Estimate) -> str:
    """A table, for a notebook."""
    rows = "".join(
        "<tr>"
        + "".join(f"<td style='text-align:left'>{escape(cell)}</td>" for cell in _cells(name, estimate))
        + "</tr>"
        for name in estimate.parameters
    )
    notes = "".join(f"<div>{escape(note)}</div>" for note in _notes(estimate))
    head = "<tr><th>parameter</th><th>value</th><th>±</th><th>unit</th><th></th></tr>"
    return f"<div><b>{escape(_headline(estimate))}</b><table>{head}{rows}</table>{notes}</div>"


def _headline(estimate: Estimate) -> str:
    state = "" if estimate.status.value == "ok" else f" [{estimate.status.value}: {estimate.reason}]"
    return f"{estimate.method}: {estimate.samples} samples, {estimate.span:.1f} s, took {estimate.seconds:.2f} s{state}"


def _cells(name: str, estimate: Estimate) -> tuple[str, str, str, str, str]:
    parameter = estimate.parameters[name]
    if parameter.value is None or parameter.std is None:
        return name, "-", "", parameter.unit, f"{parameter.status.value}: {parameter.reason}"
    scale = common([(parameter.value, parameter.std)], parameter.unit)
    value, std = scale.pair(parameter.value, parameter.std)
    return name, value, f"± {std}" if std else "", scale.unit, parameter.reason


def _notes(estimate: Estimate) -> list[str]:
    notes = [f"predicts {channel}: {percent:.2f} %" for channel, percent in estimate.fit_percent.items()]
    notes += [f"{name} is at its bound" for name in estimate.bounds_hit]
    if estimate.correlation is not None:
        names = list(estimate.parameters)
        size = np.abs(np.nan_to_num(np.tril(estimate.correlation, -1)))
        reported = np.argwhere(size > REPORTED_CORRELATION).tolist()
        for row, column in sorted(reported, key=lambda at: -size[at[0], at[1]]):
            notes.append(f"{names[column]} and {names[row]} are correlated: {estimate.correlation[row, column]:+.3f}")
    return notes


class Estimator(Protocol):
    """Three methods. `method` is the name under which the result is reported, such as "recursive_least_squares"."""

    @property
    def method(self) -> str: ...

    def update(self, frame: Frame) -> None:
        """Take one control cycle. Cycles that carry no information are skipped without an error."""

    def result(self) -> Estimate:
        """The estimate from all cycles so far."""

    def reset(self) -> None:
        """Return to the state after construction."""
