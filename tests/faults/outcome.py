"""What became of a fault, measured from the truth: the plant, its drives and what was recorded."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import degrees

from faults.bench import Bench, Moment, moving
from faults.fault import End, Fault, When
from upright.service.control.cycle.operation import Mode
from upright.vehicles.experiment.phases import UPRIGHT, Phase

AFTER = 3.0
"""s that are watched after the end: a quick stop takes 1 s, the recording goes on for 2 s."""
LONGEST = 65.0
"""s after which a run that has not ended never does: with every phase as long as its time-out it takes 61 s."""
LYING = 0.95
"""Share of the support's angle beyond which the vehicle lies on it."""
AWAY = 0.9
"""Share of the support's angle below which the vehicle has left it."""
CONTACT = 0.98
"""Share of the support's angle at which an impact begins."""
STEP = 0.02
"""s between two looks at whether the run has ended."""


@dataclass(frozen=True, slots=True)
class Situation:
    """Where a fault meets a vehicle."""

    kind: str
    experiment: str
    when: When

    def __str__(self) -> str:
        return f"{self.kind}, {self.experiment}, {self.when}"


@dataclass(frozen=True, slots=True)
class Outcome:
    """Times in ms from the injection, None for what did not happen; angles in deg.

    `known` is when the fault could be known, `detected` when the daemon did something about it or reported it,
    `ended` when the run was over, `off` when the last power stage was. `fell` is when the vehicle lay on a support
    while it was to be upright; `rose`: it was off its supports at some time. `impact` is the hardest on a support,
    deg/s. `still_on` and `still_moving` name drives three seconds after the end. `missing` is what the recording lacks
    before the end, s; None: it was not closed.
    """

    fault: str
    situation: Situation
    end: End
    code: str
    reason: str
    known: float | None
    detected: float | None
    ended: float | None
    off: float | None
    fell: float | None
    rose: bool
    peak: float
    impact: float
    still_on: tuple[str, ...]
    still_moving: tuple[str, ...]
    missing: float | None
    exceptions: tuple[str, ...]
    interlocks: tuple[str, ...]

    @property
    def delay(self) -> float | None:
        """ms from when the fault could be known until it was detected."""
        return None if self.detected is None else max(0.0, self.detected - (self.known or 0.0))


def run(bench: Bench, fault: Fault, situation: Situation) -> Outcome:
    """Inject the fault now, and watch the vehicle until `AFTER` s after the end of its run."""
    begin, events = bench.truth.time, bench.trace[-1].events
    knowable: list[float] = []
    fault.inject(bench)
    if fault.since is None:
        knowable.append(begin)
    else:
        _note_when(fault.since(bench), knowable, bench)
    over_at = begin if bench.loop.mode is not Mode.RUNNING else None
    while over_at is None and bench.truth.time - begin < LONGEST:
        bench.advance(STEP)
        if bench.loop.mode is not Mode.RUNNING:
            over_at = bench.truth.time
    end, code, reason = _end(bench)
    bench.advance(AFTER)
    trace = [moment for moment in bench.trace if moment.time >= begin]
    still_on, still_moving = trace[-1].powered, tuple(n for n, drive in bench.drives.items() if moving(drive))
    missing = _missing(bench, over_at)
    interlocks: list[str] = []
    if fault.locks:
        bench.reset()
        interlocks = bench.loop.interlocks()

    def since(time: float | None) -> float | None:
        return None if time is None else round((time - begin) * 1e3, 1)

    detected = next((moment.time for moment in trace if _noticed(moment, events)), None)
    if detected is None and end is End.IN_ORDER:
        detected = over_at
    known = next(iter(knowable), None)
    if known is not None and situation.when in (When.REST, When.ENABLE):
        # On its support the vehicle is safe: the fault has to be known before it rises.
        rises = next((moment.time for moment in trace if moment.phase is Phase.RISE), detected)
        known = max(known, rises or known)
    off = next((later.time for later, now in zip(trace[::-1], trace[-2::-1], strict=False) if now.powered), begin)
    upright = (moment for moment in trace if moment.phase in UPRIGHT and moment.mode is Mode.RUNNING)
    return Outcome(
        fault=fault.name,
        situation=situation,
        end=end,
        code=code,
        reason=reason,
        known=since(known),
        detected=since(detected),
        ended=since(next((moment.time for moment in trace if moment.mode is not Mode.RUNNING), None)),
        off=None if still_on else since(off),
        fell=since(next((moment.time for moment in upright if abs(moment.angle) > LYING * bench.support), None)),
        rose=any(abs(moment.angle) < AWAY * bench.support for moment in trace),
        peak=round(degrees(max(abs(moment.angle) for moment in trace)), 2),
        impact=round(degrees(_impact(trace, bench.support)), 1),
        still_on=still_on,
        still_moving=still_moving,
        missing=missing,
        exceptions=tuple(dict.fromkeys(bench.exceptions)),
        interlocks=tuple(interlocks),
    )


def _note_when(test: Callable[[], bool], knowable: list[float], bench: Bench) -> None:
    def look() -> None:
        if not knowable and test():
            knowable.append(bench.truth.time)

    bench.each_cycle.append(look)


def _noticed(moment: Moment, events: int) -> bool:
    return moment.mode is Mode.FAULT or bool(moment.ending) or moment.events > events


def _end(bench: Bench) -> tuple[End, str, str]:
    loop = bench.loop
    if loop.mode is Mode.RUNNING:
        return End.NEVER, "", loop.reason
    if loop.mode is Mode.FAULT:
        return End.STOPPED, loop.code, loop.reason
    if loop.code == "done":
        return (End.IN_ORDER if loop.reason else End.HARMLESS), loop.code, loop.reason
    return End.IN_ORDER, loop.code, loop.reason


def _missing(bench: Bench, over_at: float | None) -> float | None:
    """How much earlier the recorded frames end than the run, s; an IMU that is silent leaves nothing to record."""
    witness = bench.witness
    if over_at is None or len(witness.ended) < len(witness.recordings):
        return None
    last = next(
        (
            later.time
            for later, now in zip(bench.trace[::-1], bench.trace[-2::-1], strict=False)
            if later.frames > now.frames
        ),
        0.0,
    )
    return round(max(0.0, over_at - last), 3)


def _impact(trace: list[Moment], support: float) -> float:
    """The largest rate at which the vehicle, once off its supports, came onto one, rad/s."""
    hardest, away, rate = 0.0, False, 0.0
    for moment in trace:
        lying = abs(moment.angle) >= CONTACT * support
        if lying and away:
            hardest = max(hardest, rate, abs(moment.rate))
            away = False
        away = away or abs(moment.angle) < AWAY * support
        rate = abs(moment.rate)
    return hardest
