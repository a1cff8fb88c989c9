"""From recordings to the gapless segments that a compiled model takes, with a check whether the data can be used.

A sample is used if all inputs and outputs are known and, if there is a support angle, the vehicle is free of its
supports. Inputs keep the instants at which they were sampled. Outputs of a device that is sampled at other instants
than the recording (`age`) are interpolated to the recording's instants. An input with a delay acts on the first sample
of a segment by its earlier values. If a recording begins with a segment, its first sample provides only this earlier
value.

Data that would make a fit look good but be wrong are refused here, with the channel and the reason: a missing channel,
one that never moves or is clipped, and an angle and a rate that are inconsistent (degrees for radians, a swapped sign
or channel).
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from math import inf, nan

import numpy as np
from numpy.typing import NDArray

from upright.estimators.contract import EstimationError, Status
from upright.estimators.data.ramp import RampLimiter
from upright.models.compiler.curves import read
from upright.models.model import Model
from upright.models.natural_time import USUAL, natural_time
from upright.models.parts import Hold, Input, Output
from upright.models.segment import Segment
from upright.models.sensing import filter_inputs
from upright.models.text.expressions import names_in
from upright.telemetry.channels import IDLE
from upright.telemetry.errors import RecordingError
from upright.telemetry.options import mapped, option
from upright.telemetry.recording import Recording

Array = NDArray[np.float64]

SHORTEST = 50
"""Samples of the shortest segment that is used."""
SUPPORT_MARGIN = float(np.radians(0.3))
"""rad: a vehicle is free if its angle is smaller than the support angle by at least this margin."""
RESTING = 0.8
"""Share of the support angle above which the vehicle rests on its support when a recording begins or ends."""
REACH = 2.5
"""Natural times (models.natural_time) before a segment for which its inputs are kept: a lag of half a natural time has
then decayed to less than a hundredth."""
BEFORE_A_FALL = 0.5
"""Natural times before a fall that are left out too, since the cause of the fall may already have acted then."""
OVER = 1.25
"""Natural times over which an angle is compared with its rate: short compared with a record, but long enough for the
motion to exceed quantisation."""
LONGEST_GAP = 2.5
"""A segment ends at a gap of more than this number of sampling periods."""
AGREEMENT = (0.5, 2.0)
"""Range of the ratio between a rate and the derivative of its angle that sensor errors can explain."""


class DataError(EstimationError):
    """The data cannot be used for the task. `status` is the status of the result."""

    def __init__(self, status: Status, what: str, message: str, *, remedy: str) -> None:
        super().__init__(what, message, remedy=remedy)
        self.status = status


class Contradiction(DataError):
    """An angle and a rate that cannot both be what their names say."""


def segments(
    model: Model, recordings: Sequence[Recording], *, support: float | None = None, longest: float | None = None
) -> list[Segment]:
    """The usable segments of all `recordings`, none longer than about `longest` s.

    `support` is the magnitude of the coordinate (rad) at which supports carry the vehicle and the model is not valid;
    by default that of the recording's metadata, if any. Raises DataError.
    """
    found: list[Segment] = []
    for recording in recordings:
        _check(model, recording)
        limit = support if support is not None else recorded_support(recording)
        free = _free(model, recording, limit)
        if not free.any():
            raise _never_free(model, recording, limit)
        _check_free(model, recording, free)
        late = _late(model, recording)
        found += [_segment(model, recording, part, late) for part in _gapless(recording, free, longest)]
    if not found:
        held = any(support is not None or recorded_support(each) is not None for each in recordings)
        raise DataError(
            Status.TOO_FEW_SAMPLES,
            "recording",
            f"no gapless segment {'of free motion ' if held else ''}has {SHORTEST} samples",
            remedy=f"record for longer{', with the vehicle upright' if held else ', without holes'}.",
        )
    return found


def _never_free(model: Model, recording: Recording, limit: float | None) -> DataError:
    """The reason why no sample can be used: a channel without values, or a vehicle on its supports."""
    names = [name for name in channels_of(model) if name in recording.values]
    for name in names:
        if not np.isfinite(recording[name]).any():
            remedy = f"name another column: {mapped({name: 'COLUMN'})}."
            return DataError(
                Status.MISSING_CHANNEL, f"channel {name}", f"has no values in {recording.source}", remedy=remedy
            )
    if limit is None:
        what = f"no sample has all of {', '.join(names)} known"
        return DataError(Status.TOO_FEW_SAMPLES, recording.source, what, remedy="record all channels in each sample.")
    what = "no sample has all channels known and the vehicle free of its supports"
    return DataError(Status.TOO_FEW_SAMPLES, recording.source, what, remedy="record it upright.")


def after_settling(model: Model, recordings: Sequence[Recording], support: float | None = None) -> list[Recording]:
    """`recordings`, each of which is cut at the time when the model has settled (`Model.settling`) if it begins on a
    support.

    A recording that begins in free motion, or has none for as long, is unchanged.
    """
    if not model.settling:
        return list(recordings)
    found = []
    for recording in recordings:
        _check(model, recording)
        free = _free(model, recording, support if support is not None else recorded_support(recording))
        settled_at = float(recording.time[np.argmax(free)] - recording.time[0]) + model.settling
        whole = free[0] or settled_at >= recording.duration or not free.any()
        found.append(recording if whole else recording.between(settled_at))
    return found


def recorded_support(recording: Recording) -> float | None:
    """Magnitude of the coordinate (rad) at which supports carry the vehicle, from the recording's metadata."""
    text = recording.metadata.get("support")
    if not text:
        return None
    try:
        angle = float(text)
    except ValueError:
        angle = nan
    if not 0.0 < angle < inf:
        what = f"the support angle in its metadata is no angle: {text[:40]!r}"
        raise RecordingError(recording.source, "support", what, remedy="Write the angle, in rad, or leave it out.")
    return angle


