"""Runs the fault table: one prepared vehicle for each situation, and one forked process for each fault."""

from __future__ import annotations

import os
import pickle
import select
import tempfile
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from flywheels import with_flywheels

from faults.bench import Bench
from faults.fault import EXPERIMENTS, MEASURED_FLYWHEELS, SIDE_LOAD, Fault, When, harmless
from faults.outcome import Outcome, Situation, run
from faults.verdict import verdict
from upright.vehicles.experiment.phases import Phase
from upright.vehicles.file import VehicleFile, load

T = TypeVar("T")

DURATION = 6.0
"""s of excitation: enough for the slowest fault to be known, and for a run that goes on to lower the vehicle."""
SITS_DOWN, LONGER = 2.0, 10.0
"""s of excitation at which a person sits down, and how long that experiment is."""
AFTER = {When.REST: 2.0, When.ENABLE: 0.02, When.RISE: 0.15, When.SETTLE: 1.0, When.EXCITE: 1.0, When.LOWER: 0.2}
"""s from the beginning of a phase until the fault; the IMU's filter and the recording need 0.5 s at rest."""
BRAKING = 0.05
"""s from the stop until the fault in the aftermath."""
FREE_FALL = {"monocab": 12.0, MEASURED_FLYWHEELS: 12.0, "twsbr": 0.0, "cube": 0.0}
"""deg/s, the impact with control switched off while the vehicle is upright, where the issue states it. Elsewhere, and
where it is harder because the vehicle moved before, it is measured."""
MOVED_ON = 0.1
"""s later, and the vehicle moves otherwise: control is switched off at the injection, and after the detection."""
TOLERANCE = {"monocab": 1.02, MEASURED_FLYWHEELS: 1.02, "twsbr": 1.05, "cube": 1.05}
"""The impact is read once in a cycle, in which a vehicle on its way down gains this share of its rate."""


@dataclass(frozen=True, slots=True)
class Result:
    """What became of a fault, and what is wrong with that; `impact` is the one with control switched off, deg/s."""

    outcome: Outcome
    impact: float
    wrong: list[str]


@dataclass(frozen=True, slots=True)
class Trial:
    """One fault on a prepared bench; `usual` is the hardest impact without it: control switched off, or lowered."""

    fault: Fault
    situation: Situation
    bench: Bench
    usual: float

    def __call__(self) -> Result:
        impact = self.usual
        if self.fault.pushes:
            impact = max(impact, _switched_off(self.bench, self.situation, self.fault.inject))
        outcome = run(self.bench, self.fault, self.situation)
        return Result(outcome, impact, verdict(self.fault, outcome, impact))


def shortened(vehicle: VehicleFile) -> VehicleFile:
    """The vehicle file with experiments of the campaign's duration."""
    experiments = dict(vehicle.experiments)
    for name in EXPERIMENTS:
        frequency = experiments[name].frequency
        faster = {} if frequency is None else {"frequency": max(frequency, 0.5)}
        experiments[name] = experiments[name].model_copy(update={"duration": DURATION, **faster})
    if SIDE_LOAD in experiments:
        section = experiments[SIDE_LOAD]
        person = section.load.model_copy(update={"after": SITS_DOWN}) if section.load is not None else None
        experiments[SIDE_LOAD] = section.model_copy(update={"duration": LONGER, "load": person})
    return vehicle.model_copy(update={"experiments": experiments})


def vehicle_of(kind: str) -> VehicleFile:
    """The file of one of VEHICLES."""
    if kind != MEASURED_FLYWHEELS:
        return load(kind)
    with tempfile.TemporaryDirectory() as folder:
        return with_flywheels(Path(folder))


