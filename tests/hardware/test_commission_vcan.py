"""The commissioning of a virtual MONOCAB in real time on SocketCAN, from drives switched off to the report.

Limits that only a machine with a processor of its own keeps are skipped with that reason: this one pauses for some
milliseconds several times a second.
"""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import rig as shared
from rig import Rig

from upright.models.file.model_file import load_model
from upright.service.commission.guide import Guide
from upright.service.observer.live.online_estimators import estimators_of
from upright.vehicles.commissioning import Entry, State, is_within, steps_of
from upright.vehicles.file import load

pytestmark = [pytest.mark.vcan, pytest.mark.timeout(1500)]

SHORTER = {
    "rest": 5.0,
    "tilt": 9.0,
    "drives": 8.0,
    "hold": 8.0,
    "trim": 20.0,
    "sweep": 30.0,
    "side_load": 22.0,
    "full_sweep": 30.0,
}
"""s, of experiments that are longer than is needed to show that they run in real time."""
PAUSED = "no complete IMU frame set"
"""The daemon's reason if such a machine paused for more than 200 ms."""


SHAKEN = ("--hide", "disturbance=8,0.3")
HIDDEN = ("", "coulomb_friction", "viscous_friction", "input_delay")


@contextmanager
def commissioned(folder: Path, *simulate: str) -> Iterator[Rig]:
    """A virtual MONOCAB on SocketCAN, whose experiments are SHORTER."""
    vehicle = load("monocab")
    estimators_of(vehicle).join()
    text = Path(vehicle.path).read_text()
    for name, duration in SHORTER.items():
        text = re.sub(rf"(\[experiments\.{name}\][^\[]*?\nduration = )[\d.]+", rf"\g<1>{duration}", text, count=1)
    # The drives of the rig wait longer for their master, so that the silence has to be longer, too.
    text = text.replace("width = 0.5  ", "width = 1.2  ")
    with shared.rig(folder, text, *simulate) as made:
        yield made


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    with commissioned(tmp_path) as made:
        yield made


def number(entry: Entry, name: str) -> float:
    value = entry.numbers[name].value
    assert value is not None, (entry.step, name, entry.text)
    return value


def carried_out(rig: Rig, last: str) -> dict[str, Entry]:
    """What became of each step up to `last`. One that cannot be carried out ends it."""
    vehicle = load(str(rig.data / "patient.toml"))
    guide = Guide(vehicle, [rig.socket], lambda messages: list(messages)[-1])
    guide.begin()
    found: dict[str, Entry] = {}
    while last not in found and (step := guide.steps.next(guide.record())) is not None:
        began = time.monotonic()
        entry = found[step.id] = guide.carry_out(step.id)
        for _ in range(3):
            if entry.state is State.FAILED and PAUSED in entry.reason:
                rig.ask("reset")
                rig.until_ready()
                entry = found[step.id] = guide.carry_out(step.id)
        print(f"{step.id}: {entry.state.value} after {time.monotonic() - began:.0f} s {entry.reason}", flush=True)
        if entry.state is State.FAILED:
            return found
        if entry.state is State.NOT_ACCEPTED:
            # Frames that come late make numbers wrong that are right on a real bus.
            wrong = [each.title for each in step.acceptance if not is_within(each, entry.numbers)]
            guide.skip(step.id, f"this virtual machine shares its processor with others: {', '.join(wrong)}")
    guide.save_report()
    return found


def test_the_whole_way_ends_with_a_controller_that_holds_a_person(rig: Rig) -> None:
    entries = carried_out(rig, "response")
    last = list(entries.values())[-1]
    assert last.step == "response", (last.step, last.reason)
    report = (rig.data / "commissioning" / "report.html").read_text()
    assert "The commissioning is complete" in report
    assert "signature" in report
    assert number(entries["bus"], "drives_missing") == 0.0
    assert number(entries["imu"], "gravity") == pytest.approx(9.81, abs=0.01)
    assert number(entries["tilt"], "gyro_scale") == pytest.approx(1.0, abs=0.05)
    assert number(entries["silence"], "drives_not_reacting") == 0.0
    assert number(entries["drives"], "moved") < 0.3
    for name, true in (("inertia", 1650.0), ("gravity_stiffness", 14500.0)):
        assert number(entries["identify"], name) == pytest.approx(true, rel=0.01)
    assert number(entries["trim"], "trim_effect") == pytest.approx(1.0, abs=0.06)
    assert number(entries["disturbance"], "largest_roll") < 0.1
    assert number(entries["disturbance"], "final_precession") == pytest.approx(0.0, abs=0.5)
    # The loop as recorded was reconstructed and simulated. How close the two are, benchmarks/commissioning.py measures
    # where a control cycle takes as long as on a vehicle.
    assert number(entries["prediction"], "loop_error") > 0.0


@pytest.mark.thorough
@pytest.mark.parametrize("hidden", HIDDEN)
def test_a_shaken_vehicle_is_commissioned_and_what_it_hides_is_found(hidden: str, tmp_path: Path) -> None:
    """Shaken by 8 N m RMS, with a hidden effect that the model file of the commissioning has in the end."""
    with commissioned(tmp_path, *SHAKEN, *(("--hide", hidden) if hidden else ())) as rig:
        entries = carried_out(rig, "response")
    last = list(entries.values())[-1]
    assert last.step == "response", (last.step, last.reason)
    assert "The commissioning is complete" in (rig.data / "commissioning" / "report.html").read_text()
    model = entries["effects"].model
    names = [each.name for each in load_model(rig.data / "commissioning" / model).effects] if model else []
    assert names == ([hidden] if hidden else []), entries["effects"].text
    assert number(entries["disturbance"], "final_precession") == pytest.approx(0.0, abs=2.0)
    (response,) = (each for each in steps_of("monocab").step if each.id == "response")
    measured = [each for each in response.acceptance if each.quantity in ("gain_off", "phase_off")]
    assert len(measured) == 2
    for each in measured:
        assert is_within(each, entries["response"].numbers), (each.quantity, entries["response"].text)