def channels_of(model: Model) -> tuple[str, ...]:
    """The channels that the model's equations really use, and their ages. A recording may lack ages: all channels then
    count as sampled at the same instant, and the model's time offsets cover the differences."""
    used = _used_names(model)
    inputs = [each for each in model.inputs if each.name in used or f"{each.name}_slope" in used]
    names = [each.channel for each in inputs] + [each.name for each in model.outputs]
    ages = [each.age for each in inputs] + [each.age for each in model.outputs]
    return (*names, *dict.fromkeys(age for age in ages if age))


def optional_channels(model: Model) -> frozenset[str]:
    """The channels that a recording may lack: the ages of other channels, and inputs with a usual value."""
    ages = [each.age for each in model.inputs] + [each.age for each in model.outputs]
    return frozenset(age for age in ages if age) | {each.channel for each in model.inputs if each.usual is not None}


def _used_names(model: Model) -> frozenset[str]:
    texts = [state.derivative for state in model.base_states] + [each.expression for each in model.outputs]
    texts += list(model.definitions.values())
    for joint in model.joints:
        texts += [joint.coordinate, joint.rate, joint.inertia, joint.load]
    if model.effects:
        texts += [text for actuator in model.actuators for text in (actuator.rate, actuator.angle) if text]
    return filter_inputs(model).union(*(names_in(text) for text in texts))


def _check(model: Model, recording: Recording) -> None:
    optional = optional_channels(model)
    for name in channels_of(model):
        if name not in recording.values and name not in optional:
            raise DataError(
                Status.MISSING_CHANNEL,
                f"channel {name}",
                f"is not in {recording.source}, which has {', '.join(recording.channels.names)}",
                remedy=f"{_near(name, recording)}record it, or use a {option('--model', 'model=')} that does without.",
            )


def _near(name: str, recording: Recording) -> str:
    """The option that names the column of a channel, with one whose name is similar."""
    known = recording.channels.names
    near = [each for each in known if name.lower() in each.lower()] or difflib.get_close_matches(name, known, n=1)
    return (
        f"name its column ({mapped({name: near[0]})}?), " if near else f"name its column ({mapped({name: 'COLUMN'})}), "
    )