def situations(kind: str, experiment: str, whens: Sequence[When]) -> Iterator[tuple[Situation, Bench]]:
    """The vehicle in each of these situations, in order; the caller must not advance it."""
    bench = Bench(shortened(vehicle_of(kind)))
    interlocks = bench.loop.interlocks()
    if interlocks:
        raise RuntimeError(f"{kind} cannot run: {' '.join(interlocks)}")
    experiment_run = bench.loop.start_experiment(experiment)
    bench.watching = True
    for when in sorted(set(whens) - {When.AFTERMATH}, key=list(When).index):
        _reach(bench, Phase[when.name])
        bench.advance(AFTER[when])
        yield Situation(kind, experiment, when), bench
    if When.AFTERMATH in whens:
        if experiment_run.phase > Phase.EXCITE:
            _, bench = next(situations(kind, experiment, [When.EXCITE]))
        else:
            _reach(bench, Phase.EXCITE)
        bench.loop.stop_now("stopped by the campaign")
        bench.advance(BRAKING)
        yield Situation(kind, experiment, When.AFTERMATH), bench


def _reach(bench: Bench, phase: Phase) -> None:
    """Advance to the first cycle of a phase."""
    while (run := bench.loop.run) is not None and run.phase is not phase:
        bench.advance(bench.vehicle.period)
    if run is None:
        raise RuntimeError(f"the run ended before {phase.name}: {bench.loop.reason}")


def campaign(
    kind: str, experiment: str, whens: Sequence[When], faults: Sequence[Fault], processes: int
) -> Iterator[Result]:
    """The results for this vehicle and experiment, as they come in."""
    for situation, bench in situations(kind, experiment, whens):
        chosen = [fault for fault in faults if kind in fault.kinds and situation.when in fault.when]
        usual = max(_switched_off(bench, situation, lambda bench: None), _lowered(bench, situation))

        yield from in_processes([Trial(fault, situation, bench, usual) for fault in chosen], processes)


def _switched_off(bench: Bench, situation: Situation, inject: Callable[[Bench], None]) -> float:
    """The hardest impact of this vehicle when control is switched off now, or a little later, deg/s."""

    def fall(delay: float) -> Outcome:
        def off(bench: Bench) -> None:
            inject(bench)
            bench.advance(delay)
            bench.loop.stop_now("control switched off")

        return run(bench, harmless("switched_off", "control is switched off", off), situation)

    outcomes = in_processes([lambda: fall(0.0), lambda: fall(MOVED_ON)], 1)
    hardest = max(outcome.impact for outcome in outcomes)
    return round(max(FREE_FALL[situation.kind], TOLERANCE[situation.kind] * hardest), 1)


def _lowered(bench: Bench, situation: Situation) -> float:
    """The impact of a run without a fault, deg/s: a robot is not lowered, but tipped over."""
    healthy = harmless("healthy", "nothing happens", lambda bench: None)
    (outcome,) = in_processes([lambda: run(bench, healthy, situation)], 1)
    return round(TOLERANCE[situation.kind] * outcome.impact, 1)


def in_processes(tasks: Sequence[Callable[[], T]], processes: int) -> Iterator[T]:
    """What each task returns, each computed in a fork of this process, at most `processes` at a time."""
    waiting = list(tasks)
    running: dict[int, tuple[int, bytearray]] = {}
    while waiting or running:
        while waiting and len(running) < processes:
            reading, writing = os.pipe()
            child = os.fork()
            if child == 0:
                os.close(reading)
                _answer(waiting[0], writing)
            waiting.pop(0)
            os.close(writing)
            running[reading] = (child, bytearray())
        for reading in select.select(list(running), [], [])[0]:
            child, data = running[reading]
            if part := os.read(reading, 1 << 16):
                data += part
                continue
            del running[reading]
            os.close(reading)
            os.waitpid(child, 0)
            if not data:
                raise RuntimeError("a process of the campaign has ended without a result; see above")
            yield pickle.loads(data)


def _answer(task: Callable[[], object], writing: int) -> None:
    """In the child: send the result, and end without what the parent has yet to do."""
    try:
        with os.fdopen(writing, "wb") as file:
            file.write(pickle.dumps(task()))
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(0)
