"""What is wrong with an outcome, in words; an empty list is as expected."""

from __future__ import annotations

from faults.fault import End, Fault, When
from faults.outcome import Outcome

SAFE = 1.5
"""s from the stop to the last power stage: 1 s of quick stop, and the drives' own time-outs of 0.12 s before it."""
WHOLE = 1.0
"""s that a recording may lack at its end."""


def verdict(fault: Fault, outcome: Outcome, impact: float) -> list[str]:
    """What differs from the expectation; `impact` (deg/s) is the hardest impact that is as with control off."""
    return [
        *_unsafe(outcome),
        *_wrong_end(fault, outcome),
        *_late(fault, outcome),
        *_hard(outcome, impact),
        *_lost(fault, outcome),
    ]


def _unsafe(outcome: Outcome) -> list[str]:
    found = [f"an exception in the loop: {each}" for each in outcome.exceptions]
    if outcome.still_on:
        found.append(f"still under power after the end: {', '.join(outcome.still_on)}")
    if outcome.still_moving:
        found.append(f"still moving after the end: {', '.join(outcome.still_moving)}")
    if outcome.end in (End.HARMLESS, End.IN_ORDER) and outcome.fell is not None:
        found.append(f"lay on a support after {outcome.fell:.0f} ms and ended as {outcome.code}")
    elif outcome.end is End.NEVER:
        found.append("the run has not ended")
    return found


def _wrong_end(fault: Fault, outcome: Outcome) -> list[str]:
    ends = set(fault.ends)
    when = outcome.situation.when
    if when is When.AFTERMATH:
        return [] if outcome.code == "operator" else [f"the first reason was replaced by {outcome.code}"]
    if not outcome.rose and End.HARMLESS not in ends:
        ends |= {End.STOPPED, End.IN_ORDER}  # on the support one is as safe as the other
    if when in (When.REST, When.ENABLE) and fault.passes:
        ends.add(End.HARMLESS)
    if outcome.known is None:
        ends.add(End.HARMLESS)  # it had no consequence by which it could be known
    if outcome.end not in ends:
        return [f"{_ended(outcome)}, expected: {' or '.join(end.value for end in fault.ends)}"]
    if outcome.end is End.STOPPED and outcome.code not in fault.codes and End.STOPPED in fault.ends:
        return [f"wrong reason: {outcome.code}, expected {' or '.join(fault.codes)}"]
    if outcome.end is End.IN_ORDER and fault.says and not _says(fault, outcome):
        return [f"the reason does not mention {' or '.join(fault.says)}: {outcome.reason}"]
    return []


def _says(fault: Fault, outcome: Outcome) -> bool:
    return outcome.code in fault.codes or any(word in outcome.reason.lower() for word in fault.says)


def _ended(outcome: Outcome) -> str:
    return f"{outcome.end.value} ({outcome.code})" if outcome.code else outcome.end.value


def _late(fault: Fault, outcome: Outcome) -> list[str]:
    if fault.within is None or outcome.situation.when is When.AFTERMATH or outcome.known is None:
        return []
    if outcome.end is End.HARMLESS and fault.passes and outcome.situation.when in (When.REST, When.ENABLE):
        return []
    if outcome.delay is None:
        return ["not detected"]
    allowed = fault.within * 1e3
    return [f"detected after {outcome.delay:.0f} ms, allowed: {allowed:.0f} ms"] if outcome.delay > allowed else []


def _hard(outcome: Outcome, impact: float) -> list[str]:
    if outcome.impact <= impact:
        return []
    return [f"hit the support at {outcome.impact:.1f} deg/s, {impact:.1f} deg/s with control switched off"]


def _lost(fault: Fault, outcome: Outcome) -> list[str]:
    found = []
    if outcome.end is End.STOPPED and outcome.ended is not None and outcome.off is not None:
        late = (outcome.off - outcome.ended) * 1e-3
        if late > SAFE:
            found.append(f"drives off {late:.1f} s after the stop")
    if outcome.missing is None:
        found.append("the recording was not closed")
    elif outcome.missing > WHOLE:
        found.append(f"the recording lacks its last {outcome.missing:.1f} s")
    if fault.locks and not any(fault.locks in each for each in outcome.interlocks):
        found.append(f"after a reset the next run is not refused for its {fault.locks}")
    return found