def _free(model: Model, recording: Recording, support: float | None) -> NDArray[np.bool_]:
    known = np.all([np.isfinite(recording[name]) for name in channels_of(model) if name in recording.values], axis=0)
    # A reading between a known and an unknown sample is not known either.
    known &= np.all([np.isfinite(_reading(recording, each)) for each in model.outputs], axis=0)
    known &= ~_fallen(model, recording)
    coordinate = _coordinate(model)
    if support is not None and coordinate in recording.values and known.any():
        size = np.abs(np.where(known, recording[coordinate], np.inf))
        # A sensor with an offset shows another angle on the support, on which most recordings begin and end.
        ends = [float(each) for each in size[known][[0, -1]] if each > RESTING * support]
        known &= size < min([support, *ends]) - SUPPORT_MARGIN
    return np.asarray(known)


def _natural(model: Model) -> float:
    """s."""
    return natural_time(model) or USUAL


def _coordinate(model: Model) -> str:
    """The coordinate in which the vehicle falls."""
    return model.joints[0].coordinate if model.joints else ""


def _falls(model: Model, recording: Recording) -> list[tuple[int, int]]:
    """The samples at which a vehicle begins to fall, and those at which it is held again.

    A fall begins with the motion to one side that continues until nothing holds the vehicle any more.
    """
    coordinate = _coordinate(model)
    if "phase" not in recording.values or coordinate not in recording.values:
        return []
    let_go, angle = recording["phase"] == IDLE, recording[coordinate]
    falls = []
    for row in (np.flatnonzero(let_go[1:] & ~let_go[:-1]) + 1).tolist():
        back = np.flatnonzero(~(np.sign(angle[row]) * np.diff(angle[: row + 1]) > 0.0))
        held_again = np.flatnonzero(~let_go[row:])
        falls.append((back[-1] + 1 if len(back) else 0, row + held_again[0] if len(held_again) else len(angle)))
    return falls


def _fallen(model: Model, recording: Recording) -> NDArray[np.bool_]:
    """Mask (n,) of the samples of falls and of BEFORE_A_FALL before each."""
    before = BEFORE_A_FALL * _natural(model)
    fallen = np.zeros(len(recording.time), dtype=bool)
    for begin, end in _falls(model, recording):
        fallen[np.searchsorted(recording.time, recording.time[begin] - before) : end] = True
    return fallen


def falls_at(model: Model, recording: Recording, support: float | None = None) -> float | None:
    """When the vehicle began to fall from free motion, s from the first sample; None if it did not."""
    limit = support if support is not None else recorded_support(recording)
    for begin, _ in _falls(model, recording):
        if limit is None or abs(recording[_coordinate(model)][begin]) < RESTING * limit:
            return float(recording.time[begin] - recording.time[0])
    return None


def _check_free(model: Model, recording: Recording, free: NDArray[np.bool_]) -> None:
    """Raises DataError for channels that cannot be what their names say."""
    used = _used_names(model)
    measured = [each.name for each in model.outputs]
    counted = {each.name for each in model.outputs if each.counted}
    held = {each.name for each in model.inputs if each.hold is Hold.ZERO_ORDER or each.usual is not None}
    measured += [each.name for each in model.inputs if each.name in used and each.name not in held]
    ages = {each.name: each.age for each in model.inputs} | {each.name: each.age for each in model.outputs}
    for name in measured:
        values = recording[name][free & _fresh(recording, ages[name])]
        if name in {each.name for each in model.outputs} and np.ptp(values) == 0.0:
            remedy = "check the sensor and its scaling."
            raise DataError(Status.BAD_DATA, f"channel {name}", "never moves", remedy=remedy)
        # A counted output is constant until the next count.
        share = 0.0 if name in counted else clipped_share(values)
        if share > 0.0:
            raise DataError(
                Status.BAD_DATA,
                f"channel {name}",
                f"is clipped at {np.max(np.abs(values)):.4g} for {100.0 * share:.1f} % of the time",
                remedy="widen the sensor's range or excite less.",
            )
    pairs = [(sensor.angle, sensor.rate) for sensor in model.sensors]
    pairs += [(actuator.angle, actuator.rate) for actuator in model.actuators]
    for angle, rate in pairs:
        if angle in recording.values and rate in recording.values:
            _check_pair(recording, angle, rate, free, OVER * _natural(model))


