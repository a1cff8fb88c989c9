"""The safety verdict: every reason, its reaction, its text, and when it does not apply."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from upright.drivers.imu.imu import ImuHealth
from upright.service.control.cycle.safety import DriveObservation, Observation, Safety
from upright.vehicles.bounds import OK, Code, Reaction
from upright.vehicles.cube.kind import CubeCode
from upright.vehicles.file import load
from upright.vehicles.monocab.axes import GimbalMeasurement
from upright.vehicles.monocab.kind import MonocabCode, bounds
from upright.vehicles.twsbr.kind import TwsbrCode

VEHICLE = load("monocab")
SAFETY = Safety(
    bounds(VEHICLE), missed_cycles=VEHICLE.limits.missed_cycles, period=VEHICLE.period, heartbeat_timeout=0.14
)
STILL = GimbalMeasurement(1, 0.0, 0.0, 0.0, 0.0, 0.0)
AS_MODELLED = SimpleNamespace(gimbal_following=0.0, trim_following=0.0, jump=0.0, gained=0.0, recovery=0.1)


def balancing() -> Observation:
    """An observation without a fault, in the middle of an experiment."""
    drives = tuple(
        DriveObservation(name, age=0.004, enabled=True, state="Operation enabled")
        for name in ("gimbal_left", "gimbal_right", "trim")
    )
    return Observation(
        drives=drives,
        armed=True,
        should_run=True,
        balancing=True,
        upright=True,
        imu_age=0.004,
        angle=0.01,
        axes=STILL,
        watched=AS_MODELLED,
    )


def drive(**changes: object) -> Callable[[Observation], None]:
    def spoil(seen: Observation) -> None:
        left, right, trim = seen.drives
        seen.drives = (left, replace(right, **changes), trim)  # type: ignore[arg-type]

    return spoil


def field(**changes: object) -> Callable[[Observation], None]:
    def spoil(seen: Observation) -> None:
        for name, value in changes.items():
            setattr(seen, name, value)

    return spoil


def axes(**changes: object) -> Callable[[Observation], None]:
    def spoil(seen: Observation) -> None:
        seen.axes = replace(STILL, **changes)  # type: ignore[arg-type]

    return spoil


def watched(**changes: float) -> Callable[[Observation], None]:
    def spoil(seen: Observation) -> None:
        seen.watched = SimpleNamespace(**{**vars(AS_MODELLED), **changes})

    return spoil


NAN = math.nan
ALWAYS = [
    (field(imu_age=0.040), Code.IMU_SILENT, ("40.0 ms", "7 cycles")),
    (field(imu_age=NAN), Code.IMU_SILENT, ()),
    (field(imu_health=ImuHealth.SILENT), Code.IMU_SILENT, ()),
    (field(imu_health=ImuHealth.STUCK, imu_text="IMU repeats itself"), Code.IMU_STUCK, ("IMU repeats itself",)),
    (field(imu_frozen=8), Code.IMU_TIME, ("9 IMU frame sets", "same time stamp")),
    (field(imu_health=ImuHealth.OUT_OF_RANGE), Code.IMU_OUT_OF_RANGE, ("out of range",)),
    (field(imu_health=ImuHealth.WRONG_LENGTH), Code.IMU_FORMAT, ("another format",)),
    (field(angle=0.1), MonocabCode.ROLL, ("5.73 deg", "5.00 deg")),
    (field(angle=-0.1), MonocabCode.ROLL, ("-5.73 deg",)),
    (field(angle=NAN), Code.NOT_FINITE, ("roll", "not a number")),
    (field(rate=0.8), MonocabCode.ROLL_RATE, ("45.84 deg/s", "40.00 deg/s")),
    (field(rate=math.inf), Code.NOT_FINITE, ("roll rate",)),
]
ARMED = [
    (drive(age=0.040), Code.DRIVE_SILENT, ("gimbal_right", "40.0 ms")),
    (drive(age=NAN), Code.DRIVE_SILENT, ("gimbal_right",)),
    (drive(emergency="8130h heartbeat lost", emergency_code=0x8130), Code.DRIVE_EMERGENCY, ("gimbal_right", "8130h")),
    (drive(emergency="8250h RPDO timeout", emergency_code=0x8250), Code.DRIVE_EMERGENCY, ("gimbal_right", "8250h")),
    (drive(restarted=True), Code.DRIVE_RESTARTED, ("gimbal_right",)),
    (drive(remote=False), Code.DRIVE_NOT_REMOTE, ("gimbal_right", "bit 9")),
    (axes(precession=1.1), MonocabCode.PRECESSION, ("63.03 deg", "60.00 deg")),
    (axes(precession=NAN), Code.NOT_FINITE, ("precession",)),
    (axes(precession_rate=-1.6), MonocabCode.PRECESSION_RATE, ("-91.67 deg/s",)),
    (axes(gimbal_mismatch=0.1), MonocabCode.GIMBAL_MISMATCH, ("5.73 deg",)),
    (axes(trim_position=-0.31), MonocabCode.TRIM_POSITION, ("-0.310 m", "0.300 m")),
    (axes(trim_rate=0.16), MonocabCode.TRIM_RATE, ("trim mass rate of 0.160 m/s", "0.150 m/s")),
    (axes(trim_position=NAN), Code.NOT_FINITE, ("trim",)),
    (watched(gimbal_following=0.01), MonocabCode.GIMBAL_FOLLOWING, ("do not follow", "0.57 deg", "0.10 deg")),
    (field(late_cycles=7), Code.DEADLINE, ("7 control cycles", "4 ms")),
]
UPRIGHT = [
    (field(angle=-0.066), MonocabCode.FALLEN, ("lies on its support", "-3.78 deg", "3.70 deg")),
    (watched(jump=0.05), Code.GYRO_JUMP, ("the gyro jumps", "2.86 deg/s")),
    (watched(recovery=1.2), MonocabCode.RECOVERY, ("cannot bring", "120 %")),
    (watched(recovery=NAN), Code.NOT_FINITE, ("precession that is left",)),
]
WHILE_BALANCING = [
    (field(contradiction=6.5), Code.IMU_CONTRADICTION, ("contradict each other", "6.5 standard deviations")),
    (field(contradiction=NAN), Code.NOT_FINITE, ("accelerometer and gyro",)),
]
ARMED_IN_ORDER = [
    (watched(trim_following=0.004), MonocabCode.TRIM_FOLLOWING, ("does not follow", "4.0 of 2 mm", "moves freely")),
]
UPRIGHT_IN_ORDER = [
    (watched(gained=0.1), MonocabCode.TORQUE_BALANCE, ("no torque explains", "5.7 of 5 deg/s", "flywheels")),
]
SHOULD_RUN = [
    (drive(enabled=False, state="Quick stop active"), Code.DRIVE_NOT_ENABLED, ("Quick stop active",)),
    (drive(voltage=False), Code.DRIVE_NO_VOLTAGE, ("gimbal_right", "no torque", "bit 4")),
]
IN_ORDER = [
    (drive(emergency="FF01h vendor-specific", emergency_code=0xFF01), Code.DRIVE_WARNING, ("gimbal_right", "FF01h")),
    (drive(heartbeat_age=0.2), Code.DRIVE_HEARTBEAT, ("gimbal_right", "200 ms")),
    (drive(heartbeat_age=NAN), Code.DRIVE_HEARTBEAT, ("gimbal_right",)),
    (field(foreign_request="somebody else"), Code.FOREIGN_SDO, ("somebody else",)),
]
BALANCING = [
    (watched(recovery=0.8), MonocabCode.RECOVERY, ("leave too little", "80.0 of 70 %")),
    (axes(precession=0.8), MonocabCode.PRECESSION_BUDGET, ("45.8 of 45 deg",)),
    (axes(precession=-0.8), MonocabCode.PRECESSION_BUDGET, ("-45.8",)),
    (field(observer_alive=False), Code.OBSERVER_GONE, ("observer",)),
]


def test_verdict_without_a_fault_is_the_constant_ok() -> None:
    assert SAFETY.judge(balancing()) is OK
    assert OK.reaction is Reaction.CONTINUE


@pytest.mark.parametrize(("spoil", "code", "words"), ALWAYS + ARMED + SHOULD_RUN + UPRIGHT + WHILE_BALANCING)
def test_state_that_cannot_be_controlled_stops_immediately(
    spoil: Callable[[Observation], None], code: Code, words: tuple[str, ...]
) -> None:
    seen = balancing()
    spoil(seen)
    verdict = SAFETY.judge(seen)
    assert (verdict.code, verdict.reaction) == (code, Reaction.STOP_NOW)
    assert all(word in verdict.text for word in words), verdict.text


@pytest.mark.parametrize(("spoil", "code", "words"), BALANCING + IN_ORDER + ARMED_IN_ORDER + UPRIGHT_IN_ORDER)
def test_state_that_can_still_be_controlled_ends_in_order(
    spoil: Callable[[Observation], None], code: Code, words: tuple[str, ...]
) -> None:
    seen = balancing()
    spoil(seen)
    verdict = SAFETY.judge(seen)
    assert (verdict.code, verdict.reaction) == (code, Reaction.END_EXPERIMENT)
    assert all(word in verdict.text for word in words), verdict.text


@pytest.mark.parametrize(
    ("flag", "cases"),
    [
        ("armed", ARMED + ARMED_IN_ORDER + SHOULD_RUN + BALANCING + IN_ORDER),
        ("should_run", SHOULD_RUN),
        ("balancing", BALANCING + WHILE_BALANCING),
        ("upright", UPRIGHT + UPRIGHT_IN_ORDER),
    ],
)
def test_checks_of_a_phase_do_not_apply_outside_it(
    flag: str, cases: list[tuple[Callable[[Observation], None], Code]]
) -> None:
    for spoil, *_ in cases:
        seen = balancing()
        setattr(seen, flag, False)
        spoil(seen)
        assert SAFETY.judge(seen) is OK


def test_imu_and_roll_are_monitored_in_every_phase() -> None:
    for spoil, code, _ in ALWAYS:
        seen = balancing()
        seen.armed = seen.should_run = seen.balancing = False
        spoil(seen)
        assert SAFETY.judge(seen).code is code


def test_resting_on_a_support_is_not_a_fault() -> None:
    seen = balancing()
    seen.upright = False
    seen.angle = math.radians(4.1)
    assert SAFETY.judge(seen) is OK


def test_seven_missed_cycles_are_tolerated_and_the_eighth_is_not() -> None:
    """`missed_cycles = 7` at 4 ms, with half a cycle of jitter."""
    for age, code in ((0.0285, Code.OK), (0.0299, Code.OK), (0.0301, Code.DRIVE_SILENT)):
        seen = balancing()
        drive(age=age)(seen)
        assert SAFETY.judge(seen).code is code


def test_cause_is_named_before_its_consequence() -> None:
    """A drive with an emergency also leaves Operation enabled; a dead IMU also leaves roll undefined."""
    seen = balancing()
    drive(emergency="2310h overcurrent", enabled=False, state="Fault")(seen)
    assert SAFETY.judge(seen).code is Code.DRIVE_EMERGENCY
    seen.imu_age, seen.angle = 0.1, NAN
    assert SAFETY.judge(seen).code is Code.IMU_SILENT


def test_warning_of_a_drive_hides_no_fault() -> None:
    for spoil, code, _ in ARMED[4:]:
        seen = balancing()
        seen.drives[0].emergency, seen.drives[0].emergency_code = "FF01h", 0xFF01
        spoil(seen)
        assert SAFETY.judge(seen).code is code


def test_emergency_with_a_fault_is_no_mere_warning() -> None:
    seen = balancing()
    seen.should_run = False
    drive(emergency="FF01h", emergency_code=0xFF01, faulty=True)(seen)
    assert SAFETY.judge(seen).code is Code.DRIVE_EMERGENCY


def test_hard_limit_takes_precedence_over_the_budget() -> None:
    seen = balancing()
    seen.axes = replace(STILL, precession=1.2)
    assert SAFETY.judge(seen).reaction is Reaction.STOP_NOW


@pytest.mark.parametrize(("ending", "_", "__"), BALANCING + IN_ORDER + ARMED_IN_ORDER + UPRIGHT_IN_ORDER)
def test_what_stops_is_not_hidden_by_what_ends_in_order(
    ending: Callable[[Observation], None], _: Code, __: tuple[str, ...]
) -> None:
    """An experiment that is being ended goes on for seconds, and its reason with it."""
    stops = [field(late_cycles=7), field(contradiction=6.5), field(angle=-0.066), drive(voltage=False)]
    for stopping in stops:
        seen = balancing()
        ending(seen)
        stopping(seen)
        assert SAFETY.judge(seen).reaction is Reaction.STOP_NOW


def test_nearest_limit_is_the_one_of_which_most_is_used() -> None:
    seen = balancing()
    seen.watched = SimpleNamespace(**{**vars(AS_MODELLED), "recovery": 0.35})
    found = SAFETY.nearest(seen)
    assert found is not None
    bound, share = found
    assert (bound.code, share) == (MonocabCode.RECOVERY, pytest.approx(0.5))
    seen.upright = False
    seen.angle = NAN
    found = SAFETY.nearest(seen)
    assert found is None or found[1] == 0.0


def test_every_code_is_in_the_reference() -> None:
    page = (Path(__file__).parents[3] / "docs" / "reference" / "faults.md").read_text()
    codes: list[str] = [*Code, *MonocabCode, *TwsbrCode, *CubeCode]
    assert [code for code in codes if code != Code.OK and f"`{code}`" not in page] == []
