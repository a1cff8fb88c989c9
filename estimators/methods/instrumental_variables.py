"""Instrumental variables on a joint's balance: the regression of `least_squares` without the bias by noise.

The instruments are noise-free estimates of the balance's regressors, from an auxiliary model: every channel is
projected on the injected excitation and on its response through first-order lags of 1/32 to 1 s (at the default
bandwidth; in proportion at others). The regressors are evaluated on these projections, sign() included, and filtered in
the same way. They are uncorrelated with sensor noise and with a disturbance that the controller feeds back, since both
are independent of the excitation. So the result is consistent in closed loop, on unstable plants too. A term that the
excitation does not move has no instrument and is reported as unknown, even if the vehicle moved for other reasons.
Noise inside a nonlinear term, as in the sign of a rate near zero, is not removed.

An excitation that alone drives the gimbals, as the step from rest does, acts differently from one within the closed
loop: while the setpoint equals the excitation, it is projected on separate lags.

Source: Young, Recursive Estimation and Time-Series Analysis, chapters 6 and 7 (auxiliary model); Soederstroem and
Stoica, System Identification, chapter 8; Griese et al., section IV, for the bias this removes.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from upright.estimators.contract import Estimate, Status
from upright.estimators.data.instrument_bank import InstrumentBank
from upright.estimators.data.segments import DataError, segments
from upright.estimators.fit.result import refused
from upright.estimators.methods.balance import Balance, channel, split
from upright.estimators.methods.least_squares import balance_rows, checked_bandwidth, regression
from upright.estimators.stopwatch import stopwatch
from upright.models.model import Model
from upright.models.segment import Segment
from upright.telemetry.recording import Recording

Array = NDArray[np.float64]

METHOD = "instrumental_variables"
ANSWERED = 0.3
"""Share of the rate's power that the excitation has to explain; by chance it is up to a fifth in half a minute."""


def instrumental_variables(
    model: Model | str,
    recordings: Sequence[Recording],
    *,
    estimate: Iterable[str] | None = None,
    support: float | None = None,
    bandwidth: float | None = None,
    joint: str = "",
    excitation: str = "excitation",
    setpoint: str = "",
) -> Estimate:
    """As `least_squares`, with instruments from the channel `excitation`, whatever its unit.

    `setpoint` is the channel of the actuators' command, needed if the excitation alone may drive the vehicle (see
    above). The excitation has to be known at every sample and injected from outside: a reference or a test signal, not
    a measurement. Data that cannot be used give an Estimate without values that says why. Errors as for
    `least_squares`.
    """
    began = stopwatch()
    balance = split(model, joint, estimate)
    try:
        data = [(segments(balance.model, [recording], support=support), recording) for recording in recordings]
        pooled = [segment for found, _ in data for segment in found]
        if not pooled:
            raise DataError(Status.TOO_FEW_SAMPLES, "recordings", "none is given", remedy="give at least one.")
        bandwidth = checked_bandwidth(bandwidth, pooled)
        injected = [
            injection(segment, recording, excitation, setpoint) for found, recording in data for segment in found
        ]
        banks = [bank(segment, *each, bandwidth) for segment, each in zip(pooled, injected, strict=True)]
        if not any(np.ptp(values) > 0.0 for values, _ in injected):
            what = f"channel {excitation} never moves"
            raise DataError(Status.TOO_LITTLE_EXCITATION, "recordings", what, remedy="run an experiment that excites.")
        projected = noise_free(balance, pooled, banks)
        _require_response(balance, pooled, projected, excitation)
    except DataError as error:
        return refused(balance.model, METHOD, error, stopwatch() - began)
    rows = balance_rows(balance, pooled, bandwidth)
    quiet = balance_rows(balance, projected, bandwidth)
    return regression(METHOD, balance, pooled, rows, bandwidth, began, [each.regressors for each in quiet])


def injection(
    segment: Segment, recording: Recording, excitation: str, setpoint: str
) -> tuple[Array, NDArray[np.bool_]]:
    """The excitation at the samples of `segment`, and a mask of those at which it alone drives. Raises DataError if it
    is unknown."""
    remedy = "it is not on the bus: use the .arrow that was recorded beside the log, or least_squares."
    if excitation not in recording.values:
        there = ", ".join(recording.channels.names)
        what = f"channel {excitation} is missing, and no other is known to be free of noise; the channels are {there}"
        raise DataError(Status.MISSING_CHANNEL, recording.source, what, remedy=remedy)
    at = np.searchsorted(recording.time, segment.time)
    values = recording[excitation][at]
    unknown = int(np.sum(~np.isfinite(values)))
    if unknown:
        what = f"channel {excitation} is unknown in {unknown} of {len(values)} samples"
        raise DataError(Status.MISSING_CHANNEL, recording.source, what, remedy=remedy)
    alone = np.zeros(len(values), dtype=bool)
    if setpoint in recording.values:
        alone = np.abs(recording[setpoint][at] - values) < InstrumentBank.ALONE
    return values, alone


def bank(segment: Segment, excitation: Array, alone: NDArray[np.bool_], bandwidth: float) -> Array:
    """Held excitation, its lags, and a constant at the samples of `segment`: (n, instruments)."""
    rates = InstrumentBank.RATES * bandwidth / (2.0 * np.pi * 5.0)
    held = np.stack((np.where(alone, 0.0, excitation), np.where(alone, excitation, 0.0)), axis=1)
    share = -np.expm1(-np.diff(segment.time)[:, None] * rates)
    lags = np.zeros((len(held), len(rates), 2))
    for row in range(1, len(held)):
        lags[row] = lags[row - 1] + share[row - 1][:, None] * (held[row - 1] - lags[row - 1])
    return np.concatenate((lags.reshape(len(held), -1), held, np.ones((len(held), 1))), axis=1)


def noise_free(balance: Balance, data: Sequence[Segment], banks: Sequence[Array]) -> list[Segment]:
    """`data` with every channel replaced by its projection on `banks`; one projection for all segments."""
    tools = np.concatenate(banks)
    scale = np.sqrt(np.mean(tools**2, axis=0))
    tools = tools[:, scale > 0.0] / scale[scale > 0.0]
    width = data[0].measured.shape[1]
    channels = np.concatenate([np.concatenate((each.measured, each.row_inputs), axis=1) for each in data])
    projected = tools @ np.linalg.lstsq(tools, channels, rcond=None)[0]
    found, first = [], 0
    for segment in data:
        part = projected[first : first + len(segment)]
        first += len(segment)
        found.append(
            replace(
                segment,
                knots=segment.row_knots,
                measured=np.ascontiguousarray(part[:, :width]),
                inputs=np.ascontiguousarray(part[:, width:]),
            )
        )
    return found


def _require_response(balance: Balance, data: Sequence[Segment], projected: Sequence[Segment], excitation: str) -> None:
    """Raises DataError if the joint does not respond to the excitation: the instruments would be due to chance."""
    for place, output in enumerate(balance.model.outputs):
        if not balance.motion[1].has(channel(output.name), channel(output.name, 1)):
            continue
        measured, quiet = (np.concatenate([each.measured[:, place] for each in part]) for part in (data, projected))
        share = 1.0 - float(np.var(measured - quiet) / np.var(measured))
        if share < ANSWERED:
            what = f"{100.0 * share:.0f} % of the variance of {output.name} is explained by {excitation}"
            remedy = f"{100.0 * ANSWERED:.0f} % are needed: excite more strongly, and check that it was injected."
            raise DataError(Status.TOO_LITTLE_EXCITATION, "recordings", what, remedy=remedy)