def _fresh(recording: Recording, age: str) -> NDArray[np.bool_]:
    """Mask (n,) of the samples at which a reading is new, by the channel of its `age`: an old one is older by the time
    that has passed. A reading that is repeated, because no other came, is not clipped."""
    new = np.ones(len(recording), dtype=bool)
    if age in recording.values:
        new[1:] = ~(np.diff(recording[age]) > 0.5 * np.diff(recording.time))
    return new


def _check_pair(recording: Recording, angle: str, rate: str, free: NDArray[np.bool_], span: float) -> None:
    """Checks that an angle changes by the integral of its rate over `span` s, which is short compared with a record but
    long enough for the motion to exceed the noise. Across a gap the integral is not known."""
    values, rates, time = recording[angle], recording[rate], recording.time
    ahead = max(1, round(span * recording.rate))
    if ahead >= len(values):
        return
    joined = np.diff(time) <= LONGEST_GAP / recording.rate
    whole = np.convolve(free, np.ones(ahead + 1), "valid") > ahead
    whole &= np.convolve(joined, np.ones(ahead), "valid") > ahead - 1
    turned = np.concatenate(([0.0], np.cumsum(0.5 * (rates[1:] + rates[:-1]) * np.diff(time))))
    moved, expected = (values[ahead:] - values[:-ahead])[whole], (turned[ahead:] - turned[:-ahead])[whole]
    if len(moved) < SHORTEST or not np.all(np.isfinite(expected)) or np.std(expected) == 0.0 or np.std(moved) == 0.0:
        return
    together = float(np.corrcoef(moved, expected)[0, 1])
    factor = float(np.std(expected) / np.std(moved)) * (1.0 if together > 0.0 else -1.0)
    if abs(together) > 0.5 and AGREEMENT[0] < factor < AGREEMENT[1]:
        return
    if abs(together) <= 0.5:
        raise Contradiction(
            Status.BAD_DATA,
            f"channel {rate}",
            f"is not the derivative of {angle} (correlation {together:.2f})",
            remedy="check which channel is which.",
        )
    degrees = 0.5 < abs(factor) * np.pi / 180.0 < 2.0 or 0.5 < abs(factor) * 180.0 / np.pi < 2.0
    unit = "; one of them is in degrees" if degrees else ""
    raise Contradiction(
        Status.BAD_DATA,
        f"channel {rate}",
        f"is {factor:.3g} times the derivative of {angle}{unit}",
        remedy="convert both to SI units (rad, rad/s) and check signs and scaling.",
    )


def clipped_share(values: Array) -> float:
    """The share of `values`, (n,), that is clipped at their largest or smallest: constant there, and reached at speed.

    A quantised reading is constant in many places, and its last step before a turning point may be a whole one however
    slow the motion. So a change by its finest step does not count as speed.
    """
    step = np.abs(np.diff(values))
    usual = float(np.sqrt(np.mean(step**2)))
    flat_inside = (step == 0.0) & (values[1:] < np.max(values)) & (values[1:] > np.min(values))
    finest = float(np.min(step[step > 0.0], initial=np.inf)) if flat_inside.any() else 0.0
    clipped = 0
    for extreme in (np.max(values), np.min(values)):
        at = np.concatenate(([False], values == extreme, [False]))
        starts = np.flatnonzero(at[1:] & ~at[:-1])
        ends = np.flatnonzero(~at[1:] & at[:-1])
        for start, end in zip(starts, ends, strict=True):
            if end - start >= 5 and start >= 3 and np.mean(step[start - 3 : start]) > finest + 0.5 * usual:
                clipped += int(end - start)
    return clipped / len(values)


