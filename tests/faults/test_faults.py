"""The short form of the fault campaign: the MONOCAB, while it excites, each fault once.

The campaign runs in a process of its own, since it forks; each test waits for the outcome of its fault.
"""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from faults import clues
from faults.bench import Bench
from faults.campaign import situations
from faults.fault import EXPERIMENTS, KINDS, MEASURED_FLYWHEELS, VEHICLES, End, Fault, When, harmless, stopped
from faults.outcome import Outcome, Situation
from faults.scenarios import FAULTS
from faults.shortfalls import SHORTFALLS
from faults.table import parsed
from faults.verdict import verdict

MONOCABS = ("monocab", MEASURED_FLYWHEELS)
TESTS = Path(__file__).resolve().parents[1]
SHORT = [fault for fault in FAULTS if {*MONOCABS} & {*fault.kinds} and When.EXCITE in fault.when]


class Campaign:
    """A campaign that runs beside the tests: what is wrong with each outcome, as it becomes known."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process
        self._wrong: dict[str, list[str]] = {}

    def wrong(self, name: str) -> list[str]:
        assert self._process.stdout is not None
        while name not in self._wrong:
            line = self._process.stdout.readline()
            assert line, f"the campaign ended without {name}"
            outcome = json.loads(line)
            self._wrong[outcome["fault"]] = outcome["wrong"]
        return self._wrong[name]


@pytest.fixture(scope="module")
def campaign() -> Iterator[Campaign]:
    path = os.pathsep.join([str(TESTS), *[each for each in sys.path if each]])
    command = [sys.executable, "-m", "faults.table", "--json", "--once"]
    command += ["--phase", "excite", "--processes", "1"]
    command += [word for each in MONOCABS for word in ("--vehicle", each)]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": path}
    ) as process:
        yield Campaign(process)
        process.kill()


def _expected(fault: Fault) -> object:
    reason = SHORTFALLS.get(fault.name)
    marks = [pytest.mark.xfail(reason=reason, strict=True)] if reason else []
    return pytest.param(fault, id=fault.name, marks=marks)


@pytest.mark.patient
@pytest.mark.timeout(300)
@pytest.mark.parametrize("fault", [_expected(fault) for fault in SHORT])
def test_fault_ends_as_expected(campaign: Campaign, fault: Fault) -> None:
    assert campaign.wrong(fault.name) == []


def test_every_shortfall_is_that_of_a_fault() -> None:
    assert set(SHORTFALLS) <= {fault.name for fault in SHORT}


def test_table_has_each_fault_once_and_says_what_it_expects() -> None:
    names = [fault.name for fault in FAULTS]
    assert len(names) == len(set(names))
    for fault in FAULTS:
        assert fault.what
        assert set(fault.kinds) <= set(VEHICLES)
        assert fault.codes or End.STOPPED not in fault.ends, f"{fault.name} may be stopped for any reason"
        assert fault.why or fault.since is None, f"{fault.name} does not say why its time begins later"
        assert fault.within is not None or End.HARMLESS in fault.ends, f"{fault.name} need never be detected"


@pytest.mark.parametrize("kind", KINDS)
def test_nothing_is_known_of_a_healthy_vehicle(kind: str) -> None:
    """The clues by which a fault is known say nothing without one, while the vehicle is excited."""
    _, bench = next(situations(kind, EXPERIMENTS[0], [When.EXCITE]))
    known = {clue.__name__: clue(bench) for clue in (clues.not_followed, clues.axis_lies, clues.gyro_lies)}
    if bench.of_role("trim"):
        known["trim_not_followed"] = clues.trim_not_followed(bench)
    said: set[str] = set()
    bench.each_cycle.append(lambda: said.update(name for name, test in known.items() if test()))
    bench.advance(3.0)
    assert bench.loop.run is not None
    assert said == set()


def nothing(bench: Bench) -> None:
    pass


STOPPED = stopped("stopped", "stops", nothing, "imu_silent", locks="product")
HARMLESS = harmless("harmless", "goes on", nothing)
AS_STOPPED = Outcome(
    fault="stopped",
    situation=Situation("monocab", "hold", When.EXCITE),
    end=End.STOPPED,
    code="imu_silent",
    reason="no IMU",
    known=0.0,
    detected=20.0,
    ended=20.0,
    off=100.0,
    fell=None,
    rose=True,
    peak=4.2,
    impact=11.9,
    still_on=(),
    still_moving=(),
    missing=0.0,
    exceptions=(),
    interlocks=("another product",),
)
AS_HARMLESS = dataclasses.replace(AS_STOPPED, end=End.HARMLESS, code="done", reason="", detected=None, impact=4.0)


@pytest.mark.parametrize(("fault", "outcome"), [(STOPPED, AS_STOPPED), (HARMLESS, AS_HARMLESS)])
def test_nothing_is_wrong_with_what_was_expected(fault: Fault, outcome: Outcome) -> None:
    assert verdict(fault, outcome, 12.0) == []


@pytest.mark.parametrize(
    ("fault", "outcome", "changes", "words"),
    [
        (STOPPED, AS_STOPPED, {"still_on": ("trim",), "off": None}, "still under power after the end: trim"),
        (STOPPED, AS_STOPPED, {"still_moving": ("trim",)}, "still moving after the end: trim"),
        (STOPPED, AS_STOPPED, {"code": "roll"}, "wrong reason: roll"),
        (STOPPED, AS_STOPPED, {"detected": 101.0}, "detected after 101 ms"),
        (STOPPED, AS_STOPPED, {"detected": 171.0, "known": 70.0}, "detected after 101 ms"),
        (STOPPED, AS_STOPPED, {"impact": 12.1}, "hit the support at 12.1 deg/s"),
        (STOPPED, AS_STOPPED, {"off": 1620.0}, "drives off 1.6 s after the stop"),
        (STOPPED, AS_STOPPED, {"missing": None}, "the recording was not closed"),
        (STOPPED, AS_STOPPED, {"missing": 1.2}, "the recording lacks its last 1.2 s"),
        (STOPPED, AS_STOPPED, {"interlocks": ()}, "is not refused"),
        (STOPPED, AS_STOPPED, {"exceptions": ("KeyError: 1",)}, "an exception in the loop"),
        (STOPPED, AS_STOPPED, {"end": End.HARMLESS, "code": "done"}, "expected: stopped"),
        (STOPPED, AS_STOPPED, {"end": End.NEVER, "detected": None}, "not detected"),
        (HARMLESS, AS_HARMLESS, {"fell": 900.0}, "lay on a support after 900 ms and ended as done"),
        (HARMLESS, AS_STOPPED, {}, "expected: harmless"),
    ],
)
def test_what_is_wrong_is_said(fault: Fault, outcome: Outcome, changes: dict[str, object], words: str) -> None:
    wrong = verdict(fault, dataclasses.replace(outcome, **changes), 12.0)  # type: ignore[arg-type]
    assert any(words in each for each in wrong), wrong


@pytest.mark.parametrize("rose", [False, True])
def test_on_its_support_a_fault_may_end_the_run_either_way(rose: bool) -> None:
    situation = Situation("monocab", "hold", When.REST)
    outcome = dataclasses.replace(
        AS_STOPPED, situation=situation, end=End.IN_ORDER, code="done", reason="no IMU", rose=rose
    )
    assert bool(verdict(STOPPED, outcome, 12.0)) == rose


def test_command_knows_vehicles_phases_and_faults() -> None:
    chosen = parsed(["--vehicle", "cube", "--phase", "rise", "--only", "imu_silent", "--markdown"])
    assert (chosen.vehicle, chosen.phase, chosen.only, chosen.markdown) == (
        ["cube"],
        [When.RISE],
        ["imu_silent"],
        True,
    )
    assert chosen.processes == 2
