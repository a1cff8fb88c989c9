"""Flywheels whose inverters report their speed: read from the bus, spun up, run down, and what follows from it."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import replace
from math import hypot, isnan, tau
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flywheels import with_flywheels

from upright.drivers.observed_speed import ObservedSpeed, SpeedConfig
from upright.service.control import assembly
from upright.service.control.cycle.operation import Mode
from upright.service.control.cycle.rows import rows_from_frames
from upright.service.offline.diagnose import diagnosed
from upright.service.offline.identify import identified
from upright.service.offline.inputs.machine import as_measured
from upright.service.virtual.run import ClosedLoop, VirtualRunError, record
from upright.simulation.bus.object_dictionary import SimulationError
from upright.simulation.config import SimulationConfig
from upright.telemetry.samples import CanFrame
from upright.vehicles import registry
from upright.vehicles.commissioning import CommissioningError, is_within, steps_for
from upright.vehicles.file import VehicleFile, VehicleFileError, load
from upright.vehicles.monocab.identification.flywheels import measured, run_down, spin_up
from upright.vehicles.monocab.model import MONOCAB_ROLL

NOMINAL = 6000.0 * tau / 60.0


def standing(configuration: SimulationConfig) -> SimulationConfig:
    return replace(configuration, flywheels_stand=True)


def slower(share: float) -> Callable[[SimulationConfig], SimulationConfig]:
    """Flywheels whose inverters keep another speed: all angular momentum is less by that share."""

    def configured(configuration: SimulationConfig) -> SimulationConfig:
        truth: Any = configuration.plant
        return replace(configuration, plant=replace(truth, angular_momentum=share * truth.angular_momentum))

    return configured


def test_a_frame_is_read_where_the_file_says_and_a_short_one_says_nothing() -> None:
    wheel = ObservedSpeed(SpeedConfig("left", 0x194, 2, "int16", -0.5))
    wheel.handle(CanFrame(7, 0x194, b"\xff\xff" + struct.pack("<h", -300)))
    assert (wheel.speed, wheel.timestamp_ns, wheel.wrong_lengths) == (150.0, 7, 0)
    wheel.handle(CanFrame(9, 0x194, b"\x01\x02\x03"))
    assert (wheel.speed, wheel.timestamp_ns, wheel.wrong_lengths) == (150.0, 7, 1)
    wheel.reset(11)
    assert isnan(wheel.speed)
    assert wheel.timestamp_ns == 11


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ("can_id = 0x194", "can_id = 0x181", "carries values"),
        ("can_id = 0x195", "can_id = 0x194", "carries the speed of flywheel_left"),
        ("start_byte = 0", "start_byte = 6", "not within 8 bytes"),
        ('name = "flywheel_right"', 'name = "flywheel_left"', "the same name"),
        ('unit = "kg m^2" } # about', 'unit = "g" } # about', "kg m"),
        ('after = 5.0\nannouncement = "Switch', 'after = 50.0\nannouncement = "Switch', "before the duration"),
    ],
)
def test_a_section_that_cannot_be_is_refused_in_words(before: str, after: str, words: str, tmp_path: Path) -> None:
    def changed(text: str) -> str:
        assert before in text
        return text.replace(before, after)

    with pytest.raises(VehicleFileError, match=words):
        with_flywheels(tmp_path, changed)


def test_an_experiment_that_watches_flywheels_needs_them(tmp_path: Path) -> None:
    def without(text: str) -> str:
        return text[: text.index("[[flywheel]]")] + text[text.index("[experiments.spin_up]") :]

    with pytest.raises(VehicleFileError, match=r"add a \[\[flywheel\]\] section"):
        with_flywheels(tmp_path, without)


def test_flywheels_are_spun_up_hold_the_vehicle_and_run_down(tmp_path: Path) -> None:
    vehicle = with_flywheels(tmp_path)
    closed = ClosedLoop(vehicle, configure=standing)
    (refusal,) = closed.loop.obstacles("hold")
    assert "turn too slowly (flywheel_left 0, flywheel_right 0 of 6000 rpm)" in refusal
    assert not closed.loop.obstacles("rest"), "on its support it may be moved and recorded"
    assert closed.loop.state()["stays_down"] == [refusal]

    closed.run("spin_up")
    up = closed.recording("spin_up")
    assert closed.plant_side.plant.speeds == pytest.approx([NOMINAL, NOMINAL], rel=1e-3)
    assert up["angular_momentum"][500] == 0.0
    found = spin_up(vehicle, [up])
    (step,) = (each for each in steps_for(vehicle).step if each.id == "spin_up")
    assert all(is_within(each, found) for each in step.acceptance), found
    assert not closed.loop.obstacles("hold")

    closed.run("hold")
    assert closed.loop.mode is Mode.DISARMED
    assert closed.loop.reason == ""

    closed.run("run_down")
    down = run_down(vehicle, [closed.recording("run_down")])
    (step,) = (each for each in steps_for(vehicle).step if each.id == "run_down")
    assert all(is_within(each, down) for each in step.acceptance), down
    true = sum(each.drag for each in closed.plant_side.plant.flywheels)  # type: ignore[attr-defined]
    assert down["drag"].value == pytest.approx(true, rel=0.01)
    assert any("too slowly" in each for each in closed.loop.obstacles("hold"))


def test_the_angular_momentum_of_a_raw_log_is_that_of_the_recording(tmp_path: Path) -> None:
    vehicle, frames = with_flywheels(tmp_path), list[CanFrame]()
    closed = ClosedLoop(vehicle, configure=standing, log=frames.append)
    closed.run("spin_up")
    recording = closed.recording("spin_up")
    (_, start_ns), io = closed.witness.recordings[-1], assembly.vehicle_io(vehicle)
    kind = registry.kind_of(vehicle, io)
    logged = [frame for frame in frames if frame.timestamp_ns >= start_ns]
    place = assembly.channels(vehicle).index_of("angular_momentum")
    again = [row.values[place] for row in rows_from_frames(logged, io, kind, assembly.roll_filter(vehicle), start_ns)]
    assert len(recording) > 10_000
    np.testing.assert_array_equal(again[: len(recording)], recording["angular_momentum"])


def test_flywheels_that_lose_their_drive_end_a_run_in_order_before_the_vehicle_falls(tmp_path: Path) -> None:
    closed = ClosedLoop(with_flywheels(tmp_path))
    closed.loop.start_experiment("sine_stream")
    closed.advance(8.0)
    for flywheel in closed.plant_side.plant.flywheels:  # type: ignore[attr-defined]
        flywheel.on = False
    closed.until(lambda: closed.loop.mode is not Mode.RUNNING, 40.0)
    assert closed.loop.mode is Mode.DISARMED
    assert "the flywheels do not keep their speed" in closed.loop.reason
    assert "check the inverters of the flywheels" in closed.loop.reason


def test_a_flywheel_that_falls_silent_ends_a_run_in_order(tmp_path: Path) -> None:
    closed = ClosedLoop(with_flywheels(tmp_path))
    closed.loop.start_experiment("hold")
    closed.advance(8.0)
    closed.plant_side.speed_reports.silent[0] = True
    closed.until(lambda: closed.loop.mode is not Mode.RUNNING, 40.0)
    assert closed.loop.mode is Mode.DISARMED
    assert "a flywheel does not report its speed any more" in closed.loop.reason
    momentum = closed.recording("hold")["angular_momentum"]
    assert np.isnan(momentum[-1])
    assert np.isfinite(momentum[500])


def test_what_was_not_measured_is_not_accepted_and_not_used(tmp_path: Path) -> None:
    vehicle = with_flywheels(tmp_path)
    closed = ClosedLoop(vehicle, configure=standing)
    closed.plant_side.speed_reports.silent[1] = True
    closed.run("spin_up")
    recording = closed.recording("spin_up")
    assert np.isnan(recording["angular_momentum"]).all()
    assert measured(vehicle, [recording]) == {}
    for evaluation in (spin_up, run_down):
        with pytest.raises(CommissioningError, match="does not report its speed"):
            evaluation(vehicle, [recording])


def test_a_flywheel_that_turns_the_wrong_way_and_one_that_is_silent_are_named(tmp_path: Path) -> None:
    def reversed_right(configuration: SimulationConfig) -> SimulationConfig:
        left, right = configuration.speeds
        return replace(configuration, speeds=[left, replace(right, unit=-right.unit)])

    closed = ClosedLoop(with_flywheels(tmp_path), configure=reversed_right)
    (refusal,) = closed.loop.obstacles("hold")
    assert refusal.startswith(
        "flywheel_right turns the wrong way (flywheel_left 6000, flywheel_right -6000 of 6000 rpm)"
    )

    closed = ClosedLoop(with_flywheels(tmp_path))
    closed.plant_side.speed_reports.silent[1] = True
    closed.advance(1.5)
    (refusal,) = closed.loop.obstacles("hold")
    assert refusal.startswith("flywheel_right does not report its speed")
    for _ in range(3):
        closed.loop.io.handle(CanFrame(1, 0x195, b"\x01"))
    with pytest.raises(VirtualRunError, match=r"does not report its speed \(3 frames with its can_id were too short\)"):
        closed.run("hold")


def test_an_identification_takes_the_angular_momentum_from_the_measured_speeds(tmp_path: Path) -> None:
    """With flywheels 3 % slow, all torques are 3 % smaller than the file says: so would be all estimates."""
    vehicle = with_flywheels(tmp_path)
    recording = record(vehicle, "multisine", configure=slower(0.97), duration=12.0)
    (value, std) = measured(vehicle, [recording])["angular_momentum"]
    assert value == pytest.approx(0.97 * 3300.0, abs=1.0)
    assert std == pytest.approx(value * hypot(0.012, 0.012) / (2.0 * 2.626), rel=0.01)

    def inertia(of: VehicleFile) -> float:
        found = identified([recording], of, methods=["prediction_error"]).document
        return float(found["methods"]["prediction_error"]["parameters"]["inertia"]["value"])

    searched = diagnosed([recording], vehicle, candidates=["static_torque"]).model
    for model in (searched, as_measured(MONOCAB_ROLL, vehicle, [recording])):
        assert model.values["angular_momentum"] == value
    blind, seeing = inertia(load("monocab")), inertia(vehicle)
    assert blind / seeing == pytest.approx(1.0 / 0.97, rel=1e-3)
    assert seeing == pytest.approx(1650.0, rel=0.005)


def test_the_steps_of_a_vehicle_are_those_that_it_can_do(tmp_path: Path) -> None:
    seeing, blind = (
        {each.id: each for each in steps_for(vehicle).step} for vehicle in (with_flywheels(tmp_path), load("monocab"))
    )
    assert seeing.keys() - blind.keys() == {"spin_up", "run_down"}
    assert blind.keys() - seeing.keys() == {"flywheels"}
    assert (seeing["step"].needs, blind["step"].needs) == (["spin_up"], ["flywheels"])


def test_a_virtual_vehicle_has_as_many_flywheels_as_its_plant(tmp_path: Path) -> None:
    vehicle = with_flywheels(tmp_path)
    with pytest.raises(SimulationError, match="1 flywheels report their speed, and a MONOCAB has 2"):
        ClosedLoop(vehicle.model_copy(update={"flywheel": vehicle.flywheel[:1]}))
