"""The commissioning of a virtual MONOCAB on SocketCAN, from drives switched off to the report.

It runs in a guest with a time of its own, in which computing takes none: no frame is late, as on a computer that has
nothing else to do, so that every step has to be accepted by its own limits.
"""

from __future__ import annotations

import json
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import rig as shared
from rig import Rig
from thorough import of_many

from upright.models.effects.catalogue import CATALOGUE
from upright.models.file.model_file import load_model
from upright.models.parts import Place
from upright.service.commission.guide import Guide
from upright.service.observer.live.online_estimators import estimators_of
from upright.vehicles.commissioning import Entry, State
from upright.vehicles.file import load

pytestmark = [pytest.mark.vcan, pytest.mark.own_time, pytest.mark.timeout(1500)]

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
SHAKEN = ("--hide", "disturbance=8,0.3")
HIDDEN = ("", "coulomb_friction", "viscous_friction", "input_delay")
SLOWER = {"input_delay": 7.0}
"""`effort_weight` of the full controller, as the step `full` advises: with setpoints 12 ms late and the weight as
shipped, its margins would be too small."""


@contextmanager
def commissioned(folder: Path, *simulate: str, weight: float = 1.0) -> Iterator[Rig]:
    """A virtual MONOCAB on SocketCAN, whose experiments are SHORTER, with this weight as in SLOWER."""
    vehicle = load("monocab")
    estimators_of(vehicle).join()
    text = Path(vehicle.path).read_text()
    for name, duration in SHORTER.items():
        text = re.sub(rf"(\[experiments\.{name}\][^\[]*?\nduration = )[\d.]+", rf"\g<1>{duration}", text, count=1)
    # The drives of the rig wait longer for their master, so that the silence has to be longer, too.
    text = text.replace("width = 0.5  ", "width = 1.2  ")
    with shared.rig(folder, f"{text}\n[full_controller]\neffort_weight = {weight}\n", *simulate) as made:
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
    """What became of each step up to `last`; all are accepted."""
    vehicle = load(str(rig.data / "patient.toml"))
    guide = Guide(vehicle, [rig.socket], lambda messages: list(messages)[-1])
    guide.begin()
    found: dict[str, Entry] = {}
    while last not in found and (step := guide.steps.next(guide.record())) is not None:
        began = time.monotonic()
        entry = found[step.id] = guide.carry_out(step.id)
        print(f"{step.id}: {entry.state.value} after {time.monotonic() - began:.0f} s {entry.reason}", flush=True)
        assert entry.state is State.ACCEPTED, (step.id, entry.reason, entry.text, entry.numbers)
    guide.save_report()
    return found


def test_the_whole_way_ends_with_a_controller_that_holds_a_person(rig: Rig) -> None:
    entries = carried_out(rig, "response")
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


@pytest.mark.parametrize("hidden", of_many(HIDDEN, "coulomb_friction"))
def test_a_shaken_vehicle_is_commissioned_and_what_it_hides_is_found(hidden: str, tmp_path: Path) -> None:
    """Shaken by 8 N m RMS, with a hidden effect; the last step compares the loop, octave by octave, with its model."""
    hide = ("--hide", hidden) if hidden else ()
    with commissioned(tmp_path, *SHAKEN, *hide, weight=SLOWER.get(hidden, 1.0)) as rig:
        entries = carried_out(rig, "response")
    folder, effects = rig.data / "commissioning", entries["effects"]
    assert "The commissioning is complete" in (folder / "report.html").read_text()
    (document,) = (json.loads((folder / name).read_text()) for name in effects.files if name.endswith(".json"))
    wanted = [hidden] if hidden else []
    assert [each["effect"] for each in document["findings"]] == wanted, effects.text
    assert bool(effects.model) is bool(wanted)
    if effects.model:
        model = load_model(folder / effects.model)
        of_actuators = model.actuators_model.effects if model.actuators_model is not None else ()
        of_commands = [each for each in wanted if CATALOGUE[each].place is Place.ACTUATOR]
        assert [each.name for each in of_actuators] == of_commands
        assert [each.name for each in model.effects] == [each for each in wanted if each not in of_commands]
    assert number(entries["disturbance"], "final_precession") == pytest.approx(0.0, abs=2.0)
    assert {"gain_off", "phase_off"} <= entries["response"].numbers.keys()