def _gapless(recording: Recording, free: NDArray[np.bool_], longest: float | None) -> Iterator[slice]:
    spacing = np.diff(recording.time)
    follows = np.zeros(len(free), dtype=bool)
    follows[1:] = free[1:] & free[:-1] & (spacing < LONGEST_GAP * float(np.median(spacing)))
    starts = np.flatnonzero(free & ~follows)
    ends = np.flatnonzero(free & ~np.append(follows[1:], False)) + 1
    for start, end in zip(starts.tolist(), ends.tolist(), strict=True):
        count = 1
        if longest is not None:
            count = max(1, round((recording.time[end - 1] - recording.time[start]) / longest))
        edges = np.linspace(start, end, count + 1).round().astype(int).tolist()
        for first, last in pairwise(edges):
            if last - first >= SHORTEST:
                yield slice(first, last)


def _late(model: Model, recording: Recording) -> NDArray[np.bool_] | None:
    """Mask (n,) of the samples at which all inputs that the model uses are known; None if none of them has a delay."""
    used = channels_of(model)
    inputs = [each for each in model.inputs if each.channel in used and each.channel in recording.values]
    if not any(each.delays for each in inputs):
        return None
    channels = {each.channel for each in inputs} | {each.age for each in inputs if each.age in recording.values}
    return np.asarray(np.all([np.isfinite(recording[channel]) for channel in channels], axis=0))


def _before(recording: Recording, part: slice, known: NDArray[np.bool_], reach: float) -> int:
    """The first sample of the gapless, `known` samples that lead up to `part`, no more than `reach` s before it."""
    time, longest = recording.time, LONGEST_GAP * float(np.median(np.diff(recording.time)))
    row: int = part.start
    while (
        row > 0 and known[row - 1] and time[row] - time[row - 1] < longest and time[part.start] - time[row - 1] < reach
    ):
        row -= 1
    return row


def _segment(model: Model, recording: Recording, part: slice, late: NDArray[np.bool_] | None) -> Segment:
    """`late`: see `_late`."""
    time = recording.time
    used = channels_of(model)
    zeros = np.zeros(len(time))
    acting = part
    if late is not None:
        acting = slice(_before(recording, part, late, REACH * _natural(model)), part.stop)
        part = slice(max(part.start, acting.start + 1), part.stop)

    inputs = [_input(recording, each) if each.channel in used else zeros for each in model.inputs]
    knots = [_sampled(recording, each.age if each.channel in used else "") for each in model.inputs]
    measured = [_reading(recording, each) for each in model.outputs]
    return Segment(
        time=np.ascontiguousarray(time[part]),
        knots=_columns(knots, acting),
        inputs=_columns(inputs, acting),
        measured=_columns(measured, part),
        source=recording.source,
    )


def _sampled(recording: Recording, age: str) -> Array:
    """The instants (n,) at which channels with this `age` were sampled."""
    return recording.time - recording[age] if age in recording.values else recording.time


def _reading(recording: Recording, each: Output) -> Array:
    """The samples of an output, (n,), interpolated to the recording's instants."""
    values = recording[each.name]
    if each.age not in recording.values:
        return values
    return reading(each)(recording.time, _sampled(recording, each.age), values)


def reading(each: Output) -> Callable[[Array, Array, Array], Array]:
    """How an output is interpolated: (time, knots, values). A curve through the steps of a counted one would
    overshoot."""
    return np.interp if each.counted else read


def _input(recording: Recording, each: Input) -> Array:
    """The samples of an input."""
    if each.usual is not None and each.channel not in recording.values:
        return np.full(len(recording.time), each.usual)
    values = recording[each.channel]
    return ramp_shortfall(values, recording.time, each.ramp) if each.ramp_of else values


def ramp_shortfall(values: Array, time: Array, ramp: float) -> Array:
    """Output minus input of a rate limiter (`ramp` per second) for held `values` (n,), as a mean over each sample.

    It is 0 at samples whose value is unknown; the limiter restarts after them.
    """
    limiter = RampLimiter(ramp, float(values[0]))
    spacing = np.append(np.diff(time), np.median(np.diff(time)))
    steps = [limiter.step(target, span) for target, span in zip(values.tolist(), spacing.tolist(), strict=True)]
    return np.array(steps, dtype=np.float64)


def _columns(columns: Sequence[Array], part: slice) -> Array:
    if not columns:
        return np.zeros((part.stop - part.start, 0))
    return np.ascontiguousarray(np.stack([column[part] for column in columns], axis=1))
