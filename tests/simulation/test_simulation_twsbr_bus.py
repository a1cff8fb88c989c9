"""The motor controllers and the IMU of the virtual balancing robot on the bus."""

from __future__ import annotations

import math
import struct
import threading
from dataclasses import replace
from pathlib import Path

import can
import canopen
import numpy as np
import pytest
from simulated_bus import DISABLE_VOLTAGE, MASTER, QUICK_STOP, SHUTDOWN, SWITCH_ON, Harness
from twsbr_plant import IMU, PITCH, RATE, TRUTH, Balancer

from upright.drivers.imu.imu import Imu
from upright.drivers.imu.layout import ImuConfig
from upright.simulation.bus.object_dictionary import SimulationError
from upright.simulation.bus.power_state import PowerState
from upright.simulation.config import DriveNode, SimulationConfig
from upright.simulation.faults import parse_faults
from upright.simulation.runner import Runner
from upright.simulation.twsbr.plant import TwsbrPlant
from upright.simulation.twsbr.truth import TwsbrTruth
from upright.telemetry.samples import CanFrame

EDS = Path(__file__).resolve().parents[2] / "drivers" / "eds" / "upright_motor.eds"
FLOOR_DEG = math.degrees(TRUTH.floor_angle)
ENABLE = 0x0F


def wheel_nodes(**changes: object) -> tuple[DriveNode, ...]:
    """The two motor controllers, in units of a wheel turn; the right one is mirrored."""
    node = DriveNode(
        name="left_wheel",
        role="wheel",
        node=1,
        direction=1,
        axis_per_turn=2.0 * math.pi,
        increments_per_turn=700,
        velocity_unit_rpm=1.0 / 8192.0,
        rated_torque=0.5,
        eds=EDS,
        mode=-1,
        rpdo=(("controlword", "target_voltage"),),
        tpdo=(("statusword", "position_actual"), ("velocity_actual", "torque_actual")),
    )
    nodes = (node, replace(node, name="right_wheel", node=2, direction=-1))
    return tuple(replace(node, **changes) for node in nodes)  # type: ignore[arg-type]


def configuration(truth: TwsbrTruth = TRUTH) -> SimulationConfig:
    return SimulationConfig(drives=wheel_nodes(), plant=truth, rate=RATE, imu=IMU)


class Robot(Harness):
    """The master of the other tests, with volts instead of rpm and with two nodes."""

    def set_up(self, mode: int = -1, timeout_ms: int = 120, reaction: int = 3) -> None:
        for node in (1, 2):
            assert self.sdo(node, 0x6060, 0, mode, 1) >= 0
            assert self.sdo(node, 0x1016, 1, MASTER << 16 | timeout_ms) >= 0
            assert self.sdo(node, 0x6007, 0, reaction, 2) >= 0
        self.nmt(1)

    def cycle(self, controlword: int, volts: float = 0.0, *, heartbeat: bool = True, rpdo: bool = True) -> None:
        if rpdo:
            for node, sign in ((1, 1), (2, -1)):
                target = round(sign * volts * 1000.0)
                self.vehicle.receive(0x200 + node, struct.pack("<Hh", controlword, target))
        self.vehicle.advance_steps(self.config.steps_per_ms)
        self.vehicle.receive(0x080, b"")
        if heartbeat:
            self.vehicle.receive(0x700 + MASTER, b"\x05")
        self.vehicle.advance_steps(self.config.steps_per_period - self.config.steps_per_ms)
        self.vehicle.begin_cycle()

    def enable(self) -> None:
        for controlword in (DISABLE_VOLTAGE, SHUTDOWN, SWITCH_ON, ENABLE):
            self.cycles(0.1, controlword)

    @property
    def robot(self) -> TwsbrPlant:
        assert isinstance(self.vehicle.plant, TwsbrPlant)
        return self.vehicle.plant

    @property
    def states(self) -> list[PowerState]:
        return [drive.state for drive in self.vehicle.drives.values()]

    def actual(self, node: int) -> tuple[int, int, int, int]:
        """Statusword, position, velocity and torque as last sent by the drive."""
        word, position = struct.unpack("<Hi", self.frames(0x180 + node)[-1])
        return word, position, *struct.unpack("<ih", self.frames(0x280 + node)[-1])


@pytest.fixture
def bus() -> Robot:
    bus = Robot(configuration())
    bus.set_up()
    return bus


