"""A load that an experiment asks for: announced, carried by the virtual vehicle, a part of the recording's model."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncGenerator
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from closed_loop import ClosedLoop
from pydantic import ValidationError

from upright.diagnosis.prediction.compare import Comparison, compare
from upright.service.control.clients.api import ExitCode, Message, result
from upright.service.control.clients.server import ApiServer
from upright.service.observer.live.online_estimators import LOADED, estimators_of
from upright.service.virtual.passenger import Passenger
from upright.service.virtual.run import record
from upright.simulation.physics.load import Load, LoadTorque
from upright.telemetry.errors import RecordingError
from upright.telemetry.recording import Recording
from upright.vehicles import registry
from upright.vehicles.experiment.load import asked_for, load_of, refuse_loads, with_load, without_load
from upright.vehicles.experiment.phases import Phase
from upright.vehicles.file import load
from upright.vehicles.sections import ExperimentSection

VEHICLE = load("monocab")
ASKED = VEHICLE.experiments["side_load"].load
TRUE = {"inertia": 1650.0, "gravity_stiffness": 14500.0, "static_torque.torque": 0.0}
"""Of the virtual vehicle."""


@cache
def side_load(*hide: str) -> Recording:
    return record("monocab", "side_load", hide=hide, seed=5)


@cache
def compared(*hide: str) -> dict[str, Comparison]:
    """The true model, without and with viscous friction, with the load."""
    recording = side_load(*hide)
    nominal = registry.nominal_model("monocab")
    true = nominal.change(TRUE)
    models = {"true": true}
    if hide:
        models["drag"] = true.add("viscous_friction").change({"viscous_friction.coefficient": 400.0})
    found = compare(
        {name: with_load(model, recording) for name, model in models.items()},
        [recording],
        support=VEHICLE.support,
        loops=[registry.recorded_loop(VEHICLE, recording)],
    )
    return {each.name: each for each in found}


class TestAnnouncement:
    def test_load_is_asked_for_at_its_time_and_until_the_end(self) -> None:
        assert ASKED is not None
        closed = ClosedLoop()
        closed.loop.start_experiment("side_load")
        closed.until(lambda: closed.loop.state()["phase"] == "excite", 30.0)
        closed.advance(ASKED.after - 0.2)
        assert closed.loop.state()["load"] is None
        closed.advance(0.3)
        assert closed.loop.state()["load"] == ASKED.model_dump(include={"torque", "ramp", "announcement"})
        assert ("info", "load", ASKED.announcement) in closed.witness.events
        closed.until(lambda: closed.loop.run is None, 90.0)
        assert closed.loop.state()["load"] is None
        assert sum(code == "load" for _, code, _ in closed.witness.events) == 1

    def test_experiment_that_ends_before_its_load_does_not_ask_for_it(self) -> None:
        closed = ClosedLoop()
        closed.loop.start_experiment("side_load")
        closed.until(lambda: closed.loop.state()["phase"] == "excite", 30.0)
        closed.loop.end_experiment("enough")
        closed.until(lambda: closed.loop.run is None, 60.0)
        assert not [code for _, code, _ in closed.witness.events if code == "load"]

    async def test_person_beside_a_virtual_vehicle_does_what_the_daemon_asks_for(self, tmp_path: Path) -> None:
        asked: Message | None = {"torque": 550.0, "ramp": 1.0, "announcement": "sit down"}

        async def answer(request: Message) -> AsyncGenerator[Message]:
            assert request["verb"] == "status"
            yield result(ExitCode.DONE, status={"load": asked})

        path = tmp_path / "s.sock"
        person = Passenger([path])
        await asyncio.to_thread(person.look)  # there is no daemon yet
        assert person() is None
        server = ApiServer(path, answer)
        await server.start()
        await asyncio.to_thread(person.look)
        assert person() == Load(550.0, 1.0)
        asked = None
        await asyncio.to_thread(person.look)
        assert person() is None
        await server.close()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"torque": 0.0}, "0 N m is no load"),
        ({"ramp": 0.0}, "greater than 0"),
        ({"after": 29.5}, "the load is on 30.5 s after the start, but the duration is 30 s"),
    ],
)
def test_impossible_load_is_refused(change: dict[str, float], message: str) -> None:
    table = VEHICLE.experiments["side_load"].model_dump()
    with pytest.raises(ValidationError, match=message):
        ExperimentSection.model_validate({**table, "load": {**table["load"], **change}})


def test_virtual_load_comes_and_goes_as_a_ramp() -> None:
    subject = LoadTorque(1e-3, 1650.0)
    assert [subject.torque(0.0, 0.0) for _ in range(3)] == [0.0] * 3
    subject.carry(Load(-40.0, 0.1))
    rising = [subject.torque(0.0, 0.0) for _ in range(150)]
    np.testing.assert_allclose(rising, np.maximum(-0.4 * np.arange(1, 151), -40.0), atol=1e-9)
    subject.carry(None)
    falling = [subject.torque(0.0, 0.0) for _ in range(150)]
    np.testing.assert_allclose(falling, np.minimum(-40.0 + 0.4 * np.arange(1, 151), 0.0), atol=1e-9)


def test_load_is_no_live_finding() -> None:
    """The observer has the experiment's definition in the metadata of the recording that it starts."""
    assert asked_for(side_load().metadata) == ASKED
    bank = estimators_of(VEHICLE)
    bank.of_recording(side_load().metadata)
    assert bank.diagnosis() == {
        "adequate": False, "verdict": "insufficient_data", "reason": LOADED, "findings": [],
    }  # fmt: skip