def test_master_enables_both_motors_in_voltage_mode(bus: Robot) -> None:
    bus.enable()
    words = [struct.unpack_from("<H", data)[0] & 0x6F for data in bus.frames(0x181)]
    assert [word for i, word in enumerate(words) if i == 0 or word != words[i - 1]] == [0x00, 0x40, 0x21, 0x23, 0x27]
    assert bus.states == [PowerState.OPERATION_ENABLED] * 2
    assert bus.sdo(1, 0x6061) & 0xFF == 0xFF
    assert bus.sdo(1, 0x6502) == 1 << 16
    assert bus.sdo(1, 0x6060, 0, 2, 1) == -0x06090030


def test_target_voltage_turns_both_wheels_forward(bus: Robot) -> None:
    """2 V lift the robot off its bumper and throw it onto the other one; on the way both encoders count forwards."""
    bus.enable()
    bus.cycles(0.05, ENABLE, 2.0)
    assert bus.sdo(1, 0x2401) == pytest.approx(2000, abs=24)
    for node, sign in ((1, 1), (2, -1)):
        _, position, velocity, torque = bus.actual(node)
        motor = bus.robot.motors[node - 1]
        assert sign * position * PITCH == pytest.approx(motor.measured_position, abs=3.0 * PITCH)
        assert sign * position > 0
        assert sign * velocity > 0
        assert sign * torque > 0
    assert bus.robot.motors[0].wheel_rate == pytest.approx(bus.robot.motors[1].wheel_rate, rel=1e-9)


def test_voltage_beyond_the_supply_is_limited_and_reported(bus: Robot) -> None:
    bus.enable()
    bus.cycle(ENABLE, 12.0)
    assert not bus.actual(1)[0] & 0x800
    bus.cycles(0.02, ENABLE, 14.0)
    assert bus.actual(1)[0] & 0x800
    assert bus.sdo(1, 0x2401) == 12_000
    assert bus.robot.motors[0].demand == 12.0


@pytest.mark.parametrize("controlword", [ENABLE | 0x100, SWITCH_ON])
def test_halt_and_disable_remove_the_voltage(bus: Robot, controlword: int) -> None:
    bus.enable()
    bus.cycles(0.05, ENABLE, 3.0)
    bus.cycles(0.05, controlword, 3.0)
    assert [motor.target for motor in bus.robot.motors] == [0.0, 0.0]


def test_motors_without_a_mode_have_no_voltage() -> None:
    bus = Robot(configuration())
    bus.nmt(1)
    bus.enable()
    bus.cycles(0.05, ENABLE, 3.0)
    assert bus.states == [PowerState.OPERATION_ENABLED] * 2
    assert [motor.duty for motor in bus.robot.motors] == [0.0, 0.0]


def test_quick_stop_shorts_the_motors_and_then_opens_the_bridges(bus: Robot) -> None:
    bus.enable()
    bus.cycles(0.1, ENABLE, 6.0)
    bus.cycle(QUICK_STOP, 6.0)
    assert bus.states == [PowerState.QUICK_STOP_ACTIVE] * 2
    assert [(motor.powered, motor.target) for motor in bus.robot.motors] == [(True, 0.0)] * 2
    bus.cycles(2.2, QUICK_STOP)
    assert bus.states == [PowerState.SWITCH_ON_DISABLED] * 2
    assert not any(motor.powered for motor in bus.robot.motors)


def test_loss_of_the_masters_heartbeat_removes_the_voltage(bus: Robot) -> None:
    bus.enable()
    bus.cycles(0.135, ENABLE, 4.0, heartbeat=False)
    assert [bus.emergencies(node) for node in (1, 2)] == [[0x8130]] * 2
    assert [motor.target for motor in bus.robot.motors] == [0.0, 0.0]
    bus.cycles(2.5, ENABLE, 4.0, heartbeat=False)
    assert bus.states == [PowerState.FAULT] * 2
    assert math.degrees(abs(bus.robot.tilt)) == pytest.approx(FLOOR_DEG, abs=0.2)


def test_fault_of_one_motor_opens_its_bridge() -> None:
    bus = Robot(configuration(), faults=parse_faults(["drive_fault:right_wheel@0.5"], ["left_wheel", "right_wheel"]))
    bus.set_up()
    bus.enable()
    bus.cycles(0.2, ENABLE, 2.0)
    assert bus.states == [PowerState.OPERATION_ENABLED, PowerState.FAULT]
    assert not bus.robot.motors[1].powered
    assert bus.robot.yaw < 0.0


def test_control_loop_over_the_bus_balances_the_robot(bus: Robot) -> None:
    """Raised from the bumper with the IMU's frames as decoded by the driver, through the square wave, within 3 deg."""
    imu = Imu(
        ImuConfig(
            protocol=IMU.protocol,
            base_id=IMU.base_id,
            precision=IMU.precision,
            slots=tuple(IMU.slots),
            rate=RATE,
            axes=IMU.axes,
            acceleration_sign=1,
            angular_rate_unit=IMU.angular_rate_unit,
        )
    )
    bus.enable()
    balancer, tilts, volts = Balancer(8.0), [], 0.0
    for _ in range(4 * RATE):
        bus.sent.clear()
        bus.cycle(ENABLE, volts)
        sample = None
        for stamp, can_id, data in bus.sent:
            sample = imu.handle(CanFrame(stamp, can_id, data)) or sample
        assert sample is not None
        volts = max(-12.0, min(12.0, balancer.measured(sample.acceleration, sample.angular_rate)))
        tilts.append(bus.robot.tilt)
    assert math.degrees(tilts[0]) > 11.9
    assert math.degrees(np.abs(tilts[RATE:]).max()) < 3.0


def test_imu_of_the_resting_robot_shows_the_floor_angle(bus: Robot) -> None:
    bus.cycles(0.1, DISABLE_VOLTAGE)
    (x,) = struct.unpack_from("<f", bus.frames(0x18A)[-1])
    assert math.degrees(math.asin(-x)) == pytest.approx(FLOOR_DEG, abs=0.5)


def test_drives_that_do_not_suit_the_robot_are_refused() -> None:
    nodes = wheel_nodes()
    with pytest.raises(SimulationError, match="1 trim drives, a balancing robot has 0"):
        Robot(replace(configuration(), drives=(*nodes, replace(nodes[0], name="trim", role="trim", node=3))))
    with pytest.raises(SimulationError, match=r"6042h \(target_velocity\)"):
        Robot(replace(configuration(), drives=wheel_nodes(mode=2, rpdo=(("controlword", "target_velocity"),))))


def test_plain_canopen_master_runs_the_robot_on_a_python_can_bus(request: pytest.FixtureRequest) -> None:
    channel = request.node.name
    bus = can.Bus(interface="virtual", channel=channel, preserve_timestamps=True)
    other = can.Bus(interface="virtual", channel=channel, preserve_timestamps=True)
    stop = threading.Event()
    runner = Runner(configuration(), bus, lock_step=True, stop=stop)
    thread = threading.Thread(target=runner.run)
    network = canopen.Network(other)
    network.notifier = can.Notifier(other, network.listeners, 0.05)
    thread.start()
    try:
        nodes = [network.add_node(node, str(EDS)) for node in (1, 2)]
        imu_set = threading.Event()
        network.subscribe(0x38A, lambda *_: imu_set.set())
        for node in nodes:
            node.sdo[0x6060].raw = -1
            node.nmt.state = "OPERATIONAL"
        node.rpdo.read()
        assert [variable.index for variable in node.rpdo[1].map] == [0x6040, 0x2400]
        node.tpdo.read()
        assert [variable.index for variable in node.tpdo[1].map] == [0x6041, 0x6064]
        for controlword, cycles, volts in ((0, 15, 0), (6, 15, 0), (7, 15, 0), (15, 15, 0), (15, 20, 3000)):
            for _ in range(cycles):
                assert imu_set.wait(5.0)
                imu_set.clear()
                for node_id, sign in ((1, 1), (2, -1)):
                    network.send_message(0x200 + node_id, struct.pack("<Hh", controlword, sign * volts))
                network.send_message(0x080, b"")
        assert nodes[0].sdo[0x6061].raw == -1
        assert nodes[0].sdo[0x6041].raw & 0x6F == 0x27
        assert nodes[0].sdo[0x2401].raw == pytest.approx(3000, abs=24)
        assert nodes[0].sdo[0x6064].raw > 5
        assert nodes[1].sdo[0x6064].raw < -5
    finally:
        stop.set()
        thread.join(5.0)
        network.disconnect()
        bus.shutdown()
    assert not thread.is_alive()