class TestModel:
    def test_it_is_as_announced_until_it_is_fitted(self) -> None:
        assert ASKED is not None
        recording = side_load()
        nominal = registry.nominal_model("monocab")
        model = with_load(nominal, recording)
        begins = recording.time[np.argmax(recording["phase"] == Phase.EXCITE)] + ASKED.after
        values = model.values
        assert (values["load.torque"], values["load.rise"]) == (ASKED.torque, ASKED.ramp)
        assert values["load.start"] == pytest.approx(begins)
        assert {"load.torque", "load.start", "load.rise", "inertia"} <= {
            p.name for p in model.parameters if p.estimated
        }
        assert with_load(model, recording) is model
        assert without_load(model) == nominal

    def test_recordings_without_one_leave_the_model_as_it_is(self) -> None:
        nominal, recording = registry.nominal_model("monocab"), side_load()
        late = recording.between(recording.time[np.argmax(recording["phase"] == Phase.EXCITE)] + 1.0, np.inf)
        other = replace(recording, metadata={**recording.metadata, "experiment_definition": "not JSON"})
        definition = json.loads(recording.metadata["experiment_definition"])
        strange = {**definition, "load": {"torque": "heavy"}}
        odd = replace(recording, metadata={**recording.metadata, "experiment_definition": json.dumps(strange)})
        for each in (late, other, odd, replace(recording, metadata={})):
            assert with_load(nominal, each) is nominal
        assert [load_of(each) for each in (other, odd)] == [None, None]

    def test_parameters_are_not_fitted_to_a_recording_with_a_load(self) -> None:
        with pytest.raises(RecordingError, match="a person put a load on the vehicle") as caught:
            refuse_loads([side_load()])
        assert "without a load" in caught.value.remedy


class TestFigure4:
    """Measured and simulated in the closed loop of the full controller."""

    def test_load_is_identified(self) -> None:
        events = compared()["true"].events
        assert events["load.torque"] == pytest.approx(550.0, rel=0.01)
        assert events["load.rise"] == pytest.approx(1.0, rel=0.05)
        begins = side_load().time[np.argmax(side_load()["phase"] == Phase.EXCITE)] + 5.0
        assert events["load.start"] == pytest.approx(begins, abs=0.02)

    def test_simulated_curves_are_within_the_noise_of_the_measured_ones(self) -> None:
        loop = compared()["true"].closed_loop
        assert list(loop.measured) == ["roll", "precession", "trim_position"]
        for channel in loop.measured:
            assert loop.over_floor(channel) < 1.0
        roll, precession, trim = (loop.simulated[each] for each in loop.simulated)
        assert np.degrees(np.max(np.abs(roll))) < 0.051
        assert np.degrees(np.max(np.abs(precession))) < 15.0
        assert abs(np.degrees(precession[-1])) < 0.1
        assert np.min(trim) < 1.3 * trim[-1]

    def test_hidden_friction_is_seen_and_gone_once_the_model_has_it(self) -> None:
        found = compared("viscous_friction")
        assert not found["true"].adequate
        assert found["drag"].adequate
        for channel in ("precession", "trim_position"):
            assert found["drag"].closed_loop.over_floor(channel) < 1.0
            assert found["true"].closed_loop.over_floor(channel) > 2.5 * found["drag"].closed_loop.over_floor(channel)
